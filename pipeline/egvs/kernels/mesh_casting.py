r"""Which vehicle body each beam of a sensor hits first: a closed mesh that is scaled to a box.

Frame: the sensor's position, the world's axes, metres, float64. A body is stored once, in a box of size 1 around zero;
a beam is transformed into that box by the affine map of the vehicle's box. An affine map preserves t in :math:`o +
t\,d`, so t is the range in metres.

1. Beams are sorted into cells of azimuth and elevation, one degree wide. The footprint and the heights of a box give
   the cells that it may cover; a beam of another cell cannot meet it.
2. A beam that misses the box is skipped, then the parts whose own boxes it misses.
3. The triangles of the other parts that face the sensor are intersected after Moeller and Trumbore (1997, "Fast,
   Minimum Storage Ray/Triangle Intersection"); terms that do not depend on the beam are computed once a body.

A point up to ``SLACK`` (1e-9 of the triangle's sides) outside a triangle is on it, so that no beam slips between two of
them. A triangle at grazing incidence (sine of the angle in the unit box below ``GRAZE``) is skipped; its neighbour
takes the hit.
"""

from __future__ import annotations

import math

import numpy as np

from egvs.kernels.jit import njit
from egvs.kernels.occupancy import box_axes

SLACK = 1e-9
GRAZE = 1e-9
CELL_DEG = 1.0
COLUMNS, ROWS = 360, 180

_PAD = 1e-9
"""Boxes and cells are enlarged by this (relative to their size; radians)."""

_LARGEST = 1e200  # stands for 1 / 0: times a length it is larger than any range

_kernel = njit()
_inlined = njit(forceinline=True)


@_inlined
def _angle_cell(angle, first):  # type: ignore[no-untyped-def]
    """Cell of an angle, counted from ``first`` degrees; may be one before the first or after the last."""
    return np.int64(np.floor((math.degrees(angle) - first) / CELL_DEG))


@_kernel
def direction_cells(d, cells):  # type: ignore[no-untyped-def]
    """Fill the cell (row * COLUMNS + column) of each direction d (n, 3), ``cells`` (n,) int64."""
    for n in range(d.shape[0]):
        row = _angle_cell(math.atan2(d[n, 2], math.hypot(d[n, 0], d[n, 1])), -90.0)
        column = _angle_cell(math.atan2(d[n, 1], d[n, 0]), -180.0)
        cells[n] = min(max(row, 0), ROWS - 1) * COLUMNS + min(max(column, 0), COLUMNS - 1)


@_kernel
def _covered_cells(c, axes, half):  # type: ignore[no-untyped-def]
    """First and last row, first column and number of columns that a box may cover."""
    flat = math.hypot(axes[0, 0], axes[0, 1])
    fx, fy = axes[1, 1], -axes[1, 0]  # forward on the ground
    along = half[0] * flat + half[2] * math.hypot(axes[2, 0], axes[2, 1])
    across, up = half[1], half[0] * abs(axes[0, 2]) + half[2] * abs(axes[2, 2])
    forward, sideways = abs(c[0] * fx + c[1] * fy), abs(c[1] * fx - c[0] * fy)
    near = math.hypot(max(forward - along, 0.0), max(sideways - across, 0.0))
    far = math.hypot(forward + along, sideways + across)
    low, high = c[2] - up, c[2] + up
    bottom = math.atan2(low, far if low > 0.0 else near) - _PAD
    top = math.atan2(high, near if high > 0.0 else far) + _PAD
    first, last = max(_angle_cell(bottom, -90.0), 0), min(_angle_cell(top, -90.0), ROWS - 1)
    if near <= _PAD * far:
        return first, last, 0, COLUMNS
    left, right, middle = 0.0, 0.0, math.atan2(c[1], c[0])
    for corner in range(4):
        a = along if corner < 2 else -along
        b = across if corner in (0, 3) else -across
        x, y = c[0] + a * fx - b * fy, c[1] + a * fy + b * fx
        turn = math.atan2(c[0] * y - c[1] * x, c[0] * x + c[1] * y)
        left, right = max(left, turn), min(right, turn)
    start, end = _angle_cell(middle + right - _PAD, -180.0), _angle_cell(middle + left + _PAD, -180.0)
    return first, last, start % COLUMNS, min(end - start + 1, COLUMNS)


@_inlined
def _inverse(x):  # type: ignore[no-untyped-def]
    return 1.0 / x if abs(x) > 1.0 / _LARGEST else _LARGEST


@_inlined
def _crosses_box(box, per_x, per_y, per_z, max_range):  # type: ignore[no-untyped-def]
    """Whether a ray crosses a box before ``max_range``: low and high corner (6,) from the start, and 1 / direction."""
    x0, x1 = box[0] * per_x, box[3] * per_x
    y0, y1 = box[1] * per_y, box[4] * per_y
    z0, z1 = box[2] * per_z, box[5] * per_z
    first = max(max(min(x0, x1), min(y0, y1)), max(min(z0, z1), 0.0))
    return first <= min(min(max(x0, x1), max(y0, y1)), min(max(z0, z1), max_range))


@_kernel
def _prepare_body(kind, o, shapes, boxes, firsts, prepared, source):  # type: ignore[no-untyped-def]
    """Fill the terms of a body's intersections that all beams of a sensor share; o (3,) is the sensor in the unit box.

    With a triangle's corner a and sides e, f from it, s = o - a and n = e x f, a ray o + t d meets its plane at
    t = (s n) / (-d n), at the share d (f x s) / (-d n) along e and d (s x e) / (-d n) along f. Terms without d are the
    same for all beams: the columns of ``prepared`` (m, 11) are -n, f x s, s x e, s n and the smallest (-d n) that is
    not grazing, all with the sign that makes s n positive. Triangles of a closed part that face away are skipped.

    ``boxes`` are the parts' boxes relative to the sensor; triangles firsts[p] to firsts[p + 1] of ``prepared`` are
    those of the kind's part p, and ``source`` are their numbers in the mesh.
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
            row = prepared[count]
            row[0], row[1], row[2] = -sign * nx, -sign * ny, -sign * nz
            row[3], row[4], row[5] = f[1] * z - f[2] * y, f[2] * x - f[0] * z, f[0] * y - f[1] * x
            row[6], row[7], row[8] = y * e[2] - z * e[1], z * e[0] - x * e[2], x * e[1] - y * e[0]
            for k in range(3, 9):
                row[k] *= sign
            row[9], row[10], source[count] = abs(away), GRAZE * crosses[m], m
            count += 1
    firsts[part_starts[kind + 1] - low] = count


@_inlined
def _nearest(parts, boxes, firsts, prepared, dx, dy, dz, max_range):  # type: ignore[no-untyped-def]
    """Range at which a ray meets a prepared body before ``max_range``, and the row of ``prepared`` (-1 for none)."""
    per_x, per_y, per_z = _inverse(dx), _inverse(dy), _inverse(dz)
    length, nearest = math.sqrt(dx * dx + dy * dy + dz * dz), -1
    for part in range(parts):
        if not _crosses_box(boxes[part], per_x, per_y, per_z, max_range):
            continue
        for i in range(firsts[part], firsts[part + 1]):
            row = prepared[i]
            det = dx * row[0] + dy * row[1] + dz * row[2]
            if det <= row[10] * length or row[9] >= max_range * det:
                continue
            u = dx * row[3] + dy * row[4] + dz * row[5]
            v = dx * row[6] + dy * row[7] + dz * row[8]
            slack = SLACK * det
            if u >= -slack and v >= -slack and u + v <= det + slack:
                max_range, nearest = row[9] / det, i
    return max_range, nearest


@_inlined
def _cosine(triangle, size, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Cosine between a beam and a triangle's normal, both scaled to metres along the box's axes; 0 to 1."""
    ax, ay, az = triangle[1, 0] * size[0], triangle[1, 1] * size[1], triangle[1, 2] * size[2]
    bx, by, bz = triangle[2, 0] * size[0], triangle[2, 1] * size[1], triangle[2, 2] * size[2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    return abs(nx * dx + ny * dy + nz * dz) / length if length > 0.0 else 0.0


@_kernel
def cast_meshes(d, row, starts, boxes, kinds, shapes, ranges, sent, owner, triangle):  # type: ignore[no-untyped-def]
    """Intersect the beams of one sensor with vehicle bodies; the nearest surface wins, the static world included.

    Parameters
    ----------
    d, row, starts
        Unit directions along the world's axes (n, 3) float64, in the order of their cells; the row of ``ranges`` of
        each (n,) int64; where each cell starts (ROWS * COLUMNS + 1,) int64.
    boxes
        Centre relative to the sensor, length, width, height, yaw, pitch, (b, 8) float64. A box that contains the sensor
        is skipped.
    kinds
        The shape of each box's body, (b,) int64.
    shapes
        Where each shape's parts start (shapes + 1,) int64; boxes of parts (p, 6) float64, and whether each is closed
        and faces outwards (p,) bool; where each part's triangles start (p + 1,) int64; triangles as a corner and two
        sides from it (m, 3, 3), length of each cross product (m,) and reflectivity (m,), in the unit box, float64.
    ranges, sent, owner, triangle
        Of each row: range of the nearest surface so far (float64; a negative one is never replaced), reflectivity times
        the cosine of the angle of incidence (float64), its box and its triangle of ``shapes`` (int32 each); changed
        where a body is nearer.
    """
    part_starts, _, _, triangle_starts, triangles, _, reflectivity = shapes
    axes, half, c, o = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    room = 0
    for kind in range(part_starts.shape[0] - 1):
        room = max(room, triangle_starts[part_starts[kind + 1]] - triangle_starts[part_starts[kind]])
    part_boxes, firsts = np.empty((part_starts[-1], 6)), np.empty(part_starts[-1] + 1, np.int64)
    prepared, source, outer_box = np.empty((room, 11)), np.empty(room, np.int64), np.empty(6)
    for b in range(boxes.shape[0]):
        box_axes(boxes[b, 6], boxes[b, 7], axes)
        size, contains_sensor = boxes[b, 3:6], True
        for a in range(3):
            c[a], half[a] = boxes[b, a], 0.5 * size[a]
        for a in range(3):
            o[a] = -(c[0] * axes[a, 0] + c[1] * axes[a, 1] + c[2] * axes[a, 2]) / size[a]
            contains_sensor = contains_sensor and abs(o[a]) <= 0.5
            outer_box[a], outer_box[3 + a] = -0.5 - _PAD - o[a], 0.5 + _PAD - o[a]
        if contains_sensor:
            continue
        first_row, last_row, first_column, columns = _covered_cells(c, axes, half)
        parts, is_prepared = part_starts[kinds[b] + 1] - part_starts[kinds[b]], False
        for line in range(first_row, last_row + 1):
            for piece in range(2):  # two where a box extends across azimuth 180
                low = first_column if piece == 0 else 0
                high = min(first_column + columns, COLUMNS) if piece == 0 else first_column + columns - COLUMNS
                if high <= low:
                    continue
                for n in range(starts[line * COLUMNS + low], starts[line * COLUMNS + high]):
                    fx = d[n, 0] * axes[0, 0] + d[n, 1] * axes[0, 1] + d[n, 2] * axes[0, 2]
                    fy = d[n, 0] * axes[1, 0] + d[n, 1] * axes[1, 1] + d[n, 2] * axes[1, 2]
                    fz = d[n, 0] * axes[2, 0] + d[n, 1] * axes[2, 1] + d[n, 2] * axes[2, 2]
                    dx, dy, dz = fx / size[0], fy / size[1], fz / size[2]
                    if not _crosses_box(outer_box, _inverse(dx), _inverse(dy), _inverse(dz), ranges[row[n]]):
                        continue
                    if not is_prepared:
                        _prepare_body(kinds[b], o, shapes, part_boxes, firsts, prepared, source)
                        is_prepared = True
                    best, nearest = _nearest(parts, part_boxes, firsts, prepared, dx, dy, dz, ranges[row[n]])
                    if nearest >= 0:
                        ranges[row[n]], owner[row[n]], m = best, b, source[nearest]
                        triangle[row[n]] = m
                        sent[row[n]] = reflectivity[m] * _cosine(triangles[m], size, fx, fy, fz)


@_kernel
def fill_returns(beam, returned, ranges, noise, sent, d, returns):  # type: ignore[no-untyped-def]
    """Fill the returns of a sweep.

    Parameters
    ----------
    beam, returned
        The beam of each row (n,), and the rows that return (k,) int64.
    ranges, noise, sent
        Range of each row (n,), the noise of each return (k,), metres; intensity of each row (n,).
    d
        Nominal direction of each beam in the sensor's frame, (beams, 3) float64.
    returns
        Filled: x, y, z, intensity of each return, (k, 4) float32.
    """
    for i in range(returned.shape[0]):
        n = returned[i]
        far = max(ranges[n] + noise[i], 0.0)
        for a in range(3):
            returns[i, a] = far * d[beam[n], a]
        returns[i, 3] = min(max(sent[n], 0.0), 1.0)
