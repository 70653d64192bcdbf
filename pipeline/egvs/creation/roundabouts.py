"""The roundabouts of a network: rings of short streets that make one junction.

netconvert finds the rings and lists their nodes and edges. :func:`find_rings` gives each its outline; a ring that fits
the largest region of interest is one junction, whose arms are the streets that enter or leave it (:func:`ring_arms`).

World frame, metres.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from egvs.core.grid import XY
from egvs.traffic.network import Edge, Network

_ARM_M = 30.0
"""The direction of an arm is that of the point at this distance from the ring, seen from its middle."""

_SAME_ARM_DEG = 45.0
"""Two carriageways of the same name within this angle are one arm."""


@dataclass(frozen=True)
class Ring:
    """A roundabout.

    Attributes
    ----------
    nodes, edges
        Ids of its nodes and of the edges between them, sorted.
    area
        Carriageway and central island, seen from above.
    """

    nodes: tuple[str, ...]
    edges: tuple[str, ...]
    area: BaseGeometry

    @property
    def middle_m(self) -> XY:
        """Its middle, in whole centimetres."""
        center = self.area.centroid
        return round(center.x, 2), round(center.y, 2)

    @property
    def side_m(self) -> float:
        """The longer side of its bounding box."""
        x0, y0, x1, y1 = self.area.bounds
        return float(max(x1 - x0, y1 - y0))

    def bearing_deg(self, point_m: XY) -> float:
        """Return the direction of a point from the middle, counter-clockwise from east."""
        x, y = self.middle_m
        return float(np.degrees(np.arctan2(point_m[1] - y, point_m[0] - x)))


def find_rings(network: Network, areas: Mapping[str, BaseGeometry]) -> Iterator[Ring]:
    """Yield the roundabouts of a network.

    Parameters
    ----------
    network
        The network.
    areas
        The carriageway by edge id, inside junctions too.
    """
    edges = {edge.id: edge for edge in network.edges}
    junctions = {node.id: node for node in network.junctions}
    for roundabout in network.roundabouts:
        ring_edges = [edges[edge_id] for edge_id in roundabout.edges]
        pieces = [areas[edge.id] for edge in ring_edges]
        for node_id in roundabout.nodes:
            corners_m = junctions[node_id].shape_m[:, :2]
            if len(corners_m) >= 3:
                pieces.append(shapely.make_valid(Polygon(corners_m)))
        pieces.append(_island(ring_edges))
        yield Ring(tuple(sorted(roundabout.nodes)), tuple(sorted(roundabout.edges)), _without_holes(pieces))


def _island(ring_edges: Sequence[Edge]) -> BaseGeometry:
    """Return the area inside the middle lines of a ring, or, if they are not a ring, their convex hull."""
    by_start = {edge.from_node: edge for edge in ring_edges}
    start = ring_edges[0].from_node
    points: list[XY] = []
    node = start
    for _ in ring_edges:
        edge = by_start.get(node)
        if edge is None:
            break
        points += [(x, y) for x, y in edge.lanes[0].shape_m[:, :2].tolist()]
        node = edge.to_node
    if node == start and len(by_start) == len(ring_edges):
        return shapely.make_valid(Polygon(points))
    return shapely.MultiPoint(np.vstack([edge.lanes[0].shape_m[:, :2] for edge in ring_edges])).convex_hull


def _without_holes(pieces: Sequence[BaseGeometry]) -> BaseGeometry:
    """Return the union of areas with all holes filled."""
    union = shapely.union_all(pieces)
    return shapely.union_all([Polygon(part.exterior) for part in shapely.get_parts(union) if isinstance(part, Polygon)])


def ring_arms(ring: Ring, roads: Sequence[Edge]) -> list[list[Edge]]:
    """Return the arms of a roundabout, each with its edges at the ring.

    Edges to and from the same neighbouring node are one arm, and so are two carriageways of one street that lead in
    about the same direction.

    Parameters
    ----------
    ring
        The roundabout.
    roads
        The edges at its nodes.

    Returns
    -------
    list of list of Edge
        In the order of their first edges in ``roads``.
    """
    by_neighbour: dict[str, list[Edge]] = {}
    for road in roads:
        if road.id not in ring.edges:
            neighbour = road.from_node if road.to_node in ring.nodes else road.to_node
            by_neighbour.setdefault(neighbour, []).append(road)

    arms: list[list[Edge]] = []
    for edges in by_neighbour.values():
        other = next((arm for arm in arms if _are_carriageways(ring, arm, edges)), None)
        if other is None:
            arms.append(edges)
        else:
            other += edges
    return arms


def _are_carriageways(ring: Ring, arm: Sequence[Edge], other: Sequence[Edge]) -> bool:
    """Return whether all of one arm enters and all of the other one leaves, on the same street."""
    enters = {edge.to_node in ring.nodes for edge in arm}
    other_enters = {edge.to_node in ring.nodes for edge in other}
    if len(enters) != 1 or len(other_enters) != 1 or enters == other_enters:
        return False
    return is_same_street(ring, arm[0], other[0])


def is_same_street(ring: Ring, edge: Edge, other: Edge) -> bool:
    """Return whether two edges have the same name and lead in about the same direction from a roundabout."""
    if edge.name != other.name:
        return False
    turned_deg = ring.bearing_deg(_arm_point(ring, edge)) - ring.bearing_deg(_arm_point(ring, other))
    return abs((turned_deg + 180.0) % 360.0 - 180.0) <= _SAME_ARM_DEG


def _arm_point(ring: Ring, edge: Edge) -> XY:
    """Return the point of an edge some way from the ring, or its far end."""
    points = edge.lanes[0].shape_m[:, :2]
    ends = [math.dist(ring.middle_m, points[index].tolist()) for index in (0, -1)]
    if ends[1] < ends[0]:
        points = points[::-1]
    point = LineString(points).interpolate(_ARM_M)
    return point.x, point.y
