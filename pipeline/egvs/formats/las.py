"""LAS and LAZ files are read through laspy (``pip install egvs[las]``): the scaled coordinates, as the file gives them.

A packed file (LAZ) is unpacked by another process, this module run as a program: what unpacks it asks for as much
memory as a damaged file says, and ends the process that it runs in where there is none.

Frame: that of the file, which may say its coordinate reference system (:func:`crs_of`).
"""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.reading import translate_errors
from egvs.formats.point_clouds import stack_xyz

_CHUNK = 1_000_000
_EXPECTED = "a whole LAS or LAZ file"
_CANNOT_READ = "cannot be read as LAS"
_ROOT = Path(__file__).resolve().parents[2]


def read(path: Path, where: str) -> NDArray[np.float64]:
    """All points, (n, 3) float64; a damaged file, or laspy missing, is an InputError at ``where``."""
    try:
        import laspy
    except ImportError:
        raise InputError(where, "needs laspy, which is not installed", "pip install egvs[las]") from None
    size = limits.checked_size(path, limits.FILE, where)
    with translate_errors(where, _EXPECTED, _CANNOT_READ), path.open("rb") as file:
        packed = _is_packed(where, file.read(375), size)
        if packed and laspy.LazBackend.Lazrs not in laspy.LazBackend.detect_available():
            raise InputError(where, "needs lazrs, which is not installed", "pip install egvs[las]")
        if packed:
            _check_chunks(where, file, size)
        file.seek(0)
        with laspy.open(file, closefd=False, read_evlrs=False) as las:
            declared = int(las.header.point_count)
            need, held = declared * las.header.point_format.size, size - las.header.offset_to_point_data
        if held < need and not packed:
            right = f"{need}, as its header says; a whole file"
            raise InputError(where, f"holds {held} bytes of points", right)
        limits.POINTS.check(where, declared)
        points = _unpack(path, where, declared) if packed else np.concatenate([np.empty((0, 3)), *_chunks(path)])
    if len(points) != declared:
        raise InputError(where, f"holds {len(points)} points", f"{declared}, as its header says; a whole file")
    return points


def _chunks(path: Path) -> Iterator[NDArray[np.float64]]:
    """The points, piece by piece."""
    import laspy

    # The serial backend: what the parallel one raises in its threads is printed there.
    backend = laspy.LazBackend.Lazrs
    quiet = np.errstate(over="ignore", invalid="ignore")  # what a scale makes infinite is dropped
    with quiet, path.open("rb") as file, laspy.open(file, read_evlrs=False, laz_backend=backend) as las:
        for chunk in las.chunk_iterator(_CHUNK):
            yield stack_xyz([chunk.x, chunk.y, chunk.z])


def _unpack(path: Path, where: str, declared: int) -> NDArray[np.float64]:
    """The points of a packed file, at most ``declared``, as another process tells them."""
    points = np.empty((declared, 3))
    command = [sys.executable, "-P", "-m", __name__, os.fspath(path.resolve()), str(limits.READER_MEMORY.maximum)]
    own = os.environ.get("PYTHONPATH")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(_ROOT), *([own] if own else [])])}
    with (
        tempfile.TemporaryFile() as complaint,
        subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=complaint) as reader,
    ):
        assert reader.stdout is not None
        held, told = points.data.cast("B"), 0
        while told < len(held) and (got := reader.stdout.readinto(held[told:])):  # type: ignore[attr-defined]
            told += got
        more = reader.stdout.read(1)
        reader.stdout.close()
        code = reader.wait()
        complaint.seek(0)
        lines = complaint.read(100_000).decode("utf-8", "replace").strip().splitlines()
    if code < 0:
        found = f"{_CANNOT_READ} (what unpacks it ended, by signal {-code}: it asked for too much memory)"
        raise InputError(where, found, limits.READER_MEMORY.hint)
    if code or more:
        raise InputError(
            where, f"{_CANNOT_READ} ({lines[-1] if lines else 'more points than its header says'})", _EXPECTED
        )
    return points[: told // points.itemsize // 3]


def stream_points(path: Path, most_mb: int) -> None:
    """Write the points of a file to standard output, as float64, within so much memory."""
    with suppress(ImportError):  # where the system knows no such bound
        import resource

        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        most = most_mb * limits.MB if hard == resource.RLIM_INFINITY else min(hard, most_mb * limits.MB)
        resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    for points in _chunks(path):
        sys.stdout.buffer.write(points.data)


def crs_of(path: Path, where: str) -> str | None:
    """The coordinate reference system that the file's header declares, as WKT; None where it declares none.

    InputError at ``where`` where it declares one that is damaged. For a file that :func:`read` has read.
    """
    import laspy

    with (
        translate_errors(where, "a whole header", "its coordinate reference system cannot be read"),
        path.open("rb") as file,
        laspy.open(file, closefd=False, read_evlrs=False) as las,
    ):
        found = las.header.parse_crs()
        return None if found is None else str(found.to_wkt())


def _is_packed(where: str, head: bytes, size: int) -> bool:
    """Check the public header block (ASPRS LAS 1.4, table 3): laspy would follow a damaged count for hours."""
    if head[:4] != b"LASF" or len(head) < 227:
        raise InputError(where, "is not a LAS file (no LASF header)", "a whole LAS or LAZ file")
    header_size, points_at, records = struct.unpack_from("<HII", head, 94)
    if not 227 <= header_size <= points_at <= size or 54 * records > points_at - header_size:
        raise InputError(where, "its LAS header points past the file or into itself", "a whole LAS or LAZ file")
    return bool(head[104] & 0xC0)  # LAZ sets the upper bits of the point format


def _check_chunks(where: str, file: BinaryIO, size: int) -> None:
    """Check how many chunks a LAZ file says it has: lazrs would end the process when it finds no memory for them."""
    at = _number_at(file, "<q", _number_at(file, "<I", 96))
    at = _number_at(file, "<q", size - 8) if at == -1 else at  # written as a stream: the place stands at the end
    if 0 < at <= size - 8 and (chunks := _number_at(file, "<I", at + 4)) > size:
        raise InputError(where, f"says that it holds {chunks} chunks in {size} bytes", "a whole LAS or LAZ file")


def _number_at(file: BinaryIO, kind: str, at: int) -> int:
    file.seek(at)
    return int(struct.unpack(kind, file.read(struct.calcsize(kind)))[0])


if __name__ == "__main__":
    stream_points(Path(sys.argv[1]), int(sys.argv[2]))
