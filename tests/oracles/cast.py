"""Finds what a ray meets first, and which voxels a segment crosses: slowly, obviously, in float64.

Shares no code with the pipeline. Rays: each is held against every triangle (Moeller and Trumbore 1997, "Fast, Minimum
Storage Ray/Triangle Intersection"), then against the rules that the pipeline documents: a plane seen at a sine below
1e-9 or within 1 micrometre of the start is not met, and a point up to 1 micrometre outside a triangle is on it.
:func:`allowed` judges one ray in rational arithmetic.
Segments: all crossings with the planes of the grid are collected and sorted; the middle of each piece tells the voxel.
"""

from fractions import Fraction

import numba
import numpy as np

EDGE_M = 1e-6
GRAZE = 1e-9
CHORD_M = 1e-6
ROUNDING = 4 * 2.0**-53
"""Of a cross product in float64, relative to the product of the lengths: two roundings of each product, one of each
side, one of the difference."""


@numba.njit(cache=True, nogil=True)
def _distance(p, a, b):
    """Of a point from the segment a-b."""
    along, length = 0.0, 0.0
    for k in range(3):
        along += (p[k] - a[k]) * (b[k] - a[k])
        length += (b[k] - a[k]) ** 2
    s = min(max(along / length, 0.0), 1.0)
    away = 0.0
    for k in range(3):
        away += (p[k] - a[k] - s * (b[k] - a[k])) ** 2
    return np.sqrt(away)


@numba.njit(cache=True, nogil=True)
def _brute(o, d, corners, heights, area2, edge_m, graze, ranges, which):
    p = np.empty(3)
    for r in range(d.shape[0]):
        best, best_of = np.inf, -1
        ox, oy, oz = o[r]
        dx, dy, dz = d[r]
        for m in range(corners.shape[0]):
            ax, ay, az = corners[m, 0]
            e1x, e1y, e1z = corners[m, 1, 0] - ax, corners[m, 1, 1] - ay, corners[m, 1, 2] - az
            e2x, e2y, e2z = corners[m, 2, 0] - ax, corners[m, 2, 1] - ay, corners[m, 2, 2] - az
            px, py, pz = dy * e2z - dz * e2y, dz * e2x - dx * e2z, dx * e2y - dy * e2x
            det = e1x * px + e1y * py + e1z * pz
            if det == 0.0:
                continue
            sx, sy, sz = ox - ax, oy - ay, oz - az
            u = (sx * px + sy * py + sz * pz) / det
            if u * heights[m, 1] < -2.0 * edge_m:
                continue
            qx, qy, qz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
            v = (dx * qx + dy * qy + dz * qz) / det
            if v * heights[m, 2] < -2.0 * edge_m or (1.0 - u - v) * heights[m, 0] < -2.0 * edge_m:
                continue
            t = (e2x * qx + e2y * qy + e2z * qz) / det
            sine = abs(det) / area2[m]
            if not 0.0 < t < best or sine < graze or t * sine <= edge_m:
                continue
            if u < 0.0 or v < 0.0 or u + v > 1.0:
                p[0], p[1], p[2] = ox + t * dx, oy + t * dy, oz + t * dz
                a, b, c = corners[m, 0], corners[m, 1], corners[m, 2]
                if min(_distance(p, a, b), _distance(p, b, c), _distance(p, c, a)) > edge_m:
                    continue
            best, best_of = t, m
        ranges[r], which[r] = best, best_of


def first_hits(o, d, corners, edge_m=EDGE_M, graze=GRAZE):
    """Range of each ray's first hit (infinity for none), and its triangle (-1).

    ``o`` (3,) or (n, 3), unit ``d`` (n, 3), ``corners`` (m, 3, 3). Triangles without area are not met.
    """
    d = np.ascontiguousarray(d, dtype=np.float64)
    o = np.ascontiguousarray(np.broadcast_to(np.asarray(o, dtype=np.float64), d.shape))
    corners = np.asarray(corners, dtype=np.float64)
    area2 = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    kept = np.flatnonzero(area2 > 0)
    corners, area2 = np.ascontiguousarray(corners[kept]), area2[kept]
    opposite = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1), axis=2)
    ranges, which = np.empty(len(d)), np.empty(len(d), dtype=np.int64)
    _brute(o, d, corners, area2[:, None] / opposite, area2, edge_m, graze, ranges, which)
    return ranges, np.where(which >= 0, np.append(kept, -1)[which], -1)


def differ(found, true, tolerance_m=1e-9):
    """Which outcomes differ: met against not met, or ranges further apart than the tolerance (relative to 1 m +
    range)."""
    with np.errstate(invalid="ignore"):
        close = np.abs(found - true) <= tolerance_m * (1.0 + np.abs(true))
    return ~((found == true) | close)


def _minus(a, b):
    return [x - y for x, y in zip(a, b, strict=True)]


def _dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


def _cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _outside_m(p, triangle, normal):
    """How far a point of a triangle's plane lies from the triangle; all in rational numbers but the root."""
    pairs = [(triangle[i], triangle[(i + 1) % 3]) for i in range(3)]
    if all(_dot(_cross(normal, _minus(b, a)), _minus(p, a)) >= 0 for a, b in pairs):
        return 0.0
    squares = []
    for a, b in pairs:
        side = _minus(b, a)
        s = min(max(_dot(_minus(p, a), side) / _dot(side, side), Fraction(0)), Fraction(1))
        off = [x - y - s * z for x, y, z in zip(p, a, side, strict=True)]
        squares.append(_dot(off, off))
    return float(min(squares)) ** 0.5


def allowed(found, o, d, corners):
    """Whether a ray's range (infinity: nothing met) is one that the rules allow, in rational arithmetic.

    Float64 knows the normal of a triangle of size L and height h to ROUNDING * L / h radians: seen at sine s, the hit
    on it moves along the ray by ROUNDING * L**2 / (h s). A triangle that is met wherever its plane lies within that
    must be met; a range must be that of a triangle that is met for one such plane.

    ``o``, ``d`` (3,), ``corners`` (m, 3, 3).
    """
    low, high = corners.min(axis=1) - 1e-3, corners.max(axis=1) + 1e-3
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - o) / d, (high - o) / d
    near = np.fmin(a, b).max(axis=1) <= np.fmax(a, b).min(axis=1)
    start, way = [Fraction(float(x)) for x in o], [Fraction(float(x)) for x in d]
    latest, of_some = np.inf, bool(np.isinf(found))
    for corner in corners[near]:
        triangle = [[Fraction(float(x)) for x in point] for point in corner]
        normal = _cross(_minus(triangle[1], triangle[0]), _minus(triangle[2], triangle[0]))
        facing = _dot(normal, way)
        if facing == 0:
            continue
        exact = _dot(normal, _minus(triangle[0], start)) / facing
        outside = _outside_m([x + exact * y for x, y in zip(start, way, strict=True)], triangle, normal)
        t, area2 = float(exact), float(_dot(normal, normal)) ** 0.5
        size = max(np.linalg.norm(corner - np.roll(corner, 1, axis=0), axis=1))
        sine = abs(float(facing)) / area2
        moved = (ROUNDING * size**3 / area2 + ROUNDING * (np.abs(corner).max() + np.abs(o).max())) / sine
        of_some |= t > 0.0 and outside <= EDGE_M + moved and abs(found - t) <= moved
        if sine > 2 * GRAZE and t * sine > 2 * EDGE_M and outside <= EDGE_M - moved:
            latest = min(latest, t + moved)
    return of_some and found <= latest


def crossed(start, way, origin, voxel, shape):
    """The voxels, (k, 3), that share a chord longer than CHORD_M with the segment from ``start`` to ``start + way``."""
    start, way = np.asarray(start, dtype=np.float64) - origin, np.asarray(way, dtype=np.float64)
    length = np.linalg.norm(way)
    cuts = [np.array([0.0, 1.0])]
    for axis in range(3):
        if way[axis] != 0.0:
            at = (np.arange(shape[axis] + 1) * voxel - start[axis]) / way[axis]
            cuts.append(at[(at > 0.0) & (at < 1.0)])
    cuts = np.sort(np.concatenate(cuts))
    middle = start + way * (0.5 * (cuts[1:] + cuts[:-1]))[:, None]
    index = np.floor(middle / voxel).astype(np.int64)
    return index[(np.diff(cuts) * length > CHORD_M) & ((index >= 0) & (index < shape)).all(axis=1)]


@numba.njit(cache=True, nogil=True)
def _count(start, ways, voxel, shape, hits):
    cuts = np.empty(2 + shape.sum() + 3)
    for beam in range(ways.shape[0]):
        way = ways[beam]
        n = 0
        for axis in range(3):
            if way[axis] != 0.0:
                for plane in range(shape[axis] + 1):
                    at = (plane * voxel - start[axis]) / way[axis]
                    if 0.0 < at < 1.0:
                        cuts[n] = at
                        n += 1
        cuts[n], cuts[n + 1] = 0.0, 1.0
        found = np.sort(cuts[: n + 2])
        length = np.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
        for piece in range(n + 1):
            if (found[piece + 1] - found[piece]) * length > CHORD_M:
                middle = 0.5 * (found[piece] + found[piece + 1])
                i = np.floor((start[0] + way[0] * middle) / voxel)
                j = np.floor((start[1] + way[1] * middle) / voxel)
                k = np.floor((start[2] + way[2] * middle) / voxel)
                if 0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= k < shape[2]:
                    hits[int(i), int(j), int(k)] += 1


def count_hits(position, ways, origin, voxel, shape):
    """Beams that cross each voxel, int64 of the grid's shape: :func:`crossed` for each of ``ways`` (n, 3), added up."""
    hits = np.zeros(shape, dtype=np.int64)
    start = np.asarray(position, dtype=np.float64) - np.asarray(origin)
    _count(start, np.ascontiguousarray(ways, dtype=np.float64), float(voxel), np.asarray(shape, dtype=np.int64), hits)
    return hits
