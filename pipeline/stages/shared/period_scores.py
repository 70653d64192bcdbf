"""Scores of each period beside those of the mix: ``scores_by_period.parquet``, and what rankings disagree on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artefacts import tables
from pipeline.artefacts.readers import read_periods, read_tpog
from pipeline.core.findings import Finding
from pipeline.scenario.models import FILE
from pipeline.scoring.leave_out import LeaveOut
from pipeline.scoring.scorer import PeriodTpog, SiteScore, ranks
from pipeline.scoring.uncertainty import Estimate
from pipeline.stages.shared.judged import Judged


def period_tpogs(path: Path, *, standard_errors: bool) -> tuple[PeriodTpog, ...]:
    """The TPOG of each period of ``tpog.parquet``; none where it has no periods."""
    found = []
    for name in (period.name for period in read_periods(path) if period.name):
        tpog = read_tpog(path, name)
        found.append(PeriodTpog(name, tpog, LeaveOut.of(path, tpog, name) if standard_errors else None))
    return tuple(found)


def write(
    path: Path,
    sites: Sequence[str],
    scores: Sequence[SiteScore],
    ranking: Judged,
    others: Sequence[Judged],
    periods: Sequence[PeriodTpog],
    limits: Sequence[float],
    about: dict[str, Any],
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
    with tables.writer(path, "scores_by_period", more) as file:
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
                estimate = Estimate.of(left_out, period.leave_out.groups)
                columns |= {"egvs_se": estimate.se, "egvs_bias": estimate.bias}
            columns |= {other.name: other.by_period[number] for other in others}
            file.write(columns)
        file.describe(about)


def disagreements(sites: Sequence[str], ranking: Judged, periods: Sequence[PeriodTpog]) -> list[Finding]:
    """A warning for each period whose best site, by the score that ranks, is another than the mix's."""
    if not sites:
        return []
    best = _best(ranking.values)
    found = []
    for period, values in zip(periods, ranking.by_period, strict=True):
        its = _best(values)
        if best & its or not values.max() > 0:
            continue
        first, there = min(best), min(its)
        lost, rank = 1.0 - values[first] / values.max(), int(ranks(values)[first])
        what = f"{sites[there]} is the best site, not {sites[first]} of the mix, which is rank {rank} there"
        cure = "weigh which period counts: the best of the mix need not be the best at any hour"
        place = f"{FILE}: traffic.periods ({period.name})"
        found.append(Finding("periods disagree", place, f"{what} and scores {lost:.1%} less", cure))
    return found


def _best(values: np.ndarray[Any, np.dtype[np.float64]]) -> set[int]:
    return set(np.flatnonzero(values == values.max()).tolist())
