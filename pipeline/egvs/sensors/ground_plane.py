r"""Find the ground below a sensor, and the height, roll and pitch that follow from it.

Only returns count from surfaces whose normal is near that of the plane, so that walls and hedges do not. Candidate
planes are drawn through three random returns (RANSAC, Fischler and Bolles 1981, Commun. ACM 24, 381-395); the one with
most returns within 20 cm, which leaves room for a road's camber, is refined by least squares over the returns within
2.5 robust standard deviations. Its returns are removed and the search is repeated, because roads, verges and yards
often lie at different heights, and only a person knows which of them is the ground of the map.

A plane with the unit normal n (upwards, in the sensor's frame) and the height h of the sensor above it satisfies
:math:`n \cdot p = -h`. With the mount's rotation (roll first, then pitch, then yaw; nose up positive), the world's z
axis is :math:`n = (\sin p,\; \cos p \sin r,\; \cos p \cos r)`. Yaw and position do not follow from a plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.statistics.blocks import jackknife_variance

MAX_PLANES = 3
MAX_TILT_DEG = 45.0
MIN_HEIGHT_M = 0.3

_TRIALS = 600
_SAMPLE = 20_000
_TOLERANCE_M = 0.20
_REMOVED_M = 0.5
_MIN_SHARE = 0.02
_BLOCK_DEG = 10.0
_SHORTEST = 1e-12
_MIN_COSINE = math.cos(math.radians(25.0))
"""Normals of surfaces deviate by at most this angle from that of the plane."""


@dataclass(frozen=True)
class GroundPlane:
    """A plane below the sensor.

    Attributes
    ----------
    normal
        Unit normal in the sensor's frame, upwards, (3,).
    height_m, roll_deg, pitch_deg
        Pose of the sensor over this plane, in the convention of sites.
    height_se_m, roll_se_deg, pitch_se_deg
        Standard errors, from leaving out sectors of 10 degrees of azimuth in turn.
    returns, share
        Number of returns that were fitted, and their share of all.
    roughness_m
        Robust standard deviation of their distances to the plane.
    x_m, y_m
        Where they lie in the sensor's frame: 2nd and 98th percentile along each axis.
    """

    normal: FloatArray
    height_m: float
    roll_deg: float
    pitch_deg: float
    height_se_m: float
    roll_se_deg: float
    pitch_se_deg: float
    returns: int
    share: float
    roughness_m: float
    x_m: tuple[float, float]
    y_m: tuple[float, float]

    @property
    def is_inverted(self) -> bool:
        """Whether the sensor is upside down."""
        return bool(self.normal[2] < 0.0)

    def upside_down(self) -> GroundPlane:
        """The same plane in the frame of a sensor that is turned by 180 degrees about its x axis."""
        low_m, high_m = self.y_m
        return replace(
            self,
            normal=self.normal * (1.0, -1.0, -1.0),
            roll_deg=self.roll_deg - math.copysign(180.0, self.roll_deg),
            y_m=(-high_m, -low_m),
        )

    def distance_m(self, points_m: FloatArray) -> FloatArray:
        """Height of points (..., 3) above the plane."""
        return points_m @ self.normal + self.height_m


def find_ground_planes(points_m: FloatArray, normals: FloatArray, where: str) -> list[GroundPlane]:
    """Return the planes below the sensor, the one with most returns first, at most :data:`MAX_PLANES`.

    Parameters
    ----------
    points_m
        Returns in the sensor's frame, (n, 3).
    normals
        Unit normals of their surfaces, (n, 3); returns with NaN do not count.
    where
        The sweep, for messages.

    Raises
    ------
    InputError
        If no plane below the sensor contains at least 2 % of the returns.
    """
    rng = np.random.default_rng(0)
    total = len(points_m)
    with np.errstate(invalid="ignore"):
        is_flat = normals[:, 2] > math.cos(math.radians(MAX_TILT_DEG + 25.0))
    rest, normals = points_m[is_flat], normals[is_flat]
    planes: list[GroundPlane] = []
    while len(planes) < MAX_PLANES and len(rest) >= max(3, _MIN_SHARE * total):
        start = _strongest_plane(rest, normals, rng)
        if start is None or start.inside < _MIN_SHARE * total:
            break
        members = normals @ start.normal > _MIN_COSINE
        planes.append(_refine(rest[members], start.normal, start.height_m, total))
        away = np.abs(planes[-1].distance_m(rest)) > _REMOVED_M
        rest, normals = rest[away], normals[away]
    if not planes:
        hint = "Give sweeps in which the road is visible; of a sensor that is upside down, with --mount inverted."
        raise InputError(where, "expected a ground plane below the sensor, got none", hint)
    return planes


@dataclass(frozen=True)
class _Candidate:
    """A plane, and the number of returns near it."""

    normal: FloatArray
    height_m: float
    inside: int


def _strongest_plane(points_m: FloatArray, normals: FloatArray, rng: np.random.Generator) -> _Candidate | None:
    """Return the plane through three returns that has most returns nearby."""
    points, directions = points_m, normals
    if len(points_m) > _SAMPLE:
        sample = np.sort(rng.choice(len(points_m), _SAMPLE, replace=False))
        points, directions = points_m[sample], normals[sample]
    best: _Candidate | None = None
    for _ in range(_TRIALS):
        a, b, c = points[rng.integers(len(points), size=3)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < _SHORTEST:
            continue
        normal = normal / (length if normal[2] > 0 else -length)
        height_m = -float(normal @ a)
        if normal[2] < math.cos(math.radians(MAX_TILT_DEG)) or height_m < MIN_HEIGHT_M:
            continue
        near = np.abs(points @ normal + height_m) < _TOLERANCE_M
        inside = int(np.count_nonzero(near & (directions @ normal > _MIN_COSINE)))
        if best is None or inside > best.inside:
            best = _Candidate(normal, height_m, inside)
    if best is None:
        return None
    return _Candidate(best.normal, best.height_m, round(best.inside * len(points_m) / len(points)))


def _refine(points_m: FloatArray, normal: FloatArray, height_m: float, total: int) -> GroundPlane:
    # z = slope_x x + slope_y y + level
    coefficients = np.array([-normal[0] / normal[2], -normal[1] / normal[2], -height_m / normal[2]])
    tolerance_m = _TOLERANCE_M
    for _ in range(8):
        residual = points_m[:, 2] - _design(points_m) @ coefficients
        used = np.abs(residual) <= tolerance_m
        design = _design(points_m[used])
        coefficients = _solve(design.T @ design, design.T @ points_m[used, 2])
        residual = points_m[used, 2] - design @ coefficients
        tolerance_m = float(np.clip(2.5 * 1.4826 * np.median(np.abs(residual)), 0.01, _TOLERANCE_M))
    members = points_m[used]
    pose = _pose(coefficients)
    errors = _jackknife(members)
    normal, height_m = _plane(coefficients)
    low, high = np.percentile(members[:, :2], [2, 98], axis=0)
    return GroundPlane(
        normal=normal,
        height_m=height_m,
        roll_deg=float(pose[1]),
        pitch_deg=float(pose[2]),
        height_se_m=float(errors[0]),
        roll_se_deg=float(errors[1]),
        pitch_se_deg=float(errors[2]),
        returns=len(members),
        share=len(members) / total,
        roughness_m=1.4826 * float(np.median(np.abs(residual))) * float(normal[2]),
        x_m=(float(low[0]), float(high[0])),
        y_m=(float(low[1]), float(high[1])),
    )


def _solve(matrix: FloatArray, side: FloatArray) -> FloatArray:
    """Solve the normal equations; where returns lie on a line, with the smallest slopes."""
    return np.linalg.lstsq(matrix, side)[0].astype(np.float64)


def _design(points_m: FloatArray) -> FloatArray:
    return np.column_stack([points_m[:, 0], points_m[:, 1], np.ones(len(points_m))])


def _plane(coefficients: FloatArray) -> tuple[FloatArray, float]:
    """Return normal and height of z = a x + b y + c."""
    normal = np.array([-coefficients[0], -coefficients[1], 1.0])
    length = float(np.linalg.norm(normal))
    return normal / length, float(-coefficients[2]) / length


def _pose(coefficients: FloatArray) -> FloatArray:
    """Return height (m), roll and pitch (degrees)."""
    normal, height_m = _plane(coefficients)
    roll = math.degrees(math.atan2(normal[1], normal[2]))
    return np.array([height_m, roll, math.degrees(math.asin(normal[0]))])


def _jackknife(members: FloatArray) -> FloatArray:
    """Return standard errors of the pose: each sector of azimuth is left out in turn."""
    sector = np.floor((np.degrees(np.arctan2(members[:, 1], members[:, 0])) + 180.0) / _BLOCK_DEG).astype(np.int64)
    design = _design(members)
    sectors = np.unique(sector)
    products, sides = [], []
    for number in sectors:
        part = design[sector == number]
        products.append(part.T @ part)
        sides.append(part.T @ members[sector == number, 2])
    if len(sectors) < 3:
        return np.full(3, np.nan)
    poses = np.array([_pose(_solve(sum(products) - p, sum(sides) - s)) for p, s in zip(products, sides, strict=True)])
    return np.sqrt(jackknife_variance(poses))
