"""What the readers of recorded tracks return: one box per row, in metres, seconds and radians.

A reader is a module with ``companions`` and ``read``, in the table of readers (:mod:`egvs.core.readers`). It reads
columns by name and converts them to :class:`Tracks`: centres of boxes, yaw counter-clockwise from +x. It returns rows
as they were recorded. Duplicates, gaps, missing sizes and headings, and the frame period are the business of
:mod:`egvs.extensions.tracks.cleaning` and :mod:`egvs.extensions.tracks.resampling`, which treat all formats alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, get_args

import numpy as np

from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.scenario.track_columns import RoadUserClass

CLASSES: tuple[str, ...] = get_args(RoadUserClass)
"""Classes of road users."""


@dataclass(frozen=True)
class TrackFrame:
    """Coordinate system of the positions of tracks: system = (x, y) + ``offset_m``.

    Attributes
    ----------
    crs
        A projected coordinate reference system in metres, as PROJ knows it; None for the world frame of the map, x east
        and y north.
    offset_m
        Added to x and y to get easting and northing.
    """

    crs: str | None = None
    offset_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Tracks:
    """Recorded boxes, one per row, in any order. All arrays have shape (n,) and are float64 unless stated.

    Attributes
    ----------
    names
        Names of the tracks, distinct.
    classes
        Class of each track, of :data:`CLASSES`, in the order of ``names``.
    track
        Position of the row's track among ``names``, int64.
    time_s
        Time, on one clock for the whole recording.
    x_m, y_m
        Centre of the box, in ``frame``.
    z_m
        Height of the centre of the box; NaN where the format has none.
    yaw_rad
        Direction of the front, counter-clockwise from +x; NaN where it is not given.
    length_m, width_m, height_m
        Size; NaN or 0 where it is not given.
    frame
        Coordinate system.
    sources
        Sentences for the user about what the reader did that was not obvious, and on the licence if the file states it.
    """

    names: tuple[str, ...]
    classes: tuple[str, ...]
    track: IntArray
    time_s: FloatArray
    x_m: FloatArray
    y_m: FloatArray
    z_m: FloatArray
    yaw_rad: FloatArray
    length_m: FloatArray
    width_m: FloatArray
    height_m: FloatArray
    frame: TrackFrame = TrackFrame()
    sources: tuple[str, ...] = ()

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return self.track.size

    @classmethod
    def from_rows(
        cls,
        track_names: Sequence[str],
        row_classes: Sequence[str],
        columns: Mapping[str, FloatArray],
        frame: TrackFrame = TrackFrame(),
        sources: Sequence[str] = (),
    ) -> Tracks:
        """Return tracks from the names and classes of rows.

        Parameters
        ----------
        track_names
            Name of the track of each row, n texts.
        row_classes
            Class of each row. A track has the class that most of its rows have.
        columns
            ``time_s``, ``x_m`` and ``y_m``, shape (n,); optionally ``z_m``, ``yaw_rad``, ``length_m``, ``width_m`` and
            ``height_m``, which are NaN otherwise.
        frame, sources
            As the attributes.
        """
        names, track = np.unique(np.asarray(track_names, dtype=object).astype(str), return_inverse=True)
        classes, row_class = np.unique(np.asarray(row_classes, dtype=object).astype(str), return_inverse=True)
        counts = np.zeros((names.size, classes.size), dtype=np.int64)
        np.add.at(counts, (track, row_class), 1)
        missing = np.full(track.size, np.nan)
        arrays = {key: np.asarray(columns.get(key, missing), dtype=np.float64) for key in _NUMBERS}
        return cls(
            tuple(names.tolist()),
            tuple(classes[counts.argmax(axis=1)].tolist()) if names.size else (),
            track.astype(np.int64),
            **arrays,
            frame=frame,
            sources=tuple(sources),
        )

    def select_tracks(self, mask: BoolArray) -> Tracks:
        """Return some of the tracks, (n_tracks,), with their rows and names only."""
        number = np.cumsum(mask) - 1
        rows = self.select(mask[self.track])
        names = tuple(name for name, is_selected in zip(self.names, mask, strict=True) if is_selected)
        classes = tuple(name for name, is_selected in zip(self.classes, mask, strict=True) if is_selected)
        return replace(rows, names=names, classes=classes, track=number[rows.track])

    def select(self, mask: BoolArray | IntArray) -> Tracks:
        """Return some of the rows, with all names."""
        arrays = {key: getattr(self, key)[mask] for key in ("track", *_NUMBERS)}
        return Tracks(self.names, self.classes, frame=self.frame, sources=self.sources, **arrays)


_NUMBERS = ("time_s", "x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")


class TrackReader(Protocol):
    """A module that reads one format.

    It may have a function ``can_open(path, head)``, which decides where the table of readers cannot.
    """

    __name__: str

    def companions(self, path: Path) -> Sequence[Path]:
        """Return the files beside it that :meth:`read` needs, e.g. with sizes and classes; they must exist."""
        ...

    def read(self, path: Path) -> Tracks:
        """Read a file; InputError if it is damaged."""
        ...
