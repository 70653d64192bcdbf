"""Movements in words: "westbound on High Street, left to Station Road".

World frame, in plan: x east, y north, metres.
"""

from __future__ import annotations

import html

import numpy as np

from egvs.traffic.directions import TURNS, compass, lane_heading
from egvs.traffic.network import Edge, Network

_WAYS = {"straight": "straight on", "left": "left", "right": "right", "back": "U-turn"}
_UNNAMED_STREET = "an unnamed street"

_STRAIGHT_DEG, _BACK_DEG = 45.0, 135.0
"""Changes of direction that are not yet a turn, and more than a turn."""


class MovementNames:
    """Describes movements from one edge of a network to another.

    Parameters
    ----------
    network
        Its edges should have names (netconvert's ``--output.street-names``).
    """

    def __init__(self, network: Network) -> None:
        self._edges = {edge.id: edge for edge in network.edges}
        self._turns: dict[tuple[str, str], str] = {}
        for connection in network.connections:
            if connection.direction in TURNS:
                ends = network.edges[connection.source].id, network.edges[connection.target].id
                self._turns.setdefault(ends, TURNS[connection.direction])

    def describe(self, from_edge: str, to_edge: str | None) -> str:
        """Return a movement in words.

        The turn is SUMO's where a connection joins the edges, otherwise that of their directions.

        Parameters
        ----------
        from_edge
            Id of the edge of the approach.
        to_edge
            Id of the edge of the exit; None for all vehicles of the approach.

        Returns
        -------
        str
            For example ``"westbound on High Street, left to Station Road"``.
        """
        approach = self._edges[from_edge]
        words = f"{compass(lane_heading(approach.lanes[0], at_end=True))}bound on {_street(approach)}"
        if to_edge is None:
            return words
        way_out = self._edges[to_edge]
        turn = self._turns.get((from_edge, to_edge)) or _turn_between(approach, way_out)
        if turn == "straight" and approach.name == way_out.name:
            return f"{words}, straight on"
        return f"{words}, {_WAYS[turn]} to {_street(way_out)}"


def _street(edge: Edge) -> str:
    """Return the name of an edge's street on one line; netconvert escapes names twice."""
    printable = (character if character.isprintable() else " " for character in html.unescape(edge.name))
    return " ".join("".join(printable).split()) or _UNNAMED_STREET


def _turn_between(approach: Edge, way_out: Edge) -> str:
    """Return a value of :data:`TURNS` from the directions of two edges."""
    before = lane_heading(approach.lanes[0], at_end=True)
    after = lane_heading(way_out.lanes[0], at_end=False)
    cross = before[0] * after[1] - before[1] * after[0]
    turned_deg = float(np.degrees(np.arctan2(cross, before @ after)))
    if abs(turned_deg) <= _STRAIGHT_DEG:
        return "straight"
    if abs(turned_deg) > _BACK_DEG:
        return "back"
    return "left" if turned_deg > 0 else "right"
