"""Where the road marks of an OpenDRIVE map forbid lane changes, which netconvert (1.28) ignores.

A network cannot forbid a change on a part of a lane. It is forbidden where the marks forbid it on more than half of
the lane's length.

World frame of the network: x, y of the map plus the network's ``netOffset`` and the header's offset, metres.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from xml.sax.saxutils import unescape

import numpy as np
import shapely
from scipy.spatial import KDTree

from egvs.core.grid import FloatArray
from egvs.extensions.maps.formats.opendrive import LaneSection, OpenDriveMap, Road
from egvs.extensions.maps.lane_changes import NO_CHANGE, open_unreachable_lanes
from egvs.extensions.maps.opendrive.check import MadeNetwork, NetworkLane
from egvs.extensions.maps.opendrive.turns import DRIVING_TYPES

_STEP_M = 1.0
_LANE_TAG = re.compile(r'<lane id="([^"]+)"')


@dataclass(frozen=True)
class ForbiddenChanges:
    """Forbidden lane changes in a network.

    Attributes
    ----------
    to_lanes
        The neighbouring lanes that vehicles may not change to, by edge and lane.
    opened
        Lanes, as edge and lane, that vehicles may change to although the marks forbid it, since nothing leads to them.
    """

    to_lanes: Mapping[tuple[str, int], frozenset[int]]
    opened: tuple[tuple[str, int], ...]

    @property
    def edges(self) -> list[str]:
        """The edges with forbidden changes, sorted."""
        return sorted({edge for edge, _ in self.to_lanes})


@dataclass(frozen=True)
class _DrivingLane:
    """A lane of a network, and the road and the lane of the map that it comes from."""

    road: Road
    number: int
    made: NetworkLane


def find_forbidden_changes(made: MadeNetwork, road_map: OpenDriveMap, *, mirrored: bool) -> ForbiddenChanges:
    """Find the lane changes between lanes for vehicles that the marks forbid.

    Parameters
    ----------
    made
        The network.
    road_map
        The map as netconvert read it.
    mirrored
        Whether netconvert drew the lanes on the other side of the reference line, for left-hand traffic.
    """
    offset_m = np.array([*np.add(made.offset_m, road_map.offset_m[:2]), 0.0])
    entered: dict[str, set[int]] = defaultdict(set)
    for _, _, edge, lane in made.connections:
        entered[edge].add(lane)
    forbidden: dict[tuple[str, int], frozenset[int]] = {}
    opened: list[tuple[str, int]] = []
    for edge, lanes in _neighbouring_lanes(made, road_map):
        first = lanes[0].made.index
        permitted: list[set[int]] = [set() for _ in lanes]
        for position, (outer, inner) in enumerate(pairwise(lanes)):
            outwards, inwards = _permitted_changes(outer, inner, offset_m, mirrored)
            if outwards:
                permitted[position + 1].add(position)
            if inwards:
                permitted[position].add(position + 1)
        reached = {lane - first for lane in entered[edge] if 0 <= lane - first < len(lanes)}
        if reached:
            opened += [(edge, first + position) for position in open_unreachable_lanes(permitted, reached)]
        for position, others in enumerate(permitted):
            neighbours = {position - 1, position + 1} & set(range(len(lanes)))
            if neighbours - others:
                forbidden[edge, first + position] = frozenset(first + other for other in neighbours - others)
    return ForbiddenChanges(forbidden, tuple(opened))


def forbid_changes(network_text: str, changes: ForbiddenChanges, *, lefthand: bool) -> str:
    """Return the text of a network in which the changes are forbidden.

    Parameters
    ----------
    network_text
        The network, as netconvert wrote it.
    changes
        The forbidden changes.
    lefthand
        Whether traffic drives on the left; then lane 0 is the leftmost.
    """
    attributes = {}
    for (edge, lane), others in changes.to_lanes.items():
        on_left = lane - 1 if lefthand else lane + 1
        keys = sorted("changeLeft" if other == on_left else "changeRight" for other in others)
        attributes[f"{edge}_{lane}"] = "".join(f' {key}="{NO_CHANGE}"' for key in keys)

    def extend(match: re.Match[str]) -> str:
        return match[0] + attributes.get(unescape(match[1], {"&quot;": '"'}), "")

    return _LANE_TAG.sub(extend, network_text)


def _neighbouring_lanes(made: MadeNetwork, road_map: OpenDriveMap) -> Iterator[tuple[str, list[_DrivingLane]]]:
    """Yield each edge with the lanes for vehicles that lie beside each other on it, from the kerb inwards."""
    by_edge: dict[str, dict[int, _DrivingLane]] = defaultdict(dict)
    for (road, number), lanes in made.lanes.items():
        for lane in lanes:
            if lane.type in DRIVING_TYPES and road in road_map.roads:
                by_edge[lane.edge].setdefault(lane.index, _DrivingLane(road_map.roads[road], number, lane))
    for edge, by_index in sorted(by_edge.items()):
        beside: list[_DrivingLane] = []
        for index in sorted(by_index):
            if beside and beside[-1].made.index != index - 1:
                yield edge, beside
                beside = []
            beside.append(by_index[index])
        yield edge, beside


def _permitted_changes(
    outer: _DrivingLane, inner: _DrivingLane, offset_m: FloatArray, mirrored: bool
) -> tuple[bool, bool]:
    """Return whether vehicles may change from the inner to the outer lane, and from the outer to the inner one."""
    side = 1 if inner.number > 0 else -1
    between = range(inner.number, outer.number, side)
    if inner.road.id != outer.road.id or not between:
        return True, True
    votes = []
    for section, ds_m in _positions_along(inner, offset_m, mirrored):
        lanes = (section.lanes[number] for number in between if number in section.lanes)
        marks = [mark for lane in lanes if (mark := lane.mark_at(ds_m)) is not None]
        votes.append((all(mark.outwards for mark in marks), all(mark.inwards for mark in marks)))
    outwards, inwards = np.mean(votes, axis=0) >= 0.5
    return bool(outwards), bool(inwards)


def _positions_along(lane: _DrivingLane, offset_m: FloatArray, mirrored: bool) -> list[tuple[LaneSection, float]]:
    """Return the section, and the distance from its start in metres, of points of a lane of the network."""
    lines, positions = [], []
    for section in lane.road.sections:
        if lane.number in section.lanes:
            line = lane.road.lane_line(section, lane.number, _STEP_M, mirrored=mirrored) + offset_m
            distances_m = np.linspace(0.0, section.end_m - section.start_m, len(line))
            lines.append(line[:, :2])
            positions += [(section, ds_m) for ds_m in distances_m.tolist()]
    shape = shapely.LineString(lane.made.shape_m[:, :2])
    points = shapely.get_coordinates(shapely.segmentize(shape, _STEP_M))
    nearest = KDTree(np.concatenate(lines)).query(points)[1]
    return [positions[index] for index in nearest]
