"""How much memory a Parquet or Feather (Arrow IPC) file takes, from the headers of its parts, before they are unpacked.

The sums in the footer of a Parquet file need not be true; those before each compressed page are, since Arrow allocates
as much and compares. The same holds for the buffers of a Feather file. Two more ways to let a few bytes stand for many
are closed: columns with lists, and encodings in which a value repeats the one before it. A text of a dictionary is
counted once, so readers keep texts encoded, and :func:`decode_texts` limits their length.

References: https://github.com/apache/parquet-format (parquet.thrift; Thrift's compact protocol);
https://arrow.apache.org/docs/format/Columnar.html (File.fbs, Message.fbs); https://flatbuffers.dev/internals.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from egvs.core.errors import InputError
from egvs.core.reading import COMPLETE_FILE

if TYPE_CHECKING:
    import pyarrow as pa

MAX_TEXT_BYTES = 1000
"""Longest text of a column: the name of a vehicle or of its type."""

_MAX_PARTS = 1_000_000
"""Pages or buffers of a file; each takes some microseconds to read."""
_MAX_FIXED_BYTES = 32
_MAX_DEPTH = 8
_PLAIN_HINT = "Save it again with pyarrow or pandas, with their usual settings."

_ENCODINGS = {0: "PLAIN", 2: "PLAIN_DICTIONARY", 3: "RLE", 4: "BIT_PACKED", 5: "DELTA_BINARY_PACKED",
              6: "DELTA_LENGTH_BYTE_ARRAY", 8: "RLE_DICTIONARY", 9: "BYTE_STREAM_SPLIT"}  # fmt: skip
_REPEATING = {7: "DELTA_BYTE_ARRAY"}
"""Encodings by their number; those that are read, and one in which a value repeats the one before it."""
_KIND, _UNPACKED_SIZE, _PACKED_SIZE = 1, 2, 3
"""Fields of a PageHeader."""
_DICTIONARY_PAGE = 2
_ROW_GROUPS, _COLUMNS, _COLUMN_METADATA = 4, 1, 3
"""Fields of FileMetaData, of a RowGroup, and of a ColumnChunk."""
_PATH, _VALUES, _PACKED, _DATA_PAGE, _DICTIONARY_POSITION = 3, 5, 7, 9, 11
"""Fields of ColumnMetaData: its names, its number of values, its size in the file, and positions of pages."""
_KINDS = {0: (5, 2), _DICTIONARY_PAGE: (7, 2), 3: (8, 4)}
"""By kind of page (data, dictionary, data of version 2): the field of its own header, and the field in it with the
encoding; field 1 is the number of values."""


def parquet_group_bytes(file: Any, source: Path | IO[bytes], columns: Sequence[str], where: object) -> list[int]:
    """Return how many bytes some columns of each row group have after decompression.

    Parameters
    ----------
    file
        The open pyarrow.parquet.ParquetFile.
    source
        Its path, or its content.
    columns
        Names of the columns.
    where
        The file, for messages.

    Raises
    ------
    InputError
        When a column has lists, long binary values or an encoding that repeats values, or a page is damaged.
    """
    leaves = [
        index
        for index in range(len(file.schema))
        if any(file.schema.column(index).path.split(".")[0] == name.split(".")[0] for name in columns)
    ]
    for index in leaves:
        leaf = file.schema.column(index)
        is_wide = leaf.physical_type == "FIXED_LEN_BYTE_ARRAY" and not 0 < leaf.length <= _MAX_FIXED_BYTES
        if leaf.max_repetition_level or is_wide:
            problem = f"expected one number or text in each row, got {'long values' if is_wide else 'lists'}"
            raise InputError(f"{where}: {leaf.path}", problem, _PLAIN_HINT)
    with source.open("rb") if isinstance(source, Path) else nullcontext(source) as content:
        groups = read_parquet_groups(content)
        pages = _PageReader(content, where)
        return [sum(pages.column_bytes(group[index]) for index in leaves) for group in groups]


@dataclass(frozen=True)
class ColumnChunk:
    """The pages of a column in a row group, as the footer of a Parquet file describes them.

    Attributes
    ----------
    name
        Name of the column, with those of the groups that it is in.
    values
        Number of values, also of those that are missing.
    packed_bytes
        Size in the file.
    start
        Position of the first page.
    """

    name: str
    values: int
    packed_bytes: int
    start: int


def read_parquet_groups(file: IO[bytes]) -> list[list[ColumnChunk]]:
    """Return the columns of each row group from the footer of a Parquet file.

    Arrow's own description of a column, in Python, ends the program where its statistics are inconsistent.

    Raises
    ------
    ValueError, LookupError, TypeError, AttributeError
        When the footer is damaged.
    """
    end = file.seek(0, io.SEEK_END)
    size, magic = struct.unpack("<I4s", _read_at(file, end - 8, 8))
    if magic != b"PAR1":
        raise ValueError("it has no footer that can be read")
    footer = _read_thrift_struct(io.BytesIO(_read_at(file, end - 8 - size, size)))
    return [[_column_chunk(column[_COLUMN_METADATA]) for column in group[_COLUMNS]] for group in footer[_ROW_GROUPS]]


def _column_chunk(metadata: dict[int, Any]) -> ColumnChunk:
    name = ".".join(part.decode("utf-8", "replace") for part in metadata[_PATH])
    start, dictionary = metadata[_DATA_PAGE], metadata.get(_DICTIONARY_POSITION, 0)
    if 0 < dictionary < start:
        start = dictionary
    return ColumnChunk(name, metadata[_VALUES], metadata[_PACKED], start)


def decode_texts(column: pa.Array, where: object) -> pa.Array:
    """Return a column of texts that need not be encoded; InputError for long ones, of which each row may have one."""
    import pyarrow as pa
    import pyarrow.compute as pc

    if pa.types.is_dictionary(column.type):
        if not (pa.types.is_string(column.type.value_type) or pa.types.is_large_string(column.type.value_type)):
            raise InputError(where, f"expected texts, got {column.type.value_type}", _PLAIN_HINT)
        longest = pc.max(pc.binary_length(column.dictionary)).as_py() or 0
        if longest > MAX_TEXT_BYTES:
            problem = f"expected texts of at most {MAX_TEXT_BYTES:,} bytes, got {longest:,}"
            raise InputError(where, problem, "Use short names.")
        column = column.dictionary_decode()
    return pc.cast(column, pa.string())


def feather_bytes(file: IO[bytes], where: object) -> int:
    """Return how many bytes all buffers of a Feather file have after decompression.

    Parameters
    ----------
    file
        Its content.
    where
        The file, for messages.

    Raises
    ------
    ValueError, struct.error
        When the file is damaged.
    """
    end = file.seek(0, io.SEEK_END)
    footer_size, _ = struct.unpack("<i6s", _read_at(file, end - 10, 10))
    footer = _FlatTable.root(_read_at(file, end - 10 - footer_size, footer_size))
    size = parts = 0
    for field in (2, 3):  # dictionaries and record batches
        for offset, head_size, _ in footer.structs(field, "<qi4xq"):
            for buffer_size in _buffer_sizes(file, offset, head_size):
                size, parts = size + buffer_size, parts + 1
                _check_parts(parts, where)
    return size


def _buffer_sizes(file: IO[bytes], offset: int, head_size: int) -> Iterator[int]:
    """Yield the size of each buffer of a message after decompression; -1 before it says that it is not compressed."""
    head = _read_at(file, offset, head_size)
    is_marked = head.startswith(b"\xff\xff\xff\xff")  # since Arrow 0.15
    message = _FlatTable.root(head[8:] if is_marked else head[4:])
    batch = message.table(2)
    if message.number(1, "<B") == 2:  # a dictionary
        batch = batch.table(1)
    is_compressed = batch.has(3)
    for start, size in batch.structs(2, "<qq"):
        if is_compressed and size:
            unpacked = struct.unpack("<q", _read_at(file, offset + head_size + start, 8))[0]
            yield size if unpacked == -1 else max(0, unpacked)
        else:
            yield size


def _check_parts(parts: int, where: object) -> None:
    if parts > _MAX_PARTS:
        raise InputError(where, f"consists of more than {_MAX_PARTS:,} parts", _PLAIN_HINT)


def _read_at(file: IO[bytes], position: int, size: int) -> bytes:
    """Return bytes of a file; ValueError when it does not have them."""
    if size < 0 or not 0 <= position <= file.seek(0, io.SEEK_END):
        raise ValueError("a position in it is outside of it")
    file.seek(position)
    data = file.read(size)
    if len(data) < size:
        raise ValueError("it ends too early")
    return data


class _PageReader:
    """Reads the headers of pages, and skips their content."""

    def __init__(self, file: IO[bytes], where: object) -> None:
        self._file, self._where, self._pages = file, where, 0

    def column_bytes(self, chunk: ColumnChunk) -> int:
        """Return how many bytes the pages of a column have after decompression."""
        position = chunk.start
        size = values = 0
        while values < chunk.values:
            self._pages += 1
            _check_parts(self._pages, self._where)
            self._file.seek(position)
            header = _read_thrift_struct(self._file)
            unpacked, packed = header.get(_UNPACKED_SIZE, -1), header.get(_PACKED_SIZE, -1)
            if min(unpacked, packed) < 0:
                raise InputError(f"{self._where}: {chunk.name}", "a page has no size", COMPLETE_FILE)
            size += unpacked
            position = self._file.tell() + packed
            if header.get(_KIND) in _KINDS:
                own, encoding = _KINDS[header[_KIND]]
                self._check_encoding(header[own].get(encoding, 0), chunk)
                values += 0 if header[_KIND] == _DICTIONARY_PAGE else max(0, header[own].get(1, 0))
        return size

    def _check_encoding(self, encoding: int, chunk: ColumnChunk) -> None:
        if encoding not in _ENCODINGS:
            problem = f"the encoding {_REPEATING.get(encoding, encoding)} is not supported"
            raise InputError(f"{self._where}: {chunk.name}", problem, _PLAIN_HINT)


def _read_thrift_struct(file: IO[bytes], depth: int = 0) -> dict[int, Any]:
    """Return the integers, texts, lists and structures of a structure by field; other values are skipped."""
    if depth > _MAX_DEPTH:
        raise ValueError("it is nested too deeply")
    fields: dict[int, Any] = {}
    field = 0
    while kind := _read_byte(file):
        step, kind = kind >> 4, kind & 15
        field = field + step if step else _read_zigzag(file)
        value = _read_thrift_value(file, kind, depth)
        if value is not None:
            fields[field] = value
    return fields


def _read_thrift_value(file: IO[bytes], kind: int, depth: int) -> Any:
    match kind:
        case 1 | 2:  # a truth value, which is its kind
            return None
        case 3:
            return _read_byte(file)
        case 4 | 5 | 6:
            return _read_zigzag(file)
        case 7:
            file.seek(8, io.SEEK_CUR)
            return None
        case 8:
            size = _read_varint(file)
            text = file.read(size)
            if len(text) < size:
                raise ValueError("it ends too early")
            return text
        case 9 | 10:
            return _read_thrift_list(file, depth + 1)
        case 12:
            return _read_thrift_struct(file, depth + 1)
    raise ValueError(f"a page has a field of the type {kind}")


def _read_thrift_list(file: IO[bytes], depth: int) -> list[Any]:
    if depth > _MAX_DEPTH:
        raise ValueError("it is nested too deeply")
    head = _read_byte(file)
    kind, count = head & 15, head >> 4
    if count == 15:
        count = _read_varint(file)
    if kind in (1, 2):  # truth values, a byte each
        kind = 3
    return [_read_thrift_value(file, kind, depth) for _ in range(count)]


def _read_byte(file: IO[bytes]) -> int:
    byte = file.read(1)
    if not byte:
        raise ValueError("it ends too early")
    return byte[0]


def _read_varint(file: IO[bytes]) -> int:
    value = 0
    for shift in range(0, 70, 7):
        byte = _read_byte(file)
        value |= (byte & 127) << shift
        if byte < 128:
            return value
    raise ValueError("a number in it is too long")


def _read_zigzag(file: IO[bytes]) -> int:
    value = _read_varint(file)
    return (value >> 1) ^ -(value & 1)


class _FlatTable:
    """A table of a FlatBuffer: where its fields are stands in another table, at a distance before it."""

    def __init__(self, data: bytes, position: int) -> None:
        self._data, self._position = data, position
        self._fields = position - self._unpack("<i", position)

    @classmethod
    def root(cls, data: bytes) -> _FlatTable:
        """Return the table that a buffer begins with."""
        return cls(data, struct.unpack_from("<I", data)[0])

    def has(self, field: int) -> bool:
        """Return whether a field has a value."""
        return self._offset(field) > 0

    def number(self, field: int, form: str) -> int:
        """Return a number; 0 where it is left out."""
        return self._unpack(form, self._position + self._offset(field)) if self.has(field) else 0

    def table(self, field: int) -> _FlatTable:
        """Return a table; ValueError where it is left out."""
        return _FlatTable(self._data, self._follow(field))

    def structs(self, field: int, form: str) -> Iterator[tuple[int, ...]]:
        """Yield the structures of a list, which is empty where it is left out."""
        if not self.has(field):
            return
        start = self._follow(field)
        size = struct.calcsize(form)
        for number in range(self._unpack("<I", start)):
            yield struct.unpack_from(form, self._data, start + 4 + number * size)

    def _offset(self, field: int) -> int:
        entry = 4 + 2 * field
        return self._unpack("<H", self._fields + entry) if entry < self._unpack("<H", self._fields) else 0

    def _follow(self, field: int) -> int:
        if not self.has(field):
            raise ValueError("a part of it has no content")
        reference = self._position + self._offset(field)
        return reference + self._unpack("<I", reference)

    def _unpack(self, form: str, position: int) -> int:
        if position < 0:
            raise ValueError("a position in it is negative")
        value: int = struct.unpack_from(form, self._data, position)[0]
        return value
