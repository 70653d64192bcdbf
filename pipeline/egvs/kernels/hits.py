"""Hits per voxel: beam crossings with their ranges, weighted sums over crossings, and thinning by range.

Frame: the grid's own, in voxel units, with the traversal of :mod:`egvs.kernels.traversal`. :func:`thin_by_range`
multiplies hits by a function of range, given as a table of cubic polynomials; there, the range of a voxel is that of
its centre from the sensor.
"""

from __future__ import annotations

import numpy as np

from egvs.kernels import traversal
from egvs.kernels.jit import njit

_kernel = njit()

_THIN_BLOCK = 256
"""Voxels whose ranges are computed together."""


@_kernel
def list_crossings(o, d, shape, voxel_m, first, cells, enter_m, leave_m):  # type: ignore[no-untyped-def]
    """List the voxels that each beam crosses, with the ranges at which it enters and leaves them.

    Parameters
    ----------
    o, d
        The sensor (3,), and the beam ends relative to it (n, 3), float64, voxel units.
    shape, voxel_m
        The grid, as in :func:`egvs.kernels.traversal.count_hits`.
    first
        Filled, (n + 1,) int64: crossings first[i] to first[i + 1] belong to beam i.
    cells, enter_m, leave_m
        Filled: flat index (int64), range of entry and of exit (float64) of each crossing. At least n * sum(shape) long
        each.
    """
    times = traversal.crossing_buffer(shape)
    t_cells = np.empty((shape[0] + shape[1] + shape[2], 2), np.float64)
    total = 0
    first[0] = 0
    for n in range(d.shape[0]):
        count, _, _ = traversal.list_voxels(o, d[n], shape, voxel_m, cells[total:], t_cells, times)
        length_m = np.sqrt(d[n, 0] ** 2 + d[n, 1] ** 2 + d[n, 2] ** 2) * voxel_m
        for i in range(count):
            enter_m[total + i] = t_cells[i, 0] * length_m
            leave_m[total + i] = t_cells[i, 1] * length_m
        total += count
        first[n + 1] = total


@_kernel
def add_shares(first, cells, weights, share, unit, hits):  # type: ignore[no-untyped-def]
    """Add the transmitted share of each beam piece to the voxels that it crosses.

    Parameters
    ----------
    first, cells
        As :func:`list_crossings` fills them.
    weights
        Weight of each beam piece, (n,) float64.
    share
        Share of the piece that reaches each crossing, (k,) float64.
    unit
        Hits are whole multiples of 1 / ``unit``.
    hits
        Added to, flat, int64.
    """
    for n in range(first.shape[0] - 1):
        weight = weights[n]
        for i in range(first[n], first[n + 1]):
            hits[cells[i]] += np.int64(np.rint(weight * share[i] * unit))


@_kernel
def add_stepwise_shares(o, d, shape, voxel_m, rows, first, range_m, share, weights, unit, hits):  # type: ignore[no-untyped-def]
    """Add the transmitted share of beams whose share falls step by step, without listing their crossings.

    The result is that of :func:`add_shares` on the crossings of :func:`list_crossings`.

    Parameters
    ----------
    o, d, shape, voxel_m
        As in :func:`list_crossings`.
    rows
        The beams, (n,) int64, indices of ``d`` and ``weights``.
    first, range_m, share
        Steps first[i] to first[i + 1] belong to beam rows[i], (n + 1,) int64: their ranges, ascending, and the share
        that reaches voxels that are entered further away, (k,) float64 each.
    weights, unit, hits
        As in :func:`add_shares`.
    """
    times, max_steps = traversal.crossing_buffer(shape), np.int64(0)
    for i in range(rows.shape[0]):
        max_steps = max(max_steps, first[i + 1] - first[i])
    cells, tolerances = traversal.cell_buffer(shape), traversal.make_tolerances(o, shape, traversal.CHORD_M / voxel_m)
    t_falls, amounts = np.empty(max_steps + 1), np.empty(max_steps + 1, np.int64)
    for i in range(rows.shape[0]):
        beam, count = rows[i], first[i + 1] - first[i]
        weight = weights[beam]
        amounts[0] = np.int64(np.rint(weight * unit))
        if count == 0:
            crossed = traversal.traverse_fixed_point(o, d[beam], shape, tolerances, cells)
            if crossed < 0:
                traversal.add_to_voxels(o, d[beam], shape, voxel_m, amounts[0], hits, times)
            for k in range(crossed):
                hits[cells[k]] += amounts[0]
            continue
        length_m = np.sqrt(d[beam, 0] ** 2 + d[beam, 1] ** 2 + d[beam, 2] ** 2) * voxel_m
        for k in range(count):
            t_falls[k] = range_m[first[i] + k] / length_m
            amounts[k + 1] = np.int64(np.rint(weight * share[first[i] + k] * unit))
        t_falls[count] = np.inf
        traversal.add_stepwise(o, d[beam], shape, voxel_m, t_falls, amounts, hits, times)


@_kernel
def max_free_probability(first, cells, log_free, best):  # type: ignore[no-untyped-def]
    """Maximum over beams of the probability that all voxels before a voxel are free, as if they were independent.

    Parameters
    ----------
    first, cells
        As :func:`list_crossings` fills them.
    log_free
        Logarithm of the probability that each voxel is free, flat, float64; may be minus infinity. Sums of logarithms
        stay finite where products of probabilities would vanish.
    best
        Raised: logarithm of the maximum at each voxel, flat, float64.
    """
    for n in range(first.shape[0] - 1):
        free = 0.0
        for i in range(first[n], first[n + 1]):
            best[cells[i]] = max(best[cells[i]], free)
            free += log_free[cells[i]]


@_kernel
def thin_by_range(hits, unit, o, shape, voxel_m, near_m, per_m, cubics, cells, thinned):  # type: ignore[no-untyped-def]
    """Multiply the hits of some voxels by a function of range, rounded to whole numbers.

    Parameters
    ----------
    hits
        Of each voxel, flat, (nx * ny * nz,) uint32 or int64.
    unit
        What one of ``hits`` counts in ``thinned``, int64.
    o, shape, voxel_m
        The sensor (3,), the grid, as in :func:`egvs.kernels.traversal.count_hits`.
    near_m, per_m, cubics
        Piece j of the function begins at near_m + j / per_m; with s from 0 to 1 along it, it is the sum of cubics[j, i]
        * s**i, (pieces, 4) float64; NaN where a cubic does not approximate the function.
    cells
        Flat index of each of the voxels, (n,) int64; fastest when ascending.
    thinned
        Filled at ``cells``, (nx * ny * nz,) int64; may be ``hits`` itself. Where the cubics are NaN:
        -1 - hits * unit.

    Returns
    -------
    int
        Number of voxels where the cubics are NaN.
    """
    last, unknown = np.int32(cubics.shape[0] - 1), 0
    pieces_per_voxel, pieces_before = voxel_m * per_m, near_m * per_m
    along_x, along_y, upward = _squared_offsets(o, shape)
    piece, position = np.empty(_THIN_BLOCK, np.int32), np.empty(_THIN_BLOCK)
    bottom, across = -shape[2], 0.0  # of the voxel column of the previous cell
    for begin in range(0, cells.shape[0], _THIN_BLOCK):
        block = cells[begin : min(begin + _THIN_BLOCK, cells.shape[0])]
        for i in range(block.shape[0]):  # the squared range in voxels
            iz = block[i] - bottom
            if not 0 <= iz < shape[2]:
                column = block[i] // shape[2]
                bottom = column * shape[2]
                iz = block[i] - bottom
                across = along_x[column // shape[1]] + along_y[column % shape[1]]
            position[i] = across + upward[np.uint64(iz)]
        for i in range(block.shape[0]):  # has no branch, so several are computed at once
            s = np.sqrt(position[i]) * pieces_per_voxel - pieces_before
            piece[i] = min(max(np.int32(s), np.int32(0)), last)
            position[i] = s - piece[i]
        for i in range(block.shape[0]):
            cell, j, s = np.uint64(block[i]), np.uint64(piece[i]), position[i]  # signed indices would be checked
            amount = np.int64(hits[cell]) * unit
            share = ((cubics[j, 3] * s + cubics[j, 2]) * s + cubics[j, 1]) * s + cubics[j, 0]
            if share == share:
                thinned[cell] = np.int64(np.rint(share * amount))
            else:
                thinned[cell] = -1 - amount
                unknown += 1
    return unknown


@_kernel
def _squared_offsets(o, shape):  # type: ignore[no-untyped-def]
    """Squared distance, along each axis, from the sensor to the centre of each voxel, in voxels."""
    along_x, along_y, along_z = np.empty(shape[0]), np.empty(shape[1]), np.empty(shape[2])
    for i in range(shape[0]):
        along_x[i] = (i + 0.5 - o[0]) ** 2
    for i in range(shape[1]):
        along_y[i] = (i + 0.5 - o[1]) ** 2
    for i in range(shape[2]):
        along_z[i] = (i + 0.5 - o[2]) ** 2
    return along_x, along_y, along_z


@_kernel
def fit_cubics(values, to_cubic, tolerance, cubics):  # type: ignore[no-untyped-def]
    """Fit a cubic to each piece of a function, and reject those that are too inaccurate.

    Parameters
    ----------
    values
        The function at the start of each piece, at each sixth of it, and at the end of the last, (6 * pieces + 1,)
        float64.
    to_cubic
        Row i times the values at thirds of a piece gives coefficient i: (4, 4) float64.
    tolerance
        Largest accepted difference at the three sixths between the thirds.
    cubics
        Filled, as :func:`thin_by_range` takes them, (pieces, 4) float64; NaN in all four where a cubic is rejected.

    Returns
    -------
    int
        Number of rejected cubics.
    """
    rejected = 0
    for j in range(cubics.shape[0]):
        piece, cubic = values[6 * j : 6 * j + 7], cubics[j]
        for i in range(4):
            cubic[i] = piece[0] * to_cubic[i, 0] + piece[2] * to_cubic[i, 1]
            cubic[i] = (cubic[i] + piece[4] * to_cubic[i, 2]) + piece[6] * to_cubic[i, 3]
        is_accurate = True
        for k in (1, 3, 5):
            s = k / 6.0
            fitted = ((cubic[3] * s + cubic[2]) * s + cubic[1]) * s + cubic[0]
            is_accurate &= abs(fitted - piece[k]) <= tolerance
        if not is_accurate:
            cubic[:] = np.nan
            rejected += 1
    return rejected
