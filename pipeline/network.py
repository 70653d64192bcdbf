"""Which roads does a SUMO network have, and who may drive from where to where?

Reads a ``.net.xml`` (gzipped or not) straight into the few things that demand and checks need: the roads, their lanes'
permissions, the connections between them, the longest signal cycle, and whether shapes have heights. World frame, metres,
seconds.

The graph of a vClass has an edge's successors as SUMO's own router sees them: a connection counts when the class may use
the lane that it leaves, the lane that it reaches, and the connection itself.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from pipeline import safexml
from pipeline.errors import InputError

_TURNAROUNDS = ("t", "T")


@dataclass(frozen=True)
class Permission:
    """Which vClasses a lane or connection admits, as its attributes ``allow`` and ``disallow`` say."""

    allow: frozenset[str] | None
    disallow: frozenset[str]

    @classmethod
    def of(cls, element: Element) -> Permission:
        """From a ``<lane>`` or a ``<connection>``."""
        allow, disallow = element.get("allow"), element.get("disallow")
        return cls(None if allow in (None, "", "all") else frozenset(str(allow).split()), frozenset((disallow or "").split()))

    def admits(self, vclass: str) -> bool:
        """Whether a vehicle of ``vclass`` may go there."""
        if self.allow is not None:
            return vclass in self.allow
        return vclass not in self.disallow and "all" not in self.disallow


@dataclass(frozen=True)
class Edge:
    """A road in one direction."""

    id: str
    from_node: str
    to_node: str
    lanes: tuple[Permission, ...]
    start_m: tuple[float, float]
    end_m: tuple[float, float]

    def lanes_for(self, vclass: str) -> int:
        """How many of its lanes ``vclass`` may use."""
        return sum(lane.admits(vclass) for lane in self.lanes)


@dataclass(frozen=True)
class Connection:
    """A way from one lane to another; ``source`` and ``target`` are positions in ``Network.edges``."""

    source: int
    source_lane: int
    target: int
    target_lane: int
    turnaround: bool
    permission: Permission


@dataclass(frozen=True)
class Network:
    """What demand and checks need of a network."""

    edges: tuple[Edge, ...]
    connections: tuple[Connection, ...]
    cycle_s: float
    has_heights: bool

    @cached_property
    def diagonal_m(self) -> float:
        """From the south-west to the north-east corner of all roads' ends."""
        ends = np.array([p for e in self.edges for p in (e.start_m, e.end_m)])
        return float(np.hypot(*(ends.max(axis=0) - ends.min(axis=0))))

    def links(self, vclass: str) -> NDArray[np.int64]:
        """(n, 3) of source edge, target edge, and 1 for a turnaround, for ``vclass``."""
        edges = self.edges
        found = [
            (c.source, c.target, int(c.turnaround))
            for c in self.connections
            if edges[c.source].lanes[c.source_lane].admits(vclass)
            and edges[c.target].lanes[c.target_lane].admits(vclass)
            and c.permission.admits(vclass)
        ]
        return np.array(found, dtype=np.int64).reshape(-1, 3)


@dataclass
class _Reading:
    edges: list[Edge] = field(default_factory=list)
    index: dict[str, int] = field(default_factory=dict)
    connections: list[Element] = field(default_factory=list)
    cycle_s: float = 0.0
    has_heights: bool = False


def read(path: Path, name: Path | None = None) -> Network:
    """Read a network; messages call it ``name`` where it is a copy of what the user named.

    Raises
    ------
    InputError
        When the file is no SUMO network, is damaged, or has no road.
    """
    reading, copy = _Reading(), path
    path = name or path
    for element in safexml.children(copy, "net", path):
        try:
            _take(reading, element)
        except (KeyError, ValueError, IndexError) as error:
            what = f"<{element.tag} id={element.get('id', element.get('from', ''))!r}>"
            raise InputError(path, f"{what} is not as in a SUMO network ({error!r})", "a file that netconvert wrote") from None
    if not reading.edges:
        raise InputError(path, "the network has no road", "a network with at least one edge")
    return Network(tuple(reading.edges), tuple(_connections(reading, path)), reading.cycle_s, reading.has_heights)


def _take(reading: _Reading, element: Element) -> None:
    match element.tag:
        case "edge" if not element.get("function"):
            reading.index[element.attrib["id"]] = len(reading.edges)
            reading.edges.append(_edge(reading, element))
        case "connection" if not element.attrib["from"].startswith(":"):
            reading.connections.append(element)
        case "tlLogic":
            reading.cycle_s = max(reading.cycle_s, cycle_s(element.iter("phase")))


def cycle_s(phases: Iterable[Element]) -> float:
    """How long a signal program takes at most to come round."""
    return sum(float(p.get("maxDur", p.attrib["duration"])) for p in phases)


def _edge(reading: _Reading, element: Element) -> Edge:
    lanes = list(element.iter("lane"))
    shape = lanes[0].attrib["shape"].split()
    first, last = ([float(v) for v in shape[i].split(",")] for i in (0, -1))
    reading.has_heights |= len(first) > 2
    return Edge(
        element.attrib["id"],
        element.attrib["from"],
        element.attrib["to"],
        tuple(Permission.of(lane) for lane in lanes),
        (first[0], first[1]),
        (last[0], last[1]),
    )


def _connections(reading: _Reading, path: Path) -> Iterable[Connection]:
    for element in reading.connections:
        try:
            source, target = (reading.index.get(element.attrib[key]) for key in ("from", "to"))
            lanes = int(element.attrib["fromLane"]), int(element.attrib["toLane"])
        except (KeyError, ValueError) as error:
            raise InputError(
                path, f"a <connection> from {element.get('from')!r} is damaged ({error!r})", "a file that netconvert wrote"
            ) from None
        if source is None or target is None:
            continue  # to or from a walking area or a crossing
        if lanes[0] >= len(reading.edges[source].lanes) or lanes[1] >= len(reading.edges[target].lanes):
            raise InputError(
                path,
                f"a <connection> from {element.get('from')!r} names a lane that is not there",
                "a file that netconvert wrote",
            )
        yield Connection(source, lanes[0], target, lanes[1], element.get("dir") in _TURNAROUNDS, Permission.of(element))
