"""Turn the objects of city models (CityGML, CityJSON) into meshes and footprints in the world frame.

Steps for each object: choose its surfaces at the highest level of detail; place templates; leave out what is outside
the window; convert x and y, and keep heights as they are; triangulate. An object with a footprint only (LOD 0) becomes
a prism: as high as the file says (``measuredHeight``), else by its storeys, else by default.

Source of the frame of implicit geometries: CityGML 2.0, OGC 12-019, 8.2. Where coordinates are degrees, the axes of a
template are taken as metres to the east, north and up, which the standard leaves open.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.polygons import check_crossings, repair_polygon
from egvs.core.wording import by_number, list_first, number_of
from egvs.creation.carriageway import geometry_pieces
from egvs.creation.map_parts import (
    DEFAULT_BUILDING_M,
    OUT_OF_RANGE,
    ImportCounts,
    MapContext,
    MappedMesh,
    MappedSolid,
    SolidMap,
)
from egvs.extensions.maps.formats.city_objects import (
    CityObject,
    Placement,
    Surface,
    select_footprint,
    select_surfaces,
)
from egvs.extensions.maps.formats.gml import ReferenceSystem, parse_srs_name
from egvs.extensions.maps.formats.surface_meshes import SurfaceMesh, triangulate_surfaces
from egvs.formats.georeference import format_distance
from egvs.scenario.fields import MAX_COORDINATE_M
from egvs.world.map_features import LEVEL_M

SOLID_KINDS: Mapping[str, str] = {
    "Building": "building",
    "Bridge": "bridge",
    "CityFurniture": "furniture",
    "OtherConstruction": "construction",
    "PlantCover": "vegetation",
    "SolitaryVegetationObject": "vegetation",
}
"""Kinds of objects that stand in the way of beams, by their type in CityGML."""

_EARTH_AXIS_M, _EARTH_ECCENTRICITY_2 = 6_378_137.0, 0.006_694_380_022_90
"""Half axis and squared eccentricity of the ellipsoid GRS 80."""

_FLAT_NORMAL = 0.7
_MAX_NAMES = 10
_FAR_M = 100_000
"""Greater distances in the world frame are not exact."""
_MAX_CHECKED = 1000

Rings = list[list[FloatArray]]
"""Rings (n, 3) of each surface of an object."""


class CityModelFile(Protocol):
    """A file with city objects."""

    path: Path
    templates: dict[str, list[Surface]]

    def objects(self) -> Iterator[CityObject]:
        """Yield the objects."""
        raise NotImplementedError


class _Placed(NamedTuple):
    """Surfaces of an object in its reference system, in the order x, y, z."""

    rings: Rings
    system: ReferenceSystem


def collect_solids(
    files: Iterable[CityModelFile], context: MapContext, kinds: Mapping[str, str] = SOLID_KINDS
) -> SolidMap:
    """Return the objects of city models in the window.

    Parameters
    ----------
    files
        The files.
    context
        The world frame and the window.
    kinds
        Kinds of the objects to read, by their type; others are counted as not modelled.

    Raises
    ------
    InputError
        When a file is damaged, its coordinates cannot be converted, or the order of its axes is wrong.
    """
    collector = _Collector(context, kinds)
    for file in files:
        collector.add_file(file)
    return collector.result()


@dataclass
class _Collector:
    """Collects meshes and footprints, and counts what happens."""

    context: MapContext
    kinds: Mapping[str, str]
    counts: ImportCounts = field(default_factory=ImportCounts)
    solids: list[MappedSolid] = field(default_factory=list)
    meshes: dict[str, MappedMesh] = field(default_factory=dict)
    lods: dict[str, Counter[str]] = field(default_factory=dict)
    repairs: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    triangles: int = 0

    def add_file(self, file: CityModelFile) -> None:
        """Add the objects of a file; those that need a template from further down are added at its end."""
        systems: dict[str, ReferenceSystem] = {}
        outside = _OutsideObjects(self.context, str(file.path))
        postponed: list[CityObject] = []
        for city_object in file.objects():
            if city_object.kind not in self.kinds:
                self.counts.not_modelled[city_object.kind] += 1
            elif _needs_template(city_object, file.templates):
                limits.MAP_OBJECTS.check(file.path, len(postponed), "has too many templates that come after their use")
                postponed.append(city_object)
            else:
                self._add_object(city_object, file, systems, outside)
        for city_object in postponed:
            self._add_object(city_object, file, systems, outside)
        self.notes += outside.notes()

    def result(self) -> SolidMap:
        """Return everything that was collected."""
        notes = [*self._lod_notes(), *self._closedness_notes(), *self._repair_notes(), *self.notes]
        self.counts.repaired += self.repairs["crossing"]
        return SolidMap(
            tuple(self.solids), tuple(self.meshes.values()), self.counts, has_absolute_heights=True, notes=tuple(notes)
        )

    def _add_object(
        self, city_object: CityObject, file: CityModelFile, systems: dict[str, ReferenceSystem],
        outside: _OutsideObjects,
    ) -> None:  # fmt: skip
        kind = self.kinds[city_object.kind]
        where = f"{file.path}: {city_object.name}"
        system = systems.get(city_object.srs_name)
        if system is None:
            system = systems[city_object.srs_name] = self._reference_system(city_object.srs_name, where)

        selection = select_surfaces(city_object)
        self.repairs["unresolved"] += selection.unresolved
        self.repairs["no surface"] += city_object.ignored
        surfaces = selection.surfaces or select_footprint(city_object)
        is_footprint = not selection.surfaces and not selection.placements
        rings = [[system.to_xyz(ring) for ring in surface.rings] for surface in surfaces]
        for placement in selection.placements:
            rings += self._place(placement, file, system, where)
        if not any(len(ring) for surface in rings for ring in surface):
            self.counts.drop(kind, "no_surface")
            return

        _check_coordinates(np.concatenate([ring for surface in rings for ring in surface]), where)
        limits.HOLES.check(where, max(len(surface) - 1 for surface in rings))
        limits.CORNERS.check(where, max(len(ring) for surface in rings for ring in surface))
        placed = _Placed(rings, system)
        if not outside.is_in_window(placed, where):
            self.counts.drop(kind, OUT_OF_RANGE)
            return
        rings_m = _to_world(placed, self.context, where)
        if is_footprint:
            self._add_footprint(city_object, kind, rings_m, where)
        else:
            self._add_mesh(city_object, kind, rings_m, where)

    def _reference_system(self, srs_name: str, where: str) -> ReferenceSystem:
        crs = self.context.usable_crs(lambda: parse_srs_name(srs_name, where).crs, where)
        return ReferenceSystem(None) if crs is None else parse_srs_name(srs_name, where)

    def _place(self, placement: Placement, file: CityModelFile, system: ReferenceSystem, where: str) -> Rings:
        """Return the surfaces of a template where it is placed."""
        if placement.library:
            self.repairs["library"] += 1
            return []
        template = placement.template
        surfaces = file.templates.get(template, []) if isinstance(template, str) else template
        if not surfaces or placement.point is None:
            self.repairs["unresolved"] += 1
            return []
        self._check_size(sum(len(ring) for surface in surfaces for ring in surface.rings), where)
        if system.is_in_degrees:
            self.repairs["placed in degrees"] += 1
        return [[_place_ring(ring, placement, system) for ring in surface.rings] for surface in surfaces]

    def _check_size(self, triangles: int, where: str) -> None:
        self.triangles += triangles
        limits.TRIANGLES.check(where, self.triangles, "makes too many triangles with the objects before it")

    def _add_mesh(self, city_object: CityObject, kind: str, rings_m: Rings, where: str) -> None:
        mesh = triangulate_surfaces(rings_m)
        self._check_size(len(mesh.faces), city_object.name)
        self.repairs["degenerate"] += mesh.degenerate_rings
        self.repairs["crossing"] += mesh.crossing
        if not len(mesh.faces):
            self.counts.drop(kind, "degenerate")
            return
        if city_object.kind == "PlantCover" and city_object.measured_height_m() and _is_flat(mesh):
            self._add_footprint(city_object, kind, rings_m, where)
            return
        mapped = self._with_unique_name(MappedMesh(city_object.name, kind, mesh.vertices_m, mesh.faces, mesh.is_closed))
        if mapped is None:
            return
        self.meshes[mapped.name] = mapped
        self.counts.objects[kind] += 1
        self.counts.heights.setdefault(kind, Counter())["geometry"] += 1
        self.lods.setdefault(kind, Counter())[f"{city_object.lod:g}"] += 1

    def _with_unique_name(self, mesh: MappedMesh) -> MappedMesh | None:
        """Return a mesh under another name if its own is taken; None if the same mesh was in another file."""
        name = mesh.name
        number = 1
        while name in self.meshes:
            known = self.meshes[name]
            if known.vertices_m.shape == mesh.vertices_m.shape and (known.vertices_m == mesh.vertices_m).all():
                self.counts.drop(mesh.kind, "duplicate")
                return None
            number += 1
            name = f"{mesh.name}#{number}"
        return MappedMesh(name, mesh.kind, mesh.vertices_m, mesh.faces, mesh.is_closed)

    def _add_footprint(self, city_object: CityObject, kind: str, rings_m: Rings, where: str) -> None:
        height_m, source = city_object.measured_height_m(), "height"
        if height_m is None and city_object.storeys() is not None:
            height_m, source = LEVEL_M * (city_object.storeys() or 0.0), "levels"
        if height_m is None and kind != "building":
            self.counts.drop(kind, "no_height")
            return
        area = _footprint(rings_m, where)
        if area.is_empty:
            self.counts.drop(kind, "degenerate")
            return
        if height_m is None:
            height_m, source = DEFAULT_BUILDING_M, "default"
        solid = MappedSolid(city_object.name, kind, area, height_m, source)
        self.counts.keep(solid)
        self.solids.append(solid)
        self.lods.setdefault(kind, Counter())["0"] += 1

    def _lod_notes(self) -> Iterator[str]:
        for kind, lods in sorted(self.lods.items()):
            levels = ", ".join(f"{count:,} at LOD {lod}" for lod, count in sorted(lods.items(), reverse=True))
            yield f"{kind}: {levels}."

    def _closedness_notes(self) -> Iterator[str]:
        for kind in ("building", "bridge", "construction"):
            meshes = [mesh for mesh in self.meshes.values() if mesh.kind == kind]
            open_names = [mesh.name for mesh in meshes if not mesh.is_closed]
            if open_names:
                yield (
                    f"{len(open_names):,} of {number_of(len(meshes), 'mesh', 'meshes')} of the kind {kind}"
                    f" {by_number(len(open_names), 'is', 'are')} not closed, so a point"
                    f" inside cannot be recognised: {list_first(open_names, _MAX_NAMES)}."
                )

    def _repair_notes(self) -> Iterator[str]:
        descriptions = {
            "degenerate": ("ring without area was", "rings without area were", "left out"),
            "crossing": ("surface crosses itself", "surfaces cross themselves", "with approximate triangles"),
            "unresolved": ("reference leads", "references lead", "to no surface in the same object"),
            "library": ("template is", "templates are", "in other files, which are not read"),
            "no surface": ("geometry is", "geometries are", "points or lines, which stop no beam"),
            "placed in degrees": (
                "template is", "templates are", "placed at degrees; axes are taken as metres east, north and up",
            ),
        }  # fmt: skip
        for repair, (singular, plural, rest) in descriptions.items():
            if self.repairs[repair]:
                yield f"{number_of(self.repairs[repair], singular, plural)} {rest}."


class _OutsideObjects:
    """Tells which objects of a file are in the window, and remembers where some of the others are."""

    def __init__(self, context: MapContext, where: str) -> None:
        self._context = context
        self._where = where
        self._inside = 0
        self._outside = 0
        self._nearest_m = math.inf
        self._examples: list[tuple[FloatArray, ReferenceSystem]] = []

    def is_in_window(self, placed: _Placed, where: str) -> bool:
        """Return whether the rectangle around an object meets the window."""
        points = np.concatenate([ring[:, :2] for surface in placed.rings for ring in surface])
        (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        corners_m = self._context.to_world(corners, placed.system.crs, where)
        box = shapely.box(*corners_m.min(axis=0), *corners_m.max(axis=0))
        if self._context.window.intersects(box):
            self._inside += 1
            return True
        self._outside += 1
        self._nearest_m = min(self._nearest_m, float(self._context.window.distance(box)))
        if len(self._examples) < _MAX_CHECKED:
            self._examples.append((corners[:1], placed.system))
        return False

    def notes(self) -> Iterator[str]:
        """Yield a note if all objects are outside; InputError if they would be inside with the axes swapped."""
        if self._inside or not self._outside:
            return
        swapped = sum(self._is_inside_swapped(point, system) for point, system in self._examples)
        if swapped:
            order = "longitude, latitude" if self._examples[0][1].is_in_degrees else "east, north"
            if not self._examples[0][1].is_y_first:
                order = "latitude, longitude" if self._examples[0][1].is_in_degrees else "north, east"
            problem = f"no object is within reach of the roads; in the order {order}, {swapped:,} would be"
            hint = f"Correct the order of the coordinates, or name a system whose axes are {order}."
            raise InputError(self._where, problem, hint)
        distance = format_distance(math.ceil(self._nearest_m))
        if self._nearest_m > _FAR_M:
            distance = f"more than {format_distance(_FAR_M)}"
        yield (
            f"{Path(self._where).name}: none of its {number_of(self._outside, 'object')} is within reach of the"
            f" sensors; the nearest is {distance} beyond it."
        )

    def _is_inside_swapped(self, point: FloatArray, system: ReferenceSystem) -> bool:
        if self._context.frame is None or system.crs is None:
            return False
        point_m = self._context.frame.from_crs(point[:, ::-1], system.crs)
        return bool(np.isfinite(point_m).all()) and bool(self._context.window.intersects(shapely.Point(point_m[0])))


def _needs_template(city_object: CityObject, templates: Mapping[str, list[Surface]]) -> bool:
    """Return whether an object needs a template that was not read yet."""
    placements = select_surfaces(city_object).placements
    return any(isinstance(placement.template, str) and placement.template not in templates for placement in placements)


def _place_ring(ring: FloatArray, placement: Placement, system: ReferenceSystem) -> FloatArray:
    """Return the points (n, 3) of a template's ring in the reference system, in the order x, y, z."""
    matrix = np.reshape(placement.matrix, (4, 4))
    with np.errstate(over="ignore", invalid="ignore"):  # coordinates that are too large are rejected later
        local = ring @ matrix[:3, :3].T + matrix[:3, 3]
    point = np.array([placement.point], dtype=np.float64)
    if not system.is_in_degrees:
        return system.to_xyz(local + point)
    lon_lat = system.to_xyz(point)
    lat = math.radians(float(np.clip(lon_lat[0, 1], -89.0, 89.0)))
    squared = 1.0 - _EARTH_ECCENTRICITY_2 * math.sin(lat) ** 2
    parallel_radius_m = _EARTH_AXIS_M / math.sqrt(squared) * math.cos(lat)
    meridian_radius_m = _EARTH_AXIS_M * (1.0 - _EARTH_ECCENTRICITY_2) / squared**1.5
    moved: FloatArray = lon_lat + local / (math.radians(parallel_radius_m), math.radians(meridian_radius_m), 1.0)
    return moved


def _to_world(placed: _Placed, context: MapContext, where: str) -> Rings:
    """Return rings with x and y in the world frame."""
    rings = [ring for surface in placed.rings for ring in surface]
    points = np.concatenate(rings)
    xy_m = context.to_world(points[:, :2], placed.system.crs, where)
    unit_m = context.height_unit(None, where).metres if placed.system.crs is None else 1.0  # else metres already
    points_m = np.column_stack([xy_m, points[:, 2] * unit_m])
    _check_coordinates(points_m, where)
    pieces = iter(np.split(points_m, np.cumsum([len(ring) for ring in rings])[:-1]))
    return [[next(pieces) for _ in surface] for surface in placed.rings]


def _check_coordinates(points: FloatArray, where: str) -> None:
    far = np.argwhere(~(np.abs(points) <= MAX_COORDINATE_M))
    if len(far):
        row, axis = far[0]
        problem = f"expected coordinates within {MAX_COORDINATE_M:g} m, got {'xyz'[axis]} = {points[row, axis]:g}"
        raise InputError(where, problem, "Check the file's coordinates and its reference system.")


def _footprint(rings_m: Sequence[Sequence[FloatArray]], where: str) -> BaseGeometry:
    """Return the area under surfaces, seen from above; empty if they have none."""
    areas = []
    for surface in rings_m:
        outer, *holes = [ring[:, :2] for ring in surface]
        if len(outer) > 2:
            surface_m = shapely.Polygon(outer, [hole for hole in holes if len(hole) > 2])
            areas.append(repair_polygon(surface_m, where))
    check_crossings(areas, where)
    area = shapely.union_all(areas)
    polygons = [piece for piece in geometry_pieces(area) if piece.geom_type == "Polygon"]
    return polygons[0] if len(polygons) == 1 else shapely.MultiPolygon(polygons)


def _is_flat(mesh: SurfaceMesh) -> bool:
    """Return whether all triangles lie rather than stand, so that they are an area on the ground."""
    corners = mesh.vertices_m[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return bool((np.abs(normals[:, 2]) >= _FLAT_NORMAL * np.linalg.norm(normals, axis=1)).all())
