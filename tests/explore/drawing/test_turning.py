"""Quaternions of mounts against the matrix that turns beams."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.explore import drawing
from egvs.sensors.sensor import rotation_world_sensor
from egvs.sensors.sites import Pose

ANGLES = st.tuples(st.floats(-180, 180), st.floats(-89.9, 89.9), st.floats(-180, 180))


def matrix(wxyz: tuple[float, float, float, float]) -> np.ndarray:
    """The matrix of a quaternion, by turning each axis: q v q*."""
    w, u = wxyz[0], np.array(wxyz[1:])
    return np.column_stack([v + 2 * np.cross(u, np.cross(u, v) + w * v) for v in np.eye(3)])


@given(ANGLES)
def test_a_quaternion_turns_as_the_beams_are_turned(angles: tuple[float, float, float]) -> None:
    turned = matrix(drawing.quaternion(Pose(0, 0, 0, *angles)))
    assert np.allclose(turned, rotation_world_sensor(*angles), atol=1e-12)


@given(ANGLES)
def test_angles_come_back(angles: tuple[float, float, float]) -> None:
    again = drawing.angles_deg(drawing.quaternion(Pose(0, 0, 0, *angles)))
    away = [math.remainder(a - b, 360.0) for a, b in zip(again, angles, strict=True)]
    assert np.allclose(away, 0.0, atol=1e-6)


@pytest.mark.parametrize("pitch", [90.0, -90.0])
@pytest.mark.parametrize(("yaw", "roll"), [(0.0, 0.0), (30.0, 0.0), (-120.0, 50.0)])
def test_straight_up_and_down_turn_alike(yaw: float, pitch: float, roll: float) -> None:
    found = drawing.angles_deg(drawing.quaternion(Pose(0, 0, 0, yaw, pitch, roll)))
    assert found[1:] == (pitch, 0.0)
    assert np.allclose(rotation_world_sensor(*found), rotation_world_sensor(yaw, pitch, roll), atol=1e-6)


def test_what_is_not_dragged_stays_to_the_last_digit() -> None:
    pose = Pose(1 / 3, 2 / 3, 5.0, 37.123456, -12.3456, 179.999)
    wxyz = drawing.quaternion(pose)
    assert drawing.moved_pose(pose, pose.position_m, wxyz) == pose
    lifted = drawing.moved_pose(pose, (pose.x_m, pose.y_m, 6.23456), wxyz)
    assert lifted == Pose(1 / 3, 2 / 3, 6.235, 37.123456, -12.3456, 179.999)
    turned = drawing.moved_pose(pose, pose.position_m, drawing.quaternion(Pose(0, 0, 0, 40.0, -12.3456, 179.999)))
    assert turned == Pose(1 / 3, 2 / 3, 5.0, 40.0, -12.3456, 179.999)


def test_yaw_beyond_a_half_turn_is_the_same_yaw() -> None:
    pose = Pose(0, 0, 3, 270.0)
    assert drawing.moved_pose(pose, pose.position_m, drawing.quaternion(pose)) == pose
