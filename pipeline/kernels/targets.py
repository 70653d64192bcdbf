"""Finds which beams of one sensor meet which boxes of recorded frames first, and where boxes stand in plan.

Frame: the grid's own, in metres. A box is met as in :mod:`pipeline.kernels.occlusion`: made 0.1 mm smaller on each of
its six sides, where a beam enters it.

Beams come in bands of similar slope, and in each band in the order of their azimuths: so a box asks only the bands that
are neither too steep nor too flat for it, and of these only the beams between the azimuths that it spans. Both bounds
are those of the box *unshrunk*, so rounding loses no beam. What is left is a few long runs of beams, which
:func:`_enter` puts to the box together, without a branch.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.kernels.boxes import SHRINK_M
from pipeline.kernels.compile_cache import compiled
from pipeline.kernels.occlusion import face

_kernel = compiled()
_inlined = compiled(forceinline=True)

_MARGIN_RAD = 1e-9
"""Spans are widened by this: rounding loses no beam."""

SLICES = 64
"""A vehicle's length is cut into so many slices, to find the longest stretch of it without points."""

_ON_SIDE_M = 1e-6
"""A beam that ends within this of the plane of a side has met it, not the roof."""

_TINY = 1e-300
"""Stands for a direction of 0 along an axis: a beam so nearly parallel enters and leaves beyond any length."""


@_kernel
def _add_runs(span, azimuth, start, runs, count):  # type: ignore[no-untyped-def]
    """Put to ``runs`` (m, 2), from ``count`` on, which rows of ascending azimuths in [-pi, pi] lie in a span, which may
    leave that interval: first and one past the last, where ``start`` is the first row's number; a run for each turn of
    the circle. Returns how many there are then."""
    low, high = span[0] - _MARGIN_RAD, span[1] + _MARGIN_RAD
    if high - low >= 2.0 * math.pi:
        runs[count, 0], runs[count, 1] = start, start + azimuth.shape[0]
        return count + 1
    for turn in range(-1, 2):
        first, last = low + turn * 2.0 * math.pi, high + turn * 2.0 * math.pi
        if first <= math.pi and last >= -math.pi:
            runs[count, 0] = start + np.searchsorted(azimuth, first)
            runs[count, 1] = start + np.searchsorted(azimuth, last)
            count += runs[count, 0] < runs[count, 1]
    return count


@_kernel
def _slopes(block):  # type: ignore[no-untyped-def]
    """The lowest and the highest rise over run of rays from the sensor that can meet a block of :func:`face`."""
    near_u, near_v = max(abs(block[2]) - block[3], 0.0), max(abs(block[4]) - block[5], 0.0)
    far_u, far_v = abs(block[2]) + block[3], abs(block[4]) + block[5]
    near, far = math.sqrt(near_u * near_u + near_v * near_v), math.sqrt(far_u * far_u + far_v * far_v)
    return block[6] / (near if block[6] < 0.0 else far), block[7] / (near if block[7] > 0.0 else far)


@_inlined
def _towards(o, half):  # type: ignore[no-untyped-def]
    """How far the plane by which a box can be entered along one axis is from the sensor; 0 within the slab."""
    return -half - o if o <= -half else (half - o if o >= half else 0.0)


@_kernel
def _enter(box, d, first, last, t_m):  # type: ignore[no-untyped-def]
    """Fill where rays first .. last, directions d (3, n), enter a box, a row of ``facing``; infinity where they do not.

    The range is that of the last slab to be entered, as :func:`pipeline.kernels.occlusion._entered` has it to the last
    bit. It counts when no slab has been left by then, which is asked by a product: so there is a division for each
    plane that faces the sensor, and none of what does not.
    """
    ax, ay, az, ao, ah = box[0], box[1], box[2], box[3], box[4]
    bx, by, bz, bo, bh = box[5], box[6], box[7], box[8], box[9]
    cx, cy, cz, co, ch = box[10], box[11], box[12], box[13], box[14]
    to_a, to_b, to_c = _towards(ao, ah), _towards(bo, bh), _towards(co, ch)
    x, y, z = d[0, first:last], d[1, first:last], d[2, first:last]
    for n in range(last - first):
        a = ax * x[n] + ay * y[n] + az * z[n]
        b = bx * x[n] + by * y[n] + bz * z[n]
        c = cx * x[n] + cy * y[n] + cz * z[n]
        a, b, c = (a if a != 0.0 else _TINY), (b if b != 0.0 else _TINY), (c if c != 0.0 else _TINY)
        t_a, t_b, t_c = to_a / a, to_b / b, to_c / c
        t = t_a if t_a > t_b else t_b
        t = t if t > t_c else t_c
        meets = (t_a >= 0.0) & (t_b >= 0.0) & (t_c >= 0.0)
        meets &= (ao if a > 0.0 else -ao) + t * abs(a) < ah
        meets &= (bo if b > 0.0 else -bo) + t * abs(b) < bh
        meets &= (co if c > 0.0 else -co) + t * abs(c) < ch
        t_m[n] = t if meets else np.inf


@_kernel
def _meet(k, box, beams, runs, owner, range_m, t_m):  # type: ignore[no-untyped-def]
    """Let box k end the beams of ``runs`` that it meets before anything else; returns what all that meet it are
    worth."""
    d, length_m, weight = beams[3], beams[4], beams[5]
    worth = 0.0
    for run in range(runs.shape[0]):
        first, last = runs[run]
        _enter(box, d, first, last, t_m)
        for i in range(last - first):
            n = first + i
            if t_m[i] < length_m[n]:
                worth += weight[n]
                if t_m[i] < range_m[n]:
                    owner[n], range_m[n] = k, t_m[i]
    return worth


@_inlined
def _is_on_side(along, across, half_length, half_width):  # type: ignore[no-untyped-def]
    """Whether a hit lies on a side of its box, not on its roof (or, from below, its underside)."""
    return abs(along) > half_length - _ON_SIDE_M or abs(across) > half_width - _ON_SIDE_M


@_inlined
def _slice_of(along, half_length):  # type: ignore[no-untyped-def]
    """The bit of the slice of its box's length that a hit lies in."""
    part = int(SLICES * (0.5 * along / half_length + 0.5))
    return np.uint64(1) << np.uint64(min(max(part, 0), SLICES - 1))


@_kernel
def _add(k, b, box, beams, runs, owner, range_m, mine, found):  # type: ignore[no-untyped-def]
    """Add up the beams that end on box k, which is box b of all frames, as in :func:`first_met`; listed in ``mine``
    (n,) first, so that there is no branch at each of the others."""
    ax, ay, az, ao, ah = box[0], box[1], box[2], box[3], box[4]
    bx, by, bz, bo, bh = box[5], box[6], box[7], box[8], box[9]
    x, y, z, weight = beams[3][0], beams[3][1], beams[3][2], beams[5]
    total, sides, slices, low, high = found
    count = 0
    for run in range(runs.shape[0]):
        for n in range(runs[run, 0], runs[run, 1]):
            mine[count] = n
            count += owner[n] == k
    worth, on_sides, parts = 0.0, 0.0, np.uint64(0)
    a_low, a_high, b_low, b_high = np.inf, -np.inf, np.inf, -np.inf
    for i in range(count):
        n = mine[i]
        worth += weight[n]
        if weight[n] > 0.0:
            along = ao + range_m[n] * (ax * x[n] + ay * y[n] + az * z[n])
            across = bo + range_m[n] * (bx * x[n] + by * y[n] + bz * z[n])
            on_sides += weight[n] if _is_on_side(along, across, ah, bh) else 0.0
            parts |= _slice_of(along, ah)
            a_low, a_high = min(a_low, along), max(a_high, along)
            b_low, b_high = min(b_low, across), max(b_high, across)
    total[b], sides[b], slices[b] = worth, on_sides, parts
    low[b, 0], high[b, 0], low[b, 1], high[b, 1] = a_low, a_high, b_low, b_high


@_kernel
def _list(k, b, box, beams, runs, owner, range_m, hits, count):  # type: ignore[no-untyped-def]
    """List the beams that end on box k, which is box b of all frames, from ``count`` on; returns how many there are
    then."""
    x, y, z = beams[3][0], beams[3][1], beams[3][2]
    hit_box, hit_row, hit_range, hit_along, hit_across = hits
    for run in range(runs.shape[0]):
        for n in range(runs[run, 0], runs[run, 1]):
            if owner[n] == k:
                hit_box[count], hit_row[count], hit_range[count] = b, n, range_m[n]
                hit_along[count] = box[3] + range_m[n] * (box[0] * x[n] + box[1] * y[n] + box[2] * z[n])
                hit_across[count] = box[8] + range_m[n] * (box[5] * x[n] + box[6] * y[n] + box[7] * z[n])
                count += 1
    return count


@_kernel
def _restore(runs, length_m, owner, range_m):  # type: ignore[no-untyped-def]
    """Take the boxes out of the way of beams again."""
    for run in range(runs.shape[0]):
        for n in range(runs[run, 0], runs[run, 1]):
            owner[n], range_m[n] = -1, length_m[n]


@_kernel
def first_met(begin, o, size_m, boxes, beams, owner, range_m, found, hits):  # type: ignore[no-untyped-def]
    """Add up, or list, the beams that meet a box first: of all frames, or as many as there is room for in the list.

    Parameters
    ----------
    begin
        The frame to begin with.
    o, size_m
        The sensor, (3,) float64; the grid is the box from 0 to ``size_m`` (3,).
    boxes
        ``starts``: boxes starts[f] to starts[f + 1] are those of frame f, (frames + 1,) int64. ``values``, ``low``,
        ``high``: as :func:`pipeline.kernels.occlusion.bounds` takes and fills them, (b, 8), (b, 3), (b, 3).
        ``listed``: which boxes are asked about, (b,) bool; the others are in the way.
    beams
        ``bands``: rows bands[i] to bands[i + 1] are those of band i, (bands + 1,) int64. ``slopes``: the lowest and the
        highest rise over run in each, (bands, 2). Of each beam: azimuth in [-pi, pi], ascending in a band; unit
        direction (3, n); where it ends without boxes; what it is worth; float64.
    owner, range_m
        Scratch, (n,) int32 and float64: -1, and where the beam ends, now and afterwards.
    found
        Filled: ``alone``, (b,) float64, the worth of all beams that meet the box, whatever stands before it; 0 at
        first. And, of boxes that are asked about, where nothing is listed, of the beams that meet it first: ``total``,
        (b,) float64, what they are worth; ``sides``, the same of those that do not end on its roof; ``slices``, (b,)
        uint64, a bit for each of the :data:`SLICES` equal slices of its length, from the rear, where one ends; and the
        bounds ``low`` and ``high`` of where they end, (b, 2) float64, along and across the box from its centre. 0, 0,
        0, infinity and minus infinity at first.
    hits
        Filled, if long enough for all beams; else without any length: which box is met, which beam meets it, where
        (range; along and across the box). Int64, int64, float64, float64, float64. Hits of a box come together.

    Returns
    -------
    next_frame, count
        The frame to go on with, and how many hits are listed.
    """
    starts, values, low, high, listed = boxes
    bands, slopes, azimuth = beams[0], beams[1], beams[2]
    alone, counted = found[0], found[1:]
    most, count, room = 0, 0, hits[0].shape[0]
    for f in range(begin, starts.shape[0] - 1):
        most = max(most, starts[f + 1] - starts[f])
    facing, block, span = np.empty((most, 15)), np.empty((most, 9)), np.empty((most, 2))
    box, away, t_m = np.empty(most, np.int64), np.empty(most), np.empty(azimuth.shape[0])
    runs, filled = np.empty((most, 3 * bands.shape[0], 2), np.int64), np.zeros(most, np.int64)
    mine = np.empty(azimuth.shape[0], np.int64)
    for f in range(begin, starts.shape[0] - 1):
        if room > 0 and count + azimuth.shape[0] > room:
            return f, count
        first, last = starts[f], starts[f + 1]
        for b in range(first, last):
            x, y, z = values[b, 0] - o[0], values[b, 1] - o[1], values[b, 2] - o[2]
            away[b - first] = x * x + y * y + z * z
        order = np.argsort(away[: last - first], kind="mergesort")
        here = values[first:last], low[first:last], high[first:last]
        kept = face(o, order, here[0], here[1], here[2], size_m, facing, block, span, box)
        for k in range(kept):
            lowest, highest = _slopes(block[k])
            filled[k] = 0
            for i in range(bands.shape[0] - 1):
                if slopes[i, 0] <= highest and slopes[i, 1] >= lowest:
                    filled[k] = _add_runs(span[k], azimuth[bands[i] : bands[i + 1]], bands[i], runs[k], filled[k])
            alone[first + box[k]] = _meet(k, facing[k], beams, runs[k, : filled[k]], owner, range_m, t_m)
        for k in range(kept):
            b, its = first + box[k], runs[k, : filled[k]]
            if listed[b] and room > 0:
                count = _list(k, b, facing[k], beams, its, owner, range_m, hits, count)
            elif listed[b]:
                _add(k, b, facing[k], beams, its, owner, range_m, mine, counted)
        for k in range(kept):
            _restore(runs[k, : filled[k]], beams[4], owner, range_m)
    return starts.shape[0] - 1, count


@_kernel
def add_up(box, worth, along, across, boxes, found):  # type: ignore[no-untyped-def]
    """Add up hits that :func:`first_met` listed.

    Parameters
    ----------
    box, worth, along, across
        Of hits: which box, what it is worth, where along and across the box; (k,) int64 and float64.
    boxes
        As :func:`pipeline.kernels.occlusion.bounds` takes them, (b, 8) float64.
    found
        Added to: ``total``, ``sides``, ``slices``, ``low`` and ``high``, as :func:`first_met` fills them.
    """
    total, sides, slices, low, high = found
    for i in range(box.shape[0]):
        b, half_length, half_width = box[i], 0.5 * boxes[box[i], 5] - SHRINK_M, 0.5 * boxes[box[i], 6] - SHRINK_M
        total[b] += worth[i]
        if worth[i] > 0.0:
            sides[b] += worth[i] if _is_on_side(along[i], across[i], half_length, half_width) else 0.0
            slices[b] |= _slice_of(along[i], half_length)
            low[b, 0], high[b, 0] = min(low[b, 0], along[i]), max(high[b, 0], along[i])
            low[b, 1], high[b, 1] = min(low[b, 1], across[i]), max(high[b, 1], across[i])


@_kernel
def holes(slices, share):  # type: ignore[no-untyped-def]
    """Fill the longest stretch between two slices with points, as a share of the length, (n,) float64."""
    for i in range(slices.shape[0]):
        longest, last = 0, -1
        for part in range(SLICES):
            if (slices[i] >> np.uint64(part)) & np.uint64(1):
                if last >= 0:
                    longest = max(longest, part - last - 1)
                last = part
        share[i] = longest / SLICES


@_kernel
def footprints(boxes, plan):  # type: ignore[no-untyped-def]
    """Fill the rectangles that boxes (n, 8) cover in plan, pitched or not: centre x, y, cosine and sine of the yaw,
    half length, half width; (n, 6) float64."""
    for b in range(boxes.shape[0]):
        plan[b, 0], plan[b, 1] = boxes[b, 0], boxes[b, 1]
        plan[b, 2], plan[b, 3] = math.cos(boxes[b, 3]), math.sin(boxes[b, 3])
        plan[b, 4] = 0.5 * (boxes[b, 5] * abs(math.cos(boxes[b, 4])) + boxes[b, 7] * abs(math.sin(boxes[b, 4])))
        plan[b, 5] = 0.5 * boxes[b, 6]


@_kernel
def _corners_beside(a, b):  # type: ignore[no-untyped-def]
    """How near the corners of rectangle b come to rectangle a, squared; and whether all of b lies beyond one side of a.

    In a's own frame a point is as far from a as it is beyond the nearest sides, along and across.
    """
    x, y = b[0] - a[0], b[1] - a[1]
    u, v = x * a[2] + y * a[3], y * a[2] - x * a[3]
    c, s = b[2] * a[2] + b[3] * a[3], b[3] * a[2] - b[2] * a[3]
    nearest, u_low, u_high, v_low, v_high = np.inf, np.inf, -np.inf, np.inf, -np.inf
    for corner in range(4):
        along = b[4] if corner < 2 else -b[4]
        across = b[5] if corner in (0, 3) else -b[5]
        cu, cv = u + along * c - across * s, v + along * s + across * c
        u_low, u_high, v_low, v_high = min(u_low, cu), max(u_high, cu), min(v_low, cv), max(v_high, cv)
        beyond_u, beyond_v = max(abs(cu) - a[4], 0.0), max(abs(cv) - a[5], 0.0)
        nearest = min(nearest, beyond_u * beyond_u + beyond_v * beyond_v)
    return nearest, u_low > a[4] or u_high < -a[4] or v_low > a[5] or v_high < -a[5]


@_kernel
def gap(a, b):  # type: ignore[no-untyped-def]
    """Smallest distance between two rectangles of :func:`footprints`, metres; 0 where they overlap or touch.

    They are apart when one lies beyond a side of the other (separating axes); then a corner of one is nearest.
    """
    one, beyond_a = _corners_beside(a, b)
    other, beyond_b = _corners_beside(b, a)
    return math.sqrt(min(one, other)) if beyond_a or beyond_b else 0.0


@_kernel
def gaps(starts, plan, asked, others, gap_m):  # type: ignore[no-untyped-def]
    """Fill how far each box is from its nearest neighbour in its frame, in plan.

    Parameters
    ----------
    starts
        Boxes starts[f] to starts[f + 1] are those of frame f, (frames + 1,) int64.
    plan
        As :func:`footprints` fills it, (b, 6).
    asked, others
        Which boxes are asked about, and which are neighbours, (b,) bool.
    gap_m
        Filled where it is asked, (b,) float64; infinity without a neighbour.
    """
    for f in range(starts.shape[0] - 1):
        for i in range(starts[f], starts[f + 1]):
            if not asked[i]:
                continue
            nearest, reach = np.inf, math.sqrt(plan[i, 4] ** 2 + plan[i, 5] ** 2)
            for j in range(starts[f], starts[f + 1]):
                if i == j or not others[j]:
                    continue
                away = math.sqrt((plan[j, 0] - plan[i, 0]) ** 2 + (plan[j, 1] - plan[i, 1]) ** 2)
                if away - reach - math.sqrt(plan[j, 4] ** 2 + plan[j, 5] ** 2) < nearest:
                    nearest = min(nearest, gap(plan[i], plan[j]))
            gap_m[i] = nearest
