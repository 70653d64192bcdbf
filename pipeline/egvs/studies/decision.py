r"""What a choice of a pole is worth: the probability that it is the best one, and its expected loss.

The traffic of a study comes in k independent *units*: runs of SUMO with other seeds, or parts of a recording. From unit
e, mount i is expected to find the share :math:`Y_e(i)` of the vehicles. A *draw* is traffic of one or a few units, as
much as a setting has; by the scores of that setting it chooses mount c.

*Loss.* All traffic except unit e chooses the reference :math:`b_e`; unit e, which had no part in either choice, judges:

.. math:: b_e = \arg\max_i \sum_{k \ne e} Y_k(i), \qquad
          loss = \operatorname{mean}_{e \notin draw} \; Y_e(b_e) - Y_e(c)

This is leave-one-out cross-validation (Stone, J. R. Stat. Soc. B 36, 1974). The maximum of noisy values is biased
upwards, but the noise of unit e is independent of both choices: between two equal poles the mean loss is 0. A loss may
be negative by chance; the mean over the draws counts as 0 then. It is the loss against the best mount that the other
units can identify, and the mount counts, not the pole alone: a wrong height on the right pole costs something.

*Probability.* Given the units R outside the draw, the true shares have a multivariate t distribution with k - 1 degrees
of freedom around their means over R, with the covariance of the units (Gelman et al., Bayesian Data Analysis, 2013,
section 3.6, with a flat prior). The probability that pole q has the best mount is its share of :data:`SAMPLES` samples
of that distribution, and the probability of a draw is that of the pole of its choice. It is one half for two equal
poles, and it includes that the study itself may not know the best pole.

*Model.* A draw needs units that judge it, and a handful of draws that all choose the same pole do not prove that the
next one would. So choices are also sampled: with judge e, the scores of traffic of length L (in units) are the means
over the other units plus normal noise with their covariance divided by L. The model alone prices traffic of more than
(k - 2) / 2 of the k units (:func:`assess_by_model`); otherwise it counts as one further draw, which matters among few
draws. Its probability is of the poles given the units that it samples around, so it is too high among nearly equal
poles.

Probability and loss are means over draws. The squared standard error of the loss is the variance of its mean over the
judging units, plus that over the units that draw; that of the probability the latter. Mounts with equal scores share a
choice.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from egvs.core.grid import FloatArray, IntArray

MIN_UNITS = 4
"""Number of units that a study needs: one draws, the others judge, and one of these can be left out."""

SAMPLES = 2000
"""Number of samples of the true shares, and of choices by the model."""

MAX_LENGTHENING = 2.0**12
"""Longest traffic that is considered, in units."""

_SAMPLE_SEED = 0x0DEC151
"""Seed of the samples: a constant, so that equal inputs give equal results."""

_TIE = 1e-9
"""Scores whose relative difference is smaller are equal."""


class Draw(NamedTuple):
    """Traffic of one setting, and what it makes of the mounts.

    Attributes
    ----------
    units
        Indices of the units that the traffic is from.
    scores
        Score that ranks of each mount, (n,) float64.
    """

    units: tuple[int, ...]
    scores: FloatArray


@dataclass(frozen=True, eq=False)
class Reference:
    """What mounts are worth.

    Attributes
    ----------
    found
        Share of the vehicles that each mount is expected to find, from each unit, (k, n) float64, 0 to 1.
    poles
        Pole of each mount, (n,) int64, from 0.
    """

    found: FloatArray
    poles: IntArray

    @property
    def units(self) -> int:
        """Number of units."""
        return len(self.found)


@dataclass(frozen=True)
class DecisionQuality:
    """What the choices of a setting are worth.

    Attributes
    ----------
    probability, probability_se
        Probability that the chosen pole is the best one, 0 to 1, and its standard error; NaN by the model.
    loss_points, loss_se_points
        Expected loss in percentage points of vehicles found, 0 or above, and its standard error.
    draws
        Number of draws; 0 where the model alone counts.
    """

    probability: float
    probability_se: float
    loss_points: float
    loss_se_points: float
    draws: int


def choose(scores: FloatArray) -> FloatArray:
    """Return the share of the choice that each mount gets, (n,) float64: 1 for the best, in equal parts if several.

    Parameters
    ----------
    scores
        Scores of the mounts, (n,), or of several draws, (m, n).

    Examples
    --------
    >>> choose(np.array([0.2, 0.5, 0.5])).tolist()
    [0.0, 0.5, 0.5]
    """
    highest = scores.max(axis=-1, keepdims=True)
    is_best = scores >= highest - _TIE * np.abs(highest)
    shares: FloatArray = is_best / is_best.sum(axis=-1, keepdims=True)
    return shares


def assess_choices(
    draws: Sequence[Draw], scores: FloatArray, reference: Reference, length_units: float
) -> DecisionQuality:
    """Return what the choices of some draws are worth, by the units outside each draw.

    Parameters
    ----------
    draws
        Draws of one setting, each with at least two units outside.
    scores
        Score that ranks of each mount, from each unit, (k, n) float64, for the model.
    reference
        What mounts are worth, from all units.
    length_units
        Length of the draws, in units.
    """
    choices_of: dict[tuple[int, ...], list[FloatArray]] = {}
    for draw in draws:
        choices_of.setdefault(draw.units, []).append(choose(draw.scores))

    best = [choose(np.delete(reference.found, judge, axis=0).mean(axis=0)) for judge in range(reference.units)]
    chances = np.empty(len(choices_of) + 1)
    losses = np.full((len(choices_of) + 1, reference.units), math.nan)
    weights = np.empty(len(choices_of) + 1)
    for row, (units, choices) in enumerate(choices_of.items()):
        chosen = np.mean(choices, axis=0)
        outside = [unit for unit in range(reference.units) if unit not in units]
        chances[row] = _by_pole(chosen, reference.poles) @ best_pole_chances(reference, outside)
        for judge in outside:
            losses[row, judge] = (best[judge] - chosen) @ reference.found[judge]
        weights[row] = len(choices)
    chances[-1], losses[-1] = _model(scores, reference, length_units)
    weights[-1] = 1.0

    by_draw = np.nanmean(losses, axis=1)
    by_judge = np.array([_weighted_mean(column, weights) for column in losses.T])
    loss_se = math.hypot(_standard_error(by_judge), _standard_error(by_draw))
    probability = _weighted_mean(chances, weights)
    return _quality(probability, _standard_error(chances), _weighted_mean(by_draw, weights), loss_se, len(draws))


def assess_by_model(scores: FloatArray, reference: Reference, length_units: float) -> DecisionQuality:
    """Return what choices from long traffic would be worth, by the model.

    Parameters
    ----------
    scores
        Score that ranks of each mount, from each unit, (k, n) float64.
    reference
        What mounts are worth, from these units and perhaps more.
    length_units
        Length of the traffic, in units.
    """
    probability, loss_by_judge = _model(scores, reference, length_units)
    return _quality(probability, math.nan, float(loss_by_judge.mean()), _standard_error(loss_by_judge), 0)


def length_needed(scores: FloatArray, reference: Reference, tolerance_points: float) -> float:
    """Return the length of traffic, in units, from which the expected loss is within a tolerance by the model.

    Infinite if even :data:`MAX_LENGTHENING` units are not enough. Lengths are powers of two.

    Parameters
    ----------
    scores, reference
        As in :func:`assess_by_model`.
    tolerance_points
        Percentage points of vehicles found.
    """
    length = 1.0
    while length <= MAX_LENGTHENING:
        if assess_by_model(scores, reference, length).loss_points <= tolerance_points:
            return length
        length *= 2.0
    return math.inf


def _model(scores: FloatArray, reference: Reference, length_units: float) -> tuple[float, FloatArray]:
    """Return the probability of choices by the model, and their loss as each unit judges it, (units,)."""
    chances, losses = np.empty(reference.units), np.empty(reference.units)
    for judge in range(reference.units):
        found = np.delete(reference.found, judge, axis=0).mean(axis=0)
        others = np.delete(scores, judge, axis=0) if judge < len(scores) else scores
        choices = choose(_samples_of_means(others, length_units)).mean(axis=0)
        losses[judge] = (choose(found) - choices) @ reference.found[judge]
        outside = [unit for unit in range(reference.units) if unit != judge]
        chances[judge] = _by_pole(choices, reference.poles) @ best_pole_chances(reference, outside)
    return float(chances.mean()), losses


def _quality(probability: float, probability_se: float, loss: float, loss_se: float, draws: int) -> DecisionQuality:
    return DecisionQuality(
        probability=round(probability, 4),
        probability_se=round(probability_se, 4),
        loss_points=round(max(0.0, 100.0 * loss), 4),
        loss_se_points=round(100.0 * loss_se, 4),
        draws=draws,
    )


def _weighted_mean(values: FloatArray, weights: FloatArray) -> float:
    """Return the mean of the values that are not NaN."""
    known = ~np.isnan(values)
    return float((values[known] * weights[known]).sum() / weights[known].sum())


def _standard_error(values: FloatArray) -> float:
    """Return the standard error of the mean of independent values; 0 for a single one."""
    if len(values) < 2:
        return 0.0
    return float(values.std(ddof=1)) / math.sqrt(len(values))


def best_pole_chances(reference: Reference, units: Sequence[int]) -> FloatArray:
    """Return the probability of each pole to have the best mount, given some units, (poles,) float64.

    Parameters
    ----------
    reference
        What mounts are worth.
    units
        Indices of the units that are known.
    """
    mean = reference.found[list(units)].mean(axis=0)
    noise = _unit_noise(reference.found, heavy_tails=True) / math.sqrt(len(units))
    return _by_pole(choose(mean + noise).mean(axis=0), reference.poles)


def _samples_of_means(scores: FloatArray, length_units: float) -> FloatArray:
    """Return samples of the scores from traffic of some length, (samples, n) float64."""
    samples: FloatArray = scores.mean(axis=0) + _unit_noise(scores, heavy_tails=False) / math.sqrt(length_units)
    return samples


def _unit_noise(values: FloatArray, *, heavy_tails: bool) -> FloatArray:
    """Return samples of noise with the covariance of the units (k, n), (samples, n) float64.

    With heavy tails it has the multivariate t distribution of k - 1 degrees of freedom.
    """
    freedom = len(values) - 1
    random = np.random.default_rng(_SAMPLE_SEED)
    normal = random.standard_normal((SAMPLES, len(values)))
    if heavy_tails:
        normal *= np.sqrt(freedom / random.chisquare(freedom, (SAMPLES, 1)))
    deviations = (values - values.mean(axis=0)) / math.sqrt(freedom)
    noise = np.zeros((SAMPLES, values.shape[1]))
    for unit in range(len(values)):  # no matrix product: a BLAS may add in another order on another machine
        noise += normal[:, unit, None] * deviations[unit]
    return noise


def _by_pole(shares: FloatArray, poles: IntArray) -> FloatArray:
    """Return shares of mounts (n,) summed over the mounts of each pole, (poles,)."""
    return np.bincount(poles, weights=shares).astype(np.float64)
