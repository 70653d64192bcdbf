"""The ground through lanes, against SciPy's interpolation and cases by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator

from egvs.core.grid import FloatArray
from egvs.traffic import network
from egvs.world.terrain import TerrainSurface, triangulate, triangulate_ground

LOW_M, HIGH_M = np.array([-40.0, 15.0]), np.array([90.0, 75.0])


def surface(points_m: FloatArray) -> TerrainSurface:
    low_m, high_m = points_m[:, :2].min(axis=0), points_m[:, :2].max(axis=0)
    return TerrainSurface(points_m, triangulate(points_m, low_m), low_m, high_m)


def valley() -> TerrainSurface:
    """z = |x| on a square of 10 m."""
    x_m, y_m = (side.ravel() for side in np.meshgrid([-5.0, 0.0, 5.0], [-5.0, 5.0]))
    return surface(np.column_stack([x_m, y_m, np.abs(x_m)]))


def ground_of(folder: Path, *shapes: str) -> TerrainSurface:
    """The ground through lanes 4 m wide, over a rectangle that is not a square."""
    lanes = [f'<lane id="e{i}_0" index="0" length="1" width="4" shape="{s}"/>' for i, s in enumerate(shapes)]
    edges = "".join(f'<edge id="e{i}" from="a{i}" to="b{i}">{lane}</edge>' for i, lane in enumerate(lanes))
    (folder / "made.net.xml").write_text(f'<net version="1.20">{edges}</net>')
    return triangulate_ground(network.read_net_xml(folder / "made.net.xml"), LOW_M, HIGH_M)


def test_heights_agree_with_scipy_and_continue_beyond_the_border() -> None:
    rng = np.random.default_rng(4)
    corners, far_m = [[0, 0], [30, 0], [0, 20], [30, 20]], np.array([4e5, 5e6])
    xy_m = far_m + np.concatenate([corners, rng.uniform([0, 0], [30, 20], (60, 2))])
    ground = surface(np.column_stack([xy_m, rng.uniform(0, 5, 64)]))
    at_m = far_m + rng.uniform([-10, -10], [40, 30], (400, 2))
    inside_m = np.clip(at_m, ground.low_m + 1e-6, ground.high_m - 1e-6) - ground.low_m
    expected_m = LinearNDInterpolator(xy_m - ground.low_m, ground.vertices_m[:, 2])(inside_m)
    np.testing.assert_allclose(ground.height_m(*at_m.T), expected_m, atol=1e-3)
    is_inside = np.all(inside_m == at_m - ground.low_m, axis=1)
    assert 50 < is_inside.sum() < 350
    np.testing.assert_allclose(ground.height_m(*at_m[is_inside].T), expected_m[is_inside], atol=1e-9)


def test_faces_face_up_and_cover_the_rectangle() -> None:
    rng = np.random.default_rng(6)
    xy_m = np.concatenate([[[0, 0], [30, 0], [0, 20], [30, 20]], rng.uniform([0, 0], [30, 20], (60, 2))])
    a, b, c = np.moveaxis(xy_m[triangulate(np.column_stack([xy_m, np.zeros(64)]), xy_m[0])], 1, 0)
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(600)


@pytest.mark.parametrize("outline_m", [[[-5, 0], [5, 0]], [[5, -1], [-5, -1]], [[5, 2], [3, 2], [-3, -2]]])
def test_lowest_point_may_be_between_the_corners_of_an_outline(outline_m: list[list[float]]) -> None:
    assert valley().lowest_m(np.array(outline_m, dtype=float)) < 0.5


def test_corners_of_an_outline_count() -> None:
    assert valley().lowest_m(np.array([[0.0, 1.0], [5.0, 1.0]])) == pytest.approx(0)
    assert valley().lowest_m(np.array([[2.0, 1.0], [2.5, 1.0]])) == pytest.approx(2)
    assert valley().lowest_m(np.array([[2.5, 1.0], [2.0, 1.0]])) == pytest.approx(2)


def test_ground_has_both_sides_of_a_lane_and_a_rim(tmp_path: Path) -> None:
    """A lane along (12, 16) that rises by 1 m; its sides, 2 m along (-16, 12) / 20 beside it, are as high."""
    ground = ground_of(tmp_path, "10,30,1 22,46,2")
    (low_x, low_y), (high_x, high_y) = LOW_M, HIGH_M
    vertices = {tuple(vertex) for vertex in np.round(ground.vertices_m, 3).tolist()}
    middle = [(10.0, 30.0, 1.0), (16.0, 38.0, 1.5), (22.0, 46.0, 2.0)]
    lane = {(round(x - 1.6 * side, 3), round(y + 1.2 * side, 3), z) for x, y, z in middle for side in (-1, 0, 1)}
    assert lane <= vertices
    rim = {(round(x, 3), y) for x in np.linspace(low_x, high_x, 4) for y in (low_y, high_y)}
    rim |= {(x, 45.0) for x in (low_x, high_x)}
    assert {vertex[:2] for vertex in vertices - lane} == rim
    assert ground.height_m(np.array([-40.0, 90.0]), np.array([15.0, 75.0])).tolist() == pytest.approx([1, 2], abs=1e-5)


@pytest.mark.parametrize(("above_m", "is_bridge"), [(1.4, False), (1.6, True)])
def test_lane_above_another_is_a_bridge_from_a_level_on(tmp_path: Path, above_m: float, is_bridge: bool) -> None:
    """The lane below is not sampled where the other one crosses it."""
    ground = ground_of(tmp_path, "-20,40,0 60,40,0", f"24,25,{above_m} 24,55,{above_m}")
    assert (ground.height_m(np.array([24.0]), np.array([45.0]))[0] < 0.5) == is_bridge
    assert ground.height_m(np.array([24.0]), np.array([55.0]))[0] == pytest.approx(above_m, abs=0.01)
