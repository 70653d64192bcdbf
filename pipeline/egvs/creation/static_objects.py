"""Collect the static objects of a new scenario from all its maps.

Footprints become ``statics.geojson``; meshes become one PLY file for each kind of object. Steps of
:func:`collect_objects`: lower meshes whose heights count from sea level to the network's ground, and lift those whose
heights count from a sloping ground; drop buildings of a base map where another map has one; cut footprints that
cover the carriageway, and name meshes that do; give buildings without a height that of a surface model or of their
neighbours.

World frame: x east, y north in metres; heights in metres above z = 0 of the network.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import shapely
from shapely.geometry import MultiPoint, Point
from shapely.geometry.base import BaseGeometry

from egvs.core.errors import InputError
from egvs.core.grid import XY, FloatArray, Roi
from egvs.core.wording import by_number, list_first, number_of
from egvs.creation import building_heights, map_readers
from egvs.creation.carriageway import clear_of_carriageway
from egvs.creation.junctions import Streets
from egvs.creation.map_parts import OBJECT_KIND, ImportCounts, MapContext, MappedMesh, MappedSolid, SolidMap, Terrain
from egvs.creation.map_readers import MapFile
from egvs.creation.road_source import RoadSource
from egvs.world.terrain import TerrainSurface

REPLACED = "replaced_by_another_map"
"""The reason to leave out a building of a base map."""

_COVERED_SHARE = 0.3
"""A building of a base map is left out if another map's building covers this share of it."""

_NEAREST_BASES = 20
"""Number of meshes whose lowest points tell the height of the ground, where no terrain does."""

_LARGE_DIFFERENCE_M = 5.0

GROUND = "ground"
"""The kind of meshes that are ground; it becomes the terrain of the scenario."""

_LEAST_TRIANGLE_M2 = 1e-6
"""Smaller triangles, seen from above, are walls."""

_SQUARE_M = 0.5
_NEAR_GROUND_M = (0.5, 4.0)
"""Heights above the ground in which the surface of a point cloud is in the way of a pole."""

_MAX_NAMES = 10
"""How many objects a note names."""


@dataclass(frozen=True)
class MapSummary:
    """What a map contributed.

    Attributes
    ----------
    paths, reader
        Its files, and the name of their format.
    counts
        What happened to its objects.
    height_range_m
        Height of the lowest and of the highest object above the ground; None without objects.
    notes
        Sentences for the user.
    """

    paths: tuple[Path, ...]
    reader: str
    counts: ImportCounts
    height_range_m: tuple[float, float] | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class StaticObjects:
    """The static objects of a new scenario.

    Attributes
    ----------
    solids, meshes
        World frame, heights above z = 0 of the network.
    counts
        What happened to the objects of all maps.
    maps
        The same for each map.
    attributions
        Who made the maps, without repetitions.
    zero_height_m
        Height above sea level of z = 0; None if no map states heights above sea level.
    """

    solids: tuple[MappedSolid, ...] = ()
    meshes: tuple[MappedMesh, ...] = ()
    counts: ImportCounts = field(default_factory=ImportCounts)
    maps: tuple[MapSummary, ...] = ()
    attributions: tuple[str, ...] = ()
    zero_height_m: float | None = None

    @property
    def file_names(self) -> list[str]:
        """Names of the files that contributed objects."""
        return [path.name for summary in self.maps if summary.height_range_m for path in summary.paths]

    @property
    def areas(self) -> list[BaseGeometry]:
        """The areas where no pole can stand, seen from above: all objects except the ground.

        A mesh is taken as its outline, the surface of a point cloud as the squares in which it is near the ground.
        """
        areas = [solid.area for solid in self.solids]
        ground = next((mesh for mesh in self.meshes if mesh.kind == GROUND), None)
        for mesh in self.meshes:
            if mesh.kind == OBJECT_KIND and ground is not None:
                areas += _squares_near_ground(mesh, ground)
            elif mesh.kind != GROUND:
                areas.append(outline(mesh))
        return areas


@dataclass(frozen=True)
class ReadMap:
    """The objects of the files of one reader, with heights as the files count them."""

    paths: tuple[Path, ...]
    reader: str
    objects: SolidMap


def read_maps(maps: Sequence[MapFile], roads: RoadSource, road_file: MapFile, context: MapContext) -> list[ReadMap]:
    """Read the static objects of all maps, base maps last: other maps replace their buildings.

    Parameters
    ----------
    maps
        Files with static objects.
    roads, road_file
        The road map, read, and its file.
    context
        The world frame and the window.

    Raises
    ------
    InputError
        When a file is damaged.
    """
    read = []
    for group in _group_by_reader(maps):
        paths = tuple(file.path for file in group)
        objects = roads.solids(context.window) if paths == (road_file.path,) else None
        if objects is None:
            with map_readers.reading(group):
                objects = group[0].module.read_solids(paths, context)
        read.append(ReadMap(paths, group[0].reader.name, objects))
    return sorted(read, key=lambda read_map: read_map.objects.is_base)


def unseen_shares(maps: Sequence[ReadMap], sites_m: FloatArray, roi: Roi) -> FloatArray | None:
    """Return the share of each site's view that no station of a point cloud saw, (n,); None without a point cloud.

    Parameters
    ----------
    maps
        From :func:`read_maps`.
    sites_m
        Sensors, (n, 3), with heights as the point cloud counts them.
    roi
        The region of interest, in the same frame.
    """
    for read in maps:
        shares = read.objects.unseen_shares(sites_m, roi)
        if shares is not None:
            return shares
    return None


def ground_mesh(maps: Sequence[ReadMap]) -> MappedMesh | None:
    """Return the ground of a point cloud; None without a point cloud."""
    meshes = (mesh for read in maps for mesh in read.objects.meshes)
    return next((mesh for mesh in meshes if mesh.kind == GROUND), None)


@dataclass(frozen=True)
class SurfaceModel:
    """Heights of roofs, trees and everything else, and of the ground below, in the same vertical system."""

    surface: Terrain
    ground: Terrain


def collect_objects(
    maps: Sequence[ReadMap],
    streets: Streets,
    middle_m: XY,
    zero_height_m: float | None = None,
    ground: TerrainSurface | None = None,
    surface_model: SurfaceModel | None = None,
) -> StaticObjects:
    """Put the objects of all maps on the ground, clear the carriageway, and assume heights that no map gives.

    Parameters
    ----------
    maps
        From :func:`read_maps`.
    streets
        The carriageway.
    middle_m
        World-frame x, y of the junction.
    zero_height_m
        Height above sea level of z = 0; None if unknown.
    ground
        The ground, world frame; None where it is flat.
    surface_model
        Heights of buildings that no map states; None without one.
    """
    collected = StaticObjects(zero_height_m=zero_height_m)
    for read in maps:
        if read.objects.is_base:
            objects = _without_replaced(read.objects, collected)
        else:
            objects, subtracted_m = _lower_to_ground(read, middle_m, zero_height_m)
            if collected.zero_height_m is None and subtracted_m is not None:
                collected = replace(collected, zero_height_m=subtracted_m)
            if ground is not None and not read.objects.has_absolute_heights:
                objects = _lift_to_ground(objects, ground)
            objects = _clear_of_carriageway(objects, streets, ground)
        collected = _add(collected, objects, read.paths, read.reader)
    if surface_model is not None:
        measured = building_heights.heights_from_surface(
            collected.solids, collected.counts, surface_model.surface, surface_model.ground
        )
        collected = replace(collected, solids=tuple(measured))
    solids = building_heights.heights_from_neighbours(collected.solids, collected.counts, collected.meshes)
    return replace(collected, solids=tuple(solids))


def outline(mesh: MappedMesh) -> BaseGeometry:
    """Return the convex hull of a closed mesh, seen from above, or the area below the triangles of an open one.

    An open mesh may be many objects, such as all buildings of a file.
    """
    if mesh.is_closed:
        return _convex_hull(mesh)
    triangles = shapely.polygons(mesh.vertices_m[mesh.faces][:, :, :2])
    return shapely.union_all(triangles[shapely.area(triangles) > _LEAST_TRIANGLE_M2])


def _convex_hull(mesh: MappedMesh) -> BaseGeometry:
    return MultiPoint(mesh.vertices_m[:, :2]).convex_hull


def _squares_near_ground(mesh: MappedMesh, ground: MappedMesh) -> list[BaseGeometry]:
    """Return the squares of a grid that contain vertices of a surface a little above the ground."""
    from scipy.spatial import KDTree  # its import takes long, and most maps need none

    nearest = KDTree(ground.vertices_m[:, :2]).query(mesh.vertices_m[:, :2])[1]
    height_m = mesh.vertices_m[:, 2] - ground.vertices_m[nearest, 2]
    low_m, high_m = _NEAR_GROUND_M
    is_near = (height_m > low_m) & (height_m < high_m)
    cells = np.unique(np.floor(mesh.vertices_m[is_near, :2] / _SQUARE_M), axis=0) * _SQUARE_M
    return list(shapely.box(*cells.T, *(cells + _SQUARE_M).T))


def mesh_files(meshes: Sequence[MappedMesh]) -> dict[str, Callable[[Path], None]]:
    """Return the functions that write one PLY file for each kind of object, by file name.

    Parameters
    ----------
    meshes
        World-frame metres.
    """
    by_kind: dict[str, list[MappedMesh]] = {}
    for mesh in sorted(meshes, key=lambda mesh: mesh.kind):
        by_kind.setdefault(mesh.kind, []).append(mesh)
    return {f"{kind}.ply": partial(_write_ply, of_kind) for kind, of_kind in by_kind.items()}


def _write_ply(meshes: Sequence[MappedMesh], path: Path) -> None:
    """Write a binary PLY of all triangles; objects share no vertices."""
    first = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
    vertices_m = np.round(np.concatenate([mesh.vertices_m for mesh in meshes]), 4)
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, first[:-1], strict=True)])
    rows = np.empty(len(faces), dtype=[("n", "u1"), ("corners", "<i4", 3)])
    rows["n"], rows["corners"] = 3, faces
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices_m)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode("ascii") + vertices_m.astype("<f8").tobytes() + rows.tobytes())


def _group_by_reader(maps: Sequence[MapFile]) -> list[list[MapFile]]:
    """Return the files of each reader."""
    groups: dict[str, list[MapFile]] = {}
    for file in maps:
        groups.setdefault(file.reader.name, []).append(file)
    return list(groups.values())


def _lower_to_ground(read: ReadMap, middle_m: XY, zero_height_m: float | None) -> tuple[SolidMap, float | None]:
    """Return a map whose heights count from z = 0, and what was subtracted from its heights; None if nothing was.

    Without a known height of z = 0, it is the median of the lowest points of the objects nearest to the junction.
    """
    solid_map = read.objects
    if not solid_map.has_absolute_heights or not solid_map.meshes:
        return solid_map, None
    objects = [mesh for mesh in solid_map.meshes if mesh.kind not in (GROUND, OBJECT_KIND)]
    if objects:
        bases_m = _ground_height_m(objects, middle_m)
    elif zero_height_m is not None:  # a point cloud, whose ground is the terrain
        bases_m = zero_height_m
    else:
        problem = "the points show no ground, so the height of z = 0 is unknown"
        raise InputError(", ".join(map(str, read.paths)), problem, "Add a map of the terrain, or a denser cloud.")
    ground_m = bases_m if zero_height_m is None else zero_height_m
    source = "of the lowest points of the objects nearest to the junction"
    if zero_height_m is not None:
        source = "of the ground at the junction"
    notes = [f"{ground_m:.2f} m, the height {source}, is subtracted from the heights in the map."]
    difference_m = bases_m - ground_m
    if abs(difference_m) > _LARGE_DIFFERENCE_M:
        notes.append(
            f"The objects nearest to the junction begin {abs(difference_m):.1f} m"
            f" {'above' if difference_m > 0 else 'below'} its ground; check that both maps count heights from the same"
            " level."
        )
    meshes = tuple(_shift(mesh, -ground_m) for mesh in solid_map.meshes)
    return replace(solid_map, meshes=meshes, notes=(*solid_map.notes, *notes), has_absolute_heights=False), ground_m


def _lift_to_ground(solid_map: SolidMap, ground: TerrainSurface) -> SolidMap:
    """Return a map whose meshes, with heights above the ground, stand on it: each group below its middle."""
    groups: dict[str, list[MappedMesh]] = {}
    for mesh in solid_map.meshes:
        groups.setdefault(mesh.group or f"mesh {mesh.name}", []).append(mesh)
    lifted: dict[str, MappedMesh] = {}
    notes = []
    for name, meshes in groups.items():
        corners_m = np.concatenate([mesh.vertices_m[:, :2] for mesh in meshes])
        middle_m = (corners_m.min(axis=0) + corners_m.max(axis=0)) / 2
        by_m = float(ground.height_m(middle_m[:1], middle_m[1:])[0])
        lifted |= {mesh.name: _shift(mesh, by_m) for mesh in meshes}
        notes.append(f"{name}: {by_m:.2f} m, the height of the ground below its middle, is added to its heights.")
    meshes_on_ground = tuple(lifted[mesh.name] for mesh in solid_map.meshes)
    return replace(solid_map, meshes=meshes_on_ground, notes=(*solid_map.notes, *notes))


def _ground_height_m(meshes: Sequence[MappedMesh], middle_m: XY) -> float:
    middle = Point(middle_m)
    nearest = sorted(meshes, key=lambda mesh: (outline(mesh).distance(middle), mesh.name))[:_NEAREST_BASES]
    return float(np.median([mesh.vertices_m[:, 2].min() for mesh in nearest]))


def _shift(mesh: MappedMesh, by_m: float) -> MappedMesh:
    vertices_m: FloatArray = mesh.vertices_m + np.array([0.0, 0.0, by_m])
    return replace(mesh, vertices_m=vertices_m)


def _clear_of_carriageway(solid_map: SolidMap, streets: Streets, ground: TerrainSurface | None) -> SolidMap:
    """Return a map whose footprints do not cover lanes; its counts name meshes that do."""
    lanes = shapely.STRtree(list(streets.areas.values()))
    solids: list[MappedSolid] = []
    counts = replace(solid_map.counts, objects=Counter(), heights={}) if solid_map.solids else solid_map.counts
    for solid in solid_map.solids:
        solids += clear_of_carriageway(solid, lanes, counts)

    def ground_m(xy_m: FloatArray) -> FloatArray:
        return np.zeros(len(xy_m)) if ground is None else ground.height_m(*xy_m.T)

    in_lanes = building_heights.objects_on_carriageway(solid_map.meshes, list(streets.areas.values()), ground_m)
    notes = solid_map.notes
    if in_lanes:
        verb = by_number(len(in_lanes), "stands", "stand")
        notes = (
            *notes,
            f"{len(in_lanes)} of {number_of(len(solid_map.meshes), 'object')} {verb} in lanes; check the"
            " position of the map:"
            f" {list_first(in_lanes, _MAX_NAMES)}.",
        )
    return replace(solid_map, solids=tuple(solids), counts=counts, notes=notes)


def _without_replaced(solid_map: SolidMap, others: StaticObjects) -> SolidMap:
    """Return a map without the buildings that another map has as well, and without all that a point cloud contains.

    Its counts are updated.
    """
    areas = [outline(mesh) for mesh in others.meshes if mesh.kind == "building"]
    surveyed = [_convex_hull(mesh) for mesh in others.meshes if mesh.kind == OBJECT_KIND]
    areas += surveyed + [solid.area for solid in others.solids if solid.kind == "building"]
    if not areas:
        return solid_map
    tree = shapely.STRtree(areas)
    counts = solid_map.counts
    remaining = []
    for solid in solid_map.solids:
        if (surveyed or solid.kind in ("building", "roof")) and _is_covered(solid.area, tree):
            counts.remove(solid)
            counts.drop(solid.kind, REPLACED)
        else:
            remaining.append(solid)
    return replace(solid_map, solids=tuple(remaining))


def _is_covered(area: BaseGeometry, tree: shapely.STRtree) -> bool:
    near = tree.geometries[tree.query(area, predicate="intersects")]
    covered_m2: float = shapely.union_all(near).intersection(area).area
    return bool(covered_m2 > _COVERED_SHARE * area.area)


def _add(collected: StaticObjects, solid_map: SolidMap, paths: tuple[Path, ...], reader: str) -> StaticObjects:
    tops_m = [solid.height_m for solid in solid_map.solids]
    tops_m += [float(mesh.vertices_m[:, 2].max()) for mesh in solid_map.meshes if mesh.kind != GROUND]
    height_range_m = (min(tops_m), max(tops_m)) if tops_m else None
    summary = MapSummary(paths, reader, solid_map.counts, height_range_m, solid_map.notes)
    attributions = dict.fromkeys([*collected.attributions, solid_map.attribution])
    return StaticObjects(
        (*collected.solids, *solid_map.solids),
        (*collected.meshes, *solid_map.meshes),
        collected.counts.plus(solid_map.counts),
        (*collected.maps, summary),
        tuple(name for name in attributions if name),
        collected.zero_height_m,
    )
