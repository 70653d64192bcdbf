"""The lanes at a position, and the height of the road there, also where roads are above one another.

**Lanes.** :meth:`RoadLanes.near` returns the lanes around positions: how far these are from the lane's area, and the
lane's height and direction there.

**Levels.** Heights of lanes near a position that differ by more than :data:`LEVEL_M` are different levels, such as a
bridge and the road below it. :meth:`RoadLanes.heights_m` chooses the level of each position of a track. The cost of a
level is the distance from its nearest lane, plus :data:`ACROSS_COST_M` for a vehicle across that lane; the track as a
whole has the lowest sum. A change of height that no road has between two positions costs more than anything else, so a
track stays on its level through a crossing. Where nothing decides, the lowest level counts.

World frame, metres, radians.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.core import polylines
from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.traffic.network import LANE_WIDTH_M, Network, is_carriageway

LEVEL_M = 1.5
"""Roads whose heights differ by more than this are different levels."""

ACROSS_COST_M = 3.0
"""Cost of a level whose lane is at right angles to a vehicle, as a distance from the lane."""

MAX_GRADE, MAX_STEP_M = 0.3, 0.5
"""Between two positions, a road rises no more than this grade and this height together allow."""

_JUMP_COST_M = 1e4
"""Cost of a change of height that no road has."""

_HIGHER_COST_M = 1e-3
"""Cost of a level for each level below it, so that the lowest one counts where nothing decides."""

_BESIDE_M = 4.0
"""Lanes that are farther from a position than the nearest one by no more than this may be those of a track."""

_SAMPLE_M = 0.5
_LEVEL_SAMPLE_M = 2.0
_ROWS_AT_ONCE = 50_000

_PEDESTRIAN_FUNCTIONS = ("crossing", "walkingarea")


@dataclass(frozen=True)
class NearbyLanes:
    """Pairs of a position and a lane near it, by position.

    Attributes
    ----------
    row, lane
        Index of the position and of the lane, (n,) int64.
    distance_m
        Distance of the position from the lane's area, 0 inside, (n,).
    height_m, yaw_rad
        Height and direction of the lane at its point nearest to the position, (n,).
    """

    row: IntArray
    lane: IntArray
    distance_m: FloatArray
    height_m: FloatArray
    yaw_rad: FloatArray


class RoadLanes:
    """The lanes for road vehicles of a network, those inside junctions included.

    Parameters
    ----------
    network
        The network.

    Attributes
    ----------
    limits_m_s
        Speed limit of each lane.
    """

    def __init__(self, network: Network) -> None:
        self._lines_m: list[FloatArray] = []
        half_widths_m, limits_m_s = [], []
        for edge in network.all_edges:
            for lane in edge.lanes:
                line_m = lane.shape_m
                line_m = line_m[np.insert(np.any(np.diff(line_m[:, :2], axis=0) != 0, axis=1), 0, True)]
                if edge.function in _PEDESTRIAN_FUNCTIONS or not is_carriageway(lane.permission) or len(line_m) < 2:
                    continue
                self._lines_m.append(line_m)
                half_widths_m.append((LANE_WIDTH_M if lane.width_m is None else lane.width_m) / 2.0)
                limits_m_s.append(lane.speed_m_s)
        self._half_widths_m = np.array(half_widths_m)
        self.limits_m_s = np.array(limits_m_s)
        self._junctions = [shape for shape in network.junctions if shape.type != "internal" and len(shape.shape_m) > 2]

    def __len__(self) -> int:
        return len(self._lines_m)

    def near(self, xy_m: FloatArray, within_m: float | FloatArray) -> NearbyLanes:
        """Return the lanes around positions.

        Parameters
        ----------
        xy_m
            Positions, (n, 2).
        within_m
            Largest distance from the lane's area, for all positions or for each (n,).
        """
        import shapely

        if not len(self) or not len(xy_m):
            none = np.empty(0)
            return NearbyLanes(none.astype(np.int64), none.astype(np.int64), none, none, none)
        lines, tree, stations_m, points_m, first_station_m = self._index
        limits_m = np.broadcast_to(np.asarray(within_m, dtype=np.float64), len(xy_m))
        points = shapely.points(xy_m)
        row, lane = tree.query(points, "dwithin", limits_m + self._half_widths_m.max())
        order = np.lexsort((lane, row))
        row, lane = row[order].astype(np.int64), lane[order].astype(np.int64)
        distance_m = np.maximum(shapely.distance(lines[lane], points[row]) - self._half_widths_m[lane], 0.0)
        is_near = distance_m <= limits_m[row]
        row, lane, distance_m = row[is_near], lane[is_near], distance_m[is_near]
        at_m = first_station_m[lane] + shapely.line_locate_point(lines[lane], points[row])
        height_m = np.interp(at_m, stations_m, points_m[:, 2])
        segment = np.clip(np.searchsorted(stations_m, at_m, side="right") - 1, 0, len(stations_m) - 2)
        is_between = segment + 1 == self._first_points[lane + 1]  # beyond the end of the lane's line
        segment = segment - is_between
        along_m = points_m[segment + 1, :2] - points_m[segment, :2]
        return NearbyLanes(row, lane, distance_m, height_m, np.arctan2(along_m[:, 1], along_m[:, 0]))

    @property
    def bounds_m(self) -> FloatArray:
        """South-west and north-east corner of all lanes, (2, 2)."""
        points_m = np.concatenate(self._lines_m)[:, :2]
        half_width_m = self._half_widths_m.max()
        return np.array([points_m.min(axis=0) - half_width_m, points_m.max(axis=0) + half_width_m])

    def in_junctions(self, xy_m: FloatArray) -> BoolArray:
        """Return whether positions (n, 2) are inside the outline of a junction, (n,)."""
        import shapely

        inside = np.zeros(len(xy_m), dtype=np.bool_)
        inside[self._outlines.query(shapely.points(xy_m), "intersects")[0]] = True
        return inside

    def heights_m(self, track: IntArray, time: NDArray[Any], xy_m: FloatArray, yaw_rad: FloatArray) -> FloatArray:
        """Return the height of the road below the positions of tracks.

        Parameters
        ----------
        track, time
            Track and time of each position, (n,), in any order.
        xy_m
            Positions, (n, 2).
        yaw_rad
            Heading at each position, (n,); NaN where it says nothing about the lane.

        Returns
        -------
        ndarray
            Heights, (n,); those of the nearest lane in plan where there is one level only, 0 without lanes.
        """
        from scipy.spatial import KDTree

        if not len(xy_m) or not any(line_m[:, 2].any() for line_m in self._lines_m):
            return np.zeros(len(xy_m))
        samples_m = self._sample(_SAMPLE_M)
        nearest_m, sample = KDTree(samples_m[:, :2]).query(xy_m)
        heights_m: FloatArray = samples_m[sample, 2].copy()
        stacked_m = self._stacked_m
        if not len(stacked_m):
            return heights_m
        reach_m = nearest_m + 2.0 * _BESIDE_M + _LEVEL_SAMPLE_M
        rows = np.flatnonzero(KDTree(stacked_m).query(xy_m)[0] <= reach_m)
        order = rows[np.lexsort((time[rows], track[rows]))]
        levels = self._levels(xy_m[order], yaw_rad[order], nearest_m[order])
        heights_m[order] = [row_levels[0][0] for row_levels in levels]
        _choose_levels(track, time, xy_m, heights_m, dict(zip(order.tolist(), levels, strict=True)))
        return heights_m

    @cached_property
    def _first_points(self) -> IntArray:
        """Index of the first point of each lane among all points, and the number of points, (n_lanes + 1,)."""
        return np.cumsum([0, *(len(line_m) for line_m in self._lines_m)])

    @cached_property
    def _index(self) -> tuple[NDArray[Any], Any, FloatArray, FloatArray, FloatArray]:
        """Lines, their tree, stations and points of all lanes one after the other, and where each lane starts."""
        import shapely

        lines = np.array([shapely.LineString(line_m[:, :2]) for line_m in self._lines_m], dtype=object)
        stations = [polylines.stations_m(line_m) for line_m in self._lines_m]
        lengths_m = np.array([station_m[-1] + 1.0 for station_m in stations])
        starts_m = np.cumsum(lengths_m) - lengths_m
        stations_m = np.concatenate(
            [start_m + station_m for start_m, station_m in zip(starts_m, stations, strict=True)]
        )
        return lines, shapely.STRtree(lines), stations_m, np.concatenate(self._lines_m), starts_m

    @cached_property
    def _outlines(self) -> Any:
        import shapely

        rings = [shape.shape_m[:, :2] for shape in self._junctions]
        return shapely.STRtree([shapely.make_valid(shapely.Polygon(ring)) for ring in rings])

    def _sample(self, spacing_m: float) -> FloatArray:
        """Return points on all lanes, (n, 3)."""
        return np.concatenate([
            polylines.points_at(line_m, np.arange(0.0, polylines.length_m(line_m), spacing_m))
            for line_m in self._lines_m
        ])  # fmt: skip

    @cached_property
    def _stacked_m(self) -> FloatArray:
        """Points (n, 2) of lanes that are above or below other lanes."""
        heights_m = np.concatenate(self._lines_m)[:, 2]
        if np.ptp(heights_m) <= LEVEL_M:
            return np.empty((0, 2))
        samples_m = self._sample(_LEVEL_SAMPLE_M)
        lanes = self.near(samples_m[:, :2], _BESIDE_M)
        is_other = np.abs(lanes.height_m - samples_m[lanes.row, 2]) > LEVEL_M
        return samples_m[np.unique(lanes.row[is_other]), :2]

    def _levels(self, xy_m: FloatArray, yaw_rad: FloatArray, nearest_m: FloatArray) -> list[list[tuple[float, float]]]:
        """Return the levels at each position from the lowest on: their height, and their cost."""
        levels: list[list[tuple[float, float]]] = []
        for first in range(0, len(xy_m), _ROWS_AT_ONCE):
            rows = slice(first, first + _ROWS_AT_ONCE)
            lanes = self.near(xy_m[rows], nearest_m[rows] + _BESIDE_M)
            turn_rad = np.nan_to_num(yaw_rad[rows])[lanes.row] - lanes.yaw_rad
            across = np.where(np.isnan(yaw_rad[rows][lanes.row]), 0.0, np.sin(turn_rad) ** 2)
            levels += _group_levels(len(xy_m[rows]), lanes, lanes.distance_m + ACROSS_COST_M * across)
        return levels


def _group_levels(n_rows: int, lanes: NearbyLanes, cost_m: FloatArray) -> list[list[tuple[float, float]]]:
    """Join the lanes of each row whose heights follow one another; each level has the height of its best lane."""
    order = np.lexsort((lanes.height_m, lanes.row))
    row, height_m, cost_m = lanes.row[order], lanes.height_m[order], cost_m[order]
    is_first = (np.diff(row, prepend=-1) != 0) | (np.diff(height_m, prepend=-np.inf) > LEVEL_M)
    level = np.cumsum(is_first) - 1
    best = np.lexsort((cost_m, level))[np.flatnonzero(is_first)]
    levels: list[list[tuple[float, float]]] = [[] for _ in range(n_rows)]
    for number, at_m, level_cost_m in zip(
        row[best].tolist(), height_m[best].tolist(), cost_m[best].tolist(), strict=True
    ):
        levels[number].append((at_m, level_cost_m))
    return levels


def _choose_levels(
    track: IntArray,
    time: NDArray[Any],
    xy_m: FloatArray,
    heights_m: FloatArray,
    levels: dict[int, list[tuple[float, float]]],
) -> None:
    """Set the height of each row that has several levels; other rows of the same track keep theirs."""
    tracks = np.unique(track[[row for row, choices in levels.items() if len(choices) > 1]])
    rows = np.flatnonzero(np.isin(track, tracks))
    rows = rows[np.lexsort((time[rows], track[rows]))]
    starts = np.flatnonzero(np.diff(track[rows], prepend=-1, append=-1) != 0)
    for first, end in itertools.pairwise(starts.tolist()):
        of_track = rows[first:end].tolist()
        steps_m = np.append(0.0, np.hypot(*np.diff(xy_m[of_track], axis=0).T)).tolist()
        choices = [levels.get(row) or [(float(heights_m[row]), 0.0)] for row in of_track]
        heights_m[of_track] = _cheapest_heights(choices, steps_m)


def _cheapest_heights(choices: list[list[tuple[float, float]]], steps_m: list[float]) -> list[float]:
    """Return one height for each position of a track, with the lowest sum of costs (Viterbi's algorithm)."""
    totals = [cost_m + rank * _HIGHER_COST_M for rank, (_, cost_m) in enumerate(choices[0])]
    came_from: list[list[int]] = []
    for before, here, step_m in zip(choices, choices[1:], steps_m[1:], strict=False):
        rise_m = MAX_GRADE * step_m + MAX_STEP_M
        next_totals, origins = [], []
        for rank, (height_m, cost_m) in enumerate(here):
            reached = [
                total + (_JUMP_COST_M if abs(height_m - other_m) > rise_m else 0.0)
                for total, (other_m, _) in zip(totals, before, strict=True)
            ]
            best = min(range(len(reached)), key=reached.__getitem__)
            next_totals.append(reached[best] + cost_m + rank * _HIGHER_COST_M)
            origins.append(best)
        totals = next_totals
        came_from.append(origins)
    level = min(range(len(totals)), key=totals.__getitem__)
    heights_m = [choices[-1][level][0]]
    for position in range(len(choices) - 1, 0, -1):
        level = came_from[position - 1][level]
        heights_m.append(choices[position - 1][level][0])
    return heights_m[::-1]
