"""The estimate of the time that is left, from simulated times."""

from __future__ import annotations

import random

import pytest

from egvs.extensions.validation.remaining_time import RemainingTime


def estimates(seconds: list[float], workers: int) -> list[tuple[float, float]]:
    """Return each estimate and the time that was truly left, for units that free workers take in turn."""
    remaining = RemainingTime(["unit"] * len(seconds), workers)
    free_at = [0.0] * workers
    ends = []
    for unit_s in seconds:
        worker = min(range(workers), key=free_at.__getitem__)
        free_at[worker] += unit_s
        ends.append((free_at[worker], unit_s))
    ends.sort()
    pairs = []
    for end_s, unit_s in ends:
        remaining.unit_done("unit", unit_s)
        if remaining.seconds is not None:
            pairs.append((remaining.seconds, ends[-1][0] - end_s))
    return pairs


def test_equal_units_are_estimated_exactly_by_one_worker() -> None:
    pairs = estimates([20.0] + [3.0] * 9, 1)  # the first one also compiles
    assert len(pairs) == 6
    for estimated_s, true_s in pairs:
        assert estimated_s == pytest.approx(true_s)


@pytest.mark.parametrize("workers", [1, 2, 4, 8])
@pytest.mark.parametrize("seed", range(5))
def test_estimates_are_right_within_a_factor_of_two(workers: int, seed: int) -> None:
    rng = random.Random(seed)
    seconds = [30.0] * workers + [rng.uniform(2.0, 3.8) for _ in range(5 * workers)]
    pairs = estimates(seconds, workers)
    assert pairs
    for estimated_s, true_s in pairs:
        assert 0.5 * true_s <= estimated_s <= 2.0 * true_s


def test_no_estimate_before_units_were_measured() -> None:
    remaining = RemainingTime(["unit"] * 9, 2)
    for _ in range(3):
        assert remaining.seconds is None
        remaining.unit_done("unit", 1.0)
    assert remaining.seconds is None  # the first two compiled, and one unit is no sample
    remaining.unit_done("unit", 1.0)
    assert remaining.seconds == pytest.approx((5 - 0.5) / 2)


def test_no_estimate_while_units_differ_by_more_than_two() -> None:
    remaining = RemainingTime(["unit"] * 9, 1)
    for seconds in (9.0, 1.0, 2.1):
        remaining.unit_done("unit", seconds)
    assert remaining.seconds is None


def test_no_estimate_while_a_kind_of_unit_was_not_measured() -> None:
    remaining = RemainingTime(["short"] * 5 + ["long"] * 5, 1)
    for _ in range(5):
        remaining.unit_done("short", 1.0)
    assert remaining.seconds is None
    for _ in range(2):
        remaining.unit_done("long", 4.0)
    assert remaining.seconds == pytest.approx(12.0)


def test_no_estimate_when_all_units_are_running() -> None:
    remaining = RemainingTime(["unit"] * 6, 2)
    for _ in range(4):
        remaining.unit_done("unit", 1.0)
    assert remaining.seconds is None
