"""Read E57 files (ASTM E2807) with pye57 (``pip install 'egvs[las]'``): all scans, each with the pose of its station.

The points of a scan are converted with its pose to the file's common frame, in metres:

.. math:: p_\\mathrm{file} = R(q)\\, p_\\mathrm{scan} + t

A station is where :math:`t` says. A scan without a pose has no known station. Points that the scanner marks as invalid
are returned as NaN.

The file is read in chunks by another process (:mod:`egvs.formats.reader_process`): the library prints to the terminal
when a file is damaged, and trusts the counts that the file states.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.reading import COMPLETE_FILE
from egvs.formats.point_clouds import PointChunk
from egvs.formats.reader_process import Block, read_blocks, serve

_SIGNATURE = b"ASTM-E57"
_CANNOT_READ = "cannot be read as E57"
_CHUNK = 500_000
_MAX_SCANS = 10_000
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")


def read(path: Path, where: str) -> FloatArray:
    """Return the points of all scans, (n, 3) float64; InputError at ``where`` for a damaged file."""
    chunks = []
    count = 0
    for chunk in stream(path, where):
        count += len(chunk.points_m)
        limits.POINTS.check(where, count)
        chunks.append(chunk.points_m)
    return np.concatenate([np.empty((0, 3)), *chunks])


def stream(path: Path, where: str) -> Iterator[PointChunk]:
    """Yield the points in chunks, scan by scan; InputError at ``where`` for a damaged file, or if pye57 is missing."""
    for block in _blocks(path, where):
        if "scan" in block.values:
            station = block.values["station_m"]
            yield PointChunk(block.values["scan"], None if station is None else np.array(station), block.points_m)


def crs_of(path: Path, where: str) -> str | None:
    """Return the coordinate reference system that the file declares, as WKT; None if it declares none."""
    blocks = _blocks(path, where)
    try:
        text = str(next(blocks).values["crs"]).strip()
    finally:
        blocks.close()
    return text or None


def _blocks(path: Path, where: str) -> Generator[Block, None, None]:
    if find_spec("pye57") is None:
        raise InputError(where, "needs pye57, which is not installed", "Run pip install 'egvs[las]'.")
    limits.checked_size(path, limits.FILE, where)
    with path.open("rb") as file:
        if file.read(len(_SIGNATURE)) != _SIGNATURE:
            raise InputError(where, "not an E57 file: it does not begin with ASTM-E57", COMPLETE_FILE)
    yield from read_blocks(__name__, path, where, _CANNOT_READ)


# --- in the other process ---


def _read_file(path: Path) -> Iterator[Block]:
    """Yield the file's reference system, then the points of each scan in chunks."""
    import pye57

    with pye57.E57(str(path)) as file:
        root = file.root
        crs = root["coordinateMetadata"].value() if root.isDefined("coordinateMetadata") else ""
        yield Block({"crs": crs})
        if file.scan_count > _MAX_SCANS:
            raise ValueError(f"it declares {file.scan_count} scans")
        headers = [file.get_header(number) for number in range(file.scan_count)]
        poses = [_pose(header, number) for number, header in enumerate(headers)]
        if all(pose is None or pose.is_identity for pose in poses):
            poses = [None] * len(poses)  # scans that another program has joined: their stations are lost
        for number, (header, pose) in enumerate(zip(headers, poses, strict=True)):
            yield from _read_scan(file, number, header, pose)


def _read_scan(file: Any, number: int, header: Any, pose: _Pose | None) -> Iterator[Block]:
    names, invalid = _point_fields(header.point_fields, number)
    declared = header.point_count
    station = None if pose is None else pose.translation.tolist()
    columns, buffers = file.make_buffers([*names, *invalid], min(declared, _CHUNK))
    reader = header.points.reader(buffers)
    count = 0
    while count < declared:
        read_now = reader.read()
        if not read_now:
            raise ValueError(f"scan {number} declares {declared} points, but contains {count}")
        count += read_now
        points = np.column_stack([columns[name][:read_now] for name in names])
        if names == _SPHERICAL:
            points = _to_cartesian(points)
        for name in invalid:
            points[columns[name][:read_now] != 0] = np.nan
        with np.errstate(invalid="ignore", over="ignore"):
            if pose is not None:
                points = _rotated(points, pose.rotation) + pose.translation
        yield Block.of_points({"scan": number, "station_m": station}, points)
    reader.close()


def _point_fields(fields: list[str], number: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the coordinates, and of the field that marks invalid points, if there is one."""
    for names, invalid in ((_CARTESIAN, "cartesianInvalidState"), (_SPHERICAL, "sphericalInvalidState")):
        if set(names) <= set(fields):
            return names, (invalid,) if invalid in fields else ()
    raise ValueError(f"scan {number} has neither cartesian nor spherical coordinates, but {' '.join(fields)[:200]}")


class _Pose(NamedTuple):
    """Rotation (3, 3) and translation (3,) of a scan."""

    rotation: FloatArray
    translation: FloatArray

    @property
    def is_identity(self) -> bool:
        return not self.translation.any() and bool((self.rotation == np.eye(3)).all())


def _pose(header: Any, number: int) -> _Pose | None:
    """Return the pose of a scan; None if it has none."""
    if not header.has_pose():
        return None
    w, x, y, z = quaternion = np.asarray(header.rotation, dtype=np.float64)
    translation = np.asarray(header.translation, dtype=np.float64)
    if not (np.isfinite(translation).all() and abs(float(np.linalg.norm(quaternion)) - 1.0) < 1e-3):
        raise ValueError(f"scan {number} has no valid pose: {quaternion.tolist()}, {translation.tolist()}")
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return _Pose(rotation, translation)


def _rotated(points: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return R p in plain sums: the last bits of a matrix product depend on the machine."""
    x, y, z = points.T
    return np.column_stack([row[0] * x + row[1] * y + row[2] * z for row in rotation])


def _to_cartesian(points: FloatArray) -> FloatArray:
    """Return x, y, z of range, azimuth and elevation in radians (ASTM E2807, 3.1)."""
    range_m, azimuth, elevation = points.T
    flat = range_m * np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), range_m * np.sin(elevation)])


if __name__ == "__main__":
    serve(_read_file)
