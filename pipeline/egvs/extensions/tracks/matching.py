"""Which lanes of a network recorded vehicles drove on.

Positions of a track are matched to lanes together, as the most likely path of a hidden Markov model (Newson and Krumm
2009, "Hidden Markov map matching through noise and sparseness"), here with costs in place of probabilities:

- a position costs :math:`d^2 / (2 \\sigma^2)`, with its distance d from the middle line of the lane; lanes farther away
  than :data:`FAR_M`, or in a direction that differs by more than :data:`SAME_WAY_RAD`, are no candidates;
- going on along the lane, or to a lane that connections lead to, costs nothing; changing to a lane beside it costs
  :data:`CHANGE_COST`; anything else, as from one carriageway to another, :data:`BREAK_COST`.

World frame, in plan, metres, seconds and radians.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from egvs.core import polylines
from egvs.core.grid import FloatArray, IntArray
from egvs.extensions.tracks.resampling import ResampledTracks
from egvs.traffic.lane_alignment import FAR_M
from egvs.traffic.network import CAR, DEFAULT_SPEED_M_S, Lane, Network

PERIOD_S = 0.5
"""Usual time between matched positions."""

SAME_WAY_RAD = np.pi / 3
SIGMA_M = 1.0
"""Standard deviation of positions across the lane."""

CHANGE_COST, BREAK_COST = 2.0, 12.0

_MAX_HOPS = 4
"""Lanes that may be passed between two positions; lanes inside junctions can be shorter than the way between them."""


@dataclass(frozen=True, eq=False)
class DrivenLane:
    """A lane for cars, on a road or inside a junction.

    Attributes
    ----------
    edge
        Id of its edge.
    source, target
        Ids of the roads that it connects; both are its edge on a road.
    line_m
        Middle line, (n, 2).
    speed_m_s
        Speed limit.
    turn
        SUMO's code of the direction inside a junction; empty on a road.
    """

    edge: str
    source: str
    target: str
    line_m: FloatArray
    speed_m_s: float
    turn: str = ""

    @property
    def is_inside(self) -> bool:
        """Whether it is inside a junction."""
        return self.edge.startswith(":")

    @cached_property
    def along_m(self) -> FloatArray:
        """Distance of the points of the line from its start, (n,)."""
        return polylines.stations_m(self.line_m)

    @property
    def length_m(self) -> float:
        """Length of the middle line."""
        return float(self.along_m[-1])


@dataclass(frozen=True, eq=False)
class MatchedTracks:
    """Positions of vehicles on lanes, sorted by track and time. Arrays have shape (n,).

    Attributes
    ----------
    lanes
        The lanes of the network.
    following
        Lanes that each lane leads to.
    track
        Track of each position, int64.
    time_s
        Time since the first frame.
    lane
        Position in ``lanes``, int64; -1 where no lane is near.
    at_m
        Distance of the centre of the vehicle from the start of the lane.
    speed_m_s
        Mean speed from the row before to the row after.
    """

    lanes: tuple[DrivenLane, ...]
    following: tuple[tuple[int, ...], ...]
    track: IntArray
    time_s: FloatArray
    lane: IntArray
    at_m: FloatArray
    speed_m_s: FloatArray

    def tracks(self) -> Iterator[tuple[int, slice]]:
        """Yield each track and its rows."""
        bounds = np.flatnonzero(np.diff(self.track, prepend=-1, append=-1))
        for start, end in itertools.pairwise(bounds.tolist()):
            yield int(self.track[start]), slice(start, end)


def match_tracks(boxes: ResampledTracks, period_s: float, network: Network) -> MatchedTracks:
    """Match the positions of vehicles to the lanes of a network.

    Parameters
    ----------
    boxes
        Positions of motor vehicles, world frame.
    period_s
        Time between its frames, at most about :data:`PERIOD_S`.
    network
        The network.
    """
    order = np.lexsort((boxes.frame, boxes.track))
    track = boxes.track[order]
    xy_m = np.column_stack([boxes.x_m, boxes.y_m])[order]
    lanes, following = driven_lanes(network)
    near = _Candidates(lanes, xy_m, boxes.yaw_rad[order])
    costs = _transition_costs(lanes, following)
    lane = np.full(track.size, -1, dtype=np.int64)
    at_m = np.full(track.size, np.nan)
    bounds = np.flatnonzero(np.diff(track, prepend=-1, append=-1))
    for start, end in itertools.pairwise(bounds.tolist()):
        for row, number, along_m in _most_likely_path(near.of_rows(start, end), costs):
            lane[start + row], at_m[start + row] = number, along_m
    time_s: FloatArray = boxes.frame[order].astype(np.float64) * period_s
    return MatchedTracks(lanes, following, track, time_s, lane, at_m, _speeds(track, time_s, xy_m))


def _speeds(track: IntArray, time_s: FloatArray, xy_m: FloatArray) -> FloatArray:
    """Return the mean speed from the row before each row to the one after it, (n,); 0 for tracks of one row."""
    rows = np.arange(track.size)
    before, after = np.maximum(rows - 1, 0), np.minimum(rows + 1, track.size - 1)
    before = np.where(track[before] == track, before, rows)
    after = np.where(track[after] == track, after, rows)
    step_s = time_s[after] - time_s[before]
    distance_m = np.hypot(*(xy_m[after] - xy_m[before]).T)
    return np.divide(distance_m, step_s, out=np.zeros(track.size), where=step_s > 0)


def driven_lanes(network: Network) -> tuple[tuple[DrivenLane, ...], tuple[tuple[int, ...], ...]]:
    """Return the lanes for cars, and the lanes that each of them leads to.

    Parameters
    ----------
    network
        The network.
    """
    inside = {lane.id: lane for lane in _inside_lanes(network)}
    lanes: list[DrivenLane] = []
    numbers: dict[str, int] = {}
    for edge in network.all_edges:
        for which, lane in enumerate(edge.lanes):
            name = f"{edge.id}_{which}"
            if not lane.permission.admits(CAR) or len(lane.shape_m) < 2 or edge.function not in ("", "internal"):
                continue
            source, target, turn = edge.id, edge.id, ""
            if edge.function:
                if name not in inside:
                    continue
                source, target, turn = inside[name].source, inside[name].target, inside[name].turn
            numbers[name] = len(lanes)
            lanes.append(DrivenLane(edge.id, source, target, lane.shape_m[:, :2], _limit(lane), turn))

    following: list[set[int]] = [set() for _ in lanes]
    for first, second in _lane_links(network, inside):
        if first in numbers and second in numbers:
            following[numbers[first]].add(numbers[second])
    return tuple(lanes), tuple(tuple(sorted(after)) for after in following)


@dataclass(frozen=True)
class _InsideLane:
    """A lane inside a junction: its id, the roads that it connects, the turn, and the lane on the road before it."""

    id: str
    source: str
    target: str
    turn: str
    before: str
    after: str


def _inside_lanes(network: Network) -> Iterator[_InsideLane]:
    """Yield the lanes inside junctions; a left turn that waits in the middle has two, one after the other."""
    waits_before = {
        junction.incoming_lanes[0]: junction.id
        for junction in network.junctions
        if junction.type == "internal" and junction.incoming_lanes
    }
    for connection in network.connections:
        if not connection.via:
            continue
        source, target = network.edges[connection.source].id, network.edges[connection.target].id
        before, after = f"{source}_{connection.source_lane}", f"{target}_{connection.target_lane}"
        second = waits_before.get(connection.via, "")
        yield _InsideLane(connection.via, source, target, connection.direction, before, second or after)
        if second:
            yield _InsideLane(second, source, target, connection.direction, connection.via, after)


def _lane_links(network: Network, inside: dict[str, _InsideLane]) -> Iterator[tuple[str, str]]:
    """Yield pairs of lanes of which the first leads to the second."""
    for lane in inside.values():
        yield lane.before, lane.id
        yield lane.id, lane.after
    for connection in network.connections:
        if not connection.via:
            source, target = network.edges[connection.source].id, network.edges[connection.target].id
            yield f"{source}_{connection.source_lane}", f"{target}_{connection.target_lane}"


def _limit(lane: Lane) -> float:
    return lane.speed_m_s if lane.speed_m_s > 0 else DEFAULT_SPEED_M_S


class _Candidates:
    """Lanes near positions: for each pair, the row, the lane, the squared cost and the distance along the lane."""

    def __init__(self, lanes: Sequence[DrivenLane], xy_m: FloatArray, yaw_rad: FloatArray) -> None:
        rows, numbers, costs, alongs = [], [], [], []
        for number, lane in enumerate(lanes):
            low_m, high_m = lane.line_m.min(axis=0) - FAR_M, lane.line_m.max(axis=0) + FAR_M
            near = np.flatnonzero(((xy_m >= low_m) & (xy_m <= high_m)).all(axis=1))
            if not near.size or lane.length_m == 0.0:
                continue
            distance_m, along_m, heading_rad = project(xy_m[near], lane)
            turned_rad = np.abs(np.angle(np.exp(1j * (yaw_rad[near] - heading_rad))))
            is_candidate = (distance_m <= FAR_M) & (turned_rad <= SAME_WAY_RAD)
            rows.append(near[is_candidate])
            numbers.append(np.full(rows[-1].size, number))
            costs.append((distance_m[is_candidate] / SIGMA_M) ** 2 / 2.0)
            alongs.append(along_m[is_candidate])
        row = np.concatenate([np.empty(0, dtype=np.int64), *rows])
        order = np.argsort(row, kind="stable")
        self._row = row[order]
        self._lane = np.concatenate([np.empty(0, dtype=np.int64), *numbers])[order]
        self._cost = np.concatenate([np.empty(0), *costs])[order]
        self._along_m = np.concatenate([np.empty(0), *alongs])[order]

    def of_rows(self, start: int, end: int) -> list[tuple[int, IntArray, FloatArray, FloatArray]]:
        """Return, for each of the rows with candidates: its number from ``start`` on, lanes, costs and distances."""
        bounds = np.searchsorted(self._row, np.arange(start, end + 1))
        result = []
        for number, (first, last) in enumerate(itertools.pairwise(bounds.tolist())):
            if last > first:
                part = slice(first, last)
                result.append((number, self._lane[part], self._cost[part], self._along_m[part]))
        return result


def project(xy_m: FloatArray, lane: DrivenLane) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the distance of points (n, 2) from a lane, how far along it they are, and its direction there, (n,) each.

    Parameters
    ----------
    xy_m
        The points.
    lane
        The lane; its length is not 0.
    """
    start, step = lane.line_m[:-1], np.diff(lane.line_m, axis=0)
    length_m = np.hypot(*step.T)
    has_length = length_m > 0
    start, step, first_m, length_m = (
        start[has_length],
        step[has_length],
        lane.along_m[:-1][has_length],
        length_m[has_length],
    )
    offset = xy_m[:, None, :] - start[None]
    share = np.clip((offset * step).sum(axis=2) / length_m**2, 0.0, 1.0)
    distances_m = np.hypot(*np.moveaxis(offset - share[:, :, None] * step, 2, 0))
    nearest = distances_m.argmin(axis=1)
    rows = np.arange(len(xy_m))
    heading_rad = np.arctan2(step[nearest, 1], step[nearest, 0])
    return distances_m[rows, nearest], first_m[nearest] + share[rows, nearest] * length_m[nearest], heading_rad


def _transition_costs(lanes: Sequence[DrivenLane], following: Sequence[Sequence[int]]) -> FloatArray:
    """Return the cost of going from each lane to each lane, (n, n)."""
    costs = np.full((len(lanes), len(lanes)), BREAK_COST)
    beside = defaultdict(list)
    for number, lane in enumerate(lanes):
        if not lane.is_inside:
            beside[lane.edge].append(number)
    for number in range(len(lanes)):
        reached, front = {number}, {number}
        for _ in range(_MAX_HOPS):
            front = {after for each in front for after in following[each]} - reached
            reached |= front
        neighbours = [other for each in reached for other in beside[lanes[each].edge] if not lanes[each].is_inside]
        costs[number, neighbours] = CHANGE_COST
        costs[number, list(reached)] = 0.0
    return costs


def _most_likely_path(
    steps: Sequence[tuple[int, IntArray, FloatArray, FloatArray]], costs: FloatArray
) -> Iterator[tuple[int, int, float]]:
    """Yield row, lane and distance along it of the path with the least cost (Viterbi's algorithm)."""
    if not steps:
        return
    total = steps[0][2]
    best_before: list[IntArray] = []
    for before, after in itertools.pairwise(steps):
        ways = total[:, None] + costs[np.ix_(before[1], after[1])]
        best = ways.argmin(axis=0)
        best_before.append(best)
        total = ways[best, np.arange(best.size)] + after[2]
    chosen = int(total.argmin())
    path = []
    for number in range(len(steps) - 1, -1, -1):
        row, lane, _, along_m = steps[number]
        path.append((row, int(lane[chosen]), float(along_m[chosen])))
        if number:
            chosen = int(best_before[number - 1][chosen])
    yield from reversed(path)
