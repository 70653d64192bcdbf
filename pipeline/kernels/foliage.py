r"""Finds where the leaves' share of a beam ends.

Frame: any one with the world's axes, in metres, float64. A crown is a closed surface of triangles with one leaf density
throughout; along a beam the share that gets as far as a depth s of leaves is :math:`e^{-k s}`, where overlapping crowns
add up.

Steps for a beam: leave out crowns whose bounding ball it misses; meet the triangles of the others by the rules of
:mod:`pipeline.kernels.rays`, as the caster does, so that a crown begins where it began when it was opaque; what lies
between two neighbouring meetings is inside when its middle is (winding number, or on the surface), so nothing has to
pair, and an edge that is met twice adds a stretch without length; cut what is inside into steps; end each step's loss
at its mean depth.

Shares are whole multiples of 2**-32, as hits are, so the parts of a beam add up to exactly that beam; depths of ends
are rounded to 1 nanometre. So last-bit differences of exp between machines do not travel on.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.kernels.compile_cache import compiled
from pipeline.kernels.rays import EDGE_M, _inside, meet
from pipeline.kernels.solids import crossing

LEAST = 2.0**-33
"""A part of a whole beam up to this size would be rounded to nothing when hits are added up; its neighbour takes it."""

_FINE = 2.0**32
_NANO = 1e9

_kernel = compiled()


@_kernel
def _holds(x, y, z, triangles, planes):  # type: ignore[no-untyped-def]
    """Whether a point lies in a closed surface, or on it to EDGE_M."""
    winding = 0
    for m in range(triangles.shape[0]):
        plane = planes[m]
        away = plane[0, 0] * x + plane[0, 1] * y + plane[0, 2] * z - plane[0, 3]
        if abs(away) <= EDGE_M:
            _, on = _inside(triangles[m], plane, x - away * plane[0, 0], y - away * plane[0, 1], z - away * plane[0, 2])
            if on:
                return True
        sign, height = crossing(triangles[m], x, y)
        if sign != 0 and height > z:
            winding += sign
    return winding != 0


@_kernel
def _ball_missed(ball, o, d, far):  # type: ignore[no-untyped-def]
    """Whether the segment of length ``far`` stays outside a ball (centre, radius squared)."""
    x, y, z = ball[0] - o[0], ball[1] - o[1], ball[2] - o[2]
    t = min(max(x * d[0] + y * d[1] + z * d[2], 0.0), far)
    x, y, z = x - t * d[0], y - t * d[1], z - t * d[2]
    return x * x + y * y + z * z > ball[3]


@_kernel
def _stretches(triangles, planes, ball, o, d, far, ts, low, high, count):  # type: ignore[no-untyped-def]
    """Append the stretches of a beam inside one crown, in order and apart; returns how many there are now.

    A crown that is touched and no more gets a stretch of EDGE_M, so that no leaves are so dense that it is overlooked.
    """
    ox, oy, oz, dx, dy, dz = o[0], o[1], o[2], d[0], d[1], d[2]
    met = 0
    for m in range(triangles.shape[0]):
        t, _, _ = meet(triangles[m], planes[m], ox, oy, oz, dx, dy, dz)
        if t < np.inf:
            ts[met] = t
            met += 1
    if met == 0:
        return count
    if not _ball_missed(ball, o, d, 0.0) and _holds(ox, oy, oz, triangles, planes):
        ts[met] = 0.0  # the sensor stands on the crown
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
            middle = 0.5 * (t + ts[i + 1])
            joined = ts[i + 1] - t <= EDGE_M or _holds(
                ox + middle * dx, oy + middle * dy, oz + middle * dz, triangles, planes
            )
            if joined:
                high[count - 1] = min(max(high[count - 1], ts[i + 1]), far)
    return count


@_kernel
def _clip(o, d, size, far):  # type: ignore[no-untyped-def]
    """Where a beam enters and leaves the box [0, size]; ``far`` twice when it does not."""
    first, last = 0.0, far
    for a in range(3):
        if d[a] == 0.0:
            if not 0.0 <= o[a] <= size[a]:
                return far, far
        else:
            t0, t1 = (0.0 - o[a]) / d[a], (size[a] - o[a]) / d[a]
            first, last = max(first, min(t0, t1)), min(last, max(t0, t1))
    return (first, last) if first < last else (far, far)


@_kernel
def _mean_depth(k, h):  # type: ignore[no-untyped-def]
    """Mean depth at which a step of length h takes what it takes, at extinction k."""
    x = k * h
    return h * (0.5 - x / 12) if x < 1e-3 else 1 / k - h / math.expm1(x)


@_kernel
def _layers(low, high, count, middle):  # type: ignore[no-untyped-def]
    """In how many stretches a range lies."""
    layers = 0
    for j in range(count):
        layers += low[j] < middle < high[j]
    return layers


@_kernel
def _with_room(rows, shares, ends, total, more):  # type: ignore[no-untyped-def]
    """The three lists with room for so many more after ``total``."""
    if total + more <= rows.shape[0]:
        return rows, shares, ends
    size = 2 * (total + more)
    longer = np.empty(size, np.int64), np.empty(size), np.empty(size)
    longer[0][:total], longer[1][:total], longer[2][:total] = rows[:total], shares[:total], ends[:total]
    return longer


@_kernel
def _parts(marks, low, high, count, inner, outer, least, extinction, step_m, shares, ends):  # type: ignore[no-untyped-def]
    """Fill shares and ends of one beam's parts from its marks, ascending; returns how many there are."""
    depth, kept, parts = 0.0, 1.0, 0  # optical depth so far; what is in no part yet
    for i in range(marks.shape[0] - 1):
        middle, length = 0.5 * (marks[i] + marks[i + 1]), marks[i + 1] - marks[i]
        layers = _layers(low, high, count, middle)
        if layers == 0 or length <= 0.0:
            continue
        steps = max(1, math.ceil(length / step_m)) if inner <= middle <= outer else 1
        k, h = layers * extinction, length / steps
        mean = np.rint(_mean_depth(k, h) * _NANO) / _NANO
        for s in range(steps):
            depth += k * h
            after = np.rint(math.exp(-depth) * _FINE) / _FINE
            if kept - after > least:
                shares[parts], ends[parts] = kept - after, marks[i] + s * h + mean
                parts, kept = parts + 1, after
    if kept > least or parts == 0:
        shares[parts], ends[parts] = kept, np.inf
        return parts + 1
    shares[parts - 1] += kept
    return parts


@_kernel
def cut(o, d, far, weight, size, starts, balls, triangles, planes, extinction, step_m):  # type: ignore[no-untyped-def]
    """Cut the beams of one sensor into parts that end in leaves, and one that goes on.

    Parameters
    ----------
    o, d, far
        The sensor (3,), unit directions (n, 3), and the range at which each beam ends (n,), float64; in the frame of
        the region of interest, which is the box [0, ``size``]. Leaves outside it are one step: where in them a beam
        ends changes no voxel.
    weight
        Of each beam, (n,) float64.
    starts, balls, triangles, planes
        Triangles starts[c] to starts[c + 1] are those of crown c, (crowns + 1,) int64; centre and squared radius of a
        ball round each crown, (crowns, 4); triangles (m, 3, 3) and planes (m, 4, 4), float64.
    extinction, step_m
        Nepers a metre within one crown, above 0; the longest step.

    Returns
    -------
    rows, shares, ends
        For each part the beam that it is of, ascending, int64; its share of that beam, float64; the range at which it
        ends, and infinity for the part that goes on to where the beam ends.
    """
    room, total = triangles.shape[0] + 1, 0
    ts, low, high, marks = np.empty(room), np.empty(room), np.empty(room), np.empty(2 * room + 2)
    rows, shares, ends = np.empty(d.shape[0], np.int64), np.empty(d.shape[0]), np.empty(d.shape[0])
    for n in range(d.shape[0]):
        count, marked, more = 0, 1, 1
        for c in range(starts.shape[0] - 1):
            if not _ball_missed(balls[c], o, d[n], far[n]):
                part = slice(starts[c], starts[c + 1])
                count = _stretches(triangles[part], planes[part], balls[c], o, d[n], far[n], ts, low, high, count)
        inner, outer = _clip(o, d[n], size, far[n])
        if count > 0:
            marked = 2 * count + 2
            marks[:count], marks[count : 2 * count], marks[2 * count], marks[2 * count + 1] = (
                low[:count],
                high[:count],
                inner,
                outer,
            )
            marks[:marked].sort()
            more = marked + int((high[:count] - low[:count]).sum() / step_m)
        rows, shares, ends = _with_room(rows, shares, ends, total, more)
        least, free_shares, free_ends = LEAST / weight[n], shares[total:], ends[total:]
        found = _parts(
            marks[:marked], low, high, count, inner, outer, least, extinction, step_m, free_shares, free_ends
        )
        rows[total : total + found] = n
        total += found
    return rows[:total], shares[:total], ends[:total]
