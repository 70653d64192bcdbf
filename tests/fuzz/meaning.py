"""What a file says, read by other code than the program's, so that a mutant can be told from the file that it was.

Each reader returns a value that is equal for files that say the same, and raises one of DAMAGED for what is not whole.
It is asked only about mutants that the program made a ranking of.
"""

from __future__ import annotations

import csv
import gzip
import io
import json
import re
import struct
import tomllib
import zipfile
import zlib
from collections.abc import Callable, Sequence
from typing import Any
from xml.etree import ElementTree

Meaning = Callable[[bytes], object]

DAMAGED = (
    ValueError,
    EOFError,
    OSError,
    LookupError,
    RecursionError,
    zlib.error,
    struct.error,
    zipfile.BadZipFile,
    ElementTree.ParseError,
)
"""What a reader may raise: the file is not whole."""


_MOST_BYTES = 1 << 26


def bytes_themselves(data: bytes) -> object:
    """For kinds that no other code reads here: any change may be one of meaning."""
    return data


def nothing_else(data: bytes) -> object:
    """For what the program wrote itself: no other bytes may give another ranking."""
    raise ValueError("has other bytes than the program wrote")


def gzipped(inner: Meaning) -> Meaning:
    """The meaning of what is packed; a file that is not packed is taken as it is, as the program does."""

    def read(data: bytes) -> object:
        return inner(_unpacked(data) if data.startswith(b"\x1f\x8b") else data)

    return read


def _unpacked(data: bytes) -> bytes:
    """Without the memory that a bomb would take."""
    with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
        inner = file.read(_MOST_BYTES)
        if file.read(1):
            raise ValueError("is larger than any file here")
    return inner


def toml(data: bytes) -> object:
    """Values."""
    return json.dumps(tomllib.loads(data.decode()), sort_keys=True, default=str)


def text_json(data: bytes) -> object:
    """Values; a key that stands there twice is damage, NaN and Infinity only where they are read."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len({key for key, _ in pairs}) < len(pairs):
            raise ValueError("a key stands there twice")
        return dict(pairs)

    return json.dumps(json.loads(data.decode(), object_pairs_hook=once), sort_keys=True)


def xml(data: bytes) -> object:
    """Elements with their attributes; the text between them says nothing in SUMO's files."""
    if b"<!DOCTYPE" in data.upper():
        raise ValueError("declares a document type")
    events = ElementTree.iterparse(io.BytesIO(_utf8(data)), events=("start", "end"))
    return [(event, one.tag, sorted(one.attrib.items()) if event == "start" else None) for event, one in events]


def kml(data: bytes) -> object:
    """Elements with their texts and attributes."""
    return [xml(data), [one.text for one in ElementTree.fromstring(_utf8(data)).iter()]]


def _utf8(data: bytes) -> bytes:
    """As UTF-8, whatever encoding the file declares: expat knows no Shift_JIS."""
    head, mark, rest = data.partition(b"?>")
    if not mark or b"encoding" not in head or data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data
    name = head.split(b"encoding")[1].split(b'"' if b'"' in head.split(b"encoding")[1] else b"'")[1]
    return rest.decode(name.decode("ascii")).encode()


def rows(data: bytes) -> object:
    """Cells of a CSV in UTF-8, or in a spreadsheet's Windows-1252, each row as long as the header."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252")
    table = _cells(text)
    if any(len(row) != len(table[0]) for row in table):
        raise ValueError("rows of different lengths")
    return table


def _cells(text: str) -> list[list[str]]:
    """Cells of a CSV; between semicolons or tabs, a decimal comma is a point."""
    head = text.partition("\n")[0]
    mark = "," if "," in head else next((other for other in ";\t" if other in head), ",")
    rows = csv.reader(io.StringIO(text, newline=""), delimiter=mark)
    return [[cell.strip() if mark == "," else cell.strip().replace(",", ".") for cell in row] for row in rows if row]


def table(data: bytes) -> object:
    """Cells of a CSV, each row as long as the header, beside which only empty ones may stand."""
    lines = _cells(data.decode("utf-8-sig"))
    if any(len(row) < len(lines[0]) or any(row[len(lines[0]) :]) for row in lines):
        raise ValueError("rows of different lengths")
    return [row[: len(lines[0])] for row in lines]


def json_lines(data: bytes) -> object:
    """Values of each line; NaN is one."""
    lines = [line for line in data.decode("utf-8-sig").split("\n") if line.strip()]
    return [text_json(line.replace("NaN", "null").encode()) for line in lines]


def lenient_json(data: bytes) -> object:
    """Values, of which NaN and Infinity may be some that are not used."""
    return text_json(re.sub(rb"-?\b(NaN|Infinity)\b", b"null", data.removeprefix(b"\xef\xbb\xbf")))


def semicolons(data: bytes) -> object:
    """Cells of SUMO's CSV, separated by semicolons or commas."""
    text = data.decode("utf-8-sig")
    table = list(csv.reader(io.StringIO(text, newline=""), delimiter=";" if ";" in text.split("\n")[0] else ","))
    return [row for row in table if row]


def commas(data: bytes) -> object:
    """Cells of a CSV without a header."""
    return [row for row in csv.reader(io.StringIO(data.decode("utf-8-sig"), newline="")) if row]


def words(data: bytes) -> object:
    """Words of each line."""
    return [line.split() for line in data.decode().splitlines()]


def parquet(data: bytes, columns: Sequence[str] | None = None, optional: Sequence[str] = ()) -> object:
    """Columns and values; of some columns, and of optional ones that are there, if the others are not read."""
    import pyarrow
    import pyarrow.parquet as pq

    there = set(pq.read_schema(pyarrow.BufferReader(data)).names)
    wanted = columns and [*columns, *(name for name in optional if name in there)]
    return repr(pq.read_table(pyarrow.BufferReader(data), columns=wanted).to_pydict())


def feather(data: bytes) -> object:
    """Columns and values."""
    import pyarrow
    from pyarrow import feather as arrow_feather

    return repr(arrow_feather.read_table(pyarrow.BufferReader(data)).to_pydict())


def obj(data: bytes) -> object:
    """Vertices and faces of an OBJ; other lines say nothing of the shape."""
    lines = [line.split() for line in data.decode("utf-8", "replace").replace("\\\n", " ").splitlines()]
    vertices = [tuple(float(x) for x in line[1:4]) for line in lines if line[:1] == ["v"]]
    faces = [tuple(int(corner.split("/")[0]) for corner in line[1:]) for line in lines if line[:1] == ["f"]]
    if any(not 1 <= (i if i > 0 else len(vertices) + 1 + i) <= len(vertices) for face in faces for i in face):
        raise ValueError("a face names a vertex that is not there")
    return repr((vertices, faces))


def stl(data: bytes) -> object:
    """Triangles of a binary STL: as many as it says."""
    (count,) = struct.unpack_from("<I", data, 80)
    if len(data) < 84 + 50 * count:
        raise ValueError("holds fewer triangles than it says")
    return data[84 : 84 + 50 * count]


def glb(data: bytes) -> object:
    """Both chunks of a GLB."""
    magic, version, length = struct.unpack_from("<4sII", data)
    size, kind = struct.unpack_from("<I4s", data, 12)
    if magic != b"glTF" or version != 2 or length > len(data) or kind != b"JSON" or 20 + size > length:
        raise ValueError("its header says otherwise")
    return text_json(data[20 : 20 + size]), data[20 + size : length]


def ply(data: bytes) -> object:
    """Header and body of a PLY of points, in which each property is a number."""
    head, mark, body = data.partition(b"end_header\n")
    if not mark:
        raise ValueError("has no end of its header")
    lines = [line for line in head.decode("ascii").splitlines() if not line.startswith(("comment", "obj_info"))]
    return lines, body


def pcd(data: bytes) -> object:
    """Header without comments, and body."""
    head, mark, body = data.partition(b"DATA ")
    if not mark:
        raise ValueError("has no data")
    lines = [line for line in head.splitlines() if not line.startswith(b"#")]
    return [line.decode("ascii").split() for line in lines], body
