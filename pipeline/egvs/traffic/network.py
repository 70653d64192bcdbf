"""Read SUMO networks: roads, lanes, connections, junctions, signals, sidewalks.

:func:`read_net_xml` parses a ``.net.xml`` (gzipped or not) once, element by element, and checks it. Shapes are kept as
text and parsed when they are used. World frame, metres, seconds.

:meth:`Network.links` follows SUMO's router: a vClass may use a connection if it may use the lane that the connection
leaves, the lane that it reaches, and the connection itself.

sumolib's reader is not used: it accepts any XML, entities included, and a damaged file ends in a traceback.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from egvs.core import polylines
from egvs.core.digests import hash_input
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.core.polygons import PairCount, check_corners, check_edge_pairs
from egvs.formats import osm, xml
from egvs.scenario.fields import parse_coordinate_m
from egvs.traffic.signal_clock import SignalClock

if TYPE_CHECKING:
    from shapely import Polygon

LANE_WIDTH_M, DEFAULT_SPEED_M_S = 3.2, 13.89
"""SUMO's defaults for lanes without a width or a speed limit."""

TURNAROUNDS = ("t", "T")
"""SUMO's directions of connections back to the road from which a vehicle comes."""
_SHAPE_WITH_HEIGHT = re.compile(rb"(?:^|\s)[^,\s]+,[^,\s]+,[^,\s]+(?:\s|$)")
"""A point with a third coordinate, which SUMO omits where it is 0."""

MAY_PASS_LETTERS = frozenset("GgsoO")
"""States of a signal in which a vehicle may drive on, at once or after giving way."""

CAR = "passenger"
"""SUMO vClass of cars."""

ROAD_VCLASSES = (
    "passenger", "private", "taxi", "bus", "coach", "delivery", "truck", "trailer", "motorcycle", "moped", "evehicle",
    "hov", "emergency", "authority", "army", "vip", "tram",
)  # fmt: skip
"""A lane that admits one of these vClasses is carriageway."""

_PEDESTRIAN = "pedestrian"

_MAP_ROOTS = ("osm", "OpenDRIVE")  # of OpenStreetMap and Lanelet2, and of OpenDRIVE
_HINT = "Use a network that netconvert wrote."
MAX_PHASE_S = 1e9
_MIN_PHASE_S = 1e-3  # SUMO's smallest step
_MAX_LENGTH_M = 1e6
# pairs of their edges are far below any limit
_FEW_POINTS = 200


@dataclass(frozen=True)
class Permission:
    """The vClasses that may use a lane or connection; ``allow`` is None if it does not restrict them."""

    allow: frozenset[str] | None
    disallow: frozenset[str]

    @classmethod
    def from_attributes(cls, attributes: Mapping[str, str]) -> Permission:
        """Parse ``allow`` and ``disallow`` of a ``<lane>`` or a ``<connection>``."""
        allow = attributes.get("allow", "")
        disallow = frozenset(attributes.get("disallow", "").split())
        return cls(None if allow in ("", "all") else frozenset(allow.split()), disallow)

    def admits(self, vclass: str) -> bool:
        """Whether vehicles of a vClass may use it."""
        if self.allow is not None:
            return vclass in self.allow
        return vclass not in self.disallow and "all" not in self.disallow


def is_carriageway(permission: Permission) -> bool:
    """Return whether a lane is for road vehicles."""
    return any(permission.admits(vclass) for vclass in ROAD_VCLASSES)


@dataclass(frozen=True)
class Shape:
    """A line or an outline, as text of the file ("x,y x,y,z ...").

    ``where`` names it in messages; ``pairs`` are the pairs of edges of the file so far.
    """

    text: str
    where: str
    pairs: PairCount = field(default_factory=PairCount, compare=False, repr=False, kw_only=True)

    @cached_property
    def shape_m(self) -> FloatArray:
        """Points in metres, shape (n, 3), float64; z is 0 where the file has none."""
        try:
            points = [[*map(parse_coordinate_m, point.split(",")), 0.0][:3] for point in self.text.split()]
            shape_m = np.array(points, dtype=np.float64).reshape(-1, 3)
        except ValueError as error:
            raise InputError(self.where, f"invalid coordinates in a shape ({error})", _HINT) from None
        if (length_m := polylines.length_m(shape_m[:, :2])) > _MAX_LENGTH_M:
            problem = f"expected a shape of at most {_MAX_LENGTH_M:,.0f} m, got {length_m:,.0f} m"
            raise InputError(self.where, problem, _HINT)
        if len(shape_m) > _FEW_POINTS:
            self._check_edges(shape_m)
        return shape_m

    def _check_edges(self, shape_m: FloatArray) -> None:
        """Raise an InputError when it would take long to repair the outline."""
        import shapely

        outline = shapely.Polygon(shape_m[:, :2])
        if not outline.is_valid:
            check_edge_pairs(outline, self.where, count=self.pairs)

    @property
    def has_heights(self) -> bool:
        """Whether any point has a third coordinate."""
        return self.text.count(",") > len(self.text.split())


@dataclass(frozen=True)
class Lane(Shape):
    """A lane, with its centre line, or a walking area, with its outline; ``width_m`` is None for the default."""

    width_m: float | None
    length_m: float
    permission: Permission
    speed_m_s: float = DEFAULT_SPEED_M_S

    @property
    def is_pavement(self) -> bool:
        """Whether only pedestrians may use it."""
        return self.permission.allow == frozenset({_PEDESTRIAN})

    @property
    def is_sidewalk(self) -> bool:
        """Whether pedestrians may use it, and cars may not."""
        return self.permission.admits(_PEDESTRIAN) and not self.permission.admits(CAR)

    def _check_edges(self, shape_m: FloatArray) -> None:
        """Raise an InputError when it would take long to widen the line, or to repair the outline."""
        import shapely

        super()._check_edges(shape_m)
        width_m = LANE_WIDTH_M if self.width_m is None else self.width_m
        check_edge_pairs(shapely.LineString(shape_m[:, :2]), self.where, width_m / 2.0, self.pairs)

    def area(self, last_m: float | None = None, *, margin_m: float = 0.0) -> Polygon:
        """Return the area of a lane with a centre line of at least two points, with flat ends.

        Parameters
        ----------
        last_m
            Length of the last part that is meant; None for the complete lane.
        margin_m
            Width that is added on both sides.
        """
        import shapely
        import shapely.ops

        line = shapely.LineString(self.shape_m[:, :2])
        if last_m is not None and last_m < line.length:
            line = shapely.ops.substring(line, line.length - last_m, line.length)
        width_m = LANE_WIDTH_M if self.width_m is None else self.width_m
        return shapely.buffer(line, width_m / 2.0 + margin_m, cap_style="flat")


@dataclass(frozen=True)
class Edge:
    """A road in one direction, or the part of a junction that ``function`` names (e.g. ``"crossing"``)."""

    id: str
    function: str
    from_node: str
    to_node: str
    name: str
    lanes: tuple[Lane, ...]
    type: str = ""
    """Type of the road, e.g. ``"highway.primary"``; may be empty."""
    crossed_edges: tuple[str, ...] = ()
    """Ids of the roads that a crossing crosses."""

    @cached_property
    def start_m(self) -> tuple[float, float]:
        """Start of the first lane."""
        return _point(self.lanes[0].text.split()[0])

    @cached_property
    def end_m(self) -> tuple[float, float]:
        """End of the first lane."""
        return _point(self.lanes[0].text.split()[-1])

    @property
    def seconds(self) -> float:
        """Travel time on the fastest lane, at the speed limit; infinite where that is 0."""
        speed_m_s = max(lane.speed_m_s for lane in self.lanes)
        return self.lanes[0].length_m / speed_m_s if speed_m_s > 0 else math.inf

    def lanes_for(self, vclass: str) -> int:
        """Return the number of lanes that a vClass may use."""
        return sum(lane.permission.admits(vclass) for lane in self.lanes)


@dataclass(frozen=True)
class Connection:
    """A connection from one lane to another.

    Attributes
    ----------
    source, target
        Positions of the edges in ``Network.edges``.
    source_lane, target_lane
        Index of the lane on its edge.
    direction
        SUMO's code ("s", "l", "R" ...); may be empty.
    via
        First lane inside the junction; may be empty.
    signal
        Id of the signal that governs it; may be empty.
    """

    source: int
    source_lane: int
    target: int
    target_lane: int
    direction: str
    permission: Permission
    via: str
    signal: str = ""


@dataclass(frozen=True)
class Junction(Shape):
    """A junction, with its outline; ``type`` is SUMO's ("traffic_light", "dead_end", "internal", ...)."""

    id: str
    type: str
    at_m: tuple[float, float]
    incoming_lanes: tuple[str, ...]

    def _check_edges(self, shape_m: FloatArray) -> None:
        """Raise an InputError when it would take long to repair or to cut the outline."""
        import shapely

        check_corners(shapely.Polygon(shape_m[:, :2]), self.where)
        super()._check_edges(shape_m)


class Roundabout(NamedTuple):
    """Ids of the nodes and edges of a ring."""

    nodes: tuple[str, ...]
    edges: tuple[str, ...]


@dataclass(frozen=True)
class StopLine:
    """The end of a lane at a signal, and the longest time that one of its connections waits for green."""

    at_m: tuple[float, float]
    red_s: float


@dataclass(frozen=True)
class Location:
    """Georeference of a network: (x, y) = projection(lon, lat) + ``offset_m``."""

    projection: str
    offset_m: tuple[float, float]


@dataclass(frozen=True)
class Sidewalk:
    """A sidewalk; walking areas and crossings connect the sidewalks of one ``part``."""

    edge: str
    from_node: str
    to_node: str
    length_m: float
    part: int


@dataclass(frozen=True)
class Walkways:
    """The sidewalks of a network; numbers of walking areas and crossings."""

    sidewalks: tuple[Sidewalk, ...]
    areas: int
    crossings: int


@dataclass(frozen=True)
class Network:
    """A road network.

    Attributes
    ----------
    all_edges
        All edges, in file order, including those inside junctions, crossings and walking areas.
    connections
        Connections between roads.
    junctions
        All junctions, in file order.
    cycle_s
        Longest cycle of a signal; 0 without signals.
    location
        Georeference, if the network has one.
    lane_links
        Pairs of lanes that walking areas and crossings connect, in both directions.
    stop_lines
        The ends of lanes at signals that become green.
    roundabouts
        The roundabouts, in file order.
    signal_clock
        The clock of a program that replays recorded signals, if there is one.
    """

    all_edges: tuple[Edge, ...]
    connections: tuple[Connection, ...]
    junctions: tuple[Junction, ...] = ()
    cycle_s: float = 0.0
    location: Location | None = None
    lane_links: tuple[tuple[str, str], ...] = ()
    stop_lines: tuple[StopLine, ...] = ()
    roundabouts: tuple[Roundabout, ...] = ()
    signal_clock: SignalClock | None = None

    @property
    def red_s(self) -> float:
        """Longest time that a vehicle waits for green at a signal; 0 without signals."""
        return max((stop_line.red_s for stop_line in self.stop_lines), default=0.0)

    @cached_property
    def edges(self) -> tuple[Edge, ...]:
        """Roads: edges without a function."""
        return tuple(edge for edge in self.all_edges if not edge.function)

    @cached_property
    def signal_groups(self) -> dict[str, frozenset[str]]:
        """Nodes of each signal that governs several, by its id: one junction on the ground."""
        nodes: dict[str, set[str]] = {}
        for connection in self.connections:
            if connection.signal:
                nodes.setdefault(connection.signal, set()).add(self.edges[connection.source].to_node)
        return {signal: frozenset(governed) for signal, governed in nodes.items() if len(governed) > 1}

    @cached_property
    def has_heights(self) -> bool:
        """Whether any lane has heights."""
        return any(lane.has_heights for edge in self.all_edges for lane in edge.lanes)

    @cached_property
    def lacks_internal_edges(self) -> bool:
        """Whether vehicles jump across all junctions, since the network was made without edges inside them."""
        return bool(self.connections) and not any(edge.function == "internal" for edge in self.all_edges)

    @cached_property
    def diagonal_m(self) -> float:
        """Diagonal of the bounding box of the ends of all roads."""
        ends = np.array([edge.start_m for edge in self.edges] + [edge.end_m for edge in self.edges])
        return float(np.hypot(*(ends.max(axis=0) - ends.min(axis=0))))

    def links(self, vclass: str) -> IntArray:
        """Return the connections that a vClass may use, shape (n, 3): source, target, and 1 for a turnaround."""
        usable = []
        for connection in self.connections:
            source_lane = self.edges[connection.source].lanes[connection.source_lane]
            target_lane = self.edges[connection.target].lanes[connection.target_lane]
            permissions = (source_lane.permission, target_lane.permission, connection.permission)
            if all(permission.admits(vclass) for permission in permissions):
                is_turnaround = connection.direction in TURNAROUNDS
                usable.append((connection.source, connection.target, int(is_turnaround)))
        return np.array(usable, dtype=np.int64).reshape(-1, 3)

    @cached_property
    def walkways(self) -> Walkways:
        """First sidewalk of each edge, grouped into connected parts."""
        lanes: dict[str, tuple[Edge, Lane]] = {}
        for edge in self.edges:
            for index, lane in enumerate(edge.lanes):
                if lane.is_sidewalk:
                    lanes[f"{edge.id}_{index}"] = edge, lane
                    break
        parts = _connected_parts(list(lanes), self.lane_links)
        sidewalks = []
        for (edge, lane), part in zip(lanes.values(), parts, strict=True):
            sidewalks.append(Sidewalk(edge.id, edge.from_node, edge.to_node, lane.length_m, part))
        functions = [edge.function for edge in self.all_edges]
        return Walkways(tuple(sidewalks), functions.count("walkingarea"), functions.count("crossing"))


def read_net_xml(path: Path, name: Path | None = None) -> Network:
    """Read a network. The two last read are cached by content.

    Parameters
    ----------
    path
        The file.
    name
        Its name in messages, where ``path`` is a copy.

    Raises
    ------
    InputError
        When the file is not a SUMO network, is damaged, or has no road.
    """
    return _read_network_file(_NamedFile(name or path, path), hash_input(path))


def no_internal_edges_error(where: object, path: Path) -> InputError:
    """Return the error for a network that was made without edges inside junctions."""
    problem = "the network has no edges inside its junctions (internal links), so vehicles would jump across them"
    return InputError(
        where, problem, f"Run netconvert -s {path.name} --no-internal-links false -o new.net.xml, and use it."
    )


@dataclass(frozen=True)
class _NamedFile:
    """A file to read and its name in messages; only the name counts in comparisons."""

    name: Path
    path: Path = field(compare=False)


@lru_cache(maxsize=2)
def _read_network_file(file: _NamedFile, _content: str) -> Network:
    pairs = PairCount(file.name)
    edges: list[Edge] = []
    connections: list[dict[str, str]] = []
    lane_links: list[tuple[str, str]] = []
    junctions: list[Junction] = []
    cycle_s = 0.0
    signals: list[tuple[tuple[str, int], tuple[str, int]]] = []
    reds_s: dict[tuple[str, int], float] = {}
    location = None
    roundabouts: list[Roundabout] = []
    signal_clock: SignalClock | None = None
    for element in xml.iter_elements(file.path, "net", file.name):
        try:
            match element.tag:
                case "edge":
                    edges.append(_parse_edge(element, pairs))
                case "connection":
                    start = element.attrib["from"]
                    end = element.get("to", "")
                    if not start.startswith(":"):
                        connections.append(element.attrib)
                        if "tl" in element.attrib:
                            position = int(element.get("linkIndex", "-1"))
                            lane = start, int(element.attrib["fromLane"])
                            signals.append((lane, (element.attrib["tl"], position)))
                    if start.startswith(":") or end.startswith(":"):
                        lane_links.append((f"{start}_{element.get('fromLane')}", f"{end}_{element.get('toLane')}"))
                case "junction":
                    junctions.append(_parse_junction(element.attrib, pairs))
                case "tlLogic":
                    phases = [_Phase.from_attributes(phase.attrib) for phase in element.iter("phase")]
                    clock = SignalClock.from_program(element)
                    signal_clock = signal_clock or clock
                    program_s = sum(phase.duration_s for phase in phases)
                    cycle_s = max(cycle_s, program_s if clock is None else clock.cycle_s)
                    for position, red_s in _longest_reds(phases).items():
                        key = element.attrib["id"], position
                        reds_s[key] = max(red_s, reds_s.get(key, 0.0))
                case "roundabout":
                    nodes, ring = (tuple(element.attrib[key].split()) for key in ("nodes", "edges"))
                    roundabouts.append(Roundabout(nodes, ring))
                case "location":
                    location = parse_location(element, file.name)
        except (KeyError, ValueError, IndexError) as error:
            title = f"<{element.tag} id={element.get('id', element.get('from', ''))!r}>"
            raise InputError(file.name, f"invalid {title} for a SUMO network ({error!r})", _HINT) from None
    roads = [edge for edge in edges if not edge.function]
    if not roads:
        raise InputError(file.name, "the network has no roads", "Use a network with at least one edge.")
    road_connections = tuple(_parse_connections(connections, roads, file.name))
    stop_lines = tuple(_stop_lines(signals, roads, reds_s))
    return Network(
        tuple(edges), road_connections, tuple(junctions), cycle_s, location, tuple(lane_links), stop_lines,
        tuple(roundabouts), signal_clock,
    )  # fmt: skip


class _Phase(NamedTuple):
    """A phase of a signal program: its longest duration, and one letter for each connection."""

    duration_s: float
    state: str

    @classmethod
    def from_attributes(cls, attributes: Mapping[str, str]) -> _Phase:
        duration_s = parse_phase_s("duration", attributes["duration"])
        if "maxDur" in attributes:
            duration_s = parse_phase_s("maxDur", attributes["maxDur"])
        return cls(duration_s, attributes.get("state", ""))


def parse_phase_s(key: str, text: str) -> float:
    """Return a duration of a phase of a signal; ValueError where SUMO would reject it."""
    value = float(text)
    least_s = _MIN_PHASE_S if key == "duration" else 0.0
    if not least_s <= value <= MAX_PHASE_S:
        raise ValueError(f"{key} = {text[:80]!r}: expected seconds, from {least_s:g} to {MAX_PHASE_S:g}")
    return value


def _longest_reds(phases: Sequence[_Phase]) -> dict[int, float]:
    """Return how long each connection of a signal program waits for green; those that never have green are left out."""
    longest_s = {}
    for position, states in enumerate(zip(*(phase.state for phase in phases), strict=False)):
        if MAY_PASS_LETTERS.isdisjoint(states):
            continue
        red_s = longest_s[position] = 0.0
        for state, phase in zip(states * 2, [*phases, *phases], strict=True):  # two cycles contain every red phase
            red_s = 0.0 if state in MAY_PASS_LETTERS else red_s + phase.duration_s
            longest_s[position] = max(longest_s[position], red_s)
    return longest_s


def _stop_lines(
    signals: Sequence[tuple[tuple[str, int], tuple[str, int]]],
    roads: Sequence[Edge],
    reds_s: Mapping[tuple[str, int], float],
) -> Iterator[StopLine]:
    """Yield the ends of the lanes at signals that become green.

    Parameters
    ----------
    signals
        Edge and lane before each connection, and its program and position in the states.
    roads
        All roads.
    reds_s
        The longest red by program and position.
    """
    by_id = {edge.id: edge for edge in roads}
    by_lane: dict[tuple[str, int], float] = {}
    for lane, position in signals:
        red_s = reds_s.get(position)
        if red_s is not None and lane[0] in by_id:
            by_lane[lane] = max(red_s, by_lane.get(lane, 0.0))
    for (edge, index), red_s in by_lane.items():
        yield StopLine(_point(by_id[edge].lanes[index].text.split()[-1]), red_s)


def read_location(path: Path, root: str = "net") -> Location | None:
    """Read the georeference at the head of a file.

    Parameters
    ----------
    path
        A network, an additional file, or FCD.
    root
        Tag of its root element; any if empty.

    Returns
    -------
    Location or None
        None for a file without georeference.
    """
    for element in xml.iter_elements(path, root):
        if element.tag == "location":
            return parse_location(element, path)
        if element.tag in ("edge", "timestep"):
            return None
    return None


def parse_location(element: Element, path: Path) -> Location:
    """Return the georeference of an element ``<location>``; InputError naming the file when it is invalid."""
    try:
        x, y = map(float, element.attrib["netOffset"].split(",")[:2])  # -1e10 in a network without roads
    except (KeyError, ValueError) as error:
        raise InputError(path, f"invalid <location> ({error!r})", _HINT) from None
    return Location(element.get("projParameter", ""), (x, y))


def _parse_edge(element: Element, pairs: PairCount) -> Edge:
    function, start, end, name, kind = (element.get(key, "") for key in ("function", "from", "to", "name", "type"))
    lanes = tuple(_parse_lane(lane, pairs) for lane in element.iter("lane"))
    crossed = tuple(element.get("crossingEdges", "").split())
    edge = Edge(element.attrib["id"], function, start, end, name, lanes, kind, crossed)
    if not function:
        if not start or not end:
            raise KeyError("to" if start else "from")
        _ = edge.start_m, edge.end_m  # raises where a road has no lane, or no coordinates
    return edge


def _parse_lane(lane: Element, pairs: PairCount) -> Lane:
    width_m = float(lane.attrib["width"]) if "width" in lane.attrib else None
    length_m = float(lane.get("length", 0))
    speed_m_s = float(lane.get("speed", DEFAULT_SPEED_M_S))
    if not (length_m >= 0 and speed_m_s >= 0):
        raise ValueError(f"lane {lane.get('id', '')!r} has the length {length_m} and the speed {speed_m_s}")
    where = f"{pairs.file}: lane {lane.get('id', '')}"
    # a speed limit of 0 closes a lane
    permission = Permission.from_attributes(lane.attrib if speed_m_s > 0 else {"disallow": "all"})
    return Lane(lane.attrib["shape"], where, width_m, length_m, permission, speed_m_s, pairs=pairs)


def _parse_junction(junction: dict[str, str], pairs: PairCount) -> Junction:
    name = junction["id"]
    location_m = parse_coordinate_m(junction["x"]), parse_coordinate_m(junction["y"])
    incoming = tuple(junction.get("incLanes", "").split())
    where = f"{pairs.file}: junction {name}"
    kind = junction.get("type", "")
    return Junction(junction.get("shape", ""), where, name, kind, location_m, incoming, pairs=pairs)


def _parse_connections(
    connections: Iterable[dict[str, str]], roads: Sequence[Edge], path: Path
) -> Iterator[Connection]:
    index = {road.id: i for i, road in enumerate(roads)}
    for connection in connections:
        start = connection["from"]
        try:
            source, target = index.get(start), index.get(connection["to"])
            source_lane, target_lane = int(connection["fromLane"]), int(connection["toLane"])
        except (KeyError, ValueError) as error:
            raise InputError(path, f"invalid <connection> from {start!r} ({error!r})", _HINT) from None
        if source is None or target is None:
            continue  # from or to a walking area or a crossing
        if source_lane >= len(roads[source].lanes) or target_lane >= len(roads[target].lanes):
            raise InputError(path, f"a <connection> from {start!r} refers to a lane that does not exist", _HINT)
        permission = Permission.from_attributes(connection)
        direction = connection.get("dir", "")
        via, signal = connection.get("via", ""), connection.get("tl", "")
        yield Connection(source, source_lane, target, target_lane, direction, permission, via, signal)


def _point(text: str) -> tuple[float, float]:
    x, y = text.split(",")[:2]
    return parse_coordinate_m(x), parse_coordinate_m(y)


def check_is_no_map(path: Path) -> None:
    """Raise an InputError for a map of a format that ``egvs new`` makes networks of."""
    state = path.stat()
    if _is_map(path, state.st_mtime_ns, state.st_size):
        hint = f"Run egvs new NAME --from {shlex.quote(path.name)}, which makes a scenario with a network of it."
        raise InputError(path, "expected a SUMO network, got a map", hint)


@lru_cache(maxsize=8)
def _is_map(path: Path, _modified_ns: int, _size: int) -> bool:
    """Whether a file is OpenStreetMap, Lanelet2 or OpenDRIVE; stages name their network many times."""
    try:
        return osm.is_pbf(path) or xml.read_root_tag(path) in _MAP_ROOTS
    except InputError:
        return False  # whoever reads the network reports it


def may_have_slopes(path: Path) -> bool:
    """Whether a SUMO network has a shape with heights, without parsing it."""
    if not path.is_file():
        return False
    return any(_SHAPE_WITH_HEIGHT.search(shape) is not None for shape in xml.scan_attribute_values(path, "shape"))


def _connected_parts(lanes: Sequence[str], links: Sequence[tuple[str, str]]) -> list[int]:
    """Return the number of the connected part of each lane."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not lanes:
        return []
    names = [*lanes, *(lane for link in links for lane in link)]
    index = {name: i for i, name in enumerate(dict.fromkeys(names))}
    rows = [index[start] for start, _ in links]
    columns = [index[end] for _, end in links]
    graph = coo_array((np.ones(len(links)), (rows, columns)), shape=(len(index), len(index)))
    _, parts = connected_components(graph, directed=False)
    return [int(part) for part in parts[: len(lanes)]]
