"""Read a user's own file of tracks, CSV with a header row or JSON lines, by the mapping in ``[traffic.track_columns]``.

A row is a box at an instant. The mapping (:class:`egvs.scenario.track_columns.TrackColumns`) names the columns, their
units and conventions. The file is JSON lines if its first character is ``{``. Plain or gzipped.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from egvs.core import limits, reading
from egvs.core.errors import InputError
from egvs.core.grid import BoolArray, FloatArray
from egvs.core.wording import number_of
from egvs.extensions.tracks import columns
from egvs.extensions.tracks.columns import Table
from egvs.extensions.tracks.formats.geographic import grid_turn_rad, to_utm
from egvs.extensions.tracks.model import CLASSES, TrackFrame, Tracks
from egvs.extensions.tracks.motion import motion_yaw_rad
from egvs.formats.georeference import WGS84, WorldFrame, parse_crs
from egvs.scenario.track_columns import TrackColumns

_HINT = "Correct [traffic.track_columns], which names the columns of this file."
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_METRES = {"m": 1.0, "ft": 0.3048}
_RADIANS = {"rad": 1.0, "deg": math.radians(1.0)}
_MOTION_STEP_M = 2.0


def read(path: Path, mapping: TrackColumns, where: str = "traffic.track_columns") -> Tracks:
    """Read a file.

    Parameters
    ----------
    path
        The file.
    mapping
        Names, units and conventions of its columns.
    where
        The mapping's file and table, for messages.

    Raises
    ------
    InputError
        When the file is damaged, lacks a column, or has a cell that does not fit; or when the coordinate reference
        system is unknown.
    """
    table = _read_table(path, mapping)
    unit_m = _METRES[mapping.length_unit]
    values = {
        f"{key}_m": table.sizes_m(column, unit_m)
        for key, column in (("length", mapping.length), ("width", mapping.width), ("height", mapping.height))
        if column is not None
    }
    values["time_s"] = table.times_s(mapping.time, _SECONDS[mapping.time_unit])
    if mapping.yaw is not None:
        values["yaw_rad"] = _to_ccw_from_east(table.angles_rad(mapping.yaw, _RADIANS[mapping.yaw_unit]), mapping)
    frame = _add_positions(table, mapping, where, values)
    if mapping.z is not None:
        values["z_m"] = table.heights_m(mapping.z, unit_m)
        if mapping.z_reference == "bottom":
            values["z_m"] = values["z_m"] + values["height_m"] / 2.0
    names, classes, sources = table.names(mapping.id), _classes(table, mapping), list[str]()
    if mapping.reference == "front":
        is_placed = _move_to_centres(table, mapping, values)
        if not is_placed.all():
            rows = number_of(int(np.count_nonzero(~is_placed)), "row")
            sources.append(f"{rows} left out: only the front is given, and the track has no heading and does not move")
            names, classes = list(compress(names, is_placed)), list(compress(classes, is_placed))
            values = {key: numbers[is_placed] for key, numbers in values.items()}
    return Tracks.from_rows(names, classes, values, frame, sources)


def _to_ccw_from_east(yaw_rad: FloatArray, mapping: TrackColumns) -> FloatArray:
    return math.pi / 2.0 - yaw_rad if mapping.yaw_convention == "cw_from_north" else yaw_rad


def _add_positions(table: Table, mapping: TrackColumns, where: str, values: dict[str, FloatArray]) -> TrackFrame:
    """Add x_m and y_m, turn yaw_rad from true north to that of the grid, and return the frame."""
    if mapping.crs is None:
        unit_m = _METRES[mapping.length_unit]
        values |= {"x_m": table.positions_m(mapping.x, unit_m), "y_m": table.positions_m(mapping.y, unit_m)}
        return TrackFrame()
    key, crs = f"{where}: crs", WGS84 if mapping.crs == "lonlat" else mapping.crs
    if not parse_crs(crs, key).is_geographic:
        WorldFrame.from_projection(crs, (0.0, 0.0), key)
        values |= {"x_m": table.positions_m(mapping.x), "y_m": table.positions_m(mapping.y)}
        return TrackFrame(crs)
    lon_deg, lat_deg = table.numbers(mapping.x), table.numbers(mapping.y)
    names = f"{mapping.x}, {mapping.y}"
    xy_m, frame = to_utm(lon_deg, lat_deg, lambda row, problem: table.error(row, names, problem), crs)
    values |= {"x_m": xy_m[:, 0], "y_m": xy_m[:, 1]}
    if "yaw_rad" in values:
        values["yaw_rad"] = values["yaw_rad"] + grid_turn_rad(lon_deg, lat_deg, frame)
    return frame


def _classes(table: Table, mapping: TrackColumns) -> list[str]:
    """Return the class of each row."""
    default = mapping.default_type
    if mapping.type is None:
        return [str(default)] * table.n_rows
    by_text: dict[str, str] = {name: name for name in CLASSES}
    if default is not None:
        by_text[""] = default
    by_text |= {text.strip().lower(): name for text, name in mapping.types.items()}
    return table.classes(mapping.type, by_text)


def _move_to_centres(table: Table, mapping: TrackColumns, values: dict[str, FloatArray]) -> BoolArray:
    """Move x_m, y_m from the front to the centre; return which rows have a heading, given or of the motion, (n,)."""
    for row in np.flatnonzero(np.isnan(values["length_m"])):
        raise table.error(int(row), str(mapping.length), "expected a length, from the front to the centre, got none")
    names = np.asarray(table.texts(mapping.id), dtype=object).astype(str)
    track = np.unique(names, return_inverse=True)[1].astype(np.int64)
    motion_rad = motion_yaw_rad(track, values["time_s"], values["x_m"], values["y_m"], _MOTION_STEP_M)
    given_rad = values.get("yaw_rad", motion_rad)
    yaw_rad = np.where(np.isnan(given_rad), motion_rad, given_rad)
    values["x_m"] = values["x_m"] - values["length_m"] / 2.0 * np.cos(yaw_rad)
    values["y_m"] = values["y_m"] - values["length_m"] / 2.0 * np.sin(yaw_rad)
    return ~np.isnan(yaw_rad)


def _read_table(path: Path, mapping: TrackColumns) -> Table:
    """Return the columns that the mapping names."""
    keys = ("time", "id", "x", "y", "z", "yaw", "length", "width", "height", "type")
    names = list(dict.fromkeys(name for key in keys if (name := getattr(mapping, key)) is not None))
    first = next((line for line in columns.read_lines(path, _HINT) if line.strip()), "")
    if first.lstrip().startswith("{"):
        return _read_json_lines(path, names)
    return columns.read_table(path, names, delimiter=mapping.delimiter, hint=_HINT)


def _read_json_lines(path: Path, names: Sequence[str]) -> Table:
    """Return columns of JSON lines; a key that an object lacks is an empty cell, unless all lack it."""
    cells: dict[str, list[str]] = {name: [] for name in names}
    lines: list[int] = []
    for line, text in enumerate(columns.read_lines(path, _HINT), start=1):
        if not text.strip():
            continue
        where, hint = f"{path}: line {line}", "Write one JSON object per line."
        with reading.translate_errors(where, hint, "is not valid JSON"):
            item = reading.parse_json(text.encode("utf-8"))
        if not isinstance(item, dict):
            raise InputError(where, "expected a JSON object", hint)
        for name in names:
            value = _value(item, name)
            if isinstance(value, dict | list):
                problem = f"expected a number or a text, got {type(value).__name__}"
                raise InputError(f"{where}: {name}", problem, _HINT)
            cells[name].append("" if value is None else str(value).strip())
        lines.append(line)
        limits.ROWS.check(path, len(lines))
    for name in names:
        if not any(cells[name]):
            raise InputError(path, f"expected a key {name!r}, which no line has", _HINT)
    return Table(path, cells, lines)


def _value(item: dict[str, Any], name: str) -> Any:
    """Return the value of a key, or of a path of keys and positions with dots; None if it does not exist."""
    if name in item:
        return item[name]
    value: Any = item
    for part in name.split("."):
        if isinstance(value, dict):
            value = value.get(part)
        elif isinstance(value, list) and part.isdecimal() and int(part) < len(value):
            value = value[int(part)]
        else:
            return None
    return value
