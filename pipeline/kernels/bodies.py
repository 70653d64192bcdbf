r"""Finds which beams of a sensor meet a body first: a closed mesh that is stretched to a box.

Frame: the sensor's position, the world's axes, metres, float64. A body is kept once, in a box of size 1 round zero; a
beam is brought into that box by the affine map that takes the vehicle's box there. An affine map keeps what t is in
:math:`o + t\,d`, so t stays the range in metres.

1. Beams lie in cells of azimuth and elevation, one degree wide. The cells that a box may cover follow from its
   footprint and its heights; a beam of another cell cannot meet it.
2. A beam that misses the box is left out, then the parts whose own boxes it misses.
3. The triangles of the other parts that face the sensor are met as Moeller and Trumbore do (1997, "Fast, Minimum
   Storage Ray/Triangle Intersection"); what does not depend on the beam is worked out once a body.

A point up to ``SLACK`` (1e-9 of the triangle's sides) outside a triangle is on it, so that no beam slips between two of
them; a triangle seen at a sine below ``GRAZE`` in the unit box is not met, the one beside it is.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.kernels.boxes import axes_of
from pipeline.kernels.compile_cache import compiled

SLACK = 1e-9
GRAZE = 1e-9
CELL_DEG = 1.0
COLUMNS, ROWS = 360, 180

_PAD = 1e-9
"""Boxes and cells are taken wider by this (of their size; radians)."""

_LARGEST = 1e200  # stands for 1 / 0: times a length it is larger than any range

_kernel = compiled()
_inlined = compiled(forceinline=True)


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
def _inverse(x):  # type: ignore[no-untyped-def]
    return 1.0 / x if abs(x) > 1.0 / _LARGEST else _LARGEST


@_inlined
def _crossed(box, per_x, per_y, per_z, most):  # type: ignore[no-untyped-def]
    """Whether a ray crosses a box before ``most``: its low and high corner (6,) seen from the start, and what 1 is
    divided by along each axis."""
    x0, x1 = box[0] * per_x, box[3] * per_x
    y0, y1 = box[1] * per_y, box[4] * per_y
    z0, z1 = box[2] * per_z, box[5] * per_z
    first = max(max(min(x0, x1), min(y0, y1)), max(min(z0, z1), 0.0))
    return first <= min(min(max(x0, x1), max(y0, y1)), min(max(z0, z1), most))


@_kernel
def _prepare(kind, o, shapes, boxes, firsts, seen, which):  # type: ignore[no-untyped-def]
    """Fill what all beams of one sensor ask of a body, o (3,) being the sensor in the unit box.

    With a triangle's corner a and sides e, f from it, s = o - a and n = e x f, a ray o + t d meets its plane at
    t = (s n) / (-d n), at the share d (f x s) / (-d n) along e and d (s x e) / (-d n) along f. What does not hold d is
    the same for all beams: ``seen`` (m, 11) holds -n, f x s, s x e, s n and the smallest (-d n) that is no grazing, all
    with the sign that makes s n positive. Of a closed part, the sides that face away are left out.

    ``boxes`` are the parts' boxes seen from the sensor; triangles firsts[p] to firsts[p + 1] of ``seen`` are those of
    the kind's part p, and ``which`` says which ones they are.
    """
    part_starts, part_boxes, closed, triangle_starts, triangles, crosses, _ = shapes
    count, low = 0, part_starts[kind]
    for part in range(low, part_starts[kind + 1]):
        for a in range(3):
            boxes[part - low, a], boxes[part - low, 3 + a] = part_boxes[part, a] - o[a], part_boxes[part, 3 + a] - o[a]
        firsts[part - low] = count
        for m in range(triangle_starts[part], triangle_starts[part + 1]):
            a, e, f = triangles[m, 0], triangles[m, 1], triangles[m, 2]
            x, y, z = o[0] - a[0], o[1] - a[1], o[2] - a[2]
            nx, ny, nz = e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0]
            away = x * nx + y * ny + z * nz
            if away == 0.0 or (away < 0.0 and closed[part]):
                continue
            sign = 1.0 if away > 0.0 else -1.0
            row = seen[count]
            row[0], row[1], row[2] = -sign * nx, -sign * ny, -sign * nz
            row[3], row[4], row[5] = f[1] * z - f[2] * y, f[2] * x - f[0] * z, f[0] * y - f[1] * x
            row[6], row[7], row[8] = y * e[2] - z * e[1], z * e[0] - x * e[2], x * e[1] - y * e[0]
            for k in range(3, 9):
                row[k] *= sign
            row[9], row[10], which[count] = abs(away), GRAZE * crosses[m], m
            count += 1
    firsts[part_starts[kind + 1] - low] = count


@_inlined
def _nearest(parts, boxes, firsts, seen, dx, dy, dz, most):  # type: ignore[no-untyped-def]
    """Range at which a ray meets a prepared body before ``most``, and the row of ``seen`` (-1 for none)."""
    per_x, per_y, per_z = _inverse(dx), _inverse(dy), _inverse(dz)
    length, nearest = math.sqrt(dx * dx + dy * dy + dz * dz), -1
    for part in range(parts):
        if not _crossed(boxes[part], per_x, per_y, per_z, most):
            continue
        for i in range(firsts[part], firsts[part + 1]):
            row = seen[i]
            det = dx * row[0] + dy * row[1] + dz * row[2]
            if det <= row[10] * length or row[9] >= most * det:
                continue
            u = dx * row[3] + dy * row[4] + dz * row[5]
            v = dx * row[6] + dy * row[7] + dz * row[8]
            slack = SLACK * det
            if u >= -slack and v >= -slack and u + v <= det + slack:
                most, nearest = row[9] / det, i
    return most, nearest


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
        Where each shape's parts start (shapes + 1,) int64; boxes of parts (p, 6) float64, and whether each is closed
        and faces outwards (p,) bool; where each part's triangles start (p + 1,) int64; triangles as a corner and two
        sides from it (m, 3, 3), length of each cross product (m,) and reflectivity (m,), in the unit box, float64.
    ranges, sent, owner
        Of each row: range of the nearest surface so far (float64; nothing is nearer than a negative one), reflectivity
        times the cosine of the angle of incidence (float64), and the box that it lies on (int32); changed where a body
        is nearer.
    """
    part_starts, _, _, triangle_starts, triangles, _, reflectivity = shapes
    axes, half, c, o = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    room = 0
    for kind in range(part_starts.shape[0] - 1):
        room = max(room, triangle_starts[part_starts[kind + 1]] - triangle_starts[part_starts[kind]])
    parts_m, firsts = np.empty((part_starts[-1], 6)), np.empty(part_starts[-1] + 1, np.int64)
    seen, which, whole = np.empty((room, 11)), np.empty(room, np.int64), np.empty(6)
    for b in range(boxes.shape[0]):
        axes_of(boxes[b, 6], boxes[b, 7], axes)
        size, holds = boxes[b, 3:6], True
        for a in range(3):
            c[a], half[a] = boxes[b, a], 0.5 * size[a]
        for a in range(3):
            o[a] = -(c[0] * axes[a, 0] + c[1] * axes[a, 1] + c[2] * axes[a, 2]) / size[a]
            holds = holds and abs(o[a]) <= 0.5
            whole[a], whole[3 + a] = -0.5 - _PAD - o[a], 0.5 + _PAD - o[a]
        if holds:
            continue
        first_row, last_row, first_column, columns = _covered(c, axes, half)
        parts, prepared = part_starts[kinds[b] + 1] - part_starts[kinds[b]], False
        for line in range(first_row, last_row + 1):
            for piece in range(2):  # a box that lies across azimuth 180 has two
                low = first_column if piece == 0 else 0
                high = min(first_column + columns, COLUMNS) if piece == 0 else first_column + columns - COLUMNS
                if high <= low:
                    continue
                for n in range(starts[line * COLUMNS + low], starts[line * COLUMNS + high]):
                    fx = d[n, 0] * axes[0, 0] + d[n, 1] * axes[0, 1] + d[n, 2] * axes[0, 2]
                    fy = d[n, 0] * axes[1, 0] + d[n, 1] * axes[1, 1] + d[n, 2] * axes[1, 2]
                    fz = d[n, 0] * axes[2, 0] + d[n, 1] * axes[2, 1] + d[n, 2] * axes[2, 2]
                    dx, dy, dz = fx / size[0], fy / size[1], fz / size[2]
                    if not _crossed(whole, _inverse(dx), _inverse(dy), _inverse(dz), ranges[row[n]]):
                        continue
                    if not prepared:
                        _prepare(kinds[b], o, shapes, parts_m, firsts, seen, which)
                        prepared = True
                    best, nearest = _nearest(parts, parts_m, firsts, seen, dx, dy, dz, ranges[row[n]])
                    if nearest >= 0:
                        ranges[row[n]], owner[row[n]], m = best, b, which[nearest]
                        sent[row[n]] = reflectivity[m] * _cosine(triangles[m], size, fx, fy, fz)


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
