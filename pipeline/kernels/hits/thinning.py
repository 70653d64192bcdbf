"""Multiplies the hits of voxels by a function of its range, given as a table of cubic polynomials.

Frame: the grid's own, in voxel units. The range of a voxel is that of its centre from the sensor.
"""

from __future__ import annotations

import numpy as np

from pipeline.kernels.compile_cache import compiled

_kernel = compiled()


@_kernel
def thin(hits, whole, o, shape, voxel_m, near_m, per_m, cubics, cells, thinned):  # type: ignore[no-untyped-def]
    """Fill what is left of the hits of some voxels, rounded to whole numbers.

    Parameters
    ----------
    hits
        Of each voxel, flat, (nx * ny * nz,) uint32 or int64.
    whole
        What one of ``hits`` counts in ``thinned``, int64.
    o, shape, voxel_m
        The sensor (3,), the grid, as in :func:`pipeline.kernels.march.count_hits`.
    near_m, per_m, cubics
        Piece j of the function begins at near_m + j / per_m; with s from 0 to 1 along it, it is the sum of cubics[j, i]
        * s**i, (pieces, 4) float64; NaN where the table does not know it.
    cells
        Flat index of each of the voxels, (n,) int64; quickest when ascending.
    thinned
        Filled at ``cells``, (nx * ny * nz,) int64; may be ``hits`` itself. Where the table does not know the function:
        -1 - hits * whole.

    Returns
    -------
    int
        For how many voxels the table does not know the function.
    """
    last, unknown = cubics.shape[0] - 1, 0
    pieces, begin = voxel_m * per_m, near_m * per_m  # of the table: in a voxel, before the first one
    upward = np.empty(shape[2])
    for iz in range(shape[2]):
        upward[iz] = (iz + 0.5 - o[2]) ** 2
    bottom, across = -shape[2], 0.0  # of the column of voxels that the last cell was in
    for n in range(cells.shape[0]):
        cell = np.uint64(cells[n])
        if hits[cell] == 0:
            thinned[cell] = 0
            continue
        iz = cells[n] - bottom
        if not 0 <= iz < shape[2]:
            column = cells[n] // shape[2]
            bottom = column * shape[2]
            ix, iy, iz = column // shape[1], column % shape[1], cells[n] - bottom
            across = (ix + 0.5 - o[0]) ** 2 + (iy + 0.5 - o[1]) ** 2
        s, amount = np.sqrt(across + upward[iz]) * pieces - begin, np.int64(hits[cell]) * whole
        j = np.uint64(min(max(np.int64(s), 0), last))  # unsigned, see march
        s -= j
        share = ((cubics[j, 3] * s + cubics[j, 2]) * s + cubics[j, 1]) * s + cubics[j, 0]
        if share == share:
            thinned[cell] = np.int64(np.rint(share * amount))
        else:
            thinned[cell], unknown = -1 - amount, unknown + 1
    return unknown
