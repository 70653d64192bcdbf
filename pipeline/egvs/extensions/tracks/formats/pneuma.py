"""Read pNEUMA trajectories (Athens, by drones): a line per vehicle, cells separated by semicolons.

The header has ten names: track_id; type; traveled_d; avg_speed; lat; lon; speed; lon_acc; lat_acc; time. A line begins
with the first four and repeats the last six for each position. Latitude and longitude have six decimals, 0.11 m and
0.09 m, and are taken to be the centre. There are no sizes and no headings. See Barmpounakis and Geroliminis 2020,
https://doi.org/10.1016/j.trc.2019.11.023.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.extensions.tracks import columns
from egvs.extensions.tracks.formats.geographic import to_utm
from egvs.extensions.tracks.model import Tracks

_VEHICLE = ("track_id", "type", "traveled_d", "avg_speed")
_POSITION = ("lat", "lon", "speed", "lon_acc", "lat_acc", "time")
_CLASSES = {
    "car": "car", "taxi": "car", "motorcycle": "motorcycle", "bus": "bus", "medium vehicle": "van",
    "heavy vehicle": "truck", "bicycle": "bicycle", "pedestrian": "pedestrian",
}  # fmt: skip


def can_open(_path: Path, head: bytes) -> bool:
    """Return whether the first line has pNEUMA's ten names."""
    return _is_header(columns.header(head, ";"))


def companions(_path: Path) -> Sequence[Path]:
    """Return no files."""
    return []


def read(path: Path) -> Tracks:
    """Read a file."""
    table = _read_positions(path)
    lat_deg, lon_deg = table.numbers("lat"), table.numbers("lon")
    xy_m, frame = to_utm(lon_deg, lat_deg, lambda row, problem: table.error(row, "lat, lon", problem))
    values = {"time_s": table.times_s("time"), "x_m": xy_m[:, 0], "y_m": xy_m[:, 1]}
    sources = ['"Medium Vehicle" counts as van, "Heavy Vehicle" as truck, "Taxi" as car']
    return Tracks.from_rows(table.names("track_id"), table.classes("type", _CLASSES), values, frame, sources)


def _is_header(names: Sequence[str]) -> bool:
    return tuple(name for name in names if name) == (*_VEHICLE, *_POSITION)


def _read_positions(path: Path) -> columns.Table:
    """Return a row for each position, with id and type of its vehicle."""
    cells: dict[str, list[str]] = {name: [] for name in ("track_id", "type", "lat", "lon", "time")}
    lines: list[int] = []
    seen: set[str] = set()
    rows = columns.read_rows(path, ";")
    if not _is_header([name.strip().lower() for name in next(rows, (0, []))[1]]):
        problem = f"expected {'; '.join((*_VEHICLE, *_POSITION))} in the first line"
        raise InputError(path, problem, "Use the file as it was published.")
    for line, texts in rows:
        row = [text.strip() for text in texts]
        while row and not row[-1]:
            row.pop()
        count, rest = divmod(len(row) - len(_VEHICLE), len(_POSITION))
        if count < 1 or rest:
            problem = f"expected 4 cells and 6 for each position, got {len(row)}"
            raise InputError(f"{path}: line {line}", problem, "Complete the line, or remove it.")
        if row[0] in seen:
            raise InputError(f"{path}: line {line}: track_id", f"{row[0][:80]!r} occurs twice", "Remove the line.")
        seen.add(row[0])
        for name, text in zip(_VEHICLE[:2], row[:2], strict=True):
            cells[name] += [text] * count
        for name in ("lat", "lon", "time"):
            cells[name] += row[len(_VEHICLE) + _POSITION.index(name) :: len(_POSITION)]
        lines += [line] * count
        limits.ROWS.check(path, len(lines))
    if not lines:
        raise InputError(path, "contains no vehicles", "Use the file as it was published.")
    return columns.Table(path, cells, lines)
