"""Read triangulated surfaces of LandXML files (1.0 to 2.0), as surveyors and road designers exchange them.

A surface has points ``<P id="1">northing easting height</P>`` and faces ``<F>1 2 3</F>`` that name their corners; faces
with ``i="1"`` are hidden, and left out. Source: LandXML 1.2 (http://www.landxml.org/schema/LandXML-1.2/).

The file is parsed as a stream, without a tree; a document type or an entity is rejected. Coordinates are returned in
the order x (easting), y (northing), z, in metres.
"""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.core.reading import COMPLETE_FILE, translate_errors
from egvs.formats import xml

ROOT = "LandXML"

_CHUNK_BYTES = 1 << 16
_MAX_TEXT = 10_000
_MAX_DEPTH = 100
_UNITS_M = {
    "meter": 1.0, "metre": 1.0, "millimeter": 0.001, "centimeter": 0.01, "decimeter": 0.1, "kilometer": 1000.0,
    "foot": 0.3048, "ussurveyfoot": 1200 / 3937, "inch": 0.0254, "mile": 1609.344,
}  # fmt: skip
_HINT = "Export the surface again as LandXML, with points and faces (a TIN)."


@dataclass(frozen=True, eq=False)
class TinSurface:
    """A triangulated surface.

    Attributes
    ----------
    name
        As in the file.
    vertices
        (n, 3) float64: x, y in the file's system, z in metres.
    faces
        (m, 3) int64.
    """

    name: str
    vertices: FloatArray
    faces: IntArray


@dataclass(frozen=True)
class LandXmlFile:
    """The surfaces of a file, its reference system (None if it declares none), and the number of hidden faces."""

    surfaces: tuple[TinSurface, ...]
    crs: str | None
    hidden_faces: int


def read_landxml(path: Path) -> LandXmlFile:
    """Read the surfaces of a LandXML file, gzipped or not.

    Raises
    ------
    InputError
        When the file is damaged, too large, or has no triangulated surface.
    """
    handler = _Handler(path)
    encoding = xml.file_encoding(path)
    is_decoded = encoding not in xml.PARSER_ENCODINGS
    parser = expat.ParserCreate("utf-8" if is_decoded else None)
    parser.buffer_text = True
    parser.StartElementHandler = handler.start
    parser.EndElementHandler = handler.end
    parser.CharacterDataHandler = handler.text
    parser.StartDoctypeDeclHandler = handler.reject
    parser.EntityDeclHandler = handler.reject
    with translate_errors(path), xml.open_bounded(path) as file:
        source: Any = xml.Utf8Reader(file, encoding) if is_decoded else file
        try:
            while chunk := source.read(_CHUNK_BYTES):
                parser.Parse(chunk, False)
            parser.Parse(b"", True)
        except expat.ExpatError as error:
            raise InputError(path, f"is not well-formed XML: {error}", COMPLETE_FILE) from None
        except UnicodeDecodeError as error:
            raise InputError(path, f"is not {encoding} text: byte {error.start}", COMPLETE_FILE) from None
    if not handler.surfaces:
        raise InputError(path, "has no triangulated surface with points and faces", _HINT)
    return LandXmlFile(tuple(handler.surfaces), handler.crs, handler.hidden_faces)


@dataclass
class _Points:
    """Points and faces of the surface that is being read."""

    name: str
    ids: dict[str, int] = field(default_factory=dict)
    coordinates: array[float] = field(default_factory=lambda: array("d"))
    faces: array[int] = field(default_factory=lambda: array("q"))


class _Handler:
    """Collects the surfaces while the file is parsed."""

    def __init__(self, path: Path) -> None:
        self.surfaces: list[TinSurface] = []
        self.crs: str | None = None
        self.hidden_faces = 0
        self._path = path
        self._depth = 0
        self._unit_m = 1.0
        self._surface: _Points | None = None
        self._attributes: dict[str, str] = {}
        self._text: list[str] | None = None
        self._text_length = 0

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        tag = tag.rpartition(":")[2]
        if not self._depth and tag != ROOT:
            problem = f"expected the root element <{ROOT}>, got <{tag}>"
            raise InputError(self._path, problem, "Check the file name.")
        self._depth += 1
        if self._depth > _MAX_DEPTH:
            raise InputError(self._path, f"elements are nested more than {_MAX_DEPTH} deep", COMPLETE_FILE)
        match tag:
            case "Metric" | "Imperial":
                self._set_unit(attributes.get("linearUnit", "meter" if tag == "Metric" else "foot"))
            case "CoordinateSystem":
                self._set_crs(attributes)
            case "Surface":
                self._surface = _Points(attributes.get("name", ""))
            case "P" | "F" if self._surface is not None:
                self._attributes, self._text, self._text_length = attributes, [], 0

    def text(self, text: str) -> None:
        if self._text is not None:
            self._text.append(text)
            self._text_length += len(text)
            if self._text_length > _MAX_TEXT:
                raise InputError(self._path, "has a point or face of unlimited text", COMPLETE_FILE)

    def end(self, tag: str) -> None:
        self._depth -= 1
        tag = tag.rpartition(":")[2]
        if tag == "Surface" and self._surface is not None:
            self._finish_surface(self._surface)
            self._surface = None
        elif tag in ("P", "F") and self._surface is not None and self._text is not None:
            words = "".join(self._text).split()
            self._text = None
            if tag == "P":
                self._add_point(self._surface, words)
            elif self._attributes.get("i") == "1":
                self.hidden_faces += 1
            else:
                self._add_face(self._surface, words)

    def reject(self, *_arguments: Any) -> None:
        problem = "declares XML entities or a document type, which are not allowed"
        raise InputError(self._path, problem, "Remove <!DOCTYPE ...> from the file.")

    def _set_unit(self, unit: str) -> None:
        unit_m = _UNITS_M.get(unit.lower())
        if unit_m is None:
            known = ", ".join(_UNITS_M)
            raise InputError(f"{self._path}: linearUnit", f"expected one of {known}, got {unit[:40]!r}", _HINT)
        self._unit_m = unit_m

    def _set_crs(self, attributes: dict[str, str]) -> None:
        code = attributes.get("epsgCode", "").strip().upper().removeprefix("EPSG:")
        if code.isascii() and code.isdecimal() and int(code[:9]):
            self.crs = f"EPSG:{int(code[:9])}"
        elif attributes.get("ogcWktCode", "").strip():
            self.crs = attributes["ogcWktCode"].strip()

    def _add_point(self, surface: _Points, words: list[str]) -> None:
        name = self._attributes.get("id", str(len(surface.ids) + 1))
        where = f"{self._path}: point {name[:40]}"
        if name in surface.ids:
            raise InputError(where, "the id occurs twice in the surface", _HINT)
        numbers = []
        for word in words:
            try:
                numbers.append(float(word))
            except ValueError:
                numbers.append(math.nan)
        if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
            problem = f"expected northing, easting and height, got {' '.join(words)[:60]!r}"
            raise InputError(where, problem, _HINT)
        northing, easting, height = numbers
        surface.ids[name] = len(surface.ids)
        limits.POINTS.check(self._path, len(surface.ids))
        surface.coordinates.extend((easting, northing, height * self._unit_m))

    def _add_face(self, surface: _Points, words: list[str]) -> None:
        try:
            corners = [surface.ids[word] for word in words]
        except KeyError as error:
            problem = f"names the point {str(error)[:40]}, which is not there"
            raise InputError(f"{self._path}: face {' '.join(words)[:60]!r}", problem, _HINT) from None
        if len(corners) not in (3, 4):
            problem = f"expected the ids of 3 points, got {len(corners)}"
            raise InputError(f"{self._path}: face {' '.join(words)[:60]!r}", problem, _HINT)
        limits.TRIANGLES.check(self._path, len(surface.faces) / 3)
        for second in range(1, len(corners) - 1):
            surface.faces.extend((corners[0], corners[second], corners[second + 1]))

    def _finish_surface(self, surface: _Points) -> None:
        if surface.faces:
            vertices = np.array(surface.coordinates, dtype=np.float64).reshape(-1, 3)
            faces = np.array(surface.faces, dtype=np.int64).reshape(-1, 3)
            self.surfaces.append(TinSurface(surface.name, vertices, faces))
