"""Heights of buildings for which the map has none, and which objects stand on the carriageway.

:func:`heights_from_neighbours` takes the median of the known heights near by; :func:`heights_from_surface` takes the
difference of a surface model and a terrain model inside the outline. Both replace only heights that were assumed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from egvs.core.grid import FloatArray
from egvs.creation.map_parts import ImportCounts, MappedMesh, MappedSolid, Terrain
from egvs.world.clearances import CLEARANCE_M, KERB_M

ASSUMED = "default"
"""The ``height_source`` of solids whose height is not known."""

NEIGHBOURS, SURFACE_MODEL = "neighbours", "surface model"
"""The ``height_source`` of solids with a height from this module."""

NEIGHBOUR_M, MIN_NEIGHBOURS = 100.0, 3

MIN_HEIGHT_M = 2.0
"""Lower objects in a surface model are no buildings, e.g. a place where a building was removed."""

_KNOWN = frozenset({"height", "levels", "geometry", SURFACE_MODEL})
_SAMPLE_M = 1.0
_MIN_SAMPLES = 3
_MAX_SAMPLES = 10_000


def heights_from_neighbours(
    solids: Sequence[MappedSolid], counts: ImportCounts, meshes: Sequence[MappedMesh] = ()
) -> list[MappedSolid]:
    """Give buildings without a height the median height of their neighbours.

    Neighbours are the buildings whose centres are within :data:`NEIGHBOUR_M` and whose heights are known, from the map
    or from their mesh. With fewer than :data:`MIN_NEIGHBOURS` of them, the assumed height stays.

    Parameters
    ----------
    solids
        All solids of the scenario.
    counts
        Their ``heights`` are updated.
    meshes
        Buildings with a mesh; their heights count as known.

    Returns
    -------
    list of MappedSolid
        All solids in their order.
    """
    known = [solid for solid in solids if solid.kind == "building" and solid.height_source in _KNOWN]
    centres = [solid.geometry.centroid for solid in known]
    heights_m = [solid.height_m for solid in known]
    for mesh in meshes:
        if mesh.kind == "building":
            low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
            centres.append(shapely.Point((low[:2] + high[:2]) / 2))
            heights_m.append(float(high[2] - low[2]))
    tree = shapely.STRtree(centres)
    known_m = np.array(heights_m)

    def neighbours_height_m(solid: MappedSolid) -> float | None:
        near = tree.query(solid.geometry.centroid, predicate="dwithin", distance=NEIGHBOUR_M)
        return float(np.median(known_m[near])) if len(near) >= MIN_NEIGHBOURS else None

    return _with_heights(solids, counts, neighbours_height_m, NEIGHBOURS)


def heights_from_surface(
    solids: Sequence[MappedSolid], counts: ImportCounts, surface: Terrain, ground: Terrain
) -> list[MappedSolid]:
    """Give buildings without a height the median difference of a surface model and the ground inside their outlines.

    The models are sampled every metre. The assumed height stays where fewer than three samples are known, or where
    their median is below :data:`MIN_HEIGHT_M`.

    Parameters
    ----------
    solids
        All solids of the scenario.
    counts
        Their ``heights`` are updated.
    surface, ground
        Heights of roofs and trees, and of the ground, in the same vertical system.
    """

    def height_m(solid: MappedSolid) -> float | None:
        points = sample_points(solid.geometry)
        heights = surface.height_m(points) - ground.height_m(points)
        heights = heights[np.isfinite(heights)]
        if len(heights) < _MIN_SAMPLES:
            return None
        median_m = float(np.median(heights))
        return median_m if median_m >= MIN_HEIGHT_M else None

    return _with_heights(solids, counts, height_m, SURFACE_MODEL)


def sample_points(area: BaseGeometry) -> FloatArray:
    """Return points (n, 2) of a grid inside an area, one for each square metre, fewer in a very large one."""
    x0, y0, x1, y1 = area.bounds
    step_m = max(_SAMPLE_M, float(np.sqrt((x1 - x0) * (y1 - y0) / _MAX_SAMPLES)))
    x = np.arange(x0 + step_m / 2, x1, step_m)
    y = np.arange(y0 + step_m / 2, y1, step_m)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    points: FloatArray = grid[shapely.contains_xy(area, grid[:, 0], grid[:, 1])]
    return points


def _with_heights(
    solids: Sequence[MappedSolid], counts: ImportCounts, height_m: Callable[[MappedSolid], float | None], source: str
) -> list[MappedSolid]:
    """Replace the assumed heights of buildings where another is known, and count them."""
    replaced = []
    for solid in solids:
        height = None
        if solid.kind == "building" and solid.height_source == ASSUMED:
            height = height_m(solid)
        if height is None or height <= solid.base_m:
            replaced.append(solid)
            continue
        counts.heights["building"][ASSUMED] -= 1
        counts.heights["building"][source] += 1
        replaced.append(replace(solid, height_m=height, height_source=source))
    counts.heights = {kind: +sources for kind, sources in counts.heights.items()}
    return replaced


def objects_on_carriageway(
    meshes: Sequence[MappedMesh], lanes: Sequence[BaseGeometry], ground_m: Callable[[FloatArray], FloatArray]
) -> list[str]:
    """Return the names of meshes that reach into the space of vehicles.

    That is the space over a lane, above a kerb and below the clearance.

    Parameters
    ----------
    meshes
        Static objects.
    lanes
        Areas of the carriageway, in the world frame.
    ground_m
        Heights of the ground (n,) at points (n, 2), in the vertical system of the meshes.
    """
    tree = shapely.STRtree(list(lanes))
    return [mesh.name for mesh in meshes if mesh.kind != "ground" and _is_over_lane(mesh, tree, ground_m)]


def _is_over_lane(mesh: MappedMesh, lanes: shapely.STRtree, ground_m: Callable[[FloatArray], FloatArray]) -> bool:
    low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
    if not len(lanes.query(shapely.box(*low[:2], *high[:2]))):
        return False
    corners = mesh.vertices_m[mesh.faces]
    ground = ground_m(corners[:, :, :2].mean(axis=1))
    is_low = corners[:, :, 2].min(axis=1) < ground + CLEARANCE_M
    is_high = corners[:, :, 2].max(axis=1) > ground + KERB_M
    # A wall is a line from above; a triangle with an area of 0 is no valid polygon, but its outline is a valid line.
    near = corners[is_low & is_high]
    low, high = near[:, :, :2].min(axis=1), near[:, :, :2].max(axis=1)
    near = near[np.unique(lanes.query(shapely.box(*low.T, *high.T))[0])]
    areas = shapely.convex_hull(shapely.linestrings(near[:, [0, 1, 2, 0], :2]))
    return bool(len(lanes.query(areas, predicate="intersects")[0]))
