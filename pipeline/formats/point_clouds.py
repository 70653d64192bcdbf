r"""How does a point cloud of an empty scan get in and out?

Frame: the world's (right-handed, x east, y north, z up), metres, float64. Steps: read the file by its suffix; bring the
points into the world frame; drop, and count, the returns that are missing (NaN) or infinite.

- ``.pcd``: DATA ascii, binary or binary_compressed; fields in any order, of any TYPE, SIZE and COUNT. A VIEWPOINT other
  than the identity is the sensor's pose in the world: the points then stand in the sensor's frame, and

  .. math:: p_\mathrm{world} = R(q)\, p_\mathrm{sensor} + t, \qquad
            \mathrm{VIEWPOINT} = t_x\, t_y\, t_z\, q_w\, q_x\, q_y\, q_z.

  (Format: the PCL documentation, "The PCD (Point Cloud Data) file format", version 0.7.)
- ``.ply``: ascii, binary little or big endian; everything but the vertices' x, y and z is ignored, faces included.
- ``.las``, ``.laz``: through laspy (``pip install egvs[las]``); the scaled coordinates, as the file gives them. A file
  in a map projection is in the world frame only when the scenario is in the same projection.
- ``.csv``: a header row with ``x_m, y_m, z_m``, then one return a row; further columns are ignored.

A text file's numbers are taken at float64 even where its header says float. What is not whole is refused; nothing is
guessed."""

from __future__ import annotations

import csv
import io
import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
from numpy.typing import NDArray

from pipeline.core.errors import InputError
from pipeline.core.files import aside

_AXES = ("x", "y", "z")
_COLUMNS = ("x_m", "y_m", "z_m")
_IDENTITY = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
_A_NUMBER = "a number, or nan where nothing returned"
_UNIT = 1e-3  # how far a quaternion's length may be from 1: headers are often written with few digits


def read_points(path: Path, place: str) -> tuple[NDArray[np.float64], int]:
    """Read a point cloud.

    Parameters
    ----------
    path
        A .pcd, .ply, .las, .laz or .csv file. A .pcd's VIEWPOINT is applied (see the module's docstring).
    place
        Who names the file, for messages, e.g. ``"sites.csv: row A"``; the path is added where the place does not hold
        its name.

    Returns
    -------
    points_m
        The finite points, in the file's order, in the world frame, (n, 3) float64, n >= 1.
    dropped
        How many further points were NaN or infinite.

    Raises
    ------
    InputError
        When the file is missing, of an unknown kind, damaged, or without one finite point.
    """
    where = place if path.name in place else ": ".join(filter(None, (place, str(path))))
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(where, _suffix(path), f"one of {', '.join(_READERS)}")
    try:
        points = reader(path, where)
    except OSError as error:
        raise InputError(
            where, f"cannot be read ({error.strerror or error})", "a file that is there and may be read"
        ) from None
    finite = np.isfinite(points).all(axis=1)
    dropped = len(points) - int(np.count_nonzero(finite))
    if dropped == len(points):
        raise InputError(
            where, f"holds no finite point (of {len(points)})", "at least one return with finite x, y and z"
        )
    return (points[finite] if dropped else points), dropped


def write_points(path: Path, points_m: NDArray[np.float64]) -> None:
    """Write a point cloud, whole or not at all; the same points give the same bytes.

    Parameters
    ----------
    path
        A .pcd (binary, VIEWPOINT identity) or .ply (binary little endian) file; both hold x, y, z as float64.
    points_m
        World frame, (n, 3) float64. Read back, they are the same to the bit.

    Raises
    ------
    InputError
        When the suffix is neither.
    """
    header = _HEADERS.get(path.suffix.lower())
    if header is None:
        raise InputError(path, _suffix(path), f"one of {', '.join(_HEADERS)}")
    if points_m.ndim != 2 or points_m.shape[1] != 3:
        raise ValueError(f"points_m has the shape {points_m.shape}, not (n, 3)")
    with aside(path) as partial, partial.open("wb") as file:
        file.write(header.format(n=len(points_m)).encode("ascii"))
        file.write(np.ascontiguousarray(points_m, dtype="<f8").data)


def _suffix(path: Path) -> str:
    return f"is of the unknown kind {path.suffix!r}" if path.suffix else "has no suffix that tells its kind"


# --- what PCD and PLY share: n records of equal layout ----------------------------------------------------------------


@dataclass(frozen=True)
class _Layout:
    """Where x, y and z stand among ``n`` records of ``values`` text values or ``size`` bytes each."""

    where: str
    n: int
    values: int
    size: int
    columns: tuple[int, ...] = field(repr=False)
    offsets: tuple[int, ...] = field(repr=False)
    formats: tuple[str, ...] = field(repr=False)

    @classmethod
    def of(cls, where: str, n: int, names: Sequence[str], formats: Sequence[str], counts: Sequence[int]) -> _Layout:
        """From the fields in their order; ``formats`` are numpy's, with byte order."""
        if n == 0:
            raise InputError(where, "holds no points, says its header", "at least one return")
        for axis in _AXES:
            if names.count(axis) != 1 or counts[names.index(axis)] != 1:
                raise InputError(
                    where, f"has no single field {axis!r} (its fields: {' '.join(names) or 'none'})", "x, y and z"
                )
        columns = (0, *accumulate(counts))
        offsets = (0, *accumulate(np.dtype(f).itemsize * count for f, count in zip(formats, counts, strict=True)))
        at = [names.index(axis) for axis in _AXES]
        return cls(where, n, columns[-1], offsets[-1],
                   tuple(columns[i] for i in at), tuple(offsets[i] for i in at), tuple(formats[i] for i in at))  # fmt: skip

    def from_text(self, text: bytes, line: int, skip: int = 0, last: bool = True) -> NDArray[np.float64]:
        """Points from lines of text, the first of which is the file's line ``line``; ``skip`` records come before."""
        rows = [(number, row) for number, row in enumerate(text.splitlines(), line) if row.strip()][skip:]
        if len(rows) < self.n or (last and len(rows) > self.n):
            raise InputError(
                self.where, f"holds {len(rows)} lines of points", f"{self.n}, as its header says; a whole file"
            )
        rows = rows[: self.n]
        try:
            table = np.loadtxt([row for _, row in rows], comments=None, encoding="latin-1", ndmin=2)
        except ValueError as error:
            raise self._fault(rows, str(error)) from None
        if table.shape[1] != self.values:
            raise self._fault(rows, f"lines of {table.shape[1]} values")
        return np.ascontiguousarray(table[:, self.columns], dtype=np.float64)

    def from_records(self, body: memoryview, last: bool = True) -> NDArray[np.float64]:
        """Points from binary records, one after the other; nothing but white space may follow the ``last`` ones."""
        need = self.n * self.size
        if len(body) < need or (last and bytes(body[need:]).strip()):
            right = f"{need} ({self.n} points of {self.size}), as its header says; a whole file"
            raise InputError(self.where, f"holds {len(body)} bytes of points", right)
        kind = np.dtype({"names": _AXES, "formats": self.formats, "offsets": self.offsets, "itemsize": self.size})
        records = np.frombuffer(body[:need], dtype=kind)
        return _columns([records[axis] for axis in _AXES])

    def from_blocks(self, body: bytes) -> NDArray[np.float64]:
        """Points from binary data that holds each field of all records as one block (PCD's binary_compressed)."""
        parts = zip(self.formats, self.offsets, strict=True)
        return _columns([np.frombuffer(body, dtype=f, count=self.n, offset=offset * self.n) for f, offset in parts])

    def _fault(self, rows: list[tuple[int, bytes]], error: str) -> InputError:
        for number, row in rows:
            words = row.decode("latin-1").split()
            if len(words) != self.values:
                return InputError(
                    f"{self.where}: line {number}", f"holds {len(words)} values", f"{self.values} in each line"
                )
            for word in words:
                if _number(word) is None:
                    return InputError(f"{self.where}: line {number}", f"{word!r} is no number", _A_NUMBER)
        return InputError(self.where, f"cannot be read as text ({error})", "numbers apart by spaces")


def _columns(columns: Sequence[NDArray[np.generic]]) -> NDArray[np.float64]:
    points = np.empty((len(columns[0]), 3))
    with np.errstate(invalid="ignore"):  # a signalling NaN marks a missing return like any other
        for axis, column in enumerate(columns):
            points[:, axis] = column
    return points


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _whole(where: str, key: str, words: Sequence[str]) -> int:
    if len(words) != 1 or not words[0].isdecimal() or len(words[0]) > 18:
        raise InputError(where, f"{key} is {' '.join(words)!r}", "a whole number")
    return int(words[0])


# --- PCD --------------------------------------------------------------------------------------------------------------

_PCD = """\
# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z
SIZE 8 8 8
TYPE F F F
COUNT 1 1 1
WIDTH {n}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {n}
DATA binary
"""

_PCD_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}


def _read_pcd(path: Path, where: str) -> NDArray[np.float64]:
    data = path.read_bytes()
    header, start, lines = _pcd_header(where, data)
    layout = _pcd_layout(where, header)
    viewpoint = _viewpoint(where, header.get("VIEWPOINT"))
    match header["DATA"]:
        case ["ascii"]:
            points = layout.from_text(data[start:], lines + 1)
        case ["binary"]:
            points = layout.from_records(memoryview(data)[start:])
        case ["binary_compressed"]:
            points = layout.from_blocks(_pcd_unpacked(where, data[start:], layout.n * layout.size))
        case other:
            raise InputError(where, f"DATA is {' '.join(other)!r}", "ascii, binary or binary_compressed")
    return points if viewpoint == _IDENTITY else _to_world(points, viewpoint)


def _pcd_header(where: str, data: bytes) -> tuple[dict[str, list[str]], int, int]:
    """The header's words by keyword, where the points start, and how many lines come before."""
    header: dict[str, list[str]] = {}
    start = lines = 0
    while "DATA" not in header:
        if start >= len(data):
            raise InputError(where, "is not a whole PCD file (no line DATA in its header)", "a PCD file, version 0.7")
        end = data.find(b"\n", start) % (len(data) + 1)  # -1, no further line end, becomes the file's end
        words = data[start:end].decode("latin-1").split()
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
        start, lines = end + 1, lines + 1
    return header, start, lines


def _pcd_layout(where: str, header: dict[str, list[str]]) -> _Layout:
    for key in ("FIELDS", "SIZE", "TYPE"):
        if key not in header:
            raise InputError(where, f"its PCD header has no line {key}", "FIELDS, SIZE, TYPE, POINTS and DATA")
    names = header["FIELDS"]
    words = {"COUNT": ["1"] * len(names)} | header
    for key in ("SIZE", "TYPE", "COUNT"):
        if len(words[key]) != len(names):
            raise InputError(where, f"{key} has {len(words[key])} values for {len(names)} FIELDS", "one value a field")
    formats = []
    for name, kind, size in zip(names, words["TYPE"], words["SIZE"], strict=True):
        if _whole(where, f"the SIZE of {name}", [size]) not in _PCD_SIZES.get(kind, ()):
            raise InputError(
                where, f"field {name!r} has TYPE {kind} and SIZE {size}", "F of 4 or 8, I or U of 1, 2, 4 or 8"
            )
        formats.append(f"<{kind.lower()}{size}")
    counts = [_whole(where, f"the COUNT of {name}", [count]) for name, count in zip(names, words["COUNT"], strict=True)]
    return _Layout.of(where, _pcd_points(where, header), names, formats, counts)


def _pcd_points(where: str, header: dict[str, list[str]]) -> int:
    said = {key: _whole(where, key, header[key]) for key in ("POINTS", "WIDTH", "HEIGHT") if key in header}
    product = said["WIDTH"] * said["HEIGHT"] if {"WIDTH", "HEIGHT"} <= said.keys() else said.get("POINTS")
    if product is None:
        raise InputError(where, "its PCD header has no line POINTS", "FIELDS, SIZE, TYPE, POINTS and DATA")
    if said.get("POINTS", product) != product:
        raise InputError(where, f"POINTS is {said['POINTS']}, but WIDTH x HEIGHT is {product}", "the same number")
    return product


def _viewpoint(where: str, words: list[str] | None) -> tuple[float, ...]:
    """t_x, t_y, t_z, q_w, q_x, q_y, q_z, with the quaternion brought to length 1."""
    if words is None:
        return _IDENTITY
    found = [value for word in words if (value := _number(word)) is not None and math.isfinite(value)]
    length = math.hypot(*found[3:])
    if len(found) != len(words) or len(found) != 7 or abs(length - 1) > _UNIT:
        right = "a translation and a unit quaternion, tx ty tz qw qx qy qz"
        raise InputError(where, f"VIEWPOINT is {' '.join(words)!r}", right)
    return (*found[:3], *(value / length for value in found[3:]))


def _to_world(points: NDArray[np.float64], viewpoint: tuple[float, ...]) -> NDArray[np.float64]:
    """Rotate and shift, in plain sums: a matrix product's last bits would depend on the machine."""
    tx, ty, tz, w, x, y, z = viewpoint
    rotation = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    px, py, pz = points.T
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite stays so, and is dropped
        return np.stack(
            [a * px + b * py + c * pz + t for (a, b, c), t in zip(rotation, (tx, ty, tz), strict=True)], axis=1
        )


def _pcd_unpacked(where: str, body: bytes, need: int) -> bytes:
    right = f"{need}, as its header says; a whole file"
    if len(body) < 8:
        raise InputError(where, f"ends before its points ({len(body)} bytes of them)", right)
    packed, size = struct.unpack_from("<II", body)
    if size != need:
        raise InputError(where, f"holds {size} bytes of points, unpacked", right)
    if len(body) < 8 + packed:
        raise InputError(where, f"holds {len(body) - 8} bytes of packed points", f"{packed}; a whole file")
    unpacked = _lzf(body[8 : 8 + packed], size)
    if unpacked is None:
        raise InputError(where, "its packed points are damaged", f"LZF data of {right}")
    return unpacked


def _lzf(packed: bytes, size: int) -> bytes | None:
    """Undo LZF, the format of Marc Lehmann's liblzf; None when the outcome would not have ``size`` bytes.

    A control byte c below 32 is followed by c + 1 plain bytes. Any other copies from what is already there: its upper
    three bits are the length less 2 (7: another byte adds to it), its lower five and one byte more the distance back,
    less 1."""
    out, at, end = bytearray(), 0, len(packed)
    try:
        while at < end:
            control = packed[at]
            at += 1
            if control < 32:
                out += packed[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[at]
                at += 1
            length += 2
            back = ((control & 31) << 8 | packed[at]) + 1
            at += 1
            first = len(out) - back
            if first < 0:
                return None
            piece = out[first : first + length]
            # A copy may run into what it writes: then the last ``back`` bytes repeat.
            out += piece if back >= length else (piece * (length // back + 1))[:length]
    except IndexError:
        return None
    return bytes(out) if at == end and len(out) == size else None


# --- PLY --------------------------------------------------------------------------------------------------------------

_PLY = """\
ply
format binary_little_endian 1.0
element vertex {n}
property double x
property double y
property double z
end_header
"""

_PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip


@dataclass
class _Element:
    """One element of a PLY header: its name, how many there are, and its properties (a list's format is None)."""

    name: str
    n: int
    properties: dict[str, str | None]


def _read_ply(path: Path, where: str) -> NDArray[np.float64]:
    data = path.read_bytes()
    order, elements, start, lines = _ply_header(where, data)
    names = [element.name for element in elements]
    if "vertex" not in names:
        found = f"has no element 'vertex' (its elements: {' '.join(names) or 'none'})"
        raise InputError(where, found, "vertices with x, y and z")
    at = names.index("vertex")
    vertex, last = elements[at], at == len(elements) - 1
    formats = _ply_formats(where, vertex, order)
    layout = _Layout.of(where, vertex.n, list(vertex.properties), formats, [1] * len(formats))
    if order == "=":
        return layout.from_text(data[start:], lines + 1, sum(element.n for element in elements[:at]), last)
    before = sum(e.n * sum(np.dtype(f).itemsize for f in _ply_formats(where, e, order)) for e in elements[:at])
    return layout.from_records(memoryview(data)[start + before :], last)


def _ply_formats(where: str, element: _Element, order: str) -> list[str]:
    formats = [order + kind for kind in element.properties.values() if kind is not None]
    if len(formats) < len(element.properties):
        right = "no list among the vertices' properties, nor in a binary file before the vertices"
        raise InputError(where, f"the element {element.name!r} holds a list", right)
    return formats


def _ply_header(where: str, data: bytes) -> tuple[str, list[_Element], int, int]:
    """Byte order, elements, where the data start, and how many lines come before."""
    stop = data.find(b"\nend_header")
    if not data.startswith(b"ply") or stop < 0:
        raise InputError(where, "is not a whole PLY file (from 'ply' to 'end_header')", "a PLY file, ascii or binary")
    start = data.find(b"\n", stop + 1) + 1 or len(data)
    order, elements = "", list[_Element]()
    lines = data[:start].splitlines()
    for number, line in enumerate((line.decode("latin-1") for line in lines), 1):
        match line.split():
            case ["format", kind, _] if kind in _PLY_ORDERS:
                order = _PLY_ORDERS[kind]
            case ["element", name, count]:
                elements.append(_Element(name, _whole(where, f"the count of element {name!r}", [count]), {}))
            case ["property", "list", _, _, name] if elements:
                elements[-1].properties[name] = None
            case ["property", kind, name] if elements and kind in _PLY_TYPES and name not in elements[-1].properties:
                elements[-1].properties[name] = _PLY_TYPES[kind]
            case ["ply" | "comment" | "obj_info" | "end_header", *_] | []:
                pass
            case _:
                right = "a format, an element, or a property of a known type, each name once"
                raise InputError(f"{where}: line {number}", f"{line.strip()[:60]!r} in its PLY header", right)
    if not order:
        raise InputError(where, "its PLY header has no line 'format'", f"one of {', '.join(_PLY_ORDERS)}")
    return order, elements, start, len(lines)


# --- LAS, LAZ ---------------------------------------------------------------------------------------------------------

_LAS_CHUNK = 1_000_000


def _read_las(path: Path, where: str) -> NDArray[np.float64]:
    try:
        import laspy
    except ImportError:
        raise InputError(where, "needs laspy, which is not installed", "pip install egvs[las]") from None
    # The serial backend: the parallel one ends the whole process on a damaged file.
    backend = laspy.LazBackend.Lazrs
    damaged = (laspy.LaspyException, RuntimeError, ValueError, struct.error)  # RuntimeError: lazrs
    with path.open("rb") as file:
        packed = _las_is_packed(where, file.read(375), path.stat().st_size)
        if packed and backend not in laspy.LazBackend.detect_available():
            raise InputError(where, "needs lazrs, which is not installed", "pip install egvs[las]")
        file.seek(0)
        try:
            with laspy.open(file, closefd=False, read_evlrs=False, laz_backend=backend) as las:
                said = int(las.header.point_count)
                chunks = [_columns([chunk.x, chunk.y, chunk.z]) for chunk in las.chunk_iterator(_LAS_CHUNK)]
        except damaged as error:
            raise InputError(where, f"cannot be read as LAS ({error})", "a whole LAS or LAZ file") from None
    points = np.concatenate([np.empty((0, 3)), *chunks])
    if len(points) != said:
        raise InputError(where, f"holds {len(points)} points", f"{said}, as its header says; a whole file")
    return points


def _las_is_packed(where: str, head: bytes, size: int) -> bool:
    """Check the public header block (ASPRS LAS 1.4, table 3): laspy would follow a damaged count for hours."""
    if head[:4] != b"LASF" or len(head) < 227:
        raise InputError(where, "is not a LAS file (no LASF header)", "a whole LAS or LAZ file")
    header_size, points_at, records = struct.unpack_from("<HII", head, 94)
    if not 227 <= header_size <= points_at <= size or 54 * records > points_at - header_size:
        raise InputError(where, "its LAS header points past the file or into itself", "a whole LAS or LAZ file")
    return bool(head[104] & 0xC0)  # LAZ sets the upper bits of the point format


# --- CSV --------------------------------------------------------------------------------------------------------------


def _read_csv(path: Path, where: str) -> NDArray[np.float64]:
    data = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    head, _, body = data.partition(b"\n")
    try:
        header = next(csv.reader([head.decode("latin-1").rstrip("\r")], skipinitialspace=True), [])
    except csv.Error as error:
        raise InputError(where, f"cannot be read as CSV ({error})", "a header row, then one return a row") from None
    names = [name.strip() for name in header]
    for name in _COLUMNS:
        if names.count(name) != 1:
            right = f"a header row with {', '.join(_COLUMNS)}"
            raise InputError(where, f"has no single column {name!r} (its columns: {', '.join(names) or 'none'})", right)
    if not body.strip():
        return np.empty((0, 3))
    # Numbered, because further columns may share a name or have none.
    wanted = [str(names.index(name)) for name in _COLUMNS]
    read = pa.csv.ReadOptions(column_names=[str(i) for i in range(len(names))])
    types = dict.fromkeys(wanted, pa.float64())
    convert = pa.csv.ConvertOptions(column_types=types, include_columns=wanted, null_values=[])
    try:
        table = pa.csv.read_csv(pa.py_buffer(body), read, convert_options=convert)
    except pa.ArrowInvalid as error:
        raise _csv_fault(where, body, names, str(error)) from None
    return _columns([table[name].to_numpy() for name in wanted])


def _csv_fault(where: str, body: bytes, names: list[str], error: str) -> InputError:
    """Find the first row that is wrong, which Arrow's own message does not name."""
    rows = csv.reader(io.StringIO(body.decode("latin-1"), newline=""))
    try:
        for row in rows:
            place = f"{where}: line {rows.line_num + 1}"
            if row and len(row) != len(names):
                return InputError(place, f"holds {len(row)} values", f"{len(names)}, one a column")
            for name, text in zip(names, row, strict=bool(row)):
                if name in _COLUMNS and _number(text) is None:
                    return InputError(f"{place}: {name}", f"{text!r} is no number", _A_NUMBER)
    except csv.Error:
        pass  # Arrow's message says it
    return InputError(where, f"cannot be read as CSV ({error.splitlines()[0]})", "a header row, then one return a row")


_READERS: dict[str, Callable[[Path, str], NDArray[np.float64]]] = {
    ".pcd": _read_pcd,
    ".ply": _read_ply,
    ".las": _read_las,
    ".laz": _read_las,
    ".csv": _read_csv,
}
_HEADERS = {".pcd": _PCD, ".ply": _PLY}
