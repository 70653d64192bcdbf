"""Which roads does a SUMO network have, and who may drive from where to where?

Reads a ``.net.xml`` (gzipped or not) straight into the few things that demand and checks need: the roads, their lanes'
permissions, the connections between them, the longest signal cycle, and whether shapes have heights. Further readings
of the same file, for effects only: the lanes' shapes with their heights (:func:`lanes`), and where people may walk
(:func:`walkways`). World frame, metres, seconds.

The graph of a vClass has an edge's successors as SUMO's own router sees them: a connection counts when the class may
use the lane that it leaves, the lane that it reaches, and the connection itself."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from pipeline.core.errors import InputError
from pipeline.formats import safe_xml as safexml
from pipeline.scenario.models import Scenario

_TURNAROUNDS = ("t", "T")
_HEIGHT = re.compile(rb'[" ][^", ]+,[^", ]+,[^", ]+[" ]')
"""A point with a third coordinate. (SUMO writes none where a height is 0.)"""

_LANE_M = 3.2
"""A lane's width where the network names none."""

_PEDESTRIAN = "pedestrian"
_OSM = (".osm", ".osm.xml")


@dataclass(frozen=True)
class Permission:
    """Which vClasses a lane or connection admits, as its attributes ``allow`` and ``disallow`` say."""

    allow: frozenset[str] | None
    disallow: frozenset[str]

    @classmethod
    def of(cls, element: Element) -> Permission:
        """From a ``<lane>`` or a ``<connection>``."""
        allow, disallow = element.get("allow"), element.get("disallow")
        return cls(
            None if allow in (None, "", "all") else frozenset(str(allow).split()), frozenset((disallow or "").split())
        )

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
    lengths_m: tuple[float, ...] = ()
    """Of each lane, as SUMO counts."""

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
            raise InputError(
                path, f"{what} is not as in a SUMO network ({error!r})", "a file that netconvert wrote"
            ) from None
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
    shape = [point.split(",") for point in lanes[0].attrib["shape"].split()]
    first, last = ([float(v) for v in shape[i]] for i in (0, -1))
    reading.has_heights |= any(len(point) > 2 for point in shape)
    return Edge(
        element.attrib["id"],
        element.attrib["from"],
        element.attrib["to"],
        tuple(Permission.of(lane) for lane in lanes),
        (first[0], first[1]),
        (last[0], last[1]),
        tuple(float(lane.get("length", 0)) for lane in lanes),
    )


def _connections(reading: _Reading, path: Path) -> Iterable[Connection]:
    for element in reading.connections:
        try:
            source, target = (reading.index.get(element.attrib[key]) for key in ("from", "to"))
            lanes = int(element.attrib["fromLane"]), int(element.attrib["toLane"])
        except (KeyError, ValueError) as error:
            raise InputError(
                path,
                f"a <connection> from {element.get('from')!r} is damaged ({error!r})",
                "a file that netconvert wrote",
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


def is_osm(path: Path) -> bool:
    """Whether a network is still a map of OpenStreetMap."""
    return path.name.removesuffix(".gz").endswith(_OSM)


def path_of(scenario: Scenario) -> Path | None:
    """The network that a scenario, or the configuration that it names, simulates; None where it names a finished
    file."""
    traffic = scenario.traffic
    if traffic.network is not None:
        return scenario.find(traffic.network, "traffic.network")
    if traffic.sumocfg is None:
        return None
    config = scenario.find(traffic.sumocfg, "traffic.sumocfg")
    for child in safexml.children(config, ""):
        for element in child.iter():
            value = element.get("value", element.get("v"))
            if element.tag in ("net-file", "net", "n") and value:
                return config.parent / os.path.expandvars(value)
    return None


def may_have_heights(path: Path) -> bool:
    """Whether any shape of the file has a third coordinate: a quick look, so that flat networks need no second
    reading."""
    if is_osm(path) or not path.is_file():
        return False
    with safexml.opened(path) as file:
        return any(_HEIGHT.search(line, line.find(b"shape=")) is not None for line in file if b"shape=" in line)


@dataclass(frozen=True)
class Lane:
    """A lane's middle line, (n, 3) float64 in metres, and its width. A walking area has its outline, and no width."""

    shape_m: NDArray[np.float64]
    width_m: float


def lanes(path: Path) -> list[Lane]:
    """All lanes, those inside junctions and people's too.

    Raises
    ------
    InputError
        When the file is no SUMO network, or damaged.
    """
    found = []
    for element in safexml.children(path, "net"):
        if element.tag != "edge":
            continue
        for lane in element.iter("lane"):
            try:
                points = [[float(v) for v in point.split(",")] for point in lane.attrib["shape"].split()]
                shape = np.array([[*point, 0.0][:3] for point in points], dtype=np.float64).reshape(-1, 3)
                width = 0.0 if element.get("function") == "walkingarea" else float(lane.get("width", _LANE_M))
            except (KeyError, ValueError) as error:
                what = f"<lane id={lane.get('id', '')!r}>"
                raise InputError(
                    path, f"{what} is not as in a SUMO network ({error!r})", "a file that netconvert wrote"
                ) from None
            found.append(Lane(shape, width))
    return found


@dataclass(frozen=True)
class Sidewalk:
    """A road's lane that people walk on. Sidewalks of one ``part`` are joined by walking areas and crossings."""

    edge: str
    from_node: str
    to_node: str
    length_m: float
    part: int


@dataclass(frozen=True)
class Walkways:
    """Where people may walk."""

    sidewalks: tuple[Sidewalk, ...]
    areas: int
    crossings: int


def walkways(path: Path) -> Walkways:
    """The sidewalks of a network, and how they hang together (people walk both ways)."""
    roads, functions, joined = [], [], _Joined()
    for element in safexml.children(path, "net"):
        if element.tag == "edge":
            functions.append(element.get("function"))
            if functions[-1] is None:
                roads += list(_sidewalks(element))
        elif element.tag == "connection":
            joined.join(element.get("from", ""), element.get("to", ""), element.get("fromLane"), element.get("toLane"))
    whole: dict[str, int] = {}
    sidewalks = [
        Sidewalk(edge, start, end, length, whole.setdefault(joined.find(f"{edge}_{index}"), len(whole)))
        for edge, start, end, length, index in roads
    ]
    return Walkways(tuple(sidewalks), functions.count("walkingarea"), functions.count("crossing"))


def _sidewalks(edge: Element) -> Iterator[tuple[str, str, str, float, int]]:
    """The lane of a road that people, but no cars, may use."""
    for index, lane in enumerate(edge.iter("lane")):
        permission = Permission.of(lane)
        if permission.admits(_PEDESTRIAN) and not permission.admits("passenger"):
            yield edge.attrib["id"], edge.attrib["from"], edge.attrib["to"], float(lane.get("length", 0)), index
            return


class _Joined:
    """Which lanes hang together (union-find)."""

    def __init__(self) -> None:
        self._parent: dict[str, str] = {}

    def find(self, lane: str) -> str:
        """The lane that stands for all that hang together with this one."""
        while (above := self._parent.get(lane, lane)) != lane:
            self._parent[lane] = self._parent.get(above, above)
            lane = above
        return lane

    def join(self, start: str, end: str, start_lane: str | None, end_lane: str | None) -> None:
        """Take note of a connection; only those of walking areas and crossings, whose names begin with a colon, join
        sidewalks."""
        if start.startswith(":") or end.startswith(":"):
            self._parent[self.find(f"{start}_{start_lane}")] = self.find(f"{end}_{end_lane}")
