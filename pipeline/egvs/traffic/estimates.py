r"""Values with 95 % intervals, from a number of vehicles.

Counts of k vehicles have the exact interval of a Poisson mean, from :math:`\chi^2_{0.025}(2 k) / 2` to
:math:`\chi^2_{0.975}(2 k + 2) / 2` (Garwood 1936), shares that of Clopper and Pearson (1934), means Student's, standard
deviations that of chi-squared, and medians the distribution-free one of order statistics.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egvs.core.grid import FloatArray

MIN_OBSERVATIONS = 20
"""A value from fewer vehicles is not used."""

_LEVEL = 0.95


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % interval, from n observations."""

    value: float
    low: float
    high: float
    n: int

    @property
    def is_usable(self) -> bool:
        """Whether there are enough observations."""
        return self.n >= MIN_OBSERVATIONS

    def format(self, digits: int = 2, unit: str = "") -> str:
        """Return the interval as text: "95 %: 1.9 to 2.3 s, from 31"."""
        space = " " if unit else ""
        return f"95 %: {self.low:.{digits}f} to {self.high:.{digits}f}{space}{unit}, from {self.n:,}"


def poisson_interval(count: int) -> tuple[float, float]:
    """Return the exact 95 % interval of the mean of a Poisson distribution from which a count was drawn."""
    from scipy.stats import chi2

    tail = (1.0 - _LEVEL) / 2.0
    low = float(chi2.ppf(tail, 2 * count)) / 2.0 if count else 0.0
    return low, float(chi2.ppf(1.0 - tail, 2 * count + 2)) / 2.0


def share_interval(count: int, total: int) -> tuple[float, float]:
    """Return the exact 95 % interval of a share (Clopper and Pearson 1934)."""
    from scipy.stats import beta

    tail = (1.0 - _LEVEL) / 2.0
    low = float(beta.ppf(tail, count, total - count + 1)) if count else 0.0
    high = float(beta.ppf(1.0 - tail, count + 1, total - count)) if count < total else 1.0
    return low, high


def median_of(values: Sequence[float] | FloatArray) -> Estimate | None:
    """Return the median with the interval of order statistics; None without values."""
    from scipy.stats import binom

    ordered = np.sort(np.asarray(values, dtype=np.float64))
    n = ordered.size
    if not n:
        return None
    rank = max(int(binom.ppf((1.0 - _LEVEL) / 2.0, n, 0.5)), 1)
    return Estimate(float(np.median(ordered)), float(ordered[rank - 1]), float(ordered[n - rank]), n)


def mean_of(values: Sequence[float] | FloatArray) -> Estimate | None:
    """Return the mean with Student's interval; None with fewer than two values."""
    from scipy.stats import t

    numbers = np.asarray(values, dtype=np.float64)
    n = numbers.size
    if n < 2:
        return None
    half = float(t.ppf(0.5 + _LEVEL / 2.0, n - 1) * numbers.std(ddof=1) / math.sqrt(n))
    mean = float(numbers.mean())
    return Estimate(mean, mean - half, mean + half, n)


def deviation_of(values: Sequence[float] | FloatArray) -> Estimate | None:
    """Return the standard deviation with the interval for normal values; None with fewer than two values."""
    from scipy.stats import chi2

    numbers = np.asarray(values, dtype=np.float64)
    n = numbers.size
    if n < 2:
        return None
    deviation, tail = float(numbers.std(ddof=1)), (1.0 - _LEVEL) / 2.0
    low, high = (deviation * math.sqrt((n - 1) / chi2.ppf(share, n - 1)) for share in (1.0 - tail, tail))
    return Estimate(deviation, float(low), float(high), n)
