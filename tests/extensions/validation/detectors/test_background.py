"""The ground from empty scans, and foreground points."""

import numpy as np
import pytest

from egvs.clouds.sweeps import SiteView, Sweep
from egvs.core.grid import Roi
from egvs.extensions.validation.detectors import background
from egvs.extensions.validation.detectors.background import MAX_SLOPE, SQUARE_M, GroundMap
from egvs.sensors.sensor import CATALOGUE
from egvs.sensors.sites import Pose

ROI = Roi((0.0, 0.0, 0.0), (40.0, 40.0, 5.0))
SENSOR = CATALOGUE["VLP-32C"]


def _view(range_of, pose=None):
    pose = pose or Pose(-5.0, 20.0, 4.0)
    return SiteView("s", pose, SENSOR, range_of(np.asarray(pose.position_m), SENSOR.directions(*pose.angles_deg)))


def _to_plane(slope, wall_x_m=np.inf):
    """Ranges to the plane z = slope * x, and to a wall across x."""

    def range_of(start, ways):
        with np.errstate(divide="ignore"):
            down = (slope * start[0] - start[2]) / (ways[:, 2] - slope * ways[:, 0])
            wall = (wall_x_m - start[0]) / ways[:, 0]
        down, wall = (np.where(ranges > 0, ranges, np.inf) for ranges in (down, wall))
        ranges = np.minimum(down, wall)
        return np.where(ranges < SENSOR.range_m, ranges, np.inf)

    return range_of


@pytest.mark.parametrize("slope", [0.0, 0.06, -0.1])
def test_ground_of_slope(slope):
    ground = GroundMap.from_empty_scans([_view(_to_plane(slope))], ROI)
    at = np.random.default_rng(0).uniform(5.0, 35.0, (200, 2))
    np.testing.assert_allclose(ground.height_m(at), slope * at[:, 0], atol=2 * abs(slope) * 2 + 1e-9)


def test_wall_is_not_ground():
    ground = GroundMap.from_empty_scans([_view(_to_plane(0.0, wall_x_m=30.0))], ROI)
    at = np.array([[10.0, 20.0], [29.0, 20.0], [31.0, 20.0], [39.0, 10.0]])
    np.testing.assert_allclose(ground.height_m(at), 0.0, atol=MAX_SLOPE * SQUARE_M)  # its foot counts as a slope


def test_ground_without_returns_is_at_height_of_sensor():
    view = _view(lambda _, ways: np.full(len(ways), np.inf))
    np.testing.assert_array_equal(GroundMap.from_empty_scans([view], ROI).height_m(np.array([[1.0, 2.0]])), [4.0])


def test_foreground_is_in_front_of_empty_scan():
    pose = Pose(1.0, 2.0, 3.0, yaw_deg=30.0, pitch_deg=-10.0, roll_deg=5.0)
    view = _view(_to_plane(0.0), pose)
    ways = SENSOR.directions()  # in the sensor's frame
    beam = np.flatnonzero(np.isfinite(view.empty_range_m))[:3].astype(np.uint32)
    shorter = view.empty_range_m[beam] - [0.0, 0.14, 0.16]
    points = np.column_stack([ways[beam] * shorter[:, None], np.ones(3)]).astype(np.float32)
    sweep = Sweep(points, beam)
    np.testing.assert_array_equal(background.foreground_mask(sweep, view), [False, False, True])
    there = np.asarray(pose.position_m) + SENSOR.directions(*pose.angles_deg)[beam] * shorter[:, None]
    np.testing.assert_allclose(background.points_in_world(sweep, view), there, atol=1e-5)
