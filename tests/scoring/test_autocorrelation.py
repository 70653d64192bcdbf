"""Is the autocorrelation time estimated, and are standard errors inflated accordingly?

Evidence: processes whose autocorrelation time is known, a plain twin of the sums, and the scatter of many records."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.scoring.standard_errors import BlockGroups, ScoreUncertainty, summarise_uncertainty, uncertainty_warnings
from egvs.statistics import blocks as block_statistics
from egvs.statistics.blocks import GROUP_LENGTH_TIMES, MIN_GROUPS, group_sizes


def autoregressive_series(records: int, frames: int, keeps: float, seed: int) -> np.ndarray:
    """First-order autoregressive series (records, frames), started in their stationary state;
    tau = (1 + a) / (1 - a)."""
    rng = np.random.default_rng(seed)
    values = np.empty((records, frames))
    values[:, 0] = rng.normal(size=records)
    for frame in range(1, frames):
        values[:, frame] = keeps * values[:, frame - 1] + np.sqrt(1 - keeps**2) * rng.normal(size=records)
    return values


@pytest.mark.parametrize("keeps", [0.0, 0.5, 0.9])
def test_autocorrelation_time_of_autoregressive_series(keeps: float) -> None:
    found = [block_statistics.autocorrelation_time(series) for series in autoregressive_series(40, 4000, keeps, 1)]
    assert np.mean(found) == pytest.approx((1 + keeps) / (1 - keeps), rel=0.15)


def test_the_sums_by_hand() -> None:
    """Plain sums, lag by lag, of a short series."""
    series = np.array([3, 1, 4, 1, 5, 9, 2, 6, 5, 3, 5, 8, 9, 7, 9, 3, 2, 3, 8, 4])
    centred, total, largest = series - series.mean(), 1.0, 1.0
    for lag in range(1, len(series)):
        total += 2 * float(centred[lag:] @ centred[:-lag]) / float(centred @ centred)
        largest = max(largest, total)
        if lag >= 5 * largest:
            break
    assert block_statistics.autocorrelation_time(series) == pytest.approx(largest, abs=1e-3)


def test_a_periodic_signal_does_not_hide_the_correlation_over_full_cycles() -> None:
    """The plain sum of a swing of 80 frames cancels within half a cycle; the largest one does not."""
    slow = autoregressive_series(20, 4000, 0.9, 2)
    swinging = slow + 1.5 * np.sign(np.sin(2 * np.pi * np.arange(4000) / 80))
    assert np.mean([block_statistics.autocorrelation_time(series) for series in swinging]) >= 15


@pytest.mark.parametrize("series", [np.zeros(9), np.full(9, 3), np.array([5]), np.array([1, -1] * 20)])
def test_constant_and_alternating_series_have_no_autocorrelation(series: np.ndarray) -> None:
    assert block_statistics.autocorrelation_time(series) == 1.0


@given(st.floats(1, 500), st.integers(10, 100_000), st.integers(2, 10))
def test_errors_are_never_narrowed_and_long_records_are_left_alone(lasts: float, frames: int, groups: int) -> None:
    assert block_statistics.standard_error_inflation(lasts, frames, groups) >= 1.0
    assert block_statistics.standard_error_inflation(lasts, int(1000 * lasts * groups), groups) < 1.01


@pytest.mark.parametrize(("lasts", "frames", "groups"), [(50, 1000, 10), (50, 2000, 4), (200, 1000, 4), (5, 1000, 10)])
def test_inflation_equals_that_of_the_covariance(
    lasts: float, frames: int, groups: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a series that keeps a share of itself from frame to frame: the variance of its mean, and the scatter of the
    means of groups that is to be expected, entry by entry of the covariance matrix."""
    monkeypatch.setattr(block_statistics, "_time_upper_bound", lambda time_frames, frames: time_frames)
    at = np.arange(frames)
    covariance = ((lasts - 1.0) / (lasts + 1.0)) ** np.abs(at[:, None] - at[None, :])
    of_groups = covariance.reshape(groups, frames // groups, groups, frames // groups).mean(axis=(1, 3))
    scatter = (np.trace(of_groups) - of_groups.sum() / groups) / (groups - 1) / groups
    needed = math.sqrt(covariance.mean() / scatter)
    assert block_statistics.standard_error_inflation(lasts, frames, groups) == pytest.approx(needed, rel=1e-3)


def test_groups_are_longer_than_the_correlation_time_if_the_record_allows() -> None:
    assert group_sizes(10, 100, 5.0) == [1] * 10
    assert group_sizes(10, 100, 5.1) == [2] * 5
    assert group_sizes(10, 100, 1000.0) == [3, 3, 2, 2]
    assert group_sizes(50, 20, 5.0) == [5] * 10
    assert group_sizes(3, 20, 1000.0) == [1, 1, 1]
    for correlation_frames in (1.0, 12.0, 40.0):
        sizes = group_sizes(100, 25, correlation_frames)
        assert len(sizes) == MIN_GROUPS or min(sizes) * 25 >= GROUP_LENGTH_TIMES * correlation_frames


def estimates(series: np.ndarray, blocks: int) -> list[ScoreUncertainty]:
    """Of the means of records (records, frames), as the blocks of a TPOG would give them."""
    found = []
    for one in series:
        lasts = block_statistics.autocorrelation_time(one)
        frames = np.array(group_sizes(blocks, len(one) // blocks, lasts)) * (len(one) // blocks)
        sums = np.array([part.sum() for part in np.split(one, np.cumsum(frames)[:-1])])
        left_out = [(one.sum() - part) / (len(one) - n) for part, n in zip(sums, frames, strict=True)]
        found.append(ScoreUncertainty.of(np.array([[one.mean(), *left_out]]), (BlockGroups(frames, lasts),)))
    return found


@pytest.mark.parametrize("frames", [600, 1500])
def test_intervals_hold_where_groups_of_ten_would_not(frames: int) -> None:
    """A memory of 39 frames in a record of 15 or of 38 of them: ten groups would hold less than 0.85."""
    found = estimates(autoregressive_series(400, frames, 0.95, 3), 10)
    held = [one.intervals()[0, 0] <= 0 <= one.intervals()[0, 1] for one in found]
    assert 0.86 <= np.mean(held) <= 0.96
    assert all(one.strata[0].widening > 1 for one in found)


def test_a_short_record_is_warned_of_and_a_long_one_is_not() -> None:
    (short,) = estimates(autoregressive_series(1, 200, 0.95, 4), 10)
    (doubt,) = uncertainty_warnings(short, "scenario.toml: traffic.frames", 0.5)
    assert doubt.problem.startswith("200 frames (100 s) are few")
    assert "for autocorrelation" in doubt.problem
    assert doubt.hint.startswith("Record at least ")
    assert "for autocorrelation" in str(summarise_uncertainty(short)["standard_errors_from"])
    (long,) = estimates(autoregressive_series(1, 20_000, 0.95, 4), 10)
    assert uncertainty_warnings(long, "scenario.toml: traffic.frames", 0.5) == []


def test_of_a_mix_the_variances_and_biases_add_up() -> None:
    """Two records of their own: se^2 = se_1^2 + se_2^2, and t between the smaller and the sum of both freedoms."""
    rng = np.random.default_rng(5)
    one, other = (BlockGroups(np.full(k, 20), 0.0) for k in (5, 8))
    score = np.array([[10.0], [20.0]])
    left = [score + rng.normal(size=(2, k)) for k in (5, 8)]
    apart = [
        ScoreUncertainty.of(np.hstack([score, part]), (its,)) for part, its in zip(left, (one, other), strict=True)
    ]
    mix = ScoreUncertainty.of(np.hstack([score, *left]), (one, other))
    assert mix.se**2 == pytest.approx(apart[0].se ** 2 + apart[1].se ** 2)
    assert mix.bias == pytest.approx(apart[0].bias + apart[1].bias)
    assert 4 <= mix.freedom <= 4 + 7
    assert (apart[0].freedom, apart[1].freedom, mix.groups) == (4, 7, 13)
