"""Errors of poses, by hand: a box 50 m ahead of a sensor."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks import pose_errors

from egvs.sensors.sensor import rotation_world_sensor
from egvs.sensors.sites import Pose

SENSOR = Pose(10.0, 20.0, 5.0, yaw_deg=90.0)
AHEAD = np.array([[10.0, 70.0, 5.0, 4.5, 1.8, 1.5, np.pi / 2]])


@pytest.mark.parametrize(
    ("believed", "expected"),
    [
        (SENSOR, (10.0, 70.0, 5.0, 90.0)),
        (Pose(10.1, 20.0, 5.0, yaw_deg=90.0), (10.1, 70.0, 5.0, 90.0)),
        # counter-clockwise by 1 degree: to the left, which is -x; 50 m times sin 1 degree are 0.873 m
        (Pose(10.0, 20.0, 5.0, yaw_deg=91.0), (9.1274, 69.9924, 5.0, 91.0)),
        # nose up: the box rises by as much
        (Pose(10.0, 20.0, 5.0, yaw_deg=90.0, pitch_deg=1.0), (10.0, 69.9924, 5.8726, 90.0)),
        # about its own axis: what is straight ahead stays
        (Pose(10.0, 20.0, 5.0, yaw_deg=90.0, roll_deg=1.0), (10.0, 70.0, 5.0, 90.0)),
    ],
)
def test_boxes_move_with_the_pose(believed: Pose, expected: tuple[float, ...]) -> None:
    (box,) = pose_errors.move_boxes(AHEAD, SENSOR, believed)
    assert (*box[:3], np.degrees(box[6])) == pytest.approx(expected, abs=1e-4)
    assert box[3:6].tolist() == AHEAD[0, 3:6].tolist()


@pytest.mark.parametrize("seed", range(5))
def test_errors_have_the_stated_size(seed: int) -> None:
    moved = pose_errors.with_error(SENSOR, np.random.default_rng(seed))
    assert np.linalg.norm(np.subtract(moved.position_m, SENSOR.position_m)) == pytest.approx(0.1)
    assert np.abs(np.subtract(moved.angles_deg, SENSOR.angles_deg)) == pytest.approx([1.0, 1.0, 1.0])


def test_a_point_seen_by_the_sensor_is_where_the_detector_believes() -> None:
    rng = np.random.default_rng(1)
    pose, believed = (pose_errors.with_error(SENSOR, rng) for _ in range(2))
    seen_m = np.array([30.0, -4.0, -2.0])  # in the sensor's frame
    true_m, believed_m = (rotation_world_sensor(*p.angles_deg) @ seen_m + p.position_m for p in (pose, believed))
    box = np.array([[*true_m, 4.0, 2.0, 1.5, 0.3]])
    np.testing.assert_allclose(pose_errors.move_boxes(box, pose, believed)[0, :3], believed_m)
