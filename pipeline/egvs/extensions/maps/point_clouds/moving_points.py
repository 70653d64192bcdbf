"""Find what moved while a point cloud was taken: vehicles and pedestrians.

Two rules, both of which need to know where the scanner stood:

- **Several sweeps from one place** (:func:`not_shared`): a direction ends at the farthest range that at least 30 % of
  the sweeps, and at least three, share. Points elsewhere are moving, or noise.
- **Several places** (:func:`seen_through`): a point is moving when another station measured farther in that direction
  and all around it, or met nothing there, and no other station measured anything where the point is. Source of the
  idea: Pagad et al. 2020, "Robust method for removing dynamic objects from point clouds", ICRA.

Directions are compared in cells of azimuth and elevation. Frame: that of the points, metres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egvs.core.grid import BoolArray, FloatArray, IntArray

SAME_STATION_M = 0.5
"""Scanners closer to each other than this are at one station."""

MIN_SWEEPS, SHARE = 3, 0.3
SWEEP_CELL_DEG = (0.2, 0.1)
"""Azimuth and elevation of the cells that compare sweeps: about one beam each."""

VIEW_CELL_DEG = 0.5
MAX_RANGE_RATIO = 5.0
"""A station judges only points that are at most this many times as far from it as from their own station."""

DENSE_SHARE = 0.5
"""Where more of the cells of a scan are filled, a patch of nine empty cells is sky, not a gap between beams."""

_OUTER_PERCENT = 5

_TOLERANCE_M, _TOLERANCE_SHARE = 0.3, 0.01
_MIN_FILLED = 6
_MASK_BITS = 64


@dataclass(frozen=True)
class StationScan:
    """Points of one scan, or of several sweeps from one place.

    Attributes
    ----------
    station_m
        Where the scanner stood, (3,).
    points_m
        (n, 3) float64, finite.
    """

    station_m: FloatArray
    points_m: FloatArray


def tolerance_m(range_m: FloatArray) -> FloatArray:
    """Return the difference up to which ranges are equal, metres."""
    return np.maximum(_TOLERANCE_M, _TOLERANCE_SHARE * range_m)


def group_by_station(scans: Sequence[StationScan]) -> list[list[int]]:
    """Return the numbers of the scans at each station, in the order of their first scans."""
    groups: list[list[int]] = []
    for number, scan in enumerate(scans):
        for group in groups:
            if math.dist(scans[group[0]].station_m, scan.station_m) <= SAME_STATION_M:
                group.append(number)
                break
        else:
            groups.append([number])
    return groups


def not_shared(sweeps: Sequence[StationScan]) -> list[BoolArray]:
    """Return which points of each sweep are not at the farthest range that enough sweeps share in their direction.

    Parameters
    ----------
    sweeps
        At least three from one place.

    Returns
    -------
    list of ndarray of bool
        (n,) for each sweep.
    """
    azimuth, elevation, range_m = _polar(np.concatenate([sweep.points_m - sweep.station_m for sweep in sweeps]))
    cell = _cell_number(azimuth, elevation, SWEEP_CELL_DEG)
    counts = [len(sweep.points_m) for sweep in sweeps]
    number = np.repeat(np.arange(len(sweeps)), counts)
    needed = max(MIN_SWEEPS, math.ceil(SHARE * min(len(sweeps), _MASK_BITS)))
    shared = _sweeps_in_reach(cell, number, range_m) >= needed
    farthest = np.full(int(cell.max(initial=0)) + 1, -np.inf)
    np.maximum.at(farthest, cell[shared], range_m[shared])
    moving = np.abs(farthest[cell] - range_m) > tolerance_m(range_m)
    return np.split(moving, np.cumsum(counts)[:-1])


def _sweeps_in_reach(cell: IntArray, sweep: IntArray, range_m: FloatArray) -> IntArray:
    """Return, for each point, how many sweeps have a point in its cell at the same range; (n,)."""
    order = np.lexsort((range_m, cell))
    key = cell[order] * 1e5 + np.minimum(range_m[order], 5e4)  # one sorted axis: ranges of a cell do not reach the next
    mask = np.left_shift(np.uint64(1), (sweep[order] % _MASK_BITS).astype(np.uint64))
    tolerance = tolerance_m(range_m[order])
    first = np.searchsorted(key, key - tolerance, side="left")
    last = np.searchsorted(key, key + tolerance, side="right")
    # reduceat of pairs; a last index beyond the end stands for the end
    bounds = np.column_stack([first, last]).ravel()
    union = np.bitwise_or.reduceat(np.append(mask, np.uint64(0)), bounds)[::2]
    counts = np.empty(len(cell), dtype=np.int64)
    counts[order] = np.bitwise_count(union)
    return counts


def seen_through(views: Sequence[StationScan]) -> list[BoolArray]:
    """Return which points of each view another station saw through, while no other station confirms them.

    Parameters
    ----------
    views
        All points of each station, at least two stations.

    Returns
    -------
    list of ndarray of bool
        (n,) for each view.
    """
    images = [_RangeImage.of(view) for view in views]
    moving = []
    for number, view in enumerate(views):
        own_range = np.sqrt(((view.points_m - view.station_m) ** 2).sum(axis=1))
        through = np.zeros(len(view.points_m), dtype=np.int64)
        confirmed = np.zeros(len(view.points_m), dtype=np.int64)
        for other, image in enumerate(images):
            if other == number:
                continue
            is_through, is_confirmed = image.judge(view.points_m, own_range)
            through += is_through
            confirmed += is_confirmed
        moving.append((through > 0) & (confirmed == 0))
    return moving


@dataclass(frozen=True)
class _RangeImage:
    """The ranges that a station measured, by direction.

    Attributes
    ----------
    station_m
        (3,).
    nearest, farthest
        Ranges in each cell of azimuth and elevation, inf and -inf where there is no point.
    surrounding
        Nearest range in each cell and its eight neighbours.
    filled
        How many of these cells have a point.
    sky_limits
        Lowest and highest elevation in degrees, and largest range, up to which nine empty cells are sky; none of a
        sparse scan.
    """

    station_m: FloatArray
    nearest: FloatArray
    farthest: FloatArray
    surrounding: FloatArray
    filled: IntArray
    sky_limits: tuple[float, float, float]

    @classmethod
    def of(cls, view: StationScan) -> _RangeImage:
        from scipy.ndimage import convolve, minimum_filter

        azimuth, elevation, range_m = _polar(view.points_m - view.station_m)
        cell = _cell_number(azimuth, elevation, (VIEW_CELL_DEG, VIEW_CELL_DEG))
        shape = _image_shape((VIEW_CELL_DEG, VIEW_CELL_DEG))
        nearest = np.full(shape, np.inf)
        np.minimum.at(nearest.ravel(), cell, range_m)
        farthest = np.full(shape, -np.inf)
        np.maximum.at(farthest.ravel(), cell, range_m)
        around = ("wrap", "nearest")
        filled = np.isfinite(nearest).astype(np.int64)
        sky_limits = _sky_limits(filled, elevation, range_m)
        for axis, mode in enumerate(around):
            filled = convolve(filled, np.ones((3, 1) if axis == 0 else (1, 3), dtype=np.int64), mode=mode)
        surrounding = minimum_filter(nearest, size=3, mode=around)
        return cls(view.station_m, nearest, farthest, surrounding, filled, sky_limits)

    def judge(self, points_m: FloatArray, own_range_m: FloatArray) -> tuple[BoolArray, BoolArray]:
        """Return which points (n, 3) this station saw through, and which it confirms."""
        azimuth, elevation, range_m = _polar(points_m - self.station_m)
        cell = _cell_number(azimuth, elevation, (VIEW_CELL_DEG, VIEW_CELL_DEG))
        tolerance = tolerance_m(range_m)
        filled = self.filled.ravel()[cell]
        is_farther = (filled >= _MIN_FILLED) & (self.surrounding.ravel()[cell] > range_m + tolerance)
        lowest, highest, longest = self.sky_limits
        is_sky = (filled == 0) & (elevation >= lowest) & (elevation <= highest) & (range_m <= longest)
        through = (is_farther | is_sky) & (range_m <= MAX_RANGE_RATIO * own_range_m)
        nearest, farthest = self.nearest.ravel()[cell], self.farthest.ravel()[cell]
        confirmed = (nearest <= range_m + tolerance) & (farthest >= range_m - tolerance)
        return through, confirmed


def _sky_limits(filled: IntArray, elevation: FloatArray, range_m: FloatArray) -> tuple[float, float, float]:
    """Return the elevations and the range up to which empty cells of an image are sky, see :class:`_RangeImage`."""
    nowhere = (np.inf, -np.inf, -np.inf)
    if not len(range_m):
        return nowhere
    low, high = np.percentile(elevation, (_OUTER_PERCENT, 100 - _OUTER_PERCENT))
    first, last = (int((edge + 90.0) / VIEW_CELL_DEG) for edge in (low, high))
    if filled[:, first : last + 1].mean() <= DENSE_SHARE:
        return nowhere
    return float(low), float(high), float(np.percentile(range_m, 100 - _OUTER_PERCENT))


def _polar(offsets: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return azimuth in [0, 360) and elevation in degrees, and range in metres, of offsets (n, 3)."""
    x, y, z = offsets.T
    flat = np.hypot(x, y)
    return np.degrees(np.arctan2(y, x)) % 360.0, np.degrees(np.arctan2(z, flat)), np.hypot(flat, z)


def _image_shape(cell_deg: tuple[float, float]) -> tuple[int, int]:
    return math.ceil(360.0 / cell_deg[0]), math.ceil(180.0 / cell_deg[1]) + 1


def _cell_number(azimuth: FloatArray, elevation: FloatArray, cell_deg: tuple[float, float]) -> IntArray:
    """Return the number of the cell of each direction, (n,) int64."""
    columns, rows = _image_shape(cell_deg)
    column = np.minimum((azimuth / cell_deg[0]).astype(np.int64), columns - 1)
    row = np.minimum(((elevation + 90.0) / cell_deg[1]).astype(np.int64), rows - 1)
    return column * rows + row
