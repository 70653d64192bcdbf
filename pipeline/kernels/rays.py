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

_AT_ONCE = 256  # segments whose components are laid out one beside the other

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
def settle(nearest, owner, triangles, planes, o, d, range_m, ranges, met, doubtful):  # type: ignore[no-untyped-def]
    """Place the hits that were proposed, and tell which proposals float32 cannot be trusted with.

    Parameters
    ----------
    nearest
        What each ray meets first in slightly enlarged form, as an index into ``owner``, -1 for none, (n,) int32.
    owner
        The triangle behind each, ``FIN`` for a fin; the last is none, -1. int64.
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
    for ray in range(nearest.shape[0]):
        k = owner[nearest[ray]]
        met[ray] = k
        t, sure = _plainly_met(planes[max(k, 0)], ox, oy, oz, d[ray, 0], d[ray, 1], d[ray, 2], range_m)
        ranges[ray] = t if sure and k >= 0 else np.inf
        if (not sure and k != -1) or k < -1:
            if k >= 0:
                ranges[ray], _, _ = meet(triangles[k], planes[k], ox, oy, oz, d[ray, 0], d[ray, 1], d[ray, 2])
            doubtful[count] = ray
            count += 1
    return count


@_inlined
def _plainly_met(plane, ox, oy, oz, dx, dy, dz, range_m):  # type: ignore[no-untyped-def]
    """Range at which a ray meets one triangle, and whether :func:`settle` can trust it: as :func:`meet`, for what is
    well inside and not seen too flat. Without a branch, since whether a beam meets anything cannot be foretold."""
    facing = plane[0, 0] * dx + plane[0, 1] * dy + plane[0, 2] * dz
    away = plane[0, 3] - (plane[0, 0] * ox + plane[0, 1] * oy + plane[0, 2] * oz)
    t, sine = away / facing, abs(facing)
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    first = plane[1, 0] * x + plane[1, 1] * y + plane[1, 2] * z - plane[1, 3] >= SURE_M
    second = plane[2, 0] * x + plane[2, 1] * y + plane[2, 2] * z - plane[2, 3] >= SURE_M
    third = plane[3, 0] * x + plane[3, 1] * y + plane[3, 2] * z - plane[3, 3] >= SURE_M
    met = (sine >= GRAZE) & (abs(away) > EDGE_M) & (t >= 0.0) & first & second & third
    return t, met & ((sine >= SHALLOW) | (t > range_m + 1.0))


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
        As in :func:`settle`, which came before; ``ranges`` and ``met`` are filled for these rays. Nothing is looked for
        behind the hits that it placed.
    """
    ox, oy, oz, top = o[0], o[1], o[2], starts.shape[0] - 2
    for r in range(rays.shape[0]):
        ray, best, level, k = rays[r], np.inf, top, 0
        behind = ranges[ray]
        dx, dy, dz = d[ray, 0], d[ray, 1], d[ray, 2]
        per_x, per_y, per_z = _inverse(dx), _inverse(dy), _inverse(dz)
        while True:
            box = boxes[starts[level] + k]
            x0, x1 = (box[0] - ox) * per_x, (box[3] - ox) * per_x
            y0, y1 = (box[1] - oy) * per_y, (box[4] - oy) * per_y
            z0, z1 = (box[2] - oz) * per_z, (box[5] - oz) * per_z
            first = max(max(min(x0, x1), min(y0, y1)), max(min(z0, z1), 0.0))
            last = min(min(max(x0, x1), max(y0, y1)), min(max(z0, z1), behind))
            if first <= last and level > 0:
                level, k = level - 1, k * GROUP
                continue
            if first <= last:
                t, _, _ = meet(triangles[k], planes[k], ox, oy, oz, dx, dy, dz)
                if t < best:
                    best, met[ray] = t, k
                    behind = min(behind, t)
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


@_inlined
def _within(o, high, flat, d, first, last):  # type: ignore[no-untyped-def]
    """Cut [first, last] to one axis of the box, which ends ``high`` ahead of the sensor, and at ``flat`` for a segment
    that stays where the sensor is. Nothing but selections: several segments are done at once."""
    t0, t1 = (0.0 - o) / d, high / d
    low_t, high_t = t0 if t0 < t1 else t1, t1 if t0 < t1 else t0
    low_t, high_t = 0.0 if d == 0.0 else low_t, flat if d == 0.0 else high_t
    return low_t if low_t > first else first, high_t if high_t < last else last


@_kernel
def can_meet(o, ends, size, reaches, range_m=1.0):  # type: ignore[no-untyped-def]
    """Tell which segments share a piece longer than CHORD_M with the box [0, size], its faces included.

    Parameters
    ----------
    o, ends
        The sensor (3,) in the box's frame, and where the segments end seen from it (n, 3), in ``range_m``; float64.
    size
        Of the box, (3,) float64.
    reaches
        Filled, (n,) bool.
    """
    ox, oy, oz, high_x, high_y, high_z = o[0], o[1], o[2], size[0] - o[0], size[1] - o[1], size[2] - o[2]
    flat_x = 1.0 if ox >= 0.0 and high_x >= 0.0 else -1.0
    flat_y = 1.0 if oy >= 0.0 and high_y >= 0.0 else -1.0
    flat_z = 1.0 if oz >= 0.0 and high_z >= 0.0 else -1.0
    x, y, z = np.empty(_AT_ONCE), np.empty(_AT_ONCE), np.empty(_AT_ONCE)
    for start in range(0, ends.shape[0], _AT_ONCE):
        some = ends[start : start + _AT_ONCE]
        for n in range(some.shape[0]):
            x[n], y[n], z[n] = some[n, 0] * range_m, some[n, 1] * range_m, some[n, 2] * range_m
        found = reaches[start : start + _AT_ONCE]
        for n in range(some.shape[0]):
            first, last = _within(ox, high_x, flat_x, x[n], 0.0, 1.0)
            first, last = _within(oy, high_y, flat_y, y[n], first, last)
            first, last = _within(oz, high_z, flat_z, z[n], first, last)
            found[n] = (last - first) * math.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n]) > CHORD_M


@_kernel
def take(reaches, directions, beam, d, single):  # type: ignore[no-untyped-def]
    """Take the beams that reach: filled are their indices ``beam`` (k,) uint32, their directions ``d`` (k, 3) float64,
    and ``single``, these as float32."""
    k = 0
    for n in range(directions.shape[0]):
        if reaches[n]:
            x, y, z = directions[n, 0], directions[n, 1], directions[n, 2]
            beam[k] = n
            d[k, 0], d[k, 1], d[k, 2] = x, y, z
            single[k, 0], single[k, 1], single[k, 2] = x, y, z
            k += 1


@_kernel
def end(ranges, d, range_m, ends, returned):  # type: ignore[no-untyped-def]
    """Fill where each ray ends, ``ends`` (n, 3), seen from the sensor: at its hit, or at ``range_m`` where that is
    nearer; and whether it is a hit, ``returned`` (n,) bool."""
    for ray in range(ranges.shape[0]):
        t = ranges[ray]
        returned[ray] = t <= range_m
        t = t if t <= range_m else range_m
        ends[ray, 0], ends[ray, 1], ends[ray, 2] = d[ray, 0] * t, d[ray, 1] * t, d[ray, 2] * t
