"""Write recorded signals into a network, as a program of SUMO's traffic lights.

Steps of :func:`apply_signals`: give the junction traffic lights where the network has none (netconvert); find the
signal group of each connection (where no file assigns them, from how recorded road users move:
:mod:`egvs.extensions.tracks.new.signal_assignment`); choose the recorded cycle whose length is nearest to the median,
with green for as many groups as possible; write its states as phases. A cycle that was recorded has no conflicting
greens and keeps the recorded clearance times. Vehicle-actuated signals vary from cycle to cycle: the notes state
medians and their intervals.

For recorded people beside simulated vehicles, the program is the complete recording on the clock of the people
(:class:`Replay`) instead of one cycle.

A connection without a group is never stopped. Of two greens that cross, SUMO's right of way decides who waits ("g");
where a program governs several junctions, whoever turns. A crossing for pedestrians without a group is green while no
vehicle drives into the road that it crosses, or straight on out of it, and for :data:`CLEARANCE_S` before that.

World frame, metres, seconds.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import LineString, Point

from egvs.core import files
from egvs.core.errors import InputError, RunError
from egvs.core.grid import FloatArray
from egvs.core.wording import by_number, format_percent, number_of
from egvs.creation.plain_network import NETCONVERT_FLAGS, NETWORK_FILE
from egvs.extensions.tracks.new.signal_assignment import (
    Approach,
    RecordedMotion,
    green_share,
    guess_lights,
    is_opposite,
)
from egvs.extensions.tracks.new.signals import GREEN, RED, YELLOW, GroupOfEdges, RecordedSignals, SignalRecord
from egvs.formats import xml
from egvs.formats.georeference import WorldFrame
from egvs.statistics import intervals
from egvs.statistics.intervals import Estimate
from egvs.traffic import sumo
from egvs.traffic.approach_names import ApproachNames
from egvs.traffic.network import read_net_xml
from egvs.traffic.signal_clock import SignalClock
from egvs.traffic.signals import Phase, Program, replace_programs, request_bits

NEAR_M = 6.0
"""A way of the file that assigns groups belongs to a connection if both its ends are nearer than this to its path."""

STEP_S = 0.1
MIN_CYCLE_S, MAX_CYCLE_S = 5.0, 600.0
"""Shorter and longer times between two beginnings of green are no cycles."""

CLEARANCE_S = 5.0
"""A crossing becomes red this long before vehicles may drive over it."""

MIN_IN_GREEN = 0.8
"""Share of recorded vehicles that pass in green or yellow, below which the signals are doubtful."""

MIN_YELLOW_S = 3.0
"""Yellow that is added where a recorded cycle ends in a green that the next one begins with red."""

_GENERATED = re.compile(r"<!-- generated on .*?-->\n*", re.DOTALL)


@dataclass(frozen=True)
class RecordedSignalNetwork:
    """A network with recorded signals.

    Attributes
    ----------
    network
        The text of the network.
    notes
        What was measured, and what is not governed.
    is_guessed
        Whether the assignment of the groups was guessed.
    clock
        The clock of a replayed recording.
    """

    network: str
    notes: tuple[str, ...]
    is_guessed: bool = False
    clock: SignalClock | None = None


@dataclass(frozen=True)
class Replay:
    """The part of a recording that a program replays.

    Attributes
    ----------
    first_s
        Time of the recording at the first frame.
    begin_s
        Time of the simulation at the first frame.
    duration_s
        From the first to the last frame.
    """

    first_s: float
    begin_s: float
    duration_s: float

    @classmethod
    def of(cls, time_range_s: tuple[float, float], begin_s: float) -> Replay:
        """Return the replay of a time range of the recording from a second of the simulation on."""
        first_s, last_s = time_range_s
        return cls(first_s, begin_s, last_s - first_s)


@dataclass(frozen=True)
class _Link:
    """A connection at a signal: its position in the states, its edges, and its path from lane to lane.

    ``stop_line_m`` are the last two points of its first lane, ``exit_m`` the first two of its last. A crossing for
    pedestrians has the edges that it crosses.
    """

    index: int
    from_edge: str
    to_edge: str
    path_m: FloatArray
    stop_line_m: FloatArray
    exit_m: FloatArray
    turns: bool = False
    crossed_edges: frozenset[str] = frozenset()


@dataclass
class _Junction:
    """The signal of a junction: program, links, for each link those that it gives way to, and names of approaches."""

    program: str
    links: list[_Link] = field(default_factory=list)
    yields_to: dict[int, set[int]] = field(default_factory=dict)
    titles: dict[str, str] = field(default_factory=dict)

    @property
    def connections(self) -> list[_Link]:
        """The links of vehicles."""
        return [link for link in self.links if not link.crossed_edges]


@dataclass(frozen=True)
class _Cycle:
    """A recorded cycle, from one beginning of a group's green to the next."""

    begin_s: float
    end_s: float

    @property
    def length_s(self) -> float:
        return self.end_s - self.begin_s


def apply_signals(
    network: str,
    node: str,
    signals: RecordedSignals,
    frame: WorldFrame | None,
    where: str,
    motion: RecordedMotion | None = None,
    replay: Replay | None = None,
) -> RecordedSignalNetwork:
    """Replace the signals of a junction by recorded ones.

    Parameters
    ----------
    network
        The text of a network.
    node
        The junction's id.
    signals
        The recording.
    frame
        Position of the world frame on the Earth, for assignments in degrees.
    where
        Option or file, for messages.
    motion
        Recorded road users, on the clock of the signals: assigns groups where no file does, and tests assignments.
    replay
        What the program replays; by default, it repeats one cycle.

    Raises
    ------
    InputError
        When no group governs a connection of the junction, or no complete cycle is recorded.
    """
    with files.temporary_folder() as folder:
        files.write_text(folder / "map.net.xml", network)
        if not _programs(folder / "map.net.xml", node):
            flags = ["-s", "map.net.xml", "--tls.set", node, *NETCONVERT_FLAGS]
            try:
                sumo.run_netconvert(flags, folder, NETWORK_FILE)
            except RunError as error:
                raise InputError(where, f"netconvert cannot give {node} traffic lights: {error}") from None
            network = _GENERATED.sub("", (folder / NETWORK_FILE).read_text(encoding="utf-8"), count=1)
            files.write_text(folder / "map.net.xml", network)
        junction = _read_junction(folder / "map.net.xml", node)
    motion = motion or RecordedMotion()
    notes: list[str] = []
    is_guessed = not signals.ways and not signals.edges
    if is_guessed:
        signals, notes = _guess_groups(junction, signals, motion, where)
    if signals.ways and not signals.edges and frame is None:
        problem = "the map has no reference system, so lanes in longitude and latitude cannot be assigned to its roads"
        hint = f"Assign the groups in a CSV file with the columns {', '.join(GroupOfEdges.COLUMNS)}."
        raise InputError(where, problem, hint)
    groups = _assign_groups(junction.links, signals, frame)
    if not groups:
        problem = f"no signal group governs a connection of the junction {node}"
        raise InputError(where, problem, "Check that the assignment of groups is for this junction.")
    used = {name: signals.records[name] for name in dict.fromkeys(groups.values())}
    records = list(used.values())
    cycles = _cycles(records)
    if not cycles:
        hint = "Record longer: two beginnings of green of one group."
        raise InputError(where, "no complete cycle of the signals is recorded", hint)
    lengths = intervals.median_of([cycle.length_s for cycle in cycles])
    assert lengths is not None
    cycle = _typical_cycle(cycles, lengths.value, records)
    clock = None
    n_steps = round(cycle.length_s / STEP_S)
    times_s = np.asarray(cycle.begin_s + STEP_S * (np.arange(n_steps) + 0.5), dtype=np.float64)
    if replay is not None:
        clock = _clock(replay, records, cycle)
        times_s = _replayed_times_s(replay, clock)
    phases = _phases(junction, groups, used, times_s)
    text = _write_program(network, junction.program, phases, clock)
    notes += _notes(junction, groups, used, cycle, lengths, clock)
    notes += _agreement_notes(junction, groups, used, motion)
    return RecordedSignalNetwork(text, tuple(notes), is_guessed, clock)


def _guess_groups(
    junction: _Junction, signals: RecordedSignals, motion: RecordedMotion, where: str
) -> tuple[RecordedSignals, list[str]]:
    """Return the recording with groups that were guessed from recorded road users, and notes on them."""
    approaches = _approaches(junction)
    guesses = guess_lights(approaches, signals.records, motion)
    if not guesses:
        problem = "no file says which lanes each signal group governs, and recorded road users do not show it either"
        names = ", ".join(f"{approach.edge} ({junction.titles[approach.edge]})" for approach in approaches)
        hint = f"Add a CSV file with the columns {', '.join(GroupOfEdges.COLUMNS)}; the roads are {names}."
        raise InputError(where, problem, hint)
    roads: dict[tuple[str, str], list[str]] = {}
    for guess in guesses:
        title = f"{guess.from_edge} to {guess.to_edge}" if guess.to_edge else guess.from_edge
        roads.setdefault((guess.light, guess.reason), []).append(title)
    notes = [
        f"Guessed from recorded road users: {light} governs {', '.join(titles)} ({reason})."
        for (light, reason), titles in roads.items()
    ]
    edges = sorted((guess.group for guess in guesses), key=lambda group: not group.to_edge)
    return RecordedSignals(signals.records, (), tuple(edges)), notes


def _approaches(junction: _Junction) -> list[Approach]:
    """Return the roads to a junction, each with the lanes on the same arm that lead away."""
    ends_m: dict[str, dict[tuple[float, ...], None]] = {}
    directions_rad: dict[str, float] = {}
    for link in junction.connections:
        ends_m.setdefault(link.from_edge, {})[tuple(link.stop_line_m[-1].tolist())] = None
        directions_rad.setdefault(link.from_edge, _direction_rad(link.stop_line_m))
    for link in junction.connections:
        away_rad = _direction_rad(link.exit_m)
        for edge, direction_rad in directions_rad.items():
            if is_opposite(direction_rad, away_rad):
                ends_m[edge][tuple(link.exit_m[0].tolist())] = None
    return [Approach(edge, np.array(list(points_m)), directions_rad[edge]) for edge, points_m in ends_m.items()]


def _direction_rad(points_m: FloatArray) -> float:
    x_m, y_m = points_m[-1] - points_m[0]
    return float(np.arctan2(y_m, x_m))


def _clock(replay: Replay, records: Sequence[SignalRecord], cycle: _Cycle) -> SignalClock:
    from_s = max(float(record.starts_s[0]) for record in records)
    to_s = min(record.end_s for record in records)
    return SignalClock(replay.first_s - replay.begin_s, from_s, to_s, cycle.length_s)


def _replayed_times_s(replay: Replay, clock: SignalClock) -> FloatArray:
    """Return the times of the recording to show in each step, from second 0 of the simulation on.

    Times before and after the record are moved by whole cycles into it.
    """
    n_steps = int(np.ceil((replay.begin_s + replay.duration_s + clock.cycle_s) / STEP_S))
    times_s = clock.zero_s + STEP_S * (np.arange(n_steps) + 0.5)
    early = np.ceil(np.maximum(clock.from_s - times_s, 0.0) / clock.cycle_s)
    late = np.ceil(np.maximum(times_s - clock.to_s, 0.0) / clock.cycle_s)
    moved_s: FloatArray = times_s + clock.cycle_s * (early - late)
    return moved_s


def _programs(path: Path, node: str) -> set[str]:
    """Return the programs that govern the connections of a node."""
    edges = {edge.get("id", "") for edge in xml.iter_elements(path, "net") if edge.get("to") == node}
    connections = (element for element in xml.iter_elements(path, "net") if element.tag == "connection")
    return {element.attrib["tl"] for element in connections if element.get("from") in edges and "tl" in element.attrib}


def _read_junction(path: Path, node: str) -> _Junction:
    """Read the links of the program of a node."""
    programs = _programs(path, node)
    if len(programs) != 1:
        hint = "Use a network with one program for the junction."
        raise InputError(node, f"expected one signal program at the junction, got {len(programs)}", hint)
    junction = _Junction(programs.pop())
    shapes: dict[str, FloatArray] = {}
    crossed: dict[str, frozenset[str]] = {}
    internal_lanes: dict[str, list[str]] = {}
    requests: dict[str, dict[int, set[int]]] = {}
    link_of_lane: dict[str, int] = {}
    for element in xml.iter_elements(path, "net"):
        if element.tag == "edge":
            shapes |= {lane.attrib["id"]: _line(lane.attrib["shape"]) for lane in element.iter("lane")}
            if element.get("function") == "crossing":
                crossed[element.attrib["id"]] = frozenset(element.get("crossingEdges", "").split())
        elif element.tag == "junction":
            internal_lanes[element.attrib["id"]] = element.get("intLanes", "").split()
            requests[element.attrib["id"]] = {
                int(request.attrib["index"]): request_bits(request.attrib["response"])
                for request in element.iter("request")
            }
        elif element.tag == "connection" and element.get("tl") == junction.program:
            start, end = element.attrib["from"], element.attrib["to"]
            via = element.get("via", "")
            lanes = f"{start}_{element.attrib['fromLane']}", via, f"{end}_{element.attrib['toLane']}"
            path_m = [shapes[lane] for lane in lanes if lane in shapes]
            turns = element.get("dir") != "s"
            index = int(element.attrib["linkIndex"])
            link_of_lane[lanes[2] if end in crossed else via] = index
            ends_m = path_m[0][-2:], path_m[-1][:2]
            link = _Link(index, start, end, np.vstack(path_m), *ends_m, turns, crossed.get(end, frozenset()))
            junction.links.append(link)
    names = ApproachNames(read_net_xml(path))
    junction.titles = {link.from_edge: names.approach(link.from_edge) for link in junction.connections}
    governed = {lane.rsplit("_", 2)[0].removeprefix(":") for lane in link_of_lane}
    if governed == {node}:
        junction.yields_to = _yields_to(internal_lanes[node], requests[node], link_of_lane)
    else:  # requests of different junctions do not refer to each other
        indices = {link.index for link in junction.links}
        turning = {link.index for link in junction.connections if link.turns}
        junction.yields_to = {index: indices - {index} for index in turning}
    return junction


def _yields_to(
    lanes: Sequence[str], requests: Mapping[int, set[int]], link_of_lane: Mapping[str, int]
) -> dict[int, set[int]]:
    """Return the positions in the states that each gives way to; requests count the lanes inside the junction."""
    yields_to: dict[int, set[int]] = {}
    for request, foes in requests.items():
        if request >= len(lanes) or lanes[request] not in link_of_lane:
            continue
        index = link_of_lane[lanes[request]]
        others = {link_of_lane[lanes[foe]] for foe in foes if foe < len(lanes) and lanes[foe] in link_of_lane}
        yields_to[index] = yields_to.get(index, set()) | others - {index}
    return yields_to


def _line(text: str) -> FloatArray:
    return np.array([[float(value) for value in point.split(",")[:2]] for point in text.split()], dtype=np.float64)


def _assign_groups(links: Sequence[_Link], signals: RecordedSignals, frame: WorldFrame | None) -> dict[int, str]:
    """Return the lit signal group of each link that has one."""
    lit = {name for name, record in signals.records.items() if record.is_lit}
    ways = []
    if frame is not None:
        for way in signals.ways:
            # lanes begin at the junction, in both directions
            source_m, sink_m = frame.from_lon_lat(way.source_deg[:1]), frame.from_lon_lat(way.sink_deg[:1])
            ways.append((way.group, Point(source_m[0]), Point(sink_m[0])))
    groups = {}
    for link in links:
        by_edges = [
            each.group
            for each in signals.edges
            if each.from_edge == link.from_edge and each.to_edge in ("", link.to_edge) and each.group in lit
        ]
        if by_edges:
            groups[link.index] = by_edges[0]
            continue
        if link.crossed_edges:
            continue
        path = LineString(link.path_m)
        near = [(max(path.distance(source), path.distance(sink)), group) for group, source, sink in ways if group in lit
                and path.project(source) < path.project(sink)]  # fmt: skip
        distance_m, group = min(near, default=(np.inf, ""))
        if distance_m <= NEAR_M:
            groups[link.index] = group
    return groups


def _cycles(records: Sequence[SignalRecord]) -> list[_Cycle]:
    """Return all recorded cycles, from each beginning of green to the next of the same group."""
    cycles = []
    for record in records:
        starts_s = record.green_starts_s
        cycles += [_Cycle(begin_s, end_s) for begin_s, end_s in itertools.pairwise(starts_s)]
    return [cycle for cycle in cycles if MIN_CYCLE_S <= cycle.length_s <= MAX_CYCLE_S]


def _typical_cycle(cycles: Sequence[_Cycle], median_s: float, records: Sequence[SignalRecord]) -> _Cycle:
    """Return the cycle in which most groups become green, and of these the one nearest to the median."""

    def without_green(cycle: _Cycle) -> int:
        return sum(
            not any(cycle.begin_s - 1e-6 <= start_s < cycle.end_s - 1e-6 for start_s in record.green_starts_s)
            for record in records
        )

    return min(cycles, key=lambda cycle: (without_green(cycle), abs(cycle.length_s - median_s), cycle.begin_s))


def _phases(
    junction: _Junction, groups: Mapping[int, str], records: Mapping[str, SignalRecord], times_s: FloatArray
) -> list[tuple[float, str]]:
    """Return duration and state of the phases that show a recording at some times, one for each step."""
    n_links = max(link.index for link in junction.links) + 1
    letters = np.full((times_s.size, n_links), "g")
    for index, group in groups.items():
        letters[:, index] = _with_yellow([records[group].state_at(time_s) for time_s in times_s.tolist()])
    governed = set(groups)
    for link in junction.links:
        if link.crossed_edges and link.index not in groups:
            letters[:, link.index] = _crossing_letters(link, junction.connections, groups, letters)
            governed.add(link.index)
    states = ["".join(_with_right_of_way(row, governed, junction.yields_to)) for row in letters.tolist()]
    phases: list[tuple[float, str]] = []
    for state in states:
        if phases and phases[-1][1] == state:
            phases[-1] = (phases[-1][0] + STEP_S, state)
        else:
            phases.append((STEP_S, state))
    return [(round(duration_s, 1), state) for duration_s, state in phases]


def _crossing_letters(
    crossing: _Link, connections: Sequence[_Link], groups: Mapping[int, str], letters: NDArray[np.str_]
) -> NDArray[np.str_]:
    """Return the states of a crossing without a group: green while no vehicle comes, except those that turn into it."""
    is_free = np.ones(len(letters), dtype=bool)
    for link in connections:
        comes = link.from_edge in crossing.crossed_edges or (link.to_edge in crossing.crossed_edges and not link.turns)
        if comes and link.index in groups:
            is_free &= letters[:, link.index] == RED
    steps = round(CLEARANCE_S / STEP_S)
    is_green = is_free.copy()
    for shift in range(1, steps + 1):
        is_green &= np.roll(is_free, -shift)
    return np.where(is_green, GREEN, RED)


def _with_yellow(states: list[str]) -> list[str]:
    """Replace the end of a green that is followed by red at once, also across the end of the cycle, by yellow."""
    count = round(MIN_YELLOW_S / STEP_S)
    result = list(states)
    for step, state in enumerate(states):
        if states[step - 1] == GREEN and state == RED:
            for before in range(step - count, step):
                result[before] = YELLOW
    return result


def _with_right_of_way(
    letters: Sequence[str], governed: Collection[int], yields_to: Mapping[int, set[int]]
) -> Iterator[str]:
    """Yield the letters, with "g" for a green that gives way to green or yellow."""
    may_drive = {index for index, letter in enumerate(letters) if letter in (GREEN, YELLOW)}
    for index, letter in enumerate(letters):
        if index in governed and letter == GREEN and yields_to.get(index, set()) & may_drive:
            yield "g"
        else:
            yield letter


def _write_program(
    network: str, program: str, phases: Sequence[tuple[float, str]], clock: SignalClock | None = None
) -> str:
    """Replace a program of a network."""
    recorded = Program("static", 0.0, tuple(Phase(duration_s, state) for duration_s, state in phases), clock)
    return replace_programs(network, {program: recorded})


def _notes(
    junction: _Junction,
    groups: Mapping[int, str],
    records: Mapping[str, SignalRecord],
    cycle: _Cycle,
    lengths: Estimate,
    clock: SignalClock | None,
) -> Iterator[str]:
    program = f"The signals repeat a recorded cycle of {cycle.length_s:.1f} s"
    if clock is not None:
        seconds = f"{clock.from_s:.1f} to {clock.to_s:.1f} s"
        program = f"The signals replay the record from {seconds} on the clock of the tracks"
    yield (
        f"{program}; median of {number_of(lengths.n, 'recorded cycle')}"
        f" {lengths.value:.1f} s ({lengths.low:.1f} to {lengths.high:.1f} s)."
    )
    texts = []
    for name, record in sorted(records.items(), key=lambda item: (len(item[0]), item[0])):
        green = intervals.median_of(record.green_durations_s)
        offsets_s = [(start_s - cycle.begin_s) % cycle.length_s for start_s in record.green_starts_s]
        text = f"{name}: no complete green"
        if green is not None:
            greens = number_of(green.n, "green")
            text = f"{name}: {green.value:.1f} s ({green.low:.1f} to {green.high:.1f}, {greens})"
        in_cycle_s = [
            start_s - cycle.begin_s for start_s in record.green_starts_s if cycle.begin_s <= start_s < cycle.end_s
        ]
        text += f" from {(in_cycle_s or offsets_s)[0]:.1f} s" if offsets_s else ""
        texts.append(text)
    meaning = "median (95 % interval; the range where there are few), and its beginning in the cycle"
    yield f"Green of each signal group, {meaning}: {'; '.join(texts)}."
    free = sum(link.index not in groups for link in junction.connections)
    if free:
        yield (
            f"{free} of {number_of(len(junction.connections), 'connection')} {by_number(free, 'has', 'have')}"
            " no recorded signal; vehicles there give way."
        )
    crossings = sum(bool(link.crossed_edges) and link.index not in groups for link in junction.links)
    if crossings:
        yield f"{number_of(crossings, 'crossing')} without recorded signal: green while the crossed vehicles have red."


def _agreement_notes(
    junction: _Junction, groups: Mapping[int, str], records: Mapping[str, SignalRecord], motion: RecordedMotion
) -> Iterator[str]:
    """Say how well recorded vehicles obey the signals: it shows a wrong assignment, or another clock."""
    by_edges = {(link.from_edge, link.to_edge): groups[link.index] for link in junction.links if link.index in groups}
    in_green, count = green_share(by_edges, records, motion)
    if count:
        text = (
            f"{in_green} of {number_of(count, 'recorded vehicle')} ({format_percent(in_green / count, 0)}) "
            "pass the stop"
            " line in green or yellow"
        )
        doubtful = in_green < MIN_IN_GREEN * count
        yield f"{text}{': check the clock and the assignment of the signals' if doubtful else ''}."
