"""Compare scores and rankings: relative errors, correlation, agreement, and regret."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from egvs.core.grid import FloatArray, IntArray

CoefficientKind = Literal["pearson", "spearman", "kendall"]

COEFFICIENT_KINDS: tuple[CoefficientKind, ...] = ("pearson", "spearman", "kendall")

MIN_VALUES = 3
"""Values that a coefficient needs: the correlation of two is always perfect."""

EQUALITY_TOLERANCE = 1e-12
"""Values are equal if they differ by less than this share of the largest."""


def relative_errors(scores: FloatArray, reference: FloatArray) -> FloatArray:
    """Return abs(score / reference - 1) of each site; infinite if only the reference is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        change: FloatArray = np.where(scores == reference, 0.0, np.abs(scores / reference - 1.0))
    return change


def rank_agreement(scores: FloatArray, reference: FloatArray, kind: Literal["tau", "rho"]) -> float:
    """Return the correlation of two rankings.

    Parameters
    ----------
    scores, reference
        Scores of the same sites, (n,).
    kind
        ``"tau"`` for Kendall's tau-b, ``"rho"`` for Spearman's rho with shared ranks for ties.

    Returns
    -------
    float
        1 if all sites are equal in both, 0 if they are equal in one of them.
    """
    from scipy.stats import kendalltau, spearmanr

    is_constant = [len(np.unique(values)) < 2 for values in (scores, reference)]
    if any(is_constant):
        return float(all(is_constant))
    if kind == "tau":
        return float(kendalltau(scores, reference).statistic)
    return float(spearmanr(scores, reference).statistic)


def best_sites(scores: FloatArray, count: int) -> set[int]:
    """Return the indices of the ``count`` best sites, and of all that tie with the last of them."""
    if not len(scores):
        return set()
    last = np.sort(scores)[::-1][min(count, len(scores)) - 1]
    return set(np.flatnonzero(scores >= last).tolist())


def regret(scores: FloatArray, reference: FloatArray) -> float:
    """Return the share of the best reference score that is lost at the best site by ``scores`` (the worst if several).

    Parameters
    ----------
    scores, reference
        Scores of the same sites, (n,).
    """
    highest = reference.max(initial=0.0)
    if highest <= 0:
        return 0.0
    return float(1.0 - min(reference[site] for site in best_sites(scores, 1)) / highest)


def rank_order(scores: FloatArray) -> IntArray:
    """Return sites by score, best first; equal scores in the order of the sites."""
    return np.argsort(-scores, kind="stable")


@dataclass(frozen=True)
class StandardisedValues:
    r"""Lists of values, prepared for one kind of coefficient; one list per resample.

    A coefficient is the cosine of two vectors, one per list of values,

    .. math:: c = \frac{\sum_k a_k b_k}{\sqrt{\sum_k a_k^2} \sqrt{\sum_k b_k^2}}

    - Pearson: a are the values minus their mean.
    - Spearman: a are the ranks minus their mean; equal values share the mean of their ranks.
    - Kendall: a are the signs of the differences of all pairs; a pair of equal values has 0 (tau-b: Kendall, Biometrika
      33, 1945).

    So each list is standardised once, whatever it is compared with. The coefficient is undefined (NaN) for fewer than
    three values, and where all values of a list are equal.

    Attributes
    ----------
    vector
        (resamples, d): float64, or int8 for the signs of Kendall.
    norm
        Length of each vector, (resamples,) float64; NaN where all values are equal.
    """

    vector: NDArray[Any]
    norm: FloatArray

    @classmethod
    def from_values(cls, values: FloatArray, kind: CoefficientKind) -> StandardisedValues:
        """Standardise values, shape (resamples, n), float64."""
        from scipy.stats import rankdata

        if kind == "kendall":
            first, second = np.triu_indices(values.shape[1], 1)
            a = values[:, first]
            b = values[:, second]
            vector: NDArray[Any] = (a > b).astype(np.int8) - (a < b).astype(np.int8)
            norm = np.sqrt(np.count_nonzero(vector, axis=1))
        else:
            vector = rankdata(values, axis=1) if kind == "spearman" else values
            vector = vector - vector.mean(axis=1, keepdims=True)
            norm = np.sqrt((vector**2).sum(axis=1))
        differ = np.ptp(values, axis=1) > EQUALITY_TOLERANCE * np.abs(values).max(axis=1, initial=0.0)
        return cls(vector, np.where(differ & (values.shape[1] >= MIN_VALUES), norm, np.nan))

    def correlate(self, other: StandardisedValues) -> FloatArray:
        """Return the coefficient with other values of the same kind, (resamples,) float64, from -1 to 1."""
        if self.vector.dtype == np.int8:
            product = (self.vector * other.vector).sum(axis=1, dtype=np.int32).astype(np.float64)
        else:
            product = np.einsum("ij,ij->i", self.vector, other.vector)
        coefficient: FloatArray = np.clip(product / self.norm / other.norm, -1.0, 1.0)
        return coefficient
