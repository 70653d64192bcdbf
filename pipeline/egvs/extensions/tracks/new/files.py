"""Recorded tracks in a new scenario: which junction they show, and the copies and keys that the scenario gets."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from egvs.core import reading
from egvs.core.errors import InputError
from egvs.core.grid import XY, Roi
from egvs.core.wording import number_of
from egvs.creation.junctions import Streets
from egvs.creation.plain_network import NETWORK_FILE
from egvs.extensions.tracks import recorded_tracks
from egvs.extensions.tracks import sources as track_readers
from egvs.extensions.tracks.model import Tracks
from egvs.extensions.tracks.recorded_tracks import RecordedTracks
from egvs.extensions.tracks.sources import TrackSource
from egvs.formats.georeference import Georeference
from egvs.scenario.model import Scenario, TpogConfig
from egvs.scenario.track_columns import TrackColumns
from egvs.scenario.traffic_config import DEFAULT_FRAMES
from egvs.world import geolocation

FOLDER = "tracks"
"""Folder of the copies in the scenario."""

MIN_FRAMES, MAX_PERIOD_S = 1000, 1.0
"""A recording with fewer frames than this gets a shorter frame period than that."""

_PERIODS_S = (0.1, 0.2, 0.25, 0.5, MAX_PERIOD_S)
_SIMULATED_PERIODS_S = (0.25, 0.5, MAX_PERIOD_S)
"""Multiples of the default step of a simulation."""

_BLOCKS = int(TpogConfig.model_fields["blocks"].default)
_MARGIN_M = 1000.0


@dataclass(frozen=True)
class TrackFiles:
    """Files of recorded tracks, and how to read them."""

    source: TrackSource

    @classmethod
    def find(cls, paths: Sequence[Path], crs: str | None = None, columns: TrackColumns | None = None) -> TrackFiles:
        """Return the files with tracks among some paths, and in the folders among them.

        A file that the reader of another reads with it, such as a further sweep, is not among them.

        Parameters
        ----------
        paths
            Files and folders.
        crs, columns
            As for :class:`egvs.extensions.tracks.sources.TrackSource`; with columns, folders are not searched.

        Raises
        ------
        InputError
            When a file does not exist or no reader opens it, or a folder has no tracks.
        """
        tracks: dict[Path, None] = {}
        read_with_others: set[Path] = set()
        for path in paths:
            is_folder = path.is_dir() and columns is None
            for file in _tracks_in_folder(path) if is_folder else [path]:
                if file.absolute() in read_with_others:
                    continue
                tracks[file] = None
                read_with_others |= {other.absolute() for other in TrackSource((file,), columns).companions()}
        return cls(TrackSource(tuple(tracks), columns, crs))

    def copies(self) -> dict[str, Callable[[Path], None]]:
        """Return functions that write the copies, by their path in the scenario.

        Raises
        ------
        InputError
            When two files have one name.
        """
        sources: dict[str, Path] = {}
        for path in self.source.paths:
            for source, name in self._names(path).items():
                if sources.setdefault(name, source) != source:
                    raise InputError(source, "a second file of tracks has the same name", "Rename one of them.")
        return {name: _copier(source) for name, source in sources.items()}

    def _names(self, path: Path) -> dict[Path, str]:
        """Return the paths in the scenario of a file and of those beside it, in the same folders as before."""
        companions = TrackSource((path,), self.source.columns).companions()
        files = [file.absolute() for file in (path, *companions)]
        folder = Path(os.path.commonpath([file.parent for file in files]))
        return {file: f"{FOLDER}/{file.relative_to(folder).as_posix()}" for file in files}

    def traffic_table(self) -> dict[str, Any]:
        """Return the keys of ``[traffic]`` for recorded traffic."""
        period_s = self._frame_period_s(_PERIODS_S)
        return self._source_keys("tracks", {"frame_period_s": period_s, "roads": NETWORK_FILE})

    def pedestrian_table(self, until_s: float | None = None) -> dict[str, Any]:
        """Return the keys of ``[traffic]`` for recorded people beside simulated vehicles.

        Parameters
        ----------
        until_s
            When the recorded signals end, on the clock of the recording; frames after it are left out.

        Raises
        ------
        InputError
            When the recording is too short for the blocks of the TPOG.
        """
        period_s = self._frame_period_s(_SIMULATED_PERIODS_S)
        first_s, last_s = self.time_range_s
        if until_s is not None:
            last_s = min(last_s, until_s)
        frames = min(int((last_s - first_s) / period_s + 1e-6) + 1, DEFAULT_FRAMES)
        if frames < _BLOCKS:
            problem = f"expected at least {_BLOCKS} frames of {period_s:g} s, got {max(frames, 0)}"
            hint = "Check the unit of the times, or use a longer recording of people and signals."
            raise InputError(self.source.paths[0], problem, hint)
        frames -= frames % _BLOCKS
        return self._source_keys("pedestrian_tracks", {"frames": frames, "frame_period_s": period_s})

    def _source_keys(self, key: str, times: dict[str, Any]) -> dict[str, Any]:
        """Return the key with the files, those of times, and those that say how the files are read."""
        source = self.source
        table: dict[str, Any] = {key: [self._names(path)[path.absolute()] for path in source.paths]}
        if source.crs is not None:
            table["track_crs"] = source.crs
        table |= times
        if source.columns is not None:
            table["track_columns"] = source.columns.model_dump(exclude_unset=True)
        return table

    @cached_property
    def time_range_s(self) -> tuple[float, float]:
        """The first and the last time, on the clock of the recording."""
        time_s = np.concatenate([tracks.time_s for tracks in self.source.read()])
        return float(np.nanmin(time_s)), float(np.nanmax(time_s))

    def read(self, streets: Streets) -> Tracks:
        """Read the tracks in the world frame of streets; InputError where they are damaged or far from them."""
        points_m = np.concatenate([lane.shape_m[:, :2] for edge in streets.network.edges for lane in edge.lanes])
        low_m, high_m = points_m.min(axis=0) - _MARGIN_M, points_m.max(axis=0) + _MARGIN_M
        region = Roi((*low_m.tolist(), 0.0), (*(high_m - low_m).tolist(), 1.0))
        return recorded_tracks.read_in_world_frame(self.source, Georeference(streets.frame, region, "the map"))

    def middle_m(self, streets: Streets) -> XY:
        """Return the median position in the world frame, metres; InputError where the tracks are far from the map."""
        tracks = self.read(streets)
        return float(np.nanmedian(tracks.x_m)), float(np.nanmedian(tracks.y_m))

    def _frame_period_s(self, periods_s: Sequence[float]) -> float:
        first_s, last_s = self.time_range_s
        longest_s = (last_s - first_s) / MIN_FRAMES
        return max((period_s for period_s in periods_s if period_s <= longest_s), default=periods_s[0])


def describe(recorded: RecordedTracks) -> str:
    """Return how much was recorded, and how well it fits the network, as a sentence."""
    classes = Counter(recorded.tracks.classes)
    texts = [_count(name, number) for name, number in classes.most_common()]
    duration_s = recorded.window.count * recorded.window.period_ms / 1000.0
    text = f"{number_of(len(recorded.tracks.names), 'recorded track')} of {duration_s:,.0f} s ({', '.join(texts)})"
    if recorded.alignment is not None:
        text += f"; {recorded.alignment.describe()}"
    return text


def _count(name: str, number: int) -> str:
    return number_of(number, name, f"{name}es" if name.endswith("s") else "")


def read_for_summary(scenario: Scenario) -> RecordedTracks:
    """Read the tracks of a scenario as a run does; InputError if they are wrong."""
    return recorded_tracks.read_recorded_tracks(scenario, geolocation.scenario_georeference(scenario))


def read_track_columns(path: Path) -> TrackColumns:
    """Read a TOML file with the keys of ``[traffic.track_columns]``; InputError if it is invalid."""
    try:
        return TrackColumns.from_dict(reading.read_toml(path))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        problem = first["msg"].removeprefix("Value error, ")
        hint = "Write the keys of [traffic.track_columns], see docs/tracks.md."
        raise InputError(f"{path}: {key}" if key else path, problem, hint) from None


def _tracks_in_folder(folder: Path) -> list[Path]:
    """Return the files with tracks in a folder."""
    paths = [path for path in sorted(folder.iterdir()) if path.is_file() and track_readers.can_read(path)]
    if not paths:
        hint = f"Formats: {track_readers.describe_formats()}."
        raise InputError(folder, "the folder contains no recorded tracks", hint)
    return paths


def _copier(source: Path) -> Callable[[Path], None]:
    def copy(target: Path) -> None:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)

    return copy
