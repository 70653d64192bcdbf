"""What does a ray meet first, and which voxels does a segment cross - slowly, obviously, in float64?

Shares no code with the pipeline. Rays: each is held against every triangle (Moeller and Trumbore 1997, "Fast, Minimum
Storage Ray/Triangle Intersection"), then against the rules that the pipeline documents: a plane that is seen at a sine below 1e-9
is not met, and a point up to 1 micrometre outside a triangle is on it. Segments: all crossings with the planes of the grid are
collected and sorted; the middle of each piece tells the voxel.
"""

import numba
import numpy as np

EDGE_M = 1e-6
GRAZE = 1e-9
CHORD_M = 1e-6


@numba.njit(cache=True, nogil=True)
def _off(p, a, b):
    """Distance of a point from the segment a-b."""
    along, length = 0.0, 0.0
    for k in range(3):
        along += (p[k] - a[k]) * (b[k] - a[k])
        length += (b[k] - a[k]) ** 2
    s = along / length
    if s < 0.0:
        s = 0.0
    if s > 1.0:
        s = 1.0
    away = 0.0
    for k in range(3):
        away += (p[k] - a[k] - s * (b[k] - a[k])) ** 2
    return np.sqrt(away)


@numba.njit(cache=True, nogil=True)
def _brute(o, d, corners, heights, edge_m, graze, ranges, which):
    p = np.empty(3)
    for r in range(d.shape[0]):
        best, best_of = np.inf, -1
        dx, dy, dz = d[r, 0], d[r, 1], d[r, 2]
        for m in range(corners.shape[0]):
            e1x, e1y, e1z = corners[m, 1, 0] - corners[m, 0, 0], corners[m, 1, 1] - corners[m, 0, 1], corners[m, 1, 2] - corners[m, 0, 2]
            e2x, e2y, e2z = corners[m, 2, 0] - corners[m, 0, 0], corners[m, 2, 1] - corners[m, 0, 1], corners[m, 2, 2] - corners[m, 0, 2]
            px, py, pz = dy * e2z - dz * e2y, dz * e2x - dx * e2z, dx * e2y - dy * e2x
            det = e1x * px + e1y * py + e1z * pz
            if det == 0.0:
                continue
            sx, sy, sz = o[r, 0] - corners[m, 0, 0], o[r, 1] - corners[m, 0, 1], o[r, 2] - corners[m, 0, 2]
            u = (sx * px + sy * py + sz * pz) / det
            if u * heights[m, 1] < -2.0 * edge_m:
                continue
            qx, qy, qz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
            v = (dx * qx + dy * qy + dz * qz) / det
            if v * heights[m, 2] < -2.0 * edge_m or (1.0 - u - v) * heights[m, 0] < -2.0 * edge_m:
                continue
            t = (e2x * qx + e2y * qy + e2z * qz) / det
            if not 0.0 < t < best or abs(det) < graze * heights[m, 3]:
                continue
            if u < 0.0 or v < 0.0 or u + v > 1.0:
                p[0], p[1], p[2] = o[r, 0] + t * dx, o[r, 1] + t * dy, o[r, 2] + t * dz
                a, b, c = corners[m, 0], corners[m, 1], corners[m, 2]
                if min(_off(p, a, b), _off(p, b, c), _off(p, c, a)) > edge_m:
                    continue
            best, best_of = t, m
        ranges[r], which[r] = best, best_of


def first_hits(o, d, corners, edge_m=EDGE_M, graze=GRAZE):
    """Range of each ray's first hit (infinity for none) and the triangle (-1).

    ``o`` (3,) or (n, 3); unit ``d`` (n, 3); ``corners`` (m, 3, 3). Triangles without area are not met.
    """
    d = np.ascontiguousarray(d, dtype=np.float64)
    o = np.ascontiguousarray(np.broadcast_to(np.asarray(o, dtype=np.float64), d.shape))
    corners = np.ascontiguousarray(corners, dtype=np.float64)
    double_area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    kept = np.flatnonzero(double_area > 0)
    corners, double_area = corners[kept], double_area[kept]
    opposite = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1), axis=2)
    heights = np.column_stack([double_area[:, None] / opposite, double_area])
    ranges, which = np.empty(len(d)), np.empty(len(d), dtype=np.int64)
    _brute(o, d, corners, heights, edge_m, graze, ranges, which)
    return ranges, np.where(which >= 0, kept[which] if len(kept) else -1, -1)
