"""Scans whose pose is known: the yard of ``benchmarks.simulated_sweeps`` as a mesh, and rooms along the axes.

Scans are computed by solving for the range to each plane, meshes from the corners of these planes; nothing is shared
with the ray caster.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from benchmarks.simulated_sweeps import WALL_DISTANCES_M, WALL_HEIGHT_M, Truth, simulate_sweep

from egvs.core.grid import FloatArray
from egvs.sensors.sensor import Sensor, rotation_world_sensor
from egvs.sensors.sites import Pose
from egvs.world.mesh import World

YARD_TRUTH = Truth(sigma_m=0.02, lost=0.05)
"""Over the ground z = 0; the pose of the yard's sensor has its height, roll and pitch."""

YARD_POSE = Pose(12.0, -7.0, YARD_TRUTH.height_m, 33.0, YARD_TRUTH.pitch_deg, YARD_TRUTH.roll_deg)

_FAR_M = 200.0


def mesh_of(quads: Sequence[Sequence[FloatArray]], kinds: Sequence[str] | None = None) -> World:
    """Return a world of quadrilaterals, each of them a solid."""
    corners = np.concatenate([np.asarray(quad, dtype=np.float64) for quad in quads])
    first = 4 * np.arange(len(quads))
    faces = np.stack([np.stack([first, first + 1, first + 2], 1), np.stack([first, first + 2, first + 3], 1)], 1)
    names = tuple((f"surface{i}", kinds[i] if kinds else "building") for i in range(len(quads)))
    solid = np.repeat(np.arange(len(quads), dtype=np.int32), 2)
    return World(corners, faces.reshape(-1, 3).astype(np.int32), solid, names)


def yard(pose: Pose = YARD_POSE, without: Sequence[int] = ()) -> World:
    """Return the yard around a sensor at a pose, without some of its four walls."""
    rotation, position = rotation_world_sensor(*pose.angles_deg), np.array(pose.position_m)
    square = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    quads = [[np.array([pose.x_m + a * _FAR_M, pose.y_m + b * _FAR_M, 0.0]) for a, b in square]]
    for number, distance_m in enumerate(WALL_DISTANCES_M):
        if number in without:
            continue
        angle = np.radians(90.0 * number + 17.0)
        normal = np.array([np.cos(angle), np.sin(angle), 0.0])
        along = np.array([-normal[1], normal[0], 0.0])
        heights = (-40.0, -40.0, WALL_HEIGHT_M, WALL_HEIGHT_M)
        corners = zip((-1, 1, 1, -1), heights, strict=True)
        wall = [normal * distance_m + along * side * _FAR_M + np.array([0.0, 0.0, z]) for side, z in corners]
        quads.append([rotation @ corner + position for corner in wall])
    return mesh_of(quads)


def yard_scan(sensor: Sensor, seed: int = 0) -> FloatArray:
    """Return the returns of a sensor in the yard, in its frame, (n, 3)."""
    points = simulate_sweep(sensor, YARD_TRUTH, np.random.default_rng(seed))
    returned: FloatArray = points[np.isfinite(points[:, 0])]
    return returned


def room(x_m: tuple[float, float], y_m: tuple[float, float], top_m: float = 30.0) -> World:
    """Return a room along the axes on the ground z = 0; infinite walls are left out."""
    (x0, x1), (y0, y1) = np.clip(x_m, -_FAR_M, _FAR_M), np.clip(y_m, -_FAR_M, _FAR_M)
    ground = [np.array(corner) for corner in ((x0, y0, 0.0), (x1, y0, 0.0), (x1, y1, 0.0), (x0, y1, 0.0))]
    quads = [ground]
    for k, is_there in enumerate(np.isfinite((y_m[0], x_m[1], y_m[1], x_m[0]))):
        if is_there:
            a, b = ground[k], ground[(k + 1) % 4]
            up = np.array([0.0, 0.0, top_m])
            quads.append([a, b, b + up, a + up])
    return mesh_of(quads)


def room_scan(
    pose: Pose, x_m: tuple[float, float], y_m: tuple[float, float], sigma_m: float = 0.01, seed: int = 0
) -> FloatArray:
    """Return the returns of 16 channels and 360 azimuths in an endlessly high room, in the sensor's frame, (n, 3)."""
    elevation, azimuth = (
        values.ravel() for values in np.meshgrid(np.radians(np.linspace(-30, 10, 16)), np.radians(np.arange(360)))
    )
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    world_rays = rays @ rotation_world_sensor(*pose.angles_deg).T
    planes = [(axis, at) for axis, ends in enumerate((x_m, y_m, (0.0,))) for at in ends if np.isfinite(at)]
    with np.errstate(divide="ignore"):
        ranges = np.array([(at - pose.position_m[axis]) / world_rays[:, axis] for axis, at in planes])
    first = np.where(ranges > 0, ranges, np.inf).min(axis=0)
    first += sigma_m * np.random.default_rng(seed).standard_normal(len(first))
    near = first < 60.0
    points: FloatArray = rays[near] * first[near, None]
    return points
