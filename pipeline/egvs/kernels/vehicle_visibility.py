"""Which vehicle box each beam hits first; distances between boxes; boosted trees over these features.

Frame: that of the grid, in metres. Boxes are shrunk by 0.1 mm on each of their six sides, as in
:mod:`egvs.kernels.occlusion`; a hit is the point where a beam enters the shrunk box.

:func:`sort_beams` sorts beams into bands of similar slope, and in each band into cells of azimuth. So a box needs only
the bands that are neither too steep nor too flat for it, and of these only the cells between the azimuths that it
spans. Both bounds are those of the box *unshrunk*, so rounding loses no beam. What remains are a few long runs of
beams, which :func:`_enter_box` intersects with the box without a branch. A run starts and ends at a multiple of
:data:`BLOCK` beams: further beams do no harm, and whole blocks are computed at once.

The beams that end on a box are then those whose nearest entry is that of the box. Where two boxes are entered at
exactly the same range, the first one in the order of distance takes the beam.
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

AZIMUTH_CELLS = 1024
"""Cells of the circle."""

BLOCK = 8
"""Beams that are computed together: what a processor computes at once."""

SAME_SLOPE = 1e-9
"""Slopes that differ by less are those of one ring of a sensor, and belong to one band."""

_STEEPEST = 1e308
"""The slope of a vertical beam."""

SLICES = 64
"""Slices of a vehicle's length, to find the longest stretch without points."""

NEGLIGIBLE_CHANCE = 1e-3
"""Gaps that are rarer than this are not added up."""

MANY_POINTS = 128.0
"""From this expected number of points on a vehicle, their extent is that of all beams which meet it."""

_SHARE_UNIT = 2.0**30
"""Shares of returns are added in integer multiples of 1 / ``_SHARE_UNIT``."""

MANY_SLICES = 12.0
"""From this expected number of slices with points, the gaps after each of them are taken as independent."""

SHARE_TOLERANCE = 1e-3
"""Largest difference between a share of returns and its parabola over a vehicle."""

MAX_STEP_CHANGE = 1.0
"""Chances of gaps are interpolated over steps with at most this number of slices times the change of the chance."""

_ON_SIDE_M = 1e-6
"""A beam that ends within this distance of the plane of a side meets the side, not the roof."""

_TINY = 1e-300
"""Replaces a direction of 0 or less along an axis, which no beam has that enters through its face."""

_LARGEST_KEY = np.int64(2**63 - 1)
"""Above every key of :func:`_order_key`; its negative is below every one."""


@_inlined
def _azimuth_cell(azimuth):  # type: ignore[no-untyped-def]
    """The cell of an azimuth in [-pi, pi]; cell 0 begins at -pi."""
    cell = np.int64((azimuth + math.pi) * (AZIMUTH_CELLS / (2.0 * math.pi)))
    return min(max(cell, 0), AZIMUTH_CELLS - 1)


@_kernel
def sort_beams(ends_m, azimuth, limits, cells, slopes, directions, length_m, cell_of):  # type: ignore[no-untyped-def]
    """Sort beams into bands of slopes, and in each band into cells of azimuth. Beams of one cell stay in their order.

    Parameters
    ----------
    ends_m, azimuth
        End of each beam relative to the sensor, (n, 3) float64; its azimuth in [-pi, pi], (n,) float64.
    limits
        Slopes between the bands, ascending, (bands - 1,) float64.
    cells
        Filled, zeros at first: sorted beams cells[c] to cells[c + 1] are those of cell c % ``AZIMUTH_CELLS`` in band
        c // ``AZIMUTH_CELLS``, (bands * AZIMUTH_CELLS + 1,) int64.
    slopes
        Filled: the lowest and the highest rise over run in each band, (bands, 2) float64.
    directions, length_m
        Filled, zeros at first: the sorted unit directions (3, m) and lengths (m,), float64. m is the
        next multiple of :data:`BLOCK`; the last ones are beams without length, which meet nothing.
    cell_of
        Scratch, (n,) int64.
    """
    bands = limits.shape[0] + 1
    for b in range(bands):
        slopes[b, 0], slopes[b, 1] = np.inf, -np.inf
    for n in range(ends_m.shape[0]):
        x, y, z = ends_m[n, 0], ends_m[n, 1], ends_m[n, 2]
        slope = z / np.sqrt(x * x + y * y)
        if not abs(slope) < _STEEPEST:  # vertical, or without length
            slope = 0.0 if z == 0.0 else math.copysign(_STEEPEST, z)
        band = np.int64(0)
        while band < bands - 1 and limits[band] < slope + SAME_SLOPE:
            band += 1
        slopes[band, 0], slopes[band, 1] = min(slopes[band, 0], slope), max(slopes[band, 1], slope)
        cell_of[n] = band * AZIMUTH_CELLS + _azimuth_cell(azimuth[n])
        cells[cell_of[n] + 1] += 1
    for c in range(cells.shape[0] - 1):
        cells[c + 1] += cells[c]
    for n in range(ends_m.shape[0]):
        at = cells[cell_of[n]]
        cells[cell_of[n]] += 1
        x, y, z = ends_m[n, 0], ends_m[n, 1], ends_m[n, 2]
        length = np.sqrt((x * x + y * y) + z * z)
        directions[0, at], directions[1, at], directions[2, at] = x / length, y / length, z / length
        length_m[at] = length
    for c in range(cells.shape[0] - 1, 0, -1):  # each is now where the next one begins
        cells[c] = cells[c - 1]
    cells[0] = 0


@_inlined
def _cells_of_span(span):  # type: ignore[no-untyped-def]
    """First and last cell of a span of azimuths; the first is larger where the span crosses -pi."""
    low, high = span[0] - _MARGIN_RAD, span[1] + _MARGIN_RAD
    if low < -math.pi:
        low, high = low + 2.0 * math.pi, high + 2.0 * math.pi
    first = _azimuth_cell(low)
    if high <= math.pi:
        return first, _azimuth_cell(high)
    last = _azimuth_cell(high - 2.0 * math.pi)
    if high - low >= 2.0 * math.pi or last >= first:
        return 0, AZIMUTH_CELLS - 1
    return first, last


@_inlined
def _append_run(first, last, runs, count):  # type: ignore[no-untyped-def]
    """Append beams first .. last in whole blocks, without those of the run before; returns the number of runs."""
    if first < last:
        first, last = first // BLOCK * BLOCK, (last + BLOCK - 1) // BLOCK * BLOCK
        if count > 0:
            first = max(first, runs[count - 1, 1])
        if first < last:
            runs[count, 0], runs[count, 1] = first, last
            count += 1
    return count


@_kernel
def _find_runs(span, bounds, cells, slopes, runs):  # type: ignore[no-untyped-def]
    """Fill the runs of beams that can meet a box, ascending, and return their number.

    Parameters
    ----------
    span, bounds
        First and last azimuth of the box, lowest and highest slope.
    cells, slopes
        As :func:`sort_beams` fills them.
    runs
        Filled: the first beam of each run and one past the last, (2 * bands, 2) int64.
    """
    first, last = _cells_of_span(span)
    lowest, highest = bounds
    count = np.int64(0)
    for band in range(slopes.shape[0]):
        if slopes[band, 0] <= highest and slopes[band, 1] >= lowest:
            begin = band * AZIMUTH_CELLS
            if first <= last:
                count = _append_run(cells[begin + first], cells[begin + last + 1], runs, count)
            else:
                count = _append_run(cells[begin], cells[begin + last + 1], runs, count)
                count = _append_run(cells[begin + first], cells[begin + AZIMUTH_CELLS], runs, count)
    return count


@_kernel
def _slope_bounds(block):  # type: ignore[no-untyped-def]
    """Lowest and highest rise over run of rays from the sensor that can meet a block of :func:`orient_boxes`."""
    near_u, near_v = max(abs(block[2]) - block[3], 0.0), max(abs(block[4]) - block[5], 0.0)
    far_u, far_v = abs(block[2]) + block[3], abs(block[4]) + block[5]
    near, far = math.sqrt(near_u * near_u + near_v * near_v), math.sqrt(far_u * far_u + far_v * far_v)
    return block[6] / (near if block[6] < 0.0 else far), block[7] / (near if block[7] > 0.0 else far)


@_inlined
def _facing_axis(x, y, z, o, half):  # type: ignore[no-untyped-def]
    """One axis of a box, a fifth of a row of ``facing``, turned so that the sensor is on its negative side.

    Returns its direction (3), the sensor's coordinate, the half size; the distance along it to the face through which
    the box can be entered, 0 where the sensor is between both faces; and what the direction of a beam that enters must
    exceed, and its coordinate then.
    """
    if o > 0.0:
        x, y, z, o = -x, -y, -z, -o
    if o <= -half:
        return x, y, z, o, half, -half - o, 0.0, -np.inf
    return x, y, z, o, half, 0.0, -np.inf, -half


@_kernel
def _enter_box(box, directions, length_m, runs, nearest_m, t_m):  # type: ignore[no-untyped-def]
    """Intersect runs of beams with a box, a row of ``facing``; lower ``nearest_m`` to where they enter it.

    The range is that of the last slab to be entered, to the last bit as in
    :func:`egvs.kernels.occlusion._entry_range`. It counts when the beam has not left any slab by then, which needs only
    a product: so there is a division for each axis, not for each plane.

    Parameters
    ----------
    box, directions, length_m, runs
        The box, all beams and their lengths, and the runs to intersect.
    nearest_m
        Range of the nearest entry of each beam, or its length, (n,) float64.
    t_m
        Filled: where each beam of the runs enters the box, run after run, infinite where it does not.

    Returns
    -------
    met, ties
        Number of beams that meet the box; of those that enter it exactly where they entered another box.
    """
    ax, ay, az, ao, ah, to_a, least_a, low_a = _facing_axis(box[0], box[1], box[2], box[3], box[4])
    bx, by, bz, bo, bh, to_b, least_b, low_b = _facing_axis(box[5], box[6], box[7], box[8], box[9])
    cx, cy, cz, co, ch, to_c, least_c, low_c = _facing_axis(box[10], box[11], box[12], box[13], box[14])
    met, ties, done = 0, 0, 0
    for r in range(runs.shape[0]):
        first, last = runs[r, 0], runs[r, 1]
        x, y, z = directions[0, first:last], directions[1, first:last], directions[2, first:last]
        longest, nearest, run_t_m = length_m[first:last], nearest_m[first:last], t_m[done : done + last - first]
        for n in range(last - first):
            a = ax * x[n] + ay * y[n] + az * z[n]
            b = bx * x[n] + by * y[n] + bz * z[n]
            c = cx * x[n] + cy * y[n] + cz * z[n]
            t_a, t_b, t_c = to_a / max(a, _TINY), to_b / max(b, _TINY), to_c / max(c, _TINY)
            t = t_a if t_a > t_b else t_b
            t = t if t > t_c else t_c
            on_a, on_b, on_c = ao + t * a, bo + t * b, co + t * c
            meets = (t < longest[n]) & (a > least_a) & (b > least_b) & (c > least_c)
            meets &= (on_a < ah) & (on_b < bh) & (on_c < ch) & (on_a > low_a) & (on_b > low_b) & (on_c > low_c)
            t = t if meets else np.inf
            run_t_m[n] = t
            met += meets
            ties += t == nearest[n]
            nearest[n] = t if t < nearest[n] else nearest[n]
        done += last - first
    return met, ties


@_inlined
def _order_key(x):  # type: ignore[no-untyped-def]
    """An integer for each float64, in the same order: of integers, a processor finds the least of several at once."""
    bits = np.float64(x).view(np.int64)
    return bits ^ ((bits >> np.int64(63)) & _LARGEST_KEY)


@_inlined
def _key_value(key):  # type: ignore[no-untyped-def]
    """The number whose key this is."""
    return np.int64(key ^ ((key >> np.int64(63)) & _LARGEST_KEY)).view(np.float64)


@_inlined
def _is_on_side(along, across, half_length, half_width):  # type: ignore[no-untyped-def]
    """Whether a hit is on a side of its box, not on its roof (or, from below, its underside)."""
    return (abs(along) > half_length - _ON_SIDE_M) | (abs(across) > half_width - _ON_SIDE_M)


@_inlined
def _slice_of(along, half_length):  # type: ignore[no-untyped-def]
    """The slice of the box's length that a hit is in."""
    part = SLICES * (0.5 * along / half_length + 0.5)
    return np.uint64(np.int32(min(max(part, 0.0), SLICES - 1.0)))


@_kernel
def _count_box_hits(b, box, directions, runs, nearest_m, t_m, sums):  # type: ignore[no-untyped-def]
    """Fill the sums of :func:`first_hits` for box b of all frames, where each beam counts 1."""
    ax, ay, az, ao, ah = box[0], box[1], box[2], box[3], box[4]
    bx, by, bz, bo, bh = box[5], box[6], box[7], box[8], box[9]
    count, on_sides, parts, done = 0, 0, np.uint64(0), 0
    a_low, a_high, b_low, b_high = _LARGEST_KEY, -_LARGEST_KEY, _LARGEST_KEY, -_LARGEST_KEY
    for r in range(runs.shape[0]):
        first, last = runs[r, 0], runs[r, 1]
        x, y, z = directions[0, first:last], directions[1, first:last], directions[2, first:last]
        nearest, run_t_m = nearest_m[first:last], t_m[done : done + last - first]
        for n in range(last - first):
            ends_here, t = run_t_m[n] == nearest[n], run_t_m[n]
            along = ao + t * (ax * x[n] + ay * y[n] + az * z[n])
            across = bo + t * (bx * x[n] + by * y[n] + bz * z[n])
            count += ends_here
            on_sides += ends_here & _is_on_side(along, across, ah, bh)
            parts |= (np.uint64(1) if ends_here else np.uint64(0)) << _slice_of(along, ah)
            u, v = _order_key(along), _order_key(across)
            a_low, a_high = min(a_low, u if ends_here else _LARGEST_KEY), max(a_high, u if ends_here else -_LARGEST_KEY)
            b_low, b_high = min(b_low, v if ends_here else _LARGEST_KEY), max(b_high, v if ends_here else -_LARGEST_KEY)
        done += last - first
    total, sides, slices, low, high = sums
    if count > 0:
        total[b], sides[b], slices[b] = count, on_sides, parts
        low[b, 0], high[b, 0] = _key_value(a_low), _key_value(a_high)
        low[b, 1], high[b, 1] = _key_value(b_low), _key_value(b_high)


@_kernel
def _list_rows(runs, nearest_m, t_m, rows):  # type: ignore[no-untyped-def]
    """List the beams that end on a box, in their order, without a branch for each; returns their number.

    ``rows``: int64, one more than there are beams.
    """
    count, done = np.int64(0), 0
    for r in range(runs.shape[0]):
        first, last = runs[r, 0], runs[r, 1]
        nearest, t = nearest_m[first:last], t_m[done : done + last - first]
        for i in range(last - first):
            rows[count] = first + i
            count += t[i] == nearest[i]
        done += last - first
    return count


@_kernel
def _add_box_hits(b, box, directions, rows, nearest_m, weight, sums):  # type: ignore[no-untyped-def]
    """Fill the sums of :func:`first_hits` for box b of all frames, on which the beams ``rows`` end."""
    ax, ay, az, ao, ah = box[0], box[1], box[2], box[3], box[4]
    bx, by, bz, bo, bh = box[5], box[6], box[7], box[8], box[9]
    x, y, z = directions[0], directions[1], directions[2]
    total, sides, slices, low, high = sums
    hit_weight, on_sides, parts = 0.0, 0.0, np.uint64(0)
    a_low, a_high, b_low, b_high = np.inf, -np.inf, np.inf, -np.inf
    for n in rows:
        hit_weight += weight[n]
        if weight[n] > 0.0:
            along = ao + nearest_m[n] * (ax * x[n] + ay * y[n] + az * z[n])
            across = bo + nearest_m[n] * (bx * x[n] + by * y[n] + bz * z[n])
            on_sides += weight[n] if _is_on_side(along, across, ah, bh) else 0.0
            parts |= np.uint64(1) << _slice_of(along, ah)
            a_low, a_high = min(a_low, along), max(a_high, along)
            b_low, b_high = min(b_low, across), max(b_high, across)
    total[b], sides[b], slices[b] = hit_weight, on_sides, parts
    low[b, 0], high[b, 0], low[b, 1], high[b, 1] = a_low, a_high, b_low, b_high


@_inlined
def _share_at(by_range, steps):  # type: ignore[no-untyped-def]
    """The share of returns that are detected, interpolated between the steps of range."""
    step = min(np.int64(steps), by_range.shape[0] - 2)
    return by_range[step] + min(steps - step, 1.0) * (by_range[step + 1] - by_range[step])


@_kernel
def _parabola(by_range, near, far):  # type: ignore[no-untyped-def]
    """The parabola through the share at the ends and the middle of some steps of range, as c0 + c1 u + c2 u^2.

    u is the number of steps from the middle. Returns also the largest difference at two points between.
    """
    middle, half = 0.5 * (near + far), max(0.5 * (far - near), 1e-9)
    at_near, at_middle, at_far = _share_at(by_range, near), _share_at(by_range, middle), _share_at(by_range, far)
    slope, bend = 0.5 * (at_far - at_near) / half, 0.5 * (at_far + at_near - 2.0 * at_middle) / (half * half)
    u = 0.5 * half
    below = abs(at_middle - slope * u + bend * u * u - _share_at(by_range, middle - u))
    above = abs(at_middle + slope * u + bend * u * u - _share_at(by_range, middle + u))
    return at_middle, slope, bend, max(below, above)


@_kernel
def _box_parabola(box, by_range, per_m):  # type: ignore[no-untyped-def]
    """Coefficients of the share of returns over a box, the step of range that they count from, and their error."""
    away = math.sqrt(box[3] * box[3] + box[8] * box[8] + box[13] * box[13]) * per_m
    reach = math.sqrt(box[4] * box[4] + box[9] * box[9] + box[14] * box[14]) * per_m
    near, far = max(away - reach, 0.0), away + reach
    c0, c1, c2, error = _parabola(by_range, near, far)
    return (c0, c1, c2, 0.5 * (near + far)), error


@_kernel
def _weigh_box_hits(b, box, directions, runs, nearest_m, t_m, parabola, per_m, sums):  # type: ignore[no-untyped-def]
    """Fill the sums of :func:`first_hits` for box b, where each beam counts the share of its return that is detected.

    The share is a ``parabola`` of :func:`_box_parabola`.
    """
    c0, c1, c2, middle = parabola
    ax, ay, az, ao, ah = box[0], box[1], box[2], box[3], box[4]
    bx, by, bz, bo, bh = box[5], box[6], box[7], box[8], box[9]
    units, side_units, parts, done = np.int64(0), np.int64(0), np.uint64(0), 0  # sums of integers are vectorised
    a_low, a_high, b_low, b_high = _LARGEST_KEY, -_LARGEST_KEY, _LARGEST_KEY, -_LARGEST_KEY
    for r in range(runs.shape[0]):
        first, last = runs[r, 0], runs[r, 1]
        x, y, z = directions[0, first:last], directions[1, first:last], directions[2, first:last]
        nearest, run_t_m = nearest_m[first:last], t_m[done : done + last - first]
        for n in range(last - first):
            ends_here, t = run_t_m[n] == nearest[n], run_t_m[n]
            along = ao + t * (ax * x[n] + ay * y[n] + az * z[n])
            across = bo + t * (bx * x[n] + by * y[n] + bz * z[n])
            steps = (t if ends_here else 0.0) * per_m - middle
            share = np.int32(_SHARE_UNIT * min(max(c0 + steps * (c1 + steps * c2), 0.0), 1.0))
            units += share if ends_here else np.int32(0)
            side_units += share if ends_here & _is_on_side(along, across, ah, bh) else np.int32(0)
            parts |= (np.uint64(1) if ends_here else np.uint64(0)) << _slice_of(along, ah)
            u, v = _order_key(along), _order_key(across)
            a_low, a_high = min(a_low, u if ends_here else _LARGEST_KEY), max(a_high, u if ends_here else -_LARGEST_KEY)
            b_low, b_high = min(b_low, v if ends_here else _LARGEST_KEY), max(b_high, v if ends_here else -_LARGEST_KEY)
        done += last - first
    total, sides, slices, low, high = sums
    if parts != np.uint64(0):
        total[b], sides[b], slices[b] = units / _SHARE_UNIT, side_units / _SHARE_UNIT, parts
        low[b, 0], high[b, 0] = _key_value(a_low), _key_value(a_high)
        low[b, 1], high[b, 1] = _key_value(b_low), _key_value(b_high)


@_kernel
def _miss_slices(box, directions, rows, nearest_m, parabola, per_m, misses):  # type: ignore[no-untyped-def]
    """Fill the misses (2, SLICES) of a box: the probability that no return of the beams ``rows`` is from a slice."""
    c0, c1, c2, middle = parabola
    ax, ay, az, ao, ah = box[0], box[1], box[2], box[3], box[4]
    bx, by, bz, bo, bh = box[5], box[6], box[7], box[8], box[9]
    x, y, z = directions[0], directions[1], directions[2]
    misses[:] = 1.0
    by_length, by_width = misses[0], misses[1]
    for n in rows:
        t = nearest_m[n]
        steps = t * per_m - middle
        miss = np.float32(1.0 - min(max(c0 + steps * (c1 + steps * c2), 0.0), 1.0))
        by_length[_slice_of(ao + t * (ax * x[n] + ay * y[n] + az * z[n]), ah)] *= miss
        by_width[_slice_of(bo + t * (bx * x[n] + by * y[n] + bz * z[n]), bh)] *= miss


@_kernel
def _thin_box_hits(b, box, directions, rows, nearest_m, weight, loss, sums):  # type: ignore[no-untyped-def]
    """Fill the sums of :func:`first_hits` and the misses for box b, on which the beams ``rows`` end."""
    shares, share_row, per_m, miss_row, misses = loss
    ax, ay, az, ao, ah = box[0], box[1], box[2], box[3], box[4]
    bx, by, bz, bo, bh = box[5], box[6], box[7], box[8], box[9]
    x, y, z = directions[0], directions[1], directions[2]
    total, sides, slices, low, high = sums
    by_range, is_weighted = shares[share_row[b]], weight.shape[0] > 0
    by_length, by_width = misses[miss_row[b], 0], misses[miss_row[b], 1]
    by_length[:], by_width[:] = 1.0, 1.0
    hit_weight, on_sides, parts = 0.0, 0.0, np.uint64(0)
    a_low, a_high, b_low, b_high = np.inf, -np.inf, np.inf, -np.inf
    for n in rows:
        share = _share_at(by_range, nearest_m[n] * per_m)
        if is_weighted:
            share *= weight[n]
        if share > 0.0:
            along = ao + nearest_m[n] * (ax * x[n] + ay * y[n] + az * z[n])
            across = bo + nearest_m[n] * (bx * x[n] + by * y[n] + bz * z[n])
            hit_weight += share
            on_sides += share if _is_on_side(along, across, ah, bh) else 0.0
            part = _slice_of(along, ah)
            parts |= np.uint64(1) << part
            by_length[part] *= 1.0 - share
            by_width[_slice_of(across, bh)] *= 1.0 - share
            a_low, a_high = min(a_low, along), max(a_high, along)
            b_low, b_high = min(b_low, across), max(b_high, across)
    total[b], sides[b], slices[b] = hit_weight, on_sides, parts
    low[b, 0], high[b, 0], low[b, 1], high[b, 1] = a_low, a_high, b_low, b_high


@_kernel
def _list_box_hits(b, box, directions, rows, nearest_m, hits, count):  # type: ignore[no-untyped-def]
    """List the hits of the beams ``rows`` on box b of all frames after ``count``; returns the new number."""
    x, y, z = directions[0], directions[1], directions[2]
    hit_box, hit_row, hit_range, hit_along, hit_across = hits
    for n in rows:
        hit_box[count], hit_row[count], hit_range[count] = b, n, nearest_m[n]
        hit_along[count] = box[3] + nearest_m[n] * (box[0] * x[n] + box[1] * y[n] + box[2] * z[n])
        hit_across[count] = box[8] + nearest_m[n] * (box[5] * x[n] + box[6] * y[n] + box[7] * z[n])
        count += 1
    return count


@_kernel
def _met_weight(runs, t_m, weight):  # type: ignore[no-untyped-def]
    """Add up the weights of the beams that meet a box, in their order."""
    total, done = 0.0, 0
    for r in range(runs.shape[0]):
        for n in range(runs[r, 0], runs[r, 1]):
            total += weight[n] if t_m[done] < np.inf else 0.0
            done += 1
    return total


@_kernel
def _take_beams(runs, nearest_m, t_m):  # type: ignore[no-untyped-def]
    """Leave nothing of the beams that end on a box to the boxes behind it that they enter at the same range."""
    done = 0
    for r in range(runs.shape[0]):
        for n in range(runs[r, 0], runs[r, 1]):
            nearest_m[n] = -1.0 if t_m[done] == nearest_m[n] else nearest_m[n]
            done += 1


@_kernel
def _reset(runs, length_m, nearest_m):  # type: ignore[no-untyped-def]
    """Reset the nearest entries of the beams of ``runs``."""
    for r in range(runs.shape[0]):
        first, last = runs[r, 0], runs[r, 1]
        nearest, longest = nearest_m[first:last], length_m[first:last]
        for i in range(last - first):
            nearest[i] = longest[i]


@_kernel
def first_hits(begin, o, size_m, boxes, beams, nearest_m, loss, sums, hits):  # type: ignore[no-untyped-def]
    """Add up, or list, the beams that meet each box first: of all frames, or as many as fit in the list.

    Parameters
    ----------
    begin
        The first frame.
    o, size_m
        The sensor, (3,) float64; the grid is the box from 0 to ``size_m`` (3,).
    boxes
        ``starts``, ``order``: boxes order[starts[f]] to order[starts[f + 1]] are those of frame f that can be between
        sensor and grid, nearest first, (frames + 1,) and (m,) int64. ``values``, ``low``, ``high``: as
        :func:`egvs.kernels.occlusion.box_bounds` takes and fills them, (b, 8), (b, 3), (b, 3). ``listed``: for which
        boxes beams are added up or listed, (b,) bool; the others only occlude.
    beams
        ``cells``, ``slopes``, ``directions`` and ``length_m`` as :func:`sort_beams` fills them; the weight of each
        beam, or no weights (0,) where all are 1, float64. Weights are added in the order of the beams. Hits are
        listed only where there are weights.
    nearest_m
        Scratch, (m,) float64: the length of each beam, before and after the call.
    loss
        Losses of returns, where beams are added up: ``shares``, the share of returns that are detected at equidistant
        ranges from 0, interpolated between them, a row for each reflectivity, (k, m) float64, m > 1; no row where all
        are detected. ``share_row``: the row of each box, (b,) int64. ``per_m``: steps in a metre. ``miss_row``: the row
        of ``misses`` of each box, (b,) int64; filled with -1 for boxes with :data:`MANY_POINTS` expected points, whose
        extent is that of all beams. ``misses`` is filled: the probability that no return is from a slice of the length,
        and of the width, (n, 2, SLICES) float32.
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
    starts, order, values, low, high, listed = boxes
    cells, slopes, directions, length_m, weight = beams
    alone, added = sums[0], sums[1:]
    max_boxes, count, room = np.int64(0), np.int64(0), hits[0].shape[0]
    for f in range(begin, starts.shape[0] - 1):
        max_boxes = max(max_boxes, starts[f + 1] - starts[f])
    facing, block, span = np.empty((max_boxes, 15)), np.empty((max_boxes, 9)), np.empty((max_boxes, 2))
    box, filled, offset = (
        np.empty(max_boxes, np.int64),
        np.empty(max_boxes, np.int64),
        np.empty(max_boxes + 1, np.int64),
    )
    runs = np.empty((max_boxes, 2 * slopes.shape[0], 2), np.int64)
    rows, t_m = np.empty(length_m.shape[0] + 1, np.int64), np.empty(length_m.shape[0])
    offset[0] = 0
    for f in range(begin, starts.shape[0] - 1):
        if room > 0 and count + length_m.shape[0] > room:
            return f, count
        frame_order = order[starts[f] : starts[f + 1]]
        oriented = orient_boxes(o, frame_order, values, low, high, size_m, facing, block, span, box)
        for k in range(oriented):
            filled[k] = _find_runs(span[k], _slope_bounds(block[k]), cells, slopes, runs[k])
            offset[k + 1] = offset[k]
            for r in range(filled[k]):
                offset[k + 1] += runs[k, r, 1] - runs[k, r, 0]
        if offset[oriented] > t_m.shape[0]:
            t_m = np.empty(2 * offset[oriented])
        ties = 0
        for k in range(oriented):
            box_runs, box_t_m = runs[k, : filled[k]], t_m[offset[k] :]
            met, box_ties = _enter_box(facing[k], directions, length_m, box_runs, nearest_m, box_t_m)
            ties += box_ties
            alone[box[k]] = met if weight.shape[0] == 0 else _met_weight(box_runs, box_t_m, weight)
        for k in range(oriented):
            b, box_runs, box_t_m = box[k], runs[k, : filled[k]], t_m[offset[k] :]
            if listed[b] and weight.shape[0] == 0 and loss[0].shape[0] == 0:
                _count_box_hits(b, facing[k], directions, box_runs, nearest_m, box_t_m, added)
            elif listed[b]:
                has_losses, is_smooth, parabola = loss[0].shape[0] > 0, False, (0.0, 0.0, 0.0, 0.0)
                if has_losses and weight.shape[0] == 0:
                    parabola, error = _box_parabola(facing[k], loss[0][loss[1][b]], loss[2])
                    is_smooth = error <= SHARE_TOLERANCE
                if is_smooth:
                    _weigh_box_hits(b, facing[k], directions, box_runs, nearest_m, box_t_m, parabola, loss[2], added)
                is_certain = is_smooth and (added[0][b] >= MANY_POINTS or added[2][b] == np.uint64(0))
                box_rows = rows[:0]
                if not is_certain:
                    box_rows = rows[: _list_rows(box_runs, nearest_m, box_t_m, rows)]
                if is_certain:
                    loss[3][b] = -1
                elif is_smooth:
                    box_misses = loss[4][loss[3][b]]
                    _miss_slices(facing[k], directions, box_rows, nearest_m, parabola, loss[2], box_misses)
                elif has_losses:
                    _thin_box_hits(b, facing[k], directions, box_rows, nearest_m, weight, loss, added)
                elif room > 0:
                    count = _list_box_hits(b, facing[k], directions, box_rows, nearest_m, hits, count)
                else:
                    _add_box_hits(b, facing[k], directions, box_rows, nearest_m, weight, added)
            if ties > 0:
                _take_beams(box_runs, nearest_m, box_t_m)
        for k in range(oriented):
            _reset(runs[k, : filled[k]], length_m, nearest_m)
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
            slices[b] |= np.uint64(1) << _slice_of(along[i], half_length)
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
def expected_spans(misses, rows, bounds_m, sizes_m, spans):  # type: ignore[no-untyped-def]
    """Fill the expected distance between the outermost points, as a share of each vehicle's length and width.

    A point in a slice counts at its outer end, but not beyond ``bounds_m``. Points are lost independently.

    Parameters
    ----------
    misses
        Probability that a slice has no point: of the length, and of the width, (n, 2, SLICES) float32.
    rows
        Vehicles to fill, (k,) int64.
    bounds_m
        Lowest and highest coordinate of any point that may be detected, (n, 2, 2) float64.
    sizes_m
        Length and width, (n, 2) float64.
    spans
        Filled: shares, (n, 2) float64; 0 for a vehicle without points.
    """
    for i in rows:
        for axis in range(2):
            low, high = bounds_m[i, 0, axis], bounds_m[i, 1, axis]
            if not high > low:
                spans[i, axis] = 0.0
                continue
            size, empty_below, empty_above, span = sizes_m[i, axis], 1.0, 1.0, 0.0
            for part in range(SLICES):
                below, above = misses[i, axis, part], misses[i, axis, SLICES - 1 - part]
                if below < 1.0:  # the lowest point is in this slice
                    span -= empty_below * (1.0 - below) * max(low, size * (part / SLICES - 0.5))
                    empty_below *= below
                if above < 1.0:
                    span += empty_above * (1.0 - above) * min(high, size * (0.5 - part / SLICES))
                    empty_above *= above
            spans[i, axis] = min(max(span / size, 0.0), 1.0)


@_kernel
def _chance_of_gap(miss, part, count, gap, ends):  # type: ignore[no-untyped-def]
    """Probability that ``gap`` or more slices without points lie between two slices with points.

    All gaps are shorter with the probability of the sum over s of f(s) times that no point follows slice s, plus that
    no slice has a point, where f(s) is the probability that s has a point and all gaps before it are shorter.

    Parameters
    ----------
    miss, part
        Probability that a slice has no point, below 1, and the number of this slice, ascending; (m,) float64 and int64.
    count
        Number of slices, at most m.
    gap
        Number of slices without points, at least 1.
    ends
        Scratch, (m,) float64: f.
    """
    none_before = 1.0
    for s in range(count):
        reached, empty, before = none_before, 1.0, s - 1
        while before >= 0 and part[s] - part[before] <= gap and empty > NEGLIGIBLE_CHANCE:
            reached += ends[before] * empty
            empty *= miss[before]
            before -= 1
        ends[s] = reached * (1.0 - miss[s])
        none_before *= miss[s]
    shorter, none_after = none_before, 1.0
    for s in range(count - 1, -1, -1):
        shorter += ends[s] * none_after
        none_after *= miss[s]
    return max(1.0 - shorter, 0.0)


@_kernel
def _mean_gap_of_many(miss, part, count, none):  # type: ignore[no-untyped-def]
    """Expected longest gap between many slices with points, where the gaps after each of them are nearly independent.

    ``none``: scratch, (SLICES + 1,) float64: the probability that no gap is as long. Other parameters are as for
    :func:`_chance_of_gap`.
    """
    none[:] = 1.0
    longest = 0
    for s in range(count - 1):
        run, next_slice, gap = 1.0 - miss[s], s + 1, 1  # that s has a point, and no slice after it so far
        while next_slice < count - 1 or part[s] + gap < part[count - 1]:
            if part[s] + gap == part[next_slice]:
                run *= miss[next_slice]
                next_slice += 1
            if run < NEGLIGIBLE_CHANCE:
                break
            none[gap] *= 1.0 - run
            gap += 1
        longest = max(longest, gap - 1)
    mean = 0.0
    for gap in range(1, longest + 1):
        mean += 1.0 - none[gap]
    return mean


@_kernel
def expected_gaps(misses, rows, share):  # type: ignore[no-untyped-def]
    """Fill the expected longest stretch between two slices with points, as a share of the length, (n,) float64.

    ``misses`` and ``rows`` are as for :func:`expected_spans`; other vehicles are not filled.
    """
    miss, part, ends, none = np.empty(SLICES), np.empty(SLICES, np.int64), np.empty(SLICES), np.empty(SLICES + 1)
    for i in rows:
        count, occupied = 0, 0.0
        for s in range(SLICES):
            if misses[i, 0, s] < 1.0:
                miss[count], part[count] = misses[i, 0, s], s
                occupied += 1.0 - miss[count]
                count += 1
        if occupied >= MANY_SLICES:
            share[i] = _mean_gap_of_many(miss, part, count, none) / SLICES
            continue
        total, gap, chance = 0.0, 0, 1.0  # sums the chances of gaps 1, 2, ...; longer ones are rarer
        most = part[count - 1] - part[0] - 1 if count > 1 else 0
        step = 4
        while gap < most and chance > NEGLIGIBLE_CHANCE:
            step = min(step, most - gap)
            next_chance = _chance_of_gap(miss, part, count, gap + step, ends)
            while step > 1 and (chance - next_chance) * step > MAX_STEP_CHANGE:
                step //= 2
                next_chance = _chance_of_gap(miss, part, count, gap + step, ends)
            total += 0.5 * ((step - 1) * chance + (step + 1) * next_chance)  # linear in between
            gap, chance, step = gap + step, next_chance, 2 * step
        share[i] = total / SLICES


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
