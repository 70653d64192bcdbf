r"""Finds which voxels static geometry fills, and which points lie inside a solid.

Frame: the grid's own, in metres. Two questions, because a triangle mesh is only a surface:

- :func:`touch`: a triangle reaches deeper than ``SHRINK_M`` (0.1 mm) into a voxel. Separating axes of a triangle and a
  cube (Akenine-Moeller 2001, "Fast 3D Triangle-Box Overlap Testing"), the cube made 0.1 mm smaller on each side, so
  that a plane that coincides with voxel faces (the ground at z = 0) fills none.
- :func:`wind`: a voxel without surface in it is inside or outside as a whole; its centre decides, by the winding number
  along +z. Corners and centres are first moved to the nearest multiple of ``SNAP_M``, which is far less than half a
  voxel, so that the sides of edges are decided in whole numbers, without rounding. A centre exactly above an edge would
  be counted twice or not at all; each edge is therefore looked at from its lexicographically smaller end, and what lies
  on it is to its left, as if every point were moved by (-e^2, e). So the triangles of a closed solid never disagree.
"""

from __future__ import annotations

import numpy as np

from pipeline.kernels.boxes import SHRINK_M, TINY
from pipeline.kernels.compile_cache import compiled

SNAP_M = 2.0**-14
"""Lattice (61 micrometres) on which winding numbers are settled; solids up to 100 km across fit into int64."""

_kernel = compiled()


@_kernel
def _parts(nx, ny, nz, tri, centre, half):  # type: ignore[no-untyped-def]
    """True when the axis n parts the triangle from the cube of half size ``half``."""
    size = abs(nx) + abs(ny) + abs(nz)
    if size < TINY:
        return False  # no axis: parallel edges, or a triangle without area
    low, high = np.inf, -np.inf
    for v in range(3):
        p = (tri[v, 0] - centre[0]) * nx + (tri[v, 1] - centre[1]) * ny + (tri[v, 2] - centre[2]) * nz
        low, high = min(low, p), max(high, p)
    return low >= half * size or high <= -half * size


@_kernel
def triangle_meets_cube(tri, centre, half):  # type: ignore[no-untyped-def]
    """Whether a triangle (3, 3) meets the open cube round ``centre`` (3,)."""
    for a in range(3):
        if _parts(1.0 if a == 0 else 0.0, 1.0 if a == 1 else 0.0, 1.0 if a == 2 else 0.0, tri, centre, half):
            return False
    ux, uy, uz = tri[1, 0] - tri[0, 0], tri[1, 1] - tri[0, 1], tri[1, 2] - tri[0, 2]
    vx, vy, vz = tri[2, 0] - tri[0, 0], tri[2, 1] - tri[0, 1], tri[2, 2] - tri[0, 2]
    if _parts(uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx, tri, centre, half):
        return False
    for e in range(3):
        x, y, z = tri[(e + 1) % 3, 0] - tri[e, 0], tri[(e + 1) % 3, 1] - tri[e, 1], tri[(e + 1) % 3, 2] - tri[e, 2]
        if _parts(0.0, z, -y, tri, centre, half) or _parts(-z, 0.0, x, tri, centre, half):
            return False
        if _parts(y, -x, 0.0, tri, centre, half):
            return False
    return True


@_kernel
def touch(triangles, shape, voxel_m, filled):  # type: ignore[no-untyped-def]
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
                    if not filled[ix, iy, iz] and triangle_meets_cube(tri, centre, half):
                        filled[ix, iy, iz] = True


@_kernel
def _side(ax, ay, bx, by, px, py):  # type: ignore[no-untyped-def]
    """Twice the signed area of a, b, p: above 0 where p lies to the left of a-b. Whole numbers, so it is exact."""
    return (bx - ax) * (py - ay) - (by - ay) * (px - ax)


@_kernel
def _left(side, ax, ay, bx, by):  # type: ignore[no-untyped-def]
    """Whether p lies to the left of a-b; on the line: to the left of the edge that starts at its smaller end."""
    return side > 0 or (side == 0 and (ax < bx or (ax == bx and ay < by)))


@_kernel
def crossing(tri, px, py):  # type: ignore[no-untyped-def]
    """Where the vertical line at (px, py) crosses a triangle: (sign, z); sign 0 when it does not.

    The sign is +1 when the triangle's normal points up (the line leaves a solid there), -1 when down.
    """
    x, y = np.int64(np.rint(px / SNAP_M)), np.int64(np.rint(py / SNAP_M))
    ax, ay = np.int64(np.rint(tri[0, 0] / SNAP_M)), np.int64(np.rint(tri[0, 1] / SNAP_M))
    bx, by = np.int64(np.rint(tri[1, 0] / SNAP_M)), np.int64(np.rint(tri[1, 1] / SNAP_M))
    cx, cy = np.int64(np.rint(tri[2, 0] / SNAP_M)), np.int64(np.rint(tri[2, 1] / SNAP_M))
    c, a, b = _side(ax, ay, bx, by, x, y), _side(bx, by, cx, cy, x, y), _side(cx, cy, ax, ay, x, y)
    left = _left(c, ax, ay, bx, by)
    if left != _left(a, bx, by, cx, cy) or left != _left(b, cx, cy, ax, ay) or a + b + c == 0:
        return 0, 0.0
    # The areas weigh the corners; none has the other sign, so z stays between them however steep the triangle is.
    return (1 if left else -1), (a * tri[0, 2] + b * tri[1, 2] + c * tri[2, 2]) / (a + b + c)


@_kernel
def wind(triangles, signs, shape, voxel_m, winding):  # type: ignore[no-untyped-def]
    """Add up the winding numbers of voxel centres.

    Parameters
    ----------
    triangles
        Of closed solids, (n, 3, 3) float64, grid frame, metres.
    signs
        +1 or -1 for each triangle: -1 where the solid's triangles face inwards, (n,) int64.
    shape, voxel_m
        As in :func:`touch`.
    winding
        Differences along z, added to, (nx, ny, nz + 1) int32; their running sum is the winding number.
    """
    nx, ny, nz = shape[0], shape[1], shape[2]
    for n in range(triangles.shape[0]):
        tri = triangles[n]
        low_x, high_x = min(tri[0, 0], tri[1, 0], tri[2, 0]), max(tri[0, 0], tri[1, 0], tri[2, 0])
        low_y, high_y = min(tri[0, 1], tri[1, 1], tri[2, 1]), max(tri[0, 1], tri[1, 1], tri[2, 1])
        for ix in range(max(0.0, np.floor(low_x / voxel_m) - 1), min(float(nx), np.ceil(high_x / voxel_m) + 1)):
            for iy in range(max(0.0, np.floor(low_y / voxel_m) - 1), min(float(ny), np.ceil(high_y / voxel_m) + 1)):
                sign, z = crossing(tri, (ix + 0.5) * voxel_m, (iy + 0.5) * voxel_m)
                if sign != 0:
                    k = np.int64(min(max(np.ceil(z / voxel_m - 0.5), 0.0), float(nz)))
                    winding[ix, iy, 0] += sign * signs[n]
                    winding[ix, iy, k] -= sign * signs[n]


@_kernel
def windings_at(point, triangles, solids, signs, totals):  # type: ignore[no-untyped-def]
    """Add up one point's winding number in each solid: ``totals`` (solids,) int64, added to."""
    for n in range(triangles.shape[0]):
        sign, z = crossing(triangles[n], point[0], point[1])
        if sign != 0 and z > point[2]:
            totals[solids[n]] += sign * signs[n]
