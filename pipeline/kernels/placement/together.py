r"""What a further sensor adds to what others see: sums over the cells that it hits.

A sensor's sight is a sparse row: the cells that it hits, and by how much, in whole numbers. A cell is worth
:math:`w f(t)`, t the hits of all sensors together, f one of

- ``CAPPED``: :math:`f(t) = \min(t, s)`,
- ``LOGARITHM``: :math:`f(t) = \ln(1 + t / s)`,
- ``SATURATING``: :math:`f(t) = 1 - e^{-t / s}`,

each rising and concave with f(0) = 0. Totals are whole numbers, so they do not depend on the order of sensors; sums
over cells are taken in the order of a row, so a gain is the same on any thread.
"""

from __future__ import annotations

import numba
import numpy as np

CAPPED, LOGARITHM, SATURATING = 0, 1, 2

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")
_inlined = numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)


@_inlined
def _worth(curve, scale, total):  # type: ignore[no-untyped-def]
    if curve == CAPPED:
        return min(np.float64(total), scale)
    if curve == LOGARITHM:
        return np.log1p(total / scale)
    return -np.expm1(-total / scale)


@_kernel
def gains(rows, starts, cells, amounts, each_once, totals, weight, curve, scale, gained):  # type: ignore[no-untyped-def]
    """What each of some sensors would add to the sum of :math:`w f(t)`.

    Parameters
    ----------
    rows
        The sensors asked for, (m,) int64.
    starts, cells, amounts
        Entries starts[r] to starts[r + 1] are those of sensor r: cell (int32) and hits (unsigned or int64).
    each_once
        Whether a sensor counts once in a cell that it hits, however often.
    totals
        Hits of those that are there already, (cells,) int64.
    weight
        w, (cells,) float64.
    curve, scale
        f and s, see above.
    gained
        Filled, (m,) float64.
    """
    for i in range(rows.shape[0]):
        total = 0.0
        for k in range(starts[rows[i]], starts[rows[i] + 1]):
            cell = cells[k]
            before, amount = totals[cell], np.int64(1) if each_once else np.int64(amounts[k])
            if curve == CAPPED:
                if before < scale:
                    total += weight[cell] * (min(np.float64(before + amount), scale) - before)
            else:
                total += weight[cell] * (_worth(curve, scale, before + amount) - _worth(curve, scale, before))
        gained[i] = total


@_kernel
def slopes(rows, starts, cells, amounts, each_once, slope, summed):  # type: ignore[no-untyped-def]
    """Fill ``summed`` (m,) with each sensor's hits times a slope of its cells (cells,): how a sum rises with it."""
    for i in range(rows.shape[0]):
        total = 0.0
        for k in range(starts[rows[i]], starts[rows[i] + 1]):
            total += slope[cells[k]] * (1.0 if each_once else np.float64(amounts[k]))
        summed[i] = total


@_kernel
def add(first, last, cells, amounts, each_once, times, totals):  # type: ignore[no-untyped-def]
    """Add the entries ``first`` to ``last`` of one sensor to ``totals`` (cells,), ``times`` over: -1 takes it away, a
    share adds a share where totals are float64."""
    for k in range(first, last):
        totals[cells[k]] += times if each_once else times * amounts[k]
