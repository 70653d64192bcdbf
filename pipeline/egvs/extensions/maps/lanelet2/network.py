"""Build a SUMO network of the roads of a Lanelet2 map, with netconvert.

Steps of :meth:`NetworkBuilder.build`: write nodes, edges and connections as plain XML, with the shapes of all lanes,
connections and nodes; run netconvert; measure how far the lanes are from those of the map; change the shape of the
nodes where one is more than :data:`MAX_LANE_ERROR_M` off, and run netconvert again. Then count what was lost or added.

Frame: x, y, z in metres of the world frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from shapely.geometry import LineString

from egvs.core import files, polylines
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.wording import number_of
from egvs.creation.plain_network import NETWORK_FILE
from egvs.creation.turns import Connection, TurnComparison, compare_turns
from egvs.extensions.maps.formats.lanelet2 import LaneletMap
from egvs.extensions.maps.lane_changes import NO_CHANGE
from egvs.extensions.maps.lanelet2 import rules
from egvs.extensions.maps.lanelet2.crosswalks import Crosswalk
from egvs.extensions.maps.lanelet2.lane_changes import find_lane_changes
from egvs.extensions.maps.lanelet2.nodes import ATTEMPTS, NodeShapes, lane_errors_m
from egvs.extensions.maps.lanelet2.plain_network import PlainElement, PlainNetwork, format_number, format_shape
from egvs.extensions.maps.lanelet2.right_of_way import find_right_of_way
from egvs.extensions.maps.lanelet2.road_layout import Road, RoadLayout, Turn
from egvs.extensions.maps.lanelet2.sidewalks import crossing_elements, crossing_lines_m, sidewalk_element
from egvs.extensions.maps.lanelet2.signals import SignalPlan
from egvs.formats.georeference import WorldFrame
from egvs.traffic import network as road_network
from egvs.traffic import sumo

MAX_LANE_ERROR_M = 0.3
"""How far a lane may be from that of the map."""

_EDITOR_HINT = "Correct the map in an editor."
_SIMPLIFY_M = 0.01
_EXTENSION_M = 20.0
"""netconvert gets the line of a road longer than it is by this: from the line, cut at the nodes, it finds the direction
of the road, and with it those of the turns. Very short roads would be turned anywhere. It finds no roundabout in such
lines, so these are found without, before."""
_PRIORITIES = {
    "motorway": 12,
    "trunk": 11,
    "primary": 10,
    "secondary": 8,
    "tertiary": 6,
    "living_street": 2,
    "service": 1,
}
_OTHER_PRIORITY = 4
_KM_H_PER_M_S = 3.6


@dataclass
class NetworkQuality:
    """How a network differs from the map.

    Attributes
    ----------
    max_lane_error_m
        Largest distance of a lane from that of the map.
    bad_lanes
        Lanes that are more than :data:`MAX_LANE_ERROR_M` off, as ``road_lane``.
    turns
        Connections that netconvert dropped or invented.
    lost_crossings
        Crosswalks that netconvert cannot build.
    """

    max_lane_error_m: float = 0.0
    bad_lanes: list[str] = field(default_factory=list)
    turns: TurnComparison[Connection] = field(default_factory=lambda: TurnComparison((), ()))
    lost_crossings: list[Crosswalk] = field(default_factory=list)


class NetworkBuilder:
    """Writes a layout as plain XML and builds it.

    Parameters
    ----------
    layout
        Roads, nodes and turns.
    lanelet_map
        The map, for tags.
    frame
        Position of the world frame on the Earth.
    signals
        The traffic lights.
    where
        The file, for messages.
    lefthand
        Whether traffic drives on the left.
    crosswalks
        Crosswalks; the layout says which roads get a sidewalk.
    """

    def __init__(
        self,
        layout: RoadLayout,
        lanelet_map: LaneletMap,
        frame: WorldFrame | None,
        signals: SignalPlan,
        where: str,
        *,
        lefthand: bool,
        crosswalks: Sequence[Crosswalk] = (),
    ) -> None:
        self._crosswalks = crosswalks
        self._layout = layout
        self.signals = signals
        self._map = lanelet_map
        self._frame = frame
        self._where = where
        self._lefthand = lefthand
        self._shapes = NodeShapes(layout)
        self.lane_changes = find_lane_changes(layout, lanelet_map, lefthand=lefthand)
        self.right_of_way = find_right_of_way(layout, lanelet_map, signals.nodes)
        self.assumed = rules.Assumptions()

    def build(self) -> tuple[str, NetworkQuality]:
        """Return the text of the network, and how it differs from the map."""
        edges: list[PlainElement] = [self._edge(road, _EXTENSION_M) for road in self._layout.roads.values()]
        connections = [*self._connections(), *self.right_of_way.elements()]
        signals = list(self.signals.elements)
        flags = ["--lefthand"] if self._lefthand else []
        attempts = dict.fromkeys(self._layout.nodes(), 0)
        if _has_ring({(road.start, road.end) for road in self._layout.roads.values()}):
            edges += self._roundabouts(connections, signals, flags)
        crossings = list(crossing_elements(self._crosswalks, self.signals, None))
        while True:
            nodes = [self._node(node, attempt) for node, attempt in attempts.items()]
            text = self._convert(PlainNetwork(self._frame, nodes, edges, connections + crossings, signals), flags)
            quality, bad_nodes = self._measure(text)
            improvable = {node for node in bad_nodes if attempts[node] < ATTEMPTS - 1}
            if not improvable:
                break
            attempts |= {node: attempts[node] + 1 for node in improvable}
        if self._crosswalks:
            crossings = list(crossing_elements(self._crosswalks, self.signals, text))
            text = self._convert(PlainNetwork(self._frame, nodes, edges, connections + crossings, signals), flags)
            quality, _ = self._measure(text)
            built = crossing_lines_m(text)
            quality.lost_crossings = [walk for walk in self._crosswalks if frozenset(walk.roads) not in built]
        return text, quality

    def _roundabouts(
        self, connections: list[PlainElement], signals: list[PlainElement], flags: Sequence[str]
    ) -> list[PlainElement]:
        """Return the roundabouts that netconvert finds."""
        counted, self.assumed = self.assumed, rules.Assumptions()
        nodes = [self._node(node, 0) for node in self._layout.nodes()]
        edges = [self._edge(road, 0.0) for road in self._layout.roads.values()]
        self.assumed = counted  # these roads are not counted again
        text = self._convert(PlainNetwork(self._frame, nodes, edges, connections, signals), flags)
        try:
            rings = read_network_text(text).roundabouts
        except InputError:  # of a network without roads, as in _measure, which reports it
            return []
        return [
            PlainElement("roundabout", {"nodes": " ".join(ring.nodes), "edges": " ".join(ring.edges)}) for ring in rings
        ]

    def _convert(self, plain: PlainNetwork, flags: Sequence[str]) -> str:
        try:
            return plain.build(flags)
        except sumo.SumoInputError as error:
            problem = "netconvert cannot build a network of its lanelets"
            raise error.for_input(self._where, problem, _EDITOR_HINT) from None

    def _node(self, node: str, attempt: int) -> PlainElement:
        x, y, z = self._shapes.position_m(node).tolist()
        shape = self._shapes.shape_m(node, attempt)
        attributes = {"id": node, "x": format_number(x), "y": format_number(y), "z": format_number(z)}
        if node in self.signals.nodes:
            attributes |= {"type": "traffic_light", "tl": node}
        else:
            attributes["type"] = "allway_stop" if node in self.right_of_way.all_way_stops else "priority"
        attributes["shape"] = format_shape(shape, z)
        return PlainElement("node", attributes)

    def _edge(self, road: Road, extension_m: float) -> PlainElement:
        lanelets = list(road.lanes)
        kind = rules.road_class(lanelets[0].tags, len(lanelets), self.assumed)
        attributes = {
            "id": road.id, "from": road.start, "to": road.end,
            "numLanes": str(self._layout.sumo_lane(road.id, len(road.lanes))),
            "type": f"highway.{kind}", "priority": str(_PRIORITIES.get(kind, _OTHER_PRIORITY)),
            "spreadType": "center", "shape": format_shape(simplify_line(_extend(_road_line_m(road), extension_m))),
        }  # fmt: skip
        if all("highway" in lanelet.tags for lanelet in lanelets):
            name = rules.common_tag(lanelets, "name")
            attributes |= {"name": name} if name else {}
        lanes = [self._lane(road, index) for index in range(len(road.lanes))]
        if road.id in self._layout.sidewalks:
            lanes.insert(0, sidewalk_element(road, lefthand=self._lefthand))
        return PlainElement("edge", attributes, tuple(lanes))

    def _lane(self, road: Road, index: int) -> PlainElement:
        lane = road.lanes[index]
        speed_km_h = rules.speed_limit_km_h(lane, self._map, self._where, self.assumed)
        attributes = {
            "index": str(self._layout.sumo_lane(road.id, index)),
            "speed": format_number(speed_km_h / _KM_H_PER_M_S),
            "width": format_number(lane.width_m),
            "shape": format_shape(simplify_line(lane.center_m)),
        }
        attributes |= rules.permission_attributes(lane.users)
        left, right = (index - 1, index + 1) if self._lefthand else (index + 1, index - 1)
        for key, other in (("changeLeft", left), ("changeRight", right)):
            if 0 <= other < len(road.lanes) and other not in self.lane_changes.to_lanes[road.id, index]:
                attributes[key] = NO_CHANGE
        origin = PlainElement("param", {"key": "origId", "value": str(lane.key.id)})
        return PlainElement("lane", attributes, (origin,))

    def _connections(self) -> Iterator[PlainElement]:
        turns = self._layout.turns
        for turn in turns:
            yield self._connection(turn)
        leaving = {turn.source for turn in turns}
        for road in self._layout.roads:
            if road not in leaving:  # else netconvert invents connections
                yield PlainElement("connection", {"from": road})

    def _connection(self, turn: Turn) -> PlainElement:
        attributes = {"from": turn.source, "to": turn.target}
        attributes["fromLane"] = str(self._layout.sumo_lane(turn.source, turn.source_lane))
        attributes["toLane"] = str(self._layout.sumo_lane(turn.target, turn.target_lane))
        if len(turn.shape_m):
            attributes["shape"] = format_shape(simplify_line(turn.shape_m))
        is_signalised = self._layout.roads[turn.source].end in self.signals.nodes
        if is_signalised and turn not in self.signals.index_of:
            attributes["uncontrolled"] = "true"
        return PlainElement("connection", attributes)

    def _measure(self, text: str) -> tuple[NetworkQuality, set[str]]:
        """Compare a network with the map; return the nodes at the bad ends of lanes, too."""
        try:
            actual = read_network_text(text)
        except InputError as error:  # netconvert writes a network without roads where it finds nothing to connect
            problem = f"netconvert makes no network of its lanelets: {error.problem}"
            raise InputError(self._where, problem, _EDITOR_HINT) from None
        sumo_lane = self._layout.sumo_lane
        wanted_m = {
            (road.id, sumo_lane(road.id, index)): lane.center_m
            for road in self._layout.roads.values()
            for index, lane in enumerate(road.lanes)
        }
        actual_m = {(edge.id, index): lane.shape_m for edge in actual.edges for index, lane in enumerate(edge.lanes)}
        missing = [key for key in wanted_m if key not in actual_m]
        if missing:
            problem = f"netconvert dropped {number_of(len(missing), 'lane')}, the first of {missing[0][0]}"
            raise InputError(self._where, problem, _EDITOR_HINT)
        quality = NetworkQuality()
        bad_nodes = set()
        for (road_id, index), errors_m in lane_errors_m(wanted_m, actual_m).items():
            quality.max_lane_error_m = max(quality.max_lane_error_m, errors_m[2])
            if errors_m[2] <= MAX_LANE_ERROR_M:
                continue
            quality.bad_lanes.append(f"{road_id}_{index}")
            road = self._layout.roads[road_id]
            at_ends = {
                node
                for node, error_m in zip((road.start, road.end), errors_m, strict=False)
                if error_m > MAX_LANE_ERROR_M
            }
            bad_nodes |= at_ends or {road.start, road.end}
        permitted = {
            Connection(
                turn.source,
                sumo_lane(turn.source, turn.source_lane),
                turn.target,
                sumo_lane(turn.target, turn.target_lane),
            )
            for turn in self._layout.turns
        }
        edges = actual.edges
        built = {
            Connection(edges[c.source].id, c.source_lane, edges[c.target].id, c.target_lane) for c in actual.connections
        }
        quality.turns = compare_turns(permitted, built)
        return quality, bad_nodes


def simplify_line(line_m: FloatArray) -> FloatArray:
    """Drop points (n, 3) within 1 cm of the line through the others, in plan and in height."""
    stations_m = polylines.stations_m(line_m)
    keep = np.zeros(len(line_m), dtype=bool)
    for flat in (line_m[:, :2], np.column_stack([stations_m, line_m[:, 2]])):
        points = np.asarray(LineString(flat).simplify(_SIMPLIFY_M, preserve_topology=False).coords)
        position = 0
        for point in points:
            while not np.array_equal(flat[position], point):
                position += 1
            keep[position] = True
    return np.asarray(line_m[keep])


def read_network_text(text: str) -> road_network.Network:
    """Read a network from its text."""
    with files.temporary_folder() as folder:
        files.write_text(folder / NETWORK_FILE, text)
        return road_network.read_net_xml(folder / NETWORK_FILE)


def _road_line_m(road: Road) -> FloatArray:
    """Return the middle line of a road: that of its middle lane, or between its two middle lanes."""
    lanes = road.lanes
    middle = len(lanes) // 2
    if len(lanes) % 2:
        return lanes[middle].center_m
    one, other = lanes[middle - 1].center_m, lanes[middle].center_m
    shares = np.linspace(0.0, 1.0, max(len(one), len(other)))
    both = [
        np.column_stack([np.interp(shares, np.linspace(0, 1, len(line)), axis) for axis in line.T])
        for line in (one, other)
    ]
    return np.asarray((both[0] + both[1]) / 2)


def _extend(line_m: FloatArray, extension_m: float) -> FloatArray:
    """Extend a line (n, 3) straight at both ends."""
    if not extension_m:
        return line_m
    ends = []
    for end, inner in ((line_m[0], line_m[1]), (line_m[-1], line_m[-2])):
        step = end[:2] - inner[:2]
        point_m = end[:2] + extension_m * step / max(float(np.hypot(*step)), 1e-9)
        ends.append([*point_m, end[2]])
    return np.vstack([ends[:1], line_m, ends[1:]])


def _has_ring(roads: Set[tuple[str, str]]) -> bool:
    """Return whether roads between nodes lead around in a circle, without those that others lead back along."""
    one_way = {(start, end) for start, end in roads if (end, start) not in roads}
    while True:
        starts, ends = {start for start, _ in one_way}, {end for _, end in one_way}
        inner = {(start, end) for start, end in one_way if start in ends and end in starts}
        if inner == one_way:
            return bool(inner)
        one_way = inner


def unused_relations(layout: RoadLayout) -> list[tuple[str, str]]:
    """Return the pairs of lanelets that follow each other on the map, but in no connection of the network."""
    used: set[tuple[str, str]] = set()
    for turn in layout.turns:
        source = layout.roads[turn.source].lanes[turn.source_lane].key
        target = layout.roads[turn.target].lanes[turn.target_lane].key
        path = [source, *turn.path, target]
        used.update((str(a), str(b)) for a, b in pairwise(path))
    everything = ((str(key), str(other)) for key, after in layout.graph.followers.items() for other in after)
    return [pair for pair in everything if pair not in used]
