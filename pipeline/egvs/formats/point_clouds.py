"""Read and write point clouds of any format in the table of readers (:mod:`egvs.core.readers`).

Steps of :func:`read_points`: find the format by the file's suffix; read the file; drop, and count, the points that are
NaN or infinite, which mark missing returns, and those that the file marks as errors (:data:`NOISE`). Incomplete files
are rejected.

The module of a format has a function ``read`` and may have ``write``, ``crs_of``, ``stream`` and ``read_field``
(:class:`PointFormat`). The formats of this program are in :mod:`egvs.formats.readers`; other packages may add theirs
(``docs/extending.md``).

Points are in the world frame (right-handed, x east, y north, z up), metres, float64, or in the coordinate reference
system that the file declares (:func:`point_cloud_crs`).

:class:`RecordLayout` reads records of equal size, as in PCD and PLY files: some fields (by default x, y and z) from
lines of text, from binary records, or from blocks of one field each. Numbers in text files are read as float64 even
where the header says float.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from egvs.core import limits, readers
from egvs.core.errors import EgvsError, InputError, MissingBackendError
from egvs.core.files import atomic_write
from egvs.core.grid import BoolArray, FloatArray
from egvs.core.numbers import parse_decimal
from egvs.core.readers import Reader
from egvs.core.reading import COMPLETE_FILE, describe_exception, translate_errors
from egvs.formats.georeference import parse_crs

KIND = "points"
"""Kind of the readers of point clouds."""


class PointFormat(Protocol):
    """A file format that can be read."""

    def read(self, path: Path, where: str, /) -> FloatArray:
        """Return all points in the file's order, world frame, (n, 3) float64, including those that are not finite.

        Raises InputError at ``where`` when the file is damaged; an OSError may pass.
        """


class WritableFormat(PointFormat, Protocol):
    """A file format that can also be written."""

    def write(self, path: Path, points_m: FloatArray, /) -> None:
        """Write (n, 3) float64 to a new file, whose name may have another suffix. Equal points give equal bytes."""


@runtime_checkable
class LocatedFormat(PointFormat, Protocol):
    """A file format that can declare a coordinate reference system, in whose units ``read`` returns the points."""

    def crs_of(self, path: Path, where: str, /) -> str | None:
        """Return the coordinate reference system of a file, in a form that PROJ knows; None if it declares none."""


@runtime_checkable
class FieldFormat(PointFormat, Protocol):
    """A file format whose points may have more than coordinates."""

    def read_field(self, path: Path, where: str, names: Sequence[str], /) -> FloatArray | None:
        """Return the first of these fields that a file has, (n,) float64 in its order; None if it has none of them."""


class PointChunk(NamedTuple):
    """Some of the points of a file.

    Attributes
    ----------
    scan
        Number of the scan that they are from, from 0; a file has one scan, or several that follow one another.
    station_m
        Where the scanner stood, (3,) float64 in the frame of the points; None if the file does not say.
    points_m
        (n, 3) float64, including points that are not finite.
    marked
        How many of these points the file marks as errors, by the mark; their coordinates are NaN.
    """

    scan: int
    station_m: FloatArray | None
    points_m: FloatArray
    marked: Mapping[str, int] = MappingProxyType({})


NOISE = {7: "noise (class 7)", 18: "noise (class 18)"}
"""Classes of LAS whose points are errors of measurement, low and high, with their names in notes."""

CLASS_FIELDS = ("classification", "Classification", "scalar_Classification")
"""Names of the field with the class of LAS in PCD and PLY files of PDAL and CloudCompare."""


def drop_marked(points_m: FloatArray, marks: Mapping[str, BoolArray]) -> dict[str, int]:
    """Set points, (n, 3), with a mark to NaN in place, and return how many have each mark; the first one counts."""
    counts = {}
    left = np.ones(len(points_m), dtype=np.bool_)
    for name, mask in marks.items():
        count = int(np.count_nonzero(mask & left))
        if count:
            counts[name] = count
            left &= ~mask
    if counts:
        points_m[~left] = np.nan
    return counts


def drop_noise(points_m: FloatArray, classes: FloatArray | None) -> dict[str, int]:
    """Set points, (n, 3), of the noise classes to NaN in place, and return their numbers; none without classes (n,)."""
    if classes is None:
        return {}
    return drop_marked(points_m, {name: classes == number for number, name in NOISE.items()})


@runtime_checkable
class StreamedFormat(PointFormat, Protocol):
    """A file format that is read in chunks, or that says where scanners stood."""

    def stream(self, path: Path, where: str, /) -> Iterator[PointChunk]:
        """Yield the points in the file's order; InputError at ``where`` when the file is damaged."""


def read_points(path: Path, where: str) -> tuple[FloatArray, int]:
    """Return the finite points of a file, in its order, (n, 3) float64, n >= 1, and how many others it has.

    Parameters
    ----------
    path
        A .pcd, .ply, .las, .laz or .csv file, or of a format that an installed package adds. A .pcd's VIEWPOINT is
        applied (see :mod:`egvs.formats.pcd`).
    where
        File and row that name the point cloud, for messages, e.g. ``"sites.csv: row A"``; the path is added unless its
        name is in it.

    Raises
    ------
    InputError
        When the file is missing, of an unknown format, damaged, or without a finite point; or when its reader fails or
        does not return points.
    """
    where = _with_path(where, path)
    points = _read_all(path, where)
    drop_noise(points, read_field(path, where, CLASS_FIELDS))
    finite = np.isfinite(points).all(axis=1)
    dropped = len(points) - int(np.count_nonzero(finite))
    if dropped == len(points):
        problem = f"expected at least one return with finite x, y and z, got none of {len(points)}"
        raise InputError(where, problem, COMPLETE_FILE)
    return points[finite] if dropped else points, dropped


def _read_all(path: Path, where: str) -> FloatArray:
    """Return all points of a file, (n, 3) float64, including those that are not finite."""
    reader = _find_reader(path, where)
    point_format: PointFormat = _load_format(reader)
    if path.is_file():
        limits.checked_size(path, limits.FILE, where)
    title = f"its reader {reader.module} (package {readers.reader_package(reader)})"
    return _read_with(point_format, path, where, title)


def _read_with(point_format: PointFormat, path: Path, where: str, reader: str) -> FloatArray:
    """Return what a format reads, as (n, 3) float64; InputError when it fails or returns something else."""
    hint = f"Check the file, or fix {reader}."
    try:
        points = point_format.read(path, where)
    except EgvsError:
        raise
    except (OSError, MemoryError) as error:
        problem = f"cannot be read ({describe_exception(error)})"
        raise InputError(where, problem, "Check the path, the permissions, and that the file is complete.") from None
    except (Exception, SystemExit) as error:  # a reader of another package may raise anything
        raise InputError(where, f"{reader} raised {error!r}", hint) from error
    if not isinstance(points, np.ndarray):
        raise InputError(where, f"{reader} returns {type(points).__name__}, not an array", hint)
    if points.dtype.kind not in "fiu" or points.ndim != 2 or points.shape[1] != 3:
        problem = f"{reader} returns a {points.dtype} array of shape {points.shape}, not numbers of shape (n, 3)"
        raise InputError(where, problem, hint)
    limits.POINTS.check(where, len(points))
    return points.astype(np.float64, copy=False)


def stream_points(path: Path, where: str) -> Iterator[PointChunk]:
    """Yield the points of a file in chunks, where its format allows that, else all at once.

    Parameters
    ----------
    path
        As for :func:`read_points`.
    where
        The file, for messages.

    Raises
    ------
    InputError
        While iterating, as :func:`read_points`; but points that are not finite are kept, and there is no limit of their
        number where they come in chunks.
    """
    where = _with_path(where, path)
    point_format = _load_format(_find_reader(path, where))
    if not isinstance(point_format, StreamedFormat):
        points = _read_all(path, where)
        yield PointChunk(0, None, points, drop_noise(points, read_field(path, where, CLASS_FIELDS)))
        return
    limits.checked_size(path, limits.FILE, where)
    with translate_errors(where, COMPLETE_FILE):
        yield from point_format.stream(path, where)


def read_field(path: Path, where: str, names: Sequence[str]) -> FloatArray | None:
    """Return a field of all points of a file besides x, y and z.

    Parameters
    ----------
    path
        A file that :func:`read_points` can read.
    where
        The file, for messages.
    names
        Names of the field; the first that the file has counts.

    Returns
    -------
    field
        One value per point, (n,) float64 in the file's order; None if the file has no such field, or its format none
        at all.

    Raises
    ------
    InputError
        If the file is damaged.
    """
    where = _with_path(where, path)
    point_format = _load_format(_find_reader(path, where))
    if not isinstance(point_format, FieldFormat):
        return None
    limits.checked_size(path, limits.FILE, where)
    with translate_errors(where, COMPLETE_FILE):
        return point_format.read_field(path, where, names)


def point_cloud_crs(path: Path, where: str) -> str | None:
    """Return the coordinate reference system that a point cloud declares; None if it declares none.

    For a file that :func:`read_points` has read; InputError at ``where`` when the declaration is damaged, or when PROJ
    does not know the system.
    """
    where = _with_path(where, path)
    point_format = _load_format(_find_reader(path, where))
    crs = point_format.crs_of(path, where) if isinstance(point_format, LocatedFormat) else None
    if not (crs or "").strip(" \t\r\n\0\"'"):
        return None
    parse_crs(crs, where)
    return crs


def other_point_cloud_crs(path: Path, where: str) -> str | None:
    """Return a second reference system that a point cloud declares, and that does not count; None if it is unknown."""
    where = _with_path(where, path)
    point_format = _load_format(_find_reader(path, where))
    other_crs_of = getattr(point_format, "other_crs_of", None)
    with suppress(InputError):
        if other_crs_of is not None and (crs := other_crs_of(path)) is not None:
            parse_crs(crs, where)
            return str(crs)
    return None


def format_of_file(path: Path, where: str) -> str:
    """Return the module that reads files with this suffix; InputError at ``where`` if no reader knows the suffix."""
    return _find_reader(path, _with_path(where, path)).module


def write_points(path: Path, points_m: FloatArray) -> None:
    """Write a point cloud atomically; equal points give equal bytes.

    Parameters
    ----------
    path
        A .pcd (binary, VIEWPOINT identity) or .ply (binary little endian) file, which store float64, or of a format
        that an installed package can write.
    points_m
        World frame, (n, 3) float64. Read back from .pcd and .ply, they are equal to the bit.

    Raises
    ------
    InputError
        When no format with that suffix can be written.
    """
    writable: dict[str, WritableFormat] = {}
    for suffix, reader in _readers_by_suffix().items():
        with suppress(MissingBackendError):  # a broken plug-in must not disable the others
            point_format = _load_format(reader)
            if hasattr(point_format, "write"):
                writable[suffix] = point_format
    suffix = _known_suffix(path, path, writable)
    if points_m.ndim != 2 or points_m.shape[1] != 3:
        raise ValueError(f"points_m has the shape {points_m.shape}, not (n, 3)")
    with atomic_write(path) as partial:
        writable[suffix].write(partial, points_m)


def _with_path(where: str, path: Path) -> str:
    """Return the location with the path, unless it contains the file's name already."""
    if path.name in where:
        return where
    return f"{where}: {path}" if where else str(path)


def _readers_by_suffix() -> dict[str, Reader]:
    """Return the readers of point clouds by suffix; of several, the first one."""
    by_suffix = {suffix: reader for reader in reversed(readers.list_readers(KIND)) for suffix in reader.suffixes}
    return dict(sorted(by_suffix.items()))


def _find_reader(path: Path, where: str) -> Reader:
    by_suffix = _readers_by_suffix()
    return by_suffix[_known_suffix(path, where, by_suffix)]


def _load_format(reader: Reader) -> Any:
    return readers.load_reader(reader, ("read",), "a module with a function read")


def _known_suffix(path: Path, where: object, known: Iterable[str]) -> str:
    """Return the suffix of a file; InputError unless it is known."""
    suffix = path.suffix.lower()
    if suffix in known:
        return suffix
    problem = f"unknown file format {path.suffix!r}" if path.suffix else "the file name has no suffix"
    raise InputError(where, problem, f"Use one of {', '.join(known)}.")


AXES = ("x", "y", "z")
PADDING = b"\0 \t\n\r\v\f"
"""Bytes that may follow the last point: programs fill files up to whole blocks."""
NUMBER_HINT = "Use a number, or nan for a missing return."


@dataclass(frozen=True)
class RecordLayout:
    """Positions of some fields, by default x, y and z, in records of equal size.

    Attributes
    ----------
    where
        The file, for messages.
    n
        Number of records.
    values, size
        Values of a record in text, and bytes of a binary record.
    columns, offsets, formats
        Column in text, offset in a binary record, and numpy format of each field that is read.
    """

    where: str
    n: int
    values: int
    size: int
    columns: tuple[int, ...]
    offsets: tuple[int, ...]
    formats: tuple[str, ...]

    @classmethod
    def from_fields(
        cls,
        where: str,
        n: int,
        names: Sequence[str],
        formats: Sequence[str],
        counts: Sequence[int],
        read: Sequence[str] = AXES,
    ) -> Self:
        """Return the layout of records with fields of these names, numpy formats (with byte order) and counts.

        InputError when there are no points or too many, or not exactly one field each of those that are ``read``.
        """
        if n == 0:
            raise InputError(where, "the header declares 0 points", "Use a file with at least one return.")
        limits.POINTS.check(where, n)
        for name in read:
            if names.count(name) != 1 or counts[names.index(name)] != 1:
                problem = f"expected one field {name!r}, got the fields {' '.join(names) or 'none'}"
                hint = "Write one field for each of x, y and z." if name in AXES else f"Write one field {name}."
                raise InputError(where, problem, hint)
        sizes = [np.dtype(kind).itemsize * count for kind, count in zip(formats, counts, strict=True)]
        columns = (0, *accumulate(counts))
        offsets = (0, *accumulate(sizes))
        fields = [names.index(name) for name in read]
        first, start = [tuple(values[i] for i in fields) for values in (columns, offsets)]
        return cls(where, n, columns[-1], offsets[-1], first, start, tuple(formats[i] for i in fields))

    def from_text(self, text: bytes, line: int, skip: int = 0, last: bool = True) -> FloatArray:
        """Return the fields that are read, from lines of text.

        Parameters
        ----------
        text
            The lines; empty ones are ignored.
        line
            Number of the first line in the file, for messages.
        skip
            Number of other records that come first.
        last
            Whether nothing may follow the points.
        """
        rows = [(number, row) for number, row in enumerate(text.splitlines(), line) if row.strip(PADDING)][skip:]
        if len(rows) < self.n or (last and len(rows) > self.n):
            raise InputError(
                self.where,
                f"the header declares {self.n} points, but the file contains {len(rows)} lines",
                COMPLETE_FILE,
            )
        rows = rows[: self.n]
        try:
            table = np.loadtxt([row for _, row in rows], comments=None, encoding="latin-1", ndmin=2)
        except ValueError as error:
            raise self._text_error(rows, str(error)) from None
        if table.shape[1] != self.values:
            raise self._text_error(rows, f"lines of {table.shape[1]} values")
        return np.ascontiguousarray(table[:, self.columns], dtype=np.float64)

    def from_records(self, body: memoryview, last: bool = True) -> FloatArray:
        """Return the fields that are read from binary records; only padding may follow the ``last`` ones."""
        expected = self.n * self.size
        if len(body) < expected or (last and bytes(body[expected:]).strip(PADDING)):
            problem = (
                f"the header declares {self.n} points of {self.size} bytes ({expected} bytes), but the file contains"
                f" {len(body)} bytes"
            )
            raise InputError(self.where, problem, COMPLETE_FILE)
        names = [str(number) for number in range(len(self.formats))]
        kind = np.dtype({"names": names, "formats": self.formats, "offsets": self.offsets, "itemsize": self.size})
        records = np.frombuffer(body[:expected], dtype=kind)
        return stack_columns([records[name] for name in names])

    def from_blocks(self, body: bytes | bytearray) -> FloatArray:
        """Return the fields that are read from binary data with one block per field (PCD's binary_compressed)."""
        blocks = zip(self.formats, self.offsets, strict=True)
        return stack_columns([np.frombuffer(body, kind, self.n, offset * self.n) for kind, offset in blocks])

    def _text_error(self, rows: list[tuple[int, bytes]], error: str) -> InputError:
        """Return the error for the first line that is wrong, which numpy's message does not name."""
        for line, row in rows:
            words = row.decode("latin-1").split()
            where = f"{self.where}: line {line}"
            if len(words) != self.values:
                return InputError(where, f"expected {self.values} values, got {len(words)}", COMPLETE_FILE)
            for word in words:
                if parse_float(word) is None:
                    return InputError(where, f"expected a number, got {word!r}", NUMBER_HINT)
        return InputError(
            self.where, f"expected {self.values} numbers in each line ({error})", "Separate the numbers with spaces."
        )


def stack_columns(columns: Sequence[NDArray[np.generic]]) -> FloatArray:
    """Return columns of any numeric types, (n,) each, such as x, y and z, as one (n, columns) float64."""
    points = np.empty((len(columns[0]), len(columns)))
    with np.errstate(invalid="ignore"):  # a signalling NaN marks a missing return like any other
        for number, column in enumerate(columns):
            points[:, number] = column
    return points


def pack_records(columns: Mapping[str, NDArray[np.generic]]) -> NDArray[np.void]:
    """Return columns (n,) as records, little endian, without gaps, in the columns' order."""
    kinds = [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()]
    records = np.empty(len(next(iter(columns.values()))), dtype=kinds)
    for name, column in columns.items():
        records[name] = column
    return records


def parse_float(text: str) -> float | None:
    """Parse a number, including nan and inf; None if the text is not a number."""
    try:
        return parse_decimal(text)
    except ValueError:
        return None


def parse_count(where: str, key: str, words: Sequence[str]) -> int:
    """Parse the words after a header's ``key`` as a count; InputError unless they are one whole number."""
    if len(words) != 1 or not words[0].isdecimal() or len(words[0]) > 18:
        raise InputError(where, f"{key}: expected a whole number, got {' '.join(words)!r}", COMPLETE_FILE)
    return int(words[0])
