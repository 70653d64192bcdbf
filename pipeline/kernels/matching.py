r"""Overlaps boxes, and matches detections to objects as KITTI's evaluation does.

Frame: any, in metres and radians. A rectangle is (x, y, length, width, yaw), its centre first. The rectangle b is moved
into the frame of a, where a is :math:`|x| \le l/2, |y| \le w/2`, and clipped to one of these four half-planes after the
other (Sutherland and Hodgman, Communications of the ACM 17, 1974). What is left of a convex polygon is convex; where
sides touch or coincide it is a sliver of no area, so that the area depends on the last bits only by the last bits.

The matching is that of Geiger, Lenz, Urtasun (CVPR 2012), written from what it is known to do:
:mod:`pipeline.validation.metrics.matching` says what.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.kernels.compile_cache import compiled

EXCEED = 1e-9
"""An overlap must be larger than a bound, or than another overlap, by more than this to count as larger: boxes on round
coordinates overlap by exactly one half, and the last bit of a cosine must decide nothing."""

_kernel = compiled()


@_kernel
def _clip(px, py, count, nx, ny, reach, qx, qy):  # type: ignore[no-untyped-def]
    """What of a polygon lies in the half-plane nx x + ny y <= reach; returns how many corners are filled in."""
    filled = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        here, there = nx * px[i] + ny * py[i] - reach, nx * px[j] + ny * py[j] - reach
        if here <= 0.0:
            qx[filled], qy[filled] = px[i], py[i]
            filled += 1
        if (here < 0.0 and there > 0.0) or (here > 0.0 and there < 0.0):
            t = here / (here - there)
            qx[filled], qy[filled] = px[i] + t * (px[j] - px[i]), py[i] + t * (py[j] - py[i])
            filled += 1
    return filled


@_kernel
def shared_area(ax, ay, al, aw, a_yaw, bx, by, bl, bw, b_yaw, corners):  # type: ignore[no-untyped-def]
    """Area that two rectangles share, m2.

    Parameters
    ----------
    corners
        Scratch, (4, 24) float64: four corners clipped four times become eight, and with rounding at the worst 20.
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
    count = _clip(px, py, 4, 1.0, 0.0, 0.5 * al, qx, qy)
    count = _clip(qx, qy, count, -1.0, 0.0, 0.5 * al, px, py)
    count = _clip(px, py, count, 0.0, 1.0, 0.5 * aw, qx, qy)
    count = _clip(qx, qy, count, 0.0, -1.0, 0.5 * aw, px, py)
    twice = 0.0
    for i in range(1, count - 1):  # triangles of the first corner: coordinates of the sliver itself, not of the frame
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
    return min(area / (a_area + b_area - area), 1.0), min(volume / solid, 1.0) if solid > 0.0 else 0.0


@_kernel
def overlap_each(a, b, bev, solid):  # type: ignore[no-untyped-def]
    """Fill the overlaps of box k of a with box k of b, both (n, 7) float64: ``bev`` and ``solid``, (n,) float64."""
    corners = np.empty((4, 24))
    for k in range(a.shape[0]):
        bev[k], solid[k] = overlap_pair(a[k], b[k], corners)


@_kernel
def overlap_frames(objects, object_start, found, found_start, pair_start, overlap):  # type: ignore[no-untyped-def]
    """Fill the overlaps of every object with every detection of its frame.

    Parameters
    ----------
    objects, found
        Boxes of all frames, frame after frame, (n, 7) and (m, 7) float64.
    object_start, found_start, pair_start
        Where each frame begins in ``objects``, ``found`` and ``overlap``, and where the last ends, (frames + 1,) int64.
    overlap
        Filled: from above and in space, (2, pairs) float64; of a frame all detections of its first object come first.
    """
    corners = np.empty((4, 24))
    for f in range(object_start.shape[0] - 1):
        pair = pair_start[f]
        for i in range(object_start[f], object_start[f + 1]):
            for j in range(found_start[f], found_start[f + 1]):
                overlap[0, pair], overlap[1, pair] = overlap_pair(objects[i], found[j], corners)
                pair += 1


@_kernel
def _claim(overlap, wanted, n, m, upto, least, taken):  # type: ignore[no-untyped-def]
    """The second pass in one frame, with the detections before ``upto`` alone: true and false positives."""
    taken[:upto] = False
    true = 0
    for round in range(2):  # those that count first: a box that fits one of each is theirs
        for i in range(n):
            if wanted[i] != (round == 0):
                continue
            best, row = least, -1
            for j in range(upto):
                if not taken[j] and overlap[i * m + j] > best + EXCEED:
                    best, row = overlap[i * m + j], j
            if row >= 0:
                taken[row] = True
                true += wanted[i]
    free = 0
    for j in range(upto):
        free += not taken[j]
    return true, free


@_kernel
def _surest(overlap, wanted, n, m, least, taken, scored):  # type: ignore[no-untyped-def]
    """The first pass in one frame: mark which detections are those that a counted object takes by their score."""
    taken[:m] = False
    for round in range(2):
        for i in range(n):
            if wanted[i] != (round == 0):
                continue
            for j in range(m):  # descending in score
                if not taken[j] and overlap[i * m + j] > least + EXCEED:
                    taken[j], scored[j] = True, wanted[i]
                    break


@_kernel
def match_frames(  # type: ignore[no-untyped-def]
    object_start, found_start, pair_start, overlap, wanted, least, scored, true_step, false_step
):
    """Match the detections of every frame, descending in score, to its objects, at every threshold on the score.

    Parameters
    ----------
    object_start, found_start, pair_start, overlap
        As for :func:`overlap_frames`; of the overlaps one row, (pairs,).
    wanted
        Whether each object counts, (n,) bool; one that does not takes a detection out of the count.
    least
        The overlap that a match must exceed.
    scored
        Filled: whether the first pass gives a detection to an object that counts, (m,) bool.
    true_step, false_step
        Filled: how many more true and false positives there are once a detection is let in, after those before it in
        its frame, (m,) int64. Of equal scores the sum counts.
    """
    most = 0
    for f in range(found_start.shape[0] - 1):
        most = max(most, found_start[f + 1] - found_start[f])
    taken = np.empty(most, np.bool_)
    for f in range(found_start.shape[0] - 1):
        first, m = found_start[f], found_start[f + 1] - found_start[f]
        n = object_start[f + 1] - object_start[f]
        its, counts = overlap[pair_start[f] : pair_start[f + 1]], wanted[object_start[f] : object_start[f + 1]]
        _surest(its, counts, n, m, least, taken, scored[first : first + m])
        true, false = 0, 0
        for j in range(m):
            fits = False
            for i in range(n):
                fits = fits or its[i * m + j] > least + EXCEED
            more_true, more_false = true, false + 1  # what fits nothing changes no match
            if fits:
                more_true, more_false = _claim(its, counts, n, m, j + 1, least, taken)
            true_step[first + j], false_step[first + j] = more_true - true, more_false - false
            true, false = more_true, more_false


@_kernel
def threshold_rows(scored, objects, steps, rows):  # type: ignore[no-untyped-def]
    """Fill which of the scores that the first pass gave, in descending order, are thresholds; returns how many are.

    Parameters
    ----------
    scored
        How many scores there are.
    objects
        How many objects count.
    steps
        How many steps of recall there are, 40 in KITTI's.
    rows
        Filled: positions in the descending scores, (steps + 1,) int64.
    """
    filled = 0
    for i in range(scored):
        recall, left = filled / steps, (i + 1) / objects
        right = (i + 2) / objects if i + 1 < scored else left
        if i + 1 < scored and right - recall < recall - left - EXCEED:
            continue  # the next score comes nearer to this step
        rows[filled] = i
        filled += 1
        if filled == rows.shape[0]:
            break
    return filled
