"""Reads footprints, and mends or refuses what is not sound.

Steps: read GeoJSON polygons, lines and points (:mod:`pipeline.world.poly_xml` reads SUMO's); bring what is in degrees
or in a map projection into the world frame (:mod:`pipeline.formats.georeference`); widen lines and points; mend what
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

from pipeline.core.errors import InputError
from pipeline.core.findings import Finding, FindingsError
from pipeline.core.reading import documents
from pipeline.formats.georeference import IN_WORLD, Georeference, Reading, coordinates_of, declared_by
from pipeline.scenario.near_names import misspelt
from pipeline.scenario.types import FARTHEST_M

if TYPE_CHECKING:
    from shapely import Polygon
    from shapely.geometry.base import BaseGeometry

CROSSED = "rings that cross themselves, each part that they enclose kept"
_SLIVERS = 0.01  # of an area
_QUARTER_SIDES = 4  # a disc is a regular polygon of four times as many sides


_SPELT = ("height_m", "base_m")
"""Properties that count: what is nearly one of them must not be taken for a stranger."""
_NOTES = ("height_from",)
"""What ``egvs new`` notes beside them."""
_MOST_TOLD = 20
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
    mended: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    warnings: list[Finding] = field(default_factory=list)


def read_geojson(path: Path, world: Georeference) -> FootprintFile:
    """Footprints of a GeoJSON FeatureCollection in world-frame metres, degrees, or the system that it declares.

    InputError names the features that cannot be understood, have no height, or are no sound polygons, all at once.
    """
    file = FootprintFile()
    document = documents.read_json(path, "a GeoJSON FeatureCollection")
    if not isinstance(document, dict) or not isinstance(document.get("features"), list):
        raise InputError(path, "has no list of features", "a GeoJSON FeatureCollection in world-frame metres")
    declared = declared_by(document, str(path))
    reading = world.reading(coordinates_of(document["features"]), str(path), declared)
    if reading.convert is not None:
        file.mended[f"features in {reading.words}, brought into the world frame"] += len(document["features"])
    refused: list[InputError] = []
    for number, feature in enumerate(document["features"]):
        try:
            file.footprints.extend(_of_feature(feature, number, path, file.mended, reading))
        except InputError as error:
            refused.append(error)
    if refused:
        raise FindingsError(_told(refused, path))
    return file


def _of_feature(feature: Any, number: int, path: Path, mended: Counter[str], reading: Reading) -> list[Footprint]:
    """The footprints of one feature, counting in ``mended``."""
    place = f"{path}: feature {number}"
    if not isinstance(feature, dict) or not isinstance(feature.get("properties") or {}, dict):
        raise InputError(place, "is not a GeoJSON feature", "an object with geometry and properties")
    properties = feature.get("properties") or {}
    name = str(_named(properties, "name", f"{path.stem}_{number}"))
    place = f"{place} ({name})"
    if (odd := misspelt((key for key in properties if key not in _NOTES), _SPELT)) is not None:
        raise InputError(place, f"unknown property {odd[0]!r}", f"did you mean {odd[1]}?")
    height, base = _metres(properties, "height_m", place), _metres(properties, "base_m", place, 0.0)
    if not height > base:
        raise InputError(place, f"height_m = {height:g} with base_m = {base:g}", "a top above the underside")
    kind = str(_named(properties, "kind", "footprint"))
    parts = polygons_of(feature.get("geometry"), properties, place, mended, reading)
    return [Footprint(name, kind, part, base, height) for part in parts]


def _told(refused: list[InputError], path: Path) -> Iterator[Finding]:
    """The first of a file's wrong features, and how many more there are."""
    for error in refused[:_MOST_TOLD]:
        yield Finding.of("statics", error)
    if (more := len(refused) - _MOST_TOLD) > 0:
        yield Finding("statics", str(path), f"{more} more features are wrong", "those above first", is_error=True)


def _named(properties: dict[str, Any], key: str, default: str) -> Any:
    value = properties.get(key)
    return default if value is None else value


def _metres(properties: dict[str, Any], key: str, place: str, default: float | None = None) -> float:
    value = properties.get(key)
    if value is None:  # a GIS writes null where another feature of the table has the property
        value = default
    if value is None:
        raise InputError(place, f"{key} is missing", "a number of metres")
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= FARTHEST_M:
        raise InputError(f"{place}: {key}", f"{value!r}", f"a finite number of metres, at most {FARTHEST_M:g}")
    return float(value)


def polygons_of(
    geometry: Any,
    properties: dict[str, Any],
    place: str,
    mended: Counter[str],
    reading: Reading = IN_WORLD,
    *,
    mends_crossings: bool = False,
) -> list[Polygon]:
    """The polygons of one feature, in the world frame: lines and points buffered, dirt mended, multi-part geometries
    taken apart. Rings that cross themselves are refused, unless what comes from a map is to be taken as it is."""
    import shapely

    shape_place = f"{place}: geometry"
    damage = (shapely.errors.ShapelyError, TypeError, ValueError, LookupError, AttributeError, RecursionError)
    try:
        with np.errstate(invalid="ignore"):  # what is no number is refused below
            shape: BaseGeometry = shapely.geometry.shape(geometry)
        coordinates = shapely.get_coordinates(shape)
    except damage as error:
        raise InputError(shape_place, f"cannot be understood ({error})", "a GeoJSON geometry") from None
    if shape.is_empty or not np.isfinite(coordinates).all():
        raise InputError(shape_place, "is empty or has a coordinate that is no number", "finite metres")
    if (far_m := np.abs(coordinates).max()) > FARTHEST_M:
        raise InputError(shape_place, f"lies {far_m:g} m from the world's zero", f"within {FARTHEST_M:g} m")
    if shapely.has_z(shape) and np.any(shapely.get_coordinates(shape, include_z=True)[:, 2] != 0):
        raise InputError(shape_place, "has z coordinates", "two coordinates a point; heights go into base_m, height_m")
    if reading.convert is not None:
        shape = shapely.transform(shape, reading.to_world)
    if shape.geom_type == "GeometryCollection":
        shape = _areas_alone(shape, mended)
    if shape.geom_type.endswith(("Point", "LineString")):
        radius = _metres(properties, "radius_m", place)
        if radius <= 0:
            raise InputError(f"{place}: radius_m", f"{radius:g}", "above 0")
        cap = "flat" if "Line" in shape.geom_type else "round"
        shape = shape.buffer(radius, quad_segs=_QUARTER_SIDES, cap_style=cap)
    elif "Polygon" not in shape.geom_type:
        raise InputError(shape_place, f"is a {shape.geom_type}", "a Polygon, LineString or Point, or their Multi forms")
    sound = _sound(shape, shape_place, mended, reading.convert is not None, mends_crossings)
    areas = [part for part in shapely.get_parts(sound) if "Polygon" in part.geom_type]
    parts = [polygon for area in areas for polygon in shapely.get_parts(area)]  # mended ones lie deeper
    if not parts:
        raise InputError(shape_place, "encloses no area", "a polygon with three corners that are not in line")
    return parts


def _areas_alone(collection: BaseGeometry, mended: Counter[str]) -> BaseGeometry:
    """The polygons of a collection. A GIS that rounds degrees turns the thinnest corners of a polygon into lines beside
    it; a collection without a polygon stays what it is."""
    import shapely

    parts = shapely.get_parts(collection)
    areas = [part for part in parts if "Polygon" in part.geom_type]
    if not areas:
        return collection
    mended["lines and points beside polygons, left out"] += len(parts) - len(areas)
    return shapely.MultiPolygon([area for part in areas for area in shapely.get_parts(part)])


def _barely_crosses(shape: BaseGeometry) -> bool:
    """Whether what the crossing rings of an area turn over is next to nothing: slivers as wide as a last digit."""
    import shapely

    whole_m2 = shapely.make_valid(shape).area
    return bool(abs(whole_m2 - shape.area) <= _SLIVERS * whole_m2)


def _sound(shape: BaseGeometry, place: str, mended: Counter[str], may_be_rounded: bool, mends: bool) -> BaseGeometry:
    """Mend what has one meaning only (doubled points, rings that touch themselves, or that cross where degrees were
    rounded); what has two is refused, or ``mends`` keeps each part that is enclosed."""
    import shapely

    if not shapely.is_valid(shape):
        reason = shapely.is_valid_reason(shape)
        touches = reason.startswith("Ring Self-intersection")
        rounded = may_be_rounded and _barely_crosses(shape)
        if not (touches or rounded or mends):
            raise InputError(place, f"is not a sound polygon ({reason})", "rings that do not cross, holes inside")
        shape = shapely.make_valid(shape)
        mended[
            "rings that touched themselves"
            if touches
            else "rings that rounded degrees made cross"
            if rounded
            else CROSSED
        ] += 1
    clean = shapely.remove_repeated_points(shape)
    if doubled := len(shapely.get_coordinates(shape)) - len(shapely.get_coordinates(clean)):
        mended["doubled points"] += doubled
    return shapely.orient_polygons(clean)
