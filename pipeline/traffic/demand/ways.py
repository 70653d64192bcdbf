"""Finds plausible ways over given places of a network, for one class of vehicle.

A way leads from where one can come from nowhere else (the fringe) to where one can go no further, the fastest way
before the place and after it. It is plausible when it is no detour: at most :data:`DETOUR` times as long as the fastest
way between the same ends, with no edge twice. Where no way over a place is, the shortest detours are taken.

Lengths of ways are seconds at the speed limit. A turnaround is no way on; where nothing of the fringe leads to a place,
ways start there, and likewise they end there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from pipeline.core.errors import InputError
from pipeline.scenario.traffic import TrafficModel
from pipeline.traffic.boxes import Floats, Ints
from pipeline.traffic.demand import trips
from pipeline.traffic.network import Network

DETOUR = 1.25
_DRAWS = 60
_KEPT = 24
_FEWEST = 4


@dataclass(frozen=True)
class Place:
    """Where vehicles are counted: an edge, or the edges from one to another; ids, and positions in the network."""

    edges: tuple[str, ...]
    indices: tuple[int, ...]

    def xml(self, vehicles: int) -> str:
        """As routeSampler reads it."""
        if len(self.edges) == 1:
            return f'    <edge id={quoteattr(self.edges[0])} entered="{vehicles}"/>'
        first, last = quoteattr(self.edges[0]), quoteattr(self.edges[-1])
        return f'    <edgeRelation from={first} to={last} count="{vehicles}"/>'


class Ways:
    """The ways of one vClass through a network."""

    def __init__(self, network: Network, vclass: str) -> None:
        self._network, self._vclass = network, vclass
        self._index = {edge.id: i for i, edge in enumerate(network.edges)}
        self._lanes = np.array([edge.lanes_for(vclass) for edge in network.edges], dtype=np.float64)
        links = network.links(vclass)
        self._links = links[links[:, 2] == 0]
        self._sources, self._sinks = trips.fringe(self._lanes, self._links)

    @cached_property
    def _pairs(self) -> set[tuple[int, int]]:
        return {(int(a), int(b)) for a, b in self._links[:, :2]}

    @cached_property
    def _graph(self) -> Any:
        """Seconds from the end of an edge to the end of the next."""
        from scipy.sparse import csr_array

        pairs = np.array(sorted(self._pairs), dtype=np.int64).reshape(-1, 2)
        seconds = np.array([max(edge.seconds, 1e-3) for edge in self._network.edges])
        size = self._lanes.size
        return csr_array((seconds[pairs[:, 1]], (pairs[:, 0], pairs[:, 1])), shape=(size, size))

    def may_drive(self, edges: Sequence[str]) -> bool:
        """Whether the class may use all these edges, one after another."""
        way = [self._index[edge] for edge in edges]
        return all(self._lanes[i] for i in way) and self._pairs.issuperset(pairwise(way))

    def place(self, first: str, last: str | None, where: str) -> Place:
        """The edge ``first``, or the fastest way from there to ``last``; InputError where there is none."""
        for edge in filter(None, (first, last)):
            if edge not in self._index:
                raise InputError(where, f"the network has no edge {edge!r}", "the id of an edge")
            if not self._lanes[self._index[edge]]:
                raise InputError(where, f"{self._vclass} may not use the edge {edge!r}", "an edge with a lane for it")
        start = self._index[first]
        way = [start] if last is None else self._between(start, self._index[last])
        if not way:
            raise InputError(where, f"no way leads from {first!r} to {last!r}", "an edge that can be reached from it")
        return Place(tuple(self._network.edges[i].id for i in way), tuple(way))

    def _between(self, start: int, end: int) -> list[int]:
        _, before = self._fastest([start])
        return _walk(before[0], end, start)[::-1]

    def _fastest(self, starts: Sequence[int], backward: bool = False) -> tuple[Floats, Ints]:
        """Seconds (starts, edges) from each start's end to each edge's end, and the edge before each on that way.

        Backward: from each edge's end to the start's, and the edge that comes next.
        """
        from scipy.sparse.csgraph import dijkstra

        graph = self._graph.T.tocsr() if backward else self._graph
        seconds, before = dijkstra(graph, indices=list(starts), return_predecessors=True)
        return seconds, before.astype(np.int64)

    def candidates(
        self, places: Sequence[Place], traffic: TrafficModel, rng: np.random.Generator, where: str
    ) -> list[tuple[str, ...]]:
        """Plausible ways over each of the places, each once; they start and end as drawn trips do."""
        likely = trips.weights(self._network, self._lanes, traffic, where)
        found: dict[tuple[int, ...], None] = {}
        for place in places:
            found.update(dict.fromkeys(self._over(place, likely, rng)))
        return [tuple(self._network.edges[i].id for i in way) for way in found]

    def _over(self, place: Place, likely: Floats, rng: np.random.Generator) -> list[tuple[int, ...]]:
        """Ways over one place."""
        first, last = place.indices[0], place.indices[-1]
        to_s, onward = (values[0] for values in self._fastest([first], backward=True))
        from_s, before = (values[0] for values in self._fastest([last]))
        sources = _reached(self._sources, to_s, likely, first)
        sinks = _reached(self._sinks, from_s, likely, last)
        starts, ends = (_drawn(ids, likely, rng) for ids in (sources, sinks))
        drawn = list(dict.fromkeys((int(s), int(t)) for s, t in zip(starts, ends, strict=True)))
        direct_s = self._direct_s(drawn)
        inner_s = sum(self._network.edges[i].seconds for i in place.indices[1:])
        ways = []
        for (start, end), fastest_s in zip(drawn, direct_s, strict=True):
            way = (*_walk(onward, start, first), *place.indices[1:], *_walk(before, end, last)[::-1][1:])
            seconds = to_s[start] + inner_s + from_s[end]
            back = self._network.edges[start].from_node == self._network.edges[end].to_node
            detour = 1.0 if seconds <= fastest_s else seconds / max(fastest_s, 1e-3)
            ways.append((len(set(way)) < len(way), back, detour, way))
        if good := [way for twice, back, detour, way in ways if not twice and not back and detour <= DETOUR]:
            return good[:_KEPT]
        return [way for *_, way in sorted(ways)[:_FEWEST]]

    def _direct_s(self, pairs: Sequence[tuple[int, int]]) -> list[float]:
        """Seconds of the fastest way between each pair of ends."""
        starts = sorted({start for start, _ in pairs})
        seconds, _ = self._fastest(starts)
        row = {start: i for i, start in enumerate(starts)}
        return [float(seconds[row[start], end]) for start, end in pairs]


def _reached(ends: Ints, seconds: Floats, likely: Floats, itself: int) -> list[int]:
    """Those of the fringe that are joined to a place and likely at all; the place itself where there is none."""
    return [int(i) for i in ends if np.isfinite(seconds[i]) and likely[i] > 0] or [itself]


def _drawn(ends: Sequence[int], likely: Floats, rng: np.random.Generator) -> Ints:
    """Ends by how likely they are; the place itself is taken even where no trip is to start or end."""
    share = likely[ends] if likely[ends].any() else np.ones(len(ends))
    drawn: Ints = np.asarray(ends)[np.searchsorted(np.cumsum(share) / share.sum(), rng.random(_DRAWS))]
    return drawn


def _walk(onward: Ints, start: int, end: int) -> list[int]:
    """From ``start``, always to ``onward`` of it, up to ``end``; empty where that leads elsewhere."""
    way = [start]
    while way[-1] != end:
        if (following := int(onward[way[-1]])) < 0:
            return []
        way.append(following)
    return way
