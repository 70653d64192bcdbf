"""Shares and scales: known values, robustness, and coverage of the intervals.

Evidence: samples of known distributions; the formulas written out.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from egvs.statistics.intervals import estimate_scale, estimate_share


def test_wilson_interval_by_hand() -> None:
    """8 of 10: centre (0.8 + z^2 / 20) / (1 + z^2 / 10) = 0.71675, half width 0.22658, with z = 1.95996."""
    estimate = estimate_share(np.array([1.0] * 8 + [0.0] * 2))
    assert estimate.value == 0.8
    assert (estimate.low, estimate.high) == (pytest.approx(0.49016, abs=1e-5), pytest.approx(0.94332, abs=1e-5))


def test_share_of_all() -> None:
    estimate = estimate_share(np.ones(200))
    assert (estimate.value, estimate.high) == (1.0, 1.0)
    assert 0.97 < estimate.low < 1.0


def test_correlated_losses_widen_interval() -> None:
    """Losses in patches of 50 pulses say as much as one loss each."""
    patches = np.random.default_rng(0).random(200) < 0.8
    alone = estimate_share(patches.astype(float))
    patched = estimate_share(np.repeat(patches, 50).astype(float))
    assert patched.value == alone.value
    assert patched.se == pytest.approx(alone.se, rel=0.3)


def test_inflation_of_neighbours_is_that_of_simulated_pulses() -> None:
    """Variance of the share among pulses between two returns: 1 + 2 p (1 - p) times the binomial one."""
    rng = np.random.default_rng(1)
    for kept in (0.6, 0.9):
        shares = []
        counts = []
        for _ in range(4000):
            hits = rng.random(402) < kept
            chosen = hits[:-2] & hits[2:]
            shares.append(hits[1:-1][chosen].mean())
            counts.append(chosen.sum())
        binomial = kept * (1 - kept) / np.mean(counts)
        assert np.mean(shares) == pytest.approx(kept, abs=0.004)
        assert np.var(shares) / binomial == pytest.approx(1 + 2 * kept * (1 - kept), rel=0.1)


def test_scale_ignores_edges() -> None:
    rng = np.random.default_rng(2)
    residual = 0.01 * rng.standard_normal(20_000)
    residual[::20] += rng.normal(0.0, 3.0, 1000)
    estimate = estimate_scale(residual, 1.0)
    assert estimate is not None
    assert estimate.value == pytest.approx(0.01, rel=0.02)


@pytest.mark.parametrize("sigma_m", [0.003, 0.006, 0.02])
def test_scale_of_rounded_ranges(sigma_m: float) -> None:
    """Ranges rounded to 5 mm; second differences have 6 times their variance."""
    rng = np.random.default_rng(3)
    ranges = np.round((10.0 + rng.random((20_000, 1)) + sigma_m * rng.standard_normal((20_000, 3))) / 0.005) * 0.005
    estimate = estimate_scale(ranges[:, 0] - 2 * ranges[:, 1] + ranges[:, 2], 6.0, 0.005)
    assert estimate is not None
    assert estimate.value == pytest.approx(sigma_m, rel=0.05)


def test_too_few_values_give_no_scale() -> None:
    assert estimate_scale(np.ones(99), 1.0) is None


def test_intervals_of_scale_contain_it() -> None:
    """91 to 99 % of 400 intervals, for residuals of overlapping second differences."""
    rng = np.random.default_rng(4)
    inside = 0
    for _ in range(400):
        ranges = 0.02 * rng.standard_normal(802)
        estimate = estimate_scale(ranges[:-2] - 2 * ranges[1:-1] + ranges[2:], 6.0)
        assert estimate is not None
        inside += estimate.low <= 0.02 <= estimate.high
    assert 0.91 <= inside / 400 <= 0.99


def test_standard_error_of_scale() -> None:
    """That of n independent normal values is sigma / sqrt(2 n); clipping at 3 loses a little."""
    estimate = estimate_scale(np.random.default_rng(5).standard_normal(40_000), 1.0)
    assert estimate is not None
    assert estimate.se == pytest.approx(1 / math.sqrt(80_000), rel=0.35)
