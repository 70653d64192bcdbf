"""How deep does a box overlap a voxel, and which voxels do vehicles occupy?

The depth is the largest length by which all six faces of the box can be moved inwards while box and voxel still share a
volume (and the box has one). A box of half sizes :math:`h_i - s` shares a volume with a voxel exactly when no axis n of
the fifteen of the separating-axis theorem parts them (Gottschalk, Lin, Manocha 1996, "OBBTree", Theorem 1), that is,
when for each

.. math:: |g \\cdot n| < r \\, |n|_1 + \\sum_i (h_i - s) \\, |a_i \\cdot n|

with g from centre to centre, r half a voxel, and :math:`a_i` the box's axes. Solved for s, the least right side is the
depth; a voxel is occupied when the depth is above 0.1 mm. The numbers may be fractions (boxes whose sine and cosine are
rational) or mpmath floats of 50 digits; nothing here knows which."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction
from typing import Any

import mpmath
import numpy as np

DIGITS = 50
SHRINK_M = Fraction(1, 10**4)
MARGIN_M = Fraction(1, 10**9)

# (a, b, c) with a^2 + b^2 = c^2: the sine a / c and the cosine b / c are rational.
PYTHAGOREAN = [
    (0, 1, 1),
    (3, 4, 5),
    (5, 12, 13),
    (8, 15, 17),
    (7, 24, 25),
    (20, 21, 29),
    (696, 697, 985),
    (1, 0, 1),
    (9999, 200, 10001),
]


def axes_of(sin_yaw: Any, cos_yaw: Any, sin_pitch: Any, cos_pitch: Any) -> list[list[Any]]:
    """Forward, left, up of a box that was pitched nose up, then turned."""
    return [
        [cos_yaw * cos_pitch, sin_yaw * cos_pitch, sin_pitch],
        [-sin_yaw, cos_yaw, sin_pitch * 0],
        [-cos_yaw * sin_pitch, -sin_yaw * sin_pitch, cos_pitch],
    ]


def dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Any, b: Any) -> list[Any]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def parting(axes: Any, half: Any, voxel: Any) -> list[tuple[Any, Any, Any]]:
    """(n, reach of box and voxel along n, how fast that shrinks with s) for each of the fifteen axes."""
    one, none = voxel / voxel, voxel - voxel
    units = [[one, none, none], [none, one, none], [none, none, one]]
    found = []
    for n in [*units, *axes, *(cross(u, a) for u in units for a in axes)]:
        along = [abs(dot(a, n)) for a in axes]
        size = sum(abs(c) for c in n)
        if size * 10**40 > 1:  # else the edges are parallel: no axis
            found.append((n, voxel / 2 * size + sum(h * s for h, s in zip(half, along, strict=True)), sum(along)))
    return found


def depth_at(gap: Any, half: Any, normals: Any) -> Any:
    """Depth where the voxel's centre is ``gap`` from the box's."""
    return min(*half, *((reach - abs(dot(gap, n))) / shrinks for n, reach, shrinks in normals))


def depth(centre: Any, axes: Any, half: Any, low: Any, voxel: Any) -> Any:
    """Depth of a box in the voxel whose low corner is ``low``; negative where they are apart."""
    return depth_at([low[a] + voxel / 2 - centre[a] for a in range(3)], half, parting(axes, half, voxel))


def exact_box(box: Any) -> tuple[list[Any], list[list[Any]], list[Any]]:
    """Centre, axes and half sizes of (x, y, z, yaw, pitch, length, width, height), floats, to 50 digits."""
    with mpmath.workdps(DIGITS):
        x, y, z, yaw, pitch, *size = (mpmath.mpf(float(v)) for v in box)
        return (
            [x, y, z],
            axes_of(mpmath.sin(yaw), mpmath.cos(yaw), mpmath.sin(pitch), mpmath.cos(pitch)),
            [s / 2 for s in size],
        )


def depths(box: Any, shape: Any, voxel_m: float, least: float = -1e-3) -> dict[tuple[int, int, int], Any]:
    """Depth of one box (grid frame) in each voxel, where it is above ``least``; voxels out of its ball's reach are
    passed over."""
    centre, axes, half = exact_box(box)
    reach = float(sum(half)) + 1e-2
    found = {}
    with mpmath.workdps(DIGITS):
        voxel = mpmath.mpf(voxel_m)
        ranges = [
            [
                i
                for i in range(n)
                if float(centre[a]) - reach < (i + 1) * voxel_m and i * voxel_m < float(centre[a]) + reach
            ]
            for a, n in enumerate(shape)
        ]
        normals = parting(axes, half, voxel)
        for cell in itertools.product(*ranges):
            deep = depth_at([(i + 0.5) * voxel - c for i, c in zip(cell, centre, strict=True)], half, normals)
            if deep > least:
                found[cell] = deep
    return found


def occupied(box: Any, shape: Any, voxel_m: float) -> tuple[set[tuple[int, int, int]], set[tuple[int, int, int]]]:
    """The voxels that a box occupies, and those too close to 0.1 mm to hold a float64 program to."""
    found = depths(box, shape, voxel_m)
    with mpmath.workdps(DIGITS):
        bound, margin = mpmath.mpf(1) / 10**4, mpmath.mpf(1) / 10**9
        inside = {cell for cell, deep in found.items() if deep > bound}
        return inside, {cell for cell, deep in found.items() if abs(deep - bound) <= margin}


def tpog(frames: Any, values: Any, shape: Any, voxel_m: float, total: int) -> tuple[Any, int]:
    """Frames in which each voxel is occupied (nested lists by ix, iy, iz), box by box and frame by frame; and ambiguous
    pairs."""
    counts = [[[0] * shape[2] for _ in range(shape[1])] for _ in range(shape[0])]
    ambiguous = 0
    for frame in range(total):
        here: set[tuple[int, int, int]] = set()
        for f, box in zip(frames, values, strict=True):
            if f == frame:
                inside, unsure = occupied(box, shape, voxel_m)
                here |= inside
                ambiguous += len(unsure)
        for i, j, k in here:
            counts[i][j][k] += 1
    return counts, ambiguous


def occupied_by_upright(
    centre_m: Any, yaw_rad: float, size_m: tuple[float, float, float], shape: Any, voxel_m: float
) -> Any:
    """Voxels of a grid (bool, of its shape) that an upright box occupies, in float64: separating axes in plan."""
    half = np.array(size_m) / 2.0 - float(SHRINK_M)
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    to_x, to_y, z = ((np.arange(n) + 0.5) * voxel_m - c for n, c in zip(shape, centre_m, strict=True))
    dx, dy = np.meshgrid(to_x, to_y, indexing="ij")
    r = voxel_m / 2.0
    span = r * (abs(cos) + abs(sin))
    in_plan = np.abs(dx) < r + half[0] * abs(cos) + half[1] * abs(sin)
    in_plan &= np.abs(dy) < r + half[0] * abs(sin) + half[1] * abs(cos)
    in_plan &= np.abs(dx * cos + dy * sin) < half[0] + span
    in_plan &= np.abs(dy * cos - dx * sin) < half[1] + span
    return in_plan[:, :, None] & (np.abs(z) < r + half[2])
