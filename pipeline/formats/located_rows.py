"""Brings the coordinates of candidate sites into the world frame: metres, degrees, or what a GeoJSON file declares.

A CSV says by the names of its columns what it holds: ``x_m, y_m``, or longitude and latitude under one of the names of
:data:`LONGITUDE` and :data:`LATITUDE` (WGS 84, degrees). Where it has both, they must agree.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from pipeline.core.errors import InputError
from pipeline.formats.crs import WGS84
from pipeline.formats.georeference import Georeference, Reading, coordinates_of, declared_by

Row = tuple[str, dict[str, Any]]
"""Where a site stands in its file, for messages; and its values by column."""

LONGITUDE = ("lon", "lng", "longitude", "lon_deg", "longitude_deg")
LATITUDE = ("lat", "latitude", "lat_deg", "latitude_deg")

_AGREE_M = 0.1
_MOST_M = 1e8  # beyond is no place on Earth, which who reads the row tells
_RIGHT = "columns x_m, y_m in metres of the world frame, or longitude, latitude in degrees"


def placed(rows: Iterable[Row], path: object, world: Georeference) -> list[dict[str, Any]]:
    """The rows of a CSV, given with their places, with ``x_m, y_m`` in the world frame and without longitude, latitude.

    InputError where columns that say metres hold degrees, where both do not agree, or where no row lies near the region
    of interest. What is missing, or no number, is left to who reads the row.
    """
    found = list(rows)
    names = [_columns(row) for _, row in found]
    metres = [(_number(row.get("x_m")), _number(row.get("y_m"))) for _, row in found]
    stated = [xy for xy in metres if abs(xy[0]) <= _MOST_M and abs(xy[1]) <= _MOST_M]
    world.metres(np.array(stated).reshape(-1, 2), str(path), _RIGHT)
    if not any(names):
        return [row for _, row in found]
    degrees = [_degrees(place, row, columns) for (place, row), columns in zip(found, names, strict=True)]
    lone = [spot for spot, xy in zip(degrees, metres, strict=True) if spot is not None and not math.isfinite(sum(xy))]
    if world.frame is None and not lone:
        return [_without(row, columns) for (_, row), columns in zip(found, names, strict=True)]
    known = np.array([spot for spot in degrees if spot is not None]).reshape(-1, 2)
    reading = world.reading(known, str(path), WGS84, _RIGHT)
    return [
        _without(row, columns) | _in_world(place, row, spot, reading)
        for (place, row), columns, spot in zip(found, names, degrees, strict=True)
    ]


def reading_of(document: Mapping[str, Any], path: object, world: Georeference) -> Reading:
    """What the coordinates of a GeoJSON file of sites are; InputError where they are in nothing that is known."""
    return world.reading(coordinates_of(document["features"]), str(path), declared_by(document, str(path)))


def in_world(spot: list[Any], reading: Reading) -> list[Any]:
    """A GeoJSON point's coordinates with x, y in the world frame; what is no number is left to who reads the site."""
    x, y = map(_plain_number, spot[:2])
    if reading.convert is None or not math.isfinite(x + y):
        return spot
    return [*reading.to_world(np.array([[x, y]]))[0].tolist(), *spot[2:]]


def agree(stated: Any, told: Any) -> bool:
    """Whether a coordinate among a feature's properties is the one that its geometry gives."""
    return abs(_number(stated) - _number(told)) <= _AGREE_M


def _columns(row: Mapping[str, Any]) -> tuple[str, str] | None:
    """The names of the row's columns of longitude and latitude; None where it does not have both."""
    named = {name.strip().lower(): name for name in row if isinstance(name, str)}
    lon = next((named[name] for name in LONGITUDE if name in named), None)
    lat = next((named[name] for name in LATITUDE if name in named), None)
    return None if lon is None or lat is None else (lon, lat)


def _degrees(place: str, row: Mapping[str, Any], columns: tuple[str, str] | None) -> tuple[float, float] | None:
    """Longitude and latitude of a row, checked; None where it has none."""
    if columns is None or all(row[name] in (None, "") for name in columns):
        return None
    for name, most in zip(columns, (180.0, 90.0), strict=True):
        if not abs(_number(row[name])) <= most:
            raise InputError(f"{place}: {name}", repr(row[name])[:80], f"degrees from {-most:g} to {most:g}")
    return _number(row[columns[0]]), _number(row[columns[1]])


def _in_world(
    place: str, row: Mapping[str, Any], spot: tuple[float, float] | None, reading: Reading
) -> dict[str, float]:
    """x_m and y_m of a row that has longitude and latitude; nothing where it has its own, which must agree."""
    if spot is None:
        return {}
    x_m, y_m = reading.to_world(np.array([spot]))[0].tolist()
    own = [_number(row.get(name)) for name in ("x_m", "y_m")]
    if not math.isfinite(sum(own)):
        return {"x_m": x_m, "y_m": y_m}
    if (apart_m := math.dist(own, (x_m, y_m))) > _AGREE_M:
        found = f"x_m, y_m = ({own[0]:g}, {own[1]:g}), but longitude and latitude give ({x_m:.2f}, {y_m:.2f})"
        raise InputError(place, f"{found}, {apart_m:.1f} m away", "one of them")
    return {}


def _without(row: dict[str, Any], columns: tuple[str, str] | None) -> dict[str, Any]:
    return {name: value for name, value in row.items() if name not in (columns or ())}


def _number(value: Any) -> float:
    """A column's value as a number; NaN where it is none."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def _plain_number(value: Any) -> float:
    return math.nan if isinstance(value, str | bool) else _number(value)
