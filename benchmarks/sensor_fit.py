"""Does ``egvs sensor fit`` find the sensor that made a sweep, and do its 95 % intervals contain the true values?

Usage: ``python -m benchmarks.sensor_fit angles`` and ``python -m benchmarks.sensor_fit intervals [--trials N]``. Both
print a Markdown table. Sweeps are those of :mod:`benchmarks.simulated_sweeps`, as lists of returns in random order with
float32 coordinates: the case with least help.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from benchmarks.simulated_sweeps import Truth, simulate_sweep
from egvs.core.wording import format_percent
from egvs.extensions.hardware.fit.fit import SensorFit, fit_sensor
from egvs.formats.sweep_files import Sweep
from egvs.sensors.sensor import CATALOGUE, Sensor
from egvs.statistics.intervals import Estimate

SENSORS = ("VLP-16", "VLP-32C", "AT128", "Pandar128", "OS1-64", "RS-Ruby Plus")
RANGE_STEPS_M = (0.0, 0.002, 0.004)


@dataclass(frozen=True)
class AngleErrors:
    """Largest errors over channels, and of the pose.

    Attributes
    ----------
    elevation_deg, offset_mm, azimuth_deg
        Largest errors of elevation, vertical offset, and azimuth offset modulo one step.
    height_m, tilt_deg
        Errors of height, and of the larger of roll and pitch.
    """

    elevation_deg: float
    offset_mm: float
    azimuth_deg: float
    height_m: float
    tilt_deg: float


def fit_list(points_m: np.ndarray, rng: np.random.Generator) -> SensorFit:
    """Fit a sensor to the returns of a sweep in random order, with float32 coordinates."""
    returns = rng.permutation(points_m[np.isfinite(points_m[:, 0])])
    return fit_sensor([Sweep("simulated", returns.astype(np.float32).astype(np.float64))])


def angle_errors(sensor: Sensor, truth: Truth, fit: SensorFit) -> AngleErrors:
    """Compare fitted with true angles; raises ValueError if the number of channels or azimuths is wrong."""
    angles = fit.angles
    if angles.channels != sensor.channels or angles.azimuths != sensor.azimuths:
        raise ValueError(f"{angles.channels} channels x {angles.azimuths}, not {sensor.channels} x {sensor.azimuths}")
    order = np.argsort(sensor.elevations_deg, kind="stable")
    elevation_deg = np.array(sensor.elevations_deg)[order]
    fitted = angles.ascending
    first_deg = 0.0 if sensor.azimuth_deg is None else sensor.azimuth_deg[0]
    azimuth_deg = np.array(sensor.azimuth_offsets_deg)[order] + first_deg
    step_deg = angles.grid_step_deg
    turned = angles.azimuth_offset_deg[fitted] + angles.first_azimuth_deg - azimuth_deg
    offset_m = -truth.axis_distance_m * np.tan(np.radians(elevation_deg))
    tilt = (fit.plane.roll_deg - truth.roll_deg, fit.plane.pitch_deg - truth.pitch_deg)
    return AngleErrors(
        float(np.abs(angles.elevation_deg[fitted] - elevation_deg).max()),
        1000 * float(np.abs(angles.offset_m[fitted] - offset_m).max()),
        float(np.abs(np.mod(turned + step_deg / 2, step_deg) - step_deg / 2).max()),
        fit.plane.height_m - truth.height_m,
        max(tilt, key=abs),
    )


def hard_truth(sensor: Sensor) -> Truth:
    """A sensor with optics 30 mm off the axis, pulses that scatter by 0.01 degrees, losses, noise and range steps."""
    return Truth(sigma_m=sensor.range_sigma_m, lost=0.05, axis_distance_m=0.03, step_m=0.004, pointing_deg=0.01)


def angles_table(names: Iterable[str] = SENSORS, seed: int = 1) -> str:
    """Fit sweeps of sensors of the catalogue, and return the errors as a table."""
    rows = ["| sensor | elevation | vertical offset | azimuth | height | roll, pitch |", "|---|---|---|---|---|---|"]
    for name in names:
        sensor = CATALOGUE[name]
        rng = np.random.default_rng(seed)
        truth = hard_truth(sensor)
        errors = angle_errors(sensor, truth, fit_list(simulate_sweep(sensor, truth, rng), rng))
        rows.append(
            f"| {name} | {errors.elevation_deg:.5f}° | {errors.offset_mm:.3f} mm | {errors.azimuth_deg:.5f}° "
            f"| {1000 * errors.height_m:+.1f} mm | {errors.tilt_deg:+.4f}° |"
        )
    return "\n".join(rows)


def interval_hits(trials: int, seed: int = 0, sensor_name: str = "VLP-16") -> dict[str, list[bool]]:
    """Return for each interval of each trial whether it contains the true value, by what it is of.

    Range noise (4 to 40 mm), losses (1 to 25 %), range step and pose are drawn anew in each trial.
    """
    sensor = CATALOGUE[sensor_name]
    hits: dict[str, list[bool]] = defaultdict(list)
    for trial in range(trials):
        rng = np.random.default_rng([seed, trial])
        truth = Truth(
            sigma_m=float(rng.uniform(0.004, 0.04)),
            lost=float(rng.uniform(0.01, 0.25)),
            height_m=float(rng.uniform(3.0, 6.0)),
            roll_deg=float(rng.uniform(-3.0, 3.0)),
            pitch_deg=float(rng.uniform(-3.0, 3.0)),
            axis_distance_m=float(rng.uniform(0.0, 0.04)),
            step_m=float(rng.choice(RANGE_STEPS_M)),
        )
        fit = fit_list(simulate_sweep(sensor, truth, rng), rng)
        kept = 1.0 - truth.lost
        _note(hits, "range noise, 5 to 25 m", fit.sigma_m, truth.sigma_m)
        for noise in fit.noise:
            _note(hits, "range noise, by range", noise.sigma_m, truth.sigma_m)
        for sigma in fit.noise_by_channel:
            _note(hits, "range noise, by channel", sigma, truth.sigma_m)
        _note(hits, "return rate, smooth surfaces", fit.return_rate, kept)
        for rate in fit.return_rates:
            _note(hits, "return rate, by range and incidence", rate.rate, kept)
        for rate in fit.road_rates:
            _note(hits, "return rate, road by range", rate.rate, kept)
    return hits


def _note(hits: dict[str, list[bool]], what: str, estimate: Estimate | None, truth: float) -> None:
    if estimate is not None:
        hits[what].append(estimate.low <= truth <= estimate.high)


def intervals_table(hits: dict[str, list[bool]]) -> str:
    """Return the share of intervals that contain the true value, as a table."""
    rows = ["| interval of | intervals | contain the true value |", "|---|---|---|"]
    for what, values in hits.items():
        rows.append(f"| {what} | {len(values):,} | {format_percent(float(np.mean(values)))} |")
    return "\n".join(rows)


def main() -> None:
    """Run one of the two parts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=("angles", "intervals"))
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.part == "angles":
        print(angles_table())
    else:
        print(intervals_table(interval_hits(options.trials, options.seed)))


if __name__ == "__main__":
    main()
