"""Changes of a file that know its format, so that what comes of it is whole, but says something else.

Elements of XML, values of JSON, columns of tables, rows of SQLite, fields of headers: one is removed, repeated, nested,
moved, or gets a hostile value; then the file is written again with correct lengths and checksums.
"""

from __future__ import annotations

import io
import json
import random
import re
import sqlite3
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from typing import Any

Change = Callable[[random.Random, bytes], bytes]
Inner = Callable[[random.Random, bytes], bytes]

_TAG = re.compile(r"<(/?)([A-Za-z_][\w:.-]*)((?:[^<>\"']|\"[^\"]*\"|'[^']*')*?)(/?)>")
_ATTRIBUTE = re.compile(r"(?<![\w:.-])([\w:.-]+)\s*=\s*(\"[^\"]*\"|'[^']*')")
_MOST_ELEMENTS = 20_000

HOSTILE_TEXTS = (
    "nan", "-inf", "1e308", "-1e308", "1e-320", "0", "-1", "-0", "4294967296", "9223372036854775807", "1e9", "", " ",
    "true", "null", "../../x", "/etc/passwd", "é", "x" * 5000, "1 2", "1,2", "a:b", "#", "$HOME", "\u202e",
)  # fmt: skip
_HOSTILE_VALUES: tuple[Any, ...] = (
    None, True, 0, -1, 1, 2**31, 2**63, 10**40, 1e308, -1e308, 1e-320, 0.5, float("nan"), float("inf"), "", "x", "1",
    "nan", [], {}, [[]], [None], {"": None}, ["a"], [0] * 3, [1e308] * 3, "x" * 5000, "/etc/passwd",
)  # fmt: skip


# ---- XML


def change_xml(rng: random.Random, data: bytes) -> bytes:
    """Change an element or an attribute; the document stays well-formed."""
    text = data.decode("utf-8", "surrogateescape")
    elements = list(_elements(text))
    if not elements:
        return data
    return rng.choice((_element, _attribute, _attribute))(rng, text, elements).encode("utf-8", "surrogateescape")


def _elements(text: str) -> Iterator[tuple[int, int, int, int]]:
    """Yield the begin and end of elements, and those of what is inside."""
    opened: list[tuple[str, int, int]] = []
    for number, tag in enumerate(_TAG.finditer(text)):
        if number > _MOST_ELEMENTS:
            return
        closing_tag, name, _, empty = tag.groups()
        if empty:
            yield tag.start(), tag.end(), tag.end(), tag.end()
        elif not closing_tag:
            opened.append((name, tag.start(), tag.end()))
        elif opened and opened[-1][0] == name:
            _, begin, inside = opened.pop()
            yield begin, tag.end(), inside, tag.start()


def _element(rng: random.Random, text: str, elements: list[tuple[int, int, int, int]]) -> str:
    begin, end, inside, inside_end = rng.choice(elements)
    element, content = text[begin:end], text[inside:inside_end]
    other = text[slice(*rng.choice(elements)[:2])][:20_000]
    match rng.randrange(7):
        case 0:
            new = ""
        case 1:
            new = element * rng.choice((2, 3, 400 if len(element) < 5000 else 2))
        case 2:
            new = other
        case 3:
            new = element + other
        case 4 if inside < inside_end:
            new = text[begin:inside] + rng.choice(HOSTILE_TEXTS).replace("&", "") + text[inside_end:end]
        case 5 if inside < inside_end:
            depth = rng.choice((1, 60, 3000 if inside - begin < 100 else 60))
            new = text[begin:inside] * depth + content + text[inside_end:end] * depth
        case _ if inside < inside_end:
            new = text[begin:inside] + text[inside_end:end]
        case _:
            new = element + element
    return text[:begin] + new + text[end:]


def _attribute(rng: random.Random, text: str, elements: list[tuple[int, int, int, int]]) -> str:
    """Give an attribute another value: a hostile one, or that of another attribute; or remove it."""
    places = [match for match in _ATTRIBUTE.finditer(text) if match.start() < 1_000_000]
    if not places:
        return _element(rng, text, elements)
    chosen = rng.choice(places)
    if rng.random() < 0.15:
        return text[: chosen.start()] + text[chosen.end() :]
    if rng.random() < 0.4:
        same = [place for place in places if place[1] == chosen[1]]
        value = rng.choice(same if rng.random() < 0.5 else places)[2]
    else:
        value = f'"{rng.choice(HOSTILE_TEXTS)}"'
    return text[: chosen.start(2)] + value + text[chosen.end(2) :]


# ---- JSON


def change_json(rng: random.Random, data: bytes) -> bytes:
    """Change a value; JSON lines each for themselves."""
    text = data.decode()
    lines = text.splitlines(keepends=True)
    with suppress(ValueError):
        return json.dumps(_changed_value(rng, json.loads(text))).encode()
    number = rng.randrange(len(lines))
    lines[number] = json.dumps(_changed_value(rng, json.loads(lines[number]))) + "\n"
    return "".join(lines).encode()


def _changed_value(rng: random.Random, value: Any) -> Any:
    """Change a member somewhere inside of a value."""
    places = list(holders(value))
    if not places:
        return rng.choice(_HOSTILE_VALUES)
    holder, key = rng.choice(places)
    other_holder, other = rng.choice(places)
    match rng.randrange(7):
        case 0:
            del holder[key]
        case 1:
            holder[key] = json.loads(json.dumps(other_holder[other]))
        case 2 if isinstance(holder, list):
            holder[key : key + 1] = [holder[key]] * rng.choice((2, 3, 300))
        case 3:
            holder[key] = [holder[key]]
        case 4 if isinstance(holder, dict):
            holder[rng.choice(("", "x", str(other), "é"))] = holder.pop(key)
        case _:
            holder[key] = rng.choice(_HOSTILE_VALUES)
    return value


def holders(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each list or dictionary inside of a value with each of its keys."""
    keys = value.keys() if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    for key in keys:
        yield value, key
        yield from holders(value[key])


# ---- tables


def change_table(rng: random.Random, data: bytes) -> bytes:
    """Change a column or a cell of a table of text, of which one line is the header."""
    lines = data.decode().splitlines()
    sign = ";" if lines and lines[0].count(";") > lines[0].count(",") else ","
    rows = [line.split(sign) for line in lines]
    width = max(map(len, rows), default=0)
    if not width:
        return data
    one, other = rng.randrange(width), rng.randrange(width)
    row = rng.choice(rows)
    if one >= len(row):
        return data + sign.encode()
    match rng.randrange(8):
        case 0:
            rows = [[cell for number, cell in enumerate(cells) if number != one] for cells in rows]
        case 1:
            rows = [[*cells, cells[one]] if one < len(cells) else cells for cells in rows]
        case 2:
            for cells in rows:
                if max(one, other) < len(cells):
                    cells[one], cells[other] = cells[other], cells[one]
        case 3:
            row[one] = row[min(other, len(row) - 1)]
        case 4:
            rows = [[cell.replace(".", ",") for cell in cells] for cells in rows]
            sign = rng.choice((";", ",", "\t"))
        case 5:
            for cells in rows[1:]:
                if one < len(cells):
                    cells[one] = "0"
        case _:
            row[one] = rng.choice(HOSTILE_TEXTS)
    return "\n".join(sign.join(cells) for cells in rows).encode() + b"\n"


def change_arrow(rng: random.Random, data: bytes) -> bytes:
    """Change a column of a Parquet or Feather file: its name, type, values or metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq
    from pyarrow import feather

    is_parquet = data.startswith(b"PAR1")
    table = (pq if is_parquet else feather).read_table(pa.BufferReader(data))
    number = rng.randrange(table.num_columns)
    name, column = table.column_names[number], table.column(number)
    match rng.randrange(9):
        case 0:
            table = table.remove_column(number)
        case 1:
            table = table.append_column(rng.choice((name, "x", "")), column)
        case 2:
            names = table.column_names
            names[number] = rng.choice((*names, "é", "x" * 2000))
            table = table.rename_columns(names)
        case 3:
            table = table.set_column(number, name, pa.nulls(table.num_rows, column.type))
        case 4:
            kind = rng.choice((pa.string(), pa.large_string(), pa.binary(), pa.int64(), pa.float32(), pa.uint8()))
            table = table.set_column(number, name, column.cast(kind, safe=False))
        case 5:
            lists = pa.array([[value] for value in column.to_pylist()], pa.list_(column.type))
            table = table.set_column(number, name, lists)
        case 6:
            table = table.slice(0, rng.choice((0, 1, table.num_rows // 2)))
        case 7:
            metadata = dict(table.schema.metadata or {})
            for key in list(metadata):
                with suppress(ValueError):
                    value = metadata[key]
                    metadata[key] = rng.choice((b"", value[: len(value) // 2], change_json(rng, value)))
            table = table.replace_schema_metadata(metadata)
        case _:
            values = column.to_pylist()
            hostile = [None, 0, -1, 2**31 - 1, 1e308, float("nan"), float("inf"), "", "x" * 2000, b"", b"\xff" * 9]
            for row in [rng.randrange(len(values)) for _ in range(rng.choice((1, 1, 5)) if values else 0)]:
                values[row] = rng.choice(hostile)
            table = table.set_column(number, name, pa.array(values, column.type))
    output = io.BytesIO()
    if is_parquet:
        pq.write_table(table, output, compression=rng.choice(("snappy", "zstd", "none")))
    else:
        feather.write_feather(table, output, compression=rng.choice(("lz4", "zstd", "uncompressed")))
    return output.getvalue()


def change_sqlite(rng: random.Random, data: bytes) -> bytes:
    """Change a row, a table or the settings of a SQLite database, such as a GeoPackage."""
    with closing(sqlite3.connect(":memory:")) as base:
        base.deserialize(data)
        names = [row[0] for row in base.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name")]
        table = rng.choice(names)
        columns = [row[1] for row in base.execute(f'PRAGMA table_info("{table}")')]
        column = rng.choice(columns)
        rows = [row[0] for row in base.execute(f'SELECT rowid FROM "{table}"')] or [0]
        hostile = (None, 0, -1, 2**63 - 1, 1e308, "", "x" * 3000, "nan", b"", b"GP\x00\x01", "/etc/passwd", "é")
        match rng.randrange(8):
            case 0:
                base.execute(f'DROP TABLE "{table}"')
            case 1:
                base.execute(f'DELETE FROM "{table}"')
            case 2:
                base.execute(f'ALTER TABLE "{table}" RENAME TO "{rng.choice(("x", "é", "rtree_x"))}"')
            case 3:
                base.execute(f'ALTER TABLE "{table}" RENAME COLUMN "{column}" TO "{rng.choice(("x", "geom2", "é"))}"')
            case 4:
                base.execute(f"PRAGMA application_id = {rng.choice((0, 1, 2**31 - 1))}")
            case 5:
                old = base.execute(f'SELECT "{column}" FROM "{table}"').fetchall()
                values = [value for (value,) in old if isinstance(value, bytes) and value]
                if values:
                    changed = bytearray(rng.choice(values))
                    changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
                    base.execute(f'UPDATE "{table}" SET "{column}" = ?', (bytes(changed),))
            case _:
                row = rng.choice(rows)
                base.execute(f'UPDATE "{table}" SET "{column}" = ? WHERE rowid = ?', (rng.choice(hostile), row))
        base.commit()
        return base.serialize()


# ---- headers


def change_tiff(rng: random.Random, data: bytes) -> bytes:
    """Change an entry of the first directory of a TIFF: tag, type, count or value."""
    order = "<" if data.startswith(b"II") else ">"
    (start,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, start)
    at = start + 2 + 12 * rng.randrange(count)
    changed = bytearray(data)
    number = rng.choice((0, 1, 2, 255, 65535, 2**31 - 1, 2**32 - 1, rng.randrange(2**32)))
    match rng.randrange(4):
        case 0:
            struct.pack_into(f"{order}H", changed, at, rng.choice((256, 257, 258, 259, 277, 322, 339, 33550, 34735)))
        case 1:
            struct.pack_into(f"{order}H", changed, at + 2, rng.randrange(18))
        case part:
            struct.pack_into(f"{order}I", changed, at + 4 * (part - 1), number)
    return bytes(changed)


_LAS_FIELDS = (
    (6, "H"), (24, "B"), (25, "B"), (94, "H"), (96, "I"), (100, "I"), (104, "B"), (105, "H"), (107, "I"), (111, "I"),
    (131, "d"), (139, "d"), (147, "d"), (155, "d"), (163, "d"), (171, "d"), (179, "d"), (187, "d"), (219, "d"),
    (227, "Q"), (235, "Q"), (243, "I"), (247, "Q"),
)  # fmt: skip
"""Offset and type of the fields in the header of a LAS."""


def change_las(rng: random.Random, data: bytes) -> bytes:
    """Change a field of the header of a LAS or LAZ."""
    at, kind = rng.choice(_LAS_FIELDS)
    size = struct.calcsize(f"<{kind}")
    if kind == "d":
        value: float = rng.choice((0.0, -1.0, 1e308, 1e-308, float("nan"), float("inf"), 1e9))
    else:
        value = rng.choice((0, 1, 2, 255, rng.randrange(256**size), 256**size - 1)) % 256**size
    return data[:at] + struct.pack(f"<{kind}", value) + data[at + size :]


def change_glb(rng: random.Random, data: bytes) -> bytes:
    """Change the JSON of a GLB."""
    (size,) = struct.unpack_from("<I", data, 12)
    text = change_json(rng, data[20 : 20 + size])
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + rest


def change_head(rng: random.Random, data: bytes, inner: Inner) -> bytes:
    """Change the header, which is text, of a PLY or PCD file with binary points."""
    mark = b"end_header\n" if data.startswith(b"ply") else b"DATA "
    head, mark, body = data.partition(mark)
    return inner(rng, head) + mark + body


def change_pbf(rng: random.Random, data: bytes, inner: Inner) -> bytes:
    """Change the unpacked content of a block of an OpenStreetMap PBF."""
    blocks = []
    at = 0
    while at < len(data):
        (size,) = struct.unpack_from(">I", data, at)
        head = data[at + 4 : at + 4 + size]
        fields = dict(read_fields(head))
        end = at + 4 + size + int(fields[3])
        blocks.append((fields[1], data[at + 4 + size : end]))
        at = end
    chosen = rng.randrange(len(blocks))
    parts = []
    for number, (kind, blob) in enumerate(blocks):
        if number == chosen:
            fields = dict(read_fields(blob))
            content = inner(rng, fields[1] if 1 in fields else zlib.decompress(fields[3]))
            blob = b"\x10" + _varint(len(content)) + _bytes_field(3, zlib.compress(content))
        head = _bytes_field(1, kind) + b"\x18" + _varint(len(blob))
        parts += [struct.pack(">I", len(head)), head, blob]
    return b"".join(parts)


def change_protobuf(rng: random.Random, data: bytes) -> bytes:
    """Change a field of a message of protocol buffers, or of one inside it."""
    fields = list(read_fields(data))
    if not fields:
        return data
    chosen = rng.randrange(len(fields))
    parts = []
    for number, (key, value) in enumerate(fields):
        copies = 1
        if number == chosen:
            if isinstance(value, bytes) and len(value) > 1 and rng.random() < 0.7:
                with suppress(ValueError, IndexError):
                    value = change_protobuf(rng, value)
            elif rng.random() < 0.5:
                copies = rng.choice((0, 2, 300))
            elif isinstance(value, bytes):
                value = rng.choice((b"", value[: len(value) // 2], value * 2, b"\xff" * 9, rng.randbytes(4)))
            else:
                value = rng.choice((0, 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1, int(value) + 1))
        one = _bytes_field(key, value) if isinstance(value, bytes) else _varint(key << 3) + _varint(int(value))
        parts.append(one * copies)
    return b"".join(parts)


def read_fields(data: bytes) -> Iterator[tuple[int, Any]]:
    """Yield number and value of the fields of a message; ValueError for what has other kinds of fields."""
    at = 0
    while at < len(data):
        key, at = _read_varint(data, at)
        value, at = _read_varint(data, at)
        if key & 7 == 2:
            if at + value > len(data):
                raise ValueError("no message")
            yield key >> 3, data[at : at + value]
            at += value
        elif key & 7 == 0:
            yield key >> 3, value
        else:
            raise ValueError("no message")


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        value |= (data[at] & 127) << shift
        shift, at = shift + 7, at + 1
        if data[at - 1] < 128:
            return value, at


def _varint(value: int) -> bytes:
    parts = bytearray()
    while value > 127:
        parts.append(value & 127 | 128)
        value >>= 7
    return bytes([*parts, value])


def _bytes_field(number: int, value: bytes) -> bytes:
    return _varint(number << 3 | 2) + _varint(len(value)) + value
