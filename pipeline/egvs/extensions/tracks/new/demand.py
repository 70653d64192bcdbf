"""Estimate the demand of a new scenario from recorded tracks: turning counts, fleet, speeds and gaps.

Steps of :func:`estimate_demand`, after the motor vehicles were matched to lanes
(:mod:`egvs.extensions.tracks.new.motion`): count them by movement, and estimate how they drive
(:mod:`egvs.extensions.tracks.demand`). The result is written as ordinary keys of ``[traffic]``, each with its interval
in a comment. What was not observed often enough keeps SUMO's default, or is marked for the user.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomlkit

from egvs.core.errors import InputError
from egvs.core.wording import number_of
from egvs.creation import junctions, scenario_files
from egvs.creation.junctions import StreetJunction, Streets
from egvs.extensions.tracks import demand as track_demand
from egvs.extensions.tracks.cleaning import CleanTracks
from egvs.extensions.tracks.demand import Passage
from egvs.extensions.tracks.new.fleet import VEHICLE_CLASSES, KindEstimate, estimate_fleet
from egvs.extensions.tracks.new.motion import MatchedRecording
from egvs.scenario.traffic_config import CountConfig
from egvs.statistics import intervals
from egvs.statistics.intervals import MIN_OBSERVATIONS
from egvs.traffic.lane_alignment import Alignment
from egvs.traffic.movements import MovementNames
from egvs.traffic.network import CAR, Network


@dataclass(frozen=True)
class MovementEstimate:
    """Vehicles of one movement: the count of the scenario, and how many were recorded."""

    flow: CountConfig
    vehicles: int
    low_per_h: float
    high_per_h: float

    @property
    def is_usable(self) -> bool:
        """Whether enough vehicles were recorded."""
        return self.vehicles >= MIN_OBSERVATIONS

    @property
    def comment(self) -> str:
        """The interval in words, and a mark where there are too few vehicles."""
        text = f"95 %: {self.low_per_h:.0f} to {self.high_per_h:.0f}"
        if self.is_usable:
            return f"{text}, from {number_of(self.vehicles, 'vehicle')}"
        return f"{text} ({number_of(self.vehicles, 'vehicle')} only; enter your own count)"


@dataclass(frozen=True)
class TrackDemand:
    """The demand that recorded tracks show.

    Attributes
    ----------
    duration_s
        Length of the recording.
    movements
        Counts by movement through the region of interest.
    fleet
        The kinds of vehicles, the most frequent first.
    notes
        What could not be estimated, and what was left out.
    alignment
        How well the tracks fit the lanes.
    """

    duration_s: float
    movements: tuple[MovementEstimate, ...]
    fleet: tuple[KindEstimate, ...]
    notes: tuple[str, ...]
    alignment: Alignment | None

    is_recorded = True

    @property
    def flows(self) -> tuple[CountConfig, ...]:
        """The counts of the scenario."""
        return tuple(movement.flow for movement in self.movements)

    @property
    def marked(self) -> int:
        """Number of movements with too few vehicles."""
        return sum(not movement.is_usable for movement in self.movements)

    @property
    def per_h(self) -> int:
        """Sum of the counts."""
        return round(math.fsum(flow.per_hour for flow in self.flows))

    @property
    def assumptions(self) -> list[str]:
        """What the recording does not tell, for the key ``assumed``."""
        assumed = []
        if self.marked:
            few = f"with fewer than {MIN_OBSERVATIONS} recorded vehicles"
            assumed.append(f"counts of {self.marked} of {number_of(len(self.movements), 'movement')} ({few})")
        names = [estimate.kind.name for estimate in self.fleet if estimate.has_default_size]
        if names:
            assumed.append(f"sizes of vehicles ({', '.join(names)})")
        return assumed

    def describe(self) -> str:
        """Return a sentence."""
        vehicles = sum(movement.vehicles for movement in self.movements)
        text = (
            f"{number_of(vehicles, 'recorded vehicle')} in {self.duration_s:,.0f} s became {self.per_h:,} an hour in"
            f" {number_of(len(self.movements), 'movement')}"
        )
        if self.marked:
            text += f", {self.marked} of them with fewer than {MIN_OBSERVATIONS} vehicles"
        return text

    def warnings(self, scenario_file: Path) -> Iterator[str]:
        """Warn about counts from few vehicles, and about tracks beside the lanes."""
        if self.marked:
            yield (
                f"{self.marked} of {len(self.movements)} counts come from fewer than {MIN_OBSERVATIONS} vehicles. Enter"
                f" your own counts under [traffic] in {scenario_file}; they are marked there, with their intervals."
            )
        if self.alignment is not None:
            for warning in self.alignment.warnings("--like"):
                yield str(warning)

    def add_keys(self, table: Any, streets: Streets, junction: StreetJunction) -> None:
        """Add kinds and counts, with their intervals, to ``[traffic]``."""
        names = MovementNames(streets.network, junction.at_m, self.flows)
        kinds = [estimate.kind for estimate in self.fleet]
        table.update({"kinds": scenario_files.kinds_array(kinds, [estimate.comments for estimate in self.fleet])})
        table["kinds"].comment("estimated from the recorded vehicles")
        comments = [movement.comment for movement in self.movements]
        table.update({"counts": scenario_files.counts_array(self.flows, names, comments)})
        table["counts"].comment(f"vehicles an hour, from {self.duration_s:,.0f} s of recorded tracks")
        table.add(
            tomlkit.comment("The profile of the day is not extrapolated from the recording; it is yours to enter.")
        )
        table.add(tomlkit.comment(scenario_files.PERIODS_HINT))


def estimate_demand(recording: MatchedRecording, streets: Streets, junction: StreetJunction) -> TrackDemand:
    """Estimate the demand through a junction from recorded tracks.

    Parameters
    ----------
    recording
        The recorded tracks, matched to the lanes of the streets.
    streets
        The streets of the new scenario.
    junction
        The junction, whose region of interest defines the movements.

    Raises
    ------
    InputError
        When no vehicle passes the junction.
    """
    cleaned, matched, duration_s = recording.tracks, recording.matched, recording.duration_s
    passages = track_demand.find_passages(matched)
    if not passages.counted:
        problem = "no recorded vehicle passes a junction of the network"
        hint = "Check that map and tracks show the same place and use the same coordinates."
        raise InputError(recording.path, problem, hint)

    counted = _count_movements(passages.counted, streets, junction)
    if not counted.vehicles:
        problem = f"no recorded vehicle passes the {junction.title}"
        raise InputError(recording.path, problem, "Choose another junction with --at LAT,LON.")
    notes = list(_passage_notes(passages, counted.unassigned))
    notes += _people_notes(cleaned)
    fleet = estimate_fleet(cleaned, [passage.track for passage in passages.counted], matched)
    movements = tuple(
        _movement(flow, counted.vehicles[number], duration_s) for number, flow in enumerate(counted.flows)
    )
    return TrackDemand(duration_s, movements, fleet, tuple(notes), recording.alignment)


def _movement(flow: CountConfig, vehicles: int, duration_s: float) -> MovementEstimate:
    low, high = intervals.poisson_interval(vehicles)
    hours = duration_s / 3600.0
    count = flow.model_copy(update={"per_hour": round(vehicles / hours, 1)})
    return MovementEstimate(count, vehicles, low / hours, high / hours)


@dataclass(frozen=True)
class _MovementCounts:
    """Movements, the vehicles of each, and the number of vehicles that belong to none."""

    flows: tuple[CountConfig, ...]
    vehicles: Counter[int]
    unassigned: int


def _count_movements(passages: Sequence[Passage], streets: Streets, junction: StreetJunction) -> _MovementCounts:
    """Count vehicles by the roads on which they enter and leave the region of interest."""
    flows = junctions.assumed_flows(streets, junctions.region_around(junction), junction.ring)
    number_of = {(flow.edge or flow.from_edge, flow.edge or flow.to_edge): number for number, flow in enumerate(flows)}
    reach = _Reach(streets.network)
    entries = {start for start, _ in number_of if start}
    exits = {end for _, end in number_of if end}
    vehicles: Counter[int] = Counter()
    unassigned = 0
    for passage in passages:
        starts = _gates(passage.edges[::-1], entries, reach.before(passage.edges[0]))
        ends = _gates(passage.edges[::-1], exits, reach.after(passage.edges[-1]))
        possible = [number_of[pair] for pair in itertools.product(starts, ends) if pair in number_of]
        if possible:
            vehicles[possible[0]] += 1
        else:
            unassigned += 1
    return _MovementCounts(tuple(flows), vehicles, unassigned)


def _gates(edges: Sequence[str], gates: set[str], beyond: set[str]) -> list[str]:
    """Return the gates among the roads of a vehicle, or the only one beyond them.

    A vehicle that changes between parallel roads uses several; the one nearest to the junction has its turn.
    """
    used = [edge for edge in edges if edge in gates]
    possible = gates & beyond
    return used or (list(possible) if len(possible) == 1 else [])


class _Reach:
    """The roads from which a road is reached, and those that it leads to, without turning back."""

    def __init__(self, network: Network) -> None:
        edges = network.edges
        self._after: dict[str, set[str]] = {}
        self._before: dict[str, set[str]] = {}
        for source, target, turns_back in network.links(CAR).tolist():
            if not turns_back:
                self._after.setdefault(edges[source].id, set()).add(edges[target].id)
                self._before.setdefault(edges[target].id, set()).add(edges[source].id)

    def after(self, edge: str) -> set[str]:
        """Return the roads that a road leads to."""
        return _reached(edge, self._after)

    def before(self, edge: str) -> set[str]:
        """Return the roads that lead to a road."""
        return _reached(edge, self._before)


def _reached(edge: str, following: Mapping[str, set[str]]) -> set[str]:
    reached, front = {edge}, [edge]
    while front:
        for after in following.get(front.pop(), ()):
            if after not in reached:
                reached.add(after)
                front.append(after)
    return reached


def _passage_notes(passages: track_demand.Passages, unassigned: int) -> Iterator[str]:
    left_out = [
        (passages.inside_at_begin, "were inside the junction when the recording began"),
        (passages.on_one_road, "were seen on one road only"),
        (passages.off_lanes, "were near no lane"),
        (unassigned, "passed it on no movement through the region of interest"),
    ]
    texts = [f"{number} {reason}" for number, reason in left_out if number]
    if texts:
        yield f"Recorded vehicles that count for no movement: {', '.join(texts)}."


def _people_notes(tracks: CleanTracks) -> Iterator[str]:
    """Say which road users the counts do not contain."""
    others = Counter(name for name in tracks.classes if name not in VEHICLE_CLASSES)
    if others:
        texts = [number_of(number, name) for name, number in others.most_common()]
        yield (
            f"Not part of the demand: {', '.join(texts)}. Pedestrians and bicycles are added with the effect"
            " pedestrians_bicycles."
        )
