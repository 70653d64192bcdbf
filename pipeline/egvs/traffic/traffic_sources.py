"""Traffic that was recorded elsewhere: what an extension reads for keys of ``[traffic]``.

An extension declares an object with the attributes of :class:`TrafficSource` as an entry point of the group
``egvs.traffic_sources``. The keys themselves belong to this program: a scenario has one schema, whatever is installed.

World frame (x east, y north, z up), metres, radians; times are whole milliseconds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import pyarrow as pa

from egvs.core import plugins
from egvs.core.errors import Diagnostic, InputError
from egvs.core.grid import BoolArray, FloatArray
from egvs.formats.georeference import Georeference
from egvs.scenario.model import Scenario
from egvs.scenario.traffic_config import TrafficConfig
from egvs.traffic import sumo_folder
from egvs.traffic.fcd import FrameWindow
from egvs.traffic.shared_names import SharedNames
from egvs.traffic.vehicle_boxes import VehicleSize

GROUP = "egvs.traffic_sources"

TRACKS, PEDESTRIAN_TRACKS = "tracks", "pedestrian_tracks"
"""Keys of ``[traffic]`` that name recordings: of all road users, and of people beside simulated vehicles."""

EXTENSION = "tracks"
"""The extension of this program that reads them, for messages."""

_REQUIRED = ("KEYS", "files", "modules", "frame_count", "record", "for_new")


class CoveredArea(Protocol):
    """The area that a recording could see."""

    def contains(self, xy_m: FloatArray) -> BoolArray:
        """Return whether points (n, 2) are inside, (n,)."""


@dataclass(frozen=True)
class RecordedTraffic:
    """Road users of a recording at the frames of a scenario.

    Attributes
    ----------
    rows
        Tables of :data:`egvs.traffic.fcd.FCD_SCHEMA`, in order of time; can be read once. Beside simulated vehicles,
        times are those of the simulation.
    window
        Which time steps are frames.
    sizes
        Size of each vehicle type.
    uncounted_types
        Types that do not count as vehicles: people on foot and on bicycles.
    summary
        What was read, changed and left out, as JSON.
    warnings
        What is doubtful.
    unknown_boxes
        Gaps in which positions are unknown, as JSON; see :data:`egvs.artefacts.frame_boxes.UNKNOWN_BOXES_KEY`. Frames
        count from the first of the recording.
    coverage
        What the recording could see; None where that is not known.
    shared_names
        What says that two road users share a name, of rows that are left out.
    """

    rows: Iterable[pa.Table]
    window: FrameWindow
    sizes: Mapping[str, VehicleSize]
    uncounted_types: frozenset[str]
    summary: Mapping[str, Any]
    warnings: Sequence[Diagnostic]
    unknown_boxes: Sequence[Mapping[str, Any]]
    coverage: CoveredArea | None = None
    shared_names: SharedNames = field(default_factory=SharedNames)


class TrafficSource(Protocol):
    """Reads the recording that a scenario names.

    Scenarios have one of the keys, and no periods: a scenario with periods is passed period by period. A source that
    ``egvs new`` uses has ``for_new`` as well, see :class:`egvs.creation.new_traffic.NewTrafficSource`.
    """

    KEYS: tuple[str, ...]
    """The keys of ``[traffic]`` with which it is used."""

    def files(self, scenario: Scenario) -> list[Path]:
        """Return all files that it reads, for the key of the stage; InputError when one does not exist."""

    def modules(self, scenario: Scenario) -> tuple[str, ...]:
        """Return the modules that read them, for the key of the stage; InputError when a file does not exist."""

    def frame_count(self, scenario: Scenario) -> int:
        """Return the number of frames of the recording; InputError when a file is damaged or too short."""

    def record(self, scenario: Scenario, world: Georeference) -> RecordedTraffic:
        """Read the recording; InputError for one that cannot be used."""


def source_key(traffic: TrafficConfig) -> str | None:
    """Return the key that names a recording; None where no recording is named."""
    for key in (TRACKS, PEDESTRIAN_TRACKS):
        if getattr(traffic, key) is not None:
            return key
    return None


def source_of(scenario: Scenario) -> TrafficSource:
    """Return the source that reads the recording of a scenario.

    Raises
    ------
    InputError
        When no installed extension reads it.
    """
    key = source_key(scenario.traffic)
    assert key is not None, "a recording is named"
    for name in plugins.plugin_names(GROUP):
        source: TrafficSource = load_source(name)
        if key in source.KEYS:
            return source
    raise missing_extension(f"{sumo_folder.traffic_location(scenario)}.{key}")


def is_installed() -> bool:
    """Return whether an extension that reads recordings is installed; it is not imported."""
    return bool(plugins.plugin_names(GROUP))


def load_source(name: str) -> Any:
    """Return the source of an entry point; MissingBackendError where it lacks a part."""
    source = plugins.load_plugin(GROUP, name)
    missing = [attribute for attribute in _REQUIRED if not hasattr(source, attribute)]
    if missing:
        expected = "expected a TrafficSource, see egvs.traffic.traffic_sources"
        raise plugins.plugin_error(GROUP, name, f"it has no {', '.join(missing)}; {expected}")
    return source


def missing_extension(where: str) -> InputError:
    """Return the error for a key or an option that no installed extension knows."""
    return InputError(where, f"needs the extension {EXTENSION}", "Install it, or remove the key or option.")


def loaded_modules(scenario: Scenario) -> tuple[str, ...]:
    """Return the modules that read the recording of a scenario; none without a recording. InputError as for a source.

    They are loaded by name, so a stage that reads recordings names them among its dependencies.
    """
    return () if source_key(scenario.traffic) is None else source_of(scenario).modules(scenario)
