"""Read columns of a Parquet file in a process of its own.

A few bytes of such a file may stand for gigabytes: values that repeat, and sizes that are not true. The other process
(:mod:`egvs.formats.reader_process`) has a limit of memory.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Generator, Iterator, Sequence
from contextlib import suppress
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


def read_header(path: Path, doing: str) -> ParquetHeader:
    """Return the header of a file; InputError, with ``doing`` for what failed, when it is damaged."""
    blocks = _blocks(path, doing, None)
    try:
        values = json.loads(bytes(next(blocks).content))
    except StopIteration:
        raise InputError(path, doing, COMPLETE_FILE) from None
    finally:
        blocks.close()
    return ParquetHeader(tuple(values["columns"]), values["metadata"])


def read_batches(path: Path, doing: str, columns: Sequence[str]) -> Iterator[pa.RecordBatch]:
    """Yield the rows of a file in batches.

    Parameters
    ----------
    path
        The file.
    doing
        What failed, for messages, e.g. "cannot be read as Parquet".
    columns
        Names of the columns to read, all of which exist.

    Raises
    ------
    InputError
        When the file is damaged, a text is not UTF-8, or it needs too much memory or time.
    """
    import pyarrow as pa

    blocks = _blocks(path, doing, columns)
    try:
        next(blocks, None)  # the header
        for block in blocks:
            with pa.ipc.open_stream(block.content) as stream:
                for batch in stream:
                    batch.validate(full=True)
                    yield batch
    except (pa.ArrowException, UnicodeDecodeError) as error:
        raise InputError(path, f"{doing} ({error})", COMPLETE_FILE) from None
    finally:
        blocks.close()


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


def _blocks(path: Path, doing: str, columns: Sequence[str] | None) -> Generator[Block, None, None]:
    limits.checked_size(path, limits.FILE)
    arguments = [json.dumps(None if columns is None else list(columns))]
    return read_blocks(__name__, path, os.fspath(path), doing, arguments)


# --- in the other process ---


def _read_file(path: Path) -> Iterator[Block]:
    import pyarrow.parquet as pq

    columns = json.loads(sys.argv[2])
    with pq.ParquetFile(path, pre_buffer=False) as file:
        yield _header_block(file.schema_arrow.names, file.metadata.metadata)
        if columns is not None:
            for batch in file.iter_batches(_BATCH_ROWS, columns=columns, use_threads=False):
                yield _batch_block(batch.select(columns))


def _header_block(columns: list[str], metadata: dict[bytes, bytes] | None) -> Block:
    texts = {}
    for key, value in (metadata or {}).items():
        with suppress(UnicodeDecodeError):
            texts[key.decode()] = value.decode()
    return Block({}, json.dumps({"columns": columns, "metadata": texts}).encode())


def _batch_block(batch: pa.RecordBatch) -> Block:
    import pyarrow as pa

    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, batch.schema) as stream:
        stream.write_batch(batch)
    return Block({}, memoryview(sink.getvalue()).cast("B"))


if __name__ == "__main__":
    serve(_read_file)
