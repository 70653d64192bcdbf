"""Find the reader of a file of recorded tracks in the table of readers (:mod:`egvs.core.readers`)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import cast

import numpy as np

from egvs.core import readers
from egvs.core.errors import InputError
from egvs.core.reading import translate_errors
from egvs.extensions.tracks import columns, user_table
from egvs.extensions.tracks.model import TrackReader, Tracks
from egvs.scenario.track_columns import TrackColumns

KIND = "tracks"
"""Kind of the readers of tracks."""

MIN_NEAREST_SHARE = 0.5
"""A file with a larger share of the columns of a format is probably meant to be of it."""


def find_reader(path: Path) -> TrackReader:
    """Return the module that reads a file.

    Raises
    ------
    InputError
        When the file does not exist, or no reader accepts it.
    MissingBackendError
        When its reader cannot be used.
    """
    reader = _find(path)
    if reader is None:
        raise InputError(path, f"the format of the tracks is unknown{_describe_nearest(path)}", _format_hint())
    return reader


def _describe_nearest(path: Path) -> str:
    """Return which format's table a file resembles, and the columns that it lacks; empty if it resembles none."""
    names = set(columns.header(readers.read_head(path)))
    nearest = ""
    best_share = MIN_NEAREST_SHARE
    for reader in readers.list_readers(KIND):
        required: tuple[str, ...] = getattr(readers.load_reader(reader), "REQUIRED_COLUMNS", ())
        missing = [name for name in required if name.lower() not in names]
        share = 1.0 - len(missing) / max(len(required), 1)
        if required and missing and share > best_share:
            nearest, best_share = f"; nearest to {reader.name}, without {', '.join(missing)}", share
    return nearest


def can_read(path: Path) -> bool:
    """Return whether a reader accepts a file; InputError when it does not exist."""
    return _find(path) is not None


def _format_hint() -> str:
    return f"Formats: {describe_formats()}. For your own table, name its columns in [traffic.track_columns]."


def _find(path: Path) -> TrackReader | None:
    reader = readers.find_reader(KIND, path)
    if reader is None:
        return None
    module = readers.load_reader(reader, ("companions", "read"), f"a module as described in {TrackReader.__module__}")
    return cast(TrackReader, module)


@dataclass(frozen=True)
class TrackSource:
    """Files of recorded tracks on one clock, and how to read them.

    Attributes
    ----------
    paths
        Files with tracks.
    columns
        Meaning of their columns, where they are a user's own tables; None for files in a known format.
    crs
        Coordinate system instead of the one of the format; "world" for the world frame; None for that of the format.
    """

    paths: tuple[Path, ...]
    columns: TrackColumns | None = None
    crs: str | None = None

    def companions(self) -> list[Path]:
        """Return the files beside the tracks that their readers need."""
        if self.columns is not None:
            return []
        companions: dict[Path, None] = {}
        for path in self.paths:
            companions |= dict.fromkeys(find_reader(path).companions(path))
        return [path for path in companions if path not in self.paths]

    def reader_modules(self) -> list[str]:
        """Return the modules that read the files."""
        if self.columns is not None:
            return [user_table.__name__]
        return sorted({find_reader(path).__name__ for path in self.paths})

    def read(self) -> list[Tracks]:
        """Read each file; one that was read before is read again only when it has changed.

        Raises
        ------
        InputError
            When a file is damaged, or has no row with a time and a position.
        """
        key = None if self.columns is None else self.columns.model_dump_json()
        modified_ns = tuple(path.stat().st_mtime_ns for path in (*self.paths, *self.companions()))
        return [_read_file(path, modified_ns, key) for path in self.paths]


@lru_cache(maxsize=8)
def _read_file(path: Path, _modified_ns: tuple[int, ...], columns: str | None) -> Tracks:
    """Read a file, by the JSON of the columns of a user's own table."""
    with translate_errors(path):
        if columns is None:
            tracks = find_reader(path).read(path)
        else:
            tracks = user_table.read(path, TrackColumns.model_validate_json(columns))
    if not (np.isfinite(tracks.time_s) & np.isfinite(tracks.x_m) & np.isfinite(tracks.y_m)).any():
        raise InputError(path, "contains no row with a time and a position", "Use a file with at least one track.")
    return tracks


def describe_formats() -> str:
    """Return the names of the formats that can be read."""
    return readers.describe_formats(KIND)
