"""The ground of a new scenario: where z = 0 is, and how its roads follow the terrain.

Maps count heights from sea level; the world frame counts from the ground at the junction. :func:`find_zero` states the
height of z = 0, which is then subtracted from all maps with heights above sea level. :func:`lay_on_ground` gives the
roads their heights: those of the terrain if the road map has none.

All maps are assumed to use the same vertical datum. Differences between datums (a geoid, a local tide gauge) are
constant within a junction; where the road map and the terrain both have heights, their difference is measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from shapely.geometry import box

from egvs.creation.junctions import StreetJunction, Streets
from egvs.creation.map_parts import MapContext, MappedMesh, RoadMap, Terrain
from egvs.creation.map_readers import MapFile, reading
from egvs.creation.road_source import NetworkRoads, RoadSource
from egvs.creation.terrain import draping, network_heights, relief
from egvs.creation.terrain.ground_heights import CombinedTerrain, ExtendedTerrain, TinTerrain

_MARGIN_M = 10.0

_LARGE_SPREAD_M = 1.0
"""A terrain whose difference from the roads varies by more than this may be another place or an old survey."""


@dataclass(frozen=True)
class ZeroHeight:
    """The height above sea level of z = 0; ``height_m`` is None if no map of roads or terrain states heights."""

    height_m: float | None = None
    notes: tuple[str, ...] = ()


def read_terrain(files: Sequence[MapFile], context: MapContext) -> Terrain | None:
    """Return the ground of all terrain files; None without any; InputError when a file is damaged."""
    by_reader: dict[str, list[MapFile]] = {}
    for file in files:
        by_reader.setdefault(file.reader.name, []).append(file)
    terrains = []
    for group in by_reader.values():
        with reading(group):
            terrains.append(group[0].module.read_terrain(tuple(file.path for file in group), context))
    if not terrains:
        return None
    return terrains[0] if len(terrains) == 1 else CombinedTerrain(tuple(terrains))


def measured_ground(mesh: MappedMesh) -> Terrain:
    """Return the ground of a point cloud; beyond it, that of its nearest point."""
    note = "The ground is that of the point cloud; beyond the cloud it continues at the nearest height."
    return ExtendedTerrain(TinTerrain(mesh.vertices_m, mesh.faces, (note,)))


def with_roads(context: MapContext, streets: Streets) -> MapContext:
    """Return a context whose window also covers all roads."""
    corners_m = np.array([area.bounds for area in streets.areas.values() if not area.is_empty])
    low_m, high_m = corners_m[:, :2].min(axis=0), corners_m[:, 2:].max(axis=0)
    return replace(context, window=context.window.union(box(*low_m, *high_m).buffer(_MARGIN_M)))


def find_zero(
    roads: RoadSource,
    file: MapFile,
    junction: StreetJunction,
    terrain: Terrain | None,
    terrain_files: Sequence[MapFile] = (),
) -> ZeroHeight:
    """Return the height of z = 0.

    Parameters
    ----------
    roads, file
        The roads, and their map.
    junction
        z = 0 is its ground, unless the road map keeps its heights.
    terrain
        The ground; None without a terrain.
    terrain_files
        Its files, for messages.

    Raises
    ------
    InputError
        When the terrain has no height there.
    """
    has_heights = roads.streets.network.has_heights
    road_height_m = 0.0
    if has_heights and not roads.keeps_heights:
        road_height_m = round(float(np.median(relief.lane_heights_near(roads.streets, junction))), 3)
    if terrain is None:
        return ZeroHeight(road_height_m if has_heights else None)
    if not has_heights:
        return ZeroHeight(draping.ground_height_m(terrain, junction.at_m, _names(terrain_files) or file.path))
    measured = terrain.terrain if isinstance(terrain, ExtendedTerrain) else terrain
    difference_m, spread_m = draping.level_difference_m(roads.network, measured, _names(terrain_files) or file.path)
    note = f"The terrain is {difference_m:+.2f} m above the heights of the road map (median; spread {spread_m:.2f} m)."
    if spread_m > _LARGE_SPREAD_M:
        note += " So large a spread suggests that one of them is wrong, or of another place."
    return ZeroHeight(road_height_m + difference_m, (note,))


def lay_on_ground(
    roads: RoadSource,
    file: MapFile,
    junction: StreetJunction,
    terrain: Terrain | None,
    terrain_files: Sequence[MapFile] = (),
) -> RoadSource:
    """Return the roads with heights that count from the ground at a junction.

    Parameters
    ----------
    roads, file
        The roads, and their map.
    junction
        The junction.
    terrain
        The ground; None without a terrain.
    terrain_files
        Its files, for messages.

    Raises
    ------
    InputError
        When the terrain has no height at a road.
    """
    if roads.streets.network.has_heights:
        if roads.keeps_heights:
            return roads
        zero_m = find_zero(roads, file, junction, None).height_m
        if not zero_m:
            return roads
        note = f"z = 0 is a height of {zero_m:.2f} m, that of the lanes at the junction."
        return _with_network(roads, network_heights.shift_heights(roads.network, -zero_m), (note,), file.path)
    if terrain is None:
        return roads
    where = _names(terrain_files) or file.path
    draped = draping.drape_network(roads.network, terrain, junction.at_m, roads.edge_levels(), where)
    return _with_network(roads, draped.text, draped.notes, file.path)


def _names(files: Sequence[MapFile]) -> str:
    return ", ".join(str(file.path) for file in files)


def _with_network(roads: RoadSource, network: str, notes: Sequence[str], path: Path) -> NetworkRoads:
    return NetworkRoads.read(RoadMap(network, roads.attribution, (*roads.notes, *notes), has_heights=True), path)
