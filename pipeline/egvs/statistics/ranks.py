"""Compare scores and rankings: relative errors, agreement, and regret."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray


def relative_errors(scores: NDArray[np.float64], reference: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return abs(score / reference - 1) of each site; infinite if only the reference is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        change: NDArray[np.float64] = np.where(scores == reference, 0.0, np.abs(scores / reference - 1.0))
    return change


def rank_agreement(scores: NDArray[np.float64], reference: NDArray[np.float64], kind: Literal["tau", "rho"]) -> float:
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


def best_sites(scores: NDArray[np.float64], count: int) -> set[int]:
    """Return the indices of the ``count`` best sites, and of all that tie with the last of them."""
    if not len(scores):
        return set()
    last = np.sort(scores)[::-1][min(count, len(scores)) - 1]
    return set(np.flatnonzero(scores >= last).tolist())


def regret(scores: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
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
