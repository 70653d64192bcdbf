"""Polygons of a user's file: repair rings that cross, touch or overlap, within limits.

GEOS's own repair (``make_valid`` with the method ``linework``) gives the same areas, but takes 14 s for 300 random
corners, since it removes one layer of a crossing ring after another. Here the layers are counted instead.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from egvs.core import limits
from egvs.core.limits import Limit

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

# edges or rings that are compared with all others at once: bounds the memory
_BOXES_AT_ONCE = 64
# pairs of boxes of edges that are looked at to find one crossing
_BOXES_OF_CROSSING = 50
# share of a radius within which GEOS simplifies a line before it widens it
_DETAIL = 0.01
_POINTS_OF_PIECE = 200


def repair_polygon(shape: BaseGeometry, where: object) -> BaseGeometry:
    """Return the area that the rings of a shape enclose, by the even-odd rule.

    A part of the plane belongs to it if an odd number of edges separates it from the outside; edges on top of each
    other count as one. What has no area is left out. A valid shape is returned as it is.

    Parameters
    ----------
    shape
        Polygons, with finite coordinates.
    where
        File and feature, for messages.

    Raises
    ------
    InputError
        When the repair would take long (:func:`check_edge_pairs`).
    """
    import shapely
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    if shapely.is_valid(shape):
        return shape
    check_edge_pairs(shape, where)
    rings = shapely.get_rings(shapely.get_parts(shape))
    _check_nesting(rings, where)
    lines = shapely.union_all([shapely.LineString(ring) for ring in rings])
    parts = shapely.get_parts(shapely.polygonize(shapely.get_parts(lines)))
    if len(parts) == 0:
        return shapely.MultiPolygon()
    part_of_side, edge_of_side = _sides(parts)
    # the sides of an edge follow each other: two parts, or one part and the outside
    is_pair = edge_of_side[1:] == edge_of_side[:-1]
    is_outer = (np.bincount(edge_of_side) == 1)[edge_of_side]
    outside = len(parts)
    first = np.concatenate([part_of_side[:-1][is_pair], part_of_side[is_outer]])
    second = np.concatenate([part_of_side[1:][is_pair], np.full(np.count_nonzero(is_outer), outside)])
    neighbours = coo_array((np.ones(len(first)), (first, second)), shape=(outside + 1, outside + 1)).tocsr()
    edges_to_outside = dijkstra(neighbours, directed=False, unweighted=True, indices=outside)[:outside]
    area: BaseGeometry = shapely.coverage_union_all(parts[edges_to_outside % 2 == 1])
    return area


def _sides(parts: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return, for each side of each edge, its part and its edge, sorted by edges."""
    import shapely

    rings, part_of_ring = shapely.get_rings(parts, return_index=True)
    points, ring = shapely.get_coordinates(rings, return_index=True)
    is_edge = ring[1:] == ring[:-1]
    starts, ends = points[:-1][is_edge], points[1:][is_edge]
    is_reversed = (starts[:, 0] > ends[:, 0]) | ((starts[:, 0] == ends[:, 0]) & (starts[:, 1] > ends[:, 1]))
    starts, ends = (
        np.where(is_reversed[:, None], ends, starts),
        np.where(is_reversed[:, None], starts, ends),
    )
    edge = np.unique(np.column_stack([starts, ends]), axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(edge, kind="stable")
    return part_of_ring[ring[:-1][is_edge]][order], edge[order]


def check_corners(shape: BaseGeometry, where: object) -> None:
    """Raise an InputError when a polygon has many holes, or a ring of it many corners."""
    import shapely

    polygons = shapely.get_parts(shapely.get_parts(shape))
    limits.HOLES.check(where, shapely.get_num_interior_rings(polygons).max(initial=0))
    areas = polygons[shapely.get_type_id(polygons) == shapely.GeometryType.POLYGON]
    limits.CORNERS.check(where, (shapely.get_num_coordinates(shapely.get_rings(areas)) - 1).max(initial=0))


def check_edge_pairs(shape: BaseGeometry, where: object, radius_m: float = 0.0) -> None:
    """Raise an InputError when many edges of a shape are side by side.

    Memory and time to repair or to widen the shape grow with the number of their crossings, of which a few kilobytes of
    corners can have billions. Counted are pairs of edges (of points, if it has no edges) whose boxes, widened by
    ``radius_m``, overlap; twice if they are widened, since an edge then has two sides.
    """
    import shapely

    parts = shapely.get_parts(shape)
    if "Polygon" in shape.geom_type:
        parts = shapely.get_rings(parts)
    elif "Point" not in shape.geom_type and radius_m:
        parts = _without_details(parts, _DETAIL * radius_m)
    points, part = shapely.get_coordinates(parts, return_index=True)
    starts = ends = points
    if "Point" not in shape.geom_type:
        is_edge = part[1:] == part[:-1]
        starts, ends = points[:-1][is_edge], points[1:][is_edge]
    most = limits.EDGE_PAIRS.maximum // 2 if radius_m else limits.EDGE_PAIRS.maximum
    if len(starts) ** 2 // 2 <= most:
        return
    low = np.minimum(starts, ends) - radius_m
    high = np.maximum(starts, ends) + radius_m
    actual = f"has more than {limits.EDGE_PAIRS.maximum:,} pairs of edges side by side"
    _check_pairs(shapely.box(*low.T, *high.T), limits.EDGE_PAIRS, most, 1, where, actual)


def _without_details(lines: NDArray[Any], tolerance_m: float) -> NDArray[Any]:
    """Return lines without the points that GEOS leaves out before it widens them, in pieces."""
    import shapely

    # the time to simplify a line can grow with the square of its points
    pieces = [
        shapely.LineString(points[start : start + _POINTS_OF_PIECE + 1])
        for points in map(shapely.get_coordinates, lines)
        for start in range(0, len(points) - 1, _POINTS_OF_PIECE)
    ]
    simple: NDArray[Any] = shapely.simplify(pieces, tolerance_m, preserve_topology=False)
    return simple


def check_crossings(shapes: Iterable[BaseGeometry], where: object) -> None:
    """Raise an InputError when so many edges of shapes cross that it would take long to join or subtract the shapes.

    Edges that touch or overlap, as those of tiles do, do not count.
    """
    import shapely

    lines = shapely.get_parts([shape.boundary if "Polygon" in shape.geom_type else shape for shape in shapes])
    points, line = shapely.get_coordinates(lines, return_index=True)
    is_edge = line[1:] == line[:-1]
    edges = shapely.linestrings(np.stack([points[:-1][is_edge], points[1:][is_edge]], axis=1))
    most = limits.EDGE_PAIRS.maximum
    if len(edges) ** 2 // 2 <= most:
        return
    actual = f"has more than {most:,} pairs of edges that cross"
    _check_pairs(edges, limits.EDGE_PAIRS, _BOXES_OF_CROSSING * most, 1, where, actual)
    _check_pairs(edges, limits.EDGE_PAIRS, most, 1, where, actual, "crosses")


def _check_nesting(rings: NDArray[Any], where: object) -> None:
    """Raise an InputError when many rings are inside others: each is compared with all of these."""
    import shapely

    boxes = shapely.box(*shapely.bounds(rings).T)
    count = limits.HOLES.maximum
    actual = f"has rings that do not fit together, more than {count:,} of them inside each other"
    _check_pairs(boxes, limits.HOLES, count**2 // 2, 0, where, actual)


def _check_pairs(
    shapes: NDArray[Any], limit: Limit, most: int, neighbours: int, where: object, actual: str,
    predicate: Literal["crosses"] | None = None,
) -> None:  # fmt: skip
    """Raise an InputError when more than ``most`` pairs of boxes overlap, apart from those that follow each other.

    With a predicate, the shapes in the boxes are compared.
    """
    import shapely

    tree = shapely.STRtree(shapes)
    pairs = 0
    for start in range(0, len(shapes), _BOXES_AT_ONCE):
        one, other = tree.query(shapes[start : start + _BOXES_AT_ONCE], predicate=predicate)
        pairs += int(np.count_nonzero(other > one + start + neighbours))
        if pairs > most:
            limit.check(where, limit.maximum + 1, actual)
