"""Read labels of the LUMPI data set (Hannover, several LiDARs at one junction): ``Label.csv``, without a header row.

Cells: time in s, id, four numbers of a rectangle, score (4: corrected by hand), class, number of points, centre x, y
and z, length, width, height, heading in radians counter-clockwise from +x, and further numbers that are not read. The
description of the data set calls x and y UTM; northings below 1,000 km are taken as local. See Busch et al. 2022,
"LUMPI: The Leibniz University Multi-Perspective Intersection Dataset", IEEE Intelligent Vehicles Symposium.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.extensions.tracks import columns
from egvs.extensions.tracks.model import TrackFrame, Tracks

_CELLS = (
    "time", "id", "left", "top", "rectangle width", "rectangle height", "score", "class", "visibility",
    "x", "y", "z", "length", "width", "height", "heading",
)  # fmt: skip
_CLASSES = {
    "0": "pedestrian", "1": "car", "2": "bicycle", "3": "motorcycle", "4": "bus", "5": "truck", "6": "other",
    "7": "other",
}  # fmt: skip
_BY_HAND = 4.0
_UTM = "EPSG:25832"
_MIN_UTM_NORTHING_M = 1e6
"""Hannover's northing is 5.8e6 m; smaller ones are local."""


def can_open(path: Path, head: bytes) -> bool:
    """Return whether the file has the data set's name, and lines with enough cells."""
    is_json = head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith((b"{", b"["))
    return path.name.lower().startswith("label") and not is_json and len(columns.header(head)) >= len(_CELLS)


def companions(_path: Path) -> Sequence[Path]:
    """Return no files."""
    return []


def read(path: Path) -> Tracks:
    """Read a file."""
    table = _read_boxes(path)
    values = {f"{name}_m": table.sizes_m(name) for name in ("length", "width", "height")}
    values |= {f"{name}_m": table.positions_m(name) for name in ("x", "y", "z")}
    values |= {"time_s": table.times_s("time"), "yaw_rad": table.angles_rad("heading")}
    is_utm = float(np.median(values["y_m"])) > _MIN_UTM_NORTHING_M
    n_by_hand = np.count_nonzero(table.numbers("score") == _BY_HAND)
    sources = [f"{n_by_hand:,} of {table.n_rows:,} boxes were corrected by hand",
               "classes 6 and 7 (van or unknown) are of class other"]  # fmt: skip
    frame = TrackFrame(_UTM) if is_utm else TrackFrame()
    return Tracks.from_rows(table.names("id"), table.classes("class", _CLASSES), values, frame, sources)


def _read_boxes(path: Path) -> columns.Table:
    """Return the rows, with classes as whole numbers."""
    cells: dict[str, list[str]] = {name: [] for name in _CELLS}
    lines: list[int] = []
    for line, row in columns.read_rows(path):
        if not lines and row[0].strip().isidentifier():  # names of columns
            continue
        if len(row) < len(_CELLS):
            problem = f"expected at least {len(_CELLS)} cells, got {len(row)}"
            raise InputError(f"{path}: line {line}", problem, "Complete the row, or remove it.")
        for name, text in zip(_CELLS, row, strict=False):
            cells[name].append(text.strip())
        lines.append(line)
        limits.ROWS.check(path, len(lines))
    if not lines:
        raise InputError(path, "contains no rows", "Use the file as it was published.")
    table = columns.Table(path, cells, lines)
    cells["class"] = [f"{number:g}" for number in table.numbers("class")]
    return table
