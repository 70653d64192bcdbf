r"""Correlates scores with detection over sites, with intervals, at one junction or over several.

Over several junctions sites are compared within each (a score in bits means little across junctions): the coefficient
is the mean of the junctions' own, weighted by their numbers of places (sites of one pole are one place),

.. math:: c = \sum_j n_j c_j / \sum_j n_j

Resamples keep the junctions and draw places and blocks of frames within each, so an interval speaks of other places and
other traffic at these junctions, not of other junctions.

Two scores are compared on the same resamples: what they share is taken out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.core.findings import Finding
from pipeline.validation.statistics.coefficients import FEWEST, Form, Kind
from pipeline.validation.statistics.intervals import Interval, share_above
from pipeline.validation.statistics.junctions import Draws, Junction

RESAMPLES = 2000
"""Resamples of an interval: its ends scatter by a twentieth of its width."""

FEWEST_PLACES = 5
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
    interval: Interval
    better: float
    sites: int
    dropped: tuple[str, ...]
    why: str

    def doubts(self, place: str) -> list[Finding]:
        """What is missing, as warnings."""
        found = []
        if self.dropped:
            names = ", ".join(self.dropped)
            found.append(Finding("correlation", place, f"left out, for a value is not defined there: {names}", ""))
        if self.why:
            what = "no interval" if math.isfinite(self.value) else "no correlation"
            found.append(Finding("correlation", place, f"{what}: {self.why}", "more sites, or sites that differ more"))
        return found


class Study:
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

    def __init__(self, junctions: Sequence[Junction], seed: int, resamples: int = RESAMPLES) -> None:
        self.junctions, self.seed, self.resamples = tuple(junctions), seed, resamples
        self._kind: Kind | None = None
        self._draws: dict[tuple[str, bytes], Draws] = {}
        self._scores: dict[tuple[str, bytes, Kind, str], Form] = {}
        self._measure: dict[tuple[str, bytes, Kind], tuple[str, Form]] = {}  # the last one alone: forms are large

    def correlation(self, score: str, measure: str, kind: Kind) -> Correlation:
        """How well a score goes with a measure.

        Quickest when all scores are asked for one measure, then the next, and one kind after the other."""
        return self._compare([score], measure, kind)

    def difference(self, first: str, second: str, measure: str, kind: Kind) -> Correlation:
        """By how much better one score goes with a measure than another one does, over sites that have both."""
        return self._compare([first, second], measure, kind)

    def _compare(self, scores: Sequence[str], measure: str, kind: Kind) -> Correlation:
        masks = [junction.known(scores, measure) for junction in self.junctions]
        pairs = list(zip(self.junctions, masks, strict=True))
        sites = sum(int(mask.sum()) for mask in masks)
        dropped = tuple(
            f"{junction.name} {site}"
            for junction, mask in pairs
            for site, known in zip(junction.sites, mask, strict=True)
            if not known
        )
        why = next(filter(None, (_undefined(*pair, scores, measure) for pair in pairs)), "")
        if why:
            return Correlation(math.nan, Interval.unknown(why), math.nan, sites, dropped, why)
        places = [junction.places_of(mask) for junction, mask in pairs]
        each = [pooled([_once(*pair, score, measure, kind) for pair in pairs], places)[0] for score in scores]
        value = float(each[0] - each[1] if len(each) == 2 else each[0])
        few = [f"{j.name} has sites at {count} places" for j, count in zip(self.junctions, places, strict=True)
               if count < FEWEST_PLACES]  # fmt: skip
        if few:
            interval = Interval.unknown(f"{few[0]}; an interval needs {FEWEST_PLACES}")
            return Correlation(value, interval, math.nan, sites, dropped, interval.why)
        drawn = [pooled([self._drawn(*pair, score, measure, kind) for pair in pairs], places) for score in scores]
        draws = drawn[0] - drawn[1] if len(drawn) == 2 else drawn[0]
        interval = Interval.of(value, draws)
        better = share_above(draws) if len(drawn) == 2 else math.nan
        return Correlation(value, interval, better, sites, dropped, interval.why)

    def _drawn(
        self, junction: Junction, known: NDArray[np.bool_], score: str, measure: str, kind: Kind
    ) -> NDArray[np.float64]:
        """The coefficient of one junction in every resample, (resamples,)."""
        place = junction.name, known.tobytes(), kind
        if kind != self._kind:  # forms of one kind are enough to hold
            self._kind = kind
            self._scores.clear()
            self._measure.clear()
        if (key := (*place, score)) not in self._scores:
            values = self._draws_of(junction, known).of_score(junction.scores[score][known])
            self._scores[key] = Form.of(values, kind)
        if self._measure.get(place, ("",))[0] != measure:
            values = self._draws_of(junction, known).of_measure(junction.measures[measure], known)
            self._measure[place] = measure, Form.of(values, kind)
        return self._scores[key].with_(self._measure[place][1])

    def _draws_of(self, junction: Junction, known: NDArray[np.bool_]) -> Draws:
        """The same for all scores and measures that are defined at the same sites."""
        if (key := (junction.name, known.tobytes())) not in self._draws:
            places = (
                [place for place, has in zip(junction.places, known, strict=True) if has] if junction.places else ()
            )
            sites = int(known.sum())
            self._draws[key] = Draws.of(junction.name, sites, junction.blocks, self.resamples, self.seed, places)
        return self._draws[key]


def pooled(each: Sequence[NDArray[np.float64]], places: Sequence[int]) -> NDArray[np.float64]:
    """The mean of the junctions' coefficients, each (resamples,), weighted by how many places each has."""
    weights = np.array(places, dtype=np.float64)
    mean: NDArray[np.float64] = (np.stack(each) * weights[:, None]).sum(axis=0) / weights.sum()
    return mean


def _once(junction: Junction, known: NDArray[np.bool_], score: str, measure: str, kind: Kind) -> NDArray[np.float64]:
    """The coefficient of one junction's sites themselves, (1,)."""
    a, b = junction.scores[score][known], junction.measures[measure].values[known]
    return Form.of(a[None], kind).with_(Form.of(b[None], kind))


def _undefined(junction: Junction, known: NDArray[np.bool_], scores: Sequence[str], measure: str) -> str:
    """Why a junction has no coefficient, or nothing."""
    if known.sum() < FEWEST:
        return f"{junction.name} has {known.sum()} sites with values; {FEWEST} are needed"
    values = {score: junction.scores[score] for score in scores} | {measure: junction.measures[measure].values}
    for name, its in values.items():
        if np.isnan(Form.of(its[known][None], "pearson").norm[0]):
            return f"{name} is the same at all sites of {junction.name}"
    return ""
