"""The first static surface that each beam hits, and where.

Embree (float32) finds *which triangle*, float64 arithmetic *where*:

1. The world is moved to the frame of the region of interest in float64.
2. Embree (:class:`egvs.kernels.embree.TriangleTree`) gets every triangle enlarged by a rim that is wider than the error
   of float32, and a low upright fin on each side that is not shared with a steep neighbour. A beam that hits a triangle
   also hits it there: no beam leaks through a shared edge or vertex, or along a surface at a fraction of a degree.
3. Each proposed hit is computed in float64 on the exact triangle. Beams are ambiguous (one in a thousand) if they hit
   only a rim or fin, pass within 0.02 mm of an edge, or hit a surface at less than 0.6 degrees. Their first hit is
   searched among all exact triangles in float64.

The remaining effect of float32: where two surfaces are within about 1e-5 m of each other, a beam that hits both there
may be assigned to the farther one. For a wall that is on the ground, that is less than 1 mm behind the nearer one; for
surfaces that almost coincide and are hit at a degree, some millimetres (``docs/numerics.md``).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from egvs.core.errors import InputError
from egvs.core.grid import BoolArray, FloatArray, IntArray, Roi
from egvs.core.special import cosdg, sindg
from egvs.kernels import ray_triangle
from egvs.world.mesh import World

_RIM_M = 1e-4
# rim per largest coordinate of a triangle: eight times the rounding of float32
_RIM_SHARE = 2.0**-21
# a sliver triangle whose tip would move farther than this when it is enlarged is replaced by a rectangle
_MAX_SHIFT_M = 1.0
# shapes are left out of the tree only if they are farther away than any triangle is enlarged by
_CLEARANCE_M = 2.0
# triangles that are longer, and whose box has more than this multiple of their area, are split in the tree
_LONG_M, _MAX_BOX_RATIO = 10.0, 6.0
# triangles that are thinner are not split: their pieces would have no plane
_THIN_M = 1e-3
# sine of the angle between two planes above which the rim of one extends far enough out of the other
_STEEP_SINE = 0.25
# more than the tolerances of the kernels and the rounding of float64 need
_PADDING_M = 1e-5


@dataclass(frozen=True)
class EmptyScan:
    """Beams of one site against the static world.

    Attributes
    ----------
    beam
        Index of each cast beam in the table of the sensor, (n,) uint32, ascending.
    ends_m
        End of each beam relative to the sensor, along the world axes, (n, 3) float64.
    returned
        Whether the beam hit something within range, (n,) bool.
    ambiguous
        Number of beams whose hit float32 alone could not determine.
    weight
        Share of the beam that each row is, (n,) float64; None unless effects weight beams.
    face
        Face of the world that each beam ends on, -1 for none (leaves), (n,) int64; None except for full sweeps.
    """

    beam: NDArray[np.uint32]
    ends_m: FloatArray
    returned: BoolArray
    ambiguous: int = 0
    weight: FloatArray | None = None
    face: IntArray | None = None


class Caster:
    """Casts beams at a static world. Threads may share one.

    Parameters
    ----------
    world
        The static world; may be empty.
    roi
        Beams that cannot meet it are not cast.
    starts_m
        Where beams start, (n, 3) world frame. If most of the world is out of their reach, it is left out of the tree.
        By default, beams may start anywhere.
    range_m
        Maximum range of these beams.
    """

    def __init__(
        self, world: World, roi: Roi, starts_m: FloatArray | None = None, range_m: float = float("inf")
    ) -> None:
        self._origin_m = np.asarray(roi.origin_m, dtype=np.float64)
        self._size_m = np.asarray(roi.size_m, dtype=np.float64)
        triangles = world.triangles_m - self._origin_m
        if not np.isfinite(triangles).all():
            raise InputError("statics", "expected finite coordinates, got a triangle with nan or inf")
        # A beam through a degenerate triangle (zero area) hits its neighbours.
        faces = np.flatnonzero(_cross(triangles).any(axis=1))
        if starts_m is not None:
            is_reachable = reachable_shapes(world.triangles_m[faces], roi, starts_m, range_m)
            if 2 * np.count_nonzero(is_reachable) < len(faces):  # removing a few does not make the tree faster
                faces = faces[is_reachable]
        faces = faces[_morton_order(triangles[faces].mean(axis=1))]
        self._faces = faces
        self._triangles = triangles[faces]
        self._boxes, self._level_starts = _box_tree(self._triangles)
        self._planes = np.zeros((1, 4, 4))  # kernels need one; without triangles it is not used
        self._owner: NDArray[np.int32] = np.array([-1], dtype=np.int32)
        self._tree: TriangleTree | None = None
        if len(faces):
            self._planes = _planes(self._triangles)
            enlarged, self._owner = _enlarge(self._triangles)
            from egvs.kernels.embree import TriangleTree  # loads Embree and numba, which only a cast needs

            self._tree = TriangleTree(enlarged)

    def scan(self, position_m: tuple[float, float, float], directions: FloatArray, range_m: float) -> EmptyScan:
        """Cast the beams of a sensor that can meet the region of interest.

        Parameters
        ----------
        position_m
            The sensor in the world frame, metres.
        directions
            Unit vectors of all beams along the world axes, (beams, 3) float64.
        range_m
            Where a beam ends that hits nothing.
        """
        o = np.asarray(position_m, dtype=np.float64) - self._origin_m
        beam = np.empty(len(directions), np.uint32)
        count = ray_triangle.select_beams(o, directions, self._size_m, range_m, beam)
        return self._cast(o, beam[:count].copy(), directions, range_m)[0]

    def sweep(self, position_m: tuple[float, float, float], directions: FloatArray, range_m: float) -> EmptyScan:
        """Cast all beams of a sensor, and return the faces that they hit.

        The caster must not have ``starts_m``: beams may leave the region of interest anywhere. Parameters are those of
        :meth:`scan`.
        """
        o = np.asarray(position_m, dtype=np.float64) - self._origin_m
        scan, triangle = self._cast(o, np.arange(len(directions), dtype=np.uint32), directions, range_m)
        face = np.full(len(directions), -1, dtype=np.int64)
        face[scan.returned] = self._faces[triangle[scan.returned]]
        return replace(scan, face=face)

    def first_hits(self, o_roi_m: FloatArray, d: FloatArray, range_m: float = float("inf")) -> tuple[FloatArray, int]:
        """Return the ranges of first hits.

        Parameters
        ----------
        o_roi_m
            The sensor in the frame of the region of interest, (3,).
        d
            Unit vectors of the rays, (n, 3).
        range_m
            Hits beyond it need not be found.

        Returns
        -------
        ranges, ambiguous
            Range of each ray's first hit, infinite for none, (n,); number of rays that were searched in float64.
        """
        ranges = np.empty(len(d))
        scan, _ = self._cast(o_roi_m, np.arange(len(d), dtype=np.uint32), d, range_m, ranges)
        return ranges, scan.ambiguous

    def _cast(
        self, o: FloatArray, beam: NDArray[np.uint32], d: FloatArray, range_m: float, ranges: FloatArray | None = None
    ) -> tuple[EmptyScan, IntArray]:
        """Return where beams end, and the triangle that each hits.

        ``o`` is the sensor in the frame of the region of interest, ``d`` the directions of all its beams; ``ranges`` is
        filled with the ranges of first hits.
        """
        count = len(beam)
        if ranges is None:
            ranges = np.empty(count)
        hits = ray_triangle.Hits(
            ranges, np.empty(count, dtype=np.int64), np.empty((count, 3)), np.empty(count, dtype=np.bool_)
        )
        nearest = np.full(count, -1, dtype=np.int32)
        if self._tree is not None:
            nearest = self._tree.nearest(o, beam, d)
        mesh = ray_triangle.TriangleMesh(self._triangles, self._planes)
        rays = ray_triangle.Rays(o, beam, d, float(range_m))
        ambiguous = np.empty(count, dtype=np.int64)
        ambiguous = ambiguous[: ray_triangle.resolve_hits(nearest, self._owner, mesh, rays, hits, ambiguous)]
        boxes = ray_triangle.BoxTree(self._boxes, self._level_starts)
        ray_triangle.search_triangles(ambiguous, mesh, boxes, rays, hits)
        return EmptyScan(beam, hits.ends, hits.returned, len(ambiguous)), hits.triangle


def reachable_shapes(shapes: FloatArray, roi: Roi, sites_m: FloatArray, range_m: float = float("inf")) -> BoolArray:
    """Return which shapes may be hit by beams that start at a site and meet the region of interest.

    If the complete region is at least as high as all sites along a normal n, beams rise along n, and shapes below the
    lowest site are not hit.

    Parameters
    ----------
    shapes
        Corners of each shape, (m, k, 3), world frame.
    roi
        The region of interest.
    sites_m
        Where beams start, (n, 3), world frame.
    range_m
        Maximum range of the beams.

    Returns
    -------
    array of bool, (m,)
        False only for shapes that are certainly not hit.
    """
    if len(sites_m) == 0:
        return np.zeros(len(shapes), dtype=np.bool_)
    origin = np.asarray(roi.origin_m)
    sites = sites_m - origin
    shapes = shapes - origin
    normals = _separating_normals()
    is_rising = (_corners(roi) @ normals.T).min(axis=0) >= (sites @ normals.T).max(axis=0)
    gap = np.maximum(shapes.min(axis=1) - sites.max(axis=0), sites.min(axis=0) - shapes.max(axis=1))
    distance = np.sqrt((np.maximum(gap, 0.0) ** 2).sum(axis=1))
    is_reachable: BoolArray = distance <= range_m + _CLEARANCE_M
    for normal in normals[is_rising]:
        is_reachable &= (shapes @ normal).max(axis=1) >= (sites @ normal).min() - _CLEARANCE_M
    return is_reachable


def shapes_between(shapes: FloatArray, roi: Roi, sites_m: FloatArray) -> BoolArray:
    """Return which shapes may reach into the convex hull of the region of interest and any one site.

    Parameters
    ----------
    shapes
        Corners of each shape, (m, k, 3), world frame.
    roi
        The region of interest.
    sites_m
        The sites, (n, 3), world frame.

    Returns
    -------
    array of bool, (m,)
        False only for shapes that are certainly not in between.
    """
    origin = np.asarray(roi.origin_m)
    normals = _separating_normals()
    heights = np.column_stack([((shapes - origin) @ normal).max(axis=1) for normal in normals])
    box = (_corners(roi) @ normals.T).min(axis=0)
    is_between = np.zeros(len(shapes), dtype=np.bool_)
    for site in (sites_m - origin) @ normals.T:
        is_between |= (heights >= np.minimum(site, box) - _PADDING_M).all(axis=1)
    return is_between


@cache
def _separating_normals() -> FloatArray:
    """Return normals of planes that may separate shapes, (192, 3)."""
    angles_deg = np.arange(64) * (360 / 64)
    circle = np.column_stack([cosdg(angles_deg), sindg(angles_deg), np.zeros(64)])
    return np.concatenate([np.roll(circle, axis, axis=1) for axis in range(3)])


def _corners(roi: Roi) -> FloatArray:
    """Return the corners of the region of interest in its own frame, (8, 3)."""
    return np.array(list(itertools.product(*((0.0, size) for size in roi.size_m))))


def with_planes(triangles: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
    """Select the triangles that have an area.

    Parameters
    ----------
    triangles
        Corners, (n, 3, 3).

    Returns
    -------
    triangles, planes, numbers
        The triangles with an area, their planes (see :func:`egvs.kernels.ray_triangle.triangle_planes`), and their
        indices in the input.
    """
    numbers = np.flatnonzero(_cross(triangles).any(axis=1))
    return triangles[numbers], _planes(triangles[numbers]), numbers


def touches_sensor(triangles: FloatArray) -> BoolArray:
    """Return whether each triangle (n, 3, 3), relative to a sensor, touches it (within 1 micrometre); (n,) bool."""
    with_area, planes, numbers = with_planes(triangles)
    touched = np.empty(len(numbers), dtype=np.bool_)
    ray_triangle.touched_triangles(with_area, planes, np.zeros(3), touched)
    touches = np.zeros(len(triangles), dtype=np.bool_)
    touches[numbers] = touched
    return touches


def _cross(triangles: FloatArray) -> FloatArray:
    """Return normals whose length is twice the area, (n, 3); exactly zero without area."""
    cross: FloatArray = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return np.where(((cross**2).sum(axis=1) > 0.0)[:, None], cross, 0.0)


def _unit_vectors(vectors: FloatArray) -> FloatArray:
    """Return vectors (n, 3) scaled to length 1."""
    units: FloatArray = vectors / np.sqrt((vectors**2).sum(axis=1))[:, None]
    return units


def _planes(triangles: FloatArray) -> FloatArray:
    """Return the four planes of each triangle, see :func:`egvs.kernels.ray_triangle.triangle_planes`."""
    planes = np.empty((len(triangles), 4, 4))
    ray_triangle.triangle_planes(triangles, _unit_vectors(_cross(triangles)), planes)
    return planes


def _morton_order(points: FloatArray) -> IntArray:
    """Return an order of points (n, 3) that keeps neighbours in space together: a Z-order curve (Morton 1966)."""
    low = points.min(axis=0, initial=np.inf)
    scale = 2.0**20 / max(float((points - low).max(initial=0.0)), _PADDING_M) * (1 - 1e-9)
    cells = ((points - low) * scale).astype(np.int64)
    key = np.zeros(len(points), dtype=np.int64)
    for bit in range(20):
        for axis in range(3):
            key |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


def _box_tree(triangles: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return boxes around triangles, around groups of these, up to a single one; and where each level starts."""
    low = triangles.min(axis=1) - _PADDING_M
    high = triangles.max(axis=1) + _PADDING_M
    levels = [np.column_stack([low, high])]
    while len(low) > 1:
        first = np.arange(0, len(low), ray_triangle.BOX_GROUP_SIZE)
        low = np.minimum.reduceat(low, first)
        high = np.maximum.reduceat(high, first)
        levels.append(np.column_stack([low, high]))
    return np.concatenate(levels), np.cumsum([0, *map(len, levels)])


def _enlarge(triangles: FloatArray) -> tuple[FloatArray, NDArray[np.int32]]:
    """Return the triangles for Embree, (k, 3, 3), and the exact triangle of each: FIN for a fin; then -1, for no hit.

    Large slivers are split first. A triangle is scaled from its incentre, so that its sides move outwards by the rim.
    This would move the tip of a needle far; needles are replaced by two triangles of a rectangle that covers them. Fins
    are added last.
    """
    triangles, owner = _split_large(triangles)
    rim = _RIM_M + _RIM_SHARE * np.abs(triangles).max(axis=(1, 2))
    sides = _opposite_sides(triangles)
    lengths = np.sqrt((sides**2).sum(axis=2))
    perimeter = lengths.sum(axis=1)
    incentre = (triangles * lengths[:, :, None]).sum(axis=1) / perimeter[:, None]
    from_centre = triangles - incentre[:, None]
    reach = np.sqrt((from_centre**2).sum(axis=2)).max(axis=1)
    cross = _cross(triangles)
    share = rim * perimeter / np.sqrt((cross**2).sum(axis=1))  # inradius = 2 area / perimeter
    needles = np.flatnonzero(share * reach > _MAX_SHIFT_M)
    share[needles] = 0.0
    enlarged = triangles + from_centre * share[:, None, None]
    first, second = _rectangles(triangles[needles], sides[needles], cross[needles], rim[needles])
    enlarged[needles] = first
    fins = _fins(triangles, cross, rim)
    owner = np.concatenate([owner, owner[needles], np.full(len(fins), ray_triangle.FIN), [-1]])
    return np.concatenate([enlarged, second, fins]), owner.astype(np.int32)


def _opposite_sides(triangles: FloatArray) -> FloatArray:
    """Return the side opposite each corner, (n, 3, 3)."""
    return np.roll(triangles, -2, axis=1) - np.roll(triangles, -1, axis=1)


def _split_large(triangles: FloatArray) -> tuple[FloatArray, IntArray]:
    """Split triangles (m, 3, 3) that fill little of a large box; return the pieces and the triangle of each.

    They are halved at their longest sides. A beam that enters a box of Embree's tree is tested against its content, and
    the boxes of slivers that fan out overlap. There are at most twice as many pieces as triangles.
    """
    triangles = triangles.copy()
    owner = np.arange(len(triangles))
    max_pieces = 2 * len(triangles)
    while True:
        size = triangles.max(axis=1) - triangles.min(axis=1)
        box = size[:, 0] * size[:, 1] + size[:, 1] * size[:, 2] + size[:, 2] * size[:, 0]
        area = 0.5 * np.sqrt((_cross(triangles) ** 2).sum(axis=1))
        lengths = np.sqrt((_opposite_sides(triangles) ** 2).sum(axis=2))
        longest = lengths.max(axis=1)
        is_large = (longest > _LONG_M) & (box > _MAX_BOX_RATIO * area) & (2.0 * area > _THIN_M * longest)
        large = np.flatnonzero(is_large)
        if len(large) == 0 or len(triangles) + len(large) > max_pieces:
            return triangles, owner
        corners = (lengths[large].argmax(axis=1)[:, None] + np.arange(3)) % 3  # first the one opposite the longest side
        apex, a, b = np.moveaxis(np.take_along_axis(triangles[large], corners[:, :, None], axis=1), 1, 0)
        middle = 0.5 * (a + b)
        triangles[large] = np.stack([apex, a, middle], axis=1)
        triangles = np.concatenate([triangles, np.stack([apex, middle, b], axis=1)])
        owner = np.concatenate([owner, owner[large]])


def _fins(triangles: FloatArray, cross: FloatArray, rim: FloatArray) -> FloatArray:
    """Return upright strips on the sides without a steep neighbour, (f, 3, 3).

    A rim in the plane of a triangle does not stop a beam along that plane. The rim of a steep neighbour does; other
    sides get a strip that is as high above and below as the rim is wide.
    """
    normals = _unit_vectors(cross)
    starts = triangles.reshape(-1, 3)
    ends = np.roll(triangles, -1, axis=1).reshape(-1, 3)
    is_ordered = _precedes(starts, ends)[:, None]
    low = np.where(is_ordered, starts, ends)
    high = np.where(is_ordered, ends, starts)
    order = np.lexsort(np.column_stack([low, high]).T)
    low = low[order]
    high = high[order]
    owner = order // 3
    is_new = ~((low[1:] == low[:-1]) & (high[1:] == high[:-1])).all(axis=1)
    group = np.cumsum(np.append(0, is_new))
    first = np.flatnonzero(np.append(True, is_new))
    first_owner = owner[first][group]
    sine = np.sqrt((np.cross(normals[owner], normals[first_owner]) ** 2).sum(axis=1))
    is_steep = np.maximum.reduceat(sine, first) > _STEEP_SINE

    side = first[~is_steep]
    a = low[side]
    b = high[side]
    width = rim[owner[side], None]
    up = normals[owner[side]] * width
    along = _unit_vectors(b - a) * width
    corners = [a - along - up, b + along - up, b + along + up, a - along + up]
    return np.concatenate([np.stack([corners[0], corners[i], corners[i + 1]], axis=1) for i in (1, 2)])


def _precedes(a: FloatArray, b: FloatArray) -> BoolArray:
    """Return whether points a (n, 3) are before points b in lexical order."""
    x, y, z = (a - b).T
    before: BoolArray = (x < 0) | ((x == 0) & ((y < 0) | ((y == 0) & (z < 0))))
    return before


def _rectangles(
    triangles: FloatArray, sides: FloatArray, cross: FloatArray, rim: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return two triangles (n, 3, 3) each that cover a triangle and its rim: a rectangle along its longest side."""
    rows = np.arange(len(triangles))
    u = _unit_vectors(sides[rows, (sides**2).sum(axis=2).argmax(axis=1)])
    v = _unit_vectors(np.cross(cross, u))
    base = triangles[:, 0]
    from_base = triangles - base[:, None]
    along = (from_base * u[:, None]).sum(axis=2)
    across = (from_base * v[:, None]).sum(axis=2)
    corners = []
    for at_u in (along.min(axis=1) - rim, along.max(axis=1) + rim):
        for at_v in (across.min(axis=1) - rim, across.max(axis=1) + rim):
            corners.append(base + u * at_u[:, None] + v * at_v[:, None])
    first = np.stack([corners[0], corners[2], corners[3]], axis=1)
    return first, np.stack([corners[0], corners[3], corners[1]], axis=1)
