"""Find the signalised junctions of an OpenStreetMap map, and let one signal govern each of them.

Mappers put signals at the stop lines, at the crossings of pedestrians, or at the nodes where streets meet. Steps:
leave out the signals that stand beside a junction (:func:`signals_at_stop_lines`), so that netconvert makes no junction
of a stop line; in its network, find the junctions that they govern, and join those that are one junction on the ground
(:func:`find_signals`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping
from itertools import combinations, pairwise
from typing import TYPE_CHECKING, NamedTuple

from egvs.creation.openstreetmap import distance_m
from egvs.formats.osm import OsmExtract, Tags

if TYPE_CHECKING:
    from egvs.creation.openstreetmap.street_turns import StreetEdge, StreetGraph

STOP_LINE_M = 40.0
"""Longest way from a signal to the junction that it governs."""

SAME_JUNCTION_M = 40.0
"""Longest distance between neighbouring nodes of a junction, such as those of two carriageways."""

LARGEST_M = 80.0
"""Longest distance between two nodes of a junction."""

_MIN_ARMS = 3
_CONTROLLED = re.compile(
    r'(?P<before><connection from="(?P<edge>[^"]*)"[^>]* tl="(?P<signal>[^"]*)" )linkIndex="(?P<index>\d+)"'
)


def is_signal(tags: Tags) -> bool:
    """Return whether a node has a traffic signal; at a crossing, for vehicles and pedestrians."""
    return "traffic_signals" in (tags.get("highway"), tags.get("crossing"))


def signals_at_stop_lines(extract: OsmExtract, roads: Collection[int], *, walk: bool) -> frozenset[int]:
    """Return the nodes with a signal that are no junctions, and whose signals are to be left out.

    Parameters
    ----------
    extract
        The map.
    roads
        Its ways for vehicles.
    walk
        Whether pedestrians may be simulated: signals of crossings away from junctions stay.
    """
    neighbours: dict[int, dict[int, float]] = {}
    for way in roads:
        nodes = [node for node in extract.ways[way].nodes if node in extract.nodes]
        for node, other in pairwise(nodes):
            length_m = distance_m(extract.nodes[node], extract.nodes[other])
            neighbours.setdefault(node, {})[other] = neighbours.setdefault(other, {})[node] = length_m
    signals = [node for node in neighbours if is_signal(extract.node_tags.get(node, {}))]
    beside = {node: _junctions_near(node, neighbours) for node in signals if len(neighbours[node]) < _MIN_ARMS}
    if not walk:
        return frozenset(beside)
    number: dict[int, int] = {node: 2 for node in signals if node not in beside}
    for near in beside.values():
        for junction in near:
            number[junction] = number.get(junction, 0) + 1
    return frozenset(node for node, near in beside.items() if any(number[junction] > 1 for junction in near))


def without_signal(tags: Tags) -> dict[str, str]:
    """Return the tags of a node without its signal."""
    return {key: value for key, value in tags.items() if value != "traffic_signals"}


def _junctions_near(start: int, neighbours: Mapping[int, Mapping[int, float]]) -> set[int]:
    """Return the nodes where at least three streets meet, on the way from a node to each side."""
    found: set[int] = set()
    queue = [(start, start, 0.0)]
    while queue:
        node, before, length_m = queue.pop()
        if len(neighbours[node]) >= _MIN_ARMS:
            found.add(node)
            continue
        for after, step_m in neighbours[node].items():
            if after not in (before, start) and length_m + step_m <= STOP_LINE_M:
                queue.append((after, node, length_m + step_m))
    return found


class MapSignals(NamedTuple):
    """The signals of a network.

    Attributes
    ----------
    nodes
        Signalised nodes of each junction, by the id of its signal.
    ungoverned
        Nodes of the network between a signal of the map and the junction that it governs.
    """

    nodes: Mapping[str, tuple[str, ...]]
    ungoverned: tuple[str, ...]


def find_signals(graph: StreetGraph) -> MapSignals:
    """Find the junctions of a network that signals of the map govern.

    A junction of three or more streets has signals if netconvert gave it some, or if the map has signals on at least
    half of its approaches, and on two or more. Signalised nodes near each other are one junction, except those
    of a roundabout.

    Parameters
    ----------
    graph
        The network and its map.
    """
    streets = _CarStreets(graph)
    governed, behind_signal = {*graph.signalised}, set()
    for node in sorted(streets.crossings - governed):
        approaches = streets.approaches[node]
        with_signal = sum(map(streets.has_signal, approaches))
        if with_signal >= 2 and 2 * with_signal >= len(approaches):
            governed.add(node)
        elif with_signal and len(approaches) > 1:
            behind_signal.add(node)

    nodes_m = graph.nodes_m(governed | behind_signal)
    distances_m = {(node, other): math.dist(nodes_m[node], nodes_m[other]) for node, other in combinations(nodes_m, 2)}
    near = sorted((length_m, *pair) for pair, length_m in distances_m.items() if length_m <= SAME_JUNCTION_M)
    junctions = {node: {node} for node in governed}
    for _, node, other in near:
        if governed.issuperset((node, other)) and not (graph.is_on_ring(node) or graph.is_on_ring(other)):
            joined = junctions[node] | junctions[other]
            if max(distances_m[pair] for pair in distances_m if joined.issuperset(pair)) <= LARGEST_M:
                junctions |= dict.fromkeys(joined, joined)
    groups = sorted({tuple(sorted(nodes)) for nodes in junctions.values()})
    signals = {"_".join(("signal", *nodes)) if len(nodes) > 1 else nodes[0]: nodes for nodes in groups}
    inside = {other for _, *pair in near for node, other in (pair, pair[::-1]) if node in governed}
    return MapSignals(signals, tuple(sorted(inside - governed)))


class _CarStreets:
    """The edges of a network on which cars may drive."""

    def __init__(self, graph: StreetGraph) -> None:
        self._graph = graph
        self.approaches: dict[str, list[StreetEdge]] = {}
        arms: dict[str, set[str]] = {}
        for edge in graph.edges.values():
            if edge.car_lanes:
                self.approaches.setdefault(edge.to_node, []).append(edge)
                arms.setdefault(edge.to_node, set()).add(edge.from_node)
                arms.setdefault(edge.from_node, set()).add(edge.to_node)
        self.crossings = {node for node, others in arms.items() if len(others) >= _MIN_ARMS and node in self.approaches}

    def has_signal(self, approach: StreetEdge) -> bool:
        """Return whether a signal stands on an approach, within :data:`STOP_LINE_M` of its end."""
        length_m = 0.0
        for edge in self._back(approach):
            for step in reversed(edge.steps):
                if self._graph.has_signal(self._graph.end_node(step)):
                    return True
                length_m += self._graph.length_m([step])
                if length_m > STOP_LINE_M:
                    return False
            if self._graph.has_signal(self._graph.start_node(edge.steps[0])):
                return True
        return False

    def _back(self, approach: StreetEdge) -> Iterator[StreetEdge]:
        """Yield an edge and those before it, as far as the next junction."""
        edge, visited = approach, set[str]()
        while edge.id not in visited:
            visited.add(edge.id)
            yield edge
            before = [other for other in self.approaches.get(edge.from_node, ()) if other.from_node != edge.to_node]
            if edge.from_node in self.crossings or len(before) != 1:
                return
            edge = before[0]


def number_crossings(text: str) -> str:
    """Return a network in which no crossing shares its position in a signal's states with another link.

    Where netconvert joins signals, crossings keep the positions of their former signal.
    """
    used: dict[str, set[int]] = {}
    for match in _CONTROLLED.finditer(text):
        if not match["edge"].startswith(":"):
            used.setdefault(match["signal"], set()).add(int(match["index"]))

    def renumber(match: re.Match[str]) -> str:
        if not match["edge"].startswith(":"):
            return match[0]
        indices = used.setdefault(match["signal"], set())
        index = int(match["index"])
        if index in indices:
            index = max(indices) + 1
        indices.add(index)
        return f'{match["before"]}linkIndex="{index}"'

    return _CONTROLLED.sub(renumber, text)
