"""Poses of sensors in the conventions of other programs, as JSON.

The world frame is right-handed: x east, y north, z up, metres. A sensor's frame is right-handed: x along its front, y
to its left, z up. ``T_world_sensor`` is the 4 x 4 matrix, written by rows, that takes column vectors (x, y, z, 1) from
the sensor's frame to the world frame.

glTF 2.0 (https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, 3.4) is right-handed with y up. A position in the
world frame becomes (x, z, -y): :data:`R_GLTF_WORLD`.

CARLA and the Unreal Engine are left-handed: x as here, y reversed, z up; angles in degrees, yaw clockwise seen from
above, pitch positive with the nose up. With :math:`F = diag(1, -1, 1)` the rotation is :math:`F R F`, and the angles
become (pitch, -yaw, roll): the matrix that CARLA makes of its angles (``carla::geom::Transform::GetMatrix``) is then
the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from egvs.core.grid import FloatArray
from egvs.export.finished_run import ExportCrs
from egvs.sensors.sensor import rotation_world_sensor
from egvs.sensors.sites import Pose, grid_bearing_deg

Matrix = FloatArray

R_GLTF_WORLD: Matrix = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""From the world frame (z up) to glTF's frame (y up): (x, y, z) becomes (x, z, -y)."""

_FLIP_Y = np.diag([1.0, -1.0, 1.0])

FRAMES = {
    "world": "right-handed; x east, y north, z up; metres",
    "sensor": "right-handed; x along the sensor's front, y to its left, z up; metres",
    "scene": "the world frame minus scene_origin_m; the frame of the nodes below egvs_world_z_up in scene.glb, and of"
    " /World in scene.usdc",
    "gltf": "right-handed; x east, y up, z south; metres: (x, z, -y) of the scene frame",
    "carla": "left-handed; x east, y south, z up; metres",
}

CONVENTIONS = {
    "matrices": "4 x 4, by rows, for column vectors: p_world = T_world_sensor * p_sensor",
    "quaternions": "unit, of the rotation from sensor to world; wxyz has the scalar first, xyzw has it last",
    "angles": "yaw counter-clockwise from east, pitch nose up positive, roll about the front; roll first, then pitch,"
    " then yaw; degrees",
    "bearing_deg": "of the sensor's front, clockwise from grid north",
}

USAGE = {
    "open3d": "cloud.transform(T_world_sensor) moves a cloud from the sensor's frame to the world frame. Cameras of"
    " Open3D use the inverse, T_sensor_world.",
    "cloudcompare": "Edit > Apply transformation, tab Matrix 4x4: paste the lines of cloudcompare_matrix.",
    "isaac_sim": "Stage with z up and metres: set translate to position_m and orient to quaternion_wxyz (scalar first)."
    " The sensor's x axis is its front, as that of LiDARs in Isaac Sim.",
    "carla": "carla.Transform(carla.Location(**carla.location), carla.Rotation(**carla.rotation)). Its points come in"
    " the left-handed frame of the sensor: reverse y before you use T_world_sensor. The map of CARLA must have the"
    " origin of the world frame.",
    "gltf": "T_gltf_sensor is the global matrix of the sensor's node in scene.glb.",
}


@dataclass(frozen=True)
class PosedSensor:
    """A sensor at a site.

    Attributes
    ----------
    site, sensor
        Names.
    pose
        World frame.
    rank
        Rank of the site in the run.
    """

    site: str
    sensor: str
    pose: Pose
    rank: int


def transform_world_sensor(pose: Pose) -> Matrix:
    """Return T_world_sensor, (4, 4) float64.

    >>> front = transform_world_sensor(Pose(1.0, 2.0, 3.0, yaw_deg=90.0)) @ [1.0, 0.0, 0.0, 1.0]
    >>> front.tolist()
    [1.0, 3.0, 3.0, 1.0]
    """
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_world_sensor(*pose.angles_deg)
    matrix[:3, 3] = pose.position_m
    return matrix


def quaternion_wxyz(rotation: Matrix) -> Matrix:
    """Return the unit quaternion of a rotation matrix (3, 3), scalar first and not negative, shape (4,)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return np.array([w, x, y, z])


def carla_transform(pose: Pose) -> dict[str, dict[str, float]]:
    """Return location and rotation of a pose as CARLA names them; metres and degrees.

    >>> carla_transform(Pose(1.0, 2.0, 3.0, yaw_deg=90.0, pitch_deg=-10.0))["rotation"]
    {'pitch': -10.0, 'yaw': -90.0, 'roll': 0.0}
    """
    return {
        "location": {"x": pose.x_m, "y": 0.0 - pose.y_m, "z": pose.z_m},
        "rotation": {"pitch": pose.pitch_deg, "yaw": 0.0 - pose.yaw_deg, "roll": pose.roll_deg},
    }


def transform_carla_sensor(pose: Pose) -> Matrix:
    """Return the matrix from the left-handed frame of the sensor to CARLA's world frame, (4, 4) float64."""
    matrix = np.eye(4)
    matrix[:3, :3] = _FLIP_Y @ rotation_world_sensor(*pose.angles_deg) @ _FLIP_Y
    matrix[:3, 3] = _FLIP_Y @ np.asarray(pose.position_m)
    return matrix


def transform_gltf_sensor(pose: Pose, origin_m: Matrix) -> Matrix:
    """Return the matrix from the sensor's frame to glTF's frame, (4, 4) float64.

    Parameters
    ----------
    pose
        World frame.
    origin_m
        Origin of the scene in the world frame, (3,).
    """
    matrix = transform_world_sensor(pose)
    matrix[:3, 3] -= origin_m
    to_gltf = np.eye(4)
    to_gltf[:3, :3] = R_GLTF_WORLD
    return to_gltf @ matrix


def extrinsics_document(
    scenario: str, sensors: Sequence[PosedSensor], origin_m: Matrix, reference: ExportCrs
) -> dict[str, Any]:
    """Return the JSON document.

    Parameters
    ----------
    scenario
        Name of the scenario.
    sensors
        The sensors.
    origin_m
        Origin of the scene files in the world frame, (3,).
    reference
        The reference system.
    """
    world: dict[str, Any] = {"reference_system": reference.description, "crs": None, "offset_m": None}
    if reference.frame is not None:
        world["crs"] = reference.crs
        world["offset_m"] = list(reference.frame.offset_m)
        world["position"] = "x = easting + offset_m[0], y = northing + offset_m[1]"
    return {
        "schema": 1,
        "scenario": scenario,
        "units": {"length": "m", "angle": "degree"},
        "frames": FRAMES,
        "conventions": CONVENTIONS,
        "use": USAGE,
        "world_frame": world,
        "scene_origin_m": origin_m.tolist(),
        "sensors": [_sensor_entry(sensor, origin_m, reference) for sensor in sensors],
    }


def _sensor_entry(sensor: PosedSensor, origin_m: Matrix, reference: ExportCrs) -> dict[str, Any]:
    pose = sensor.pose
    matrix = _without_negative_zero(transform_world_sensor(pose))
    inverse = np.eye(4)
    inverse[:3, :3] = matrix[:3, :3].T
    inverse[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    w, x, y, z = _without_negative_zero(quaternion_wxyz(matrix[:3, :3])).tolist()
    entry: dict[str, Any] = {
        "site": sensor.site,
        "sensor": sensor.sensor,
        "rank": sensor.rank,
        "position_m": list(pose.position_m),
        "yaw_deg": pose.yaw_deg,
        "pitch_deg": pose.pitch_deg,
        "roll_deg": pose.roll_deg,
        "bearing_deg": grid_bearing_deg(pose.yaw_deg),
        "T_world_sensor": matrix.tolist(),
        "T_sensor_world": _without_negative_zero(inverse).tolist(),
        "quaternion_wxyz": [w, x, y, z],
        "quaternion_xyzw": [x, y, z, w],
        "T_gltf_sensor": _without_negative_zero(transform_gltf_sensor(pose, origin_m)).tolist(),
        "carla": carla_transform(pose),
        "T_carla_sensor": _without_negative_zero(transform_carla_sensor(pose)).tolist(),
        "cloudcompare_matrix": [" ".join(f"{value:.12g}" for value in row) for row in matrix.tolist()],
    }
    if reference.frame is not None:
        easting_m, northing_m = reference.from_world(np.array([[pose.x_m, pose.y_m]]))[0].tolist()
        entry["easting_m"], entry["northing_m"] = easting_m, northing_m
    return entry


def _without_negative_zero(matrix: Matrix) -> Matrix:
    return matrix + 0.0
