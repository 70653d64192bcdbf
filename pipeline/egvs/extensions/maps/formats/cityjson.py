"""Read the objects of CityJSON files, versions 1.0 to 2.0.

A file is JSON: ``vertices`` as integers, to be scaled and moved by ``transform``; ``CityObjects`` with geometries at
several levels of detail whose ``boundaries`` are nested lists of vertex numbers; templates that are placed many times;
``metadata.referenceSystem``. Parts of a building are objects of their own, here components of it. The order of the axes
is that of the reference system, as in CityGML.

Source: OGC 20-072r5, CityJSON Community Standard 2.0.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.reading import COMPLETE_FILE, read_json
from egvs.extensions.maps.formats.city_objects import (
    SOLID,
    SURFACE,
    CityObject,
    Component,
    Geometry,
    Placement,
    Surface,
)
from egvs.extensions.maps.formats.citygml import valid_height_m, valid_storeys

_SURFACES = {"MultiSurface": 0, "CompositeSurface": 0, "Solid": 1, "MultiSolid": 2, "CompositeSolid": 2}
"""How many levels the boundaries of a geometry have above the list of its surfaces."""

_HINT = "Use a complete CityJSON file of version 1.0, 1.1 or 2.0."


class CityJsonFile:
    """The objects of a CityJSON file; InputError when it is damaged.

    Parameters
    ----------
    path
        The file.

    Attributes
    ----------
    templates
        Surfaces of templates by their number in the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        document = read_json(path, _HINT)
        version = document.get("version") if isinstance(document, dict) else None
        if not isinstance(document, dict) or document.get("type") != "CityJSON":
            raise InputError(path, 'expected a CityJSON object with "type": "CityJSON"', _HINT)
        if not isinstance(version, str) or not re.fullmatch(r"[12]\.\d+(\.\d+)?", version):
            raise InputError(f"{path}: version", f"expected 1.0 to 2.0, got {version!r}"[:120], _HINT)
        self._objects = _typed(document, "CityObjects", dict, path)
        vertices = _points(_typed(document, "vertices", list, path), f"{path}: vertices")
        self._vertices = _apply_transform(vertices, document.get("transform"), path)
        self._srs_name = _srs_name(document.get("metadata"), path)
        self.templates: dict[str, list[Surface]] = {}
        self._template_lods: dict[str, float] = {}
        self._read_templates(document.get("geometry-templates"))

    def objects(self) -> Iterator[CityObject]:
        """Yield the objects that are no parts of others, in their order; InputError when the file is damaged."""
        children = self._children()
        parts = {name for names in children.values() for name in names}
        read: set[str] = set()
        for name, document in self._objects.items():
            if name in parts:
                continue
            where = f"{self.path}: {name}"
            kind = document.get("type")
            if not isinstance(kind, str):
                raise InputError(f"{where}: type", f"expected a name, got {kind!r}"[:120], _HINT)
            members = _descendants(name, children, read)
            components = [self._component(self._objects[member], where) for member in members]
            yield CityObject(name, kind, self._srs_name, components)
        unread = next((name for name in self._objects if name not in read), None)
        if unread is not None:
            raise InputError(f"{self.path}: {unread}: children", "is a part of itself", COMPLETE_FILE)

    def _children(self) -> dict[str, list[str]]:
        """Return the parts of each object; those that do not exist are left out."""
        children: dict[str, list[str]] = {}
        for name, document in self._objects.items():
            if not isinstance(document, dict):
                raise InputError(f"{self.path}: {name}", "expected an object of the city", _HINT)
            names = document.get("children", [])
            if not isinstance(names, list):
                raise InputError(f"{self.path}: {name}: children", "expected a list of names", _HINT)
            if document.get("type") != "CityObjectGroup":
                children[name] = [child for child in names if isinstance(child, str) and child in self._objects]
        return children

    def _component(self, document: Mapping[str, Any], where: str) -> Component:
        component = Component()
        attributes = document.get("attributes")
        if isinstance(attributes, dict):
            heights = [_number(attributes.get(key)) for key in ("measuredHeight", "height", "averageHeight")]
            valid = [height_m for height in heights if (height_m := valid_height_m(height)) is not None]
            component.measured_height_m = max(valid, default=None)
            component.storeys = valid_storeys(_number(attributes.get("storeysAboveGround")))
        geometries = document.get("geometry", [])
        if not isinstance(geometries, list):
            raise InputError(f"{where}: geometry", "expected a list", _HINT)
        for geometry in geometries:
            if not isinstance(geometry, dict):
                raise InputError(f"{where}: geometry", "expected an object", _HINT)
            kind = geometry.get("type")
            if not isinstance(kind, str):
                raise InputError(f"{where}: geometry", f"expected the name of a type, got {kind!r}"[:120], _HINT)
            if kind == "GeometryInstance":
                component.placements.append(self._placement(geometry, where))
            elif kind in _SURFACES:
                component.geometries.append(_geometry(geometry, self._vertices, where))
        return component

    def _placement(self, geometry: Mapping[str, Any], where: str) -> Placement:
        where = f"{where}: GeometryInstance"
        template = geometry.get("template")
        boundaries = geometry.get("boundaries")
        matrix = geometry.get("transformationMatrix")
        if type(template) is not int or str(template) not in self.templates:
            raise InputError(f"{where}: template", f"expected the number of a template, got {template!r}"[:120], _HINT)
        if not isinstance(matrix, list) or len(matrix) != 16 or not all(map(_is_finite, matrix)):
            raise InputError(f"{where}: transformationMatrix", "expected 16 finite numbers", _HINT)
        if not isinstance(boundaries, list) or len(boundaries) != 1:
            raise InputError(f"{where}: boundaries", "expected the number of one vertex", _HINT)
        point = _ring(boundaries, self._vertices, where)[0]
        lod = self._template_lods[str(template)]
        return Placement(lod, [float(value) for value in matrix], point.tolist(), str(template))

    def _read_templates(self, document: Any) -> None:
        if document is None:
            return
        where = f"{self.path}: geometry-templates"
        if not isinstance(document, dict):
            raise InputError(where, "expected an object", _HINT)
        vertices = _points(_typed(document, "vertices-templates", list, where), f"{where}: vertices-templates")
        for number, template in enumerate(_typed(document, "templates", list, where)):
            if not isinstance(template, dict) or template.get("type") not in list(_SURFACES):  # it may be a list
                self.templates[str(number)] = []
                self._template_lods[str(number)] = 0.0
                continue
            geometry = _geometry(template, vertices, f"{where}: {number}")
            surfaces = [member for member in geometry.members if isinstance(member, Surface)]
            self.templates[str(number)] = surfaces
            self._template_lods[str(number)] = geometry.lod


def _geometry(document: Mapping[str, Any], vertices: FloatArray, where: str) -> Geometry:
    """Return the surfaces of a geometry."""
    kind = document["type"]
    where = f"{where}: {kind}"
    surfaces = document.get("boundaries")
    for _ in range(_SURFACES[kind]):
        if not isinstance(surfaces, list) or not all(isinstance(item, list) for item in surfaces):
            raise InputError(f"{where}: boundaries", "expected nested lists", _HINT)
        surfaces = [inner for item in surfaces for inner in item]
    if not isinstance(surfaces, list):
        raise InputError(f"{where}: boundaries", "expected a list of surfaces", _HINT)
    geometry = Geometry(_lod(document.get("lod"), where), SOLID if "Solid" in kind else SURFACE)
    openings = _openings(document.get("semantics"), _SURFACES[kind])
    for number, surface in enumerate(surfaces):
        if not isinstance(surface, list):
            raise InputError(f"{where}: boundaries", "expected a list of rings", _HINT)
        rings = tuple(_ring(ring, vertices, where) for ring in surface)
        if number not in openings:
            geometry.members.append(Surface(rings))
    return geometry


def _openings(semantics: Any, levels: int) -> set[int]:
    """Return the numbers of the closure surfaces, through which beams pass; none for unreadable semantics."""
    if not isinstance(semantics, dict) or not isinstance(semantics.get("surfaces"), list):
        return set()
    kinds = [surface.get("type") if isinstance(surface, dict) else None for surface in semantics["surfaces"]]
    values = semantics.get("values")
    for _ in range(levels):
        if not isinstance(values, list) or not all(isinstance(item, list) for item in values):
            return set()
        values = [inner for item in values for inner in item]
    if not isinstance(values, list):
        return set()
    closures = {number for number, kind in enumerate(kinds) if kind == "ClosureSurface"}
    return {number for number, value in enumerate(values) if type(value) is int and value in closures}


def _ring(ring: Any, vertices: FloatArray, where: str) -> FloatArray:
    """Return the points (n, 3) of a list of vertex numbers."""
    if not isinstance(ring, list) or not all(type(number) is int for number in ring):
        raise InputError(f"{where}: boundaries", "expected lists of vertex numbers", _HINT)
    if ring and not 0 <= min(ring) <= max(ring) < len(vertices):
        problem = f"expected vertex numbers from 0 to {len(vertices) - 1}, got {min(ring)} to {max(ring)}"
        raise InputError(f"{where}: boundaries", problem, _HINT)
    return vertices[np.array(ring, dtype=np.int64)]


def _lod(value: Any, where: str) -> float:
    """Return a level of detail, which is text ("2.2") or, in version 1.0, a number."""
    text = str(value)
    if not re.fullmatch(r"[0-4](\.\d)?", text):
        raise InputError(f"{where}: lod", f'expected a level of detail from "0" to "4", got {text[:40]!r}', _HINT)
    return float(text)


def _descendants(name: str, children: Mapping[str, Sequence[str]], read: set[str]) -> list[str]:
    """Return an object and all its parts, without those in ``read``, and add them to it."""
    members = []
    pending = [name]
    while pending:
        member = pending.pop()
        if member not in read:
            read.add(member)
            members.append(member)
            pending += reversed(children.get(member, ()))
    return members


def _points(values: list[Any], where: str) -> FloatArray:
    """Return a list of [x, y, z] as an array (n, 3)."""
    limits.POINTS.check(where, len(values))
    for number, value in enumerate(values):
        if not isinstance(value, list) or len(value) != 3 or not all(map(_is_finite, value)):
            problem = f"expected three finite numbers, got {value!r}"[:160]
            raise InputError(f"{where}: {number}", problem, COMPLETE_FILE)
    return np.array(values, dtype=np.float64).reshape(-1, 3)


def _apply_transform(vertices: FloatArray, transform: Any, path: Path) -> FloatArray:
    if transform is None:
        return vertices
    if not isinstance(transform, dict):
        raise InputError(f"{path}: transform", "expected scale and translate", _HINT)
    scale, translate = (_points([transform.get(key)], f"{path}: transform: {key}") for key in ("scale", "translate"))
    with np.errstate(over="ignore"):
        points: FloatArray = vertices * scale + translate
    if not np.isfinite(points).all():
        raise InputError(f"{path}: transform", "its scale makes coordinates infinite", _HINT)
    return points


def _srs_name(metadata: Any, path: Path) -> str:
    """Return the name of the reference system; empty if the file names none."""
    if metadata is None:
        return ""
    if not isinstance(metadata, dict):
        raise InputError(f"{path}: metadata", "expected an object", _HINT)
    name = metadata.get("referenceSystem", "")
    if not isinstance(name, str):
        raise InputError(f"{path}: metadata: referenceSystem", f"expected a name, got {name!r}"[:120], _HINT)
    return name


def _typed(document: Mapping[str, Any], key: str, kind: type, where: object) -> Any:
    value = document.get(key)
    if not isinstance(value, kind):
        raise InputError(f"{where}: {key}", f"expected {kind.__name__}, got {value!r}"[:120], _HINT)
    return value


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _number(value: Any) -> float:
    """Return a number, or nan for any other value."""
    return float(value) if _is_finite(value) else float("nan")
