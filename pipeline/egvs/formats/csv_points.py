"""Read CSV files of points: a header row with ``x_m, y_m, z_m`` in any order, then one return per row.

Of further columns, one that is asked for by name is read. World frame, metres.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv

from egvs.core.digests import open_input
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.formats.point_clouds import NUMBER_HINT, parse_float, stack_columns

_COLUMNS = ("x_m", "y_m", "z_m")
_MAX_COLUMNS = 10_000
_HINT = "Write a header row with x_m, y_m, z_m, then one return per row."


def read(path: Path, where: str) -> FloatArray:
    """Return all points, (n, 3) float64; InputError at ``where`` for a damaged file."""
    names, body = _split(path, where)
    return _read_columns(where, body, names, _COLUMNS)


def read_field(path: Path, where: str, names: Sequence[str]) -> FloatArray | None:
    """Return the first of these columns that the file has once, (n,) float64; None if it has none of them."""
    columns, body = _split(path, where)
    known = [name for name in names if columns.count(name) == 1]
    return _read_columns(where, body, columns, known[:1])[:, 0] if known else None


def _split(path: Path, where: str) -> tuple[list[str], bytes]:
    """Return the names of the columns, and the rows."""
    with open_input(path) as file:
        head, _, body = file.read().removeprefix(b"\xef\xbb\xbf").partition(b"\n")
    return _column_names(where, head), body


def _read_columns(where: str, body: bytes, names: list[str], read: Sequence[str]) -> FloatArray:
    if not body.strip():
        return np.empty((0, len(read)))

    # Columns are read by number, because further ones may share a name or have none.
    numbers = [str(names.index(name)) for name in read]
    options = pa.csv.ReadOptions(column_names=[str(i) for i in range(len(names))])
    types = dict.fromkeys(numbers, pa.float64())
    convert = pa.csv.ConvertOptions(column_types=types, include_columns=numbers, null_values=[])
    try:
        table = pa.csv.read_csv(pa.py_buffer(body), options, convert_options=convert)
    except pa.ArrowInvalid as error:
        raise _row_error(where, body, names, read, str(error)) from None
    return stack_columns([table[number].to_numpy() for number in numbers])


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


def _row_error(where: str, body: bytes, names: list[str], read: Sequence[str], error: str) -> InputError:
    """Return the error for the first row that is wrong, which Arrow's message does not name."""
    rows = csv.reader(io.StringIO(body.decode("latin-1"), newline=""))
    try:
        for row in rows:
            row_where = f"{where}: line {rows.line_num + 1}"
            if row and len(row) != len(names):
                return InputError(row_where, f"expected {len(names)} values, one per column, got {len(row)}", _HINT)
            for name, text in zip(names, row, strict=bool(row)):
                if name in read and parse_float(text) is None:
                    return InputError(f"{row_where}: {name}", f"expected a number, got {text!r}", NUMBER_HINT)
    except csv.Error:
        pass  # Arrow's message describes it
    return InputError(where, f"cannot be read as CSV ({error.splitlines()[0]})", _HINT)
