"""Finds the static surface that each beam meets first, and where.

Embree (float32) answers *which triangle*, float64 *where*:

1. The world is moved to the region of interest's own frame in float64.
2. Embree (:class:`egvs.kernels.embree.TriangleTree`) holds every triangle enlarged by a rim that is wider than
float32's
   error, and a low fin upright on each side that is not shared with a steep neighbour. What a beam truly meets, it
   meets there too: none leaks through a shared edge or vertex, and none slips in along a surface that it sees at a
   fraction of a degree.
3. Each proposed hit is placed in float64 on the true triangle. A beam that met only a rim or fin, came within 0.02 mm
   of an edge, or met a surface at less than 0.6 degrees, is doubtful (one in a thousand); its first hit is searched
   among all true triangles in float64.

What is left to float32: where two surfaces come within some 1e-5 m of each other, a beam that meets both there may be
given the farther one. Where a wall stands on the ground, that lies less than 1 mm behind the nearer; for surfaces that
almost coincide and are seen at a degree, some millimetres (``docs/numerics.md``).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import cosdg, sindg

from egvs.core.errors import InputError
from egvs.core.grid import Roi
from egvs.kernels import ray_triangle
from egvs.kernels.embree import TriangleTree
from egvs.world.mesh import World

Floats = NDArray[np.float64]

_RIM_M = 1e-4
_RIM_SHARE = 2.0**-21  # of the triangle's largest coordinate: eight times float32's rounding
_MAX_SHIFT_M = 1.0  # a needle whose tip would move further when it is enlarged is held as a rectangle
_CLEAR_M = 2.0  # what is left out of the tree is further away than anything held there is enlarged
_LONG_M, _WASTE = 10.0, 6.0  # a triangle longer than this, in a box with so many times its area, is cut in the tree
_THIN_M = 1e-3  # but for one that is no wider, whose pieces would have no plane
_STEEP = 0.25  # sine of the angle between two planes from which the one's rim stands out of the other far enough
_PAD_M = 1e-5  # more than the rules of kernels.rays and float64's rounding ask for

_TURN = np.arange(64) * (360 / 64)
_ROUND = np.column_stack([cosdg(_TURN), sindg(_TURN), np.zeros(64)])
_FAN = np.concatenate([np.roll(_ROUND, turn, axis=1) for turn in range(3)])  # normals of planes that part shapes


@dataclass(frozen=True)
class EmptyScan:
    """One site's beams against the static world.

    Attributes
    ----------
    beam
        Index of each cast beam in the sensor's table, (n,) uint32, ascending.
    ends_m
        Where the beam ends, seen from the sensor along the world's axes, (n, 3) float64.
    returned
        False where nothing was met within the sensor's range, (n,) bool.
    doubtful
        How many beams float32 alone would not have settled.
    weight
        Only where effects weight beams: the share of its beam that each row is, (n,) float64.
    face
        Only of a whole sweep: the face of the world that each beam ends on, -1 for none (leaves), (n,) int64.
    """

    beam: NDArray[np.uint32]
    ends_m: Floats
    returned: NDArray[np.bool_]
    doubtful: int = 0
    weight: Floats | None = None
    face: NDArray[np.int64] | None = None


class Caster:
    """Casts beams at a static world. Threads may share one.

    Parameters
    ----------
    world
        The static world; may be empty, then no tree is built.
    roi
        Beams that cannot meet it are not cast.
    sites_m, range_m
        Where beams start, (n, 3), and how far they go at most: what none of them can meet is left out of the tree,
        where that is most of the world. All is kept when None.
    """

    def __init__(self, world: World, roi: Roi, sites_m: Floats | None = None, range_m: float = float("inf")) -> None:
        self._origin_m = np.asarray(roi.origin_m, dtype=np.float64)
        self._size_m = np.asarray(roi.size_m, dtype=np.float64)
        triangles = world.triangles_m - self._origin_m
        if not np.isfinite(triangles).all():
            raise InputError("statics", "a triangle has a corner that is no number", "finite metres")
        met = np.flatnonzero(_cross(triangles).any(axis=1))  # the others have no plane, and what is beside them is met
        if sites_m is not None:
            reached = reachable_shapes(world.triangles_m[met], roi, sites_m, range_m)
            if 2 * np.count_nonzero(reached) < len(met):  # a few less make no quicker tree
                met = met[reached]
        met = met[_along_curve(triangles[met].mean(axis=1))]
        self._faces = met
        self._triangles = triangles[met]
        self._planes = _planes(self._triangles) if len(met) else np.zeros((1, 4, 4))  # one, which is never asked
        self._boxes, self._starts = _boxes(self._triangles)
        self._owner: NDArray[np.int32] = np.array([-1], dtype=np.int32)
        self._tree: TriangleTree | None = None
        if len(met):
            enlarged, self._owner = _enlarge(self._triangles)
            self._tree = TriangleTree(enlarged)

    def scan(self, position_m: tuple[float, float, float], directions: Floats, range_m: float) -> EmptyScan:
        """Cast the beams of one sensor.

        Parameters
        ----------
        position_m
            The sensor in the world frame, metres.
        directions
            Unit vectors of all its beams along the world's axes, (beams, 3) float64.
        range_m
            Where a beam ends that meets nothing.
        """
        o = np.asarray(position_m, dtype=np.float64) - self._origin_m
        beam = np.empty(len(directions), np.uint32)
        count = ray_triangle.select_beams(o, directions, self._size_m, range_m, beam)
        return self._ended(o, beam[:count].copy(), directions, range_m)[0]

    def sweep(self, position_m: tuple[float, float, float], directions: Floats, range_m: float) -> EmptyScan:
        """Cast every beam, whether or not it can meet the region of interest; as :meth:`scan`, and what is met.

        Beams may leave the region anywhere: for a caster without ``sites_m``.
        """
        o = np.asarray(position_m, dtype=np.float64) - self._origin_m
        scan, met = self._ended(o, np.arange(len(directions), dtype=np.uint32), directions, range_m)
        face = np.full(len(directions), -1, dtype=np.int64)
        face[scan.returned] = self._faces[met[scan.returned]]
        return replace(scan, face=face)

    def first_hits(self, o_roi_m: Floats, d: Floats, range_m: float = float("inf")) -> tuple[Floats, int]:
        """Range of each ray's first hit (infinity for none), and how many rays had to be searched in float64.

        ``o_roi_m`` is the sensor in the ROI's frame, (3,); ``d`` are unit directions (n, 3); hits beyond ``range_m`` do
        not matter.
        """
        ranges = np.empty(len(d))
        scan, _ = self._ended(o_roi_m, np.arange(len(d), dtype=np.uint32), d, range_m, ranges)
        return ranges, scan.doubtful

    def _ended(
        self,
        o: Floats,
        beam: NDArray[np.uint32],
        d: Floats,
        range_m: float,
        ranges: Floats | None = None,
    ) -> tuple[EmptyScan, NDArray[np.int64]]:
        """Where some beams end, and which of the kept triangles each meets.

        ``o`` is the sensor in the ROI's frame, ``d`` the directions of all beams; ``ranges`` is filled with the first
        hits of those that are cast.
        """
        count = len(beam)
        ranges = np.empty(count) if ranges is None else ranges
        met, doubtful = np.empty((2, count), dtype=np.int64)
        ends, returned = np.empty((count, 3)), np.empty(count, dtype=np.bool_)
        nearest = np.full(count, -1, dtype=np.int32) if self._tree is None else self._tree.nearest(o, beam, d)
        mesh = ray_triangle.TriangleMesh(self._triangles, self._planes)
        rays = ray_triangle.Rays(o, beam, d, float(range_m))
        hits = ray_triangle.Hits(ranges, met, ends, returned)
        some = doubtful[: ray_triangle.resolve_hits(nearest, self._owner, mesh, rays, hits, doubtful)]
        ray_triangle.search_triangles(some, mesh, ray_triangle.BoxTree(self._boxes, self._starts), rays, hits)
        return EmptyScan(beam, ends, returned, len(some)), met


def reachable_shapes(shapes: Floats, roi: Roi, sites_m: Floats, range_m: float = float("inf")) -> NDArray[np.bool_]:
    """Which shapes may be met by a beam that starts at a site, meets the region of interest, and goes on behind it.

    Where a normal n has all of the region at least as high as all sites, beams rise along n, and what lies lower than
    the lowest site is not met. Corners of each shape (m, k, 3), world frame; (m,) bool, False only when certain.
    """
    if len(sites_m) == 0:
        return np.zeros(len(shapes), dtype=np.bool_)
    origin = np.asarray(roi.origin_m)
    sites, shapes, box = sites_m - origin, shapes - origin, _corners(roi)
    rising = (box @ _FAN.T).min(axis=0) >= (sites @ _FAN.T).max(axis=0)
    gap = np.maximum(shapes.min(axis=1) - sites.max(axis=0), sites.min(axis=0) - shapes.max(axis=1))
    met: NDArray[np.bool_] = np.sqrt((np.maximum(gap, 0.0) ** 2).sum(axis=1)) <= range_m + _CLEAR_M
    for normal in _FAN[rising]:
        met &= (shapes @ normal).max(axis=1) >= (sites @ normal).min() - _CLEAR_M
    return met


def shapes_between(shapes: Floats, roi: Roi, sites_m: Floats) -> NDArray[np.bool_]:
    """Which shapes may reach into the convex hull of the region of interest and any one site; as
    :func:`reachable_shapes`."""
    origin = np.asarray(roi.origin_m)
    heights = np.column_stack([((shapes - origin) @ normal).max(axis=1) for normal in _FAN])
    box, sites = (_corners(roi) @ _FAN.T).min(axis=0), (sites_m - origin) @ _FAN.T
    reaching = np.zeros(len(shapes), dtype=np.bool_)
    for site in sites:
        reaching |= (heights >= np.minimum(site, box) - _PAD_M).all(axis=1)
    return reaching


def _corners(roi: Roi) -> Floats:
    """Corners of the region of interest in its own frame, (8, 3)."""
    return np.array(list(itertools.product(*((0.0, size) for size in roi.size_m))))


def with_planes(triangles: Floats) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Triangles that have a plane, these planes (see :func:`egvs.kernels.ray_triangle.triangle_planes`), and which
    ones they are."""
    kept = np.flatnonzero(_cross(triangles).any(axis=1))
    return triangles[kept], _planes(triangles[kept]), kept


def touches_sensor(triangles: Floats) -> NDArray[np.bool_]:
    """Which triangles (n, 3, 3), seen from a sensor, it stands on (to 1 micrometre), (n,) bool."""
    flat, planes, kept = with_planes(triangles)
    touched, on = np.empty(len(kept), dtype=np.bool_), np.zeros(len(triangles), dtype=np.bool_)
    ray_triangle.touched_triangles(flat, planes, np.zeros(3), touched)
    on[kept] = touched
    return on


def _cross(triangles: Floats) -> Floats:
    """Normals as long as twice the area, (n, 3); exactly zero where there is none."""
    cross: Floats = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return np.where(((cross**2).sum(axis=1) > 0.0)[:, None], cross, 0.0)


def _unit_vectors(vectors: Floats) -> Floats:
    """Vectors (n, 3), each one metre long."""
    units: Floats = vectors / np.sqrt((vectors**2).sum(axis=1))[:, None]
    return units


def _planes(triangles: Floats) -> Floats:
    """The four planes of each triangle, see :func:`egvs.kernels.ray_triangle.triangle_planes`."""
    cross, planes = _cross(triangles), np.empty((len(triangles), 4, 4))
    ray_triangle.triangle_planes(triangles, _unit_vectors(cross), planes)
    return planes


def _along_curve(points: Floats) -> NDArray[np.int64]:
    """An order of the points (n, 3) in which neighbours in space lie together: along a Z-shaped curve (Morton 1966)."""
    low = points.min(axis=0, initial=np.inf)
    scale = 2.0**20 / max(float((points - low).max(initial=0.0)), _PAD_M) * (1 - 1e-9)
    cells = ((points - low) * scale).astype(np.int64)
    key = np.zeros(len(points), dtype=np.int64)
    for bit in range(20):
        for axis in range(3):
            key |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


def _boxes(triangles: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Boxes round the triangles, round groups of these, and so on up to one; and where each level starts."""
    low, high = triangles.min(axis=1) - _PAD_M, triangles.max(axis=1) + _PAD_M
    levels = [np.column_stack([low, high])]
    while len(low) > 1:
        firsts = np.arange(0, len(low), ray_triangle.BOX_GROUP_SIZE)
        low, high = np.minimum.reduceat(low, firsts), np.maximum.reduceat(high, firsts)
        levels.append(np.column_stack([low, high]))
    return np.concatenate(levels), np.cumsum([0, *map(len, levels)])


def _enlarge(triangles: Floats) -> tuple[Floats, NDArray[np.int32]]:
    """What Embree holds for some triangles, (k, 3, 3); and the triangle behind each, FIN for a fin, with one more for
    none, -1.

    Large slivers are cut first. A triangle is scaled from its incentre so that its sides move out by the rim. That
    moves a needle's tip far; a needle is held as the two triangles of a rectangle that covers it. Then the fins.
    """
    triangles, cut_from = _split_large(triangles)
    rim = _RIM_M + _RIM_SHARE * np.abs(triangles).max(axis=(1, 2))
    sides = np.roll(triangles, -2, axis=1) - np.roll(triangles, -1, axis=1)  # opposite corner i
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
    owner = np.concatenate([cut_from, cut_from[needles], np.full(len(fins), ray_triangle.FIN), [-1]])
    return np.concatenate([enlarged, second, fins]), owner.astype(np.int32)


def _split_large(triangles: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Cut triangles (m, 3, 3) that fill little of a large box, across their longest sides; the pieces, and of which
    triangle each is.

    A beam that enters a box of Embree's tree is tried against what lies in it, and where slivers fan out, their boxes
    lie one over another. At most twice as many triangles come out.
    """
    triangles, owner, most = triangles.copy(), np.arange(len(triangles)), 2 * len(triangles)
    while True:
        size = triangles.max(axis=1) - triangles.min(axis=1)
        box = size[:, 0] * size[:, 1] + size[:, 1] * size[:, 2] + size[:, 2] * size[:, 0]
        area = 0.5 * np.sqrt((_cross(triangles) ** 2).sum(axis=1))
        sides = np.sqrt(((np.roll(triangles, -2, axis=1) - np.roll(triangles, -1, axis=1)) ** 2).sum(axis=2))
        long = sides.max(axis=1)
        chosen = np.flatnonzero((long > _LONG_M) & (box > _WASTE * area) & (2.0 * area > _THIN_M * long))
        if len(chosen) == 0 or len(triangles) + len(chosen) > most:
            return triangles, owner
        turn = (sides[chosen].argmax(axis=1)[:, None] + np.arange(3)) % 3  # the corner that faces it comes first
        apex, a, b = np.moveaxis(np.take_along_axis(triangles[chosen], turn[:, :, None], axis=1), 1, 0)
        middle = 0.5 * (a + b)
        triangles[chosen] = np.stack([apex, a, middle], axis=1)
        triangles = np.concatenate([triangles, np.stack([apex, middle, b], axis=1)])
        owner = np.concatenate([owner, owner[chosen]])


def _fins(triangles: Floats, cross: Floats, rim: Floats) -> Floats:
    """Strips upright on the sides that no steep neighbour guards, (f, 3, 3).

    A rim in the triangle's plane is no guard against a beam along that plane. The rim of a neighbour that stands steep
    on it is; elsewhere the side gets a strip as high above and below as the rim is wide.
    """
    normals = _unit_vectors(cross)
    starts, ends = triangles.reshape(-1, 3), np.roll(triangles, -1, axis=1).reshape(-1, 3)
    ahead = _precedes(starts, ends)
    low, high = np.where(ahead[:, None], starts, ends), np.where(ahead[:, None], ends, starts)
    order = np.lexsort(np.column_stack([low, high]).T)
    low, high, owner = low[order], high[order], order // 3
    same = ((low[1:] == low[:-1]) & (high[1:] == high[:-1])).all(axis=1)
    group = np.cumsum(np.append(0, ~same))
    first = np.flatnonzero(np.append(True, ~same))
    lead = owner[first][group]
    sine = np.sqrt((np.cross(normals[owner], normals[lead]) ** 2).sum(axis=1))
    steep = np.maximum.reduceat(sine, first) > _STEEP
    side = first[~steep]
    a, b, n, wide = low[side], high[side], normals[owner[side]], rim[owner[side], None]
    along = _unit_vectors(b - a) * wide
    corners = [a - along - n * wide, b + along - n * wide, b + along + n * wide, a - along + n * wide]
    return np.concatenate([np.stack([corners[0], corners[i], corners[i + 1]], axis=1) for i in (1, 2)])


def _precedes(a: Floats, b: Floats) -> NDArray[np.bool_]:
    """Whether points a (n, 3) come before points b in lexical order."""
    x, y, z = (a - b).T
    before: NDArray[np.bool_] = (x < 0) | ((x == 0) & ((y < 0) | ((y == 0) & (z < 0))))
    return before


def _rectangles(triangles: Floats, sides: Floats, cross: Floats, rim: Floats) -> tuple[Floats, Floats]:
    """Two triangles each, (n, 3, 3), that together cover a triangle and a rim round it; one side along its longest."""
    rows = np.arange(len(triangles))
    u = _unit_vectors(sides[rows, (sides**2).sum(axis=2).argmax(axis=1)])
    v = _unit_vectors(np.cross(cross, u))
    base = triangles[:, 0]
    along, across = (((triangles - base[:, None]) * axis[:, None]).sum(axis=2) for axis in (u, v))
    corners = [
        base + u * (at_u + turn_u * rim)[:, None] + v * (at_v + turn_v * rim)[:, None]
        for at_u, turn_u in ((along.min(axis=1), -1), (along.max(axis=1), 1))
        for at_v, turn_v in ((across.min(axis=1), -1), (across.max(axis=1), 1))
    ]
    first, second = ([corners[0], corners[i], corners[j]] for i, j in ((2, 3), (3, 1)))
    return np.stack(first, axis=1), np.stack(second, axis=1)
