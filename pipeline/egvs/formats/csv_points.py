"""CSV files of points are read: a header row with ``x_m, y_m, z_m`` in any order, then one return a row; further
columns are ignored. Frame: the world's, metres.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
from numpy.typing import NDArray

from egvs.core.errors import InputError
from egvs.formats.point_clouds import EXPECTED_NUMBER, parse_float, stack_xyz

_COLUMNS = ("x_m", "y_m", "z_m")
_MAX_COLUMNS = 10_000


def read(path: Path, where: str) -> NDArray[np.float64]:
    """All points, (n, 3) float64; a damaged file is an InputError at ``where``."""
    data = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    head, _, body = data.partition(b"\n")
    try:
        header = next(csv.reader([head.decode("latin-1").rstrip("\r")], skipinitialspace=True), [])
    except csv.Error as error:
        raise InputError(where, f"cannot be read as CSV ({error})", "a header row, then one return a row") from None
    names = [name.strip() for name in header]
    if len(names) > _MAX_COLUMNS:
        raise InputError(where, f"has {len(names):,} columns", f"at most {_MAX_COLUMNS:,}")
    for name in _COLUMNS:
        if names.count(name) != 1:
            right = f"a header row with {', '.join(_COLUMNS)}"
            raise InputError(where, f"has no single column {name!r} (its columns: {', '.join(names) or 'none'})", right)
    if not body.strip():
        return np.empty((0, 3))
    # Numbered, because further columns may share a name or have none.
    wanted = [str(names.index(name)) for name in _COLUMNS]
    read = pa.csv.ReadOptions(column_names=[str(i) for i in range(len(names))])
    types = dict.fromkeys(wanted, pa.float64())
    convert = pa.csv.ConvertOptions(column_types=types, include_columns=wanted, null_values=[])
    try:
        table = pa.csv.read_csv(pa.py_buffer(body), read, convert_options=convert)
    except pa.ArrowInvalid as error:
        raise _find_fault(where, body, names, str(error)) from None
    return stack_xyz([table[name].to_numpy() for name in wanted])


def _find_fault(where: str, body: bytes, names: list[str], error: str) -> InputError:
    """Find the first row that is wrong, which Arrow's own message does not name."""
    rows = csv.reader(io.StringIO(body.decode("latin-1"), newline=""))
    try:
        for row in rows:
            row_place = f"{where}: line {rows.line_num + 1}"
            if row and len(row) != len(names):
                return InputError(row_place, f"holds {len(row)} values", f"{len(names)}, one a column")
            for name, text in zip(names, row, strict=bool(row)):
                if name in _COLUMNS and parse_float(text) is None:
                    return InputError(f"{row_place}: {name}", f"{text!r} is no number", EXPECTED_NUMBER)
    except csv.Error:
        pass  # Arrow's message says it
    return InputError(where, f"cannot be read as CSV ({error.splitlines()[0]})", "a header row, then one return a row")
