"""Kernels of the module ``crowding``: gaps between vehicles as seen from a sensor, in plan view.

Rectangles are rows of :func:`egvs.kernels.vehicle_visibility.footprints`: centre x, y, cosine and sine of the yaw, half
length, half width; metres and the grid's frame. A rectangle spans azimuths from its middle minus to its middle plus a
half width, all of them where it contains the sensor. Gaps along the line of sight are taken on three rays, at
:data:`RAY_SHARES` of the azimuths that two rectangles share: near both ends of what one hides of the other, and in the
middle.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from egvs.kernels.vehicle_visibility import rectangle_distance

_kernel = numba.njit(nogil=True, error_model="numpy")
"""Not cached on disk: numba would not notice a change of the kernels of ``egvs`` that these call."""

RAY_SHARES = 0.02, 0.5, 0.98
"""Positions of the rays in the azimuths that two rectangles share; not at their ends, where a ray touches a corner."""

_TINY = 1e-12


@_kernel
def near_pairs(rows, frame, starts, plan, others, vehicle, reach_m, pair_starts, pairs):
    """Count, and list if there is room, the neighbours of each target that are at most ``reach_m`` away in plan view.

    Other parts of the same vehicle are not neighbours.

    Parameters
    ----------
    rows, frame
        Box and frame of each target, (n,) int64.
    starts
        Boxes starts[f] to starts[f + 1] are those of frame f, (frames + 1,) int64.
    plan, others
        Rectangle of each box, (b, 6) float64; which boxes count as neighbours, (b,) bool.
    vehicle
        The vehicle that each box is part of, (b,) int64.
    reach_m
        Largest distance.
    pair_starts
        Filled: neighbours pair_starts[i] to pair_starts[i + 1] are those of target i, (n + 1,) int64.
    pairs
        Filled with boxes in their order, (p,) int64; not used where p is 0.
    """
    count = 0
    for i in range(rows.shape[0]):
        pair_starts[i] = count
        a = plan[rows[i]]
        near_m = reach_m + math.sqrt(a[4] * a[4] + a[5] * a[5])
        for j in range(starts[frame[i]], starts[frame[i] + 1]):
            if vehicle[j] == vehicle[rows[i]] or not others[j]:
                continue
            x, y = plan[j, 0] - a[0], plan[j, 1] - a[1]
            bound_m = near_m + math.sqrt(plan[j, 4] * plan[j, 4] + plan[j, 5] * plan[j, 5])
            if x * x + y * y <= bound_m * bound_m and rectangle_distance(a, plan[j]) <= reach_m:
                if pairs.shape[0] > 0:
                    pairs[count] = j
                count += 1
    pair_starts[rows.shape[0]] = count


@_kernel
def _view(x, y, box, view):
    """Fill middle azimuth, half width (radians), nearest and farthest range (metres) of a rectangle from x, y."""
    dx, dy = box[0] - x, box[1] - y
    c, s, half_u, half_v = box[2], box[3], box[4], box[5]
    u, v = abs(dx * c + dy * s), abs(dy * c - dx * s)
    near_u, near_v = max(u - half_u, 0.0), max(v - half_v, 0.0)
    view[2] = math.sqrt(near_u * near_u + near_v * near_v)
    view[3] = math.sqrt((u + half_u) * (u + half_u) + (v + half_v) * (v + half_v))
    if view[2] == 0.0:
        view[0], view[1] = math.atan2(dy, dx), math.pi
        return
    right_x, right_y, left_x, left_y = 0.0, 0.0, 0.0, 0.0
    for corner in range(4):
        along = half_u if corner < 2 else -half_u
        across = half_v if corner in (0, 3) else -half_v
        cx, cy = dx + along * c - across * s, dy + along * s + across * c
        if corner == 0:
            right_x, right_y, left_x, left_y = cx, cy, cx, cy
        if right_x * cy - right_y * cx < 0.0:
            right_x, right_y = cx, cy
        if left_x * cy - left_y * cx > 0.0:
            left_x, left_y = cx, cy
    width = math.atan2(right_x * left_y - right_y * left_x, right_x * left_x + right_y * left_y)
    view[0], view[1] = math.atan2(right_y, right_x) + 0.5 * width, 0.5 * width


@_kernel
def _crossing(x, y, direction_x, direction_y, box):
    """Where a ray enters and leaves a rectangle, metres; infinity twice where it misses it."""
    dx, dy = x - box[0], y - box[1]
    c, s = box[2], box[3]
    enter, leave = 0.0, np.inf
    for axis in range(2):
        if axis == 0:
            o, d, half = dx * c + dy * s, direction_x * c + direction_y * s, box[4]
        else:
            o, d, half = dy * c - dx * s, direction_y * c - direction_x * s, box[5]
        if abs(d) < _TINY:
            if abs(o) > half:
                return np.inf, np.inf
            continue
        first, second = (-half - o) / d, (half - o) / d
        enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
    if enter > leave:
        return np.inf, np.inf
    return enter, leave


@_kernel
def sight_gaps(x, y, rows, pair_starts, pairs, plan, views, front_m, behind_m, beside_rad):
    """Fill the gaps from each target to its neighbours as seen from the sensor.

    Parameters
    ----------
    x, y
        Position of the sensor, in the frame of ``plan``, metres.
    rows, pair_starts, pairs, plan
        As :func:`near_pairs` takes and fills them.
    views
        Scratch, (b, 4) float64.
    front_m, behind_m
        Smallest gap along the line of sight to a neighbour in front, and behind, that shares azimuths with the target,
        metres; 0 where both overlap, the nearer one being in front. (n,) float64; the initial values are
        the largest ones.
    beside_rad
        Smallest angle between the target and a neighbour that shares no azimuth with it, but ranges, radians.
        (n,) float64.
    """
    views[:, 1] = -1.0
    for i in range(rows.shape[0]):
        if pair_starts[i] == pair_starts[i + 1]:
            continue
        a, own = plan[rows[i]], views[rows[i]]
        if own[1] < 0.0:
            _view(x, y, a, own)
        for k in range(pair_starts[i], pair_starts[i + 1]):
            b, other = plan[pairs[k]], views[pairs[k]]
            if other[1] < 0.0:
                _view(x, y, b, other)
            turn = other[0] - own[0]
            if turn > math.pi:
                turn -= 2.0 * math.pi
            elif turn < -math.pi:
                turn += 2.0 * math.pi
            apart = abs(turn) - own[1] - other[1]
            if apart >= 0.0:
                if other[2] < own[3] and own[2] < other[3]:
                    beside_rad[i] = min(beside_rad[i], apart)
                continue
            low, high = max(-own[1], turn - other[1]), min(own[1], turn + other[1])
            for share in RAY_SHARES:
                azimuth = own[0] + low + share * (high - low)
                direction_x, direction_y = math.cos(azimuth), math.sin(azimuth)
                enter, leave = _crossing(x, y, direction_x, direction_y, a)
                other_enter, other_leave = _crossing(x, y, direction_x, direction_y, b)
                if enter == np.inf or other_enter == np.inf:
                    continue
                if other_leave <= enter:
                    front_m[i] = min(front_m[i], enter - other_leave)
                elif leave <= other_enter:
                    behind_m[i] = min(behind_m[i], other_enter - leave)
                elif other[2] < own[2]:
                    front_m[i] = 0.0
                else:
                    behind_m[i] = 0.0


@_kernel
def point_gaps(pair_starts, pairs, target_of_box, spanned, has_points, gap_m):
    """Lower ``gap_m`` to the distance between the rectangles around the points of each target and its neighbours.

    Parameters
    ----------
    pair_starts, pairs
        As :func:`near_pairs` fills them.
    target_of_box
        The target of each box, -1 for none, (b,) int64.
    spanned
        Rectangle that the points of each target span in plan view, (n, 6) float64.
    has_points
        (n,) bool; without points on both there is no gap.
    gap_m
        (n,) float64; the initial values are the largest ones.
    """
    for i in range(gap_m.shape[0]):
        if not has_points[i]:
            continue
        for k in range(pair_starts[i], pair_starts[i + 1]):
            j = target_of_box[pairs[k]]
            if j >= 0 and has_points[j]:
                x, y = spanned[j, 0] - spanned[i, 0], spanned[j, 1] - spanned[i, 1]
                bound_m = (
                    gap_m[i]
                    + math.sqrt(spanned[i, 4] ** 2 + spanned[i, 5] ** 2)
                    + math.sqrt(spanned[j, 4] ** 2 + spanned[j, 5] ** 2)
                )
                if x * x + y * y < bound_m * bound_m:
                    gap_m[i] = min(gap_m[i], rectangle_distance(spanned[i], spanned[j]))
