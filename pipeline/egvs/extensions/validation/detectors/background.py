"""Background subtraction, and heights of the ground from empty scans.

**Background subtraction**, as is common for roadside sensors, which do not move: a return well before that of the empty
scan along the same beam belongs to traffic. The margin covers noise, and everything closer to a surface than that.

**Ground:** take the lowest return of each square; the ground is the highest surface below all of these that is nowhere
steeper than a street; interpolate linearly between the squares on this surface, and take the nearest of them outside.
Only the pose and the empty scan of a roadside unit are used, no map. Several units combine their scans.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import grey_erosion, map_coordinates

from egvs.clouds.sweeps import SiteView, Sweep
from egvs.core.grid import BoolArray, FloatArray, Roi
from egvs.sensors.sensor import rotation_world_sensor

MARGIN_M = 0.15
"""Five standard deviations of a range with a specified accuracy of +-3 cm."""

SQUARE_M = 2.0
MAX_SLOPE = 0.15
"""Rise per metre that no street exceeds, but kerbs and walls of houses do."""

_MARGIN_AROUND_M = 20.0  # around the region of interest, because vehicles extend beyond it
_SLOPE_SQUARES = 15  # squares over which the slope is limited
_MIN_SQUARES = 3  # squares with ground that a surface needs


def foreground_mask(sweep: Sweep, view: SiteView) -> BoolArray:
    """Return which points of a sweep are well before the return of the empty scan along their beam, (n,)."""
    range_m = np.sqrt((sweep.points[:, :3].astype(np.float64) ** 2).sum(axis=1))
    is_foreground: BoolArray = range_m < view.empty_range_m[sweep.beam] - MARGIN_M
    return is_foreground


def points_in_world(sweep: Sweep, view: SiteView) -> FloatArray:
    """Return the points of a sweep in the world frame, (n, 3) float64."""
    rotation = rotation_world_sensor(*view.pose.angles_deg)
    rotated = (sweep.points[:, None, :3].astype(np.float64) * rotation).sum(axis=2)
    points_m: FloatArray = rotated + np.asarray(view.pose.position_m)
    return points_m


@dataclass(frozen=True)
class GroundMap:
    """Height of the ground on a raster of squares.

    Attributes
    ----------
    low_m
        World x, y of the centre of the first square.
    z_m
        World z of the ground at the centres of the squares, (nx, ny) float64.
    """

    low_m: FloatArray
    z_m: FloatArray

    @classmethod
    def from_empty_scans(cls, views: Sequence[SiteView], roi: Roi) -> GroundMap:
        """Return the ground in and around the region of interest, from the empty scans of at least one site."""
        low = np.asarray(roi.origin_m)[:2] - _MARGIN_AROUND_M
        shape = tuple(np.ceil((np.asarray(roi.size_m)[:2] + 2 * _MARGIN_AROUND_M) / SQUARE_M).astype(int).tolist())
        points = np.concatenate([empty_scan_points(view) for view in views])
        square = np.floor((points[:, :2] - low) / SQUARE_M).astype(np.int64)
        inside = ((square >= 0) & (square < shape)).all(axis=1)
        lowest_return_m = np.full(shape, np.inf)
        np.minimum.at(lowest_return_m, tuple(square[inside].T), points[inside, 2])
        lowest_sensor_m = min(view.pose.z_m for view in views)
        fallback_m = float(points[:, 2].min(initial=lowest_sensor_m))
        return cls(low + SQUARE_M / 2, _fit_ground(lowest_return_m, fallback_m))

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        """Return the world z of the ground at positions (n, 2) in the world frame, (n,)."""
        squares = ((xy_m - self.low_m) / SQUARE_M).T
        height_m: FloatArray = map_coordinates(self.z_m, squares, order=1, mode="nearest")
        return height_m


def empty_scan_points(view: SiteView) -> FloatArray:
    """Return the returns of the empty scan in the world frame, (n, 3)."""
    returned = np.isfinite(view.empty_range_m)
    directions = view.sensor.directions(*view.pose.angles_deg)[returned]
    return np.asarray(view.pose.position_m) + directions * view.empty_range_m[returned, None]


def _fit_ground(lowest_m: FloatArray, fallback_m: float) -> FloatArray:
    """Return the ground of every square from the lowest return of each, infinite where no beam returned."""
    has_return = np.isfinite(lowest_m)
    if not has_return.any():
        return np.full(lowest_m.shape, fallback_m)

    # A surface of limited slope below all returns is their erosion by a cone.
    steps = np.arange(-_SLOPE_SQUARES, _SLOPE_SQUARES + 1) * SQUARE_M
    cone = -MAX_SLOPE * np.hypot(*np.meshgrid(steps, steps, indexing="ij"))
    filled_m = np.where(has_return, lowest_m, lowest_m[has_return].max() + 1e3)
    limit_m = grey_erosion(filled_m, structure=cone, mode="nearest")
    ground = np.argwhere(has_return & (lowest_m <= limit_m))
    ground_m = lowest_m[tuple(ground.T)]

    squares = np.argwhere(np.ones(lowest_m.shape, dtype=np.bool_))
    surface_m = NearestNDInterpolator(ground, ground_m)(squares)
    is_plane = len(ground) >= _MIN_SQUARES and bool(np.ptp(ground, axis=0).all())
    if is_plane and np.linalg.matrix_rank(ground - ground[0]) == 2:
        interpolated_m = LinearNDInterpolator(ground, ground_m)(squares)
        surface_m = np.where(np.isnan(interpolated_m), surface_m, interpolated_m)
    surface: FloatArray = surface_m.reshape(lowest_m.shape)
    return surface
