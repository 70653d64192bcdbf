"""The traffic of a new scenario, and what recordings give to it.

Vehicles are assumed (:mod:`egvs.creation.assumed_traffic`), counted (:mod:`egvs.creation.street_counts`), or come from
recordings, which an extension reads (:mod:`egvs.traffic.traffic_sources`). Recorded people on foot and recorded signals
come from it, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from egvs.core import plugins
from egvs.core.grid import XY
from egvs.creation.junctions import StreetJunction, Streets
from egvs.creation.scenario_files import FileContent
from egvs.scenario.model import Scenario
from egvs.scenario.traffic_config import CountConfig
from egvs.traffic import traffic_sources


@dataclass(frozen=True)
class RecordingOptions:
    """Recordings for a new scenario; see :class:`egvs.creation.new_scenario.NewScenarioOptions`.

    Attributes
    ----------
    tracks, like, pedestrian_tracks
        Files or folders of tracks: to replay, to simulate such traffic, and of people beside simulated vehicles.
    signals
        Files of recorded signals, and of what their groups govern.
    crs
        Coordinate system of the tracks; None for that of their format.
    columns
        TOML file with the meaning of the columns of tracks in a table of one's own.
    """

    tracks: tuple[Path, ...] = ()
    like: tuple[Path, ...] = ()
    pedestrian_tracks: tuple[Path, ...] = ()
    signals: tuple[Path, ...] = ()
    crs: str | None = None
    columns: Path | None = None

    @property
    def by_option(self) -> dict[str, tuple[Path, ...]]:
        """The files, by the option of ``egvs new`` that names them."""
        return {
            "--tracks": self.tracks,
            "--like": self.like,
            "--pedestrian-tracks": self.pedestrian_tracks,
            "--signals": self.signals,
        }

    def check(self) -> None:
        """Raise an InputError when there are recordings, but no installed extension reads them."""
        for option, paths in self.by_option.items():
            if paths and not traffic_sources.is_installed():
                raise traffic_sources.missing_extension(option)


class ScenarioTraffic(Protocol):
    """The vehicles of a new scenario."""

    @property
    def flows(self) -> tuple[CountConfig, ...]:
        """The flows that are simulated; empty for recorded vehicles, or where no street leads through the region."""

    @property
    def notes(self) -> Sequence[str]:
        """What to know before trusting it."""

    @property
    def assumptions(self) -> Sequence[str]:
        """What is assumed, for the key ``assumed``."""

    @property
    def is_recorded(self) -> bool:
        """Whether it comes from recorded vehicles."""

    def describe(self) -> str:
        """Return a sentence."""

    def warnings(self, scenario_file: Path) -> Iterator[str]:
        """Yield warnings; ``scenario_file`` is the new scenario.toml."""

    def add_keys(self, table: Any, streets: Streets, junction: StreetJunction) -> None:
        """Add its keys, with comments, to the table ``[traffic]`` of a TOML document."""


@dataclass(frozen=True)
class RecordingPlan:
    """What recordings give to a new scenario.

    Attributes
    ----------
    network
        The text of the network; with recorded signals, if there are any.
    traffic
        The vehicles; None where they are not recorded.
    keys
        Keys of ``[traffic]``.
    is_finished
        Whether nothing is simulated, and the keys are all that there are.
    files
        Copies of the recordings, by their path in the scenario.
    notes
        What to know before trusting the scenario.
    signal_notes
        Durations of recorded signals, with intervals; empty without them.
    assumptions
        What was guessed, for the key ``assumed``.
    read_back
        Reads what was written as a run does, and returns the vehicles; None where there is nothing to read.
    """

    network: str
    traffic: ScenarioTraffic | None = None
    keys: Mapping[str, Any] = field(default_factory=dict)
    is_finished: bool = False
    files: Mapping[str, FileContent] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    signal_notes: tuple[str, ...] = ()
    assumptions: tuple[str, ...] = ()
    read_back: Callable[[Scenario], ScenarioTraffic] | None = None


class NewTraffic(Protocol):
    """Recordings for a new scenario."""

    @property
    def path(self) -> Path | None:
        """The first file of tracks, for messages; None for signals without tracks."""

    def middle_m(self, streets: Streets) -> XY:
        """Return the median position of the tracks in the world frame; InputError where they are far from the map."""

    def plan(self, network: str, streets: Streets, junction: StreetJunction) -> RecordingPlan:
        """Return what the recordings give to the scenario of a junction; InputError where they do not fit."""


class NewTrafficSource(traffic_sources.TrafficSource, Protocol):
    """A source whose recordings ``egvs new`` makes scenarios of."""

    def for_new(self, options: RecordingOptions) -> NewTraffic:
        """Return the recordings; InputError where a file does not exist or is of no known format."""


def find_recordings(options: RecordingOptions) -> NewTraffic | None:
    """Return the recordings for a new scenario; None where no file is given.

    Raises
    ------
    InputError
        When a file does not exist or is of no known format, or no installed extension reads recordings.
    """
    if not any(options.by_option.values()):
        return None
    options.check()
    source: NewTrafficSource = traffic_sources.load_source(plugins.plugin_names(traffic_sources.GROUP)[0])
    return source.for_new(options)
