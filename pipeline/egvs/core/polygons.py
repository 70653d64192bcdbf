"""Polygons of a user's file: repair rings that cross, touch or overlap, within limits.

GEOS's own repair (``make_valid`` with the method ``linework``) gives the same areas, but takes 14 s for 300 random
corners, since it removes one layer of a crossing ring after another. Here the layers are counted instead.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from egvs.core import limits
from egvs.core.grid import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

# pairs per edge that are not counted, since their time grows with the size of the file only
_FREE_PAIRS, _FREE_WIDENED_PAIRS = 2, 5
# edges or rings that are compared with all others at once: bounds the memory
_BOXES_AT_ONCE = 64
# pairs of boxes of edges that are looked at to find one crossing
_BOXES_OF_CROSSING = 50
# share of a radius within which GEOS simplifies a line before it widens it
_DETAIL = 0.01
_POINTS_OF_PIECE = 200


@dataclass
class PairCount:
    """Pairs of edges that were compared to repair, widen or join the geometries of one file.

    Attributes
    ----------
    file
        The file, for messages.
    pairs
        The pairs so far, by what they are of, and by the factor of their limit.
    """

    file: object = ""
    pairs: Counter[tuple[str, float]] = field(default_factory=Counter)


def repair_polygon(shape: BaseGeometry, where: object, count: PairCount | None = None) -> BaseGeometry:
    """Return the area that the rings of a polygon enclose, by the even-odd rule, or all polygons of a shape together.

    A part of the plane belongs to a polygon if an odd number of edges separates it from the outside; edges on top of
    each other count as one. Polygons that overlap or share edges are joined. What has no area is left out. A valid
    shape is returned as it is.

    Parameters
    ----------
    shape
        Polygons, with finite coordinates.
    where
        File and feature, for messages.
    count
        Pairs of edges of the same file so far, to which those of this shape are added.

    Raises
    ------
    InputError
        When the shape has too many corners, or the repair would take long (:func:`check_edge_pairs`).
    """
    import shapely

    check_corners(shape, where)
    if shapely.is_valid(shape):
        return shape
    count = PairCount() if count is None else count
    polygons = [_repair_rings(polygon, where, count) for polygon in shapely.get_parts(shape)]
    if len(polygons) == 1:
        return polygons[0]
    check_crossings(polygons, where, count)
    return shapely.union_all(polygons)


def _repair_rings(polygon: BaseGeometry, where: object, count: PairCount) -> BaseGeometry:
    """Return the area that the rings of one polygon enclose."""
    import shapely
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    if shapely.is_valid(polygon):
        return polygon
    check_edge_pairs(polygon, where, count=count)
    lines = shapely.union_all([shapely.LineString(ring) for ring in shapely.get_rings(polygon)])
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
    return shapely.coverage_union_all(parts[edges_to_outside % 2 == 1])


def _sides(parts: NDArray[Any]) -> tuple[IntArray, IntArray]:
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


def check_corners(shape: BaseGeometry, where: object, factor: int = 1) -> None:
    """Raise an InputError when a polygon, with its holes, or a line has more corners than the limit times a factor."""
    import shapely

    if shapely.get_num_coordinates(shape) <= factor * limits.CORNERS.maximum:
        return
    parts = shapely.get_parts(shapely.get_parts(shape))
    is_polygon = shapely.get_type_id(parts) == shapely.GeometryType.POLYGON
    # a ring repeats its first corner at its end
    rings = np.where(is_polygon, shapely.get_num_interior_rings(parts) + 1, 0)
    corners = (shapely.get_num_coordinates(parts) - rings).max(initial=0)
    if corners > factor * limits.CORNERS.maximum:
        limits.CORNERS.check(where, corners)


def check_edge_pairs(shape: BaseGeometry, where: object, radius_m: float = 0.0, count: PairCount | None = None) -> None:
    """Raise an InputError when many edges of a shape, with those of the same file so far, are side by side.

    Memory and time to repair or to widen the shape grow with the number of their crossings, of which a few kilobytes of
    corners can have billions. Counted are pairs of edges (of points, if it has no edges) whose boxes, widened by
    ``radius_m``, overlap; twice if they are widened, since an edge then has two sides. A few pairs for each edge
    are free.
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
    low = np.minimum(starts, ends) - radius_m
    high = np.maximum(starts, ends) + radius_m
    boxes = shapely.box(*low.T, *high.T)
    most, free = (0.5, _FREE_WIDENED_PAIRS) if radius_m else (1.0, _FREE_PAIRS)
    _count_pairs(boxes, where, count, "pairs of edges side by side", most=most, free=free)


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


def check_crossings(shapes: Iterable[BaseGeometry], where: object, count: PairCount | None = None) -> None:
    """Raise an InputError when so many edges of shapes cross that it would take long to join or subtract the shapes.

    Edges that touch or overlap, as those of tiles do, do not count, and a few pairs for each edge are free.
    """
    import shapely

    lines = shapely.get_parts([shape.boundary if "Polygon" in shape.geom_type else shape for shape in shapes])
    points, line = shapely.get_coordinates(lines, return_index=True)
    is_edge = line[1:] == line[:-1]
    starts, ends = points[:-1][is_edge], points[1:][is_edge]
    boxes = shapely.box(*np.minimum(starts, ends).T, *np.maximum(starts, ends).T)

    def cross(one: IntArray, other: IntArray) -> BoolArray:
        return _are_separated(starts[one], ends[one], starts[other], ends[other]) & _are_separated(
            starts[other], ends[other], starts[one], ends[one]
        )

    what = "pairs of edges that cross"
    _count_pairs(boxes, where, count, what, most=_BOXES_OF_CROSSING)
    _count_pairs(boxes, where, count, what, is_counted=cross)


def _are_separated(start: FloatArray, end: FloatArray, one: FloatArray, other: FloatArray) -> BoolArray:
    """Return for each line (n, 2) from start to end whether two points (n, 2) are on different sides of it."""
    direction = end - start
    side_of_one = direction[:, 0] * (one - start)[:, 1] - direction[:, 1] * (one - start)[:, 0]
    side_of_other = direction[:, 0] * (other - start)[:, 1] - direction[:, 1] * (other - start)[:, 0]
    return np.sign(side_of_one) * np.sign(side_of_other) < 0


def _count_pairs(
    boxes: NDArray[Any], where: object, count: PairCount | None, what: str, *,
    free: int = _FREE_PAIRS, most: float = 1.0,
    is_counted: Callable[[IntArray, IntArray], BoolArray] | None = None,
) -> None:  # fmt: skip
    """Add the pairs of boxes that overlap, apart from those that follow each other, to those of a file.

    Parameters
    ----------
    boxes
        Those of edges.
    where, what
        Feature, and what has the limit, for messages.
    count
        Pairs of the file so far.
    free
        How much per box is not counted.
    most
        Factor of the limit.
    is_counted
        Whether pairs count, given the numbers of both; all by default.

    Raises
    ------
    InputError
        When the pairs exceed the limit.
    """
    import shapely

    limit = limits.EDGE_PAIRS
    uncounted = free * len(boxes)
    if len(boxes) ** 2 // 2 <= uncounted:
        return
    count = PairCount() if count is None else count
    before = count.pairs[what, most]
    tree = shapely.STRtree(boxes)
    pairs = 0
    for start in range(0, len(boxes), _BOXES_AT_ONCE):
        one, other = tree.query(boxes[start : start + _BOXES_AT_ONCE])
        one += start
        one, other = one[other > one + 1], other[other > one + 1]
        pairs += len(one) if is_counted is None else int(np.count_nonzero(is_counted(one, other)))
        if before + max(pairs - uncounted, 0) > most * limit.maximum:
            has = "has, with those before it in the file," if before else "has"
            limit.check(where, limit.maximum + 1, f"{has} more than {limit.maximum:,} {what}")
    count.pairs[what, most] = before + max(pairs - uncounted, 0)
