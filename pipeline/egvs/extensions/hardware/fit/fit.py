"""Fit a sensor to its sweeps: angles, range noise, return rates, ground plane, empty scan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.extensions.hardware.fit import empty_scan, range_noise, return_rates
from egvs.extensions.hardware.fit.beam_angles import BeamAngles, PulseGrid, fit_beam_angles, pulse_grid, range_step
from egvs.extensions.hardware.fit.calibration import CalibratedPose
from egvs.extensions.hardware.fit.empty_scan import EmptyScanFit
from egvs.extensions.hardware.fit.map_pose import MapPose, fit_map_pose
from egvs.extensions.hardware.fit.range_noise import NoiseBin, RangeResiduals
from egvs.extensions.hardware.fit.return_rates import PlaneView, RateBin
from egvs.extensions.hardware.fit.rotation import Rotation, fit_rotation
from egvs.extensions.hardware.fit.surface_normals import surface_normals
from egvs.formats.sweep_files import Sweep
from egvs.scenario.model import Scenario
from egvs.sensors import ground_plane
from egvs.sensors.ground_plane import GroundPlane
from egvs.stages.inputs import Inputs
from egvs.statistics.intervals import Estimate, estimate_scale

SIGMA_RANGE_M = (5.0, 25.0)
"""The range noise of the sensor is that between these ranges: nearer, curved surfaces and the mount add to it, farther,
rough ones."""


@dataclass(frozen=True)
class FitOptions:
    """Choices of the user.

    Attributes
    ----------
    ground
        Number of the ground plane, from 1.
    road_deg
        First and last azimuth of the road in the sensor's frame, counter-clockwise; None to find it.
    is_inverted
        Whether the sensor is upside down, so that z of its frame points downwards.
    """

    ground: int = 1
    road_deg: tuple[float, float] | None = None
    is_inverted: bool = False


@dataclass(frozen=True)
class SensorFit:
    """A fitted sensor.

    Attributes
    ----------
    sweeps
        The sweeps.
    layout
        Order of the first sweep's points, see :class:`egvs.extensions.hardware.fit.sweep_layout.Layout`.
    has_file_rings, ring_note
        Whether the rings are those that the file states; if not although it states some, why, as a sentence.
    silent_channels
        Channels of an organised sweep, or rings of the file, with too few returns to be fitted.
    angles
        Directions of all pulses.
    grids
        Returns of each sweep by pulse.
    range_step_m
        Step of measured ranges, metres; None if they have none.
    max_range_m
        Largest measured range.
    sigma_m
        Range noise between 5 and 25 m (or of all ranges, if there are too few); None if there are too few at all.
    noise, noise_on_road, noise_by_channel
        Range noise on all surfaces and on the road, by range; and by channel.
    return_rate, return_rates, road_rates
        Share of returns on smooth surfaces, in all and by range and incidence; and on the road by range.
    rates_towards_road
        Share of returns of all pulses towards the road, from vehicles as well, by range.
    empty_sectors_deg
        Sectors of azimuth without returns.
    planes, plane
        Ground planes, and the chosen one.
    plane_view
        Where pulses meet the chosen plane.
    empty_scan
        The background; None with fewer than three sweeps.
    residuals
        Differences between ranges of neighbours, for figures.
    rotation
        How fast the sensor turns; None if the sweeps have no times.
    map_pose
        The pose in the world of a scenario; None unless :func:`with_map_pose` adds it.
    calibrated_pose
        The pose by a calibration file; None unless one is given.
    """

    sweeps: Sequence[Sweep]
    layout: str
    has_file_rings: bool
    ring_note: str
    silent_channels: int
    angles: BeamAngles
    grids: list[PulseGrid]
    range_step_m: float | None
    max_range_m: float
    sigma_m: Estimate | None
    noise: list[NoiseBin]
    noise_on_road: list[NoiseBin]
    noise_by_channel: list[Estimate | None]
    return_rate: Estimate | None
    return_rates: list[RateBin]
    road_rates: list[RateBin]
    rates_towards_road: list[RateBin]
    empty_sectors_deg: list[tuple[float, float]]
    planes: list[GroundPlane]
    plane: GroundPlane
    plane_view: PlaneView
    empty_scan: EmptyScanFit | None
    residuals: RangeResiduals
    rotation: Rotation | None = None
    map_pose: MapPose | None = None
    calibrated_pose: CalibratedPose | None = None


def fit_sensor(
    sweeps: Sequence[Sweep], options: FitOptions | None = None, on_step: Callable[[str], None] = lambda _: None
) -> SensorFit:
    """Fit a sensor to sweeps.

    Parameters
    ----------
    sweeps
        At least one that is not coarse. Coarse ones serve the empty scan only.
    options
        Choices of the user.
    on_step
        Called with the name of each step.

    Raises
    ------
    InputError
        If the points lie on no rings, the azimuths have no common step, or there is no such ground plane.
    """
    options = options or FitOptions()
    on_step("angles")
    angles, layout = fit_beam_angles(sweeps)
    grids = [pulse_grid(sweep, angles) for sweep in sweeps]
    fine = [grid.range_m for grid, sweep in zip(grids, sweeps, strict=True) if not sweep.is_coarse]

    on_step("ground")
    planes = _find_ground_planes(fine, angles, sweeps[0].name, is_inverted=options.is_inverted)
    if not 1 <= options.ground <= len(planes):
        raise InputError("--ground", f"expected a plane from 1 to {len(planes)}, got {options.ground}")
    plane = planes[options.ground - 1]
    view = return_rates.view_of_plane(fine, angles, plane, options.road_deg)

    on_step("range noise")
    step_m = range_step(np.concatenate([grid.ravel() for grid in fine]))
    residuals = range_noise.range_residuals(fine, angles.is_full_circle)
    on_road = [view.on_road & (np.abs(view.height_m(grid)) <= return_rates.ROAD_BAND_M) for grid in fine]
    road_residuals = range_noise.range_residuals(fine, angles.is_full_circle, on_road, view.incidence_deg)

    on_step("return rates")
    return_rate, rates = return_rates.smooth_rates(return_rates.smooth_pulses(fine, angles))
    background = None
    if len(grids) >= empty_scan.MIN_SWEEPS:
        on_step("empty scan")
        background = empty_scan.fit_empty_scan([grid.range_m for grid in grids])
    step = step_m or 0.0
    return SensorFit(
        sweeps=sweeps,
        layout=layout.order,
        has_file_rings=layout.has_file_rings,
        ring_note=layout.note,
        silent_channels=layout.silent,
        angles=angles,
        grids=grids,
        range_step_m=step_m,
        max_range_m=_max_range_m(fine),
        sigma_m=_sensor_sigma(residuals, step),
        noise=range_noise.noise_by_range(residuals, step),
        noise_on_road=range_noise.noise_by_range(road_residuals, step),
        noise_by_channel=range_noise.noise_by_channel(_near(residuals), angles.channels, step),
        return_rate=return_rate,
        return_rates=rates,
        rates_towards_road=return_rates.rates_towards_road(fine, view),
        road_rates=return_rates.road_rates(fine, angles, view),
        empty_sectors_deg=return_rates.empty_sectors(fine, angles),
        planes=planes,
        plane=plane,
        plane_view=view,
        empty_scan=background,
        residuals=residuals,
        rotation=fit_rotation(sweeps, angles),
    )


def with_map_pose(fit: SensorFit, scenario: Scenario, site_m: tuple[float, ...]) -> SensorFit:
    """Return a fit with the pose in the world of a scenario.

    Parameters
    ----------
    fit
        The fitted sensor. Its empty scan is registered, or all returns if it has none.
    scenario
        Its static world is built.
    site_m
        x and y of the sensor to 2 m, and z if the world has no ground there.

    Raises
    ------
    InputError
        As of :func:`egvs.extensions.hardware.fit.map_pose.fit_map_pose`, or if the static world cannot be built.
    """
    if fit.empty_scan is not None:
        points = empty_scan.points_of(fit.empty_scan.range_m, fit.angles)
        points_m = points[np.isfinite(fit.empty_scan.range_m)]
    else:
        fine = [sweep.points_m for sweep in fit.sweeps if not sweep.is_coarse]
        points_m = np.concatenate([points[np.isfinite(points[:, 0])] for points in fine])
    world = Inputs(scenario).world
    return replace(fit, map_pose=fit_map_pose(points_m, fit.plane, world, site_m, scenario.name, fit.sweeps[0].name))


def _find_ground_planes(
    grids: list[FloatArray], angles: BeamAngles, where: str, *, is_inverted: bool
) -> list[GroundPlane]:
    points, normals = [], []
    for grid in grids:
        returned = np.isfinite(grid)
        points.append(empty_scan.points_of(grid, angles)[returned])
        normals.append(surface_normals(grid, angles)[returned])
    turn = np.array([1.0, -1.0, -1.0]) if is_inverted else np.ones(3)
    planes = ground_plane.find_ground_planes(np.concatenate(points) * turn, np.concatenate(normals) * turn, where)
    return [plane.upside_down() for plane in planes] if is_inverted else planes


def _max_range_m(grids: list[FloatArray]) -> float:
    return max(float(np.nanmax(grid)) for grid in grids)


def _near(residuals: RangeResiduals) -> RangeResiduals:
    """Return the residuals between :data:`SIGMA_RANGE_M`, or all if there are too few."""
    low, high = SIGMA_RANGE_M
    near = (residuals.range_m >= low) & (residuals.range_m < high)
    if np.count_nonzero(near) < 1000:
        return residuals
    return RangeResiduals(
        residuals.residual_m[near],
        residuals.range_m[near],
        residuals.channel[near],
        residuals.pulse[near],
        residuals.incidence_deg[near],
    )


def _sensor_sigma(residuals: RangeResiduals, step_m: float) -> Estimate | None:
    return estimate_scale(_near(residuals).residual_m, range_noise.VARIANCE_FACTOR, step_m)
