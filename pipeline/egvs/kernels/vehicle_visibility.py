"""Which vehicle box each beam hits first; distances between boxes; boosted trees over these features.

Frame: that of the grid, in metres. Boxes are shrunk by 0.1 mm on each of their six sides, as in
:mod:`egvs.kernels.occlusion`; a hit is the point where a beam enters the shrunk box.

Beams are sorted into bands of similar slope, and in each band by azimuth. So a box needs only the bands that are
neither too steep nor too flat for it, and of these only the beams between the azimuths that it spans. Both bounds are
those of the box *unshrunk*, so rounding loses no beam. What remains are a few long runs of beams, which
:func:`_entry_ranges` intersects with the box together, without a branch.
"""

from __future__ import annotations

import math

import numpy as np

from egvs.kernels.jit import njit
from egvs.kernels.occlusion import orient_boxes
from egvs.kernels.occupancy import SHRINK_M

_kernel = njit()


_inlined = njit(forceinline=True)

_MARGIN_RAD = 1e-9
"""Spans are widened by this: rounding loses no beam."""

SLICES = 64
"""Slices of a vehicle's length, to find the longest stretch without points."""

_ON_SIDE_M = 1e-6
"""A beam that ends within this distance of the plane of a side meets the side, not the roof."""

_TINY = 1e-300
"""Replaces a direction of 0 along an axis: such a beam enters and leaves beyond any length."""


@_kernel
def _append_runs(span, azimuth, start, runs, count):  # type: ignore[no-untyped-def]
    """Append the runs of rows whose azimuths are in a span; returns the number of runs with the new ones.

    Azimuths are ascending in [-pi, pi], the span may exceed that interval: one run for each turn of the circle. Each
    row of ``runs`` (m, 2) is the first row and one past the last; ``start`` is the number of the first azimuth.
    """
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
def _slope_bounds(block):  # type: ignore[no-untyped-def]
    """Lowest and highest rise over run of rays from the sensor that can meet a block of :func:`orient_boxes`."""
    near_u, near_v = max(abs(block[2]) - block[3], 0.0), max(abs(block[4]) - block[5], 0.0)
    far_u, far_v = abs(block[2]) + block[3], abs(block[4]) + block[5]
    near, far = math.sqrt(near_u * near_u + near_v * near_v), math.sqrt(far_u * far_u + far_v * far_v)
    return block[6] / (near if block[6] < 0.0 else far), block[7] / (near if block[7] > 0.0 else far)


@_inlined
def _face_distance(o, half):  # type: ignore[no-untyped-def]
    """Distance along one axis from the sensor to the face through which a box can be entered; 0 within the slab."""
    if o <= -half:
        return -half - o
    if o >= half:
        return half - o
    return 0.0


@_kernel
def _entry_ranges(box, d, first, last, t_m):  # type: ignore[no-untyped-def]
    """Fill where rays first .. last, directions d (3, n), enter a box, a row of ``facing``; infinite where they do not.

    The range is that of the last slab to be entered, to the last bit as in
    :func:`egvs.kernels.occlusion._entry_range`. It counts when the ray has not left any slab by then, which needs only
    a product: so there is a division for each plane that faces the sensor, and none for the others.
    """
    ax, ay, az, ao, ah = box[0], box[1], box[2], box[3], box[4]
    bx, by, bz, bo, bh = box[5], box[6], box[7], box[8], box[9]
    cx, cy, cz, co, ch = box[10], box[11], box[12], box[13], box[14]
    to_a, to_b, to_c = _face_distance(ao, ah), _face_distance(bo, bh), _face_distance(co, ch)
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
def _intersect_box(k, box, beams, runs, owner, range_m, t_m):  # type: ignore[no-untyped-def]
    """End the beams of ``runs`` at box k where they meet it first; returns the weight of all beams that meet it."""
    is_weighted, met_weight, met = beams[5].shape[0] > 0, 0.0, 0
    for run in range(runs.shape[0]):
        first, last = runs[run]
        _entry_ranges(box, beams[3], first, last, t_m)
        length_m, nearest_m, owners = beams[4][first:last], range_m[first:last], owner[first:last]
        for i in range(last - first):
            met += t_m[i] < length_m[i]
        if is_weighted:
            weight = beams[5][first:last]
            for i in range(last - first):
                met_weight += weight[i] if t_m[i] < length_m[i] else 0.0
        for i in range(last - first):
            is_nearer = t_m[i] < nearest_m[i]
            owners[i] = np.int32(k) if is_nearer else owners[i]
            nearest_m[i] = t_m[i] if is_nearer else nearest_m[i]
    return met_weight if is_weighted else float(met)


@_inlined
def _is_on_side(along, across, half_length, half_width):  # type: ignore[no-untyped-def]
    """Whether a hit is on a side of its box, not on its roof (or, from below, its underside)."""
    return abs(along) > half_length - _ON_SIDE_M or abs(across) > half_width - _ON_SIDE_M


@_inlined
def _slice_of(along, half_length):  # type: ignore[no-untyped-def]
    """The bit of the slice of the box's length that a hit is in."""
    part = int(SLICES * (0.5 * along / half_length + 0.5))
    return np.uint64(1) << np.uint64(min(max(part, 0), SLICES - 1))


@_kernel
def _add_box_hits(k, b, box, beams, runs, owner, range_m, selected, sums):  # type: ignore[no-untyped-def]
    """Add up the beams that end on box k, which is box b of all frames, as in :func:`first_hits`.

    They are listed in ``selected`` (n,) first, so that there is no branch for each of the others.
    """
    ax, ay, az, ao, ah = box[0], box[1], box[2], box[3], box[4]
    bx, by, bz, bo, bh = box[5], box[6], box[7], box[8], box[9]
    x, y, z, weight = beams[3][0], beams[3][1], beams[3][2], beams[5]
    total, sides, slices, low, high = sums
    count, is_weighted = 0, weight.shape[0] > 0
    for run in range(runs.shape[0]):
        first, last = runs[run]
        owners = owner[first:last]
        for i in range(last - first):
            selected[count] = first + i
            count += owners[i] == k
    hit_weight, on_sides, parts = 0.0, 0.0, np.uint64(0)
    a_low, a_high, b_low, b_high = np.inf, -np.inf, np.inf, -np.inf
    for i in range(count):
        n = selected[i]
        share = weight[n] if is_weighted else 1.0
        hit_weight += share
        if share > 0.0:
            along = ao + range_m[n] * (ax * x[n] + ay * y[n] + az * z[n])
            across = bo + range_m[n] * (bx * x[n] + by * y[n] + bz * z[n])
            on_sides += share if _is_on_side(along, across, ah, bh) else 0.0
            parts |= _slice_of(along, ah)
            a_low, a_high = min(a_low, along), max(a_high, along)
            b_low, b_high = min(b_low, across), max(b_high, across)
    total[b], sides[b], slices[b] = hit_weight, on_sides, parts
    low[b, 0], high[b, 0], low[b, 1], high[b, 1] = a_low, a_high, b_low, b_high


@_kernel
def _list_box_hits(k, b, box, beams, runs, owner, range_m, hits, count):  # type: ignore[no-untyped-def]
    """List the beams that end on box k, which is box b of all frames, after ``count``; returns the new number."""
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
def _clear_box_hits(runs, length_m, owner, range_m):  # type: ignore[no-untyped-def]
    """Reset the first hits of the beams of ``runs``."""
    for run in range(runs.shape[0]):
        first, last = runs[run]
        owner[first:last] = -1
        range_m[first:last] = length_m[first:last]


@_kernel
def first_hits(begin, o, size_m, boxes, beams, owner, range_m, sums, hits):  # type: ignore[no-untyped-def]
    """Add up, or list, the beams that meet each box first: of all frames, or as many as fit in the list.

    Parameters
    ----------
    begin
        The first frame.
    o, size_m
        The sensor, (3,) float64; the grid is the box from 0 to ``size_m`` (3,).
    boxes
        ``starts``: boxes starts[f] to starts[f + 1] are those of frame f, (frames + 1,) int64. ``values``, ``low``,
        ``high``: as :func:`egvs.kernels.occlusion.box_bounds` takes and fills them, (b, 8), (b, 3), (b, 3).
        ``listed``: for which boxes beams are added up or listed, (b,) bool; the others only occlude.
    beams
        ``bands``: rows bands[i] to bands[i + 1] are those of band i, (bands + 1,) int64. ``slopes``: the lowest and the
        highest rise over run in each, (bands, 2). Of each beam: azimuth in [-pi, pi], ascending in a band; unit
        direction (3, n); its length without boxes; its weight, or no weights (0,) where all are 1; float64.
    owner, range_m
        Scratch, (n,) int32 and float64: -1 and the length of each beam, before and after the call.
    sums
        Filled: ``alone``, (b,) float64, the weight of all beams that meet the box, occluded or not; 0 at first. And,
        for ``listed`` boxes, unless ``hits`` are listed, of the beams that meet it first: ``total``, (b,) float64,
        their weight; ``sides``, the weight of those that do not end on its roof; ``slices``, (b,) uint64, a bit for
        each of the :data:`SLICES` equal slices of its length, from the rear, in which a beam ends; and the bounds
        ``low`` and ``high`` of their ends, (b, 2) float64, along and across the box from its centre. 0, 0, 0, infinity
        and minus infinity at first.
    hits
        Filled, with room for at least all beams, or of length 0 where beams are added up: box, beam, range, coordinates
        of the hit along and across the box. Int64, int64, float64, float64, float64. Hits of a box are contiguous.

    Returns
    -------
    next_frame, count
        The frame to continue with, and the number of listed hits.
    """
    starts, values, low, high, listed = boxes
    bands, slopes, azimuth = beams[0], beams[1], beams[2]
    alone, counted = sums[0], sums[1:]
    max_boxes, count, room = 0, 0, hits[0].shape[0]
    for f in range(begin, starts.shape[0] - 1):
        max_boxes = max(max_boxes, starts[f + 1] - starts[f])
    facing, block, span = np.empty((max_boxes, 15)), np.empty((max_boxes, 9)), np.empty((max_boxes, 2))
    box, away, t_m = np.empty(max_boxes, np.int64), np.empty(max_boxes), np.empty(azimuth.shape[0])
    runs, filled = np.empty((max_boxes, 3 * bands.shape[0], 2), np.int64), np.zeros(max_boxes, np.int64)
    selected = np.empty(azimuth.shape[0], np.int64)
    for f in range(begin, starts.shape[0] - 1):
        if room > 0 and count + azimuth.shape[0] > room:
            return f, count
        first, last = starts[f], starts[f + 1]
        for b in range(first, last):
            x, y, z = values[b, 0] - o[0], values[b, 1] - o[1], values[b, 2] - o[2]
            away[b - first] = x * x + y * y + z * z
        order = np.argsort(away[: last - first], kind="mergesort")
        frame_values, frame_low, frame_high = values[first:last], low[first:last], high[first:last]
        oriented = orient_boxes(o, order, frame_values, frame_low, frame_high, size_m, facing, block, span, box)
        for k in range(oriented):
            lowest, highest = _slope_bounds(block[k])
            filled[k] = 0
            for i in range(bands.shape[0] - 1):
                if slopes[i, 0] <= highest and slopes[i, 1] >= lowest:
                    filled[k] = _append_runs(span[k], azimuth[bands[i] : bands[i + 1]], bands[i], runs[k], filled[k])
            alone[first + box[k]] = _intersect_box(k, facing[k], beams, runs[k, : filled[k]], owner, range_m, t_m)
        for k in range(oriented):
            b, box_runs = first + box[k], runs[k, : filled[k]]
            if listed[b] and room > 0:
                count = _list_box_hits(k, b, facing[k], beams, box_runs, owner, range_m, hits, count)
            elif listed[b]:
                _add_box_hits(k, b, facing[k], beams, box_runs, owner, range_m, selected, counted)
        for k in range(oriented):
            _clear_box_hits(runs[k, : filled[k]], beams[4], owner, range_m)
    return starts.shape[0] - 1, count


@_kernel
def accumulate_hits(box, weight, along, across, boxes, sums):  # type: ignore[no-untyped-def]
    """Add up hits that :func:`first_hits` listed.

    Parameters
    ----------
    box, weight, along, across
        Of each hit: its box, its weight, its coordinates along and across the box; (k,) int64 and float64.
    boxes
        As :func:`egvs.kernels.occlusion.box_bounds` takes them, (b, 8) float64.
    sums
        Added to: ``total``, ``sides``, ``slices``, ``low`` and ``high``, as :func:`first_hits` fills them.
    """
    total, sides, slices, low, high = sums
    for i in range(box.shape[0]):
        b, half_length, half_width = box[i], 0.5 * boxes[box[i], 5] - SHRINK_M, 0.5 * boxes[box[i], 6] - SHRINK_M
        total[b] += weight[i]
        if weight[i] > 0.0:
            sides[b] += weight[i] if _is_on_side(along[i], across[i], half_length, half_width) else 0.0
            slices[b] |= _slice_of(along[i], half_length)
            low[b, 0], high[b, 0] = min(low[b, 0], along[i]), max(high[b, 0], along[i])
            low[b, 1], high[b, 1] = min(low[b, 1], across[i]), max(high[b, 1], across[i])


@_kernel
def longest_slice_gaps(slices, share):  # type: ignore[no-untyped-def]
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
    """Fill the rectangles that boxes (n, 8) cover in plan view, pitched or not.

    ``plan``, (n, 6) float64: centre x, y, cosine and sine of the yaw, half length, half width.
    """
    for b in range(boxes.shape[0]):
        plan[b, 0], plan[b, 1] = boxes[b, 0], boxes[b, 1]
        plan[b, 2], plan[b, 3] = math.cos(boxes[b, 3]), math.sin(boxes[b, 3])
        plan[b, 4] = 0.5 * (boxes[b, 5] * abs(math.cos(boxes[b, 4])) + boxes[b, 7] * abs(math.sin(boxes[b, 4])))
        plan[b, 5] = 0.5 * boxes[b, 6]


@_kernel
def _corner_distance(a, b):  # type: ignore[no-untyped-def]
    """Squared distance from rectangle a to the nearest corner of b; and whether all of b is beyond one side of a.

    In a's own frame, the distance of a point is how far it is beyond the nearest sides, along and across.
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
def rectangle_distance(a, b):  # type: ignore[no-untyped-def]
    """Smallest distance between two rectangles of :func:`footprints`, metres; 0 where they overlap or touch.

    They are apart when one is beyond a side of the other (separating axes); then a corner of one is nearest.
    """
    from_a, beyond_a = _corner_distance(a, b)
    from_b, beyond_b = _corner_distance(b, a)
    if beyond_a or beyond_b:
        return math.sqrt(min(from_a, from_b))
    return 0.0


@_kernel
def neighbour_distances(starts, plan, selected, others, gap_m):  # type: ignore[no-untyped-def]
    """Fill the distance of each box to its nearest neighbour in its frame, in plan view.

    Parameters
    ----------
    starts
        Boxes starts[f] to starts[f + 1] are those of frame f, (frames + 1,) int64.
    plan
        As :func:`footprints` fills it, (b, 6).
    selected, others
        The boxes to fill, and those that count as neighbours, (b,) bool.
    gap_m
        Filled for the selected boxes, (b,) float64; infinite without a neighbour.
    """
    for f in range(starts.shape[0] - 1):
        for i in range(starts[f], starts[f + 1]):
            if not selected[i]:
                continue
            nearest, reach = np.inf, math.sqrt(plan[i, 4] ** 2 + plan[i, 5] ** 2)
            for j in range(starts[f], starts[f + 1]):
                if i == j or not others[j]:
                    continue
                away = math.sqrt((plan[j, 0] - plan[i, 0]) ** 2 + (plan[j, 1] - plan[i, 1]) ** 2)
                if away - reach - math.sqrt(plan[j, 4] ** 2 + plan[j, 5] ** 2) < nearest:
                    nearest = min(nearest, rectangle_distance(plan[i], plan[j]))
            gap_m[i] = nearest
