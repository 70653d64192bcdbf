"""Scans of a sensor that is not where it was planned: range noise, lost returns, vehicles, a pole in front of it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from egvs.core.grid import FloatArray
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor, rotation_world_sensor
from egvs.sensors.sites import Pose
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster
from egvs.world.supports import without_solids

_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_FACES = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ],
    dtype=np.int32,
)  # fmt: skip


def box(center_m: Iterable[float], size_m: Iterable[float], yaw_rad: float = 0.0) -> FloatArray:
    """Return the triangles of an upright box, (12, 3, 3), world frame."""
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    corners: FloatArray = np.asarray(tuple(center_m)) + (_CORNERS * np.asarray(tuple(size_m))) @ turn.T
    return corners[_FACES]


def simulate_scan(
    scene: Scene,
    sensor: Sensor,
    planned: Pose,
    actual: Pose,
    *,
    boxes: Iterable[FloatArray] = (),
    sigma_m: float = 0.0,
    lost: float = 0.0,
    seed: int = 0,
) -> FloatArray:
    """Return the returns in the sensor's frame, (n, 3), of a sensor at ``actual``.

    ``boxes`` stand in its way besides the static world; what carries the planned sensor does not.
    """
    supports = scene.own_supports(planned)
    world = without_solids(scene.world, supports) if supports else scene.world
    triangles = list(boxes)
    if triangles:
        world = with_triangles(world, np.concatenate(triangles))
    directions = sensor.directions()
    rotation = rotation_world_sensor(*actual.angles_deg)
    scan = Caster(world, scene.roi).sweep(
        actual.position_m, np.ascontiguousarray(directions @ rotation.T), sensor.range_m
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    range_m = np.linalg.norm(scan.ends_m, axis=1) + rng.normal(0.0, sigma_m, len(directions))
    keep: NDArray[np.bool_] = scan.returned & (rng.random(len(directions)) >= lost)
    points: FloatArray = (directions * range_m[:, None])[keep]
    return points


def without_elevation(points_m: FloatArray, elevation_deg: float) -> FloatArray:
    """Return a scan without the returns of the channel at an elevation."""
    elevations = np.degrees(np.arcsin(points_m[:, 2] / np.linalg.norm(points_m, axis=1)))
    remaining: FloatArray = points_m[np.abs(elevations - elevation_deg) > 0.01]
    return remaining


def with_triangles(world: World, triangles: FloatArray) -> World:
    """Return the world with one more solid."""
    vertices = np.concatenate([world.vertices_m, triangles.reshape(-1, 3)])
    n = len(world.vertices_m)
    faces = np.concatenate([world.faces, n + np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3)])
    solid = np.concatenate([world.solid_of_face, np.full(len(triangles), len(world.solids), dtype=np.int32)])
    return World(vertices, faces.astype(np.int32), solid.astype(np.int32), (*world.solids, ("added", "obstacle")))
