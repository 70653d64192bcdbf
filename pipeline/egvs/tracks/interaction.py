"""Read tracks in the columns of the INTERACTION data set: INTERACTION 1.0 to 1.2, and TAF-BW (Karlsruhe).

Columns: track_id, frame_id, timestamp_ms, agent_type, x, y, vx, vy, psi_rad, length, width; pedestrians have no
psi_rad, length and width. x, y are the centre, psi_rad is counter-clockwise from +x. Times come from timestamp_ms: in
TAF-BW frame ids step by 1 to 3 within 100 ms.

INTERACTION's coordinates are those of its Lanelet2 map, UTM zone 31 minus the point at latitude and longitude 0. TAF-BW
states the origin in ``meta_data.csv`` beside the tracks; its metres are a spherical Mercator projection about it, with
true scale at its latitude. See Zhan et al. 2019, arXiv 1910.03088, and the repository of the test area.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from egvs.core.errors import InputError
from egvs.tracks import columns
from egvs.tracks.model import TrackFrame, Tracks

NAME = "INTERACTION or TAF-BW tracks"

_REQUIRED = ("track_id", "timestamp_ms", "agent_type", "x", "y")
_OPTIONAL = ("psi_rad", "length", "width", "case_id")
_META_FILE = "meta_data.csv"
_EARTH_RADIUS_M = 6378137.0

_CLASSES = {
    "car": "car", "truck": "truck", "bus": "bus", "van": "van", "motorcycle": "motorcycle", "bike": "bicycle",
    "bicycle": "bicycle", "pedestrian": "pedestrian", "pedestrian/bicycle": "pedestrian", "tram": "tram",
    "vehicle": "car",
}  # fmt: skip


def can_open(_path: Path, head: bytes) -> bool:
    """Return whether the first line names INTERACTION's columns; SinD's have further ones."""
    return columns.has_columns(head, *_REQUIRED) and not columns.has_columns(head, "ax", "ay")


def companions(path: Path) -> Sequence[Path]:
    """Return ``meta_data.csv`` beside the tracks, if it exists."""
    meta = path.parent / _META_FILE
    return [meta] if meta.is_file() else []


def read(path: Path) -> Tracks:
    """Read a file."""
    table = columns.read_table(path, _REQUIRED, _OPTIONAL)
    names = list(table.texts("track_id"))
    if "case_id" in table.columns:
        names = [f"{case}-{name}" for case, name in zip(table.texts("case_id"), names, strict=True)]
    frame, sources = TrackFrame("EPSG:32631", _UTM_31_AT_ZERO_M), []
    for meta in companions(path):
        frame = _frame_from_origin(meta)
        sources.append(f"positions are a spherical Mercator projection about the origin in {meta.name}")
    values = {
        "time_s": table.numbers("timestamp_ms") / 1000.0,
        "x_m": table.numbers("x"),
        "y_m": table.numbers("y"),
        "yaw_rad": table.optional_numbers("psi_rad"),
        "length_m": table.optional_numbers("length"),
        "width_m": table.optional_numbers("width"),
    }
    classes = [_class_of(table, row, text) for row, text in enumerate(table.texts("agent_type"))]
    if "pedestrian/bicycle" in table.texts("agent_type"):
        sources.append('tracks of type "pedestrian/bicycle" count as pedestrians')
    return Tracks.from_rows(names, classes, values, frame, sources)


_UTM_31_AT_ZERO_M = (166021.4430805405, 0.0)
"""UTM zone 31 at latitude and longitude 0, which INTERACTION's and SinD's tools subtract."""


def _class_of(table: columns.Table, row: int, text: str) -> str:
    name = _CLASSES.get(text.lower())
    if name is None:
        raise table.error(row, "agent_type", f"unknown type {text!r}", f"Use one of {', '.join(_CLASSES)}.")
    return name


def _frame_from_origin(meta: Path) -> TrackFrame:
    """Return the projection about the origin of TAF-BW's ``meta_data.csv``."""
    table = columns.read_table(meta, ("originLat", "originLon"))
    lat_deg, lon_deg = float(table.numbers("originLat")[0]), float(table.numbers("originLon")[0])
    if not (abs(lat_deg) < 85.0 and abs(lon_deg) <= 180.0):
        raise InputError(f"{meta}: originLat, originLon", f"got {lat_deg:g}, {lon_deg:g}", "Use degrees.")
    scale = math.cos(math.radians(lat_deg))
    northing_m = scale * _EARTH_RADIUS_M * math.asinh(math.tan(math.radians(lat_deg)))
    crs = f"+proj=merc +R={_EARTH_RADIUS_M:.0f} +lon_0={lon_deg!r} +k_0={scale!r} +nadgrids=@null +units=m +no_defs"
    return TrackFrame(crs, (0.0, float(np.round(northing_m, 6))))
