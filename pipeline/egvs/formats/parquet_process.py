"""Read a GeoParquet file in a process of its own.

A few bytes of such a file may stand for gigabytes: values that repeat, and sizes that are not true. The other process
(:mod:`egvs.formats.reader_process`) has a limit of memory.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.reading import COMPLETE_FILE
from egvs.formats.reader_process import Block, read_blocks, serve

if TYPE_CHECKING:
    import pyarrow as pa

_BATCH_ROWS = 65_536


@dataclass(frozen=True)
class ParquetHeader:
    """What a file says of its content.

    Attributes
    ----------
    columns
        Names, in the order of the file.
    metadata
        Texts by key, without values that are not UTF-8.
    """

    columns: tuple[str, ...]
    metadata: dict[str, str]


@contextmanager
def open_parquet(path: Path, doing: str) -> Iterator[tuple[ParquetHeader, Iterator[pa.RecordBatch]]]:
    """Start to read a GeoParquet file.

    Parameters
    ----------
    path
        The file.
    doing
        What failed, for messages, e.g. "cannot be read as Parquet".

    Yields
    ------
    ParquetHeader
        What the file says of its content.
    iterator of pyarrow.RecordBatch
        Its rows, without the columns that repeat the bounds of each geometry.

    Raises
    ------
    InputError
        When the file is damaged, a text is not UTF-8, or it needs too much memory or time.
    """
    limits.checked_size(path, limits.FILE)
    blocks = read_blocks(__name__, path, os.fspath(path), doing)
    try:
        header = next(blocks, None)
        if header is None:
            raise InputError(path, doing, COMPLETE_FILE)
        values = json.loads(bytes(header.content))
        yield ParquetHeader(tuple(values["columns"]), values["metadata"]), _batches(blocks, path, doing)
    finally:
        blocks.close()


def _batches(blocks: Iterator[Block], path: Path, doing: str) -> Iterator[pa.RecordBatch]:
    import pyarrow as pa

    try:
        for block in blocks:
            with pa.ipc.open_stream(block.content) as stream:
                for batch in stream:
                    batch.validate(full=True)
                    yield batch
    except (pa.ArrowException, UnicodeDecodeError) as error:
        raise InputError(path, f"{doing} ({error})", COMPLETE_FILE) from None


def decoded_bytes(batch: pa.RecordBatch) -> int:
    """Return the size of a batch if no value were encoded as an entry of a dictionary."""
    import pyarrow as pa
    import pyarrow.compute as pc

    size = 0
    for array in batch.columns:
        size += array.nbytes
        if not pa.types.is_dictionary(array.type):
            continue
        values = array.dictionary
        if pa.types.is_binary(values.type) or pa.types.is_string(values.type):
            lengths = pc.binary_length(values)
            size += pc.sum(lengths.take(array.indices)).as_py() or 0
    return size


# --- in the other process ---


def _read_file(path: Path) -> Iterator[Block]:
    import pyarrow.parquet as pq

    with pq.ParquetFile(path, pre_buffer=False) as file:
        texts = {}
        for key, value in (file.metadata.metadata or {}).items():
            with suppress(UnicodeDecodeError):
                texts[key.decode()] = value.decode()
        names = file.schema_arrow.names
        yield Block({}, json.dumps({"columns": names, "metadata": texts}).encode())
        coverings = _covering_columns(texts.get("geo", ""))
        columns = [name for name in names if name not in coverings]
        for batch in file.iter_batches(_BATCH_ROWS, columns=columns, use_threads=False):
            yield _batch_block(batch.select(columns))


def _covering_columns(geo: str) -> set[str]:
    """Return the names of the columns that repeat the bounds of each geometry; none where the metadata are damaged.

    Source: GeoParquet 1.1, "covering": {"bbox": {"xmin": [column, "xmin"], ...}}.
    """
    try:
        columns = json.loads(geo)["columns"].values()
        return {path[0] for column in columns for path in column.get("covering", {}).get("bbox", {}).values()}
    except (ValueError, KeyError, TypeError, AttributeError, IndexError):
        return set()


def _batch_block(batch: pa.RecordBatch) -> Block:
    import pyarrow as pa

    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, batch.schema) as stream:
        stream.write_batch(batch)
    return Block({}, memoryview(sink.getvalue()).cast("B"))


if __name__ == "__main__":
    serve(_read_file)
