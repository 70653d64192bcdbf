"""Movements in words: "High Street (east), left to Station Road".

The approach is that at the junction (:mod:`egvs.traffic.approach_names`), not the edge of the count, which may be far
from it. All movements of one edge have the same approach: that of the movement that passes nearest to the middle of the
junction, as zones and signals name it. Their turn is the change of direction from the approach to the exit.

World frame, in plan: x east, y north, metres.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.scenario.traffic_config import CountConfig
from egvs.traffic.approach_names import ApproachNames, street_name
from egvs.traffic.demand import RouteFinder
from egvs.traffic.directions import TURNS, U_TURN
from egvs.traffic.network import CAR, Edge, Network

_WAYS = {"straight": "straight on", "left": "left", "right": "right", U_TURN: U_TURN}
_UNNAMED_STREET = "an unnamed street"

_STRAIGHT_DEG, _BACK_DEG = 45.0, 135.0
"""Changes of direction that are not yet a turn, and more than a turn."""


class _Passage(NamedTuple):
    """How a movement passes a junction: the edges to it and from it, and how far from its middle."""

    to_junction: Sequence[Edge]
    from_junction: Sequence[Edge]
    distance_m: float = math.inf


class Movement(NamedTuple):
    """A way through a junction.

    Attributes
    ----------
    approach
        The edges that lead to the junction, in the order of driving; at least one.
    street
        Name of the street of the approach at the junction; empty if it has none.
    heading
        Direction (2,) in which vehicles arrive at the junction, not normalised: x east, y north.
    turn
        A value of :data:`~egvs.traffic.directions.TURNS`; empty for all vehicles of an approach.
    aliases
        Other streets that lead to the approach.
    way_out
        Name of the street on which it leaves the junction; may be empty.
    """

    approach: tuple[Edge, ...]
    street: str
    heading: FloatArray
    turn: str
    aliases: tuple[str, ...] = ()
    way_out: str = ""


class MovementNames:
    """Describes movements from one edge of a network to another.

    Parameters
    ----------
    network
        Its edges should have names (netconvert's ``--output.street-names``).
    center_m
        x, y of the junction. Of the nodes on the way from one edge to the other, the nearest one is its node.
    flows
        All flows of the junction, from which movements of one edge get one approach.
    """

    def __init__(self, network: Network, center_m: tuple[float, float], flows: Iterable[CountConfig] = ()) -> None:
        self._center_m = center_m
        self._edges = {edge.id: edge for edge in network.edges}
        self._approaches = ApproachNames(network)
        self._nodes_m = {node.id: node.at_m for node in network.junctions}
        self._several_nodes = [set(ring.nodes) for ring in network.roundabouts] + [*network.signal_groups.values()]
        self._routes = RouteFinder(network, CAR)
        self._turns: dict[tuple[str, str], str] = {}
        for connection in network.connections:
            if connection.direction in TURNS:
                ends = network.edges[connection.source].id, network.edges[connection.target].id
                self._turns.setdefault(ends, TURNS[connection.direction])
        self._passages: dict[tuple[str, str], _Passage] = {}
        self._nearest: dict[str, _Passage] = {}
        self._ways: dict[str, list[Edge]] = {}
        for flow in flows:
            if flow.from_edge is not None and flow.to_edge is not None:
                passage = self._passage(flow.from_edge, flow.to_edge)
                self._ways.setdefault(flow.from_edge, []).extend(passage.to_junction)
                former = self._nearest.setdefault(flow.from_edge, passage)
                if passage.distance_m < former.distance_m:
                    self._nearest[flow.from_edge] = passage

    def describe(self, from_edge: str, to_edge: str | None) -> str:
        """Return a movement in words.

        The turn is SUMO's where a connection joins the edges at the junction, otherwise that of their directions.

        Parameters
        ----------
        from_edge
            Id of the edge of the approach.
        to_edge
            Id of the edge of the exit; None for all vehicles of the approach.

        Returns
        -------
        str
            For example ``"High Street (east), left to Station Road"``.
        """
        if to_edge is None:
            edges = self._edges_to_junction(from_edge)
            return self._approaches.approach(edges[-1].id)

        passage = self._passage(from_edge, to_edge)
        approach, way_out = self._approach(passage), passage.from_junction[0]
        words = self._approaches.approach(approach.id)
        turn = self._turn(passage)
        last = passage.from_junction[-1]
        towards = f" towards {_street(last)}" if last.name not in ("", way_out.name) else ""
        if turn == "straight" and approach.name == way_out.name:
            return f"{words}, straight on{towards}"
        return f"{words}, {_WAYS[turn]} to {_street(way_out)}{towards}"

    def movement(self, from_edge: str, to_edge: str | None) -> Movement:
        """Return approach and turn of a movement; parameters as of :meth:`describe`."""
        edges, turn, way_out = self._edges_to_junction(from_edge), "", ""
        if to_edge is not None:
            passage = self._passage(from_edge, to_edge)
            edges, turn = tuple(self._nearest.get(from_edge, passage).to_junction), self._turn(passage)
            way_out = self._approaches.street(passage.from_junction[0].id)
        last = edges[-1].id
        ways = self._ways.get(from_edge, edges)
        aliases = [self._approaches.street(edge.id) for edge in ways] + [*self._approaches.aliases(last)]
        street = self._approaches.street(last)
        others = tuple(dict.fromkeys(name for name in aliases if name not in ("", street)))
        return Movement(edges, street, self._approaches.heading(last), turn, others, way_out)

    def _edges_to_junction(self, from_edge: str) -> tuple[Edge, ...]:
        if from_edge in self._nearest:
            return tuple(self._nearest[from_edge].to_junction)
        return (self._edges[from_edge],)

    def _turn(self, passage: _Passage) -> str:
        """Return SUMO's turn where a connection joins the edges at the junction, otherwise that of their directions."""
        ends = self._approach(passage).id, passage.from_junction[0].id
        if ends in self._turns:
            return self._turns[ends]
        return _turn_between(self._approaches.heading(ends[0]), self._approaches.exit_heading(ends[1]))

    def _approach(self, passage: _Passage) -> Edge:
        """Return the edge whose name the approach of a movement has."""
        return self._nearest.get(passage.to_junction[0].id, passage).to_junction[-1]

    def _passage(self, from_edge: str, to_edge: str) -> _Passage:
        """Find the junction on the fastest way between two edges."""
        if (from_edge, to_edge) not in self._passages:
            self._passages[from_edge, to_edge] = self._find_passage(from_edge, to_edge)
        return self._passages[from_edge, to_edge]

    def _find_passage(self, from_edge: str, to_edge: str) -> _Passage:
        try:
            ids = self._routes.locate(from_edge, to_edge, "movement").edges
        except InputError:  # cars may not drive there: the two edges describe the movement
            return _Passage([self._edges[from_edge]], [self._edges[to_edge]])
        way = [self._edges[edge_id] for edge_id in ids]
        nodes = [edge.to_node for edge in way[:-1]]
        distances_m = [math.dist(self._nodes_m[node], self._center_m) for node in nodes]
        distance_m = min(distances_m)
        nearest = distances_m.index(distance_m)

        for ring in self._several_nodes:
            if nodes[nearest] in ring:
                on_ring = [index for index, node in enumerate(nodes) if node in ring]
                return _Passage(way[: on_ring[0] + 1], way[on_ring[-1] + 1 :], distance_m)
        return _Passage(way[: nearest + 1], way[nearest + 1 :], distance_m)


def _street(edge: Edge) -> str:
    """Return the name of an edge's street on one line."""
    return street_name(edge) or _UNNAMED_STREET


def _turn_between(before: FloatArray, after: FloatArray) -> str:
    """Return a value of :data:`TURNS` from two directions, (2,) each."""
    cross = before[0] * after[1] - before[1] * after[0]
    turned_deg = float(np.degrees(np.arctan2(cross, before @ after)))
    if abs(turned_deg) <= _STRAIGHT_DEG:
        return "straight"
    if abs(turned_deg) > _BACK_DEG:
        return U_TURN
    return "left" if turned_deg > 0 else "right"
