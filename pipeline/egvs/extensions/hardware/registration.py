r"""Register a measured scan to the static world: the pose of the sensor, with its covariance.

The points are in the sensor's frame (x forward, z up, metres). A pose is that of :class:`egvs.sensors.sites.Pose`: the
position in the world frame, and the angles of :func:`egvs.sensors.sensor.rotation_world_sensor`, so that a point
:math:`p` of the sensor's frame is at

.. math:: q = R_{yaw} R_{pitch} R_{roll}\, p + t

with roll about x first, then pitch (nose up positive), then yaw (counter-clockwise from +x).

The method is the iterative closest point method with distances from points to planes (Chen and Medioni 1992, Image and
Vision Computing 10, 145-155), and with the correspondence along the beam (Blais and Levine 1995, IEEE Trans. Pattern
Anal. 17, 820-824): each point is compared with the plane of the face of the static world that its own beam hits first
from the current pose. So occlusion is exact, and no nearest point needs to be searched. Weights are Tukey's biweight
inside a gate that narrows to four robust standard deviations, but not below 0.4 m; points on vehicles, or on trees that
the static world does not have, get no weight.

Errors of neighbouring points are correlated, since the static world differs from the real one. The covariance is
therefore that of the jackknife over clusters (one step from each; Cameron and Miller 2015, J. Hum. Resour. 50, 317-372,
CR3). Clusters are sectors of azimuth, or the walls of a solid within a wider sector, whichever gives the larger
variance. A direction that one cluster alone fixes is as uncertain as the place of a wall on a map, 0.2 m, since without
the cluster no step can tell. A parameter that no surface fixes, such as the position along an endless wall, has an
infinite variance and keeps its start value. The covariance knows nothing about errors that all of the world shares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import BoolArray, FloatArray, IntArray, Roi
from egvs.core.special import cosdg, sindg
from egvs.sensors.sensor import rotation_world_sensor
from egvs.sensors.sites import Pose
from egvs.statistics.blocks import clustered_mean_se, one_step_jackknife
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster
from egvs.world.supports import Supports, without_solids

PARAMETERS = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")
"""Order of the rows and columns of a covariance."""

_UNITS = np.array([1.0, 1.0, 1.0, *(np.degrees(1.0),) * 3])
"""Metres or degrees per metre or radian, in which steps are computed."""

MIN_POINTS = 200
"""Fewest points that are registered, and fewest that must lie on the static world."""

_MAX_POINTS = 20_000
_SEARCH_POINTS = 3_000
_START_GATE_M = 3.0
_MIN_GATE_M = 0.4
"""Walls of a map may be wrong by decimetres, while the ground fits to a centimetre: they must not count as outliers."""
_SINGLE_CLUSTER_M = 0.5 * _MIN_GATE_M
"""How wrong a wall of a map may be if no other surface confirms where it is."""
_SINGLE_CLUSTER_SHARE = 1e-3
"""A cluster alone fixes a direction if the others have less than this share of the information about it."""
_GATE_SIGMAS = 4.0
_NARROWING = 0.75
_RANGE_GATES = 5.0
"""Along the beam, a point may be this many gates away from the face: surfaces are seen at grazing incidence too."""
_OUTLIER_RATIO = 3.0
_STEADY = 1.02
"""The gate narrows until it is at most this multiple of its final width."""
_MIN_INFORMATION = 1e-6
"""Mean squared cosine between normals and a direction of motion, below which the direction counts as not fixed."""
_BLOCK_DEG, _WALL_BLOCK_DEG = 5.0, 30.0
_LEVEL = 0.7
"""Surfaces that face up: the z component of their normals is larger."""
_YAW_STEP_DEG = 2.0
_SEARCH_CAP_M = 2.0
_COST_CAP_M = 0.5
_MAX_CANDIDATES = 8
_SAME_YAW_DEG, _SAME_POSITION_M = 1.0, 0.5
_AMBIGUOUS_SIGMAS = 2.0
_AMBIGUOUS_M = 1e-3


@dataclass(frozen=True)
class Registration:
    """The pose at which a scan fits the static world.

    Attributes
    ----------
    pose
        The fitted pose.
    covariance
        Of :data:`PARAMETERS`, (6, 6) float64, metres and degrees; 0 for parameters that were not fitted, infinite on
        the diagonal for those that no surface fixes.
    not_fixed
        Fitted parameters that no surface fixes.
    distance_m
        Signed distance of each point from the plane of the face that its beam hits, (n,) float64, positive on the
        outer side of the face; NaN where the beam hits nothing.
    on_surface
        Whether the point counts as one of the static world, (n,) bool.
    sigma_m
        Robust standard deviation of the distances of these points.
    cost_m
        Mean distance of all points, each capped at 0.5 m, which is also the distance where a beam hits nothing.
    converged
        Whether the last step was less than a micrometre and a microradian (0.1 mm and 0.006 degrees for alternatives of
        a search).
    """

    pose: Pose
    covariance: FloatArray
    not_fixed: tuple[str, ...]
    distance_m: FloatArray
    on_surface: BoolArray
    sigma_m: float
    cost_m: float
    converged: bool

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard error of each of :data:`PARAMETERS`, metres and degrees."""
        return dict(zip(PARAMETERS, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


@dataclass(frozen=True)
class Alternative:
    """Another yaw at which a scan may fit.

    Attributes
    ----------
    registration
        The fit.
    excess_m
        By how much its cost exceeds that of the best fit.
    excess_se_m
        Standard error of this difference, from sectors of azimuth.
    """

    registration: Registration
    excess_m: float
    excess_se_m: float

    @property
    def is_as_good(self) -> bool:
        """Whether the scan cannot tell this fit from the best one: they differ by at most two standard errors."""
        return self.excess_m <= max(_AMBIGUOUS_SIGMAS * self.excess_se_m, _AMBIGUOUS_M)


@dataclass(frozen=True)
class YawSearch:
    """The best fit of a scan among all yaws.

    Attributes
    ----------
    best
        The best fit.
    alternatives
        The other local optima, best first.
    yaws_deg, costs_m
        The yaws that were tried at the start position, (k,), and the mean distance of points from surfaces at each,
        capped at 2 m.
    """

    best: Registration
    alternatives: tuple[Alternative, ...]
    yaws_deg: FloatArray
    costs_m: FloatArray

    @property
    def equally_good(self) -> tuple[Alternative, ...]:
        """The alternatives that the scan cannot tell from the best fit."""
        return tuple(other for other in self.alternatives if other.is_as_good)


@dataclass(frozen=True)
class _Matches:
    """Each point against the face that its beam hits; arrays of n rows.

    ``along_m`` is the measured range minus that of the face, ``solid`` the solid of the face (-1 for none).
    """

    arms: FloatArray
    normal: FloatArray
    distance_m: FloatArray
    along_m: FloatArray
    solid: IntArray


class _Limit(NamedTuple):
    """When an iteration ends: after this number of steps, or below this size of a step, metres and radians."""

    iterations: int
    step: float


_EXACT, _ROUGH = _Limit(80, 1e-6), _Limit(30, 1e-4)


@dataclass(frozen=True)
class _Optimum:
    """Where an iteration ended; parameters in metres and degrees."""

    parameters: FloatArray
    gate_m: float
    converged: bool

    @property
    def pose(self) -> Pose:
        return _pose(self.parameters)


class StaticSurfaces:
    """The static world around a sensor, for beams from poses near it.

    Parameters
    ----------
    world
        The static world.
    position_m
        About where the sensor is, (x, y, z); solids that carry a sensor there (pole, mast, sign) are left out.
    """

    def __init__(self, world: World, position_m: Sequence[float]) -> None:
        supports = Supports.of(world).at(position_m[0], position_m[1])
        world = without_solids(world, supports) if supports else world
        x_m, y_m, z_m = (float(value) for value in position_m)
        self._caster = Caster(world, Roi((x_m - 1.0, y_m - 1.0, z_m - 1.0), (2.0, 2.0, 2.0)))
        corners = world.triangles_m - np.asarray(position_m)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normals, axis=1)[:, None]
        self._solids: IntArray = world.solid_of_face.astype(np.int64)
        self._normals: FloatArray = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)

    def match(self, points_m: FloatArray, pose: Pose) -> _Matches:
        """Compare points (n, 3) of the sensor's frame with the faces that their beams hit from a pose."""
        arms = points_m @ rotation_world_sensor(pose.yaw_deg, pose.pitch_deg, pose.roll_deg).T
        range_m = np.linalg.norm(arms, axis=1)
        scan = self._caster.sweep(pose.position_m, np.ascontiguousarray(arms / range_m[:, None]), float("inf"))
        assert scan.face is not None
        hit = scan.returned & (scan.face >= 0)
        ends = np.where(hit[:, None], scan.ends_m, np.nan)
        normal = np.where(hit[:, None], self._normals[np.maximum(scan.face, 0)], np.nan)
        distance = np.einsum("ij,ij->i", normal, arms - ends)
        solid = np.where(hit, self._solids[np.maximum(scan.face, 0)], -1)
        return _Matches(arms, normal, distance, range_m - np.linalg.norm(ends, axis=1), solid)


def register_scan(
    points_m: FloatArray,
    surfaces: StaticSurfaces,
    start: Pose,
    *,
    free: Sequence[str] = PARAMETERS,
    where: str = "scan",
) -> Registration:
    """Return the pose near ``start`` at which a scan fits the static world best.

    Parameters
    ----------
    points_m
        Returns in the sensor's frame, (n, 3) float64, finite, none at the origin. Of more than 20,000, a random
        sample is fitted; distances are those of all.
    surfaces
        The static world around the sensor.
    start
        Within about 3 m and 5 degrees of the pose.
    free
        Which of :data:`PARAMETERS` are fitted; the others keep their values of ``start``.
    where
        The scan, for messages.

    Raises
    ------
    InputError
        If the scan has fewer than :data:`MIN_POINTS` points, or fewer of them lie on the static world.
    """
    if len(points_m) < MIN_POINTS:
        raise InputError(where, f"expected at least {MIN_POINTS} returns, got {len(points_m)}", "Give complete scans.")
    columns = np.array(sorted(PARAMETERS.index(name) for name in free))
    fitted_m = sample_points(points_m, _MAX_POINTS)
    optimum = _fit(fitted_m, surfaces, start, columns, _EXACT, where)
    return _registration(points_m, fitted_m, surfaces, optimum, columns)


def search_yaw(
    points_m: FloatArray,
    surfaces: StaticSurfaces,
    start: Pose,
    *,
    free: Sequence[str] = PARAMETERS,
    where: str = "scan",
) -> YawSearch:
    """Return the pose at which a scan fits the static world best, whatever its yaw, and other yaws that fit as well.

    Yaws are tried every 2 degrees; the best local optima are registered.

    Parameters
    ----------
    points_m, surfaces, free, where
        As of :func:`register_scan`.
    start
        Within about 2 m of the position, and 3 degrees of pitch and roll; its yaw is not used.

    Raises
    ------
    InputError
        As of :func:`register_scan`.
    """
    if len(points_m) < MIN_POINTS:
        raise InputError(where, f"expected at least {MIN_POINTS} returns, got {len(points_m)}", "Give complete scans.")
    columns = np.array(sorted(PARAMETERS.index(name) for name in free))
    few = sample_points(points_m, _SEARCH_POINTS)
    yaws_deg = np.arange(0.0, 360.0, _YAW_STEP_DEG)
    costs = np.array([_capped(surfaces.match(few, _with_yaw(start, yaw)), _SEARCH_CAP_M).mean() for yaw in yaws_deg])
    is_optimum = (costs <= np.roll(costs, 1)) & (costs <= np.roll(costs, -1))
    optima = np.flatnonzero(is_optimum)
    optima = optima[np.argsort(costs[optima], kind="stable")][:_MAX_CANDIDATES]
    fits: list[Registration] = []
    for yaw_deg in yaws_deg[optima]:
        try:
            optimum = _fit(few, surfaces, _with_yaw(start, float(yaw_deg)), columns, _ROUGH, where)
        except InputError:  # hardly a point lies on the static world at this yaw
            continue
        if not any(is_same_pose(optimum.pose, fit.pose) for fit in fits):
            fits.append(_registration(points_m, few, surfaces, optimum, columns))
    if not fits:
        raise _off_surface(where)
    fits.sort(key=lambda fit: fit.cost_m)
    best = register_scan(points_m, surfaces, fits[0].pose, free=free, where=where)
    blocks = _azimuth_blocks(points_m)
    others = [fit for fit in fits[1:] if not is_same_pose(fit.pose, best.pose)]
    return YawSearch(best, tuple(_alternative(best, other, blocks) for other in others), yaws_deg, costs)


def sample_points(points_m: FloatArray, count: int) -> FloatArray:
    """Return at most ``count`` points, drawn at random with a fixed seed, in their order.

    Parameters
    ----------
    points_m
        The points, (n, 3).
    count
        Largest number of points.
    """
    if len(points_m) <= count:
        return points_m
    chosen = np.sort(np.random.default_rng(0).choice(len(points_m), count, replace=False))
    return points_m[chosen]


def _with_yaw(pose: Pose, yaw_deg: float) -> Pose:
    return Pose(*pose.position_m, yaw_deg, pose.pitch_deg, pose.roll_deg)


def is_same_pose(one: Pose, other: Pose) -> bool:
    """Return whether two poses are one optimum: their yaws within 1 degree, their positions within 0.5 m."""
    turn_deg = (one.yaw_deg - other.yaw_deg + 180.0) % 360.0 - 180.0
    apart_m = float(np.linalg.norm(np.subtract(one.position_m, other.position_m)))
    return abs(turn_deg) < _SAME_YAW_DEG and apart_m < _SAME_POSITION_M


def _capped(matches: _Matches, cap_m: float) -> FloatArray:
    """Return the distance of each point from its face, at most ``cap_m``, which also stands for no face."""
    distance: FloatArray = np.minimum(np.nan_to_num(np.abs(matches.distance_m), nan=cap_m), cap_m)
    return distance


def _alternative(best: Registration, other: Registration, blocks: IntArray) -> Alternative:
    capped = [np.minimum(np.nan_to_num(np.abs(fit.distance_m), nan=_COST_CAP_M), _COST_CAP_M) for fit in (other, best)]
    return Alternative(other, *clustered_mean_se(capped[0] - capped[1], blocks))


def parameter_name_and_unit(parameter: str) -> tuple[str, str]:
    """Return the name and the unit of one of :data:`PARAMETERS`.

    >>> parameter_name_and_unit("yaw_deg"), parameter_name_and_unit("x_m")
    (('yaw', 'degrees'), ('x', 'm'))
    """
    name, _, unit = parameter.rpartition("_")
    return name, "degrees" if unit == "deg" else unit


def _azimuth_blocks(points_m: FloatArray) -> IntArray:
    """Return the number of the sector of azimuth of each point, from 0, without gaps."""
    azimuth_deg = np.degrees(np.arctan2(points_m[:, 1], points_m[:, 0]))
    _, block = np.unique(np.floor(azimuth_deg / _BLOCK_DEG), return_inverse=True)
    return block.astype(np.int64)


def _jackknife(along: FloatArray, curvature: FloatArray, scores: FloatArray, cluster: IntArray) -> FloatArray:
    """Return the covariance of parameters, (k, k), from one step without each cluster of rows in turn."""
    order = np.argsort(cluster, kind="stable")
    starts = np.searchsorted(cluster[order], np.arange(int(cluster.max()) + 1))
    products = (along * curvature[:, None])[order, :, None] * along[order, None, :]
    normals = np.add.reduceat(products, starts, axis=0)
    sums = np.add.reduceat(scores[order], starts, axis=0)
    information = np.bincount(cluster, weights=curvature).astype(np.float64)
    return one_step_jackknife(normals, sums) + _single_cluster_variance(normals, information)


def _single_cluster_variance(normals: FloatArray, information: FloatArray) -> FloatArray:
    """Return the covariance of directions that one cluster alone fixes, (k, k): nothing else tells where it is.

    Such a cluster may be off by :data:`_SINGLE_CLUSTER_M` (root mean square over its points), which moves the pose in
    this direction.

    Parameters
    ----------
    normals
        Normal matrix of each cluster, (g, k, k).
    information
        Sum of the weights of each cluster, (g,).
    """
    values, vectors = np.linalg.eigh(normals.sum(axis=0))
    covariance: FloatArray = np.zeros(normals.shape[1:])
    if not len(values) or values[0] <= 0.0:
        return covariance
    root = vectors / np.sqrt(values) @ vectors.T
    remaining, directions = np.linalg.eigh(root @ (normals.sum(axis=0) - normals) @ root)
    for cluster, k in np.argwhere(remaining < _SINGLE_CLUSTER_SHARE):
        if information[cluster] > 0.0:
            # The direction moves the points of the cluster by 1 / sqrt(information), root mean square.
            moved = root @ directions[cluster, :, k] * (_SINGLE_CLUSTER_M * np.sqrt(information[cluster]))
            covariance += np.outer(moved, moved)
    return covariance


def _larger(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return a covariance that is at least each of two, in every direction where they differ most."""
    from scipy.linalg import eigh

    tiny = 1e-9 * max(float(np.trace(one)), 1e-12) / len(one)
    ratio, vectors = eigh(other, one + tiny * np.eye(len(one)))
    back = np.linalg.inv(vectors)
    larger: FloatArray = back.T @ (np.maximum(ratio, 1.0)[:, None] * back)
    return larger


def _clusters(points_m: FloatArray, matches: _Matches, rows: BoolArray) -> IntArray:
    """Return the number of the cluster of each point, from 0: errors within a cluster are correlated.

    A cluster is what a sector of 30 degrees has of the walls of one solid, which a map may have in the wrong place, or
    what a sector of 5 degrees has of surfaces that face up.
    """
    azimuth_deg = np.degrees(np.arctan2(points_m[:, 1], points_m[:, 0]))
    is_level = np.abs(matches.normal[rows, 2]) > _LEVEL
    sector = np.floor(azimuth_deg / np.where(is_level, _BLOCK_DEG, _WALL_BLOCK_DEG))
    keys = np.column_stack([np.where(is_level, -1, matches.solid[rows]), sector])
    _, cluster = np.unique(keys, axis=0, return_inverse=True)
    return cluster.ravel().astype(np.int64)


def _fit(
    points_m: FloatArray, surfaces: StaticSurfaces, start: Pose, columns: IntArray, limit: _Limit, where: str
) -> _Optimum:
    parameters = np.array([*start.position_m, *start.angles_deg])
    gate_m = _START_GATE_M
    for _ in range(limit.iterations):
        matches = surfaces.match(points_m, _pose(parameters))
        inside = _inside(matches, gate_m)
        if np.count_nonzero(inside) < min(MIN_POINTS, 0.5 * len(points_m)):
            raise _off_surface(where)
        distance_m = matches.distance_m[inside]
        weight = (1.0 - (distance_m / gate_m) ** 2) ** 2
        design = _design(matches, inside, parameters)[:, columns]
        inverse = _fixed_inverse(design, weight)
        step = inverse @ (design.T @ (weight * distance_m))
        parameters[columns] -= _UNITS[columns] * step
        narrow_m = max(_MIN_GATE_M, _GATE_SIGMAS * _inlier_sigma(distance_m))
        is_narrow = gate_m <= _STEADY * narrow_m
        if is_narrow and np.abs(step).max(initial=0.0) < limit.step:
            return _Optimum(parameters, gate_m, True)
        if not is_narrow:
            gate_m = max(_NARROWING * gate_m, narrow_m)
    return _Optimum(parameters, gate_m, False)


def _registration(
    points_m: FloatArray, fitted_m: FloatArray, surfaces: StaticSurfaces, optimum: _Optimum, columns: IntArray
) -> Registration:
    """Evaluate an optimum: the covariance of the points that were fitted, and the distances of all."""
    covariance, not_fixed = _covariance(fitted_m, surfaces, optimum, columns)
    matches = surfaces.match(points_m, optimum.pose)
    inside = _inside(matches, optimum.gate_m)
    return Registration(
        pose=optimum.pose,
        covariance=covariance,
        not_fixed=not_fixed,
        distance_m=matches.distance_m,
        on_surface=inside,
        sigma_m=_robust_sigma(matches.distance_m[inside]),
        cost_m=float(_capped(matches, _COST_CAP_M).mean()),
        converged=optimum.converged,
    )


def _off_surface(where: str) -> InputError:
    problem = f"fewer than {MIN_POINTS} returns lie on the static world from this position"
    return InputError(where, problem, "Check the position, and that the world has the surfaces around it.")


def _pose(parameters: FloatArray) -> Pose:
    x_m, y_m, z_m, yaw_deg, pitch_deg, roll_deg = parameters.tolist()
    if not -180.0 <= yaw_deg < 180.0:
        yaw_deg = (yaw_deg + 180.0) % 360.0 - 180.0
    return Pose(x_m, y_m, z_m, yaw_deg, pitch_deg, roll_deg)


def _inside(matches: _Matches, gate_m: float) -> BoolArray:
    with np.errstate(invalid="ignore"):
        inside: BoolArray = (np.abs(matches.distance_m) < gate_m) & (np.abs(matches.along_m) < _RANGE_GATES * gate_m)
    return inside


def _robust_sigma(distance_m: FloatArray) -> float:
    return 1.4826 * float(np.median(np.abs(distance_m))) if len(distance_m) else float("nan")


def _inlier_sigma(distance_m: FloatArray) -> float:
    """Return the robust standard deviation of distances, also where up to two thirds of them are outliers.

    A fifth of the distances is within 0.2533 standard deviations. Where that tells of far less scatter than the median
    does, outliers determine the median.
    """
    fifth = float(np.quantile(np.abs(distance_m), 0.2)) / 0.2533
    return min(_robust_sigma(distance_m), _OUTLIER_RATIO * fifth)


def _design(matches: _Matches, rows: BoolArray, parameters: FloatArray) -> FloatArray:
    """Return the derivatives of the distances with respect to all parameters, per metre and radian, (n, 6).

    A small rotation about the unit axis a moves the point at the arm v by a x v; a is up for the yaw, minus the turned
    y axis for the pitch (nose up positive), and the sensor's x axis for the roll.
    """
    normal, arms = matches.normal[rows], matches.arms[rows]
    yaw_deg, pitch_deg, _ = parameters[3:].tolist()
    forward = rotation_world_sensor(yaw_deg, pitch_deg, 0.0)[:, 0]
    axes = (np.array([0.0, 0.0, 1.0]), np.array([sindg(yaw_deg), -cosdg(yaw_deg), 0.0]), forward)
    turned = [np.einsum("ij,ij->i", normal, np.cross(axis, arms)) for axis in axes]
    return np.column_stack([normal, *turned])


def _fixed_inverse(design: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the inverse of the normal matrix in the directions that surfaces fix, (k, k)."""
    basis, _ = _fixed_directions(design, weight)
    along = design @ basis
    return basis @ np.linalg.inv((along * weight[:, None]).T @ along) @ basis.T


def _fixed_directions(design: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the directions of the parameters that surfaces fix, and those that none fixes, as columns.

    Angles are scaled by a typical arm, so that all parameters move points by about as much.
    """
    lengths = np.sqrt((weight[:, None] * design**2).sum(axis=0) / weight.sum())
    scale = 1.0 / np.where(lengths > 1.0, lengths, 1.0)
    scaled = design * scale
    values, vectors = np.linalg.eigh((scaled * (weight / weight.sum())[:, None]).T @ scaled)
    is_fixed = values > _MIN_INFORMATION
    return scale[:, None] * vectors[:, is_fixed], vectors[:, ~is_fixed]


def _covariance(
    points_m: FloatArray, surfaces: StaticSurfaces, optimum: _Optimum, columns: IntArray
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return the covariance of all parameters (metres, degrees), and the fitted ones that no surface fixes."""
    matches = surfaces.match(points_m, optimum.pose)
    inside = _inside(matches, optimum.gate_m)
    design = _design(matches, inside, optimum.parameters)[:, columns]
    relative = (matches.distance_m[inside] / optimum.gate_m) ** 2
    weight = (1.0 - relative) ** 2
    # The derivative of weight * distance, which is less than the weight.
    curvature = (1.0 - relative) * (1.0 - 5.0 * relative)
    basis, null = _fixed_directions(design, weight)
    scores = design * (weight * matches.distance_m[inside])[:, None]
    along, scores = design @ basis, scores @ basis
    by_sector, by_wall = (
        _jackknife(along, curvature, scores, clusters)
        for clusters in (_azimuth_blocks(points_m[inside]), _clusters(points_m[inside], matches, inside))
    )
    fitted = basis @ _larger(by_sector, by_wall) @ basis.T
    fitted = _UNITS[columns, None] * fitted * _UNITS[columns]
    is_free = (null**2).sum(axis=1) > 1e-6
    fitted[np.diag_indices(len(columns))] = np.where(is_free, np.inf, np.diag(fitted))
    covariance = np.zeros((6, 6))
    covariance[np.ix_(columns, columns)] = fitted
    return covariance, tuple(PARAMETERS[column] for column in columns[is_free])
