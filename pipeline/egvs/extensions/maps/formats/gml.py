"""Surfaces of GML (OGC's Geography Markup Language 3.1 and 3.2) as an XML file is read.

:class:`SurfaceParser` collects the rings of polygons, triangles and patches; which reference system they are in; and
which groups of surfaces have names. What they belong to is decided by classes that extend it.

A reference system applies to the elements below the one that names it, and the envelope of the whole file names the
default. Coordinates are in the order of the system's axes. That order is the one that its authority defines, whatever
the form of the name: latitude before longitude in EPSG:6697, north before east in EPSG:6677.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.reading import COMPLETE_FILE
from egvs.extensions.maps.formats.city_objects import Member, Reference, Surface
from egvs.extensions.maps.formats.xml_events import local_name
from egvs.formats import georeference

POLYGONS = frozenset({"Polygon", "PolygonPatch", "Triangle", "Rectangle"})
_RINGS = frozenset({"exterior", "interior", "outerBoundaryIs", "innerBoundaryIs"})
_COORDINATES = frozenset({"posList", "pos", "coordinates"})
_NO_SURFACES = frozenset({"Point", "MultiPoint", "LineString", "MultiCurve", "CompositeCurve", "Curve"})

_OLD_NAME = re.compile(r".*(?:epsg\.xml#|srs/EPSG#)(\d+)", re.IGNORECASE)
_ADV_NAME = re.compile(r"urn:adv:crs:ETRS89_UTM(3[1-3])\b.*")
"""Names of the German surveys, which PROJ does not know."""


class ReferenceSystem(NamedTuple):
    """The reference system of coordinates.

    Attributes
    ----------
    crs
        In a form that PROJ knows; None if the file names none.
    is_y_first
        Whether the first axis points north.
    height_unit_m
        Length in metres of a height of 1.
    is_in_degrees
        Whether x and y are longitude and latitude.
    """

    crs: str | None
    is_y_first: bool = False
    height_unit_m: float = 1.0
    is_in_degrees: bool = False

    def to_xyz(self, coordinates: FloatArray) -> FloatArray:
        """Return coordinates (n, 3) in the order x (easting, longitude), y, z, with heights in metres."""
        order = [1, 0, 2] if self.is_y_first else [0, 1, 2]
        return coordinates[:, order] * (1.0, 1.0, self.height_unit_m)


def parse_srs_name(srs_name: str, where: str) -> ReferenceSystem:
    """Return the system of a ``srsName``; an empty one names none. InputError when PROJ does not know it."""
    name = srs_name.strip()
    if not name:
        return ReferenceSystem(None)
    if match := _OLD_NAME.fullmatch(name):
        name = f"EPSG:{match[1]}"
    elif match := _ADV_NAME.fullmatch(name):
        name = f"EPSG:258{match[1]}"
    where = f"{where}: srsName"
    crs = georeference.parse_crs(name, where)
    is_y_first = georeference.is_north_first(name, where)
    return ReferenceSystem(name, is_y_first, georeference.height_unit_m(name, where), crs.is_geographic)


def parse_coordinates(text: str, dimension: int, where: str) -> FloatArray:
    """Return the points (n, 3) of a list of coordinates; z is 0 in two dimensions.

    Raises
    ------
    InputError
        When it has something other than finite numbers, or not ``dimension`` of them for each point.
    """
    try:
        if not text.isascii() or "_" in text:  # which float would accept
            raise ValueError("it has characters that are no part of a number")
        values = np.array([float(word) for word in text.split()])
    except ValueError as error:
        raise InputError(where, f"expected numbers ({error})", COMPLETE_FILE) from None
    if dimension not in (2, 3) or len(values) % dimension:
        problem = f"expected {dimension} numbers for each point, got {len(values)} numbers"
        raise InputError(where, problem, "Check srsDimension; it must be 2 or 3.")
    if not np.isfinite(values).all():
        raise InputError(where, "expected finite coordinates, got nan or inf", COMPLETE_FILE)
    points = values.reshape(-1, dimension)
    return points if dimension == 3 else np.column_stack([points, np.zeros(len(points))])


class SurfaceParser:
    """Collects surfaces from the elements of a GML file.

    Parameters
    ----------
    path
        The file, for messages.

    Attributes
    ----------
    tags
        Names of the open elements, from the root to the current one.
    collected
        Corners and surfaces since an extending class has set it to 0; limited.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.tags: list[str] = []
        self.default_srs_name = ""
        self.collected = 0
        self._max_collected = limits.TRIANGLES.maximum
        self._declared: list[tuple[int, str | None, int | None]] = []
        self._rings: list[FloatArray] | None = None
        self._ring: list[FloatArray] | None = None
        self._polygon_name = ""
        self._polygon_srs_name = ""
        self._reversed: list[int] = []
        self._open_groups: list[tuple[int, str, list[Member]]] = []

    # What extending classes define.

    def open_element(self, tag: str, attributes: Mapping[str, str]) -> bool:
        """Handle an element that is no part of a polygon; return whether its text is needed."""
        raise NotImplementedError

    def close_element(self, tag: str, text: str) -> None:
        """Handle the end of such an element."""
        raise NotImplementedError

    def add_member(self, member: Member, srs_name: str) -> None:
        """Handle a surface, or a reference to one."""
        raise NotImplementedError

    def add_group(self, name: str, members: Sequence[Member]) -> None:
        """Handle the surfaces inside an element with a name."""
        raise NotImplementedError

    def collects_surfaces(self) -> bool:
        """Return whether surfaces are needed here."""
        raise NotImplementedError

    def describe(self) -> str:
        """Name the current object, for messages."""
        raise NotImplementedError

    # The elements.

    def start(self, tag: str, attributes: Mapping[str, str]) -> bool:
        """Handle the start of an element (see :class:`egvs.extensions.maps.formats.xml_events.EventHandler`)."""
        self.tags.append(tag)
        if attributes:
            self._read_declarations(tag, attributes)
        if self._rings is not None:
            if tag in _RINGS:
                self._ring = []
            return tag in _COORDINATES and self._ring is not None
        is_text_needed = self.open_element(tag, attributes)
        if not self.collects_surfaces():
            return is_text_needed
        if tag in POLYGONS:
            self._rings = []
            self._polygon_name = _attribute(attributes, "id")
            self._polygon_srs_name = self.srs_name()
            return False
        if tag == "OrientableSurface" and attributes.get("orientation") == "-":
            self._reversed.append(len(self.tags))
        if name := _attribute(attributes, "id"):
            self._open_groups.append((len(self.tags), name, []))
        if target := _attribute(attributes, "href"):
            self._emit(Reference(target.removeprefix("#"), self._is_reversed()), self.srs_name())
        return is_text_needed

    def end(self, tag: str, text: str) -> None:
        """Handle the end of an element."""
        depth = len(self.tags)
        if self._rings is not None:
            self._end_in_polygon(tag, text)
        else:
            self.close_element(tag, text)
        while self._open_groups and self._open_groups[-1][0] == depth:
            _, name, members = self._open_groups.pop()
            self.add_group(name, members)
        if self._reversed and self._reversed[-1] == depth:
            self._reversed.pop()
        if self._declared and self._declared[-1][0] == depth:
            self._declared.pop()
        self.tags.pop()

    def srs_name(self) -> str:
        """Return the name of the reference system that applies here; empty if it is not stated."""
        for _, srs_name, _ in reversed(self._declared):
            if srs_name is not None:
                return srs_name
        return self.default_srs_name

    def points(self, text: str) -> FloatArray:
        """Return the points (n, 3) of the text of the current element."""
        where = f"{self.path}: {self.describe()}: {self.tags[-1]}"
        dimension = 3
        for _, _, declared in reversed(self._declared):
            if declared is not None:
                dimension = declared
                break
        if self.tags[-1] == "coordinates":
            tuples = text.split()
            dimension = tuples[0].count(",") + 1 if tuples else 3
            text = text.replace(",", " ")
        elif self.tags[-1] == "pos":
            dimension = 2 if len(text.split()) == 2 else 3
        return parse_coordinates(text, dimension, where)

    def _read_declarations(self, tag: str, attributes: Mapping[str, str]) -> None:
        srs_name = attributes.get("srsName")
        dimension = attributes.get("srsDimension")
        if srs_name is None and dimension is None:
            return
        if tag == "Envelope":
            if len(self.tags) <= 3 and srs_name is not None:
                self.default_srs_name = srs_name
            return
        number = None
        if dimension is not None:
            number = int(dimension) if dimension.strip() in ("2", "3") else 0
        self._declared.append((len(self.tags), srs_name, number))

    def _end_in_polygon(self, tag: str, text: str) -> None:
        if tag in _COORDINATES and self._ring is not None:
            self._ring.append(self.points(text))
        elif tag in _RINGS and self._ring is not None and self._rings is not None:
            ring = np.concatenate(self._ring) if self._ring else np.empty((0, 3))
            self._rings.append(ring)
            self._ring = None
        elif tag in POLYGONS and self._rings is not None:
            surface = Surface(tuple(self._rings))
            if self._is_reversed():
                surface = surface.reversed()
            self._rings = None
            self._emit(surface, self._polygon_srs_name)
            if self._polygon_name:
                self.add_group(self._polygon_name, [surface])

    def _is_reversed(self) -> bool:
        return len(self._reversed) % 2 == 1

    def _emit(self, member: Member, srs_name: str) -> None:
        self.collected += 1 + len(self._open_groups)
        if isinstance(member, Surface):
            self.collected += sum(len(ring) for ring in member.rings)
        if self.collected > self._max_collected:
            limits.TRIANGLES.check(f"{self.path}: {self.describe()}", self.collected, "has too many surfaces")
        for _, _, members in self._open_groups:
            members.append(member)
        self.add_member(member, srs_name)


def _attribute(attributes: Mapping[str, str], name: str) -> str:
    """Return an attribute by its name without prefix; empty if it is absent."""
    for key, value in attributes.items():
        if local_name(key) == name:
            return value
    return ""


def has_no_surface(tag: str) -> bool:
    """Return whether a geometry consists of points or lines."""
    return tag in _NO_SURFACES
