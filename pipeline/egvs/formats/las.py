"""Read LAS and LAZ files with laspy (``pip install egvs[las]``): scaled coordinates in the file's own system.

LAZ files are decompressed by another process (:mod:`egvs.formats.reader_process`): the decompressor allocates as much
memory as a damaged file asks for, and ends its process when there is not enough.

A file may declare its coordinate reference system (:func:`crs_of`).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.reading import COMPLETE_FILE, translate_errors
from egvs.formats.point_clouds import PointChunk, stack_columns
from egvs.formats.reader_process import Block, read_blocks, serve

if TYPE_CHECKING:
    import laspy

_CHUNK = 1_000_000
_CHUNK_SIZE_AT = 12
"""Position of the size of chunks in the record of LASzip."""
_CANNOT_READ = "cannot be read as LAS"
_INSTALL_HINT = "Run pip install 'egvs[las]'."


def read(path: Path, where: str) -> FloatArray:
    """Return all points, (n, 3) float64; InputError at ``where`` for a damaged file, or if laspy is missing."""
    with translate_errors(where, COMPLETE_FILE, _CANNOT_READ):
        declared = _check_file(path, where)
        limits.POINTS.check(where, declared)
        points = np.empty((declared, 3))
        filled = 0
        for chunk in _checked_chunks(path, where, declared):
            points[filled : filled + len(chunk)] = chunk
            filled += len(chunk)
    return points


def stream(path: Path, where: str) -> Iterator[PointChunk]:
    """Yield the points in chunks; the file does not say where the scanner stood. Errors are those of :func:`read`."""
    with translate_errors(where, COMPLETE_FILE, _CANNOT_READ):
        declared = _check_file(path, where)
        for chunk in _checked_chunks(path, where, declared):
            yield PointChunk(0, None, chunk)


def _check_file(path: Path, where: str) -> int:
    """Check the header of a file, and return the number of points that it declares."""
    try:
        import laspy
    except ImportError:
        raise InputError(where, "needs laspy, which is not installed", _INSTALL_HINT) from None
    size = limits.checked_size(path, limits.FILE, where)
    with path.open("rb") as file:
        is_packed = _check_header(where, file.read(375), size)
        if is_packed:
            if laspy.LazBackend.Lazrs not in laspy.LazBackend.detect_available():
                raise InputError(where, "needs lazrs, which is not installed", _INSTALL_HINT)
            chunks = _check_chunks(where, file, size)
        file.seek(0)
        with laspy.open(file, closefd=False, read_evlrs=False) as las:
            declared = int(las.header.point_count)
            expected = declared * las.header.point_format.size
            actual = size - las.header.offset_to_point_data
            after_points = _first_record_after_points(las.header)
            chunk_size = _chunk_size(las.header) if is_packed else None
    if is_packed:
        if chunks and chunk_size and chunks > -(-declared // chunk_size):
            problem = f"the header declares {declared} points, but there are {chunks} chunks of {chunk_size} points"
            raise InputError(where, problem, COMPLETE_FILE)
        return declared
    if actual < expected:
        problem = f"the header declares {expected} bytes of points, but the file contains {actual}"
        raise InputError(where, problem, COMPLETE_FILE)
    most = min(actual, (after_points or size) - (size - actual))
    if most - expected >= expected // max(1, declared) > 0:
        problem = f"the header declares {declared} points, but there are {most - expected} bytes after the last one"
        raise InputError(where, problem, COMPLETE_FILE)
    return declared


def _first_record_after_points(header: laspy.LasHeader) -> int:
    """Return where the first record after the points starts; 0 without such a record."""
    starts = []
    if header.number_of_evlrs:
        starts.append(int(header.start_of_first_evlr))
    if header.global_encoding.waveform_data_packets_internal:
        starts.append(int(header.start_of_waveform_data_packet_record))
    return min(starts, default=0)


def _checked_chunks(path: Path, where: str, declared: int) -> Iterator[FloatArray]:
    """Yield the points in chunks; InputError unless there are as many as the header declares."""
    count = 0
    for chunk in _unpacked_chunks(path, where) if _is_packed(path) else _chunks(path):
        count += len(chunk)
        if count > declared:
            problem = f"{_CANNOT_READ} (more points than its header declares)"
            raise InputError(where, problem, COMPLETE_FILE)
        yield chunk
    if count < declared:
        problem = f"the header declares {declared} points, but the file contains {count}"
        raise InputError(where, problem, COMPLETE_FILE)


def _unpacked_chunks(path: Path, where: str) -> Iterator[FloatArray]:
    """Yield the points of a LAZ file, decompressed by another process."""
    for block in read_blocks(__name__, path, where, _CANNOT_READ):
        yield block.points_m


def _chunks(path: Path) -> Iterator[FloatArray]:
    """Yield the points in chunks."""
    import laspy

    # The serial backend: the parallel one prints what its threads raise.
    backend = laspy.LazBackend.Lazrs
    quiet = np.errstate(over="ignore", invalid="ignore")  # points that a scale makes infinite are dropped
    with quiet, path.open("rb") as file, laspy.open(file, read_evlrs=False, laz_backend=backend) as las:
        for chunk in las.chunk_iterator(_CHUNK):
            yield stack_columns([chunk.x, chunk.y, chunk.z])


def crs_of(path: Path, where: str) -> str | None:
    """Return the coordinate reference system that the file's header declares, as WKT; None if it declares none.

    For a file that :func:`read` has read. InputError at ``where`` when the declaration is damaged.
    """
    import laspy

    with (
        translate_errors(where, COMPLETE_FILE, "the coordinate reference system in the header cannot be read"),
        path.open("rb") as file,
        laspy.open(file, closefd=False, read_evlrs=False) as las,
    ):
        crs = las.header.parse_crs()
        if crs is None:
            return None
        return str(crs.to_wkt())


def _check_header(where: str, head: bytes, size: int) -> bool:
    """Check the public header block (ASPRS LAS 1.4, table 3) and return whether the file is a LAZ file.

    laspy would follow a damaged count for hours.
    """
    if head[:4] != b"LASF" or len(head) < 227:
        raise InputError(where, "not a LAS file: it has no LASF header", COMPLETE_FILE)
    header_size, points_at, records = struct.unpack_from("<HII", head, 94)
    if not 227 <= header_size <= points_at <= size or 54 * records > points_at - header_size:
        raise InputError(where, "the LAS header points beyond the file or into itself", COMPLETE_FILE)
    return _has_laz_bits(head)


def _has_laz_bits(head: bytes) -> bool:
    return bool(head[104] & 0xC0)  # LAZ sets the upper bits of the point format


def _is_packed(path: Path) -> bool:
    with path.open("rb") as file:
        return _has_laz_bits(file.read(105))


def _chunk_size(header: laspy.LasHeader) -> int | None:
    """Return the number of points in each chunk of a LAZ file but the last; None where chunks differ, or for no LAZ."""
    records = header.vlrs.get("LasZipVlr")
    content = records[0].record_data if records else b""
    if len(content) < _CHUNK_SIZE_AT + 4:
        return None
    size = int.from_bytes(content[_CHUNK_SIZE_AT : _CHUNK_SIZE_AT + 4], "little")
    return None if size in (0, 0xFFFFFFFF) else size


def _check_chunks(where: str, file: BinaryIO, size: int) -> int:
    """Return the number of chunks that a LAZ file declares, 0 where it does not.

    InputError where there cannot be so many: lazrs ends the process when there is no memory for them.
    """
    points_at = _number_at(file, "<I", 96)
    table_at = _number_at(file, "<q", points_at)
    if table_at == -1:  # written as a stream: the offset is at the end
        table_at = _number_at(file, "<q", size - 8)
    if not 0 < table_at <= size - 8:
        return 0
    chunks = _number_at(file, "<I", table_at + 4)
    if chunks > size:
        raise InputError(where, f"the file declares {chunks} chunks in {size} bytes", COMPLETE_FILE)
    return chunks


def _number_at(file: BinaryIO, kind: str, offset: int) -> int:
    file.seek(offset)
    return int(struct.unpack(kind, file.read(struct.calcsize(kind)))[0])


if __name__ == "__main__":
    serve(lambda path: (Block.of_points({}, chunk) for chunk in _chunks(path)))
