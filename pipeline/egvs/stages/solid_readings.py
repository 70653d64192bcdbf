"""Other readings of solids: in feet, with x and y swapped, mirrored, with y up.

Coordinates have no mark of their unit or axes, so a wrong reading shows only where it contradicts the roads:

- Footprints in feet, swapped or mirrored are named where they cover lanes, and would cover almost none in another
  reading. Where they cover none, nothing tells; nor does anything tell heights in feet, for tall houses exist.
- A mesh with y up (the standard of glTF; OBJ has none) is named where much of it is below all roads, or all of it above
  them, and where turned it would stand on the ground beside them.
- A mesh of some centimetres is in kilometres, or in another unit.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from egvs.core.errors import Diagnostic
from egvs.core.grid import FloatArray
from egvs.stages.inputs import CheckInputs
from egvs.world import clearances
from egvs.world.mesh import World
from egvs.world.static_world import MESHES

MIN_COVERED_SHARE = 0.03
"""Share of the lanes that must be covered before other readings are tried."""

MAX_FREE_SHARE = 0.1
"""In a reading free of the lanes, the share of the solids over lanes is at most this part of the stated one."""

MIN_BELOW_SHARE, MAX_BELOW_SHARE = 0.2, 0.02
"""Share of the area of a mesh below all roads: of one with y up, and of one that is turned as it should be."""

MARGIN_M = 3.0
"""Basements and embankments are no farther from the height of the roads."""

MIN_MESH_M = 0.2
"""No mesh of a static world is smaller in all directions."""

_FOOT_M = 0.3048

_READINGS = {
    "in feet": np.diag([_FOOT_M, _FOOT_M]),
    "with x and y swapped": np.array([[0.0, 1.0], [1.0, 0.0]]),
    "with y mirrored": np.diag([1.0, -1.0]),
    "with x mirrored": np.diag([-1.0, 1.0]),
}


def describe_free_readings(world: World, lanes: Any, low_m: FloatArray, high_m: FloatArray) -> str | None:
    """Return the readings in which solids that cover lanes cover almost none, in words; None without such a reading.

    Parameters
    ----------
    world
        The static world.
    lanes
        Area of the lanes around the region of interest.
    low_m, high_m
        Corners of this surrounding, (2,).
    """
    is_solid = np.array([kind != "ground" for _, kind in world.solids], dtype=np.bool_)
    triangles_m = world.triangles_m[is_solid[world.solid_of_face]][:, :, :2]
    covered, around = _covered_share(triangles_m, lanes, low_m, high_m)
    names = []
    for name, matrix in _READINGS.items():
        read_covered, read_around = _covered_share(triangles_m @ matrix.T, lanes, low_m, high_m)
        if read_covered <= MAX_FREE_SHARE * covered and 2 * read_around >= around:
            names.append(name)
    return f"read {' or '.join(names)}" if names else None


def _covered_share(triangles_m: FloatArray, lanes: Any, low_m: FloatArray, high_m: FloatArray) -> tuple[float, int]:
    """Return the share of triangles in plan, (n, 3, 2), that is over lanes, and how many of these are around."""
    import shapely

    is_around = (triangles_m.min(axis=1) <= high_m).all(axis=1) & (triangles_m.max(axis=1) >= low_m).all(axis=1)
    shapes = shapely.polygons(triangles_m[is_around])
    over_lanes_m2 = float(shapely.area(shapely.intersection(shapes, lanes)).sum())
    return over_lanes_m2 / max(float(shapely.area(shapes).sum()), 1e-9), int(is_around.sum())


def warn_mesh_axes(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn about meshes that look as if y, not z, were up, and about tiny ones."""
    if inputs.world is None:
        return
    world = inputs.world
    for source in inputs.solid_sources:
        if source.key != MESHES:
            continue
        is_part = (world.solid_of_face >= source.first) & (world.solid_of_face < source.end)
        triangles_m = world.triangles_m[is_part]
        if not len(triangles_m):
            continue
        size_m = np.ptp(triangles_m.reshape(-1, 3), axis=0)
        if size_m.max() < MIN_MESH_M:
            problem = f"expected a mesh in metres, got one of {' x '.join(f'{side:.2g}' for side in size_m)} m"
            yield Diagnostic("mesh units", source.where, problem, "Scale it to metres.")
        elif inputs.carriageway is not None and _has_y_up(triangles_m, inputs):
            problem = (
                "expected z up, got a mesh that stands on the ground beside the roads only with y up: now it is"
                f" at z = {triangles_m[:, :, 2].min():,.0f} to {triangles_m[:, :, 2].max():,.0f} m"
            )
            hint = "Turn it to z up: (x, y, z) becomes (x, -z, y). glTF has y up by its standard."
            yield Diagnostic("mesh axes", source.where, problem, hint)


def _has_y_up(triangles_m: FloatArray, inputs: CheckInputs) -> bool:
    """Return whether triangles (n, 3, 3) fit the heights of the roads with y up only."""
    assert inputs.carriageway is not None
    box = inputs.scenario.roi.box
    low_m = np.asarray(box.origin_m[:2]) - clearances.ROI_MARGIN_M
    high_m = np.add(box.origin_m, box.size_m)[:2] + clearances.ROI_MARGIN_M
    roads_m = inputs.carriageway.heights_in(low_m, high_m)
    if not roads_m.size:
        return False
    turned_m = np.stack([triangles_m[:, :, 0], -triangles_m[:, :, 2], triangles_m[:, :, 1]], axis=2)
    corners_m = turned_m.reshape(-1, 3)
    is_around = (corners_m[:, :2].min(axis=0) <= high_m).all() and (corners_m[:, :2].max(axis=0) >= low_m).all()
    lowest_m, highest_m = float(roads_m.min()), float(roads_m.max())
    stands = lowest_m - MARGIN_M <= corners_m[:, 2].min() <= highest_m + MARGIN_M
    if not (is_around and stands):
        return False
    area_m2 = np.linalg.norm(
        np.cross(triangles_m[:, 1] - triangles_m[:, 0], triangles_m[:, 2] - triangles_m[:, 0]), axis=1
    )
    is_below = triangles_m[:, :, 2].mean(axis=1) < lowest_m - MARGIN_M
    is_turned_below = turned_m[:, :, 2].mean(axis=1) < lowest_m - MARGIN_M
    floats = bool(triangles_m[:, :, 2].min() > highest_m + MARGIN_M)
    below_share = float(area_m2 @ is_below / area_m2.sum())
    turned_share = float(area_m2 @ is_turned_below / area_m2.sum())
    return (below_share >= MIN_BELOW_SHARE or floats) and turned_share <= MAX_BELOW_SHARE
