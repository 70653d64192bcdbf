"""Read and write point clouds by file format (entry points).

Point clouds of empty scans are read and written here, whatever their file format.

Steps of :func:`read_points`: find the format by the file's suffix; let it read the file and bring the points into the
world frame; drop, and count, the returns that are missing (NaN) or infinite. What is not whole is refused; nothing is
guessed.

A format is an entry point of the group ``egvs.point_clouds``: its name is the suffix without the dot, its object has
``read`` and perhaps ``write`` (:class:`PointFormat`). Here, each is a module, declared in ``pyproject.toml``; other
packages may add theirs (``docs/extending.md``).

Frame: the world's (right-handed, x east, y north, z up), metres, float64; that of :func:`point_cloud_crs` where a
file says so.

Records of equal layout, as PCD and PLY files hold them: x, y and z are picked from lines of text, from binary
records, or from blocks of one field each.

Steps: the header's fields give a :class:`RecordLayout`; it checks that x, y and z are there once and that the data are
as long as the header says; its three readers return the points as float64, (n, 3), in the file's order and frame. A
text file's numbers are taken at float64 even where its header says float. What is not whole is refused; nothing is
guessed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from egvs.core import limits, plugins
from egvs.core.errors import EgvsError, InputError, MissingBackendError
from egvs.core.files import atomic_write
from egvs.core.reading import describe_exception

GROUP = "egvs.point_clouds"


class PointFormat(Protocol):
    """What reads one kind of file."""

    def read(self, path: Path, where: str, /) -> NDArray[np.float64]:
        """All points in the file's order, world frame, (n, 3) float64, those that are not finite included.

        Raises InputError at ``where`` when the file is damaged; an OSError may pass.
        """


class WritableFormat(PointFormat, Protocol):
    """What also writes it."""

    def write(self, path: Path, points_m: NDArray[np.float64], /) -> None:
        """Write (n, 3) float64 to a new file; its name may have another suffix. The same points, the same bytes."""


@runtime_checkable
class LocatedFormat(PointFormat, Protocol):
    """What also knows where on the Earth a file's points are; then ``read`` gives them in that system's units."""

    def crs_of(self, path: Path, where: str, /) -> str | None:
        """The coordinate reference system that a file declares, in a form that PROJ knows; None for none."""


def read_points(path: Path, where: str) -> tuple[NDArray[np.float64], int]:
    """Read a point cloud.

    Parameters
    ----------
    path
        A .pcd, .ply, .las, .laz or .csv file, or of a kind that an installed package adds. A .pcd's VIEWPOINT is
        applied (see :mod:`egvs.formats.pcd`).
    where
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
    where = _with_path(where, path)
    kind = _format_of_suffix(where, path, plugins.plugin_names(GROUP))
    point_format: PointFormat = plugins.load_plugin(GROUP, kind)
    reader = f"its reader {plugins.plugin_module(GROUP, kind)} (package {plugins.plugin_package(GROUP, kind)})"
    if path.is_file():
        limits.checked_size(path, limits.FILE, where)
    try:
        points = point_format.read(path, where)
    except EgvsError:
        raise
    except (OSError, MemoryError) as error:
        raise InputError(
            where, f"cannot be read ({describe_exception(error)})", "a file that is there and may be read"
        ) from None
    except (Exception, SystemExit) as error:  # whatever somebody else's reader does
        raise InputError(where, f"{reader} ended with {error!r}", "a whole file, or a mended reader") from error
    if not isinstance(points, np.ndarray) or points.dtype.kind not in "fiu":
        found = type(points).__name__ + (f" of {points.dtype}" if isinstance(points, np.ndarray) else "")
        raise InputError(where, f"{reader} returns {found}", "an array of numbers, (n, 3)")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(where, f"{reader} returns an array of the shape {points.shape}", "(n, 3)")
    limits.POINTS.check(where, len(points))
    points = points.astype(np.float64, copy=False)
    finite = np.isfinite(points).all(axis=1)
    dropped = len(points) - int(np.count_nonzero(finite))
    if dropped == len(points):
        right = "at least one return with finite x, y and z"
        raise InputError(where, f"holds no finite point (of {len(points)})", right)
    return (points[finite] if dropped else points), dropped


def point_cloud_crs(path: Path, where: str) -> str | None:
    """The coordinate reference system that a point cloud declares, as WKT; None where it, or its kind, declares none.

    For a file that :func:`read_points` has read; InputError at ``where`` when what it declares is damaged.
    """
    where = _with_path(where, path)
    point_format = plugins.load_plugin(GROUP, _format_of_suffix(where, path, plugins.plugin_names(GROUP)))
    return point_format.crs_of(path, where) if isinstance(point_format, LocatedFormat) else None


def format_of_file(path: Path, where: str) -> str:
    """The module that reads files of this kind; InputError at ``where`` when none does."""
    return plugins.plugin_module(GROUP, _format_of_suffix(_with_path(where, path), path, plugins.plugin_names(GROUP)))


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
    for name in plugins.plugin_names(GROUP):
        with suppress(MissingBackendError):  # one that is broken may not keep the others from being written
            if hasattr(loaded := plugins.load_plugin(GROUP, name), "write"):
                writable[name] = loaded
    kind = _format_of_suffix(path, path, list(writable))
    if points_m.ndim != 2 or points_m.shape[1] != 3:
        raise ValueError(f"points_m has the shape {points_m.shape}, not (n, 3)")
    with atomic_write(path) as partial:
        writable[kind].write(partial, points_m)


def _with_path(where: str, path: Path) -> str:
    return where if path.name in where else ": ".join(filter(None, (where, str(path))))


def _format_of_suffix(where: object, path: Path, kinds: list[str]) -> str:
    """Which of the kinds the suffix names."""
    if (kind := path.suffix.lower().removeprefix(".")) in kinds:
        return kind
    problem = f"is of the unknown kind {path.suffix!r}" if path.suffix else "has no suffix that tells its kind"
    raise InputError(where, problem, f"one of {', '.join(f'.{kind}' for kind in kinds)}")


AXES = ("x", "y", "z")
EXPECTED_NUMBER = "a number, or nan where nothing returned"


@dataclass(frozen=True)
class RecordLayout:
    """Where x, y and z stand among ``n`` records of ``values`` text values or ``size`` bytes each."""

    where: str
    n: int
    values: int
    size: int
    columns: tuple[int, ...]
    offsets: tuple[int, ...]
    formats: tuple[str, ...]

    @classmethod
    def of(cls, where: str, n: int, names: Sequence[str], formats: Sequence[str], counts: Sequence[int]) -> Self:
        """From the fields in their order; ``formats`` are numpy's, with byte order."""
        if n == 0:
            raise InputError(where, "holds no points, says its header", "at least one return")
        limits.POINTS.check(where, n)
        for axis in AXES:
            if names.count(axis) != 1 or counts[names.index(axis)] != 1:
                problem = f"has no single field {axis!r} (its fields: {' '.join(names) or 'none'})"
                raise InputError(where, problem, "x, y and z")
        first_columns = (0, *accumulate(counts))
        first_bytes = (0, *accumulate(np.dtype(f).itemsize * count for f, count in zip(formats, counts, strict=True)))
        at = [names.index(axis) for axis in AXES]
        columns, offsets = tuple(first_columns[i] for i in at), tuple(first_bytes[i] for i in at)
        return cls(where, n, first_columns[-1], first_bytes[-1], columns, offsets, tuple(formats[i] for i in at))

    def from_text(self, text: bytes, line: int, skip: int = 0, last: bool = True) -> NDArray[np.float64]:
        """Points from lines of text, the first of which is the file's line ``line``; ``skip`` records come before."""
        rows = [(number, row) for number, row in enumerate(text.splitlines(), line) if row.strip()][skip:]
        if len(rows) < self.n or (last and len(rows) > self.n):
            right = f"{self.n}, as its header says; a whole file"
            raise InputError(self.where, f"holds {len(rows)} lines of points", right)
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
        kind = np.dtype({"names": AXES, "formats": self.formats, "offsets": self.offsets, "itemsize": self.size})
        records = np.frombuffer(body[:need], dtype=kind)
        return stack_xyz([records[axis] for axis in AXES])

    def from_blocks(self, body: bytes | bytearray) -> NDArray[np.float64]:
        """Points from binary data that holds each field of all records as one block (PCD's binary_compressed)."""
        parts = zip(self.formats, self.offsets, strict=True)
        return stack_xyz([np.frombuffer(body, dtype=f, count=self.n, offset=offset * self.n) for f, offset in parts])

    def _fault(self, rows: list[tuple[int, bytes]], error: str) -> InputError:
        for line, row in rows:
            words, place = row.decode("latin-1").split(), f"{self.where}: line {line}"
            if len(words) != self.values:
                return InputError(place, f"holds {len(words)} values", f"{self.values} in each line")
            for word in words:
                if parse_float(word) is None:
                    return InputError(place, f"{word!r} is no number", EXPECTED_NUMBER)
        return InputError(self.where, f"cannot be read as text ({error})", "numbers apart by spaces")


def stack_xyz(columns: Sequence[NDArray[np.generic]]) -> NDArray[np.float64]:
    """Columns x, y, z of any numeric types, (n,) each, as one (n, 3) float64."""
    points = np.empty((len(columns[0]), 3))
    with np.errstate(invalid="ignore"):  # a signalling NaN marks a missing return like any other
        for axis, column in enumerate(columns):
            points[:, axis] = column
    return points


def pack_records(columns: Mapping[str, NDArray[np.generic]]) -> NDArray[np.void]:
    """Columns (n,) as records, little endian, without gaps, in the columns' order."""
    kinds = [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()]
    records = np.empty(len(next(iter(columns.values()))), dtype=kinds)
    for name, column in columns.items():
        records[name] = column
    return records


def parse_float(text: str) -> float | None:
    """A number as Python reads it, nan and inf included; None when it is none."""
    try:
        return float(text)
    except ValueError:
        return None


def parse_count(where: str, key: str, words: Sequence[str]) -> int:
    """The header's words after ``key`` as a count; InputError when they are none."""
    if len(words) != 1 or not words[0].isdecimal() or len(words[0]) > 18:
        raise InputError(where, f"{key} is {' '.join(words)!r}", "a whole number")
    return int(words[0])
