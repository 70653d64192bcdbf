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
_inlined = compiled(forceinline=True)


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
def settle(nearest, owner, triangles, planes, o, beam, d, range_m, ranges, met, doubtful, ends, returned):  # type: ignore[no-untyped-def]
    """Place the hits that were proposed, and tell which proposals float32 cannot be trusted with.

    Parameters
    ----------
    nearest
        What each ray meets first in slightly enlarged form, as an index into ``owner``, -1 for none, (n,) int32.
    owner
        The triangle behind each, ``FIN`` for a fin; the last is none, -1. int32.
    triangles, planes
        All triangles (m, 3, 3) and their planes (m, 4, 4), float64.
    o
        The sensor, (3,) float64.
    beam, d
        Where the direction of each ray stands, (n,) uint32, in unit vectors (beams, 3) float64.
    range_m
        Of a hit that is further away, it is enough to know that it is.
    ranges
        Filled: range of each hit, infinity where nothing is met, (n,) float64.
    met
        Filled: the triangle that each ray meets; where nothing is met, of no meaning, (n,) int64.
    doubtful
        Filled: the rays that met a triangle less than ``SURE_M`` inside, its enlargement only, or at an angle below
        ``SHALLOW``, (n,) int64.
    ends, returned
        Filled: where each ray ends, seen from the sensor: at its hit, or at ``range_m`` where that is nearer, (n, 3);
        and whether it is a hit, (n,) bool.

    Returns
    -------
    int
        How many rays are doubtful; :func:`search` settles them.
    """
    ox, oy, oz, count = o[0], o[1], o[2], 0
    for ray in range(nearest.shape[0]):
        k = owner[nearest[ray]]
        met[ray] = k
        n = beam[ray]
        dx, dy, dz = d[n, 0], d[n, 1], d[n, 2]
        t, sure = _plainly_met(planes, max(k, 0), ox, oy, oz, dx, dy, dz, range_m)
        t = t if sure & (k >= 0) else np.inf
        ranges[ray] = t
        _end(ray, t, dx, dy, dz, range_m, ends, returned)
        if (k != -1) & ((k < -1) | (not sure)):
            if k >= 0:
                ranges[ray], _, _ = meet(triangles[k], planes[k], ox, oy, oz, dx, dy, dz)
            doubtful[count] = ray
            count += 1
    return count


@_inlined
def _end(ray, t, dx, dy, dz, range_m, ends, returned):  # type: ignore[no-untyped-def]
    """Fill where a ray ends that meets something at range ``t``."""
    returned[ray] = t <= range_m
    t = t if t <= range_m else range_m
    ends[ray, 0], ends[ray, 1], ends[ray, 2] = dx * t, dy * t, dz * t


@_inlined
def _plainly_met(planes, k, ox, oy, oz, dx, dy, dz, range_m):  # type: ignore[no-untyped-def]
    """Range at which a ray meets one triangle, and whether :func:`settle` can trust it: as :func:`meet`, for what is
    well inside and not seen too flat. Without a branch, since whether a beam meets anything cannot be foretold."""
    facing = planes[k, 0, 0] * dx + planes[k, 0, 1] * dy + planes[k, 0, 2] * dz
    away = planes[k, 0, 3] - (planes[k, 0, 0] * ox + planes[k, 0, 1] * oy + planes[k, 0, 2] * oz)
    t, sine = away / facing, abs(facing)
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    first = planes[k, 1, 0] * x + planes[k, 1, 1] * y + planes[k, 1, 2] * z - planes[k, 1, 3] >= SURE_M
    second = planes[k, 2, 0] * x + planes[k, 2, 1] * y + planes[k, 2, 2] * z - planes[k, 2, 3] >= SURE_M
    third = planes[k, 3, 0] * x + planes[k, 3, 1] * y + planes[k, 3, 2] * z - planes[k, 3, 3] >= SURE_M
    met = (sine >= GRAZE) & (abs(away) > EDGE_M) & (t >= 0.0) & first & second & third
    return t, met & ((sine >= SHALLOW) | (t > range_m + 1.0))


@_inlined
def _inverse(x):  # type: ignore[no-untyped-def]
    return 1.0 / x if abs(x) > 1.0 / _LARGEST else _LARGEST


@_kernel
def search(rays, triangles, planes, boxes, starts, o, beam, d, range_m, ranges, met, ends, returned):  # type: ignore[no-untyped-def]
    """Find the first hit of a few rays among all triangles.

    Parameters
    ----------
    rays
        Indices of the rays, (k,) int64.
    boxes, starts
        Boxes round the triangles, round each ``GROUP`` consecutive boxes of those, and so on to a single one: (b, 6)
        float64, low and high corner; where each level starts, (levels + 1,) int64.
    triangles, planes, o, beam, d, range_m, ranges, met, ends, returned
        As in :func:`settle`, which came before; the last four are filled for these rays. Nothing is looked for behind
        the hits that it placed.
    """
    ox, oy, oz, top = o[0], o[1], o[2], starts.shape[0] - 2
    for r in range(rays.shape[0]):
        ray, best, level, k = rays[r], np.inf, top, 0
        behind = ranges[ray]
        n = beam[ray]
        dx, dy, dz = d[n, 0], d[n, 1], d[n, 2]
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
        _end(ray, best, dx, dy, dz, range_m, ends, returned)


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
def _within(t0, t1, flat, d, first, last):  # type: ignore[no-untyped-def]
    """Cut [first, last] to the piece from t0 to t1, where a segment crosses the two ends of one axis of the box; to
    ``flat`` for one that stays where the sensor is. Nothing but selections: several segments are done at once."""
    low_t, high_t = t0 if t0 < t1 else t1, t1 if t0 < t1 else t0
    low_t, high_t = 0.0 if d == 0.0 else low_t, flat if d == 0.0 else high_t
    return low_t if low_t > first else first, high_t if high_t < last else last


@_inlined
def _is_tiny(d):  # type: ignore[no-untyped-def]
    """Whether 1 / d is too large for a product, and d is not 0."""
    return (abs(d) < 1.0 / _LARGEST) & (d != 0.0)


@_inlined
def _box_seen_from(o, size):  # type: ignore[no-untyped-def]
    """The sensor in the box's frame, how far the box goes on ahead of it, and, an axis each, 1 where a segment that
    stays on that axis is within the box, else -1."""
    ox, oy, oz, high_x, high_y, high_z = o[0], o[1], o[2], size[0] - o[0], size[1] - o[1], size[2] - o[2]
    flat_x = 1.0 if ox >= 0.0 and high_x >= 0.0 else -1.0
    flat_y = 1.0 if oy >= 0.0 and high_y >= 0.0 else -1.0
    flat_z = 1.0 if oz >= 0.0 and high_z >= 0.0 else -1.0
    return (ox, oy, oz), (high_x, high_y, high_z), (flat_x, flat_y, flat_z)


@_inlined
def _rounding(length_m):  # type: ignore[no-untyped-def]
    """By how much the rounding of t, at most 1, and of squares can change the square of a piece of about CHORD_M, of
    segments no longer than this."""
    wide = 1e-14 * length_m + 1e-9
    return wide * (2.0 * CHORD_M + wide)


@_kernel
def _some_meet(o, high, flat, some, range_m, wide, room, found):  # type: ignore[no-untyped-def]
    """Fill ``found`` for at most ``_AT_ONCE`` segments, see :func:`can_meet`; ``wide`` is :func:`_rounding`'s.

    Products with 1 / d and squares decide, unless a piece is so nearly as long as CHORD_M that their rounding could;
    then quotients and a root do, which take twice the time.
    """
    (ox, oy, oz), (high_x, high_y, high_z), (flat_x, flat_y, flat_z) = o, high, flat
    count, doubts = some.shape[0], 0
    for n in range(count):
        room[0, n], room[1, n], room[2, n] = some[n, 0] * range_m, some[n, 1] * range_m, some[n, 2] * range_m
    for n in range(count):
        x, y, z = room[0, n], room[1, n], room[2, n]
        per_x, per_y, per_z = 1.0 / x, 1.0 / y, 1.0 / z
        first, last = _within((0.0 - ox) * per_x, high_x * per_x, flat_x, x, 0.0, 1.0)
        first, last = _within((0.0 - oy) * per_y, high_y * per_y, flat_y, y, first, last)
        first, last = _within((0.0 - oz) * per_z, high_z * per_z, flat_z, z, first, last)
        square = (last - first) * (last - first) * (x * x + y * y + z * z)
        found[n] = (last > first) & (square > CHORD_M * CHORD_M)
        doubts += abs(square - CHORD_M * CHORD_M) <= wide
        doubts += _is_tiny(x) | _is_tiny(y) | _is_tiny(z)
    if doubts == 0:
        return
    for n in range(count):
        x, y, z = room[0, n], room[1, n], room[2, n]
        first, last = _within((0.0 - ox) / x, high_x / x, flat_x, x, 0.0, 1.0)
        first, last = _within((0.0 - oy) / y, high_y / y, flat_y, y, first, last)
        first, last = _within((0.0 - oz) / z, high_z / z, flat_z, z, first, last)
        found[n] = (last - first) * math.sqrt(x * x + y * y + z * z) > CHORD_M


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
    origin, high, flat = _box_seen_from(o, size)
    room, longest = np.empty((3, _AT_ONCE)), 0.0
    for n in range(ends.shape[0]):
        longest = max(longest, abs(ends[n, 0]) + abs(ends[n, 1]) + abs(ends[n, 2]))
    wide = _rounding(longest * range_m)
    for start in range(0, ends.shape[0], _AT_ONCE):
        stop = start + _AT_ONCE
        _some_meet(origin, high, flat, ends[start:stop], range_m, wide, room, reaches[start:stop])


@_kernel
def take(o, directions, size, range_m, beam):  # type: ignore[no-untyped-def]
    """Take the beams that can meet the box; how many they are.

    Parameters
    ----------
    o, size
        As in :func:`can_meet`.
    directions, range_m
        Unit vectors, (n, 3) float64, and how long the beams are.
    beam
        The first are filled: their indices, uint32. There is room for all.
    """
    origin, high, flat = _box_seen_from(o, size)
    room, found, k = np.empty((3, _AT_ONCE)), np.empty(_AT_ONCE, dtype=np.bool_), 0
    wide = _rounding(2.0 * range_m)
    for start in range(0, directions.shape[0], _AT_ONCE):
        some = directions[start : start + _AT_ONCE]
        _some_meet(origin, high, flat, some, range_m, wide, room, found)
        for n in range(some.shape[0]):
            if found[n]:
                beam[k] = start + n
                k += 1
    return k
