"""Read columns of Parquet and Feather (Arrow IPC) files, in a process of its own.

A few bytes of such a file may stand for gigabytes: values that repeat, and sizes that are not true. The other process
(:mod:`egvs.formats.reader_process`) has a limit of memory; texts stay encoded on the way, so that a long one that
occurs in each row is passed on once for each batch.
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

PARQUET_START, FEATHER_START = b"PAR1", b"ARROW1"
_BATCH_ROWS = 65_536


@dataclass(frozen=True)
class ArrowHeader:
    """What a file says of its content.

    Attributes
    ----------
    columns
        Names, in the order of the file.
    metadata
        Texts by key, without values that are not UTF-8.
    rows
        Number of rows; None for a Feather file, which does not say it.
    packed_bytes
        Size of the compressed columns; None for a Feather file.
    """

    columns: tuple[str, ...]
    metadata: dict[str, str]
    rows: int | None
    packed_bytes: int | None


def read_header(path: Path, doing: str, where: str = "") -> ArrowHeader:
    """Return the header of a file; InputError at ``where``, which is the path by default, when it is damaged."""
    blocks = _blocks(path, doing, where, None, ())
    try:
        return _header(next(blocks))
    except StopIteration:
        raise InputError(where or path, doing, COMPLETE_FILE) from None
    finally:
        blocks.close()


def read_batches(
    path: Path, doing: str, columns: Sequence[str], texts: Sequence[str] = (), where: str = ""
) -> Iterator[pa.RecordBatch]:
    """Yield the rows of a file in batches.

    Parameters
    ----------
    path
        The file.
    doing
        What failed, for messages, e.g. "cannot be read as Parquet".
    columns
        Names of the columns to read, all of which exist.
    texts
        Those of them whose values stay encoded as a dictionary, in Parquet files.
    where
        The file, for messages; the path by default.

    Raises
    ------
    InputError
        When the file is damaged, a text is not UTF-8, or it needs too much memory or time.
    """
    import pyarrow as pa

    blocks = _blocks(path, doing, where, columns, texts)
    try:
        next(blocks, None)  # the header
        for block in blocks:
            with pa.ipc.open_stream(block.content) as stream:
                for batch in stream:
                    batch.validate(full=True)
                    yield batch
    except (pa.ArrowException, UnicodeDecodeError) as error:
        raise InputError(where or path, f"{doing} ({error})", COMPLETE_FILE) from None
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


def _blocks(
    path: Path, doing: str, where: str, columns: Sequence[str] | None, texts: Sequence[str]
) -> Generator[Block, None, None]:
    limits.checked_size(path, limits.FILE, where)
    arguments = [json.dumps([None if columns is None else list(columns), list(texts)])]
    return read_blocks(__name__, path, where or os.fspath(path), doing, arguments)


def _header(block: Block) -> ArrowHeader:
    values = json.loads(bytes(block.content))
    return ArrowHeader(tuple(values["columns"]), values["metadata"], values["rows"], values["packed_bytes"])


# --- in the other process ---


def _read_file(path: Path) -> Iterator[Block]:
    columns, texts = json.loads(sys.argv[2])
    with path.open("rb") as file:
        is_parquet = file.read(len(PARQUET_START)) == PARQUET_START
    read = _read_parquet if is_parquet else _read_feather
    yield from read(path, columns, texts)


def _read_parquet(path: Path, columns: list[str] | None, texts: list[str]) -> Iterator[Block]:
    import pyarrow.parquet as pq

    with pq.ParquetFile(path, read_dictionary=texts, pre_buffer=False) as file:
        groups = [file.metadata.row_group(number) for number in range(file.metadata.num_row_groups)]
        packed = sum(group.column(i).total_compressed_size for group in groups for i in range(group.num_columns))
        yield _header_block(file.schema_arrow.names, file.metadata.metadata, file.metadata.num_rows, packed)
        if columns is not None:
            for batch in file.iter_batches(_BATCH_ROWS, columns=columns, use_threads=False):
                yield _batch_block(batch.select(columns))


def _read_feather(path: Path, columns: list[str] | None, _texts: list[str]) -> Iterator[Block]:
    import pyarrow as pa

    with pa.OSFile(str(path)) as source:
        with pa.ipc.open_file(source) as file:
            schema = file.schema
        yield _header_block(schema.names, schema.metadata, None, None)
        if columns is None:
            return
        fields = [schema.names.index(name) for name in columns]
        options = pa.ipc.IpcReadOptions(use_threads=False, included_fields=fields)
        source.seek(0)
        file = pa.ipc.open_file(source, options=options)
        for number in range(file.num_record_batches):
            yield _batch_block(file.get_batch(number).select(columns))


def _header_block(
    columns: list[str], metadata: dict[bytes, bytes] | None, rows: int | None, packed_bytes: int | None
) -> Block:
    texts = {}
    for key, value in (metadata or {}).items():
        with suppress(UnicodeDecodeError):
            texts[key.decode()] = value.decode()
    values = {"columns": columns, "metadata": texts, "rows": rows, "packed_bytes": packed_bytes}
    return Block({}, json.dumps(values).encode())


def _batch_block(batch: pa.RecordBatch) -> Block:
    import pyarrow as pa

    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, batch.schema) as stream:
        stream.write_batch(batch)
    return Block({}, memoryview(sink.getvalue()).cast("B"))


if __name__ == "__main__":
    serve(_read_file)
