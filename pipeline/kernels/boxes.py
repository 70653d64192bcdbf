r"""Counts which voxels a vehicle's box occupies, and in how many frames.

Frame: the grid's own, in metres (the world's axes, zero at the grid's origin). A box occupies a voxel when the box,
made ``SHRINK_M`` (0.1 mm) smaller on each of its six sides, and the voxel share positive volume. So a car whose side
lies on a voxel face, as lane centres make them, does not touch what is behind it, and the last bit of a sine decides
nothing.

- A flat box (pitch 0) is a rectangle times an interval of layers. The rectangle is convex, so what it covers of a
  column of cells :math:`x \in [i, i+1)` is one interval of :math:`y`, found by cutting its four sides to the column.
- A pitched box is tested voxel by voxel with separating axes (Gottschalk, Lin, Manocha 1996, "OBBTree"): three axes of
  the grid, three of the box, nine cross products. A column of voxels meets a convex box in one interval of layers.

How deep a box overlaps a voxel is the largest length by which its six faces can be moved inwards with volume still
shared. Both ways decide as for a box whose corners are moved by rounding alone: right wherever the depth differs from
``SHRINK_M`` by more than 2^-48 of the largest coordinate or size, which is 4e-13 m for 100 m and under 1e-9 m up to 100
km.

Two boxes in a voxel in a frame count once. Counting works on intervals of layers: a column notes the last frame in
which it was occupied and the layers that were; the counts are differences along z, summed up by :func:`sum_layers` at
the end.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.kernels.compile_cache import compiled

SHRINK_M = 1e-4 + 1e-9
"""An overlap up to this depth is no contact: 0.1 mm, and 1 nanometre for what lies on that bound.

Positions and sizes are decimals, so a side may lie 0.1 mm behind a plane to the last digit; it is no contact then,
whatever binary numbers make of those decimals."""

TINY = 1e-100
"""A cross product shorter than this is 0 but for products that vanish; any longer one, however rough, is a sound
axis."""

_kernel = compiled()


@_kernel
def _cut(xa, ya, xb, yb, low, high, y_min, y_max):  # type: ignore[no-untyped-def]
    """Widen [y_min, y_max] by what the side a-b covers between x = low and x = high."""
    if xa > xb:
        xa, ya, xb, yb = xb, yb, xa, ya
    if xb < low or xa > high:
        return y_min, y_max
    if xa < low:
        y = ya + (yb - ya) * ((low - xa) / (xb - xa))
        y_min, y_max = min(y_min, y), max(y_max, y)
    else:
        y_min, y_max = min(y_min, ya), max(y_max, ya)
    if xb > high:
        y = ya + (yb - ya) * ((high - xa) / (xb - xa))
        y_min, y_max = min(y_min, y), max(y_max, y)
    else:
        y_min, y_max = min(y_min, yb), max(y_max, yb)
    return y_min, y_max


@_kernel
def _cells(low, high, voxel_m, count):  # type: ignore[no-untyped-def]
    """First and one-past-last cell that share a positive length with the open interval (low, high)."""
    first = max(np.floor(low / voxel_m), 0.0)
    last = min(np.ceil(high / voxel_m), float(count))
    return (np.int64(first), np.int64(last)) if first < last else (np.int64(0), np.int64(0))


@_kernel
def _axis_parts(nx, ny, nz, c, axes, half, low, voxel_m):  # type: ignore[no-untyped-def]
    """True when the axis n parts the box from the voxel whose low corner is ``low``. Soundness needs no exact axis."""
    size = abs(nx) + abs(ny) + abs(nz)
    if size < TINY:
        return False  # parallel edges: no axis
    h = 0.5 * voxel_m
    gap = abs((low[0] + h - c[0]) * nx + (low[1] + h - c[1]) * ny + (low[2] + h - c[2]) * nz)
    reach = h * size
    for a in range(3):
        reach += half[a] * abs(axes[a, 0] * nx + axes[a, 1] * ny + axes[a, 2] * nz)
    return gap >= reach


@_kernel
def overlaps(c, axes, half, low, voxel_m):  # type: ignore[no-untyped-def]
    """Whether a box and a voxel share positive volume.

    Parameters
    ----------
    c, axes, half
        Centre (3,), unit axes (3, 3; one a row) and half sizes (3,) of the box, already shrunk, metres.
    low, voxel_m
        Low corner (3,) and edge length of the voxel, metres.
    """
    for i in range(3):
        if _axis_parts(axes[i, 0], axes[i, 1], axes[i, 2], c, axes, half, low, voxel_m):
            return False
        if _axis_parts(
            1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0, 1.0 if i == 2 else 0.0, c, axes, half, low, voxel_m
        ):
            return False
        x, y, z = axes[i, 0], axes[i, 1], axes[i, 2]
        if _axis_parts(0.0, z, -y, c, axes, half, low, voxel_m):
            return False
        if _axis_parts(-z, 0.0, x, c, axes, half, low, voxel_m):
            return False
        if _axis_parts(y, -x, 0.0, c, axes, half, low, voxel_m):
            return False
    return True


@_kernel
def axes_of(yaw_rad, pitch_rad, axes):  # type: ignore[no-untyped-def]
    """Fill the box's unit axes, one a row: forward (nose up for positive pitch), left, up."""
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    axes[0, 0], axes[0, 1], axes[0, 2] = cy * cp, sy * cp, sp
    axes[1, 0], axes[1, 1], axes[1, 2] = -sy, cy, 0.0
    axes[2, 0], axes[2, 1], axes[2, 2] = -cy * sp, -sy * sp, cp


@_kernel
def _is_fresh(row, j_low, j_high, frame):  # type: ignore[no-untyped-def]
    """True when no cell of the row was occupied in this frame before."""
    for iy in range(j_low, j_high):  # noqa: SIM110 - Numba has no generators
        if row[iy] == frame:
            return False
    return True


@_kernel
def _occupy_row(ix, j_low, j_high, k_low, k_high, frame, steps, seen):  # type: ignore[no-untyped-def]
    """Count layers k_low .. k_high - 1 of a row of fresh columns. Separate loops over one array each: they
    vectorise."""
    for array, value in ((seen[0], frame), (seen[1], k_low), (seen[2], k_high)):
        row = array[ix]
        for iy in range(j_low, j_high):
            row[iy] = value
    up, down = steps[k_low, ix], steps[k_high, ix]
    for iy in range(j_low, j_high):
        up[iy] += 1
    for iy in range(j_low, j_high):
        down[iy] -= 1


@_kernel
def _occupy_again(ix, iy, k_low, k_high, steps, seen, spare, n_spare):  # type: ignore[no-untyped-def]
    """Count the layers of a column that other boxes of this frame left free. Returns the number of spare intervals in
    use."""
    low, high = seen[1, ix, iy], seen[2, ix, iy]
    if k_low >= low and k_high <= high:
        return n_spare
    for k in range(k_low, k_high):
        new = k < low or k >= high
        for s in range(n_spare):
            if spare[s, 0] == ix and spare[s, 1] == iy and spare[s, 2] <= k < spare[s, 3]:
                new = False
        if new:
            steps[k, ix, iy] += 1
            steps[k + 1, ix, iy] -= 1
    if k_low <= high and k_high >= low:
        seen[1, ix, iy], seen[2, ix, iy] = min(low, k_low), max(high, k_high)
        return n_spare
    spare[n_spare, 0], spare[n_spare, 1], spare[n_spare, 2], spare[n_spare, 3] = ix, iy, k_low, k_high
    return n_spare + 1


@_kernel
def _layers(c, axes, half, ix, iy, k_low, k_high, voxel_m, low):  # type: ignore[no-untyped-def]
    """The interval of layers that a pitched box occupies in one column."""
    low[0], low[1] = ix * voxel_m, iy * voxel_m
    first, last = k_high, k_low
    for k in range(k_low, k_high):
        low[2] = k * voxel_m
        if overlaps(c, axes, half, low, voxel_m):
            first, last = min(first, k), k + 1
    return first, last


@_kernel
def _grown(spare, needed):  # type: ignore[no-untyped-def]
    if needed <= spare.shape[0]:
        return spare
    larger = np.empty((2 * needed, 4), np.int64)
    for n in range(spare.shape[0]):  # an assignment of slices would take longer to compile than all the rest
        for k in range(4):
            larger[n, k] = spare[n, k]
    return larger


@_kernel
def count_boxes(frames, boxes, shape, voxel_m, steps, seen):  # type: ignore[no-untyped-def]
    """Count in which voxels boxes stand, frame by frame.

    Parameters
    ----------
    frames
        Frame of each box, (n,) int64, ascending and not negative; all boxes of a frame in one call.
    boxes
        Centre x, y, z, yaw, pitch, length, width, height of each, (n, 8) float64, grid frame, metres and radians.
    shape, voxel_m
        Voxels along x, y, z, (3,) int64, and their edge length.
    steps
        Added to: differences of the counts along z, (nz + 1, nx, ny) int32: neighbours along y lie together.
    seen
        Scratch that lives as long as ``steps``: last frame of each column and its layers, (3, nx, ny) int64, -1 at
        first.
    """
    nx, ny, nz = shape[0], shape[1], shape[2]
    px, py = np.empty(4), np.empty(4)
    axes, half, low = np.empty((3, 3)), np.empty(3), np.empty(3)
    spare, n_spare, last_frame = np.empty((64, 4), np.int64), 0, np.int64(-1)
    for b in range(frames.shape[0]):
        frame = frames[b]
        if frame != last_frame:
            n_spare, last_frame = 0, frame
        c, pitch = boxes[b, :3], boxes[b, 4]
        for a in range(3):
            half[a] = 0.5 * boxes[b, 5 + a] - SHRINK_M
        axes_of(boxes[b, 3], pitch, axes)
        reach_x = half[0] * abs(axes[0, 0]) + half[1] * abs(axes[1, 0]) + half[2] * abs(axes[2, 0])
        reach_y = half[0] * abs(axes[0, 1]) + half[1] * abs(axes[1, 1]) + half[2] * abs(axes[2, 1])
        reach_z = half[0] * abs(axes[0, 2]) + half[1] * abs(axes[1, 2]) + half[2] * abs(axes[2, 2])
        i_low, i_high = _cells(c[0] - reach_x, c[0] + reach_x, voxel_m, nx)
        k_low, k_high = _cells(c[2] - reach_z, c[2] + reach_z, voxel_m, nz)
        if i_low == i_high or k_low == k_high:
            continue
        for corner in range(4):
            along = half[0] if corner in (0, 3) else -half[0]
            across = half[1] if corner < 2 else -half[1]
            px[corner] = c[0] + along * axes[0, 0] + across * axes[1, 0]
            py[corner] = c[1] + along * axes[0, 1] + across * axes[1, 1]
        for ix in range(i_low, i_high):
            if pitch == 0.0:
                y_min, y_max = np.inf, -np.inf
                for corner in range(4):
                    other = (corner + 1) % 4
                    y_min, y_max = _cut(px[corner], py[corner], px[other], py[other],
                                        ix * voxel_m, (ix + 1) * voxel_m, y_min, y_max)  # fmt: skip
            else:
                y_min, y_max = c[1] - reach_y, c[1] + reach_y
            j_low, j_high = _cells(y_min, y_max, voxel_m, ny)
            if pitch == 0.0 and _is_fresh(seen[0, ix], j_low, j_high, frame):
                _occupy_row(ix, j_low, j_high, k_low, k_high, frame, steps, seen)
                continue
            spare = _grown(spare, n_spare + j_high - j_low)
            for iy in range(j_low, j_high):
                first, last = k_low, k_high
                if pitch != 0.0:
                    first, last = _layers(c, axes, half, ix, iy, k_low, k_high, voxel_m, low)
                if first >= last:
                    continue
                if seen[0, ix, iy] == frame:
                    n_spare = _occupy_again(ix, iy, first, last, steps, seen, spare, n_spare)
                else:
                    _occupy_row(ix, iy, iy + 1, first, last, frame, steps, seen)


@_kernel
def sum_layers(steps):  # type: ignore[no-untyped-def]
    """Turn differences along z into counts, in place; ``steps[:-1]`` holds the counts (nz, nx, ny) afterwards."""
    for k in range(1, steps.shape[0]):
        for ix in range(steps.shape[1]):
            for iy in range(steps.shape[2]):
                steps[k, ix, iy] += steps[k - 1, ix, iy]
