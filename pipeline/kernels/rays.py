r"""Finds exactly where a ray meets a triangle.

Frame: any one with the world's axes, in metres, float64; ray :math:`o + t\,d` with unit :math:`d`, so t is the range.

Embree works in float32 and proposes; the functions here decide, by rules that rounding cannot turn:

- A ray meets a triangle when it pierces its plane at :math:`t = (n \cdot a - n \cdot o) / n \cdot d > 0`, no further
  than ``EDGE_M`` (1 micrometre) outside the triangle. So no ray slips between two triangles that share an edge or a
  vertex.
- A plane seen at less than ``GRAZE`` (1e-9) radians is not met; the surface beside it is.
- A plane that passes within ``EDGE_M`` of the start is not met: the sensor stands on it.

A triangle is kept as four planes (see :func:`planes`): its own, and one upright on each side, facing inwards.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.kernels.compile_cache import compiled

EDGE_M = 1e-6
"""A ray that passes a triangle's edge no further outside than this meets the triangle."""

GRAZE = 1e-9
"""A plane seen at a smaller angle (its sine) is not met."""

SURE_M = 2e-5
"""Nearer to an edge than this, float32 may take the wrong one of the two triangles that share it: its rounding at 200
m."""

SHALLOW = 0.01
"""A surface seen at a smaller angle (its sine): float32's rounding, some 1e-5 m, moves the hit on it by millimetres."""

CHORD_M = 1e-6
"""A ray that shares no longer piece with the region of interest is not cast."""

FIN = -2
"""Stands for a fin, which is no triangle: a ray that meets it first is doubtful."""

GROUP = 8
"""Boxes that share the next larger box in :func:`search`."""

_LARGEST = 1e200  # stands for 1 / 0: times a length it is larger than any range, times zero it is zero

_kernel = compiled()
_inlined = compiled(inline="always")


@_kernel
def planes(triangles, normals, found):  # type: ignore[no-untyped-def]
    """Fill the four planes of each triangle.

    Parameters
    ----------
    triangles, normals
        Corners (m, 3, 3) and unit normals (m, 3), float64; no two corners of a triangle at one place.
    found
        Filled, (m, 4, 4) float64: row 0 is the triangle's own plane, row 1 + i stands on the side from corner i to the
        next. Each holds a unit normal and its product with a point of the plane.
    """
    for m in range(triangles.shape[0]):
        n, a = normals[m], triangles[m, 0]
        own = found[m, 0]
        own[0], own[1], own[2], own[3] = n[0], n[1], n[2], n[0] * a[0] + n[1] * a[1] + n[2] * a[2]
        for i in range(3):
            a, b = triangles[m, i], triangles[m, (i + 1) % 3]
            x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
            length = math.sqrt(x * x + y * y + z * z)
            x, y, z = (n[1] * z - n[2] * y) / length, (n[2] * x - n[0] * z) / length, (n[0] * y - n[1] * x) / length
            side = found[m, 1 + i]
            side[0], side[1], side[2], side[3] = x, y, z, x * a[0] + y * a[1] + z * a[2]


@_inlined
def _near_segment(x, y, z, a, b):  # type: ignore[no-untyped-def]
    """Whether a point lies within EDGE_M of the segment from a to b."""
    bx, by, bz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    px, py, pz = x - a[0], y - a[1], z - a[2]
    s = min(max((px * bx + py * by + pz * bz) / (bx * bx + by * by + bz * bz), 0.0), 1.0)
    px, py, pz = px - s * bx, py - s * by, pz - s * bz
    return px * px + py * py + pz * pz <= EDGE_M * EDGE_M


@_inlined
def _inside(triangle, plane, x, y, z):  # type: ignore[no-untyped-def]
    """How far inside a triangle a point of its plane lies (negative: outside), and whether that counts as on it."""
    depth = min(
        plane[1, 0] * x + plane[1, 1] * y + plane[1, 2] * z - plane[1, 3],
        plane[2, 0] * x + plane[2, 1] * y + plane[2, 2] * z - plane[2, 3],
        plane[3, 0] * x + plane[3, 1] * y + plane[3, 2] * z - plane[3, 3],
    )
    if depth >= 0.0:
        return depth, True
    if depth < -EDGE_M:
        return depth, False
    near = _near_segment(x, y, z, triangle[0], triangle[1]) or _near_segment(x, y, z, triangle[1], triangle[2])
    return depth, near or _near_segment(x, y, z, triangle[2], triangle[0])


@_inlined
def meet(triangle, plane, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Range at which a ray meets one triangle (infinity when it does not), how far inside that is, and the sine of the
    angle.

    Parameters
    ----------
    triangle, plane
        Corners (3, 3) and planes (4, 4), float64.
    ox, oy, oz, dx, dy, dz
        Start and unit direction of the ray.
    """
    facing = plane[0, 0] * dx + plane[0, 1] * dy + plane[0, 2] * dz
    away = plane[0, 3] - (plane[0, 0] * ox + plane[0, 1] * oy + plane[0, 2] * oz)
    if not (abs(facing) >= GRAZE and abs(away) > EDGE_M):
        return np.inf, -np.inf, 0.0
    t = away / facing
    if t < 0.0:
        return np.inf, -np.inf, 0.0
    depth, on = _inside(triangle, plane, ox + t * dx, oy + t * dy, oz + t * dz)
    return (t if on else np.inf), depth, abs(facing)


@_kernel
def settle(proposed, triangles, planes, o, d, range_m, ranges, met, doubtful):  # type: ignore[no-untyped-def]
    """Place the hits that were proposed, and tell which proposals float32 cannot be trusted with.

    Parameters
    ----------
    proposed
        Index of the triangle that each ray meets first in slightly enlarged form, -1 for none, ``FIN`` for a fin, (n,)
        int64.
    triangles, planes
        All triangles (m, 3, 3) and their planes (m, 4, 4), float64.
    o, d
        The sensor (3,) and the rays' unit directions (n, 3), float64.
    range_m
        Of a hit that is further away, it is enough to know that it is.
    ranges
        Filled: range of each hit, infinity where nothing is met, (n,) float64.
    met
        Filled: the triangle that each ray meets; where nothing is met, of no meaning, (n,) int64.
    doubtful
        Filled: the rays that met a triangle less than ``SURE_M`` inside, its enlargement only, or at an angle below
        ``SHALLOW``, (n,) int64.

    Returns
    -------
    int
        How many rays are doubtful; :func:`search` settles them.
    """
    ox, oy, oz, count = o[0], o[1], o[2], 0
    for ray in range(proposed.shape[0]):
        ranges[ray], k = np.inf, proposed[ray]
        met[ray] = k
        if k >= 0:
            ranges[ray], depth, sine = meet(triangles[k], planes[k], ox, oy, oz, d[ray, 0], d[ray, 1], d[ray, 2])
            if depth >= SURE_M and (sine >= SHALLOW or ranges[ray] > range_m + 1.0):
                continue
        if k != -1:
            doubtful[count] = ray
            count += 1
    return count


@_inlined
def _inverse(x):  # type: ignore[no-untyped-def]
    return 1.0 / x if abs(x) > 1.0 / _LARGEST else _LARGEST


@_kernel
def search(rays, triangles, planes, boxes, starts, o, d, ranges, met):  # type: ignore[no-untyped-def]
    """Find the first hit of a few rays among all triangles.

    Parameters
    ----------
    rays
        Indices of the rays, (k,) int64.
    boxes, starts
        Boxes round the triangles, round each ``GROUP`` consecutive boxes of those, and so on to a single one: (b, 6)
        float64, low and high corner; where each level starts, (levels + 1,) int64.
    triangles, planes, o, d, ranges, met
        As in :func:`settle`; ``ranges`` and ``met`` are filled for these rays.
    """
    ox, oy, oz, top = o[0], o[1], o[2], starts.shape[0] - 2
    for r in range(rays.shape[0]):
        ray, best, level, k = rays[r], np.inf, top, 0
        dx, dy, dz = d[ray, 0], d[ray, 1], d[ray, 2]
        per_x, per_y, per_z = _inverse(dx), _inverse(dy), _inverse(dz)
        while True:
            box = boxes[starts[level] + k]
            x0, x1 = (box[0] - ox) * per_x, (box[3] - ox) * per_x
            y0, y1 = (box[1] - oy) * per_y, (box[4] - oy) * per_y
            z0, z1 = (box[2] - oz) * per_z, (box[5] - oz) * per_z
            first = max(max(min(x0, x1), min(y0, y1)), max(min(z0, z1), 0.0))
            last = min(min(max(x0, x1), max(y0, y1)), min(max(z0, z1), best))
            if first <= last and level > 0:
                level, k = level - 1, k * GROUP
                continue
            if first <= last:
                t, _, _ = meet(triangles[k], planes[k], ox, oy, oz, dx, dy, dz)
                if t < best:
                    best, met[ray] = t, k
            k += 1
            while level < top and (k % GROUP == 0 or k == starts[level + 1] - starts[level]):
                level, k = level + 1, (k - 1) // GROUP + 1
            if level == top:
                break
        ranges[ray] = best


@_kernel
def stands_on(triangles, planes, point, touched):  # type: ignore[no-untyped-def]
    """Tell which triangles a point (3,) lies on, to ``EDGE_M``: ``touched`` is filled, (m,) bool."""
    x, y, z = point[0], point[1], point[2]
    for m in range(triangles.shape[0]):
        n = planes[m, 0]
        away = n[0] * x + n[1] * y + n[2] * z - n[3]
        _, on = _inside(triangles[m], planes[m], x - away * n[0], y - away * n[1], z - away * n[2])
        touched[m] = on and abs(away) <= EDGE_M


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
