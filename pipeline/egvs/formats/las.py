"""Read LAS and LAZ files with laspy (``pip install egvs[las]``): scaled coordinates in the file's own system.

LAZ files are decompressed by another process, which runs this module as a program: the decompressor allocates as much
memory as a damaged file asks for, and ends its process when there is not enough.

A file may declare its coordinate reference system (:func:`crs_of`).
"""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from egvs.core import limits, platform
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.reading import COMPLETE_FILE, translate_errors
from egvs.formats.point_clouds import stack_xyz

_CHUNK = 1_000_000
_CANNOT_READ = "cannot be read as LAS"
_INSTALL_HINT = "Run pip install 'egvs[las]'."
_ROOT = Path(__file__).resolve().parents[2]
"""Folder of the package ``egvs``, which the other process must find."""


def read(path: Path, where: str) -> FloatArray:
    """Return all points, (n, 3) float64; InputError at ``where`` for a damaged file, or if laspy is missing."""
    try:
        import laspy
    except ImportError:
        raise InputError(where, "needs laspy, which is not installed", _INSTALL_HINT) from None
    size = limits.checked_size(path, limits.FILE, where)
    with translate_errors(where, COMPLETE_FILE, _CANNOT_READ), path.open("rb") as file:
        is_packed = _check_header(where, file.read(375), size)
        if is_packed:
            if laspy.LazBackend.Lazrs not in laspy.LazBackend.detect_available():
                raise InputError(where, "needs lazrs, which is not installed", _INSTALL_HINT)
            _check_chunks(where, file, size)
        file.seek(0)
        with laspy.open(file, closefd=False, read_evlrs=False) as las:
            declared = int(las.header.point_count)
            expected = declared * las.header.point_format.size
            actual = size - las.header.offset_to_point_data
        if actual < expected and not is_packed:
            problem = f"the header declares {expected} bytes of points, but the file contains {actual}"
            raise InputError(where, problem, COMPLETE_FILE)
        limits.POINTS.check(where, declared)
        if is_packed:
            points = _read_in_other_process(path, where, declared)
        else:
            points = np.concatenate([np.empty((0, 3)), *_chunks(path)])
    if len(points) != declared:
        raise InputError(
            where, f"the header declares {declared} points, but the file contains {len(points)}", COMPLETE_FILE
        )
    return points


def _chunks(path: Path) -> Iterator[FloatArray]:
    """Yield the points in chunks."""
    import laspy

    # The serial backend: the parallel one prints what its threads raise.
    backend = laspy.LazBackend.Lazrs
    quiet = np.errstate(over="ignore", invalid="ignore")  # points that a scale makes infinite are dropped
    with quiet, path.open("rb") as file, laspy.open(file, read_evlrs=False, laz_backend=backend) as las:
        for chunk in las.chunk_iterator(_CHUNK):
            yield stack_xyz([chunk.x, chunk.y, chunk.z])


def _read_in_other_process(path: Path, where: str, declared: int) -> FloatArray:
    """Return the points of a LAZ file, at most ``declared``, decompressed by another process."""
    points = np.empty((declared, 3))
    command = [sys.executable, "-P", "-m", __name__, os.fspath(path.resolve()), str(limits.READER_MEMORY.maximum)]
    search_path = [str(_ROOT)]
    if os.environ.get("PYTHONPATH"):
        search_path.append(os.environ["PYTHONPATH"])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(search_path)}
    with (
        tempfile.TemporaryFile() as errors,
        subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=errors) as reader,
    ):
        assert reader.stdout is not None
        buffer = points.data.cast("B")
        filled = 0
        while filled < len(buffer):
            count = reader.stdout.readinto(buffer[filled:])  # type: ignore[attr-defined]
            if not count:
                break
            filled += count
        has_more = bool(reader.stdout.read(1))
        reader.stdout.close()
        code = reader.wait()
        errors.seek(0)
        lines = errors.read(100_000).decode("utf-8", "replace").strip().splitlines()
    if code < 0:
        problem = f"{_CANNOT_READ} (the decompressor was killed by signal {-code}: it needed too much memory)"
        raise InputError(where, problem, limits.READER_MEMORY.hint)
    if code or has_more:
        reason = "more points than its header declares"
        if lines:
            reason = lines[-1]
        raise InputError(where, f"{_CANNOT_READ} ({reason})", COMPLETE_FILE)
    return points[: filled // points.itemsize // 3]


def stream_points(path: Path, memory_mb: int) -> None:
    """Write the points of a file to standard output as float64, within a limit of memory."""
    platform.limit_memory(memory_mb * limits.MB)
    for points in _chunks(path):
        sys.stdout.buffer.write(points.data)


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
    return bool(head[104] & 0xC0)  # LAZ sets the upper bits of the point format


def _check_chunks(where: str, file: BinaryIO, size: int) -> None:
    """Check the number of chunks that a LAZ file declares: lazrs ends the process when there is no memory for them."""
    points_at = _number_at(file, "<I", 96)
    table_at = _number_at(file, "<q", points_at)
    if table_at == -1:  # written as a stream: the offset is at the end
        table_at = _number_at(file, "<q", size - 8)
    if not 0 < table_at <= size - 8:
        return
    chunks = _number_at(file, "<I", table_at + 4)
    if chunks > size:
        raise InputError(where, f"the file declares {chunks} chunks in {size} bytes", COMPLETE_FILE)


def _number_at(file: BinaryIO, kind: str, offset: int) -> int:
    file.seek(offset)
    return int(struct.unpack(kind, file.read(struct.calcsize(kind)))[0])


if __name__ == "__main__":
    stream_points(Path(sys.argv[1]), int(sys.argv[2]))
