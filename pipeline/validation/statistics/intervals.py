r"""Makes intervals of 95 % from resamples, corrected for bias.

BC (Efron, Canadian Journal of Statistics 9, 1981; Efron and Tibshirani, "An Introduction to the Bootstrap", 1993,
section 14.3, with the acceleration left at 0). With G the distribution of the resampled values, :math:`\hat\theta` the
value itself and :math:`\Phi` the normal distribution,

.. math:: z_0 = \Phi^{-1}(G(\hat\theta)), \qquad
          [\,G^{-1}(\Phi(2 z_0 - 1.96)),\; G^{-1}(\Phi(2 z_0 + 1.96))\,]

Values that equal :math:`\hat\theta` count half in G.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

LEVEL = 0.95
"""Confidence of intervals."""

UNDEFINED = 0.05
"""Share of resamples that may be undefined: those that hold one value alone."""

_EQUAL = 1e-12


@dataclass(frozen=True)
class Interval:
    """Where a value may lie.

    Attributes
    ----------
    low, high
        NaN where resampling cannot tell.
    why
        Why it cannot; empty where it can.
    """

    low: float
    high: float
    why: str = ""

    @classmethod
    def unknown(cls, why: str) -> Interval:
        """It cannot be told."""
        return cls(math.nan, math.nan, why)

    @classmethod
    def of(cls, value: float, draws: NDArray[np.float64]) -> Interval:
        """From the value and what it was in each resample, NaN where it was undefined."""
        known = draws[~np.isnan(draws)]
        if len(known) < (1.0 - UNDEFINED) * len(draws):
            share = 1.0 - len(known) / len(draws)
            return cls.unknown(f"{share:.0%} of the resamples have equal values only")
        if np.ptp(known) <= _EQUAL:
            return cls.unknown("all resamples agree to the last digit, which says nothing of other sites")
        below = np.count_nonzero(known < value - _EQUAL) + 0.5 * np.count_nonzero(np.abs(known - value) <= _EQUAL)
        half = 0.5 / len(known)
        z0, reach = ndtri(np.clip(below / len(known), half, 1.0 - half)), ndtri(0.5 + 0.5 * LEVEL)
        low, high = np.quantile(known, [ndtr(2.0 * z0 - reach), ndtr(2.0 * z0 + reach)])
        return cls(float(low), float(high))


def share_above(draws: NDArray[np.float64]) -> float:
    """Share of resamples in which a difference is above 0; ties count half, undefined ones are left out."""
    known = draws[~np.isnan(draws)]
    if not len(known):
        return math.nan
    ties = np.count_nonzero(np.abs(known) <= _EQUAL)
    return float((np.count_nonzero(known > _EQUAL) + 0.5 * ties) / len(known))
