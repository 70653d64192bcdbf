"""Counts which beams of one sensor meet which boxes of one frame, and which box each meets first.

Frame: the grid's own, in metres. A box is met as in :mod:`pipeline.kernels.occlusion`: made 0.1 mm smaller on each of
its six sides, where a beam enters it. Beams come in the order of their azimuths, so a box asks only those between the
azimuths that it spans.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from pipeline.kernels.occlusion import _entered

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")

_MARGIN_RAD = 1e-9
"""Spans are widened by this: rounding loses no beam."""


@_kernel
def first_met(facing, span, azimuth, d, length_m, weight, alone, owner, range_m):  # type: ignore[no-untyped-def]
    """Find the box that each beam meets first.

    Parameters
    ----------
    facing, span
        Of boxes, as :func:`pipeline.kernels.occlusion.face` fills them, (m, 15) and (m, 2).
    azimuth, d, length_m, weight
        Of beams: azimuth in [-pi, pi], ascending, (n,) float64; unit direction (n, 3); where the beam ends without
        boxes, and what it is worth, (n,).
    alone
        Filled, (m,) float64: the worth of all beams that meet the box, whatever stands before it.
    owner, range_m
        Filled, (n,) int64 and float64: the box that the beam meets first, -1 for none, and where; ``length_m`` for
        none.
    """
    owner[:] = -1
    range_m[:] = length_m
    for b in range(span.shape[0]):
        alone[b] = 0.0
        low, high = span[b, 0] - _MARGIN_RAD, span[b, 1] + _MARGIN_RAD
        around = high - low >= 2.0 * math.pi
        for turn in range(-1, 2):
            if around and turn != 0:
                continue
            shift = turn * 2.0 * math.pi
            start = 0 if around else np.searchsorted(azimuth, low + shift)
            end = azimuth.shape[0] if around else np.searchsorted(azimuth, high + shift)
            for n in range(start, end):
                t = _entered(facing, b, d[n, 0], d[n, 1], d[n, 2])
                if t < length_m[n]:
                    alone[b] += weight[n]
                    if t < range_m[n]:
                        owner[n], range_m[n] = b, t
