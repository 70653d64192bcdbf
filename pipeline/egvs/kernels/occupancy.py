r"""Which voxels vehicle boxes and solids fill: counts of frames, triangle-cube tests and winding numbers.

Frame: the grid's own, in metres (the world's axes, zero at the grid's origin).

**Vehicle boxes.** A box occupies a voxel when the box, made ``SHRINK_M`` (0.1 mm) smaller on each of its six sides, and
the voxel share positive volume. So a car whose side lies on a voxel face, as lane centres produce them, does not touch
the voxel behind it, and the last bit of a sine decides nothing.

- A flat box (pitch 0) is a rectangle times an interval of layers. The rectangle is convex, so in a column of cells
  :math:`x \in [i, i+1)` it covers one interval of :math:`y`, computed by clipping its four sides to the column.
- A pitched box is tested voxel by voxel with separating axes (Gottschalk, Lin, Manocha 1996, "OBBTree"): three axes of
  the grid, three of the box, nine cross products. A column of voxels meets a convex box in one interval of layers.

The depth of an overlap is the largest length by which the box's six faces can be moved inwards with volume still
shared. Both tests decide as for a box whose corners are moved only by rounding: correct wherever the depth differs from
``SHRINK_M`` by more than 2^-48 of the largest coordinate or size, which is 4e-13 m for 100 m and under 1e-9 m up to 100
km.

Two boxes in a voxel in a frame count once. Counting works on intervals of layers: for each column, the last frame in
which it was occupied and the occupied layers are stored; the counts are differences along z, summed up by
:func:`sum_layers` at the end.

**Solids.** A triangle mesh is only a surface, so there are two tests:

- :func:`mark_triangle_voxels`: a triangle reaches deeper than ``SHRINK_M`` into a voxel. Separating axes of a triangle
  and a cube (Akenine-Moeller 2001, "Fast 3D Triangle-Box Overlap Testing"), the cube made 0.1 mm smaller on each side,
  so that a plane that coincides with voxel faces (the ground at z = 0) fills none.
- :func:`add_winding_numbers`: a voxel without surface in it is entirely inside or outside; its centre decides, by the
  winding number along +z. Corners and centres are first moved to the nearest multiple of ``SNAP_M``, which is far less
  than half a voxel, so that the sides of edges are decided in whole numbers, without rounding. A centre exactly above
  an edge would count twice or not at all; so each edge is oriented from its lexicographically smaller end, and a point
  on it counts as left of it, as if every point were moved by (-e^2, e). So the triangles of a closed solid are
  consistent.
"""

from __future__ import annotations

import math

import numpy as np

from egvs.kernels.jit import njit

SHRINK_M = 1e-4 + 1e-9
"""An overlap up to this depth is no contact: 0.1 mm, and 1 nanometre for what lies on that bound.

Positions and sizes are decimals, so a side may lie 0.1 mm behind a plane to the last digit; it is no contact then,
whatever binary numbers make of those decimals."""

TINY = 1e-100
"""A shorter cross product is 0 up to underflow; any longer one, however inaccurate, is a valid axis."""

_kernel = njit()


@_kernel
def _widen_interval(xa, ya, xb, yb, low, high, y_min, y_max):  # type: ignore[no-untyped-def]
    """Widen [y_min, y_max] by the part of the side a-b between x = low and x = high."""
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
def _overlapped_cells(low, high, voxel_m, count):  # type: ignore[no-untyped-def]
    """First and one-past-last cell that share a positive length with the open interval (low, high)."""
    first = max(np.floor(low / voxel_m), 0.0)
    last = min(np.ceil(high / voxel_m), float(count))
    return (np.int64(first), np.int64(last)) if first < last else (np.int64(0), np.int64(0))


@_kernel
def _axis_separates(nx, ny, nz, c, axes, half, low, voxel_m):  # type: ignore[no-untyped-def]
    """Whether the axis n separates the box from the voxel whose low corner is ``low``; n may be inaccurate."""
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
        if _axis_separates(axes[i, 0], axes[i, 1], axes[i, 2], c, axes, half, low, voxel_m):
            return False
        if _axis_separates(1.0 * (i == 0), 1.0 * (i == 1), 1.0 * (i == 2), c, axes, half, low, voxel_m):
            return False
        x, y, z = axes[i, 0], axes[i, 1], axes[i, 2]
        if _axis_separates(0.0, z, -y, c, axes, half, low, voxel_m):
            return False
        if _axis_separates(-z, 0.0, x, c, axes, half, low, voxel_m):
            return False
        if _axis_separates(y, -x, 0.0, c, axes, half, low, voxel_m):
            return False
    return True


@_kernel
def box_axes(yaw_rad, pitch_rad, axes):  # type: ignore[no-untyped-def]
    """Fill the box's unit axes, one a row: forward (nose up for positive pitch), left, up."""
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    axes[0, 0], axes[0, 1], axes[0, 2] = cy * cp, sy * cp, sp
    axes[1, 0], axes[1, 1], axes[1, 2] = -sy, cy, 0.0
    axes[2, 0], axes[2, 1], axes[2, 2] = -cy * sp, -sy * sp, cp


@_kernel
def _is_fresh(row, j_low, j_high, frame):  # type: ignore[no-untyped-def]
    """Whether no cell of the row was occupied in this frame before."""
    for iy in range(j_low, j_high):  # noqa: SIM110 - Numba has no generators
        if row[iy] == frame:
            return False
    return True


@_kernel
def _occupy_row(ix, j_low, j_high, k_low, k_high, frame, steps, latest):  # type: ignore[no-untyped-def]
    """Count layers k_low .. k_high - 1 of a row of fresh columns; one loop for each array, so that it vectorises."""
    for array, value in ((latest[0], frame), (latest[1], k_low), (latest[2], k_high)):
        row = array[ix]
        for iy in range(j_low, j_high):
            row[iy] = value
    up, down = steps[k_low, ix], steps[k_high, ix]
    for iy in range(j_low, j_high):
        up[iy] += 1
    for iy in range(j_low, j_high):
        down[iy] -= 1


@_kernel
def _occupy_again(ix, iy, k_low, k_high, steps, latest, spare, n_spare):  # type: ignore[no-untyped-def]
    """Count the layers of a column that no other box of this frame occupies; returns the number of spare intervals."""
    low, high = latest[1, ix, iy], latest[2, ix, iy]
    if k_low >= low and k_high <= high:
        return n_spare
    for k in range(k_low, k_high):
        is_new = k < low or k >= high
        for s in range(n_spare):
            if spare[s, 0] == ix and spare[s, 1] == iy and spare[s, 2] <= k < spare[s, 3]:
                is_new = False
        if is_new:
            steps[k, ix, iy] += 1
            steps[k + 1, ix, iy] -= 1
    if k_low <= high and k_high >= low:
        latest[1, ix, iy], latest[2, ix, iy] = min(low, k_low), max(high, k_high)
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
def _grow(spare, needed):  # type: ignore[no-untyped-def]
    if needed <= spare.shape[0]:
        return spare
    larger = np.empty((2 * needed, 4), np.int64)
    for n in range(spare.shape[0]):  # slices would take longer to compile than all the rest
        for k in range(4):
            larger[n, k] = spare[n, k]
    return larger


@_kernel
def count_boxes(frames, boxes, shape, voxel_m, steps, latest):  # type: ignore[no-untyped-def]
    """Count the frames in which each voxel is occupied by a box.

    Parameters
    ----------
    frames
        Frame of each box, (n,) int64, ascending and not negative; all boxes of a frame in one call.
    boxes
        Centre x, y, z, yaw, pitch, length, width, height of each, (n, 8) float64, grid frame, metres and radians.
    shape, voxel_m
        Voxels along x, y, z, (3,) int64, and their edge length.
    steps
        Added to: differences of the counts along z, (nz + 1, nx, ny) int32, contiguous along y.
    latest
        State that belongs to ``steps``: last frame of each column and its layers, (3, nx, ny) int64, -1 at first.
    """
    nx, ny, nz = shape[0], shape[1], shape[2]
    px, py = np.empty(4), np.empty(4)
    axes, half, low = np.empty((3, 3)), np.empty(3), np.empty(3)
    spare, n_spare, last_frame = np.empty((64, 4), np.int64), np.int64(0), np.int64(-1)
    for b in range(frames.shape[0]):
        frame = frames[b]
        if frame != last_frame:
            n_spare, last_frame = np.int64(0), frame
        c, pitch = boxes[b, :3], boxes[b, 4]
        for a in range(3):
            half[a] = 0.5 * boxes[b, 5 + a] - SHRINK_M
        box_axes(boxes[b, 3], pitch, axes)
        reach_x = half[0] * abs(axes[0, 0]) + half[1] * abs(axes[1, 0]) + half[2] * abs(axes[2, 0])
        reach_y = half[0] * abs(axes[0, 1]) + half[1] * abs(axes[1, 1]) + half[2] * abs(axes[2, 1])
        reach_z = half[0] * abs(axes[0, 2]) + half[1] * abs(axes[1, 2]) + half[2] * abs(axes[2, 2])
        i_low, i_high = _overlapped_cells(c[0] - reach_x, c[0] + reach_x, voxel_m, nx)
        k_low, k_high = _overlapped_cells(c[2] - reach_z, c[2] + reach_z, voxel_m, nz)
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
                    end = (corner + 1) % 4
                    y_min, y_max = _widen_interval(
                        px[corner], py[corner], px[end], py[end], ix * voxel_m, (ix + 1) * voxel_m, y_min, y_max
                    )
            else:
                y_min, y_max = c[1] - reach_y, c[1] + reach_y
            j_low, j_high = _overlapped_cells(y_min, y_max, voxel_m, ny)
            if pitch == 0.0 and _is_fresh(latest[0, ix], j_low, j_high, frame):
                _occupy_row(ix, j_low, j_high, k_low, k_high, frame, steps, latest)
                continue
            spare = _grow(spare, n_spare + j_high - j_low)
            for iy in range(j_low, j_high):
                first, last = k_low, k_high
                if pitch != 0.0:
                    first, last = _layers(c, axes, half, ix, iy, k_low, k_high, voxel_m, low)
                if first >= last:
                    continue
                if latest[0, ix, iy] == frame:
                    n_spare = _occupy_again(ix, iy, first, last, steps, latest, spare, n_spare)
                else:
                    _occupy_row(ix, iy, iy + 1, first, last, frame, steps, latest)


@_kernel
def sum_layers(steps):  # type: ignore[no-untyped-def]
    """Turn differences along z into counts, in place: afterwards ``steps[:-1]`` are the counts, (nz, nx, ny)."""
    for k in range(1, steps.shape[0]):
        for ix in range(steps.shape[1]):
            for iy in range(steps.shape[2]):
                steps[k, ix, iy] += steps[k - 1, ix, iy]


@_kernel
def accumulate(cells, weights, hits):  # type: ignore[no-untyped-def]
    """Add whole-number weights (k,) to ``hits`` at ``cells``, flat, of the same dtype: uint32 or int64."""
    for i in range(cells.shape[0]):
        hits[cells[i]] += weights[i]


SNAP_M = 2.0**-14
"""Lattice (61 micrometres) on which winding numbers are computed; solids up to 100 km across fit into int64."""


@_kernel
def _axis_separates_triangle(nx, ny, nz, tri, centre, half):  # type: ignore[no-untyped-def]
    """Whether the axis n separates the triangle from the cube of half size ``half``."""
    size = abs(nx) + abs(ny) + abs(nz)
    if size < TINY:
        return False  # no axis: parallel edges, or a triangle without area
    low, high = np.inf, -np.inf
    for v in range(3):
        p = (tri[v, 0] - centre[0]) * nx + (tri[v, 1] - centre[1]) * ny + (tri[v, 2] - centre[2]) * nz
        low, high = min(low, p), max(high, p)
    return low >= half * size or high <= -half * size


@_kernel
def triangle_intersects_cube(tri, centre, half):  # type: ignore[no-untyped-def]
    """Whether a triangle (3, 3) meets the open cube around ``centre`` (3,)."""
    for a in range(3):
        if _axis_separates_triangle(1.0 * (a == 0), 1.0 * (a == 1), 1.0 * (a == 2), tri, centre, half):
            return False
    ux, uy, uz = tri[1, 0] - tri[0, 0], tri[1, 1] - tri[0, 1], tri[1, 2] - tri[0, 2]
    vx, vy, vz = tri[2, 0] - tri[0, 0], tri[2, 1] - tri[0, 1], tri[2, 2] - tri[0, 2]
    if _axis_separates_triangle(uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx, tri, centre, half):
        return False
    for e in range(3):
        x, y, z = tri[(e + 1) % 3, 0] - tri[e, 0], tri[(e + 1) % 3, 1] - tri[e, 1], tri[(e + 1) % 3, 2] - tri[e, 2]
        if _axis_separates_triangle(0.0, z, -y, tri, centre, half):
            return False
        if _axis_separates_triangle(-z, 0.0, x, tri, centre, half):
            return False
        if _axis_separates_triangle(y, -x, 0.0, tri, centre, half):
            return False
    return True


@_kernel
def mark_triangle_voxels(triangles, shape, voxel_m, filled):  # type: ignore[no-untyped-def]
    """Mark the voxels that a triangle reaches into.

    Parameters
    ----------
    triangles
        (n, 3, 3) float64, grid frame, metres.
    shape, voxel_m
        Voxels along x, y, z, (3,) int64, and their edge length.
    filled
        Set to True where touched, (nx, ny, nz) bool.
    """
    centre, first, last = np.empty(3), np.empty(3, np.int64), np.empty(3, np.int64)
    half = 0.5 * voxel_m - SHRINK_M
    for n in range(triangles.shape[0]):
        tri = triangles[n]
        for a in range(3):
            low, high = min(tri[0, a], tri[1, a], tri[2, a]), max(tri[0, a], tri[1, a], tri[2, a])
            first[a] = np.int64(min(max(np.floor((low + SHRINK_M) / voxel_m), 0.0), float(shape[a])))
            last[a] = np.int64(max(min(np.ceil((high - SHRINK_M) / voxel_m), float(shape[a])), 0.0))
        for ix in range(first[0], last[0]):
            centre[0] = (ix + 0.5) * voxel_m
            for iy in range(first[1], last[1]):
                centre[1] = (iy + 0.5) * voxel_m
                for iz in range(first[2], last[2]):
                    centre[2] = (iz + 0.5) * voxel_m
                    if not filled[ix, iy, iz] and triangle_intersects_cube(tri, centre, half):
                        filled[ix, iy, iz] = True


@_kernel
def _signed_area(ax, ay, bx, by, px, py):  # type: ignore[no-untyped-def]
    """Twice the signed area of a, b, p, in whole numbers: above 0 where p is to the left of a-b."""
    return (bx - ax) * (py - ay) - (by - ay) * (px - ax)


@_kernel
def _is_left(side, ax, ay, bx, by):  # type: ignore[no-untyped-def]
    """Whether p is to the left of a-b; on the line: to the left of the edge that starts at its smaller end."""
    return side > 0 or (side == 0 and (ax < bx or (ax == bx and ay < by)))


@_kernel
def vertical_crossing(tri, px, py):  # type: ignore[no-untyped-def]
    """Intersect the vertical line at (px, py) with a triangle (3, 3).

    Returns
    -------
    sign, z
        +1 when the triangle's normal points up (the line leaves a solid there), -1 when down, 0 without intersection;
        height of the intersection.
    """
    x, y = np.int64(np.rint(px / SNAP_M)), np.int64(np.rint(py / SNAP_M))
    ax, ay = np.int64(np.rint(tri[0, 0] / SNAP_M)), np.int64(np.rint(tri[0, 1] / SNAP_M))
    bx, by = np.int64(np.rint(tri[1, 0] / SNAP_M)), np.int64(np.rint(tri[1, 1] / SNAP_M))
    cx, cy = np.int64(np.rint(tri[2, 0] / SNAP_M)), np.int64(np.rint(tri[2, 1] / SNAP_M))
    c, a, b = _signed_area(ax, ay, bx, by, x, y), _signed_area(bx, by, cx, cy, x, y), _signed_area(cx, cy, ax, ay, x, y)
    left = _is_left(c, ax, ay, bx, by)
    if left != _is_left(a, bx, by, cx, cy) or left != _is_left(b, cx, cy, ax, ay) or a + b + c == 0:
        return 0, 0.0
    # The areas weigh the corners; none has the other sign, so z stays between them however steep the triangle is.
    return (1 if left else -1), (a * tri[0, 2] + b * tri[1, 2] + c * tri[2, 2]) / (a + b + c)


@_kernel
def add_winding_numbers(triangles, signs, shape, voxel_m, winding):  # type: ignore[no-untyped-def]
    """Add up the winding numbers of voxel centres.

    Parameters
    ----------
    triangles
        Of closed solids, (n, 3, 3) float64, grid frame, metres.
    signs
        +1 or -1 for each triangle: -1 where the solid's triangles face inwards, (n,) int64.
    shape, voxel_m
        As in :func:`mark_triangle_voxels`.
    winding
        Differences along z, added to, (nx, ny, nz + 1) int32; their running sum is the winding number.
    """
    nx, ny, nz = shape[0], shape[1], shape[2]
    for n in range(triangles.shape[0]):
        tri = triangles[n]
        low_x, high_x = min(tri[0, 0], tri[1, 0], tri[2, 0]), max(tri[0, 0], tri[1, 0], tri[2, 0])
        low_y, high_y = min(tri[0, 1], tri[1, 1], tri[2, 1]), max(tri[0, 1], tri[1, 1], tri[2, 1])
        first_x, end_x = max(0.0, np.floor(low_x / voxel_m) - 1), min(float(nx), np.ceil(high_x / voxel_m) + 1)
        first_y, end_y = max(0.0, np.floor(low_y / voxel_m) - 1), min(float(ny), np.ceil(high_y / voxel_m) + 1)
        for ix in range(np.int64(first_x), np.int64(end_x)):
            for iy in range(np.int64(first_y), np.int64(end_y)):
                sign, z = vertical_crossing(tri, (ix + 0.5) * voxel_m, (iy + 0.5) * voxel_m)
                if sign != 0:
                    k = np.int64(min(max(np.ceil(z / voxel_m - 0.5), 0.0), float(nz)))
                    winding[ix, iy, 0] += sign * signs[n]
                    winding[ix, iy, k] -= sign * signs[n]


@_kernel
def point_winding_numbers(point, triangles, solids, signs, totals):  # type: ignore[no-untyped-def]
    """Add up one point's winding number in each solid: ``totals`` (solids,) int64, added to."""
    for n in range(triangles.shape[0]):
        sign, z = vertical_crossing(triangles[n], point[0], point[1])
        if sign != 0 and z > point[2]:
            totals[solids[n]] += sign * signs[n]
