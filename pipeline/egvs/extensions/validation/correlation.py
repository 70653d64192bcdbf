r"""Correlation of scores with measures of detection over sites: Pearson, Spearman, Kendall, with intervals.

**Coefficients**: see :class:`egvs.statistics.ranks.StandardisedValues`.

**Resampling.** A correlation is uncertain in two ways: other sites could have been chosen, and other frames recorded. A
resample draws n of the n sites with replacement (all sites of a pole together), and k of the k blocks of frames; the
blocks are the same for all sites, because all sites see the same traffic. Scores are not resampled over frames: the
uncertainty from their own traffic is not included.

Average precision is not computed anew for each draw of blocks. It is close enough to linear in the blocks: with
:math:`\theta_{(g)}` the measure without block g, :math:`\bar\theta` their mean, and block g drawn :math:`w_g` times,

.. math:: \theta^* = \theta + \sqrt{\frac{k-1}{k}} \sum_g w_g (\bar\theta - \theta_{(g)})

The root makes the variance over draws equal to the jackknife's; without it the variance would be (k - 1) / k of that of
k independent blocks (Efron and Tibshirani 1993, sections 11.5 and 20.3: bootstrap of the jackknife's linear form).

**Intervals** of 95 % are corrected for bias (BC: Efron, Canadian Journal of Statistics 9, 1981; Efron and Tibshirani,
"An Introduction to the Bootstrap", 1993, section 14.3, with the acceleration left at 0). With G the distribution of the
resampled values, :math:`\hat\theta` the value itself and :math:`\Phi` the normal distribution,

.. math:: z_0 = \Phi^{-1}(G(\hat\theta)), \qquad
          [\,G^{-1}(\Phi(2 z_0 - 1.96)),\; G^{-1}(\Phi(2 z_0 + 1.96))\,]

Values equal to :math:`\hat\theta` count half in G.

**Several junctions.** Sites are compared within each junction, because a score in bits means little across junctions.
The coefficient is the mean of the junctions' coefficients, weighted by their numbers of poles,

.. math:: c = \sum_j n_j c_j / \sum_j n_j

Resamples keep the junctions and draw poles and blocks of frames within each. An interval therefore speaks of other
poles and other traffic at these junctions, not of other junctions.

Two scores are compared on the same resamples, so that what they have in common cancels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from zlib import crc32

import numpy as np
from scipy.special import ndtr, ndtri

from egvs.core.errors import Diagnostic
from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.core.wording import format_percent
from egvs.extensions.validation.detection_metrics import JackknifeEstimate
from egvs.statistics.ranks import MIN_VALUES, CoefficientKind, StandardisedValues

CONFIDENCE_LEVEL = 0.95

MAX_UNDEFINED_SHARE = 0.05
"""Largest share of resamples without a coefficient, because all their values are equal."""

RESAMPLES = 2000
"""Resamples of an interval: its ends then scatter by a twentieth of its width."""

MIN_POLES = 5
"""Poles of a junction that an interval needs."""

_TIE_TOLERANCE = 1e-12


@dataclass(frozen=True)
class ConfidenceInterval:
    """A 95 % interval.

    Attributes
    ----------
    low, high
        NaN where there is no interval.
    why
        Why there is no interval; empty where there is one.
    """

    low: float
    high: float
    why: str = ""

    @classmethod
    def undefined(cls, why: str) -> ConfidenceInterval:
        """Return no interval, with the reason."""
        return cls(math.nan, math.nan, why)

    @classmethod
    def from_resamples(cls, value: float, resampled: FloatArray) -> ConfidenceInterval:
        """Return the bias-corrected interval of a value.

        Parameters
        ----------
        value
            The value of the sample itself.
        resampled
            The value of each resample, (resamples,); NaN where it is undefined.
        """
        defined = resampled[~np.isnan(resampled)]
        if len(defined) < (1.0 - MAX_UNDEFINED_SHARE) * len(resampled):
            share = 1.0 - len(defined) / len(resampled)
            return cls.undefined(f"{format_percent(share, 0)} of the resamples have equal values only")
        if np.ptp(defined) <= _TIE_TOLERANCE:
            return cls.undefined("all resamples have the same value, which says nothing about other sites")

        ties = np.count_nonzero(np.abs(defined - value) <= _TIE_TOLERANCE)
        below = np.count_nonzero(defined < value - _TIE_TOLERANCE) + 0.5 * ties
        half = 0.5 / len(defined)
        z0 = ndtri(np.clip(below / len(defined), half, 1.0 - half))
        half_width = ndtri(0.5 + 0.5 * CONFIDENCE_LEVEL)
        low, high = np.quantile(defined, [ndtr(2.0 * z0 - half_width), ndtr(2.0 * z0 + half_width)])
        return cls(float(low), float(high))


def share_above_zero(differences: FloatArray) -> float:
    """Return the share of resamples with a difference above 0; ties count half, undefined ones are left out."""
    defined = differences[~np.isnan(differences)]
    if not len(defined):
        return math.nan
    ties = np.count_nonzero(np.abs(defined) <= _TIE_TOLERANCE)
    return float((np.count_nonzero(defined > _TIE_TOLERANCE) + 0.5 * ties) / len(defined))


@dataclass(frozen=True)
class MeasureValues:
    """A measure of detection at the sites of a junction.

    Attributes
    ----------
    values
        (n,) float64, NaN where the measure is undefined.
    left_out
        With each block of frames left out, (n, blocks) float64.
    """

    values: FloatArray
    left_out: FloatArray

    @classmethod
    def from_estimates(cls, estimates: Sequence[JackknifeEstimate]) -> MeasureValues:
        """Return the values of one estimate per site."""
        values = np.array([estimate.value for estimate in estimates])
        return cls(values, np.stack([estimate.left_out for estimate in estimates]))

    @property
    def defined(self) -> BoolArray:
        """Whether the measure is defined at each site, with all frames and without each block, (n,)."""
        return np.isfinite(self.values) & np.isfinite(self.left_out).all(axis=1)


@dataclass(frozen=True)
class JunctionScores:
    """Scores and measures of detection at the sites of a junction.

    Attributes
    ----------
    name
        Name of the junction.
    sites
        Names of the n sites.
    scores
        Values by score, (n,) float64 each, with the sign changed where less is better; NaN where undefined.
    measures
        Values by measure, all with the same blocks of frames.
    poles
        Pole of each site. Sites of one pole (at several heights) are much alike, so they are drawn together. Empty
        where each site has a pole of its own.
    part
        A part of the junction, such as one mounting height. Parts of a junction draw the same blocks of frames, and the
        same poles where they have as many.
    """

    name: str
    sites: tuple[str, ...]
    scores: Mapping[str, FloatArray]
    measures: Mapping[str, MeasureValues]
    poles: tuple[str, ...] = ()
    part: str = ""

    @property
    def blocks(self) -> int:
        """Number of blocks of frames."""
        return int(next(iter(self.measures.values())).left_out.shape[1])

    def defined_sites(self, scores: Sequence[str], measure: str) -> BoolArray:
        """Return at which sites these scores and the measure are all defined, (n,) bool."""
        defined = self.measures[measure].defined.copy()
        for score in scores:
            defined &= np.isfinite(self.scores[score])
        return defined

    def selected_poles(self, selected: BoolArray) -> tuple[str, ...]:
        """Return the poles of the selected sites, (n,) bool; empty where each site has a pole of its own."""
        if not self.poles:
            return ()
        return tuple(pole for pole, is_selected in zip(self.poles, selected, strict=True) if is_selected)

    def count_poles(self, selected: BoolArray) -> int:
        """Return the number of poles of the selected sites, (n,) bool."""
        if not self.poles:
            return int(selected.sum())
        return len(set(self.selected_poles(selected)))


@dataclass(frozen=True)
class Resamples:
    """Resamples of m sites and k blocks of a junction.

    Attributes
    ----------
    sites
        Rows of the drawn sites, (resamples, m) int64.
    blocks
        How often each block is drawn, (resamples, k) int64.
    """

    sites: IntArray
    blocks: IntArray

    @classmethod
    def draw(
        cls, junction: str, sites: int, blocks: int, resamples: int, seed: int, poles: Sequence[str] = ()
    ) -> Resamples:
        """Draw resamples; equal arguments give equal resamples, whatever else is drawn.

        Poles are drawn from those with the same number of sites, so that all resamples have the same number of sites.
        """
        rng = np.random.default_rng(np.random.SeedSequence((seed, crc32(junction.encode()))))
        block_counts = rng.multinomial(blocks, np.full(blocks, 1.0 / blocks), resamples)
        sites_by_pole: dict[str | int, list[int]] = {}
        for site in range(sites):
            sites_by_pole.setdefault(poles[site] if poles else site, []).append(site)

        rows = []
        for size in sorted({len(pole_sites) for pole_sites in sites_by_pole.values()}):
            same_size = np.array([pole_sites for pole_sites in sites_by_pole.values() if len(pole_sites) == size])
            drawn = rng.integers(0, len(same_size), (resamples, len(same_size)))
            rows.append(same_size[drawn].reshape(resamples, -1))
        return cls(np.concatenate(rows, axis=1), block_counts)

    def resample_score(self, values: FloatArray) -> FloatArray:
        """Return a score, (m,), at the drawn sites, (resamples, m)."""
        return values[self.sites]

    def resample_measure(self, measure: MeasureValues, selected: BoolArray) -> FloatArray:
        """Return a measure of the selected sites at the drawn sites and in the drawn blocks, (resamples, m)."""
        left_out = measure.left_out[selected]
        k = left_out.shape[1]
        change = self.blocks @ (left_out.mean(axis=1, keepdims=True) - left_out).T
        return np.take_along_axis(measure.values[selected] + np.sqrt((k - 1) / k) * change, self.sites, axis=1)


@dataclass(frozen=True)
class Correlation:
    """Correlation of a score with a measure, or the difference between those of two scores.

    Attributes
    ----------
    value
        The coefficient, or that of the first score minus that of the second; NaN where it is undefined.
    interval
        Its 95 % interval.
    better
        Share of resamples in which the first of two scores has the larger coefficient; NaN for one score.
    sites
        Number of sites.
    dropped
        Sites at which a score or the measure is undefined.
    why
        Why there is no value, or no interval; empty where there are both.
    """

    value: float
    interval: ConfidenceInterval
    better: float
    sites: int
    dropped: tuple[str, ...]
    why: str

    def warnings(self, location: str) -> list[Diagnostic]:
        """Return a warning for sites left out, and for a missing value or interval."""
        warnings = []
        if self.dropped:
            problem = f"without {', '.join(self.dropped)}, where a value is undefined"
            warnings.append(Diagnostic("correlation", location, problem, ""))
        if self.why:
            missing = "no interval" if math.isfinite(self.value) else "no correlation"
            hint = "Use more sites, or sites that differ more."
            warnings.append(Diagnostic("correlation", location, f"{missing}: {self.why}", hint))
        return warnings


class CorrelationStudy:
    """Correlates scores with measures of detection at the sites of some junctions.

    Parameters
    ----------
    junctions
        At least one; all have the same scores and measures.
    seed
        Seed of the resamples.
    resamples
        Number of resamples.
    """

    def __init__(self, junctions: Sequence[JunctionScores], seed: int, resamples: int = RESAMPLES) -> None:
        self.junctions = tuple(junctions)
        self.seed = seed
        self.resamples = resamples
        self._kind: CoefficientKind | None = None
        self._resamples: dict[tuple[str, str, bytes], Resamples] = {}
        self._scores: dict[tuple[str, str, bytes, str], StandardisedValues] = {}
        self._measures: dict[
            tuple[str, str, bytes], tuple[str, StandardisedValues]
        ] = {}  # the last measure only: large

    def correlation(self, score: str, measure: str, kind: CoefficientKind) -> Correlation:
        """Return the correlation of a score with a measure.

        Quickest when all scores are correlated with one measure, then with the next, and kinds one after the other.
        """
        return self._compare([score], measure, kind)

    def difference(self, first: str, second: str, measure: str, kind: CoefficientKind) -> Correlation:
        """Return how much better one score correlates with a measure than another, over sites that have both."""
        return self._compare([first, second], measure, kind)

    def _compare(self, scores: Sequence[str], measure: str, kind: CoefficientKind) -> Correlation:
        masks = [junction.defined_sites(scores, measure) for junction in self.junctions]
        sites = sum(int(mask.sum()) for mask in masks)
        dropped = self._dropped_sites(masks)
        for junction, mask in zip(self.junctions, masks, strict=True):
            why = _undefined_reason(junction, mask, scores, measure)
            if why:
                return Correlation(math.nan, ConfidenceInterval.undefined(why), math.nan, sites, dropped, why)

        values = []
        for score in scores:
            sample = []
            for junction, mask in zip(self.junctions, masks, strict=True):
                sample.append(_sample_coefficient(junction, mask, score, measure, kind))
            values.append(self._pooled(sample, masks)[0])
        value = float(values[0] - values[1] if len(values) == 2 else values[0])
        for junction, mask in zip(self.junctions, masks, strict=True):
            poles = junction.count_poles(mask)
            if poles < MIN_POLES:
                why = f"{junction.name} has sites on {poles} poles, and an interval needs {MIN_POLES}"
                return Correlation(value, ConfidenceInterval.undefined(why), math.nan, sites, dropped, why)

        resampled = []
        for score in scores:
            coefficients = []
            for junction, mask in zip(self.junctions, masks, strict=True):
                coefficients.append(self._resampled_coefficient(junction, mask, score, measure, kind))
            resampled.append(self._pooled(coefficients, masks))
        if len(scores) == 1:
            interval = ConfidenceInterval.from_resamples(value, resampled[0])
            return Correlation(value, interval, math.nan, sites, dropped, interval.why)
        differences = resampled[0] - resampled[1]
        interval = ConfidenceInterval.from_resamples(value, differences)
        return Correlation(value, interval, share_above_zero(differences), sites, dropped, interval.why)

    def _dropped_sites(self, masks: Sequence[BoolArray]) -> tuple[str, ...]:
        dropped = []
        for junction, mask in zip(self.junctions, masks, strict=True):
            dropped += [f"{junction.name} {junction.sites[row]}" for row in np.flatnonzero(~mask)]
        return tuple(dropped)

    def _pooled(self, coefficients: Sequence[FloatArray], masks: Sequence[BoolArray]) -> FloatArray:
        """Return the mean of the junctions' coefficients, (resamples,) each, weighted by their numbers of poles."""
        poles = [junction.count_poles(mask) for junction, mask in zip(self.junctions, masks, strict=True)]
        weights = np.array(poles, dtype=np.float64)
        mean: FloatArray = (np.stack(coefficients) * weights[:, None]).sum(axis=0) / weights.sum()
        return mean

    def _resampled_coefficient(
        self, junction: JunctionScores, mask: BoolArray, score: str, measure: str, kind: CoefficientKind
    ) -> FloatArray:
        """Return the coefficient of one junction in every resample, (resamples,)."""
        if kind != self._kind:  # cache the values of one kind only, which bounds the memory
            self._kind = kind
            self._scores.clear()
            self._measures.clear()
        sites_key = (junction.name, junction.part, mask.tobytes())
        if sites_key not in self._resamples:
            poles = junction.selected_poles(mask)
            self._resamples[sites_key] = Resamples.draw(
                junction.name, int(mask.sum()), junction.blocks, self.resamples, self.seed, poles
            )
        resamples = self._resamples[sites_key]

        score_key = (*sites_key, score)
        if score_key not in self._scores:
            values = resamples.resample_score(junction.scores[score][mask])
            self._scores[score_key] = StandardisedValues.from_values(values, kind)
        cached_measure = self._measures.get(sites_key)
        if cached_measure is None or cached_measure[0] != measure:
            values = resamples.resample_measure(junction.measures[measure], mask)
            self._measures[sites_key] = measure, StandardisedValues.from_values(values, kind)
        return self._scores[score_key].correlate(self._measures[sites_key][1])


def _sample_coefficient(
    junction: JunctionScores, mask: BoolArray, score: str, measure: str, kind: CoefficientKind
) -> FloatArray:
    """Return the coefficient of one junction's sites themselves, (1,)."""
    score_values = StandardisedValues.from_values(junction.scores[score][mask][None], kind)
    return score_values.correlate(StandardisedValues.from_values(junction.measures[measure].values[mask][None], kind))


def _undefined_reason(junction: JunctionScores, mask: BoolArray, scores: Sequence[str], measure: str) -> str:
    """Return why a junction has no coefficient; empty if it has one."""
    if mask.sum() < MIN_VALUES:
        return f"{junction.name} has {mask.sum()} sites with values, and a correlation needs {MIN_VALUES}"
    values = {score: junction.scores[score] for score in scores} | {measure: junction.measures[measure].values}
    for name, site_values in values.items():
        if np.isnan(StandardisedValues.from_values(site_values[mask][None], "pearson").norm[0]):
            return f"{name} is the same at all sites of {junction.name}"
    return ""
