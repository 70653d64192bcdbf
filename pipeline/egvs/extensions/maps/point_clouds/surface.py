"""Triangulate a point cloud: a ground surface, and small rectangles ("surfels") on everything else.

Steps of :func:`triangulate_cloud`: tell ground points from others (:func:`is_ground`); triangulate the means of the
ground points in cells of half a metre (:func:`triangulate_ground`); thin the other points and put a rectangle on each
(:func:`make_surfels`). World frame (x east, y north, z up), metres.

Ground filter: the lowest point of each cell of 1 m; grey openings of that height map with windows of 3 to 41 cells
remove what stands out by more than 0.25 m and is narrower than the window. Source: Zhang et al. 2003, "A progressive
morphological filter for removing nonground measurements from airborne LIDAR data", IEEE TGRS 41(4), 872-882, with one
threshold for all windows, after a plane has been subtracted.

Surfels: oriented discs in Pfister et al. 2000, "Surfels: surface elements as rendering primitives", SIGGRAPH. Here they
are rectangles: across the local normal (the direction in which 16 neighbours vary least), along the direction in which
they vary most. On each of its four sides a rectangle extends 0.6 of the distance to the sixth neighbour, but no farther
than the neighbours reach, so that walls and poles do not grow beyond their edges.

Limits: the ground continues under buildings and through places that no beam reached; closed surfaces come out as open
ones.

Coordinates are rounded to 0.1 mm, so that last bits of eigenvectors do not change the result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.world.terrain import triangulate

GROUND_CELL_M = 0.5
"""Ground vertices: one in each cell of this size."""

SURFEL_SPACING_M = 0.15
"""Other points are thinned to one in each cube of this size."""

FILTER_CELL_M = 1.0
MAX_WINDOW_CELLS = 41
STEP_M = 0.25
"""Points that are higher above the ground than this are objects."""
PIT_M = 1.0
"""Cells that are deeper below their neighbours than this hold a false return."""

NEIGHBOURS = 16
SIZE_NEIGHBOUR = 6
SIZE_FACTOR = 0.75
MIN_SIDE_M, MAX_SIDE_M, MIN_REACH_M = 0.08, 0.6, 0.02

SKIPPED_NEIGHBOURS = 3

_PLANE_FITS = 6
_DIGITS = 4
_BLOCK = 50_000


@dataclass(frozen=True)
class TriangleSurface:
    """An open triangle mesh.

    Attributes
    ----------
    vertices_m
        (n, 3) float64, world frame, rounded to 0.1 mm.
    faces
        (m, 3) int64.
    """

    vertices_m: FloatArray
    faces: IntArray


@dataclass(frozen=True)
class CloudSurface:
    """The surface of a point cloud.

    Attributes
    ----------
    ground
        The triangulated ground; no faces where fewer than three cells have ground points.
    objects
        Surfels on everything else, two triangles each.
    ground_points
        Number of points on the ground.
    """

    ground: TriangleSurface
    objects: TriangleSurface
    ground_points: int


def triangulate_cloud(points_m: FloatArray, spacing_m: float = SURFEL_SPACING_M) -> CloudSurface:
    """Triangulate a point cloud.

    Parameters
    ----------
    points_m
        Finite points, (n, 3) float64, in any order; without moving objects.
    spacing_m
        Edge length of the cubes that thin the points above the ground.

    Returns
    -------
    CloudSurface
        Equal points in equal order give equal bytes.
    """
    ground = is_ground(points_m)
    objects = thin_points(points_m[~ground], spacing_m)
    return CloudSurface(triangulate_ground(points_m[ground]), make_surfels(objects), int(np.count_nonzero(ground)))


def thin_points(points_m: FloatArray, cell_m: float) -> FloatArray:
    """Return the mean of the points (n, 3) in each cube with edges of ``cell_m``, sorted by cube."""
    cells = np.floor(points_m / cell_m).astype(np.int64)
    return _means_by_cell(points_m, cells)


def is_ground(points_m: FloatArray) -> BoolArray:
    """Return which points (n, 3) lie on the ground, (n,) bool.

    A point is on the ground when the lowest point of its cell survives all openings, and it is at most ``STEP_M`` above
    that.
    """
    if not len(points_m):
        return np.zeros(0, dtype=np.bool_)
    low = np.floor(points_m[:, :2].min(axis=0) / FILTER_CELL_M)
    column, row = (np.floor(points_m[:, :2] / FILTER_CELL_M) - low).astype(np.int64).T
    heights = np.full((column.max() + 1, row.max() + 1), np.inf)
    np.minimum.at(heights, (column, row), points_m[:, 2])
    is_pit = _pits(_fill_gaps(heights))
    heights[is_pit] = np.inf
    lowest = _fill_gaps(heights)
    is_low = _survives_openings(lowest - _trend(lowest)) & ~is_pit
    on_ground: BoolArray = is_low[column, row] & (points_m[:, 2] <= lowest[column, row] + STEP_M)
    return on_ground


def _fill_gaps(heights: FloatArray) -> FloatArray:
    """Return a height map whose infinite cells have the height of the nearest finite one."""
    from scipy.ndimage import distance_transform_edt

    gaps = ~np.isfinite(heights)
    if gaps.all():
        return np.zeros_like(heights)
    nearest = distance_transform_edt(gaps, return_distances=False, return_indices=True)
    filled: FloatArray = heights[tuple(nearest)]
    return filled


def _pits(heights: FloatArray) -> BoolArray:
    """Return the cells that are far below all their neighbours: returns by way of a mirror, not ground."""
    from scipy.ndimage import grey_closing

    deep: BoolArray = grey_closing(heights, size=(3, 3)) - heights > PIT_M
    return deep


def _trend(heights: FloatArray) -> FloatArray:
    """Return a plane below most of a height map, for openings cut off the upper end of a slope.

    Least squares, repeated without the cells that are above the last plane.
    """
    columns, rows = np.indices(heights.shape).reshape(2, -1)
    terms = np.column_stack([columns, rows, np.ones(columns.size)]).astype(np.float64)
    flat = heights.ravel()
    used = np.ones(flat.size, dtype=np.bool_)
    plane = np.zeros(3)
    for _ in range(_PLANE_FITS):
        if np.count_nonzero(used) < 3:
            break
        plane = np.round(np.linalg.lstsq(terms[used], flat[used], rcond=None)[0], _DIGITS)
        used = flat <= _along_plane(terms, plane) + STEP_M
    return _along_plane(terms, plane).reshape(heights.shape)


def _along_plane(terms: FloatArray, plane: FloatArray) -> FloatArray:
    heights: FloatArray = terms[:, 0] * plane[0] + terms[:, 1] * plane[1] + plane[2]
    return heights


def _survives_openings(heights: FloatArray) -> BoolArray:
    """Return which cells stand out by no more than ``STEP_M`` in openings with growing windows."""
    from scipy.ndimage import grey_opening

    opened = heights
    survives = np.ones(heights.shape, dtype=np.bool_)
    for window in _window_sizes():
        lower = grey_opening(opened, size=(window, window))
        survives &= opened - lower <= STEP_M
        opened = lower
    return survives


def _window_sizes() -> list[int]:
    """Return odd sizes that about double: 3, 5, 9, 17, 33, 41."""
    sizes = []
    size = 3
    while size < MAX_WINDOW_CELLS:
        sizes.append(size)
        size = 2 * size - 1
    return [*sizes, MAX_WINDOW_CELLS]


def triangulate_ground(points_m: FloatArray) -> TriangleSurface:
    """Triangulate ground points (n, 3): Delaunay of the means in cells of ``GROUND_CELL_M``, facing up."""
    cells = np.floor(points_m[:, :2] / GROUND_CELL_M).astype(np.int64)
    vertices = _rounded(_means_by_cell(points_m, cells))
    if len(vertices) < 3 or np.linalg.matrix_rank(vertices[1:, :2] - vertices[0, :2]) < 2:
        return TriangleSurface(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64))
    return TriangleSurface(vertices, triangulate(vertices, vertices[0, :2]))


def make_surfels(points_m: FloatArray) -> TriangleSurface:
    """Put a rectangle on each of some thinned points (n, 3): four vertices and two faces each.

    Fewer than four points give no surfel.
    """
    from scipy.spatial import KDTree

    if len(points_m) < 4:
        return TriangleSurface(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64))
    tree = KDTree(points_m)
    neighbours = min(NEIGHBOURS, len(points_m) - 1)
    corners = []
    for start in range(0, len(points_m), _BLOCK):
        centres = points_m[start : start + _BLOCK]
        distances, index = tree.query(centres, k=neighbours + 1)
        offsets = points_m[index[:, 1:]] - centres[:, None]
        size_m = distances[:, min(SIZE_NEIGHBOUR, neighbours)]
        corners.append(centres[:, None] + _rectangles(offsets, size_m))
    vertices = _rounded(np.concatenate(corners).reshape(-1, 3))
    first = 4 * np.arange(len(points_m), dtype=np.int64)[:, None, None]
    faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return TriangleSurface(vertices, faces)


def _rectangles(offsets: FloatArray, size_m: FloatArray) -> FloatArray:
    """Return the corners of rectangles about their points, (n, 4, 3).

    Parameters
    ----------
    offsets
        From each point to its neighbours, (n, k, 3).
    size_m
        Distance to the neighbour that sets the size, (n,).
    """
    along, across = _main_directions(offsets)
    longest = np.clip(SIZE_FACTOR * size_m, MIN_SIDE_M, MAX_SIDE_M)
    u = np.einsum("nki,ni->nk", offsets, along)
    v = np.einsum("nki,ni->nk", offsets, across)
    right, left, front, back = (
        np.clip(_reach(distances), MIN_REACH_M, longest)[:, None] for distances in (u, -u, v, -v)
    )
    corners = [right * along + front * across, -left * along + front * across,
               -left * along - back * across, right * along - back * across]  # fmt: skip
    return np.stack(corners, axis=1)


def _reach(distances: FloatArray) -> FloatArray:
    """Return how far neighbours (n, k) reach to one side, (n,): not the farthest ones, which noise may have moved."""
    last = distances.shape[1] - 1
    position = max(last - SKIPPED_NEIGHBOURS, 0)
    return np.partition(distances, position, axis=1)[:, position]


def _main_directions(offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the unit vectors in which neighbours (n, k, 3) vary most and second most, (n, 3) each.

    Their signs are chosen so that the component that is largest is positive.
    """
    centred = offsets - offsets.mean(axis=1, keepdims=True)
    covariance = np.einsum("nki,nkj->nij", centred, centred)
    _, vectors = np.linalg.eigh(covariance)
    return _with_fixed_sign(vectors[:, :, 2]), _with_fixed_sign(vectors[:, :, 1])


def _with_fixed_sign(vectors: FloatArray) -> FloatArray:
    largest = np.take_along_axis(vectors, np.abs(vectors).argmax(axis=1)[:, None], axis=1)
    return vectors * np.where(largest < 0, -1.0, 1.0)


def _means_by_cell(points_m: FloatArray, cells: IntArray) -> FloatArray:
    """Return the mean of the points (n, 3) in each cell (n, k), sorted by cell."""
    if not len(points_m):
        return np.empty((0, 3))
    order = np.lexsort(cells.T[::-1])
    cells = cells[order]
    starts = np.flatnonzero(np.insert((np.diff(cells, axis=0) != 0).any(axis=1), 0, True))
    count = np.diff(starts, append=len(points_m))
    origin = points_m[order[starts]]  # sums of small differences keep their digits far from the world's origin
    differences = points_m[order] - np.repeat(origin, count, axis=0)
    return origin + np.add.reduceat(differences, starts, axis=0) / count[:, None]


def _rounded(points_m: FloatArray) -> FloatArray:
    return np.round(points_m, _DIGITS) + 0.0  # no -0
