r"""Walks a segment through the grid and tells which voxels it crosses.

Frame: the grid's own, in voxel units, so that voxel :math:`(i, j, k)` is :math:`[i, i+1) \times [j, j+1) \times [k,
k+1)`. A segment is :math:`p(t) = o + t\,d,\ 0 \le t \le 1`. It crosses a voxel when the chord that they share is longer
than ``CHORD_M`` (1 micrometre).

Steps, after Amanatides and Woo (1987), "A Fast Voxel Traversal Algorithm for Ray Tracing", with three departures that
make the outcome independent of rounding:

1. The crossing of plane :math:`k` is computed by itself, :math:`t_k = (k - o) / d`, with a true division, for all
   planes of an axis in one go (which vectorises), then the three lists are merged. Accumulating :math:`t \mathrel{+}=
   \Delta t` would add up an error with each step.
2. Crossings that are equal are stepped one after the other without moving on, so a segment through an edge or a corner
   goes on diagonally: what it passes in between has a chord of length 0.
3. A voxel counts by the length of its chord, so the order of crossings that differ by rounding alone does not matter:
   what lies between them is far shorter than ``CHORD_M``.

A component that is exactly 0 (or -0) never crosses a plane: the segment belongs to the voxel whose half-open side holds
it. The number of steps is bounded by the number of planes between both ends.

How far that carries: :math:`k - o` and the division are each off by at most :math:`u = 2^{-53}` of their value, so each
end of a chord by :math:`2 u R` and its length by :math:`4 u R` and less than a hundredth more, with R the distance from
the segment's start to that end. For R up to 1e7 m that is 4.5e-9 m: right wherever the chord differs from ``CHORD_M``
by more than 1e-8 m. The segment may end anywhere, up to the largest float64. Any other finite input is walked in as
many steps, with :math:`4 u R` in place of 1e-8 m.

Where nothing but hits is asked for, most beams take a shorter way to the same voxels, which says where it is not
certain of them: :mod:`pipeline.kernels.hits.sure_march`.
"""

from __future__ import annotations

import numpy as np

from pipeline.kernels.compile_cache import compiled
from pipeline.kernels.hits import sure_march

CHORD_M = 1e-6
"""A shared chord up to this length is no contact."""


_kernel = compiled()
_inlined = compiled(forceinline=True)


@_inlined
def _clip(o, d, low, high, t_first, t_last):  # type: ignore[no-untyped-def]
    """Cut [t_first, t_last] to the slab low <= o + t * d < high of one axis; empty when nothing is left."""
    if d == 0.0:
        return (t_first, t_last) if low <= o < high else (1.0, 0.0)
    a, b = (low - o) / d, (high - o) / d
    return max(t_first, min(a, b)), min(t_last, max(a, b))


@_inlined
def _enter(o, d, n, t_first):  # type: ignore[no-untyped-def]
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
def _cross(o, d, n, plane, step, t_last, counting, times):  # type: ignore[no-untyped-def]
    """List when one axis crosses its planes from ``plane`` on, then infinity: nothing is crossed from ``t_last`` on."""
    if d == 0.0:
        times[0] = np.inf
        return
    # As many as a guess of the last voxel asks for, then on to the first behind the end (at the latest the border).
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
def _shortest(dx, dy, dz, voxel_m):  # type: ignore[no-untyped-def]
    """``CHORD_M`` as a share of the segment; infinite for a segment without length."""
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    if length < np.inf:
        return CHORD_M / voxel_m / length
    x, y, z = dx * 2.0**-600, dy * 2.0**-600, dz * 2.0**-600  # their squares do not overflow
    return CHORD_M / voxel_m / np.sqrt(x * x + y * y + z * z) * 2.0**-600


@_kernel
def _scratch(shape):  # type: ignore[no-untyped-def]
    """Room for the crossings of each axis in rows 0 to 2; row 3 holds 0, 1, 2, ..."""
    times = np.empty((4, max(shape[0], shape[1], shape[2]) + 2), np.float64)
    for i in range(times.shape[1]):
        times[3, i] = i
    return times


@_inlined
def _count_falling(hits, falls, times_x, times_y, times_z, cell, step_x, step_y, step_z, t, t_last, shortest):  # type: ignore[no-untyped-def]
    """Merge the crossings of the three axes and add a changing amount to what is crossed. ``falls`` are two arrays:
    where, as shares of the segment, ascending, infinity last; and the amounts of voxels entered before each."""
    t_falls, amounts = falls
    one = np.uint64(1)
    ix, iy, iz, at = np.uint64(0), np.uint64(0), np.uint64(0), np.uint64(0)
    tx, ty, tz, following, on = times_x[ix], times_y[iy], times_z[iz], cell, True
    while on:
        if tx < ty and tx < tz:
            t_next, following = tx, cell + step_x
            ix += one
            tx = times_x[ix]
        elif ty < tz:
            t_next, following = ty, cell + step_y
            iy += one
            ty = times_y[iy]
        elif tz < np.inf:
            t_next, following = tz, cell + step_z
            iz += one
            tz = times_z[iz]
        else:
            t_next, on = t_last, False
        while t_falls[at] < t:
            at += one
        hits[cell] += amounts[at] * (t_next - t > shortest)
        t, cell = t_next, following


@_kernel
def _walk(o, d, shape, voxel_m, hits, amount, falls, cells, t_cells, times):  # type: ignore[no-untyped-def]
    """:func:`walk` with what a crossed voxel gets, and room for the crossings, from :func:`_scratch`.

    Whether voxels get one amount, get amounts that fall (:func:`_count_falling`), or are listed is settled when it is
    compiled: ``falls`` and ``cells`` are None or not.
    """
    ox, oy, oz = o[0], o[1], o[2]
    dx, dy, dz = d[0], d[1], d[2]
    nx, ny, nz = float(shape[0]), float(shape[1]), float(shape[2])
    t, t_last = _clip(ox, dx, 0.0, nx, 0.0, 1.0)
    t, t_last = _clip(oy, dy, 0.0, ny, t, t_last)
    t, t_last = _clip(oz, dz, 0.0, nz, t, t_last)
    if not t < t_last:
        return 0, 0.0, 0.0
    times_x, times_y, times_z, counting = times[0], times[1], times[2], times[3]
    cx, px, sx = _enter(ox, dx, nx, t)
    cy, py, sy = _enter(oy, dy, ny, t)
    cz, pz, sz = _enter(oz, dz, nz, t)
    _cross(ox, dx, nx, px, sx, t_last, counting, times_x)
    _cross(oy, dy, ny, py, sy, t_last, counting, times_y)
    _cross(oz, dz, nz, pz, sz, t_last, counting, times_z)
    # Unsigned indices: signed ones would be checked for "count from the end" at each step; a step back wraps round.
    stride_y, stride_x = shape[2], shape[1] * shape[2]
    cell = np.uint64(np.int64(cx) * stride_x + np.int64(cy) * stride_y + np.int64(cz))
    step_x, step_y, step_z = (
        np.uint64(np.int64(sx) * stride_x),
        np.uint64(np.int64(sy) * stride_y),
        np.uint64(np.int64(sz)),
    )
    shortest = _shortest(dx, dy, dz, voxel_m)
    one = np.uint64(1)
    ix, iy, iz = np.uint64(0), np.uint64(0), np.uint64(0)
    tx, ty, tz = times_x[ix], times_y[iy], times_z[iz]
    t_first, count = t, 0
    if falls is not None:
        _count_falling(hits, falls, times_x, times_y, times_z, cell, step_x, step_y, step_z, t, t_last, shortest)
        return 0, t_first, t_last
    following, on = cell, True
    while on:
        if tx < ty and tx < tz:
            t_next, following = tx, cell + step_x
            ix += one
            tx = times_x[ix]
        elif ty < tz:
            t_next, following = ty, cell + step_y
            iy += one
            ty = times_y[iy]
        elif tz < np.inf:
            t_next, following = tz, cell + step_z
            iz += one
            tz = times_z[iz]
        else:
            t_next, on = t_last, False
        crossed = t_next - t > shortest
        if cells is None:
            hits[cell] += amount * crossed
        else:
            cells[count], t_cells[count, 0], t_cells[count, 1] = cell, t, t_next
            count += crossed
        t, cell = t_next, following
    return count, t_first, t_last


@_kernel
def walk(o, d, shape, voxel_m, hits, cells, t_cells):  # type: ignore[no-untyped-def]
    """Visit the voxels that one segment crosses, in order.

    Parameters
    ----------
    o, d
        Start and extent of the segment, each three finite float64 in voxel units of the grid's frame.
    shape
        Voxels along x, y, z, (3,) int64.
    voxel_m
        Edge length of a voxel in metres.
    hits
        Counters by flat index (ix * ny + iy) * nz + iz, uint32; added to when ``cells`` is None.
    cells
        None, or filled with the flat index of each crossed voxel: int64, at least sum(shape) long.
    t_cells
        None, or filled: row i holds where voxel i is entered and left, as shares of the segment; as long as ``cells``,
        (n, 2) float64.

    Returns
    -------
    count, t_first, t_last
        Number of voxels listed (0 where they are counted); the part of the segment inside the grid (none when
        ``t_last <= t_first``).
    """
    return _walk(o, d, shape, voxel_m, hits, np.uint32(1), None, cells, t_cells, _scratch(shape))


@_kernel
def count_hits(o, d, shape, voxel_m, hits):  # type: ignore[no-untyped-def]
    """Add each beam of one sensor to the voxels that it crosses.

    Parameters
    ----------
    o
        The sensor, (3,) float64, voxel units of the grid's frame.
    d
        Where each beam ends, seen from the sensor, (n, 3) float64, voxel units.
    shape, voxel_m
        The grid, as in :func:`walk`.
    hits
        Counters, (nx * ny * nz,) uint32, added to.
    """
    _count_beams(o, d, shape, voxel_m, None, hits)


@_kernel
def add_hits(o, d, shape, voxel_m, weights, hits):  # type: ignore[no-untyped-def]
    """As :func:`count_hits`, for beams that weigh ``weights`` (n,) int64; ``hits`` are int64."""
    _count_beams(o, d, shape, voxel_m, weights, hits)


@_inlined
def _count_beams(o, d, shape, voxel_m, weights, hits):  # type: ignore[no-untyped-def]
    """Add each beam by the march that multiplies, where that is certain, else by :func:`_walk`."""
    times, cells = _scratch(shape), sure_march.scratch(shape)
    near = sure_march.room(o, shape, CHORD_M / voxel_m)
    for beam in range(d.shape[0]):
        amount = np.uint32(1) if weights is None else weights[beam]
        count = sure_march.crossed(o, d[beam], shape, near, cells)
        if count < 0:
            _walk(o, d[beam], shape, voxel_m, hits, amount, None, None, None, times)
        for i in range(count):
            hits[cells[i]] += amount


@_kernel
def tally(hits, cells, classes, gamma, capped, below, seen):  # type: ignore[no-untyped-def]
    """Add up hits for each class of voxels, in whole numbers.

    Parameters
    ----------
    hits
        Beams that cross each voxel, (nx * ny * nz,) uint32, or int64 in smaller units.
    cells, classes
        Flat index and class of the voxels that matter, (n,) int64 each.
    gamma
        Cap on the hits of a voxel, in their unit, float64, may be infinite.
    capped, below, seen
        Added to, (classes,) int64: voxels with at least gamma hits; the hits of all others; voxels with any hit.
    """
    for i in range(cells.shape[0]):
        n = hits[cells[i]]
        if n > 0:
            c = classes[i]
            seen[c] += 1
            if n >= gamma:
                capped[c] += 1
            else:
                below[c] += np.int64(n)


@_kernel
def audit(o, d, shape, voxel_m, last_beam):  # type: ignore[no-untyped-def]
    """Walk every beam once more, with a list, and check what :func:`count_hits` relies on.

    Parameters
    ----------
    o, d, shape, voxel_m
        As in :func:`count_hits`.
    last_beam
        Scratch, zeros, (nx * ny * nz,) uint32.

    Returns
    -------
    worst_sum, longest_gap_m, misplaced, doubled
        Largest difference between the clipped segment and the sum of the chords of its voxels, computed from each voxel
        by itself, and of the gaps between them, as a share of the segment; longest piece that belongs to no voxel
        (chords up to 1 micrometre, at most three in a row); chords whose middle lies outside their voxel by more than
        1e-9 of the grid; voxels visited twice by a beam.
    """
    longest = shape[0] + shape[1] + shape[2] + 3
    cells, t_cells, times = np.empty(longest, np.int64), np.empty((longest, 2), np.float64), _scratch(shape)
    worst_sum, longest_gap, misplaced, doubled = 0.0, 0.0, 0, 0
    slack = 1e-9 * max(shape[0], shape[1], shape[2])
    for beam in range(d.shape[0]):
        count, t_first, t_last = _walk(o, d[beam], shape, voxel_m, last_beam, np.uint32(1), None, cells, t_cells, times)
        if not t_first < t_last:
            continue
        size = CHORD_M / _shortest(d[beam, 0], d[beam, 1], d[beam, 2], voxel_m)
        total, end = 0.0, t_first
        for i in range(count + 1):
            start = t_cells[i, 0] if i < count else t_last
            longest_gap = max(longest_gap, (start - end) * size)
            total += start - end
            if i == count:
                break
            end = t_cells[i, 1]
            middle, cell = 0.5 * (start + end), cells[i]
            low, high, away = t_first, t_last, 0.0
            for a in range(3):
                k = float(
                    cell // (shape[1] * shape[2])
                    if a == 0
                    else cell // shape[2] % shape[1]
                    if a == 1
                    else cell % shape[2]
                )
                low, high = _clip(o[a], d[beam, a], k, k + 1.0, low, high)
                away = max(away, abs(o[a] + middle * d[beam, a] - k - 0.5))
            total += max(high - low, 0.0)
            misplaced += away > 0.5 + slack
            doubled += last_beam[cell] == beam + 1
            last_beam[cell] = beam + 1
        worst_sum = max(worst_sum, abs(total - (t_last - t_first)))
    return worst_sum, longest_gap, misplaced, doubled
