r"""Read the pose of an installed sensor from a calibration file, and hold its ground plane against it.

Sweeps alone give height, roll and pitch over a plane. Yaw and position in a map follow from a static world
(:mod:`egvs.extensions.hardware.fit.map_pose`), or from a calibration that somebody else made. Such a file is JSON with
a rigid transformation from the sensor's frame into another one,

.. math:: p_\mathrm{map} = R\, p_\mathrm{sensor} + t,

as a 4 x 4 matrix, the value of the only key ``transformation_matrix_into_FRAME`` (the TUM Traffic data sets) or the
whole file; or as ``rotation`` (3 x 3) and ``translation`` (3; DAIR-V2X).

A calibration is not made from the road, so the two disagree where the road slopes, or where the origin of the map is
not on it. Both differences are stated; none of the two is corrected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.reading import read_json
from egvs.sensors.ground_plane import GroundPlane
from egvs.sensors.sites import Pose

_PREFIX = "transformation_matrix_into_"
_TOLERANCE = 1e-3
"""Largest deviation of the rotation from an orthonormal matrix: files are often written with few digits."""
_MAX_POSITION_M = 1e8
_HINT = 'Give a 4 x 4 matrix in metres, as in {"transformation_matrix_into_map": [[1, 0, 0, 5], ...]}.'


@dataclass(frozen=True)
class CalibratedPose:
    """Pose of a sensor by a calibration file.

    Attributes
    ----------
    file, frame
        The file, and the frame that it leads to; ``"map"`` if it has no name.
    pose
        Position and angles in this frame.
    ground_z_m
        Height of the ground plane below the sensor in this frame.
    ground_tilt_deg
        Angle between the ground plane and the horizontal of this frame.
    """

    file: str
    frame: str
    pose: Pose
    ground_z_m: float
    ground_tilt_deg: float


def read_calibrated_pose(path: Path, plane: GroundPlane) -> CalibratedPose:
    """Return the pose of a sensor by a calibration file, and where its ground plane is in that frame.

    Parameters
    ----------
    path
        A JSON file.
    plane
        The ground plane below the sensor.

    Raises
    ------
    InputError
        If the file is no JSON, or holds no rigid transformation.
    """
    rotation, position_m, frame = _read_transformation(path)
    up = rotation[2]  # the map's z axis in the sensor's frame
    cosine = float(np.clip(plane.normal @ up, -1.0, 1.0))
    if cosine <= 0.0:
        problem = "expected a pose above the ground plane, got one below it"
        raise InputError(path, problem, "Give the transformation from the sensor's frame into the map, z upwards.")
    x_m, y_m, z_m = position_m.tolist()
    pose = Pose(
        x_m,
        y_m,
        z_m,
        yaw_deg=math.degrees(math.atan2(rotation[1, 0], rotation[0, 0])),
        pitch_deg=math.degrees(math.asin(np.clip(rotation[2, 0], -1.0, 1.0))),
        roll_deg=math.degrees(math.atan2(rotation[2, 1], rotation[2, 2])),
    )
    return CalibratedPose(path.name, frame, pose, pose.z_m - plane.height_m / cosine, math.degrees(math.acos(cosine)))


def _read_transformation(path: Path) -> tuple[FloatArray, FloatArray, str]:
    """Return the rotation (3, 3), the translation (3,), and the name of the frame."""
    values = read_json(path, _HINT)
    if isinstance(values, dict) and {"rotation", "translation"} <= set(values):
        rotation = _numbers(path, "rotation", values["rotation"], (3, 3))
        position_m = _numbers(path, "translation", np.ravel(_floats(values["translation"])), (3,))
        frame = "map"
    else:
        key, frame, matrix = "", "map", values
        if isinstance(values, dict):
            names = [name for name in values if name.startswith(_PREFIX)]
            if len(names) != 1:
                raise InputError(path, f"expected one key {_PREFIX}FRAME, got {len(names)}", _HINT)
            key, frame, matrix = names[0], names[0].removeprefix(_PREFIX), values[names[0]]
        transformation = _numbers(path, key, matrix, (4, 4))
        if np.abs(transformation[3] - (0.0, 0.0, 0.0, 1.0)).max() > _TOLERANCE:
            raise InputError(path, f"expected 0, 0, 0, 1 in the last row, got {transformation[3].tolist()}", _HINT)
        rotation, position_m = transformation[:3, :3], transformation[:3, 3]
    is_small = bool(np.abs(rotation).max() <= 2.0)  # else products may overflow
    if not (is_small and np.allclose(rotation @ rotation.T, np.eye(3), rtol=0.0, atol=_TOLERANCE)) or (
        np.linalg.det(rotation) < 0
    ):
        raise InputError(path, "expected a rotation (orthonormal, no mirror), got another matrix", _HINT)
    if np.abs(position_m).max() > _MAX_POSITION_M:
        raise InputError(path, f"expected a position within {_MAX_POSITION_M:g} m, got {position_m.tolist()}", _HINT)
    return rotation, position_m, frame


def _numbers(path: Path, key: str, value: Any, shape: tuple[int, ...]) -> FloatArray:
    where = f"{path}: {key}" if key else path
    array = _floats(value)
    if array.shape != shape or not np.isfinite(array).all():
        size = " x ".join(map(str, shape))
        raise InputError(where, f"expected {size} finite numbers, got another value", _HINT)
    return array


def _floats(value: Any) -> FloatArray:
    """Return nested lists of numbers as an array; empty if they are something else."""
    try:
        array = np.array(value)
    except ValueError:  # rows of different lengths
        return np.empty(0)
    return array.astype(np.float64) if array.dtype.kind in "iuf" else np.empty(0)
