"""Recorded tracks as traffic of scenarios: the entry point of the group ``egvs.traffic_sources``."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from egvs.artefacts.frame_boxes import NON_VEHICLE_KINDS
from egvs.core.errors import Diagnostic, InputError
from egvs.extensions.tracks import recorded_tracks
from egvs.extensions.tracks.recorded_tracks import RecordedTracks
from egvs.formats.georeference import Georeference
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import is_vehicle_score
from egvs.traffic import sumo_folder, traffic_sources
from egvs.traffic.traffic_sources import PEDESTRIAN_TRACKS, TRACKS, RecordedTraffic

if TYPE_CHECKING:
    from egvs.creation.new_traffic import NewTraffic, RecordingOptions

_NEW = "egvs.extensions.tracks.new.traffic"
"""Loaded by name: what new scenarios need is no part of the program that a run depends on."""


class TrackTrafficSource:
    """Recorded tracks of all road users, or of people beside simulated vehicles."""

    KEYS = (TRACKS, PEDESTRIAN_TRACKS)

    def files(self, scenario: Scenario) -> list[Path]:
        """Return the files of the tracks, those that their readers need, and the area that the recording could see."""
        files = recorded_tracks.track_files(scenario)
        if scenario.traffic.coverage is not None:
            files.append(scenario.find(scenario.traffic.coverage, "traffic.coverage"))
        return files

    def modules(self, scenario: Scenario) -> tuple[str, ...]:
        """Return this module and the readers of the files."""
        return __name__, *recorded_tracks.track_source(scenario).reader_modules()

    def frame_count(self, scenario: Scenario) -> int:
        """Return the number of frames."""
        return recorded_tracks.tracks_window(scenario).count

    def record(self, scenario: Scenario, world: Georeference) -> RecordedTraffic:
        """Read the tracks; people beside simulated vehicles are recorded on the clock of the simulation."""
        where = _key(scenario)
        if scenario.traffic.tracks is not None:
            first_ms = 0
            recorded = recorded_tracks.read_recorded_tracks(scenario, world)
            warnings = (
                *recorded_tracks.track_warnings(recorded, where),
                *_check_vehicles(scenario, recorded, where),
            )
        else:
            recorded = recorded_tracks.read_recorded_pedestrians(scenario, world)
            first_ms = _first_frame_ms(scenario)
            warnings = (
                *recorded_tracks.track_warnings(recorded, where),
                *recorded_tracks.pedestrian_warnings(recorded, first_ms / 1000.0, where),
            )
        return RecordedTraffic(
            recorded.rows(first_ms),
            recorded.window,
            recorded.vehicle_sizes(),
            recorded.vulnerable_types(),
            recorded.summary(),
            warnings,
            recorded.unknown_boxes(),
            recorded.coverage,
            recorded.tracks.report.shared_names,
        )

    def for_new(self, options: RecordingOptions) -> NewTraffic:
        """Return the recordings of a new scenario; InputError where a file does not exist or is of no known format."""
        new: NewTraffic = importlib.import_module(_NEW).NewTracks.find(options)
        return new


def _check_vehicles(scenario: Scenario, recorded: RecordedTracks, where: str) -> Iterator[Diagnostic]:
    """Warn that tracks have no vehicle; InputError if then no score can rank the sites."""
    if NON_VEHICLE_KINDS & set(scenario.score.weights.kinds):
        return
    for warning in recorded_tracks.warn_without_vehicles(recorded, where):
        if is_vehicle_score(scenario.score.rank_by) and not scenario.period:
            raise InputError(where, warning.problem, warning.hint)
        yield warning


def _key(scenario: Scenario) -> str:
    """Return the key of the tracks, for messages."""
    return f"{sumo_folder.traffic_location(scenario)}.{traffic_sources.source_key(scenario.traffic)}"


def _first_frame_ms(scenario: Scenario) -> int:
    """Return the time of the first frame in the simulation."""
    begin_s = sumo_folder.demand_files(scenario).begin_s
    timing = sumo_folder.make_timing(scenario.traffic, begin_s, sumo_folder.traffic_location(scenario))
    return timing.first_ms


SOURCE = TrackTrafficSource()
