"""Sweeps of a sensor whose angles, noise and losses are known, in a yard with a tilted ground and four walls.

Nothing is shared with ``egvs.extensions.hardware.fit``: surfaces are planes, met by solving for the range of each ray.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from egvs.sensors.sensor import Sensor

WALL_DISTANCES_M = (14.0, 33.0, 21.0, 52.0)
WALL_HEIGHT_M = 25.0


@dataclass(frozen=True)
class Truth:
    """What is simulated.

    Attributes
    ----------
    sigma_m
        Standard deviation of the range.
    lost
        Probability that a return is lost.
    height_m, roll_deg, pitch_deg
        Pose over the ground.
    axis_distance_m
        Distance of the optics from the axis of rotation.
    step_m
        Ranges are rounded to multiples of it; 0 for none.
    pointing_deg
        Standard deviation of the elevation and azimuth of a pulse around those of its channel.
    """

    sigma_m: float = 0.02
    lost: float = 0.05
    height_m: float = 4.0
    roll_deg: float = 0.8
    pitch_deg: float = -1.5
    axis_distance_m: float = 0.0
    step_m: float = 0.0
    pointing_deg: float = 0.0


def simulate_sweep(sensor: Sensor, truth: Truth, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a sweep in the sensor's frame, (azimuths * channels, 3), channel fastest, NaN without a return."""
    azimuths = np.arange(sensor.azimuths) * (sensor.azimuth_step_deg or 0.0)
    if sensor.azimuth_deg is not None:
        azimuths = azimuths + sensor.azimuth_deg[0]
    azimuth = np.radians(azimuths[:, None] + np.array(sensor.azimuth_offsets_deg))
    elevation = np.radians(np.array(sensor.elevations_deg))[None, :] + 0.0 * azimuth
    if truth.pointing_deg:
        azimuth = azimuth + np.radians(truth.pointing_deg) * rng.standard_normal(azimuth.shape)
        elevation = elevation + np.radians(truth.pointing_deg) * rng.standard_normal(elevation.shape)
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    origins = truth.axis_distance_m * np.stack([np.cos(azimuth), np.sin(azimuth), 0.0 * azimuth], axis=-1)

    roll, pitch = np.radians(truth.roll_deg), np.radians(truth.pitch_deg)
    up = np.array([np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])
    ranges = _to_plane(rays, origins, up, -truth.height_m)
    for number, distance_m in enumerate(WALL_DISTANCES_M):
        direction = np.radians(90.0 * number + 17.0)
        normal = np.array([np.cos(direction), np.sin(direction), 0.0])
        to_wall = _to_plane(rays, origins, normal, distance_m)
        heights = np.where(np.isfinite(to_wall), to_wall, 0.0) * rays[..., 2]
        ranges = np.minimum(ranges, np.where(heights < WALL_HEIGHT_M, to_wall, np.inf))

    lost = rng.random(ranges.shape) < truth.lost
    measured = ranges + truth.sigma_m * rng.standard_normal(ranges.shape)
    if truth.step_m:
        measured = np.round(measured / truth.step_m) * truth.step_m
    measured[lost | (ranges > sensor.range_m)] = np.nan
    points: NDArray[np.float64] = (origins + measured[..., None] * rays).reshape(-1, 3)
    return points


def _to_plane(
    rays: NDArray[np.float64], origins: NDArray[np.float64], normal: NDArray[np.float64], distance_m: float
) -> NDArray[np.float64]:
    """Return the range at which rays meet the plane normal . p = distance; infinite behind the origin."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = (distance_m - origins @ normal) / (rays @ normal)
    result: NDArray[np.float64] = np.where(ranges > 0, ranges, np.inf)
    return result
