"""Rows of files of candidate sites (CSV, GeoJSON, GIS formats), with coordinates in the world frame.

The column names of a CSV say what its coordinates are: ``x_m, y_m``, or longitude and latitude (WGS 84, degrees) under
one of the names of :data:`LONGITUDE` and :data:`LATITUDE`. Where a row has both, they must agree. The coordinates of a
GeoJSON file are in the system that its member ``crs`` declares. GeoPackage, Shapefile, KML and GeoParquet are read as
GeoJSON with the same content (:mod:`egvs.formats.vector_files`).

``ground_m`` is the z of the ground, from which ``sites.heights_m`` count in that row; 0 without it.

Further columns belong to the user (``fid``, ``owner``, ``note``) and are carried through to the scores. A column whose
name is nearly one of the program's, which the file lacks, is rejected as misspelt. So is a column that other programs
use for what this program reads from a column of another name (:data:`FOREIGN_COLUMNS`): ``height``, ``heading``.
"""

from __future__ import annotations

import json
import math
import re
import reprlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egvs.core import limits
from egvs.core.errors import InputError, find_misspelling
from egvs.core.grid import FloatArray
from egvs.core.numbers import ambiguous_number, parse_decimal
from egvs.core.reading import read_json
from egvs.formats import spreadsheets, vector_files
from egvs.formats.georeference import WGS84, CoordinateReading, Georeference, declared_crs, geojson_coordinates
from egvs.formats.workbooks import MAX_COLUMNS
from egvs.scenario.fields import same_name
from egvs.scenario.score_config import COST_COLUMN

REQUIRED_COLUMNS = ("site", "x_m", "y_m", "z_m")
AIM_COLUMNS = ("aim_x_m", "aim_y_m", "aim_z_m")
NUMBER_COLUMNS = ("x_m", "y_m", "z_m", "ground_m", "yaw_deg", "pitch_deg", "roll_deg", *AIM_COLUMNS)
TEXT_COLUMNS = ("sensor", "points", "aim", "mount")
KNOWN_COLUMNS = ("site", *NUMBER_COLUMNS, *TEXT_COLUMNS)

LONGITUDE = ("lon", "lng", "longitude", "lon_deg", "longitude_deg")
LATITUDE = ("lat", "latitude", "lat_deg", "latitude_deg")

_Z_HINT = (
    "Use z_m, the sensor's z in the world frame in metres: its height above the ground plus the ground's z, 0 if flat."
)
_YAW_HINT = "Use yaw_deg, counter-clockwise from east: 90 minus the degrees clockwise from north."
_PITCH_HINT = "Use pitch_deg, positive for nose up: minus the degrees by which the sensor is tilted down."
_SENSOR_HINT = "Use sensor, with a name from `egvs sensors` or from [sensors]."

FOREIGN_COLUMNS = {
    **dict.fromkeys(("height", "heights", "h", "altitude", "alt", "elevation", "elev", "height_above_ground"), _Z_HINT),
    **dict.fromkeys(("sensor_height", "mount_height", "mounting_height"), _Z_HINT),
    **dict.fromkeys(("heading", "bearing", "azimuth", "compass", "facing", "orientation", "direction"), _YAW_HINT),
    **dict.fromkeys(("tilt", "tilt_angle", "tilt_down", "down_tilt", "downtilt", "inclination"), _PITCH_HINT),
    **dict.fromkeys(("höhe", "hoehe", "einbauhöhe", "montagehöhe"), _Z_HINT),
    **dict.fromkeys(("pan", "rotation", "azimut", "blickrichtung"), _YAW_HINT),
    **dict.fromkeys(("neigung", "neigungswinkel"), _PITCH_HINT),
    **dict.fromkeys(("lidar", "sensor_name", "sensor_model", "sensor_type"), _SENSOR_HINT),
}
"""Columns of other programs, without their unit, and the column to use instead, with the conversion."""

_COLUMN_UNIT = re.compile(r"[ _]*[ _(\[](m|cm|ft|metres?|meters?|feet|deg|degrees?|rad|°)[)\]]?$")

_TOLERANCE_M = 0.1
_MAX_M = 1e8  # larger values are not on Earth; they are rejected when the row is parsed
_COLUMNS_HINT = "Use the columns x_m, y_m for metres of the world frame, or longitude, latitude for degrees."

_COLUMN_NAME = re.compile(r"[^\x00-\x1f]{1,80}")
_PLAIN_NUMBER = re.compile(r"-?(0|[1-9][0-9]{0,17})(\.[0-9]+)?")  # "007" is a name

ColumnValue = str | int | float | bool | None


@dataclass(frozen=True)
class SiteRow:
    """A row of a file, or a point of a rule.

    Attributes
    ----------
    where
        File and row, for messages.
    columns
        Values by column; x_m and y_m are in the world frame.
    heights_m
        Heights that a rule gives to the point.
    """

    where: str
    columns: dict[str, Any]
    heights_m: tuple[float, ...] = ()


def read_table(path: Path, world: Georeference) -> tuple[list[SiteRow], list[InputError]]:
    """Return the valid rows of a CSV file or a workbook, and the errors of the others, with file and row.

    Raises
    ------
    InputError
        When the file is no table (:func:`egvs.formats.spreadsheets.read_rows`), or its coordinates are not in the
        system that the names of its columns say.
    """
    table = spreadsheets.read_rows(path, lambda names: names)
    located = []
    for where, values in table.rows:
        located.append(SiteRow(f"{where} ({values['site']})" if values.get("site") else where, values))
        check_site_count(len(located), path, "each row is one", "Use fewer rows.")
    _check_costs(located)
    located, errors = _rows_in_world_frame(located, path, world)
    columns = _parse_numeric_columns([row.columns for row in located], KNOWN_COLUMNS)
    rows = [SiteRow(row.where, values) for row, values in zip(located, columns, strict=True)]
    return rows, [*table.errors, *errors]


def _check_costs(rows: list[SiteRow]) -> None:
    """Raise an InputError where each cost with a point can also be a number of thousands: 8.000."""
    costs = [(row.where, text) for row in rows if "." in (text := row.columns.get(COST_COLUMN, ""))]
    if costs and all(ambiguous_number(text) for _, text in costs):
        where, text = costs[0]
        choices = ambiguous_number(text)
        raise InputError(f"{where}: {COST_COLUMN}", f"{text} can mean {choices}", f"Write {choices}.")


_FEWER_CANDIDATES = "Use a wider spacing, or fewer heights and pitches."


def check_site_count(count: float, where: object, reason: str, hint: str = _FEWER_CANDIDATES) -> None:
    """Raise an InputError when a scenario has more candidates than :data:`egvs.core.limits.SITES`."""
    if not count <= limits.SITES.maximum:
        problem = f"there are more than {limits.SITES.maximum:,} candidates ({reason})"
        raise InputError(where, problem, f"{hint} {limits.SITES.hint}")


def _check_column_count(path: Path, names: Collection[str]) -> None:
    """Raise an InputError when the sites of a file have too many columns: each is compared with the known ones."""
    if len(names) > MAX_COLUMNS:
        problem = f"expected at most {MAX_COLUMNS} columns, got {len(names):,}"
        raise InputError(path, problem, "Remove columns that describe no site.")


def read_features(path: Path, world: Georeference, *, has_relief: bool = False) -> Iterator[SiteRow]:
    """Yield the features of a GeoJSON or GIS file as rows; InputError with file and feature for a malformed one.

    ``has_relief`` says whether the ground is elsewhere than at z = 0, so that altitudes of KML above the ground are no
    z of the world frame.
    """
    expected = "a FeatureCollection of Points"
    if vector_files.is_gis_file(path):
        document = vector_files.read_gis_file(path, "Point")
    else:
        document = read_json(path, f"Use {expected}.")
    if not isinstance(document, dict) or not isinstance(document.get("features"), list):
        raise InputError(path, f"expected {expected}, got {reprlib.repr(document)[:120]}")
    check_site_count(len(document["features"]), path, "each feature is one", "Use fewer features.")
    properties = (feature.get("properties") for feature in document["features"] if isinstance(feature, dict))
    _check_column_count(path, {name for names in properties if isinstance(names, dict) for name in names})
    coordinates = geojson_coordinates(document["features"])
    reading = world.read_coordinates(coordinates, str(path), declared_crs(document, str(path)))
    for number, feature in enumerate(document["features"]):
        where = f"{path}: feature {number}"
        columns = _feature_columns(where, feature, reading)
        if (
            has_relief
            and path.suffix.lower() in vector_files.KML_SUFFIXES
            and len(feature["geometry"]["coordinates"]) > 2
        ):
            problem = "expected the field z_m, since the ground is not at z = 0, got an altitude above the ground"
            hint = "Add z_m (extended data): the altitude + z of the ground there."
            raise InputError(f"{path}: site {columns.get('site', number)}", problem, hint)
        yield SiteRow(where, columns)


def _feature_columns(where: str, feature: Any, reading: CoordinateReading) -> dict[str, Any]:
    """Columns from a feature's coordinates, converted to the world frame, and from its properties."""
    match feature:
        case {"geometry": {"type": "Point", "coordinates": [_, _, *more] as point}, "properties": dict(properties)} if (
            len(more) < 2
        ):
            values = (properties.get("name"), *_point_to_world(point, reading))
        case _:
            expected = "expected a Feature that has properties and a Point geometry with two or three coordinates"
            raise InputError(where, f"{expected}, got {reprlib.repr(feature)[:120]}")
    row = {key: value for key, value in properties.items() if key != "name"}
    for key, value in zip(REQUIRED_COLUMNS, values, strict=False):
        if value is None:
            continue
        if isinstance(value, str) and key != "site":
            raise InputError(f"{where}: {key}", f"expected a numeric coordinate, got the text {value!r}")
        difference_m = abs(number_or_nan(row.get(key)) - number_or_nan(value))
        if reading.convert is not None and difference_m <= _TOLERANCE_M:
            continue  # a GIS carried the unrounded value along as a property: keep it
        if row.get(key, value) not in (None, value):
            raise InputError(f"{where}: {key}", f"there are two values, {row[key]!r} and {value!r}", "Use one of them.")
        row[key] = value
    return row


def _point_to_world(point: list[Any], reading: CoordinateReading) -> list[Any]:
    """A point's coordinates with x, y in the world frame; values that are no numbers are rejected later."""
    if reading.convert is None or any(isinstance(value, str | bool) for value in point[:2]):
        return point
    x = number_or_nan(point[0])
    y = number_or_nan(point[1])
    if not math.isfinite(x + y):
        return point
    return [*reading.to_world(np.array([[x, y]]))[0].tolist(), *point[2:]]


def _rows_in_world_frame(
    rows: list[SiteRow], path: object, world: Georeference
) -> tuple[list[SiteRow], list[InputError]]:
    """Return the rows with ``x_m, y_m`` in the world frame and without longitude and latitude, and errors of others.

    Missing values and values that are no numbers are left as they are; they are rejected when the row is parsed.

    Raises
    ------
    InputError
        When columns named in metres hold degrees, or when no row lies near the region of interest.
    """
    metres = [(number_or_nan(row.columns.get("x_m")), number_or_nan(row.columns.get("y_m"))) for row in rows]
    plausible = [(x, y) for x, y in metres if abs(x) <= _MAX_M and abs(y) <= _MAX_M]
    world.check_metres(_as_points(plausible), str(path), _COLUMNS_HINT)
    if not rows or (names := _lon_lat_columns(rows[0].columns)) is None:
        return rows, []
    located: list[tuple[SiteRow, tuple[float, float] | None]] = []
    errors = []
    needs_degrees = False
    for row, xy_m in zip(rows, metres, strict=True):
        try:
            lon_lat = _parse_lon_lat(row, names)
        except InputError as error:
            errors.append(error)
            continue
        columns = {name: value for name, value in row.columns.items() if name not in names}
        located.append((SiteRow(row.where, columns), lon_lat))
        if lon_lat is not None and not math.isfinite(sum(xy_m)):
            needs_degrees = True
    if world.frame is None and not needs_degrees:
        return [row for row, _ in located], errors
    known = _as_points([lon_lat for _, lon_lat in located if lon_lat is not None])
    reading = world.read_coordinates(known, str(path), WGS84, _COLUMNS_HINT)
    converted = []
    for row, lon_lat in located:
        try:
            columns = row.columns | _row_to_world(row, lon_lat, reading)
        except InputError as error:
            errors.append(error)
        else:
            converted.append(SiteRow(row.where, columns))
    return converted, errors


def _as_points(pairs: list[tuple[float, float]]) -> FloatArray:
    return np.array(pairs).reshape(-1, 2)


def _lon_lat_columns(row: Mapping[str, Any]) -> tuple[str, str] | None:
    """The names of the row's columns of longitude and latitude; None unless it has both."""
    by_lower_name = {name.strip().lower(): name for name in row if isinstance(name, str)}
    lon = next((by_lower_name[name] for name in LONGITUDE if name in by_lower_name), None)
    lat = next((by_lower_name[name] for name in LATITUDE if name in by_lower_name), None)
    if lon is None or lat is None:
        return None
    return lon, lat


def _parse_lon_lat(row: SiteRow, columns: tuple[str, str]) -> tuple[float, float] | None:
    """Longitude and latitude of a row, degrees, checked; None where both are empty."""
    if all(row.columns[name] in (None, "") for name in columns):
        return None
    lon, lat = columns
    for name, limit_deg in ((lon, 180.0), (lat, 90.0)):
        value = row.columns[name]
        if not abs(number_or_nan(value)) <= limit_deg:
            problem = f"expected degrees from {-limit_deg:g} to {limit_deg:g}, got {repr(value)[:80]}"
            raise InputError(f"{row.where}: {name}", problem)
    return number_or_nan(row.columns[lon]), number_or_nan(row.columns[lat])


def _row_to_world(row: SiteRow, lon_lat: tuple[float, float] | None, reading: CoordinateReading) -> dict[str, float]:
    """x_m and y_m of a row from its longitude and latitude; nothing where it has x_m and y_m, which must agree."""
    if lon_lat is None:
        return {}
    x_m, y_m = reading.to_world(np.array([lon_lat]))[0].tolist()
    stated = (number_or_nan(row.columns.get("x_m")), number_or_nan(row.columns.get("y_m")))
    if not math.isfinite(sum(stated)):
        return {"x_m": x_m, "y_m": y_m}
    distance_m = math.dist(stated, (x_m, y_m))
    if distance_m > _TOLERANCE_M:
        problem = (
            f"x_m, y_m = ({stated[0]:g}, {stated[1]:g}), but longitude and latitude give ({x_m:.2f}, {y_m:.2f}),"
            f" {distance_m:.1f} m away"
        )
        raise InputError(row.where, problem, "Use one of them.")
    return {}


def row_position_m(row: SiteRow) -> tuple[float, float]:
    """Return x_m and y_m of a row (world frame, metres); InputError where one is missing or not a number."""
    for key in ("x_m", "y_m"):
        if not math.isfinite(number_or_nan(row.columns.get(key))):
            problem = f"expected metres, got {row.columns.get(key)!r}"
            raise InputError(f"{row.where}: {key}", problem, _COLUMNS_HINT)
    return number_or_nan(row.columns["x_m"]), number_or_nan(row.columns["y_m"])


def number_or_nan(value: Any) -> float:
    """Return a number, or a text that is one, as a float; NaN for everything else."""
    try:
        return parse_decimal(value) if isinstance(value, str) else float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def user_columns(where: str, row: Mapping[str, Any], known: Collection[str]) -> dict[str, ColumnValue]:
    """Return the columns of a row beyond the ``known`` ones; lists and tables as JSON text.

    InputError when a column looks like a known one that the row lacks, has a name that other programs use for a known
    one, or has an invalid name.
    """
    _check_foreign_columns(where, row)
    misspelling = find_misspelling(row, known)
    if misspelling is not None:
        name, meant = misspelling
        hint = f"Did you mean {meant}? A custom column needs a less similar name."
        raise InputError(where, f"unknown column {name!r}", hint)
    columns: dict[str, ColumnValue] = {}
    for name, value in row.items():
        if name in known:
            continue
        if not _COLUMN_NAME.fullmatch(name):
            raise InputError(where, f"expected a column name of 1 to 80 characters, got {name[:80]!r}")
        columns[name] = _to_column_value(value)
    return columns


def _check_foreign_columns(where: str, row: Mapping[str, Any]) -> None:
    for name, value in row.items():
        key = re.sub(r"[\s-]+", "_", _COLUMN_UNIT.sub("", same_name(name).strip().lower()))
        if key in FOREIGN_COLUMNS and value not in (None, ""):
            hint = f"{FOREIGN_COLUMNS[key]} A custom column needs another name."
            raise InputError(where, f"the column {name!r} has no effect", hint)


def _parse_numeric_columns(rows: list[dict[str, Any]], known: Collection[str]) -> list[dict[str, Any]]:
    """Return rows of a table with numbers instead of texts in the user columns that hold only numbers.

    An empty cell becomes None.
    """
    names = {name for row in rows for name in row}
    for name in names - set(known):
        texts = [row[name].strip() for row in rows if row.get(name)]
        kind = _column_type(texts)
        for row in rows:
            text = row.get(name)
            row[name] = kind(text) if text else None
    return rows


def _column_type(texts: Iterable[str]) -> type[str] | type[int] | type[float]:
    kind: type[int] | type[float] = int
    for text in texts:
        match = _PLAIN_NUMBER.fullmatch(text)
        if match is None:
            return str
        if match[2]:
            kind = float
    return kind


def _to_column_value(value: Any) -> ColumnValue:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        return str(value)
    if isinstance(value, list | dict):
        return json.dumps(value, ensure_ascii=True)
    return value if isinstance(value, str | int | float | bool) else None
