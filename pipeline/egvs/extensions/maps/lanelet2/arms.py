"""Groups of road ends: those of both carriageways where the map ends are one end of a street.

Without this, a street with a median would count as two arms of its junction, and vehicles could be sent back where they
come from.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import shapely

from egvs.core.grid import FloatArray
from egvs.extensions.maps.formats.lanelet2_graph import LaneletGraph

if TYPE_CHECKING:
    from egvs.extensions.maps.lanelet2.roads import Road

ARM_GAP_M = 15.0
"""Roads whose lanes end nearer to each other than this, in the same direction, are the same street."""

_LEVEL_M = 3.0
_SAME_DIRECTION_COS = 0.8

RoadEnd = tuple[str, str]
"""Identifier of a road, and "start" or "end"."""


class Groups:
    """Union-find: groups of things that are joined."""

    def __init__(self) -> None:
        self._parents: dict[object, object] = {}

    def find(self, thing: object) -> object:
        """Return the representative of a thing's group."""
        root = thing
        while (parent := self._parents.setdefault(root, root)) != root:
            root = parent
        while self._parents[thing] != root:
            self._parents[thing], thing = root, self._parents[thing]
        return root

    def join(self, a: object, b: object) -> None:
        """Make one group of two."""
        self._parents[self.find(a)] = self.find(b)


def join_arms(graph: LaneletGraph, roads: Sequence[Road], groups: Groups) -> None:
    """Join the ends of roads where the map ends, if they lie side by side and lead out in the same direction.

    Both ends of a road are never joined.
    """
    members: dict[object, list[RoadEnd]] = defaultdict(list)
    for road in roads:
        for end in ("start", "end"):
            members[groups.find((road.id, end))].append((road.id, end))
    free = {(road.id, end) for road in roads for end in ("start", "end") if _is_free(graph, road, end)}
    roads_by_id = {road.id: road for road in roads}
    candidates = sorted(end for ends in members.values() if free.issuperset(ends) for end in ends)
    lines = [_lane_ends(roads_by_id[road_id], end) for road_id, end in candidates]
    if not lines:
        return
    areas = [shapely.MultiPoint(points_m[:, :2]) for points_m, _ in lines]
    first, second = shapely.STRtree(areas).query(areas, predicate="dwithin", distance=ARM_GAP_M)
    for i, j in sorted(zip(first.tolist(), second.tolist(), strict=True)):
        (points_a, out_a), (points_b, out_b) = lines[i], lines[j]
        is_level = abs(points_a[:, 2].mean() - points_b[:, 2].mean()) < _LEVEL_M
        if i >= j or not is_level or float(out_a @ out_b) < _SAME_DIRECTION_COS:
            continue
        one, other = groups.find(candidates[i]), groups.find(candidates[j])
        both = members[one] + members[other]
        if one != other and len({road_id for road_id, _ in both}) == len(both):
            groups.join(one, other)
            members[groups.find(one)] = both


def _is_free(graph: LaneletGraph, road: Road, end: str) -> bool:
    """Return whether nothing leads to a road's start, or on from its end."""
    relations = graph.predecessors if end == "start" else graph.followers
    return not any(relations[lane.key] for lane in road.lanes)


def _lane_ends(road: Road, end: str) -> tuple[FloatArray, FloatArray]:
    """Return the points (n, 3) where the lanes of a road end, and the direction (2,) out of the map there."""
    last, inner = (0, 1) if end == "start" else (-1, -2)
    points_m = np.array([lane.center_m[last] for lane in road.lanes])
    out = np.sum([(lane.center_m[last] - lane.center_m[inner])[:2] for lane in road.lanes], axis=0)
    return points_m, np.asarray(out / max(float(np.hypot(*out)), 1e-9))
