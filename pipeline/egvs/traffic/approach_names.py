"""The one name of an approach: its street, and the side of the junction where it lies: "North Street (north)".

The approach from the north lies on the north side, and its vehicles drive south. Exits and crosswalks are named after
the arm that they belong to in the same way, so that counts, signal plans, zones, lanes and crosswalks of one arm share
one name.

A street between two nodes of one signal is no approach; its name ends with "inside".

**Side.** The nearest of eight compass points to the direction from the junction along the last :data:`HEADING_OVER_M`
of the road (of an exit: the first ones). A shorter road is followed back while a single road leads to it. At a
roundabout, the direction is that from the middle of its ring.

World frame, in plan: x east, y north, metres.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from egvs.core import polylines
from egvs.core.grid import FloatArray
from egvs.traffic.directions import arrival_side, compass
from egvs.traffic.network import TURNAROUNDS, Edge, Network

INSIDE = "inside"
ALIASES_OVER_M = 150.0
"""A street that becomes the approach within this distance of the junction is another name of the approach."""

HEADING_OVER_M = 30.0
"""The direction of a road at a junction is that of its last metres before it, or of its first ones after it."""


def approach_name(side: str, street: str) -> str:
    """Return the name of an approach.

    Parameters
    ----------
    side
        Side of the junction where it lies, a value of :data:`~egvs.traffic.directions.COMPASS`; may be empty.
    street
        Its street; may be empty.

    >>> approach_name("north", "North Street"), approach_name("north", ""), approach_name("", "North Street")
    ('North Street (north)', 'north', 'North Street')
    """
    return f"{street} ({side})" if street and side else street or side


def plain_text(name: str) -> str:
    """Return a name of a network on one line; netconvert escapes names twice."""
    printable = (character if character.isprintable() else " " for character in html.unescape(name))
    return " ".join("".join(printable).split())


def street_name(edge: Edge) -> str:
    """Return the street of an edge on one line: ``"slip road"`` for one without a name, else empty if it has none."""
    return plain_text(edge.name) or ("slip road" if edge.type.endswith("_link") else "")


class Arm(NamedTuple):
    """Side and street of an arm of a junction, and the id of the edge of its approach; each may be empty."""

    side: str
    street: str
    edge: str

    @property
    def name(self) -> str:
        """The name of its approach; "junction" where nothing is known."""
        return approach_name(self.side, self.street) or "junction"


class ApproachNames:
    """Names the approaches, exits and crosswalks of a network.

    Parameters
    ----------
    network
        Its edges should have names (netconvert's ``--output.street-names``).
    """

    def __init__(self, network: Network) -> None:
        self._edges = {edge.id: edge for edge in network.all_edges}
        self._nodes_m = {node.id: np.asarray(node.at_m) for node in network.junctions}
        self._groups = [*network.signal_groups.values()]
        self._rings = [frozenset(roundabout.nodes) for roundabout in network.roundabouts]
        before: dict[str, set[str]] = {}
        after: dict[str, set[str]] = {}
        for connection in network.connections:
            if connection.direction not in TURNAROUNDS:
                source, target = network.edges[connection.source].id, network.edges[connection.target].id
                before.setdefault(target, set()).add(source)
                after.setdefault(source, set()).add(target)
        self._previous = {edge: min(others) for edge, others in before.items() if len(others) == 1}
        self._next = {edge: min(others) for edge, others in after.items() if len(others) == 1}

    def heading(self, edge_id: str) -> FloatArray:
        """Return the direction (2,) in which vehicles arrive at the end of an edge, not normalised."""
        line_m = _joined(self._edges, edge_id, self._previous, backwards=True)
        edge = self._edges[edge_id]
        middle_m = self._ring_middle_m(edge.to_node, edge.from_node)
        junction_m = line_m[0] if middle_m is None else middle_m
        heading: FloatArray = junction_m - polylines.points_at(line_m, HEADING_OVER_M)[0]
        return heading

    def exit_heading(self, edge_id: str) -> FloatArray:
        """Return the direction (2,) in which vehicles leave a junction on an edge, not normalised."""
        line_m = _joined(self._edges, edge_id, self._next, backwards=False)
        edge = self._edges[edge_id]
        middle_m = self._ring_middle_m(edge.from_node, edge.to_node)
        junction_m = line_m[0] if middle_m is None else middle_m
        heading: FloatArray = polylines.points_at(line_m, HEADING_OVER_M)[0] - junction_m
        return heading

    def side(self, edge_id: str) -> str:
        """Return the side of its junction where an approach lies, a value of ``COMPASS``."""
        return arrival_side(self.heading(edge_id))

    def street(self, edge_id: str) -> str:
        """Return the street of an edge, see :func:`street_name`."""
        return street_name(self._edges[edge_id])

    def aliases(self, edge_id: str) -> tuple[str, ...]:
        """Return the other streets that lead to the end of an edge, while a single road does, the nearest first."""
        streets: dict[str, None] = {}
        length_m, edge, visited = 0.0, edge_id, {edge_id}
        while edge in self._previous and length_m <= ALIASES_OVER_M and self._previous[edge] not in visited:
            edge = self._previous[edge]
            visited.add(edge)
            streets[self.street(edge)] = None
            length_m += self._edges[edge].lanes[0].length_m
        return tuple(street for street in streets if street not in ("", self.street(edge_id)))

    def is_inside(self, edge_id: str) -> bool:
        """Return whether an edge leads from one node of a signal to another one."""
        ends = {self._edges[edge_id].from_node, self._edges[edge_id].to_node}
        return any(ends <= group for group in self._groups)

    def approach(self, edge_id: str) -> str:
        """Return the name of the approach that ends with an edge."""
        return self._marked(approach_name(self.side(edge_id), self.street(edge_id)), edge_id)

    def _marked(self, name: str, edge_id: str) -> str:
        return f"{name} {INSIDE}" if self.is_inside(edge_id) else name

    def exit(self, edge_id: str) -> str:
        """Return the name of the arm on which an edge leaves a junction."""
        return self._marked(approach_name(compass(self.exit_heading(edge_id)), self.street(edge_id)), edge_id)

    def crossed_arm(self, crossing_id: str) -> Arm:
        """Return the arm that a crossing crosses; where only its exit is crossed, the approach beside it."""
        crossing = self._edges[crossing_id]
        node = crossing_id.removeprefix(":").rpartition("_c")[0]
        crossed = [edge for edge in crossing.crossed_edges if edge in self._edges]
        for edge in crossed:
            if self._edges[edge].to_node == node:
                return Arm(self.side(edge), self.street(edge), edge)
        if crossed:
            edge = crossed[0]
            side = compass(self.exit_heading(edge))
            for beside in self._edges.values():
                if not beside.function and beside.to_node == node and self.side(beside.id) == side:
                    return Arm(side, self.street(beside.id), beside.id)
            return Arm(side, self.street(edge), "")
        lines_m = [lane.shape_m[:, :2].mean(axis=0) for lane in crossing.lanes if len(lane.shape_m)]
        if node in self._nodes_m and lines_m:
            return Arm(compass(np.mean(lines_m, axis=0) - self._nodes_m[node]), "", "")
        return Arm("", "", "")

    def crosswalk(self, crossing_id: str) -> str:
        """Return the name of a crossing, e.g. ``"North Street (north) crosswalk"``."""
        return f"{self.crossed_arm(crossing_id).name} crosswalk"

    def _ring_middle_m(self, node: str, other_node: str) -> FloatArray | None:
        """Return the middle of the roundabout at a node (2,), for an edge that is not a part of its ring."""
        for ring in self._rings:
            if node in ring and other_node not in ring:
                middle_m: FloatArray = np.mean([self._nodes_m[each] for each in sorted(ring)], axis=0)
                return middle_m
        return None


def _joined(edges: dict[str, Edge], edge_id: str, following: dict[str, str], *, backwards: bool) -> FloatArray:
    parts: list[FloatArray] = []
    length_m = 0.0
    visited: set[str] = set()
    next_id: str | None = edge_id
    while next_id is not None and next_id not in visited:
        visited.add(next_id)
        line_m = _middle_line(edges[next_id])
        parts.append(line_m[::-1] if backwards else line_m)
        length_m = float(polylines.stations_m(np.vstack(parts))[-1])
        next_id = following.get(next_id) if length_m < HEADING_OVER_M else None
    return np.vstack(parts)


def _middle_line(edge: Edge) -> FloatArray:
    """Return the first lane for vehicles of an edge in plan, or its first lane if it has none, (n, 2)."""
    lane = next((lane for lane in edge.lanes if not lane.is_pavement and len(lane.shape_m) > 1), edge.lanes[0])
    return lane.shape_m[:, :2]


def disambiguate_approaches(names: Sequence[str], ids: Sequence[str]) -> list[str]:
    """Return names of approaches that are all different; equal ones get the id of their edge.

    >>> disambiguate_approaches(["High Street (east)", "High Street (east)", "north"], ["a", "b", "c"])
    ['High Street (east), edge a', 'High Street (east), edge b', 'north']
    """
    return [f"{name}, edge {edge}" if names.count(name) > 1 else name for name, edge in zip(names, ids, strict=True)]
