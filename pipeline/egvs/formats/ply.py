"""Read PLY files (Stanford polygon format) in ascii and in binary, little or big endian; write them as binary.

Of the vertices, x, y and z are read, and a property that is asked for by name; the rest is ignored, including faces.
World frame, metres.

Not trimesh: it rounds text to the header's float and accepts text with fewer or more points than the header declares.
Not plyfile, for the same reasons.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from egvs.core.digests import open_input
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.reading import COMPLETE_FILE, check_ply_header
from egvs.formats.point_clouds import AXES, RecordLayout, pack_records, parse_count

_HEADER = "ply\nformat binary_little_endian 1.0\nelement vertex {n}\n{properties}end_header\n"

_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_NAMES = {numpy: ply for ply, numpy in _TYPES.items() if ply.isalpha()}


@dataclass
class _Element:
    """An element of a PLY header: name, count, and numpy format by property (None for a list)."""

    name: str
    n: int
    properties: dict[str, str | None]


class _Header(NamedTuple):
    """A PLY header: numpy's byte order (``"="``: text), elements, offset of the data, number of lines."""

    order: str
    elements: list[_Element]
    data_start: int
    lines: int


def read(path: Path, where: str) -> FloatArray:
    """Return the vertices, (n, 3) float64; InputError at ``where`` for a damaged file."""
    with open_input(path) as file:
        data = file.read()
    header = _read_header(where, data)
    return _read_properties(where, data, header, AXES)


def read_field(path: Path, where: str, names: Sequence[str]) -> FloatArray | None:
    """Return the first of these properties that the vertices have, (n,) float64; None if they have none of them."""
    data = path.read_bytes()
    header = _read_header(where, data)
    properties = [name for element in header.elements if element.name == "vertex" for name in element.properties]
    known = [name for name in names if name in properties]
    return _read_properties(where, data, header, known[:1])[:, 0] if known else None


def _read_properties(where: str, data: bytes, header: _Header, read: Sequence[str]) -> FloatArray:
    """Return properties of all vertices, (n, properties) float64."""
    names = [element.name for element in header.elements]
    if "vertex" not in names:
        problem = f"expected an element 'vertex', got {' '.join(names) or 'none'}"
        raise InputError(where, problem, "Write the points as vertices with x, y and z.")
    at = names.index("vertex")
    vertex = header.elements[at]
    is_last = at == len(names) - 1
    formats = _formats(where, vertex, header.order)
    counts = [1] * len(formats)
    layout = RecordLayout.from_fields(where, vertex.n, list(vertex.properties), formats, counts, read)
    if header.order == "=":
        skip = sum(element.n for element in header.elements[:at])
        return layout.from_text(data[header.data_start :], header.lines + 1, skip, is_last)
    start = header.data_start
    for element in header.elements[:at]:
        start += element.n * sum(np.dtype(kind).itemsize for kind in _formats(where, element, header.order))
    return layout.from_records(memoryview(data)[start:], is_last)


def write(path: Path, points_m: FloatArray) -> None:
    """Write world-frame points, (n, 3) float64, binary, little endian."""
    write_columns(path, dict(zip(AXES, np.asarray(points_m, dtype=np.float64).T, strict=True)))


def write_columns(path: Path, columns: Mapping[str, NDArray[np.generic]]) -> None:
    """Write points with any properties, each (n,) of a type of PLY, binary, little endian; x, y, z are among them."""
    records = pack_records(columns)
    properties = "".join(f"property {_NAMES[records.dtype[name].str[1:]]} {name}\n" for name in columns)
    with path.open("wb") as file:
        file.write(_HEADER.format(n=len(records), properties=properties).encode("ascii"))
        file.write(records.data)


def _formats(where: str, element: _Element, order: str) -> list[str]:
    formats = [order + kind for kind in element.properties.values() if kind is not None]
    if len(formats) < len(element.properties):
        hint = "Use no list properties in the vertices or, in a binary file, in any element before them."
        raise InputError(where, f"the element {element.name!r} has a list property", hint)
    return formats


def _read_header(where: str, data: bytes) -> _Header:
    stop = data.find(b"\nend_header")
    if not data.startswith(b"ply") or stop < 0:
        raise InputError(where, "not a PLY file with a header from 'ply' to 'end_header'", COMPLETE_FILE)
    start = data.find(b"\n", stop + 1) + 1 or len(data)
    order, elements = "", list[_Element]()
    lines = data[:start].splitlines()
    check_ply_header(where, lines)
    for number, line in enumerate((line.decode("latin-1") for line in lines), 1):
        match line.split():
            case ["format", kind, _] if kind in _ORDERS:
                order = _ORDERS[kind]
            case ["element", name, count]:
                elements.append(_Element(name, parse_count(where, f"count of element {name!r}", [count]), {}))
            case ["property", "list", _, _, name] if elements:
                elements[-1].properties[name] = None
            case ["property", kind, name] if elements and kind in _TYPES and name not in elements[-1].properties:
                elements[-1].properties[name] = _TYPES[kind]
            case ["ply" | "comment" | "obj_info" | "end_header", *_] | []:
                pass
            case _:
                problem = f"expected a format, an element, or a property of a known type, got {line.strip()[:60]!r}"
                raise InputError(
                    f"{where}: line {number}", problem, "Correct the PLY header; each name is allowed once."
                )
    if not order:
        hint = f"Add a 'format' line with one of {', '.join(_ORDERS)}."
        raise InputError(where, "the PLY header has no 'format' line", hint)
    return _Header(order, elements, start, len(lines))
