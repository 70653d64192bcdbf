"""The roundabouts of a network: rings of short streets that make one junction.

netconvert finds the rings and lists their nodes and edges. :func:`find_rings` gives each its outline; a ring that fits
the largest region of interest is one junction, whose arms are the streets that enter or leave it (:func:`ring_arms`).

World frame, metres.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from egvs.core.grid import XY
from egvs.creation import arms
from egvs.traffic.network import Edge, Network


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
    """Return the arms of a roundabout (:func:`egvs.creation.arms.group_arms`); ``roads`` are the edges at its nodes."""
    return arms.group_arms(ring.nodes, ring.middle_m, [road for road in roads if road.id not in ring.edges])
