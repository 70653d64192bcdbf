"""The arms of a junction: the roads for cars that meet there.

An arm is one road, whether it is a single edge, two edges in opposite directions, or the two carriageways of a divided
road, which reach other nodes. Lanes for turning that leave their road before the junction, or join it behind, belong to
its arm.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np
from shapely.geometry import LineString

from egvs.core.grid import XY
from egvs.traffic.network import Edge

_ARM_M = 30.0
"""The direction of an arm is that of the point at this distance along it, seen from the middle of the junction."""

_ARM_PER_SIZE = 3.0
"""The same, per distance of the road's end from the middle of a large junction."""

_SAME_ARM_DEG = 45.0
"""Two carriageways of the same name within this angle are one arm."""

_BESIDE_DEG = 20.0
"""One-way edges of the same direction within this angle, such as a lane for turning, are one arm."""

_MIN_CROSSING = 3


def group_arms(nodes: Collection[str], middle_m: XY, roads: Sequence[Edge]) -> list[list[Edge]]:
    """Return the arms of a junction, each with its edges at the junction.

    Edges to and from the same neighbouring node are one arm, and so are two carriageways of one street that lead in
    about the same direction.

    Parameters
    ----------
    nodes
        The junction's nodes.
    middle_m
        World-frame x, y of its middle.
    roads
        The edges that lead to or from it.

    Returns
    -------
    list of list of Edge
        In the order of their first edges in ``roads``.
    """
    by_neighbour: dict[str, list[Edge]] = {}
    for road in roads:
        neighbour = road.from_node if road.to_node in nodes else road.to_node
        by_neighbour.setdefault(neighbour, []).append(road)

    arms: list[list[Edge]] = []
    for edges in by_neighbour.values():
        other = next((arm for arm in arms if _are_carriageways(nodes, middle_m, arm, edges)), None)
        if other is None:
            arms.append(edges)
        else:
            other += edges
    whole = _join_turning_lanes(nodes, middle_m, arms)
    return whole if len(whole) >= _MIN_CROSSING else arms  # the ramp of a motorway stays an arm


def _join_turning_lanes(nodes: Collection[str], middle_m: XY, arms: Sequence[list[Edge]]) -> list[list[Edge]]:
    """Return the arms, with one-way arms beside a larger one joined to it."""
    joined: list[list[Edge]] = []
    for arm in sorted(arms, key=lambda arm: -sum(len(edge.lanes) for edge in arm)):
        is_entry = {edge.to_node in nodes for edge in arm}
        other = next((road for road in joined if _is_beside(nodes, middle_m, arm[0], road)), None)
        if len(is_entry) == 1 and other is not None:
            other += arm
        else:
            joined.append([*arm])
    return sorted(joined, key=lambda arm: arms.index(next(a for a in arms if a[0] is arm[0])))


def _is_beside(nodes: Collection[str], middle_m: XY, edge: Edge, road: Sequence[Edge]) -> bool:
    """Return whether an edge lies beside one of a road that leads in the same direction."""
    same_way = [other for other in road if (other.to_node in nodes) == (edge.to_node in nodes)]
    return any(_turned_deg(middle_m, edge, other) <= _BESIDE_DEG for other in same_way)


def _are_carriageways(nodes: Collection[str], middle_m: XY, arm: Sequence[Edge], other: Sequence[Edge]) -> bool:
    """Return whether all of one arm enters and all of the other one leaves, on the same street."""
    enters = {edge.to_node in nodes for edge in arm}
    other_enters = {edge.to_node in nodes for edge in other}
    if len(enters) != 1 or len(other_enters) != 1 or enters == other_enters:
        return False
    return is_same_street(middle_m, arm[0], other[0])


def is_same_street(middle_m: XY, edge: Edge, other: Edge) -> bool:
    """Return whether two edges have the same name and lead in about the same direction from a junction."""
    if edge.name != other.name:
        return False
    return _turned_deg(middle_m, edge, other) <= _SAME_ARM_DEG


def _turned_deg(middle_m: XY, edge: Edge, other: Edge) -> float:
    """Return the angle between two edges from a junction, 0 to 180 degrees."""
    turned_deg = _bearing_deg(middle_m, edge) - _bearing_deg(middle_m, other)
    return abs((turned_deg + 180.0) % 360.0 - 180.0)


def _bearing_deg(middle_m: XY, edge: Edge) -> float:
    """Return the direction of an edge from the middle of the junction, degrees counter-clockwise from east."""
    points = edge.lanes[0].shape_m[:, :2]
    ends_m = [math.dist(middle_m, points[index].tolist()) for index in (0, -1)]
    if ends_m[1] < ends_m[0]:
        points = points[::-1]
    point = LineString(points).interpolate(max(_ARM_M, _ARM_PER_SIZE * min(ends_m)))
    return float(np.degrees(np.arctan2(point.y - middle_m[1], point.x - middle_m[0])))
