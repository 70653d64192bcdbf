"""Correlation coefficients against scipy, a slow reference, and cases calculated by hand."""

import itertools
import math

import numpy as np
import pytest
import scipy.stats

from egvs.statistics.ranks import COEFFICIENT_KINDS, StandardisedValues

OTHER = {
    "pearson": lambda a, b: scipy.stats.pearsonr(a, b).statistic,
    "spearman": lambda a, b: scipy.stats.spearmanr(a, b).statistic,
    "kendall": lambda a, b: scipy.stats.kendalltau(a, b, variant="b").statistic,
}


def coefficient(a, b, kind):
    return StandardisedValues.from_values(np.atleast_2d(np.asarray(a, float)), kind).correlate(
        StandardisedValues.from_values(np.atleast_2d(np.asarray(b, float)), kind)
    )


# a 1 2 2 3, b 1 3 2 4. Means 2 and 2.5; products 1.5 + 0 + 0 + 1.5 = 3; squares 2 and 5: r = 3 / sqrt 10.
# Ranks 1 2.5 2.5 4 and 1 3 2 4: products 2.25 + 0 + 0 + 2.25 = 4.5; squares 4.5 and 5: rho = 4.5 / sqrt 22.5.
# Six pairs: (2, 3) ties in a, the other five agree: tau-b = 5 / sqrt(5 * 6).
@pytest.mark.parametrize(
    ("kind", "value"), [("pearson", 3 / 10**0.5), ("spearman", 4.5 / 22.5**0.5), ("kendall", 5 / 30**0.5)]
)
def test_by_hand(kind, value):
    assert coefficient([1, 2, 2, 3], [1, 3, 2, 4], kind)[0] == pytest.approx(value, abs=1e-15)


@pytest.mark.parametrize("kind", COEFFICIENT_KINDS)
def test_coefficients_equal_scipy_for_every_resample(kind):
    rng = np.random.default_rng(4)
    a, b = rng.integers(0, 9, (200, 13)).astype(float), rng.normal(size=(200, 13)).round(1)
    expected = [OTHER[kind](*rows) for rows in zip(a, b, strict=True)]
    np.testing.assert_allclose(coefficient(a, b, kind), expected, atol=1e-12)


def test_kendall_equals_sum_over_pairs():
    rng = np.random.default_rng(8)
    a, b = rng.integers(0, 6, 15), rng.integers(0, 6, 15)
    signs = [(np.sign(a[i] - a[j]), np.sign(b[i] - b[j])) for i, j in itertools.combinations(range(15), 2)]
    expected = sum(x * y for x, y in signs) / math.sqrt(sum(x != 0 for x, _ in signs) * sum(y != 0 for _, y in signs))
    assert coefficient(a, b, "kendall")[0] == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize("kind", COEFFICIENT_KINDS)
def test_limits_and_undefined_coefficients(kind):
    up = np.array([0.1, 0.2, 0.7, 3.0])
    assert coefficient(up, 5 * up - 3, kind)[0] == pytest.approx(1, abs=1e-15)
    assert coefficient(up, -up, kind)[0] == pytest.approx(-1, abs=1e-15)
    assert math.isnan(coefficient(up, [0.1 + 0.2, 0.3, 0.3, 0.3], kind)[0])  # the same but for the last digit
    assert math.isnan(coefficient(up, [0, 0, 0, 0], kind)[0])
    assert math.isnan(coefficient([1, 2], [1, 2], kind)[0])  # two always agree


@pytest.mark.parametrize("kind", COEFFICIENT_KINDS)
def test_coefficient_is_symmetric_and_independent_of_site_order(kind):
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(2, 12))
    row = rng.permutation(12)
    value = coefficient(a, b, kind)[0]
    assert coefficient(b, a, kind)[0] == pytest.approx(value, abs=1e-15)
    assert coefficient(a[row], b[row], kind)[0] == pytest.approx(value, abs=1e-14)
