"""The ground below a sensor: heights that a person can compute from a plane."""

from __future__ import annotations

import numpy as np
import pytest

from egvs.sensors import site_feasibility
from egvs.sensors.sites import Pose
from egvs.world.mesh import World

CORNERS_M = np.array([[-10.0, -20.0], [30.0, -20.0], [30.0, 20.0], [-10.0, 20.0]])


def plane_m(x_m: float, y_m: float) -> float:
    """A slope of 10 % to the east and 5 % to the south, 3 m above zero at the origin."""
    return 3.0 + 0.1 * x_m - 0.05 * y_m


def slope(name: str = "ground", kind: str = "ground") -> World:
    """Two triangles of the plane."""
    corners_m = np.array([[x_m, y_m, plane_m(x_m, y_m)] for x_m, y_m in CORNERS_M])
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    return World(corners_m, faces, np.zeros(2, dtype=np.int32), ((name, kind),))


@pytest.mark.parametrize("at_m", [(0.0, 0.0), (17.0, -11.0), (-9.5, 19.0), (25.0, 3.0), (2.0, 14.0), (10.0, 0.0)])
def test_ground_below_a_pose_is_the_plane(at_m: tuple[float, float]) -> None:
    below_m = site_feasibility.ground_height_m(slope(), Pose(*at_m, 9.0))
    assert below_m == pytest.approx(plane_m(*at_m), abs=1e-12)


@pytest.mark.parametrize("at_m", [(31.0, 0.0), (0.0, -21.0), (500.0, 500.0)])
def test_height_outside_the_terrain_is_zero(at_m: tuple[float, float]) -> None:
    assert site_feasibility.ground_height_m(slope(), Pose(*at_m, 9.0)) == 0.0


def test_ignores_roofs() -> None:
    assert site_feasibility.ground_height_m(slope("roof", "building"), Pose(0.0, 0.0, 9.0)) == 0.0
