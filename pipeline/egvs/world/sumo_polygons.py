"""Reads what is solid in a SUMO .poly.xml as footprints; everything else is counted by its type.

Steps: look each shape's type up in the table of solids (:mod:`egvs.world.map_features`); widen lines of walls and
barriers; cut out the courtyards that polyconvert hands over as polygons of type ``inner``. Heights are the shape's own
(attribute or parameter ``height``, or what ``polyconvert --all-attributes`` kept of the map), else those of its type.
World frame, metres: a shape is in those of the file's own ``<location>``, in the world frame's where it has none, or in
degrees where it says ``geo``, as a point with ``lon`` and ``lat`` is.
"""

from __future__ import annotations

import math
from collections import Counter
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import shapely
from shapely import Polygon

from egvs.core.errors import Diagnostic, InputError
from egvs.formats import xml
from egvs.formats.georeference import WGS84, CoordinateReading, Georeference
from egvs.traffic.network import read_location
from egvs.world.footprints import CROSSING_RINGS, Footprint, FootprintFile, to_polygons
from egvs.world.geolocation import network_world_frame
from egvs.world.map_features import TRUNK_RADIUS_M, SolidType, SolidTypes, is_underground, vertical_extent

_INNER = "inner"
_WHITE = ("white", "255,255,255")  # polyconvert's colour of courtyards, which --osm.keep-full-type gives another type
_NO_TYPE = "(none)"
_MAX_LISTED = 12  # types that a warning names
_HINT = "Make the file with polyconvert and the scenario's network (-n)."


def read_poly_xml(path: Path, types: SolidTypes, height_m: float, world: Georeference) -> FootprintFile:
    """Footprints of what is solid; ``height_m`` is the top of what has no height of its own, nor one by its type.

    What is left out is counted by type; types that no table knows, and outlines of solids that are not closed, are
    warned of. InputError names the solid that is not sound, or the file where it lies elsewhere.
    """
    reader = _PolygonReader(path, types, height_m, world)
    for number, element in enumerate(xml.iter_elements(path, "additional")):
        reader.take(number, element)
    return reader.done()


class _PolygonReader:
    """Takes the shapes of one file, one by one."""

    def __init__(self, path: Path, types: SolidTypes, height_m: float, world: Georeference) -> None:
        self._path, self._types, self._height_m, self._world = path, types, height_m, world
        self._readings = _readings(path, world)
        self._file = FootprintFile()
        self._unknown, self._open, self._polygons = Counter[str](), Counter[str](), 0
        self._crossed: list[str] = []
        self._inner: list[Polygon] = []
        self._white: list[Footprint] = []
        self._added = set[tuple[bytes, float, float]]()

    def take(self, number: int, element: Element) -> None:
        if element.tag not in ("poly", "poi"):
            if element.tag != "location":
                self._file.ignored[f"<{element.tag}> of .poly.xml"] += 1
            return
        name = element.get("id", f"{self._path.stem}_{number}")
        place = f"{self._path}: {element.tag} {name}"
        tags = {p.get("key", ""): p.get("value", "") for p in element if p.tag == "param"}
        kind = _type_of(element, tags)
        if element.tag == "poi":
            self._take_point(place, name, kind, element, tags)
            return
        self._polygons += 1
        if kind == _INNER:
            self._inner += self._areas(place, self._points(element, place), element)
            return
        if is_underground(tags):
            self._leave_out("underground polygons", kind)
            return
        solid = self._types.named(kind)
        if solid is None:
            self._leave_out("polygons", kind)
            if not self._types.knows(kind):
                self._unknown[kind or _NO_TYPE] += 1
            return
        points = self._points(element, place)
        closed = points[0] == points[-1] or _is_filled(element)
        if len(set(points)) > 2 and closed and (solid.half_width_m is None or _is_filled(element)):
            areas = self._areas(place, points, element)
        elif solid.half_width_m is not None:
            areas = self._strips(place, points, element, solid.half_width_m)
        else:
            self._leave_out("open lines", kind)
            self._open[kind] += 1
            return
        self._add(place, name, kind, solid, areas, element, tags)

    def _take_point(self, where: str, name: str, kind: str, element: Element, tags: dict[str, str]) -> None:
        """A pole, or a tree with its trunk; all other points of interest are none."""
        solid = self._types.pole(kind)
        radius_m = None if solid is None else solid.half_width_m
        is_geo = "x" not in element.attrib
        x, y = (element.get(key) for key in (("lon", "lat") if is_geo else ("x", "y")))
        if solid is None or radius_m is None or x is None or y is None:
            self._leave_out("points", kind.partition(".")[0])
            return
        spots = _numbers(f"{x},{y}", where)
        at, reading = spots[0], self._reading(where, spots, is_geo)
        disc = to_polygons(
            {"type": "Point", "coordinates": at}, {"radius_m": radius_m}, where, self._file.repaired, reading
        )
        base_m = self._add(where, name, kind, solid, disc, element, tags)
        if solid.is_tree and base_m > 0:
            properties = {"radius_m": TRUNK_RADIUS_M}
            trunk = to_polygons({"type": "Point", "coordinates": at}, properties, where, self._file.repaired, reading)
            self._file.footprints.append(Footprint(f"{name}/trunk", "tree_trunk", trunk[0], 0.0, base_m))

    def _points(self, element: Element, where: str) -> list[tuple[float, float]]:
        points = _numbers(element.get("shape", ""), where)
        if len(points) < 2:
            right = "three points for an area, two for a line"
            raise InputError(f"{where}: shape", f"{element.get('shape')!r}", right)
        return points

    def _reading(self, where: str, points: list[tuple[float, float]], is_geo: bool) -> CoordinateReading:
        if (reading := self._readings[is_geo]) is None:
            raise self._world.unknown_frame_error(where, "the shape is in longitude and latitude", np.array(points))
        return reading

    def _areas(self, where: str, points: list[tuple[float, float]], element: Element) -> list[Polygon]:
        """What an outline encloses, each part where it crosses itself; nothing where it is flat."""
        mended, kind = self._file.repaired, element.get("type", "")
        if np.isfinite(points).all() and shapely.make_valid(Polygon(points)).area == 0:
            self._leave_out("outlines that enclose nothing", kind)
            return []
        ring = {"type": "Polygon", "coordinates": [points if points[0] == points[-1] else [*points, points[0]]]}
        reading, before = self._reading(where, points, _is_geographic(element)), mended[CROSSING_RINGS]
        areas = to_polygons(ring, {}, where, mended, reading, mends_crossings=True)
        if mended[CROSSING_RINGS] > before:
            self._crossed.append(where.rpartition(" ")[2])
        return areas

    def _strips(
        self, where: str, points: list[tuple[float, float]], element: Element, half_width_m: float
    ) -> list[Polygon]:
        line = {"type": "LineString", "coordinates": points}
        reading = self._reading(where, points, _is_geographic(element))
        return to_polygons(line, {"radius_m": half_width_m}, where, self._file.repaired, reading)

    def _add(
        self, where: str, name: str, kind: str, solid: SolidType, areas: list[Polygon], element: Element,
        tags: dict[str, str],
    ) -> float:  # fmt: skip
        """Add a solid, and give the z of its underside."""
        if (own := element.get("height")) is not None:
            tags = {**tags, "height": _height(own, where)}
        extent = vertical_extent(tags, solid, self._height_m)
        for what in extent.unreadable:
            self._file.repaired[f"{what} that cannot be read, taken as not there"] += 1
        shown = "tree_crown" if solid.is_tree else "roof" if solid.thickness_m else kind.partition(".")[0]
        for area in areas:
            if (same := (area.wkb, extent.base_m, extent.top_m)) in self._added:
                self._file.repaired["solids that are there twice"] += 1
                continue
            self._added.add(same)
            if extent.source == "default" and solid.height_m is None:
                self._file.repaired[f"heights taken as {self._height_m:g} m"] += 1
            into = self._white if element.get("color") in _WHITE else self._file.footprints
            into.append(Footprint(name, shown or "polygon", area, extent.base_m, extent.top_m))
        return extent.base_m

    def _leave_out(self, what: str, kind: str) -> None:
        self._file.ignored[f"{what} of type {kind or _NO_TYPE}"] += 1

    def done(self) -> FootprintFile:
        """The footprints with courtyards cut out, and what to know before trusting them."""
        file = self._file
        self._cut_courtyards()
        place = str(self._path)
        if self._unknown:
            found = f"{_list_types(self._unknown)}: left out, for no table says whether this is solid"
            cure = 'say it in [statics.polygon_types]: "solid", "ignore" or a height in metres for each type'
            file.warnings.append(Diagnostic("polygon types", place, f"polygons of type {found}", cure))
        if self._open:
            found = f"outlines of type {_list_types(self._open)} are not closed: left out"
            cure = "close them; those of polyconvert that come in several ways are joined by --osm.merge-relations 1"
            file.warnings.append(Diagnostic("open outlines", place, found, cure))
        if self._crossed:
            shown = ", ".join(self._crossed[:_MAX_LISTED]) + (", ..." if self._crossed[_MAX_LISTED:] else "")
            found = (
                f"outlines that cross themselves: {len(self._crossed)} ({shown}); each part that they enclose is kept"
            )
            file.warnings.append(
                Diagnostic("crossing outlines", place, found, "look at them on the map, and mend it there")
            )
        if self._polygons and not file.footprints:
            found = f"none of its {self._polygons} polygons is solid"
            cure = "name the types that are in [statics.polygon_types], or leave the file out of statics.polygons"
            file.warnings.append(Diagnostic("polygon types", place, found, cure))
        if inside := len(_pairs_inside(file.footprints)):
            found = f"solids inside another of their kind and height: {inside}; they may be courtyards that are filled"
            cure = "if so, polyconvert --osm.merge-relations 1 lets them be cut out"
            file.warnings.append(Diagnostic("filled courtyards", place, found, cure))
        return file

    def _cut_courtyards(self) -> None:
        """Cut polygons of type ``inner``, and white ones inside their own kind, out of what surrounds them."""
        footprints = self._file.footprints
        inner = [(polygon, None) for polygon in self._inner] + [(white.polygon, white) for white in self._white]
        tree = shapely.STRtree([footprint.polygon for footprint in footprints])
        for polygon, white in inner:
            around = [int(n) for n in tree.query(polygon, predicate="covered_by")]
            cut = {
                n: rest
                for n in sorted(around)
                if (white is None or white.kind == footprints[n].kind)
                and (rest := _cut_courtyard(footprints[n], polygon)) is not None
            }
            for number, rest in cut.items():
                footprints[number] = rest
            if cut:
                self._file.repaired["courtyards cut out"] += len(cut)
            elif white is not None:
                footprints.append(white)


def _type_of(element: Element, tags: dict[str, str]) -> str:
    """The shape's type; "building" with a parameter ``building = garage`` is a ``building.garage``."""
    kind = element.get("type", "")
    return f"{kind}.{tags[kind]}" if "." not in kind and kind in tags else kind


def _is_filled(element: Element) -> bool:
    return element.get("fill", "false").lower() in ("true", "1")


def _is_geographic(element: Element) -> bool:
    return element.get("geo", "false").lower() in ("true", "1")


def _readings(path: Path, world: Georeference) -> dict[bool, CoordinateReading | None]:
    """How the file's shapes become the world frame's: those in degrees (True), and those in metres (False).

    None where nothing says where the world frame lies, which matters only if a solid is in degrees.
    """
    points: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
    for element in xml.iter_elements(path, "additional"):
        if element.tag == "poly":
            with suppress(InputError):  # told with the shape's name where it is read
                points[_is_geographic(element)] += _numbers(element.get("shape", ""), "")
        elif element.tag == "poi" and "lon" in element.attrib:
            with suppress(InputError):
                points[True] += _numbers(f"{element.get('lon')},{element.get('lat')}", "")
    finite = {is_geo: [p for p in some if np.isfinite(p).all()] for is_geo, some in points.items()}
    degrees, metres = (np.array(finite[is_geo]).reshape(-1, 2) for is_geo in (True, False))
    own = network_world_frame(read_location(path, "additional"))
    return {
        True: None if world.frame is None else world.read_coordinates(degrees, str(path), WGS84, _HINT),
        False: world.read_framed_coordinates(own, metres, str(path), _HINT),
    }


def _numbers(text: str, where: str) -> list[tuple[float, float]]:
    try:
        return [(float(x), float(y)) for x, y in (pair.split(",")[:2] for pair in text.split())]
    except ValueError as error:
        what = f"has a value that is no number ({error})"
        raise InputError(where, what, "shape='x,y x,y ...' in metres") from None


def _height(text: str, where: str) -> str:
    """SUMO's own attribute: a number of metres, else refused."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise InputError(f"{where}: height", repr(text), "a number of metres above 0")
    return text


def _cut_courtyard(footprint: Footprint, inner: Polygon) -> Footprint | None:
    """The footprint with a courtyard cut out; None where it does not surround it."""
    if not footprint.polygon.covers(inner) or footprint.polygon.equals(inner):
        return None
    rest = footprint.polygon.difference(inner)
    return replace(footprint, polygon=shapely.orient_polygons(rest)) if rest.geom_type == "Polygon" else None


def _pairs_inside(footprints: list[Footprint]) -> list[tuple[int, int]]:
    """Which footprint lies wholly inside which other of its kind that stands as high from as low."""
    shapes = np.array([footprint.polygon for footprint in footprints], dtype=object)
    pairs = zip(*shapely.STRtree(shapes).query(shapes, predicate="within").tolist(), strict=True)
    return [(a, b) for a, b in pairs if a != b and _kind_and_extent(footprints[a]) == _kind_and_extent(footprints[b])]


def _kind_and_extent(footprint: Footprint) -> tuple[str, float, float]:
    return footprint.kind, footprint.base_m, footprint.height_m


def _list_types(counts: Counter[str]) -> str:
    """Types with how often each occurs, the most frequent first."""
    shown = [f"{name} ({count})" for name, count in sorted(counts.items(), key=lambda item: (-item[1], item[0]))]
    return ", ".join(shown[:_MAX_LISTED]) + (
        f" and {len(shown) - _MAX_LISTED} more types" if len(shown) > _MAX_LISTED else ""
    )
