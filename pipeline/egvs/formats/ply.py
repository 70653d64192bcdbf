"""PLY files (Stanford polygon format) are read in ascii and in binary, little or big endian; everything but the
vertices' x, y and z is ignored, faces included.

Frame: the world's, metres. Read by hand, because plyfile narrows text to the header's float, takes a file with more
points than its header says, and reads all faces only to have them thrown away.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from egvs.core.errors import InputError
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
    """One element of a PLY header: its name, how many there are, and its properties (a list's format is None)."""

    name: str
    n: int
    properties: dict[str, str | None]


def read(path: Path, where: str) -> NDArray[np.float64]:
    """The vertices, (n, 3) float64; a damaged file is an InputError at ``where``."""
    data = path.read_bytes()
    order, elements, start, lines = _header(where, data)
    names = [element.name for element in elements]
    if "vertex" not in names:
        problem = f"has no element 'vertex' (its elements: {' '.join(names) or 'none'})"
        raise InputError(where, problem, "vertices with x, y and z")
    at = names.index("vertex")
    vertex, last = elements[at], at == len(elements) - 1
    formats = _formats(where, vertex, order)
    layout = RecordLayout.of(where, vertex.n, list(vertex.properties), formats, [1] * len(formats))
    if order == "=":
        return layout.from_text(data[start:], lines + 1, sum(element.n for element in elements[:at]), last)
    before = sum(e.n * sum(np.dtype(f).itemsize for f in _formats(where, e, order)) for e in elements[:at])
    return layout.from_records(memoryview(data)[start + before :], last)


def write(path: Path, points_m: NDArray[np.float64]) -> None:
    """Write world-frame points, (n, 3) float64, binary, little endian."""
    write_columns(path, dict(zip(AXES, np.asarray(points_m, dtype=np.float64).T, strict=True)))


def write_columns(path: Path, columns: Mapping[str, NDArray[np.generic]]) -> None:
    """Write points with any properties, each (n,) of one of PLY's types, binary, little endian; x, y, z among them."""
    records = pack_records(columns)
    properties = "".join(f"property {_NAMES[records.dtype[name].str[1:]]} {name}\n" for name in columns)
    with path.open("wb") as file:
        file.write(_HEADER.format(n=len(records), properties=properties).encode("ascii"))
        file.write(records.data)


def _formats(where: str, element: _Element, order: str) -> list[str]:
    formats = [order + kind for kind in element.properties.values() if kind is not None]
    if len(formats) < len(element.properties):
        right = "no list among the vertices' properties, nor in a binary file before the vertices"
        raise InputError(where, f"the element {element.name!r} holds a list", right)
    return formats


def _header(where: str, data: bytes) -> tuple[str, list[_Element], int, int]:
    """Byte order, elements, where the data start, and how many lines come before."""
    stop = data.find(b"\nend_header")
    if not data.startswith(b"ply") or stop < 0:
        raise InputError(where, "is not a whole PLY file (from 'ply' to 'end_header')", "a PLY file, ascii or binary")
    start = data.find(b"\n", stop + 1) + 1 or len(data)
    order, elements = "", list[_Element]()
    lines = data[:start].splitlines()
    for number, line in enumerate((line.decode("latin-1") for line in lines), 1):
        match line.split():
            case ["format", kind, _] if kind in _ORDERS:
                order = _ORDERS[kind]
            case ["element", name, count]:
                elements.append(_Element(name, parse_count(where, f"the count of element {name!r}", [count]), {}))
            case ["property", "list", _, _, name] if elements:
                elements[-1].properties[name] = None
            case ["property", kind, name] if elements and kind in _TYPES and name not in elements[-1].properties:
                elements[-1].properties[name] = _TYPES[kind]
            case ["ply" | "comment" | "obj_info" | "end_header", *_] | []:
                pass
            case _:
                right = "a format, an element, or a property of a known type, each name once"
                raise InputError(f"{where}: line {number}", f"{line.strip()[:60]!r} in its PLY header", right)
    if not order:
        raise InputError(where, "its PLY header has no line 'format'", f"one of {', '.join(_ORDERS)}")
    return order, elements, start, len(lines)
