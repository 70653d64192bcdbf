"""Read columns of Parquet and Feather (Arrow IPC) files by name, with limits on what a file may ask for."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from egvs.core import limits, reading
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.formats import arrow_files

if TYPE_CHECKING:
    import pyarrow as pa

_DOING = "cannot be read as Parquet or Feather"
_HINT = "Use the file as it was published."


def column_names(path: Path, head: bytes) -> set[str]:
    """Return the columns of a Parquet or Feather file; none if it is another file or damaged."""
    if not head.startswith((arrow_files.PARQUET_START, arrow_files.FEATHER_START)):
        return set()
    try:
        return set(arrow_files.read_header(path, _DOING).columns)
    except InputError:
        return set()


class ArrowTable:
    """Columns of a Parquet or Feather file.

    Parameters
    ----------
    path
        The file.
    texts, numbers
        Names of columns of texts and of numbers.
    optional
        Those of them that may be missing.

    Raises
    ------
    InputError
        When the file is damaged or too large, or a column is missing.
    """

    def __init__(
        self, path: Path, texts: Sequence[str], numbers: Sequence[str], optional: Collection[str] = ()
    ) -> None:
        import pyarrow as pa

        self.path = path
        header = arrow_files.read_header(path, _DOING)
        limits.ROWS.check(path, header.rows or 0)
        selected = _select(path, header.columns, [*texts, *numbers], optional)
        batches = []
        rows = size = 0
        for batch in arrow_files.read_batches(path, _DOING, selected, [name for name in texts if name in selected]):
            rows, size = rows + batch.num_rows, size + batch.nbytes
            limits.ROWS.check(path, rows)
            limits.UNPACKED.check_bytes(path, size)
            batches.append(batch)
        if not batches:
            raise InputError(path, "contains no rows", _HINT)
        self._table = pa.Table.from_batches(batches)

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return int(self._table.num_rows)

    def has(self, name: str) -> bool:
        """Return whether a column exists."""
        return name in self._table.column_names

    def texts(self, name: str) -> list[str]:
        """Return a column of texts; InputError for a missing one."""
        column = self._column(name)
        result: list[str] = []
        with reading.translate_errors(self.path, _HINT, f"{name} cannot be read"):
            for chunk in column.chunks:
                encoded = chunk if hasattr(chunk, "dictionary") else chunk.dictionary_encode()
                values = [str(value) for value in encoded.dictionary.to_pylist()]
                result += [values[index] for index in encoded.indices.to_pylist()]
        return result

    def numbers(self, name: str) -> FloatArray:
        """Return a column of numbers, (n,) float64; InputError for a missing or infinite one, NaN and other types."""
        import pyarrow as pa

        column = self._column(name)
        kind = column.type
        if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
            raise InputError(f"{self.path}: {name}", f"expected numbers, got values of type {kind}", _HINT)
        values = np.asarray(column.to_numpy(), dtype=np.float64)
        for row in np.flatnonzero(~np.isfinite(values)):
            raise self._error(int(row), name, f"expected a number, got {values[row]}")
        return values

    def _column(self, name: str) -> pa.ChunkedArray:
        column = self._table.column(name)
        if column.null_count:
            row = int(np.flatnonzero(column.is_null().to_numpy())[0])
            raise self._error(row, name, "is empty")
        return column

    def _error(self, row: int, name: str, problem: str) -> InputError:
        return InputError(f"{self.path}: row {row + 1}: {name}", problem, "Correct the row, or remove it.")


def _select(path: Path, actual: Sequence[str], names: Sequence[str], optional: Collection[str]) -> list[str]:
    """Return the requested columns that a file has; InputError when a required one is missing or occurs twice."""
    for name in names:
        count = actual.count(name)
        if count > 1 or (count == 0 and name not in optional):
            problem = f"expected a column {name!r}, got {', '.join(actual)[:200] or 'none'}"
            raise InputError(path, problem, _HINT)
    return [name for name in names if name in actual]
