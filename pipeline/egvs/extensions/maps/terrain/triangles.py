"""Terrains from the triangles of files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.core.wording import by_number, number_of
from egvs.creation.map_parts import MapContext
from egvs.creation.terrain.ground_heights import HIGHEST_M, LOWEST_M, CombinedTerrain, TinTerrain, cross_z

_MIN_AREA_M2 = 1e-9


def tin_terrain(
    vertices: FloatArray, faces: IntArray, crs: str | None, where: str, context: MapContext, notes: Sequence[str] = ()
) -> TinTerrain | None:
    """Return the terrain of triangles of a file; None if no triangle is in the region.

    Parameters
    ----------
    vertices
        (n, 3) float64: x, y in the file's system, z in metres.
    faces
        (m, 3) int64.
    crs
        The file's reference system; None if it declares none.
    where
        The file, for messages.
    context
        The region; triangles outside its window are left out.
    notes
        Further sentences for the user.

    Raises
    ------
    InputError
        When a height in the region is impossible, or the coordinates cannot be converted.
    """
    vertices_m = np.column_stack([context.to_world(vertices[:, :2], crs, where), vertices[:, 2]])
    corners = vertices_m[faces]
    low, high = corners[:, :, :2].min(axis=1), corners[:, :, :2].max(axis=1)
    x0, y0, x1, y1 = context.window.bounds
    is_near = (high[:, 0] >= x0) & (low[:, 0] <= x1) & (high[:, 1] >= y0) & (low[:, 1] <= y1)
    area = cross_z(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    is_used = is_near & (np.abs(area) > _MIN_AREA_M2)
    if not is_used.any():
        return None
    heights = corners[is_used, :, 2]
    check_heights(heights, where)
    summary = (
        f"{where}: terrain of {np.count_nonzero(is_used):,} triangles in the region, {heights.min():.1f} to"
        f" {heights.max():.1f} m high; {np.count_nonzero(~is_used):,} outside it or without area were left out."
    )
    used, inverse = np.unique(faces[is_used], return_inverse=True)
    return TinTerrain(vertices_m[used], inverse.reshape(-1, 3), (summary, *notes))


def combine_tins(terrains: Sequence[TinTerrain | None], where: str) -> CombinedTerrain:
    """Return the terrain of several surfaces; where they overlap, of the first.

    Parameters
    ----------
    terrains
        From :func:`tin_terrain`; None for surfaces outside the region, which a note counts.
    where
        The files, for messages.

    Raises
    ------
    InputError
        When all surfaces are outside the region.
    """
    inside = tuple(terrain for terrain in terrains if terrain is not None)
    if not inside:
        raise InputError(where, "the terrain has no triangle in the region", "Use a terrain that covers the road map.")
    left_out = len(terrains) - len(inside)
    if left_out:
        note = (
            f"{left_out:,} of {number_of(len(terrains), 'terrain surface')} outside the region"
            f" {by_number(left_out, 'was', 'were')} left out."
        )
        inside = (*inside[:-1], replace(inside[-1], notes=(*inside[-1].notes, note)))
    return CombinedTerrain(inside)


def check_heights(heights_m: FloatArray, where: str) -> None:
    """Raise an InputError if a known height cannot be one."""
    wrong = heights_m[(heights_m < LOWEST_M) | (heights_m > HIGHEST_M)]
    if len(wrong):
        problem = f"expected heights of {LOWEST_M:,.0f} to {HIGHEST_M:,.0f} m, got {wrong[0]:g} m"
        raise InputError(where, problem, "Check the heights, their unit, and which value stands for no data.")
