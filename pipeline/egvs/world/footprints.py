"""Footprints: polygons that are extruded to solids, read from GeoJSON or a GIS file.

Steps: read polygons, lines and points (:mod:`egvs.world.sumo_polygons` reads those of SUMO); convert degrees or a map
projection to the world frame (:mod:`egvs.formats.georeference`); widen lines and points; repair what is unambiguous,
with a count; reject the rest. World frame, metres.

``height_m`` is the height of the top, ``base_m`` (default 0) that of the underside. The property ``z_datum`` says where
both count from: ``"ground"`` (default), the ground below the centre of the footprint, or ``"world"``, z = 0 of the
world frame; on a flat ground these are the same. Points become discs of ``radius_m``, lines strips of that half width.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from egvs.core.errors import Diagnostic, DiagnosticsError, InputError, find_misspelling
from egvs.core.grid import IntArray
from egvs.core.polygons import PairCount, check_corners, check_edge_pairs, repair_polygon
from egvs.core.reading import read_json
from egvs.core.wording import number_of
from egvs.formats import vector_files
from egvs.formats.georeference import WORLD_READING, CoordinateReading, Georeference, declared_crs, geojson_coordinates
from egvs.scenario.fields import MAX_COORDINATE_M

if TYPE_CHECKING:
    from shapely import Polygon
    from shapely.geometry.base import BaseGeometry


CROSSING_RINGS = "rings that cross themselves, each part that they enclose kept"
# rings whose crossing changes no more than this share of an area cross because coordinates were rounded
_MAX_SLIVER_SHARE = 0.01
# corners of a strip for each point of its line
_CORNERS_OF_STRIP = 3
# sides of a quarter of a disc
_QUARTER_SIDES = 4

Z_DATUM, GROUND_DATUM, WORLD_DATUM = "z_datum", "ground", "world"
"""The property that states where heights count from, and its values. A Shapefile cuts names after ten characters."""

# pairs of shapes that are compared at once: bounds the memory
_PAIRS_AT_ONCE = 1_000_000

# properties that must not be misspelt
_HEIGHT_KEYS = ("height_m", "base_m", Z_DATUM)
# properties that ``egvs new`` adds as notes
_NOTE_KEYS = ("height_from",)
# invalid features of a file that are reported one by one
_MAX_REPORTED = 20


@dataclass(frozen=True)
class Footprint:
    """A polygon (world frame, metres, may have holes) that is extruded from ``base_m`` to ``height_m``.

    ``z_datum`` is where both count from, :data:`GROUND_DATUM` or :data:`WORLD_DATUM`.
    """

    name: str
    kind: str
    polygon: Polygon
    base_m: float
    height_m: float
    z_datum: str = GROUND_DATUM


@dataclass(frozen=True)
class FootprintFile:
    """Footprints of a file.

    Attributes
    ----------
    footprints
        The footprints.
    repaired, ignored
        What was repaired and what was left out, with counts.
    warnings
        What the user should check.
    """

    footprints: list[Footprint] = field(default_factory=list)
    repaired: Counter[str] = field(default_factory=Counter)
    ignored: Counter[str] = field(default_factory=Counter)
    warnings: list[Diagnostic] = field(default_factory=list)


def read_footprints(path: Path, world: Georeference) -> FootprintFile:
    """Read the footprints of a GeoJSON FeatureCollection, or of a GIS file.

    Parameters
    ----------
    path
        GeoJSON, or a format of :mod:`egvs.formats.vector_files`; it declares its coordinate reference system.
    world
        Where the world frame is.

    Raises
    ------
    InputError
        When features are no geometries, have no height, or are invalid polygons; all are named.
    """
    file = FootprintFile()
    features, reading = _read_features(path, world)
    if reading.convert is not None:
        file.repaired[f"features in {reading.description}, brought into the world frame"] += len(features)
    errors: list[InputError] = []
    count = PairCount(path)
    for number, feature in enumerate(features):
        try:
            file.footprints.extend(_feature_footprints(feature, number, file.repaired, reading, count))
        except InputError as error:
            errors.append(error)
    if errors:
        raise DiagnosticsError(_report_errors(errors, path))
    return file


def read_named_polygons(path: Path, world: Georeference, *, need_names: bool = False) -> Iterator[tuple[str, Polygon]]:
    """Yield the name and the polygons (world frame, metres) of each feature of a file; heights are not needed.

    Parameters
    ----------
    path
        GeoJSON, or a format of :mod:`egvs.formats.vector_files`; it declares its coordinate reference system. The
        property ``name`` names a feature; by default, its number does.
    world
        Where the world frame is.
    need_names
        Whether a feature without a name is an error.

    Raises
    ------
    InputError
        When the file cannot be read, or a feature encloses no area.
    """
    features, reading = _read_features(path, world)
    count = PairCount(path)
    for number, feature in enumerate(features):
        where = f"{path}: feature {number}"
        properties = _feature_properties(feature, where)
        name = str(_property(properties, "name", "" if need_names else number)).strip()
        if not name:
            raise InputError(where, "expected the property name, got none", "Name each area, for tables and messages.")
        geometry = feature.get("geometry")
        for polygon in to_polygons(geometry, properties, f"{where} ({name})", Counter(), reading, count=count):
            yield name, polygon


def _read_features(path: Path, world: Georeference) -> tuple[list[Any], CoordinateReading]:
    """Return the features of a file, and how to convert their coordinates to the world frame."""
    if vector_files.is_gis_file(path):
        document = vector_files.read_gis_file(path, "Polygon")
    else:
        document = read_json(path, "Use a GeoJSON FeatureCollection.")
    if not isinstance(document, dict) or not isinstance(document.get("features"), list):
        raise InputError(path, "expected a GeoJSON FeatureCollection, got no features list")
    features = document["features"]
    reading = world.read_coordinates(geojson_coordinates(features), str(path), declared_crs(document, str(path)))
    return features, reading


def _feature_properties(feature: Any, where: str) -> dict[str, Any]:
    if not isinstance(feature, dict) or not isinstance(feature.get("properties") or {}, dict):
        raise InputError(where, "expected a GeoJSON feature with geometry and properties")
    return feature.get("properties") or {}


def _feature_footprints(
    feature: Any, number: int, repaired: Counter[str], reading: CoordinateReading, count: PairCount
) -> list[Footprint]:
    """Return the footprints of one feature; repairs are counted in ``repaired``."""
    where = f"{count.file}: feature {number}"
    properties = _feature_properties(feature, where)
    name = str(_property(properties, "name", f"{Path(str(count.file)).stem}_{number}"))
    where = f"{where} ({name})"
    misspelling = find_misspelling((key for key in properties if key not in _NOTE_KEYS), _HEIGHT_KEYS)
    if misspelling is not None:
        raise InputError(where, f"unknown property {misspelling[0]!r}", f"Did you mean {misspelling[1]}?")
    height_m = _metres(properties, "height_m", where)
    base_m = _metres(properties, "base_m", where, 0.0)
    if not height_m > base_m:
        raise InputError(where, f"expected height_m above base_m = {base_m:g}, got {height_m:g}")
    kind = str(_property(properties, "kind", "footprint"))
    z_datum = _property(properties, Z_DATUM, GROUND_DATUM)
    if z_datum not in (GROUND_DATUM, WORLD_DATUM):
        hint = "Use ground for heights above the ground below, world for z of the world frame."
        problem = f"expected {GROUND_DATUM!r} or {WORLD_DATUM!r}, got {repr(z_datum)[:80]}"
        raise InputError(f"{where}: {Z_DATUM}", problem, hint)
    polygons = to_polygons(feature.get("geometry"), properties, where, repaired, reading, count=count)
    return [Footprint(name, kind, polygon, base_m, height_m, z_datum) for polygon in polygons]


def _report_errors(errors: list[InputError], path: Path) -> Iterator[Diagnostic]:
    """Yield the first errors of a file, and the number of the others."""
    for error in errors[:_MAX_REPORTED]:
        yield Diagnostic.of("statics", error)
    more = len(errors) - _MAX_REPORTED
    if more > 0:
        yield Diagnostic(
            "statics", str(path), number_of(more, "more invalid feature"), "Correct those above first.", is_error=True
        )


def _property(properties: dict[str, Any], key: str, default: Any) -> Any:
    """Return a property; a GIS writes null where only other features of a table have it."""
    value = properties.get(key)
    return default if value is None else value


def _metres(properties: dict[str, Any], key: str, where: str, default: float | None = None) -> float:
    value = _property(properties, key, default)
    if value is None:
        raise InputError(where, f"{key} is missing", "Give a number of metres.")
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MAX_COORDINATE_M:
        raise InputError(f"{where}: {key}", f"expected metres, at most {MAX_COORDINATE_M:g}, got {value!r}")
    return float(value)


def box_pairs(
    shapes: Sequence[BaseGeometry] | NDArray[Any], others: Sequence[BaseGeometry] | NDArray[Any]
) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield the pairs of a shape and another one whose boxes meet, in parts, since there may be billions.

    Parameters
    ----------
    shapes, others
        Geometries.

    Yields
    ------
    numbers, other_numbers
        Indices into both, (n,) int64 each.
    """
    import shapely

    tree = shapely.STRtree(others)
    step = max(1, _PAIRS_AT_ONCE // max(1, len(others)))
    for start in range(0, len(shapes), step):
        numbers, other_numbers = tree.query(shapes[start : start + step])
        yield numbers + start, other_numbers


def to_polygons(
    geometry: Any, properties: dict[str, Any], where: str, repaired: Counter[str],
    reading: CoordinateReading = WORLD_READING, *, keep_crossing_parts: bool = False, count: PairCount | None = None,
) -> list[Polygon]:  # fmt: skip
    """Convert a GeoJSON geometry to polygons in the world frame.

    Parameters
    ----------
    geometry
        The geometry; several parts become several polygons.
    properties
        ``radius_m`` is the radius of points and the half width of lines.
    where
        The feature, for messages.
    repaired
        Counts repairs.
    reading
        Conversion of coordinates to the world frame.
    keep_crossing_parts
        For rings that cross themselves: keep each enclosed part, instead of an error.
    count
        Pairs of edges of the same file so far.

    Raises
    ------
    InputError
        When the geometry or ``radius_m`` is invalid.
    """
    import shapely

    shape = _parse_shape(geometry, f"{where}: geometry")
    if reading.convert is not None:
        shape = shapely.transform(shape, reading.to_world)
    if shape.geom_type == "GeometryCollection":
        shape = _keep_polygons(shape, repaired)
    if shape.geom_type.endswith(("Point", "LineString")):
        radius_m = _metres(properties, "radius_m", where)
        if radius_m <= 0:
            raise InputError(f"{where}: radius_m", f"expected a radius above 0 m, got {radius_m:g}")
        check_edge_pairs(shape, where, radius_m, count)
        cap = "flat" if "Line" in shape.geom_type else "round"
        shape = shape.buffer(radius_m, quad_segs=_QUARTER_SIDES, cap_style=cap)
        check_corners(shape, where, _CORNERS_OF_STRIP)

    where = f"{where}: geometry"
    if "Polygon" not in shape.geom_type:
        problem = f"expected a Polygon, LineString or Point, or a Multi form of these, got {shape.geom_type}"
        raise InputError(where, problem)
    valid = _repair(shape, where, repaired, reading.convert is not None, keep_crossing_parts, count)
    polygons = _polygons_of(valid)
    if not polygons:
        raise InputError(where, "encloses no area", "Use at least three corners that are not collinear.")
    return polygons


def _parse_shape(geometry: Any, where: str) -> BaseGeometry:
    """Return a shape with finite coordinates in two dimensions."""
    import shapely

    invalid = (shapely.errors.ShapelyError, TypeError, ValueError, LookupError, AttributeError, RecursionError)
    try:
        with np.errstate(invalid="ignore"):  # nan is rejected below
            shape: BaseGeometry = shapely.geometry.shape(geometry)
        coordinates = shapely.get_coordinates(shape)
    except invalid as error:
        raise InputError(where, f"expected a GeoJSON geometry ({error})") from None
    if shape.is_empty:
        raise InputError(where, "the geometry is empty")
    check_corners(shape, where)
    if not np.isfinite(coordinates).all():
        raise InputError(where, "expected finite coordinates, got nan or inf")
    farthest_m = np.abs(coordinates).max()
    if farthest_m > MAX_COORDINATE_M:
        raise InputError(where, f"expected coordinates within {MAX_COORDINATE_M:g} m, got {farthest_m:g} m")
    if shapely.has_z(shape) and np.any(shapely.get_coordinates(shape, include_z=True)[:, 2] != 0):
        raise InputError(where, "has z coordinates", "Set the properties base_m and height_m instead.")
    return shape


def _polygons_of(shape: BaseGeometry) -> list[Polygon]:
    """Return the polygons of a shape; repaired ones may be two levels deep."""
    import shapely

    areas = [part for part in shapely.get_parts(shape) if "Polygon" in part.geom_type]
    return list(shapely.get_parts(areas))


def _keep_polygons(collection: BaseGeometry, repaired: Counter[str]) -> BaseGeometry:
    """Drop the lines and points of a collection with polygons.

    A GIS that rounds degrees turns the thinnest corners of a polygon into such lines.
    """
    import shapely

    parts = shapely.get_parts(collection)
    areas = [part for part in parts if "Polygon" in part.geom_type]
    if not areas:
        return collection
    repaired["lines and points beside polygons, left out"] += len(parts) - len(areas)
    return shapely.MultiPolygon(_polygons_of(collection))


def _repair(
    shape: BaseGeometry, where: str, repaired: Counter[str], may_be_rounded: bool, keep_crossing_parts: bool,
    count: PairCount | None,
) -> BaseGeometry:  # fmt: skip
    """Repair repeated points, rings that touch themselves, and rings that cross because degrees were rounded.

    Other rings that cross themselves are ambiguous: they are rejected, unless ``keep_crossing_parts``.
    """
    import shapely

    if not shapely.is_valid(shape):
        valid = repair_polygon(shape, where, count)
        reason = shapely.is_valid_reason(shape)
        repair = CROSSING_RINGS
        if reason.startswith("Ring Self-intersection"):
            repair = "rings that touched themselves"
        elif may_be_rounded and _barely_crosses(shape, valid):
            repair = "rings that rounded degrees made cross"
        elif not keep_crossing_parts:
            raise InputError(
                where, f"is not a valid polygon ({reason})", "Use rings that do not cross, with holes inside."
            )
        shape = valid
        repaired[repair] += 1
    clean = shapely.remove_repeated_points(shape)
    repeated = len(shapely.get_coordinates(shape)) - len(shapely.get_coordinates(clean))
    if repeated:
        repaired["doubled points"] += repeated
    return shapely.orient_polygons(clean)


def _barely_crosses(shape: BaseGeometry, valid: BaseGeometry) -> bool:
    """Return whether the parts that crossing rings turn over, seen in their repair, are negligible slivers."""
    return bool(abs(valid.area - shape.area) <= _MAX_SLIVER_SHARE * valid.area)
