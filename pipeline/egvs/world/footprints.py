"""Reads footprints, and mends or refuses what is not sound.

Steps: read GeoJSON polygons, lines and points (:mod:`egvs.world.sumo_polygons` reads SUMO's); bring what is in degrees
or in a map projection into the world frame (:mod:`egvs.formats.georeference`); widen lines and points; mend what
has one meaning only, and count it; refuse the rest. World frame, metres.

``height_m`` is the z of the top, ``base_m`` (default 0) the z of the underside. Points are discs of ``radius_m``, lines
are strips of that half width.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from egvs.core.errors import Diagnostic, DiagnosticsError, InputError, find_misspelling
from egvs.core.reading import read_json
from egvs.formats.georeference import WORLD_READING, CoordinateReading, Georeference, declared_crs, geojson_coordinates
from egvs.scenario.fields import MAX_COORDINATE_M

if TYPE_CHECKING:
    from shapely import Polygon
    from shapely.geometry.base import BaseGeometry


CROSSING_RINGS = "rings that cross themselves, each part that they enclose kept"
_MAX_SLIVER_SHARE = 0.01  # of an area
_QUARTER_SIDES = 4  # a disc is a regular polygon of four times as many sides

_HEIGHT_KEYS = ("height_m", "base_m")
"""Properties that count: what is nearly one of them must not be taken for a stranger."""
_NOTE_KEYS = ("height_from",)
"""What ``egvs new`` notes beside them."""
_MAX_REPORTED = 20
"""So many wrong features of a file are told; of more, how many they are."""


@dataclass(frozen=True)
class Footprint:
    """A polygon (world frame, metres, may have holes) that is extruded from ``base_m`` to ``height_m``."""

    name: str
    kind: str
    polygon: Polygon
    base_m: float
    height_m: float


@dataclass(frozen=True)
class FootprintFile:
    """What a file holds; what was mended in it and left out, each with how often; what to know before trusting it."""

    footprints: list[Footprint] = field(default_factory=list)
    repaired: Counter[str] = field(default_factory=Counter)
    ignored: Counter[str] = field(default_factory=Counter)
    warnings: list[Diagnostic] = field(default_factory=list)


def read_geojson(path: Path, world: Georeference) -> FootprintFile:
    """Footprints of a GeoJSON FeatureCollection in world-frame metres, degrees, or the system that it declares.

    InputError names the features that cannot be understood, have no height, or are no sound polygons, all at once.
    """
    file = FootprintFile()
    document = read_json(path, "a GeoJSON FeatureCollection")
    if not isinstance(document, dict) or not isinstance(document.get("features"), list):
        raise InputError(path, "has no list of features", "a GeoJSON FeatureCollection in world-frame metres")
    declared = declared_crs(document, str(path))
    reading = world.read_coordinates(geojson_coordinates(document["features"]), str(path), declared)
    if reading.convert is not None:
        file.repaired[f"features in {reading.description}, brought into the world frame"] += len(document["features"])
    refused: list[InputError] = []
    for number, feature in enumerate(document["features"]):
        try:
            file.footprints.extend(_feature_footprints(feature, number, path, file.repaired, reading))
        except InputError as error:
            refused.append(error)
    if refused:
        raise DiagnosticsError(_report_refused(refused, path))
    return file


def _feature_footprints(
    feature: Any, number: int, path: Path, repaired: Counter[str], reading: CoordinateReading
) -> list[Footprint]:
    """The footprints of one feature, counting in ``repaired``."""
    place = f"{path}: feature {number}"
    if not isinstance(feature, dict) or not isinstance(feature.get("properties") or {}, dict):
        raise InputError(place, "is not a GeoJSON feature", "an object with geometry and properties")
    properties = feature.get("properties") or {}
    name = str(_named_value(properties, "name", f"{path.stem}_{number}"))
    place = f"{place} ({name})"
    if (odd := find_misspelling((key for key in properties if key not in _NOTE_KEYS), _HEIGHT_KEYS)) is not None:
        raise InputError(place, f"unknown property {odd[0]!r}", f"did you mean {odd[1]}?")
    height, base = _metres(properties, "height_m", place), _metres(properties, "base_m", place, 0.0)
    if not height > base:
        raise InputError(place, f"height_m = {height:g} with base_m = {base:g}", "a top above the underside")
    kind = str(_named_value(properties, "kind", "footprint"))
    parts = to_polygons(feature.get("geometry"), properties, place, repaired, reading)
    return [Footprint(name, kind, part, base, height) for part in parts]


def _report_refused(refused: list[InputError], path: Path) -> Iterator[Diagnostic]:
    """The first of a file's wrong features, and how many more there are."""
    for error in refused[:_MAX_REPORTED]:
        yield Diagnostic.of("statics", error)
    if (more := len(refused) - _MAX_REPORTED) > 0:
        yield Diagnostic("statics", str(path), f"{more} more features are wrong", "those above first", is_error=True)


def _named_value(properties: dict[str, Any], key: str, default: str) -> Any:
    value = properties.get(key)
    return default if value is None else value


def _metres(properties: dict[str, Any], key: str, where: str, default: float | None = None) -> float:
    value = properties.get(key)
    if value is None:  # a GIS writes null where another feature of the table has the property
        value = default
    if value is None:
        raise InputError(where, f"{key} is missing", "a number of metres")
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MAX_COORDINATE_M:
        raise InputError(f"{where}: {key}", f"{value!r}", f"a finite number of metres, at most {MAX_COORDINATE_M:g}")
    return float(value)


def to_polygons(
    geometry: Any,
    properties: dict[str, Any],
    where: str,
    repaired: Counter[str],
    reading: CoordinateReading = WORLD_READING,
    *,
    mends_crossings: bool = False,
) -> list[Polygon]:
    """The polygons of one feature, in the world frame: lines and points buffered, dirt mended, multi-part geometries
    taken apart. Rings that cross themselves are refused, unless what comes from a map is to be taken as it is."""
    import shapely

    shape_place = f"{where}: geometry"
    damage = (shapely.errors.ShapelyError, TypeError, ValueError, LookupError, AttributeError, RecursionError)
    try:
        with np.errstate(invalid="ignore"):  # what is no number is refused below
            shape: BaseGeometry = shapely.geometry.shape(geometry)
        coordinates = shapely.get_coordinates(shape)
    except damage as error:
        raise InputError(shape_place, f"cannot be understood ({error})", "a GeoJSON geometry") from None
    if shape.is_empty or not np.isfinite(coordinates).all():
        raise InputError(shape_place, "is empty or has a coordinate that is no number", "finite metres")
    if (far_m := np.abs(coordinates).max()) > MAX_COORDINATE_M:
        raise InputError(shape_place, f"lies {far_m:g} m from the world's zero", f"within {MAX_COORDINATE_M:g} m")
    if shapely.has_z(shape) and np.any(shapely.get_coordinates(shape, include_z=True)[:, 2] != 0):
        raise InputError(shape_place, "has z coordinates", "two coordinates a point; heights go into base_m, height_m")
    if reading.convert is not None:
        shape = shapely.transform(shape, reading.to_world)
    if shape.geom_type == "GeometryCollection":
        shape = _only_areas(shape, repaired)
    if shape.geom_type.endswith(("Point", "LineString")):
        radius = _metres(properties, "radius_m", where)
        if radius <= 0:
            raise InputError(f"{where}: radius_m", f"{radius:g}", "above 0")
        cap = "flat" if "Line" in shape.geom_type else "round"
        shape = shape.buffer(radius, quad_segs=_QUARTER_SIDES, cap_style=cap)
    elif "Polygon" not in shape.geom_type:
        raise InputError(shape_place, f"is a {shape.geom_type}", "a Polygon, LineString or Point, or their Multi forms")
    sound = _repair(shape, shape_place, repaired, reading.convert is not None, mends_crossings)
    areas = [part for part in shapely.get_parts(sound) if "Polygon" in part.geom_type]
    parts = [polygon for area in areas for polygon in shapely.get_parts(area)]  # mended ones lie deeper
    if not parts:
        raise InputError(shape_place, "encloses no area", "a polygon with three corners that are not in line")
    return parts


def _only_areas(collection: BaseGeometry, repaired: Counter[str]) -> BaseGeometry:
    """The polygons of a collection. A GIS that rounds degrees turns the thinnest corners of a polygon into lines beside
    it; a collection without a polygon stays what it is."""
    import shapely

    parts = shapely.get_parts(collection)
    areas = [part for part in parts if "Polygon" in part.geom_type]
    if not areas:
        return collection
    repaired["lines and points beside polygons, left out"] += len(parts) - len(areas)
    return shapely.MultiPolygon([area for part in areas for area in shapely.get_parts(part)])


def _barely_crosses(shape: BaseGeometry) -> bool:
    """Whether what the crossing rings of an area turn over is next to nothing: slivers as wide as a last digit."""
    import shapely

    whole_m2 = shapely.make_valid(shape).area
    return bool(abs(whole_m2 - shape.area) <= _MAX_SLIVER_SHARE * whole_m2)


def _repair(shape: BaseGeometry, where: str, repaired: Counter[str], may_be_rounded: bool, mends: bool) -> BaseGeometry:
    """Mend what has one meaning only (doubled points, rings that touch themselves, or that cross where degrees were
    rounded); what has two is refused, or ``mends`` keeps each part that is enclosed."""
    import shapely

    if not shapely.is_valid(shape):
        reason = shapely.is_valid_reason(shape)
        touches = reason.startswith("Ring Self-intersection")
        rounded = may_be_rounded and _barely_crosses(shape)
        if not (touches or rounded or mends):
            raise InputError(where, f"is not a sound polygon ({reason})", "rings that do not cross, holes inside")
        shape = shapely.make_valid(shape)
        repaired[
            "rings that touched themselves"
            if touches
            else "rings that rounded degrees made cross"
            if rounded
            else CROSSING_RINGS
        ] += 1
    clean = shapely.remove_repeated_points(shape)
    if doubled := len(shapely.get_coordinates(shape)) - len(shapely.get_coordinates(clean)):
        repaired["doubled points"] += doubled
    return shapely.orient_polygons(clean)
