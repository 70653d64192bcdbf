"""What the readers of boxes share: rows, checks of their values, names of classes, rotations."""

from __future__ import annotations

import math
import re
from array import array
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.extensions.tracks.columns import MAX_ANGLE_RAD, MAX_SIZE_M, MAX_TIME_S
from egvs.extensions.tracks.model import TrackFrame, Tracks
from egvs.scenario.fields import MAX_COORDINATE_M

_RANGES = {
    "time_s": (-MAX_TIME_S, MAX_TIME_S), "x_m": (-MAX_COORDINATE_M, MAX_COORDINATE_M),
    "y_m": (-MAX_COORDINATE_M, MAX_COORDINATE_M), "z_m": (-MAX_COORDINATE_M, MAX_COORDINATE_M),
    "yaw_rad": (-MAX_ANGLE_RAD, MAX_ANGLE_RAD), "length_m": (0.0, MAX_SIZE_M), "width_m": (0.0, MAX_SIZE_M),
    "height_m": (0.0, MAX_SIZE_M),
}  # fmt: skip
_REQUIRED = ("time_s", "x_m", "y_m")
_MAX_NAME_LENGTH = 200
"""Names are kept as long as the longest one, for each row."""


class Box(NamedTuple):
    """A box of a road user, as in :class:`egvs.extensions.tracks.model.Tracks`; NaN where a value is not given."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    length_m: float
    width_m: float
    height_m: float


Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Pose:
    """A rotation and a translation from one frame to another: p_to = rotation p_from + translation.

    Attributes
    ----------
    rotation
        Rows of the matrix.
    translation
        In metres.
    """

    rotation: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    translation: Vector = (0.0, 0.0, 0.0)

    @classmethod
    def from_arrays(cls, rotation: FloatArray, translation: Sequence[float] | FloatArray) -> Pose:
        """Return a pose of arrays (3, 3) and (3,)."""
        x, y, z = ((float(a), float(b), float(c)) for a, b, c in rotation)
        east, north, up = map(float, translation)
        return cls((x, y, z), (east, north, up))

    def box(self, centre: Sequence[float], front: Sequence[float], size: Sequence[float]) -> Box:
        """Return a box in the other frame.

        Parameters
        ----------
        centre
            x, y, z, in metres.
        front
            A vector to the front, of any length; the heading is not given if it is 0.
        size
            Length, width and height, in metres.
        """
        x, y, z = (
            a * centre[0] + b * centre[1] + c * centre[2] + shift
            for (a, b, c), shift in zip(self.rotation, self.translation, strict=True)
        )
        ahead, left = (a * front[0] + b * front[1] + c * front[2] for a, b, c in self.rotation[:2])
        yaw = math.nan if ahead == 0 == left else math.atan2(left, ahead)
        return Box(x, y, z, yaw, size[0], size[1], size[2])


class BoxRows:
    """Collects boxes row by row.

    Parameters
    ----------
    path
        The file, for messages.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._names: list[str] = []
        self._classes: list[str] = []
        self._numbers = array("d")

    def add(self, file: Path, name: str, cls: str, time_s: float, box: Box) -> None:
        """Append a row: the file it is from, the name of the track, the class, the time and the box.

        InputError as of :func:`make_tracks`.
        """
        _check_name(file, name)
        for (key, (lowest, highest)), value in zip(_RANGES.items(), (time_s, *box), strict=True):
            if not lowest <= value <= highest and (key in _REQUIRED or not math.isnan(value)):
                raise _range_error(file, name, time_s, key, value)
        self._names.append(name)
        self._classes.append(cls)
        self._numbers.extend((time_s, *box))
        limits.ROWS.check(self._path, len(self._names))

    def to_tracks(self, frame: TrackFrame, sources: Sequence[str]) -> Tracks:
        """Return the tracks; InputError as of :func:`make_tracks`."""
        columns = np.frombuffer(self._numbers, dtype=np.float64).reshape(-1, len(_RANGES)).T.copy()
        return make_tracks(
            self._path, self._names, self._classes, dict(zip(_RANGES, columns, strict=True)), frame, sources
        )


def make_tracks(
    path: Path,
    names: Sequence[str],
    classes: Sequence[str],
    columns: Mapping[str, FloatArray],
    frame: TrackFrame,
    sources: Sequence[str],
) -> Tracks:
    """Return tracks of rows; parameters as of :meth:`Tracks.from_rows`.

    Raises
    ------
    InputError
        When there is no row, a name is too long, or a number is impossible: not finite, a negative size, a position
        outside the Earth.
    """
    if not names:
        raise InputError(path, "contains no boxes of road users", "Use a file with labelled or tracked road users.")
    limits.ROWS.check(path, len(names))
    _check_name(path, max(names, key=len))
    for key, values in columns.items():
        lowest, highest = _RANGES[key]
        is_valid = (values >= lowest) & (values <= highest)
        if key not in _REQUIRED:
            is_valid |= np.isnan(values)
        for row in np.flatnonzero(~is_valid).tolist():
            raise _range_error(path, names[row], float(columns["time_s"][row]), key, float(values[row]))
    return Tracks.from_rows(names, classes, columns, frame, sources)


def _check_name(file: Path, name: str) -> None:
    if len(name) > _MAX_NAME_LENGTH:
        problem = f"expected a name of at most {_MAX_NAME_LENGTH:,} characters, got {len(name):,}"
        raise InputError(f"{file}: track {name[:80]!r}", problem, "Use a shorter name.")


def _range_error(file: Path, name: str, time_s: float, key: str, value: float) -> InputError:
    lowest, highest = _RANGES[key]
    problem = f"expected a number between {lowest:g} and {highest:g}, got {value:g}"
    where = f"{file}: track {name[:80]!r}, time {time_s:g} s: {key}"
    return InputError(where, problem, "Correct the row, or remove it.")


class ClassNames:
    """Converts a format's names of classes to ours, and counts those that it drops or does not know.

    Capitals and anything that is not a letter do not count: ``EMERGENCY_VEHICLE`` is ``emergencyvehicle``.

    Parameters
    ----------
    known
        Class of each name.
    static
        Names of what does not move; their rows are dropped.
    """

    def __init__(self, known: Mapping[str, str], static: Collection[str]) -> None:
        self._known, self._static = known, static
        self._dropped: Counter[str] = Counter()
        self._unknown: Counter[str] = Counter()

    def convert(self, text: str) -> str | None:
        """Return the class of a name, ``"other"`` for an unknown one; None when its row is to be dropped."""
        name = re.sub(r"[^a-z]", "", text.lower())
        if name in self._static:
            self._dropped[text[:80]] += 1
            return None
        cls = self._known.get(name)
        if cls is None:
            self._unknown[text[:80]] += 1
            return "other"
        return cls

    def sentences(self) -> list[str]:
        """Return sentences for the user on what was dropped, and on unknown names."""
        result = []
        if self._dropped:
            result.append(f"boxes of static classes left out: {_describe(self._dropped)}")
        if self._unknown:
            result.append(f'boxes of unknown classes, which count as "other": {_describe(self._unknown)}')
        return result


def _describe(counts: Counter[str]) -> str:
    named = [f"{count:,} {name}" for name, count in counts.most_common(10)]
    rest = counts.total() - sum(count for _, count in counts.most_common(10))
    return ", ".join([*named, f"{rest:,} of further classes"] if rest else named)


def to_rotations(xyzw: FloatArray) -> FloatArray:
    """Convert quaternions (..., 4), scalar last, of any length, to rotation matrices (..., 3, 3); NaN for length 0."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        x, y, z, w = np.moveaxis(xyzw / np.linalg.norm(xyzw, axis=-1, keepdims=True), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def front_of(x: float, y: float, z: float, w: float) -> Vector:
    """Return the x axis turned by a quaternion, times the square of its length."""
    return (w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y))


def yaw_of(rotations: FloatArray) -> FloatArray:
    """Return the direction of the x axis of rotations (..., 3, 3) on the ground, counter-clockwise from +x, in rad."""
    return np.arctan2(rotations[..., 1, 0], rotations[..., 0, 0])


def is_rotation(matrix: FloatArray) -> bool:
    """Return whether a matrix (3, 3) is a rotation to three digits."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3)) and bool(np.linalg.det(matrix) > 0)
