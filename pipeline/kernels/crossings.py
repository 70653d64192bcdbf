"""Lists which voxels beam pieces cross, with their ranges, and adds up what each crossing is worth.

Frame: the grid's own, in voxel units, as in :mod:`pipeline.kernels.march`, whose decisions these are.
"""

from __future__ import annotations

import numpy as np

from pipeline.kernels.compile_cache import compiled
from pipeline.kernels.march import _scratch, _walk

_kernel = compiled()


@_kernel
def crossings(o, d, shape, voxel_m, first, cells, enter_m, leave_m):  # type: ignore[no-untyped-def]
    """List crossings.

    Parameters
    ----------
    o, d, shape, voxel_m
        Sensor (3,), beam ends seen from it (n, 3), both in voxel units; the grid, as in
        :func:`pipeline.kernels.march.count_hits`.
    first
        (n + 1,) int64, filled: crossings first[i] to first[i + 1] belong to piece i.
    cells, enter_m, leave_m
        Filled: flat index, range of entry and of exit of each crossing. At least n * sum(shape) long each.
    """
    times, t_cells = _scratch(shape), np.empty((shape[0] + shape[1] + shape[2], 2), np.float64)
    unused, total = np.empty(0, np.uint32), 0
    first[0] = 0
    for n in range(d.shape[0]):
        count, _, _ = _walk(o, d[n], shape, voxel_m, unused, np.uint32(0), None, cells[total:], t_cells, times)
        size = np.sqrt(d[n, 0] ** 2 + d[n, 1] ** 2 + d[n, 2] ** 2) * voxel_m
        for i in range(count):
            enter_m[total + i] = t_cells[i, 0] * size
            leave_m[total + i] = t_cells[i, 1] * size
        total += count
        first[n + 1] = total


@_kernel
def accumulate(cells, weights, hits):  # type: ignore[no-untyped-def]
    """Add whole-number weights (k,) to ``hits`` at ``cells``, flat, of the same dtype: uint32 or int64."""
    for i in range(cells.shape[0]):
        hits[cells[i]] += weights[i]


@_kernel
def add_shares(first, cells, weights, share, unit, hits):  # type: ignore[no-untyped-def]
    """Add to ``hits`` (int64) what gets as far as each crossing, in whole multiples of 1 / ``unit``.

    Parameters
    ----------
    first, cells
        As :func:`crossings` fills them.
    weights, share
        The share of its beam that each piece is (n,), and of the piece that gets as far as each crossing (k,), float64.
    """
    for n in range(first.shape[0] - 1):
        weight = weights[n]
        for i in range(first[n], first[n + 1]):
            hits[cells[i]] += np.int64(np.rint(weight * share[i] * unit))


@_kernel
def add_falling(o, d, shape, voxel_m, rows, first, range_m, share, weights, unit, hits):  # type: ignore[no-untyped-def]
    """As :func:`add_shares` of the :func:`crossings` of some beams whose shares fall step by step; lists nothing.

    Parameters
    ----------
    o, d, shape, voxel_m
        As in :func:`crossings`.
    rows
        Which beams, (n,) int64.
    first, range_m, share
        Falls first[i] to first[i + 1] belong to beam rows[i], (n + 1,) int64: their ranges, ascending, and the share
        that gets as far as voxels that are entered further away, (k,) float64 each.
    weights, unit, hits
        As in :func:`add_shares`.
    """
    times, most = _scratch(shape), np.int64(0)
    for i in range(rows.shape[0]):
        most = max(most, first[i + 1] - first[i])
    t_falls, amounts = np.empty(most + 1), np.empty(most + 1, np.int64)
    for i in range(rows.shape[0]):
        beam, count = rows[i], first[i + 1] - first[i]
        weight = weights[beam]
        amounts[0] = np.int64(np.rint(weight * unit))
        if count == 0:
            _walk(o, d[beam], shape, voxel_m, hits, amounts[0], None, None, None, times)
            continue
        size = np.sqrt(d[beam, 0] ** 2 + d[beam, 1] ** 2 + d[beam, 2] ** 2) * voxel_m
        for k in range(count):
            t_falls[k] = range_m[first[i] + k] / size
            amounts[k + 1] = np.int64(np.rint(weight * share[first[i] + k] * unit))
        t_falls[count] = np.inf
        _walk(o, d[beam], shape, voxel_m, hits, amounts[0], (t_falls, amounts), None, None, times)


@_kernel
def best_free(first, cells, log_free, best):  # type: ignore[no-untyped-def]
    """Raise ``best`` to the chance that all voxels before a crossing are free, as if they were independent.

    Parameters
    ----------
    first, cells
        As :func:`crossings` fills them.
    log_free
        Logarithm of the chance that each voxel is free, flat, float64; may be minus infinity. Sums of logarithms stay
        numbers where products of chances would vanish.
    best
        Of each voxel, flat, float64; raised, logarithms too.
    """
    for n in range(first.shape[0] - 1):
        free = 0.0
        for i in range(first[n], first[n + 1]):
            best[cells[i]] = max(best[cells[i]], free)
            free += log_free[cells[i]]
