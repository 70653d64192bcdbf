"""Compare recorded tracks with the lanes of the network.

The centre of a moving motor vehicle lies on a lane when the nearest centre line is at most half of the lane's width
away. If positions do not fit, a shift and a rotation about their middle are sought that bring them nearer: they
minimise the mean distance to the nearest centre line, where distances above :data:`FAR_M` count as that.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from egvs.core import polylines
from egvs.core.errors import Diagnostic
from egvs.core.grid import FloatArray, Roi
from egvs.core.wording import format_percent, number_of
from egvs.traffic.network import CAR, LANE_WIDTH_M, Network

FAR_M = 5.0
"""Distance from which on a position belongs to no lane."""

MIN_SHARE, MIN_GAIN = 0.7, 0.1
"""A smaller share on lanes gets a warning; so does a fit that improves it by more."""

_SPACING_M = 0.5
_MAX_POINTS = 2000
_SHIFTS_M = (-6.0, -3.0, 0.0, 3.0, 6.0)


@dataclass(frozen=True)
class Alignment:
    """How well positions fit the lanes.

    Attributes
    ----------
    share
        Share of the positions that lie on a lane.
    fitted_share
        The same after the best shift and rotation.
    shift_m, rotation_deg
        These, about the middle of the positions; counter-clockwise.
    positions
        Number of positions.
    """

    share: float
    fitted_share: float
    shift_m: tuple[float, float]
    rotation_deg: float
    positions: int

    @property
    def fits_better(self) -> bool:
        """Whether the shift brings clearly more positions onto lanes."""
        return self.fitted_share - self.share > MIN_GAIN

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON, rounded."""
        return {
            "share_on_lanes": round(self.share, 4),
            "fitted_share": round(self.fitted_share, 4),
            "shift_m": [round(value, 2) for value in self.shift_m],
            "rotation_deg": round(self.rotation_deg, 3),
            "positions": self.positions,
        }

    def describe(self) -> str:
        """Return a sentence."""
        text = (
            f"{format_percent(self.share, 0)} of {number_of(self.positions, 'position')} of moving "
            "vehicles lie on lanes"
        )
        if self.fits_better:
            east_m, north_m = self.shift_m
            text += (
                f"; moved by {east_m:+.1f} m east and {north_m:+.1f} m north and turned by {self.rotation_deg:+.2f}"
                f" degrees, {format_percent(self.fitted_share, 0)} would"
            )
        return text

    def warnings(self, where: str) -> Iterator[Diagnostic]:
        """Warn about tracks that do not fit the map."""
        if self.share < MIN_SHARE or self.fits_better:
            key = "--track-crs" if where.startswith("--") else "traffic.track_crs"
            hint = f"Check the coordinate system ({key}), and whether map and tracks show the same place."
            yield Diagnostic("track alignment", where, self.describe(), hint)


def align(xy_m: FloatArray, roads: Network) -> Alignment | None:
    """Compare positions with the lanes of a network.

    Parameters
    ----------
    xy_m
        Positions of moving motor vehicles in the world frame, (n, 2).
    roads
        The network.

    Returns
    -------
    Alignment or None
        None without positions, or without lanes for cars.
    """
    from scipy.optimize import minimize
    from scipy.spatial import KDTree

    points_m, half_width_m = _centre_lines(roads)
    if not len(xy_m) or not len(points_m):
        return None
    step = -(-len(xy_m) // _MAX_POINTS)
    xy_m = xy_m[::step]
    tree = KDTree(points_m)
    middle_m = xy_m.mean(axis=0)

    def move(change: FloatArray) -> FloatArray:
        cos, sin = np.cos(change[2]), np.sin(change[2])
        moved_m: FloatArray = (xy_m - middle_m) @ np.array([[cos, sin], [-sin, cos]]) + middle_m + change[:2]
        return moved_m

    def mean_distance_m(change: FloatArray) -> float:
        distance_m, _ = tree.query(move(change), distance_upper_bound=FAR_M)
        return float(np.minimum(distance_m, FAR_M).mean())

    def share(change: FloatArray) -> float:
        distance_m, nearest = tree.query(move(change))
        return float((distance_m <= half_width_m[nearest]).mean())

    starts = [np.array([east_m, north_m, 0.0]) for east_m in _SHIFTS_M for north_m in _SHIFTS_M]
    start = min(starts, key=mean_distance_m)
    simplex = start + np.vstack([np.zeros(3), np.diag([1.0, 1.0, np.deg2rad(1.0)])])
    best = minimize(mean_distance_m, start, method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": 300}).x
    return Alignment(
        share(np.zeros(3)), share(best), (float(best[0]), float(best[1])), float(np.rad2deg(best[2])), len(xy_m)
    )


def lane_points(roads: Network, region: Roi) -> FloatArray:
    """Return points of equal spacing on the lanes for cars in a region, seen from above, (n, 2), world frame."""
    points_m, _ = _centre_lines(roads)
    low_m = np.array(region.origin_m[:2])
    inside = ((points_m >= low_m) & (points_m <= low_m + region.size_m[:2])).all(axis=1)
    points_inside_m: FloatArray = points_m[inside]
    return points_inside_m


def _divide(line_m: FloatArray) -> FloatArray:
    """Return points every :data:`_SPACING_M` on a line (n, 2) or (n, 3)."""
    return polylines.points_at(line_m, np.arange(0.0, polylines.stations_m(line_m)[-1], _SPACING_M))


def _centre_lines(roads: Network) -> tuple[FloatArray, FloatArray]:
    """Return points every :data:`_SPACING_M` of the lanes for cars, (n, 2), and half of the width at each."""
    points, half_widths = [np.empty((0, 2))], [np.empty(0)]
    for edge in roads.all_edges:
        for lane in edge.lanes:
            if not lane.permission.admits(CAR) or edge.function in ("crossing", "walkingarea"):
                continue
            points.append(_divide(lane.shape_m[:, :2]))
            half_widths.append(np.full(len(points[-1]), (lane.width_m or LANE_WIDTH_M) / 2.0))
    return np.concatenate(points), np.concatenate(half_widths)
