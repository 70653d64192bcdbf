r"""Counts how often moving boxes stop the beams of one sensor before each voxel.

Frame: the grid's own, in metres (the world's axes, zero at the grid's origin). A box stops a beam when the beam and the
box, made ``SHRINK_M`` (0.1 mm) smaller on each of its six sides, share a chord. So a box is here exactly as deep as
where it occupies voxels (:mod:`pipeline.kernels.boxes`), and a beam along a car's side is not stopped. The beam ends
where it enters the shrunk box:

.. math:: t = \max_a \min_\pm \frac{\pm h_a - o_a}{d_a}

with the sensor :math:`o` and the unit direction :math:`d` along the box's own axes (slabs: Kay and Kajiya 1986, "Ray
Tracing Complex Scenes"). A box that holds the sensor stops nothing.

Steps: :func:`face` turns each box that can stand before the grid into what a beam asks of it: its axes and half sizes,
where the sensor is along them, and the azimuths and slopes within which it lies. Those bounds are taken round the
*unshrunk* box, so rounding loses no beam. :func:`gather` sorts the boxes into cells of azimuth, frame by frame.
:func:`count_blocked` then takes beam after beam: the boxes in its cell of azimuth and at its slope, the nearest of each
frame, and one is added at the first crossing that lies behind it. Sums along the beam give the frames in which a
crossing was not reached. All that a beam needs lies together, and memory does not grow with beams times frames.
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
def face(o, frames, boxes, low, high, size_m, facing, frame, span):  # type: ignore[no-untyped-def]
    """Turn boxes towards the sensor; leave out those that cannot stand between it and the grid, or hold it.

    Parameters
    ----------
    o
        The sensor, (3,) float64.
    frames, boxes
        Frame of each box, ascending, (m,) int64; the boxes as in :func:`bounds`, (m, 8).
    low, high
        As :func:`bounds` fills them, (m, 3) each.
    size_m
        The grid is the box from 0 to ``size_m`` (3,).
    facing
        Filled, (m, 15) float64: for each axis of the box the axis (3), where the sensor is along it, the half size.
    frame
        Filled, (m,) int64.
    span
        Filled, (m, 4) float64: first and last azimuth, lowest and highest slope, see :func:`_directions`.

    Returns
    -------
    int
        How many boxes are left, in order.
    """
    axes, count = np.empty((3, 3)), 0
    for b in range(frames.shape[0]):
        apart = False
        for a in range(3):
            apart |= low[b, a] > max(o[a], size_m[a]) or high[b, a] < min(o[a], 0.0)
        if apart or holds(boxes[b], o):
            continue
        axes_of(boxes[b, 3], boxes[b, 4], axes)
        x, y, z = o[0] - boxes[b, 0], o[1] - boxes[b, 1], o[2] - boxes[b, 2]
        for a in range(3):
            row = facing[count, 5 * a : 5 * a + 5]
            row[:3] = axes[a]
            row[3] = axes[a, 0] * x + axes[a, 1] * y + axes[a, 2] * z
            row[4] = 0.5 * boxes[b, 5 + a] - SHRINK_M
        first, last, slope_low, slope_high = _directions(boxes[b], low[b], high[b], o)
        span[count, 0], span[count, 1], span[count, 2], span[count, 3] = first, last, slope_low, slope_high
        frame[count] = frames[b]
        count += 1
    return count


@_inlined
def _cell(azimuth, cells):  # type: ignore[no-untyped-def]
    """The cell of an azimuth, unwrapped: 0 begins at -pi."""
    return np.int64(np.floor((azimuth + math.pi) * (cells / (2.0 * math.pi))))


@_kernel
def gather(span, cells):  # type: ignore[no-untyped-def]
    """Sort boxes into cells of azimuth.

    Parameters
    ----------
    span
        As :func:`face` fills it, (m, 4).
    cells
        How many cells the circle has.

    Returns
    -------
    starts, members
        members[starts[c]] to members[starts[c + 1]] are the boxes that reach into cell c, ascending, int64.
    """
    starts = np.zeros(cells + 1, np.int64)
    for b in range(span.shape[0]):
        first = _cell(span[b, 0], cells)
        for c in range(first, min(_cell(span[b, 1], cells), first + cells - 1) + 1):
            starts[c % cells + 1] += 1
    for c in range(cells):
        starts[c + 1] += starts[c]
    members, filled = np.empty(starts[cells], np.int64), starts[:-1].copy()
    for b in range(span.shape[0]):
        first = _cell(span[b, 0], cells)
        for c in range(first, min(_cell(span[b, 1], cells), first + cells - 1) + 1):
            members[filled[c % cells]] = b
            filled[c % cells] += 1
    return starts, members


@_inlined
def _entered(facing, m, x, y, z):  # type: ignore[no-untyped-def]
    """Where a ray along (x, y, z) enters box m of ``facing``; infinity where it does not."""
    t, leave = 0.0, np.inf
    for a in (0, 5, 10):
        along = facing[m, a] * x + facing[m, a + 1] * y + facing[m, a + 2] * z
        t, leave = _slab(facing[m, a + 3], along, facing[m, a + 4], t, leave)
    return t if t < leave else np.inf


@_inlined
def _behind(enter_m, begin, last, range_m):  # type: ignore[no-untyped-def]
    """The first of the crossings ``begin`` to ``last`` that is entered behind a range below the last one's.

    Guessed, since planes lie evenly, then settled."""
    at = begin
    if last > begin:
        share = (range_m - enter_m[begin]) / (enter_m[last] - enter_m[begin])
        at = begin + min(max(np.int64(share * (last - begin)), 0), last - begin)
    while at > begin and enter_m[at - 1] > range_m:
        at -= 1
    while enter_m[at] <= range_m:
        at += 1
    return at - begin


@_kernel
def count_blocked(d, azimuth, slope, first, enter_m, frame, facing, slopes, starts, members, levels, share):  # type: ignore[no-untyped-def]
    """Count the frames in which a box stops a beam before it gets as far as each of its crossings.

    Parameters
    ----------
    d, azimuth, slope
        Unit directions (n, 3), their azimuths in [-pi, pi], and their rise over run, (n,) each.
    first, enter_m
        Crossings first[i] to first[i + 1] belong to beam i, (n + 1,) int64; range at which each is entered, ascending
        along a beam, (k,) float64.
    frame, facing, slopes
        Of each box, as :func:`face` fills them; slopes are the last two columns of ``span``.
    starts, members
        As :func:`gather` returns them.
    levels
        What is said of a crossing that is not reached in so many frames, from 0 on.
    share
        Filled, (k,), ``levels`` of each crossing.
    """
    cells, most = starts.shape[0] - 1, 0
    for i in range(d.shape[0]):
        most = max(most, first[i + 1] - first[i])
    blocked = np.zeros(most, np.int64)
    for i in range(d.shape[0]):
        begin, last = first[i], first[i + 1] - 1
        if last < begin:
            continue
        limit, rise = enter_m[last], slope[i]
        nearest, now, cell = np.inf, np.int64(-1), _cell(azimuth[i], cells) % cells
        for k in range(starts[cell], starts[cell + 1]):
            m = members[k]
            if rise < slopes[m, 0] or rise > slopes[m, 1]:
                continue
            t = _entered(facing, m, d[i, 0], d[i, 1], d[i, 2])
            if t < limit:
                if frame[m] != now:
                    if nearest < np.inf:
                        blocked[_behind(enter_m, begin, last, nearest)] += 1
                    nearest, now = np.inf, frame[m]
                nearest = min(nearest, t)
        if nearest < np.inf:
            blocked[_behind(enter_m, begin, last, nearest)] += 1
        total = 0
        for k in range(begin, last + 1):
            total += blocked[k - begin]
            blocked[k - begin] = 0
            share[k] = levels[total]


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
