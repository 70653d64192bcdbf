r"""Demand and driving behaviour from recorded vehicles that were matched to lanes.

- **Passages.** A vehicle counts when it passes a junction: from the road where it was first seen to the one where it
  was last seen. One that is inside a junction when the recording begins entered it before, and does not count.
- **Desired speed**, as a share of the limit: the median of a vehicle where nothing slows it down. It drives straight
  on, at more than :data:`FREE_SHARE` of the limit, with no other vehicle within :data:`FREE_GAP_S` ahead, and its speed
  changes by less than :data:`STEADY_M_S2`. Mean and standard deviation are those over vehicles.
- **Minimum gap**: bumper to bumper, between vehicles that stand one behind the other on a lane.
- **Headway**: between the fronts of vehicles of a queue at the stop line, from the :data:`FIRST_IN_QUEUE`\ th on.
- **Desired time gap** there: that with which SUMO's car-following model keeps the recorded gap. A follower at the
  speed v, with the gap g beyond the minimum gap and the speed l of the vehicle in front, drives at the safe speed of
  Krauss (1998, "Microscopic modeling of traffic flow") with the braking deceleration b:

  .. math:: v^2 + 2 b \tau v = l^2 + 2 b g, \qquad \tau = g / v + (l^2 - v^2) / (2 b v)

  SUMO's vehicles reach v one time step after g and l.

- **Dawdling.** SUMO's drivers fall short of these speeds by :math:`\sigma a \Delta t / 2` on average, with imperfection
  sigma, acceleration a and step length. The recorded speed is that of drivers who do, so it is added.

Times in seconds, lengths in metres.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.extensions.tracks.matching import MatchedTracks

FREE_SHARE, FREE_GAP_S, STEADY_M_S2 = 0.5, 4.0, 0.5
STANDING_M_S, QUEUED_M_S = 0.2, 1.0
"""A vehicle stands, or belongs to a queue, below these speeds."""

FIRST_IN_QUEUE = 4
"""The first vehicles of a queue need longer, because they react to the signal and start from rest (HCM 2000)."""

SATURATED_S = 5.0
"""Longer headways are no longer those of one queue."""

_MIN_ROWS = 3
_SLOWEST_AT_LINE_M_S = 3.0
_LOOK_AHEAD_M = 120.0


@dataclass(frozen=True)
class Passage:
    """A vehicle that passed a junction.

    Attributes
    ----------
    track
        The vehicle.
    edges
        Ids of the roads that it used, in order; at least two.
    """

    track: int
    edges: tuple[str, ...]


@dataclass(frozen=True)
class Passages:
    """The vehicles by what they did.

    Attributes
    ----------
    counted
        Those that passed a junction.
    inside_at_begin
        Number that were inside a junction when the recording began.
    on_one_road
        Number that were seen on one road only.
    off_lanes
        Number that were near no lane.
    """

    counted: tuple[Passage, ...]
    inside_at_begin: int
    on_one_road: int
    off_lanes: int


def find_passages(matched: MatchedTracks) -> Passages:
    """Find the vehicles that passed a junction.

    Parameters
    ----------
    matched
        Vehicles on lanes.
    """
    counted, inside_at_begin, on_one_road, off_lanes = [], 0, 0, 0
    begin_s = matched.time_s.min(initial=math.inf)
    for track, rows in matched.tracks():
        numbers = matched.lane[rows]
        on_lane = numbers >= 0
        if not on_lane.any():
            off_lanes += 1
            continue
        first = int(np.flatnonzero(on_lane)[0])
        edges: list[str] = []
        for number in dict.fromkeys(numbers[on_lane].tolist()):
            lane = matched.lanes[number]
            edges += [edge for edge in dict.fromkeys((lane.source, lane.target)) if edge not in edges]
        if len(edges) < 2:
            on_one_road += 1
        elif matched.lanes[numbers[first]].is_inside and matched.time_s[rows][first] == begin_s:
            inside_at_begin += 1
        else:
            counted.append(Passage(track, tuple(edges)))
    return Passages(tuple(counted), inside_at_begin, on_one_road, off_lanes)


@dataclass(frozen=True, eq=False)
class Leaders:
    """The next vehicle ahead of each matched position, on its lane or those that follow.

    Attributes
    ----------
    row
        Its row at the same time, (n,) int64; -1 without one within 120 m.
    distance_m
        Distance between the centres along the lanes, (n,); inf without one.
    """

    row: IntArray
    distance_m: FloatArray


def find_leaders(matched: MatchedTracks) -> Leaders:
    """Find the next vehicle ahead of each position.

    Parameters
    ----------
    matched
        Vehicles on lanes.
    """
    row = np.full(matched.track.size, -1, dtype=np.int64)
    distance_m = np.full(matched.track.size, np.inf)
    on_lane = np.flatnonzero(matched.lane >= 0)
    order = on_lane[np.lexsort((matched.at_m[on_lane], matched.lane[on_lane], matched.time_s[on_lane]))]
    _, first = np.unique(matched.time_s[order], return_index=True)
    for rows in np.split(order, first[1:]):
        first_on_lane: dict[int, int] = {}
        for each in rows[::-1].tolist():
            number = int(matched.lane[each])
            ahead = first_on_lane.get(number)
            if ahead is not None:
                row[each], distance_m[each] = ahead, matched.at_m[ahead] - matched.at_m[each]
            first_on_lane[number] = each
        for each in rows[row[rows] < 0].tolist():
            row[each], distance_m[each] = _first_ahead(matched, each, first_on_lane)
    return Leaders(row, distance_m)


def _first_ahead(matched: MatchedTracks, row: int, first_on_lane: dict[int, int]) -> tuple[int, float]:
    """Return the nearest vehicle on the lanes that follow, and its distance."""
    number = int(matched.lane[row])
    to_end_m = matched.lanes[number].length_m - float(matched.at_m[row])
    front = [(number, to_end_m)]
    visited = {number}
    best, best_m = -1, math.inf
    while front:
        number, to_end_m = front.pop()
        for after in matched.following[number]:
            if after in visited or to_end_m > min(_LOOK_AHEAD_M, best_m):
                continue
            visited.add(after)
            ahead = first_on_lane.get(after)
            if ahead is None:
                front.append((after, to_end_m + matched.lanes[after].length_m))
            elif to_end_m + matched.at_m[ahead] < best_m:
                best, best_m = ahead, to_end_m + float(matched.at_m[ahead])
    return best, best_m


def free_speed_factors(matched: MatchedTracks, leaders: Leaders) -> dict[int, float]:
    """Return speed divided by the limit of each vehicle that nothing slows down, by track.

    Parameters
    ----------
    matched, leaders
        Vehicles on lanes, and the next ones ahead.
    """
    limits = np.array([lane.speed_m_s for lane in matched.lanes])
    is_straight = np.array([not lane.is_inside or lane.turn == "s" for lane in matched.lanes])
    factor = matched.speed_m_s / limits[matched.lane]
    gap_s = leaders.distance_m / np.maximum(matched.speed_m_s, 0.1)
    free = (matched.lane >= 0) & is_straight[matched.lane] & (factor > FREE_SHARE) & (gap_s > FREE_GAP_S)
    free &= _is_steady(matched)
    factors = {}
    for track, rows in matched.tracks():
        values = factor[rows][free[rows]]
        if values.size >= _MIN_ROWS:
            factors[track] = float(np.median(values))
    return factors


def _is_steady(matched: MatchedTracks) -> BoolArray:
    """Return where the speed changes little from the row before to the row after, (n,)."""
    steady = np.zeros(matched.track.size, dtype=bool)
    same = matched.track[2:] == matched.track[:-2]
    step_s = matched.time_s[2:] - matched.time_s[:-2]
    change = np.abs(matched.speed_m_s[2:] - matched.speed_m_s[:-2]) / np.where(same, step_s, 1.0)
    steady[1:-1] = same & (change < STEADY_M_S2)
    return steady


def standing_gaps_m(matched: MatchedTracks, leaders: Leaders, length_m: FloatArray) -> dict[int, float]:
    """Return the gap to the vehicle in front, bumper to bumper, of each vehicle that stands behind another.

    Parameters
    ----------
    matched, leaders
        Vehicles on lanes, and the next ones ahead.
    length_m
        Length of each vehicle, by track.
    """
    stands = matched.speed_m_s < STANDING_M_S
    both = np.flatnonzero((leaders.row >= 0) & stands & stands[leaders.row])
    both = both[matched.lane[both] == matched.lane[leaders.row[both]]]
    gaps: dict[int, list[float]] = defaultdict(list)
    for row in both.tolist():
        track, ahead = int(matched.track[row]), int(matched.track[leaders.row[row]])
        gaps[track].append(float(leaders.distance_m[row]) - (length_m[track] + length_m[ahead]) / 2.0)
    return {track: float(np.median(values)) for track, values in gaps.items()}


@dataclass(frozen=True)
class Follower:
    """A vehicle of a queue, when its front passes the stop line.

    Attributes
    ----------
    track
        The vehicle.
    headway_s
        Time since the front of the vehicle before passed.
    gap_m
        Distance to it, bumper to bumper; NaN where it has left the lanes that follow.
    speed_m_s
        Speed of the vehicle one time step later.
    ahead_m_s
        Speed of the one before.
    """

    track: int
    headway_s: float
    gap_m: float
    speed_m_s: float
    ahead_m_s: float

    def time_gap_s(self, min_gap_m: float, deceleration_m_s2: float, dawdling_m_s: float) -> float:
        """Return SUMO's desired time gap tau.

        Parameters
        ----------
        min_gap_m
            Minimum gap.
        deceleration_m_s2
            SUMO's deceleration of the vehicle.
        dawdling_m_s
            By how much it drives below the safe speed on average.
        """
        speed_m_s = self.speed_m_s + dawdling_m_s
        braking = (self.ahead_m_s**2 - speed_m_s**2) / (2.0 * deceleration_m_s2 * speed_m_s)
        return (self.gap_m - min_gap_m) / speed_m_s + braking


def queue_followers(matched: MatchedTracks, leaders: Leaders, length_m: FloatArray, step_s: float) -> list[Follower]:
    """Return the vehicles of queues at stop lines, from the :data:`FIRST_IN_QUEUE`\\ th on.

    Parameters
    ----------
    matched, leaders
        Vehicles on lanes, and the next ones ahead.
    length_m
        Length of each vehicle, by track.
    step_s
        Time step of the simulation.
    """
    followers = []
    for crossings in _stop_line_crossings(matched, length_m).values():
        in_queue = 0
        for before, crossing in zip([None, *crossings], crossings, strict=False):
            headway_s = math.inf if before is None else crossing.time_s - before.time_s
            if not crossing.was_queued:
                in_queue = 0
                continue
            in_queue = in_queue + 1 if headway_s < SATURATED_S else 1
            if in_queue < FIRST_IN_QUEUE or before is None or matched.speed_m_s[crossing.row] < _SLOWEST_AT_LINE_M_S:
                continue
            row = crossing.row
            ahead, gap_m = int(leaders.row[row]), math.nan
            if ahead >= 0 and matched.track[ahead] == before.track:
                gap_m = float(leaders.distance_m[row] - (length_m[crossing.track] + length_m[before.track]) / 2.0)
            speeds = _speed_after(matched, row, step_s), float(matched.speed_m_s[ahead])
            followers.append(Follower(crossing.track, headway_s, gap_m, *speeds))
    return followers


def _speed_after(matched: MatchedTracks, row: int, step_s: float) -> float:
    """Return the speed of a vehicle some time after a row; that of the row where its track ends."""
    speed_m_s = float(matched.speed_m_s[row])
    if row + 1 == matched.track.size or matched.track[row + 1] != matched.track[row]:
        return speed_m_s
    share = step_s / float(matched.time_s[row + 1] - matched.time_s[row])
    return speed_m_s + min(share, 1.0) * (float(matched.speed_m_s[row + 1]) - speed_m_s)


@dataclass(frozen=True, order=True)
class _Crossing:
    """A front that passes the end of a road: its time, the vehicle, the first row after it, whether it was queued."""

    time_s: float
    track: int
    row: int
    was_queued: bool


def _stop_line_crossings(matched: MatchedTracks, length_m: FloatArray) -> dict[int, list[_Crossing]]:
    """Return the fronts that pass the end of each lane of a road, in order of time."""
    crossings: dict[int, list[_Crossing]] = defaultdict(list)
    for track, rows in matched.tracks():
        numbers, speed_m_s = matched.lane[rows], matched.speed_m_s[rows]
        for after in np.flatnonzero(np.diff(numbers)) + 1:
            first, second = int(numbers[after - 1]), int(numbers[after])
            if first < 0 or second not in matched.following[first] or matched.lanes[first].is_inside:
                continue
            lane = matched.lanes[first]
            steps = np.append(np.flatnonzero(numbers[:after] == first), after)
            to_line_m = matched.at_m[rows][steps] + length_m[track] / 2.0 - lane.length_m
            to_line_m[-1] += lane.length_m
            to_line_m = np.maximum.accumulate(to_line_m)
            if to_line_m[0] > 0.0:
                continue
            last = int(np.searchsorted(to_line_m, 0.0, side="right"))
            ends = steps[last - 1 : last + 1]
            time_s = float(np.interp(0.0, to_line_m[last - 1 : last + 1], matched.time_s[rows][ends]))
            was_queued = bool((speed_m_s[:after] < QUEUED_M_S).any())
            crossings[first].append(_Crossing(time_s, track, rows.start + int(ends[-1]), was_queued))
    return {lane: sorted(values) for lane, values in crossings.items()}
