r"""Where exactly does a ray meet a triangle?

Frame: any one with the world's axes, in metres, float64; ray :math:`o + t\,d` with unit :math:`d`, so t is the range.

Embree works in float32 and proposes; the functions here decide, by rules that rounding cannot turn:

- A ray meets a triangle when it pierces its plane at :math:`t = n \cdot (a - o) / n \cdot d > 0`, no further than ``EDGE_M``
  (1 micrometre) outside the triangle. So no ray slips between two triangles that share an edge or a vertex.
- A plane seen at less than ``GRAZE`` (1e-9) radians is not met; the surface beside it is.
"""

from __future__ import annotations

import math

import numba
import numpy as np

EDGE_M = 1e-6
"""A ray that passes a triangle's edge no further outside than this meets the triangle."""

GRAZE = 1e-9
"""A plane seen at a smaller angle (its sine) is not met."""

CHORD_M = 1e-6
"""A ray that shares no longer piece with the region of interest is not cast."""

GROUP = 16
"""Triangles that share a bounding ball in :func:`search`."""

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")
_inlined = numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")


@_kernel
def _near_segment(px, py, pz, bx, by, bz):  # type: ignore[no-untyped-def]
    """Whether point p lies within EDGE_M of the segment from zero to b."""
    length2 = bx * bx + by * by + bz * bz
    s = min(max((px * bx + py * by + pz * bz) / length2, 0.0), 1.0)
    x, y, z = px - s * bx, py - s * by, pz - s * bz
    return x * x + y * y + z * z <= EDGE_M * EDGE_M


@_kernel
def meet(triangle, n, o, d):  # type: ignore[no-untyped-def]
    """Range at which a ray meets one triangle, infinity when it does not.

    Parameters
    ----------
    triangle, n
        Corners (3, 3) and unit normal (3,), float64.
    o, d
        Start (3,) and unit direction (3,) of the ray, float64.
    """
    facing = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
    if not abs(facing) >= GRAZE:
        return np.inf
    ax, ay, az = triangle[0, 0] - o[0], triangle[0, 1] - o[1], triangle[0, 2] - o[2]
    t = (n[0] * ax + n[1] * ay + n[2] * az) / facing
    if not t > 0.0:
        return np.inf
    outside = False
    for i in range(3):
        j = (i + 1) % 3
        px, py, pz = t * d[0] - (triangle[i, 0] - o[0]), t * d[1] - (triangle[i, 1] - o[1]), t * d[2] - (triangle[i, 2] - o[2])
        bx, by, bz = triangle[j, 0] - triangle[i, 0], triangle[j, 1] - triangle[i, 1], triangle[j, 2] - triangle[i, 2]
        side = n[0] * (by * pz - bz * py) + n[1] * (bz * px - bx * pz) + n[2] * (bx * py - by * px)
        if side < 0.0:
            if side < -EDGE_M * math.sqrt(bx * bx + by * by + bz * bz):
                return np.inf
            outside = True
    if not outside:
        return t
    for i in range(3):
        j = (i + 1) % 3
        px, py, pz = t * d[0] - (triangle[i, 0] - o[0]), t * d[1] - (triangle[i, 1] - o[1]), t * d[2] - (triangle[i, 2] - o[2])
        bx, by, bz = triangle[j, 0] - triangle[i, 0], triangle[j, 1] - triangle[i, 1], triangle[j, 2] - triangle[i, 2]
        if _near_segment(px, py, pz, bx, by, bz):
            return t
    return np.inf


@_kernel
def settle(proposed, triangles, normals, o, d, ranges, doubtful):  # type: ignore[no-untyped-def]
    """Place the hits that were proposed, and tell which proposals do not hold.

    Parameters
    ----------
    proposed
        Index of the triangle that each ray meets first in slightly enlarged form, -1 for none, (n,) int32.
    triangles, normals
        All triangles (m, 3, 3) and their unit normals (m, 3), float64.
    o, d
        The sensor (3,) and the rays' unit directions (n, 3), float64.
    ranges
        Filled: range of each hit, infinity where nothing is met, (n,) float64.
    doubtful
        Filled: the rays that met only a triangle's enlargement, (n,) int64.

    Returns
    -------
    int
        How many rays are doubtful; :func:`search` settles them.
    """
    count = 0
    for ray in range(proposed.shape[0]):
        ranges[ray] = np.inf
        if proposed[ray] >= 0:
            ranges[ray] = meet(triangles[proposed[ray]], normals[proposed[ray]], o, d[ray])
            if ranges[ray] == np.inf:
                doubtful[count] = ray
                count += 1
    return count


@_inlined
def _enters(ball_x, ball_y, ball_z, radius, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Whether a ray comes into a ball."""
    cx, cy, cz = ball_x - ox, ball_y - oy, ball_z - oz
    along = cx * dx + cy * dy + cz * dz
    return cx * cx + cy * cy + cz * cz - along * along <= radius * radius and along + radius > 0.0


@_kernel
def search(rays, triangles, normals, balls, groups, o, d, ranges):  # type: ignore[no-untyped-def]
    """Find the first hit of a few rays among all triangles.

    Parameters
    ----------
    rays
        Indices of the rays, (k,) int64.
    balls, groups
        Centre and radius of a ball round each triangle, (m, 4), and round each ``GROUP`` consecutive ones,
        (ceil(m / GROUP), 4), float64. Neighbours in a mesh file are neighbours in space, so most groups are passed over whole.
    triangles, normals, o, d, ranges
        As in :func:`settle`; ``ranges`` is filled for these rays.
    """
    ox, oy, oz = o[0], o[1], o[2]
    for r in range(rays.shape[0]):
        ray, best = rays[r], np.inf
        dx, dy, dz = d[ray, 0], d[ray, 1], d[ray, 2]
        for g in range(groups.shape[0]):
            if not _enters(groups[g, 0], groups[g, 1], groups[g, 2], groups[g, 3], ox, oy, oz, dx, dy, dz):
                continue
            for k in range(g * GROUP, min((g + 1) * GROUP, triangles.shape[0])):
                if _enters(balls[k, 0], balls[k, 1], balls[k, 2], balls[k, 3], ox, oy, oz, dx, dy, dz):
                    best = min(best, meet(triangles[k], normals[k], o, d[ray]))
        ranges[ray] = best


@_kernel
def can_meet(o, ends, size, reaches):  # type: ignore[no-untyped-def]
    """Tell which segments share a piece longer than CHORD_M with the box [0, size], its faces included.

    Parameters
    ----------
    o, ends
        The sensor (3,) in the box's frame, and where the segments end seen from it (n, 3), float64 metres.
    size
        Of the box, (3,) float64.
    reaches
        Filled, (n,) bool.
    """
    for n in range(ends.shape[0]):
        first, last, length2 = 0.0, 1.0, 0.0
        for a in range(3):
            d = ends[n, a]
            length2 += d * d
            if d == 0.0:
                if not 0.0 <= o[a] <= size[a]:
                    last = -1.0
            else:
                t0, t1 = (0.0 - o[a]) / d, (size[a] - o[a]) / d
                first, last = max(first, min(t0, t1)), min(last, max(t0, t1))
        reaches[n] = (last - first) * math.sqrt(length2) > CHORD_M
