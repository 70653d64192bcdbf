"""A small sensor whose sweeps are quick to simulate and to fit."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from benchmarks.simulated_sweeps import Truth, simulate_sweep

from egvs.core.grid import FloatArray, IntArray
from egvs.extensions.hardware.fit.fit import SensorFit, fit_sensor
from egvs.formats.sweep_files import Sweep
from egvs.sensors.sensor import Sensor

ELEVATIONS_DEG = (-25.0, 3.0, -16.5, 1.0, -12.0, -9.0, -6.75, -5.0, -3.5, -1.25)
OFFSETS_DEG = (1.0, -0.13, 0.0, 0.31, 2.0, 0.0, -1.7, 0.05, 0.0, 0.22)


def small_sensor(azimuth_deg: tuple[float, float] | None = None) -> Sensor:
    """Ten channels out of order, 900 azimuths; or a field of view, 0.4 degrees apart."""
    azimuths = 900 if azimuth_deg is None else round((azimuth_deg[1] - azimuth_deg[0]) / 0.4) + 1
    return Sensor("small", ELEVATIONS_DEG, OFFSETS_DEG, azimuths, 120.0, "test", azimuth_deg=azimuth_deg)


def returns_of(points: FloatArray) -> FloatArray:
    """Return the points without missing returns."""
    return points[np.isfinite(points[:, 0])]


def coarse_sensor() -> Sensor:
    """The same channels with 300 azimuths."""
    return replace(small_sensor(), azimuths=300)


def sweep_of(truth: Truth, sensor: Sensor | None = None, seed: int = 0) -> FloatArray:
    """Return an organised sweep, channel fastest, with float32 coordinates."""
    points = simulate_sweep(sensor or small_sensor(), truth, np.random.default_rng(seed))
    return points.astype(np.float32).astype(np.float64)


OUSTER_ELEVATIONS_DEG = tuple(np.round(np.linspace(-0.5, -21.3, 40), 2).tolist())
OUSTER_FRAME_M, OUSTER_AXIS_M = 0.03618, 0.0158
"""Height of the optics above the origin of the driver's frame, and their distance from the axis."""


def ouster_sensor() -> Sensor:
    """40 channels below the horizon, half a degree apart, 512 azimuths."""
    offsets_deg = tuple((3.1, 1.0, -1.1, -3.2)[number % 4] for number in range(len(OUSTER_ELEVATIONS_DEG)))
    return Sensor("ouster", OUSTER_ELEVATIONS_DEG, offsets_deg, 512, 120.0, "test")


def ouster_sweep() -> tuple[FloatArray, IntArray]:
    """Return a sweep whose rays leave off the axis, (n, 3), and the channel of each slot: channel fastest.

    Over 120 degrees of azimuth something stands 1.1 m away, where the elevation from the frame's origin is 2 degrees
    above that of the beam.
    """
    sensor = ouster_sensor()
    points = simulate_sweep(sensor, Truth(axis_distance_m=OUSTER_AXIS_M), np.random.default_rng(0))
    channel = np.tile(np.arange(sensor.channels), sensor.azimuths)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    elevation = np.radians(np.array(OUSTER_ELEVATIONS_DEG))[channel]
    is_near = np.isfinite(azimuth) & (np.abs(azimuth) < np.radians(60.0))
    radius_m = OUSTER_AXIS_M + 1.1 * np.cos(elevation)
    near = np.stack([radius_m * np.cos(azimuth), radius_m * np.sin(azimuth), 1.1 * np.sin(elevation)], axis=-1)
    points = np.where(is_near[:, None], near, points) + np.array([0.0, 0.0, OUSTER_FRAME_M])
    return points.astype(np.float32).astype(np.float64), channel


@cache
def small_fit() -> SensorFit:
    """The fit of one sweep of the small sensor, with optics 30 mm off the axis and ranges in steps of 4 mm."""
    return fit_sensor([Sweep("one", sweep_of(TRUTH))])


TRUTH = Truth(sigma_m=0.02, lost=0.05, axis_distance_m=0.03, step_m=0.004)
