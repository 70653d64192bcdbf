r"""Files that state the beams of a sensor: tables of beams or rings, and the makers' own files.

============================  =========================================================================================
File                          Content
============================  =========================================================================================
Table of beams (CSV)          columns ``elevation_deg``, ``azimuth_deg``; one row per beam
Table of directions (CSV)     columns ``elevation_deg``, ``azimuth_deg``, ``dwell_s``; for patterns that do not repeat
Table of rings (CSV)          columns ``elevation_deg``, ``azimuth_offset_deg`` and, optionally, ``vertical_offset_m``;
                              one row per ring
Hesai angle correction (CSV)  columns ``Laser id`` (or ``Channel``), ``Elevation``, ``Azimuth``; azimuths clockwise;
                              often a line ``EEFF,...`` before, and a checksum after
RoboSense, ``angle.csv``      no header; two columns: vertical and horizontal angle; horizontal angles clockwise
Ouster, metadata (JSON)       ``beam_altitude_angles``, ``beam_azimuth_angles`` (clockwise), columns per frame; keys of
                              firmware 1 and 2 at the top level, of later ones in ``beam_intrinsics``,
                              ``lidar_data_format`` and ``config_params``
============================  =========================================================================================

Tables are recognised by their header, or by having none; CSV stands for any table that
:mod:`egvs.formats.spreadsheets` reads. Elevations of an Ouster are those of the beams, which leave
``lidar_origin_to_beam_origin_mm`` beside the axis; like the vertical offsets of a table, this distance is read and
printed, but simulated beams start at the position of the sensor.

Formats: the drivers of the makers (``ouster-sdk``, class ``SensorInfo``; ``HesaiLidar_SDK_2.0``, folder ``correction``;
``rs_driver``, class ``ChanAngles``). These files come from devices and mails, so every number in them is checked.
"""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from egvs.core import limits
from egvs.core.digests import hash_input, open_input
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.numbers import number_or_nan, parse_decimal
from egvs.core.reading import read_json
from egvs.formats import spreadsheets
from egvs.scenario.sensor_config import MAX_RINGS

BEAM_COLUMNS = ("elevation_deg", "azimuth_deg")
RING_COLUMN, HEIGHT_COLUMN, DWELL_COLUMN = "azimuth_offset_deg", "vertical_offset_m", "dwell_s"

MAX_ELEVATION_DEG, MAX_AZIMUTH_DEG = 90.0, 360.0
MAX_OFFSET_M = 1.0
"""Optics of a sensor are no farther from its origin."""
MAX_DWELL_S = 1e6
MAX_COLUMNS = 100_000
"""Columns of a turn: fifty times as many as any sensor has."""

_HEAD_BYTES = 4096
_GAP_DEG = 5.0
"""A beam table without a wider gap between azimuths covers the full circle."""
_GAP_TOLERANCE_DEG = 1e-6
"""Gaps whose widths differ by less are equally wide."""

_HESAI_MARK, _CHECKSUM = "eeff", re.compile(r"[0-9a-fA-F]{32,128}")
_MODE = re.compile(r"(\d{1,6})x(\d{1,3})")
_CSV_HINT = (
    "The header needs the columns elevation_deg, azimuth_deg (a row per beam) or elevation_deg, azimuth_offset_deg (a"
    " row per ring)."
)
_DWELL_HINT = (
    "List each direction once, with the seconds that the beam pointed there: elevation_deg,azimuth_deg,dwell_s."
)
_OUSTER_HINT = "Save it again with the maker's tools, for example from http://SENSOR/api/v1/sensor/metadata."


class BeamTable:
    """Elevation and azimuth of each beam in the sensor frame, degrees; immutable and hashable.

    Two tables are equal if their angles and weights are equal.

    Parameters
    ----------
    elevation_deg, azimuth_deg
        One value per beam, (n,) float64 each, n > 0.
    weight
        Probability that a frame has this beam, (n,) float64, above 0 and at most 1; None if each frame has all beams.
    """

    def __init__(self, elevation_deg: FloatArray, azimuth_deg: FloatArray, weight: FloatArray | None = None) -> None:
        self.elevation_deg = np.array(elevation_deg, dtype=np.float64)
        self.azimuth_deg = np.array(azimuth_deg, dtype=np.float64)
        self.weight = None if weight is None else np.array(weight, dtype=np.float64)
        columns = [column for column in (self.elevation_deg, self.azimuth_deg, self.weight) if column is not None]
        for column in columns:
            column.flags.writeable = False
        self._digest = hashlib.sha256(b"".join(column.tobytes() for column in columns)).digest()

    def __len__(self) -> int:
        return len(self.elevation_deg)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, BeamTable) and self._digest == other._digest

    def __hash__(self) -> int:
        return hash(self._digest)

    @property
    def azimuth_span_deg(self) -> tuple[float, float] | None:
        """First and last azimuth of the smallest arc that holds all beams, counter-clockwise; None for a full circle.

        The circle is full where no gap is wide, or where several gaps are equally wide, as in a coarse table of a whole
        turn.
        """
        azimuths = np.unique(np.mod(self.azimuth_deg, 360.0))
        gaps = np.diff(azimuths, append=azimuths[0] + 360.0)
        widest = int(np.argmax(gaps))
        n_widest = np.count_nonzero(gaps > gaps[widest] - _GAP_TOLERANCE_DEG)
        if gaps[widest] <= _GAP_DEG or n_widest > 1:
            return None
        first = float(azimuths[(widest + 1) % len(azimuths)])
        if first > 180.0:
            first -= 360.0
        return first, first + 360.0 - float(gaps[widest])


@dataclass(frozen=True)
class Rings:
    """Rings that a file states, in its order.

    Attributes
    ----------
    elevations_deg, azimuth_offsets_deg
        Of each ring; offsets counter-clockwise.
    vertical_offsets_m
        Where each ring's beams start above the origin; empty if the file does not say. Not simulated.
    axis_distance_m
        How far from the axis beams start; 0 if the file does not say. Not simulated.
    azimuths
        Number of columns; None if the file does not say.
    azimuth_deg
        First and last azimuth of the columns; None for the full circle, or if the file does not say.
    """

    elevations_deg: tuple[float, ...]
    azimuth_offsets_deg: tuple[float, ...]
    vertical_offsets_m: tuple[float, ...] = ()
    axis_distance_m: float = 0.0
    azimuths: int | None = None
    azimuth_deg: tuple[float, float] | None = None


@dataclass(frozen=True)
class BeamFile:
    """What a file says about the beams of a sensor.

    Attributes
    ----------
    kind
        The format, in words.
    beams
        Single beams or rings.
    dwell_s
        How long the beam of a pattern pointed into each direction, (n,) float64; None for other files.
    """

    kind: str
    beams: BeamTable | Rings
    dwell_s: FloatArray | None = None


def is_beam_file(name: str) -> bool:
    """Whether a name is that of a file of beams, by its suffix; names of sensors have no such suffix.

    >>> is_beam_file("units/metadata.json"), is_beam_file("OS1-64")
    (True, False)
    """
    return Path(name).suffix.lower() in {*spreadsheets.SUFFIXES, ".json", ".txt", ".tsv"}


def read_beam_file(path: Path) -> BeamFile:
    """Read a file that states the beams of a sensor.

    Parameters
    ----------
    path
        A CSV file, or the metadata of an Ouster (``.json``); see the table above.

    Raises
    ------
    InputError
        Naming file, row or key, and value.
    """
    if not path.is_file():
        raise InputError(path, "there is no such file", "Check the path.")
    return _read_cached(path, hash_input(path))


def read_directions(path: Path, pulses: int) -> BeamTable:
    """Read the directions of a sensor whose pattern does not repeat, with their dwell times.

    Of the ``pulses`` of a frame, each direction gets its share of the dwell time on average. A direction with more than
    one is listed several times, so that every weight is at most 1.

    Parameters
    ----------
    path
        A CSV file with the columns ``elevation_deg``, ``azimuth_deg`` and ``dwell_s``: how long the beam pointed there,
        over any time, seconds.
    pulses
        Pulses of one frame.

    Raises
    ------
    InputError
        Naming file, row and value.
    """
    file = read_beam_file(path)
    if not isinstance(file.beams, BeamTable) or file.dwell_s is None:
        raise InputError(path, f"expected a column {DWELL_COLUMN}, got a {file.kind}", _DWELL_HINT)
    expected = pulses * file.dwell_s / file.dwell_s.sum()
    copies = np.ceil(expected).astype(np.int64)
    limits.BEAMS.check(path, int(copies.sum()))
    columns = (file.beams.elevation_deg, file.beams.azimuth_deg, expected / copies)
    return BeamTable(*(np.repeat(column, copies) for column in columns))


@lru_cache(maxsize=4)
def _read_cached(path: Path, _content_hash: str) -> BeamFile:
    limits.checked_size(path, limits.FILE)
    if path.suffix.lower() == ".json":
        return BeamFile("Ouster metadata", _read_ouster(path))
    with open_input(path) as content:
        is_plain = spreadsheets.is_plain_csv(content.read(_HEAD_BYTES))
    if not is_plain:
        return _read_csv(path, iter(spreadsheets.read_cells(path)))
    try:
        with open_input(path) as content, io.TextIOWrapper(content, "utf-8-sig", newline="") as file:
            return _read_csv(path, csv.reader(file, skipinitialspace=True))
    except (UnicodeDecodeError, csv.Error) as error:
        hint = "Save it as UTF-8 text with a header row."
        raise InputError(path, f"the file cannot be read as CSV ({error})", hint) from None


# ---- tables


def _read_csv(path: Path, rows: Iterator[list[str]]) -> BeamFile:
    header = next(rows, [])
    if header and header[0].strip().lower() == _HESAI_MARK:
        header = next(rows, [])
    names = [name.strip() for name in header]
    lower = [name.lower() for name in names]
    if len(names) == 2 and all(_is_number(name) for name in names):
        rows = itertools.chain([names], rows)
        return BeamFile("RoboSense angles", _rings(path, rows, ("vertical", "horizontal"), (0, 1), -1.0))
    if {"elevation", "azimuth"} <= set(lower):
        _check_columns(path, lower, ("elevation", "azimuth"))
        angles = (lower.index("elevation"), lower.index("azimuth"))
        listed = [row for row in itertools.islice(rows, MAX_RINGS + 2) if row]
        if listed and _is_checksum(listed[-1]):
            listed.pop()
        for name in ("laser id", "channel"):
            if name in lower:
                _check_lasers(path, listed, lower.index(name))
        return BeamFile("Hesai angles", _rings(path, listed, ("Elevation", "Azimuth"), angles, -1.0, len(names)))
    if RING_COLUMN in names:
        if BEAM_COLUMNS[1] in names:
            problem = f"the file has both columns {BEAM_COLUMNS[1]} (of a beam) and {RING_COLUMN} (of a ring)"
            raise InputError(path, problem, _CSV_HINT)
        read = (BEAM_COLUMNS[0], RING_COLUMN, *((HEIGHT_COLUMN,) if HEIGHT_COLUMN in names else ()))
        _check_columns(path, names, read)
        return BeamFile("table of rings", _rings(path, rows, read, list(map(names.index, read)), 1.0, len(names)))
    has_dwell = DWELL_COLUMN in names
    columns = (*BEAM_COLUMNS, DWELL_COLUMN) if has_dwell else BEAM_COLUMNS
    _check_columns(path, names, columns)
    table = _beams(path, rows, names, columns)
    beams = BeamTable(table[:, 0], table[:, 1])
    if has_dwell:
        return BeamFile("table of directions", beams, table[:, 2])
    return BeamFile("table of beams", beams)


def _is_checksum(row: list[str]) -> bool:
    """Whether a row is the checksum at the end of a Hesai file: hexadecimal digits, and nothing else."""
    return _CHECKSUM.fullmatch(row[0].strip()) is not None and not any(cell.strip() for cell in row[1:])


def _is_number(text: str) -> bool:
    return math.isfinite(number_or_nan(text, parse_decimal))


def _check_columns(path: Path, names: Sequence[str], read: Sequence[str]) -> None:
    for column in read:
        if column not in names:
            raise InputError(path, f"the file has no column {column}", _CSV_HINT)
        if names.count(column) > 1:
            raise InputError(path, f"the file has {names.count(column)} columns {column}", _CSV_HINT)


def _beams(path: Path, rows: Iterable[list[str]], names: list[str], read: Sequence[str]) -> FloatArray:
    """Return columns of a table with a row per beam, (n, columns)."""
    columns = [names.index(name) for name in read]
    values: list[list[float]] = []
    maximum = limits.BEAMS.maximum
    for row in rows:
        if not row:
            continue
        where = f"{path}: beam {len(values)}"
        _check_width(where, row, len(names))
        cells = zip(read, columns, (MAX_ELEVATION_DEG, MAX_AZIMUTH_DEG, MAX_DWELL_S), strict=False)
        values.append([_parse(f"{where}: {name}", _cell(row, column), bound) for name, column, bound in cells])
        if len(read) > len(BEAM_COLUMNS) and values[-1][2] <= 0.0:
            raise InputError(
                f"{where}: {DWELL_COLUMN}", f"expected seconds above 0, got {values[-1][2]:g}", _DWELL_HINT
            )
        if len(values) > maximum:
            raise InputError(path, f"the file has more than {maximum:,} beams", limits.BEAMS.hint)
    if not values:
        raise InputError(path, "expected at least one beam, got none", "Write one row per beam.")
    return np.array(values)


def _rings(
    path: Path,
    rows: Iterable[list[str]],
    names: Sequence[str],
    columns: Sequence[int],
    sign: float,
    width: int = 2,
) -> Rings:
    """Return the rings of a table; ``sign`` is -1 where its azimuths are clockwise."""
    listed = list(itertools.islice((row for row in rows if row), MAX_RINGS + 1))
    _check_ring_count(path, len(listed))
    bounds = (MAX_ELEVATION_DEG, MAX_AZIMUTH_DEG, MAX_OFFSET_M)
    values = np.empty((len(listed), len(columns)))
    for number, row in enumerate(listed):
        where = f"{path}: ring {number}"
        _check_width(where, row, width)
        for index, (name, column) in enumerate(zip(names, columns, strict=True)):
            values[number, index] = _parse(f"{where}: {name}", _cell(row, column), bounds[index])
    _check_padding(path, values[:, 0], values[:, 1])
    vertical = tuple(values[:, 2].tolist()) if len(columns) > 2 else ()
    return Rings(tuple(values[:, 0].tolist()), tuple((sign * values[:, 1] + 0.0).tolist()), vertical)


def _check_ring_count(where: object, count: int) -> None:
    if count == 0:
        raise InputError(where, "expected at least one ring, got none", "Write one row per ring.")
    if count > MAX_RINGS:
        hint = "Name the column azimuth_deg if each row is a single beam."
        raise InputError(where, f"expected at most {MAX_RINGS:,} rings, got more", hint)


def _check_padding(where: object, elevations_deg: FloatArray, offsets_deg: FloatArray) -> None:
    """Raise an InputError if several rings have both angles 0, as of a table that was filled up."""
    count = int(np.count_nonzero((elevations_deg == 0.0) & (offsets_deg == 0.0)))
    if count > 1:
        problem = f"{count} of {len(elevations_deg)} rings have elevation 0 and azimuth 0, as if the list was filled up"
        raise InputError(where, problem, "Give the angles of all rings, or remove these rows.")


def _check_lasers(path: Path, rows: list[list[str]], column: int) -> None:
    """Check that no laser is listed twice."""
    first: dict[str, int] = {}
    for number, row in enumerate(rows):
        laser = _cell(row, column).strip()
        if laser in first:
            problem = f"laser {laser[:20]!r} is that of ring {first[laser]} too"
            raise InputError(f"{path}: ring {number}", problem, "List each laser once.")
        first[laser] = number


def _check_width(where: str, row: list[str], width: int) -> None:
    if len(row) != width:  # e.g. a decimal comma, which shifts all following values by one column
        problem = f"expected {width} values, one per column, got {len(row)}"
        hint = (
            "Use decimal points, not decimal commas."
            if len(row) > width
            else "Check the header, and the end of the row."
        )
        raise InputError(where, problem, hint)


def _cell(row: list[str], column: int) -> str:
    return row[column] if column < len(row) else ""


def _parse(where: str, text: str, bound: float) -> float:
    value = number_or_nan(text, parse_decimal)
    if not abs(value) <= bound:
        raise InputError(where, f"expected a number between {-bound:g} and {bound:g}, got {text[:40]!r}")
    return value


# ---- Ouster


def _read_ouster(path: Path) -> Rings:
    document = read_json(path, _OUSTER_HINT)
    if not isinstance(document, dict):
        raise InputError(path, "expected an object with beam_altitude_angles, got another value", _OUSTER_HINT)
    beams = _section(path, document, "beam_intrinsics") or document
    elevations_deg = _angles(path, beams, "beam_altitude_angles", MAX_ELEVATION_DEG)
    azimuths_deg = _angles(path, beams, "beam_azimuth_angles", MAX_AZIMUTH_DEG)
    if len(azimuths_deg) != len(elevations_deg):
        problem = f"expected {len(elevations_deg)} values, one per beam_altitude_angles, got {len(azimuths_deg)}"
        raise InputError(f"{path}: beam_azimuth_angles", problem, _OUSTER_HINT)
    form = _section(path, document, "lidar_data_format") or _section(path, document, "data_format")
    pixels = form.get("pixels_per_column", len(elevations_deg))
    if pixels != len(elevations_deg):
        problem = f"expected {str(pixels)[:40]} values, one per pixels_per_column, got {len(elevations_deg)}"
        raise InputError(f"{path}: beam_altitude_angles", problem, _OUSTER_HINT)
    distance_mm = beams.get("lidar_origin_to_beam_origin_mm", 0.0)
    if not _is_finite(distance_mm) or not 0.0 <= distance_mm <= 1000.0 * MAX_OFFSET_M:
        problem = f"expected a distance from 0 to {1000 * MAX_OFFSET_M:g} mm, got {str(distance_mm)[:40]!r}"
        raise InputError(f"{path}: lidar_origin_to_beam_origin_mm", problem, _OUSTER_HINT)
    columns, window = _columns(path, document)
    limits.BEAMS.check(path, columns * len(elevations_deg))
    _check_padding(path, np.array(elevations_deg), np.array(azimuths_deg))
    return Rings(
        elevations_deg,
        tuple(-angle + 0.0 for angle in azimuths_deg),
        axis_distance_m=distance_mm / 1000.0,
        azimuths=columns if window is None else _window_width(columns, window),
        azimuth_deg=None if window is None else _window_deg(columns, window),
    )


def _section(path: Path, document: dict[str, Any], key: str) -> dict[str, Any]:
    value = document.get(key, {})
    if not isinstance(value, dict):
        raise InputError(f"{path}: {key}", "expected an object, got another value", _OUSTER_HINT)
    return value


def _angles(path: Path, beams: dict[str, Any], key: str, bound_deg: float) -> tuple[float, ...]:
    where = f"{path}: {key}"
    values = beams.get(key)
    if not isinstance(values, list):
        actual = "none" if values is None else "another value"
        raise InputError(where, f"expected a list of angles, got {actual}", _OUSTER_HINT)
    _check_ring_count(where, len(values))
    for number, value in enumerate(values):
        if not _is_finite(value) or not abs(value) <= bound_deg:
            problem = f"expected a number between {-bound_deg:g} and {bound_deg:g}, got {str(value)[:40]!r}"
            raise InputError(f"{where}[{number}]", problem, _OUSTER_HINT)
    return tuple(float(value) for value in values)


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _columns(path: Path, document: dict[str, Any]) -> tuple[int, tuple[int, int] | None]:
    """Return the columns of a full turn, and the first and last of those that are fired; None if all are."""
    form = _section(path, document, "lidar_data_format") or _section(path, document, "data_format")
    columns = form.get("columns_per_frame")
    key = "columns_per_frame"
    if columns is None:
        key = "lidar_mode"
        mode = str(_section(path, document, "config_params").get(key, document.get(key, "")))
        match = _MODE.fullmatch(mode)
        if match is None:
            problem = f"expected a mode such as 1024x10, or columns_per_frame, got {mode[:40]!r}"
            raise InputError(f"{path}: {key}", problem, _OUSTER_HINT)
        columns = int(match[1])
    if not isinstance(columns, int) or isinstance(columns, bool) or not 1 <= columns <= MAX_COLUMNS:
        problem = f"expected a whole number from 1 to {MAX_COLUMNS:,}, got {str(columns)[:40]!r}"
        raise InputError(f"{path}: {key}", problem, _OUSTER_HINT)
    window = form.get("column_window")
    if window is None or window == [0, columns - 1]:
        return columns, None
    is_pair = isinstance(window, list) and len(window) == 2 and all(type(value) is int for value in window)
    if not is_pair or not all(0 <= value < columns for value in window):
        problem = f"expected two columns from 0 to {columns - 1}, got {str(window)[:40]}"
        raise InputError(f"{path}: column_window", problem, _OUSTER_HINT)
    is_full = _window_width(columns, (window[0], window[1])) == columns
    return columns, None if is_full else (window[0], window[1])


def _window_width(columns: int, window: tuple[int, int]) -> int:
    """Return the number of columns of a window, which may go over the end of the turn."""
    first, last = window
    return (last - first) % columns + 1


def _window_deg(columns: int, window: tuple[int, int]) -> tuple[float, float]:
    """Return the azimuths of the last and the first column of a window: columns count clockwise from the x axis."""
    last_deg = -360.0 * window[0] / columns
    first_deg = last_deg - 360.0 * (_window_width(columns, window) - 1) / columns
    turn_deg = 360.0 if first_deg < -180.0 else 0.0
    return first_deg + turn_deg, last_deg + turn_deg
