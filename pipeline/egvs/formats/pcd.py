r"""Read PCD files (Point Cloud Library) with DATA ascii, binary or binary_compressed; write them as DATA binary.

Fields may be in any order, of any TYPE, SIZE and COUNT; old files call them COLUMNS. A VIEWPOINT other than the
identity is the sensor's pose in the world; the points, in the sensor's frame in metres, are then converted to the world
frame:

.. math:: p_\mathrm{world} = R(q)\, p_\mathrm{sensor} + t, \qquad
          \mathrm{VIEWPOINT} = t_x\, t_y\, t_z\, q_w\, q_x\, q_y\, q_z.

Format: the PCL documentation, "The PCD (Point Cloud Data) file format", version 0.7.

Not pypcd4: it accepts truncated files, ignores VIEWPOINT, and needs single spaces between columns of text.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from egvs.core import limits
from egvs.core.digests import open_input
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.reading import COMPLETE_FILE
from egvs.formats.point_clouds import (
    AXES,
    CLASS_FIELDS,
    PointChunk,
    RecordLayout,
    drop_noise,
    pack_records,
    parse_count,
    parse_float,
)

_IDENTITY = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
_UNIT_TOLERANCE = 1e-3
"""Largest deviation of a quaternion's length from 1: headers are often written with few digits."""

_HEADER = """\
# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS {names}
SIZE {sizes}
TYPE {types}
COUNT {counts}
WIDTH {n}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {n}
DATA binary
"""
_HEADER_HINT = "A PCD header has the lines FIELDS, SIZE, TYPE, POINTS and DATA."

_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}


class _Header(NamedTuple):
    """A PCD header: words by keyword, offset of the data, number of lines."""

    words: dict[str, list[str]]
    data_start: int
    lines: int


def read(path: Path, where: str) -> FloatArray:
    """Return all points in the world frame, (n, 3) float64; InputError at ``where`` for a damaged file."""
    with open_input(path) as file:
        data = file.read()
    header = _read_header(where, data)
    viewpoint = _viewpoint(where, header.words.get("VIEWPOINT"))
    points = _read_fields(where, data, header, AXES)
    if viewpoint == _IDENTITY:
        return points
    return _to_world(points, viewpoint)


def read_field(path: Path, where: str, names: Sequence[str]) -> FloatArray | None:
    """Return the first of these fields that the file has, (n,) float64; None if it has none of them."""
    data = path.read_bytes()
    header = _read_header(where, data)
    known = [name for name in names if name in header.words.get("FIELDS", [])]
    return _read_fields(where, data, header, known[:1])[:, 0] if known else None


def _read_fields(where: str, data: bytes, header: _Header, names: Sequence[str]) -> FloatArray:
    """Return fields of all points as they are in the file, (n, fields) float64."""
    layout = _layout(where, header.words, names)
    match header.words["DATA"]:
        case ["ascii"]:
            return layout.from_text(data[header.data_start :], header.lines + 1)
        case ["binary"]:
            return layout.from_records(memoryview(data)[header.data_start :])
        case ["binary_compressed"]:
            body = data[header.data_start :]
            packed = _layout(where, _without_padding(header.words), names)
            if len(body) >= 8 and struct.unpack_from("<I", body, 4)[0] == packed.n * packed.size:
                layout = packed
            return layout.from_blocks(_unpack(where, body, layout.n * layout.size))
        case other:
            problem = f"DATA: expected ascii, binary or binary_compressed, got {' '.join(other)[:60]!r}"
            raise InputError(where, problem, "Convert the file to one of these.")


def _without_padding(words: dict[str, list[str]]) -> dict[str, list[str]]:
    """Return a header without the fields ``_``, the padding of records, for which PCL writes no blocks."""
    names = words["FIELDS"]
    rows = {key: words[key] for key in ("FIELDS", "SIZE", "TYPE", "COUNT") if key in words}
    return words | {
        key: [word for name, word in zip(names, row, strict=True) if name != "_"] for key, row in rows.items()
    }


def stream(path: Path, where: str) -> Iterator[PointChunk]:
    """Yield all points at once, with the position of VIEWPOINT as the station unless it is the identity."""
    with open_input(path) as file:
        viewpoint = _viewpoint(where, _read_header(where, file.read()).words.get("VIEWPOINT"))
    station_m = None if viewpoint == _IDENTITY else np.array(viewpoint[:3])
    points = read(path, where)
    yield PointChunk(0, station_m, points, drop_noise(points, read_field(path, where, CLASS_FIELDS)))


def write(path: Path, points_m: FloatArray) -> None:
    """Write world-frame points, (n, 3) float64, as DATA binary with the identity as VIEWPOINT."""
    write_columns(path, dict(zip(AXES, np.asarray(points_m, dtype=np.float64).T, strict=True)))


def write_columns(path: Path, columns: Mapping[str, NDArray[np.generic]]) -> None:
    """Write points with any fields, each (n,), as DATA binary with the identity as VIEWPOINT; x, y, z among them."""
    records = pack_records(columns)
    kinds = [records.dtype[name].str for name in columns]
    header = _HEADER.format(
        n=len(records),
        names=" ".join(columns),
        sizes=" ".join(kind[2:] for kind in kinds),
        types=" ".join(kind[1].upper() for kind in kinds),
        counts=" ".join("1" for _ in kinds),
    )
    with path.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(records.data)


def _read_header(where: str, data: bytes) -> _Header:
    words: dict[str, list[str]] = {}
    start = lines = 0
    while "DATA" not in words:
        if start >= len(data):
            raise InputError(where, "the PCD header has no DATA line", COMPLETE_FILE)
        end = data.find(b"\n", start)
        if end < 0:
            end = len(data)
        line = data[start:end].decode("latin-1")
        keyword, *values = line.split() or [""]
        if keyword and not keyword.startswith("#"):
            if not (line.isascii() and line.replace("\t", " ").rstrip("\r").isprintable()):
                raise InputError(f"{where}: line {lines + 1}", f"expected text, got {line[:80]!r}", COMPLETE_FILE)
            words["FIELDS" if keyword == "COLUMNS" else keyword] = values
        start = end + 1
        lines += 1
    return _Header(words, start, lines)


def _layout(where: str, header: dict[str, list[str]], read: Sequence[str]) -> RecordLayout:
    for key in ("FIELDS", "SIZE", "TYPE"):
        if key not in header:
            raise InputError(where, f"the PCD header has no {key} line", _HEADER_HINT)
    names = header["FIELDS"]
    words = {"COUNT": ["1"] * len(names)} | header
    for key in ("SIZE", "TYPE", "COUNT"):
        if len(words[key]) != len(names):
            problem = f"{key}: expected {len(names)} values, one per field, got {len(words[key])}"
            raise InputError(where, problem, "Correct the PCD header.")
    formats = []
    for name, kind, size in zip(names, words["TYPE"], words["SIZE"], strict=True):
        if parse_count(where, f"SIZE of {name}", [size]) not in _SIZES.get(kind, ()):
            hint = "Use TYPE F with SIZE 4 or 8, or TYPE I or U with SIZE 1, 2, 4 or 8."
            raise InputError(where, f"field {name!r} has TYPE {kind} and SIZE {size}", hint)
        formats.append(f"<{kind.lower()}{size}")
    counts = []
    for name, count in zip(names, words["COUNT"], strict=True):
        counts.append(parse_count(where, f"COUNT of {name}", [count]))
    return RecordLayout.from_fields(where, _point_count(where, header), names, formats, counts, read)


def _point_count(where: str, header: dict[str, list[str]]) -> int:
    """Return WIDTH x HEIGHT, or else POINTS; InputError when they differ."""
    counts = {key: parse_count(where, key, header[key]) for key in ("POINTS", "WIDTH", "HEIGHT") if key in header}
    points = counts.get("POINTS")
    if "WIDTH" in counts and "HEIGHT" in counts:
        product = counts["WIDTH"] * counts["HEIGHT"]
        if points not in (None, product):
            hint = "Correct the PCD header; both must be the number of points."
            raise InputError(where, f"POINTS is {points}, but WIDTH x HEIGHT is {product}", hint)
        return product
    if points is None:
        raise InputError(where, "the PCD header has no POINTS line", _HEADER_HINT)
    return points


def _viewpoint(where: str, words: list[str] | None) -> tuple[float, ...]:
    """Return t_x, t_y, t_z, q_w, q_x, q_y, q_z with the quaternion normalised to length 1."""
    if words is None:
        return _IDENTITY
    values = []
    for word in words:
        value = parse_float(word)
        if value is not None and math.isfinite(value):
            values.append(value)
    hint = "Write a translation and a unit quaternion: tx ty tz qw qx qy qz; 0 0 0 1 0 0 0 for none."
    if len(values) != len(words) or len(values) != 7:
        raise InputError(where, f"VIEWPOINT: expected seven numbers, got {' '.join(words)!r}", hint)
    length = math.hypot(*values[3:])
    if abs(length - 1) > _UNIT_TOLERANCE:
        quaternion = " ".join(words[3:])
        problem = f"VIEWPOINT: expected a quaternion of length 1, got {quaternion!r} of length {length:.4g}"
        raise InputError(where, problem, hint)
    return (*values[:3], *(value / length for value in values[3:]))


def _to_world(points: FloatArray, viewpoint: tuple[float, ...]) -> FloatArray:
    """Rotate and shift in plain sums: the last bits of a matrix product depend on the machine."""
    tx, ty, tz, w, x, y, z = viewpoint
    rotation = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    px, py, pz = points.T
    with np.errstate(invalid="ignore", over="ignore"):  # points that are not finite are dropped later
        rows = [a * px + b * py + c * pz + t for (a, b, c), t in zip(rotation, (tx, ty, tz), strict=True)]
    return np.stack(rows, axis=1)


def _unpack(where: str, body: bytes, expected: int) -> bytearray:
    """Return the ``expected`` bytes of points of a file with DATA binary_compressed."""
    if len(body) < 8:
        raise InputError(where, f"the file ends before its points (only {len(body)} bytes of data)", COMPLETE_FILE)
    packed, size = struct.unpack_from("<II", body)
    if size != expected:
        problem = f"the header declares {expected} bytes of points, but there are {size} after decompression"
        raise InputError(where, problem, COMPLETE_FILE)
    if len(body) < 8 + packed:
        problem = f"expected {packed} bytes of packed points, got {len(body) - 8} bytes"
        raise InputError(where, problem, COMPLETE_FILE)
    limits.UNPACKED.check_bytes(where, size)
    block = body[8 : 8 + packed]
    unpacked = _decompress_lzf(block, size)
    if unpacked is None and packed == size:  # stored as they are, where they cannot be compressed
        unpacked = bytearray(block)
    if unpacked is None:
        raise InputError(where, "the packed points are not valid LZF data", COMPLETE_FILE)
    return unpacked


def _decompress_lzf(packed: bytes, size: int) -> bytearray | None:
    """Decompress LZF, the format of Marc Lehmann's liblzf; None unless the result has ``size`` bytes.

    A control byte c below 32 is followed by c + 1 literal bytes. Any other copies from the output so far: its upper
    three bits are the length less 2 (7: another byte is added), its lower five and one more byte the distance back,
    less 1.
    """
    out, at, end = bytearray(), 0, len(packed)
    try:
        while at < end and len(out) <= size:
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
            if back < length:  # the copy overlaps its own output: the last ``back`` bytes repeat
                piece = (piece * (length // back + 1))[:length]
            out += piece
    except IndexError:
        return None
    if at != end or len(out) != size:
        return None
    return out
