"""Read tracks in the columns of the INTERACTION data set: INTERACTION 1.0 to 1.2, and TAF-BW (Karlsruhe).

Columns: track_id, frame_id, timestamp_ms, agent_type, x, y, vx, vy, psi_rad, length, width; pedestrians have no
psi_rad, length and width. x, y are the centre, psi_rad is counter-clockwise from +x. Times come from timestamp_ms: in
TAF-BW frame ids step by 1 to 3 within 100 ms.

Version 1.2 has cases of 4 s, in a column case_id; ids and times start again in each. The cases are placed one after
another in time, in the order of the file, so that no two of them overlap.

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
from egvs.core.grid import FloatArray
from egvs.extensions.tracks import columns
from egvs.extensions.tracks.model import TrackFrame, Tracks

REQUIRED_COLUMNS = ("track_id", "timestamp_ms", "agent_type", "x", "y")
_OPTIONAL = ("psi_rad", "length", "width", "case_id")
_META_FILE = "meta_data.csv"
_EARTH_RADIUS_M = 6378137.0
_CASE_PAUSE_S = 0.1

_CLASSES = {
    "car": "car", "truck": "truck", "bus": "bus", "van": "van", "motorcycle": "motorcycle", "bike": "bicycle",
    "bicycle": "bicycle", "pedestrian": "pedestrian", "pedestrian/bicycle": "pedestrian", "tram": "tram",
    "vehicle": "car",
}  # fmt: skip

MAP_FRAME = TrackFrame("EPSG:32631", (166021.4430805405, 0.0))
"""UTM zone 31 minus the point at latitude and longitude 0, as INTERACTION's and SinD's tools project their maps."""


def can_open(_path: Path, head: bytes) -> bool:
    """Return whether the first line names INTERACTION's columns; SinD's have further ones."""
    return columns.has_columns(head, *REQUIRED_COLUMNS) and not columns.has_columns(head, "ax", "ay")


def companions(path: Path) -> Sequence[Path]:
    """Return ``meta_data.csv`` beside the tracks, if it exists."""
    meta = path.parent / _META_FILE
    return [meta] if meta.is_file() else []


def read(path: Path) -> Tracks:
    """Read a file."""
    table = columns.read_table(path, REQUIRED_COLUMNS, _OPTIONAL)
    names, time_s = list(table.names("track_id")), table.times_s("timestamp_ms", 0.001)
    frame, sources = MAP_FRAME, []
    if "case_id" in table.columns:
        cases = table.texts("case_id")
        names = [f"{case}-{name}" for case, name in zip(cases, names, strict=True)]
        time_s = _one_after_another(cases, time_s)
        sources.append(f"{len(set(cases))} cases are placed one after another in time")
    for meta in companions(path):
        frame = _frame_from_origin(meta)
        sources.append(f"positions are a spherical Mercator projection about the origin in {meta.name}")
    values = {
        "time_s": time_s,
        "x_m": table.positions_m("x"),
        "y_m": table.positions_m("y"),
        "yaw_rad": table.angles_rad("psi_rad"),
        "length_m": table.sizes_m("length"),
        "width_m": table.sizes_m("width"),
    }
    if "pedestrian/bicycle" in table.texts("agent_type"):
        sources.append('tracks of type "pedestrian/bicycle" count as pedestrians')
    return Tracks.from_rows(names, table.classes("agent_type", _CLASSES), values, frame, sources)


def _one_after_another(cases: Sequence[str], time_s: FloatArray) -> FloatArray:
    """Return times with each case moved to begin a pause after the end of the case before it."""
    order = list(dict.fromkeys(cases))
    position_of = {case: position for position, case in enumerate(order)}
    case = np.array([position_of[name] for name in cases], dtype=np.int64)
    first_s, last_s = np.full(len(order), np.inf), np.full(len(order), -np.inf)
    np.minimum.at(first_s, case, time_s)
    np.maximum.at(last_s, case, time_s)
    begin_s = np.concatenate([[0.0], np.cumsum(last_s - first_s + _CASE_PAUSE_S)[:-1]])
    moved_s: FloatArray = time_s - first_s[case] + begin_s[case]
    return moved_s


def _frame_from_origin(meta: Path) -> TrackFrame:
    """Return the projection about the origin of TAF-BW's ``meta_data.csv``, which all its rows must share."""
    table = columns.read_table(meta, ("originLat", "originLon"))
    origins = set(zip(table.numbers("originLat").tolist(), table.numbers("originLon").tolist(), strict=True))
    (lat_deg, lon_deg), *others = sorted(origins)
    if others:
        hint = "Keep only the row of the recording that is read."
        raise InputError(f"{meta}: originLat, originLon", f"expected one origin, got {len(origins)}", hint)
    if not (abs(lat_deg) < 85.0 and abs(lon_deg) <= 180.0):
        raise InputError(f"{meta}: originLat, originLon", f"got {lat_deg:g}, {lon_deg:g}", "Use degrees.")
    scale = math.cos(math.radians(lat_deg))
    northing_m = scale * _EARTH_RADIUS_M * math.asinh(math.tan(math.radians(lat_deg)))
    crs = f"+proj=merc +R={_EARTH_RADIUS_M:.0f} +lon_0={lon_deg!r} +k_0={scale!r} +nadgrids=@null +units=m +no_defs"
    return TrackFrame(crs, (0.0, float(np.round(northing_m, 6))))
