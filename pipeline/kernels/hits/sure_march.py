r"""Lists the voxels that a segment crosses by multiplications alone, or says that it is not certain of them.

Frame: the grid's own, in voxel units, as in :mod:`pipeline.kernels.march`, whose decisions these are; it decides by
itself what is not certain here (one beam in several hundred).

A voxel is entered where the segment crosses a plane. For each plane of an axis, the other two coordinates are computed
where it is crossed; rounded down, they and the plane name the voxel. Coordinates are fixed-point numbers with
``_BITS`` binary digits behind the point, each the last one plus a step, so that a processor does several at once and no
crossing waits for another: nothing is merged or sorted.

That gives what the march gives wherever every decision is far from turning. With u = 2**-53 and S the grid's longest
side plus the sensor's largest coordinate:

- a coordinate here, from a rounded inverse, two products and two sums, is off by at most 8 u S, and by less than a last
  digit for its start and for each step, which are cut off; a crossing of the march is off by 2 u of its distance from
  the sensor, which is at most sqrt(3) S, so the distance of two by 7 u S and a rounding;
- so where each coordinate is further from the next plane than ``CHORD_M`` and 16 u S and those digits, no two crossings
  lie as near as ``CHORD_M``: their order is certain, and so is that each voxel between two of them counts;
- the same distance is asked of both ends of what lies in the grid. Exempt are the grid's own faces, which nothing
  crosses; a sensor that stands exactly on a plane; and an end so near a plane that the voxel behind it cannot count.

A component that is exactly 0 crosses nothing: its coordinate stands for the middle of its voxel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.kernels.compile_cache import compiled

_BITS = np.uint64(40)
_ONE = 2.0**40
_FRACTION = np.uint64(2**40 - 1)
_WIDEST = 2.0**20
"""Grids of more voxels along an axis would not fit beside the digits."""
_MOST_CELLS = 2.0**32
_AT_ONCE = 16
"""Crossings are computed in groups: what a processor of today does at once, a few times over."""
_SMALLEST, _LARGEST = 2.0**-500, 2.0**500
"""Components between these (or 0) and their inverses and products neither vanish nor overflow."""

_kernel = compiled()
_inlined = compiled(forceinline=True)


class Room(NamedTuple):
    """How near is too near, for one sensor and grid, in voxels.

    Attributes
    ----------
    chord
        The longest chord that is no contact.
    rounding
        The most that rounding displaces anything.
    plane
        Of a coordinate that is nearer to a plane, it is not certain on which side it counts; infinite where nothing is
        certain.
    """

    chord: float
    rounding: float
    plane: float


@_kernel
def room(o, shape, chord):  # type: ignore[no-untyped-def]
    """What :func:`crossed` asks of the distances: the sensor (3,), the grid's shape (3,), the chord in voxels."""
    most = float(max(shape[0], shape[1], shape[2]))
    rounding = 2.0**-49 * (most + max(abs(o[0]), abs(o[1]), abs(o[2])))
    plane = 1.001 * chord + rounding + (most + 4.0) / _ONE
    cells = float(shape[0]) * float(shape[1]) * float(shape[2])
    if not (plane < 0.1 and most <= _WIDEST and cells <= _MOST_CELLS):
        plane = np.inf
    return Room(chord, rounding, plane)


@_kernel
def scratch(shape):  # type: ignore[no-untyped-def]
    """As much as :func:`crossed` may fill: more than it returns."""
    return np.empty(shape[0] + shape[1] + shape[2] + 1 + _AT_ONCE, np.uint32)


@_inlined
def _clip(o, d, inverse, n, t_first, t_last):  # type: ignore[no-untyped-def]
    """Cut [t_first, t_last] to the grid along one axis; t_first is larger where nothing is left."""
    if d == 0.0:
        return (t_first, t_last) if 0.0 <= o < n else (1.0, 0.0)
    a, b = (0.0 - o) * inverse, (n - o) * inverse
    return max(t_first, min(a, b)), min(t_last, max(a, b))


@_inlined
def _ends(o, d, n, t_first, t_last, near, tail):  # type: ignore[no-untyped-def]
    """Along one axis: the voxels of both ends, and whether they are certain.

    ``tail``: an end nearer to a plane than this share of ``d``, less rounding, leaves no voxel behind it that counts.
    """
    if d == 0.0:
        return np.floor(o), np.floor(o), True
    start, end = o + t_first * d, o + t_last * d
    first, last, sure = np.floor(start), np.floor(end), True
    plane = np.rint(start)
    if abs(start - plane) < near.plane and 0.0 < plane < n:
        sure = t_first == 0.0 and o == plane
        if d < 0.0:
            first = plane - 1.0
    plane = np.rint(end)
    if abs(end - plane) < near.plane and 0.0 < plane < n:
        sure = sure and abs(end - plane) + near.rounding <= tail * abs(d)
        last = plane - 1.0 if d > 0.0 else plane
    return min(max(first, 0.0), n - 1.0), min(max(last, 0.0), n - 1.0), sure


@_inlined
def _fixed(x):  # type: ignore[no-untyped-def]
    """A fixed-point number; what is further from 0 than any grid is wide only follows a last crossing."""
    return np.uint64(np.int64(min(max(x, -2.0 * _WIDEST), 2.0 * _WIDEST) * _ONE))


@_inlined
def _coordinate(axis, t, step, near):  # type: ignore[no-untyped-def]
    """One coordinate at a crossing, raised by ``near.plane``, and what the next crossing adds."""
    o, d, _, first, _ = axis
    if d == 0.0:
        return _fixed(first + 0.5), np.uint64(0)
    return _fixed(o + t * d + near.plane), _fixed(d * step)


@_inlined
def _enter(cells, count, axis, second, third, near, least):  # type: ignore[no-untyped-def]
    """List the voxels that are entered through planes of ``axis``.

    Returns the smaller of ``least`` and the smallest fraction of the other coordinates: below twice ``near.plane``
    where one is near a plane.
    """
    o, d, inverse, first, stride = axis
    if count == 0:
        return least
    ahead = np.copysign(1.0, d)
    t = (max(first, first + ahead) - o) * inverse
    a, step_a = _coordinate(second, t, abs(inverse), near)
    b, step_b = _coordinate(third, t, abs(inverse), near)
    stride_a, stride_b = second[4], third[4]
    cell, step = np.uint64(np.int64(first + ahead)) * stride, np.uint64(np.int64(ahead)) * stride
    for i in range((count + _AT_ONCE - 1) // _AT_ONCE * _AT_ONCE):
        least = min(least, a & _FRACTION, b & _FRACTION)
        cells[i] = np.uint32(cell + (a >> _BITS) * stride_a + (b >> _BITS) * stride_b)
        a += step_a
        b += step_b
        cell += step
    return least


@_inlined
def crossed(o, d, shape, near, cells):  # type: ignore[no-untyped-def]
    """List the voxels that one segment crosses, in any order.

    Parameters
    ----------
    o, d
        Start and extent of the segment, each three float64 in voxel units of the grid's frame.
    shape
        Voxels along x, y, z, (3,) int64.
    near
        From :func:`room`.
    cells
        Filled with flat indices, uint32, as long as :func:`scratch` says.

    Returns
    -------
    int
        How many voxels are crossed; -1 where that is not certain.
    """
    nx, ny, nz = float(shape[0]), float(shape[1]), float(shape[2])
    dx, dy, dz = d[0], d[1], d[2]
    size_x, size_y, size_z = abs(dx), abs(dy), abs(dz)
    largest = max(size_x, size_y, size_z)
    if not (
        near.plane < np.inf
        and largest < _LARGEST
        and (size_x > _SMALLEST or size_x == 0.0)
        and (size_y > _SMALLEST or size_y == 0.0)
        and (size_z > _SMALLEST or size_z == 0.0)
    ):
        return -1
    per_x, per_y, per_z = 1.0 / dx, 1.0 / dy, 1.0 / dz
    t, t_last = _clip(o[0], dx, per_x, nx, 0.0, 1.0)
    t, t_last = _clip(o[1], dy, per_y, ny, t, t_last)
    t, t_last = _clip(o[2], dz, per_z, nz, t, t_last)
    if (t - t_last) * largest > near.plane:
        return 0
    tail = 0.499 * near.chord / largest
    fx, lx, x_sure = _ends(o[0], dx, nx, t, t_last, near, tail)
    fy, ly, y_sure = _ends(o[1], dy, ny, t, t_last, near, tail)
    fz, lz, z_sure = _ends(o[2], dz, nz, t, t_last, near, tail)
    if not (x_sure and y_sure and z_sure and (t_last - t) * largest > 4.0 * near.plane):
        return -1
    stride_x, stride_y, stride_z = np.uint64(shape[1] * shape[2]), np.uint64(shape[2]), np.uint64(1)
    x, y, z = (o[0], dx, per_x, fx, stride_x), (o[1], dy, per_y, fy, stride_y), (o[2], dz, per_z, fz, stride_z)
    by_x, by_y, by_z = np.int64(abs(lx - fx)), np.int64(abs(ly - fy)), np.int64(abs(lz - fz))
    cells[0] = np.uint32(np.uint64(fx) * stride_x + np.uint64(fy) * stride_y + np.uint64(fz))
    least = _enter(cells[1:], by_x, x, y, z, near, _FRACTION)
    least = _enter(cells[1 + by_x :], by_y, y, x, z, near, least)
    least = _enter(cells[1 + by_x + by_y :], by_z, z, x, y, near, least)
    return 1 + by_x + by_y + by_z if least >= _fixed(2.0 * near.plane) else -1
