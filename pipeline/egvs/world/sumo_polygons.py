"""Read the solid shapes of a SUMO .poly.xml as footprints; all other shapes are counted by type.

Steps: look up the type of each shape in the tables of solid types (:mod:`egvs.world.map_features`); widen the lines of
walls and barriers; cut out courtyards, which polyconvert writes as polygons of type ``inner``. Heights are those of the
shape (attribute or parameter ``height``, or tags that ``polyconvert --all-attributes`` keeps), else of its type.

A shape is in metres of the file's own ``<location>``, or of the world frame without it. With ``geo``, it is in
degrees, as are points with ``lon`` and ``lat``. Metres of another ``<location>`` than that of the network are converted
through longitude and latitude, and counted; without a known projection on both sides they are an error.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Element

import numpy as np

from egvs.core.errors import Diagnostic, InputError
from egvs.core.grid import FloatArray
from egvs.core.numbers import number_or_nan
from egvs.core.polygons import PairCount, repair_polygon
from egvs.core.wording import list_first
from egvs.formats import xml
from egvs.formats.georeference import WGS84, CoordinateReading, Georeference
from egvs.scenario.fields import MAX_COORDINATE_M
from egvs.traffic.network import Location, parse_location
from egvs.world.footprints import CROSSING_RINGS, Footprint, FootprintFile, box_pairs, to_polygons
from egvs.world.geolocation import StatedLocation, network_world_frame
from egvs.world.map_features import POLE_TYPES, TRUNK_RADIUS_M, SolidType, SolidTypes, is_underground, vertical_extent

if TYPE_CHECKING:
    from shapely import Polygon

_INNER = "inner"
# polyconvert's colour of courtyards, which have another type with --osm.keep-full-type
_WHITE = ("white", "255,255,255")
_NO_TYPE = "(none)"
# types, and shapes, that a warning names
_MAX_LISTED = 12
# pairs of shapes that are compared for a warning: two seconds
_MAX_COMPARISONS = 50_000
_HINT = "Make the file with polyconvert and the scenario's network (-n)."
_LOCATION_HINT = f"{_HINT} If its shapes are in metres of the network, remove <location>."

Points = list[tuple[float, float]]


def read_poly_xml(
    path: Path, types: SolidTypes, height_m: float, world: Georeference, expected: StatedLocation | None = None
) -> FootprintFile:
    """Read the footprints of solid shapes.

    Parameters
    ----------
    path
        The file.
    types
        Which types are solid.
    height_m
        Top of solids that have no height and whose type has none.
    world
        Where the world frame is.
    expected
        The ``<location>`` of the network, or else of another file of the scenario.

    Returns
    -------
    FootprintFile
        Shapes that are not solid are counted by type. Warnings name unknown types and open outlines.

    Raises
    ------
    InputError
        When a solid is invalid, or the file is of another location.
    """
    reader = _PolygonReader(path, types, height_m, world, expected)
    for number, element in enumerate(xml.iter_elements(path, "additional")):
        reader.add_element(number, element)
    return reader.finish()


@dataclass(frozen=True)
class _Shape:
    """A shape of the file; ``where`` is for messages, ``tags`` are its parameters."""

    where: str
    name: str
    kind: str
    tags: dict[str, str]
    element: Element

    @classmethod
    def from_element(cls, element: Element, name: str, path: Path) -> _Shape:
        """The type "building" with a parameter ``building = garage`` is ``building.garage``."""
        tags = {param.get("key", ""): param.get("value", "") for param in element if param.tag == "param"}
        kind = element.get("type", "")
        if "." not in kind and kind in tags:
            kind = f"{kind}.{tags[kind]}"
        return cls(f"{path}: {element.tag} {name}", name, kind, tags, element)

    @property
    def is_filled(self) -> bool:
        return _is_true(self.element, "fill")

    @property
    def is_geographic(self) -> bool:
        """Whether the coordinates are degrees."""
        if self.element.tag == "poi":
            return "x" not in self.element.attrib
        return _is_true(self.element, "geo")

    def points(self) -> Points:
        """Return the points of a polygon or line; InputError for fewer than two."""
        points = _parse_points(self.element.get("shape", ""), self.where)
        if len(points) < 2:
            expected = "expected at least three points for an area, two for a line"
            raise InputError(f"{self.where}: shape", f"{expected}, got {self.element.get('shape')!r}")
        return points


class _PolygonReader:
    """Collects the solids of one file, shape by shape."""

    def __init__(
        self, path: Path, types: SolidTypes, height_m: float, world: Georeference, expected: StatedLocation | None
    ) -> None:
        self._path = path
        self._types = types
        self._height_m = height_m
        self._world = world
        self._readings = _coordinate_readings(path, world, expected)
        self._file = FootprintFile()
        self._count = PairCount(path)
        self._polygon_count = 0
        self._unknown_types = Counter[str]()
        self._open_types = Counter[str]()
        self._crossing_names: list[str] = []
        self._inner: list[Polygon] = []
        self._white: list[Footprint] = []
        self._added = set[tuple[bytes, float, float]]()

    def add_element(self, number: int, element: Element) -> None:
        if element.tag in ("poly", "poi"):
            shape = _Shape.from_element(element, element.get("id", f"{self._path.stem}_{number}"), self._path)
            if element.tag == "poly":
                self._add_polygon(shape)
            else:
                self._add_point(shape)
        elif element.tag != "location":
            self._file.ignored[f"<{element.tag}> of .poly.xml"] += 1

    def _add_polygon(self, shape: _Shape) -> None:
        self._polygon_count += 1
        if shape.kind == _INNER:
            self._inner += self._areas(shape, shape.points())
            return
        if is_underground(shape.tags):
            self._ignore("underground polygons", shape.kind)
            return
        solid = self._types.area_type(shape.kind)
        if solid is None:
            self._ignore("polygons", shape.kind)
            if not self._types.is_known(shape.kind):
                self._unknown_types[shape.kind or _NO_TYPE] += 1
            return
        points = shape.points()
        is_area = len(set(points)) > 2 and (points[0] == points[-1] or shape.is_filled)
        if is_area and (solid.half_width_m is None or shape.is_filled):
            self._add_solid(shape, solid, self._areas(shape, points))
        elif solid.half_width_m is not None:
            line = {"type": "LineString", "coordinates": points}
            self._add_solid(shape, solid, self._widen(shape, line, points, solid.half_width_m))
        else:
            self._ignore("open lines", shape.kind)
            self._open_types[shape.kind] += 1

    def _add_point(self, shape: _Shape) -> None:
        """Add a pole, or a tree with its trunk; ignore other points of interest."""
        solid = self._types.point_type(shape.kind)
        radius_m = None if solid is None else solid.half_width_m
        x, y = (shape.element.get(key) for key in (("lon", "lat") if shape.is_geographic else ("x", "y")))
        if solid is None or radius_m is None or x is None or y is None:
            self._ignore("points", shape.kind.partition(".")[0])
            return
        points = _parse_points(f"{x},{y}", shape.where)
        centre = {"type": "Point", "coordinates": points[0]}
        base_m = self._add_solid(shape, solid, self._widen(shape, centre, points, radius_m))
        if solid.is_tree and base_m > 0:
            trunk = self._widen(shape, centre, points, TRUNK_RADIUS_M)
            self._file.footprints.append(Footprint(f"{shape.name}/trunk", "tree_trunk", trunk[0], 0.0, base_m))

    def _reading(self, shape: _Shape, points: Points) -> CoordinateReading:
        reading = self._readings[shape.is_geographic]
        if reading is None:
            what = "the shape is in longitude and latitude"
            raise self._world.unknown_frame_error(shape.where, what, np.array(points))
        return reading

    def _widen(self, shape: _Shape, geometry: Mapping[str, object], points: Points, radius_m: float) -> list[Polygon]:
        """Return a point or line as an area."""
        reading = self._reading(shape, points)
        properties = {"radius_m": radius_m}
        return to_polygons(geometry, properties, shape.where, self._file.repaired, reading, count=self._count)

    def _areas(self, shape: _Shape, points: Points) -> list[Polygon]:
        """Return what an outline encloses: each part where it crosses itself, nothing where it is flat."""
        from shapely import Polygon

        if np.abs(points).max() <= MAX_COORDINATE_M:  # all others are refused below
            outline = repair_polygon(Polygon(points), shape.where, self._count)
            if outline.area == 0:
                self._ignore("outlines that enclose nothing", shape.element.get("type", ""))
                return []
        ring = points if points[0] == points[-1] else [*points, points[0]]
        repaired = self._file.repaired
        before = repaired[CROSSING_RINGS]
        areas = to_polygons(
            {"type": "Polygon", "coordinates": [ring]}, {}, shape.where, repaired, self._reading(shape, points),
            keep_crossing_parts=True, count=self._count,
        )  # fmt: skip
        if repaired[CROSSING_RINGS] > before:
            self._crossing_names.append(shape.name)
        return areas

    def _add_solid(self, shape: _Shape, solid: SolidType, areas: list[Polygon]) -> float:
        """Add a solid; return the height of its underside."""
        tags = shape.tags
        height = shape.element.get("height")
        if height is not None:
            _check_height(height, shape.where)
            tags = {**tags, "height": height}
        reading = self._readings[shape.is_geographic]
        if areas and reading is not None and reading.convert is not None:
            self._file.repaired[f"shapes in {reading.description}, brought into the world frame"] += 1
        extent = vertical_extent(tags, solid, self._height_m)
        for what in extent.unreadable:
            self._file.repaired[f"{what} that cannot be read, taken as not there"] += 1
        kind = shape.kind.partition(".")[0] or "polygon"
        if solid.is_tree:
            kind = "tree_crown"
        elif solid.thickness_m:
            kind = "roof"
        elif shape.kind in POLE_TYPES:
            kind = "pole"
        is_white = shape.element.get("color") in _WHITE
        footprints = self._white if is_white else self._file.footprints
        for area in areas:
            key = (area.wkb, extent.base_m, extent.top_m)
            if key in self._added:
                self._file.repaired["solids that are there twice"] += 1
                continue
            self._added.add(key)
            if extent.source == "default" and solid.height_m is None:
                self._file.repaired[f"heights taken as {self._height_m:g} m"] += 1
            footprints.append(Footprint(shape.name, kind, area, extent.base_m, extent.top_m))
        return extent.base_m

    def _ignore(self, what: str, kind: str) -> None:
        self._file.ignored[f"{what} of type {kind or _NO_TYPE}"] += 1

    def finish(self) -> FootprintFile:
        """Cut out courtyards; return the footprints with warnings."""
        self._cut_courtyards()
        if self._unknown_types:
            problem = f"polygons of unknown types were left out: {_list_types(self._unknown_types)}"
            hint = 'Set each in [statics.polygon_types] to "solid", "ignore" or a height in metres.'
            self._warn("polygon types", problem, hint)
        if self._open_types:
            problem = f"open outlines of solid types were left out: {_list_types(self._open_types)}"
            hint = "Close them. polyconvert --osm.merge-relations 1 joins outlines that are split into several ways."
            self._warn("open outlines", problem, hint)
        if self._crossing_names:
            shown = list_first(self._crossing_names, _MAX_LISTED)
            count = len(self._crossing_names)
            problem = f"outlines that cross themselves: {count} ({shown}). All areas that they enclose are kept"
            self._warn("crossing outlines", problem, "Check and correct them in the map.")
        if self._polygon_count and not self._file.footprints:
            problem = f"none of the {self._polygon_count} polygons is solid"
            hint = "List solid types in [statics.polygon_types], or remove the file from statics.polygons."
            self._warn("polygon types", problem, hint)
        inside, is_complete = _count_inside(self._file.footprints)
        if inside:
            number = f"{inside}" if is_complete else f"at least {inside}"
            problem = f"solids inside another of the same kind and height: {number}. They may be filled courtyards"
            self._warn(
                "filled courtyards", problem, "If so, use polyconvert --osm.merge-relations 1, which cuts them out."
            )
        return self._file

    def _warn(self, rule: str, problem: str, hint: str) -> None:
        self._file.warnings.append(Diagnostic(rule, str(self._path), problem, hint))

    def _cut_courtyards(self) -> None:
        """Cut polygons of type ``inner``, and white ones inside their own kind, out of what surrounds them."""
        import shapely

        footprints = self._file.footprints
        tree = shapely.STRtree([footprint.polygon for footprint in footprints])
        for polygon in self._inner:
            surrounding = sorted(tree.query(polygon, predicate="covered_by").tolist())
            self._cut(polygon, surrounding)
        for white in self._white:
            around = tree.query(white.polygon, predicate="covered_by").tolist()
            surrounding = [number for number in sorted(around) if footprints[number].kind == white.kind]
            if not self._cut(white.polygon, surrounding):
                footprints.append(white)

    def _cut(self, courtyard: Polygon, surrounding: list[int]) -> int:
        """Cut a courtyard out of the footprints with these numbers; return how many it was cut out of."""
        footprints = self._file.footprints
        count = 0
        for number in surrounding:
            remaining = _cut_courtyard(footprints[number], courtyard)
            if remaining is not None:
                footprints[number] = remaining
                count += 1
        if count:
            self._file.repaired["courtyards cut out"] += count
        return count


def _is_true(element: Element, attribute: str) -> bool:
    return element.get(attribute, "false").lower() in ("true", "1")


def read_poly_location(path: Path) -> StatedLocation | None:
    """Return the ``<location>`` of a file, wherever it is in it; None for a file without, InputError for a second."""
    location: Location | None = None
    for element in xml.iter_elements(path, "additional"):
        if element.tag != "location":
            continue
        if location is not None:
            raise InputError(path, "there are two <location>s", "Keep the one that its shapes are in.")
        location = parse_location(element, path)
    return None if location is None else StatedLocation(str(path), location)


def _coordinate_readings(
    path: Path, world: Georeference, expected: StatedLocation | None
) -> dict[bool, CoordinateReading | None]:
    """Return the conversion to the world frame of shapes in degrees (True) and in metres (False).

    It is None for degrees if the position of the world frame is unknown; this only matters if a solid is in degrees.
    """
    degrees: Points = []
    metres: Points = []
    for element in xml.iter_elements(path, "additional"):
        with suppress(InputError):  # reported with the name of the shape when it is read
            if element.tag == "poly":
                points = _parse_points(element.get("shape", ""), "")
                if _is_true(element, "geo"):
                    degrees += points
                else:
                    metres += points
            elif element.tag == "poi" and "lon" in element.attrib:
                degrees += _parse_points(f"{element.get('lon')},{element.get('lat')}", "")
            elif element.tag == "poi":
                metres += _parse_points(f"{element.get('x')},{element.get('y')}", "")
    stated = read_poly_location(path)
    own_frame = None if stated is None else network_world_frame(stated.location)
    if metres and stated is not None and expected is not None and (own_frame is None or world.frame is None):
        stated.check_same(expected, _LOCATION_HINT)
    in_degrees = None
    if world.frame is not None:
        in_degrees = world.read_coordinates(_finite_points(degrees), str(path), WGS84, _HINT)
    in_metres = world.read_framed_coordinates(own_frame, _finite_points(metres), str(path), _HINT)
    return {True: in_degrees, False: in_metres}


def _finite_points(points: Points) -> FloatArray:
    array = np.array(points, dtype=np.float64).reshape(-1, 2)
    return array[np.isfinite(array).all(axis=1)]


def _parse_points(text: str, where: str) -> Points:
    try:
        return [(float(x), float(y)) for x, y in (pair.split(",")[:2] for pair in text.split())]
    except ValueError as error:
        raise InputError(where, f"expected shape='x,y x,y ...' in metres ({error})") from None


def _check_height(text: str, where: str) -> None:
    """Raise an InputError unless an attribute ``height`` of a shape is a number above 0."""
    height_m = number_or_nan(text)
    if not 0 < height_m < math.inf:
        raise InputError(f"{where}: height", f"expected a number of metres above 0, got {text!r}")


def _cut_courtyard(footprint: Footprint, courtyard: Polygon) -> Footprint | None:
    """Return the footprint without the courtyard; None if the courtyard is not inside."""
    import shapely

    if not footprint.polygon.covers(courtyard) or footprint.polygon.equals(courtyard):
        return None
    remaining = footprint.polygon.difference(courtyard)
    if remaining.geom_type != "Polygon":
        return None
    return replace(footprint, polygon=shapely.orient_polygons(remaining))


def _count_inside(footprints: list[Footprint]) -> tuple[int, bool]:
    """Count pairs of a footprint inside another of the same kind and vertical extent; stop after many comparisons.

    Returns
    -------
    count
        Pairs.
    is_complete
        Whether all pairs were compared.
    """
    import shapely

    shapes = np.array([footprint.polygon for footprint in footprints], dtype=object)
    if not len(shapes):
        return 0, True
    extents: dict[tuple[str, float | None, float], int] = {}
    names = [(footprint.kind, footprint.base_m, footprint.height_m) for footprint in footprints]
    extent = np.array([extents.setdefault(name, len(extents)) for name in names])
    low, high = np.split(shapely.bounds(shapes), 2, axis=1)
    count = compared = 0
    for inner, outer in box_pairs(shapes, shapes):
        is_candidate = (inner != outer) & (extent[inner] == extent[outer])
        is_candidate &= (low[inner] >= low[outer]).all(axis=1) & (high[inner] <= high[outer]).all(axis=1)
        inner, outer = inner[is_candidate], outer[is_candidate]
        left = _MAX_COMPARISONS - compared
        count += int(np.count_nonzero(shapely.within(shapes[inner[:left]], shapes[outer[:left]])))
        compared += len(inner)
        if compared > _MAX_COMPARISONS:
            return count, False
    return count, True


def _list_types(counts: Counter[str]) -> str:
    """Return types with their counts, the most frequent first."""
    by_count = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    return list_first([f"{name} ({count})" for name, count in by_count], _MAX_LISTED)
