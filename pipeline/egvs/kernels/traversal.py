r"""Voxel traversal of line segments: which voxels a beam crosses, and how many beams cross each voxel.

Frame: the grid's own, in voxel units, so that voxel :math:`(i, j, k)` is :math:`[i, i+1) \times [j, j+1) \times [k,
k+1)`. A segment is :math:`p(t) = o + t\,d,\ 0 \le t \le 1`. It crosses a voxel when the chord that they share is longer
than ``CHORD_M`` (1 micrometre). A component of :math:`d` that is exactly 0 (or -0) never crosses a plane: the segment
belongs to the voxel whose half-open side contains it.

There are two traversals with the same result. The fixed-point traversal is several times as fast, and reports when it
is not certain (one beam in several hundred); then the exact traversal decides.

**Exact traversal** (:func:`list_voxels`), after Amanatides and Woo (1987), "A Fast Voxel Traversal Algorithm for Ray
Tracing", with three changes that make the result independent of rounding:

1. The crossing of plane :math:`k` is computed on its own, :math:`t_k = (k - o) / d`, with a true division, for all
   planes of an axis at once (which vectorises); then the three lists are merged. Accumulating :math:`t \mathrel{+}=
   \Delta t` would add up an error with each step.
2. Equal crossings are stepped over one after the other at the same :math:`t`, so a segment through an edge or a corner
   continues diagonally: the voxels in between have a chord of length 0.
3. A voxel counts by the length of its chord, so the order of crossings that differ only by rounding does not matter:
   the chord between them is far shorter than ``CHORD_M``.

The number of steps is at most the number of planes between both ends.

Accuracy: :math:`k - o` and the division are each off by at most :math:`u = 2^{-53}` of their value, so each end of a
chord by :math:`2 u R` and its length by :math:`4 u R` and less than a hundredth more, where R is the distance from the
segment's start to that end. For R up to 1e7 m that is 4.5e-9 m: correct wherever the chord differs from ``CHORD_M`` by
more than 1e-8 m. The segment may end anywhere, up to the largest float64. Any other finite input is traversed in as
many steps, with :math:`4 u R` in place of 1e-8 m.

**Fixed-point traversal** (:func:`traverse_fixed_point`): a voxel is entered where the segment crosses a plane. For each
plane of an axis, the other two coordinates are computed at the crossing; rounded down, they and the plane name the
voxel. Coordinates are fixed-point numbers with ``_BITS`` binary digits after the point, each the previous one plus a
step, so that a processor computes several at once and no crossing waits for another: nothing is merged or sorted.

Its result is that of the exact traversal wherever every decision has a margin. With S the grid's longest side plus the
sensor's largest coordinate:

- a coordinate here, from a rounded inverse, two products and two sums, is off by at most 8 u S, and by less than a last
  digit for its start and for each step, which are truncated; a crossing of the exact traversal is off by 2 u of its
  distance from the sensor, which is at most sqrt(3) S, so the distance of two by 7 u S and a rounding;
- so where each coordinate is further from the next plane than ``CHORD_M`` and 16 u S and those digits, no two crossings
  are as near as ``CHORD_M``: their order is certain, and each voxel between two of them counts;
- both ends of the part inside the grid need the same distance. Exempt are the grid's own faces, which nothing crosses;
  a sensor exactly on a plane; and an end so near a plane that the voxel behind it cannot count.

A component that is exactly 0 crosses nothing: its coordinate is that of the middle of its voxel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from egvs.kernels.jit import njit

CHORD_M = 1e-6
"""A shared chord up to this length is no contact."""

_BITS = np.uint64(40)
_ONE = 2.0**40
_FRACTION = np.uint64(2**40 - 1)
_MAX_SIDE = 2.0**20
"""Voxels along an axis: a larger index would not fit beside the digits."""
_MAX_CELLS = 2.0**32
_BLOCK_SIZE = 16
"""Crossings that are computed together: several times what a processor computes at once."""
_SMALLEST, _LARGEST = 2.0**-500, 2.0**500
"""Between these (or at 0), components, their inverses and their products neither vanish nor overflow."""

_kernel = njit()
_inlined = njit(forceinline=True)


# --- the hits of one sensor -------------------------------------------------------------------------------------------


@_kernel
def count_hits(o, d, shape, voxel_m, hits):  # type: ignore[no-untyped-def]
    """Add 1 for each beam of a sensor to the voxels that it crosses.

    Parameters
    ----------
    o
        The sensor, (3,) float64, voxel units of the grid's frame.
    d
        End of each beam relative to the sensor, (n, 3) float64, voxel units.
    shape
        Voxels along x, y, z, (3,) int64.
    voxel_m
        Edge length of a voxel in metres.
    hits
        Counters by flat index (ix * ny + iy) * nz + iz, (nx * ny * nz,) uint32, added to.
    """
    times, cells = crossing_buffer(shape), cell_buffer(shape)
    tolerances = make_tolerances(o, shape, CHORD_M / voxel_m)
    for beam in range(d.shape[0]):  # a helper for the body, even inlined, made this half as slow again
        count = traverse_fixed_point(o, d[beam], shape, tolerances, cells)
        if count < 0:
            add_to_voxels(o, d[beam], shape, voxel_m, np.uint32(1), hits, times)
        for i in range(count):
            hits[cells[i]] += np.uint32(1)


@_kernel
def add_hits(o, d, shape, voxel_m, weights, hits):  # type: ignore[no-untyped-def]
    """As :func:`count_hits`, for beams with weights (n,) int64; ``hits`` are int64."""
    times, cells = crossing_buffer(shape), cell_buffer(shape)
    tolerances = make_tolerances(o, shape, CHORD_M / voxel_m)
    for beam in range(d.shape[0]):
        count = traverse_fixed_point(o, d[beam], shape, tolerances, cells)
        if count < 0:
            add_to_voxels(o, d[beam], shape, voxel_m, weights[beam], hits, times)
        for i in range(count):
            hits[cells[i]] += weights[beam]


@_kernel
def sum_by_class(hits, cells, classes, gamma, capped, below, hit):  # type: ignore[no-untyped-def]
    """Add up hits for each class of voxels, in whole numbers.

    Parameters
    ----------
    hits
        Beams that cross each voxel, (nx * ny * nz,) uint32, or int64 in smaller units.
    cells, classes
        Flat index and class of the voxels to add up, (n,) int64 each.
    gamma
        Cap on the hits of a voxel, in their unit, float64, may be infinite.
    capped, below, hit
        Added to, (classes,) int64: voxels with at least gamma hits; the hits of all others; voxels with any hit.
    """
    for i in range(cells.shape[0]):
        n = hits[cells[i]]
        if n > 0:
            c = classes[i]
            hit[c] += 1
            if n >= gamma:
                capped[c] += 1
            else:
                below[c] += np.int64(n)


# --- exact traversal --------------------------------------------------------------------------------------------------


@_kernel
def crossing_buffer(shape):  # type: ignore[no-untyped-def]
    """Memory for the plane crossings of each axis in rows 0 to 2; row 3 is 0, 1, 2, ..."""
    times = np.empty((4, max(shape[0], shape[1], shape[2]) + 2), np.float64)
    for i in range(times.shape[1]):
        times[3, i] = i
    return times


@_kernel
def list_voxels(o, d, shape, voxel_m, cells, t_cells, times):  # type: ignore[no-untyped-def]
    """List the voxels that one segment crosses, in order.

    Parameters
    ----------
    o, d
        Start and extent of the segment, each three finite float64 in voxel units of the grid's frame.
    shape, voxel_m
        The grid, as in :func:`count_hits`.
    cells
        Filled with the flat index of each crossed voxel: int64, at least sum(shape) long.
    t_cells
        Filled: row i says where voxel i is entered and left, as shares of the segment, (n, 2) float64, as long as
        ``cells``.
    times
        Scratch, from :func:`crossing_buffer`.

    Returns
    -------
    count, t_first, t_last
        Number of crossed voxels; the part of the segment inside the grid (empty when ``t_last <= t_first``).
    """
    path = _enter_grid(o, d, shape, times)
    min_share = _min_chord_share(d[0], d[1], d[2], voxel_m)
    t, cell, count = path.t_first, path.cell, 0
    ix, iy, iz = np.uint64(0), np.uint64(0), np.uint64(0)
    inside = path.t_first < path.t_last
    while inside:
        t_next, step, ix, iy, iz = _next_crossing(path, times, ix, iy, iz)
        cells[count], t_cells[count, 0], t_cells[count, 1] = cell, t, t_next
        count += t_next - t > min_share
        inside = step != np.uint64(0)
        t, cell = t_next, cell + step
    return count, path.t_first, path.t_last


@_kernel
def add_to_voxels(o, d, shape, voxel_m, amount, hits, times):  # type: ignore[no-untyped-def]
    """Add an amount to ``hits`` (flat, of the same dtype) in the voxels of :func:`list_voxels`."""
    path = _enter_grid(o, d, shape, times)
    min_share = _min_chord_share(d[0], d[1], d[2], voxel_m)
    t, cell = path.t_first, path.cell
    ix, iy, iz = np.uint64(0), np.uint64(0), np.uint64(0)
    inside = path.t_first < path.t_last
    while inside:
        t_next, step, ix, iy, iz = _next_crossing(path, times, ix, iy, iz)
        hits[cell] += amount * (t_next - t > min_share)
        inside = step != np.uint64(0)
        t, cell = t_next, cell + step


@_kernel
def add_stepwise(o, d, shape, voxel_m, t_falls, amounts, hits, times):  # type: ignore[no-untyped-def]
    """Add an amount that falls along the segment to ``hits`` (flat) in the voxels of :func:`list_voxels`.

    Parameters
    ----------
    o, d, shape, voxel_m, times
        As in :func:`list_voxels`.
    t_falls
        Shares of the segment at which the amount falls, ascending, the last one infinite, (k,) float64.
    amounts
        The amount that voxels get that are entered up to each fall, (k,) of the dtype of ``hits``.
    """
    path = _enter_grid(o, d, shape, times)
    min_share = _min_chord_share(d[0], d[1], d[2], voxel_m)
    t, cell = path.t_first, path.cell
    fall, one = np.uint64(0), np.uint64(1)
    ix, iy, iz = np.uint64(0), np.uint64(0), np.uint64(0)
    inside = path.t_first < path.t_last
    while inside:
        t_next, step, ix, iy, iz = _next_crossing(path, times, ix, iy, iz)
        while t_falls[fall] < t:
            fall += one
        hits[cell] += amounts[fall] * (t_next - t > min_share)
        inside = step != np.uint64(0)
        t, cell = t_next, cell + step


class _Path(NamedTuple):
    """A segment inside the grid.

    Attributes
    ----------
    t_first, t_last
        The part inside the grid, as shares of the segment; empty when ``t_last <= t_first``.
    cell
        Flat index of its first voxel, uint64: signed indices would be checked for negative values at each step.
    step_x, step_y, step_z
        What a plane crossing along each axis adds to the flat index, uint64; a step back wraps around.
    """

    t_first: float
    t_last: float
    cell: np.uint64
    step_x: np.uint64
    step_y: np.uint64
    step_z: np.uint64


@_inlined
def _enter_grid(o, d, shape, times):  # type: ignore[no-untyped-def]
    """Clip a segment to the grid, and fill rows 0 to 2 of ``times`` with its plane crossings."""
    ox, oy, oz = o[0], o[1], o[2]
    dx, dy, dz = d[0], d[1], d[2]
    nx, ny, nz = float(shape[0]), float(shape[1]), float(shape[2])
    t, t_last = _clip(ox, dx, 0.0, nx, 0.0, 1.0)
    t, t_last = _clip(oy, dy, 0.0, ny, t, t_last)
    t, t_last = _clip(oz, dz, 0.0, nz, t, t_last)
    if not t < t_last:
        return _Path(0.0, 0.0, np.uint64(0), np.uint64(0), np.uint64(0), np.uint64(0))
    cx, px, sx = _first_voxel(ox, dx, nx, t)
    cy, py, sy = _first_voxel(oy, dy, ny, t)
    cz, pz, sz = _first_voxel(oz, dz, nz, t)
    _list_plane_crossings(ox, dx, nx, px, sx, t_last, times[3], times[0])
    _list_plane_crossings(oy, dy, ny, py, sy, t_last, times[3], times[1])
    _list_plane_crossings(oz, dz, nz, pz, sz, t_last, times[3], times[2])
    stride_y, stride_x = shape[2], shape[1] * shape[2]
    cell = np.uint64(np.int64(cx) * stride_x + np.int64(cy) * stride_y + np.int64(cz))
    step_x = np.uint64(np.int64(sx) * stride_x)
    step_y = np.uint64(np.int64(sy) * stride_y)
    step_z = np.uint64(np.int64(sz))
    return _Path(t, t_last, cell, step_x, step_y, step_z)


@_inlined
def _next_crossing(path, times, ix, iy, iz):  # type: ignore[no-untyped-def]
    """The next crossing of the merged lists: its t, its step of the flat index, and the positions in the lists then.

    After the last crossing: the end of the segment inside the grid, and a step of 0.
    """
    times_x, times_y, times_z, one = times[0], times[1], times[2], np.uint64(1)
    tx, ty, tz = times_x[ix], times_y[iy], times_z[iz]
    if tx < ty and tx < tz:
        return tx, path.step_x, ix + one, iy, iz
    if ty < tz:
        return ty, path.step_y, ix, iy + one, iz
    if tz < np.inf:
        return tz, path.step_z, ix, iy, iz + one
    return path.t_last, np.uint64(0), ix, iy, iz


@_inlined
def _clip(o, d, low, high, t_first, t_last):  # type: ignore[no-untyped-def]
    """Clip [t_first, t_last] to the slab low <= o + t * d < high of one axis; empty when nothing remains."""
    if d == 0.0:
        return (t_first, t_last) if low <= o < high else (1.0, 0.0)
    a, b = (low - o) / d, (high - o) / d
    return max(t_first, min(a, b)), min(t_last, max(a, b))


@_inlined
def _first_voxel(o, d, n, t_first):  # type: ignore[no-untyped-def]
    """Along one axis: the voxel index just after ``t_first``, the next plane, and the step from plane to plane."""
    if d == 0.0:
        return np.floor(o), 0.0, 0.0
    # A guess that rounding may put one off, settled by the same division that times every crossing.
    k = min(max(np.floor(o + t_first * d), 0.0), n - 1.0)
    if d > 0.0:
        while (k + 1.0 - o) / d <= t_first:
            k += 1.0
        while k > 0.0 and (k - o) / d > t_first:
            k -= 1.0
        return k, k + 1.0, 1.0
    while (k - o) / d <= t_first:
        k -= 1.0
    while k + 1.0 < n and (k + 1.0 - o) / d > t_first:
        k += 1.0
    return k, k, -1.0


@_inlined
def _list_plane_crossings(o, d, n, plane, step, t_last, counting, times):  # type: ignore[no-untyped-def]
    """List when one axis crosses its planes from ``plane`` on; infinite from the first one at or after ``t_last``."""
    if d == 0.0:
        times[0] = np.inf
        return
    # As many as a guess of the last voxel requires, then on to the first behind the end (at the latest the border).
    last = min(max(np.floor(o + t_last * d), 0.0), n - 1.0)
    count = np.int64(abs(last - plane)) + 2
    for i in range(count):
        t = (plane + step * counting[i] - o) / d
        times[i] = t if t < t_last else np.inf
    while times[count - 1] < np.inf:
        t = (plane + step * counting[count] - o) / d
        times[count] = t if t < t_last else np.inf
        count += 1


@_inlined
def _min_chord_share(dx, dy, dz, voxel_m):  # type: ignore[no-untyped-def]
    """``CHORD_M`` as a share of the segment; infinite for a segment without length."""
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    if length < np.inf:
        return CHORD_M / voxel_m / length
    x, y, z = dx * 2.0**-600, dy * 2.0**-600, dz * 2.0**-600  # their squares do not overflow
    return CHORD_M / voxel_m / np.sqrt(x * x + y * y + z * z) * 2.0**-600


# --- fixed-point traversal --------------------------------------------------------------------------------------------


class Tolerances(NamedTuple):
    """Margins of :func:`traverse_fixed_point` for one sensor and grid, in voxels.

    Attributes
    ----------
    chord
        The longest chord that is no contact.
    rounding
        The largest displacement by rounding.
    plane
        The side of a plane on which a coordinate counts is uncertain within this distance of the plane; infinite where
        nothing is certain.
    """

    chord: float
    rounding: float
    plane: float


@_kernel
def make_tolerances(o, shape, chord):  # type: ignore[no-untyped-def]
    """Margins for a sensor (3,) in voxel units, the grid's shape (3,) int64, and ``CHORD_M`` in voxels."""
    longest = float(max(shape[0], shape[1], shape[2]))
    rounding = 2.0**-49 * (longest + max(abs(o[0]), abs(o[1]), abs(o[2])))
    plane = 1.001 * chord + rounding + (longest + 4.0) / _ONE
    cells = float(shape[0]) * float(shape[1]) * float(shape[2])
    if not (plane < 0.1 and longest <= _MAX_SIDE and cells <= _MAX_CELLS):
        plane = np.inf
    return Tolerances(chord, rounding, plane)


@_kernel
def cell_buffer(shape):  # type: ignore[no-untyped-def]
    """Memory for all that :func:`traverse_fixed_point` writes, which is more than it returns."""
    return np.empty(shape[0] + shape[1] + shape[2] + 1 + _BLOCK_SIZE, np.uint32)


class _Axis(NamedTuple):
    """One axis of a segment: its start, extent, 1 / extent, first voxel, and the stride of the flat index."""

    o: float
    d: float
    inverse: float
    first: float
    stride: np.uint64


@_inlined
def traverse_fixed_point(o, d, shape, tolerances, cells):  # type: ignore[no-untyped-def]
    """List the voxels that one segment crosses, in any order.

    Parameters
    ----------
    o, d
        Start and extent of the segment, each three float64 in voxel units of the grid's frame.
    shape
        Voxels along x, y, z, (3,) int64.
    tolerances
        From :func:`make_tolerances`.
    cells
        Filled with flat indices, uint32, from :func:`cell_buffer`.

    Returns
    -------
    int
        Number of crossed voxels; -1 where that is not certain.
    """
    nx, ny, nz = float(shape[0]), float(shape[1]), float(shape[2])
    dx, dy, dz = d[0], d[1], d[2]
    size_x, size_y, size_z = abs(dx), abs(dy), abs(dz)
    largest = max(size_x, size_y, size_z)
    if not (
        tolerances.plane < np.inf
        and largest < _LARGEST
        and (size_x > _SMALLEST or size_x == 0.0)
        and (size_y > _SMALLEST or size_y == 0.0)
        and (size_z > _SMALLEST or size_z == 0.0)
    ):
        return -1
    per_x, per_y, per_z = 1.0 / dx, 1.0 / dy, 1.0 / dz
    t, t_last = _clip_by_inverse(o[0], dx, per_x, nx, 0.0, 1.0)
    t, t_last = _clip_by_inverse(o[1], dy, per_y, ny, t, t_last)
    t, t_last = _clip_by_inverse(o[2], dz, per_z, nz, t, t_last)
    if (t - t_last) * largest > tolerances.plane:
        return 0
    tail = 0.499 * tolerances.chord / largest
    first_x, last_x, x_certain = _end_voxels(o[0], dx, nx, t, t_last, tolerances, tail)
    first_y, last_y, y_certain = _end_voxels(o[1], dy, ny, t, t_last, tolerances, tail)
    first_z, last_z, z_certain = _end_voxels(o[2], dz, nz, t, t_last, tolerances, tail)
    if not (x_certain and y_certain and z_certain and (t_last - t) * largest > 4.0 * tolerances.plane):
        return -1
    stride_x, stride_y, stride_z = np.uint64(shape[1] * shape[2]), np.uint64(shape[2]), np.uint64(1)
    x = _Axis(o[0], dx, per_x, first_x, stride_x)
    y = _Axis(o[1], dy, per_y, first_y, stride_y)
    z = _Axis(o[2], dz, per_z, first_z, stride_z)
    by_x, by_y, by_z = np.int64(abs(last_x - first_x)), np.int64(abs(last_y - first_y)), np.int64(abs(last_z - first_z))
    cells[0] = np.uint32(np.uint64(first_x) * stride_x + np.uint64(first_y) * stride_y + np.uint64(first_z))
    least = _list_entered_voxels(cells[1:], by_x, x, y, z, tolerances, _FRACTION)
    least = _list_entered_voxels(cells[1 + by_x :], by_y, y, x, z, tolerances, least)
    least = _list_entered_voxels(cells[1 + by_x + by_y :], by_z, z, x, y, tolerances, least)
    if least < _to_fixed_point(2.0 * tolerances.plane):
        return -1
    return 1 + by_x + by_y + by_z


@_inlined
def _clip_by_inverse(o, d, inverse, n, t_first, t_last):  # type: ignore[no-untyped-def]
    """Clip [t_first, t_last] to the grid along one axis; t_first is larger where nothing remains."""
    if d == 0.0:
        return (t_first, t_last) if 0.0 <= o < n else (1.0, 0.0)
    a, b = (0.0 - o) * inverse, (n - o) * inverse
    return max(t_first, min(a, b)), min(t_last, max(a, b))


@_inlined
def _end_voxels(o, d, n, t_first, t_last, tolerances, tail):  # type: ignore[no-untyped-def]
    """Along one axis: the voxels of both ends, and whether they are certain.

    ``tail``: an end nearer to a plane than this share of ``d``, less rounding, leaves no voxel behind it that counts.
    """
    if d == 0.0:
        return np.floor(o), np.floor(o), True
    start, end = o + t_first * d, o + t_last * d
    first, last, certain = np.floor(start), np.floor(end), True
    plane = np.rint(start)
    if abs(start - plane) < tolerances.plane and 0.0 < plane < n:
        certain = t_first == 0.0 and o == plane
        if d < 0.0:
            first = plane - 1.0
    plane = np.rint(end)
    if abs(end - plane) < tolerances.plane and 0.0 < plane < n:
        certain = certain and abs(end - plane) + tolerances.rounding <= tail * abs(d)
        last = plane - 1.0 if d > 0.0 else plane
    return min(max(first, 0.0), n - 1.0), min(max(last, 0.0), n - 1.0), certain


@_inlined
def _list_entered_voxels(cells, count, axis, second, third, tolerances, least):  # type: ignore[no-untyped-def]
    """List the voxels that are entered through the ``count`` planes of ``axis``.

    Returns the smaller of ``least`` and the smallest fraction of the other coordinates: below twice
    ``tolerances.plane`` where one is near a plane.
    """
    if count == 0:
        return least
    ahead = np.copysign(1.0, axis.d)
    t = (max(axis.first, axis.first + ahead) - axis.o) * axis.inverse
    a, step_a = _coordinate_at_crossing(second, t, abs(axis.inverse), tolerances)
    b, step_b = _coordinate_at_crossing(third, t, abs(axis.inverse), tolerances)
    stride_a, stride_b = second.stride, third.stride
    cell = np.uint64(np.int64(axis.first + ahead)) * axis.stride
    step = np.uint64(np.int64(ahead)) * axis.stride
    for i in range((count + _BLOCK_SIZE - 1) // _BLOCK_SIZE * _BLOCK_SIZE):
        least = min(least, a & _FRACTION, b & _FRACTION)
        cells[i] = np.uint32(cell + (a >> _BITS) * stride_a + (b >> _BITS) * stride_b)
        a += step_a
        b += step_b
        cell += step
    return least


@_inlined
def _coordinate_at_crossing(axis, t, step, tolerances):  # type: ignore[no-untyped-def]
    """One coordinate at a crossing, raised by ``tolerances.plane``, and what the next crossing adds."""
    if axis.d == 0.0:
        return _to_fixed_point(axis.first + 0.5), np.uint64(0)
    return _to_fixed_point(axis.o + t * axis.d + tolerances.plane), _to_fixed_point(axis.d * step)


@_inlined
def _to_fixed_point(x):  # type: ignore[no-untyped-def]
    """A fixed-point number; clamped, since a coordinate beyond any grid occurs only after the last crossing."""
    return np.uint64(np.int64(min(max(x, -2.0 * _MAX_SIDE), 2.0 * _MAX_SIDE) * _ONE))


# --- audit ------------------------------------------------------------------------------------------------------------


@_kernel
def audit_beams(o, d, shape, voxel_m, last_beam):  # type: ignore[no-untyped-def]
    """Traverse every beam exactly once more, and check what :func:`count_hits` relies on.

    Parameters
    ----------
    o, d, shape, voxel_m
        As in :func:`count_hits`.
    last_beam
        Scratch, zeros, (nx * ny * nz,) uint32.

    Returns
    -------
    worst_sum, longest_gap_m, misplaced, doubled
        Largest difference between the clipped segment and the sum of the chords of its voxels, each computed
        independently, and of the gaps between them, as a share of the segment; longest piece that belongs to no voxel
        (chords up to 1 micrometre, at most three in a row); number of chords whose middle is outside their voxel by
        more than 1e-9 of the grid; number of voxels that a beam visits twice.
    """
    longest = shape[0] + shape[1] + shape[2] + 3
    cells, t_cells, times = np.empty(longest, np.int64), np.empty((longest, 2), np.float64), crossing_buffer(shape)
    index = np.empty(3)
    worst_sum, longest_gap, misplaced, doubled = 0.0, 0.0, 0, 0
    slack = 1e-9 * max(shape[0], shape[1], shape[2])
    for beam in range(d.shape[0]):
        count, t_first, t_last = list_voxels(o, d[beam], shape, voxel_m, cells, t_cells, times)
        if not t_first < t_last:
            continue
        length_m = CHORD_M / _min_chord_share(d[beam, 0], d[beam, 1], d[beam, 2], voxel_m)
        total, end = 0.0, t_first
        for i in range(count):
            start = t_cells[i, 0]
            longest_gap = max(longest_gap, (start - end) * length_m)
            total += start - end
            end = t_cells[i, 1]
            middle, cell = 0.5 * (start + end), cells[i]
            index[0], index[1], index[2] = cell // (shape[1] * shape[2]), cell // shape[2] % shape[1], cell % shape[2]
            low, high, away = t_first, t_last, 0.0
            for a in range(3):
                k = index[a]
                low, high = _clip(o[a], d[beam, a], k, k + 1.0, low, high)
                away = max(away, abs(o[a] + middle * d[beam, a] - k - 0.5))
            total += max(high - low, 0.0)
            misplaced += away > 0.5 + slack
            doubled += last_beam[cell] == beam + 1
            last_beam[cell] = beam + 1
        longest_gap = max(longest_gap, (t_last - end) * length_m)
        total += t_last - end
        worst_sum = max(worst_sum, abs(total - (t_last - t_first)))
    return worst_sum, longest_gap, misplaced, doubled
