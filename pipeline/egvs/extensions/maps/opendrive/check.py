"""Compare a network that netconvert made of an OpenDRIVE map with the map: what was lost, by road.

netconvert notes the road and the lane that each lane of the network comes from (``origId``). Steps of
:func:`compare_with_map`: find the lanes of the network for each lane of the map; measure how far they lie off it, in
the plane and in height; look up each permitted turn; see which signals have a traffic light.

World frame of the network: x, y of the map plus the network's ``netOffset`` and the header's offset, metres.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import shapely

from egvs.core.grid import FloatArray
from egvs.creation.turns import BuiltTurns, Connection, compare_turns
from egvs.extensions.maps.formats.opendrive import OpenDriveMap
from egvs.extensions.maps.opendrive.turns import DRIVING_TYPES, LaneKey, Turn, driving_lanes, permitted_turns
from egvs.formats import xml
from egvs.traffic import network

OFF_M = 0.3
"""A lane that lies farther from the map's is reported."""

HEIGHT_OFF_M = 0.1

_AT_LANE_M = 10.0
"""Junctions of the network cut lanes by up to some metres at each end."""

_AT_END_M = 25.0
_ORIGIN = "origId"


@dataclass(frozen=True)
class NetworkLane:
    """A lane of a network.

    Attributes
    ----------
    edge, index
        Its edge, and its position on it.
    type
        The type of lane of the map.
    shape_m
        Its middle, (n, 3).
    is_restricted
        Whether only special vehicles may use it.
    """

    edge: str
    index: int
    type: str
    shape_m: FloatArray
    is_restricted: bool


@dataclass(frozen=True)
class MadeNetwork:
    """The parts of a network that are compared.

    Attributes
    ----------
    lanes
        Lanes by road and lane of the map.
    turns
        Its connections.
    signal_roads
        Roads with a lane that leads to a traffic light.
    signal_nodes
        Ids of the traffic lights.
    offset_m
        netOffset.
    """

    lanes: Mapping[tuple[str, int], tuple[NetworkLane, ...]]
    turns: BuiltTurns
    signal_roads: frozenset[str]
    signal_nodes: frozenset[str]
    offset_m: tuple[float, float]

    @property
    def connections(self) -> Set[Connection]:
        """Its connections, without U-turns."""
        return self.turns.connections - self.turns.u_turns


@dataclass(frozen=True)
class MapComparison:
    """What a network kept of an OpenDRIVE map.

    Attributes
    ----------
    lanes, lost_lanes
        Number of lanes of the map for vehicles, and those that the network lacks.
    turns
        Number of permitted turns.
    missing
        Turns that the network lacks, with the lanes between which they can be added.
    lost_turns
        Turns that cannot be added, since one of their lanes is missing.
    added
        Connections of the network that the map does not have, from lanes that lead elsewhere in the map.
    guessed
        Connections of the network from lanes that lead nowhere in the map.
    off_m
        Distance of each road's lanes from the map, by road.
    height_off_m
        Difference of heights, by road.
    unlit_roads
        Roads with signals that have no traffic light.
    restricted
        Number of lanes closed to normal traffic, because they are narrow.
    """

    lanes: int
    lost_lanes: tuple[LaneKey, ...]
    turns: int
    missing: Mapping[Turn, tuple[NetworkLane, NetworkLane]]
    lost_turns: tuple[Turn, ...]
    added: tuple[tuple[str, int, str, int], ...]
    guessed: tuple[tuple[str, int, str, int], ...] = ()
    off_m: Mapping[str, float] = field(default_factory=dict)
    height_off_m: Mapping[str, float] = field(default_factory=dict)
    unlit_roads: tuple[str, ...] = ()
    restricted: int = 0


def read_made_network(path: Path) -> MadeNetwork:
    """Read a network that netconvert made with ``--output.original-names``."""
    lanes: dict[tuple[str, int], list[NetworkLane]] = {}
    road_of_edge: dict[str, set[str]] = {}
    turns = BuiltTurns()
    signalised_edges = set()
    signal_nodes = set()
    offset_m = (0.0, 0.0)
    for element in xml.iter_elements(path, "net"):
        turns.add(element)
        if element.tag == "location":
            x, y = map(float, element.attrib["netOffset"].split(",")[:2])
            offset_m = (x, y)
        elif element.tag == "edge" and not element.get("function"):
            edge = element.attrib["id"]
            for lane in element.iterfind("lane"):
                made = _network_lane(edge, lane, path)
                origins = [param.get("value", "") for param in lane.iterfind("param") if param.get("key") == _ORIGIN]
                for origin in origins[0].split() if origins else []:
                    road, _, number = origin.rpartition("_")
                    lanes.setdefault((road, int(number)), []).append(made)
                    road_of_edge.setdefault(edge, set()).add(road)
        elif element.tag == "connection" and "tl" in element.attrib and not element.attrib["from"].startswith(":"):
            signalised_edges.add(element.attrib["from"])
            signal_nodes.add(element.attrib["tl"])
    signal_roads = {road for edge in signalised_edges for road in road_of_edge.get(edge, ())}
    by_origin = {key: tuple(made) for key, made in lanes.items()}
    return MadeNetwork(by_origin, turns, frozenset(signal_roads), frozenset(signal_nodes), offset_m)


def compare_with_map(made: MadeNetwork, road_map: OpenDriveMap, *, mirrored: bool) -> MapComparison:
    """Compare a network with its map.

    Parameters
    ----------
    made
        The network.
    road_map
        The map as netconvert read it.
    mirrored
        Whether netconvert drew the lanes on the other side of the reference line, for left-hand traffic.
    """
    lines = _lane_lines(road_map, made.offset_m, mirrored)
    lost = tuple(key for key in lines if not _candidates_near(made, key, lines[key]))
    turns = permitted_turns(road_map)
    ends: dict[Turn, tuple[NetworkLane, NetworkLane]] = {}
    connections: dict[Turn, Connection] = {}
    lost_turns = []
    for turn in turns:
        source = _lane_at(made, turn.source, _end_point(lines, turn.source), -1)
        target = _lane_at(made, turn.target, _start_point(lines, turn.target), 0)
        if source is None or target is None:
            lost_turns.append(turn)
            continue
        ends[turn] = source, target
        connections[turn] = Connection(source.edge, source.index, target.edge, target.index)
    permitted = set(connections.values())
    comparison = compare_turns(permitted, made.connections, _within_lanes(made))
    lost_connections = set(comparison.lost)
    missing = {
        turn: ends[turn]
        for turn, connection in connections.items()
        if connection in lost_connections and ends[turn][0] is not ends[turn][1]
    }
    linked = {connection[:2] for connection in permitted}
    off_m, height_off_m = _distances(made, lines)
    return MapComparison(
        lanes=len(lines),
        lost_lanes=lost,
        turns=len(turns),
        missing=missing,
        lost_turns=tuple(lost_turns),
        added=tuple(connection for connection in comparison.added if connection[:2] in linked),
        guessed=tuple(connection for connection in comparison.added if connection[:2] not in linked),
        off_m=off_m,
        height_off_m=height_off_m,
        unlit_roads=tuple(_unlit_roads(made, road_map)),
        restricted=sum(lane.is_restricted for lane in _driving_lanes(made)),
    )


def _network_lane(edge: str, lane: Element, path: Path) -> NetworkLane:
    shape = network.Shape(lane.attrib["shape"], f"{path}: lane {lane.get('id')}").shape_m
    permission = network.Permission.from_attributes(lane.attrib)
    return NetworkLane(edge, int(lane.attrib["index"]), lane.get("type", ""), shape, not permission.admits("passenger"))


def _lane_lines(road_map: OpenDriveMap, offset_m: tuple[float, float], mirrored: bool) -> dict[LaneKey, FloatArray]:
    """Return the middle (n, 3) of each lane for vehicles, world frame, in the direction of traffic."""
    lines = {}
    # netconvert takes the header's offset as a part of netOffset, and leaves x and y
    map_offset_m = np.array([*np.add(offset_m, road_map.offset_m[:2]), 0.0])
    for key in driving_lanes(road_map):
        road = road_map.roads[key.road]
        line = road.lane_line(road.sections[key.section], key.lane, mirrored=mirrored)
        line = line + map_offset_m
        lines[key] = line if key.lane < 0 else line[::-1]
    return lines


def _candidates_near(made: MadeNetwork, key: LaneKey, line_m: FloatArray) -> bool:
    """Return whether a lane of the network from this lane of the map is near its middle."""
    middle = shapely.points(line_m[len(line_m) // 2, :2])
    candidates = made.lanes.get((key.road, key.lane), ())
    return any(shapely.LineString(lane.shape_m[:, :2]).distance(middle) <= _AT_LANE_M for lane in candidates)


def _end_point(lines: Mapping[LaneKey, FloatArray], key: LaneKey) -> FloatArray | None:
    return lines[key][-1, :2] if key in lines else None


def _start_point(lines: Mapping[LaneKey, FloatArray], key: LaneKey) -> FloatArray | None:
    return lines[key][0, :2] if key in lines else None


def _lane_at(made: MadeNetwork, key: LaneKey, at_m: FloatArray | None, end: int) -> NetworkLane | None:
    """Return the lane of the network whose start (0) or end (-1) is nearest to a point; None if it is far away."""
    candidates = made.lanes.get((key.road, key.lane), ())
    if at_m is None or not candidates:
        return None
    distances = [float(np.hypot(*(lane.shape_m[end, :2] - at_m))) for lane in candidates]
    nearest = int(np.argmin(distances))
    return candidates[nearest] if distances[nearest] <= _AT_END_M else None


def _driving_lanes(made: MadeNetwork) -> Iterator[NetworkLane]:
    for lanes in made.lanes.values():
        yield from (lane for lane in lanes if lane.type in DRIVING_TYPES)


def _within_lanes(made: MadeNetwork) -> Iterator[Connection]:
    """Yield the connections that are joints of two pieces of one lane of the map, or not for vehicles."""
    origin = {}
    for key, lanes in made.lanes.items():
        for lane in lanes:
            if lane.type in DRIVING_TYPES:
                origin[lane.edge, lane.index] = key
    for connection in made.connections:
        source, target = origin.get(connection[:2]), origin.get(connection[2:])
        if source is None or target is None or source == target:
            yield connection


def _distances(made: MadeNetwork, lines: Mapping[LaneKey, FloatArray]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the largest distance of lanes of the network from those of the map, and of heights, by road."""
    points: dict[tuple[str, int], list[FloatArray]] = {}
    for key, line_m in lines.items():
        points.setdefault((key.road, key.lane), []).append(line_m)
    off_m: dict[str, float] = {}
    height_off_m: dict[str, float] = {}
    for origin, pieces in points.items():
        for lane in made.lanes.get(origin, ()):
            off, height_off = _distance(lane.shape_m, pieces)
            off_m[origin[0]] = max(off_m.get(origin[0], 0.0), off)
            height_off_m[origin[0]] = max(height_off_m.get(origin[0], 0.0), height_off)
    return off_m, height_off_m


def _distance(shape_m: FloatArray, pieces: list[FloatArray]) -> tuple[float, float]:
    """Return the largest distance of points (n, 3) from the nearest of some lines, and difference of heights."""
    line = shapely.MultiLineString([piece[:, :2] for piece in pieces])
    off_m = float(shapely.distance(shapely.points(shape_m[:, :2]), line).max())
    map_points = np.concatenate(pieces)
    from scipy.spatial import KDTree

    nearest = KDTree(map_points[:, :2]).query(shape_m[:, :2])[1]
    return off_m, float(np.abs(map_points[nearest, 2] - shape_m[:, 2]).max())


def _unlit_roads(made: MadeNetwork, road_map: OpenDriveMap) -> Iterator[str]:
    """Yield the roads with a signal, none of whose lanes leads to a traffic light, nor leads through one."""
    for road in road_map.roads.values():
        if any(signal.dynamic for signal in road.signals):
            is_lit = road.id in made.signal_roads or road.junction in made.signal_nodes
            if not is_lit:
                yield road.id
