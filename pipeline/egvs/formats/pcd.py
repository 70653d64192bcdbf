r"""PCD files (Point Cloud Library) are read with DATA ascii, binary or binary_compressed and fields in any order, of
any TYPE, SIZE and COUNT, and written as DATA binary.

Frame: a VIEWPOINT other than the identity is the sensor's pose in the world; the points then stand in the sensor's
frame, in metres, and are brought into the world's:

.. math:: p_\mathrm{world} = R(q)\, p_\mathrm{sensor} + t, \qquad
          \mathrm{VIEWPOINT} = t_x\, t_y\, t_z\, q_w\, q_x\, q_y\, q_z.

Format: the PCL documentation, "The PCD (Point Cloud Data) file format", version 0.7. Read by hand, because pypcd4 takes
a file that was cut short, does not apply VIEWPOINT, and reads no text whose columns are apart by more than one space.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.formats.point_clouds import AXES, RecordLayout, pack_records, parse_count, parse_float

_IDENTITY = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
_UNIT_TOLERANCE = 1e-3  # how far a quaternion's length may be from 1: headers are often written with few digits

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

_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}


def read(path: Path, where: str) -> NDArray[np.float64]:
    """All points in the world frame, (n, 3) float64; a damaged file is an InputError at ``where``."""
    data = path.read_bytes()
    header, start, lines = _header(where, data)
    layout = _layout(where, header)
    viewpoint = _viewpoint(where, header.get("VIEWPOINT"))
    match header["DATA"]:
        case ["ascii"]:
            points = layout.from_text(data[start:], lines + 1)
        case ["binary"]:
            points = layout.from_records(memoryview(data)[start:])
        case ["binary_compressed"]:
            points = layout.from_blocks(_unpack(where, data[start:], layout.n * layout.size))
        case other:
            raise InputError(where, f"DATA is {' '.join(other)[:60]!r}", "ascii, binary or binary_compressed")
    return points if viewpoint == _IDENTITY else _to_world(points, viewpoint)


def write(path: Path, points_m: NDArray[np.float64]) -> None:
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


def _header(where: str, data: bytes) -> tuple[dict[str, list[str]], int, int]:
    """The header's words by keyword, where the points start, and how many lines come before."""
    header: dict[str, list[str]] = {}
    start = lines = 0
    while "DATA" not in header:
        if start >= len(data):
            raise InputError(where, "is not a whole PCD file (no line DATA in its header)", "a PCD file, version 0.7")
        end = data.find(b"\n", start) % (len(data) + 1)  # -1, no further line end, becomes the file's end
        words = (line := data[start:end].decode("latin-1")).split()
        if words and not words[0].startswith("#"):
            if not (line.isascii() and line.replace("\t", " ").rstrip("\r").isprintable()):
                raise InputError(f"{where}: line {lines + 1}", f"{line[:80]!r} is no text", "a whole PCD file")
            header[words[0]] = words[1:]
        start, lines = end + 1, lines + 1
    return header, start, lines


def _layout(where: str, header: dict[str, list[str]]) -> RecordLayout:
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
        if parse_count(where, f"the SIZE of {name}", [size]) not in _SIZES.get(kind, ()):
            problem = f"field {name!r} has TYPE {kind} and SIZE {size}"
            raise InputError(where, problem, "F of 4 or 8, I or U of 1, 2, 4 or 8")
        formats.append(f"<{kind.lower()}{size}")
    named_counts = zip(names, words["COUNT"], strict=True)
    counts = [parse_count(where, f"the COUNT of {name}", [count]) for name, count in named_counts]
    return RecordLayout.of(where, _count(where, header), names, formats, counts)


def _count(where: str, header: dict[str, list[str]]) -> int:
    counts = {key: parse_count(where, key, header[key]) for key in ("POINTS", "WIDTH", "HEIGHT") if key in header}
    product = counts["WIDTH"] * counts["HEIGHT"] if {"WIDTH", "HEIGHT"} <= counts.keys() else counts.get("POINTS")
    if product is None:
        raise InputError(where, "its PCD header has no line POINTS", "FIELDS, SIZE, TYPE, POINTS and DATA")
    if counts.get("POINTS", product) != product:
        raise InputError(where, f"POINTS is {counts['POINTS']}, but WIDTH x HEIGHT is {product}", "the same number")
    return product


def _viewpoint(where: str, words: list[str] | None) -> tuple[float, ...]:
    """t_x, t_y, t_z, q_w, q_x, q_y, q_z, with the quaternion brought to length 1."""
    if words is None:
        return _IDENTITY
    values = [value for word in words if (value := parse_float(word)) is not None and math.isfinite(value)]
    length = math.hypot(*values[3:])
    if len(values) != len(words) or len(values) != 7 or abs(length - 1) > _UNIT_TOLERANCE:
        right = "a translation and a unit quaternion, tx ty tz qw qx qy qz"
        raise InputError(where, f"VIEWPOINT is {' '.join(words)!r}", right)
    return (*values[:3], *(value / length for value in values[3:]))


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
        rows = [a * px + b * py + c * pz + t for (a, b, c), t in zip(rotation, (tx, ty, tz), strict=True)]
    return np.stack(rows, axis=1)


def _unpack(where: str, body: bytes, need: int) -> bytearray:
    right = f"{need}, as its header says; a whole file"
    if len(body) < 8:
        raise InputError(where, f"ends before its points ({len(body)} bytes of them)", right)
    packed, size = struct.unpack_from("<II", body)
    if size != need:
        raise InputError(where, f"holds {size} bytes of points, unpacked", right)
    if len(body) < 8 + packed:
        raise InputError(where, f"holds {len(body) - 8} bytes of packed points", f"{packed}; a whole file")
    limits.UNPACKED.check_bytes(where, size)
    unpacked = _decompress_lzf(body[8 : 8 + packed], size)
    if unpacked is None:
        raise InputError(where, "its packed points are damaged", f"LZF data of {right}")
    return unpacked


def _decompress_lzf(packed: bytes, size: int) -> bytearray | None:
    """Undo LZF, the format of Marc Lehmann's liblzf; None when the outcome would not have ``size`` bytes.

    A control byte c below 32 is followed by c + 1 plain bytes. Any other copies from what is already there: its upper
    three bits are the length less 2 (7: another byte adds to it), its lower five and one byte more the distance back,
    less 1.
    """
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
    return out if at == end and len(out) == size else None
