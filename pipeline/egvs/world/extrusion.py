"""Closed prisms over polygons.

The vertices and faces are those of ``trimesh.creation.extrude_polygon`` with the engine earcut, in the same order
(trimesh 5.2), without the import of trimesh, which takes longer than building the world of a junction.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from egvs.core.grid import FloatArray, IntArray

if TYPE_CHECKING:
    from shapely import Polygon


_MERGED_DIGITS = 8
"""Vertices that are equal when rounded to this number of decimals are one."""

_WOUND = 10
"""Triangles that tell in which direction a triangulation is wound."""


def extrude_polygon(polygon: Polygon, height_m: float) -> tuple[FloatArray, IntArray]:
    """Return vertices and faces (outwards) of a closed prism.

    Parameters
    ----------
    polygon
        The base, at z = 0; may have holes.
    height_m
        Height of the prism, above 0.

    Returns
    -------
    vertices_m, faces
        (n, 3) float64, and (m, 3) int64.
    """
    corners, triangles = _triangulate(polygon)
    sides = corners[_boundary_edges(triangles)]

    bottom = np.column_stack([corners, np.zeros(len(corners))])
    top = np.column_stack([corners, np.full(len(corners), height_m)])
    walls = np.column_stack(
        [np.tile(sides.reshape(-1, 2), 2).reshape(-1, 2), np.tile([0.0, height_m, 0.0, height_m], len(sides))]
    )
    wall_faces = (np.array([3, 1, 2, 2, 1, 0]) + 4 * np.arange(len(sides))[:, None]).reshape(-1, 3)
    faces = [triangles[:, ::-1], triangles + len(corners), wall_faces + 2 * len(corners)]
    return _merge_vertices(np.concatenate([bottom, top, walls]), np.concatenate(faces))


def _triangulate(polygon: Polygon) -> tuple[FloatArray, IntArray]:
    """Return corners (n, 2) and triangles (m, 3), counter-clockwise, of a polygon."""
    from mapbox_earcut import triangulate_float64

    rings = [np.array(ring.coords) for ring in (polygon.exterior, *polygon.interiors)]
    corners = np.vstack(rings)
    ends = np.cumsum([len(ring) for ring in rings])
    triangles = triangulate_float64(corners, ends).reshape(-1, 3).astype(np.int64)

    first, second, third = corners[triangles[:_WOUND].T]
    a, b = first - second, second - third
    areas = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    if len(areas) and np.sign(areas.mean()) != 1:
        triangles = np.fliplr(triangles)
    return corners, triangles


def _boundary_edges(triangles: IntArray) -> IntArray:
    """Return the edges that one triangle has alone, (n, 2), in the order of their larger, then smaller corner."""
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    low, high = edges.min(axis=1), edges.max(axis=1)
    order = np.lexsort((low, high))
    is_new = np.ones(len(edges) + 1, dtype=np.bool_)
    is_new[1:-1] = (np.diff(low[order]) != 0) | (np.diff(high[order]) != 0)
    return edges[order[is_new[:-1] & is_new[1:]]]


def _merge_vertices(vertices_m: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Merge equal vertices, and drop those that no face has; the others keep their order."""
    is_used = np.zeros(len(vertices_m), dtype=np.bool_)
    is_used[faces] = True
    used = np.flatnonzero(is_used)
    rounded = (vertices_m[used] * 10**_MERGED_DIGITS).round().astype(np.int64)
    _, first, group = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    number = np.zeros(len(vertices_m), dtype=np.int64)
    number[used] = rank[group.reshape(-1)]
    return vertices_m[used[first[order]]], number[faces]
