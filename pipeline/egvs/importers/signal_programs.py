"""Write recorded signals into a network, as a program of SUMO's traffic lights.

Steps of :func:`apply_signals`: give the junction traffic lights where the network has none (netconvert); find the
signal group of each connection; choose the recorded cycle whose length is nearest to the median, with green for as many
groups as possible; write its states as phases. A cycle that was recorded has no conflicting greens and keeps the
recorded clearance times. Vehicle-actuated signals vary from cycle to cycle: the notes state medians and their
intervals.

A connection without a group is never stopped. Of two greens that cross, SUMO's right of way decides who waits ("g");
where a program governs several junctions, whoever turns.

World frame, metres, seconds.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from shapely.geometry import LineString, Point

from egvs.core import files
from egvs.core.errors import InputError, RunError
from egvs.core.grid import FloatArray
from egvs.formats import xml
from egvs.formats.georeference import WorldFrame
from egvs.importers.plain_network import NETCONVERT_FLAGS, NETWORK_FILE
from egvs.importers.recorded_signals import GREEN, RED, YELLOW, RecordedSignals, SignalRecord
from egvs.traffic import estimates, sumo
from egvs.traffic.estimates import Estimate
from egvs.traffic.signals import Phase, Program, replace_programs, request_bits

NEAR_M = 6.0
"""A way of the file that assigns groups belongs to a connection if both its ends are nearer than this to its path."""

STEP_S = 0.1
MIN_CYCLE_S, MAX_CYCLE_S = 5.0, 600.0
"""Shorter and longer times between two beginnings of green are no cycles."""

MIN_YELLOW_S = 3.0
"""Yellow that is added where a recorded cycle ends in a green that the next one begins with red."""

_GENERATED = re.compile(r"<!-- generated on .*?-->\n*", re.DOTALL)


@dataclass(frozen=True)
class SignalPlan:
    """A network with recorded signals.

    Attributes
    ----------
    network
        The text of the network.
    notes
        What was measured, and what is not governed.
    """

    network: str
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Link:
    """A connection at a signal: its position in the states, its edges, and its path from lane to lane."""

    index: int
    from_edge: str
    to_edge: str
    path_m: FloatArray


@dataclass
class _Junction:
    """The signal of a junction: program, links, and for each link those that it gives way to."""

    program: str
    links: list[_Link] = field(default_factory=list)
    yields_to: dict[int, set[int]] = field(default_factory=dict)


@dataclass(frozen=True)
class _Cycle:
    """A recorded cycle, from one beginning of a group's green to the next."""

    begin_s: float
    end_s: float

    @property
    def length_s(self) -> float:
        return self.end_s - self.begin_s


def apply_signals(
    network: str, node: str, signals: RecordedSignals, frame: WorldFrame | None, where: str
) -> SignalPlan:
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
    lengths = estimates.median_of([cycle.length_s for cycle in cycles])
    assert lengths is not None
    cycle = _typical_cycle(cycles, lengths.value, records)
    phases = _phases(junction, groups, used, cycle)
    text = _write_program(network, junction.program, phases)
    return SignalPlan(text, tuple(_notes(junction, groups, used, cycle, lengths)))


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
    governed: set[str] = set()
    turning: set[int] = set()
    requests: dict[str, dict[int, set[int]]] = {}
    for element in xml.iter_elements(path, "net"):
        if element.tag == "edge":
            shapes |= {lane.attrib["id"]: _line(lane.attrib["shape"]) for lane in element.iter("lane")}
        elif element.tag == "junction":
            requests[element.attrib["id"]] = {
                int(request.attrib["index"]): request_bits(request.attrib["response"])
                for request in element.iter("request")
            }
        elif element.tag == "connection" and element.get("tl") == junction.program:
            start, end = element.attrib["from"], element.attrib["to"]
            via = element.get("via", "")
            lanes = f"{start}_{element.attrib['fromLane']}", via, f"{end}_{element.attrib['toLane']}"
            path_m = np.vstack([shapes[lane] for lane in lanes if lane in shapes])
            junction.links.append(_Link(int(element.attrib["linkIndex"]), start, end, path_m))
            if element.get("dir") != "s":
                turning.add(junction.links[-1].index)
            governed.add(via.rsplit("_", 2)[0].removeprefix(":"))
    if governed == {node}:  # positions in the states are those of the requests only where it governs one junction
        junction.yields_to = requests[node]
    else:
        indices = {link.index for link in junction.links}
        junction.yields_to = {index: indices - {index} for index in turning}
    return junction


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
    junction: _Junction, groups: Mapping[int, str], records: Mapping[str, SignalRecord], cycle: _Cycle
) -> list[tuple[float, str]]:
    """Return duration and state of the phases of a cycle."""
    n_links = max(link.index for link in junction.links) + 1
    n_steps = round(cycle.length_s / STEP_S)
    letters = np.full((n_steps, n_links), "g")
    for index, group in groups.items():
        times_s = cycle.begin_s + STEP_S * (np.arange(n_steps) + 0.5)
        letters[:, index] = _with_yellow([records[group].state_at(time_s) for time_s in times_s])
    states = ["".join(_with_right_of_way(row, groups, junction.yields_to)) for row in letters.tolist()]
    phases: list[tuple[float, str]] = []
    for state in states:
        if phases and phases[-1][1] == state:
            phases[-1] = (phases[-1][0] + STEP_S, state)
        else:
            phases.append((STEP_S, state))
    return [(round(duration_s, 1), state) for duration_s, state in phases]


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
    letters: Sequence[str], groups: Mapping[int, str], yields_to: Mapping[int, set[int]]
) -> Iterator[str]:
    """Yield the letters, with "g" for a green that gives way to another."""
    green = {index for index, letter in enumerate(letters) if letter == GREEN}
    for index, letter in enumerate(letters):
        if index in groups and letter == GREEN and yields_to.get(index, set()) & green:
            yield "g"
        else:
            yield letter


def _write_program(network: str, program: str, phases: Sequence[tuple[float, str]]) -> str:
    """Replace a program of a network."""
    recorded = Program("static", 0.0, tuple(Phase(duration_s, state) for duration_s, state in phases))
    return replace_programs(network, {program: recorded})


def _notes(
    junction: _Junction,
    groups: Mapping[int, str],
    records: Mapping[str, SignalRecord],
    cycle: _Cycle,
    lengths: Estimate,
) -> Iterator[str]:
    yield (
        f"the signals repeat a recorded cycle of {cycle.length_s:.1f} s; median of {lengths.n} recorded cycles"
        f" {lengths.value:.1f} s ({lengths.low:.1f} to {lengths.high:.1f} s)"
    )
    texts = []
    for name, record in sorted(records.items(), key=lambda item: (len(item[0]), item[0])):
        green = estimates.median_of(record.green_durations_s)
        offsets_s = [(start_s - cycle.begin_s) % cycle.length_s for start_s in record.green_starts_s]
        text = f"{name}: no complete green"
        if green is not None:
            text = f"{name}: {green.value:.1f} s ({green.low:.1f} to {green.high:.1f}, {green.n} greens)"
        in_cycle_s = [
            start_s - cycle.begin_s for start_s in record.green_starts_s if cycle.begin_s <= start_s < cycle.end_s
        ]
        text += f" from {(in_cycle_s or offsets_s)[0]:.1f} s" if offsets_s else ""
        texts.append(text)
    meaning = "median (95 % interval; the range where there are few), and its beginning in the cycle"
    yield f"green of each signal group, {meaning}: {'; '.join(texts)}"
    free = len(junction.links) - len(groups)
    if free:
        yield f"{free} of {len(junction.links)} connections have no recorded signal; vehicles there give way"
