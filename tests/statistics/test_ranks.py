"""Errors and rankings with ties."""

from __future__ import annotations

import numpy as np
import pytest

from egvs.statistics import ranks


def test_rank_agreement_best_sites_and_regret_with_ties() -> None:
    a, b = np.array([3.0, 3.0, 1.0, 2.0]), np.array([4.0, 3.0, 1.0, 2.0])
    pairs = [(i, j) for i in range(4) for j in range(i)]
    signs = [(np.sign(a[i] - a[j]), np.sign(b[i] - b[j])) for i, j in pairs]
    agree = sum(x * y for x, y in signs) / np.sqrt(sum(x != 0 for x, _ in signs) * sum(y != 0 for _, y in signs))
    assert ranks.rank_agreement(a, b, "tau") == pytest.approx(agree)
    assert ranks.rank_agreement(np.ones(3), np.ones(3), "rho") == 1.0
    assert ranks.rank_agreement(np.ones(4), b, "tau") == 0.0
    assert ranks.best_sites(a, 1) == {0, 1}
    assert ranks.best_sites(b, 3) == {0, 1, 3}
    assert ranks.regret(a, b) == pytest.approx(0.25)  # of two that tie, the worse
    assert ranks.regret(b, a) == 0.0
    assert ranks.relative_errors(np.array([0.0, 1.0]), np.array([0.0, 0.0])).tolist() == [0.0, np.inf]
