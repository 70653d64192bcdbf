r"""Fits rectangles to clusters of points that show two sides of a box at most: the closeness criterion.

For each heading the points are projected on two axes, the rectangle is the smallest that holds them, and the criterion
says how near the points lie to its sides (Zhang, Xu, Dong, Dolan, "Efficient L-Shape Fitting for Vehicle Detection
Using Laser Scanners", IV 2017, algorithms 2 and 4):

.. math:: \beta(\theta) = \sum_i \frac{1}{\max(\min(D_{1i}, D_{2i}), d_0)}

where :math:`D_k` are the distances to that end of axis k which is nearer to the points, by the sum of their squares.
The heading with the largest :math:`\beta` is taken; of equal ones the first.
"""

from __future__ import annotations

import numpy as np

from pipeline.kernels.compile_cache import compiled

_kernel = compiled()


@_kernel
def _ends(u):  # type: ignore[no-untyped-def]
    """The smallest and the largest of some numbers, and whether they lie nearer to the latter."""
    low, high = u[0], u[0]
    for i in range(1, u.shape[0]):
        low, high = min(low, u[i]), max(high, u[i])
    below, above = 0.0, 0.0
    for i in range(u.shape[0]):
        below += (u[i] - low) * (u[i] - low)
        above += (high - u[i]) * (high - u[i])
    return low, high, above < below


@_kernel
def _closeness(u, v, nearest_m):  # type: ignore[no-untyped-def]
    """The criterion of points that are projected on two axes, and the ends of both."""
    u_low, u_high, at_u_high = _ends(u)
    v_low, v_high, at_v_high = _ends(v)
    total = 0.0
    for i in range(u.shape[0]):
        from_u = u_high - u[i] if at_u_high else u[i] - u_low
        from_v = v_high - v[i] if at_v_high else v[i] - v_low
        total += 1.0 / max(min(from_u, from_v), nearest_m)
    return total, u_low, u_high, v_low, v_high


@_kernel
def fit(xy_m, start, cosine, sine, nearest_m, heading, ends_m, closeness):  # type: ignore[no-untyped-def]
    """Find the rectangle of each cluster.

    Parameters
    ----------
    xy_m
        Points of all clusters, cluster after cluster, (n, 2) float64.
    start
        Where each cluster begins, and where the last ends, (m + 1,) int64; none is empty.
    cosine, sine
        Of the headings that are tried, 0 to 90 degrees, (h,) float64.
    nearest_m
        d0: nearer than this counts as on the side.
    heading
        Filled: index of the best one, (m,) int64.
    ends_m
        Filled: the lowest and highest coordinate along the heading, then across it (counter-clockwise), (m, 4) float64.
    closeness
        Filled: the criterion times d0, divided by the number of points, (m,) float64; 1 where all lie on the sides.
    """
    most = 0
    for c in range(start.shape[0] - 1):
        most = max(most, start[c + 1] - start[c])
    along, across = np.empty(most), np.empty(most)
    for c in range(start.shape[0] - 1):
        first, count = start[c], start[c + 1] - start[c]
        u, v = along[:count], across[:count]
        closeness[c] = -1.0
        for h in range(cosine.shape[0]):
            for i in range(count):
                x, y = xy_m[first + i, 0], xy_m[first + i, 1]
                u[i], v[i] = x * cosine[h] + y * sine[h], y * cosine[h] - x * sine[h]
            total, u_low, u_high, v_low, v_high = _closeness(u, v, nearest_m)
            if total > closeness[c]:
                closeness[c], heading[c] = total, h
                ends_m[c, 0], ends_m[c, 1], ends_m[c, 2], ends_m[c, 3] = u_low, u_high, v_low, v_high
        closeness[c] *= nearest_m / count
