"""Read tables of recorded tracks (CSV, plain or gzipped) by the names of their columns."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egvs.core import reading
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.formats import xml

_HINT = "Use the file as it was published, with its header row."


@dataclass(frozen=True)
class Table:
    """Columns of a file, each with one text per row, stripped.

    Attributes
    ----------
    path
        The file.
    columns
        Texts of each column, by name.
    """

    path: Path
    columns: Mapping[str, Sequence[str]]

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return len(next(iter(self.columns.values()), ()))

    def texts(self, name: str) -> Sequence[str]:
        """Return the texts of a column."""
        return self.columns[name]

    def numbers(self, name: str) -> FloatArray:
        """Return the numbers of a column, (n,) float64; InputError for a text, an empty cell, infinity or NaN."""
        values = self.optional_numbers(name)
        for row in np.flatnonzero(np.isnan(values)):
            raise self.error(int(row), name, f"expected a number, got {self.columns[name][row]!r}")
        return values

    def optional_numbers(self, name: str) -> FloatArray:
        """Return the numbers of a column, NaN where a cell is empty or the column does not exist, (n,) float64."""
        if name not in self.columns:
            return np.full(self.n_rows, math.nan)
        texts = self.columns[name]
        try:
            values = np.array([text or "nan" for text in texts], dtype=np.str_).astype(np.float64)
        except ValueError:
            values = np.array([_to_float(text) for text in texts])
        is_empty = np.array([not text or text.lower() in ("nan", "none", "null") for text in texts], dtype=bool)
        for row in np.flatnonzero(~np.isfinite(values) & ~is_empty):
            raise self.error(int(row), name, f"expected a number, got {texts[row][:80]!r}")
        return np.where(is_empty, math.nan, values)

    def error(self, row: int, name: str, problem: str, hint: str = "Correct the row, or remove it.") -> InputError:
        """Return an error about a cell; rows count from 1, without the header."""
        return InputError(f"{self.path}: row {row + 1}: {name}", problem, hint)


def _to_float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.inf


def header(head: bytes, delimiter: str = ",") -> list[str]:
    """Return the names in the first line of a file, lower case and stripped, or [] if it is no text."""
    try:
        line = head.removeprefix(b"\xef\xbb\xbf").split(b"\n", 1)[0].decode("utf-8")
    except UnicodeDecodeError:
        return []
    return [name.strip().strip('"').lower() for name in line.split(delimiter)]


def has_columns(head: bytes, *names: str) -> bool:
    """Return whether the first line of a comma-separated file names all these columns, in any case."""
    return set(name.lower() for name in names) <= set(header(head))


def read_table(path: Path, required: Sequence[str], optional: Sequence[str] = (), delimiter: str = ",") -> Table:
    """Read columns of a CSV file.

    Parameters
    ----------
    path
        The file, plain or gzipped.
    required, optional
        Names of columns. Names in the file may differ in case. Other columns are not read.
    delimiter
        Between the cells of a row.

    Raises
    ------
    InputError
        When the file is damaged, a required column is missing, a wanted column occurs twice, a row has too few cells,
        or there is no row.
    """
    with reading.translate_errors(path, _HINT, "cannot be read as CSV"), xml.open_bounded(path) as file:
        lines = file.read().decode("utf-8-sig").splitlines()
    rows = csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
    with reading.translate_errors(path, _HINT, "cannot be read as CSV"):
        names = [name.strip() for name in next(rows, [])]
        positions = _positions(path, names, required, optional)
        cells: dict[str, list[str]] = {name: [] for name in positions}
        for row in rows:
            if not row:
                continue
            for name, position in positions.items():
                if position >= len(row):
                    where = f"{path}: line {rows.line_num}"
                    raise InputError(where, f"expected {len(names)} cells, got {len(row)}", "Complete the row.")
                cells[name].append(row[position].strip())
    table = Table(path, cells)
    if not table.n_rows:
        raise InputError(path, "contains no rows", _HINT)
    return table


def _positions(path: Path, names: list[str], required: Sequence[str], optional: Sequence[str]) -> dict[str, int]:
    """Return the position of each wanted column in the file."""
    lower = [name.lower() for name in names]
    positions: dict[str, int] = {}
    for name in (*required, *optional):
        count = lower.count(name.lower())
        if count > 1:
            raise InputError(path, f"the column {name!r} occurs {count} times", _HINT)
        if count:
            positions[name] = lower.index(name.lower())
        elif name in required:
            actual = ", ".join(names)[:200] or "none"
            raise InputError(path, f"expected a column {name!r}, got {actual}", _HINT)
    return positions
