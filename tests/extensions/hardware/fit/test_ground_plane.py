"""The pose over a plane, in the convention of sites; planes at several heights; walls are no ground.

Evidence: planes whose pose is set; the mount's rotation matrix.
"""

from __future__ import annotations

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.sensors.ground_plane import find_ground_planes
from egvs.sensors.sensor import rotation_world_sensor
from tests.extensions.hardware.fit.small_sensor import TRUTH, small_fit


def ground(n: int, height_m: float, roll_deg: float, pitch_deg: float, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """Points of a flat world below a sensor, in its frame, and the normals."""
    rng = np.random.default_rng(seed)
    world = np.column_stack([rng.uniform(-40, 40, (n, 2)), np.full(n, -height_m) + 0.02 * rng.standard_normal(n)])
    rotation = rotation_world_sensor(0.0, pitch_deg, roll_deg)
    return world @ rotation, np.tile(rotation[2], (n, 1))


@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(0.0, 0.0), (3.0, -12.0), (-20.0, 7.0)])
def test_pose(roll_deg: float, pitch_deg: float) -> None:
    points, normals = ground(5000, 5.0, roll_deg, pitch_deg)
    plane = find_ground_planes(points, normals, "sweep")[0]
    assert plane.height_m == pytest.approx(5.0, abs=4 * plane.height_se_m)
    assert plane.roll_deg == pytest.approx(roll_deg, abs=4 * plane.roll_se_deg)
    assert plane.pitch_deg == pytest.approx(pitch_deg, abs=4 * plane.pitch_se_deg)
    assert max(plane.height_se_m, plane.roll_se_deg, plane.pitch_se_deg) < 0.003
    assert plane.roughness_m == pytest.approx(0.02, rel=0.1)
    assert plane.share == pytest.approx(0.99, abs=0.02)


def test_turned_back_points_are_level() -> None:
    fit = small_fit()
    grid = fit.grids[0].range_m
    points = fit.angles.origins_m() + fit.angles.directions() * grid[..., None]
    on_ground = np.abs(fit.plane_view.height_m(grid)) < 0.2
    level = points[on_ground] @ rotation_world_sensor(0.0, fit.plane.pitch_deg, fit.plane.roll_deg).T
    assert level[:, 2].mean() == pytest.approx(-TRUTH.height_m, abs=0.01)
    assert np.abs(np.polyfit(level[:, 0], level[:, 2], 1)[0]) < 1e-3


def test_two_heights() -> None:
    road, up = ground(4000, 3.7, -0.6, 0.2)
    yard, yard_up = ground(2000, 6.5, 0.4, 0.0, seed=1)
    first, second = find_ground_planes(np.concatenate([yard, road]), np.concatenate([yard_up, up]), "sweep")
    assert (first.height_m, second.height_m) == (pytest.approx(3.7, abs=0.01), pytest.approx(6.5, abs=0.01))


def test_wall_with_more_returns_is_no_ground() -> None:
    road, up = ground(2000, 4.0, 1.0, 0.0)
    rng = np.random.default_rng(3)
    wall = np.column_stack([np.full(9000, 12.0), rng.uniform(-20, 20, 9000), rng.uniform(-4, 8, 9000)])
    normals = np.tile([-1.0, 0.0, 0.0], (9000, 1))
    planes = find_ground_planes(np.concatenate([wall, road]), np.concatenate([normals, up]), "sweep")
    assert [plane.height_m for plane in planes] == [pytest.approx(4.0, abs=0.01)]


def test_rejects_sweep_without_ground() -> None:
    points, normals = ground(3000, -2.0, 0.0, 0.0)  # a ceiling
    with pytest.raises(InputError, match="ground plane below the sensor"):
        find_ground_planes(points, normals, "sweep.pcd")
