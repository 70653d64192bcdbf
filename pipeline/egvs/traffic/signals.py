"""Signal plans: read those of a network, and replace them by plans of the scenario.

A signal governs links, one for each way from lane to lane or over a crossing. A plan gives green to movements of
approaches ("north Main Street: left"). Steps of :func:`apply_plans`: find the signal and the links of each movement;
check the plan; write its phases, each followed by yellow and all-red for the links that lose their green, into the
network.

In a phase, a link has green with right of way ("G"), or gives way to another green ("g"), as the network's right of way
says. Two links that conflict (foes in the network) may be green together only if one of them turns and gives way to
oncoming traffic, or to people on a crossing.

World frame, metres, seconds.
"""

from __future__ import annotations

import csv
import gzip
import io
import re
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from pydantic import ValidationError

from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.grid import Roi
from egvs.formats import xml
from egvs.scenario.model import Scenario
from egvs.scenario.signal_config import SignalConfig, SignalPhaseConfig
from egvs.traffic import network
from egvs.traffic.directions import TURNS, Floats, compass, lane_heading
from egvs.traffic.movements import street_name

GREEN_LETTERS = frozenset("Gg")
YELLOW_LETTERS = frozenset("yY")
_MAY_PASS = GREEN_LETTERS | frozenset("sOo")
"""States in which a vehicle may drive on, at once or after giving way."""

CROSSING, ALL = "crossing", "all"
MOVEMENTS = ("left", "straight", "right", "back", CROSSING)

_OPPOSITE_COSINE = -0.5
"""Approaches whose directions differ by more than 120 degrees are opposite."""

_PROGRAM = re.compile(r"    <tlLogic id=(\"[^\"]*\").*?</tlLogic>\n", re.DOTALL)
_GZIP = b"\x1f\x8b"
_MAX_NAMED = 20
_MAX_GREENS = 6
_MAX_CSV_BYTES = 1_000_000

CSV_COLUMNS = ("phase", "approach", "movement", "green_s")
CSV_OPTIONAL = ("yellow_s", "all_red_s", "min_green_s", "max_green_s")


@dataclass(frozen=True)
class Link:
    """A way over a signalised junction.

    Attributes
    ----------
    index
        Its position in the states of the program.
    approach
        Compass direction and street that it comes from; of a crossing, the arm that it crosses.
    movement
        One of :data:`MOVEMENTS`.
    edge, street
        Edge of the approach, and its street; empty for a crossing, and for a street without a name.
    heading
        Direction of travel at the stop line, (2,); None for a crossing.
    foes, yields_to
        Positions of the links that conflict with it, and of those that it gives way to.
    """

    index: int
    approach: str
    movement: str
    edge: str
    street: str
    heading: Floats | None
    foes: frozenset[int] = frozenset()
    yields_to: frozenset[int] = frozenset()

    @property
    def title(self) -> str:
        """Approach and movement."""
        return f"{self.approach} {self.movement}"


class Phase(NamedTuple):
    """A phase of a program: seconds, one letter for each link, and the limits of an actuated phase."""

    duration_s: float
    state: str
    min_s: float | None = None
    max_s: float | None = None


@dataclass(frozen=True)
class Program:
    """Phases of a signal; ``type`` is SUMO's ("static", "actuated", ...). ``params`` are XML elements."""

    type: str
    offset_s: float
    phases: tuple[Phase, ...]
    params: tuple[str, ...] = ()

    @classmethod
    def from_element(cls, element: Any) -> Program:
        """Parse a ``<tlLogic>``."""
        phases = []
        for phase in element.iter("phase"):
            limits = [float(phase.attrib[key]) if key in phase.attrib else None for key in ("minDur", "maxDur")]
            phases.append(Phase(float(phase.attrib["duration"]), phase.attrib["state"], *limits))
        return cls(element.get("type", "static"), float(element.get("offset", "0")), tuple(phases))

    @property
    def cycle_s(self) -> float:
        """Sum of the durations of the phases."""
        return sum(phase.duration_s for phase in self.phases)

    def to_xml(self, name: str) -> str:
        """Return the ``<tlLogic>`` as netconvert writes it."""
        lines = []
        for phase in self.phases:
            limits = "".join(
                f' {key}="{value:g}"'
                for key, value in (("minDur", phase.min_s), ("maxDur", phase.max_s))
                if value is not None
            )
            lines.append(f'        <phase duration="{phase.duration_s:g}" state="{phase.state}"{limits}/>\n')
        lines += [f"        {param}\n" for param in self.params]
        head = f'    <tlLogic id={quoteattr(name)} type="{self.type}" programID="0" offset="{self.offset_s:g}">\n'
        return f"{head}{''.join(lines)}    </tlLogic>\n"


@dataclass(frozen=True)
class Signal:
    """A traffic signal of a network.

    Attributes
    ----------
    id
        Id of its program.
    nodes
        Ids of the junctions that it governs.
    at_m
        Mean position of these.
    links
        In the order of the states.
    program
        Its program in the network.
    """

    id: str
    nodes: tuple[str, ...]
    at_m: tuple[float, float]
    links: tuple[Link, ...]
    program: Program

    @property
    def approaches(self) -> dict[str, list[str]]:
        """Movements of each approach."""
        movements: dict[str, list[str]] = {}
        for link in self.links:
            known = movements.setdefault(link.approach, [])
            if link.movement not in known:
                known.append(link.movement)
        return movements

    @property
    def streets(self) -> tuple[str, ...]:
        """Names of its streets."""
        return tuple(dict.fromkeys(link.street for link in self.links if link.street))

    @property
    def states(self) -> int:
        """Number of letters of a state."""
        return max(link.index for link in self.links) + 1


@dataclass
class _NetworkParts:
    """Elements of a network that concern signals."""

    connections: list[dict[str, str]] = field(default_factory=list)
    requests: dict[str, list[dict[str, str]]] = field(default_factory=dict)
    programs: dict[str, Program] = field(default_factory=dict)
    crossed_edges: dict[str, list[str]] = field(default_factory=dict)


def read_signals(path: Path, roads: network.Network) -> tuple[Signal, ...]:
    """Read the signals of a network.

    Parameters
    ----------
    path
        The network.
    roads
        The same network.

    Raises
    ------
    InputError
        When the file is damaged.
    """
    parts = _NetworkParts()
    for element in xml.iter_elements(path, "net"):
        try:
            if element.tag == "connection" and "tl" in element.attrib:
                parts.connections.append(dict(element.attrib))
            elif element.tag == "junction":
                parts.requests[element.attrib["id"]] = [dict(each.attrib) for each in element.iter("request")]
            elif element.tag == "tlLogic":
                parts.programs[element.attrib["id"]] = Program.from_element(element)
            elif element.tag == "edge" and element.get("function") == "crossing":
                parts.crossed_edges[element.attrib["id"]] = element.get("crossingEdges", "").split()
        except (KeyError, ValueError) as error:
            raise InputError(path, f"invalid <{element.tag}> of a signal ({error!r})", "Use netconvert.") from None
    by_signal: dict[str, list[dict[str, str]]] = {}
    for connection in parts.connections:
        by_signal.setdefault(connection["tl"], []).append(connection)
    signals = []
    for name, connections in by_signal.items():
        if name in parts.programs:
            signals.append(_read_signal(name, connections, parts, roads))
    return tuple(signals)


def _read_signal(
    name: str, connections: Sequence[Mapping[str, str]], parts: _NetworkParts, roads: network.Network
) -> Signal:
    edges = {edge.id: edge for edge in roads.all_edges}
    positions: dict[tuple[str, int], int] = {}  # of the links, by junction and position among its requests
    keys = []
    for connection in connections:
        key = _request_key(connection, parts)
        positions[key] = int(connection["linkIndex"])
        keys.append(key)

    incoming = {connection["from"] for connection in connections if not connection["from"].startswith(":")}
    names = _approach_names([edges[edge] for edge in sorted(incoming)])
    links = []
    for connection, (node, number) in zip(connections, keys, strict=True):
        request = next((each for each in parts.requests[node] if int(each["index"]) == number), {})
        foes, yields_to = (
            frozenset(positions[node, bit] for bit in request_bits(request.get(key, "")) if (node, bit) in positions)
            for key in ("foes", "response")
        )
        start = connection["from"]
        if start in names:
            lane = edges[start].lanes[int(connection["fromLane"])]
            movement = TURNS.get(connection.get("dir", ""), "straight")
            heading = lane_heading(lane, at_end=True)
            street = street_name(edges[start]) if edges[start].name else ""
            link = Link(int(connection["linkIndex"]), names[start], movement, start, street, heading, foes, yields_to)
        else:
            arm = _crossed_arm(parts.crossed_edges.get(connection["to"], ()), names, edges)
            link = Link(int(connection["linkIndex"]), arm, CROSSING, "", "", None, foes, yields_to)
        links.append(link)
        if "linkIndex2" in connection:
            links.append(replace(link, index=int(connection["linkIndex2"])))
    nodes = tuple(dict.fromkeys(node for node, _ in keys))
    at_m = np.mean([junction.at_m for junction in roads.junctions if junction.id in nodes], axis=0)
    links.sort(key=lambda link: link.index)
    return Signal(name, nodes, (float(at_m[0]), float(at_m[1])), tuple(links), parts.programs[name])


def _request_key(connection: Mapping[str, str], parts: _NetworkParts) -> tuple[str, int]:
    """Return the junction of a connection, and its position among the junction's requests.

    Internal edges are numbered by the first of their links; the crossings are the last requests of a junction.
    """
    to = connection["to"]
    if to in parts.crossed_edges:
        node, _, number = to[1:].rpartition("_c")
        crossings = sum(name.startswith(f":{node}_c") for name in parts.crossed_edges)
        return node, len(parts.requests[node]) - crossings + int(number)
    node, first, lane = connection["via"][1:].rsplit("_", 2)
    return node, int(first) + int(lane)


def request_bits(bits: str) -> set[int]:
    """Return the links in ``foes`` or ``response`` of a request; the last letter is that of link 0."""
    return {index for index, bit in enumerate(reversed(bits)) if bit == "1"}


def _approach_names(edges: Sequence[network.Edge]) -> dict[str, str]:
    """Return the name of each approach by the id of its edge: where it comes from, and its street."""
    names = {}
    for edge in edges:
        words = [compass(-lane_heading(edge.lanes[0], at_end=True))]
        if edge.name:
            words.append(street_name(edge))
        names[edge.id] = " ".join(words)
    listed = list(names.values())
    return {edge: name if listed.count(name) == 1 else f"{name} ({edge})" for edge, name in names.items()}


def _crossed_arm(crossed: Sequence[str], names: Mapping[str, str], edges: Mapping[str, network.Edge]) -> str:
    """Return the approach of the arm that a crossing crosses; where only its exit is crossed, the one beside it."""
    for edge in crossed:
        if edge in names:
            return names[edge]
    for edge in crossed:
        if edge in edges:
            side = compass(lane_heading(edges[edge].lanes[0], at_end=False))
            beside = [name for name in names.values() if name.partition(" ")[0] == side]
            return beside[0] if beside else side
    return "the junction"


# ---- plans of the scenario


def check_plans(scenario: Scenario, path: Path, roads: network.Network) -> None:
    """Raise an InputError if a plan of the scenario is wrong for a network; parameters as in :func:`apply_plans`."""
    _programs(scenario, path, roads)


def apply_plans(scenario: Scenario, path: Path, name: Path) -> None:
    """Replace the programs in a network by the plans of the scenario.

    Parameters
    ----------
    scenario
        The plans, ``[traffic.signals]``.
    path
        A copy of its network, which is changed.
    name
        The network, for messages.

    Raises
    ------
    InputError
        When a signal, an approach or a movement is unknown, movements of a phase conflict, one never has green, or the
        phases do not fill the cycle.
    """
    if not scenario.traffic.signals:
        return
    programs = _programs(scenario, path, network.read_net_xml(path, name))
    with files.attach_filename(path):
        content = path.read_bytes()
        if content.startswith(_GZIP):
            content = gzip.decompress(content)
        try:
            text = replace_programs(content.decode("utf-8"), programs)
        except ValueError as error:
            raise InputError(
                name, f"signal programs cannot be replaced: {error}", "Convert it with netconvert."
            ) from None
        path.write_text(text, encoding="utf-8")


def replace_programs(text: str, programs: Mapping[str, Program]) -> str:
    """Return the text of a network with other programs. All programs that a signal has are replaced by one.

    Parameters
    ----------
    text
        The network, as netconvert writes it.
    programs
        New programs by the id of their signal.

    Raises
    ------
    ValueError
        When a signal has no program in the text.
    """
    by_name = {quoteattr(name): (name, program) for name, program in programs.items()}
    replaced: set[str] = set()

    def replacement(match: re.Match[str]) -> str:
        if match[1] not in by_name:
            return match[0]
        if match[1] in replaced:
            return ""
        replaced.add(match[1])
        name, program = by_name[match[1]]
        return program.to_xml(name)

    text = _PROGRAM.sub(replacement, text)
    if missing := by_name.keys() - replaced:
        raise ValueError(f"no <tlLogic> of {', '.join(sorted(missing))} on lines of its own")
    return text


def signal_files(scenario: Scenario) -> list[Path]:
    """Return the files of the plans of a scenario; InputError where one is missing."""
    paths = []
    for name, config in scenario.traffic.signals.items():
        if config.file is not None:
            paths.append(scenario.find(config.file, f"traffic.signals.{name}.file"))
    return paths


def _programs(scenario: Scenario, path: Path, roads: network.Network) -> dict[str, Program]:
    signals = read_signals(path, roads)
    programs: dict[str, Program] = {}
    for name, config in scenario.traffic.signals.items():
        where = f"{scenario.file}: traffic.signals.{name}"
        signal = _find_signal(name, signals, where)
        if signal.id in programs:
            raise InputError(where, f"signal {signal.id!r} has two plans", "Remove one of them.")
        programs[signal.id] = _make_program(config, signal, scenario, where)
    return programs


def _find_signal(name: str, signals: Sequence[Signal], where: str) -> Signal:
    """Return the signal of a name: its id, the id of a junction, or street names with "/" or "&" between them."""
    for signal in signals:
        if name == signal.id or name in signal.nodes:
            return signal
    streets = {street.strip().casefold() for street in re.split("[/&]", name)}
    found = [signal for signal in signals if streets <= {street.casefold() for street in signal.streets}]
    if len(found) == 1:
        return found[0]
    known = ", ".join(_describe_signal(signal) for signal in (found or signals)[:_MAX_NAMED]) or "none"
    if found:
        raise InputError(where, f"{len(found)} signals are at these streets: {known}", "Use an id.")
    raise InputError(where, "the network has no such signal", f"Its signals are: {known}.")


def _describe_signal(signal: Signal) -> str:
    return f"{signal.id} ({' / '.join(signal.streets)})" if signal.streets else signal.id


def _make_program(config: SignalConfig, signal: Signal, scenario: Scenario, where: str) -> Program:
    if config.file is not None:
        path = scenario.find(config.file, f"{where.partition(': ')[2]}.file")
        if config.is_sumo_file:
            return _read_program(path, config, signal)
        config = config.model_copy(update={"phases": _read_csv(path, config), "file": None})
        where = str(path)
    greens = [_green_links(phase, signal, f"{where}: phase {n}") for n, phase in enumerate(config.phases, start=1)]
    for number, green in enumerate(greens, start=1):
        _check_conflicts(green, signal, f"{where}: phase {number}")
    _check_never_green(set().union(*greens), signal, where)
    phases = tuple(_phases(config, greens, signal))
    program = Program("static" if config.type == "fixed" else "actuated", config.offset_s, phases)
    if config.cycle_s is not None and abs(program.cycle_s - config.cycle_s) > 1e-6:
        parts = ", ".join(f"{phase.duration_s:g}" for phase in phases)
        problem = f"the phases with yellow and all-red add up to {program.cycle_s:g} s ({parts})"
        raise InputError(f"{where}: cycle_s = {config.cycle_s:g}", problem, f"Use cycle_s = {program.cycle_s:g}.")
    return program


def _green_links(phase: SignalPhaseConfig, signal: Signal, where: str) -> set[int]:
    """Return the positions of the links with green in a phase.

    A crossing that no phase names has green where no green conflicts with it, except turns that give way to people.
    """
    green: set[int] = set()
    for approach, movements in phase.green.items():
        on_approach = _links_of_approach(approach, signal, where)
        for movement in movements:
            wanted = movement.strip().casefold()
            found = [link for link in on_approach if wanted in (ALL, link.movement)]
            if wanted == ALL:
                found = [link for link in found if link.movement != CROSSING]
            if not found:
                known = ", ".join(dict.fromkeys(link.movement for link in on_approach))
                problem = f"approach {approach!r} has no movement {movement!r}"
                raise InputError(where, problem, f"Its movements are: {known}.")
            green |= {link.index for link in found}
    vehicles = [link for link in signal.links if link.index in green and link.movement != CROSSING]
    for link in signal.links:
        if link.movement == CROSSING and all(_gives_way_to_people(each, link) for each in vehicles):
            green.add(link.index)
    return green


def _gives_way_to_people(link: Link, crossing: Link) -> bool:
    if crossing.index not in link.foes and link.index not in crossing.foes:
        return True
    return link.movement != "straight" and crossing.index in link.yields_to


def _links_of_approach(approach: str, signal: Signal, where: str) -> list[Link]:
    wanted = " ".join(approach.split()).casefold()
    matches: dict[str, list[Link]] = {}
    for link in signal.links:
        side, _, street = link.approach.casefold().partition(" ")
        if wanted in (link.approach.casefold(), side, street, link.edge.casefold()):
            matches.setdefault(link.approach, []).append(link)
    known = "; ".join(f"{name} ({', '.join(movements)})" for name, movements in signal.approaches.items())
    if not matches:
        raise InputError(where, f"signal {signal.id} has no approach {approach!r}", f"Its approaches are: {known}.")
    if len(matches) > 1:
        problem = f"approach {approach!r} may be {' or '.join(map(repr, matches))}"
        raise InputError(where, problem, "Use the full name.")
    return next(iter(matches.values()))


def _check_conflicts(green: set[int], signal: Signal, where: str) -> None:
    links = {link.index: link for link in signal.links}
    for index in sorted(green):
        for foe in sorted(links[index].foes & green):
            a, b = links[index], links[foe]
            if index < foe and not _may_be_green_together(a, b):
                problem = f"{a.title} and {b.title} conflict, but both have green"
                raise InputError(where, problem, "Give them green in different phases.")


def _may_be_green_together(a: Link, b: Link) -> bool:
    """Whether one of two links that conflict turns and gives way to people, or to oncoming traffic."""
    for turning, other in ((a, b), (b, a)):
        if turning.movement == CROSSING:
            continue
        if other.movement == CROSSING:
            if _gives_way_to_people(turning, other):
                return True
            continue
        assert turning.heading is not None and other.heading is not None
        gives_way = turning.movement != "straight" and other.index in turning.yields_to
        if gives_way and (turning.edge == other.edge or _cosine(turning.heading, other.heading) < _OPPOSITE_COSINE):
            return True
    return False


def _cosine(a: Floats, b: Floats) -> float:
    return float(a @ b / np.sqrt((a @ a) * (b @ b)))


def _check_never_green(green: set[int], signal: Signal, where: str) -> None:
    red = dict.fromkeys(link.title for link in signal.links if link.index not in green and link.movement != CROSSING)
    if red:
        raise InputError(where, f"never green: {', '.join(red)}", "Add these movements to a phase.")


def _phases(config: SignalConfig, greens: Sequence[set[int]], signal: Signal) -> Iterator[Phase]:
    """Yield each phase, and the yellow and all-red after it for the links that lose their green."""
    is_actuated = config.type == "actuated"
    for number, (phase, green) in enumerate(zip(config.phases, greens, strict=True)):
        limits = (phase.shortest_green_s, phase.longest_green_s) if is_actuated else ()
        yield Phase(phase.green_s, state_of(green, signal), *limits)
        remaining = green & greens[(number + 1) % len(greens)]
        ending = {link.index for link in signal.links if link.index in green - remaining and link.movement != CROSSING}
        yellow_s = config.yellow_s if phase.yellow_s is None else phase.yellow_s
        all_red_s = config.all_red_s if phase.all_red_s is None else phase.all_red_s
        if yellow_s:
            yield Phase(yellow_s, state_of(remaining, signal, ending))
        if all_red_s:
            yield Phase(all_red_s, state_of(remaining, signal))


def state_of(green: Set[int], signal: Signal, yellow: Set[int] = frozenset()) -> str:
    """Return the state with green and yellow links; a green that gives way to another one is "g".

    Parameters
    ----------
    green, yellow
        Positions of links.
    signal
        Their signal.
    """
    letters = ["r"] * signal.states
    for link in signal.links:
        if link.index in green:
            letters[link.index] = "g" if link.yields_to & green else "G"
        elif link.index in yellow:
            letters[link.index] = "y"
    return "".join(letters)


def _read_program(path: Path, config: SignalConfig, signal: Signal) -> Program:
    """Read the program of a signal from a SUMO file: that of its id, or the only one."""
    programs = {}
    try:
        for element in xml.iter_elements(path, ""):
            if element.tag == "tlLogic":
                programs[element.attrib["id"]] = Program.from_element(element)
    except (KeyError, ValueError) as error:
        raise InputError(path, f"invalid <tlLogic> ({error!r})", "See SUMO's documentation of tlLogic.") from None
    program = programs.get(signal.id)
    if program is None and len(programs) == 1:
        program = next(iter(programs.values()))
    if program is None or not program.phases:
        known = ", ".join(programs) or "none"
        raise InputError(path, f"no <tlLogic> with phases for signal {signal.id!r}", f"It has: {known}.")
    by_index = {link.index: link for link in signal.links}
    never_green = set(by_index)
    for number, phase in enumerate(program.phases, start=1):
        where = f"{path}: phase {number}"
        if len(phase.state) != signal.states:
            problem = f"expected a state of {signal.states} letters, got {len(phase.state)}"
            raise InputError(where, problem, f"The signal {signal.id} has {signal.states} links.")
        never_green -= {index for index, letter in enumerate(phase.state) if letter in _MAY_PASS}
        with_right_of_way = {
            link.index for link in signal.links if phase.state[link.index] == "G" and link.movement != CROSSING
        }
        for index in sorted(with_right_of_way):
            for foe in sorted(by_index[index].foes & with_right_of_way):
                problem = (
                    f"{by_index[index].title} and {by_index[foe].title} conflict, but both have green with right of"
                    " way (G)"
                )
                raise InputError(where, problem, "Use g for the one that gives way, or another phase.")
    _check_never_green(set(by_index) - never_green, signal, str(path))
    return replace(program, offset_s=program.offset_s + config.offset_s)


def _read_csv(path: Path, config: SignalConfig) -> tuple[SignalPhaseConfig, ...]:
    """Read the phases of a plan, in the order in which they first occur."""
    hint = f"Columns: {', '.join(CSV_COLUMNS)}; optional: {', '.join(CSV_OPTIONAL)}."
    with files.open_input(path) as content:
        raw = content.read(_MAX_CSV_BYTES + 1)
    try:
        rows = list(csv.DictReader(io.StringIO(raw.decode("utf-8-sig")), skipinitialspace=True, strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, f"cannot be read as CSV ({error})", hint) from None
    if len(raw) > _MAX_CSV_BYTES:
        raise InputError(path, f"expected a signal plan, got more than {_MAX_CSV_BYTES:,} bytes", hint)
    if not rows:
        raise InputError(path, "expected a phase in each row, got none", hint)
    if missing := [name for name in CSV_COLUMNS if name not in rows[0]]:
        raise InputError(path, f"the column {missing[0]!r} is missing", hint)
    if unknown := [name for name in rows[0] if name not in (*CSV_COLUMNS, *CSV_OPTIONAL) and name is not None]:
        raise InputError(path, f"unknown column {unknown[0]!r}", hint)
    phases: dict[str, dict[str, Any]] = {}
    for line, row in enumerate(rows, start=2):
        where = f"{path}: line {line}"
        if None in row or None in row.values():
            raise InputError(where, "the row has more or fewer values than the header has columns", hint)
        values = phases.setdefault(row["phase"].strip(), {"green": {}})
        movements = values["green"].setdefault(row["approach"].strip(), [])
        movements += row["movement"].split()
        for key in ("green_s", *CSV_OPTIONAL):
            text = (row.get(key) or "").strip()
            if not text:
                continue
            number = _parse_seconds(text, f"{where}: {key}")
            if values.setdefault(key, number) != number:
                problem = f"expected {values[key]:g} as before in phase {row['phase']!r}, got {number:g}"
                raise InputError(f"{where}: {key}", problem, "Use one value for each phase.")
    configs = []
    for name, values in phases.items():
        try:
            configs.append(SignalPhaseConfig.from_dict(values))
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(map(str, first["loc"]))
            raise InputError(
                f"{path}: phase {name!r}: {key}", first["msg"].removeprefix("Value error, "), hint
            ) from None
        unused = sorted({"min_green_s", "max_green_s"} & values.keys())
        if unused and config.type == "fixed":
            problem = f"{', '.join(unused)} has no effect with a fixed plan"
            raise InputError(f"{path}: phase {name!r}", problem, 'Set type = "actuated".')
    return tuple(configs)


def _parse_seconds(text: str, where: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = float("nan")
    if not 0 <= number < 1e5:
        raise InputError(where, f"expected seconds, got {text!r}", "Use a number such as 30.")
    return number


# ---- descriptions


def describe_simulated(scenario: Scenario, path: Path, roads: network.Network) -> list[dict[str, Any]]:
    """Return :func:`describe_signals` for the network that was simulated; parameters as in :func:`apply_plans`."""
    found = read_signals(path, roads)
    planned = {}
    for name, config in scenario.traffic.signals.items():
        signal = _find_signal(name, found, f"{scenario.file}: traffic.signals.{name}")
        planned[signal.id] = config.file or "from the scenario"
    is_assumed = any("signal" in entry for entry in scenario.assumed)
    is_assumed |= scenario.traffic.network is not None and network.is_osm(Path(scenario.traffic.network))
    return describe_signals(found, scenario.roi.box, planned, "assumed" if is_assumed else "from the network")


def describe_signals(
    signals: Sequence[Signal], region: Roi, planned: Mapping[str, str], network_source: str
) -> list[dict[str, Any]]:
    """Return the plans of the signals with a junction in a region, as JSON for the summary of the traffic.

    Parameters
    ----------
    signals
        The signals of the network that was simulated.
    region
        Region of interest.
    planned
        Where the plans of the scenario come from, by the id of their signal.
    network_source
        What the others are: "assumed", or "from the network".

    Returns
    -------
    list of dict
        ``signal``, ``streets``, ``source``, ``type``, ``cycle_s``, ``max_cycle_s`` (of actuated signals), ``offset_s``,
        and ``rows``: ``approach``, ``movements``, ``green_s`` and ``yellow_s`` (pairs of begin and end in the cycle),
        and ``gives_way`` (whether all of its green gives way).
    """
    (x0, y0), (width, depth) = region.origin_m[:2], region.size_m[:2]
    described = []
    for signal in signals:
        x, y = signal.at_m
        if not (x0 <= x <= x0 + width and y0 <= y <= y0 + depth):
            continue
        program = signal.program
        longest_s = sum(phase.max_s if phase.max_s is not None else phase.duration_s for phase in program.phases)
        described.append({
            "signal": signal.id,
            "streets": list(signal.streets),
            "source": planned.get(signal.id, network_source),
            "type": "fixed" if program.type == "static" else program.type,
            "cycle_s": round(program.cycle_s, 3),
            "max_cycle_s": round(longest_s, 3),
            "offset_s": program.offset_s,
            "rows": list(_movement_rows(signal)),
        })  # fmt: skip
    return described


def _movement_rows(signal: Signal) -> Iterator[dict[str, Any]]:
    """Yield the intervals of the movements of each approach; those with equal states share a row."""
    grouped: dict[tuple[str, str], list[Link]] = {}
    for link in sorted(signal.links, key=lambda link: (_clockwise(link), MOVEMENTS.index(link.movement))):
        letters = "".join(phase.state[link.index] for phase in signal.program.phases)
        key = letters if link.movement != CROSSING else f"{CROSSING} {letters}"
        grouped.setdefault((link.approach, key), []).append(link)
    for (approach, key), links in grouped.items():
        letters = key.removeprefix(f"{CROSSING} ")
        green = set(letters) & GREEN_LETTERS
        yield {
            "approach": approach,
            "movements": list(dict.fromkeys(link.movement for link in links)),
            "green_s": _intervals(letters, signal.program, GREEN_LETTERS),
            "yellow_s": _intervals(letters, signal.program, YELLOW_LETTERS),
            "gives_way": green == {"g"},
        }


_CLOCKWISE = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


def _clockwise(link: Link) -> tuple[int, str]:
    side = link.approach.partition(" ")[0]
    return (_CLOCKWISE.index(side) if side in _CLOCKWISE else len(_CLOCKWISE)), link.approach


def _intervals(letters: str, program: Program, accepted: frozenset[str]) -> list[list[float]]:
    """Return begin and end in the cycle of each run of phases with one of the letters."""
    intervals: list[list[float]] = []
    begin_s = 0.0
    for letter, phase in zip(letters, program.phases, strict=True):
        end_s = round(begin_s + phase.duration_s, 3)
        if letter in accepted:
            if intervals and intervals[-1][1] == begin_s:
                intervals[-1][1] = end_s
            else:
                intervals.append([begin_s, end_s])
        begin_s = end_s
    return intervals


def plan_title(plan: Mapping[str, Any]) -> str:
    """Return the streets of a plan of :func:`describe_signals`, or the id of its signal."""
    return " / ".join(plan["streets"]) or str(plan["signal"])


def format_plan(plan: Mapping[str, Any]) -> str:
    """Return a plan of :func:`describe_signals` in a sentence: cycle, and greens of vehicles by approach.

    Approaches and movements that have green at the same times share an entry; of many entries, the first are named.
    """
    cycle = f"cycle {plan['cycle_s']:g} s"
    if plan["type"] != "fixed":
        cycle = f"cycle up to {plan['max_cycle_s']:g} s"
    by_approach: dict[str, list[Mapping[str, Any]]] = {}
    for row in plan["rows"]:
        if row["movements"] != [CROSSING]:
            by_approach.setdefault(row["approach"], []).append(row)
    by_times: dict[str, list[str]] = {}
    seconds: dict[str, float] = {}
    for approach, rows in by_approach.items():
        for row in rows:
            times = repr(row["green_s"])
            seconds[times] = sum(end_s - begin_s for begin_s, end_s in row["green_s"])
            is_whole = all(each["green_s"] == row["green_s"] for each in rows)
            name = approach if is_whole else f"{approach} ({', '.join(row['movements'])})"
            names = by_times.setdefault(times, [])
            if name not in names:
                names.append(name)
    listed = [f"{seconds[times]:g} s {' and '.join(names)}" for times, names in by_times.items()]
    greens = "; ".join(listed[:_MAX_GREENS])
    if len(listed) > _MAX_GREENS:
        greens += f"; {len(listed) - _MAX_GREENS} more in the report"
    return f"Signals at {plan_title(plan)} ({plan['source']}): {plan['type']}, {cycle}; green {greens}."
