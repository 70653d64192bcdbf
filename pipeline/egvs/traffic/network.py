"""Reads SUMO networks: roads, lanes, connections, junctions, signals, sidewalks.

Steps of :func:`read_net_xml`: go through a ``.net.xml`` (gzipped or not) once, child by child; check what every
reader needs;
keep the text of shapes, which become arrays only when somebody asks for them. World frame, metres, seconds.

The graph of a vClass has an edge's successors as SUMO's own router sees them: a connection counts when the class may
use the lane that it leaves, the lane that it reaches, and the connection itself.

sumolib's own reader is not used: it takes any XML, entities included, and a damaged file ends in a traceback.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from egvs.core import files
from egvs.core.errors import InputError
from egvs.formats import xml
from egvs.scenario.fields import parse_coordinate_m

LANE_WIDTH_M, DEFAULT_SPEED_M_S = 3.2, 13.89
"""A lane's width and speed limit where the network names none: SUMO's defaults."""

_TURNAROUNDS = ("t", "T")
_SHAPE_WITH_HEIGHT = re.compile(rb"(?:^|\s)[^,\s]+,[^,\s]+,[^,\s]+(?:\s|$)")
"""A point with a third coordinate. (SUMO writes none where a height is 0.)"""

_PEDESTRIAN = "pedestrian"
_OSM_SUFFIXES = (".osm", ".osm.xml", ".osm.pbf")
_EXPECTED = "a file that netconvert wrote"


@dataclass(frozen=True)
class Permission:
    """Which vClasses a lane or connection admits, as its attributes ``allow`` and ``disallow`` say."""

    allow: frozenset[str] | None
    disallow: frozenset[str]

    @classmethod
    def of(cls, attributes: Mapping[str, str]) -> Permission:
        """From those of a ``<lane>`` or a ``<connection>``."""
        allow, disallow = attributes.get("allow", ""), attributes.get("disallow", "")
        return cls(None if allow in ("", "all") else frozenset(allow.split()), frozenset(disallow.split()))

    def admits(self, vclass: str) -> bool:
        """Whether a vehicle of ``vclass`` may go there."""
        if self.allow is not None:
            return vclass in self.allow
        return vclass not in self.disallow and "all" not in self.disallow


@dataclass(frozen=True)
class Shape:
    """A line or outline as the file writes it ("x,y x,y,z ..."); ``where`` is what messages point to."""

    text: str
    where: str

    @cached_property
    def shape_m(self) -> NDArray[np.float64]:
        """(n, 3) float64, metres; z is 0 where the file names none. InputError when the text holds no coordinates."""
        try:
            points = [[parse_coordinate_m(v) for v in point.split(",")] for point in self.text.split()]
            return np.array([[*point, 0.0][:3] for point in points], dtype=np.float64).reshape(-1, 3)
        except ValueError as error:
            raise InputError(self.where, f"a shape holds no coordinates ({error})", _EXPECTED) from None

    @property
    def has_heights(self) -> bool:
        """Whether any point has a third coordinate."""
        return self.text.count(",") > len(self.text.split())


@dataclass(frozen=True)
class Lane(Shape):
    """A lane: its middle line, or a walking area's outline.

    ``width_m`` is None where the file names none; ``length_m`` is as SUMO counts.
    """

    width_m: float | None
    length_m: float
    permission: Permission
    speed_m_s: float = DEFAULT_SPEED_M_S

    @property
    def is_pavement(self) -> bool:
        """Whether it is for people on foot alone."""
        return self.permission.allow == frozenset({_PEDESTRIAN})

    @property
    def is_sidewalk(self) -> bool:
        """Whether people, but no cars, may use it."""
        return self.permission.admits(_PEDESTRIAN) and not self.permission.admits("passenger")


@dataclass(frozen=True)
class Edge:
    """A road in one direction; or, where ``function`` says so, a piece of a junction, a crossing, a walking area."""

    id: str
    function: str
    from_node: str
    to_node: str
    name: str
    lanes: tuple[Lane, ...]
    type: str = ""
    """As the map has it ("highway.primary"); empty where the network names none."""

    @cached_property
    def start_m(self) -> tuple[float, float]:
        """Where its first lane starts."""
        return _point(self.lanes[0].text.split()[0])

    @cached_property
    def end_m(self) -> tuple[float, float]:
        """Where its first lane ends."""
        return _point(self.lanes[0].text.split()[-1])

    @property
    def seconds(self) -> float:
        """How long its fastest lane takes at the speed limit."""
        return self.lanes[0].length_m / max(lane.speed_m_s for lane in self.lanes)

    def lanes_for(self, vclass: str) -> int:
        """How many of its lanes ``vclass`` may use."""
        return sum(lane.permission.admits(vclass) for lane in self.lanes)


@dataclass(frozen=True)
class Connection:
    """A way from one lane to another; ``source`` and ``target`` are positions in ``Network.edges``, ``direction`` is
    SUMO's ("s", "l", "R" ...), and ``via`` the first lane inside the junction; both empty where none is named."""

    source: int
    source_lane: int
    target: int
    target_lane: int
    direction: str
    permission: Permission
    via: str


@dataclass(frozen=True)
class Junction(Shape):
    """Where edges meet, with its outline; ``type`` is SUMO's ("traffic_light", "dead_end", "internal", ...)."""

    id: str
    type: str
    at_m: tuple[float, float]
    incoming_lanes: tuple[str, ...]


@dataclass(frozen=True)
class Location:
    """How longitude and latitude became x, y: (x, y) = projection(lon, lat) + ``offset_m``."""

    projection: str
    offset_m: tuple[float, float]


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


@dataclass(frozen=True)
class Network:
    """A network as its file has it.

    Attributes
    ----------
    all_edges
        Those inside junctions and people's too, in the order of the file.
    connections
        From road to road.
    cycle_s
        The longest time that a signal program takes at most to come round; 0 without signals.
    """

    all_edges: tuple[Edge, ...]
    connections: tuple[Connection, ...]
    junctions: tuple[Junction, ...] = ()
    cycle_s: float = 0.0
    location: Location | None = None
    lane_links: tuple[tuple[str, str], ...] = ()
    """Lanes between which a walking area's or a crossing's connection leads, either way."""

    @cached_property
    def edges(self) -> tuple[Edge, ...]:
        """The roads."""
        return tuple(edge for edge in self.all_edges if not edge.function)

    @cached_property
    def has_heights(self) -> bool:
        """Whether any lane has heights."""
        return any(lane.has_heights for edge in self.all_edges for lane in edge.lanes)

    @cached_property
    def diagonal_m(self) -> float:
        """From the south-west to the north-east corner of all roads' ends."""
        ends = np.array([p for e in self.edges for p in (e.start_m, e.end_m)])
        return float(np.hypot(*(ends.max(axis=0) - ends.min(axis=0))))

    def links(self, vclass: str) -> NDArray[np.int64]:
        """(n, 3) of source edge, target edge, and 1 for a turnaround, for ``vclass``."""
        edges = self.edges
        usable = [
            (c.source, c.target, int(c.direction in _TURNAROUNDS))
            for c in self.connections
            if edges[c.source].lanes[c.source_lane].permission.admits(vclass)
            and edges[c.target].lanes[c.target_lane].permission.admits(vclass)
            and c.permission.admits(vclass)
        ]
        return np.array(usable, dtype=np.int64).reshape(-1, 3)

    @cached_property
    def walkways(self) -> Walkways:
        """The sidewalks, and how they hang together (people walk both ways)."""
        walked = [
            (edge, index)
            for edge in self.edges
            if (index := next((i for i, lane in enumerate(edge.lanes) if lane.is_sidewalk), None)) is not None
        ]
        parts = _connected_parts([f"{edge.id}_{index}" for edge, index in walked], self.lane_links)
        sidewalks = [
            Sidewalk(edge.id, edge.from_node, edge.to_node, edge.lanes[index].length_m, part)
            for (edge, index), part in zip(walked, parts, strict=True)
        ]
        functions = [edge.function for edge in self.all_edges]
        return Walkways(tuple(sidewalks), functions.count("walkingarea"), functions.count("crossing"))


def read_net_xml(path: Path, name: Path | None = None) -> Network:
    """Read a network, once for all who ask; messages call it ``name`` where it is a copy of what the user named.

    InputError when the file is no SUMO network, is damaged, or has no road.
    """
    return _read_network_file(_NamedFile(name or path, path), files.hash_file(path))


@dataclass(frozen=True)
class _NamedFile:
    """A file as messages call it, and where to read it, which does not count when two are compared."""

    name: Path
    copy: Path = field(compare=False)


@lru_cache(maxsize=2)
def _read_network_file(file: _NamedFile, _content: str) -> Network:
    copy, path = file.copy, file.name
    edges: list[Edge] = []
    connections: list[dict[str, str]] = []
    lane_links: list[tuple[str, str]] = []
    junctions: list[Junction] = []
    cycle_s, location = 0.0, None
    for element in xml.iter_elements(copy, "net", path):
        try:
            match element.tag:
                case "edge":
                    edges.append(_edge(element, path))
                case "connection":
                    start, end = element.attrib["from"], element.get("to", "")
                    if not start.startswith(":"):
                        connections.append(element.attrib)
                    if start.startswith(":") or end.startswith(":"):
                        start_lane, end_lane = f"{start}_{element.get('fromLane')}", f"{end}_{element.get('toLane')}"
                        lane_links.append((start_lane, end_lane))
                case "junction":
                    junctions.append(_junction(element.attrib, path))
                case "tlLogic":
                    phases = element.iter("phase")
                    cycle_s = max(cycle_s, sum(float(p.get("maxDur", p.attrib["duration"])) for p in phases))
                case "location":
                    location = _location(element)
        except (KeyError, ValueError, IndexError) as error:
            what = f"<{element.tag} id={element.get('id', element.get('from', ''))!r}>"
            raise InputError(path, f"{what} is not as in a SUMO network ({error!r})", _EXPECTED) from None
    roads = [edge for edge in edges if not edge.function]
    if not roads:
        raise InputError(path, "the network has no road", "a network with at least one edge")
    ways = tuple(_road_connections(connections, roads, path))
    return Network(tuple(edges), ways, tuple(junctions), cycle_s, location, tuple(lane_links))


def read_location(path: Path, root: str = "net") -> Location | None:
    """Where a network (or, by its ``root``, a file that polyconvert wrote) says that it lies on the Earth.

    None where it does not. Only the head of the file is read.
    """
    for element in xml.iter_elements(path, root):
        if element.tag == "location":
            try:
                return _location(element)
            except (KeyError, ValueError) as error:
                raise InputError(path, f"<location> is not as SUMO writes it ({error!r})", _EXPECTED) from None
        if element.tag in ("edge", "poly"):
            return None
    return None


def _location(element: Element) -> Location:
    x, y = map(float, element.attrib["netOffset"].split(",")[:2])  # -1e10 in a network of no road
    return Location(element.get("projParameter", ""), (x, y))


def _edge(element: Element, path: Path) -> Edge:
    function, start, end, name, kind = (element.get(key, "") for key in ("function", "from", "to", "name", "type"))
    lanes = tuple(_lane(lane, path) for lane in element.iter("lane"))
    edge = Edge(element.attrib["id"], function, start, end, name, lanes, kind)
    if not function:
        if not start or not end:
            raise KeyError("to" if start else "from")
        _ = edge.start_m, edge.end_m  # a road has a lane with coordinates
    return edge


def _lane(lane: Element, path: Path) -> Lane:
    width_m = float(lane.attrib["width"]) if "width" in lane.attrib else None
    length_m, place = float(lane.get("length", 0)), f"{path}: lane {lane.get('id', '')}"
    speed_m_s = float(lane.get("speed", DEFAULT_SPEED_M_S))
    return Lane(lane.attrib["shape"], place, width_m, length_m, Permission.of(lane.attrib), speed_m_s)


def _junction(junction: dict[str, str], path: Path) -> Junction:
    name, at_m = junction["id"], (parse_coordinate_m(junction["x"]), parse_coordinate_m(junction["y"]))
    incoming = tuple(junction.get("incLanes", "").split())
    shape, place = junction.get("shape", ""), f"{path}: junction {name}"
    return Junction(shape, place, name, junction.get("type", ""), at_m, incoming)


def _road_connections(connections: Iterable[dict[str, str]], roads: Sequence[Edge], path: Path) -> Iterator[Connection]:
    index = {road.id: i for i, road in enumerate(roads)}
    for connection in connections:
        start = connection["from"]
        try:
            source, target = (index.get(connection[key]) for key in ("from", "to"))
            lanes = int(connection["fromLane"]), int(connection["toLane"])
        except (KeyError, ValueError) as error:
            raise InputError(path, f"a <connection> from {start!r} is damaged ({error!r})", _EXPECTED) from None
        if source is None or target is None:
            continue  # to or from a walking area or a crossing
        if lanes[0] >= len(roads[source].lanes) or lanes[1] >= len(roads[target].lanes):
            raise InputError(path, f"a <connection> from {start!r} names a lane that is not there", _EXPECTED)
        direction, via = connection.get("dir", ""), connection.get("via", "")
        yield Connection(source, lanes[0], target, lanes[1], direction, Permission.of(connection), via)


def _point(text: str) -> tuple[float, float]:
    x, y = text.split(",")[:2]
    return parse_coordinate_m(x), parse_coordinate_m(y)


def is_osm(path: Path) -> bool:
    """Whether a network is still a map of OpenStreetMap."""
    return path.name.removesuffix(".gz").endswith(_OSM_SUFFIXES)


def may_have_heights(path: Path) -> bool:
    """Whether any shape has a third coordinate: a quick look, so that a flat network need not be read."""
    if is_osm(path) or not path.is_file():
        return False
    return any(_SHAPE_WITH_HEIGHT.search(shape) is not None for shape in xml.scan_attribute_values(path, "shape"))


def _connected_parts(lanes: Sequence[str], links: Sequence[tuple[str, str]]) -> list[int]:
    """For each lane, the number of the part that it belongs to: the same for lanes that hang together."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    index = {lane: i for i, lane in enumerate(dict.fromkeys([*lanes, *(lane for pair in links for lane in pair)]))}
    rows, columns = ([index[pair[i]] for pair in links] for i in (0, 1))
    graph = coo_array((np.ones(len(links)), (rows, columns)), shape=(len(index), len(index)))
    return [int(part) for part in connected_components(graph, directed=False)[1][: len(lanes)]] if lanes else []
