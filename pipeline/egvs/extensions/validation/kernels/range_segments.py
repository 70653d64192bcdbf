r"""Segments of a sweep on its graph of neighbouring beams, and rectangles around them.

**Segments** (:func:`join_neighbours`): two returns of neighbouring beams belong to one surface unless the range jumps
between them. With ranges :math:`d_1 \ge d_2` and the angle :math:`\alpha` between the beams, the line through both
points meets the longer beam at the angle

.. math:: \beta = \operatorname{atan2}(d_2 \sin\alpha,\; d_1 - d_2 \cos\alpha)

(Bogoslavskyi and Stachniss, "Fast Range Image-Based Segmentation of Sparse 3D Laser Scans for Online Operation", IROS
2016). A small :math:`\beta` is a jump in range, or a surface that is seen at a grazing angle, so points that are close
to each other are joined in any case, and points that are far apart never.

**Rectangles** (:func:`search_rectangles`): of all headings, take the one whose rectangle suits the points best, by area
or by the variance criterion of Zhang, Xu, Dong, Dolan ("Efficient L-Shape Fitting for Vehicle Detection Using Laser
Scanners", IV 2017, algorithms 3 and 5): each point belongs to the nearer of the two sides, and the distances to the
sides should scatter little,

.. math:: \gamma(\theta) = -\operatorname{var}(E_1) - \operatorname{var}(E_2)

Frames: segments need only angles and distances; rectangles are in plan, in any frame, in metres.
"""

from __future__ import annotations

import math

import numpy as np

from egvs.kernels.jit import njit

_kernel = njit()

BY_VARIANCE, BY_AREA = 0, 1
"""Criteria of :func:`search_rectangles`."""

SUMMARY = (
    "points", "z_low_m", "z_high_m", "z_mean_m", "z_high_low_a_m", "z_high_mid_a_m", "z_high_high_a_m",
    "z_high_low_b_m", "z_high_high_b_m", "share_on_low_a", "share_on_low_b", "hidden_low_a", "hidden_high_a",
    "hidden_low_b", "hidden_high_b",
)  # fmt: skip
"""Columns of :func:`summarise_segments`."""

MAX_SEARCHED = 400
"""Of a segment with more points, the heading is searched with evenly chosen ones, at least this many."""

ON_SIDE_M = 0.25
"""Points within this distance of a side of the rectangle are on it."""


@_kernel
def _root(parent, i):  # type: ignore[no-untyped-def]
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@_kernel
def join_neighbours(points, range_m, beam, point_of_beam, starts, neighbours, limits, label):  # type: ignore[no-untyped-def]
    """Join the points of neighbouring beams to segments.

    Parameters
    ----------
    points
        Points in the sensor's frame, (n, 3) float64.
    range_m
        Their ranges, (n,) float64.
    beam
        The beam of each, (n,) int64.
    point_of_beam
        The point of each beam, -1 without one, (beams,) int64.
    starts, neighbours
        Neighbours of beam b are neighbours[starts[b]] to neighbours[starts[b + 1]], each pair in both directions.
    limits
        The smallest tangent of beta; the distance up to which points are always joined, and the one up to which they
        may be, in metres, (3,) float64. Both distances grow by the arc between the two beams.
    label
        Filled: the smallest index among the points of each point's segment, (n,) int64.
    """
    for i in range(points.shape[0]):
        label[i] = i
    for i in range(points.shape[0]):
        for k in range(starts[beam[i]], starts[beam[i] + 1]):
            j = point_of_beam[neighbours[k]]
            if j <= i:
                continue
            far, near = max(range_m[i], range_m[j]), min(range_m[i], range_m[j])
            dot, square = 0.0, 0.0
            for axis in range(3):
                dot += points[i, axis] * points[j, axis]
                square += (points[i, axis] - points[j, axis]) ** 2
            cosine = min(1.0, dot / (far * near))
            sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
            apart_m, arc_m = math.sqrt(square), near * sine
            if apart_m > limits[2] + arc_m:
                continue
            if near * sine < limits[0] * (far - near * cosine) and apart_m > limits[1] + arc_m:
                continue
            a, b = _root(label, i), _root(label, j)
            if a != b:
                label[max(a, b)] = min(a, b)
    for i in range(points.shape[0]):
        label[i] = _root(label, i)


@_kernel
def hidden_edges(range_m, beam, label, point_of_beam, scene_range_m, starts, neighbours, step_m, hidden):  # type: ignore[no-untyped-def]
    """Mark points beside which something nearer, outside their segment, hides what is behind.

    Parameters
    ----------
    range_m, beam, label, point_of_beam, starts, neighbours
        As in :func:`join_neighbours`.
    scene_range_m
        Range of each beam in this sweep; of the empty scan where there is no new point, (beams,) float64.
    step_m
        Something is nearer if its range is shorter by more than this.
    hidden
        Filled, (n,) bool.
    """
    for i in range(range_m.shape[0]):
        hidden[i] = False
        for k in range(starts[beam[i]], starts[beam[i] + 1]):
            other = neighbours[k]
            j = point_of_beam[other]
            if (j < 0 or label[j] != label[i]) and scene_range_m[other] < range_m[i] - step_m:
                hidden[i] = True


@_kernel
def _variance(total, squares, count):  # type: ignore[no-untyped-def]
    return squares / count - (total / count) ** 2 if count > 0 else 0.0


@_kernel
def _variance_criterion(u, v, u_low, u_high, v_low, v_high):  # type: ignore[no-untyped-def]
    """The variance criterion of points that are projected on two axes."""
    u_below, u_above, v_below, v_above = 0.0, 0.0, 0.0, 0.0
    for i in range(u.shape[0]):
        u_below += (u[i] - u_low) ** 2
        u_above += (u_high - u[i]) ** 2
        v_below += (v[i] - v_low) ** 2
        v_above += (v_high - v[i]) ** 2
    count_u, total_u, square_u = 0, 0.0, 0.0
    count_v, total_v, square_v = 0, 0.0, 0.0
    for i in range(u.shape[0]):
        to_u = u[i] - u_low if u_below <= u_above else u_high - u[i]
        to_v = v[i] - v_low if v_below <= v_above else v_high - v[i]
        if to_u < to_v:
            count_u, total_u, square_u = count_u + 1, total_u + to_u, square_u + to_u * to_u
        else:
            count_v, total_v, square_v = count_v + 1, total_v + to_v, square_v + to_v * to_v
    return -_variance(total_u, square_u, count_u) - _variance(total_v, square_v, count_v)


@_kernel
def search_rectangles(xy_m, starts, cosine, sine, criterion, heading, ends_m, value):  # type: ignore[no-untyped-def]
    """Find the heading of the rectangle around each segment.

    Parameters
    ----------
    xy_m
        Points of all segments, one segment after the other, (n, 2) float64.
    starts
        Points of segment s are starts[s] to starts[s + 1], (m + 1,) int64; none is empty.
    cosine, sine
        Of the candidate headings, from 0 to less than 90 degrees, (h,) float64.
    criterion
        :data:`BY_VARIANCE` or :data:`BY_AREA`.
    heading
        Filled: index of the best one, the first of equal ones, (m,) int64.
    ends_m
        Filled: lowest and highest coordinate along the heading, then across it (counter-clockwise), (m, 4) float64.
    value
        Filled: the criterion of the searched points, m2; minus the variances, or minus the area, (m,) float64.
    """
    for s in range(starts.shape[0] - 1):
        step = max(1, (starts[s + 1] - starts[s]) // MAX_SEARCHED)
        first, count = starts[s], (starts[s + 1] - starts[s] - 1) // step + 1
        u, v = np.empty(count), np.empty(count)
        value[s] = -np.inf
        for h in range(cosine.shape[0]):
            u_low, u_high, v_low, v_high = np.inf, -np.inf, np.inf, -np.inf
            for i in range(count):
                x, y = xy_m[first + step * i, 0], xy_m[first + step * i, 1]
                u[i], v[i] = x * cosine[h] + y * sine[h], y * cosine[h] - x * sine[h]
                u_low, u_high = min(u_low, u[i]), max(u_high, u[i])
                v_low, v_high = min(v_low, v[i]), max(v_high, v[i])
            if criterion == BY_AREA:
                found = -(u_high - u_low) * (v_high - v_low)
            else:
                found = _variance_criterion(u, v, u_low, u_high, v_low, v_high)
            if found > value[s]:
                value[s], heading[s] = found, h
        h = heading[s]
        ends_m[s, 0], ends_m[s, 1], ends_m[s, 2], ends_m[s, 3] = np.inf, -np.inf, np.inf, -np.inf
        for i in range(first, starts[s + 1]):
            x, y = xy_m[i, 0], xy_m[i, 1]
            along, across = x * cosine[h] + y * sine[h], y * cosine[h] - x * sine[h]
            ends_m[s, 0], ends_m[s, 1] = min(ends_m[s, 0], along), max(ends_m[s, 1], along)
            ends_m[s, 2], ends_m[s, 3] = min(ends_m[s, 2], across), max(ends_m[s, 3], across)


@_kernel
def summarise_segments(xy_m, z_m, hidden, starts, axes, ends_m, summary):  # type: ignore[no-untyped-def]
    """Describe where the points of each segment are in its rectangle.

    Parameters
    ----------
    xy_m, starts
        As in :func:`search_rectangles`.
    z_m
        Heights above the ground, (n,) float64.
    hidden
        From :func:`hidden_edges`, in the order of ``xy_m``, (n,) bool.
    axes
        Unit vectors of axis a and axis b of each rectangle, (m, 4) float64.
    ends_m
        Lowest and highest coordinate along a, then along b, (m, 4) float64.
    summary
        Filled: columns as in :data:`SUMMARY`, (m, 15) float64. Highest points (z_high) are those in three thirds of
        axis a, and in two halves of axis b, at least 0; ``hidden`` is the share of hidden points among those on a side.
    """
    on, covered = np.empty(4), np.empty(4)
    for s in range(starts.shape[0] - 1):
        first, last = starts[s], starts[s + 1]
        row = summary[s]
        row[:] = 0.0
        on[:], covered[:] = 0.0, 0.0
        z_low, z_high, z_total = np.inf, -np.inf, 0.0
        length_a, length_b = ends_m[s, 1] - ends_m[s, 0], ends_m[s, 3] - ends_m[s, 2]
        for i in range(first, last):
            a = xy_m[i, 0] * axes[s, 0] + xy_m[i, 1] * axes[s, 1]
            b = xy_m[i, 0] * axes[s, 2] + xy_m[i, 1] * axes[s, 3]
            z = z_m[i]
            z_low, z_high, z_total = min(z_low, z), max(z_high, z), z_total + z
            third = min(2, int(3.0 * (a - ends_m[s, 0]) / length_a)) if length_a > 0.0 else 0
            half = min(1, int(2.0 * (b - ends_m[s, 2]) / length_b)) if length_b > 0.0 else 0
            row[4 + third] = max(row[4 + third], z)
            row[7 + half] = max(row[7 + half], z)
            for side in range(4):
                to_side = abs((a if side < 2 else b) - ends_m[s, side])
                if to_side <= ON_SIDE_M:
                    on[side] += 1.0
                    covered[side] += 1.0 if hidden[i] else 0.0
        count = last - first
        row[0], row[1], row[2], row[3] = count, z_low, z_high, z_total / count
        row[9], row[10] = on[0] / count, on[2] / count
        for side in range(4):
            row[11 + side] = covered[side] / on[side] if on[side] > 0.0 else 0.0
