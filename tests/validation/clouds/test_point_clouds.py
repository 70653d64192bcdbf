"""Clouds hold what every beam against every triangle gives, and what can be counted by hand."""

import numpy as np
import pytest

from pipeline.sensing.sites import Pose
from pipeline.validation.clouds.point_clouds import CloudMaker, random_of
from tests.validation.clouds.scenes import built, frame_of, moved, random_frame, twin

POSES = [
    Pose(10.0, 12.0, 3.0),
    Pose(12.0, -13.0, 4.5, yaw_deg=77.3, pitch_deg=-11.0),
    Pose(30.5, -12.0, 6.0, yaw_deg=-160.0, pitch_deg=-35.0, roll_deg=20.0),
    Pose(25.0, 1.0, 7.0, yaw_deg=10.0, pitch_deg=-90.0),
]
FAR_M = (400_000.0, 3_900_000.0, 120.0)


@pytest.mark.parametrize("pose", POSES, ids=["upright", "tilted", "rolled", "down"])
@pytest.mark.parametrize("far", [False, True], ids=["here", "far"])
def test_ranges_are_those_of_every_beam_against_every_triangle(mini, pose, far):
    scene = built(mini)
    if far:
        scene = moved(scene, FAR_M)
        pose = Pose(*np.add(pose.position_m, FAR_M).tolist(), *pose.angles_deg)
    sensor, random = scene.sensor("small"), np.random.default_rng(5)
    maker = CloudMaker(scene, pose, sensor, "here")
    found = 0
    for number in range(4):
        frame = random_frame(random, np.array(pose.position_m) * (1, 1, 0) + (0, 0, FAR_M[2] * far), number=number)
        hits = maker.first_hits(frame)
        ranges, owner = twin(scene, pose, sensor, frame)
        met = np.isfinite(ranges)
        np.testing.assert_array_equal(np.isfinite(hits.range_m), met)
        np.testing.assert_array_equal(hits.owner, owner)
        np.testing.assert_allclose(hits.range_m[met], ranges[met], rtol=0, atol=1e-9)
        found += (owner >= 0).sum()
    assert found > 100


def test_one_car_before_a_sensor_without_noise_counted_by_hand(mini):
    """A sensor 3 m up sees a box body's roof and front; behind it nothing, beside it the ground."""
    scene = built(mini, "sensors.small.range_sigma_m=0")
    maker = CloudMaker.of_site(scene, scene.sites[0])
    empty = maker.sweep(frame_of([]), random_of(1, "a", 0))
    np.testing.assert_array_equal(empty.owner, -1)
    known = np.isfinite(maker.view.empty_range_m)
    np.testing.assert_array_equal(np.flatnonzero(known), empty.sweep.beam)
    far = np.sqrt((empty.sweep.points[:, :3].astype(np.float64) ** 2).sum(axis=1))
    np.testing.assert_allclose(far, maker.view.empty_range_m[known], rtol=1e-6)
