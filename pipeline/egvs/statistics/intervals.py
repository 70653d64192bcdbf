"""Standard errors and 95 % intervals of shares and of scales, from blocks of neighbouring pulses.

Neighbouring pulses meet the same surface and, in second differences, share returns. So the variance of a sum is
estimated from sums over blocks of consecutive pulses (the delete-one-block jackknife: Künsch 1989, Ann. Statist. 17,
1217-1241), and the interval uses Student's t with as many degrees of freedom as there are blocks, less one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.stats import norm, t

from egvs.core.grid import FloatArray

BLOCKS = 40
"""Number of blocks, where there are enough values."""
MIN_VALUES = 100
"""Fewer values give no estimate."""

_CLIP = 3.0
_INSIDE = float(1.0 - 2.0 * norm.sf(_CLIP))
_CLIPPED_VARIANCE = 1.0 - 2.0 * _CLIP * float(norm.pdf(_CLIP)) / _INSIDE
"""Variance of a standard normal variable, given that it is within +-3."""


class Estimate(NamedTuple):
    """A value with its standard error and 95 % interval.

    Attributes
    ----------
    value, se
        The value and its standard error.
    low, high
        Ends of the interval.
    n
        Number of values used.
    """

    value: float
    se: float
    low: float
    high: float
    n: int


def estimate_share(hits: FloatArray, inflation: float = 1.0) -> Estimate:
    """Return the share of hits, with Wilson's interval (1927, J. Am. Stat. Assoc. 22, 209-212).

    Parameters
    ----------
    hits
        0 or 1 for each pulse, in the order of channels and columns, (n,), n >= 1.
    inflation
        Known factor by which correlation increases the variance; the factor that blocks show applies if it is larger.
    """
    n = len(hits)
    share = float(np.mean(hits))
    binomial = share * (1.0 - share) / n
    factor = inflation
    if binomial > 0.0 and n >= MIN_VALUES:
        counts, sums = _block_sums(np.column_stack([np.ones(n), hits])).T
        left_out = (sums.sum() - sums) / (counts.sum() - counts)
        factor = max(factor, jackknife_variance(left_out) / binomial)
    effective = n / factor
    z = float(norm.ppf(0.975))
    centre = (share + z * z / (2 * effective)) / (1 + z * z / effective)
    half = z / (1 + z * z / effective) * math.sqrt(share * (1 - share) / effective + (z / (2 * effective)) ** 2)
    low = min(max(0.0, centre - half), share)
    high = max(min(1.0, centre + half), share)
    return Estimate(share, math.sqrt(binomial * factor), low, high, n)


def estimate_scale(residual: FloatArray, variance_factor: float, step: float = 0.0) -> Estimate | None:
    r"""Return the standard deviation of the noise from which residuals of this multiple of its variance come.

    The first scale is the median absolute deviation. Residuals beyond 3 scales are left out, as edges and vegetation
    are, and the scale is the root mean square of the others, corrected for what a normal distribution has beyond 3;
    this is repeated until it is stable. (The median alone would jump between the few values that coarse range steps
    allow.) Rounding to a step q adds :math:`q^2 / 12` to the variance of a range, which is subtracted (Sheppard 1898).

    Parameters
    ----------
    residual
        In the order of channels and columns, (n,).
    variance_factor
        Variance of a residual, divided by that of a range.
    step
        Range step q; 0 for none.

    Returns
    -------
    Estimate or None
        None with fewer than :data:`MIN_VALUES` residuals.
    """
    if len(residual) < MIN_VALUES:
        return None
    scale = max(1.4826 * float(np.median(np.abs(residual))), step / math.sqrt(12.0) * math.sqrt(variance_factor), 1e-9)
    for _ in range(30):
        inside = np.abs(residual) <= _CLIP * scale
        scale_before = scale
        scale = math.sqrt(float(np.mean(residual[inside] ** 2)) / _CLIPPED_VARIANCE)
        if abs(scale - scale_before) <= 1e-4 * scale:
            break
        scale = max(scale, 1e-9)
    squares = np.where(inside, residual**2, 0.0)
    counts, sums = _block_sums(np.column_stack([inside, squares])).T
    full = float(sums.sum() / counts.sum())
    left_out = (sums.sum() - sums) / (counts.sum() - counts)
    # A larger scale also widens the clip. Solved to first order, this divides the deviation of the variance:
    sensitivity = 1.0 - _CLIP**3 * float(norm.pdf(_CLIP)) * (1.0 - _CLIPPED_VARIANCE / _CLIP**2) / (
        _INSIDE * _CLIPPED_VARIANCE
    )
    variance_se = math.sqrt(jackknife_variance(left_out)) / sensitivity

    to_range = 1.0 / (_CLIPPED_VARIANCE * variance_factor)
    variance = full * to_range - step**2 / 12.0
    half = float(t.ppf(0.975, len(counts) - 1)) * variance_se * to_range
    value = math.sqrt(max(variance, 0.0))
    low = math.sqrt(max(variance - half, 0.0))
    high = math.sqrt(max(variance + half, 0.0))
    se = variance_se * to_range / (2.0 * value) if value > 0 else high / 2.0
    return Estimate(value, se, low, high, len(residual))


def _block_sums(values: FloatArray) -> FloatArray:
    """Return the sums of consecutive rows in :data:`BLOCKS` blocks, (blocks, columns)."""
    starts = np.linspace(0, len(values), min(BLOCKS, len(values)), endpoint=False).astype(np.int64)
    sums: FloatArray = np.add.reduceat(values.astype(np.float64), starts, axis=0)
    return sums


def jackknife_variance(left_out: FloatArray) -> float:
    """Return the variance of an estimate from its values without each of k blocks in turn, (k,)."""
    k = len(left_out)
    return float((k - 1) / k * ((left_out - left_out.mean()) ** 2).sum())
