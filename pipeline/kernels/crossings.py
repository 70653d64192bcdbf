"""Lists which voxels beam pieces cross, with their ranges.

Frame: the grid's own, in voxel units, as in :mod:`pipeline.kernels.march`, whose decisions these are.
"""

from __future__ import annotations

import numba
import numpy as np

from pipeline.kernels.march import _scratch, _walk

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")


@_kernel
def crossings(o, d, shape, voxel_m, first, cells, enter_m, leave_m):  # type: ignore[no-untyped-def]
    """List crossings, or count them when ``cells`` is empty.

    Parameters
    ----------
    o, d, shape, voxel_m
        Sensor (3,), beam ends seen from it (n, 3), both in voxel units; the grid, as in
        :func:`pipeline.kernels.march.count_hits`.
    first
        (n + 1,) int64. Counting: ``first[i + 1]`` is set to the crossings of piece i. Listing: where each piece's
        begin.
    cells, enter_m, leave_m
        Filled: flat index, range of entry and of exit of each crossing.
    """
    longest = shape[0] + shape[1] + shape[2] + 3
    scratch, t_cells, times = np.empty(longest, np.int64), np.empty((longest, 2), np.float64), _scratch(shape)
    unused = np.empty(0, np.uint32)
    for n in range(d.shape[0]):
        count, _, _ = _walk(o, d[n], shape, voxel_m, unused, scratch, t_cells, times)
        if cells.shape[0] == 0:
            first[n + 1] = count
            continue
        size = np.sqrt(d[n, 0] ** 2 + d[n, 1] ** 2 + d[n, 2] ** 2) * voxel_m
        for i in range(count):
            at = first[n] + i
            cells[at], enter_m[at], leave_m[at] = scratch[i], t_cells[i, 0] * size, t_cells[i, 1] * size


@_kernel
def accumulate(cells, weights, hits):  # type: ignore[no-untyped-def]
    """Add whole-number weights (k,) int64 to ``hits`` at ``cells``."""
    for i in range(cells.shape[0]):
        hits[cells[i]] += weights[i]
