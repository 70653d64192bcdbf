"""Point clouds of empty scans are read and written here, whatever their file format.

Steps of :func:`read_points`: find the format by the file's suffix; let it read the file and bring the points into the
world frame; drop, and count, the returns that are missing (NaN) or infinite. What is not whole is refused; nothing is
guessed.

A format is an entry point of the group ``egvs.point_clouds``: its name is the suffix without the dot, its object has
``read`` and perhaps ``write`` (:class:`PointFormat`). Here, each is a module, declared in ``pyproject.toml``; other
packages may add theirs (``docs/extending.md``).

Frame: the world's (right-handed, x east, y north, z up), metres, float64; that of :func:`crs_of` where a file says so.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from pipeline.core import plugins
from pipeline.core.errors import EgvsError, InputError, MissingBackendError
from pipeline.core.files import aside
from pipeline.core.reading import limits
from pipeline.core.reading.refusing import why

GROUP = "egvs.point_clouds"


class PointFormat(Protocol):
    """What reads one kind of file."""

    def read(self, path: Path, place: str, /) -> NDArray[np.float64]:
        """All points in the file's order, world frame, (n, 3) float64, those that are not finite included.

        Raises InputError at ``place`` when the file is damaged; an OSError may pass.
        """


class WritableFormat(PointFormat, Protocol):
    """What also writes it."""

    def write(self, path: Path, points_m: NDArray[np.float64], /) -> None:
        """Write (n, 3) float64 to a new file; its name may have another suffix. The same points, the same bytes."""


@runtime_checkable
class LocatedFormat(PointFormat, Protocol):
    """What also knows where on the Earth a file's points are; then ``read`` gives them in that system's units."""

    def crs_of(self, path: Path, place: str, /) -> str | None:
        """The coordinate reference system that a file declares, in a form that PROJ knows; None for none."""


def read_points(path: Path, place: str) -> tuple[NDArray[np.float64], int]:
    """Read a point cloud.

    Parameters
    ----------
    path
        A .pcd, .ply, .las, .laz or .csv file, or of a kind that an installed package adds. A .pcd's VIEWPOINT is
        applied (see :mod:`pipeline.formats.pcd`).
    place
        Who names the file, for messages, e.g. ``"sites.csv: row A"``; the path is added when the place does not hold
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
        When the file is missing, of an unknown kind, damaged, or without one finite point; or when what reads its
        kind fails or returns anything but points.
    """
    place = _with_path(place, path)
    kind = _kind(place, path, plugins.names(GROUP))
    point_format: PointFormat = plugins.load(GROUP, kind)
    reader = f"its reader {plugins.module_of(GROUP, kind)} (package {plugins.package_of(GROUP, kind)})"
    if path.is_file():
        limits.size_of(path, limits.FILE, place)
    try:
        points = point_format.read(path, place)
    except EgvsError:
        raise
    except (OSError, MemoryError) as error:
        raise InputError(place, f"cannot be read ({why(error)})", "a file that is there and may be read") from None
    except (Exception, SystemExit) as error:  # whatever somebody else's reader does
        raise InputError(place, f"{reader} ended with {error!r}", "a whole file, or a mended reader") from error
    if not isinstance(points, np.ndarray) or points.dtype.kind not in "fiu":
        found = type(points).__name__ + (f" of {points.dtype}" if isinstance(points, np.ndarray) else "")
        raise InputError(place, f"{reader} returns {found}", "an array of numbers, (n, 3)")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(place, f"{reader} returns an array of the shape {points.shape}", "(n, 3)")
    limits.POINTS.check(place, len(points))
    points = points.astype(np.float64, copy=False)
    finite = np.isfinite(points).all(axis=1)
    dropped = len(points) - int(np.count_nonzero(finite))
    if dropped == len(points):
        right = "at least one return with finite x, y and z"
        raise InputError(place, f"holds no finite point (of {len(points)})", right)
    return (points[finite] if dropped else points), dropped


def crs_of(path: Path, place: str) -> str | None:
    """The coordinate reference system that a point cloud declares, as WKT; None where it, or its kind, declares none.

    For a file that :func:`read_points` has read; InputError at ``place`` when what it declares is damaged.
    """
    place = _with_path(place, path)
    point_format = plugins.load(GROUP, _kind(place, path, plugins.names(GROUP)))
    return point_format.crs_of(path, place) if isinstance(point_format, LocatedFormat) else None


def reader_of(path: Path, place: str) -> str:
    """The module that reads files of this kind; InputError at ``place`` when none does."""
    return plugins.module_of(GROUP, _kind(_with_path(place, path), path, plugins.names(GROUP)))


def write_points(path: Path, points_m: NDArray[np.float64]) -> None:
    """Write a point cloud, whole or not at all; the same points give the same bytes.

    Parameters
    ----------
    path
        A .pcd (binary, VIEWPOINT identity) or .ply (binary little endian) file, both of which hold x, y, z as float64,
        or of a kind that an installed package can write.
    points_m
        World frame, (n, 3) float64. Read back from .pcd and .ply, they are the same to the bit.

    Raises
    ------
    InputError
        When no format with that suffix can be written.
    """
    writable: dict[str, WritableFormat] = {}
    for name in plugins.names(GROUP):
        with suppress(MissingBackendError):  # one that is broken may not keep the others from being written
            if hasattr(loaded := plugins.load(GROUP, name), "write"):
                writable[name] = loaded
    kind = _kind(path, path, list(writable))
    if points_m.ndim != 2 or points_m.shape[1] != 3:
        raise ValueError(f"points_m has the shape {points_m.shape}, not (n, 3)")
    with aside(path) as partial:
        writable[kind].write(partial, points_m)


def _with_path(place: str, path: Path) -> str:
    return place if path.name in place else ": ".join(filter(None, (place, str(path))))


def _kind(place: object, path: Path, kinds: list[str]) -> str:
    """Which of the kinds the suffix names."""
    if (kind := path.suffix.lower().removeprefix(".")) in kinds:
        return kind
    problem = f"is of the unknown kind {path.suffix!r}" if path.suffix else "has no suffix that tells its kind"
    raise InputError(place, problem, f"one of {', '.join(f'.{kind}' for kind in kinds)}")
