"""Replace the direct junctions of an OpenDRIVE map (1.7 and 1.8) by connecting roads, which netconvert can read.

In a direct junction, roads meet end to end: a connection names the two roads (``incomingRoad``, ``linkedRoad``) and the
lanes that lead to each other. Each pair of lanes gets a connecting road of :data:`LENGTH_M` from the lane that vehicles
leave to the lane that they enter. Source: ASAM OpenDRIVE 1.8.0, direct junctions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from egvs.extensions.maps.formats.opendrive import ContactPoint, LaneSection, OpenDriveMap, Road, evaluate

LENGTH_M = 0.1


class _LaneEnd(NamedTuple):
    """A lane at an end of a road."""

    road: Road
    end: ContactPoint
    lane: int

    def is_left(self, forward: int) -> bool:
        """Return whether vehicles leave the road here; ``forward`` is the sign of lanes that lead along their roads."""
        return (self.lane * forward > 0) == (self.end == "end")


def replace_direct_connections(junction: Element, road_map: OpenDriveMap, *, lefthand: bool) -> list[Element]:
    """Let a junction refer to new connecting roads, and return these.

    Parameters
    ----------
    junction
        A ``<junction>``; its connections with a ``linkedRoad`` are replaced, those that name only one road are removed.
    road_map
        The map.
    lefthand
        Whether lanes with positive ids lead along their roads.
    """
    roads: list[Element] = []
    name = junction.get("id", "")
    forward = 1 if lefthand else -1
    for connection in junction.findall("connection"):
        if "connectingRoad" in connection.attrib and "incomingRoad" in connection.attrib:
            continue
        junction.remove(connection)
        for source, target in _joined_lanes(connection, name, road_map, forward):
            road_id = f"{name}-direct-{len(roads)}"
            roads.append(_connecting_road(road_id, name, source, target, forward))
            values = {"id": road_id, "incomingRoad": source.road.id, "connectingRoad": road_id, "contactPoint": "start"}
            replaced = SubElement(junction, "connection", values)
            SubElement(replaced, "laneLink", {"from": str(source.lane), "to": str(forward)})
    return roads


def _joined_lanes(
    connection: Element, junction: str, road_map: OpenDriveMap, forward: int
) -> Iterator[tuple[_LaneEnd, _LaneEnd]]:
    """Yield the lanes that vehicles leave and enter."""
    incoming = road_map.roads.get(connection.get("incomingRoad", ""))
    linked = road_map.roads.get(connection.get("linkedRoad", ""))
    if incoming is None or linked is None or not incoming.sections or not linked.sections:
        return
    linked_end: ContactPoint = "end" if connection.get("contactPoint") == "end" else "start"
    incoming_end = _end_at(incoming, junction, _point(linked, linked_end))
    if incoming_end is None:
        return
    for link in connection.iterfind("laneLink"):
        first = _LaneEnd(incoming, incoming_end, int(link.attrib["from"]))
        second = _LaneEnd(linked, linked_end, int(link.attrib["to"]))
        if not all(end.lane in _section(end).lanes for end in (first, second)):
            continue
        if first.is_left(forward) and not second.is_left(forward):
            yield first, second
        elif second.is_left(forward) and not first.is_left(forward):
            yield second, first


def _end_at(road: Road, junction: str, point: tuple[float, float]) -> ContactPoint | None:
    """Return the end of a road at a junction; where both are, the one that is nearer to a point."""
    ends: list[ContactPoint] = []
    for end, link in (("start", road.predecessor), ("end", road.successor)):
        if link is not None and link.kind == "junction" and link.id == junction:
            ends.append("start" if end == "start" else "end")
    return min(ends, key=lambda end: math.dist(_point(road, end), point), default=None)


def _pose(road: Road, end: ContactPoint) -> tuple[float, float, float]:
    x, y, heading = road.reference_line(np.array([0.0 if end == "start" else road.length_m]))[0].tolist()
    return x, y, heading


def _point(road: Road, end: ContactPoint) -> tuple[float, float]:
    return _pose(road, end)[:2]


def _section(end: _LaneEnd) -> LaneSection:
    return end.road.sections[0 if end.end == "start" else -1]


def _connecting_road(road_id: str, junction: str, source: _LaneEnd, target: _LaneEnd, forward: int) -> Element:
    """Return a short road with one lane in the direction of traffic, where the lane of ``source`` ends."""
    section = _section(source)
    s_m = np.array([0.0 if source.end == "start" else source.road.length_m])
    width_m = float(evaluate(section.lanes[source.lane].widths, s_m - section.start_m)[0])
    line = source.road.lane_line(section, source.lane)
    x, y, z = line[0 if source.end == "start" else -1].tolist()
    heading = _pose(source.road, source.end)[2] + (math.pi if source.end == "start" else 0.0)
    to_reference_m = -forward * width_m / 2  # to the left of the lane where traffic keeps to the right
    x -= to_reference_m * math.sin(heading)
    y += to_reference_m * math.cos(heading)

    road = Element("road", {"id": road_id, "junction": junction, "length": repr(LENGTH_M)})
    links = SubElement(road, "link")
    for tag, lane_end in (("predecessor", source), ("successor", target)):
        values = {"elementType": "road", "elementId": lane_end.road.id, "contactPoint": lane_end.end}
        SubElement(links, tag, values)
    plan = SubElement(road, "planView")
    start = {"s": "0", "x": repr(x), "y": repr(y), "hdg": repr(heading), "length": repr(LENGTH_M)}
    SubElement(SubElement(plan, "geometry", start), "line")
    profile = SubElement(road, "elevationProfile")
    SubElement(profile, "elevation", {"s": "0", "a": repr(z), "b": "0", "c": "0", "d": "0"})
    lanes = SubElement(SubElement(road, "lanes"), "laneSection", {"s": "0"})
    SubElement(SubElement(lanes, "center"), "lane", {"id": "0", "type": "none"})
    side = SubElement(lanes, "right" if forward < 0 else "left")
    lane = SubElement(side, "lane", {"id": str(forward), "type": section.lanes[source.lane].type})
    links = SubElement(lane, "link")
    SubElement(links, "predecessor", {"id": str(source.lane)})
    SubElement(links, "successor", {"id": str(target.lane)})
    SubElement(lane, "width", {"sOffset": "0", "a": repr(width_m), "b": "0", "c": "0", "d": "0"})
    return road
