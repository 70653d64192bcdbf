"""Compare the turns of a network with those of its OpenStreetMap map, and repair the network.

netconvert merges the nodes of a junction, and drops the turn restrictions of the pieces of street between them. Steps
of :func:`repair_turns`: find the ways of each edge (netconvert notes the nodes where it starts and ends); from its end,
follow the ways inside the junction, as far as one-way streets and restrictions permit, to the edges that leave the same
junction (:class:`StreetGraph`); compare these turns with those that netconvert built; close and add turns.

Turns back (of more than :data:`U_TURN_DEG`) are neither required nor closed, unless a restriction forbids them.
"""

from __future__ import annotations

import math
import re
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from xml.etree.ElementTree import Element

from egvs.core.grid import XY
from egvs.core.wording import by_number, list_first, number_of
from egvs.creation.openstreetmap import EARTH_M
from egvs.creation.openstreetmap.restrictions import (
    Progress,
    Restriction,
    Step,
    TurnRules,
    read_restrictions,
)
from egvs.creation.openstreetmap.street_signals import MapSignals, find_signals, is_signal
from egvs.creation.turns import (
    MOST_LISTED,
    BuiltTurns,
    Connection,
    compare_turns,
    lanes_of_pairs,
    list_turns,
    patch_network,
    turn_notes,
)
from egvs.formats import xml
from egvs.formats.osm import OsmExtract, Tags, Way
from egvs.traffic.network import CAR, Permission, is_carriageway

ORIGINAL_NAMES_FLAG = "--output.original-names"
"""Lets netconvert note the ways and nodes of the map that its edges come from."""

U_TURN_DEG = 150.0

_INSIDE_M = 200.0
"""Length of the ways inside a junction, at most."""

_HEADING_M = 15.0
_STRAIGHT_DEG = 30.0

_INTEGER = re.compile(r"-?\d+")
_ORIGIN_PARAMS = re.compile(r'\n *<param key="orig(?:Id|EdgeIds|From|To)" value="[^"]*"/>')
_EMPTY_ELEMENT = re.compile(r"(<(lane|junction)\b[^>]*[^/])>\s*</\2>")

_ONE_WAY = {"yes": (True, False), "true": (True, False), "1": (True, False), "-1": (False, True),
            "reverse": (False, True), "no": (True, True), "false": (True, True), "0": (True, True)}  # fmt: skip
_RINGS = ("roundabout", "circular")
_MOTORWAYS = ("motorway", "motorway_link")
_FOR_CARS = frozenset({
    *(f"{kind}{link}" for kind in ("motorway", "trunk", "primary", "secondary", "tertiary") for link in ("", "_link")),
    "unclassified", "residential", "living_street", "service", "road",
})  # fmt: skip
_FOR_VEHICLES = _FOR_CARS | {"busway", "bus_guideway", "track", "raceway", "services"}
"""Values of ``highway``."""

_LANE_KEYS = ("lanes", "lanes:forward", "lanes:backward")
_SPEED_KEYS = ("maxspeed", "maxspeed:forward", "maxspeed:backward")
_CAR_KEYS = ("motorcar", "motor_vehicle", "vehicle", "access")
_NO_ACCESS = ("no", "private", "agricultural", "forestry", "military")
_BUS_KEYS = ("bus", "psv")

_ARROWS_DEG = {
    "through": (-60.0, 60.0), "merge_to_left": (-60.0, 60.0), "merge_to_right": (-60.0, 60.0),
    "slight_left": (5.0, 110.0), "left": (20.0, 180.0), "sharp_left": (50.0, 180.0),
    "slight_right": (-110.0, -5.0), "right": (-180.0, -20.0), "sharp_right": (-180.0, -50.0), "reverse": (150.0, 180.0),
}  # fmt: skip
"""Angles of the turns that an arrow on a lane can mean, positive to the left."""

Pair = tuple[str, str]


def strip_origins(text: str) -> str:
    """Return a network without what :data:`ORIGINAL_NAMES_FLAG` adds to it."""
    return _EMPTY_ELEMENT.sub(r"\1/>", _ORIGIN_PARAMS.sub("", text))


def directions(tags: Tags) -> tuple[bool, bool]:
    """Return whether cars may drive along a way, and against it.

    >>> directions({"junction": "roundabout"}), directions({"oneway": "-1"}), directions({"oneway": "no"})
    ((True, False), (False, True), (True, True))
    """
    one_way = next((tags[key] for key in ("oneway:motorcar", "oneway:motor_vehicle", "oneway") if key in tags), "")
    if one_way in _ONE_WAY:
        return _ONE_WAY[one_way]
    if tags.get("junction") in _RINGS or tags.get("highway") in _MOTORWAYS:
        return True, False
    return True, True


def _bus_directions(tags: Tags) -> tuple[bool, bool]:
    """Return the same for buses, which may drive against some one-way streets."""
    along, against = directions(tags)
    is_free = any(tags.get(f"oneway:{key}") == "no" for key in _BUS_KEYS) or "opposite_lane" in tags.get("busway", "")
    return along or is_free, against or is_free


def _admits_cars(tags: Tags) -> bool:
    access = next((tags[key] for key in _CAR_KEYS if key in tags), "")
    return tags.get("highway") in _FOR_CARS and access not in _NO_ACCESS


@dataclass(frozen=True)
class StreetEdge:
    """An edge of a network, and the ways that it comes from.

    Attributes
    ----------
    id, from_node, to_node
        In the network.
    steps
        The pieces of ways, in driving direction.
    car_lanes
        Indices of the lanes for cars.
    lanes
        Number of lanes, without pavements.
    speed_m_s
        Speed limit.
    """

    id: str
    from_node: str
    to_node: str
    steps: tuple[Step, ...]
    car_lanes: tuple[int, ...]
    lanes: int
    speed_m_s: float


@dataclass(frozen=True)
class MapTurn:
    """A turn of the map between two edges.

    Attributes
    ----------
    source, target
        The edges.
    inside
        The pieces of ways between them.
    for_cars
        Whether cars may drive on all of them, in this direction.
    """

    source: str
    target: str
    inside: tuple[Step, ...]
    for_cars: bool


@dataclass(frozen=True)
class MapTurns:
    """The turns that a map permits, as pairs of edges.

    Attributes
    ----------
    for_cars, for_any
        Turns that cars, or any vehicles, may take.
    forth
        Those that do not lead back.
    off_arrows
        Those for which no lane has an arrow, although all lanes have some.
    """

    for_cars: set[Pair] = field(default_factory=set)
    for_any: set[Pair] = field(default_factory=set)
    forth: set[Pair] = field(default_factory=set)
    off_arrows: set[Pair] = field(default_factory=set)


class StreetGraph:
    """The ways of a map, and the edges of the network made of them.

    Parameters
    ----------
    extract
        The map.
    network
        The network, made with :data:`ORIGINAL_NAMES_FLAG`.
    lefthand
        Whether traffic drives on the left.
    """

    def __init__(self, extract: OsmExtract, network: Path, *, lefthand: bool) -> None:
        self._extract = extract
        self._shrink = math.cos(math.radians(extract.bounds.south_deg))
        self._xy_m: dict[int, XY] = {}
        self.lefthand = lefthand
        self._ways = {way.id: _mapped(way, extract) for way in extract.ways.values() if "highway" in way.tags}
        self.restrictions = read_restrictions(extract)
        self.built = BuiltTurns()
        self.edges: dict[str, StreetEdge] = {}
        self.unknown: list[str] = []
        self.signalised: set[str] = set()
        for element in xml.iter_elements(network, "net"):
            self.built.add(element)
            if element.tag == "junction" and element.get("type", "").startswith("traffic_light"):
                self.signalised.add(element.attrib["id"])
            if element.tag == "edge" and not element.get("function"):
                self._add_edge(element)

        self._leaving: dict[int, list[Step]] = {}
        for way in self._ways.values():
            if way.tags["highway"] not in _FOR_VEHICLES:
                continue
            along, against = _bus_directions(way.tags)
            for index in range(len(way.nodes)):
                if along and index + 1 < len(way.nodes):
                    self._leaving.setdefault(way.nodes[index], []).append(Step(way.id, index, True))
                if against and index > 0:
                    self._leaving.setdefault(way.nodes[index], []).append(Step(way.id, index, False))
        self._edge_of_first = {edge.steps[0]: edge.id for edge in self.edges.values()}
        self._on_edges = {step for edge in self.edges.values() for step in edge.steps}
        self._nodes = {node for step in self._on_edges for node in (self.start_node(step), self.end_node(step))}
        in_force = [restriction for restriction in self.restrictions.in_force if self._reaches_target(restriction)]
        self.rules = TurnRules(in_force, self._ways)
        self.without_target = tuple(r.id for r in self.restrictions.in_force if r not in in_force)

    def _reaches_target(self, restriction: Restriction) -> bool:
        """Return whether the network has the street that a restriction leaves open, if it leaves only one open."""
        return not restriction.only or any(self._is_in_network(way) for way in restriction.targets)

    def _is_in_network(self, way: int) -> bool:
        """Return whether a way for vehicles is on edges, or inside a junction between them."""
        found = self._ways.get(way)
        return found is not None and found.tags["highway"] in _FOR_VEHICLES and bool(self._nodes & {*found.nodes})

    def _add_edge(self, element: Element) -> None:
        edge_id = element.attrib["id"]
        params = {param.get("key", ""): param.get("value", "") for param in element.findall("param")}
        names = {
            name
            for param in element.iter("param")
            if param.get("key") == "origId"
            for name in param.get("value", "").split()
        }
        permissions = {
            int(lane.attrib["index"]): Permission.from_attributes(lane.attrib) for lane in element.iter("lane")
        }
        car_lanes = tuple(index for index, permission in permissions.items() if permission.admits(CAR))
        lanes = sum(map(is_carriageway, permissions.values()))
        speed_m_s = max((float(lane.attrib["speed"]) for lane in element.iter("lane")), default=0.0)
        start, end = params.get("origFrom", element.get("from", "")), params.get("origTo", element.get("to", ""))
        steps = self._steps(edge_id, start, end, {int(name) for name in names if _INTEGER.fullmatch(name)})
        if steps:
            nodes = element.get("from", ""), element.get("to", "")
            self.edges[edge_id] = StreetEdge(edge_id, *nodes, steps, car_lanes, lanes, speed_m_s)
        else:
            self.unknown.append(edge_id)

    def _steps(self, edge_id: str, start: str, end: str, ways: Collection[int]) -> tuple[Step, ...]:
        """Return the pieces of ways of an edge; empty if they cannot be told."""
        if not _INTEGER.fullmatch(start) or not _INTEGER.fullmatch(end):
            return ()
        # editors give new objects negative numbers, so -7 may be way -7, or way 7 against its direction
        name = edge_id.partition("#")[0]
        candidates = [(name, True), *([(name[1:], False)] if name.startswith("-") else [])]
        walks = []
        for number, forward in candidates:
            way = int(number) if _INTEGER.fullmatch(number) else None
            nodes = self._ways[way].nodes if way in self._ways else ()
            for index, node in enumerate(nodes):
                if way is not None and node == int(start):
                    walks.append(self._walk(Step(way, index, forward), int(end), {*ways, way}))
        return min((walk for walk in walks if walk), key=len, default=())

    def _walk(self, step: Step, end: int, ways: Collection[int]) -> tuple[Step, ...]:
        """Follow the ways of an edge from its first step to its last node; empty if that is not reached."""
        steps: list[Step] = []
        rest = {*ways} - {step.way}
        while len(steps) <= sum(len(self._ways[way].nodes) for way in ways if way in self._ways):
            nodes = self._ways[step.way].nodes
            if 0 <= step.end < len(nodes):
                steps.append(step)
                if nodes[step.end] == end:
                    return tuple(steps)
                step = Step(step.way, step.end, step.forward)
            elif nodes[0] == nodes[-1] and len(nodes) > 1:
                step = Step(step.way, 0 if step.forward else len(nodes) - 1, step.forward)
            else:
                next_step = self._continue(nodes[step.start], rest)
                if next_step is None:
                    return ()
                rest.remove(next_step.way)
                step = next_step
        return ()

    def _continue(self, node: int, ways: Collection[int]) -> Step | None:
        """Return the start of a further way of an edge at the node where the one before ends."""
        for way in sorted(ways):
            nodes = self._ways[way].nodes if way in self._ways else ()
            if nodes and nodes[0] == node:
                return Step(way, 0, True)
            if nodes and nodes[-1] == node:
                return Step(way, len(nodes) - 1, False)
        return None

    def start_node(self, step: Step) -> int:
        """Return the node where a step starts."""
        return self._ways[step.way].nodes[step.start]

    def end_node(self, step: Step) -> int:
        """Return the node where a step ends."""
        return self._ways[step.way].nodes[step.end]

    def turns_from(self, edge: StreetEdge, rules: TurnRules) -> Iterator[MapTurn]:
        """Yield the turns that a map permits from an edge."""
        progress = Progress()
        for before, after in pairwise(edge.steps):
            progress, _ = rules.follow(before, after, self.end_node(before), progress)
        queue: deque[tuple[Step, Progress, tuple[Step, ...], bool]] = deque([(edge.steps[-1], progress, (), True)])
        seen = {(edge.steps[-1], progress, True)}
        while queue:
            step, progress, inside, for_cars = queue.popleft()
            node = self.end_node(step)
            for after in self._leaving.get(node, ()):
                following, forbidding = rules.follow(step, after, node, progress)
                if forbidding:
                    continue
                target = self._edge_of_first.get(after)
                if target is not None:
                    if self.edges[target].from_node == edge.to_node:
                        yield MapTurn(edge.id, target, inside, for_cars)
                    continue
                passed = {node, self.start_node(step), *(self.start_node(other) for other in inside)}
                if after in self._on_edges or self.end_node(after) in passed:  # a circle is no turn
                    continue
                state = (after, following, for_cars and self._is_for_cars(after))
                path = (*inside, after)
                if state not in seen and self.length_m(path) <= _INSIDE_M:
                    seen.add(state)
                    queue.append((state[0], state[1], path, state[2]))

    def forbidding(self, source: str, target: str) -> frozenset[int]:
        """Return the restrictions that forbid a turn; empty if no way leads there."""
        ways_only = TurnRules((), self._ways)
        for turn in self.turns_from(self.edges[source], ways_only):
            if turn.target == target:
                steps = (*self.edges[source].steps, *turn.inside, self.edges[target].steps[0])
                progress, relations = Progress(), set()
                for before, after in pairwise(steps):
                    progress, forbidding = self.rules.follow(before, after, self.end_node(before), progress)
                    relations |= forbidding
                return frozenset(relations)
        return frozenset()

    def _is_for_cars(self, step: Step) -> bool:
        tags = self._ways[step.way].tags
        along, against = directions(tags)
        return _admits_cars(tags) and (along if step.forward else against)

    def _xy(self, node: int) -> XY:
        if node not in self._xy_m:
            lat_deg, lon_deg = self._extract.nodes[node]
            self._xy_m[node] = EARTH_M * math.radians(lon_deg) * self._shrink, EARTH_M * math.radians(lat_deg)
        return self._xy_m[node]

    def length_m(self, steps: Sequence[Step]) -> float:
        """Return the length of some pieces of ways."""
        return math.fsum(
            math.dist(self._xy(self.start_node(step)), self._xy(self.end_node(step))) for step in steps
        )  # fmt: skip

    def nodes_m(self, nodes: Collection[str]) -> dict[str, XY]:
        """Return the mean position of the ends of the edges to each of some nodes of the network."""
        ends: dict[str, list[XY]] = {}
        for edge in self.edges.values():
            if edge.to_node in nodes:
                ends.setdefault(edge.to_node, []).append(self._xy(self.end_node(edge.steps[-1])))
        return {node: (fmean(x for x, _ in points), fmean(y for _, y in points)) for node, points in ends.items()}

    def is_on_ring(self, node: str) -> bool:
        """Return whether a node of the network is on a roundabout of the map."""
        last = [edge.steps[-1] for edge in self.edges.values() if edge.to_node == node]
        return any(self._ways[step.way].tags.get("junction") in _RINGS for step in last)

    def has_signal(self, node: int) -> bool:
        """Return whether a node of the map has a traffic signal."""
        return is_signal(self._extract.node_tags.get(node, {}))

    def turned_deg(self, source: str, target: str, inside: Sequence[Step] = ()) -> float:
        """Return the angle of a turn over some pieces of ways, positive to the left; beyond 180 for a circle."""
        before = [self._xy(self.end_node(step)) for step in reversed(self.edges[source].steps)]
        before.append(self._xy(self.start_node(self.edges[source].steps[0])))
        after = [self._xy(self.start_node(step)) for step in self.edges[target].steps]
        after.append(self._xy(self.end_node(self.edges[target].steps[-1])))
        pieces = [[self._xy(self.start_node(step)), self._xy(self.end_node(step))] for step in inside]
        bearings = [_bearing_deg(before) + 180.0, *map(_bearing_deg, pieces), _bearing_deg(after)]
        return math.fsum(_wrap_deg(after - before) for before, after in pairwise(bearings))

    def goes_back(self, turn: MapTurn) -> bool:
        """Return whether a turn leads back."""
        is_back = abs(self.turned_deg(turn.source, turn.target, turn.inside)) > U_TURN_DEG
        return is_back or self.is_same_street(turn.source, turn.target)

    def follows_arrows(self, turn: MapTurn) -> bool:
        """Return whether a lane has an arrow for a turn, or some lane has none."""
        step = self.edges[turn.source].steps[-1]
        lanes = _arrows(self._ways[step.way].tags, forward=step.forward)
        return not all(lanes) or self._fits(frozenset().union(*lanes), turn.source, turn.target)

    def _fits(self, arrows: frozenset[str], source: str, target: str) -> bool:
        """Return whether one of some arrows can mean a turn; true without arrows."""
        turned_deg = _wrap_deg(self.turned_deg(source, target))
        return not arrows or any(low <= turned_deg <= high for low, high in map(_ARROWS_DEG.__getitem__, arrows))

    @cached_property
    def map_turns(self) -> MapTurns:
        """The turns that the map permits between the edges."""
        turns = MapTurns()
        for edge in self.edges.values():
            for turn in self.turns_from(edge, self.rules):
                pair = turn.source, turn.target
                turns.for_any.add(pair)
                if not self.goes_back(turn):
                    turns.forth.add(pair)
                if not self.follows_arrows(turn):
                    turns.off_arrows.add(pair)
                if turn.for_cars and edge.car_lanes and self.edges[turn.target].car_lanes:
                    turns.for_cars.add(pair)
        return turns

    def connections_off_arrows(self, built: BuiltTurns) -> Iterator[Connection]:
        """Yield the connections from lanes whose arrows mean other turns, where a street leads to several others.

        At a fork, the arrows may be those of the next junction: then the leftmost and rightmost way are left and right.
        """
        by_pair = lanes_of_pairs(built.connections)
        targets: dict[str, list[str]] = {}
        for source, target in by_pair:
            is_known = source in self.edges and target in self.edges
            if is_known and not self.is_same_street(source, target):
                targets.setdefault(source, []).append(target)
        for source in sorted(source for source, others in targets.items() if len(others) > 1):
            edge = self.edges[source]
            lanes = _arrows(self._ways[edge.steps[-1].way].tags, forward=edge.steps[-1].forward)
            if len(lanes) != len(edge.car_lanes):
                continue
            arrows = dict(zip(edge.car_lanes, lanes if self.lefthand else lanes[::-1], strict=True))
            by_angle = sorted(targets[source], key=lambda target: self.turned_deg(edge.id, target))
            outer = {by_angle[0]: "right", by_angle[-1]: "left"}
            for target in sorted(targets[source]):
                side = outer.get(target, "between")
                for connection in sorted(by_pair[source, target]):
                    of_lane = arrows.get(connection.source_lane, frozenset())
                    means_side = any(arrow.endswith(side) for arrow in of_lane)
                    if not means_side and not self._fits(of_lane, source, target):
                        yield connection

    def is_same_street(self, source: str, target: str) -> bool:
        """Return whether a turn leads back along the way that it comes from."""
        return self.edges[source].steps[-1].reverse == self.edges[target].steps[0]

    def title(self, pair: Pair, relations: Collection[int] = ()) -> str:
        """Return a description of a turn: streets, position, and the restrictions that forbid it."""
        source, target = (self.edges[edge] for edge in pair)
        names = [_way_title(self._ways[step.way]) for step in (source.steps[-1], target.steps[0])]
        lat_deg, lon_deg = self._extract.nodes[self.end_node(source.steps[-1])]
        text = f"{names[0]} to {names[1]} at {lat_deg:.5f},{lon_deg:.5f}"
        return f"{text} (relation {list_first([str(r) for r in sorted(relations)], 3)})" if relations else text

    def node_title(self, node: str) -> str:
        """Return the streets that lead to a node of the network, and its position."""
        last = [edge.steps[-1] for edge in self.edges.values() if edge.to_node == node and edge.car_lanes]
        streets = sorted({_way_title(self._ways[step.way]) for step in last})
        lat_deg, lon_deg = self._extract.nodes[self.end_node(last[0])]
        return f"{' / '.join(streets)} at {lat_deg:.5f},{lon_deg:.5f}"

    def is_in_network(self, relation: int) -> bool:
        """Return whether both ends of a restriction are streets of the network, or the one that it names."""
        members = next(r for r in self._extract.relations if r.id == relation)
        ends = [ways for ways in map(members.ways, ("from", "to")) if ways]
        return bool(ends) and all(any(map(self._is_in_network, ways)) for ways in ends)

    def edges_without(self, keys: Collection[str]) -> Iterator[StreetEdge]:
        """Yield the edges of which a part has none of some tags."""
        for edge in self.edges.values():
            if any(self._ways[step.way].tags.keys().isdisjoint(keys) for step in edge.steps):
                yield edge

    def beyond_junctions(self) -> tuple[int, ...]:
        """Return the restrictions over ways that are edges of their own: no connection can express them."""
        relations = []
        for restriction in self.rules.restrictions:
            if not restriction.via_ways or not self.is_in_network(restriction.id):
                continue
            via = {*restriction.via_ways}
            edges = [edge for edge in self.edges.values() if via & {step.way for step in edge.steps}]
            is_merged = any(restriction.sources & {step.way for step in edge.steps} for edge in edges)
            if edges and not is_merged:
                relations.append(restriction.id)
        return tuple(relations)


def _mapped(way: Way, extract: OsmExtract) -> Way:
    """Return a way without the nodes that the extract lacks."""
    return Way(way.id, tuple(node for node in way.nodes if node in extract.nodes), way.tags)


def _arrows(tags: Tags, *, forward: bool) -> list[frozenset[str]]:
    """Return the arrows on each lane of a way, from left to right; empty for a lane without any, or an unknown one."""
    keys = ["turn:lanes:forward" if forward else "turn:lanes:backward"]
    if forward and directions(tags) == (True, False):
        keys.append("turn:lanes")
    text = next((tags[key] for key in keys if key in tags), "")
    lanes = [frozenset(arrow.strip() for arrow in lane.split(";")) for lane in text.split("|")]
    return [lane if lane <= _ARROWS_DEG.keys() else frozenset() for lane in lanes]


def _wrap_deg(angle_deg: float) -> float:
    return (angle_deg + 180.0) % 360.0 - 180.0


def _bearing_deg(points: Sequence[XY]) -> float:
    """Return the direction from the first point to the one some metres further, counter-clockwise from east."""
    start = points[0]
    far = next((point for point in points if math.dist(start, point) >= _HEADING_M), points[-1])
    return math.degrees(math.atan2(far[1] - start[1], far[0] - start[0]))


def _way_title(way: Way) -> str:
    return way.tags.get("name") or way.tags.get("ref") or f"way {way.id}"


@dataclass(frozen=True)
class StreetTurns:
    """How the turns of a network differ from those of its map.

    Attributes
    ----------
    graph
        The ways and edges.
    built
        The turns of the network.
    lost, added
        Turns that the network lacks, and that only the network has, as pairs of edges.
    relations
        The restrictions that forbid an added turn, by turn.
    turns_back
        Permitted turns back to another street that the network lacks.
    off_arrows
        Connections from lanes whose arrows mean other turns.
    """

    graph: StreetGraph
    built: BuiltTurns
    lost: tuple[Pair, ...]
    added: tuple[Pair, ...]
    relations: Mapping[Pair, frozenset[int]]
    turns_back: tuple[Pair, ...]
    off_arrows: tuple[Connection, ...]


def compare_with_map(graph: StreetGraph, built: BuiltTurns) -> StreetTurns:
    """Compare the turns that a network has, as netconvert made it or after a repair, with those of its map."""
    turns = graph.map_turns
    pairs = {pair for pair in built.edge_pairs if pair[0] in graph.edges and pair[1] in graph.edges}
    comparison = compare_turns(turns.for_cars & turns.forth - turns.off_arrows, pairs, turns.for_any)
    relations = {pair: graph.forbidding(*pair) for pair in comparison.added}
    back = [pair for pair in sorted(turns.for_cars - turns.forth - pairs) if not graph.is_same_street(*pair)]
    off_lanes = tuple(graph.connections_off_arrows(built))
    return StreetTurns(graph, built, comparison.lost, comparison.added, relations, tuple(back), off_lanes)


def repair_turns(
    extract: OsmExtract, folder: Path, name: str, flags: Sequence[str], *, lefthand: bool
) -> tuple[str, ...]:
    """Close and add turns of a network as its map has them.

    Parameters
    ----------
    extract
        The map.
    folder, name
        The network, made with :data:`ORIGINAL_NAMES_FLAG`; it is replaced.
    flags
        Flags of netconvert for reading and writing a network.
    lefthand
        Whether traffic drives on the left.

    Returns
    -------
    tuple of str
        Sentences on what was repaired, and what still differs.
    """
    graph = StreetGraph(extract, folder / name, lefthand=lefthand)
    before = after = compare_with_map(graph, graph.built)
    closed = _closable(before)
    signals = find_signals(graph)
    if closed or before.lost or signals.nodes:
        lanes = lanes_of_pairs(graph.built.connections)
        removed = [connection for pair in closed for connection in lanes[pair]]
        added = [_connection(graph, pair) for pair in before.lost]
        patch_network(folder, name, f"patched.{name}", removed=removed, added=added, flags=flags, signals=signals.nodes)
        (folder / f"patched.{name}").replace(folder / name)
        after = compare_with_map(graph, BuiltTurns.read(folder / name))
    return (*_notes(before, after), *_signal_notes(graph, signals))


def _closable(turns: StreetTurns) -> list[Pair]:
    """Return the added turns that can be closed: those that a restriction forbids, and others unless an edge would lead
    nowhere, or nothing to it.
    """
    pairs = turns.built.edge_pairs - {pair for pair in turns.added if turns.relations[pair]}
    closed = []
    for pair in turns.added:
        if turns.relations[pair]:
            closed.append(pair)
            continue
        rest = pairs - {pair}
        is_needed = not any(other[0] == pair[0] for other in rest) or not any(other[1] == pair[1] for other in rest)
        if not is_needed:
            closed.append(pair)
            pairs = rest
    return closed


def _connection(graph: StreetGraph, pair: Pair) -> Connection:
    """Return the connection of a turn: between the lanes on its side."""
    source, target = graph.edges[pair[0]], graph.edges[pair[1]]
    turned_deg = graph.turned_deg(*pair)
    away_from_kerb = turned_deg < -_STRAIGHT_DEG if graph.lefthand else turned_deg > _STRAIGHT_DEG
    choose: Callable[[Sequence[int]], int] = max if away_from_kerb else min
    return Connection(source.id, choose(source.car_lanes), target.id, choose(target.car_lanes))


def _notes(before: StreetTurns, after: StreetTurns) -> Iterator[str]:
    graph = after.graph
    closed = [pair for pair in before.added if pair not in after.added]
    yield from turn_notes(
        closed=[graph.title(pair, before.relations[pair]) for pair in closed],
        opened=[graph.title(pair) for pair in before.lost if pair not in after.lost],
        lost=[graph.title(pair) for pair in after.lost],
        added=[graph.title(pair, after.relations[pair]) for pair in after.added],
    )
    if count := len(after.turns_back):
        turns = list_first([graph.title(pair) for pair in after.turns_back], 1)
        left_out = f"{number_of(count, 'U-turn')} {by_number(count, 'is', 'are')} left out"
        yield f"{left_out}, since vehicles that wait to turn block a street: {turns}."
    if count := len(after.off_arrows):
        turns = list_turns(graph.title((lane.source, lane.target)) for lane in after.off_arrows)
        subject = f"{number_of(count, 'connection')} of lanes {by_number(count, 'does', 'do')}"
        yield f"{subject} not follow the arrows of the map (turn:lanes): {turns}."
    yield from _restriction_notes(graph)
    yield from _assumption_notes(graph)
    if graph.unknown:
        edges = list_first(graph.unknown, MOST_LISTED)
        yield f"The turns of {number_of(len(graph.unknown), 'edge')} could not be compared with the map: {edges}."


def _signal_notes(graph: StreetGraph, signals: MapSignals) -> Iterator[str]:
    """Yield a sentence on the nodes inside signalised junctions that have no signals."""
    if count := len(signals.ungoverned):
        nodes = list_first([graph.node_title(node) for node in signals.ungoverned], MOST_LISTED, "; ")
        yield (
            f"{number_of(count, 'node')} inside signalised junctions {by_number(count, 'has', 'have')} no signal, since"
            f" the map has signals on fewer than half of the approaches: {nodes}."
        )


def _assumption_notes(graph: StreetGraph) -> Iterator[str]:
    """Yield sentences on the lanes and speed limits that are netconvert's defaults."""
    lanes = Counter(edge.lanes for edge in graph.edges_without(_LANE_KEYS))
    if lanes:
        yield f"Lanes assumed by road class: {_edge_counts(lanes)}."
    speeds_km_h = Counter(round(edge.speed_m_s * 3.6) for edge in graph.edges_without(_SPEED_KEYS))
    if speeds_km_h:
        counts = _edge_counts(speeds_km_h, " km/h")
        yield f"Speed limits assumed by road class: {counts}."


def _edge_counts(values: Counter[int], unit: str = "") -> str:
    return ", ".join(f"{value}{unit} for {number_of(values[value], 'edge')}" for value in sorted(values))


def _restriction_notes(graph: StreetGraph) -> Iterator[str]:
    """Yield sentences on the restrictions that a network cannot express."""
    restrictions = graph.restrictions
    rows = (
        (restrictions.conditional, "at certain times only, and are left out"),
        (restrictions.by_vehicle, "for certain vehicles only, and were not compared with the network"),
        (restrictions.with_exceptions, "for all but certain vehicles; in the network they may hold for these, too"),
    )
    for relations, what in rows:
        in_network = [str(relation) for relation in relations if graph.is_in_network(relation)]
        if in_network:
            yield f"Turn restrictions that hold {what}: {_count(in_network)}."
    without_turn = [str(relation) for relation in restrictions.without_turn if graph.is_in_network(relation)]
    if without_turn:
        what = "whose streets do not meet at their via, and which are left out"
        yield f"Turn restrictions {what}: {_count(without_turn)}."
    if beyond := graph.beyond_junctions():
        yield (
            "Turn restrictions that lead over a street between two junctions, which SUMO cannot express; the turns stay"
            f" open: {_count([str(relation) for relation in beyond])}."
        )
    if graph.without_target:
        yield (
            "Turn restrictions whose only permitted street is not in the network, and which are left out:"
            f" {_count([str(relation) for relation in graph.without_target])}."
        )


def _count(relations: Sequence[str]) -> str:
    return (
        f"{len(relations)} ({by_number(len(relations), 'relation', 'relations')} {list_first(relations, MOST_LISTED)})"
    )
