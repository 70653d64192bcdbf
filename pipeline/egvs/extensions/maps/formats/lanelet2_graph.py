"""Which way lanelets run, who may drive on them, and how they follow each other.

Three rules give the routing graph of the library Lanelet2:

1. The right bound is turned if its ends then lie nearer to those of the left bound.
2. Both bounds are turned unless the left bound followed by the turned right bound runs clockwise.
3. Lanelet B follows A where the last points of A's bounds are the first points of B's.

Neighbours share a bound and run in the same direction. Where traffic runs both ways, a lanelet stands for two
:class:`DirectedLanelet`.

Frame: x, y, z in metres of the world frame.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from egvs.core import polylines
from egvs.core.grid import FloatArray
from egvs.core.polygons import PairCount, repair_polygon
from egvs.extensions.maps.formats.lanelet2 import Lanelet, LaneletMap
from egvs.formats.osm import Tags

MOTOR_VEHICLES = ("car", "bus", "truck", "motorcycle", "taxi", "emergency")
"""Kinds of motor vehicles in the tag ``participant:vehicle:KIND``."""

_PARTICIPANTS = {kind: f"participant:vehicle:{kind}" for kind in MOTOR_VEHICLES}
_PARTICIPANTS |= {"bicycle": "participant:bicycle", "pedestrian": "participant:pedestrian"}

_BY_SUBTYPE = {
    "": frozenset(MOTOR_VEHICLES),
    "road": frozenset({*MOTOR_VEHICLES, "bicycle"}),
    "highway": frozenset(MOTOR_VEHICLES),
    "play_street": frozenset({*MOTOR_VEHICLES, "bicycle", "pedestrian"}),
    "exit": frozenset({*MOTOR_VEHICLES, "bicycle", "pedestrian"}),
    "bus_lane": frozenset({"bus", "taxi", "emergency"}),
    "emergency_lane": frozenset({"emergency"}),
    "bicycle_lane": frozenset({"bicycle"}),
    "walkway": frozenset({"pedestrian"}),
    "shared_walkway": frozenset({"pedestrian", "bicycle"}),
    "crosswalk": frozenset({"pedestrian"}),
    "stairs": frozenset({"pedestrian"}),
}
"""Who may use a lanelet without participant tags; LaneletAndAreaTagging.md of Lanelet2."""

_TRUE = frozenset({"yes", "true", "1"})
_STEP_M = 1.0
"""Distance of the points of a centre line."""

_MAX_STEPS = 2000
_SHARE_DIGITS = 9
_SAME_M = 1e-6


class LaneletKey(NamedTuple):
    """Identifier of a lanelet, whether traffic runs against its bounds, and which part it is.

    Part n is cut into the parts 2 n + 1 and 2 n + 2; 0 is the complete lanelet.
    """

    id: int
    is_reversed: bool = False
    part: int = 0

    def __str__(self) -> str:
        return f"{self.id} (reversed)" if self.is_reversed else str(self.id)


@dataclass(frozen=True)
class DirectedLanelet:
    """A lanelet in one of its driving directions.

    Attributes
    ----------
    key
        Identifier and direction.
    left_ends, right_ends
        Identifiers of the first and the last point of its bounds, in driving direction.
    left_m, right_m
        (n, 3) float64: x, y, z of its bounds, in driving direction.
    left_line, right_line
        Identifiers of the ways.
    left_along, right_along
        Whether the ways run in driving direction.
    tags
        The lanelet's tags.
    regulations
        Identifiers of its regulatory elements.
    pairs
        Pairs of edges of the file so far.
    """

    key: LaneletKey
    left_ends: tuple[int, int]
    right_ends: tuple[int, int]
    left_m: FloatArray
    right_m: FloatArray
    left_line: int
    right_line: int
    left_along: bool
    right_along: bool
    tags: Tags
    regulations: tuple[int, ...] = ()
    pairs: PairCount = field(default_factory=PairCount, compare=False, repr=False)

    @cached_property
    def center_m(self) -> FloatArray:
        """(n, 3) float64: the centre line, in the middle between points at equal shares of both bounds' lengths."""
        return _middle_line(self.left_m, self.right_m)

    @cached_property
    def width_m(self) -> float:
        """Median distance of the bounds."""
        shares = np.linspace(0.0, 1.0, 21)
        left, right = _points_at(self.left_m, shares), _points_at(self.right_m, shares)
        return float(np.median(np.hypot(*(left - right)[:, :2].T)))

    @cached_property
    def area(self) -> BaseGeometry:
        """The ground between the bounds."""
        ring = np.vstack([self.left_m[:, :2], self.right_m[::-1, :2]])
        return repair_polygon(Polygon(ring), f"{self.pairs.file}: lanelet {self.key}", self.pairs)

    @property
    def length_m(self) -> float:
        """Length of the centre line, seen from above."""
        return polylines.length_m(self.center_m)

    @property
    def users(self) -> frozenset[str]:
        """Who may drive or walk on it."""
        return allowed_users(self.tags)


@dataclass(frozen=True)
class LaneletGraph:
    """Directed lanelets and their relations.

    Attributes
    ----------
    lanelets
        By key, sorted.
    followers, predecessors
        Keys of the lanelets after and before each; empty if none.
    left_of
        The neighbours that share a lanelet's left bound and run in the same direction.
    """

    lanelets: dict[LaneletKey, DirectedLanelet]
    followers: Mapping[LaneletKey, tuple[LaneletKey, ...]]
    predecessors: Mapping[LaneletKey, tuple[LaneletKey, ...]]
    left_of: Mapping[LaneletKey, tuple[LaneletKey, ...]]


def allowed_users(tags: Tags) -> frozenset[str]:
    """Return who may use a lanelet: kinds of :data:`MOTOR_VEHICLES`, "bicycle", "pedestrian".

    Tags ``participant:...`` replace what the subtype says. ``participant:vehicle`` means all motor vehicles.

    >>> sorted(allowed_users({"subtype": "bus_lane"}))
    ['bus', 'emergency', 'taxi']
    >>> sorted(allowed_users({"subtype": "road", "participant:bicycle": "yes"}))
    ['bicycle']
    """
    overrides = {key: value for key, value in tags.items() if key.startswith("participant")}
    if not overrides:
        return _BY_SUBTYPE.get(tags.get("subtype", ""), frozenset())
    allowed = set()
    for kind, participant in _PARTICIPANTS.items():
        values = [value for key, value in overrides.items() if f"{participant}:".startswith(f"{key}:")]
        if values and values[0].lower() in _TRUE:
            allowed.add(kind)
    return frozenset(allowed)


def is_one_way(tags: Tags) -> bool:
    """Return whether motor vehicles may drive in one direction only, as they may without a tag."""
    for key in ("one_way:vehicle", "one_way"):
        if key in tags:
            return tags[key].lower() in _TRUE
    return True


def build_graph(
    lanelet_map: LaneletMap, xyz_m: Mapping[int, FloatArray], choose: Callable[[Lanelet], bool]
) -> LaneletGraph:
    """Build the graph of those lanelets that ``choose`` accepts.

    Parameters
    ----------
    lanelet_map
        The map.
    xyz_m
        x, y, z of the points by identifier.
    choose
        Which lanelets to take.
    """
    lanelets: dict[LaneletKey, DirectedLanelet] = {}
    pairs = PairCount(lanelet_map.path)
    for lanelet in lanelet_map.lanelets.values():
        if choose(lanelet):
            forward = orient_lanelet(lanelet, lanelet_map, xyz_m, pairs)
            lanelets[forward.key] = forward
            if not is_one_way(lanelet.tags):
                backward = _reverse(forward)
                lanelets[backward.key] = backward
    return connect_lanelets(dict(sorted(lanelets.items())))


def connect_lanelets(lanelets: dict[LaneletKey, DirectedLanelet]) -> LaneletGraph:
    """Find which lanelets follow each other, and which are neighbours."""
    by_start = defaultdict(list)
    by_right_bound = defaultdict(list)
    for key, lanelet in lanelets.items():
        by_start[lanelet.left_ends[0], lanelet.right_ends[0]].append(key)
        by_right_bound[lanelet.right_line, lanelet.right_ends].append(key)

    followers: dict[LaneletKey, tuple[LaneletKey, ...]] = {}
    predecessors: dict[LaneletKey, list[LaneletKey]] = {key: [] for key in lanelets}
    left_of: dict[LaneletKey, tuple[LaneletKey, ...]] = {}
    for key, lanelet in lanelets.items():
        after = by_start.get((lanelet.left_ends[1], lanelet.right_ends[1]), ())
        followers[key] = tuple(other for other in after if other != (key.id, not key.is_reversed, key.part))
        for other in followers[key]:
            predecessors[other].append(key)
        beside = by_right_bound.get((lanelet.left_line, lanelet.left_ends), ())
        left_of[key] = tuple(other for other in beside if other.id != key.id)
    return LaneletGraph(lanelets, followers, {key: tuple(value) for key, value in predecessors.items()}, left_of)


def split_lanelets(graph: LaneletGraph, shares: Mapping[LaneletKey, float]) -> LaneletGraph:
    """Cut lanelets at a share of the lengths of their bounds.

    Neighbours that are cut at the same share stay neighbours, and so do both directions of a lanelet.

    Parameters
    ----------
    graph
        The lanelets.
    shares
        Where to cut, by lanelet: above 0 and below 1.
    """
    new_id = min(point for lanelet in graph.lanelets.values() for point in (*lanelet.left_ends, *lanelet.right_ends))
    points: dict[tuple[object, ...], int] = {}

    def cut_point(line: int, ends: tuple[int, int], is_along: bool, share: float) -> int:
        """Return the identifier of the point where a bound is cut, the same in both driving directions."""
        if not is_along:
            ends, share = ends[::-1], 1.0 - share
        return points.setdefault((line, ends, round(share, _SHARE_DIGITS)), new_id - 1 - len(points))

    lanelets = {}
    for key, lanelet in graph.lanelets.items():
        if key not in shares:
            lanelets[key] = lanelet
            continue
        share = shares[key]
        left = cut_point(lanelet.left_line, lanelet.left_ends, lanelet.left_along, share)
        right = cut_point(lanelet.right_line, lanelet.right_ends, lanelet.right_along, share)
        left_parts_m, right_parts_m = split_line(lanelet.left_m, share), split_line(lanelet.right_m, share)
        for part in (0, 1):
            part_key = key._replace(part=2 * key.part + 1 + part)
            lanelets[part_key] = replace(
                lanelet,
                key=part_key,
                left_ends=(lanelet.left_ends[0], left) if part == 0 else (left, lanelet.left_ends[1]),
                right_ends=(lanelet.right_ends[0], right) if part == 0 else (right, lanelet.right_ends[1]),
                left_m=left_parts_m[part],
                right_m=right_parts_m[part],
            )
    return connect_lanelets(dict(sorted(lanelets.items())))


def orient_lanelet(
    lanelet: Lanelet, lanelet_map: LaneletMap, xyz_m: Mapping[int, FloatArray], pairs: PairCount
) -> DirectedLanelet:
    """Return a lanelet with both bounds in driving direction, by rules 1 and 2."""
    left, right = (lanelet_map.lines[line].nodes for line in (lanelet.left, lanelet.right))
    left_m, right_m = (np.array([xyz_m[node] for node in nodes]) for nodes in (left, right))
    same_m, turned_m = (
        np.hypot(*(left_m[[0, -1], :2] - ends[:, :2]).T).sum() for ends in (right_m[[0, -1]], right_m[[-1, 0]])
    )
    left_along, right_along = True, bool(turned_m >= same_m)
    ring_m = np.vstack([left_m, right_m[::-1] if right_along else right_m])
    if _signed_area_m2(ring_m) > 0:
        left_along, right_along = not left_along, not right_along
    if not left_along:
        left, left_m = left[::-1], left_m[::-1]
    if not right_along:
        right, right_m = right[::-1], right_m[::-1]
    return DirectedLanelet(
        LaneletKey(lanelet.id), (left[0], left[-1]), (right[0], right[-1]), left_m, right_m,
        lanelet.left, lanelet.right, left_along, right_along, lanelet.tags, lanelet.regulations, pairs,
    )  # fmt: skip


def split_line(line_m: FloatArray, share: float) -> tuple[FloatArray, FloatArray]:
    """Cut a line (n, 3) at a share of its length into two lines that have the point of the cut in common."""
    stations_m = polylines.stations_m(line_m)
    at_m = share * stations_m[-1]
    point = _points_at(line_m, np.array([share]))
    before, after = line_m[stations_m < at_m - _SAME_M], line_m[stations_m > at_m + _SAME_M]
    return np.vstack([before, point]), np.vstack([point, after])


def _reverse(lanelet: DirectedLanelet) -> DirectedLanelet:
    return DirectedLanelet(
        LaneletKey(lanelet.key.id, True), lanelet.right_ends[::-1], lanelet.left_ends[::-1],
        lanelet.right_m[::-1], lanelet.left_m[::-1], lanelet.right_line, lanelet.left_line,
        not lanelet.right_along, not lanelet.left_along, lanelet.tags, lanelet.regulations, lanelet.pairs,
    )  # fmt: skip


def _signed_area_m2(ring_m: FloatArray) -> float:
    """Return the area of a ring; negative if it runs clockwise."""
    x, y = (ring_m[:, :2] - ring_m[0, :2]).T
    return float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2


def _middle_line(left_m: FloatArray, right_m: FloatArray) -> FloatArray:
    """Return points between those at equal shares of two lines' lengths, about a metre apart."""
    length_m = max(polylines.stations_m(left_m)[-1], polylines.stations_m(right_m)[-1])
    steps = min(max(int(np.ceil(length_m / _STEP_M)), 1), _MAX_STEPS)
    shares = np.linspace(0.0, 1.0, steps + 1)
    return (_points_at(left_m, shares) + _points_at(right_m, shares)) / 2


def _points_at(line_m: FloatArray, shares: FloatArray) -> FloatArray:
    """Return the points (n, 3) at shares (n,) of a line's length."""
    return polylines.points_at(line_m, shares * polylines.stations_m(line_m)[-1])
