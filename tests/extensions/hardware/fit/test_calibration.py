"""The pose by a calibration file, and the ground plane in its frame.

Evidence: rotations made of known yaw, pitch and roll; a plane whose height and tilt follow by hand; wrong files.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.extensions.hardware.fit.calibration import read_calibrated_pose
from egvs.sensors.ground_plane import GroundPlane
from egvs.sensors.sensor import rotation_world_sensor


def plane(pitch_deg: float = 0.0, roll_deg: float = 0.0) -> GroundPlane:
    """A plane 6 m below a sensor that is tilted over it."""
    normal = rotation_world_sensor(0.0, pitch_deg, roll_deg)[2]
    return GroundPlane(normal, 6.0, roll_deg, pitch_deg, 0, 0, 0, 100, 1, 0, (0, 1), (0, 1))


def matrix(yaw_deg: float, pitch_deg: float, roll_deg: float) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3] = rotation_world_sensor(yaw_deg, pitch_deg, roll_deg)
    result[:3, 3] = (10.0, -20.0, 7.5)
    return result


@pytest.mark.parametrize("form", ["named", "plain", "rotation and translation"])
def test_pose_of_every_form(tmp_path: Path, form: str) -> None:
    made = matrix(77.0, -1.5, 1.25)
    values: Any = made.tolist()
    if form == "named":
        values = {"projection_matrix_into_camera": [[1, 2]], "transformation_matrix_into_base": values}
    elif form == "rotation and translation":
        values = {"rotation": made[:3, :3].tolist(), "translation": [[value] for value in made[:3, 3]]}
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(values), encoding="utf-8")
    result = read_calibrated_pose(path, plane(-1.5, 1.25))
    assert result.frame == ("base" if form == "named" else "map")
    assert result.pose.position_m == (10.0, -20.0, 7.5)
    assert result.pose.angles_deg == pytest.approx((77.0, -1.5, 1.25))
    assert result.ground_z_m == pytest.approx(1.5)
    assert result.ground_tilt_deg == pytest.approx(0.0, abs=1e-5)


def test_sloping_road(tmp_path: Path) -> None:
    """A sensor that is level in the map, over a road that falls by 3 degrees: 6 m along its normal."""
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(matrix(0.0, 0.0, 0.0).tolist()), encoding="utf-8")
    result = read_calibrated_pose(path, plane(3.0))
    assert result.ground_tilt_deg == pytest.approx(3.0)
    assert result.ground_z_m == pytest.approx(7.5 - 6.0 / np.cos(np.radians(3.0)))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "expected one key transformation_matrix_into_FRAME, got 0"),
        ({"transformation_matrix_into_a": 1, "transformation_matrix_into_b": 1}, "got 2"),
        ([[1, 0, 0], [0, 1]], "expected 4 x 4 finite numbers"),
        (np.diag([2.0, 1, 1, 1]).tolist(), "expected a rotation"),
        (np.diag([-1.0, 1, 1, 1]).tolist(), "expected a rotation"),
        (np.diag([1.0, -1, -1, 1]).tolist(), "expected a pose above the ground plane"),
        (np.full((4, 4), np.nan).tolist(), "expected 4 x 4 finite numbers"),
        ((np.eye(4) + np.eye(4, k=3) * 1e9).tolist(), "expected a position within 1e"),
        ((np.eye(4) + np.eye(4, k=-3)).tolist(), "expected 0, 0, 0, 1 in the last row"),
        ({"rotation": [[1]], "translation": [0, 0, 0]}, "rotation: expected 3 x 3 finite numbers"),
        ({"rotation": np.eye(3).tolist(), "translation": "x"}, "translation: expected 3 finite numbers"),
    ],
)
def test_rejects_what_is_no_pose(tmp_path: Path, values: Any, message: str) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(InputError, match=r"calibration\.json: .*" + message):
        read_calibrated_pose(path, plane())


def test_rejects_other_text(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    path.write_text("x: 1", encoding="utf-8")
    with pytest.raises(InputError, match="is not valid JSON"):
        read_calibrated_pose(path, plane())
