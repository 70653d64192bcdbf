"""Triangles of polygons in space: their area is that of the polygon, whatever its plane; holes stay open."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely import Polygon

from egvs.extensions.maps.formats.surface_meshes import encloses_volume, triangulate_surfaces
from tests.extensions.maps.formats.small_city_models import box_rings

BOX = [[np.array(ring)] for ring in box_rings((0, 0, 0), (2, 3, 4))]


def area_m2(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def volume_m3(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def test_box_is_closed_and_faces_outwards() -> None:
    mesh = triangulate_surfaces(BOX)
    assert (len(mesh.vertices_m), len(mesh.faces)) == (8, 12)
    assert mesh.is_closed and mesh.degenerate_rings == 0 and mesh.crossing == 0
    assert volume_m3(mesh.vertices_m, mesh.faces) == pytest.approx(24.0)


def test_box_without_a_side_is_open() -> None:
    assert not triangulate_surfaces(BOX[:5]).is_closed
    assert not encloses_volume(np.empty((0, 3), dtype=np.int64))


def test_corners_a_tenth_of_a_millimetre_apart_are_one() -> None:
    moved = [[ring + 1e-4 * (number % 2) for ring in surface] for number, surface in enumerate(BOX)]
    assert triangulate_surfaces(moved).is_closed
    apart = [[ring + 1e-2 * (number % 2) for ring in surface] for number, surface in enumerate(BOX)]
    assert not triangulate_surfaces(apart).is_closed


@pytest.mark.slow
@given(
    normal=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: sum(c * c for c in v) > 0.01),
    corners=st.integers(3, 12),
    has_hole=st.booleans(),
)
def test_area_is_that_of_the_polygon_in_any_plane(normal: tuple[float, ...], corners: int, has_hole: bool) -> None:
    """A star, turned into a plane; shapely says how large it is."""
    angles = np.arange(2 * corners) * math.pi / corners
    radii = np.where(np.arange(2 * corners) % 2, 5.0, 2.0)
    rings = [np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])]
    if has_hole:
        rings.append(0.4 * rings[0][::-1])
    expected = Polygon(rings[0], rings[1:]).area
    w = np.array(normal) / np.linalg.norm(normal)
    u = np.cross(w, np.eye(3)[np.argmin(np.abs(w))])
    u /= np.linalg.norm(u)
    axes = np.stack([u, np.cross(w, u)])
    mesh = triangulate_surfaces([[ring @ axes + (1000.0, -500.0, 30.0) for ring in rings]])
    assert area_m2(mesh.vertices_m, mesh.faces) == pytest.approx(expected, rel=1e-9)
    a, b, c = (mesh.vertices_m[mesh.faces[:, corner]] for corner in range(3))
    assert (np.cross(b - a, c - a) @ w > 0).all()
    assert mesh.crossing == 0


def test_degenerate_rings_are_counted() -> None:
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    point = np.array([[0.0, 0, 0]])
    square = np.array(box_rings((0, 0, 0), (2, 2, 2))[0], dtype=float)
    mesh = triangulate_surfaces([[line], [point], [np.empty((0, 3))], [square, line]])
    assert (mesh.degenerate_rings, len(mesh.faces)) == (4, 2)
    nothing = triangulate_surfaces([[line]])
    assert (len(nothing.vertices_m), len(nothing.faces)) == (0, 0)
    assert len(triangulate_surfaces([]).faces) == 0


def test_crossing_polygon_is_counted() -> None:
    bow_tie = np.array([[0.0, 0, 0], [2, 2, 0], [2, 0, 0], [0, 1, 0]])
    assert triangulate_surfaces([[bow_tie]]).crossing == 1
