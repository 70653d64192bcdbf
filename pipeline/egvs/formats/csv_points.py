"""Read CSV files of points: a header row with ``x_m, y_m, z_m`` in any order, then one return per row.

Further columns are ignored. World frame, metres.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv

from egvs.core.digests import open_input
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.formats.point_clouds import NUMBER_HINT, parse_float, stack_xyz

_COLUMNS = ("x_m", "y_m", "z_m")
_MAX_COLUMNS = 10_000
_HINT = "Write a header row with x_m, y_m, z_m, then one return per row."


def read(path: Path, where: str) -> FloatArray:
    """Return all points, (n, 3) float64; InputError at ``where`` for a damaged file."""
    with open_input(path) as file:
        data = file.read().removeprefix(b"\xef\xbb\xbf")
    head, _, body = data.partition(b"\n")
    names = _column_names(where, head)
    if not body.strip():
        return np.empty((0, 3))

    # Columns are read by number, because further ones may share a name or have none.
    xyz = [str(names.index(name)) for name in _COLUMNS]
    options = pa.csv.ReadOptions(column_names=[str(i) for i in range(len(names))])
    types = dict.fromkeys(xyz, pa.float64())
    convert = pa.csv.ConvertOptions(column_types=types, include_columns=xyz, null_values=[])
    try:
        table = pa.csv.read_csv(pa.py_buffer(body), options, convert_options=convert)
    except pa.ArrowInvalid as error:
        raise _row_error(where, body, names, str(error)) from None
    return stack_xyz([table[name].to_numpy() for name in xyz])


def _column_names(where: str, head: bytes) -> list[str]:
    """Parse the header row; InputError unless it has each of x_m, y_m and z_m once."""
    try:
        header = next(csv.reader([head.decode("latin-1").rstrip("\r")], skipinitialspace=True), [])
    except csv.Error as error:
        raise InputError(where, f"cannot be read as CSV ({error})", _HINT) from None
    names = [name.strip() for name in header]
    if len(names) > _MAX_COLUMNS:
        raise InputError(where, f"expected at most {_MAX_COLUMNS:,} columns, got {len(names):,}", _HINT)
    for name in _COLUMNS:
        if names.count(name) != 1:
            raise InputError(where, f"expected exactly one column {name!r}, got {', '.join(names) or 'none'}", _HINT)
    return names


def _row_error(where: str, body: bytes, names: list[str], error: str) -> InputError:
    """Return the error for the first row that is wrong, which Arrow's message does not name."""
    rows = csv.reader(io.StringIO(body.decode("latin-1"), newline=""))
    try:
        for row in rows:
            row_where = f"{where}: line {rows.line_num + 1}"
            if row and len(row) != len(names):
                return InputError(row_where, f"expected {len(names)} values, one per column, got {len(row)}", _HINT)
            for name, text in zip(names, row, strict=bool(row)):
                if name in _COLUMNS and parse_float(text) is None:
                    return InputError(f"{row_where}: {name}", f"expected a number, got {text!r}", NUMBER_HINT)
    except csv.Error:
        pass  # Arrow's message describes it
    return InputError(where, f"cannot be read as CSV ({error.splitlines()[0]})", _HINT)
