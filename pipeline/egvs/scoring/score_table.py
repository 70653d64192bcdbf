"""ScoreTable: scores[site, period, replicate, score].

What all sites are worth by one score: values, how far they may be off, and the same in each period.

Scores of each period beside those of the mix: ``scores_by_period.parquet``, and what rankings disagree on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from egvs.artefacts import parquet
from egvs.core.errors import Diagnostic
from egvs.scenario.model import SCENARIO_FILE
from egvs.scoring.scorer import PeriodTpog, SiteScore, ranks
from egvs.scoring.standard_errors import BlockGroups, ScoreUncertainty, beats_next
from egvs.scoring.target_scores import SiteTargetScores
from egvs.scoring.targets import Floats


@dataclass(frozen=True, eq=False)
class ScoreColumn:
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
    groups: tuple[BlockGroups, ...]
    by_period: tuple[Floats, ...]

    @classmethod
    def of(
        cls,
        name: str,
        sites: Sequence[tuple[SiteScore, SiteTargetScores | None]],
        groups: tuple[BlockGroups, ...] | None,
    ) -> ScoreColumn:
        """From the scores of all sites; ``groups`` are None where there are no standard errors."""
        values = np.array([_score_value(name, *site) for site in sites])
        left_out = None
        if groups is not None:
            columns = 1 + sum(len(its.frames) for its in groups)
            left_out = np.array([_jackknife_values(name, *site) for site in sites]).reshape(len(sites), columns)
        apart = zip(*(_period_values(name, *site) for site in sites), strict=True)
        return cls(name, values, left_out, groups or (), tuple(np.array(period) for period in apart))

    def standard_error_warnings(self) -> list[Diagnostic]:
        """A warning where it has values whose errors should be known and are not."""
        if self.left_out is None or self.estimate is not None or np.isnan(self.values).any():
            return []
        groups = sum(len(its.frames) for its in self.groups)
        found = f"all vehicles in the region are in one of the {groups} groups of frames"
        cure = "traffic that lasts longer"
        return [
            Diagnostic(
                "no standard error", f"{SCENARIO_FILE}: traffic", f"{found}: {self.name} has no standard error", cure
            )
        ]

    def all_zero_warnings(self, gamma: float, limit: float) -> list[Diagnostic]:
        """A warning where the score is 0 at every site, which is no ranking; why, by gamma and the EGVS's limit."""
        if np.any(self.values > 0):
            return []
        if gamma == 0:
            place, why, cure = f"{SCENARIO_FILE}: score.gamma", "gamma is 0", "a gamma above 0"
        elif limit == 0:
            place, why, cure = (
                f"{SCENARIO_FILE}: roi",
                "no traffic comes and goes in the region",
                "a region with traffic in it",
            )
        else:
            place, why = f"{SCENARIO_FILE}: sites", "no beam crosses a place with traffic"
            cure = "sites and sensors that look at the traffic in the region"
        return [Diagnostic("no ranking", place, f"{self.name} is 0 at every site, so none is best: {why}", cure)]

    def unranked_zero_warnings(self) -> list[Diagnostic]:
        """A warning where the score, which does not rank, is 0 at every site."""
        if not len(self.values) or np.any(self.values != 0):
            return []
        found = f"{self.name} is 0 at every site, so it tells none from another"
        cure = "sites, sensors and settings by which it is above 0 somewhere"
        return [Diagnostic("no other score", f"{SCENARIO_FILE}: score", found, cure)]

    @property
    def rank(self) -> np.ndarray[Any, np.dtype[np.uint32]]:
        """1 for the best, (n,)."""
        return ranks(self.values)

    @cached_property
    def estimate(self) -> ScoreUncertainty | None:
        """How far the values may be off; None where that is not known."""
        if self.left_out is None or np.isnan(self.left_out).any():
            return None
        return ScoreUncertainty.of(self.left_out, self.groups)

    @property
    def se(self) -> Floats:
        """Standard errors, (n,) float64; not numbers where they are not known."""
        return np.full(len(self.values), math.nan) if self.estimate is None else self.estimate.se

    @property
    def beats_next(self) -> Floats:
        """As :func:`egvs.scoring.standard_errors.beats_next`; not numbers where it is not known."""
        return np.full(len(self.values), math.nan) if self.estimate is None else beats_next(self.estimate)


def _score_value(name: str, score: SiteScore, targets: SiteTargetScores | None) -> float:
    if name == "egvs":
        return score.egvs
    return float((targets.scores if targets is not None and name in targets.scores else score.shares)[name][0])


def _jackknife_values(name: str, score: SiteScore, targets: SiteTargetScores | None) -> Floats | None:
    if name == "egvs":
        return score.left_out
    return (targets.scores if targets is not None and name in targets.scores else score.shares)[name]


def _period_values(name: str, score: SiteScore, targets: SiteTargetScores | None) -> list[float]:
    if targets is not None and name in targets.scores:
        return [period[name] for period in targets.by_period]
    return [_score_value(name, period, None) for period in score.by_period]


def write_scores_by_period(
    path: Path,
    sites: Sequence[str],
    scores: Sequence[SiteScore],
    ranking: ScoreColumn,
    others: Sequence[ScoreColumn],
    periods: Sequence[PeriodTpog],
    limits: Sequence[float],
    metadata: dict[str, Any],
) -> None:
    """Write one row group a period; remove the file of an earlier run where there are no periods.

    ``ranking`` is the score that ranks, ``others`` are those that get a column of their own beside what always stands
    there.
    """
    if not periods:
        path.unlink(missing_ok=True)
        return
    has_errors = all(period.leave_out is not None for period in periods)
    more = (*(("egvs_se", "egvs_bias") if has_errors else ()), *(other.name for other in others))
    with parquet.artefact_writer(path, "scores_by_period", more) as file:
        for number, (period, limit) in enumerate(zip(periods, limits, strict=True)):
            worths = [score.by_period[number] for score in scores]
            egvs = np.array([worth.egvs for worth in worths])
            columns: dict[str, Any] = {
                "period": [period.name] * len(sites),
                "site": list(sites),
                "egvs": egvs,
                "egvs_limit": np.full(len(sites), limit),
                "rank": ranks(ranking.by_period[number]),
                "entropy_seen": np.array([worth.entropy_seen for worth in worths]),
            }
            if has_errors and period.leave_out is not None:
                left_out = np.array([worth.left_out for worth in worths]).reshape(len(sites), -1)
                estimate = ScoreUncertainty.of(left_out, period.leave_out.groups)
                columns |= {"egvs_se": estimate.se, "egvs_bias": estimate.bias}
            columns |= {other.name: other.by_period[number] for other in others}
            file.write(columns)
        file.describe(metadata)


def period_disagreements(sites: Sequence[str], ranking: ScoreColumn, periods: Sequence[PeriodTpog]) -> list[Diagnostic]:
    """A warning for each period whose best site, by the score that ranks, is another than the mix's."""
    if not sites:
        return []
    best = _best_sites(ranking.values)
    found = []
    for period, values in zip(periods, ranking.by_period, strict=True):
        its = _best_sites(values)
        if best & its or not values.max() > 0:
            continue
        first, there = min(best), min(its)
        lost, rank = 1.0 - values[first] / values.max(), int(ranks(values)[first])
        what = f"{sites[there]} is the best site, not {sites[first]} of the mix, which is rank {rank} there"
        cure = "weigh which period counts: the best of the mix need not be the best at any hour"
        place = f"{SCENARIO_FILE}: traffic.periods ({period.name})"
        found.append(Diagnostic("periods disagree", place, f"{what} and scores {lost:.1%} less", cure))
    return found


def _best_sites(values: np.ndarray[Any, np.dtype[np.float64]]) -> set[int]:
    return set(np.flatnonzero(values == values.max()).tolist())
