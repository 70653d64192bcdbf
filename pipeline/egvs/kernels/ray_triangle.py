r"""Exact ray-triangle intersection in float64, and which segments meet a box.

Frame: any with the world's axes, in metres, float64; a ray is :math:`o + t\,d` with unit :math:`d`, so t is the range.

Embree works in float32 and proposes hits; the functions here decide, by rules that do not depend on rounding:

- A ray meets a triangle when it pierces its plane at :math:`t = (n \cdot a - n \cdot o) / n \cdot d > 0`, no further
  than ``EDGE_M`` (1 micrometre) outside the triangle. So no ray slips between two triangles that share an edge or a
  vertex.
- A plane at an angle below ``GRAZE`` (1e-9) radians is not met; the surface next to it is.
- A plane that passes within ``EDGE_M`` of the start is not met: the sensor is mounted on it.

A triangle is stored as four planes (see :func:`triangle_planes`): its own, and one perpendicular to it through each
side, facing inwards.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from egvs.kernels.jit import njit

EDGE_M = 1e-6
"""A ray that passes outside a triangle's edge by no more than this meets the triangle."""

GRAZE = 1e-9
"""Sine of the angle below which a plane is not met."""

CERTAIN_M = 2e-5
"""Nearer to an edge, float32 may choose the wrong one of two triangles that share it: its rounding at 200 m."""

SHALLOW_SINE = 0.01
"""Sine of the angle below which float32's rounding, some 1e-5 m, moves a hit along the surface by millimetres."""

CHORD_M = 1e-6
"""A beam is cast when it shares a longer piece than this with the region of interest."""

FIN = -2
"""Stands for a fin of the enlarged mesh, which is no triangle: the hit of a ray that meets it first is uncertain."""

BOX_GROUP_SIZE = 8
"""Number of boxes that share the next larger box of a :class:`BoxTree`."""

_BLOCK_SIZE = 256  # segments whose components are laid out side by side

_LARGEST = 1e200  # stands for 1 / 0: times a length it is larger than any range, times zero it is zero

_kernel = njit()
_inlined = njit(forceinline=True)


class TriangleMesh(NamedTuple):
    """Triangles with their planes.

    Attributes
    ----------
    triangles
        Corners, (m, 3, 3) float64.
    planes
        From :func:`triangle_planes`, (m, 4, 4) float64.
    """

    triangles: Any
    planes: Any


class BoxTree(NamedTuple):
    """Boxes around triangles, around each ``BOX_GROUP_SIZE`` consecutive boxes of those, and so on up to a single one.

    Attributes
    ----------
    boxes
        Low and high corner of each, (b, 6) float64.
    starts
        Where each level starts, (levels + 1,) int64.
    """

    boxes: Any
    starts: Any


class Rays(NamedTuple):
    """Rays of one sensor.

    Attributes
    ----------
    o
        The sensor, (3,) float64.
    beam
        Index of each ray's direction, (n,) uint32.
    directions
        Unit vectors, (beams, 3) float64.
    range_m
        Range of the sensor: of a hit further away, only that is known.
    """

    o: Any
    beam: Any
    directions: Any
    range_m: float


class Hits(NamedTuple):
    """First hits of rays; arrays that the kernels fill.

    Attributes
    ----------
    ranges
        Range of each hit, infinite where nothing is met, (n,) float64.
    triangle
        The triangle that each ray meets; undefined where nothing is met, (n,) int64.
    ends
        Where each ray ends, relative to the sensor: at its hit, or at ``range_m`` where that is nearer, (n, 3) float64.
    returned
        Whether it ends at a hit, (n,) bool.
    """

    ranges: Any
    triangle: Any
    ends: Any
    returned: Any


@_kernel
def triangle_planes(triangles, normals, planes):  # type: ignore[no-untyped-def]
    """Fill the four planes of each triangle.

    Parameters
    ----------
    triangles, normals
        Corners (m, 3, 3) and unit normals (m, 3), float64; the corners of a triangle are distinct.
    planes
        Filled, (m, 4, 4) float64: row 0 is the triangle's plane, row 1 + i is perpendicular to it through the side from
        corner i to the next. Each row is a unit normal and its product with a point of the plane.
    """
    for m in range(triangles.shape[0]):
        n, a = normals[m], triangles[m, 0]
        plane = planes[m, 0]
        plane[0], plane[1], plane[2], plane[3] = n[0], n[1], n[2], n[0] * a[0] + n[1] * a[1] + n[2] * a[2]
        for i in range(3):
            a, b = triangles[m, i], triangles[m, (i + 1) % 3]
            x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
            length = math.sqrt(x * x + y * y + z * z)
            x, y, z = (n[1] * z - n[2] * y) / length, (n[2] * x - n[0] * z) / length, (n[0] * y - n[1] * x) / length
            side = planes[m, 1 + i]
            side[0], side[1], side[2], side[3] = x, y, z, x * a[0] + y * a[1] + z * a[2]


@_kernel
def resolve_hits(nearest, owner, mesh, rays, hits, uncertain):  # type: ignore[no-untyped-def]
    """Compute in float64 the hits that Embree proposed, and list those that float32 does not decide.

    Parameters
    ----------
    nearest
        What each ray meets first in slightly enlarged form, as an index of ``owner``, -1 for nothing, (n,) int32.
    owner
        The triangle behind each enlarged one, ``FIN`` for a fin; the last element, for nothing, is -1. int32.
    mesh, rays
        :class:`TriangleMesh` and :class:`Rays`.
    hits
        :class:`Hits`, filled.
    uncertain
        Filled: the rays that met a triangle less than ``CERTAIN_M`` inside, only its enlargement, or at an angle below
        ``SHALLOW_SINE``, (n,) int64.

    Returns
    -------
    int
        Number of uncertain rays, for :func:`search_triangles`.
    """
    o, count = (rays.o[0], rays.o[1], rays.o[2]), 0
    for ray in range(nearest.shape[0]):
        k = owner[nearest[ray]]
        hits.triangle[ray] = k
        n = rays.beam[ray]
        d = rays.directions[n, 0], rays.directions[n, 1], rays.directions[n, 2]
        t, certain = _intersect_if_certain(mesh.planes, max(k, 0), o, d, rays.range_m)
        t = t if certain & (k >= 0) else np.inf
        hits.ranges[ray] = t
        _set_end(hits, ray, t, d, rays.range_m)
        if (k != -1) & ((k < -1) | (not certain)):
            if k >= 0:
                hits.ranges[ray] = intersect(mesh.triangles[k], mesh.planes[k], o, d)
            uncertain[count] = ray
            count += 1
    return count


@_kernel
def search_triangles(selected, mesh, tree, rays, hits):  # type: ignore[no-untyped-def]
    """Find the first hit of a few rays among all triangles.

    Parameters
    ----------
    selected
        Indices of the rays, (k,) int64.
    mesh, tree, rays
        :class:`TriangleMesh`, the :class:`BoxTree` of its triangles, and :class:`Rays`.
    hits
        As :func:`resolve_hits` fills it; changed for the selected rays. Triangles behind ``ranges`` are not searched.
    """
    boxes, starts = tree.boxes, tree.starts
    o, top = (rays.o[0], rays.o[1], rays.o[2]), starts.shape[0] - 2
    for r in range(selected.shape[0]):
        ray, best, level, k = selected[r], np.inf, top, 0
        behind = hits.ranges[ray]
        n = rays.beam[ray]
        d = rays.directions[n, 0], rays.directions[n, 1], rays.directions[n, 2]
        per_x, per_y, per_z = _inverse(d[0]), _inverse(d[1]), _inverse(d[2])
        while True:
            box = boxes[starts[level] + k]
            x0, x1 = (box[0] - o[0]) * per_x, (box[3] - o[0]) * per_x
            y0, y1 = (box[1] - o[1]) * per_y, (box[4] - o[1]) * per_y
            z0, z1 = (box[2] - o[2]) * per_z, (box[5] - o[2]) * per_z
            first = max(max(min(x0, x1), min(y0, y1)), max(min(z0, z1), 0.0))
            last = min(min(max(x0, x1), max(y0, y1)), min(max(z0, z1), behind))
            if first <= last and level > 0:
                level, k = level - 1, k * BOX_GROUP_SIZE
                continue
            if first <= last:
                t = intersect(mesh.triangles[k], mesh.planes[k], o, d)
                if t < best:
                    best, hits.triangle[ray] = t, k
                    behind = min(behind, t)
            k += 1
            while level < top and (k % BOX_GROUP_SIZE == 0 or k == starts[level + 1] - starts[level]):
                level, k = level + 1, (k - 1) // BOX_GROUP_SIZE + 1
            if level == top:
                break
        hits.ranges[ray] = best
        _set_end(hits, ray, best, d, rays.range_m)


@_kernel
def touched_triangles(triangles, planes, point, touched):  # type: ignore[no-untyped-def]
    """Fill whether a point (3,) lies on each triangle, to ``EDGE_M``: ``touched``, (m,) bool."""
    x, y, z = point[0], point[1], point[2]
    for m in range(triangles.shape[0]):
        n = planes[m, 0]
        away = n[0] * x + n[1] * y + n[2] * z - n[3]
        on_triangle = contains_point(triangles[m], planes[m], x - away * n[0], y - away * n[1], z - away * n[2])
        touched[m] = on_triangle and abs(away) <= EDGE_M


@_inlined
def intersect(triangle, plane, o, d):  # type: ignore[no-untyped-def]
    """Range at which a ray meets one triangle; infinite when it does not.

    Parameters
    ----------
    triangle, plane
        Corners (3, 3) and planes (4, 4), float64.
    o, d
        Start and unit direction of the ray, three float64 each.
    """
    facing = plane[0, 0] * d[0] + plane[0, 1] * d[1] + plane[0, 2] * d[2]
    away = plane[0, 3] - (plane[0, 0] * o[0] + plane[0, 1] * o[1] + plane[0, 2] * o[2])
    if not (abs(facing) >= GRAZE and abs(away) > EDGE_M):
        return np.inf
    t = away / facing
    if t < 0.0 or not contains_point(triangle, plane, o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]):
        return np.inf
    return t


@_inlined
def contains_point(triangle, plane, x, y, z):  # type: ignore[no-untyped-def]
    """Whether a point of a triangle's plane is in the triangle, or no further than ``EDGE_M`` outside."""
    depth = min(
        plane[1, 0] * x + plane[1, 1] * y + plane[1, 2] * z - plane[1, 3],
        plane[2, 0] * x + plane[2, 1] * y + plane[2, 2] * z - plane[2, 3],
        plane[3, 0] * x + plane[3, 1] * y + plane[3, 2] * z - plane[3, 3],
    )
    if depth >= 0.0:
        return True
    if depth < -EDGE_M:
        return False
    near = _near_segment(x, y, z, triangle[0], triangle[1]) or _near_segment(x, y, z, triangle[1], triangle[2])
    return near or _near_segment(x, y, z, triangle[2], triangle[0])


@_inlined
def _near_segment(x, y, z, a, b):  # type: ignore[no-untyped-def]
    """Whether a point is within ``EDGE_M`` of the segment from a to b."""
    bx, by, bz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    px, py, pz = x - a[0], y - a[1], z - a[2]
    s = min(max((px * bx + py * by + pz * bz) / (bx * bx + by * by + bz * bz), 0.0), 1.0)
    px, py, pz = px - s * bx, py - s * by, pz - s * bz
    return px * px + py * py + pz * pz <= EDGE_M * EDGE_M


@_inlined
def _intersect_if_certain(planes, k, o, d, range_m):  # type: ignore[no-untyped-def]
    """Range at which a ray meets triangle k, and whether that is certain: as :func:`intersect`, without a branch.

    Certain is a hit well inside the triangle at an angle that is not shallow. Whether a beam meets anything is random,
    so branches would be mispredicted.
    """
    facing = planes[k, 0, 0] * d[0] + planes[k, 0, 1] * d[1] + planes[k, 0, 2] * d[2]
    away = planes[k, 0, 3] - (planes[k, 0, 0] * o[0] + planes[k, 0, 1] * o[1] + planes[k, 0, 2] * o[2])
    t, sine = away / facing, abs(facing)
    x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
    first = planes[k, 1, 0] * x + planes[k, 1, 1] * y + planes[k, 1, 2] * z - planes[k, 1, 3] >= CERTAIN_M
    second = planes[k, 2, 0] * x + planes[k, 2, 1] * y + planes[k, 2, 2] * z - planes[k, 2, 3] >= CERTAIN_M
    third = planes[k, 3, 0] * x + planes[k, 3, 1] * y + planes[k, 3, 2] * z - planes[k, 3, 3] >= CERTAIN_M
    met = (sine >= GRAZE) & (abs(away) > EDGE_M) & (t >= 0.0) & first & second & third
    return t, met & ((sine >= SHALLOW_SINE) | (t > range_m + 1.0))


@_inlined
def _set_end(hits, ray, t, d, range_m):  # type: ignore[no-untyped-def]
    """Fill where a ray ends that meets something at range ``t``."""
    hits.returned[ray] = t <= range_m
    t = t if t <= range_m else range_m
    hits.ends[ray, 0], hits.ends[ray, 1], hits.ends[ray, 2] = d[0] * t, d[1] * t, d[2] * t


@_inlined
def _inverse(x):  # type: ignore[no-untyped-def]
    return 1.0 / x if abs(x) > 1.0 / _LARGEST else _LARGEST


# --- segments that meet a box -----------------------------------------------------------------------------------------


@_kernel
def can_meet_box(o, ends, size, reaches, range_m=1.0):  # type: ignore[no-untyped-def]
    """Fill whether each segment shares a piece longer than ``CHORD_M`` with the box [0, size], its faces included.

    Parameters
    ----------
    o, ends
        The sensor (3,) in the box's frame, and the ends of the segments relative to it (n, 3), in multiples of
        ``range_m``; float64.
    size
        Of the box, (3,) float64.
    reaches
        Filled, (n,) bool.
    """
    box = _box_from_sensor(o, size)
    buffer, longest = np.empty((3, _BLOCK_SIZE)), 0.0
    for n in range(ends.shape[0]):
        longest = max(longest, abs(ends[n, 0]) + abs(ends[n, 1]) + abs(ends[n, 2]))
    rounding = _rounding_error(longest * range_m)
    for start in range(0, ends.shape[0], _BLOCK_SIZE):
        stop = start + _BLOCK_SIZE
        _block_can_meet(box, ends[start:stop], range_m, rounding, buffer, reaches[start:stop])


@_kernel
def select_beams(o, directions, size, range_m, beam):  # type: ignore[no-untyped-def]
    """Select the beams that can meet the box.

    Parameters
    ----------
    o, size
        As in :func:`can_meet_box`.
    directions, range_m
        Unit vectors, (n, 3) float64, and the length of the beams.
    beam
        The first elements are filled with the indices of the selected beams, (n,) uint32.

    Returns
    -------
    int
        Number of selected beams.
    """
    box = _box_from_sensor(o, size)
    buffer, meets, k = np.empty((3, _BLOCK_SIZE)), np.empty(_BLOCK_SIZE, dtype=np.bool_), 0
    rounding = _rounding_error(2.0 * range_m)
    for start in range(0, directions.shape[0], _BLOCK_SIZE):
        block = directions[start : start + _BLOCK_SIZE]
        _block_can_meet(box, block, range_m, rounding, buffer, meets)
        for n in range(block.shape[0]):
            if meets[n]:
                beam[k] = start + n
                k += 1
    return k


class _BoxFromSensor(NamedTuple):
    """A box [0, size] as one sensor sees it, three numbers each.

    Attributes
    ----------
    o
        The sensor.
    high
        The box's high corner, relative to the sensor.
    flat
        Of each axis, 1 where a segment that does not move along it is within the box, else -1.
    """

    o: tuple[float, float, float]
    high: tuple[float, float, float]
    flat: tuple[float, float, float]


@_inlined
def _box_from_sensor(o, size):  # type: ignore[no-untyped-def]
    ox, oy, oz, high_x, high_y, high_z = o[0], o[1], o[2], size[0] - o[0], size[1] - o[1], size[2] - o[2]
    flat_x = 1.0 if ox >= 0.0 and high_x >= 0.0 else -1.0
    flat_y = 1.0 if oy >= 0.0 and high_y >= 0.0 else -1.0
    flat_z = 1.0 if oz >= 0.0 and high_z >= 0.0 else -1.0
    return _BoxFromSensor((ox, oy, oz), (high_x, high_y, high_z), (flat_x, flat_y, flat_z))


@_kernel
def _block_can_meet(box, block, range_m, rounding, buffer, meets):  # type: ignore[no-untyped-def]
    """Fill ``meets`` for at most ``_BLOCK_SIZE`` segments; ``rounding`` is from :func:`_rounding_error`.

    Products with 1 / d and squares decide, unless a piece is so nearly as long as ``CHORD_M`` that their rounding could
    matter; then quotients and a root do, which take twice the time.
    """
    (ox, oy, oz), (high_x, high_y, high_z), (flat_x, flat_y, flat_z) = box.o, box.high, box.flat
    count, uncertain = block.shape[0], 0
    for n in range(count):
        buffer[0, n], buffer[1, n], buffer[2, n] = block[n, 0] * range_m, block[n, 1] * range_m, block[n, 2] * range_m
    for n in range(count):
        x, y, z = buffer[0, n], buffer[1, n], buffer[2, n]
        per_x, per_y, per_z = 1.0 / x, 1.0 / y, 1.0 / z
        first, last = _clip_to_slab((0.0 - ox) * per_x, high_x * per_x, flat_x, x, 0.0, 1.0)
        first, last = _clip_to_slab((0.0 - oy) * per_y, high_y * per_y, flat_y, y, first, last)
        first, last = _clip_to_slab((0.0 - oz) * per_z, high_z * per_z, flat_z, z, first, last)
        square = (last - first) * (last - first) * (x * x + y * y + z * z)
        meets[n] = (last > first) & (square > CHORD_M * CHORD_M)
        uncertain += abs(square - CHORD_M * CHORD_M) <= rounding
        uncertain += _is_tiny(x) | _is_tiny(y) | _is_tiny(z)
    if uncertain == 0:
        return
    for n in range(count):
        x, y, z = buffer[0, n], buffer[1, n], buffer[2, n]
        first, last = _clip_to_slab((0.0 - ox) / x, high_x / x, flat_x, x, 0.0, 1.0)
        first, last = _clip_to_slab((0.0 - oy) / y, high_y / y, flat_y, y, first, last)
        first, last = _clip_to_slab((0.0 - oz) / z, high_z / z, flat_z, z, first, last)
        meets[n] = (last - first) * math.sqrt(x * x + y * y + z * z) > CHORD_M


@_inlined
def _clip_to_slab(t0, t1, flat, d, first, last):  # type: ignore[no-untyped-def]
    """Clip [first, last] to the part between t0 and t1, where a segment crosses the two ends of one axis of the box.

    ``flat`` replaces both for a segment that does not move along the axis. Selections only, without a branch: several
    segments are clipped at once.
    """
    low_t, high_t = t0 if t0 < t1 else t1, t1 if t0 < t1 else t0
    low_t, high_t = 0.0 if d == 0.0 else low_t, flat if d == 0.0 else high_t
    return low_t if low_t > first else first, high_t if high_t < last else last


@_inlined
def _is_tiny(d):  # type: ignore[no-untyped-def]
    """Whether 1 / d is too large for a product, and d is not 0."""
    return (abs(d) < 1.0 / _LARGEST) & (d != 0.0)


@_inlined
def _rounding_error(length_m):  # type: ignore[no-untyped-def]
    """How much the rounding of t and of squares changes the square of a piece of about ``CHORD_M``, at most.

    For segments no longer than ``length_m``, and t up to 1.
    """
    error = 1e-14 * length_m + 1e-9
    return error * (2.0 * CHORD_M + error)
