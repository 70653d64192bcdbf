"""The surface of a point cloud: hand-checked numbers, a slow twin of each step, and a box on a plane."""

from __future__ import annotations

import numpy as np
import pytest

from egvs.core.grid import FloatArray
from egvs.extensions.maps.point_clouds import surface as cloud_surface
from egvs.extensions.maps.point_clouds.surface import (
    is_ground,
    make_surfels,
    thin_points,
    triangulate_cloud,
    triangulate_ground,
)


def grid_points(x: FloatArray, y: FloatArray, z: float = 0.0) -> FloatArray:
    """Points of a regular grid at one height, (n, 3)."""
    xs, ys = np.meshgrid(x, y, indexing="ij")
    return np.column_stack([xs.ravel(), ys.ravel(), np.full(xs.size, z)])


def areas(vertices: FloatArray, faces: np.ndarray) -> FloatArray:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.sqrt((np.cross(b - a, c - a) ** 2).sum(axis=1)) / 2


# --- thinning ---


def test_thinning_gives_the_mean_of_each_cube() -> None:
    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.5, 0.9], [-0.1, 0.1, 0.1], [1.5, 0.5, 0.5]])
    expected = [[-0.1, 0.1, 0.1], [0.2, 0.3, 0.5], [1.5, 0.5, 0.5]]
    np.testing.assert_allclose(thin_points(points, 1.0), expected, rtol=0, atol=1e-15)
    assert thin_points(np.empty((0, 3)), 1.0).shape == (0, 3)


def test_thinning_equals_a_dictionary_of_cubes() -> None:
    points = np.random.default_rng(3).normal((4e5, 3.9e6, 40), 1.0, (500, 3))
    cubes: dict[tuple[int, ...], list[FloatArray]] = {}
    for point in points:
        cubes.setdefault(tuple(int(np.floor(value / 0.4)) for value in point), []).append(point)
    expected = [np.mean(cubes[key], axis=0) for key in sorted(cubes)]
    np.testing.assert_allclose(thin_points(points, 0.4), expected, rtol=0, atol=1e-8)


# --- ground ---


def test_ground_is_what_openings_leave() -> None:
    """A plane with a slope of 10 %, on it a car of 4 x 2 x 1.5 m, and one false return 3 m below the ground."""
    plane = grid_points(np.arange(0.25, 40, 0.5), np.arange(0.25, 40, 0.5))
    plane[:, 2] = 0.1 * plane[:, 0]
    on_car = (abs(plane[:, 0] - 20) < 2) & (abs(plane[:, 1] - 20) < 1)
    plane[on_car, 2] += 1.5
    pit = np.array([[8.1, 8.1, 0.81 - 3.0]])
    ground = is_ground(np.concatenate([plane, pit]))
    assert not ground[:-1][on_car].any()
    assert not ground[-1]
    pit_cell = (np.floor(plane[:, :2]) == 8).all(axis=1)
    assert ground[:-1][~on_car & ~pit_cell].all()


def test_ground_continues_below_what_is_narrower_than_the_window() -> None:
    """A roof of 30 m is no ground, one of 50 m is taken for it: the largest window has 41 cells."""
    for width_m, expected in ((30, 0.0), (50, 1.0)):
        points = grid_points(np.arange(0.5, 120), np.arange(0.5, 120))
        on_roof = (np.abs(points[:, :2] - 60) < width_m / 2).all(axis=1)
        points[on_roof, 2] = 8.0
        assert is_ground(points)[on_roof].mean() == expected


def test_ground_faces_up_and_covers_the_hull() -> None:
    points = np.random.default_rng(5).uniform(0, 10, (3000, 3)) * [1, 1, 0.01]
    surface = triangulate_ground(points)
    corners = surface.vertices_m[surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0).all()
    assert len(surface.vertices_m) == 400  # cells of half a metre
    flat = surface.vertices_m * [1, 1, 0]
    assert 85 < areas(flat, surface.faces).sum() < 100


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_ground_of_few_points_or_of_a_line_has_no_faces(count: int) -> None:
    points = np.column_stack([np.arange(count), np.arange(count), np.zeros(count)]).astype(float)
    assert len(triangulate_ground(points).faces) == 0
    assert len(is_ground(points)) == count


# --- surfels ---


def test_surfels_of_a_wall_do_not_leave_it() -> None:
    """A wall of 2 m x 1 m with a point every 0.1 m; at its corners, rectangles along the diagonal overhang."""
    points = grid_points(np.arange(21) * 0.1, np.arange(11) * 0.1)[:, [0, 2, 1]]
    corners = make_surfels(points).vertices_m.reshape(-1, 4, 3)
    assert np.abs(corners[:, :, 1]).max() == 0.0
    assert corners.min() > -0.12 and (corners.max(axis=(0, 1)) < [2.12, 0.1, 1.12]).all()
    is_edge = (np.abs(points[:, 0] - 1.0) < 0.7) & (np.abs(points[:, 2] - 0.5) > 0.49)  # without the corners
    assert is_edge.sum() == 26
    heights = corners[is_edge][:, :, 2]
    assert heights.min() > -0.05 and heights.max() < 1.05
    middle = corners[10 * 11 + 5]  # its sixth neighbour is 0.1 sqrt(2) away; 0.75 of that is 0.1061
    for start, end in ((0, 1), (1, 2)):
        assert 0.15 <= np.linalg.norm(middle[start] - middle[end]) <= 0.2123


def test_surfels_of_a_thin_pole_stay_thin() -> None:
    angle = np.linspace(0, 2 * np.pi, 6, endpoint=False)
    rings = [np.column_stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), np.full(6, z)]) for z in np.arange(0, 3, 0.1)]
    corners = make_surfels(np.concatenate(rings)).vertices_m
    assert np.hypot(corners[:, 0], corners[:, 1]).max() < 0.05 * np.sqrt(2) + 0.03
    assert corners[:, 2].max() - corners[:, 2].min() == pytest.approx(2.9, abs=0.05)


def slow_surfel(points: FloatArray, number: int) -> FloatArray:
    """The corners of one surfel: distances to all points, main directions by a singular value decomposition."""
    distances = [float(np.linalg.norm(other - points[number])) for other in points]
    nearest = sorted(range(len(points)), key=distances.__getitem__)[1:17]
    offsets = np.array([points[i] - points[number] for i in nearest])
    _, _, directions = np.linalg.svd(offsets - offsets.mean(axis=0))
    size = min(max(0.75 * distances[nearest[5]], 0.08), 0.6)
    sides = []
    for direction in directions[:2]:
        turned = direction if direction[np.argmax(abs(direction))] > 0 else -direction
        along = sorted(offsets @ turned)
        sides.append((turned, min(max(along[-4], 0.02), size), min(max(-along[3], 0.02), size)))
    (u, right, left), (v, front, back) = sides
    corners = [right * u + front * v, -left * u + front * v, -left * u - back * v, right * u - back * v]
    return points[number] + np.array(corners)


def test_surfels_equal_their_slow_twins() -> None:
    rng = np.random.default_rng(11)
    points = rng.uniform(0, 3, (300, 3)) * [1, 1, 0.2] + [4e5, 3.9e6, 0]
    surface = make_surfels(points)
    for number in range(0, 300, 13):
        expected = slow_surfel(points, number)
        np.testing.assert_allclose(surface.vertices_m[4 * number : 4 * number + 4], expected, rtol=0, atol=6e-5)
    assert surface.faces[:2].tolist() == [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize("count", [0, 3])
def test_few_points_give_no_surfels(count: int) -> None:
    assert len(make_surfels(np.zeros((count, 3))).faces) == 0


def test_same_points_give_same_bytes_in_blocks_of_any_size(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(2).uniform(0, 5, (2000, 3))
    first = triangulate_cloud(points)
    monkeypatch.setattr(cloud_surface, "_BLOCK", 7)
    second = triangulate_cloud(points)
    assert first.objects.vertices_m.tobytes() == second.objects.vertices_m.tobytes()
    assert first.ground.vertices_m.tobytes() == second.ground.vertices_m.tobytes()
    assert first.ground.faces.tobytes() == second.ground.faces.tobytes()
    assert first.ground_points == second.ground_points
