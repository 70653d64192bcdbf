"""Read a table of labels or detections, CSV with a header: one box in a row, in the sensor's frame.

Columns, each under its own name or the one that ``--columns`` maps it to: ``sweep`` (name of the sweep's file, with or
without suffix), ``time_s`` (seconds), or both; ``type``, ``x_m``, ``y_m``, ``z_m`` (centre), ``length_m``, ``width_m``,
``height_m``, and ``yaw_deg`` or ``yaw_rad``; optionally ``id``, the same for an object in all sweeps, and ``score``, of
a detector. Nothing in such a table says where headings count from: they are tested
(:mod:`egvs.extensions.validation.measured.yaw_conventions`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from egvs.core.errors import InputError
from egvs.core.numbers import number_or_nan, parse_decimal
from egvs.formats import spreadsheets
from egvs.formats.sweep_labels import LabelOptions, SweepLabels, label_class, sweep_name

SIZES = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m")
REQUIRED = ("type", *SIZES)
OPTIONAL = ("sweep", "time_s", "yaw_deg", "yaw_rad", "id", "score")

_HINT = "Name the columns so, or map them: --columns type=class,x_m=cx."


def read_labels(path: Path, options: LabelOptions) -> list[SweepLabels]:
    """Return the labels of all sweeps in a table, in the order of their first rows.

    Raises
    ------
    InputError
        If a column is missing, or a cell is not a finite number.
    """
    for name in options.columns:
        if name not in (*REQUIRED, *OPTIONAL):
            raise InputError("--columns", f"unknown value {name!r}", f"Use {', '.join((*REQUIRED, *OPTIONAL))}.")
    column = {name: options.columns.get(name, name) for name in (*REQUIRED, *OPTIONAL)}
    present: set[str] = set()

    def check_header(names: list[str]) -> list[str]:
        present.update(names)
        missing = [column[name] for name in REQUIRED if column[name] not in present]
        if missing:
            raise InputError(f"{path}: header", f"expected the columns {', '.join(missing)}, got others", _HINT)
        for one_of, most in ((("sweep", "time_s"), 2), (("yaw_deg", "yaw_rad"), 1)):
            if not 1 <= sum(column[name] in present for name in one_of) <= most:
                expected = " or ".join(column[name] for name in one_of)
                raise InputError(f"{path}: header", f"expected one of the columns {expected}", _HINT)
        return names

    table = spreadsheets.parse_rows(path, check_header, lambda where, cells: [(where, cells)])
    is_named, is_timed, is_scored = (column[name] in present for name in ("sweep", "time_s", "score"))
    rows: dict[str, list[_Row]] = {}
    for where, cells in table:

        def number(name: str, where: str = where, cells: Mapping[str, str] = cells) -> float:
            return _number(where, column[name], cells[column[name]])

        in_degrees = column["yaw_deg"] in present
        yaw_rad = math.radians(number("yaw_deg")) if in_degrees else number("yaw_rad")
        time_s = number("time_s") if is_timed else math.nan
        key = sweep_name(cells[column["sweep"]]) if is_named else cells[column["time_s"]]
        of_sweep = rows.setdefault(key, [])
        of_sweep.append(
            _Row(
                cells.get(column["id"]) or f"{key}-{len(of_sweep)}",
                label_class(cells[column["type"]]),
                [*map(number, SIZES), yaw_rad],
                time_s,
                number("score") if is_scored else math.nan,
            )
        )

    labels = []
    for key, of_sweep in rows.items():
        names, classes, boxes, times_s, scores = zip(*of_sweep, strict=True)
        labels.append(
            SweepLabels(
                path, key if is_named else "", names, classes, np.array(boxes), time_s=times_s[0],
                has_tracks=column["id"] in present, states_yaw=False, scores=np.array(scores) if is_scored else None,
            )
        )  # fmt: skip
    return labels


class _Row(NamedTuple):
    """A box: object, class, centre, sizes and heading, time, score."""

    name: str
    cls: str
    box: list[float]
    time_s: float
    score: float


def _number(where: str, name: str, text: str) -> float:
    value = number_or_nan(text, parse_decimal)
    if not math.isfinite(value):
        raise InputError(f"{where}: {name}", f"expected a finite number, got {text[:80]!r}", "Correct the cell.")
    return value
