"""Heights of the ground, from triangulated surfaces, at points of the world frame.

In a triangle, heights are linear; where triangles lie above each other, the lowest counts. World frame, metres; heights
as in the files.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from egvs.core import limits
from egvs.core.grid import FloatArray, IntArray
from egvs.creation.map_parts import Terrain

if TYPE_CHECKING:
    from scipy.spatial import KDTree

LOWEST_M, HIGHEST_M = -1000.0, 9000.0
"""Limits of heights above sea level; -9999, which often stands for unknown heights, is below."""

_QUERY = 100_000


@dataclass(frozen=True, eq=False)
class TinTerrain:
    """Heights from triangles.

    Attributes
    ----------
    vertices_m
        (n, 3) float64, world frame, with the heights of the file.
    faces
        (m, 3) int64.
    notes
        Sentences for the user.
    """

    vertices_m: FloatArray
    faces: IntArray
    notes: tuple[str, ...] = ()

    @cached_property
    def _tree(self) -> shapely.STRtree:
        return shapely.STRtree(shapely.polygons(self.vertices_m[self.faces][:, :, :2]))

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        """Return the heights (n,) of the ground at world-frame points (n, 2); NaN where unknown."""
        heights = np.full(len(xy_m), np.nan)
        for start in range(0, len(xy_m), _QUERY):
            part = slice(start, start + _QUERY)
            heights[part] = self._part_height_m(xy_m[part])
        return heights

    def _part_height_m(self, xy_m: FloatArray) -> FloatArray:
        point, face = self._tree.query(shapely.points(xy_m), predicate="intersects")
        a, b, c = (self.vertices_m[self.faces[face, corner]] for corner in range(3))
        at = xy_m[point]
        area = cross_z(b - a, c - a)
        share_b = cross_z(at - a[:, :2], c - a) / area
        share_c = cross_z(b - a, at - a[:, :2]) / area
        height = a[:, 2] + share_b * (b[:, 2] - a[:, 2]) + share_c * (c[:, 2] - a[:, 2])
        heights = np.full(len(xy_m), np.inf)
        np.minimum.at(heights, point, height)
        heights[np.isinf(heights)] = np.nan
        return heights


@dataclass(frozen=True)
class ExtendedTerrain:
    """Triangles, and beyond them the height of the nearest vertex."""

    terrain: TinTerrain

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the user."""
        return self.terrain.notes

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        """Return the heights (n,) of the ground at world-frame points (n, 2)."""
        heights_m = self.terrain.height_m(xy_m)
        beyond = np.flatnonzero(np.isnan(heights_m))
        if len(beyond):
            nearest = self._vertices.query(xy_m[beyond])[1]
            heights_m[beyond] = self.terrain.vertices_m[nearest, 2]
        return heights_m

    @cached_property
    def _vertices(self) -> KDTree:
        from scipy.spatial import KDTree  # its import takes long, and flat maps need none

        return KDTree(self.terrain.vertices_m[:, :2])


@dataclass(frozen=True)
class CombinedTerrain:
    """Heights from several terrains; at each point, from the first that knows its height."""

    terrains: tuple[Terrain, ...]
    notes: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "notes", tuple(note for terrain in self.terrains for note in terrain.notes))

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        """Return the heights (n,) of the ground at world-frame points (n, 2); NaN where unknown."""
        heights = np.full(len(xy_m), np.nan)
        for terrain in self.terrains:
            unknown = np.flatnonzero(np.isnan(heights))
            if len(unknown):
                heights[unknown] = terrain.height_m(xy_m[unknown])
        return heights


def ground_points(terrain: Terrain, window: BaseGeometry, step_m: float) -> FloatArray:
    """Sample a terrain on a square grid.

    Parameters
    ----------
    terrain
        The ground.
    window
        World frame, metres.
    step_m
        Distance of the points.

    Returns
    -------
    ndarray of float64
        (n, 3), world frame with the terrain's heights; points of unknown height are left out.

    Raises
    ------
    InputError
        When there would be too many points.
    """
    x0, y0, x1, y1 = window.bounds
    columns, rows = np.floor((x1 - x0) / step_m) + 1, np.floor((y1 - y0) / step_m) + 1
    limits.GROUND_POINTS.check("the terrain", columns * rows, f"needs {columns * rows:,.0f} points in the region")
    xy_m = _grid_inside(window, x0 + step_m * np.arange(columns), y0 + step_m * np.arange(rows))
    heights_m = terrain.height_m(xy_m)
    is_known = np.isfinite(heights_m)
    return np.column_stack([xy_m[is_known], heights_m[is_known]])


def cross_z(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the vertical part of the vector product of vectors (n, 2 or 3)."""
    return one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]


def window_points(window: BaseGeometry) -> FloatArray:
    """Return some 2,500 points in a window."""
    x0, y0, x1, y1 = window.bounds
    return _grid_inside(window, np.linspace(x0, x1, 50), np.linspace(y0, y1, 50))


def _grid_inside(window: BaseGeometry, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
    """Return the points (n, 2) of a grid that are in a window."""
    x, y = np.meshgrid(x_m, y_m)
    xy_m = np.column_stack([x.ravel(), y.ravel()])
    inside: FloatArray = xy_m[shapely.covers(window, shapely.points(xy_m))]
    return inside
