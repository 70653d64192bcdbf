"""Find which lane leads to which in an OpenDRIVE map.

A lane ends where its road, or its lane section, ends. Steps for each lane for vehicles: follow the lane links to the
next section or road; through a junction, follow each connection that starts at the lane, along the connecting roads,
to the next road that is in no junction.

Lanes of connecting roads are no lanes of the result: SUMO makes them lanes inside a junction.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

from egvs.extensions.maps.formats.opendrive import ContactPoint, LaneLink, LaneSection, Link, OpenDriveMap, Road

DRIVING_TYPES = frozenset(
    {"driving", "entry", "exit", "offRamp", "onRamp", "connectingRamp", "slipLane", "mwyEntry", "mwyExit",
     "bidirectional", "bus", "taxi", "HOV"}
)  # fmt: skip
"""Types of lanes for vehicles."""

_MAX_ROADS = 20
"""No way through a junction has more connecting roads, except in a circle."""


class LaneKey(NamedTuple):
    """A lane: its road, the number of the section, and its id."""

    road: str
    section: int
    lane: int


class Turn(NamedTuple):
    """A lane that leads to another; ``junction`` is empty for a plain joint of roads or sections."""

    source: LaneKey
    target: LaneKey
    junction: str


def driving_lanes(road_map: OpenDriveMap) -> Iterator[LaneKey]:
    """Yield the lanes for vehicles of all roads between junctions."""
    for road in road_map.roads.values():
        if road.junction:
            continue
        for number, section in enumerate(road.sections):
            for lane in section.lanes.values():
                if lane.type in DRIVING_TYPES and _has_width(lane.widths):
                    yield LaneKey(road.id, number, lane.id)


def permitted_turns(road_map: OpenDriveMap) -> tuple[Turn, ...]:
    """Return which lane for vehicles leads to which, sorted; traffic keeps to the right.

    Links to roads or lanes that do not exist are left out.
    """
    turns = set()
    for key in driving_lanes(road_map):
        for target, junction in _next_lanes(road_map, key, key.lane < 0):
            turns.add(Turn(key, target, junction))
    return tuple(sorted(turns))


def mirrored(road_map: OpenDriveMap) -> OpenDriveMap:
    """Return a map in which the ids of all lanes change their sign, as if traffic kept to the other side."""
    roads = {
        road.id: replace(road, sections=tuple(map(_mirrored_section, road.sections)))
        for road in road_map.roads.values()
    }
    junctions = {
        junction: tuple(
            replace(connection, links=tuple(LaneLink(-pair.incoming, -pair.connecting) for pair in connection.links))
            for connection in connections
        )
        for junction, connections in road_map.junctions.items()
    }
    return replace(road_map, roads=roads, junctions=junctions)


def _mirrored_section(section: LaneSection) -> LaneSection:
    lanes = {}
    for lane in section.lanes.values():
        before, after = (tuple(-number for number in linked) for linked in (lane.predecessors, lane.successors))
        lanes[-lane.id] = replace(lane, id=-lane.id, predecessors=before, successors=after)
    return replace(section, lanes=lanes)


def _has_width(widths: tuple[object, ...]) -> bool:
    return bool(widths)


def _next_lanes(road_map: OpenDriveMap, key: LaneKey, forward: bool) -> Iterator[tuple[LaneKey, str]]:
    """Yield the lanes that a lane leads to, with the junction between."""
    road = road_map.roads[key.road]
    lane = road.sections[key.section].lanes[key.lane]
    linked = lane.successors if forward else lane.predecessors
    next_section = key.section + (1 if forward else -1)
    if 0 <= next_section < len(road.sections):
        for target in linked:
            if _is_driving(road, next_section, target):
                yield LaneKey(road.id, next_section, target), ""
        return

    link = road.successor if forward else road.predecessor
    if link is None:
        return
    if link.kind != "junction":
        for target in linked:
            for end in _enter(road_map, link, target, 0):
                yield end, ""
        return
    exit_end: ContactPoint = "end" if forward else "start"
    for connection in road_map.junctions.get(link.id, ()):
        if connection.incoming != road.id or not _touches(road_map, connection.connecting, connection.contact, road.id,
                                                          exit_end):  # fmt: skip
            continue
        for pair in connection.links:
            if pair.incoming == key.lane:
                at = Link("road", connection.connecting, connection.contact)
                for end in _enter(road_map, at, pair.connecting, 0):
                    yield end, link.id


def _touches(road_map: OpenDriveMap, connecting: str, contact: ContactPoint, road: str, end: ContactPoint) -> bool:
    """Return whether the contact point of a connecting road is at an end of a road, as far as its link says."""
    found = road_map.roads.get(connecting)
    link = None if found is None else found.predecessor if contact == "start" else found.successor
    return link is None or link.kind != "road" or link.id != road or link.contact == end


def _enter(road_map: OpenDriveMap, link: Link, lane: int, roads: int) -> Iterator[LaneKey]:
    """Yield the lanes between junctions that a lane leads to which is entered at an end of its road."""
    road = road_map.roads.get(link.id)
    if road is None or not road.sections or roads > _MAX_ROADS:
        return
    forward = link.contact == "start"
    section = 0 if forward else len(road.sections) - 1
    if not _is_driving(road, section, lane) or (lane < 0) != forward:
        return
    if not road.junction:
        yield LaneKey(road.id, section, lane)
        return
    for target, next_link in _through(road_map, road, section, lane, forward):
        yield from _enter(road_map, next_link, target, roads + 1)


def _through(road_map: OpenDriveMap, road: Road, section: int, lane: int, forward: bool) -> Iterator[tuple[int, Link]]:
    """Yield the lanes of the next road that a lane of a connecting road leads to, through all its sections.

    Where the road leads into another junction, these are lanes of the connecting roads there.
    """
    found = road.sections[section].lanes[lane]
    linked = found.successors if forward else found.predecessors
    next_section = section + (1 if forward else -1)
    if 0 <= next_section < len(road.sections):
        for target in linked:
            if _is_driving(road, next_section, target):
                yield from _through(road_map, road, next_section, target, forward)
        return
    link = road.successor if forward else road.predecessor
    if link is not None and link.kind == "road":
        for target in linked:
            yield target, link
    elif link is not None:
        for connection in road_map.junctions.get(link.id, ()):
            if connection.incoming == road.id:
                at = Link("road", connection.connecting, connection.contact)
                yield from ((pair.connecting, at) for pair in connection.links if pair.incoming == lane)


def _is_driving(road: Road, section: int, lane: int) -> bool:
    found = road.sections[section].lanes.get(lane)
    return found is not None and found.type in DRIVING_TYPES
