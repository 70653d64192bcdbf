"""Turn lanelets into roads, nodes and turns, as SUMO needs them.

Steps of :func:`make_roads`:

1. Lanelets of junctions ("inner" lanelets) are those that overlap another one, share a predecessor or a successor with
   another one, or have the tag ``turn_direction``.
2. Where the map begins or ends inside a junction, a piece of the inner lanelet is cut off as a road.
3. Roads are chains of neighbours among the rest; lane 0 is the one at the kerb.
4. Nodes are groups of road ends and inner lanelets that follow each other, overlap, or share the end of a bound, and of
   road ends side by side where the map ends.
5. A road that starts and ends in the same node becomes inner if it is short, and is cut in the middle otherwise;
   then the nodes are found again.
6. Turns are the shortest paths through inner lanelets from lane to lane.

Lanelets more than :data:`LEVEL_M` above each other do not overlap: one is a bridge.

Frame: x, y, z in metres of the world frame.
"""

from __future__ import annotations

import heapq
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely
from shapely.geometry import Point

from egvs.core.grid import FloatArray
from egvs.extensions.maps.formats.lanelet2_graph import DirectedLanelet, LaneletGraph, LaneletKey, split_lanelets
from egvs.extensions.maps.lanelet2.crosswalks import cut_at_crosswalks
from egvs.extensions.maps.lanelet2.road_layout import Road, RoadLayout, Turn

LEVEL_M = 3.0
"""Roads at least so far above each other do not meet."""

MIN_OVERLAP_M2, MIN_OVERLAP_SHARE = 2.0, 0.03
"""Lanelets that overlap by more than this, and by more than this share of the smaller one, are in a junction."""

JOIN_OVERLAP_M2 = 0.5
"""Inner lanelets that overlap by more than this are in the same junction."""

SHORT_ROAD_M = 40.0
"""A road between two parts of the same node is part of the node if it is shorter than this."""

CROSSWALK_RANGE_M = 15.0
"""A crosswalk nearer than this to a junction is part of it."""

MAX_STUB_M, MAX_STUB_SHARE = 15.0, 0.3
"""Length of the road that is cut off a lanelet where the map begins or ends in a junction, and its largest share."""

ARM_GAP_M = 15.0
"""Roads whose lanes end nearer to each other than this, in the same direction, are the same street."""

_SAME_DIRECTION_COS = 0.8
_TURN_DIRECTIONS = frozenset({"left", "right", "straight"})

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


@dataclass(frozen=True)
class Overlap:
    """Two lanelets that overlap: their keys, the common area, and its share of the smaller lanelet."""

    first: LaneletKey
    second: LaneletKey
    area_m2: float
    share: float

    def is_within(self, keys: set[LaneletKey]) -> bool:
        """Return whether both lanelets are among some."""
        return self.first in keys and self.second in keys


def make_roads(graph: LaneletGraph, *, lefthand: bool, crosswalks: Sequence[DirectedLanelet] = ()) -> RoadLayout:
    """Find the roads, nodes and turns of a map.

    Parameters
    ----------
    graph
        The lanelets for motor vehicles.
    lefthand
        Whether traffic drives on the left: then lane 0 is the leftmost.
    crosswalks
        Lanelets of crosswalks; the pieces of roads under them become inner.
    """
    overlaps = _find_overlaps(graph)
    inner = _inner_lanelets(graph, overlaps)
    graph, inner, overlaps, stubs = _add_stubs(graph, inner, overlaps)
    graph, crossed = cut_at_crosswalks(graph, _make_chains(graph, inner, lefthand), crosswalks)
    inner |= set(crossed)
    while True:
        roads = _make_chains(graph, inner, lefthand)
        node_of_end, node_of_inner = _find_nodes(graph, roads, inner, overlaps, crossed)
        beside_crosswalks = _short_roads_beside(roads, node_of_end, node_of_inner, crossed)
        if beside_crosswalks:
            inner |= beside_crosswalks
            continue
        loops = [road for road in roads if node_of_end[road.id, "start"] == node_of_end[road.id, "end"]]
        if not loops:
            break
        inner_loops = [road for road in loops if road.length_m < SHORT_ROAD_M or road.lanes[0].key.part]
        for road in inner_loops:
            inner |= {lane.key for lane in road.lanes}
        if not inner_loops:
            graph = split_lanelets(graph, {lane.key: 0.5 for road in loops for lane in road.lanes})
    placed = {
        road.id: replace(road, start=node_of_end[road.id, "start"], end=node_of_end[road.id, "end"]) for road in roads
    }
    turns = tuple(_find_turns(graph, placed, inner))
    used = {key for turn in turns for key in turn.path}
    return RoadLayout(graph, placed, node_of_inner, turns, tuple(sorted(inner - used)), stubs)


def _find_overlaps(graph: LaneletGraph) -> list[Overlap]:
    """Find the pairs of lanelets that overlap on the same level.

    Directions of one lanelet, neighbours, and lanelets that follow each other do not count.
    """
    keys = list(graph.lanelets)
    lanelets = list(graph.lanelets.values())
    areas = [lanelet.area for lanelet in lanelets]
    following = {frozenset((a.id, b.id)) for a, after in graph.followers.items() for b in after}
    first, second = shapely.STRtree(areas).query(areas, predicate="intersects")
    overlaps = []
    for i, j in zip(first.tolist(), second.tolist(), strict=True):
        a, b = lanelets[i], lanelets[j]
        lines = {a.left_line, a.right_line} & {b.left_line, b.right_line}
        if i >= j or a.key.id == b.key.id or lines or frozenset((a.key.id, b.key.id)) in following:
            continue
        common = areas[i].intersection(areas[j])
        smaller_m2 = min(areas[i].area, areas[j].area)
        if common.area > JOIN_OVERLAP_M2 and _on_one_level(a, b, common.representative_point()):
            overlaps.append(Overlap(keys[i], keys[j], float(common.area), float(common.area / smaller_m2)))
    return overlaps


def _on_one_level(a: DirectedLanelet, b: DirectedLanelet, at: Point) -> bool:
    heights_m = []
    for lanelet in (a, b):
        distances_m = np.hypot(lanelet.center_m[:, 0] - at.x, lanelet.center_m[:, 1] - at.y)
        heights_m.append(lanelet.center_m[int(np.argmin(distances_m)), 2])
    return bool(abs(heights_m[0] - heights_m[1]) < LEVEL_M)


def _inner_lanelets(graph: LaneletGraph, overlaps: list[Overlap]) -> set[LaneletKey]:
    """Return the lanelets of junctions."""
    inner = set()
    for key, lanelet in graph.lanelets.items():
        forks = any(len(graph.followers[before]) > 1 for before in graph.predecessors[key])
        merges = any(len(graph.predecessors[after]) > 1 for after in graph.followers[key])
        if forks or merges or lanelet.tags.get("turn_direction") in _TURN_DIRECTIONS:
            inner.add(key)
    for overlap in overlaps:
        if overlap.area_m2 > MIN_OVERLAP_M2 and overlap.share > MIN_OVERLAP_SHARE:
            inner |= {overlap.first, overlap.second}
    return inner


def _add_stubs(
    graph: LaneletGraph, inner: set[LaneletKey], overlaps: list[Overlap]
) -> tuple[LaneletGraph, set[LaneletKey], list[Overlap], tuple[LaneletKey, ...]]:
    """Cut pieces off the inner lanelets where the map begins or ends inside a junction; the pieces become roads.

    A lanelet with neither predecessor nor follower loses a piece at both ends.
    """
    inner_part = {key: key for key in inner}
    for is_start in (True, False):
        relations = graph.predecessors if is_start else graph.followers
        lengths_m = {whole: graph.lanelets[key].length_m for whole, key in inner_part.items() if not relations[key]}
        shares = {}
        for whole, stub_m in _stub_lengths_m(lengths_m, overlaps).items():
            key = inner_part[whole]
            share = stub_m / lengths_m[whole]
            shares[key] = share if is_start else 1.0 - share
            inner_part[whole] = key._replace(part=2 * key.part + (2 if is_start else 1))
        if shares:
            graph = split_lanelets(graph, shares)
    moved = [replace(o, first=inner_part[o.first], second=inner_part[o.second]) for o in overlaps if o.is_within(inner)]
    stubs = tuple(sorted(whole for whole, part in inner_part.items() if part != whole))
    return graph, set(inner_part.values()), moved, stubs


def _stub_lengths_m(lengths_m: Mapping[LaneletKey, float], overlaps: list[Overlap]) -> dict[LaneletKey, float]:
    """Return the length of the piece to cut off each lanelet; the same for two that overlap, where it can be."""
    stubs_m = {key: min(MAX_STUB_M, MAX_STUB_SHARE * length_m) for key, length_m in lengths_m.items()}
    pairs = [(overlap.first, overlap.second) for overlap in overlaps if overlap.is_within(set(stubs_m))]
    equal_m = dict(stubs_m)
    for one, other in pairs:
        equal_m[one] = min(equal_m[one], stubs_m[other])
        equal_m[other] = min(equal_m[other], stubs_m[one])
    return equal_m


def _make_chains(graph: LaneletGraph, inner: set[LaneletKey], lefthand: bool) -> list[Road]:
    """Make roads of chains of neighbours, with lane 0 at the kerb."""
    left_of = {}
    for key in graph.lanelets:
        beside = [other for other in graph.left_of[key] if other not in inner]
        if key not in inner and len(beside) == 1:
            left_of[key] = beside[0]
    rights = defaultdict(list)
    for key, other in left_of.items():
        rights[other].append(key)
    left_of = {key: other for key, other in left_of.items() if len(rights[other]) == 1}

    roads = []
    visited: set[LaneletKey] = set()
    outer = [key for key in graph.lanelets if key not in inner]
    on_the_right = set(outer) - set(left_of.values())
    for first in [*sorted(on_the_right), *outer]:  # the second only where neighbours form a ring
        chain: list[LaneletKey] = []
        current: LaneletKey | None = first
        while current is not None and current not in visited:
            visited.add(current)
            chain.append(current)
            current = left_of.get(current)
        if chain:
            roads.append(_make_road(graph, chain[::-1] if lefthand else chain))
    return roads


def _make_road(graph: LaneletGraph, chain: list[LaneletKey]) -> Road:
    first = chain[0]
    name = f"road_{first.id}"
    if first.is_reversed:
        name += "_back"
    if first.part:
        name += f"_part{first.part}"
    return Road(name, tuple(graph.lanelets[key] for key in chain))


def _short_roads_beside(
    roads: Sequence[Road],
    node_of_end: Mapping[RoadEnd, str],
    node_of_inner: Mapping[LaneletKey, str],
    crossed: Mapping[LaneletKey, int],
) -> set[LaneletKey]:
    """Return the lanelets of short roads between a crosswalk and a junction, or another crosswalk."""
    junctions = set(node_of_inner.values())
    at_crosswalks = {node_of_inner[key] for key in crossed}
    lanelets: set[LaneletKey] = set()
    for road in roads:
        ends = {node_of_end[road.id, "start"], node_of_end[road.id, "end"]}
        if ends <= junctions and not ends.isdisjoint(at_crosswalks) and road.length_m < CROSSWALK_RANGE_M:
            lanelets |= {lane.key for lane in road.lanes}
    return lanelets


def _find_nodes(
    graph: LaneletGraph,
    roads: list[Road],
    inner: set[LaneletKey],
    overlaps: list[Overlap],
    crossed: Mapping[LaneletKey, int],
) -> tuple[dict[RoadEnd, str], dict[LaneletKey, str]]:
    """Return the node of each road end, and of each inner lanelet."""
    road_of = {lane.key: road.id for road in roads for lane in road.lanes}
    groups = Groups()
    for key, after in graph.followers.items():
        leaving: object = key if key in inner else (road_of[key], "end")
        for other in after:
            groups.join(leaving, other if other in inner else (road_of[other], "start"))
    for overlap in overlaps:
        if overlap.is_within(inner):
            groups.join(overlap.first, overlap.second)
    for ends_at_point in _ends_by_point(graph, roads).values():
        for one_end, other_end in pairwise(ends_at_point):
            groups.join(one_end, other_end)
    for key, crosswalk in crossed.items():
        groups.join(key, crosswalk)
    _join_arms(graph, roads, groups)

    members: dict[object, list[LaneletKey]] = defaultdict(list)
    for key in sorted(inner):
        members[groups.find(key)].append(key)
    names: dict[object, str] = {}
    taken: Counter[int] = Counter()
    for root, keys in members.items():
        first = keys[0].id
        taken[first] += 1
        # Both directions, or two parts, of a lanelet may be in different junctions.
        names[root] = f"junction_{first}" if taken[first] == 1 else f"junction_{first}_{taken[first]}"
    node_of_end = {}
    for road in roads:
        for end in ("start", "end"):
            root = groups.find((road.id, end))
            node_of_end[road.id, end] = names.setdefault(root, f"{road.id}_{end}")
    return node_of_end, {key: names[groups.find(key)] for key in inner}


def _join_arms(graph: LaneletGraph, roads: Sequence[Road], groups: Groups) -> None:
    """Join the ends of roads where the map ends, if they lie side by side and lead out in the same direction.

    Without this, a street with a median would count as two arms of its junction, and vehicles could be sent back where
    they come from. Both ends of a road are never joined.
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
        is_level = abs(points_a[:, 2].mean() - points_b[:, 2].mean()) < LEVEL_M
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


def _ends_by_point(graph: LaneletGraph, roads: list[Road]) -> dict[int, list[RoadEnd]]:
    """Return the road ends at each point that ends a bound; not where the map begins or ends inside a junction."""
    by_point: dict[int, list[RoadEnd]] = defaultdict(list)
    for road in roads:
        for lane in road.lanes:
            for index, (end, relations) in enumerate((("start", graph.predecessors), ("end", graph.followers))):
                if lane.key.part and not relations[lane.key]:
                    continue
                by_point[lane.left_ends[index]].append((road.id, end))
                by_point[lane.right_ends[index]].append((road.id, end))
    return by_point


def _find_turns(graph: LaneletGraph, roads: Mapping[str, Road], inner: set[LaneletKey]) -> Iterator[Turn]:
    """Yield the turns from each lane, by road and lane."""
    lane_of = {lane.key: (road.id, index) for road in roads.values() for index, lane in enumerate(road.lanes)}
    for key, (road, index) in lane_of.items():
        for target, path in _shortest_paths(graph, key, inner).items():
            to_road, to_lane = lane_of[target]
            shape_m = _join_lines([graph.lanelets[inner_key].center_m for inner_key in path])
            yield Turn(road, index, to_road, to_lane, path, shape_m)


def _shortest_paths(
    graph: LaneletGraph, start: LaneletKey, inner: set[LaneletKey]
) -> dict[LaneletKey, tuple[LaneletKey, ...]]:
    """Return the lanelets of roads that are reached through inner lanelets, and the shortest path to each."""
    paths: dict[LaneletKey, tuple[LaneletKey, ...]] = {}
    queue: list[tuple[float, tuple[LaneletKey, ...]]] = [(0.0, (start,))]
    visited = set()
    while queue:
        length_m, path = heapq.heappop(queue)
        if path[-1] in visited:
            continue
        visited.add(path[-1])
        for after in graph.followers[path[-1]]:
            if after not in inner:
                paths.setdefault(after, path[1:])
            else:
                heapq.heappush(queue, (length_m + graph.lanelets[after].length_m, (*path, after)))
    return dict(sorted(paths.items()))


def _join_lines(lines_m: list[FloatArray]) -> FloatArray:
    """Join lines, of which each begins where the one before ends."""
    if not lines_m:
        return np.zeros((0, 3))
    return np.vstack([lines_m[0], *(line[1:] for line in lines_m[1:])])
