r"""Finds which beams of a sensor meet a body first: a closed mesh that is stretched to a box.

Frame: the sensor's position, the world's axes, metres, float64. A body is kept once, in a box of size 1 round zero; a
beam is brought into that box by the affine map that takes the vehicle's box there. An affine map keeps what t is in
:math:`o + t\,d`, so t stays the range in metres.

1. Beams lie in cells of azimuth and elevation, one degree wide. The cells that a box may cover follow from its
   footprint and its heights; a beam of another cell cannot meet it.
2. A beam that misses the box is left out, then the parts whose own boxes it misses.
3. The triangles of the other parts are met by Moeller and Trumbore (1997, "Fast, Minimum Storage Ray/Triangle
   Intersection").

A point up to ``SLACK`` (1e-9 of the triangle's sides) outside a triangle is on it, so that no beam slips between two of
them; a triangle seen at a sine below ``GRAZE`` in the unit box is not met, the one beside it is.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from pipeline.kernels.boxes import axes_of

SLACK = 1e-9
GRAZE = 1e-9
CELL_DEG = 1.0
COLUMNS, ROWS = 360, 180

_PAD = 1e-9
"""Boxes and cells are taken wider by this (of their size; radians)."""

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")
_inlined = numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")


@_inlined
def _cell(angle, first):  # type: ignore[no-untyped-def]
    """Which cell an angle lies in, counted from ``first`` degrees; perhaps one before the first or behind the last."""
    return np.int64(np.floor((math.degrees(angle) - first) / CELL_DEG))


@_kernel
def cells(d, found):  # type: ignore[no-untyped-def]
    """Fill the cell (row * COLUMNS + column) of each direction d (n, 3), ``found`` (n,) int64."""
    for n in range(d.shape[0]):
        row = _cell(math.atan2(d[n, 2], math.hypot(d[n, 0], d[n, 1])), -90.0)
        column = _cell(math.atan2(d[n, 1], d[n, 0]), -180.0)
        found[n] = min(max(row, 0), ROWS - 1) * COLUMNS + min(max(column, 0), COLUMNS - 1)


@_kernel
def _covered(c, axes, half):  # type: ignore[no-untyped-def]
    """First and last row, first column and number of columns that a box may cover."""
    flat = math.hypot(axes[0, 0], axes[0, 1])
    fx, fy = axes[1, 1], -axes[1, 0]  # forward on the ground
    along = half[0] * flat + half[2] * math.hypot(axes[2, 0], axes[2, 1])
    across, up = half[1], half[0] * abs(axes[0, 2]) + half[2] * abs(axes[2, 2])
    ahead, aside = abs(c[0] * fx + c[1] * fy), abs(c[1] * fx - c[0] * fy)
    near = math.hypot(max(ahead - along, 0.0), max(aside - across, 0.0))
    far = math.hypot(ahead + along, aside + across)
    low, high = c[2] - up, c[2] + up
    bottom = math.atan2(low, far if low > 0.0 else near) - _PAD
    top = math.atan2(high, near if high > 0.0 else far) + _PAD
    first, last = max(_cell(bottom, -90.0), 0), min(_cell(top, -90.0), ROWS - 1)
    if near <= _PAD * far:
        return first, last, 0, COLUMNS
    left, right, middle = 0.0, 0.0, math.atan2(c[1], c[0])
    for corner in range(4):
        a = along if corner < 2 else -along
        b = across if corner in (0, 3) else -across
        x, y = c[0] + a * fx - b * fy, c[1] + a * fy + b * fx
        turn = math.atan2(c[0] * y - c[1] * x, c[0] * x + c[1] * y)
        left, right = max(left, turn), min(right, turn)
    start, end = _cell(middle + right - _PAD, -180.0), _cell(middle + left + _PAD, -180.0)
    return first, last, start % COLUMNS, min(end - start + 1, COLUMNS)


@_inlined
def _crossed(box, ox, oy, oz, dx, dy, dz, most):  # type: ignore[no-untyped-def]
    """Whether a ray crosses a box (low and high corner, (6,)) before ``most``."""
    first, last = 0.0, most
    for a in range(3):
        o, d = (ox, dx) if a == 0 else (oy, dy) if a == 1 else (oz, dz)
        if d == 0.0:
            if o < box[a] or o > box[3 + a]:
                return False
        else:
            t0, t1 = (box[a] - o) / d, (box[3 + a] - o) / d
            first, last = max(first, min(t0, t1)), min(last, max(t0, t1))
    return first <= last


@_inlined
def _met(triangle, ox, oy, oz, dx, dy, dz, least):  # type: ignore[no-untyped-def]
    """Range at which a ray meets a triangle (corner, two sides from it; (3, 3)), infinity when it does not."""
    ax, ay, az = triangle[1, 0], triangle[1, 1], triangle[1, 2]
    bx, by, bz = triangle[2, 0], triangle[2, 1], triangle[2, 2]
    px, py, pz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
    det = ax * px + ay * py + az * pz
    if abs(det) < least:
        return np.inf
    sx, sy, sz = ox - triangle[0, 0], oy - triangle[0, 1], oz - triangle[0, 2]
    u = (sx * px + sy * py + sz * pz) / det
    if u < -SLACK or u > 1.0 + SLACK:
        return np.inf
    qx, qy, qz = sy * az - sz * ay, sz * ax - sx * az, sx * ay - sy * ax
    v = (dx * qx + dy * qy + dz * qz) / det
    if v < -SLACK or u + v > 1.0 + SLACK:
        return np.inf
    t = (bx * qx + by * qy + bz * qz) / det
    return t if t > 0.0 else np.inf


@_inlined
def _cosine(triangle, size, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Between a beam and a triangle's normal, both stretched to metres along the box's axes; 0 to 1."""
    ax, ay, az = triangle[1, 0] * size[0], triangle[1, 1] * size[1], triangle[1, 2] * size[2]
    bx, by, bz = triangle[2, 0] * size[0], triangle[2, 1] * size[1], triangle[2, 2] * size[2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    return abs(nx * dx + ny * dy + nz * dz) / length if length > 0.0 else 0.0


@_kernel
def cast(d, row, starts, boxes, kinds, shapes, ranges, sent, owner):  # type: ignore[no-untyped-def]
    """Hold the beams of one sensor against bodies; the nearest wins, the static world included.

    Parameters
    ----------
    d, row, starts
        Unit directions along the world's axes (n, 3) float64, in the order of their cells; the row of ``ranges`` that
        each is of (n,) int64; where each cell starts (ROWS * COLUMNS + 1,) int64.
    boxes
        Centre seen from the sensor, length, width, height, yaw, pitch, (b, 8) float64. One that holds the sensor is
        left out.
    kinds
        The shape of each box's body, (b,) int64.
    shapes
        Where each shape's parts start (shapes + 1,) int64; boxes of parts (p, 6); where each part's triangles start
        (p + 1,) int64; triangles as a corner and two sides from it (m, 3, 3), length of each cross product (m,) and
        reflectivity (m,), in the unit box, float64.
    ranges, sent, owner
        Of each row: range of the nearest surface so far (float64; nothing is nearer than a negative one), reflectivity
        times the cosine of the angle of incidence (float64), and the box that it lies on (int32); changed where a body
        is nearer.
    """
    part_starts, part_boxes, triangle_starts, triangles, crosses, reflectivity = shapes
    axes, half, c, size = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    whole = np.array([-0.5, -0.5, -0.5, 0.5, 0.5, 0.5]) * (1.0 + 2.0 * _PAD)
    for b in range(boxes.shape[0]):
        axes_of(boxes[b, 6], boxes[b, 7], axes)
        inside = True
        for a in range(3):
            c[a], size[a], half[a] = boxes[b, a], boxes[b, 3 + a], 0.5 * boxes[b, 3 + a]
        o = np.empty(3)
        for a in range(3):
            o[a] = -(c[0] * axes[a, 0] + c[1] * axes[a, 1] + c[2] * axes[a, 2]) / size[a]
            inside = inside and abs(o[a]) <= 0.5
        if inside:
            continue
        ox, oy, oz = o[0], o[1], o[2]
        first_row, last_row, first_column, columns = _covered(c, axes, half)
        for line in range(first_row, last_row + 1):
            for piece in range(2):  # a box that lies across azimuth 180 has two
                low = first_column if piece == 0 else 0
                high = min(first_column + columns, COLUMNS) if piece == 0 else first_column + columns - COLUMNS
                if high <= low:
                    continue
                for n in range(starts[line * COLUMNS + low], starts[line * COLUMNS + high]):
                    best = ranges[row[n]]
                    fx = d[n, 0] * axes[0, 0] + d[n, 1] * axes[0, 1] + d[n, 2] * axes[0, 2]
                    fy = d[n, 0] * axes[1, 0] + d[n, 1] * axes[1, 1] + d[n, 2] * axes[1, 2]
                    fz = d[n, 0] * axes[2, 0] + d[n, 1] * axes[2, 1] + d[n, 2] * axes[2, 2]
                    dx, dy, dz = fx / size[0], fy / size[1], fz / size[2]
                    if not _crossed(whole, ox, oy, oz, dx, dy, dz, best):
                        continue
                    graze, nearest = GRAZE * math.sqrt(dx * dx + dy * dy + dz * dz), -1
                    for part in range(part_starts[kinds[b]], part_starts[kinds[b] + 1]):
                        if not _crossed(part_boxes[part], ox, oy, oz, dx, dy, dz, best):
                            continue
                        for m in range(triangle_starts[part], triangle_starts[part + 1]):
                            t = _met(triangles[m], ox, oy, oz, dx, dy, dz, graze * crosses[m])
                            if t < best:
                                best, nearest = t, m
                    if nearest >= 0:
                        ranges[row[n]], owner[row[n]] = best, b
                        sent[row[n]] = reflectivity[nearest] * _cosine(triangles[nearest], size, fx, fy, fz)


@_kernel
def points(beam, kept, ranges, noise, sent, d, found):  # type: ignore[no-untyped-def]
    """Place the returns of a sweep.

    Parameters
    ----------
    beam, kept
        The beam of each row (n,), and the rows that return (k,) int64.
    ranges, noise, sent
        Range of each row (n,), what is added to it for each return (k,), metres; intensity of each row (n,).
    d
        Nominal direction of each beam in the sensor's frame, (beams, 3) float64.
    found
        Filled: x, y, z, intensity of each return, (k, 4) float32.
    """
    for i in range(kept.shape[0]):
        n = kept[i]
        far = max(ranges[n] + noise[i], 0.0)
        for a in range(3):
            found[i, a] = far * d[beam[n], a]
        found[i, 3] = min(max(sent[n], 0.0), 1.0)
