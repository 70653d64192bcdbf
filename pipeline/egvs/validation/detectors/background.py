"""Background subtraction, ground heights.

Takes the background off a sweep: beam by beam, a return well before the empty scan's is something new.

Roadside practice, since the sensor does not move. Noise lies within the margin, and so does what stands on a surface by
less than it.

Estimates the ground round a site, or several, from their empty scans, so that detectors count heights from it.

Steps: the lowest return of each square; of these, what the ground can be: the highest surface below all returns that
nowhere climbs more steeply than a street; between the squares that lie on it, straight lines; beyond them, the nearest.
What is known to a roadside unit is used alone, its pose and its empty scan: no map. Several put their scans together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import grey_erosion, map_coordinates

from egvs.core.grid import Roi
from egvs.sensors.sensor import rotation_world_sensor
from egvs.validation.sweeps import SiteView, Sweep

MARGIN_M = 0.15
"""Five standard deviations of a range whose maker says +-3 cm."""


def foreground_mask(sweep: Sweep, view: SiteView) -> NDArray[np.bool_]:
    """Which points of a sweep lie well before what their beams meet in the empty scan, (n,)."""
    range_m = np.sqrt((sweep.points[:, :3].astype(np.float64) ** 2).sum(axis=1))
    found: NDArray[np.bool_] = range_m < view.empty_range_m[sweep.beam] - MARGIN_M
    return found


def points_in_world(sweep: Sweep, view: SiteView) -> NDArray[np.float64]:
    """The points of a sweep in the world frame, (n, 3) float64."""
    matrix = rotation_world_sensor(*view.pose.angles_deg)
    moved = (sweep.points[:, None, :3].astype(np.float64) * matrix).sum(axis=2)
    found: NDArray[np.float64] = moved + np.asarray(view.pose.position_m)
    return found


Floats = NDArray[np.float64]

SQUARE_M = 2.0
MAX_SLOPE = 0.15
"""Rise per metre that streets do not exceed; the walls of a kerb or a house do."""

_MARGIN_AROUND_M = 20.0  # beyond the region of interest: vehicles reach out of it
_REACH_SQUARES = 15  # squares over which the climb is bounded
_MIN_POINTS = 3  # squares with ground that a surface needs


@dataclass(frozen=True)
class GroundMap:
    """Height of the ground over squares.

    Attributes
    ----------
    low_m
        World x, y of the first square's centre.
    z_m
        The ground in the world frame at the squares' centres, (nx, ny) float64.
    """

    low_m: Floats
    z_m: Floats

    @classmethod
    def of(cls, view: SiteView, roi: Roi) -> GroundMap:
        """The ground in and round the region of interest, as the site's empty scan has it."""
        return cls.together((view,), roi)

    @classmethod
    def together(cls, views: Sequence[SiteView], roi: Roi) -> GroundMap:
        """The same, as the empty scans of several sites have it."""
        low = np.asarray(roi.origin_m)[:2] - _MARGIN_AROUND_M
        shape = tuple(np.ceil((np.asarray(roi.size_m)[:2] + 2 * _MARGIN_AROUND_M) / SQUARE_M).astype(int).tolist())
        points = np.concatenate([empty_scan_points(view) for view in views])
        cell = np.floor((points[:, :2] - low) / SQUARE_M).astype(np.int64)
        inside = ((cell >= 0) & (cell < shape)).all(axis=1)
        lowest = np.full(shape, np.inf)
        np.minimum.at(lowest, tuple(cell[inside].T), points[inside, 2])
        lowest_m = min(view.pose.z_m for view in views)
        return cls(low + SQUARE_M / 2, _fit_surface(lowest, fallback_m=float(points[:, 2].min(initial=lowest_m))))

    def height_m(self, xy_m: Floats) -> Floats:
        """The ground's z below places (n, 2) in the world frame, (n,)."""
        at = ((xy_m - self.low_m) / SQUARE_M).T
        found: Floats = map_coordinates(self.z_m, at, order=1, mode="nearest")
        return found


def empty_scan_points(view: SiteView) -> Floats:
    """The returns of the empty scan in the world frame, (n, 3)."""
    met = np.isfinite(view.empty_range_m)
    ways = view.sensor.directions(*view.pose.angles_deg)[met]
    found: Floats = np.asarray(view.pose.position_m) + ways * view.empty_range_m[met, None]
    return found


def _fit_surface(lowest: Floats, fallback_m: float) -> Floats:
    """The ground at every square, from the lowest return of each (infinite where there is none)."""
    seen = np.isfinite(lowest)
    if not seen.any():
        return np.full(lowest.shape, fallback_m)
    steps = np.arange(-_REACH_SQUARES, _REACH_SQUARES + 1) * SQUARE_M
    cone = -MAX_SLOPE * np.hypot(*np.meshgrid(steps, steps, indexing="ij"))
    highest = grey_erosion(np.where(seen, lowest, lowest[seen].max() + 1e3), structure=cone, mode="nearest")
    ground = np.argwhere(seen & (lowest <= highest))
    values = lowest[tuple(ground.T)]
    squares = np.argwhere(np.ones(lowest.shape, dtype=np.bool_))
    surface = NearestNDInterpolator(ground, values)(squares)
    if len(ground) >= _MIN_POINTS and np.ptp(ground, axis=0).all() and np.linalg.matrix_rank(ground - ground[0]) == 2:
        between = LinearNDInterpolator(ground, values)(squares)
        surface = np.where(np.isnan(between), surface, between)
    found: Floats = surface.reshape(lowest.shape)
    return found
