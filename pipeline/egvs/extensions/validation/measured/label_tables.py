"""Read a table of labels, CSV with a header: one box in a row, in the sensor's frame.

Columns, each under its own name or the one that ``--columns`` maps it to: ``sweep`` (name of the sweep's file, with or
without suffix; or ``time_s``, for recordings), ``type``, ``x_m``, ``y_m``, ``z_m`` (centre), ``length_m``, ``width_m``,
``height_m``, and ``yaw_deg`` or ``yaw_rad``; optionally ``id``, the same for an object in all sweeps. Nothing in such a
table says where headings count from: they are tested (:mod:`egvs.extensions.validation.measured.yaw_conventions`).
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from egvs.core.errors import InputError
from egvs.core.numbers import number_or_nan, parse_decimal
from egvs.formats import spreadsheets
from egvs.formats.sweep_labels import LabelOptions, SweepLabels, label_class, sweep_name

SIZES = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m")
REQUIRED = ("type", *SIZES)
OPTIONAL = ("sweep", "time_s", "yaw_deg", "yaw_rad", "id")

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
        for one_of in (("sweep", "time_s"), ("yaw_deg", "yaw_rad")):
            if sum(column[name] in present for name in one_of) != 1:
                expected = " or ".join(column[name] for name in one_of)
                raise InputError(f"{path}: header", f"expected one of the columns {expected}", _HINT)
        return names

    rows: dict[str, list[tuple[str, str, list[float]]]] = {}
    for where, cells in spreadsheets.parse_rows(path, check_header, lambda where, cells: [(where, cells)]):
        values = [_number(where, column[name], cells[column[name]]) for name in SIZES]
        if column["yaw_deg"] in present:
            values.append(math.radians(_number(where, column["yaw_deg"], cells[column["yaw_deg"]])))
        else:
            values.append(_number(where, column["yaw_rad"], cells[column["yaw_rad"]]))
        is_named = column["sweep"] in present
        key = sweep_name(cells[column["sweep"]]) if is_named else cells[column["time_s"]]
        if not is_named:
            _number(where, column["time_s"], key)
        of_sweep = rows.setdefault(key, [])
        name = cells.get(column["id"]) or f"{key}-{len(of_sweep)}"
        of_sweep.append((name, label_class(cells[column["type"]]), values))

    labels = []
    for key, of_sweep in rows.items():
        names, classes, boxes = zip(*of_sweep, strict=True)
        is_named = column["sweep"] in present
        labels.append(
            SweepLabels(
                path, key if is_named else "", names, classes, np.array(boxes),
                time_s=math.nan if is_named else float(key), has_tracks=column["id"] in present, states_yaw=False,
            )
        )  # fmt: skip
    return labels


def _number(where: str, name: str, text: str) -> float:
    value = number_or_nan(text, parse_decimal)
    if not math.isfinite(value):
        raise InputError(f"{where}: {name}", f"expected a finite number, got {text[:80]!r}", "Correct the cell.")
    return value
