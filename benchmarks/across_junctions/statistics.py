r"""Statistics of the study: rho, rho in groups, regret, the first three, reliability; with intervals.

**Rho** is Spearman's coefficient of a score with measured AP over candidates. *Within groups* (one height, or one
sensor) it is the mean over the groups, weighted by their candidates, so that neither height nor sensor can explain it.
*Given sensor and height* it is the correlation of the ranks after the least-squares effects of both were taken from
both (a partial correlation): what is left is where the candidate stands and how it is turned.

**Regret** is the AP lost by taking the candidate with the highest score instead of the one with the highest AP, in
points of 100. Of several candidates with the highest score, the mean counts; an undefined score is the lowest. The
highest of many noisy values is too high, so regret is, too, even that of a score that knew the true AP. *Crossed
regret* chooses the best candidate by AP in one half of the frames and measures the loss in the other, and the other way
round; the mean of both. It is too low on average. The regret that a planner would have is between the two.

**In the first three**: whether the candidate with the highest AP has one of the three highest scores; ties are broken
at random. Its share of resampled frames says how certain that candidate is.

**Reliability** is the rho between the AP of two halves of the frames, r, corrected to the full number of frames by
Spearman and Brown (both in British Journal of Psychology 3, 1910). The **ceiling** is what a score could reach that
knew the true AP: the correlation of a true with a measured value, the square root of R (Spearman 1904), times what
equal values of AP leave to a score without ties, with t candidates in each group of equal AP:

.. math:: R = \frac{2 r}{1 + r}, \qquad \rho_{max} = \sqrt{R} \sqrt{1 - \frac{\sum (t^3 - t)}{n^3 - n}}

**Intervals** of one junction resample candidates and blocks of frames together, as
:mod:`egvs.extensions.validation.correlation` does, and are for rho with measured AP. Groups of fewer than five
candidates resample blocks of frames only. A resample has the noise of the frames twice, so its rho is too low on
average: resamples are moved so that their median is the value. Over several junctions, the junctions are resampled too:
each resample draws as many junctions as there are, with one resample of each. The noise of candidates and frames is in
the spread of the values of the junctions already, so it counts twice; in turn, the spread of a few junctions is
underestimated. Measured on synthetic studies of six junctions (in the tests), nominal intervals of 95 % of mean rho
contain the truth in 99 of 100 studies where junctions are alike, and in 85 where they differ much. Those of a median
regret contain it in 70 to 80 of 100, so the six values are printed instead.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from egvs.core.grid import FloatArray
from egvs.extensions.validation.correlation import MIN_POLES, ConfidenceInterval, MeasureValues, Resamples
from egvs.statistics.ranks import MIN_VALUES, StandardisedValues

SEED, RESAMPLES = 3702, 2000

FIRST = 3
"""Number of the best candidates by score among which the best by AP should be."""

POINTS = 100.0

SMALLEST_REST = 1e-9
"""Mean square of ranks that is left of them where groups do not explain everything."""

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


def rho_given(scores: FloatArray, ap: FloatArray, explained: FloatArray) -> FloatArray:
    """Return the correlation of the ranks in each row without what other properties explain, (rows,).

    Parameters
    ----------
    scores, ap
        (rows, n) float64 each.
    explained
        Projections onto the effects of these properties, of :func:`projections`, (rows, n, n).
    """
    ranks = np.stack([rankdata(scores, axis=1), rankdata(ap, axis=1)], axis=2)
    rest = ranks - explained @ ranks
    product = np.einsum("ij,ij->i", rest[:, :, 0], rest[:, :, 1])
    squares = (rest**2).sum(axis=1)
    is_free = (squares > SMALLEST_REST * scores.shape[1]).all(axis=1)
    result: FloatArray = product / np.where(is_free, np.sqrt(squares.prod(axis=1)), np.nan)
    return result


def projections(groupings: Sequence[NDArray[np.int64]]) -> FloatArray:
    """Return the projection onto the means of the groups of all groupings, for each row, (rows, n, n).

    Parameters
    ----------
    groupings
        Number of the group of each candidate, (rows, n) int64 each.
    """
    indicators = [
        (groups == group).astype(np.float64) for groups in groupings for group in range(int(groups.max()) + 1)
    ]
    effects = np.stack(indicators, axis=2)
    projection: FloatArray = effects @ np.linalg.pinv(effects)
    return projection


def regret(scores: FloatArray, ap: FloatArray) -> FloatArray:
    """Return the AP lost by taking the best candidate by score, in points of 100, (rows,)."""
    lost: FloatArray = POINTS * (ap.max(axis=1) - _taken(scores, ap))
    return lost


def crossed_regret(scores: FloatArray, halves: FloatArray) -> float:
    """Return the mean AP lost in one half of the frames against the best candidate of the other, in points of 100.

    Parameters
    ----------
    scores
        (n,) float64.
    halves
        AP in both halves of the frames, (n, 2) float64.
    """
    lost = [
        (_taken(chosen_by[None, :], measured[None, :]) - _taken(scores[None, :], measured[None, :]))[0]
        for chosen_by, measured in (halves.T, halves.T[::-1])
    ]
    return POINTS * float(np.mean(lost))


def _taken(scores: FloatArray, ap: FloatArray) -> FloatArray:
    """Return the AP of the candidate with the highest score; of several, the mean, (rows,)."""
    is_best = scores == scores.max(axis=1, keepdims=True)
    taken: FloatArray = (ap * is_best).sum(axis=1) / is_best.sum(axis=1)
    return taken


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


def tie_factor(values: FloatArray) -> float:
    """Return the largest rho that any values without ties can have with these, (n,)."""
    counts = np.unique(values, return_counts=True)[1].astype(np.float64)
    n = float(len(values))
    return float(np.sqrt(1.0 - (counts**3 - counts).sum() / (n**3 - n)))


def standard_errors(measure: MeasureValues) -> FloatArray:
    """Return the jackknife's standard error of each candidate, (n,)."""
    blocks = measure.left_out.shape[1]
    spread = measure.left_out - measure.left_out.mean(axis=1, keepdims=True)
    errors: FloatArray = np.sqrt((blocks - 1) / blocks * (spread**2).sum(axis=1))
    return errors


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

    def centred(self, limits: tuple[float, float] = (-1.0, 1.0)) -> Estimate:
        """Return the estimate with resamples whose median is the value."""
        if np.isnan(self.value) or np.isnan(self.resampled).all():
            return self
        moved = np.clip(self.resampled + self.value - np.nanmedian(self.resampled), *limits)
        return Estimate(self.value, moved, self.count)

    def minus(self, other: Estimate) -> Estimate:
        """Return the difference from another estimate with the same resamples."""
        both = len(self.resampled) and len(other.resampled)
        resampled = self.resampled - other.resampled if both else np.empty(0)
        return Estimate(self.value - other.value, resampled, self.count)


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

    def rho(self, score: str, selected: NDArray[np.bool_] | None = None, group: str = "") -> Estimate:
        """Return rho over the selected candidates.

        Every selection draws the same blocks of frames; each group draws candidates of its own.
        """
        rows = self.defined(score) if selected is None else self.defined(score) & selected
        return self._estimate(rows, self.scores[score], rho, group).centred()

    def rho_given_sensor_and_height(self, score: str) -> Estimate:
        """Return rho without the effects of sensors and heights."""
        rows = self.defined(score)
        if int(rows.sum()) < MIN_VALUES:
            return Estimate(float("nan"), np.empty(0), int(rows.sum()))
        values, ap = self.scores[score][rows], self.ap.values[rows]
        draws, explained, resampled_explained = self._explained(rows.tobytes())
        value = float(rho_given(values[None, :], ap[None, :], explained)[0])
        resampled_ap = draws.resample_measure(self.ap, rows)
        resampled = rho_given(draws.resample_score(values), resampled_ap, resampled_explained)
        return Estimate(value, resampled, int(rows.sum())).centred()

    @lru_cache(maxsize=4)  # noqa: B019 - a few large arrays, for as long as the tables of a junction are made
    def _explained(self, selected: bytes) -> tuple[Resamples, FloatArray, FloatArray]:
        """Return draws of the selected candidates, and projections onto the means of sensors and heights."""
        rows = np.frombuffer(selected, dtype=np.bool_)
        groups = [np.unique(values[rows], return_inverse=True)[1] for values in (self.sensors, self.heights)]
        draws = self._draws(int(rows.sum()))
        return draws, projections([g[None, :] for g in groups]), projections([g[draws.sites] for g in groups])

    def regret(self, score: str) -> Estimate:
        """Return the regret over the candidates with an AP."""
        return self._estimate(self.ap.defined, self._with_lowest(score), regret)

    def crossed_regret(self, score: str) -> float:
        """Return the crossed regret; NaN where the AP of a half is undefined."""
        rows = self.ap.defined
        if int(rows.sum()) < MIN_VALUES or not np.isfinite(self.halves[rows]).all():
            return float("nan")
        return crossed_regret(self._with_lowest(score)[rows], self.halves[rows])

    def _with_lowest(self, score: str) -> FloatArray:
        """Return a score whose undefined values are the lowest."""
        values = self.scores[score]
        return np.where(np.isnan(values), -np.inf, values)

    def _draws(self, count: int, group: str = "") -> Resamples:
        blocks = self.ap.left_out.shape[1]
        draws = Resamples.draw(self.name, count, blocks, self.resamples, self.seed)
        if group:
            of_group = Resamples.draw(f"{self.name} {group}", count, blocks, self.resamples, self.seed)
            draws = Resamples(of_group.sites, draws.blocks)
        if count < MIN_POLES:
            draws = Resamples(np.broadcast_to(np.arange(count), (self.resamples, count)), draws.blocks)
        return draws

    def _estimate(self, rows: NDArray[np.bool_], values: FloatArray, statistic: Statistic, group: str = "") -> Estimate:
        count = int(rows.sum())
        if count < MIN_VALUES:
            return Estimate(float("nan"), np.empty(0), count)
        value = float(statistic(values[rows][None, :], self.ap.values[rows][None, :])[0])
        draws = self._draws(count, group)
        resampled_ap = np.clip(draws.resample_measure(self.ap, rows), 0.0, 1.0)
        return Estimate(value, statistic(draws.resample_score(values[rows]), resampled_ap), count)

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
        """Return rho within each group, by its name; undefined where fewer candidates have a score and an AP."""
        each = {}
        for group in np.unique(groups).tolist():
            name = f"{group:g}" if isinstance(group, float) else str(group)
            count = int((self.defined(score) & (groups == group)).sum())
            is_enough = count >= least
            each[name] = (
                self.rho(score, groups == group, name) if is_enough else Estimate(float("nan"), np.empty(0), count)
            )
        return each

    def best_in_first(self, score: str) -> float:
        """Return whether the best candidate is among the first three, 0 or 1; between them where scores are equal."""
        rows = self.ap.defined
        if int(rows.sum()) < MIN_VALUES:
            return float("nan")
        return float(in_first(self._with_lowest(score)[rows][None, :], self.ap.values[rows][None, :])[0])

    def best_in_first_resampled(self, score: str) -> float:
        """Return the same as a mean over resampled frames."""
        rows = self.ap.defined
        count = int(rows.sum())
        if count < MIN_VALUES:
            return float("nan")
        same = np.broadcast_to(np.arange(count), (self.resamples, count))
        draws = Resamples(same, self._draws(count).blocks)
        ap = np.clip(draws.resample_measure(self.ap, rows), 0.0, 1.0)
        return float(in_first(np.broadcast_to(self._with_lowest(score)[rows], ap.shape), ap).mean())

    def reliability(self, selected: NDArray[np.bool_] | None = None) -> float:
        """Return the reliability of AP; NaN where a half is undefined everywhere, or r is not above 0."""
        rows = self._halved(selected)
        if int(rows.sum()) < MIN_VALUES:
            return float("nan")
        first, second = self.halves[rows].T
        r = rho(first[None, :], second[None, :])
        return float(spearman_brown(r)[0]) if r[0] > 0.0 else float("nan")

    def ceiling(self, selected: NDArray[np.bool_] | None = None) -> float:
        """Return the rho that a score without ties can reach that knows the true AP."""
        rows = self._halved(selected)
        return float(np.sqrt(self.reliability(selected))) * (tie_factor(self.ap.values[rows]) if rows.any() else 1.0)

    def ceiling_within_heights(self, least: int) -> float:
        """Return the mean ceiling among candidates of equal height; undefined ones are left out."""
        each = [self.heights == height for height in np.unique(self.heights)]
        ceilings = [self.ceiling(selected) for selected in each if int((selected & self.ap.defined).sum()) >= least]
        defined = [ceiling for ceiling in ceilings if np.isfinite(ceiling)]
        return float(np.mean(defined)) if defined else float("nan")

    def _halved(self, selected: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
        rows = np.isfinite(self.halves).all(axis=1) & self.ap.defined
        return rows if selected is None else rows & selected


def _weighted_mean(values: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the mean over the first axis, without undefined values, (resamples,)."""
    weight = np.where(np.isnan(values), 0.0, weights[:, None])
    with np.errstate(invalid="ignore"):
        mean: FloatArray = (np.nan_to_num(values) * weight).sum(axis=0) / weight.sum(axis=0)
    return mean


def over_junctions(
    each: Mapping[str, Estimate],
    *,
    limits: tuple[float, float] = (-1.0, 1.0),
    seed: int = SEED,
) -> Estimate:
    """Return the mean over junctions, which are resampled too.

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
    value = float(np.mean([estimate.value for estimate in used]))
    count, resamples = len(used), min(len(estimate.resampled) for estimate in used)
    if count < MIN_JUNCTIONS or not resamples:
        return Estimate(value, np.empty(0), count)
    label = "+".join(each)
    rng = np.random.default_rng(np.random.SeedSequence((seed, crc32(label.encode()))))
    table = np.array([estimate.resampled[:resamples] for estimate in used])
    table += np.array([[estimate.value] for estimate in used]) - np.nanmedian(table, axis=1, keepdims=True)
    junction = rng.integers(0, count, (count, resamples))
    row = rng.integers(0, resamples, (count, resamples))
    drawn = np.nanmean(table[junction, row], axis=0)
    return Estimate(value, np.clip(drawn, *limits), count)
