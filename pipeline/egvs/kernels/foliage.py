"""Foliage: which share of a beam is intercepted by leaves, and at what range.

Frame: any with the world's axes, in metres, float64. A tree crown is a closed surface of triangles with one leaf
density throughout. The share of a beam that is transmitted through s metres of foliage is :math:`e^{-k s}`; where
crowns overlap, their extinctions add up.

Steps for each beam:

1. Skip the crowns whose bounding ball it misses.
2. Intersect the triangles of the others with the rules of :mod:`egvs.kernels.ray_triangle`, as the caster does, so that
   a crown begins where it would begin if it were opaque.
3. A stretch between two neighbouring hits is inside when its middle is (by winding number, or on the surface). So hits
   need not pair up, and an edge that is hit twice adds a stretch of length 0.
4. Cut the stretches inside into steps; the loss of each step ends at its mean depth.

Shares are whole multiples of 2**-32, as hits are, so the parts of a beam add up to exactly that beam; depths are
rounded to 1 nanometre. So last-bit differences of exp between machines have no effect.
"""

from __future__ import annotations

import math

import numpy as np

from egvs.kernels.jit import njit
from egvs.kernels.occupancy import vertical_crossing
from egvs.kernels.ray_triangle import EDGE_M, contains_point, intersect

MIN_SHARE = 2.0**-33
"""A part of a whole beam up to this size would be rounded to 0 when hits are added up; the next part includes it."""

_SHARE_UNITS = 2.0**32
_DEPTH_UNITS = 1e9

_kernel = njit()


@_kernel
def split_at_leaves(o, d, far, weight, size, starts, balls, triangles, planes, extinction, step_m):  # type: ignore[no-untyped-def]
    """Split the beams of one sensor into parts that end in leaves, and one that continues.

    Parameters
    ----------
    o, d, far
        The sensor (3,), unit directions (n, 3), and the range at which each beam ends (n,), float64; in the frame of
        the region of interest, which is the box [0, ``size``]. Leaves outside it are one step: where in them a beam
        ends does not change any voxel.
    weight
        Of each beam, (n,) float64.
    size
        Of the region of interest, (3,) float64.
    starts
        Triangles starts[c] to starts[c + 1] belong to crown c, (crowns + 1,) int64.
    balls
        Centre and squared radius of a ball around each crown, (crowns, 4) float64.
    triangles, planes
        Of all crowns, (m, 3, 3) and (m, 4, 4), float64; see :func:`egvs.kernels.ray_triangle.triangle_planes`.
    extinction, step_m
        Extinction coefficient in one crown, in 1/m, above 0; the longest step.

    Returns
    -------
    rows, shares, ends
        For each part: its beam, ascending, int64; its share of that beam, float64; the range at which it ends, float64,
        infinite for the part that continues to the end of the beam.
    """
    room, total = triangles.shape[0] + 1, 0
    ts, low, high, marks = np.empty(room), np.empty(room), np.empty(room), np.empty(2 * room + 2)
    rows, shares, ends = np.empty(d.shape[0], np.int64), np.empty(d.shape[0]), np.empty(d.shape[0])
    for n in range(d.shape[0]):
        count, marked, max_parts = 0, 1, 1
        for c in range(starts.shape[0] - 1):
            if not _misses_ball(balls[c], o, d[n], far[n]):
                crown = slice(starts[c], starts[c + 1])
                count = _append_stretches(
                    triangles[crown], planes[crown], balls[c], o, d[n], far[n], ts, low, high, count
                )
        enter, leave = _clip(o, d[n], size, far[n])
        if count > 0:
            marked = 2 * count + 2
            marks[:count], marks[count : 2 * count] = low[:count], high[:count]
            marks[2 * count], marks[2 * count + 1] = enter, leave
            marks[:marked].sort()
            max_parts = marked + int((high[:count] - low[:count]).sum() / step_m)
        rows, shares, ends = _grow(rows, shares, ends, total, max_parts)
        min_share, free_shares, free_ends = MIN_SHARE / weight[n], shares[total:], ends[total:]
        parts = _fill_parts(
            marks[:marked], low, high, count, enter, leave, min_share, extinction, step_m, free_shares, free_ends
        )
        rows[total : total + parts] = n
        total += parts
    return rows[:total], shares[:total], ends[:total]


@_kernel
def _misses_ball(ball, o, d, far):  # type: ignore[no-untyped-def]
    """Whether a segment of length ``far`` stays outside a ball (centre, radius squared)."""
    x, y, z = ball[0] - o[0], ball[1] - o[1], ball[2] - o[2]
    t = min(max(x * d[0] + y * d[1] + z * d[2], 0.0), far)
    x, y, z = x - t * d[0], y - t * d[1], z - t * d[2]
    return x * x + y * y + z * z > ball[3]


@_kernel
def _append_stretches(triangles, planes, ball, o, d, far, ts, low, high, count):  # type: ignore[no-untyped-def]
    """Append the stretches of a beam inside one crown, in order and disjoint; returns their number with the new ones.

    A crown that is only touched gets a stretch of ``EDGE_M``, so that leaves of any density count.
    """
    start, direction = (o[0], o[1], o[2]), (d[0], d[1], d[2])  # not loaded anew for each triangle
    met = 0
    for m in range(triangles.shape[0]):
        t = intersect(triangles[m], planes[m], start, direction)
        if t < np.inf:
            ts[met] = t
            met += 1
    if met == 0:
        return count
    if not _misses_ball(ball, o, d, 0.0) and _is_inside(o[0], o[1], o[2], triangles, planes):
        ts[met] = 0.0  # the sensor is on the crown
        met += 1
    ts[:met].sort()
    joined = False
    for i in range(met):
        t = ts[i]
        if t >= far:
            break
        if not joined:
            low[count], high[count] = t, min(t + EDGE_M, far)
            count += 1
        if i + 1 < met:
            t_next = ts[i + 1]
            middle = 0.5 * (t + t_next)
            x, y, z = o[0] + middle * d[0], o[1] + middle * d[1], o[2] + middle * d[2]
            joined = t_next - t <= EDGE_M or _is_inside(x, y, z, triangles, planes)
            if joined:
                high[count - 1] = min(max(high[count - 1], t_next), far)
    return count


@_kernel
def _is_inside(x, y, z, triangles, planes):  # type: ignore[no-untyped-def]
    """Whether a point is inside a closed surface, or on it to ``EDGE_M``."""
    winding = 0
    for m in range(triangles.shape[0]):
        plane = planes[m]
        nx, ny, nz = plane[0, 0], plane[0, 1], plane[0, 2]
        away = nx * x + ny * y + nz * z - plane[0, 3]
        if abs(away) <= EDGE_M and contains_point(triangles[m], plane, x - away * nx, y - away * ny, z - away * nz):
            return True
        sign, height = vertical_crossing(triangles[m], x, y)
        if sign != 0 and height > z:
            winding += sign
    return winding != 0


@_kernel
def _clip(o, d, size, far):  # type: ignore[no-untyped-def]
    """Ranges at which a beam enters and leaves the box [0, size]; ``far`` twice when it does not."""
    first, last = 0.0, far
    for a in range(3):
        if d[a] == 0.0:
            if not 0.0 <= o[a] <= size[a]:
                return far, far
        else:
            t0, t1 = (0.0 - o[a]) / d[a], (size[a] - o[a]) / d[a]
            first, last = max(first, min(t0, t1)), min(last, max(t0, t1))
    if first < last:
        return first, last
    return far, far


@_kernel
def _grow(rows, shares, ends, total, parts):  # type: ignore[no-untyped-def]
    """The three lists, with room for ``parts`` elements after ``total``."""
    if total + parts <= rows.shape[0]:
        return rows, shares, ends
    size = 2 * (total + parts)
    new_rows, new_shares, new_ends = np.empty(size, np.int64), np.empty(size), np.empty(size)
    new_rows[:total], new_shares[:total], new_ends[:total] = rows[:total], shares[:total], ends[:total]
    return new_rows, new_shares, new_ends


@_kernel
def _fill_parts(marks, low, high, count, enter, leave, min_share, extinction, step_m, shares, ends):  # type: ignore[no-untyped-def]
    """Fill shares and ends of one beam's parts between its marks, ascending; returns the number of parts."""
    depth, remaining, parts = 0.0, 1.0, 0  # optical depth so far; share that is in no part yet
    for i in range(marks.shape[0] - 1):
        middle, length = 0.5 * (marks[i] + marks[i + 1]), marks[i + 1] - marks[i]
        layers = _layers(low, high, count, middle)
        if layers == 0 or length <= 0.0:
            continue
        steps = 1
        if enter <= middle <= leave:
            steps = max(1, math.ceil(length / step_m))
        k, h = layers * extinction, length / steps
        mean = np.rint(_mean_depth(k, h) * _DEPTH_UNITS) / _DEPTH_UNITS
        for s in range(steps):
            depth += k * h
            after = np.rint(math.exp(-depth) * _SHARE_UNITS) / _SHARE_UNITS
            if remaining - after > min_share:
                shares[parts], ends[parts] = remaining - after, marks[i] + s * h + mean
                parts += 1
                remaining = after
    if remaining > min_share or parts == 0:
        shares[parts], ends[parts] = remaining, np.inf
        return parts + 1
    shares[parts - 1] += remaining
    return parts


@_kernel
def _layers(low, high, count, middle):  # type: ignore[no-untyped-def]
    """Number of stretches that contain a range."""
    layers = 0
    for j in range(count):
        layers += low[j] < middle < high[j]
    return layers


@_kernel
def _mean_depth(k, h):  # type: ignore[no-untyped-def]
    """Mean depth at which a step of length h intercepts, at extinction k."""
    x = k * h
    if x < 1e-3:
        return h * (0.5 - x / 12)
    return 1 / k - h / math.expm1(x)
