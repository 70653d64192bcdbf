"""The simulator against a measurement: a sweep of a real LiDAR, and the simulated one at the same place.

``python -m benchmarks.measured_sweep FOLDER``: FOLDER contains ``sweep.pcd.gz`` and ``frames.npz``,
eleven sweeps of one unit. Steps:

1. Fit the sensor to the sweep; find the empty scan of the ten frames, and leave out what was in front of it.
2. Triangulate the ground and everything else from the ten frames, which do not contain the sweep.
3. Cast the beams of the fitted sensor, as a scenario would read it, from the fitted pose.
4. Compare pulse by pulse with the sweep, without the pulses whose return in the sweep is in front of the empty scan,
   and without the sector in which the fit finds no returns (the mast).

Each ratio is simulated to measured; its interval leaves out sectors of 10 degrees of azimuth in turn. What the world
is made of returned in at least three of ten frames, so surfaces that return rarely are missing from it.
"""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t

from egvs.core.files import temporary_folder
from egvs.core.grid import FloatArray, Roi
from egvs.extensions.hardware.fit import empty_scan, output
from egvs.extensions.hardware.fit.empty_scan import EmptyScanFit
from egvs.extensions.hardware.fit.fit import SensorFit, fit_sensor
from egvs.extensions.hardware.fit.range_noise import VARIANCE_FACTOR, range_residuals
from egvs.extensions.hardware.fit.return_rates import ROAD_BAND_M
from egvs.extensions.maps.point_clouds.as_built_view import AsBuiltMap
from egvs.extensions.maps.point_clouds.reader import make_meshes
from egvs.extensions.maps.point_clouds.surface import triangulate_cloud
from egvs.formats.sweep_files import read_sweeps
from egvs.scenario.sensor_config import SensorConfig
from egvs.sensors.sensor import Sensor, resolve_sensor
from egvs.statistics.intervals import estimate_scale
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster, EmptyScan

SECTOR_DEG = 10.0
WORLD_M = 150.0
RANGES_M = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 80.0, 100.0, 150.0)
ELEVATIONS_DEG = (-26.0, -8.0, -6.0, -5.0, -4.0, -3.0, -2.0, -1.0, 1.0)
AGREE_M = 0.2


@dataclass(frozen=True)
class Comparison:
    """Measured and simulated ranges of the same pulses, in ascending order of elevation.

    Attributes
    ----------
    fit
        The fitted sensor.
    measured_m, simulated_m
        (channels, azimuths), NaN without a return.
    used
        Pulses that are compared: not those whose measured return is in front of the empty scan, and not those that the
        mast hides.
    sector
        Sector of azimuth of each pulse.
    is_ground, is_known
        Whether the simulated beam meets the triangulated ground, and whether the pulse has a background in the ten
        frames.
    on_road, road_range_m
        Whether a pulse is towards the road, and its range to the ground plane.
    """

    fit: SensorFit
    measured_m: FloatArray
    simulated_m: FloatArray
    used: NDArray[np.bool_]
    sector: NDArray[np.int64]
    is_ground: NDArray[np.bool_]
    is_known: NDArray[np.bool_]
    on_road: NDArray[np.bool_]
    road_range_m: FloatArray


def fitted_sensor(fit: SensorFit) -> Sensor:
    """Return the sensor as a scenario reads it from ``sensor.toml``."""
    with temporary_folder() as folder:
        output.write_fit(fit, "fitted", folder)
        table = tomllib.loads((folder / output.SENSOR_FILE).read_text(encoding="utf-8"))
    return resolve_sensor("fitted", {"fitted": SensorConfig.from_dict(table["sensors"]["fitted"])}, "fit")


def fit_sweeps(folder: Path) -> tuple[SensorFit, EmptyScanFit]:
    """Fit the sensor to the sweep; return it with the empty scan of the ten frames, which do not contain the sweep."""
    fit = fit_sensor(read_sweeps([folder / "sweep.pcd.gz", folder / "frames.npz"]))
    return fit, empty_scan.fit_empty_scan([frame.range_m for frame in fit.grids[1:]])


def build_world(fit: SensorFit, background: EmptyScanFit) -> World:
    """Triangulate what the ten frames show of the static world, upright."""
    points = []
    for number, frame in enumerate(fit.grids[1:]):
        is_static = np.isfinite(frame.range_m) & (background.labels[number] == empty_scan.BACKGROUND)
        points.append(empty_scan.points_of(frame.range_m, fit.angles)[is_static])
    cloud = output.upright(np.concatenate(points), fit.plane)
    cloud = cloud[np.hypot(cloud[:, 0], cloud[:, 1]) < WORLD_M]
    return AsBuiltMap(meshes=make_meshes(triangulate_cloud(cloud))).world()


def cast_static(fit: SensorFit, world: World, sensor: Sensor) -> EmptyScan:
    """Cast all beams of the fitted sensor from the fitted pose."""
    corner = (-WORLD_M, -WORLD_M, -30.0)
    caster = Caster(world, Roi(corner, (2 * WORLD_M, 2 * WORLD_M, 90.0)))
    directions = sensor.directions(0.0, fit.plane.pitch_deg, fit.plane.roll_deg)
    return caster.sweep((0.0, 0.0, fit.plane.height_m), directions, sensor.range_m)


def compare(folder: Path) -> Comparison:
    """Fit, build the world, simulate, and align the pulses."""
    fit, background = fit_sweeps(folder)
    sweep = fit.grids[0]
    world = build_world(fit, background)
    sensor = fitted_sensor(fit)
    scan = cast_static(fit, world, sensor)
    ranges = np.where(scan.returned, np.sqrt((scan.ends_m**2).sum(axis=1)), np.nan)
    simulated = ranges.reshape(sensor.azimuths, sensor.channels).T

    assert scan.face is not None
    solids = np.array([kind for _, kind in world.solids])
    met = solids[world.solid_of_face[np.maximum(scan.face, 0)]] == "ground"
    is_ground = (met & scan.returned).reshape(sensor.azimuths, sensor.channels).T

    order = fit.angles.ascending
    # From the origin of the frame, as simulated beams, not from the optics.
    measured = np.linalg.norm(empty_scan.points_of(sweep.range_m, fit.angles), axis=-1)[order]
    with np.errstate(invalid="ignore"):
        tolerance_m = 2.0 * empty_scan.tolerance_m(background.range_m)
        in_front = sweep.range_m < background.range_m - tolerance_m
    far = (measured > WORLD_M) | (simulated > WORLD_M)
    azimuth_deg = np.mod(fit.angles.azimuth_deg()[order], 360.0)
    return Comparison(
        fit=fit,
        measured_m=measured,
        simulated_m=simulated,
        used=~in_front[order] & ~far & ~_in_sectors(azimuth_deg, fit.empty_sectors_deg),
        sector=np.floor(azimuth_deg / SECTOR_DEG).astype(np.int64),
        is_ground=is_ground,
        is_known=np.isfinite(background.range_m)[order],
        on_road=fit.plane_view.on_road[order],
        road_range_m=fit.plane_view.range_m[order],
    )


def _in_sectors(azimuth_deg: FloatArray, sectors_deg: list[tuple[float, float]]) -> NDArray[np.bool_]:
    """Return which azimuths are in the sectors that the unit's mast or a wall hides."""
    inside = np.zeros(azimuth_deg.shape, dtype=bool)
    for first_deg, last_deg in sectors_deg:
        inside |= np.mod(azimuth_deg - first_deg, 360.0) <= last_deg - first_deg
    return inside


@dataclass(frozen=True)
class Ratio:
    """Simulated to measured, with a 95 % interval; NaN if nothing was measured."""

    measured: float
    simulated: float
    low: float
    high: float

    def row(self, name: str, form: str = ",.0f") -> str:
        """A row of a table."""
        if not self.measured:
            return f"| {name} | {self.measured:{form}} | {self.simulated:{form}} | |"
        ratio = self.simulated / self.measured
        return (
            f"| {name} | {self.measured:{form}} | {self.simulated:{form}} | {ratio:.2f} "
            f"({self.low:.2f} to {self.high:.2f}) |"
        )


def ratio(
    comparison: Comparison, value: Callable[[FloatArray, NDArray[np.bool_]], float], pulses: NDArray[np.bool_]
) -> Ratio:
    """Return the ratio of a value of ranges, with a jackknife over sectors of azimuth.

    Parameters
    ----------
    comparison
        The pulses.
    value
        Computes the value from ranges and the pulses that count.
    pulses
        Which pulses count.
    """
    measured = value(comparison.measured_m, pulses)
    simulated = value(comparison.simulated_m, pulses)
    if not measured:
        return Ratio(measured, simulated, np.nan, np.nan)
    left_out = []
    for sector in np.unique(comparison.sector[pulses]):
        rest = pulses & (comparison.sector != sector)
        below = value(comparison.measured_m, rest)
        if below:
            left_out.append(value(comparison.simulated_m, rest) / below)
    k = len(left_out)
    if k < 3:
        return Ratio(measured, simulated, np.nan, np.nan)
    se = np.sqrt((k - 1) / k * ((np.array(left_out) - np.mean(left_out)) ** 2).sum())
    half = float(t.ppf(0.975, k - 1) * se)
    return Ratio(measured, simulated, simulated / measured - half, simulated / measured + half)


def returns(ranges_m: FloatArray, pulses: NDArray[np.bool_]) -> float:
    """Count the returns."""
    return float(np.count_nonzero(np.isfinite(ranges_m) & pulses))


def report(comparison: Comparison) -> str:
    """Return all comparisons as Markdown tables."""
    used = comparison.used
    elevation_deg = np.sort(comparison.fit.angles.elevation_deg)[:, None]
    head = "| {} | measured | simulated | ratio (95 % interval) |\n|---|---|---|---|"
    lines = [head.format("returns by elevation of the channel"), ratio(comparison, returns, used).row("all")]
    for low, high in pairwise(ELEVATIONS_DEG):
        members = used & (elevation_deg >= low) & (elevation_deg < high)
        lines.append(ratio(comparison, returns, members).row(f"{low:g}° to {high:g}°"))

    lines += ["", head.format("returns by range")]
    for low, high in pairwise(RANGES_M):

        def returns_between(
            ranges_m: FloatArray, pulses: NDArray[np.bool_], low: float = low, high: float = high
        ) -> float:
            with np.errstate(invalid="ignore"):
                return float(np.count_nonzero((ranges_m >= low) & (ranges_m < high) & pulses))

        lines.append(ratio(comparison, returns_between, used).row(f"{low:g} to {high:g} m"))

    lines += ["", head.format("share of pulses towards the road that return, by range of the plane")]
    for low, high in ((10, 20), (20, 30), (30, 40), (40, 50), (50, 60), (60, 80), (80, 120)):
        members = used & comparison.on_road & (comparison.road_range_m >= low) & (comparison.road_range_m < high)
        lines.append(ratio(comparison, _share, members).row(f"{low:g} to {high:g} m", ".1%"))

    lines += ["", _noise_table(comparison, head), "", _agreement(comparison)]
    return "\n".join(lines)


def _share(ranges_m: FloatArray, pulses: NDArray[np.bool_]) -> float:
    n = int(np.count_nonzero(pulses))
    return returns(ranges_m, pulses) / max(1, n)


def _noise_table(comparison: Comparison, head: str) -> str:
    """Noise of ranges on the road: measured, and simulated with the fitted noise and range step on a plane."""
    fit = comparison.fit
    sigma_m = 0.0 if fit.sigma_m is None else fit.sigma_m.value
    step_m = fit.range_step_m or 0.0
    rng = np.random.default_rng(0)
    noisy = comparison.simulated_m + sigma_m * rng.standard_normal(comparison.simulated_m.shape)
    if step_m:
        noisy = np.round(noisy / step_m) * step_m
    lines = [head.format("range noise on the road, mm")]
    height = np.cos(np.radians(fit.plane_view.incidence_deg[fit.angles.ascending]))
    for low, high in ((10.0, 25.0), (25.0, 40.0), (40.0, 70.0)):
        values = []
        for ranges_m in (comparison.measured_m, noisy):
            near = np.abs((comparison.road_range_m - ranges_m) * height) <= ROAD_BAND_M
            residuals = range_residuals([ranges_m], True, [comparison.on_road & comparison.used & near])
            members = (residuals.range_m >= low) & (residuals.range_m < high)
            values.append(estimate_scale(residuals.residual_m[members], VARIANCE_FACTOR, step_m))
        measured, simulated = values
        if measured is None or simulated is None:
            continue
        value = simulated.value / measured.value
        half = 1.96 * value * np.hypot(measured.se / measured.value, simulated.se / simulated.value)
        result = Ratio(1000 * measured.value, 1000 * simulated.value, value - half, value + half)
        lines.append(result.row(f"{low:g} to {high:g} m", ".1f"))
    return "\n".join(lines)


def _agreement(comparison: Comparison) -> str:
    """Say what share of the pulses agree: both or neither return, and where."""
    used = comparison.used
    measured, simulated = np.isfinite(comparison.measured_m[used]), np.isfinite(comparison.simulated_m[used])
    both = measured & simulated
    difference = np.abs(comparison.measured_m[used] - comparison.simulated_m[used])[both]
    only_measured, only_simulated = np.mean(measured & ~simulated), np.mean(~measured & simulated)
    return (
        f"Of {np.count_nonzero(used):,} pulses, {np.mean(both):.1%} return in both, "
        f"{np.mean(~measured & ~simulated):.1%} in neither, {only_measured:.1%} only in the measurement, "
        f"{only_simulated:.1%} only in the simulation. Of those that return in both, "
        f"{np.mean(difference <= AGREE_M):.1%} agree within {AGREE_M:g} m "
        f"(median difference {1000 * np.median(difference):.0f} mm).\n\n{_only_simulated(comparison)}"
    )


def _only_simulated(comparison: Comparison) -> str:
    """Say what the beams met that return only in the simulation."""
    only = comparison.used & np.isnan(comparison.measured_m) & np.isfinite(comparison.simulated_m)
    with np.errstate(invalid="ignore"):
        is_far = comparison.simulated_m > 50.0
    ground = comparison.is_ground
    shares = {
        "ground beyond 50 m": ground & is_far,
        "ground up to 50 m": ground & ~is_far,
        "anything else beyond 50 m": ~ground & is_far,
        "anything else up to 50 m": ~ground & ~is_far,
    }
    parts = ", ".join(f"{np.mean(members[only]):.0%} {name}" for name, members in shares.items())
    return (
        f"Of the {np.count_nonzero(only):,} pulses that return only in the simulation, the beam meets: {parts}. "
        f"{np.mean(~comparison.is_known[only]):.0%} have no background in the ten frames either."
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.measured_sweep", description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    given = parser.parse_args()
    print(report(compare(given.folder)))


if __name__ == "__main__":
    main()
