"""Read the traffic signals of a network: their programs, and the links that these govern.

A signal governs links, one for each way from lane to lane or over a crossing; each belongs to a movement of an approach
("Main Street (north) left"). Two links that conflict are foes in the network.

World frame, metres, seconds.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.wording import shorten_id
from egvs.formats import xml
from egvs.traffic import network
from egvs.traffic.approach_names import ApproachNames, disambiguate_approaches
from egvs.traffic.directions import TURNS, U_TURN
from egvs.traffic.signal_clock import PARAM as CLOCK_PARAM
from egvs.traffic.signal_clock import SignalClock

GREEN_LETTERS = frozenset("Gg")
YELLOW_LETTERS = frozenset("yY")

CROSSING = "crosswalk"
MOVEMENTS = ("left", "straight", "right", U_TURN, CROSSING)

PROGRAM_TYPES = (
    "static", "actuated", "delay_based", "NEMA", "sotl_phase", "sotl_platoon", "sotl_request", "sotl_wave",
    "sotl_marching", "swarm", "deterministic", "off", "railSignal", "railCrossing",
)  # fmt: skip
"""Types of ``<tlLogic>`` that SUMO 1.26 knows."""

_PROGRAM = re.compile(r"    <tlLogic id=(\"[^\"]*\").*?</tlLogic>\n", re.DOTALL)


@dataclass(frozen=True)
class Link:
    """A way over a signalised junction.

    Attributes
    ----------
    index
        Its position in the states of the program.
    approach
        Name of the approach that it comes from; of a crossing, of the arm that it crosses.
    movement
        One of :data:`MOVEMENTS`.
    edge, street
        Edge of the approach, and its street; empty for a crossing, and for a street without a name or inside the
        junction.
    heading
        Direction in which vehicles arrive, (2,); None for a crossing.
    foes, yields_to
        Positions of the links that conflict with it, and of those that it gives way to.
    side
        Side of the junction where the approach lies; empty for a street inside the junction.
    target
        Edge to which it leads; empty for a crossing.
    aliases
        Other streets that lead to the approach.
    way_out
        Street of the target; may be empty.
    """

    index: int
    approach: str
    movement: str
    edge: str
    street: str
    heading: FloatArray | None
    foes: frozenset[int] = frozenset()
    yields_to: frozenset[int] = frozenset()
    side: str = ""
    target: str = ""
    aliases: tuple[str, ...] = ()
    way_out: str = ""

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
    """Phases of a signal.

    Attributes
    ----------
    type
        SUMO's ("static", "actuated", ...).
    offset_s
        Start of the first phase.
    phases
        In order.
    clock
        Clock of a recording that the program replays, if it does.
    params
        Further parameters of SUMO, such as ``max-gap``.
    """

    type: str
    offset_s: float
    phases: tuple[Phase, ...]
    clock: SignalClock | None = None
    params: tuple[tuple[str, str], ...] = ()

    @classmethod
    def from_element(cls, element: Any) -> Program:
        """Parse a ``<tlLogic>``."""
        phases = []
        for phase in element.iter("phase"):
            duration_s = network.parse_phase_s("duration", phase.attrib["duration"])
            limits_s = {
                key: network.parse_phase_s(key, phase.attrib[key])
                for key in ("minDur", "maxDur")
                if key in phase.attrib
            }
            phases.append(Phase(duration_s, phase.attrib["state"], limits_s.get("minDur"), limits_s.get("maxDur")))
        params = tuple(
            (param.attrib["key"], param.attrib["value"])
            for param in element.iterfind("param")
            if param.get("key") != CLOCK_PARAM
        )
        clock = SignalClock.from_program(element)
        kind, offset_s = element.get("type", "static"), float(element.get("offset", "0"))
        if kind not in PROGRAM_TYPES:
            raise ValueError(f"type = {kind[:80]!r}: expected one of {', '.join(PROGRAM_TYPES)}")
        if not abs(offset_s) <= network.MAX_PHASE_S:
            raise ValueError(f"offset = {offset_s:g}: expected seconds, at most {network.MAX_PHASE_S:g}")
        return cls(kind, offset_s, tuple(phases), clock, params)

    @property
    def longest_s(self) -> tuple[float, ...]:
        """Duration of each phase; of actuated signals, the longest one."""
        if self.type == "static":
            return tuple(phase.duration_s for phase in self.phases)
        return tuple(phase.duration_s if phase.max_s is None else phase.max_s for phase in self.phases)

    @property
    def cycle_s(self) -> float:
        """Duration of the cycle; of actuated signals, the longest one."""
        return sum(self.longest_s)

    def to_xml(self, name: str) -> str:
        """Return the ``<tlLogic>`` as netconvert writes it."""
        lines = []
        for phase in self.phases:
            limits = "".join(
                f' {key}="{_number(value)}"'
                for key, value in (("minDur", phase.min_s), ("maxDur", phase.max_s))
                if value is not None
            )
            lines.append(f'        <phase duration="{_number(phase.duration_s)}" state="{phase.state}"{limits}/>\n')
        if self.clock is not None:
            lines.append(f"        {self.clock.to_param()}\n")
        lines += [f"        <param key={quoteattr(key)} value={quoteattr(value)}/>\n" for key, value in self.params]
        offset_s = _number(self.offset_s)
        head = f'    <tlLogic id={quoteattr(name)} type="{self.type}" programID="0" offset="{offset_s}">\n'
        return f"{head}{''.join(lines)}    </tlLogic>\n"


def _number(value: float) -> str:
    """Return a number as text, to thousandths."""
    return f"{round(value, 3):.12g}"


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
        """Names of its streets, sorted, as in the title of a junction."""
        return tuple(sorted({link.street for link in self.links if link.street}))

    @property
    def title(self) -> str:
        """Its streets and its id in brackets, shortened, e.g. ``"High Street / Mill Lane (cluster_123456789_9…)"``."""
        return self.titled(shorten_id(self.id))

    def titled(self, name: str) -> str:
        """Return its streets, and in brackets its id as it is given."""
        return f"{' / '.join(self.streets)} ({name})" if self.streets else name

    def is_called(self, name: str) -> bool:
        """Whether a name is its id, or that of one of its junctions; also as it is shortened in messages."""
        ids = {self.id, *self.nodes}
        return name in ids | {shorten_id(each) for each in ids}

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
    crossings: set[str] = field(default_factory=set)


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
                if "via" not in element.attrib and not element.attrib["from"].startswith(":"):
                    raise network.no_internal_edges_error(path, path)
                parts.connections.append(dict(element.attrib))
            elif element.tag == "junction":
                parts.requests[element.attrib["id"]] = [dict(each.attrib) for each in element.iter("request")]
            elif element.tag == "tlLogic":
                parts.programs[element.attrib["id"]] = Program.from_element(element)
            elif element.tag == "edge" and element.get("function") == "crossing":
                parts.crossings.add(element.attrib["id"])
        except (KeyError, ValueError) as error:
            problem = f"{error} is missing" if isinstance(error, KeyError) else error
            raise InputError(path, f"invalid <{element.tag}> of a signal ({problem})", "Use netconvert.") from None
    by_signal: dict[str, list[dict[str, str]]] = {}
    for connection in parts.connections:
        by_signal.setdefault(connection["tl"], []).append(connection)
    approaches = ApproachNames(roads)
    signals = []
    for name, connections in by_signal.items():
        if name in parts.programs:
            signals.append(_read_signal(name, connections, parts, roads, approaches))
    return tuple(signals)


def _read_signal(
    name: str,
    connections: Sequence[Mapping[str, str]],
    parts: _NetworkParts,
    roads: network.Network,
    approaches: ApproachNames,
) -> Signal:
    positions: dict[tuple[str, int], int] = {}  # of the links, by junction and position among its requests
    keys = []
    for connection in connections:
        key = _request_key(connection, parts)
        positions[key] = int(connection["linkIndex"])
        keys.append(key)

    incoming = sorted({connection["from"] for connection in connections if not connection["from"].startswith(":")})
    titles = disambiguate_approaches([approaches.approach(edge) for edge in incoming], incoming)
    names = dict(zip(incoming, titles, strict=True))
    links = []
    for connection, (node, number) in zip(connections, keys, strict=True):
        request = next((each for each in parts.requests[node] if int(each["index"]) == number), {})
        foes, yields_to = (
            frozenset(positions[node, bit] for bit in request_bits(request.get(key, "")) if (node, bit) in positions)
            for key in ("foes", "response")
        )
        start = connection["from"]
        index = int(connection["linkIndex"])
        if start in names:
            movement = TURNS.get(connection.get("dir", ""), "straight")
            heading, target = approaches.heading(start), connection["to"]
            street, side, aliases = approaches.street(start), approaches.side(start), approaches.aliases(start)
            if approaches.is_inside(start):
                street, side, aliases = "", "", ()
            ends = side, target, aliases, approaches.street(target)
            link = Link(index, names[start], movement, start, street, heading, foes, yields_to, *ends)
        else:
            arm = approaches.crossed_arm(connection["to"])
            link = Link(index, names.get(arm.edge, arm.name), CROSSING, "", "", None, foes, yields_to, arm.side)
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
    if to in parts.crossings:
        node, _, number = to[1:].rpartition("_c")
        crossings = sum(name.startswith(f":{node}_c") for name in parts.crossings)
        return node, len(parts.requests[node]) - crossings + int(number)
    node, first, lane = connection["via"][1:].rsplit("_", 2)
    return node, int(first) + int(lane)


def request_bits(bits: str) -> set[int]:
    """Return the links in ``foes`` or ``response`` of a request; the last letter is that of link 0."""
    return {index for index, bit in enumerate(reversed(bits)) if bit == "1"}


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
