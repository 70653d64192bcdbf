"""Crosswalks of Lanelet2 maps.

The piece of each road under a crosswalk becomes part of a junction, so that vehicles stop before it. Steps: cut the
lanelets at both edges of the crosswalk (:func:`cut_at_crosswalks`); after nodes and turns are found, find the node of
each crosswalk and the roads that it crosses on one of its sides (:func:`place_crosswalks`).

Frame: x, y, z in metres of the world frame.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry import LineString, Point

from egvs.core.grid import FloatArray
from egvs.extensions.maps.formats.lanelet2_graph import DirectedLanelet, LaneletGraph, LaneletKey, split_lanelets
from egvs.extensions.maps.lanelet2.road_layout import Road, RoadLayout

MARGIN_M = 0.5
"""Vehicles stop so far before a crosswalk."""

ISLAND_M = 6.0
"""Widest island in the middle of a crossing."""

_LEVEL_M = 3.0
_SHORTEST_PIECE_M = 1.0
_ROAD_RANGE_M = 10.0
_EXTENSION_M = 1.0


@dataclass(frozen=True, eq=False)
class Crosswalk:
    """A crosswalk of the network.

    Attributes
    ----------
    ids
        Identifiers of its lanelets.
    node
        The node that it belongs to.
    roads
        The roads that it crosses, on one side of the node.
    shape_m
        (2, 3) float64: the ends of its centre line.
    width_m
        Width.
    """

    ids: tuple[int, ...]
    node: str
    roads: tuple[str, ...]
    shape_m: FloatArray
    width_m: float


def cut_at_crosswalks(
    graph: LaneletGraph, roads: Sequence[Road], crosswalks: Sequence[DirectedLanelet]
) -> tuple[LaneletGraph, dict[LaneletKey, int]]:
    """Cut the lanelets of roads at the edges of crosswalks.

    Returns
    -------
    graph : LaneletGraph
        With the pieces.
    pieces : dict
        The crosswalk that is on each piece under one.
    """
    pieces: dict[LaneletKey, int] = {}
    parts = {lane.key: lane.key for road in roads for lane in road.lanes}  # what remains before the next crosswalk
    for road in roads:
        # The last crosswalk first, so that shares of the part before it stay simple.
        spans = sorted(((*span, walk.key.id) for walk in crosswalks if (span := _span_m(road, walk))), reverse=True)
        length_m = road.length_m
        for start_m, end_m, walk_id in spans:
            if end_m > length_m:
                continue  # overlaps the one after it
            if length_m - end_m >= _SHORTEST_PIECE_M:
                graph = split_lanelets(graph, {parts[lane.key]: end_m / length_m for lane in road.lanes})
                _move(parts, road, 1)
                length_m = end_m
            if start_m >= _SHORTEST_PIECE_M:
                graph = split_lanelets(graph, {parts[lane.key]: start_m / length_m for lane in road.lanes})
                pieces |= {_part(parts[lane.key], 2): walk_id for lane in road.lanes}
                _move(parts, road, 1)
                length_m = start_m
            else:
                pieces |= {parts[lane.key]: walk_id for lane in road.lanes}
                break
    return graph, pieces


def place_crosswalks(
    layout: RoadLayout, crosswalks: Sequence[DirectedLanelet]
) -> tuple[tuple[Crosswalk, ...], tuple[int, ...]]:
    """Find the node of each crosswalk and the roads that it crosses.

    Returns
    -------
    placed : tuple of Crosswalk
        Sorted by identifier.
    unused : tuple of int
        The crosswalks that cross no road for motor vehicles.
    """
    placed: list[Crosswalk] = []
    unused = []
    for walk in crosswalks:
        line_m = _extended(walk.center_m)
        ends_by_node: dict[str, dict[str, FloatArray]] = defaultdict(dict)
        for turn in layout.turns:
            if not turn.path or not LineString(turn.shape_m[:, :2]).intersects(LineString(line_m[:, :2])):
                continue
            if abs(turn.shape_m[:, 2].mean() - line_m[:, 2].mean()) >= _LEVEL_M:
                continue
            node = layout.roads[turn.source].end
            ends_by_node[node][turn.source] = layout.roads[turn.source].lanes[turn.source_lane].center_m[-1]
            ends_by_node[node][turn.target] = layout.roads[turn.target].lanes[turn.target_lane].center_m[0]
        best = max(((_roads_beside(line_m, ends), node) for node, ends in ends_by_node.items()), default=None)
        if best is None or not best[0]:
            unused.append(walk.key.id)
        else:
            ends_m = walk.center_m[[0, -1]]
            placed.append(Crosswalk((walk.key.id,), best[1], best[0], ends_m, walk.width_m))
    return tuple(_join_over_islands(placed)), tuple(unused)


def _join_over_islands(crosswalks: Sequence[Crosswalk]) -> list[Crosswalk]:
    """Join crosswalks of one node that begin near the end of each other: one crossing over both carriageways."""
    joined: list[Crosswalk] = []
    for crosswalk in crosswalks:
        current = crosswalk
        for other in list(joined):
            gaps_m = np.linalg.norm(current.shape_m[:, None] - other.shape_m[None], axis=-1)
            if other.node == current.node and gaps_m.min() <= ISLAND_M:
                near, far = np.unravel_index(int(np.argmin(gaps_m)), gaps_m.shape)
                ends_m = np.array([current.shape_m[1 - near], other.shape_m[1 - far]])
                roads = tuple(dict.fromkeys((*other.roads, *current.roads)))
                width_m = min(current.width_m, other.width_m)
                joined.remove(other)
                current = Crosswalk((*other.ids, *current.ids), current.node, roads, ends_m, width_m)
        joined.append(current)
    return joined


def _span_m(road: Road, walk: DirectedLanelet) -> tuple[float, float] | None:
    """Return where a crosswalk begins and ends along a road, in metres; None if it does not cross it."""
    area = walk.area.buffer(MARGIN_M, cap_style="flat", join_style="mitre")
    stations_m = []
    for lane in road.lanes:
        line = LineString(lane.center_m[:, :2])
        if not line.intersects(LineString(_extended(walk.center_m)[:, :2])):
            continue
        if abs(lane.center_m[:, 2].mean() - walk.center_m[:, 2].mean()) >= _LEVEL_M:
            continue
        common = shapely.get_coordinates(line.intersection(area))
        scale = road.length_m / max(line.length, 1e-9)
        stations_m += [line.project(Point(point)) * scale for point in common]
    return (min(stations_m), max(stations_m)) if stations_m else None


def _roads_beside(line_m: FloatArray, ends_m: Mapping[str, FloatArray]) -> tuple[str, ...]:
    """Return the roads that end near a crosswalk on the side where more of them do."""
    line = LineString(line_m[:, :2])
    along = line_m[-1, :2] - line_m[0, :2]
    sides: dict[bool, list[str]] = {True: [], False: []}
    for road, end_m in sorted(ends_m.items()):
        if line.distance(Point(end_m[:2])) <= _ROAD_RANGE_M:
            aside = end_m[:2] - line_m[0, :2]
            sides[bool(along[0] * aside[1] - along[1] * aside[0] > 0)].append(road)
    return tuple(sides[True] if len(sides[True]) >= len(sides[False]) else sides[False])


def _part(key: LaneletKey, number: int) -> LaneletKey:
    return key._replace(part=2 * key.part + number)


def _move(parts: dict[LaneletKey, LaneletKey], road: Road, number: int) -> None:
    for lane in road.lanes:
        parts[lane.key] = _part(parts[lane.key], number)


def _extended(line_m: FloatArray) -> FloatArray:
    """Extend a line (n, 3) by a metre at both ends; crosswalks may end at the kerb or on it."""
    first, last = line_m[0] - line_m[1], line_m[-1] - line_m[-2]
    before = line_m[0] + _EXTENSION_M * first / max(float(np.hypot(*first[:2])), 1e-9)
    after = line_m[-1] + _EXTENSION_M * last / max(float(np.hypot(*last[:2])), 1e-9)
    return np.vstack([before, line_m, after])
