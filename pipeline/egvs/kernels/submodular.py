r"""Marginal gains of sensors: sums of concave functions over the cells that sensors hit.

The hits of a sensor are a sparse row: the cells that it hits, and how often, in whole numbers. The value of a cell is
:math:`w f(t)`, where t are the hits of all sensors together and f is one of

- ``CAPPED``: :math:`f(t) = \min(t, s)`,
- ``LOGARITHM``: :math:`f(t) = \ln(1 + t / s)`,
- ``SATURATING``: :math:`f(t) = 1 - e^{-t / s}`,

each rising and concave with f(0) = 0. Totals are whole numbers, so they do not depend on the order of sensors; sums
over cells are taken in the order of a row, so a gain is the same on any thread.
"""

from __future__ import annotations

import numpy as np

from egvs.kernels.jit import njit

CAPPED, LOGARITHM, SATURATING = 0, 1, 2

_kernel = njit()
_inlined = njit(forceinline=True)


@_kernel
def marginal_gains(rows, starts, cells, amounts, each_once, totals, weight, curve, scale, gained):  # type: ignore[no-untyped-def]
    """Fill what each of some sensors would add to the sum of :math:`w f(t)`.

    Parameters
    ----------
    rows
        Indices of the sensors, (m,) int64.
    starts, cells, amounts
        Entries starts[r] to starts[r + 1] belong to sensor r: cell (int32) and hits (unsigned or int64).
    each_once
        Whether a sensor counts once in each cell that it hits, however often it does.
    totals
        Hits of the sensors that are chosen already, (cells,) int64.
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
                total += weight[cell] * (
                    _curve_value(curve, scale, before + amount) - _curve_value(curve, scale, before)
                )
        gained[i] = total


@_inlined
def _curve_value(curve, scale, total):  # type: ignore[no-untyped-def]
    if curve == CAPPED:
        return min(np.float64(total), scale)
    if curve == LOGARITHM:
        return np.log1p(total / scale)
    return -np.expm1(-total / scale)


@_kernel
def tangent_slopes(rows, starts, cells, amounts, each_once, slope, summed):  # type: ignore[no-untyped-def]
    """Fill ``summed`` (m,) with each sensor's hits times the slope of each cell (cells,): the derivative of a sum."""
    for i in range(rows.shape[0]):
        total = 0.0
        for k in range(starts[rows[i]], starts[rows[i] + 1]):
            total += slope[cells[k]] * (1.0 if each_once else np.float64(amounts[k]))
        summed[i] = total


@_kernel
def add_sensor(first, last, cells, amounts, each_once, times, totals):  # type: ignore[no-untyped-def]
    """Add the entries ``first`` to ``last`` of one sensor, multiplied by ``times``, to ``totals`` (cells,).

    ``times`` is -1 to remove a sensor, or a share where totals are float64.
    """
    for k in range(first, last):
        totals[cells[k]] += times if each_once else times * amounts[k]
