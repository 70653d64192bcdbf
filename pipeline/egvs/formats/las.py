"""Read LAS and LAZ files with laspy (``pip install egvs[las]``): scaled coordinates in the file's own system.

LAZ files are decompressed by another process (:mod:`egvs.formats.reader_process`): the decompressor allocates as much
memory as a damaged file asks for, and ends its process when there is not enough.

Points that the file marks as errors have NaN as coordinates, like missing returns, and are counted: those with the flag
*withheld*, and those of the noise classes 7 and 18. All others count, whatever their class: synthetic points and those
of overlapping strips describe the surface as well. Source: ASPRS LAS 1.4 R15, tables 8, 16 and 17.

A file may declare its coordinate reference system (:func:`crs_of`), as WKT or as GeoTIFF keys
(:mod:`egvs.formats.geotiff_keys`), in records before or after the points.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import numpy as np

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.reading import COMPLETE_FILE, translate_errors
from egvs.formats.geotiff_keys import GeoKeys
from egvs.formats.point_clouds import NOISE, PointChunk, drop_marked, stack_columns
from egvs.formats.reader_process import Block, read_blocks, serve

if TYPE_CHECKING:
    import laspy

_CHUNK = 1_000_000
_CHUNK_SIZE_AT = 12
"""Position of the size of chunks in the record of LASzip."""
_CANNOT_READ = "cannot be read as LAS"
_INSTALL_HINT = "Run pip install 'egvs[las]'."
_WITHHELD = "withheld"
_CRS_USER, _WKT_RECORD, _KEY_RECORDS = b"LASF_Projection", 2112, (34735, 34736, 34737)
_WKT_FLAG = 1 << 4
_MAX_RECORDS, _MAX_RECORD_BYTES = 10_000, 1_000_000


def read(path: Path, where: str) -> FloatArray:
    """Return all points, (n, 3) float64; InputError at ``where`` for a damaged file, or if laspy is missing."""
    with translate_errors(where, COMPLETE_FILE, _CANNOT_READ):
        declared = _check_file(path, where)
        limits.POINTS.check(where, declared)
        points = np.empty((declared, 3))
        filled = 0
        for chunk in _checked_chunks(path, where, declared):
            points[filled : filled + len(chunk.points_m)] = chunk.points_m
            filled += len(chunk.points_m)
    return points


def stream(path: Path, where: str) -> Iterator[PointChunk]:
    """Yield the points in chunks; the file does not say where the scanner stood. Errors are those of :func:`read`."""
    with translate_errors(where, COMPLETE_FILE, _CANNOT_READ):
        declared = _check_file(path, where)
        yield from _checked_chunks(path, where, declared)


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
    points_end = size - actual + expected
    if most - expected >= expected // max(1, declared) > 0 and not _is_padding(path, points_end, most - expected):
        problem = f"the header declares {declared} points, but there are {most - expected} bytes after the last one"
        raise InputError(where, problem, COMPLETE_FILE)
    return declared


def _is_padding(path: Path, start: int, length: int) -> bool:
    """Return whether a part of a file has zero bytes only: programs fill files up to whole blocks."""
    with path.open("rb") as file:
        file.seek(start)
        while length > 0 and (content := file.read(min(length, _CHUNK))):
            if content.strip(b"\0"):
                return False
            length -= len(content)
    return True


def _first_record_after_points(header: laspy.LasHeader) -> int:
    """Return where the first record after the points starts; 0 without such a record."""
    starts = []
    if header.number_of_evlrs:
        starts.append(int(header.start_of_first_evlr))
    if header.global_encoding.waveform_data_packets_internal:
        starts.append(int(header.start_of_waveform_data_packet_record))
    return min(starts, default=0)


def _checked_chunks(path: Path, where: str, declared: int) -> Iterator[PointChunk]:
    """Yield the points in chunks; InputError unless there are as many as the header declares."""
    count = 0
    for chunk in _unpacked_chunks(path, where) if _is_packed(path) else _chunks(path):
        count += len(chunk.points_m)
        if count > declared:
            problem = f"{_CANNOT_READ} (more points than its header declares)"
            raise InputError(where, problem, COMPLETE_FILE)
        yield chunk
    if count < declared:
        problem = f"the header declares {declared} points, but the file contains {count}"
        raise InputError(where, problem, COMPLETE_FILE)


def _unpacked_chunks(path: Path, where: str) -> Iterator[PointChunk]:
    """Yield the points of a LAZ file, decompressed by another process."""
    for block in read_blocks(__name__, path, where, _CANNOT_READ):
        yield PointChunk(0, None, block.points_m, block.values)


def _chunks(path: Path) -> Iterator[PointChunk]:
    """Yield the points in chunks."""
    import laspy

    # The serial backend: the parallel one prints what its threads raise.
    backend = laspy.LazBackend.Lazrs
    quiet = np.errstate(over="ignore", invalid="ignore")  # points that a scale makes infinite are dropped
    with quiet, path.open("rb") as file, laspy.open(file, read_evlrs=False, laz_backend=backend) as las:
        for chunk in las.chunk_iterator(_CHUNK):
            points = stack_columns([chunk.x, chunk.y, chunk.z])
            marks = {_WITHHELD: np.asarray(chunk.withheld, dtype=np.bool_)}
            classes = np.asarray(chunk.classification)
            marks |= {name: classes == number for number, name in NOISE.items()}
            yield PointChunk(0, None, points, drop_marked(points, marks))


def crs_of(path: Path, where: str) -> str | None:
    """Return the coordinate reference system that the file declares, in a form of PROJ; None if it declares none.

    Where a file has both kinds of records, the flag of its header says which counts; where the text of that one is
    empty, the other.

    For a file that :func:`read` has read. InputError at ``where`` when the declaration is damaged, or states something
    that PROJ cannot use.
    """
    declared = _declared_systems(path)
    if declared.wkt and (declared.prefers_wkt or not declared.has_keys):
        return declared.wkt
    try:
        return declared.keys.to_crs() or declared.wkt or None
    except ValueError as error:
        if declared.wkt:
            return declared.wkt
        hint = "Write its reference system as WKT, for example with pdal translate --writers.las.a_srs=EPSG:CODE."
        raise InputError(where, str(error), hint) from None


def other_crs_of(path: Path) -> str | None:
    """Return the system of the record that does not count, where a file has both kinds; else None."""
    declared = _declared_systems(path)
    if not declared.wkt or not declared.has_keys:
        return None
    with suppress(ValueError):
        return declared.keys.to_crs() if declared.prefers_wkt else declared.wkt
    return None


class _DeclaredSystems(NamedTuple):
    """What the records of a file say of its reference system, and which kind the header prefers."""

    wkt: str
    records: dict[int, bytes]
    has_keys: bool
    prefers_wkt: bool

    @property
    def keys(self) -> GeoKeys:
        """The GeoTIFF keys; ValueError when one points beyond its record."""
        return GeoKeys.from_records(self.records)


def _declared_systems(path: Path) -> _DeclaredSystems:
    with path.open("rb") as file:
        head = file.read(375)
        records = _projection_records(file, head)
    wkt = records.get(_WKT_RECORD, b"").decode("utf-8", "replace").strip("\0 \t\r\n\"'")
    prefers_wkt = bool(struct.unpack_from("<H", head, 6)[0] & _WKT_FLAG)
    return _DeclaredSystems(wkt, records, bool(records.get(_KEY_RECORDS[0])), prefers_wkt)


class _RecordTable(NamedTuple):
    """Where variable length records start, how many there are, and the format of the head of each."""

    start: int
    number: int
    head: str


def _projection_records(file: BinaryIO, head: bytes) -> dict[int, bytes]:
    """Return the records of a reference system by number, those before the points first."""
    header_size, _, count = struct.unpack_from("<HII", head, 94)
    tables = [_RecordTable(header_size, count, "<H16sHH32x")]
    if header_size >= 375 and len(head) >= 375 and head[25] >= 4:
        start, count = struct.unpack_from("<QI", head, 235)
        tables.append(_RecordTable(start, count, "<H16sHQ32x"))
    records: dict[int, bytes] = {}
    for table in tables:
        at = table.start
        end = file.seek(0, io.SEEK_END)
        size = struct.calcsize(table.head)
        for _ in range(min(table.number, _MAX_RECORDS)):
            file.seek(min(at, end))
            start_of_record = file.read(size)
            if len(start_of_record) < size:
                break
            _, user, number, length = struct.unpack(table.head, start_of_record)
            if user.rstrip(b"\0") == _CRS_USER and number in (_WKT_RECORD, *_KEY_RECORDS):
                records.setdefault(number, file.read(min(length, _MAX_RECORD_BYTES)))
            at += size + length
    return records


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
    serve(lambda path: (Block.of_points(dict(chunk.marked), chunk.points_m) for chunk in _chunks(path)))
