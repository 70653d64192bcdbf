r"""Statistics of the study: rho, rho in groups, regret, the first three, reliability; with intervals.

**Rho** is Spearman's coefficient of a score with AP over candidates. *Within groups* (one height, or one sensor) it is
the mean over the groups, weighted by their candidates, so that neither height nor sensor can explain it. **Regret** is
the AP lost by taking the candidate with the highest score instead of the best one, in points of 100. Of several
candidates with the highest score, the mean counts. **In the first three**: the probability that the candidate with the
highest AP has one of the three highest scores; ties are broken at random.

**Reliability** is the rho between the AP of two halves of the frames, r, corrected to the full number of frames by
Spearman and Brown (both in British Journal of Psychology 3, 1910):

.. math:: R = \frac{2 r}{1 + r}

The **ceiling** is what a score could reach that knew the true AP: the correlation of a true with a measured value,
:math:`\sqrt{R}` (Spearman 1904).

**Intervals** of one junction resample candidates and blocks of frames together, as :mod:`egvs.validation.correlation`
does. Groups of fewer than five candidates resample blocks of frames only. Over several junctions, the junctions are
resampled too: each resample draws as many junctions as there are, and adds to the value of each one that is drawn how
far one of its resamples is from their median. (A resample has the noise of the frames twice, so its rho is too low on
average; taken as they are, the resamples of several junctions would move the interval away from the value.) The noise
of candidates and frames is in the spread of the values of the junctions already, so it counts twice; in turn, the
spread of a few junctions is underestimated. Measured on synthetic studies of six junctions (in the tests): intervals of
95 % contain the truth in 99 of 100 studies where junctions are alike, and in 85 where they differ much.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from egvs.core.grid import FloatArray
from egvs.validation.correlation import (
    MIN_POLES,
    MIN_VALUES,
    ConfidenceInterval,
    MeasureValues,
    Resamples,
    StandardisedValues,
)

SEED, RESAMPLES = 3702, 2000

FIRST = 3
"""Number of the best candidates by score among which the best by AP should be."""

POINTS = 100.0

MIN_SITES_OF_A_SENSOR = 4

MIN_JUNCTIONS = 3
"""Junctions that an interval over junctions needs."""

Statistic = Callable[[FloatArray, FloatArray], FloatArray]
"""Of scores and AP, (resamples, n) each; returns (resamples,)."""


def rho(scores: FloatArray, ap: FloatArray) -> FloatArray:
    """Return Spearman's rho of each row, (rows,); NaN where all values of a row are equal."""
    standardised = (StandardisedValues.from_values(values, "spearman") for values in (scores, ap))
    first, second = standardised
    return first.correlate(second)


def regret(scores: FloatArray, ap: FloatArray) -> FloatArray:
    """Return the AP lost by taking the best candidate by score, in points of 100, (rows,)."""
    is_best = scores == scores.max(axis=1, keepdims=True)
    taken = (ap * is_best).sum(axis=1) / is_best.sum(axis=1)
    lost: FloatArray = POINTS * (ap.max(axis=1) - taken)
    return lost


def in_first(scores: FloatArray, ap: FloatArray, first: int = FIRST) -> FloatArray:
    """Return the probability that the best candidate by AP is among the first by score, (rows,), 0 to 1."""
    is_best = ap == ap.max(axis=1, keepdims=True)
    higher = (scores[:, None, :] > scores[:, :, None]).sum(axis=2)
    equal = (scores[:, None, :] == scores[:, :, None]).sum(axis=2)
    chance = np.clip((first - higher) / equal, 0.0, 1.0)
    mean: FloatArray = (chance * is_best).sum(axis=1) / is_best.sum(axis=1)
    return mean


def spearman_brown(correlation: FloatArray) -> FloatArray:
    """Return the reliability of a measure from the correlation of its two halves."""
    reliability: FloatArray = 2.0 * correlation / (1.0 + correlation)
    return reliability


@dataclass(frozen=True)
class Estimate:
    """A value with the values of its resamples.

    Attributes
    ----------
    value
        NaN where it is undefined.
    resampled
        (resamples,) float64; empty where there is no interval.
    count
        Candidates, groups or junctions that it rests on.
    """

    value: float
    resampled: FloatArray
    count: int

    @cached_property
    def interval(self) -> ConfidenceInterval:
        """The bias-corrected interval of 95 %."""
        if np.isnan(self.value) or not len(self.resampled):
            return ConfidenceInterval.undefined("not enough candidates")
        return ConfidenceInterval.from_resamples(self.value, self.resampled)


@dataclass(frozen=True, eq=False)
class DetectedJunction:
    """The AP of one detector at the candidates of one junction, with all scores.

    Attributes
    ----------
    ap
        (n,), with values left out; 0 to 1.
    halves
        (n, 2) float64.
    scores
        By name, (n,) float64.
    heights, sensors
        Group of each candidate, (n,).
    """

    name: str
    ap: MeasureValues
    halves: FloatArray
    scores: Mapping[str, FloatArray]
    heights: NDArray[np.float64]
    sensors: NDArray[np.str_]
    resamples: int = RESAMPLES
    seed: int = SEED

    def defined(self, score: str) -> NDArray[np.bool_]:
        """Return where both a score and AP are defined, (n,) bool."""
        return self.ap.defined & np.isfinite(self.scores[score])

    def estimate(self, score: str, statistic: Statistic, selected: NDArray[np.bool_] | None = None) -> Estimate:
        """Return a statistic of a score over the selected candidates. All selections draw the same blocks of frames."""
        rows = self.defined(score) if selected is None else self.defined(score) & selected
        count = int(rows.sum())
        if count < MIN_VALUES:
            return Estimate(float("nan"), np.empty(0), count)
        values, ap = self.scores[score][rows], self.ap.values[rows]
        value = float(statistic(values[None, :], ap[None, :])[0])
        blocks = self.ap.left_out.shape[1]
        draws = Resamples.draw(self.name, count, blocks, self.resamples, self.seed)
        if count < MIN_POLES:
            same = np.broadcast_to(np.arange(count), (self.resamples, count))
            draws = Resamples(same, draws.blocks)
        resampled_ap = draws.resample_measure(self.ap, rows)
        return Estimate(value, statistic(draws.resample_score(values), resampled_ap), count)

    def in_groups(self, score: str, groups: NDArray[np.float64] | NDArray[np.str_], least: int) -> Estimate:
        """Return the mean rho within groups of at least so many candidates, weighted by their candidates."""
        each = self.by_group(score, groups, least)
        each = {group: estimate for group, estimate in each.items() if np.isfinite(estimate.value)}
        if not each:
            return Estimate(float("nan"), np.empty(0), 0)
        weights = np.array([estimate.count for estimate in each.values()], dtype=np.float64)
        values = np.array([estimate.value for estimate in each.values()])
        resampled = np.array([estimate.resampled for estimate in each.values()])
        return Estimate(float((weights * values).sum() / weights.sum()), _weighted_mean(resampled, weights), len(each))

    def by_group(self, score: str, groups: NDArray[np.float64] | NDArray[np.str_], least: int) -> dict[str, Estimate]:
        """Return rho within each group of at least so many candidates, by the name of the group."""
        each = {}
        for group in np.unique(groups).tolist():
            selected = groups == group
            if int(selected.sum()) >= least:
                each[f"{group:g}" if isinstance(group, float) else str(group)] = self.estimate(score, rho, selected)
        return each

    def best_in_first(self, score: str) -> float:
        """Return the probability that the best candidate is among the first three: the share of resampled frames."""
        rows = self.defined(score)
        count = int(rows.sum())
        if count < MIN_VALUES:
            return float("nan")
        draws = Resamples.draw(self.name, count, self.ap.left_out.shape[1], self.resamples, self.seed)
        same = np.broadcast_to(np.arange(count), (self.resamples, count))
        ap = Resamples(same, draws.blocks).resample_measure(self.ap, rows)
        values = np.broadcast_to(self.scores[score][rows], ap.shape)
        return float(in_first(values, ap).mean())

    def reliability(self, selected: NDArray[np.bool_] | None = None) -> float:
        """Return the reliability of AP; NaN where a half is undefined everywhere, or r is not above 0."""
        rows = np.isfinite(self.halves).all(axis=1)
        if selected is not None:
            rows = rows & selected
        if int(rows.sum()) < MIN_VALUES:
            return float("nan")
        first, second = self.halves[rows].T
        r = rho(first[None, :], second[None, :])
        return float(spearman_brown(r)[0]) if r[0] > 0.0 else float("nan")

    def ceiling(self, selected: NDArray[np.bool_] | None = None) -> float:
        """Return the rho that a score can reach that knows the true AP."""
        return float(np.sqrt(self.reliability(selected)))


def _weighted_mean(values: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the mean over the first axis, without undefined values, (resamples,)."""
    weight = np.where(np.isnan(values), 0.0, weights[:, None])
    with np.errstate(invalid="ignore"):
        mean: FloatArray = (np.nan_to_num(values) * weight).sum(axis=0) / weight.sum(axis=0)
    return mean


Summary = Callable[[FloatArray], FloatArray]
"""Of values of several junctions, (junctions, resamples); returns (resamples,)."""


def mean_of(values: FloatArray) -> FloatArray:
    """Return the mean over junctions."""
    result: FloatArray = values.mean(axis=0)
    return result


def median_of(values: FloatArray) -> FloatArray:
    """Return the median over junctions."""
    result: FloatArray = np.median(values, axis=0)
    return result


def over_junctions(
    each: Mapping[str, Estimate],
    summary: Summary = mean_of,
    *,
    limits: tuple[float, float] = (-1.0, 1.0),
    seed: int = SEED,
) -> Estimate:
    """Return a summary over junctions, which are resampled too.

    Parameters
    ----------
    each
        Estimates by junction; undefined ones are left out.
    limits
        Least and greatest possible value.
    """
    used = [estimate for estimate in each.values() if np.isfinite(estimate.value)]
    if not used:
        return Estimate(float("nan"), np.empty(0), 0)
    value = float(summary(np.array([[estimate.value] for estimate in used]))[0])
    count, resamples = len(used), min(len(estimate.resampled) for estimate in used)
    if count < MIN_JUNCTIONS or not resamples:
        return Estimate(value, np.empty(0), count)
    label = "+".join(each)
    rng = np.random.default_rng(np.random.SeedSequence((seed, crc32(label.encode()))))
    table = np.array([estimate.resampled[:resamples] for estimate in used])
    table += np.array([[estimate.value] for estimate in used]) - np.nanmedian(table, axis=1, keepdims=True)
    junction = rng.integers(0, count, (count, resamples))
    row = rng.integers(0, resamples, (count, resamples))
    drawn = summary(table[junction, row])
    return Estimate(value, np.clip(drawn, *limits), count)
