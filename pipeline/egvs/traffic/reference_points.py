"""Which point of a vehicle do the positions of a file state: the middle of the front bumper, or the centre?

FCD has front bumpers, tracks have centres. If a file has the other one, each box is half a length too far back or
ahead, and everything looks plausible. Two things tell:

- *Turns.* A point that is a distance ``d`` ahead of the point about which a vehicle turns moves sideways with ``d``
  times the rate of turn. Of SUMO's vehicles, ``d`` is 0.5 lengths at the front bumper; in a real recording of a
  junction, it is 0.13 lengths at the centre, and so 0.63 at the front bumper. Half a length more is certain. Half a
  length less is so only for tracks: angles of FCD that were computed from its positions give ``d = 0`` as well.
- *Queues.* Drivers leave the same gap whether the vehicle ahead is longer or shorter than theirs. If each box is too
  far back by a share of its length, the gap falls by this share of the difference of their lengths.

Vehicles that drive straight on, and queues of vehicles of one length, do not tell.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from egvs.core.errors import Diagnostic
from egvs.core.grid import FloatArray, IntArray
from egvs.core.wording import number_of

BASE_S = 0.5
"""Motion and turn are measured from this long before a time to this long after it, or between neighbouring rows."""

MIN_SPEED_M_S, MIN_TURN_RAD_S = 1.5, 0.1
"""Slower vehicles, and those that turn less, say nothing."""

MIN_AHEAD, MAX_AHEAD = 0.3, 0.85
"""Distance of a front bumper ahead of the point about which a vehicle turns, in lengths."""

MIN_TURNS = 5
"""Number of vehicles that turn."""

STANDING_M_S, MAX_GAP_M, MAX_ASIDE_M, MAX_ANGLE_RAD = 0.2, 6.0, 1.0, 0.2
"""Vehicles in a queue stand, one behind the other."""

MIN_SLOPE, MIN_PAIRS, MIN_UNEQUAL_M = 0.35, 10, 1.0
"""Change of the gap with the difference of lengths, in a number of pairs half of which differ by this length."""

MIN_ERRORS = 4.0
"""A value counts if it is farther from its limit than so many of its standard errors."""

_MAX_STANDING = 4000
"""Standing rows of each table that are compared."""


@dataclass
class ReferencePoints:
    """Measures turns and queues, table by table.

    Attributes
    ----------
    are_centres
        Whether the file states centres; the positions that are measured are front bumpers in any case.
    ahead
        Distance of the position of each vehicle that turns ahead of the point about which it does, in lengths.
    gaps_m
        The gap between two vehicles of a queue, and by how much the one ahead is longer, by their names.
    """

    are_centres: bool = False
    ahead: list[float] = field(default_factory=list)
    gaps_m: dict[tuple[str, str], tuple[float, float]] = field(default_factory=dict)

    def add(
        self,
        names: list[str],
        vehicle: IntArray,
        time_ms: IntArray,
        xy_m: FloatArray,
        yaw_rad: FloatArray,
        length_m: FloatArray,
    ) -> None:
        """Measure some rows, sorted by vehicle, then time; ``length_m`` is NaN where it is unknown."""
        known = np.isfinite(length_m) & (length_m > 0.0)
        vehicle, time_ms, xy_m = vehicle[known], time_ms[known], xy_m[known]
        yaw_rad, length_m = yaw_rad[known], length_m[known]
        if len(vehicle) > 1:
            self._add_turns(vehicle, time_ms / 1000.0, xy_m, yaw_rad, length_m)
            self._add_gaps(names, vehicle, time_ms / 1000.0, xy_m, yaw_rad, length_m)

    def _add_turns(
        self, vehicle: IntArray, time_s: FloatArray, xy_m: FloatArray, yaw_rad: FloatArray, length_m: FloatArray
    ) -> None:
        steps_s = np.diff(time_s)[np.diff(vehicle) == 0]
        if not len(steps_s):
            return
        step_s = float(np.median(steps_s))
        lag = max(1, round(BASE_S / step_s)) if step_s > 0 else 1
        middle = np.arange(lag, len(vehicle) - lag)
        before, after = middle - lag, middle + lag
        duration_s = time_s[after] - time_s[before]
        is_steady = (vehicle[before] == vehicle[after]) & (np.abs(duration_s - 2.0 * lag * step_s) < 0.5 * step_s)
        before, middle, after, duration_s = (rows[is_steady] for rows in (before, middle, after, duration_s))
        velocity_m_s = (xy_m[after] - xy_m[before]) / duration_s[:, None]
        turn_rad_s = np.angle(np.exp(1j * (yaw_rad[after] - yaw_rad[before]))) / duration_s
        along = np.column_stack([np.cos(yaw_rad[middle]), np.sin(yaw_rad[middle])])
        forward_m_s = (velocity_m_s * along).sum(axis=1)
        sideways_m_s = velocity_m_s[:, 1] * along[:, 0] - velocity_m_s[:, 0] * along[:, 1]
        turns = (forward_m_s > MIN_SPEED_M_S) & (np.abs(turn_rad_s) > MIN_TURN_RAD_S)
        of_vehicle, turn_rad_s = vehicle[middle[turns]], turn_rad_s[turns]
        products = np.bincount(of_vehicle, turn_rad_s * sideways_m_s[turns] / length_m[middle[turns]])
        squares = np.bincount(of_vehicle, turn_rad_s**2)
        enough = np.bincount(of_vehicle) >= 3
        self.ahead += (products[enough] / squares[enough]).tolist()

    def _add_gaps(
        self, names: list[str], vehicle: IntArray, time_s: FloatArray, xy_m: FloatArray, yaw_rad: FloatArray,
        length_m: FloatArray,
    ) -> None:  # fmt: skip
        from scipy.spatial import KDTree

        duration_s, moved_m = np.diff(time_s), np.hypot(*np.diff(xy_m, axis=0).T)
        stands = (np.diff(vehicle) == 0) & (duration_s > 0.0) & (moved_m < STANDING_M_S * duration_s)
        rows = np.flatnonzero(stands)
        if len(rows) > _MAX_STANDING:
            times_s = np.unique(time_s[rows])
            every = -(-len(rows) // _MAX_STANDING)
            rows = rows[np.isin(time_s[rows], times_s[::every])]
        if len(rows) < 2:
            return
        reach_m = float(length_m[rows].max()) + MAX_GAP_M
        apart_m = np.searchsorted(np.unique(time_s[rows]), time_s[rows]) * 2.0 * reach_m  # times do not meet
        pairs = KDTree(np.column_stack([xy_m[rows], apart_m])).query_pairs(reach_m, output_type="ndarray")
        behind, ahead = np.concatenate([pairs, pairs[:, ::-1]]).T
        behind, ahead = rows[behind], rows[ahead]
        between_m = xy_m[ahead] - xy_m[behind]
        c, s = np.cos(yaw_rad[behind]), np.sin(yaw_rad[behind])
        along_m, aside_m = between_m[:, 0] * c + between_m[:, 1] * s, between_m[:, 1] * c - between_m[:, 0] * s
        is_same_way = np.abs(np.angle(np.exp(1j * (yaw_rad[ahead] - yaw_rad[behind])))) < MAX_ANGLE_RAD
        follows = (along_m > 0.0) & (np.abs(aside_m) < MAX_ASIDE_M) & is_same_way
        order = np.lexsort((along_m, behind))
        order = order[follows[order]]
        first = order[np.diff(behind[order], prepend=-1) != 0]
        for one, other, way_m in zip(
            behind[first].tolist(), ahead[first].tolist(), along_m[first].tolist(), strict=True
        ):
            gap_m = way_m - length_m[other]
            if gap_m < MAX_GAP_M:
                pair = names[vehicle[other]], names[vehicle[one]]
                self.gaps_m[pair] = (gap_m, float(length_m[other] - length_m[one]))

    def findings(self, where: str) -> Iterator[Diagnostic]:
        """Warn if the positions are those of another point."""
        slope = self._gap_slope()
        ahead, error = self._ahead()
        is_ahead = slope > MIN_SLOPE or ahead - MIN_ERRORS * error > MAX_AHEAD
        is_behind = slope < -MIN_SLOPE or (self.are_centres and ahead + MIN_ERRORS * error < MIN_AHEAD)
        if is_ahead == is_behind:  # neither, or they contradict one another
            return
        side = "ahead of" if is_ahead else "behind"
        stated = "centre" if self.are_centres else "front bumper"
        likely = {(True, True): "front bumpers", (True, False): "rear bumpers", (False, False): "centres"}.get(
            (self.are_centres, is_ahead), "points ahead of the vehicles"
        )
        evidence = []
        if abs(slope) > MIN_SLOPE:
            pairs = number_of(len(self.gaps_m), "pair")
            evidence.append(f"gaps in queues change by {slope:+.2f} m for each metre of the vehicle ahead ({pairs})")
        if not MIN_AHEAD <= ahead <= MAX_AHEAD:
            turns = number_of(len(self.ahead), "vehicle")
            evidence.append(f"front bumpers turn about a point {ahead:.2f} lengths behind them ({turns})")
        problem = f"positions seem to be {side} the {stated} by half the length of each vehicle: {'; '.join(evidence)}"
        hint = f"Check the point that positions stand for: these look like {likely}."
        yield Diagnostic("reference point", where, problem, hint)

    def _gap_slope(self) -> float:
        """Return the change of the gap with the difference of lengths; 0 where it is not clear."""
        if len(self.gaps_m) < MIN_PAIRS:
            return 0.0
        gap_m, longer_m = np.array(list(self.gaps_m.values())).T
        if 2 * np.count_nonzero(np.abs(longer_m) >= MIN_UNEQUAL_M) < MIN_PAIRS:
            return 0.0
        centred_m = longer_m - longer_m.mean()
        slope = float(centred_m @ gap_m / (centred_m @ centred_m))
        left_m = gap_m - gap_m.mean() - slope * centred_m
        error = float(np.sqrt(left_m @ left_m / (len(gap_m) - 2) / (centred_m @ centred_m)))
        return slope if abs(slope) > MIN_ERRORS * error else 0.0

    def _ahead(self) -> tuple[float, float]:
        """Return the median distance ahead in lengths, and its standard error; infinite where too few turn."""
        values: FloatArray = np.array(self.ahead)
        if len(values) < MIN_TURNS:
            return (MIN_AHEAD + MAX_AHEAD) / 2.0, np.inf
        spread = 1.4826 * float(np.median(np.abs(values - np.median(values))))
        return float(np.median(values)), 1.2533 * spread / np.sqrt(len(values))
