"""A small sensor whose sweeps are quick to simulate and to fit."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from benchmarks.simulated_sweeps import Truth, simulate_sweep

from egvs.core.grid import FloatArray
from egvs.extensions.hardware.fit.fit import SensorFit, fit_sensor
from egvs.extensions.hardware.fit.sweep_files import Sweep
from egvs.sensors.sensor import Sensor

ELEVATIONS_DEG = (-25.0, 3.0, -16.5, 1.0, -12.0, -9.0, -6.75, -5.0, -3.5, -1.25)
OFFSETS_DEG = (1.0, -0.13, 0.0, 0.31, 2.0, 0.0, -1.7, 0.05, 0.0, 0.22)


def small_sensor(azimuth_deg: tuple[float, float] | None = None) -> Sensor:
    """Ten channels out of order, 900 azimuths; or a field of view, 0.4 degrees apart."""
    azimuths = 900 if azimuth_deg is None else round((azimuth_deg[1] - azimuth_deg[0]) / 0.4) + 1
    return Sensor("small", ELEVATIONS_DEG, OFFSETS_DEG, azimuths, 120.0, "test", azimuth_deg=azimuth_deg)


def coarse_sensor() -> Sensor:
    """The same channels with 300 azimuths."""
    return replace(small_sensor(), azimuths=300)


def sweep_of(truth: Truth, sensor: Sensor | None = None, seed: int = 0) -> FloatArray:
    """Return an organised sweep, channel fastest, with float32 coordinates."""
    points = simulate_sweep(sensor or small_sensor(), truth, np.random.default_rng(seed))
    return points.astype(np.float32).astype(np.float64)


@cache
def small_fit() -> SensorFit:
    """The fit of one sweep of the small sensor, with optics 30 mm off the axis and ranges in steps of 4 mm."""
    return fit_sensor([Sweep("one", sweep_of(TRUTH))])


TRUTH = Truth(sigma_m=0.02, lost=0.05, axis_distance_m=0.03, step_m=0.004)
