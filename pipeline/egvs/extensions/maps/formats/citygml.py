"""Read CityGML 1, 2 and 3: the objects of a city model one by one, and the triangles of its relief.

Elements are recognised by their names without prefix, so the version of the schema makes little difference: the
properties ``lod0FootPrint`` to ``lod4MultiSurface`` have the same names in all. A file of any size is read with memory
for one object and for the templates of implicit geometries.

:class:`CityGmlFile` reads objects, :func:`read_relief` reads ``TINRelief``. Heights of objects are those of
``measuredHeight`` (CityGML 3: ``height``), ``storeysAboveGround``, and of plants ``height`` and ``averageHeight``;
impossible ones, such as PLATEAU's -9999 and 9999 for "unknown", are ignored.

Not read: appearances, interiors, curves, and files that implicit geometries name.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.core.reading import COMPLETE_FILE
from egvs.extensions.maps.formats.city_objects import (
    BOUNDARY,
    FOOTPRINT,
    ROOF_EDGE,
    SOLID,
    SURFACE,
    CityObject,
    Component,
    Geometry,
    Member,
    Placement,
    Reference,
    Surface,
)
from egvs.extensions.maps.formats.gml import SurfaceParser, has_no_surface, parse_srs_name
from egvs.extensions.maps.formats.xml_events import iter_events, local_name

ROOT = "CityModel"

MAX_HEIGHT_M, MAX_STOREYS = 1000.0, 200.0

_MEMBERS = frozenset({"cityObjectMember", "featureMember", "featureMembers"})
_PARTS = frozenset({
    "BuildingPart", "BridgePart", "BuildingInstallation", "BridgeInstallation", "BridgeConstructionElement",
    "BuildingConstructiveElement", "BridgeConstructiveElement",
})  # fmt: skip
_BOUNDARIES = frozenset({"boundedBy", "boundary"})
_SKIPPED = frozenset({
    "appearance", "appearanceMember", "appearanceMembers", "interiorRoom", "interiorBuildingInstallation",
    "interiorBridgeRoom", "interiorBridgeInstallation", "buildingRoom", "bridgeRoom", "buildingSubdivision",
    "generalizesTo", "address",
})  # fmt: skip
_HEIGHTS = frozenset({"measuredHeight", "height", "averageHeight"})
_LOD_PROPERTY = re.compile(r"lod([0-4])([A-Z]\w*)")
_LOD_LINES = frozenset({"TerrainIntersection", "MultiCurve", "Network"})


def is_citygml(head: bytes) -> bool:
    """Return whether the beginning of a file is that of a city model, in any encoding."""
    return _starts_element(head, b"CityModel")


def has_relief(head: bytes) -> bool:
    """Return whether the beginning of a city model has terrain."""
    return is_citygml(head) and _starts_element(head, b"ReliefFeature")


def _starts_element(head: bytes, tag: bytes) -> bool:
    return re.search(rb"<(?:[\w.-]+:)?" + tag + rb"[\s>]", head.replace(b"\0", b"")) is not None


def valid_height_m(height_m: float) -> float | None:
    """Return a height above the ground in metres; None if it is impossible."""
    return height_m if 0.0 < height_m <= MAX_HEIGHT_M else None


def valid_storeys(storeys: float) -> float | None:
    """Return a number of storeys above the ground; None if it is impossible."""
    return storeys if 1.0 <= storeys <= MAX_STOREYS else None


class CityGmlFile:
    """The objects of a CityGML file.

    Parameters
    ----------
    path
        The file.
    kinds
        Kinds of objects whose surfaces are read; others come without surfaces. None for all.

    Attributes
    ----------
    templates
        Surfaces of implicit geometries by name; complete after :meth:`objects` ends.
    """

    def __init__(self, path: Path, kinds: Collection[str] | None = None) -> None:
        self.path = path
        self.templates: dict[str, list[Surface]] = {}
        self._kinds = kinds

    def objects(self) -> Iterator[CityObject]:
        """Yield the objects in their order; InputError when the file is damaged."""
        parser = _ObjectParser(self.path, self.templates, self._kinds)
        for _ in iter_events(self.path, ROOT, parser):
            yield from parser.finished
            parser.finished.clear()


class _ObjectParser(SurfaceParser):
    """Collects one object after the other."""

    def __init__(self, path: Path, templates: dict[str, list[Surface]], kinds: Collection[str] | None) -> None:
        super().__init__(path)
        self._kinds = kinds
        self._is_needed = False
        self.finished: list[CityObject] = []
        self._templates = templates
        self._template_points = 0
        self._count = 0
        self._object: CityObject | None = None
        self._object_depth = 0
        self._components: list[tuple[int, Component]] = []
        self._boundary_depths: list[int] = []
        self._geometry: Geometry | None = None
        self._geometry_depth = 0
        self._placement: Placement | None = None
        self._template_depth = 0
        self._skipped_depth = 0

    def collects_surfaces(self) -> bool:
        return self._geometry is not None

    def describe(self) -> str:
        return self._object.name if self._object is not None else "/".join(self.tags[-2:])

    def open_element(self, tag: str, attributes: Mapping[str, str]) -> bool:
        if self._skipped_depth:
            return False
        if self._object is None:
            if len(self.tags) > 1 and self.tags[-2] in _MEMBERS:
                self._open_object(tag, attributes)
            return False
        if not self._is_needed:
            return False
        if tag in _SKIPPED:
            self._skipped_depth = len(self.tags)
            return False
        if self._geometry is not None:
            return self._open_in_geometry(tag, attributes)
        if tag in _PARTS:
            component = Component()
            self._components.append((len(self.tags), component))
            self._object.components.append(component)
        elif tag in _BOUNDARIES:
            self._boundary_depths.append(len(self.tags))
        elif match := _LOD_PROPERTY.fullmatch(tag):
            self._open_geometry(int(match[1]), match[2], attributes)
        return self._is_height(tag)

    def close_element(self, tag: str, text: str) -> None:
        depth = len(self.tags)
        if self._skipped_depth:
            if depth == self._skipped_depth:
                self._skipped_depth = 0
            return
        if self._object is None:
            return
        if self._geometry is not None:
            self._close_in_geometry(tag, text, depth)
        elif depth == self._object_depth:
            self.finished.append(self._object)
            self._object = None
        elif not self._is_needed:
            return
        elif self._boundary_depths and self._boundary_depths[-1] == depth:
            self._boundary_depths.pop()
        elif self._components[-1][0] == depth:
            self._components.pop()
        elif self._is_height(tag):
            self._read_height(tag, text)

    def add_member(self, member: Member, srs_name: str) -> None:
        if self._object is None or self._geometry is None:
            return
        if self._template_depth:
            self._add_to_template(member)
            return
        if isinstance(member, Surface):
            if "ClosureSurface" in self.tags[self._object_depth :]:
                self._object.openings.add(id(member))
            if self._object.srs_name and self._object.srs_name != srs_name:
                problem = f"expected one reference system, got {self._object.srs_name!r} and {srs_name!r}"
                raise InputError(f"{self.path}: {self._object.name}: srsName", problem, COMPLETE_FILE)
            self._object.srs_name = srs_name
        self._geometry.members.append(member)

    def add_group(self, name: str, members: Sequence[Member]) -> None:
        if self._template_depth:
            surfaces = [member for member in members if isinstance(member, Surface)]
            self._template_points += sum(len(ring) for surface in surfaces for ring in surface.rings)
            limits.TRIANGLES.check(f"{self.path}: templates", self._template_points, "has too many templates")
            self._templates[name] = surfaces
        elif self._object is not None:
            self._object.groups[name] = list(members)

    def _open_object(self, tag: str, attributes: Mapping[str, str]) -> None:
        self._count += 1
        name = next((value for key, value in attributes.items() if local_name(key) == "id"), f"{tag} {self._count}")
        self._object = CityObject(name, tag)
        self._is_needed = self._kinds is None or tag in self._kinds
        self._object_depth = len(self.tags)
        self.collected = 0
        self._components = [(self._object_depth, self._object.components[0])]
        self._boundary_depths = []

    def _open_geometry(self, lod: int, form: str, attributes: Mapping[str, str]) -> None:
        if form in _LOD_LINES:
            self._skipped_depth = len(self.tags)
            return
        role = SURFACE
        if form == "FootPrint":
            role = FOOTPRINT
        elif form == "RoofEdge":
            role = ROOF_EDGE
        elif "Solid" in form:
            role = SOLID
        elif self._boundary_depths:
            role = BOUNDARY
        self._geometry = Geometry(float(lod), role)
        self._geometry_depth = len(self.tags)
        self._components[-1][1].geometries.append(self._geometry)

    def _open_in_geometry(self, tag: str, attributes: Mapping[str, str]) -> bool:
        if tag == "ImplicitGeometry" and self._geometry is not None:
            self._placement = Placement(self._geometry.lod)
            self._components[-1][1].placements.append(self._placement)
        elif tag == "relativeGMLGeometry" and self._placement is not None:
            self._template_depth = len(self.tags)
        elif has_no_surface(tag) and self._placement is None and self._object is not None:
            self._object.ignored += 1
        is_point = tag in ("pos", "coordinates") and "referencePoint" in self.tags[-4:]
        return is_point or tag in ("transformationMatrix", "libraryObject")

    def _close_in_geometry(self, tag: str, text: str, depth: int) -> None:
        placement = self._placement
        if depth == self._geometry_depth:
            self._geometry = None
            self._placement = None
        elif placement is None:
            return
        elif tag == "transformationMatrix":
            placement.matrix = self._matrix(text)
        elif tag == "libraryObject":
            placement.library = text.strip()
        elif tag in ("pos", "coordinates") and "referencePoint" in self.tags[-4:]:
            points = self.points(text)
            placement.point = points[0].tolist() if len(points) else None
            if self._object is not None:
                self._object.srs_name = self._object.srs_name or self.srs_name()
        elif depth == self._template_depth:
            self._template_depth = 0
        elif tag == "ImplicitGeometry":
            self._placement = None

    def _matrix(self, text: str) -> list[float]:
        where = f"{self.path}: {self.describe()}: transformationMatrix"
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        if len(values) != 16 or not np.isfinite(values).all():
            raise InputError(where, f"expected 16 finite numbers, got {text.strip()[:80]!r}", COMPLETE_FILE)
        return values

    def _add_to_template(self, member: Member) -> None:
        if self._placement is None:
            return
        if isinstance(member, Reference):
            self._placement.template = member.name
        elif isinstance(self._placement.template, list):
            self._placement.template.append(member)

    def _is_height(self, tag: str) -> bool:
        """Whether an element is a height of the current component, and not of something inside it."""
        level = len(self.tags) - self._components[-1][0]
        if level == 1:
            return tag == "storeysAboveGround" or tag in _HEIGHTS
        return level == 3 and tag == "value" and self.tags[-2] == "Height"  # CityGML 3

    def _read_height(self, tag: str, text: str) -> None:
        component = self._components[-1][1]
        try:
            value = float(text)
        except ValueError:
            return
        if tag == "storeysAboveGround":
            component.storeys = valid_storeys(value)
        else:
            height_m = valid_height_m(value)
            if height_m is not None:
                component.measured_height_m = max(height_m, component.measured_height_m or 0.0)


class Relief(NamedTuple):
    """Triangles of the ground.

    Attributes
    ----------
    vertices
        (n, 3) float64, in the order x (easting, longitude), y (northing, latitude), height in metres.
    faces
        (m, 3) int64, counter-clockwise from above.
    crs
        The reference system, in a form that PROJ knows; None if the file names none.
    """

    vertices: FloatArray
    faces: IntArray
    crs: str | None


BoundsOf = Callable[[str | None], Sequence[float]]
"""Returns west, south, east and north in a reference system, in its units and in the order x, y."""


def read_relief(path: Path, bounds_of: BoundsOf | None = None) -> Relief:
    """Read the triangulated terrain (``TINRelief``) of a CityGML file, e.g. of a PLATEAU tile ``..._dem_6697_op.gml``.

    Vertices are merged where they are equal. Triangles without area, seen from above, are left out.

    Parameters
    ----------
    path
        The file.
    bounds_of
        Returns the bounds of the region in the file's system; triangles wholly outside are left out. None for all
        triangles.

    Raises
    ------
    InputError
        When the file is damaged, has several reference systems, has no triangles, or has too many.
    """
    parser = _ReliefParser(path, bounds_of)
    for _ in iter_events(path, ROOT, parser):
        limits.TRIANGLES.check(path, parser.triangle_count, "has too many triangles of terrain")
    if not parser.has_triangles:
        hint = "Use a file with TINRelief whose tin is a TriangulatedSurface."
        raise InputError(path, "the file has no triangles of terrain", hint)
    corners = np.frombuffer(parser.corners, dtype=np.float64).reshape(-1, 3)
    system = parse_srs_name(parser.relief_srs_name or "", str(path))
    xyz = system.to_xyz(corners)
    vertices, index = np.unique(xyz, axis=0, return_inverse=True)
    faces = index.reshape(-1, 3).astype(np.int64)
    return Relief(vertices, _turn_up(vertices, faces), system.crs)


def _turn_up(vertices: FloatArray, faces: IntArray) -> IntArray:
    """Return triangles counter-clockwise from above; those without area are left out."""
    a, b, c = vertices[faces[:, 0], :2], vertices[faces[:, 1], :2], vertices[faces[:, 2], :2]
    doubled_area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    turned = np.where((doubled_area < 0)[:, None], faces[:, ::-1], faces)
    kept: IntArray = turned[doubled_area != 0]
    return kept


class _ReliefParser(SurfaceParser):
    """Collects the triangles of ``TINRelief``."""

    def __init__(self, path: Path, bounds_of: BoundsOf | None) -> None:
        super().__init__(path)
        self.corners = array("d")
        self.relief_srs_name: str | None = None
        self.has_triangles = False
        self._bounds_of = bounds_of
        self._bounds: Sequence[float] | None = None
        self._is_y_first = False
        self._tin_depth = 0
        self._triangles = 0

    @property
    def triangle_count(self) -> int:
        """How many triangles are kept."""
        return len(self.corners) // 9

    def collects_surfaces(self) -> bool:
        return self._tin_depth > 0

    def describe(self) -> str:
        return f"triangle {self._triangles + 1}"

    def open_element(self, tag: str, attributes: Mapping[str, str]) -> bool:
        if tag == "tin" and not self._tin_depth:
            self._tin_depth = len(self.tags)
        return False

    def close_element(self, tag: str, text: str) -> None:
        if len(self.tags) == self._tin_depth:
            self._tin_depth = 0

    def add_group(self, name: str, members: Sequence[Member]) -> None:
        pass

    def add_member(self, member: Member, srs_name: str) -> None:
        if not isinstance(member, Surface) or not member.rings:
            return
        self._triangles += 1
        ring = member.rings[0]
        if self.relief_srs_name is None:
            self.relief_srs_name = srs_name
            system = parse_srs_name(srs_name, str(self.path))
            self._is_y_first = system.is_y_first
            if self._bounds_of is not None:
                self._bounds = self._bounds_of(system.crs)
        if srs_name != self.relief_srs_name:
            problem = f"expected one reference system, got {self.relief_srs_name!r} and {srs_name!r}"
            raise InputError(f"{self.path}: {self.describe()}: srsName", problem, COMPLETE_FILE)
        is_triangle = len(ring) == 3 or (len(ring) == 4 and bool((ring[0] == ring[3]).all()))
        if not is_triangle or len(member.rings) > 1:
            problem = f"expected a triangle, got {max(len(ring) - 1, 0)} corners and {len(member.rings) - 1} holes"
            raise InputError(f"{self.path}: {self.describe()} of the terrain", problem, COMPLETE_FILE)
        self.has_triangles = True
        if self._is_near(ring):
            self.collected = 0
            self.corners.frombytes(np.ascontiguousarray(ring[:3]).tobytes())

    def _is_near(self, ring: FloatArray) -> bool:
        if self._bounds is None:
            return True
        x, y = (ring[:, 1], ring[:, 0]) if self._is_y_first else (ring[:, 0], ring[:, 1])
        west, south, east, north = self._bounds
        return bool(x.max() >= west and x.min() <= east and y.max() >= south and y.min() <= north)
