r"""Pearson, Spearman, Kendall with bootstrap intervals over sites.

How well two lists of values go together: Pearson's r, Spearman's rho, Kendall's tau-b, for many resamples at once.

Each is a cosine of two vectors that are made from one list each,

.. math:: c = \frac{\sum_k a_k b_k}{\sqrt{\sum_k a_k^2} \sqrt{\sum_k b_k^2}}

- Pearson: a are the values less their mean.
- Spearman: a are the ranks less their mean; equal values share the mean of their ranks.
- Kendall: a are the signs of the differences of all pairs; a pair of equal values has 0 (tau-b: Kendall, Biometrika 33,
  1945).

So each list is prepared once, whatever it is compared with. A list whose values are all the same has no coefficient
(NaN), and neither has one of fewer than three.

Makes intervals of 95 % from resamples, corrected for bias.

BC (Efron, Canadian Journal of Statistics 9, 1981; Efron and Tibshirani, "An Introduction to the Bootstrap", 1993,
section 14.3, with the acceleration left at 0). With G the distribution of the resampled values, :math:`\hat\theta` the
value itself and :math:`\Phi` the normal distribution,

.. math:: z_0 = \Phi^{-1}(G(\hat\theta)), \qquad
          [\,G^{-1}(\Phi(2 z_0 - 1.96)),\; G^{-1}(\Phi(2 z_0 + 1.96))\,]

Values that equal :math:`\hat\theta` count half in G.

What was found at the sites of a junction, and the same with sites and blocks of frames resampled.

Two things make a correlation uncertain: which sites were looked at, and which frames. A resample draws n of the n sites
with replacement (whole places, where several sites stand at one), and k of the k blocks of frames; the blocks are the
same for all sites, for all see the same traffic.

Average precision is not computed anew for each draw of blocks. It is linear enough in the blocks: with
:math:`\theta_{(g)}` the measure without block g, :math:`\bar\theta` their mean, and block g drawn :math:`w_g` times,

.. math:: \theta^* = \theta + \sqrt{\frac{k-1}{k}} \sum_g w_g (\bar\theta - \theta_{(g)})

The root makes the variance over draws the jackknife's; without it the bootstrap's would be short by (k - 1) / k of k
independent blocks (Efron and Tibshirani 1993, sections 11.5 and 20.3: the bootstrap of the jackknife's linear form).

The scores are taken as they are. What their own traffic leaves open is no part of this.

Correlates scores with detection over sites, with intervals, at one junction or over several.

Over several junctions sites are compared within each (a score in bits means little across junctions): the coefficient
is the mean of the junctions' own, weighted by their numbers of places (sites of one pole are one place),

.. math:: c = \sum_j n_j c_j / \sum_j n_j

Resamples keep the junctions and draw places and blocks of frames within each, so an interval speaks of other places and
other traffic at these junctions, not of other junctions.

Two scores are compared on the same resamples: what they share is taken out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri
from scipy.stats import rankdata

from egvs.core.errors import Diagnostic
from egvs.validation.detection_metrics import JackknifeEstimate

CoefficientKind = Literal["pearson", "spearman", "kendall"]

COEFFICIENT_KINDS: tuple[CoefficientKind, ...] = ("pearson", "spearman", "kendall")

MIN_VALUES = 3
"""Values that a coefficient needs: two always go together perfectly."""

EQUALITY_TOLERANCE = 1e-12
"""Values that scatter by less than this share of the largest are all the same."""


@dataclass(frozen=True)
class StandardisedValues:
    """A list of values prepared for one kind of coefficient, many resamples of it.

    Attributes
    ----------
    vector
        (resamples, d): float64, or int8 for Kendall's signs.
    norm
        Their lengths, (resamples,) float64; NaN where all values are the same.
    """

    vector: NDArray[Any]
    norm: NDArray[np.float64]

    @classmethod
    def of(cls, values: NDArray[np.float64], kind: CoefficientKind) -> StandardisedValues:
        """From (resamples, n) float64."""
        if kind == "kendall":
            first, second = np.triu_indices(values.shape[1], 1)
            a, b = values[:, first], values[:, second]
            vector: NDArray[Any] = (a > b).astype(np.int8) - (a < b).astype(np.int8)
            norm = np.sqrt(np.count_nonzero(vector, axis=1))
        else:
            vector = rankdata(values, axis=1) if kind == "spearman" else values
            vector = vector - vector.mean(axis=1, keepdims=True)
            norm = np.sqrt((vector**2).sum(axis=1))
        spread = np.ptp(values, axis=1) > EQUALITY_TOLERANCE * np.abs(values).max(axis=1, initial=0.0)
        return cls(vector, np.where(spread & (values.shape[1] >= MIN_VALUES), norm, np.nan))

    def correlate(self, other: StandardisedValues) -> NDArray[np.float64]:
        """The coefficient with another list, (resamples,) float64, -1 to 1."""
        if self.vector.dtype == np.int8:
            product = (self.vector * other.vector).sum(axis=1, dtype=np.int32).astype(np.float64)
        else:
            product = np.einsum("ij,ij->i", self.vector, other.vector)
        found: NDArray[np.float64] = np.clip(product / self.norm / other.norm, -1.0, 1.0)
        return found


CONFIDENCE_LEVEL = 0.95
"""Confidence of intervals."""

MAX_UNDEFINED_SHARE = 0.05
"""Share of resamples that may be undefined: those that hold one value alone."""

_TIE_TOLERANCE = 1e-12


@dataclass(frozen=True)
class ConfidenceInterval:
    """Where a value may lie.

    Attributes
    ----------
    low, high
        NaN where resampling cannot tell.
    why
        Why it cannot; empty where it can.
    """

    low: float
    high: float
    why: str = ""

    @classmethod
    def unknown(cls, why: str) -> ConfidenceInterval:
        """It cannot be told."""
        return cls(math.nan, math.nan, why)

    @classmethod
    def of(cls, value: float, draws: NDArray[np.float64]) -> ConfidenceInterval:
        """From the value and what it was in each resample, NaN where it was undefined."""
        known = draws[~np.isnan(draws)]
        if len(known) < (1.0 - MAX_UNDEFINED_SHARE) * len(draws):
            share = 1.0 - len(known) / len(draws)
            return cls.unknown(f"{share:.0%} of the resamples have equal values only")
        if np.ptp(known) <= _TIE_TOLERANCE:
            return cls.unknown("all resamples agree to the last digit, which says nothing of other sites")
        below = np.count_nonzero(known < value - _TIE_TOLERANCE) + 0.5 * np.count_nonzero(
            np.abs(known - value) <= _TIE_TOLERANCE
        )
        half = 0.5 / len(known)
        z0, reach = ndtri(np.clip(below / len(known), half, 1.0 - half)), ndtri(0.5 + 0.5 * CONFIDENCE_LEVEL)
        low, high = np.quantile(known, [ndtr(2.0 * z0 - reach), ndtr(2.0 * z0 + reach)])
        return cls(float(low), float(high))


def share_above_zero(draws: NDArray[np.float64]) -> float:
    """Share of resamples in which a difference is above 0; ties count half, undefined ones are left out."""
    known = draws[~np.isnan(draws)]
    if not len(known):
        return math.nan
    ties = np.count_nonzero(np.abs(known) <= _TIE_TOLERANCE)
    return float((np.count_nonzero(known > _TIE_TOLERANCE) + 0.5 * ties) / len(known))


@dataclass(frozen=True)
class MeasureValues:
    """A measure of detection at the sites of a junction.

    Attributes
    ----------
    values
        (n,) float64, NaN where it is not defined.
    left_out
        With each block of frames left out, (n, blocks) float64.
    """

    values: NDArray[np.float64]
    left_out: NDArray[np.float64]

    @classmethod
    def of(cls, estimates: Sequence[JackknifeEstimate]) -> MeasureValues:
        """From the estimate at each site."""
        return cls(np.array([its.value for its in estimates]), np.stack([its.left_out for its in estimates]))

    @property
    def known(self) -> NDArray[np.bool_]:
        """The sites at which it is defined, with and without each block, (n,)."""
        return np.isfinite(self.values) & np.isfinite(self.left_out).all(axis=1)


@dataclass(frozen=True)
class JunctionScores:
    """What was found at the sites of a junction.

    Attributes
    ----------
    name
        Of the junction.
    sites
        Their names, n.
    scores
        By name, (n,) float64 each, turned so that more is better; NaN where a score is not defined.
    measures
        By name, of all the same blocks.
    places
        Where each site stands, for sites that stand at one place (at several heights) are much alike: they are drawn
        together. Empty where each has a place of its own.
    """

    name: str
    sites: tuple[str, ...]
    scores: Mapping[str, NDArray[np.float64]]
    measures: Mapping[str, MeasureValues]
    places: tuple[str, ...] = ()

    @property
    def blocks(self) -> int:
        """How many blocks of frames there are."""
        return int(next(iter(self.measures.values())).left_out.shape[1])

    def known(self, scores: Sequence[str], measure: str) -> NDArray[np.bool_]:
        """The sites at which all of these are defined, (n,) bool."""
        known = self.measures[measure].known.copy()
        for score in scores:
            known &= np.isfinite(self.scores[score])
        return known

    def places_of(self, known: NDArray[np.bool_]) -> int:
        """At how many places some of the sites stand, (n,) bool."""
        if not self.places:
            return int(known.sum())
        return len({place for place, has in zip(self.places, known, strict=True) if has})


@dataclass(frozen=True)
class Resamples:
    """Resamples of m sites and k blocks of a junction.

    Attributes
    ----------
    sites
        Rows of the sites drawn, (resamples, m) int64.
    blocks
        How often each block is drawn, (resamples, k) int64.
    """

    sites: NDArray[np.int64]
    blocks: NDArray[np.int64]

    @classmethod
    def of(
        cls, junction: str, sites: int, blocks: int, resamples: int, seed: int, places: Sequence[str] = ()
    ) -> Resamples:
        """The same for the same junction, numbers, places and seed, whatever else is drawn.

        Sites of one place are drawn together: places with as many sites among each other, so that all resamples are of
        as many sites.
        """
        rng = np.random.default_rng(np.random.SeedSequence((seed, crc32(junction.encode()))))
        drawn = rng.multinomial(blocks, np.full(blocks, 1.0 / blocks), resamples)
        at: dict[str | int, list[int]] = {}
        for site in range(sites):
            at.setdefault(places[site] if places else site, []).append(site)
        rows = []
        for size in sorted({len(its) for its in at.values()}):
            alike = np.array([its for its in at.values() if len(its) == size])
            rows.append(alike[rng.integers(0, len(alike), (resamples, len(alike)))].reshape(resamples, -1))
        return cls(np.concatenate(rows, axis=1), drawn)

    def of_score(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """A score, (m,), at the sites drawn, (resamples, m)."""
        return values[self.sites]

    def of_measure(self, measured: MeasureValues, known: NDArray[np.bool_]) -> NDArray[np.float64]:
        """A measure at the sites drawn from those that are known, in the blocks drawn, (resamples, m)."""
        left_out = measured.left_out[known]
        k = left_out.shape[1]
        moved = self.blocks @ (left_out.mean(axis=1, keepdims=True) - left_out).T
        return np.take_along_axis(measured.values[known] + np.sqrt((k - 1) / k) * moved, self.sites, axis=1)


RESAMPLES = 2000
"""Resamples of an interval: its ends scatter by a twentieth of its width."""

MIN_PLACES = 5
"""Places of a junction that an interval needs; where each site is a place of its own, sites."""


@dataclass(frozen=True)
class Correlation:
    """How well a score goes with a measure, or by how much better than another score does.

    Attributes
    ----------
    value
        The coefficient, or of two scores that of the first less that of the second; NaN where it is not defined.
    interval
        Of 95 %.
    better
        Of two scores: in which share of resamples the first goes better with the measure; else NaN.
    sites
        How many it is from.
    dropped
        Sites at which the score or the measure is not defined.
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
        """What is missing, as warnings."""
        found = []
        if self.dropped:
            names = ", ".join(self.dropped)
            found.append(
                Diagnostic("correlation", location, f"left out, for a value is not defined there: {names}", "")
            )
        if self.why:
            what = "no interval" if math.isfinite(self.value) else "no correlation"
            found.append(
                Diagnostic("correlation", location, f"{what}: {self.why}", "more sites, or sites that differ more")
            )
        return found


class CorrelationStudy:
    """Scores and measures of detection at the sites of some junctions.

    Parameters
    ----------
    junctions
        At least one; all have the scores and measures that are asked for.
    seed
        Of the resamples.
    resamples
        How many.
    """

    def __init__(self, junctions: Sequence[JunctionScores], seed: int, resamples: int = RESAMPLES) -> None:
        self.junctions, self.seed, self.resamples = tuple(junctions), seed, resamples
        self._kind: CoefficientKind | None = None
        self._draws: dict[tuple[str, bytes], Resamples] = {}
        self._scores: dict[tuple[str, bytes, CoefficientKind, str], StandardisedValues] = {}
        self._measure: dict[
            tuple[str, bytes, CoefficientKind], tuple[str, StandardisedValues]
        ] = {}  # the last one alone: forms are large

    def correlation(self, score: str, measure: str, kind: CoefficientKind) -> Correlation:
        """How well a score goes with a measure.

        Quickest when all scores are asked for one measure, then the next, and one kind after the other."""
        return self._compare([score], measure, kind)

    def difference(self, first: str, second: str, measure: str, kind: CoefficientKind) -> Correlation:
        """By how much better one score goes with a measure than another one does, over sites that have both."""
        return self._compare([first, second], measure, kind)

    def _compare(self, scores: Sequence[str], measure: str, kind: CoefficientKind) -> Correlation:
        masks = [junction.known(scores, measure) for junction in self.junctions]
        pairs = list(zip(self.junctions, masks, strict=True))
        sites = sum(int(mask.sum()) for mask in masks)
        dropped = tuple(
            f"{junction.name} {site}"
            for junction, mask in pairs
            for site, known in zip(junction.sites, mask, strict=True)
            if not known
        )
        why = next(filter(None, (_undefined_reason(*pair, scores, measure) for pair in pairs)), "")
        if why:
            return Correlation(math.nan, ConfidenceInterval.unknown(why), math.nan, sites, dropped, why)
        places = [junction.places_of(mask) for junction, mask in pairs]
        each = [
            pooled_coefficient([_sample_coefficient(*pair, score, measure, kind) for pair in pairs], places)[0]
            for score in scores
        ]
        value = float(each[0] - each[1] if len(each) == 2 else each[0])
        few = [f"{j.name} has sites at {count} places" for j, count in zip(self.junctions, places, strict=True)
               if count < MIN_PLACES]  # fmt: skip
        if few:
            interval = ConfidenceInterval.unknown(f"{few[0]}; an interval needs {MIN_PLACES}")
            return Correlation(value, interval, math.nan, sites, dropped, interval.why)
        drawn = [
            pooled_coefficient([self._drawn(*pair, score, measure, kind) for pair in pairs], places) for score in scores
        ]
        draws = drawn[0] - drawn[1] if len(drawn) == 2 else drawn[0]
        interval = ConfidenceInterval.of(value, draws)
        better = share_above_zero(draws) if len(drawn) == 2 else math.nan
        return Correlation(value, interval, better, sites, dropped, interval.why)

    def _drawn(
        self, junction: JunctionScores, known: NDArray[np.bool_], score: str, measure: str, kind: CoefficientKind
    ) -> NDArray[np.float64]:
        """The coefficient of one junction in every resample, (resamples,)."""
        place = junction.name, known.tobytes(), kind
        if kind != self._kind:  # forms of one kind are enough to hold
            self._kind = kind
            self._scores.clear()
            self._measure.clear()
        if (key := (*place, score)) not in self._scores:
            values = self._draws_of(junction, known).of_score(junction.scores[score][known])
            self._scores[key] = StandardisedValues.of(values, kind)
        if self._measure.get(place, ("",))[0] != measure:
            values = self._draws_of(junction, known).of_measure(junction.measures[measure], known)
            self._measure[place] = measure, StandardisedValues.of(values, kind)
        return self._scores[key].correlate(self._measure[place][1])

    def _draws_of(self, junction: JunctionScores, known: NDArray[np.bool_]) -> Resamples:
        """The same for all scores and measures that are defined at the same sites."""
        if (key := (junction.name, known.tobytes())) not in self._draws:
            places = (
                [place for place, has in zip(junction.places, known, strict=True) if has] if junction.places else ()
            )
            sites = int(known.sum())
            self._draws[key] = Resamples.of(junction.name, sites, junction.blocks, self.resamples, self.seed, places)
        return self._draws[key]


def pooled_coefficient(each: Sequence[NDArray[np.float64]], places: Sequence[int]) -> NDArray[np.float64]:
    """The mean of the junctions' coefficients, each (resamples,), weighted by how many places each has."""
    weights = np.array(places, dtype=np.float64)
    mean: NDArray[np.float64] = (np.stack(each) * weights[:, None]).sum(axis=0) / weights.sum()
    return mean


def _sample_coefficient(
    junction: JunctionScores, known: NDArray[np.bool_], score: str, measure: str, kind: CoefficientKind
) -> NDArray[np.float64]:
    """The coefficient of one junction's sites themselves, (1,)."""
    a, b = junction.scores[score][known], junction.measures[measure].values[known]
    return StandardisedValues.of(a[None], kind).correlate(StandardisedValues.of(b[None], kind))


def _undefined_reason(junction: JunctionScores, known: NDArray[np.bool_], scores: Sequence[str], measure: str) -> str:
    """Why a junction has no coefficient, or nothing."""
    if known.sum() < MIN_VALUES:
        return f"{junction.name} has {known.sum()} sites with values; {MIN_VALUES} are needed"
    values = {score: junction.scores[score] for score in scores} | {measure: junction.measures[measure].values}
    for name, its in values.items():
        if np.isnan(StandardisedValues.of(its[known][None], "pearson").norm[0]):
            return f"{name} is the same at all sites of {junction.name}"
    return ""
