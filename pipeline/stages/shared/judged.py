"""What all sites are worth by one score: values, how far they may be off, and the same in each period."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pipeline.core.findings import Finding
from pipeline.scenario.models import FILE
from pipeline.scoring.leave_out import Groups
from pipeline.scoring.scorer import SiteScore, ranks
from pipeline.scoring.targets.record import Floats
from pipeline.scoring.uncertainty import Estimate, beats_next
from pipeline.stages.shared.target_scores import SiteTargets


@dataclass(frozen=True, eq=False)
class Judged:
    """The sites by one score, n of them.

    Attributes
    ----------
    name
        Of the score.
    values
        (n,) float64; not numbers where the score is not defined.
    left_out
        Of all traffic, then with each group of it left out, (n, 1 + k) float64; None where there are no standard
        errors.
    groups
        That were left out.
    by_period
        Values in each period alone, (n,) float64 each.
    """

    name: str
    values: Floats
    left_out: Floats | None
    groups: tuple[Groups, ...]
    by_period: tuple[Floats, ...]

    @classmethod
    def of(
        cls, name: str, sites: Sequence[tuple[SiteScore, SiteTargets | None]], groups: tuple[Groups, ...] | None
    ) -> Judged:
        """From the scores of all sites; ``groups`` are None where there are no standard errors."""
        values = np.array([_value(name, *site) for site in sites])
        left_out = None
        if groups is not None:
            columns = 1 + sum(len(its.frames) for its in groups)
            left_out = np.array([_left_out(name, *site) for site in sites]).reshape(len(sites), columns)
        apart = zip(*(_by_period(name, *site) for site in sites), strict=True)
        return cls(name, values, left_out, groups or (), tuple(np.array(period) for period in apart))

    def doubts(self) -> list[Finding]:
        """A warning where it has values whose errors should be known and are not."""
        if self.left_out is None or self.estimate is not None or np.isnan(self.values).any():
            return []
        groups = sum(len(its.frames) for its in self.groups)
        found = f"all vehicles in the region are in one of the {groups} groups of frames"
        cure = "traffic that lasts longer"
        return [Finding("no standard error", f"{FILE}: traffic", f"{found}: {self.name} has no standard error", cure)]

    def nothing(self, gamma: float, limit: float) -> list[Finding]:
        """A warning where the score is 0 at every site, which is no ranking; why, by gamma and the EGVS's limit."""
        if np.any(self.values > 0):
            return []
        if gamma == 0:
            place, why, cure = f"{FILE}: score.gamma", "gamma is 0", "a gamma above 0"
        elif limit == 0:
            place, why, cure = f"{FILE}: roi", "no traffic comes and goes in the region", "a region with traffic in it"
        else:
            place, why = f"{FILE}: sites", "no beam crosses a place with traffic"
            cure = "sites and sensors that look at the traffic in the region"
        return [Finding("no ranking", place, f"{self.name} is 0 at every site, so none is best: {why}", cure)]

    def idle(self) -> list[Finding]:
        """A warning where the score, which does not rank, is 0 at every site."""
        if not len(self.values) or np.any(self.values != 0):
            return []
        found = f"{self.name} is 0 at every site, so it tells none from another"
        cure = "sites, sensors and settings by which it is above 0 somewhere"
        return [Finding("no other score", f"{FILE}: score", found, cure)]

    @property
    def rank(self) -> np.ndarray[Any, np.dtype[np.uint32]]:
        """1 for the best, (n,)."""
        return ranks(self.values)

    @cached_property
    def estimate(self) -> Estimate | None:
        """How far the values may be off; None where that is not known."""
        if self.left_out is None or np.isnan(self.left_out).any():
            return None
        return Estimate.of(self.left_out, self.groups)

    @property
    def se(self) -> Floats:
        """Standard errors, (n,) float64; not numbers where they are not known."""
        return np.full(len(self.values), math.nan) if self.estimate is None else self.estimate.se

    @property
    def beats_next(self) -> Floats:
        """As :func:`pipeline.scoring.uncertainty.beats_next`; not numbers where it is not known."""
        return np.full(len(self.values), math.nan) if self.estimate is None else beats_next(self.estimate)


def _value(name: str, score: SiteScore, targets: SiteTargets | None) -> float:
    if name == "egvs":
        return score.egvs
    return float((targets.scores if targets is not None and name in targets.scores else score.shares)[name][0])


def _left_out(name: str, score: SiteScore, targets: SiteTargets | None) -> Floats | None:
    if name == "egvs":
        return score.left_out
    return (targets.scores if targets is not None and name in targets.scores else score.shares)[name]


def _by_period(name: str, score: SiteScore, targets: SiteTargets | None) -> list[float]:
    if targets is not None and name in targets.scores:
        return [period[name] for period in targets.by_period]
    return [_value(name, period, None) for period in score.by_period]
