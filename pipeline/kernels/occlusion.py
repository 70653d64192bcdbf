r"""Counts how often moving boxes stop the beams of one sensor before each voxel.

Frame: the grid's own, in metres (the world's axes, zero at the grid's origin). A box stops a beam when the beam and the
box, made ``SHRINK_M`` (0.1 mm) smaller on each of its six sides, share a chord. So a box is here exactly as deep as
where it occupies voxels (:mod:`pipeline.kernels.boxes`), and a beam along a car's side is not stopped. The beam ends
where it enters the shrunk box:

.. math:: t = \max_a \min_\pm \frac{\pm h_a - o_a}{d_a}

with the sensor :math:`o` and the unit direction :math:`d` along the box's own axes (slabs: Kay and Kajiya 1986, "Ray
Tracing Complex Scenes"). A box that holds the sensor stops nothing.

Steps of :func:`count_blocked`: the beams come sorted by azimuth. A box asks only those within its azimuths and
elevations, seen from the sensor; those bounds are taken round the *unshrunk* box, so rounding loses no beam. In a frame
each beam keeps the nearest box; when the frame is over, one is added at the first crossing that lies behind it. Sums
along each beam then give the frames in which a crossing was not reached. Memory holds a number a beam and a number a
crossing, however many frames there are.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from pipeline.kernels.boxes import SHRINK_M, axes_of

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")
_inlined = numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")


@_kernel
def bounds(boxes, low, high):  # type: ignore[no-untyped-def]
    """Fill the corners of the upright boxes round boxes.

    Parameters
    ----------
    boxes
        Centre x, y, z, yaw, pitch, length, width, height of each, (n, 8) float64, metres and radians.
    low, high
        Filled, (n, 3) float64.
    """
    axes = np.empty((3, 3))
    for b in range(boxes.shape[0]):
        axes_of(boxes[b, 3], boxes[b, 4], axes)
        for a in range(3):
            reach = 0.5 * (
                boxes[b, 5] * abs(axes[0, a]) + boxes[b, 6] * abs(axes[1, a]) + boxes[b, 7] * abs(axes[2, a])
            )
            low[b, a], high[b, a] = boxes[b, a] - reach, boxes[b, a] + reach


@_kernel
def holds(box, o):  # type: ignore[no-untyped-def]
    """Whether the sensor ``o`` (3,) stands inside a box (8,), deeper than ``SHRINK_M``."""
    axes = np.empty((3, 3))
    axes_of(box[3], box[4], axes)
    x, y, z = o[0] - box[0], o[1] - box[1], o[2] - box[2]
    inside = True
    for a in range(3):
        inside &= abs(axes[a, 0] * x + axes[a, 1] * y + axes[a, 2] * z) < 0.5 * box[5 + a] - SHRINK_M
    return inside


@_inlined
def _slab(o, d, half, first, last):  # type: ignore[no-untyped-def]
    """Cut [first, last] to the slab -half < o + t * d < half of one axis; empty when nothing is left."""
    if d == 0.0:
        return (first, last) if abs(o) < half else (1.0, 0.0)
    a, b = (-half - o) / d, (half - o) / d
    return max(first, min(a, b)), min(last, max(a, b))


@_kernel
def _directions(box, low, high, o):  # type: ignore[no-untyped-def]
    """First and last azimuth, and lowest and highest slope (rise over run), of all that can lie in a box, seen from the
    sensor.

    Taken round the upright block with the box's yaw that holds the (perhaps pitched) box; azimuths may leave [-pi, pi].
    """
    cy, sy = math.cos(box[3]), math.sin(box[3])
    half_u = 0.5 * (box[5] * abs(math.cos(box[4])) + box[7] * abs(math.sin(box[4])))
    half_v = 0.5 * box[6]
    x, y = box[0] - o[0], box[1] - o[1]
    u, v = x * cy + y * sy, y * cy - x * sy  # the block's centre seen from the sensor, along the block's axes
    away_u, away_v = max(abs(u) - half_u, 0.0), max(abs(v) - half_v, 0.0)
    near = math.sqrt(away_u * away_u + away_v * away_v)
    far = math.sqrt((abs(u) + half_u) ** 2 + (abs(v) + half_v) ** 2)
    down, up = low[2] - o[2], high[2] - o[2]
    if near == 0.0:  # the sensor stands above, below or in it
        slope_low = -np.inf if down < 0.0 else down / far
        slope_high = np.inf if up > 0.0 else up / far
        return -math.pi, math.pi, slope_low, slope_high
    slope_low = down / near if down < 0.0 else down / far
    slope_high = up / near if up > 0.0 else up / far
    least, most = 0.0, 0.0
    for corner in range(4):
        cu = u + (half_u if corner < 2 else -half_u)
        cv = v + (half_v if corner in (0, 3) else -half_v)
        turn = math.atan2(u * cv - v * cu, u * cu + v * cv)
        least, most = min(least, turn), max(most, turn)
    middle = math.atan2(y, x)
    return middle + least, middle + most, slope_low, slope_high


@_kernel
def _stop(box, o, d, slope, azimuth, limit, bound, scratch, nearest, touched, count):  # type: ignore[no-untyped-def]
    """Shorten ``nearest`` of the beams that a box stops; list those that no box of the frame stopped before in
    ``touched``.

    ``bound`` is what :func:`_directions` returned. Returns how many are listed now.
    """
    first, last, slope_low, slope_high = bound
    axes_of(box[3], box[4], scratch)
    a, b, c = scratch[0], scratch[1], scratch[2]
    x, y, z = o[0] - box[0], o[1] - box[1], o[2] - box[2]
    ou, ov, ow = a[0] * x + a[1] * y + a[2] * z, b[0] * x + b[1] * y + b[2] * z, c[0] * x + c[1] * y + c[2] * z
    half_u, half_v, half_w = 0.5 * box[5] - SHRINK_M, 0.5 * box[6] - SHRINK_M, 0.5 * box[7] - SHRINK_M
    for turn in (-2.0 * math.pi, 0.0, 2.0 * math.pi):
        if first + turn > math.pi or last + turn < -math.pi:
            continue
        begin = np.searchsorted(azimuth, first + turn)
        end = np.searchsorted(azimuth, last + turn, side="right")
        for i in range(begin, end):
            if slope[i] < slope_low or slope[i] > slope_high:
                continue
            x, y, z = d[i, 0], d[i, 1], d[i, 2]
            t, leave = 0.0, np.inf
            t, leave = _slab(ou, a[0] * x + a[1] * y + a[2] * z, half_u, t, leave)
            t, leave = _slab(ov, b[0] * x + b[1] * y + b[2] * z, half_v, t, leave)
            t, leave = _slab(ow, c[0] * x + c[1] * y + c[2] * z, half_w, t, leave)
            if t < leave and t < limit[i]:
                if nearest[i] == np.inf:
                    touched[count] = i
                    count += 1
                nearest[i] = min(nearest[i], t)
    return count


@_kernel
def _note(touched, count, nearest, row, first, enter_m, blocked):  # type: ignore[no-untyped-def]
    """Add the frame that is over: one at the first crossing behind where each of ``count`` beams ended. Clears
    ``nearest``."""
    for k in range(count):
        i = touched[k]
        begin, end = first[row[i]], first[row[i] + 1]
        at = begin + np.searchsorted(enter_m[begin:end], nearest[i], side="right")
        if at < end:
            blocked[at] += 1
        nearest[i] = np.inf


@_kernel
def count_blocked(o, d, azimuth, slope, row, first, enter_m, frames, boxes, low, high, blocked):  # type: ignore[no-untyped-def]
    """Count the frames in which a box stops a beam before it gets as far as each of its crossings.

    Parameters
    ----------
    o
        The sensor, (3,) float64.
    d, azimuth, slope
        Unit directions (n, 3), their azimuths in [-pi, pi], ascending, and their rise over run, (n,) each.
    row
        Which beam of ``first`` each of these is, (n,) int64; each has at least one crossing.
    first, enter_m
        Crossings first[i] to first[i + 1] belong to beam i, int64; range at which each is entered, ascending along a
        beam, (k,) float64.
    frames, boxes
        Frame of each box, ascending, (m,) int64; the boxes as in :func:`bounds`, (m, 8).
    low, high
        As :func:`bounds` fills them, (m, 3) each.
    blocked
        Zeros, filled, (k,) int64.
    """
    n = d.shape[0]
    if n == 0:
        return
    nearest, touched, limit = np.full(n, np.inf), np.empty(n, np.int64), np.empty(n)
    scratch, count = np.empty((3, 3)), 0
    reach_low, reach_high = o.copy(), o.copy()  # all that these beams pass through
    for i in range(n):
        limit[i] = enter_m[first[row[i] + 1] - 1]
        for a in range(3):
            reach_low[a] = min(reach_low[a], o[a] + limit[i] * d[i, a])
            reach_high[a] = max(reach_high[a], o[a] + limit[i] * d[i, a])
    for b in range(frames.shape[0]):
        if b > 0 and frames[b] != frames[b - 1]:
            _note(touched, count, nearest, row, first, enter_m, blocked)
            count = 0
        apart = False
        for a in range(3):
            apart |= low[b, a] > reach_high[a] or high[b, a] < reach_low[a]
        if apart or holds(boxes[b], o):
            continue
        bound = _directions(boxes[b], low[b], high[b], o)
        count = _stop(boxes[b], o, d, slope, azimuth, limit, bound, scratch, nearest, touched, count)
    _note(touched, count, nearest, row, first, enter_m, blocked)
    for i in range(n):
        for at in range(first[row[i]] + 1, first[row[i] + 1]):
            blocked[at] += blocked[at - 1]


@_kernel
def free_of_all(counts, total, first, cells, share):  # type: ignore[no-untyped-def]
    """Multiply the chances that the voxels before each crossing are free, as if they were independent.

    Parameters
    ----------
    counts, total
        Frames in which each voxel is occupied, flat, uint32, of ``total`` frames.
    first, cells
        Crossings first[i] to first[i + 1] belong to beam i, (n + 1,) int64; the voxel of each, (k,) int64.
    share
        Filled, (k,) float64.
    """
    for n in range(first.shape[0] - 1):
        free = 1.0
        for at in range(first[n], first[n + 1]):
            share[at] = free
            free *= (total - counts[cells[at]]) / total
