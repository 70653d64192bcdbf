r"""Means, medians, scales and shares with 95 % intervals.

Of independent observations, a count of k has the exact interval of a Poisson mean, from
:math:`\chi^2_{0.025}(2 k) / 2` to :math:`\chi^2_{0.975}(2 k + 2) / 2` (Garwood 1936), a share that of Clopper and
Pearson (1934), a mean Student's, a standard deviation that of chi-squared, and a median the distribution-free one of
order statistics.

Shares and scales of laser pulses have intervals from blocks. Neighbouring pulses meet the same surface and, in second
differences, share returns. So the variance of a sum is estimated from sums over blocks of consecutive pulses (the
delete-one-block jackknife: Künsch 1989, Ann. Statist. 17, 1217-1241), and the interval uses Student's t with as many
degrees of freedom as there are blocks, less one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import beta, binom, chi2, norm, t

from egvs.core.grid import FloatArray
from egvs.statistics.blocks import jackknife_variance

BLOCKS = 40
"""Number of blocks, where there are enough values."""
MIN_VALUES = 100
"""Fewer values give no estimate from blocks."""
MIN_OBSERVATIONS = 20
"""Fewer independent observations give a value that is not used."""

_LEVEL = 0.95

_CLIP = 3.0
_INSIDE = float(1.0 - 2.0 * norm.sf(_CLIP))
_CLIPPED_VARIANCE = 1.0 - 2.0 * _CLIP * float(norm.pdf(_CLIP)) / _INSIDE
"""Variance of a standard normal variable, given that it is within +-3."""


class Estimate(NamedTuple):
    """A value with its standard error and 95 % interval.

    Attributes
    ----------
    value, se
        The value and its standard error; NaN where only the interval is known.
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

    @property
    def is_usable(self) -> bool:
        """Whether there are at least :data:`MIN_OBSERVATIONS`."""
        return self.n >= MIN_OBSERVATIONS

    def format(self, digits: int = 2, unit: str = "") -> str:
        """Return the interval as text: "95 %: 1.9 to 2.3 s, from 31"."""
        space = " " if unit else ""
        return f"95 %: {self.low:.{digits}f} to {self.high:.{digits}f}{space}{unit}, from {self.n:,}"


def poisson_interval(count: int) -> tuple[float, float]:
    """Return the exact 95 % interval of the mean of a Poisson distribution from which a count was drawn."""
    tail = (1.0 - _LEVEL) / 2.0
    low = float(chi2.ppf(tail, 2 * count)) / 2.0 if count else 0.0
    return low, float(chi2.ppf(1.0 - tail, 2 * count + 2)) / 2.0


def share_interval(count: int, total: int) -> tuple[float, float]:
    """Return the exact 95 % interval of a share (Clopper and Pearson 1934)."""
    tail = (1.0 - _LEVEL) / 2.0
    low = float(beta.ppf(tail, count, total - count + 1)) if count else 0.0
    high = float(beta.ppf(1.0 - tail, count + 1, total - count)) if count < total else 1.0
    return low, high


def median_of(values: Sequence[float] | FloatArray) -> Estimate | None:
    """Return the median with the interval of order statistics; None without values."""
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    n = ordered.size
    if not n:
        return None
    rank = max(int(binom.ppf((1.0 - _LEVEL) / 2.0, n, 0.5)), 1)
    return Estimate(float(np.median(ordered)), math.nan, float(ordered[rank - 1]), float(ordered[n - rank]), n)


def mean_of(values: Sequence[float] | FloatArray) -> Estimate | None:
    """Return the mean with Student's interval; None with fewer than two values."""
    numbers = np.asarray(values, dtype=np.float64)
    n = numbers.size
    if n < 2:
        return None
    deviation = numbers.std(ddof=1)
    half = float(t.ppf(0.5 + _LEVEL / 2.0, n - 1) * deviation / math.sqrt(n))
    mean = float(numbers.mean())
    return Estimate(mean, float(deviation / math.sqrt(n)), mean - half, mean + half, n)


def deviation_of(values: Sequence[float] | FloatArray) -> Estimate | None:
    """Return the standard deviation with the interval for normal values; None with fewer than two values."""
    numbers = np.asarray(values, dtype=np.float64)
    n = numbers.size
    if n < 2:
        return None
    deviation, tail = float(numbers.std(ddof=1)), (1.0 - _LEVEL) / 2.0
    low, high = (deviation * math.sqrt((n - 1) / chi2.ppf(share, n - 1)) for share in (1.0 - tail, tail))
    return Estimate(deviation, math.nan, float(low), float(high), n)


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
        factor = max(factor, float(jackknife_variance(left_out)) / binomial)
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
    return np.add.reduceat(values.astype(np.float64), starts, axis=0)
