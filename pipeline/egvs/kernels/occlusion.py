r"""Where moving boxes stop the beams of one sensor, and in how many frames.

Frame: the grid's own, in metres (the world's axes, zero at the grid's origin). A box stops a beam when the beam and the
box, made ``SHRINK_M`` (0.1 mm) smaller on each of its six sides, share a chord. So a box is exactly as deep here as
where it occupies voxels (:mod:`egvs.kernels.occupancy`), and does not stop a beam along its side. The beam ends where
it enters the shrunk box:

.. math:: t = \max_a \min_\pm \frac{\pm h_a - o_a}{d_a}

with the sensor :math:`o` and the unit direction :math:`d` along the box's own axes (slabs: Kay and Kajiya 1986, "Ray
Tracing Complex Scenes"). A box that contains the sensor stops nothing.

Steps:

1. :func:`orient_boxes` computes, for each box that can stand between the sensor and the grid, the terms of the slab
   test that do not depend on the beam, and the upright block around the box.
2. :func:`bin_by_azimuth` sorts the boxes into cells of azimuth.
3. :func:`beam_stops` takes beams in the order of their azimuths, those of (nearly) one azimuth together, as the
   channels of an upright sensor are. Where their vertical plane cuts each block is computed once for all of them and
   gives the slopes between which a beam can meet it. The remaining beams take the slab test. Blocks are *not* shrunk
   for that, so rounding loses no beam.

Where all beams of a bundle have one azimuth and a box is flat, the slabs are computed once as well: the plane cuts the
shrunk box, and a beam enters it at that cut's near side, or through its top or bottom. A box that stands through many
frames is tested once: along a beam, nearest box first, each box stops it in those of its frames in which nothing nearer
did.
"""

from __future__ import annotations

import math

import numpy as np

from egvs.kernels.jit import njit
from egvs.kernels.occupancy import SHRINK_M, box_axes

_kernel = njit()
_inlined = njit(forceinline=True)

BUNDLE_RAD = 1e-3
"""Beams whose azimuths differ by less are bundled."""

_SAME_AZIMUTH_RAD = 1e-14
"""Azimuths that differ by less differ only by rounding."""

_TINY = 1e-300
"""Added to a divisor that may be 0; does not change any other number."""


@_kernel
def box_bounds(boxes, low, high):  # type: ignore[no-untyped-def]
    """Fill the corners of the axis-aligned boxes around boxes.

    Parameters
    ----------
    boxes
        Centre x, y, z, yaw, pitch, length, width, height of each, (n, 8) float64, metres and radians.
    low, high
        Filled, (n, 3) float64.
    """
    axes = np.empty((3, 3))
    for b in range(boxes.shape[0]):
        box_axes(boxes[b, 3], boxes[b, 4], axes)
        for a in range(3):
            reach = 0.5 * (
                boxes[b, 5] * abs(axes[0, a]) + boxes[b, 6] * abs(axes[1, a]) + boxes[b, 7] * abs(axes[2, a])
            )
            low[b, a], high[b, a] = boxes[b, a] - reach, boxes[b, a] + reach


@_kernel
def contains_sensor(box, o):  # type: ignore[no-untyped-def]
    """Whether the sensor ``o`` (3,) is inside a box (8,), deeper than ``SHRINK_M``."""
    axes = np.empty((3, 3))
    box_axes(box[3], box[4], axes)
    x, y, z = o[0] - box[0], o[1] - box[1], o[2] - box[2]
    inside = True
    for a in range(3):
        inside &= abs(axes[a, 0] * x + axes[a, 1] * y + axes[a, 2] * z) < 0.5 * box[5 + a] - SHRINK_M
    return inside


@_inlined
def _clip_to_slab(o, d, half, first, last):  # type: ignore[no-untyped-def]
    """Clip [first, last] to the slab -half < o + t * d < half of one axis; empty when nothing remains."""
    if d == 0.0:
        return (first, last) if abs(o) < half else (1.0, 0.0)
    a, b = (-half - o) / d, (half - o) / d
    return max(first, min(a, b)), min(last, max(a, b))


@_kernel
def _fill_block(box, axes, low, high, o, block):  # type: ignore[no-untyped-def]
    """Fill the upright block with the box's yaw around the (perhaps pitched) box, as described at :func:`orient_boxes`.

    ``axes`` are those of :func:`egvs.kernels.occupancy.box_axes`, which hold the cosines and sines of its angles.
    Returns the first and last azimuth of the block, seen from the sensor; they may be outside [-pi, pi].
    """
    cy, sy = axes[1, 1], -axes[1, 0]
    half_u = 0.5 * (box[5] * abs(axes[2, 2]) + box[7] * abs(axes[0, 2]))
    half_v = 0.5 * box[6]
    x, y = box[0] - o[0], box[1] - o[1]
    u, v = x * cy + y * sy, y * cy - x * sy
    block[0], block[1], block[2], block[3], block[4], block[5] = cy, sy, u, half_u, v, half_v
    block[6], block[7] = low[2] - o[2], high[2] - o[2]
    is_box = box[4] == 0.0 and min(box[5], box[6], box[7]) > 2.0 * SHRINK_M
    block[8] = SHRINK_M if is_box else 0.0
    if abs(u) <= half_u and abs(v) <= half_v:  # the sensor is above, below or in it
        return -math.pi, math.pi
    lowest, highest = 0.0, 0.0
    for corner in range(4):
        cu = u + (half_u if corner < 2 else -half_u)
        cv = v + (half_v if corner in (0, 3) else -half_v)
        turn = math.atan2(u * cv - v * cu, u * cu + v * cv)
        lowest, highest = min(lowest, turn), max(highest, turn)
    middle = math.atan2(y, x)
    return middle + lowest, middle + highest


@_kernel
def orient_boxes(o, order, boxes, low, high, size_m, facing, block, span, box):  # type: ignore[no-untyped-def]
    """Fill what the slab tests need of boxes; skip those that cannot be between sensor and grid, or contain the sensor.

    Parameters
    ----------
    o
        The sensor, (3,) float64.
    order
        Order in which boxes are taken, (m,) int64; nearest first makes :func:`beam_stops` fast.
    boxes, low, high
        As :func:`box_bounds` takes and fills them, (m, 8), (m, 3), (m, 3).
    size_m
        The grid is the box from 0 to ``size_m`` (3,).
    facing
        Filled, (m, 15) float64: for each axis of the box its direction (3), the sensor's coordinate along it, the half
        size.
    block
        Filled, (m, 9) float64: cosine and sine of the yaw; coordinate of the centre along the block, and its half
        length; across it, and its half width; its bottom and top; all relative to the sensor; by how much the block
        must shrink to be the box that stops beams, 0 where the box is pitched or too thin.
    span
        Filled, (m, 2) float64: first and last azimuth, see :func:`_fill_block`.
    box
        Filled, (m,) int64: index of the box.

    Returns
    -------
    int
        Number of filled rows.
    """
    axes, count = np.empty((3, 3)), 0
    for b in order:
        is_apart = False
        for a in range(3):
            is_apart |= low[b, a] > max(o[a], size_m[a]) or high[b, a] < min(o[a], 0.0)
        if is_apart:
            continue
        box_axes(boxes[b, 3], boxes[b, 4], axes)
        x, y, z = o[0] - boxes[b, 0], o[1] - boxes[b, 1], o[2] - boxes[b, 2]
        is_inside = True
        for a in range(3):
            row = facing[count, 5 * a : 5 * a + 5]
            row[0], row[1], row[2] = axes[a, 0], axes[a, 1], axes[a, 2]
            row[3] = axes[a, 0] * x + axes[a, 1] * y + axes[a, 2] * z
            row[4] = 0.5 * boxes[b, 5 + a] - SHRINK_M
            is_inside &= abs(row[3]) < row[4]
        if is_inside:
            continue
        span[count, 0], span[count, 1] = _fill_block(boxes[b], axes, low[b], high[b], o, block[count])
        box[count] = b
        count += 1
    return count


@_inlined
def _azimuth_cell(azimuth, cells):  # type: ignore[no-untyped-def]
    """The cell of an azimuth, not wrapped; cell 0 begins at -pi."""
    return np.int64(np.floor((azimuth + math.pi) * (cells / (2.0 * math.pi))))


@_kernel
def bin_by_azimuth(span, cells):  # type: ignore[no-untyped-def]
    """Sort boxes into cells of azimuth.

    Parameters
    ----------
    span
        As :func:`orient_boxes` fills it, (m, 2).
    cells
        Number of cells of the circle.

    Returns
    -------
    starts, members
        members[starts[c]] to members[starts[c + 1]] are the boxes that overlap cell c, ascending, int64.
    """
    starts = np.zeros(cells + 1, np.int64)
    for b in range(span.shape[0]):
        first = _azimuth_cell(span[b, 0], cells)
        for c in range(first, min(_azimuth_cell(span[b, 1], cells), first + cells - 1) + 1):
            starts[c % cells + 1] += 1
    for c in range(cells):
        starts[c + 1] += starts[c]
    members, filled = np.empty(starts[cells], np.int64), starts[:-1].copy()
    for b in range(span.shape[0]):
        first = _azimuth_cell(span[b, 0], cells)
        for c in range(first, min(_azimuth_cell(span[b, 1], cells), first + cells - 1) + 1):
            members[filled[c % cells]] = b
            filled[c % cells] += 1
    return starts, members


@_inlined
def _entry_range(facing, m, x, y, z):  # type: ignore[no-untyped-def]
    """Range at which a ray along (x, y, z) enters box m of ``facing``; infinite where it does not."""
    t, leave = 0.0, np.inf
    for a in (0, 5, 10):
        along = facing[m, a] * x + facing[m, a + 1] * y + facing[m, a + 2] * z
        t, leave = _clip_to_slab(facing[m, a + 3], along, facing[m, a + 4], t, leave)
    return t if t < leave else np.inf


@_inlined
def _range_bounds(along, spread, middle, half):  # type: ignore[no-untyped-def]
    """Bounds of the horizontal ranges at which rays are between two sides of a block.

    Each ray's direction across these sides differs from ``along`` by up to ``spread``, which is not 0.
    """
    if along < 0.0:
        along, middle = -along, -middle
    far = (middle + half) / (along - spread) if along > spread else np.inf
    return max(abs(middle) - half, 0.0) / (along + spread), far


@_kernel
def _list_cuts(azimuth, spread, block, members, cuts, near, ranges, unsorted):  # type: ignore[no-untyped-def]
    """List how beams within ``spread`` of an azimuth cut the blocks, nearest first; returns the number of cuts.

    Filled: ``near`` (m,) int64, index of the block; ``cuts`` (m, 5), lowest and highest slope with which a beam can
    meet it, the horizontal range of its near side, the height of its top or bottom if that faces the sensor (else 0),
    and above 0 where every beam between these slopes meets the shrunk box itself. ``ranges`` (m,) and ``unsorted``
    (m, 5) are scratch.
    """
    x, y, count, one_azimuth = math.cos(azimuth), math.sin(azimuth), 0, spread < _SAME_AZIMUTH_RAD
    for m in members:
        cy, sy, shrink = block[m, 0], block[m, 1], block[m, 8] if one_azimuth else 0.0
        u_near, u_far = _range_bounds(x * cy + y * sy, spread, block[m, 2], block[m, 3] - shrink)
        v_near, v_far = _range_bounds(y * cy - x * sy, spread, block[m, 4], block[m, 5] - shrink)
        first, last = max(u_near, v_near), min(u_far, v_far)
        if first < last:
            down, up = block[m, 6] + shrink, block[m, 7] - shrink
            unsorted[m, 0] = down / (first if down < 0.0 else last)
            unsorted[m, 1] = up / (first if up > 0.0 else last)
            unsorted[m, 2], unsorted[m, 3], unsorted[m, 4] = first, max(down, 0.0) + min(up, 0.0), shrink
            _insert_by_range(first, m, count, ranges, near)
            count += 1
    for k in range(count):
        for column in range(5):
            cuts[k, column] = unsorted[near[k], column]
    return count


@_inlined
def _insert_by_range(t, m, count, ranges, boxes):  # type: ignore[no-untyped-def]
    """Insert box m into ``count`` boxes that are sorted by range. Boxes come nearly in order, so few move."""
    while count > 0 and ranges[count - 1] > t:
        ranges[count], boxes[count] = ranges[count - 1], boxes[count - 1]
        count -= 1
    ranges[count], boxes[count] = t, m


@_kernel
def beam_stops(begin, rows, azimuth, beams, boxes, frames, levels, met, first, range_m, share):  # type: ignore[no-untyped-def]
    """List where beams are stopped, for as many beams as fit in the arrays.

    Parameters
    ----------
    begin
        Index in ``rows`` of the first beam.
    rows, azimuth
        Beams in the order of their azimuths in [-pi, pi], (n,) int64; these azimuths, ascending, (n,) float64.
    beams
        Of each beam, by row: rise over run, horizontal length, length over run, unit direction (n, 3), length.
    boxes
        ``facing``, ``block`` and ``box`` of :func:`orient_boxes`, ``starts`` and ``members`` of :func:`bin_by_azimuth`.
    frames
        ``first_frame`` and ``frame``: frame[first_frame[b]] to frame[first_frame[b + 1]] are those of box b, int64.
    levels
        Transmitted share by the number of frames in which a beam is stopped, from 0 on.
    met
        Scratch, int64, one for each frame, -1 at first.
    first
        Filled, (n + 1,) int64: stops first[i] to first[i + 1] belong to the beam of rows[begin + i].
    range_m, share
        Filled: the range of each stop, ascending along a beam, and the share of ``levels`` behind it. At least as long
        as there are frames.

    Returns
    -------
    int
        Number of beams whose stops are listed.
    """
    slope, run_m, stretch, d, length_m = beams
    facing, block, box, starts, members = boxes
    cells, total = starts.shape[0] - 1, 0
    near, cuts, unsorted = np.empty(len(box), np.int64), np.empty((len(box), 5)), np.empty((len(box), 5))
    ranges, entered = np.empty(len(box)), np.empty(len(box), np.int64)
    first[0], count, end = 0, 0, begin
    for i in range(begin, rows.shape[0]):
        if total + met.shape[0] > range_m.shape[0]:
            return i - begin
        if i == end:  # the first beam of the next bundle
            cell = _azimuth_cell(azimuth[i], cells)
            end = _end_of_bundle(azimuth, i, cell, cells)
            middle = 0.5 * (azimuth[i] + azimuth[end - 1])
            spread = max(0.5 * (azimuth[end - 1] - azimuth[i]), _TINY)
            candidates = members[starts[cell % cells] : starts[cell % cells + 1]]
            count = _list_cuts(middle, spread, block, candidates, cuts, near, ranges, unsorted)
        row, entries = rows[i], 0
        for k in range(count):  # the boxes that the beam enters, nearest first; as a function, even inlined, 7 % slower
            low, high, side_m, deck_m, is_exact = cuts[k, 0], cuts[k, 1], cuts[k, 2], cuts[k, 3], cuts[k, 4] > 0.0
            if side_m > run_m[row]:
                break
            if slope[row] < low or slope[row] > high:
                continue
            if is_exact:
                t = side_m * stretch[row] if side_m > 0.0 else 0.0
                if deck_m != 0.0:
                    t = max(t, deck_m / d[row, 2])
            else:
                t = _entry_range(facing, near[k], d[row, 0], d[row, 1], d[row, 2])
            if t < length_m[row]:
                _insert_by_range(t, box[near[k]], entries, ranges, entered)
                entries += 1
        stopped = 0
        for k in range(entries):
            before = stopped
            stopped = _mark_blocked_frames(row, entered[k], frames, met, stopped)
            if stopped > before:
                range_m[total], share[total] = ranges[k], levels[stopped]
                total += 1
        first[i - begin + 1] = total
    return rows.shape[0] - begin


@_inlined
def _end_of_bundle(azimuth, begin, cell, cells):  # type: ignore[no-untyped-def]
    """Index behind the last beam that is bundled with beam ``begin``, which lies in a cell of azimuth."""
    end, last = begin, azimuth[begin] + BUNDLE_RAD
    while end < azimuth.shape[0] and azimuth[end] < last and _azimuth_cell(azimuth[end], cells) == cell:
        end += 1
    return end


@_inlined
def _mark_blocked_frames(row, box, frames, met, stopped):  # type: ignore[no-untyped-def]
    """Mark the frames of a box in which a beam is stopped; returns ``stopped`` plus those that were not marked."""
    first_frame, frame = frames
    for i in range(first_frame[box], first_frame[box + 1]):
        stopped += met[frame[i]] != row
        met[frame[i]] = row
    return stopped


@_kernel
def share_at_crossings(first, enter_m, rows, stop_first, range_m, share, reached):  # type: ignore[no-untyped-def]
    """Fill the transmitted share at each crossing: that behind the last stop before it.

    Parameters
    ----------
    first, enter_m
        Crossings first[i] to first[i + 1] belong to beam i, (n + 1,) int64; range at which each voxel is entered,
        ascending along a beam, (k,) float64.
    rows, stop_first, range_m, share
        The beams to fill, (m,) int64, and their stops as :func:`beam_stops` fills them.
    reached
        (k,) float64, filled behind the first stop of each of those beams.
    """
    for i in range(rows.shape[0]):
        stop = stop_first[i]
        for k in range(first[rows[i]], first[rows[i] + 1]):
            while stop < stop_first[i + 1] and range_m[stop] < enter_m[k]:
                stop += 1
            if stop > stop_first[i]:
                reached[k] = share[stop - 1]


@_kernel
def multiply_free_chances(counts, total, first, cells, share):  # type: ignore[no-untyped-def]
    """Fill the probability that all voxels before each crossing are free, as if they were independent.

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
        for i in range(first[n], first[n + 1]):
            share[i] = free
            free *= (total - counts[cells[i]]) / total
