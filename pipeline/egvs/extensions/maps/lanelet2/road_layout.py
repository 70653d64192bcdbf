"""Roads, nodes and turns of a Lanelet2 map: what :func:`egvs.extensions.maps.lanelet2.roads.make_roads` finds.

Frame: x, y, z in metres of the world frame.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from egvs.core import polylines
from egvs.core.grid import FloatArray
from egvs.extensions.maps.formats.lanelet2_graph import DirectedLanelet, LaneletGraph, LaneletKey

APPROACH_M = 30.0
"""Lights and signs govern the next junction if it is nearer than this to the lanelets that refer to them."""


@dataclass(frozen=True)
class Road:
    """An edge of the network.

    Attributes
    ----------
    id
        Identifier.
    lanes
        Lane 0, at the kerb, first.
    start, end
        The nodes where it starts and ends.
    """

    id: str
    lanes: tuple[DirectedLanelet, ...]
    start: str = ""
    end: str = ""

    @property
    def length_m(self) -> float:
        """Mean length of its lanes, seen from above."""
        return float(np.mean([polylines.length_m(lane.center_m) for lane in self.lanes]))


@dataclass(frozen=True, eq=False)
class Turn:
    """A connection between two lanes.

    Attributes
    ----------
    source, source_lane, target, target_lane
        Identifiers of the roads, and indices of their lanes.
    path
        The inner lanelets between them.
    shape_m
        (n, 3) float64: the centre line of the path; empty where the lanes touch.
    """

    source: str
    source_lane: int
    target: str
    target_lane: int
    path: tuple[LaneletKey, ...]
    shape_m: FloatArray


@dataclass(frozen=True)
class RoadLayout:
    """Roads, nodes and turns of a map.

    Attributes
    ----------
    graph
        The lanelets, some of them cut.
    roads
        By identifier.
    inner
        The node of each inner lanelet.
    turns
        All permitted turns.
    unused
        Inner lanelets that no turn uses: their chain begins or ends in the junction.
    stubs
        The lanelets that begin or end inside a junction, a piece of which became a road.
    sidewalks
        The roads that get a sidewalk.
    """

    graph: LaneletGraph
    roads: dict[str, Road]
    inner: dict[LaneletKey, str]
    turns: tuple[Turn, ...]
    unused: tuple[LaneletKey, ...]
    stubs: tuple[LaneletKey, ...]
    sidewalks: frozenset[str] = frozenset()

    def sumo_lane(self, road: str, index: int) -> int:
        """Return SUMO's index of a lane: a sidewalk comes first."""
        return index + 1 if road in self.sidewalks else index

    @cached_property
    def turns_from(self) -> dict[tuple[str, int], list[Turn]]:
        """The turns from each lane, by road and lane."""
        turns: dict[tuple[str, int], list[Turn]] = defaultdict(list)
        for turn in self.turns:
            turns[turn.source, turn.source_lane].append(turn)
        return dict(turns)

    def turns_in_junction(self, turn: Turn) -> list[Turn]:
        """Return a turn, or those of the next junction within :data:`APPROACH_M` if it only leads to another road."""
        walked_m = 0.0
        while not turn.path:
            lane = self.roads[turn.target].lanes[turn.target_lane]
            walked_m += polylines.length_m(lane.center_m)
            following = self.turns_from.get((turn.target, turn.target_lane), [])
            if walked_m > APPROACH_M or not following:
                return []
            if len(following) > 1:
                return [other for other in following if other.path]
            turn = following[0]
        return [turn]

    def nodes(self) -> list[str]:
        """Return all nodes, sorted."""
        return sorted({node for road in self.roads.values() for node in (road.start, road.end)})
