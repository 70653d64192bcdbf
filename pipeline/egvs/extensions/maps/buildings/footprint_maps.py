"""Reader of buildings from GeoJSON, GeoPackage, Shapefile and GeoParquet: outlines with heights in columns.

Columns are recognised by their names, whatever their case: :data:`HEIGHT_COLUMNS`, :data:`LEVEL_COLUMNS`,
:data:`BASE_COLUMNS`. An outline without a usable height gets
:data:`~egvs.creation.map_parts.DEFAULT_BUILDING_M`; :mod:`egvs.creation.building_heights` has
better assumptions.

GeoJSON without the member ``crs`` is in longitude and latitude (RFC 7946, 4). With ``"crs": null`` it is in metres of
an unknown frame, and needs an alignment.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from egvs.core.errors import InputError
from egvs.core.polygons import PairCount, repair_polygon
from egvs.core.reading import read_json, translate_errors
from egvs.creation.carriageway import geometry_pieces
from egvs.creation.map_parts import DEFAULT_BUILDING_M, OUT_OF_RANGE, ImportCounts, MapContext, MappedSolid, SolidMap
from egvs.formats import vector_files
from egvs.formats.georeference import WGS84, WORLD, declared_crs
from egvs.formats.osm import parse_length_m, parse_number
from egvs.world.map_features import LEVEL_M

HEIGHT_COLUMNS = ("height_m", "height", "measuredheight", "measured_height", "building_height", "bldg_height")
LEVEL_COLUMNS = (
    "levels", "building:levels", "building_levels", "storeys", "storeysaboveground", "num_floors", "floors", "stories",
)  # fmt: skip
BASE_COLUMNS = ("base_m", "min_height")
NAME_COLUMNS = ("name", "id", "gml_id", "osm_id", "fid")

_MAX_LEVELS = 200.0
_HINT = "Use a GeoJSON FeatureCollection of polygons."


def read_solids(paths: Sequence[Path], context: MapContext) -> SolidMap:
    """Return the outlines in the window; InputError when a file is damaged or cannot be placed."""
    counts = ImportCounts()
    solids: list[MappedSolid] = []
    for path in paths:
        solids += _read_file(path, context, counts)
    return SolidMap(tuple(_with_unique_names(solids)), counts=counts)


def _read_file(path: Path, context: MapContext, counts: ImportCounts) -> Iterator[MappedSolid]:
    features, crs = _read_features(path, context)
    pairs = PairCount(path)
    for number, feature in enumerate(features):
        where = f"{path}: feature {number}"
        if not isinstance(feature, dict) or not isinstance(feature.get("properties") or {}, dict):
            raise InputError(where, "expected a GeoJSON feature with geometry and properties", _HINT)
        columns = {str(key).lower(): value for key, value in (feature.get("properties") or {}).items()}
        area = _read_area(feature.get("geometry"), crs, context, where, counts, pairs)
        if area is None:
            continue
        solid = _make_solid(columns, area, f"{path.stem}/{number}", counts)
        if solid is None:
            counts.drop("building", "no_height")
        elif not context.window.intersects(area):
            counts.drop("building", OUT_OF_RANGE)
        else:
            counts.keep(solid)
            yield solid


def _read_features(path: Path, context: MapContext) -> tuple[list[Any], str | None]:
    """Return the features of a file, and their reference system; None for local metres."""
    if vector_files.is_gis_file(path):
        document = vector_files.read_gis_file(path, "Polygon")
    else:
        document = read_json(path, _HINT)
    if not isinstance(document, dict) or not isinstance(document.get("features"), list):
        raise InputError(path, "expected a GeoJSON FeatureCollection, got no features list", _HINT)

    def read_crs() -> str | None:
        crs = declared_crs(document, str(path)) if "crs" in document else WGS84
        return None if crs == WORLD else crs

    return document["features"], context.usable_crs(read_crs, str(path))


def _read_area(
    geometry: Any, crs: str | None, context: MapContext, where: str, counts: ImportCounts, pairs: PairCount
) -> BaseGeometry | None:
    """Return the area of a feature in the world frame; None, with a count, if it has none."""
    if geometry is None:
        counts.drop("building", "no_outline")
        return None
    with translate_errors(f"{where}: geometry", _HINT, "expected a GeoJSON geometry"), np.errstate(invalid="ignore"):
        shape = shapely.force_2d(shapely.geometry.shape(geometry))
        coordinates = shapely.get_coordinates(shape)
    if not np.isfinite(coordinates).all():
        raise InputError(f"{where}: geometry", "expected finite coordinates, got nan or inf", _HINT)
    if crs == WGS84 and len(coordinates) and not (np.abs(coordinates) <= (180.0, 90.0)).all():
        farthest = coordinates[np.argmax(np.abs(coordinates).max(axis=1))]
        problem = f"expected longitude and latitude in degrees, got ({farthest[0]:.10g}, {farthest[1]:.10g})"
        raise InputError(f"{where}: geometry", problem, 'Declare the reference system in the member "crs".')
    if "Polygon" not in shape.geom_type or shape.is_empty:
        counts.drop("building", "no_outline")
        return None
    moved = shapely.transform(shape, lambda xy: context.to_world(xy, crs, where))
    counts.repaired += not moved.is_valid
    moved = repair_polygon(moved, f"{where}: geometry", pairs)
    polygons = [piece for piece in geometry_pieces(moved) if piece.geom_type == "Polygon" and piece.area > 0]
    if not polygons:
        counts.drop("building", "degenerate")
        return None
    return polygons[0] if len(polygons) == 1 else shapely.MultiPolygon(polygons)


def _make_solid(columns: Mapping[str, Any], area: BaseGeometry, name: str, counts: ImportCounts) -> MappedSolid | None:
    """Return the solid of a row; None where its base is above its top."""
    names = [columns[key] for key in NAME_COLUMNS if columns.get(key) not in (None, "")]
    if names:
        name = str(names[0])
    height_m = _first_value(columns, HEIGHT_COLUMNS, _positive_metres, counts)
    source = "height"
    if height_m is None:
        levels = _first_value(columns, LEVEL_COLUMNS, _levels, counts)
        height_m, source = (LEVEL_M * levels, "levels") if levels is not None else (DEFAULT_BUILDING_M, "default")
    base_m = _first_value(columns, BASE_COLUMNS, _metres, counts) or 0.0
    if base_m >= height_m:
        return None
    return MappedSolid(name, "building", area, height_m, source, max(base_m, 0.0))


def _first_value(columns: Mapping[str, Any], names: Sequence[str], parse: Any, counts: ImportCounts) -> float | None:
    """Return the first usable value of some columns; unusable ones are counted."""
    for name in names:
        value = columns.get(name)
        if value is None or value == "":
            continue
        number: float | None = parse(value)
        if number is not None:
            return number
        counts.unreadable[name] += 1
    return None


def _metres(value: Any) -> float | None:
    if isinstance(value, str):
        return parse_length_m(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if abs(value) < 1000 else None


def _positive_metres(value: Any) -> float | None:
    height_m = _metres(value)
    return height_m if height_m is not None and height_m > 0 else None


def _levels(value: Any) -> float | None:
    levels = parse_number(value) if isinstance(value, str) else value
    if isinstance(levels, bool) or not isinstance(levels, int | float):
        return None
    return float(levels) if 0 < levels <= _MAX_LEVELS else None


def _with_unique_names(solids: Sequence[MappedSolid]) -> Iterator[MappedSolid]:
    used: set[str] = set()
    for solid in solids:
        name, number = solid.name, 1
        while name in used:
            number += 1
            name = f"{solid.name}#{number}"
        used.add(name)
        yield solid if name == solid.name else replace(solid, name=name)
