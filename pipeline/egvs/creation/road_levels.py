"""Find what is above or below the streets of a junction: flyovers, bridges and tunnels.

The ground of a scenario is flat, so a road on another level would cross the streets of the junction at their height.
Steps of :func:`find_other_levels`: find the level of the junction's own streets, which is the ground; follow the roads
from the junction, the nearest first, and keep each unless it crosses one that is kept, on another level and without a
common node; leave out the roads that are not reached and are on another level, or cross a kept road on another level.

So a street that leaves the junction over a river is kept, although it is a bridge, and a junction on a bridge keeps its
streets and loses the motorway below.

The level of a way is its ``layer``; without one, it is 1 for a bridge, -1 for a tunnel, and 0 otherwise
(https://wiki.openstreetmap.org/wiki/Key:layer).

Frame: the network's x (east), y (north) in metres.
"""

from __future__ import annotations

import heapq
import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

from shapely.geometry import LineString, MultiPoint, Point
from shapely.geometry.base import BaseGeometry

from egvs.core.grid import XY
from egvs.creation.junctions import StreetJunction, Streets
from egvs.creation.openstreetmap import bounds_around, node_positions
from egvs.creation.openstreetmap.street_network import is_road
from egvs.formats.osm import OsmExtract, Tags, Way, parse_number

MARGIN_M = 20.0
"""How far from the region of interest roads are cut: more than half a carriageway, and than the region moves then."""

_RAILWAYS = frozenset({"rail", "light_rail", "subway", "tram", "narrow_gauge", "monorail"})
_SAME_NODE_M = 0.1
_EDGE_NAME = re.compile(r"-?(\d+)(?:#\d+)?")


@dataclass(frozen=True)
class OtherLevels:
    """Ways on other levels than the junction.

    Attributes
    ----------
    roads
        Roads for vehicles that are left out of the traffic in the region, sorted by identifier.
    decks
        Bridges above the region or its streets, of roads, railways and paths, sorted by identifier.
    """

    roads: tuple[Way, ...] = ()
    decks: tuple[Way, ...] = ()

    @property
    def road_titles(self) -> list[str]:
        """Description of each road, such as ``"High Street (bridge)"``, without repetitions."""
        return sorted({_title(way.tags) for way in self.roads})


def way_level(tags: Tags) -> int:
    """Return the level of a way, 0 for the ground.

    >>> way_level({"bridge": "yes"}), way_level({"tunnel": "yes", "layer": "-2"}), way_level({"highway": "primary"})
    (1, -2, 0)
    """
    layer = parse_number(tags.get("layer", ""))
    if layer is not None:
        return round(layer)
    if _is_bridge(tags):
        return 1
    if tags.get("tunnel", "no") not in ("no", "building_passage"):
        return -1
    return 0


def keep_levels_flags(extract: OsmExtract) -> list[str]:
    """Return flags with which netconvert does not merge bridges and tunnels with the streets before and after them.

    It merges pieces of a street under the name of the first. Names of edges that do not exist are ignored.
    """
    uses = Counter(node for way in extract.ways.values() if is_road(way) for node in {*way.nodes})
    names = []
    for way in extract.ways.values():
        if is_road(way) and way_level(way.tags):
            splits = sum(uses[node] > 1 or node in extract.node_tags for node in way.nodes)
            numbers = ["", *(f"#{number}" for number in range(splits + 1))]
            names += [f"{sign}{way.id}{number}" for sign in ("", "-") for number in numbers]
    return ["--geometry.remove.keep-edges.explicit", ",".join(names)] if names else []


def edge_levels(edges: Iterable[str], extract: OsmExtract) -> dict[str, int]:
    """Return the levels of edges of a network by id, without those on the ground.

    The network must be made with :func:`keep_levels_flags`; an edge is named after its way ("-12#3").
    """
    levels = {}
    for edge in edges:
        match = _EDGE_NAME.fullmatch(edge)
        way = extract.ways.get(int(match[1])) if match else None
        if way is not None and way_level(way.tags):
            levels[edge] = way_level(way.tags)
    return levels


def find_other_levels(
    extract: OsmExtract, streets: Streets, junction: StreetJunction, region: BaseGeometry
) -> OtherLevels:
    """Find the roads that cross a junction's region on another level, and the bridges above it.

    Parameters
    ----------
    extract
        The map.
    streets
        The network with the junction, for its frame.
    junction
        The junction; its identifier contains those of its nodes on the map.
    region
        The area to search.

    Returns
    -------
    OtherLevels
        Empty where all ways are on the junction's level, or lead to it.
    """
    area = bounds_around(streets, region)
    ways = [
        way
        for way in extract.ways.values()
        if (is_road(way) or _is_bridge(way.tags)) and way.tags.get("area") != "yes" and extract.is_near(way, area)
    ]
    xy = node_positions(extract, streets, {node for way in ways for node in way.nodes})
    pieces = {way.id: _WayInRegion(way, xy, region) for way in ways}
    nearby = {way_id: piece for way_id, piece in pieces.items() if not piece.line.is_empty}

    roads = {way_id: piece for way_id, piece in nearby.items() if is_road(piece.way)}
    nodes = {int(number) for number in re.findall(r"\d+", junction.id)}
    ground = _ground_level(roads, nodes)
    kept = _roads_of_junction(roads, nodes, ground)

    left_out = []
    decks = []
    for way_id, piece in nearby.items():
        if way_id in kept:
            continue
        crosses_street = any(piece.is_above_or_below(roads[other]) for other in kept)
        is_left_out = way_id in roads and (piece.level != ground or crosses_street)
        if is_left_out:
            left_out.append(piece.way)
        is_deck = _is_bridge(piece.way.tags) and piece.level > ground
        if is_deck and (is_left_out or (crosses_street and _is_in_use(piece.way.tags))):
            decks.append(piece.way)
    return OtherLevels(tuple(left_out), tuple(decks))


class _WayInRegion:
    """A way in the window around a region."""

    def __init__(self, way: Way, xy: Mapping[int, XY], window: BaseGeometry) -> None:
        self.way = way
        self.level = way_level(way.tags)
        self.nodes = [node for node in way.nodes if node in xy]
        self._xy = xy
        self._window = window

    @cached_property
    def line(self) -> BaseGeometry:
        """The part in the window."""
        if len(self.nodes) < 2:
            return LineString()
        return LineString([self._xy[node] for node in self.nodes]).intersection(self._window)

    @cached_property
    def distances_m(self) -> dict[int, float]:
        """Distance along the way of each node in the window."""
        distances_m: dict[int, float] = {}
        walked_m = 0.0
        previous = self._xy[self.nodes[0]]
        for node in self.nodes:
            walked_m += math.dist(previous, self._xy[node])
            previous = self._xy[node]
            if self._window.covers(Point(previous)):
                distances_m[node] = walked_m
        return distances_m

    def is_above_or_below(self, other: _WayInRegion) -> bool:
        """Return whether the two cross in the window on different levels, and not at a common node."""
        if self.level == other.level:
            return False
        crossing = self.line.intersection(other.line)
        common = [self._xy[node] for node in {*self.nodes} & {*other.nodes}]
        if common:
            crossing = crossing.difference(MultiPoint(common).buffer(_SAME_NODE_M))
        return not crossing.is_empty


def _ground_level(roads: Mapping[int, _WayInRegion], nodes: Collection[int]) -> int:
    """Return the level of most arms of a junction; 0 where they cannot be told."""
    arms: Counter[int] = Counter()
    for road in roads.values():
        for node in {*road.nodes}.intersection(nodes):
            arms[road.level] += 1 if node in (road.nodes[0], road.nodes[-1]) else 2
    return min(arms, key=lambda level: (-arms[level], abs(level), level), default=0)


def _roads_of_junction(roads: Mapping[int, _WayInRegion], nodes: Collection[int], ground: int) -> set[int]:
    """Return the roads that lead to a junction inside the window and cross no nearer one on another level."""
    roads_at_node: dict[int, list[int]] = {}
    for road_id, road in roads.items():
        for node in road.distances_m:
            roads_at_node.setdefault(node, []).append(road_id)

    queue: list[tuple[float, bool, int, int]] = []
    for node in sorted(nodes):
        for road_id in roads_at_node.get(node, []):
            queue.append((0.0, roads[road_id].level != ground, road_id, node))
    heapq.heapify(queue)

    kept: set[int] = set()
    visited: set[int] = set()
    while queue:
        distance_m, _, road_id, entry = heapq.heappop(queue)
        if road_id in visited:
            continue
        visited.add(road_id)
        road = roads[road_id]
        if any(road.is_above_or_below(roads[other]) for other in kept):
            continue
        kept.add(road_id)
        for node, at_m in road.distances_m.items():
            reached_m = distance_m + abs(at_m - road.distances_m[entry])
            for other in roads_at_node[node]:
                if other not in visited:
                    heapq.heappush(queue, (reached_m, roads[other].level != ground, other, node))
    return kept


def _is_bridge(tags: Tags) -> bool:
    return tags.get("bridge", "no") != "no"


def _is_in_use(tags: Tags) -> bool:
    """Return whether a way is a path or railway that exists."""
    if "highway" in tags:
        return tags["highway"] not in ("proposed", "construction")
    return tags.get("railway") in _RAILWAYS


def _title(tags: Tags) -> str:
    name = tags.get("name") or tags.get("ref") or f"a {tags['highway']} road"
    if _is_bridge(tags):
        return f"{name} (bridge)"
    if way_level(tags) < 0 and "tunnel" in tags:
        return f"{name} (tunnel)"
    return f"{name} (layer {way_level(tags)})"
