"""Probability and loss of choices, on mounts with a known answer."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.studies.decision import (
    DecisionQuality,
    Draw,
    Reference,
    assess_by_model,
    assess_choices,
    choose,
    length_needed,
)


def units_of(*means: float, noise: float, units: int = 6, seed: int = 1) -> np.ndarray:
    """Shares of vehicles found at some poles from independent units of traffic, which all poles share in part."""
    random = np.random.default_rng(seed)
    common = random.normal(0.0, 0.05, (units, 1))
    return np.array(means) + common + random.normal(0.0, noise, (units, len(means)))


def assess(scores: np.ndarray, found: np.ndarray, poles: np.ndarray | None = None) -> DecisionQuality:
    """Assess the choices of each unit by its scores."""
    draws = [Draw((unit,), row) for unit, row in enumerate(scores)]
    reference = reference_of(found) if poles is None else Reference(found, poles)
    return assess_choices(draws, scores, reference, 1.0)


def reference_of(found: np.ndarray) -> Reference:
    return Reference(found, np.arange(found.shape[1]))


@pytest.mark.slow
def test_two_equal_poles_are_a_coin_toss_and_cost_nothing() -> None:
    """Over many studies: the choice of the maximum of noisy values is not taken for a gain, nor for a loss."""
    chances, losses, unclipped = [], [], []
    for seed in range(60):
        found = units_of(0.6, 0.6, noise=0.02, seed=seed)
        quality = assess(found, found)
        chances.append(quality.probability)
        losses.append(quality.loss_points)
        unclipped.append(quality.loss_points > 0.0)
    assert np.mean(chances) == pytest.approx(0.5, abs=0.08)  # the model uses units twice, and is a little optimistic
    assert np.mean(losses) < 0.5  # the scatter between the two is 2.8 points in each unit
    assert 0.2 < np.mean(unclipped) < 0.8  # as many losses below 0, which count as 0, as above


def test_identical_poles_have_half_the_probability_and_no_loss() -> None:
    found = np.repeat(units_of(0.6, noise=0.02), 2, axis=1)
    quality = assess(found, found)
    assert (quality.probability, quality.loss_points) == (0.5, 0.0)
    assert assess_by_model(found, reference_of(found), 8.0).probability == 0.5


def test_pole_that_is_ten_percent_better_is_found_for_certain() -> None:
    found = units_of(0.66, 0.60, noise=0.005)
    quality = assess(found, found)
    assert quality.probability > 0.98
    assert quality.loss_points == 0.0


def test_loss_of_a_score_that_prefers_the_wrong_pole_is_the_difference() -> None:
    found = units_of(0.66, 0.60, noise=0.001)
    quality = assess(found[:, ::-1], found)
    assert quality.probability < 0.02
    assert quality.loss_points == pytest.approx(6.0, abs=0.2)
    assert length_needed(found[:, ::-1], reference_of(found), 1.0) == math.inf


def test_loss_by_hand() -> None:
    """Mount 1 is chosen; units 1 to 3 judge the draw of unit 0, all units judge the model."""
    found = np.array([[0.50, 0.60], [0.70, 0.60], [0.80, 0.60], [0.66, 0.60]])
    scores = np.tile([0.0, 1.0], (4, 1))
    quality = assess_choices([Draw((0,), scores[0])], scores, reference_of(found), 1.0)
    assert quality.draws == 1
    assert quality.loss_points == pytest.approx(
        100 * np.mean([np.mean([0.1, 0.2, 0.06]), np.mean([-0.1, 0.1, 0.2, 0.06])])
    )


def test_few_equal_choices_are_not_taken_for_certainty() -> None:
    """Four draws choose the better pole, but their scatter says that the next one may not."""
    found = np.array([[0.61, 0.60], [0.70, 0.60], [0.62, 0.60], [0.68, 0.60]])
    quality = assess(found, found)
    assert quality.probability < 1.0
    assert quality.loss_points > 0.0
    assert quality.loss_se_points > 0.0


def test_wrong_mount_on_the_best_pole_costs_its_difference() -> None:
    found = units_of(0.66, 0.60, 0.50, noise=0.001)
    quality = assess(np.tile([0.0, 1.0, 0.0], (len(found), 1)), found, np.array([0, 0, 1]))
    assert quality.probability == 1.0
    assert quality.loss_points == pytest.approx(6.0, abs=0.2)


@pytest.mark.slow
def test_standard_errors_are_the_scatter_between_studies() -> None:
    losses, errors = [], []
    for seed in range(150):
        found = units_of(0.63, 0.60, noise=0.03, units=8, seed=seed)
        quality = assess(found, found)
        losses.append(quality.loss_points)
        errors.append(quality.loss_se_points)
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) / np.std(losses) < 2.0


@pytest.mark.slow
def test_model_agrees_with_draws_of_the_same_length() -> None:
    counted, modelled = [], []
    for seed in range(40):
        found = units_of(0.62, 0.60, noise=0.02, units=8, seed=seed)
        counted.append(assess(found, found).loss_points)
        modelled.append(assess_by_model(found, reference_of(found), 1.0).loss_points)
    assert np.mean(modelled) == pytest.approx(np.mean(counted), abs=0.15)


@pytest.mark.slow
def test_traffic_that_is_needed_follows_from_the_normal_distribution() -> None:
    """With L units, the better of two poles is missed with probability Phi(-d sqrt(L) / s), where d is the mean
    difference in the units that do not judge, and s its scatter; what that loses is the difference in the judging one.
    """
    differences = 0.02 + np.random.default_rng(3).normal(0.0, 0.06, 24)
    found = 0.6 + np.column_stack([differences, np.zeros(24)])
    reference = reference_of(found)

    def loss_points(length: float) -> float:
        losses = []
        for judge, difference in enumerate(differences):
            others = np.delete(differences, judge)
            assert others.mean() > 0.0
            missed = NormalDist().cdf(-others.mean() * math.sqrt(length) / others.std(ddof=1))
            losses.append(100 * difference * missed)
        return float(np.mean(losses))

    for length in (1.0, 4.0, 16.0):
        assert assess_by_model(found, reference, length).loss_points == pytest.approx(loss_points(length), abs=0.06)
    for length in (8.0, 16.0):  # a tolerance between the losses of this length and of half of it
        tolerance = (loss_points(length) + loss_points(length / 2)) / 2
        assert length_needed(found, reference, tolerance) == length


@given(st.lists(st.integers(0, 5), min_size=1, max_size=6))
def test_choice_is_shared_by_the_best_mounts(scores: list[int]) -> None:
    expected = [(score == max(scores)) / scores.count(max(scores)) for score in scores]
    assert choose(np.array(scores) / 7).tolist() == pytest.approx(expected)
    assert choose(np.array([scores, scores[::-1]]) / 7)[1].tolist() == pytest.approx(expected[::-1])


def test_single_mount_is_the_best_one() -> None:
    found = units_of(0.6, noise=0.02)
    quality = assess(found, found)
    assert (quality.probability, quality.loss_points, quality.loss_se_points) == (1.0, 0.0, 0.0)
