"""Recordings for a new scenario: its vehicles, people on foot, and signals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from egvs.core.errors import InputError
from egvs.core.grid import XY
from egvs.creation.junctions import StreetJunction, Streets
from egvs.creation.new_traffic import RecordingOptions, RecordingPlan, ScenarioTraffic
from egvs.creation.scenario_files import FileContent
from egvs.extensions.tracks.new import files, signal_programs, signals
from egvs.extensions.tracks.new.demand import estimate_demand
from egvs.extensions.tracks.new.files import TrackFiles
from egvs.extensions.tracks.new.motion import MatchedRecording, match_recording
from egvs.extensions.tracks.new.signal_assignment import RecordedMotion
from egvs.extensions.tracks.new.signal_programs import RecordedSignalNetwork, Replay
from egvs.extensions.tracks.recorded_tracks import RecordedTracks, track_warnings, warn_without_vehicles
from egvs.scenario.model import Scenario
from egvs.scenario.traffic_config import DEFAULT_WARMUP_S

_SIGNALS_OF_TRACKS_NOTE = (
    "Recorded traffic does not depend on the signals. They are tested against it, and network.net.xml replays them on"
    " its clock; with --like instead of --tracks, simulated traffic obeys them."
)


OPTION_OF_KEY = {
    "in [traffic.track_columns]": "in a TOML file, --track-columns FILE",
    "traffic.track_crs": "--track-crs",
}
"""How hints name keys of scenarios, and the options of ``egvs new`` that set them."""


@dataclass(frozen=True)
class ReplayedVehicles:
    """Recorded vehicles that a scenario replays: nothing is simulated, and nothing assumed."""

    recorded: RecordedTracks

    flows = notes = assumptions = ()
    is_recorded = True

    def describe(self) -> str:
        """Return how much was recorded, and how well it fits the network."""
        return files.describe(self.recorded)

    def warnings(self, scenario_file: Path) -> Iterator[str]:
        """Yield what is doubtful about the tracks."""
        where = f"{scenario_file}: traffic.tracks"
        yield from map(str, track_warnings(self.recorded, where))
        yield from map(str, warn_without_vehicles(self.recorded, where))
        if self.recorded.alignment is not None:
            yield from map(str, self.recorded.alignment.warnings(where))

    def add_keys(self, table: Any, streets: Streets, junction: StreetJunction) -> None:
        """Add nothing: the keys name files, see :meth:`TrackFiles.traffic_table`."""


@dataclass(frozen=True)
class NewTracks:
    """Recordings for a new scenario.

    Attributes
    ----------
    replayed, example, people
        Tracks to replay, tracks whose demand is estimated, and tracks of people beside simulated vehicles.
    signals
        Files of recorded signals.
    """

    replayed: TrackFiles | None
    example: TrackFiles | None
    people: TrackFiles | None
    signals: tuple[Path, ...]

    @classmethod
    def find(cls, options: RecordingOptions) -> NewTracks:
        """Return the recordings; InputError where a file does not exist or is of no known format."""
        with _option_names():
            return cls(
                _find_tracks(options.tracks, options),
                _find_tracks(options.like, options),
                _find_tracks(options.pedestrian_tracks, options),
                options.signals,
            )

    @property
    def _tracks(self) -> list[TrackFiles]:
        return [tracks for tracks in (self.replayed, self.example, self.people) if tracks is not None]

    @property
    def path(self) -> Path | None:
        """The first file of tracks, for messages; None for signals without tracks."""
        return self._tracks[0].source.paths[0] if self._tracks else None

    def middle_m(self, streets: Streets) -> XY:
        """Return the median position of the tracks in the world frame; InputError where they are far from the map."""
        with _option_names():
            return self._tracks[0].middle_m(streets)

    def plan(self, network: str, streets: Streets, junction: StreetJunction) -> RecordingPlan:
        """Return what the recordings give to the scenario of a junction.

        Parameters
        ----------
        network
            The text of the network.
        streets, junction
            The streets of the network, and the junction of the scenario.

        Raises
        ------
        InputError
            When tracks are damaged or far from the streets, no vehicle passes the junction, or signals do not fit it.
        """
        with _option_names():
            matched = [match_recording(tracks, streets) for tracks in self._tracks]
        signalled = RecordedSignalNetwork(network, ())
        notes: list[str] = []
        if self.signals:
            signalled = self._with_signals(network, streets, junction, matched)
            junction = replace(junction, signalised=True)
            notes += [] if self.replayed is None else [_SIGNALS_OF_TRACKS_NOTE]
        traffic = None if self.example is None else estimate_demand(matched[0], streets, junction)
        return RecordingPlan(
            signalled.network,
            traffic,
            self._keys(None if signalled.clock is None else signalled.clock.to_s),
            is_finished=self.replayed is not None,
            files=self._copies(),
            notes=(*notes, *signalled.notes),
            signal_notes=signalled.notes,
            assumptions=("which recorded light governs which road",) if signalled.is_guessed else (),
            read_back=None if self.replayed is None else _read_replayed,
        )

    def _with_signals(
        self, network: str, streets: Streets, junction: StreetJunction, matched: Sequence[MatchedRecording]
    ) -> RecordedSignalNetwork:
        """Return the network with recorded signals at the junction, and notes on them."""
        if junction.ring is not None:
            raise InputError("--signals", "the junction is a roundabout", "Choose another junction with --at LAT,LON.")
        recorded = signals.read_signals(self.signals)
        replay = None
        if self.replayed is not None:
            replay = Replay.of(self.replayed.time_range_s, begin_s=0.0)
        elif self.people is not None:
            replay = Replay.of(self.people.time_range_s, begin_s=DEFAULT_WARMUP_S)
        where = ", ".join(map(str, self.signals))
        motion = RecordedMotion.joined([each.motion() for each in matched])
        return signal_programs.apply_signals(network, junction.id, recorded, streets.frame, where, motion, replay)

    def _keys(self, signals_end_s: float | None) -> Mapping[str, Any]:
        """Return the keys of ``[traffic]`` that name the files."""
        if self.replayed is not None:
            return self.replayed.traffic_table()
        return {} if self.people is None else self.people.pedestrian_table(signals_end_s)

    def _copies(self) -> dict[str, FileContent]:
        """Return functions that write the copies, by their path in the scenario."""
        copies: dict[str, FileContent] = {}
        for tracks in (self.replayed, self.people):
            if tracks is not None:
                copies |= tracks.copies()
        return copies


@contextmanager
def _option_names() -> Iterator[None]:
    """Let hints of errors name options of ``egvs new`` instead of keys: there is no scenario yet."""
    try:
        yield
    except InputError as error:
        hint = error.hint
        for key, option in OPTION_OF_KEY.items():
            hint = hint.replace(key, option)
        raise InputError(error.where, error.problem, hint) from None


def _find_tracks(paths: Sequence[Path], options: RecordingOptions) -> TrackFiles | None:
    """Return recorded tracks, if there are any."""
    if not paths:
        return None
    columns = None if options.columns is None else files.read_track_columns(options.columns)
    if options.crs is not None and columns is not None and columns.crs is not None:
        problem = f"states the system of the tracks already: {columns.crs!r}"
        raise InputError(f"{options.columns}: crs", problem, "Leave out this key or --track-crs.")
    return TrackFiles.find(paths, options.crs, columns)


def _read_replayed(scenario: Scenario) -> ScenarioTraffic:
    return ReplayedVehicles(files.read_for_summary(scenario))
