"""LAS and LAZ files are read through laspy (``pip install egvs[las]``): the scaled coordinates, as the file gives them.

Frame: that of the file, which may say its coordinate reference system (:func:`crs_of`).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipeline.core.errors import InputError
from pipeline.formats.point_records import columns_of

_CHUNK = 1_000_000


def read(path: Path, place: str) -> NDArray[np.float64]:
    """All points, (n, 3) float64; a damaged file, or laspy missing, is an InputError at ``place``."""
    try:
        import laspy
    except ImportError:
        raise InputError(place, "needs laspy, which is not installed", "pip install egvs[las]") from None
    # The serial backend: the parallel one ends the whole process on a damaged file.
    backend = laspy.LazBackend.Lazrs
    damaged = (laspy.LaspyException, RuntimeError, ValueError, struct.error, MemoryError)  # RuntimeError: lazrs
    quiet = np.errstate(over="ignore", invalid="ignore")  # what a scale makes infinite is dropped
    size = path.stat().st_size
    with path.open("rb") as file:
        packed = _is_packed(place, file.read(375), size)
        if packed and backend not in laspy.LazBackend.detect_available():
            raise InputError(place, "needs lazrs, which is not installed", "pip install egvs[las]")
        try:
            if packed:
                _check_chunks(place, file, size)
            file.seek(0)
            with quiet, laspy.open(file, closefd=False, read_evlrs=False, laz_backend=backend) as las:
                declared = int(las.header.point_count)
                need, held = declared * las.header.point_format.size, size - las.header.offset_to_point_data
                if held < need and not packed:
                    right = f"{need}, as its header says; a whole file"
                    raise InputError(place, f"holds {held} bytes of points", right)
                chunks = [columns_of([chunk.x, chunk.y, chunk.z]) for chunk in las.chunk_iterator(_CHUNK)]
        except BaseException as error:
            # lazrs panics, which is no Exception, and its class cannot be imported.
            if not isinstance(error, damaged) and type(error).__name__ != "PanicException":
                raise
            raise InputError(place, f"cannot be read as LAS ({error})", "a whole LAS or LAZ file") from None
    points = np.concatenate([np.empty((0, 3)), *chunks])
    if len(points) != declared:
        raise InputError(place, f"holds {len(points)} points", f"{declared}, as its header says; a whole file")
    return points


def crs_of(path: Path, place: str) -> str | None:
    """The coordinate reference system that the file's header declares, as WKT; None where it declares none.

    InputError at ``place`` where it declares one that is damaged. For a file that :func:`read` has read.
    """
    import laspy
    from pyproj.exceptions import CRSError

    try:
        with path.open("rb") as file, laspy.open(file, closefd=False, read_evlrs=False) as las:
            found = las.header.parse_crs()
    except (CRSError, laspy.LaspyException, ValueError, struct.error) as error:
        raise InputError(place, f"its coordinate reference system cannot be read ({error})", "a whole header") from None
    return None if found is None else str(found.to_wkt())


def _is_packed(place: str, head: bytes, size: int) -> bool:
    """Check the public header block (ASPRS LAS 1.4, table 3): laspy would follow a damaged count for hours."""
    if head[:4] != b"LASF" or len(head) < 227:
        raise InputError(place, "is not a LAS file (no LASF header)", "a whole LAS or LAZ file")
    header_size, points_at, records = struct.unpack_from("<HII", head, 94)
    if not 227 <= header_size <= points_at <= size or 54 * records > points_at - header_size:
        raise InputError(place, "its LAS header points past the file or into itself", "a whole LAS or LAZ file")
    return bool(head[104] & 0xC0)  # LAZ sets the upper bits of the point format


def _check_chunks(place: str, file: BinaryIO, size: int) -> None:
    """Check how many chunks a LAZ file says it has: lazrs would end the process when it finds no memory for them."""
    at = _number_at(file, "<q", _number_at(file, "<I", 96))
    at = _number_at(file, "<q", size - 8) if at == -1 else at  # written as a stream: the place stands at the end
    if 0 < at <= size - 8 and (chunks := _number_at(file, "<I", at + 4)) > size:
        raise InputError(place, f"says that it holds {chunks} chunks in {size} bytes", "a whole LAS or LAZ file")


def _number_at(file: BinaryIO, kind: str, at: int) -> int:
    file.seek(at)
    return int(struct.unpack(kind, file.read(struct.calcsize(kind)))[0])
