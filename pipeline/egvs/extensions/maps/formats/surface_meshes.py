"""Triangulate polygons in space: walls, roofs, whole buildings.

Steps: merge corners that are equal to a millimetre; drop rings without area; find the plane of each polygon by Newell's
method (Sutherland, Sproull, Schumacker 1974, ACM Computing Surveys 6(1)); triangulate it in its plane (ear clipping,
mapbox-earcut); tell whether the triangles enclose a volume. Triangles have the orientation of their polygon's outer
ring.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egvs.core.grid import FloatArray, IntArray

MERGED_M = 0.001
"""Corners that are equal when rounded to this length are one."""

_MIN_AREA_M2 = 1e-6
_MAX_AREA_ERROR = 0.01
_NO_FACES = np.empty((0, 3), dtype=np.int64)


@dataclass(frozen=True)
class SurfaceMesh:
    """Triangles of polygons.

    Attributes
    ----------
    vertices_m
        (n, 3) float64.
    faces
        (m, 3) int64.
    degenerate_rings
        How many rings without area were left out.
    crossing
        How many polygons cross themselves, so that their triangles are only approximate.
    """

    vertices_m: FloatArray
    faces: IntArray
    degenerate_rings: int = 0
    crossing: int = 0

    @property
    def is_closed(self) -> bool:
        """Whether the triangles enclose a volume (see :func:`encloses_volume`)."""
        return encloses_volume(self.faces)


def encloses_volume(faces: IntArray) -> bool:
    """Return whether each edge of triangles (m, 3) is passed as often in one direction as in the other."""
    if not len(faces):
        return False
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    direction = np.where(edges[:, 0] < edges[:, 1], 1, -1)
    _, edge = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    return not np.bincount(edge.reshape(-1), weights=direction).any()


def triangulate_surfaces(surfaces: Sequence[Sequence[FloatArray]]) -> SurfaceMesh:
    """Triangulate polygons.

    Parameters
    ----------
    surfaces
        Rings of each polygon, the outer one first, then holes: (n, 3) float64 each, in metres. Whether a ring repeats
        its first point at its end does not matter.
    """
    rings = [ring for surface in surfaces for ring in surface]
    if not rings:
        return SurfaceMesh(np.empty((0, 3)), _NO_FACES)
    vertices_m, index = _merge(np.concatenate(rings))
    indices = np.split(index, np.cumsum([len(ring) for ring in rings])[:-1])

    faces = [_NO_FACES]
    degenerate = crossing = first = 0
    for surface in surfaces:
        corners = [_without_repetitions(ring) for ring in indices[first : first + len(surface)]]
        first += len(surface)
        sound = [ring for ring in corners if _area_m2(vertices_m[ring]) >= _MIN_AREA_M2]
        degenerate += len(corners) - len(sound)
        if not sound or sound[0] is not corners[0]:
            continue
        triangles, is_simple = _triangulate(vertices_m, sound)
        faces.append(triangles)
        crossing += not is_simple
    used, renumbered = np.unique(np.concatenate(faces), return_inverse=True)
    return SurfaceMesh(vertices_m[used], renumbered.reshape(-1, 3).astype(np.int64), degenerate, crossing)


def _merge(points_m: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the different points, and the number of each point among them."""
    rounded = np.round((points_m - points_m[0]) / MERGED_M).astype(np.int64)
    _, first, index = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    return points_m[first], index.reshape(-1).astype(np.int64)


def _without_repetitions(ring: IntArray) -> IntArray:
    """Return a closed ring without corners that are equal to the previous one."""
    different: IntArray = ring[ring != np.roll(ring, 1)]
    return different


def _normal(ring_m: FloatArray) -> FloatArray:
    """Return the normal of a ring, as long as twice its area (Newell)."""
    points = ring_m - ring_m[0]
    normal: FloatArray = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    return normal


def _area_m2(ring_m: FloatArray) -> float:
    return float(np.linalg.norm(_normal(ring_m))) / 2 if len(ring_m) > 2 else 0.0


def _triangulate(vertices_m: FloatArray, rings: Sequence[IntArray]) -> tuple[IntArray, bool]:
    """Return the triangles of a polygon, and whether they cover its area."""
    from mapbox_earcut import triangulate_float64

    if len(rings) == 1 and len(rings[0]) == 3:
        return rings[0][None, :], True
    corners = np.concatenate(rings)
    points = vertices_m[corners] - vertices_m[corners[0]]
    in_plane = points @ _plane_axes(_normal(vertices_m[rings[0]])).T
    ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
    triangles = triangulate_float64(np.ascontiguousarray(in_plane), ends).reshape(-1, 3).astype(np.int64)

    a, b, c = in_plane[triangles[:, 0]], in_plane[triangles[:, 1]], in_plane[triangles[:, 2]]
    areas = ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])) / 2
    if areas.sum() < 0:
        triangles = triangles[:, ::-1]
    outer, *holes = [_area_m2(vertices_m[ring]) for ring in rings]
    expected = outer - sum(holes)
    is_simple = abs(np.abs(areas).sum() - expected) <= _MAX_AREA_ERROR * outer
    return corners[triangles], bool(is_simple)


def _plane_axes(normal: FloatArray) -> FloatArray:
    """Return two unit vectors (2, 3) that span the plane of a normal; with it they are right-handed."""
    unit = normal / np.linalg.norm(normal)
    helper = np.zeros(3)
    helper[np.argmin(np.abs(unit))] = 1.0
    first = np.cross(helper, unit)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(unit, first)])
