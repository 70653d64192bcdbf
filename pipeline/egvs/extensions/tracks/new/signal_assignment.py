"""Find out which recorded light governs which roads of a junction, from how recorded road users move.

Some recordings of signals do not say where their lights stand. Vehicles drive while their light is green or yellow, and
people walk on the lanes at a stop line while it is not. Lights with the same states at all times count as one.

- **Vehicles.** For each movement with at least :data:`MIN_VEHICLES`, the light with the largest share of vehicles that
  passed the stop line during its green or yellow; of lights with nearly the same share, the one with the shortest
  green.
  Movements with fewer vehicles get the light of all vehicles of their road.
- A road without enough vehicles gets the light of the road opposite it.
- **People**, where no road has enough vehicles. Opposite roads share a light; of all ways to give one light to each
  pair of roads, the one where people spend the least time on the lanes of an arm in its own green, per second of green.
  They cross on red, too, so this is weak evidence.

Shares below :data:`MIN_AGREEMENT` (vehicles) and :data:`MIN_PEOPLE_AGREEMENT` decide nothing. World frame, metres,
seconds on the clock of the recording.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.core.wording import format_percent, number_of
from egvs.extensions.tracks.new.signals import GREEN, YELLOW, GroupOfEdges, SignalRecord

MIN_VEHICLES, MIN_PEOPLE = 5, 10
MIN_AGREEMENT, MIN_PEOPLE_AGREEMENT = 0.75, 0.6
MAX_AXES = 4
SAME_SHARE = 0.02
"""Shares that differ by less are nearly the same."""

STOP_LINE_M = (-4.0, 10.0)
"""People count from this far before to this far behind a stop line, where crosswalks are, and on the lanes' width."""

HALF_LANE_M = 2.0
OPPOSITE_RAD = float(np.radians(40.0))


@dataclass(frozen=True)
class Crossing:
    """A recorded vehicle that passed the stop line of a junction: its roads, and when."""

    from_edge: str
    to_edge: str
    time_s: float


@dataclass(frozen=True, eq=False)
class RecordedPeople:
    """Positions of people on foot: track and time of each row, (n,), and x, y, (n, 2)."""

    track: IntArray
    time_s: FloatArray
    xy_m: FloatArray


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """What recorded road users did at a junction."""

    crossings: tuple[Crossing, ...] = ()
    people: RecordedPeople | None = None

    @classmethod
    def joined(cls, motions: Sequence[RecordedMotion]) -> RecordedMotion:
        """Join what several recordings of one clock show; people are those of the first that has any."""
        crossings = itertools.chain.from_iterable(motion.crossings for motion in motions)
        people = next((motion.people for motion in motions if motion.people is not None), None)
        return cls(tuple(crossings), people)


@dataclass(frozen=True, eq=False)
class Approach:
    """A road to the junction: the ends of the lanes of its arm, (n, 2), in both directions, and its direction there."""

    edge: str
    ends_m: FloatArray
    direction_rad: float


@dataclass(frozen=True)
class LightGuess:
    """The light of a movement, or of all movements of a road (``to_edge`` empty), and what it rests on."""

    from_edge: str
    to_edge: str
    light: str
    reason: str

    @property
    def group(self) -> GroupOfEdges:
        """The assignment."""
        return GroupOfEdges(self.light, self.from_edge, self.to_edge)


def is_opposite(first_rad: float, second_rad: float) -> bool:
    """Return whether two directions are opposite, within :data:`OPPOSITE_RAD`."""
    return abs((first_rad - second_rad) % (2.0 * np.pi) - np.pi) < OPPOSITE_RAD


def guess_lights(
    approaches: Sequence[Approach], records: Mapping[str, SignalRecord], motion: RecordedMotion
) -> list[LightGuess]:
    """Guess the light of each road to a junction.

    Parameters
    ----------
    approaches
        The roads.
    records
        States of the lights. Names that begin with "pedestrian", and lights without green, govern no vehicles.
    motion
        What was recorded at the junction, on the clock of the states.

    Returns
    -------
    list of LightGuess
        Roads and movements that could not be decided are left out.
    """
    lights = _different_lights(records)
    if len(lights) < 2:
        return []
    guesses: list[LightGuess] = []
    by_movement: dict[tuple[str, str], list[float]] = defaultdict(list)
    for crossing in motion.crossings:
        by_movement[crossing.from_edge, crossing.to_edge].append(crossing.time_s)
    for approach in approaches:
        of_road = {target: times for (start, target), times in by_movement.items() if start == approach.edge}
        for target, times_s in of_road.items():
            guesses += _from_vehicles(approach.edge, target, times_s, lights)
        guesses += _from_vehicles(approach.edge, "", list(itertools.chain(*of_road.values())), lights)
    if motion.people is not None and not guesses:
        guesses += _from_people(approaches, motion.people, lights)
    return [*guesses, *_from_opposite(approaches, guesses)]


def green_share(
    groups: Mapping[tuple[str, str], str], records: Mapping[str, SignalRecord], motion: RecordedMotion
) -> tuple[int, int]:
    """Return how many recorded vehicles passed while their light was green or yellow, and how many have a light.

    Parameters
    ----------
    groups
        Light of each movement, by the roads from and to.
    records, motion
        As for :func:`guess_lights`.
    """
    states = [
        records[groups[movement]].state_at(crossing.time_s)
        for crossing in motion.crossings
        if (movement := (crossing.from_edge, crossing.to_edge)) in groups
    ]
    return sum(state in (GREEN, YELLOW) for state in states), len(states)


def _different_lights(records: Mapping[str, SignalRecord]) -> dict[str, SignalRecord]:
    """Return one light for vehicles of each sequence of states."""
    lights: dict[str, SignalRecord] = {}
    sequences: set[tuple[bytes, tuple[str, ...]]] = set()
    for name, record in records.items():
        sequence = record.starts_s.tobytes(), record.states
        if name.startswith("pedestrian") or GREEN not in record.states or sequence in sequences:
            continue
        sequences.add(sequence)
        lights[name] = record
    return lights


def _from_vehicles(
    edge: str, target: str, times_s: Sequence[float], lights: Mapping[str, SignalRecord]
) -> Iterator[LightGuess]:
    if len(times_s) < MIN_VEHICLES:
        return
    shares = {
        name: float(np.mean([record.state_at(time_s) in (GREEN, YELLOW) for time_s in times_s]))
        for name, record in lights.items()
    }
    best = max(shares.values())
    light = min(
        (name for name, share in shares.items() if share > best - SAME_SHARE),
        key=lambda name: (sum(lights[name].green_durations_s), name),
    )
    others = max((share for name, share in shares.items() if name != light), default=0.0)
    if shares[light] >= MIN_AGREEMENT:
        reason = (
            f"{format_percent(shares[light], 0)} of {number_of(len(times_s), 'vehicle')} pass in its green "
            "or yellow; next"
            f" light {format_percent(others, 0)}"
        )
        yield LightGuess(edge, target, light, reason)


def _from_people(
    approaches: Sequence[Approach], people: RecordedPeople, lights: Mapping[str, SignalRecord]
) -> Iterator[LightGuess]:
    """Yield the light of each road, where opposite roads share one, in whose green people are on its lanes least."""
    axes = _axes(approaches)
    if len(axes) != len(lights) or len(axes) > MAX_AXES:
        return
    names = list(lights)
    is_green = {
        name: np.array([light.state_at(time_s) == GREEN for time_s in people.time_s]) for name, light in lights.items()
    }
    green_s = {name: max(sum(light.green_durations_s), 1.0) for name, light in lights.items()}
    on_axis = [np.logical_or.reduce([_on_lanes(approach, people) for approach in axis]) for axis in axes]
    rates = np.array([[(near & is_green[name]).sum() / green_s[name] for name in names] for near in on_axis])
    order = min(itertools.permutations(range(len(names))), key=lambda order: rates[range(len(axes)), order].sum())
    in_some_green = np.logical_or.reduce(list(is_green.values())) & np.logical_or.reduce(on_axis)
    count = np.unique(people.track[in_some_green]).size
    if count < MIN_PEOPLE:
        return
    agreement = 1.0 - rates[range(len(axes)), order].sum() / rates.sum()
    if agreement < MIN_PEOPLE_AGREEMENT:
        return
    reason = (
        f"{format_percent(agreement, 0)} of the time that {count} people walked on lanes in some green was "
        "not in the green of these"
        " lanes. This is weak; give a file with the groups if you know them"
    )
    for number, axis in enumerate(axes):
        for approach in axis:
            yield LightGuess(approach.edge, "", names[order[number]], reason)


def _axes(approaches: Sequence[Approach]) -> list[list[Approach]]:
    """Group roads that are opposite each other."""
    axes: list[list[Approach]] = []
    for approach in approaches:
        for axis in axes:
            if is_opposite(axis[0].direction_rad, approach.direction_rad):
                axis.append(approach)
                break
        else:
            axes.append([approach])
    return axes


def _on_lanes(approach: Approach, people: RecordedPeople) -> BoolArray:
    """Return which positions are on the lanes of a road's arm near the junction, (n,)."""
    along = np.array([np.cos(approach.direction_rad), np.sin(approach.direction_rad)])
    across = np.array([-along[1], along[0]])
    near = np.zeros(len(people.time_s), dtype=bool)
    for end_m in approach.ends_m:
        offset_m = people.xy_m - end_m
        ahead_m, beside_m = offset_m @ along, np.abs(offset_m @ across)
        near |= (ahead_m > STOP_LINE_M[0]) & (ahead_m < STOP_LINE_M[1]) & (beside_m < HALF_LANE_M)
    return near


def _from_opposite(approaches: Sequence[Approach], guesses: Sequence[LightGuess]) -> Iterator[LightGuess]:
    lights = {guess.from_edge: guess.light for guess in guesses if not guess.to_edge}
    decided = {guess.from_edge for guess in guesses}
    for approach in approaches:
        if approach.edge in decided:
            continue
        for other in approaches:
            if other.edge in lights and is_opposite(approach.direction_rad, other.direction_rad):
                reason = f"the light of {other.edge}, the road opposite"
                yield LightGuess(approach.edge, "", lights[other.edge], reason)
                break
