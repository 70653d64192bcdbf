"""Prisms over polygons are those of trimesh, vertex by vertex and face by face."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import shapely
import trimesh
from shapely.geometry import Point, Polygon, box

from egvs.world.extrusion import extrude_polygon


def random_polygons() -> Iterator[Polygon]:
    """Stars with many corners, discs, and polygons with holes, far from the origin as well as near."""
    rng = np.random.default_rng(3)
    for number in range(200):
        corners = int(rng.integers(3, 40))
        angle = np.sort(rng.uniform(0, 2 * np.pi, corners))
        radius_m = rng.uniform(0.3, 20.0, corners)
        shift_m = rng.uniform(-1, 1, 2) * 10.0 ** rng.integers(0, 6)
        star = Polygon(np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle)]) + shift_m).buffer(0)
        if number % 2:
            star = star.difference(Point(*shift_m).buffer(0.2)).difference(Point(*(shift_m + 0.7)).buffer(0.1))
        pieces = shapely.get_parts(star).tolist()
        yield from (piece for piece in pieces if piece.area > 1e-6)


POLYGONS = {
    "square": box(0, 0, 1, 1),
    "clockwise square": Polygon([(0, 0), (0, 1), (1, 1), (1, 0)]),
    "corners on a line": Polygon([(0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (0, 1)]),
    "corners nearer than rounding": Polygon([(0, 0), (1, 0), (1, 1e-9), (1, 1), (0, 1)]),
    "hole that touches the boundary": Polygon([(0, 0), (4, 0), (4, 4), (0, 4)], [[(0, 2), (2, 1), (3, 2), (2, 3)]]),
}


def assert_as_trimesh(polygon: Polygon, height_m: float) -> None:
    vertices_m, faces = extrude_polygon(polygon, height_m)
    mesh = trimesh.creation.extrude_polygon(polygon, height_m, engine="earcut")
    assert vertices_m.dtype == np.float64 and faces.dtype == np.int64
    assert vertices_m.tobytes() == np.ascontiguousarray(mesh.vertices).tobytes()
    assert np.array_equal(faces, mesh.faces)


@pytest.mark.parametrize("name", POLYGONS)
def test_prism_is_that_of_trimesh(name: str) -> None:
    assert_as_trimesh(POLYGONS[name], 3.7)


@pytest.mark.slow
def test_prisms_over_random_polygons_are_those_of_trimesh() -> None:
    heights_m = np.random.default_rng(4).uniform(0.01, 80.0, 1000)
    polygons = list(random_polygons())
    assert len(polygons) > 100 and any(polygon.interiors for polygon in polygons)
    for polygon, height_m in zip(polygons, heights_m.tolist(), strict=False):
        assert_as_trimesh(polygon, height_m)


def test_prism_is_closed_and_faces_outwards() -> None:
    polygon = Polygon([(0, 0), (4, 0), (4, 4), (0, 4)], [[(1, 1.2), (2.5, 1), (2, 2.3)]])
    mesh = trimesh.Trimesh(*extrude_polygon(polygon, 2.0), process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(2.0 * polygon.area)
