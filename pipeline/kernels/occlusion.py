r"""Finds where moving boxes stop the beams of one sensor, and in how many frames.

Frame: the grid's own, in metres (the world's axes, zero at the grid's origin). A box stops a beam when the beam and the
box, made ``SHRINK_M`` (0.1 mm) smaller on each of its six sides, share a chord. So a box is here exactly as deep as
where it occupies voxels (:mod:`pipeline.kernels.boxes`), and a beam along a car's side is not stopped. The beam ends
where it enters the shrunk box:

.. math:: t = \max_a \min_\pm \frac{\pm h_a - o_a}{d_a}

with the sensor :math:`o` and the unit direction :math:`d` along the box's own axes (slabs: Kay and Kajiya 1986, "Ray
Tracing Complex Scenes"). A box that holds the sensor stops nothing.

Steps: :func:`face` turns each box that can stand before the grid into what a beam asks of it, and into the upright
block round it. :func:`gather` sorts the boxes into cells of azimuth. :func:`stops` takes beams in the order of their
azimuths, those of (nearly) one azimuth together, as the channels of an upright sensor are: where their vertical plane
cuts each block is computed once for all of them and gives the slopes between which a beam can meet it. What is left is
put to the slabs; blocks are *unshrunk* for that, so rounding loses no beam. Where all of them have one azimuth and a
box is flat, the slabs are computed once too: the plane cuts the shrunk box, and a beam enters it at that cut's near
side, or through its top or bottom. A box that stands through many frames is tested once: along a beam, nearest box
first, each box stops it in those of its frames in which nothing nearer did.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.kernels.boxes import SHRINK_M, axes_of
from pipeline.kernels.compile_cache import compiled

_kernel = compiled()
_inlined = compiled(forceinline=True)

TOGETHER_RAD = 1e-3
"""Beams whose azimuths differ by less are taken together."""

_ALONE_RAD = 1e-14
"""Azimuths that differ by less differ by rounding alone."""

_TINY = 1e-300
"""Added to what may be 0 before it divides; all else stays what it is."""


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
def _fill_block(box, low, high, o, block):  # type: ignore[no-untyped-def]
    """Fill the upright block with the box's yaw that holds the (perhaps pitched) box, as :func:`face` says; returns the
    first and last azimuth of all that can lie in it, seen from the sensor. They may leave [-pi, pi]."""
    cy, sy = math.cos(box[3]), math.sin(box[3])
    half_u = 0.5 * (box[5] * abs(math.cos(box[4])) + box[7] * abs(math.sin(box[4])))
    half_v = 0.5 * box[6]
    x, y = box[0] - o[0], box[1] - o[1]
    u, v = x * cy + y * sy, y * cy - x * sy
    block[0], block[1], block[2], block[3], block[4], block[5] = cy, sy, u, half_u, v, half_v
    block[6], block[7] = low[2] - o[2], high[2] - o[2]
    is_box = box[4] == 0.0 and min(box[5], box[6], box[7]) > 2.0 * SHRINK_M
    block[8] = SHRINK_M if is_box else 0.0
    if abs(u) <= half_u and abs(v) <= half_v:  # the sensor stands above, below or in it
        return -math.pi, math.pi
    least, most = 0.0, 0.0
    for corner in range(4):
        cu = u + (half_u if corner < 2 else -half_u)
        cv = v + (half_v if corner in (0, 3) else -half_v)
        turn = math.atan2(u * cv - v * cu, u * cu + v * cv)
        least, most = min(least, turn), max(most, turn)
    middle = math.atan2(y, x)
    return middle + least, middle + most


@_kernel
def face(o, order, boxes, low, high, size_m, facing, block, span, box):  # type: ignore[no-untyped-def]
    """Turn boxes towards the sensor; leave out those that cannot stand between it and the grid, or hold it.

    Parameters
    ----------
    o
        The sensor, (3,) float64.
    order
        The order in which boxes are taken, (m,) int64; the nearest first makes :func:`stops` fast.
    boxes, low, high
        As :func:`bounds` takes and fills them, (m, 8), (m, 3), (m, 3).
    size_m
        The grid is the box from 0 to ``size_m`` (3,).
    facing
        Filled, (m, 15) float64: for each axis of the box the axis (3), where the sensor is along it, the half size.
    block
        Filled, (m, 9) float64: cosine and sine of the yaw; where the middle is along the block, and its half length;
        across it, and its half width; its bottom and top; all seen from the sensor; by how much it is to be shrunk to
        be the very box that stops beams, 0 where it never is.
    span
        Filled, (m, 2) float64: first and last azimuth, see :func:`_fill_block`.
    box
        Filled, (m,) int64: which box it is.

    Returns
    -------
    int
        How many boxes are left.
    """
    axes, count = np.empty((3, 3)), 0
    for b in order:
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
        span[count, 0], span[count, 1] = _fill_block(boxes[b], low[b], high[b], o, block[count])
        box[count] = b
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
        As :func:`face` fills it, (m, 2).
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
def _between(along, off, middle, half):  # type: ignore[no-untyped-def]
    """Bounds of the horizontal ranges at which rays are between two sides of a block; each ray's direction across these
    sides is ``along`` or differs from it by up to ``off``, which is not 0."""
    if along < 0.0:
        along, middle = -along, -middle
    far = (middle + half) / (along - off) if along > off else np.inf
    return max(abs(middle) - half, 0.0) / (along + off), far


@_kernel
def _list_cuts(azimuth, off, block, members, cuts, near, ranges, unsorted):  # type: ignore[no-untyped-def]
    """List how beams of an azimuth, give or take ``off``, cut the blocks; the nearest first.

    Filled: ``near`` (m,) int64, which block; ``cuts`` (m, 5), lowest and highest slope with which a beam can meet it,
    the horizontal range of its near side, the height of what bounds it towards the sensor (0 for none), and whether a
    beam between these slopes meets the very box. ``ranges`` (m,) is scratch. Returns how many.
    """
    x, y, count, alone = math.cos(azimuth), math.sin(azimuth), 0, off < _ALONE_RAD
    for m in members:
        cy, sy, sunk = block[m, 0], block[m, 1], block[m, 8] if alone else 0.0
        u_near, u_far = _between(x * cy + y * sy, off, block[m, 2], block[m, 3] - sunk)
        v_near, v_far = _between(y * cy - x * sy, off, block[m, 4], block[m, 5] - sunk)
        first, last = max(u_near, v_near), min(u_far, v_far)
        if first < last:
            down, up = block[m, 6] + sunk, block[m, 7] - sunk
            unsorted[m, 0] = down / (first if down < 0.0 else last)
            unsorted[m, 1] = up / (first if up > 0.0 else last)
            unsorted[m, 2], unsorted[m, 3], unsorted[m, 4] = first, max(down, 0.0) + min(up, 0.0), sunk
            _put(first, m, count, ranges, near)
            count += 1
    for k in range(count):
        for column in range(5):
            cuts[k, column] = unsorted[near[k], column]
    return count


@_inlined
def _put(t, m, at, ranges, which):  # type: ignore[no-untyped-def]
    """Put a box into a list by range that is ``at`` long. Boxes come nearly in order, so few move."""
    while at > 0 and ranges[at - 1] > t:
        ranges[at], which[at] = ranges[at - 1], which[at - 1]
        at -= 1
    ranges[at], which[at] = t, m


@_kernel
def stops(begin, rows, azimuth, beams, boxes, frames, levels, met, first, range_m, share):  # type: ignore[no-untyped-def]
    """List where beams are stopped, as many beams as there is room for.

    Parameters
    ----------
    begin
        Where in ``rows`` to begin.
    rows, azimuth
        Beams in the order of their azimuths in [-pi, pi], (n,) int64; these azimuths, ascending, (n,) float64.
    beams
        Of each beam, by row: rise over run, horizontal length, length over run, unit direction (n, 3), length.
    boxes
        ``facing``, ``block`` and ``box`` as :func:`face` fills them, ``starts`` and ``members`` as :func:`gather`
        returns them.
    frames
        ``first_frame`` and ``frame``: frame[first_frame[b]] to frame[first_frame[b + 1]] are those of box b, int64.
    levels
        What is said of a stop with so many frames in which the beam is stopped there or before, from 0 on.
    met
        Scratch, int64, one for each frame, -1 at first.
    first
        (n + 1,) int64, filled: stops first[i] to first[i + 1] belong to the beam of rows[begin + i].
    range_m, share
        Filled: the range of each stop, ascending along a beam, and what ``levels`` says of it. At least as long as
        there are frames.

    Returns
    -------
    int
        How many beams are done.
    """
    slope, run_m, stretch, d, length_m = beams
    facing, block, box, starts, members = boxes
    first_frame, frame = frames
    cells, total = starts.shape[0] - 1, 0
    near, cuts, unsorted = np.empty(len(box), np.int64), np.empty((len(box), 5)), np.empty((len(box), 5))
    ranges, which = np.empty(len(box)), np.empty(len(box), np.int64)
    first[0], count, end = 0, 0, begin
    for i in range(begin, rows.shape[0]):
        if total + met.shape[0] > range_m.shape[0]:
            return i - begin
        if i == end:
            cell = _cell(azimuth[i], cells)
            last = azimuth[i] + TOGETHER_RAD
            while end < rows.shape[0] and azimuth[end] < last and _cell(azimuth[end], cells) == cell:
                end += 1
            off = max(0.5 * (azimuth[end - 1] - azimuth[i]), _TINY)
            there = members[starts[cell % cells] : starts[cell % cells + 1]]
            count = _list_cuts(0.5 * (azimuth[i] + azimuth[end - 1]), off, block, there, cuts, near, ranges, unsorted)
        row, entered = rows[i], 0
        for k in range(count):
            low, high, side_m, deck_m, alone = cuts[k, 0], cuts[k, 1], cuts[k, 2], cuts[k, 3], cuts[k, 4]
            if side_m > run_m[row]:
                break
            if slope[row] < low or slope[row] > high:
                continue
            if alone > 0.0:
                t = side_m * stretch[row] if side_m > 0.0 else 0.0
                if deck_m != 0.0:
                    t = max(t, deck_m / d[row, 2])
            else:
                t = _entered(facing, near[k], d[row, 0], d[row, 1], d[row, 2])
            if t < length_m[row]:
                _put(t, box[near[k]], entered, ranges, which)
                entered += 1
        stopped = 0
        for k in range(entered):
            before = stopped
            for at in range(first_frame[which[k]], first_frame[which[k] + 1]):
                stopped += met[frame[at]] != row
                met[frame[at]] = row
            if stopped > before:
                range_m[total], share[total] = ranges[k], levels[stopped]
                total += 1
        first[i - begin + 1] = total
    return rows.shape[0] - begin


@_kernel
def reach(first, enter_m, rows, stop_first, range_m, share, reached):  # type: ignore[no-untyped-def]
    """Say of each crossing what is said of the last stop before it.

    Parameters
    ----------
    first, enter_m
        Crossings first[i] to first[i + 1] belong to beam i, (n + 1,) int64; range at which each is entered, ascending
        along a beam, (k,) float64.
    rows, stop_first, range_m, share
        Which beams are asked about, (m,) int64, and their stops as :func:`stops` fills them.
    reached
        (k,), filled where those beams have stops.
    """
    for i in range(rows.shape[0]):
        at = stop_first[i]
        for k in range(first[rows[i]], first[rows[i] + 1]):
            while at < stop_first[i + 1] and range_m[at] < enter_m[k]:
                at += 1
            if at > stop_first[i]:
                reached[k] = share[at - 1]


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
