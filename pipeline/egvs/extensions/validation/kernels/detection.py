r"""KITTI matching of detections to objects, overlaps of boxes, and L-shape fitting.

**L-shape fitting** (:func:`fit_rectangles`) fits rectangles to clusters of points that show at most two sides of a box,
by the closeness criterion. For each heading the points are projected on two axes, and the rectangle is the smallest
around them; the criterion says how near the points are to its sides (Zhang, Xu, Dong, Dolan, "Efficient L-Shape Fitting
for Vehicle Detection Using Laser Scanners", IV 2017, algorithms 2 and 4):

.. math:: \beta(\theta) = \sum_i \frac{1}{\max(\min(D_{1i}, D_{2i}), d_0)}

where :math:`D_k` are the distances to that end of axis k which is nearer to the points, by the sum of their squares.
The heading with the largest :math:`\beta` is chosen, the first of equal ones.

**Overlaps** (:func:`shared_area`). Frame: any, in metres and radians. A rectangle is (x, y, length, width, yaw), its
centre first. Rectangle b is moved into the frame of a, where a is :math:`|x| \le l/2, |y| \le w/2`, and clipped to
these four half-planes one after the other (Sutherland and Hodgman, Communications of the ACM 17, 1974). The rest of a
convex polygon is convex; where sides touch or coincide it is a sliver without area, so that last bits of the input
change only last bits of the area.

**Matching** (:func:`match_frames`) is that of Geiger, Lenz, Urtasun (CVPR 2012); its rules are described in
the detection metrics of the extension validation.
"""

from __future__ import annotations

import math

import numpy as np

from egvs.kernels.jit import njit

_kernel = njit()


@_kernel
def _interval(u):  # type: ignore[no-untyped-def]
    """Smallest and largest of some numbers, and whether they are nearer to the largest."""
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
    """The closeness criterion of points that are projected on two axes, and the ends of both."""
    u_low, u_high, at_u_high = _interval(u)
    v_low, v_high, at_v_high = _interval(v)
    total = 0.0
    for i in range(u.shape[0]):
        from_u = u_high - u[i] if at_u_high else u[i] - u_low
        from_v = v_high - v[i] if at_v_high else v[i] - v_low
        total += 1.0 / max(min(from_u, from_v), nearest_m)
    return total, u_low, u_high, v_low, v_high


@_kernel
def fit_rectangles(xy_m, start, cosine, sine, nearest_m, heading, ends_m, closeness):  # type: ignore[no-untyped-def]
    """Fit a rectangle to each cluster.

    Parameters
    ----------
    xy_m
        Points of all clusters, one cluster after the other, (n, 2) float64.
    start
        Where each cluster begins, and where the last ends, (m + 1,) int64; none is empty.
    cosine, sine
        Of the candidate headings, 0 to 90 degrees, (h,) float64.
    nearest_m
        d0: a nearer point counts as on the side.
    heading
        Filled: index of the best one, (m,) int64.
    ends_m
        Filled: the lowest and highest coordinate along the heading, then across it (counter-clockwise), (m, 4) float64.
    closeness
        Filled: the criterion times d0, divided by the number of points, (m,) float64; 1 where all are on the sides.
    """
    max_points = 0
    for c in range(start.shape[0] - 1):
        max_points = max(max_points, start[c + 1] - start[c])
    along, across = np.empty(max_points), np.empty(max_points)
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


OVERLAP_TOLERANCE = 1e-9
"""An overlap is larger than a bound, or another overlap, when it exceeds it by more than this.

Boxes on round coordinates overlap by exactly one half, and the last bit of a cosine must not decide."""


@_kernel
def _clip_half_plane(px, py, count, nx, ny, reach, qx, qy):  # type: ignore[no-untyped-def]
    """Fill the part of a polygon in the half-plane nx x + ny y <= reach; returns its number of corners."""
    filled = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        outside, next_outside = nx * px[i] + ny * py[i] - reach, nx * px[j] + ny * py[j] - reach
        if outside <= 0.0:
            qx[filled], qy[filled] = px[i], py[i]
            filled += 1
        if (outside < 0.0 and next_outside > 0.0) or (outside > 0.0 and next_outside < 0.0):
            t = outside / (outside - next_outside)
            qx[filled], qy[filled] = px[i] + t * (px[j] - px[i]), py[i] + t * (py[j] - py[i])
            filled += 1
    return filled


@_kernel
def shared_area(ax, ay, al, aw, a_yaw, bx, by, bl, bw, b_yaw, corners):  # type: ignore[no-untyped-def]
    """Area that two rectangles share, m2.

    Parameters
    ----------
    corners
        Scratch, (4, 24) float64: four corners become eight in four clips, with rounding at most 20.
    """
    dx, dy = bx - ax, by - ay
    reach = 0.5 * (math.sqrt(al * al + aw * aw) + math.sqrt(bl * bl + bw * bw))
    if dx * dx + dy * dy > reach * reach:
        return 0.0
    ca, sa = math.cos(a_yaw), math.sin(a_yaw)
    c, s = math.cos(b_yaw - a_yaw), math.sin(b_yaw - a_yaw)
    x, y = ca * dx + sa * dy, ca * dy - sa * dx
    px, py, qx, qy = corners[0], corners[1], corners[2], corners[3]
    for k in range(4):
        along = 0.5 * bl if k in (0, 3) else -0.5 * bl
        across = 0.5 * bw if k < 2 else -0.5 * bw
        px[k], py[k] = x + along * c - across * s, y + along * s + across * c
    count = _clip_half_plane(px, py, 4, 1.0, 0.0, 0.5 * al, qx, qy)
    count = _clip_half_plane(qx, qy, count, -1.0, 0.0, 0.5 * al, px, py)
    count = _clip_half_plane(px, py, count, 0.0, 1.0, 0.5 * aw, qx, qy)
    count = _clip_half_plane(qx, qy, count, 0.0, -1.0, 0.5 * aw, px, py)
    twice = 0.0
    for i in range(1, count - 1):  # triangles at the first corner: differences of nearby coordinates
        twice += (px[i] - px[0]) * (py[i + 1] - py[0]) - (px[i + 1] - px[0]) * (py[i] - py[0])
    return max(0.5 * twice, 0.0)


@_kernel
def overlap_pair(a, b, corners):  # type: ignore[no-untyped-def]
    """Intersection over union of two boxes from above, and in space; 0 where both have no area or volume."""
    area = shared_area(a[0], a[1], a[3], a[4], a[6], b[0], b[1], b[3], b[4], b[6], corners)
    if not area > 0.0:
        return 0.0, 0.0
    top, bottom = min(0.5 * a[5], (b[2] - a[2]) + 0.5 * b[5]), max(-0.5 * a[5], (b[2] - a[2]) - 0.5 * b[5])
    volume = area * max(top - bottom, 0.0)
    a_area, b_area = a[3] * a[4], b[3] * b[4]
    solid = a_area * a[5] + b_area * b[5] - volume
    volume_share = min(volume / solid, 1.0) if solid > 0.0 else 0.0
    return min(area / (a_area + b_area - area), 1.0), volume_share


@_kernel
def overlap_each(a, b, bev, solid):  # type: ignore[no-untyped-def]
    """Fill the overlaps of box k of a with box k of b, both (n, 7) float64: ``bev`` and ``solid``, (n,) float64."""
    corners = np.empty((4, 24))
    for k in range(a.shape[0]):
        bev[k], solid[k] = overlap_pair(a[k], b[k], corners)


@_kernel
def fill_overlaps(objects, object_start, detections, detection_start, pair_start, overlap):  # type: ignore[no-untyped-def]
    """Fill the overlaps of every object with every detection of its frame.

    Parameters
    ----------
    objects, detections
        Boxes of all frames, one frame after the other, (n, 7) and (m, 7) float64.
    object_start, detection_start, pair_start
        Where each frame begins in ``objects``, ``detections`` and ``overlap``, and where the last ends, (frames + 1,)
        int64.
    overlap
        Filled: from above and in space, (2, pairs) float64; within a frame, object by object.
    """
    corners = np.empty((4, 24))
    for f in range(object_start.shape[0] - 1):
        pair = pair_start[f]
        for i in range(object_start[f], object_start[f + 1]):
            for j in range(detection_start[f], detection_start[f + 1]):
                overlap[0, pair], overlap[1, pair] = overlap_pair(objects[i], detections[j], corners)
                pair += 1


@_kernel
def _match_at_threshold(overlap, counted, n, m, stop, min_overlap, taken):  # type: ignore[no-untyped-def]
    """True and false positives in one frame, with only the detections before ``stop`` (KITTI's second pass)."""
    taken[:stop] = False
    true = 0
    for round in range(2):  # objects that count first: they take a box that also fits another
        for i in range(n):
            if counted[i] != (round == 0):
                continue
            best, row = min_overlap, -1
            for j in range(stop):
                if not taken[j] and overlap[i * m + j] > best + OVERLAP_TOLERANCE:
                    best, row = overlap[i * m + j], j
            if row >= 0:
                taken[row] = True
                true += counted[i]
    free = 0
    for j in range(stop):
        free += not taken[j]
    return true, free


@_kernel
def _mark_matched_scores(overlap, counted, n, m, min_overlap, taken, scored):  # type: ignore[no-untyped-def]
    """Mark in one frame the detections that counted objects take by score (KITTI's first pass)."""
    taken[:m] = False
    for round in range(2):
        for i in range(n):
            if counted[i] != (round == 0):
                continue
            for j in range(m):  # descending in score
                if not taken[j] and overlap[i * m + j] > min_overlap + OVERLAP_TOLERANCE:
                    taken[j], scored[j] = True, counted[i]
                    break


@_kernel
def match_frames(  # type: ignore[no-untyped-def]
    object_start, detection_start, pair_start, overlap, counted, min_overlap, scored, true_step, false_step
):
    """Match the detections of every frame, descending in score, to its objects, at every threshold on the score.

    Parameters
    ----------
    object_start, detection_start, pair_start, overlap
        As for :func:`fill_overlaps`; one row of the overlaps, (pairs,).
    counted
        Whether each object counts, (n,) bool; a detection of another object is not counted at all.
    min_overlap
        The overlap that a match must exceed.
    scored
        Filled: whether the first pass assigns a detection to an object that counts, (m,) bool.
    true_step, false_step
        Filled: change of the numbers of true and false positives when a detection is added to those before it in its
        frame, (m,) int64. For equal scores, only the sum is meaningful.
    """
    max_detections = 0
    for f in range(detection_start.shape[0] - 1):
        max_detections = max(max_detections, detection_start[f + 1] - detection_start[f])
    taken = np.empty(max_detections, np.bool_)
    for f in range(detection_start.shape[0] - 1):
        first, m = detection_start[f], detection_start[f + 1] - detection_start[f]
        n = object_start[f + 1] - object_start[f]
        overlaps = overlap[pair_start[f] : pair_start[f + 1]]
        counts = counted[object_start[f] : object_start[f + 1]]
        _mark_matched_scores(overlaps, counts, n, m, min_overlap, taken, scored[first : first + m])
        true, false = 0, 0
        for j in range(m):
            fits = False
            for i in range(n):
                fits = fits or overlaps[i * m + j] > min_overlap + OVERLAP_TOLERANCE
            new_true, new_false = true, false + 1  # a detection that fits nothing changes no match
            if fits:
                new_true, new_false = _match_at_threshold(overlaps, counts, n, m, j + 1, min_overlap, taken)
            true_step[first + j], false_step[first + j] = new_true - true, new_false - false
            true, false = new_true, new_false


@_kernel
def threshold_rows(scored, objects, steps, rows):  # type: ignore[no-untyped-def]
    """Choose thresholds among the scores of the first pass, in descending order; returns their number.

    Parameters
    ----------
    scored
        Number of scores.
    objects
        Number of objects that count.
    steps
        Number of steps of recall, 40 in KITTI.
    rows
        Filled: positions in the descending scores, (steps + 1,) int64.
    """
    filled = 0
    for i in range(scored):
        recall, left = filled / steps, (i + 1) / objects
        right = (i + 2) / objects if i + 1 < scored else left
        if i + 1 < scored and right - recall < recall - left - OVERLAP_TOLERANCE:
            continue  # the next score comes nearer to this step
        rows[filled] = i
        filled += 1
        if filled == rows.shape[0]:
            break
    return filled
