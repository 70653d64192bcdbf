r"""Accept an installed sensor: compare one measured scan, or several, with the empty scan that was planned.

Steps: read the scans (sensor frame: x forward, y left, z up, metres); register them to the static world
(:mod:`egvs.extensions.hardware.registration`), which gives the measured pose with standard errors; compare them with
the empty scan that is expected from there (:mod:`egvs.extensions.hardware.installation.scan_comparison`); score the
measured pose, and the sensor with its obstacles and missing channels; check each value against its limit.

The tilt error is the angle of the turn that is left when the error of the yaw, about the vertical, is taken out. Errors
of the pose are measured minus planned; those of angles are from -180 to 180 degrees. Standard errors cover the scatter
of the returns about the static world, not an error of the whole map.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.wording import format_percent, number_of
from egvs.explore.session import Session
from egvs.extensions.hardware import registration
from egvs.extensions.hardware.installation import scan_comparison
from egvs.extensions.hardware.installation.acceptance_limits import MAX_VEHICLE_HEIGHT_M, Limits
from egvs.extensions.hardware.installation.planned_sites import PlannedSites
from egvs.extensions.hardware.installation.scan_comparison import BlockedSector, ScanComparison, StaticWorld
from egvs.extensions.hardware.registration import PARAMETERS, Registration, StaticSurfaces, parameter_name_and_unit
from egvs.formats import sweep_files
from egvs.results.labels import SCORE_LABELS
from egvs.scoring.visibility import Beams
from egvs.sensors.sensor import Sensor, rotation_world_sensor
from egvs.sensors.sites import Pose, Site

MIN_STRUCTURE_SHARE = 0.3
"""A scan is of another place if it agrees with less of the walls, poles and other solids of the static world."""

MAX_DISPLACEMENT_M = 3.0
"""A registration that ends farther from the planned position has not found the pose."""

_GOOD_STRUCTURE_SHARE = 0.6
"""Below it, other yaws are tried."""
_SURE_STRUCTURE_SHARE = 0.9
"""Below it, other frames are tried."""
_MIRROR_MARGIN = 0.02
"""A scan whose mirror image agrees with so much more of the structure is mirrored; within it, nothing can tell."""
_MIRROR = np.array([1.0, -1.0, 1.0])
_MIRROR_HINT = "Export y to the left of x: azimuths count counter-clockwise from above."
_OTHER_SITE_MARGIN = 0.05
"""A scan that agrees with so much more of the structure around another pole was taken there."""
_MAX_OTHER_POLES = 12
_BLOCKED_BEAM_DEG = 0.3
"""An expected beam is stopped by the return of an obstacle that is at most this far beside it."""
_SEARCH_POINTS = 6_000
"""Of a scan that fits near the planned pose, about as many points tell whether other yaws fit as well."""
_LEVELLED_DEG, _LEVEL_DEG = 2.0, 0.3
"""A scan may have been levelled if the sensor seems to be so level, against so much tilt in the plan."""
_STEP = 1e-4
_METRES_HINT = "Export the scan in metres, in the sensor's frame: x forward, y left, z up."


@dataclass(frozen=True)
class PoseError:
    """Measured minus planned pose.

    Attributes
    ----------
    planned, measured
        The poses, world frame.
    values, standard_errors
        By parameter (:data:`egvs.extensions.hardware.registration.PARAMETERS`), metres and degrees. A standard error is
        infinite where no surface fixes the parameter.
    position_m, position_se_m
        Distance of the positions.
    tilt_deg, tilt_se_deg
        Angle of the turn from the planned pose to the measured one with the planned yaw. Standard errors are infinite
        if no surface fixes a part of the quantity.
    other_yaws_deg
        Measured minus planned yaw of the other poses at which the scans fit as well.
    """

    planned: Pose
    measured: Pose
    values: dict[str, float]
    standard_errors: dict[str, float]
    position_m: float
    position_se_m: float
    tilt_deg: float
    tilt_se_deg: float
    other_yaws_deg: tuple[float, ...] = ()

    @classmethod
    def of(cls, planned: Pose, fit: Registration, other_yaws_deg: Sequence[float] = ()) -> PoseError:
        """Return the error of a registered pose; ``other_yaws_deg`` are those of poses that fit as well."""
        values = {name: getattr(fit.pose, name) - getattr(planned, name) for name in PARAMETERS}
        for name in PARAMETERS[3:]:
            values[name] = _signed_angle_deg(values[name])
        position_m, position_se_m = _propagate(lambda pose: _distance_m(planned, pose), fit)
        tilt_deg, tilt_se_deg = _propagate(lambda pose: _tilt_deg(planned, pose), fit)
        # A parameter that is not fixed has its planned value, where the derivatives of distance and tilt are 0.
        if {"x_m", "y_m", "z_m"} & set(fit.not_fixed):
            position_se_m = math.inf
        if {"pitch_deg", "roll_deg"} & set(fit.not_fixed):
            tilt_se_deg = math.inf
        others = tuple(_signed_angle_deg(yaw_deg - planned.yaw_deg) for yaw_deg in other_yaws_deg)
        return cls(
            planned, fit.pose, values, fit.standard_errors, position_m, position_se_m, tilt_deg, tilt_se_deg, others
        )  # fmt: skip


def _signed_angle_deg(angle_deg: float) -> float:
    return (angle_deg + 180.0) % 360.0 - 180.0


def _distance_m(planned: Pose, pose: Pose) -> float:
    return math.dist(planned.position_m, pose.position_m)


def _tilt_deg(planned: Pose, pose: Pose) -> float:
    planned_tilt = rotation_world_sensor(0.0, planned.pitch_deg, planned.roll_deg)
    tilt = rotation_world_sensor(0.0, pose.pitch_deg, pose.roll_deg)
    # The norm of the difference of rotations by an angle is 2 sqrt(2) sin(angle / 2).
    half_sine = float(np.linalg.norm(tilt - planned_tilt)) / math.sqrt(8.0)
    return 2.0 * math.degrees(math.asin(min(half_sine, 1.0)))


def _propagate(function: Callable[[Pose], float], fit: Registration) -> tuple[float, float]:
    """Return a function of the fitted pose, and its standard error to first order."""
    gradient = np.zeros(len(PARAMETERS))
    for index, name in enumerate(PARAMETERS):
        ahead = replace(fit.pose, **{name: getattr(fit.pose, name) + _STEP})
        behind = replace(fit.pose, **{name: getattr(fit.pose, name) - _STEP})
        gradient[index] = (function(ahead) - function(behind)) / (2.0 * _STEP)
    gradient[np.abs(gradient) < 1e-6] = 0.0  # so that a parameter without influence may have an infinite variance
    used = np.flatnonzero(gradient)
    variance = gradient[used] @ fit.covariance[np.ix_(used, used)] @ gradient[used] if len(used) else 0.0
    return function(fit.pose), math.sqrt(max(float(variance), 0.0)) if math.isfinite(variance) else math.inf


@dataclass(frozen=True)
class ScoreChange:
    """The score that ranks, as planned and as installed.

    Attributes
    ----------
    name
        Name of the score.
    planned
        At the planned pose.
    at_measured_pose
        At the measured pose, with the whole sensor.
    as_installed
        At the measured pose, without the beams that obstacles stop or that missing channels lack.
    """

    name: str
    planned: float
    at_measured_pose: float
    as_installed: float

    @property
    def loss(self) -> float:
        """Share of the planned score that the installed sensor loses; negative for a gain."""
        return 1.0 - self.as_installed / self.planned if self.planned else 0.0


@dataclass(frozen=True)
class Check:
    """One measured quantity against its limit.

    Attributes
    ----------
    name
        Name of the quantity.
    measured, limit
        Both, in words.
    passed
        Whether the value is within its limit.
    reason
        Why it is not; empty if it is.
    is_close
        Whether the limit is within two standard errors of the measured value.
    """

    name: str
    measured: str
    limit: str
    passed: bool
    reason: str = ""
    is_close: bool = False


@dataclass(frozen=True, eq=False)
class Acceptance:
    """The result of an acceptance check.

    Attributes
    ----------
    site
        The site, at its planned pose.
    sensor
        Its sensor.
    files
        Names of the measured scans.
    pose
        The error of the pose.
    residual_m
        Robust standard deviation of the distances of returns from the static world.
    on_surface_share
        Share of the returns that lie on the static world.
    comparison
        The scans against the expected one.
    score
        What the installation costs; None if it cannot be scored, for the reason in ``notes``.
    limits
        The limits.
    checks
        Each quantity against its limit.
    notes
        Remarks for the reader.
    """

    site: Site
    sensor: Sensor
    files: tuple[str, ...]
    pose: PoseError
    residual_m: float
    on_surface_share: float
    comparison: ScanComparison
    score: ScoreChange | None
    limits: Limits
    checks: tuple[Check, ...]
    notes: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether all checks pass."""
        return all(check.passed for check in self.checks)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why the sensor is not accepted; empty if it is."""
        return tuple(check.reason for check in self.checks if not check.passed)

    def to_json(self) -> dict[str, Any]:
        """Return the result as JSON values; infinite and missing numbers are null."""
        errors = {
            name: {"error": _finite(value), "standard_error": _finite(self.pose.standard_errors[name])}
            for name, value in self.pose.values.items()
        }
        errors["position_m"] = {"error": self.pose.position_m, "standard_error": _finite(self.pose.position_se_m)}
        errors["tilt_deg"] = {"error": self.pose.tilt_deg, "standard_error": _finite(self.pose.tilt_se_deg)}
        comparison = self.comparison
        return {
            "site": self.site.name,
            "sensor": self.sensor.name,
            "scans": list(self.files),
            "passed": self.passed,
            "reasons": list(self.reasons),
            "planned_pose": asdict(self.pose.planned),
            "measured_pose": asdict(self.pose.measured),
            "pose_error": errors,
            "other_yaw_errors_deg": list(self.pose.other_yaws_deg),
            "residual_m": self.residual_m,
            "on_surface_share": self.on_surface_share,
            "blocked_sectors": [_sector_json(sector) for sector in comparison.sectors],
            "missing_channels_deg": list(comparison.missing_channels),
            "unchecked_channels": comparison.unchecked_channels,
            "return_share": _finite(comparison.return_share),
            "returns": comparison.returns,
            "returns_off_beams": comparison.off_beams,
            "returns_nearer_than_expected": comparison.nearer,
            "score": None if self.score is None else {**asdict(self.score), "loss": self.score.loss},
            "limits": {name: _finite(value) for name, value in asdict(self.limits).items()},
            "checks": [asdict(check) for check in self.checks],
            "notes": list(self.notes),
        }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _sector_json(sector: BlockedSector) -> dict[str, Any]:
    low, high = sector.elevation_deg
    return {
        "first_azimuth_deg": sector.first_deg,
        "last_azimuth_deg": sector.last_deg,
        "width_deg": sector.width_deg,
        "bearing_deg": sector.bearing_deg,
        "distance_m": _finite(sector.distance_m),
        "elevation_deg": [_finite(low), _finite(high)],
        "share_of_beams": sector.share,
    }


def accept(
    run: str | Path,
    site: str,
    scans: Sequence[str | Path],
    limits: Limits | None = None,
    *,
    max_vehicle_height_m: float = MAX_VEHICLE_HEIGHT_M,
    progress: ProgressCallback = no_progress,
) -> Acceptance:
    """Compare measured scans of an installed sensor with the empty scan that was planned.

    Parameters
    ----------
    run
        Folder of a finished run.
    site
        Name of the site. If it is part of the plan in the folder, its pose there is the planned one.
    scans
        Files of measured scans in the sensor's frame, see :func:`egvs.formats.sweep_files.read_sweeps`.
    limits
        The limits; by default :class:`Limits`.
    max_vehicle_height_m
        A return in front of the static world that is higher above the ground is of an obstacle, not of a vehicle.
    progress
        Called after each step.

    Raises
    ------
    InputError
        If the run or a file cannot be read, there is no such site, the points are not metres in the sensor's frame, or
        the scans do not fit the static world around the site.
    """
    limits = limits or Limits()
    steps = 4
    planned_sites = PlannedSites.open(Path(run))
    planned = planned_sites.site(planned_sites.resolve(site))
    sensor = planned_sites.sensor(planned)
    sweeps = sweep_files.read_sweeps([Path(scan) for scan in scans])
    clouds = [sweep.points_m[np.isfinite(sweep.points_m[:, 0])] for sweep in sweeps]
    for sweep, cloud in zip(sweeps, clouds, strict=True):
        _check_units(sweep.name, cloud, sensor)
    files = tuple(sweep.name for sweep in sweeps)
    where = ", ".join(files)
    progress("scans read", 1, steps)

    scene = planned_sites.session.scene
    world = StaticWorld(scene, planned.pose)
    surfaces = StaticSurfaces(scene.world, planned.pose.position_m)
    try:
        fit, comparison, others = _register(clouds, sensor, planned, surfaces, world, where, max_vehicle_height_m)
    except _OtherFrameError:
        raise
    except InputError:
        _check_fits_no_other_site(clouds, planned_sites, planned, 0.0, where)
        raise
    share = _structure(comparison)
    if share < _SURE_STRUCTURE_SHARE:
        least_share = max(share + _OTHER_SITE_MARGIN, _GOOD_STRUCTURE_SHARE)
        _check_frame(clouds, sensor, planned.pose, surfaces, world, where, least_share)
    _check_fits_no_other_site(clouds, planned_sites, planned, share, where)
    mirror_note = _check_not_mirrored(clouds, sensor, planned.pose, surfaces, world, where, _structure(comparison))
    progress("registered", 2, steps)

    error = PoseError.of(planned.pose, fit, others)
    notes = [*_notes(fit, comparison, others), *mirror_note]
    if error.tilt_deg > _LEVELLED_DEG and _tilt_deg(Pose(0.0, 0.0, 0.0), fit.pose) < _LEVEL_DEG:
        notes.append("the measured pose is exactly level: was the scan levelled? Export it in the sensor's own frame")
    score = _score_change(planned_sites.session, planned, fit.pose, comparison, notes)
    progress("scored", 3, steps)
    checks = tuple(_checks(error, comparison, score, limits))
    progress("checked", steps, steps)
    return Acceptance(
        planned, sensor, files, error, fit.sigma_m, float(np.mean(fit.on_surface)), comparison, score, limits, checks,
        tuple(notes),
    )  # fmt: skip


def _check_units(name: str, points_m: FloatArray, sensor: Sensor) -> None:
    """Raise an InputError if the points of a scan cannot be metres around a sensor."""
    range_m = np.linalg.norm(points_m, axis=1)
    typical_m = float(np.quantile(range_m, 0.95))
    if typical_m > 3.0 * sensor.range_m:
        problem = (
            f"expected returns within the {sensor.range_m:g} m of {sensor.name}, got ranges up to {typical_m:,.0f}"
        )
        raise InputError(name, problem, f"{_METRES_HINT} These look like millimetres or a map's coordinates.")
    spread_m = np.quantile(points_m, 0.95, axis=0) - np.quantile(points_m, 0.05, axis=0)
    if max(spread_m[0], spread_m[1]) < 1.0:
        problem = f"expected returns around the sensor, got x and y within {max(spread_m[0], spread_m[1]):.3g} m"
        raise InputError(name, problem, f"{_METRES_HINT} These look like longitude and latitude, or kilometres.")


def _register(
    clouds: Sequence[FloatArray],
    sensor: Sensor,
    planned: Site,
    surfaces: StaticSurfaces,
    world: StaticWorld,
    where: str,
    max_vehicle_height_m: float,
) -> tuple[Registration, ScanComparison, tuple[float, ...]]:
    """Return the measured pose, the comparison there, and the yaws at which the scans fit as well."""
    points_m = np.concatenate(list(clouds))
    start = planned.pose
    try:
        fit = registration.register_scan(points_m, surfaces, start, where=where)
    except InputError:  # the yaw may be far off, which the search below finds
        fit = None
    if fit is not None:
        comparison = scan_comparison.compare_scans(clouds, sensor, fit.pose, world, max_vehicle_height_m)
        if _is_plausible(fit, start) and _structure(comparison) >= _GOOD_STRUCTURE_SHARE:
            others = _other_yaws(points_m, surfaces, fit, start, where)
            if others is not None:
                return fit, comparison, others

    problem = f"the scan does not fit the static world around {planned.name} at any yaw"
    hint = (
        f"Check that it was measured at this site, in the sensor's frame in metres, less than {MAX_DISPLACEMENT_M:g} m"
        " and about 5 degrees of tilt from the planned pose."
    )
    search, share = None, 0.0
    with contextlib.suppress(InputError):  # where at no yaw enough points lie on the static world
        search = registration.search_yaw(points_m, surfaces, start, where=where)
    if search is not None:
        best = search.best
        comparison = scan_comparison.compare_scans(clouds, sensor, best.pose, world, max_vehicle_height_m)
        share = _structure(comparison) if _is_plausible(best, start) else 0.0
    if search is None or share < MIN_STRUCTURE_SHARE:
        _check_frame(clouds, sensor, start, surfaces, world, where, max(share, _GOOD_STRUCTURE_SHARE))
        raise InputError(where, problem, hint)
    equally_good = [other.registration for other in search.equally_good]
    return best, comparison, tuple(other.pose.yaw_deg for other in equally_good if _is_near(other, start))


class _OtherFrameError(InputError):
    """A scan that fits in another frame than that of the sensor."""


def _check_frame(
    clouds: Sequence[FloatArray],
    sensor: Sensor,
    start: Pose,
    surfaces: StaticSurfaces,
    world: StaticWorld,
    where: str,
    least_share: float,
) -> None:
    """Raise an InputError that names the frame in which scans fit the static world, if one fits well."""
    own_frame = "Export it in the sensor's own frame: x forward, y left, z along its axis, right-handed."
    level_hint = f"{own_frame} Points of egvs clouds are levelled: turn them back by T_level_sensor in about.json."
    other_mount = "upright" if start.is_inverted else "inverted"
    level = rotation_world_sensor(0.0, start.pitch_deg, start.roll_deg)
    frames: list[tuple[FloatArray, str, str]] = [
        (np.diag(_MIRROR), "better as its mirror image", _MIRROR_HINT),
        (
            np.diag([1.0, -1.0, -1.0]),
            "turned by 180 degrees about its x axis: it is the other way up",
            f"If the sensor hangs so, plan it with mount {other_mount}; if the file was turned: {own_frame}",
        ),
        (np.diag([1.0, 1.0, -1.0]), "with z reversed", own_frame),
    ]
    if start.pitch_deg or start.roll_deg:
        frames.append((level, "at pitch 0 and roll 0: it was levelled", level_hint))
    if start.is_inverted:
        hung = rotation_world_sensor(0.0, start.pitch_deg, start.side_tilt_deg)
        frames.append((hung @ np.diag([1.0, -1.0, -1.0]), "levelled and the other way up", own_frame))
    shares = [
        _fitted_share([cloud @ turn for cloud in clouds], sensor, start, surfaces, world) for turn, _, _ in frames
    ]
    best = int(np.argmax(shares))
    if shares[best] > least_share:
        _, how, hint = frames[best]
        raise _OtherFrameError(where, f"the scan fits the static world {how}", hint)


def _other_yaws(
    points_m: FloatArray, surfaces: StaticSurfaces, fit: Registration, planned: Pose, where: str
) -> tuple[float, ...] | None:
    """Return the other yaws at which the scans fit as well as in ``fit``; None if they fit better at another yaw."""
    few = points_m[:: max(1, len(points_m) // _SEARCH_POINTS)]
    try:
        search = registration.search_yaw(few, surfaces, fit.pose, where=where)
    except InputError:  # too few of these points lie on the static world
        return ()
    found = [search.best, *(other.registration for other in search.equally_good)]
    near = [other for other in found if _is_near(other, planned)]
    others = [other for other in near if not registration.is_same_pose(other.pose, fit.pose)]
    if others and len(others) == len(near):
        return None
    return tuple(other.pose.yaw_deg for other in others)


def _is_near(fit: Registration, planned: Pose) -> bool:
    return _distance_m(planned, fit.pose) <= MAX_DISPLACEMENT_M


def _is_plausible(fit: Registration, planned: Pose) -> bool:
    """Return whether a registration ended, and where it can have started."""
    return fit.converged and _is_near(fit, planned)


def _check_not_mirrored(
    clouds: Sequence[FloatArray],
    sensor: Sensor,
    start: Pose,
    surfaces: StaticSurfaces,
    world: StaticWorld,
    where: str,
    share: float,
) -> list[str]:
    """Return a note where the mirror image of the scans fits as well as they do; InputError where it fits better.

    In a street whose sides are alike, a mirrored scan agrees with most of the structure.
    """
    mirrored = [cloud * _MIRROR for cloud in clouds]
    gain = _fitted_share(mirrored, sensor, start, surfaces, world) - share
    if gain > _MIRROR_MARGIN:
        raise _mirrored_error(where)
    if gain < -_MIRROR_MARGIN:
        return []
    return ["the mirror image of the scan fits as well: check that azimuths count counter-clockwise from above"]


def _mirrored_error(where: str) -> InputError:
    return InputError(where, "the scan fits the static world better as its mirror image", _MIRROR_HINT)


def _check_fits_no_other_site(
    clouds: Sequence[FloatArray], planned_sites: PlannedSites, planned: Site, share: float, where: str
) -> None:
    """Raise an InputError where scans fit the surroundings of another pole better, at any yaw.

    Compared are the other poles of the plan, or of all candidates without a plan, the nearest first. ``share`` is that
    of the structure around the planned site with which the scans agree.
    """
    scene = planned_sites.session.scene
    best: tuple[Site, Pose] | None = None
    best_share = max(share + _OTHER_SITE_MARGIN, _GOOD_STRUCTURE_SHARE)
    for other in _sites_on_other_poles(planned_sites, planned):
        surfaces = StaticSurfaces(scene.world, other.pose.position_m)
        world = StaticWorld(scene, other.pose)
        found = _best_fit(clouds, planned_sites.sensor(other), other.pose, surfaces, world)
        if found is not None and found[0] > best_share:
            best_share, best = found[0], (other, found[1])
    if best is not None:
        best_name = _closest_mount(planned_sites, *best)
        problem = f"this scan was not taken at {planned.name}; it fits {best_name}"
        raise InputError(where, problem, f"Use --site {best_name}, or the scan of {planned.name}.")


def _closest_mount(planned_sites: PlannedSites, site: Site, measured: Pose) -> str:
    """Return the site on the pole of another, of the plan if it has one there, whose pose is closest to a measured one.

    A metre counts as much as 10 degrees.
    """
    names = list(planned_sites.plan) or list(planned_sites.session.candidates)
    mounts = [other for other in map(planned_sites.site, names) if other.pole == site.pole]

    def distance(other: Site) -> float:
        turn = rotation_world_sensor(*measured.angles_deg).T @ rotation_world_sensor(*other.pose.angles_deg)
        angle_deg = math.degrees(math.acos(min(max((float(np.trace(turn)) - 1.0) / 2.0, -1.0), 1.0)))
        return _distance_m(measured, other.pose) + angle_deg / 10.0

    return min(mounts, key=distance).name


def _sites_on_other_poles(planned_sites: PlannedSites, planned: Site) -> list[Site]:
    """Return one site of each other pole, the one nearest to the planned site in three dimensions."""
    names = list(planned_sites.plan) or list(planned_sites.session.candidates)
    sites = [planned_sites.site(name) for name in names]
    by_distance = sorted(sites, key=lambda site: _distance_m(planned.pose, site.pose))
    by_pole = {site.pole: site for site in reversed(by_distance) if site.pole != planned.pole}
    return sorted(by_pole.values(), key=lambda site: _distance_m(planned.pose, site.pose))[:_MAX_OTHER_POLES]


def _fitted_share(
    clouds: Sequence[FloatArray], sensor: Sensor, start: Pose, surfaces: StaticSurfaces, world: StaticWorld
) -> float:
    """Return how well scans agree with the structure of the static world at the best yaw; 0 if none is found."""
    found = _best_fit(clouds, sensor, start, surfaces, world)
    return 0.0 if found is None else found[0]


def _best_fit(
    clouds: Sequence[FloatArray], sensor: Sensor, start: Pose, surfaces: StaticSurfaces, world: StaticWorld
) -> tuple[float, Pose] | None:
    """Return how well scans agree with the structure of the static world at the best yaw, and the pose there."""
    try:
        fit = registration.search_yaw(np.concatenate(list(clouds)), surfaces, start).best
    except InputError:
        return None
    if not _is_plausible(fit, start):
        return None
    return _structure(scan_comparison.compare_scans(clouds, sensor, fit.pose, world)), fit.pose


def _structure(comparison: ScanComparison) -> float:
    """Return the share of the structure that agrees; where nothing stands, the ground has to do."""
    share = comparison.structure_share
    return 1.0 if math.isnan(share) else share


def _notes(fit: Registration, comparison: ScanComparison, other_yaws_deg: Sequence[float]) -> list[str]:
    notes = []
    if fit.not_fixed:
        names = " and ".join(parameter_name_and_unit(name)[0] for name in fit.not_fixed)
        notes.append(f"no surface of the static world fixes {names}: planned values are used instead")
    if other_yaws_deg:
        yaws = ", ".join(f"{yaw:.0f}" for yaw in other_yaws_deg)
        notes.append(f"the scan fits as well at a yaw of {yaws} degrees: check where the front of the sensor points")
    if comparison.unchecked_channels is None:
        notes.append("the sensor has no channels, so none is checked")
    elif comparison.unchecked_channels:
        notes.append(
            f"{comparison.unchecked_channels} channels are not checked: too few surfaces within half the range"
        )
    if comparison.scans < scan_comparison.PERSISTENT_SCANS and comparison.nearer_share > 0.05:
        notes.append(
            f"{format_percent(comparison.nearer_share, 0)} of the returns are nearer than expected where "
            "vehicles can be: with"
            f" {scan_comparison.PERSISTENT_SCANS} or more scans, some minutes apart, obstacles below the height of"
            " vehicles are found too"
        )
    return notes


# ---- score


def _score_change(
    session: Session, planned: Site, measured: Pose, comparison: ScanComparison, notes: list[str]
) -> ScoreChange | None:
    """Return what the installation costs; None, with a note, if one of the poses cannot be scored."""
    name = session.rank_by
    before = session.rate(planned.name, planned.pose)
    after = session.rate(planned.name, measured)
    for rated, pose in ((before, "planned"), (after, "measured")):
        if not rated.is_feasible:
            problems = "; ".join(finding.problem for finding in rated.findings if finding.is_error)
            notes.append(f"the {pose} pose cannot be scored: {problems}")
            return None
    moved = replace(planned, pose=measured)
    installed = _installed_beams(session.beams(moved), comparison)
    as_installed = session.score_beams(moved, installed)[name]
    return ScoreChange(name, before.scores[name], after.scores[name], as_installed)


def _installed_beams(beams: Beams, comparison: ScanComparison) -> Beams:
    """Return the empty scan with the beams that obstacles stop cut there, and without those of missing channels."""
    rotation = rotation_world_sensor(*beams.pose.angles_deg)
    range_m = np.linalg.norm(beams.ends_m, axis=1)
    directions = beams.ends_m @ rotation / range_m[:, None]
    azimuth_deg = np.mod(np.degrees(np.arctan2(directions[:, 1], directions[:, 0])), 360.0)
    elevation_deg = np.degrees(np.arcsin(np.clip(directions[:, 2], -1.0, 1.0)))
    ends_m = beams.ends_m.copy()
    if len(comparison.obstacle_ranges_m):
        reach = 2.0 * math.sin(math.radians(_BLOCKED_BEAM_DEG) / 2.0)
        distance, nearest = KDTree(comparison.obstacle_directions).query(directions, distance_upper_bound=reach)
        stopped = np.flatnonzero(np.isfinite(distance))
        share = np.minimum(comparison.obstacle_ranges_m[nearest[stopped]] / range_m[stopped], 1.0)
        ends_m[stopped] *= share[:, None]
    lost = np.zeros(len(ends_m), dtype=np.bool_)
    for sector in comparison.sectors:
        if not sector.has_returns:
            lost |= np.mod(azimuth_deg - sector.first_deg, 360.0) < sector.width_deg
    if comparison.missing_channels:
        channels_deg = scan_comparison.channel_elevations_deg(beams.sensor)
        channel = np.abs(elevation_deg[:, None] - channels_deg).argmin(axis=1)
        lost |= np.isin(channels_deg[channel], comparison.missing_channels)
    weight = None if beams.weight is None else beams.weight[~lost]
    return replace(beams, ends_m=ends_m[~lost], weight=weight)


# ---- limits


def _checks(error: PoseError, comparison: ScanComparison, score: ScoreChange | None, limits: Limits) -> list[Check]:
    checks = [
        _measured_check("position", error.position_m, error.position_se_m, limits.position_m, "m"),
        _measured_check("tilt", error.tilt_deg, error.tilt_se_deg, limits.tilt_deg, "degrees"),
        _yaw_check(error, limits.yaw_deg),
    ]
    sectors = "; ".join(describe_sector(sector) for sector in comparison.sectors)
    blocked = comparison.blocked_deg <= limits.blocked_deg
    checks.append(
        Check(
            "blocked sectors",
            _with_unit(comparison.blocked_deg, "degrees"),
            f"at most {_with_unit(limits.blocked_deg, 'degrees')}",
            blocked,
            "" if blocked else f"{_with_unit(comparison.blocked_deg, 'degrees')} blocked: {sectors}",
        )
    )
    missing = comparison.missing_channels
    channels = len(missing) <= limits.missing_channels
    elevations = ", ".join(f"{elevation:g}" for elevation in missing)
    reason = "" if channels else f"{number_of(len(missing), 'channel')} without returns: elevation {elevations} degrees"
    channels_text = "not checked" if comparison.unchecked_channels is None else f"{len(missing)}"
    checks.append(Check("missing channels", channels_text, f"at most {limits.missing_channels:g}", channels, reason))
    if not math.isnan(comparison.return_share):
        share = comparison.return_share
        passed = share >= limits.returns
        reason = "" if passed else f"only {format_percent(share, 0)} of the expected returns come back"
        checks.append(
            Check(
                "expected returns",
                format_percent(share),
                f"at least {format_percent(limits.returns, 0)}",
                passed,
                reason,
            )
        )
    off = comparison.off_beams / comparison.returns
    passed = off <= limits.off_beams
    reason = (
        ""
        if passed
        else f"{format_percent(off, 0)} of the returns lie on no beam of the planned sensor: is it another model?"
    )
    checks.append(
        Check(
            "returns on no beam", format_percent(off), f"at most {format_percent(limits.off_beams, 0)}", passed, reason
        )
    )
    if score is None:
        passed = math.isinf(limits.loss)
        reason = "" if passed else "the score of the installed sensor cannot be computed"
        checks.append(
            Check(
                "score", "cannot be scored", f"at least {format_percent(-limits.loss, 0, signed=True)}", passed, reason
            )
        )
    else:
        label = SCORE_LABELS[score.name]
        passed = score.loss <= limits.loss
        measured = f"{label.value(score.as_installed)} instead of {label.value(score.planned)} {label.unit}".rstrip()
        reason = (
            ""
            if passed
            else f"the installed sensor loses {format_percent(score.loss)} of its planned score: {measured}"
        )
        checks.append(
            Check(
                "score",
                format_percent(-score.loss, signed=True),
                f"at least {format_percent(-limits.loss, 0, signed=True)}",
                passed,
                reason,
            )
        )
    return checks


def _measured_check(name: str, value: float, se: float, limit: float, unit: str) -> Check:
    """Return the check of a quantity with a standard error; one that no surface fixes keeps an infinite limit only."""
    if not math.isfinite(se):
        passed = math.isinf(limit)
        reason = "" if passed else f"{name} cannot be measured: no surface of the static world fixes it"
        return Check(name, "cannot be measured", f"at most {_with_unit(limit, unit)}", passed, reason)
    passed = abs(value) <= limit
    measured = f"{describe_error(value, se)} {unit}"
    reason = (
        "" if passed else f"{name} is off by {describe_error(abs(value), se)} {unit}, limit {_with_unit(limit, unit)}"
    )
    return Check(
        name, measured, f"at most {_with_unit(limit, unit)}", passed, reason, abs(abs(value) - limit) <= 2.0 * se
    )


def _with_unit(value: float, unit: str) -> str:
    """Return a value with its unit, which is a singular for one degree."""
    return f"{value:g} {'degree' if value == 1.0 and unit == 'degrees' else unit}"


def _yaw_check(error: PoseError, limit_deg: float) -> Check:
    """Return the check of the yaw; it fails if the scans fit as well at a yaw beyond the limit."""
    value_deg = error.values["yaw_deg"]
    check = _measured_check("yaw", value_deg, error.standard_errors["yaw_deg"], limit_deg, "degrees")
    beyond_deg = [other_deg for other_deg in error.other_yaws_deg if abs(other_deg) > limit_deg]
    if not beyond_deg or not math.isfinite(error.standard_errors["yaw_deg"]):
        return check
    errors = " or ".join(f"{error_deg:z.1f}" for error_deg in (value_deg, *beyond_deg))
    reason = f"yaw cannot be told: it is off by {errors} degrees, the scan fits as well at each"
    return replace(check, measured=f"{errors} degrees", passed=False, reason=reason, is_close=False)


def describe_error(value: float, se: float, unit: str = "") -> str:
    """Return an error of the pose with its standard error, e.g. "1.502 ± 0.004"; digits end at a thousandth.

    Examples
    --------
    >>> describe_error(1.5021, 0.0041), describe_error(-0.0001, 0.00001)
    ('1.502 ± 0.004', '0.000 ± <0.001')
    """
    if math.isinf(se):
        return "cannot be measured"
    scatter = f"{se:.3f}" if se >= 0.0005 or se == 0.0 else "<0.001"
    return f"{value:z.3f} ± {scatter} {unit}".rstrip()


def describe_sector(sector: BlockedSector) -> str:
    """Return a blocked sector in words."""
    azimuths = f"azimuth {sector.first_deg:g} to {sector.last_deg:g} (bearing {sector.bearing_deg:.0f})"
    if sector.has_returns:
        low, high = sector.elevation_deg
        return f"{azimuths}, {sector.distance_m:.1f} m away, elevation {low:.0f} to {high:.0f}"
    return f"{azimuths}, without returns"
