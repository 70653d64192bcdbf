"""Read columns of Parquet and Feather (Arrow IPC) files by name, with limits on what a file may ask for."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from egvs.core import limits, reading
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.formats import arrow_bounds

if TYPE_CHECKING:
    import pyarrow as pa

_PARQUET, _FEATHER = b"PAR1", b"ARROW1"
_HINT = "Use the file as it was published."


def column_names(path: Path, head: bytes) -> set[str]:
    """Return the columns of a Parquet or Feather file; none if it is another file or damaged."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with reading.translate_errors(path):
            if head.startswith(_PARQUET):
                return set(pq.read_schema(path).names)
            if head.startswith(_FEATHER):
                with pa.OSFile(str(path)) as file:
                    return set(pa.ipc.open_file(file).schema.names)
    except InputError:
        pass
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
        limits.checked_size(path, limits.FILE)
        with reading.translate_errors(path, _HINT, "cannot be read as Parquet or Feather"):
            with path.open("rb") as file:
                is_parquet = file.read(len(_PARQUET)) == _PARQUET
            read_batches = _parquet_batches if is_parquet else _feather_batches
            batches = list(read_batches(path, texts, [*texts, *numbers], optional))
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
        import pyarrow as pa

        column = self._column(name)
        kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
        if not (pa.types.is_string(kind) or pa.types.is_large_string(kind)):
            raise InputError(f"{self.path}: {name}", f"expected texts, got values of type {kind}", _HINT)
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


def _parquet_batches(
    path: Path, texts: Sequence[str], names: Sequence[str], optional: Collection[str]
) -> Iterator[pa.RecordBatch]:
    import pyarrow.parquet as pq

    # Texts stay encoded: a long one that occurs in each row would otherwise fill the memory.
    with pq.ParquetFile(path, read_dictionary=list(texts)) as file:
        selected = _select(path, file.schema_arrow.names, names, optional)
        limits.ROWS.check(path, file.metadata.num_rows)
        size = sum(arrow_bounds.parquet_group_bytes(file, path, selected, path))
        limits.UNPACKED.check_bytes(path, size, f"has {size / limits.MB:,.0f} MB after decompression")
        for batch in file.iter_batches(columns=selected, use_threads=False):
            batch.validate(full=True)
            yield batch


def _feather_batches(
    path: Path, _texts: Sequence[str], names: Sequence[str], optional: Collection[str]
) -> Iterator[pa.RecordBatch]:
    import pyarrow as pa

    with pa.OSFile(str(path)) as source:
        with pa.ipc.open_file(source) as file:
            actual = file.schema.names
        selected = _select(path, actual, names, optional)
        with path.open("rb") as content:
            size = arrow_bounds.feather_bytes(content, path)
        limits.UNPACKED.check_bytes(path, size, f"has {size / limits.MB:,.0f} MB after decompression")
        options = pa.ipc.IpcReadOptions(use_threads=False, included_fields=[actual.index(name) for name in selected])
        source.seek(0)
        file = pa.ipc.open_file(source, options=options)
        rows = 0
        for index in range(file.num_record_batches):
            batch = file.get_batch(index)
            batch.validate(full=True)
            rows += batch.num_rows
            limits.ROWS.check(path, rows)
            yield batch


def _select(path: Path, actual: Sequence[str], names: Sequence[str], optional: Collection[str]) -> list[str]:
    """Return the requested columns that a file has; InputError when a required one is missing or occurs twice."""
    for name in names:
        count = actual.count(name)
        if count > 1 or (count == 0 and name not in optional):
            problem = f"expected a column {name!r}, got {', '.join(actual)[:200] or 'none'}"
            raise InputError(path, problem, _HINT)
    return [name for name in names if name in actual]
