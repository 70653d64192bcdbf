r"""Probability that a pulse gives a return, by range and incidence; sectors of azimuth without returns.

The range of a pulse without a return is unknown, so what it would have met must be known otherwise:

- *On smooth surfaces*: both neighbours in azimuth returned from one surface, so the pulse between them met it too. With
  independent losses of probability 1 - p, the share of these pulses that returned estimates p without bias, because the
  pulse itself takes no part in the choice. Neighbouring choices share returns, which increases the variance of the
  share by the factor 1 + 2 p (1 - p): of three consecutive pulses, two are each other's neighbours, and

  .. math:: E[(X_k - p) X_k] \, E[(X_{k+1} - p) X_{k+1}] \, p^2 = (p (1 - p))^2 p^2

  for both neighbours, against :math:`p (1 - p) p^2` for one pulse alone. Losses in patches, as on dark or wet surfaces,
  are missed: the share is then an upper bound.
- *On the road*: the pulse aims at the ground plane, in a sector of azimuth where nearly all returns are from the plane.
  Only pulses count whose nearest returns in the same channel, within 3 degrees to the left and to the right, are from
  the road too: a lost pulse next to a vehicle or a wall may have been aimed at that. Losses in patches count.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from egvs.core.grid import BoolArray, FloatArray
from egvs.extensions.hardware.fit.beam_angles import BeamAngles
from egvs.extensions.hardware.fit.range_noise import MAX_SLOPE
from egvs.extensions.hardware.fit.surface_normals import incidence_angles_deg
from egvs.sensors.ground_plane import GroundPlane
from egvs.statistics.intervals import MIN_VALUES, Estimate, estimate_share

RANGE_EDGES_M = (
    0.0,
    5.0,
    10.0,
    15.0,
    20.0,
    25.0,
    30.0,
    35.0,
    40.0,
    45.0,
    50.0,
    55.0,
    60.0,
    70.0,
    85.0,
    100.0,
    150.0,
    200.0,
    400.0,
)
INCIDENCE_EDGES_DEG = (0.0, 30.0, 60.0, 75.0, 80.0, 85.0, 90.0)
ROAD_BAND_M = 0.5
"""Returns within this height of the plane are from the road, including its camber and kerbs."""

_SECTOR_DEG = 2.0
_SECTOR_RANGE_M = (5.0, 60.0)
_MIN_SECTOR_RETURNS = 20
_MIN_ON_ROAD, _MAX_BEHIND = 0.6, 0.05
_NEIGHBOUR_DEG = 3.0
_EMPTY_SHARE = 0.05
_MIN_EMPTY_DEG = 2.0


@dataclass(frozen=True)
class RateBin:
    """Share of returns between two ranges and two angles of incidence.

    Attributes
    ----------
    from_m, to_m, from_deg, to_deg
        The ranges and angles.
    rate
        The share.
    """

    from_m: float
    to_m: float
    from_deg: float
    to_deg: float
    rate: Estimate


@dataclass(frozen=True)
class PlaneView:
    """Where pulses meet the ground plane, all (channels, azimuths).

    Attributes
    ----------
    range_m
        Range; infinite for a pulse that does not meet it.
    incidence_deg
        Angle of incidence.
    on_road
        Whether the pulse is in a sector of azimuth where the plane is in sight.
    """

    range_m: FloatArray
    incidence_deg: FloatArray
    on_road: BoolArray

    def height_m(self, range_m: FloatArray) -> FloatArray:
        """Height of returns at these ranges above the plane."""
        return (self.range_m - range_m) * np.cos(np.radians(self.incidence_deg))


def view_of_plane(
    grids: list[FloatArray], angles: BeamAngles, plane: GroundPlane, sector_deg: tuple[float, float] | None = None
) -> PlaneView:
    """Return where pulses meet a plane, and which of them are in sectors where it is in sight.

    A sector of 2 degrees counts if at least 60 % of its returns between 5 and 60 m along the plane are from the plane,
    and at most 5 % from behind it.

    Parameters
    ----------
    grids
        Ranges of each sweep's pulses.
    angles
        Their directions.
    plane
        The plane.
    sector_deg
        First and last azimuth of the road, counter-clockwise; instead of finding the sectors.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = -(angles.directions() @ plane.normal)
        range_m = (plane.height_m + angles.origins_m() @ plane.normal) / cosine
    range_m = np.where(cosine > 0, range_m, np.inf)
    incidence_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    azimuth_deg = angles.azimuth_deg()
    if sector_deg is not None:
        first, last = sector_deg
        on_road = np.mod(azimuth_deg - first, 360.0) <= last - first
        return PlaneView(range_m, incidence_deg, on_road)

    sector = np.floor(np.mod(azimuth_deg + 180.0, 360.0) / _SECTOR_DEG).astype(np.int64)
    sectors = round(360.0 / _SECTOR_DEG)
    counts = np.zeros((3, sectors))
    near, far = _SECTOR_RANGE_M
    aimed = (range_m > near) & (range_m < far)
    for grid in grids:
        with np.errstate(invalid="ignore"):
            height_m = (range_m - grid) * cosine
        returned = aimed & np.isfinite(grid)
        counts[0] += np.bincount(sector[returned], minlength=sectors)
        counts[1] += np.bincount(sector[returned & (np.abs(height_m) <= ROAD_BAND_M)], minlength=sectors)
        counts[2] += np.bincount(sector[returned & (height_m < -ROAD_BAND_M)], minlength=sectors)
    total = np.maximum(counts[0], 1)
    is_road = (counts[0] >= _MIN_SECTOR_RETURNS * len(grids)) & (counts[1] / total >= _MIN_ON_ROAD)
    is_road &= counts[2] / total <= _MAX_BEHIND
    return PlaneView(range_m, incidence_deg, is_road[sector])


def road_rates(grids: list[FloatArray], angles: BeamAngles, view: PlaneView) -> list[RateBin]:
    """Return the share of returns from the road, in each interval of :data:`RANGE_EDGES_M` with 100 pulses."""
    returned = []
    aimed = []
    for grid in grids:
        is_road, counts = _road_pulses(grid, angles, view)
        returned.append(is_road)
        aimed.append(counts)
    bins = []
    for start_m, end_m in pairwise(RANGE_EDGES_M):
        in_range = (view.range_m >= start_m) & (view.range_m < end_m)
        values = [hits[in_range & counts] for hits, counts in zip(returned, aimed, strict=True)]
        hits = np.concatenate(values).astype(np.float64)
        if len(hits) >= MIN_VALUES:
            incidence_deg = view.incidence_deg[in_range & view.on_road]
            bins.append(
                RateBin(start_m, end_m, float(incidence_deg.min()), float(incidence_deg.max()), estimate_share(hits))
            )
    return bins


def rates_towards_road(grids: list[FloatArray], view: PlaneView) -> list[RateBin]:
    """Return the share of pulses towards the road that returned at all, from vehicles and kerbs as well."""
    bins = []
    for start_m, end_m in pairwise(RANGE_EDGES_M):
        members = view.on_road & (view.range_m >= start_m) & (view.range_m < end_m)
        hits = np.concatenate([np.isfinite(grid[members]) for grid in grids]).astype(np.float64)
        if len(hits) >= MIN_VALUES:
            incidence_deg = view.incidence_deg[members]
            bins.append(
                RateBin(start_m, end_m, float(incidence_deg.min()), float(incidence_deg.max()), estimate_share(hits))
            )
    return bins


_NOTHING, _ROAD, _OTHER = 0, 1, 2


def _road_pulses(grid: FloatArray, angles: BeamAngles, view: PlaneView) -> tuple[BoolArray, BoolArray]:
    """Return which pulses returned from the road, and which count."""
    with np.errstate(invalid="ignore"):
        is_road = np.abs(view.height_m(grid)) <= ROAD_BAND_M
    met = np.where(np.isnan(grid), _NOTHING, np.where(is_road, _ROAD, _OTHER))
    counts = view.on_road & (met != _OTHER)
    for side in (-1, 1):
        nearest = np.zeros_like(met)
        for columns in range(1, round(_NEIGHBOUR_DEG / angles.grid_step_deg) + 1):
            moved = np.roll(met, side * columns, axis=1)
            if not angles.is_full_circle:
                moved[:, :columns] = _NOTHING if side > 0 else moved[:, :columns]
                moved[:, -columns:] = _NOTHING if side < 0 else moved[:, -columns:]
            nearest = np.where(nearest == _NOTHING, moved, nearest)
        counts &= nearest != _OTHER
    return is_road, counts


@dataclass(frozen=True)
class SmoothPulses:
    """Pulses between two returns from one surface, in the order of sweeps, channels and columns, (n,) each.

    Attributes
    ----------
    range_m
        Range of the surface.
    incidence_deg
        Angle of incidence, NaN where the surface is too small to tell.
    returned
        Whether the pulse returned.
    """

    range_m: FloatArray
    incidence_deg: FloatArray
    returned: BoolArray


def smooth_pulses(grids: list[FloatArray], angles: BeamAngles) -> SmoothPulses:
    """Return the pulses whose two neighbours in azimuth returned from one surface."""
    parts = []
    for grid in grids:
        before, after = np.roll(grid, 1, axis=1), np.roll(grid, -1, axis=1)
        if not angles.is_full_circle:
            before[:, 0] = np.nan
            after[:, -1] = np.nan
        with np.errstate(invalid="ignore"):
            expected = 2.0 / (1.0 / before + 1.0 / after)
            chosen = np.abs(after - before) <= MAX_SLOPE * expected
            chosen &= np.isnan(grid) | (np.abs(grid - expected) <= MAX_SLOPE * expected)
        incidence_deg = incidence_angles_deg(np.where(np.isnan(grid), expected, grid), angles)
        parts.append((expected[chosen], incidence_deg[chosen], np.isfinite(grid[chosen])))
    return SmoothPulses(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def smooth_rates(pulses: SmoothPulses) -> tuple[Estimate | None, list[RateBin]]:
    """Return the share of all pulses on smooth surfaces that returned, and by range and incidence."""
    everything = None
    if len(pulses.returned) >= MIN_VALUES:
        everything = _rate(pulses.returned)
    bins = []
    for start_m, end_m in pairwise(RANGE_EDGES_M):
        in_range = (pulses.range_m >= start_m) & (pulses.range_m < end_m)
        for low_deg, high_deg in pairwise(INCIDENCE_EDGES_DEG):
            members = in_range & (pulses.incidence_deg >= low_deg) & (pulses.incidence_deg < high_deg)
            if np.count_nonzero(members) >= MIN_VALUES:
                bins.append(RateBin(start_m, end_m, low_deg, high_deg, _rate(pulses.returned[members])))
    return everything, bins


def _rate(returned: BoolArray) -> Estimate:
    share = float(np.mean(returned))
    return estimate_share(returned.astype(np.float64), 1.0 + 2.0 * share * (1.0 - share))


def empty_sectors(grids: list[FloatArray], angles: BeamAngles) -> list[tuple[float, float]]:
    """Return the sectors of azimuth with less than 5 % returns, counter-clockwise (first and last azimuth, degrees)."""
    bins = 720
    index = np.floor(np.mod(angles.azimuth_deg(), 360.0) / 360.0 * bins).astype(np.int64) % bins
    pulses = np.bincount(index.ravel(), minlength=bins).astype(np.float64) * len(grids)
    returns = np.zeros(bins)
    for grid in grids:
        returns += np.bincount(index[np.isfinite(grid)], minlength=bins)
    # Smoothed over 2 degrees, so that a stray return does not divide a sector.
    window = 4
    kernel = np.ones(2 * window + 1)
    share = _circular_sum(returns, kernel) / np.maximum(_circular_sum(pulses, kernel), 1.0)
    empty = (share < _EMPTY_SHARE) & (pulses > 0)
    if empty.all() or not empty.any():
        return [(-180.0, 180.0)] if empty.all() else []
    starts = np.flatnonzero(empty & ~np.roll(empty, 1))
    sectors: list[tuple[float, float]] = []
    for start in starts:
        length = 1
        while empty[(start + length) % bins]:
            length += 1
        if length * 360.0 / bins >= _MIN_EMPTY_DEG:
            first_deg = float(start * 360.0 / bins)
            first_deg -= 360.0 if first_deg >= 180.0 else 0.0
            sectors.append((first_deg, first_deg + length * 360.0 / bins))
    return sectors


def _circular_sum(values: FloatArray, kernel: FloatArray) -> FloatArray:
    half = len(kernel) // 2
    padded = np.concatenate([values[-half:], values, values[:half]])
    return np.convolve(padded, kernel, mode="valid")
