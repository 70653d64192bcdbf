"""All scores in one labelled table: ``scores[site, period, replicate, score, value]``.

The table is long because it is ragged: in the mix, every score has one replicate for each group of blocks that is left
out, and a mean over several detectors one for each detector; in a period, only EGVS has replicates, with groups of that
period. Arrays come from its views: a score of all sites (:meth:`ScoreTable.column`), the sites from best to worst
(:meth:`ScoreTable.ranking`), a score in each period (:meth:`ScoreTable.by_period`).

``scores_by_period.parquet`` and the warnings about scores are made from the table as well.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from egvs.artefacts import parquet
from egvs.core.errors import Diagnostic
from egvs.core.grid import FloatArray
from egvs.core.wording import list_first
from egvs.scenario.model import SCENARIO_FILE
from egvs.scenario.score_config import is_plugin_score
from egvs.scoring.scorer import SiteScore, ranks
from egvs.scoring.standard_errors import BlockGroups, LagBehindBest, ScoreUncertainty, beats_next, lag_behind_best
from egvs.scoring.target_scores import SiteTargetScores

MIX = ""
"""Period of the scores over all traffic: the mix of the periods where there are some."""

ALL_TRAFFIC = 0
"""Replicate with all traffic; replicates 1, 2, ... leave out one group of blocks each."""

_MAX_LISTED_SITES = 5
"""Sites that a warning names."""

JACKKNIFE_TOTAL = -1
"""Replicate with all traffic, summed in the order of the other replicates: the last bits of an EGVS can differ from
those of :data:`ALL_TRAFFIC`. Standard errors are computed from this one."""


class ScoreEntry(NamedTuple):
    """One score of one site in one period.

    ``replicates``: the score of all traffic, then with each group left out, (1 + k,) float64; None without any.
    """

    period: str
    score: str
    value: float
    replicates: FloatArray | None


class SiteScores(NamedTuple):
    """The scores of one site, as the scorers of voxels and of vehicles return them."""

    site: str
    voxels: SiteScore
    targets: SiteTargetScores | None

    def entries(self, periods: Sequence[str]) -> Iterator[ScoreEntry]:
        """Yield all scores, first those of the mix, then those of the ``periods``; of the mix only without periods."""
        yield from _voxel_entries(MIX, self.voxels)
        if self.targets is not None:
            for name, replicates in self.targets.scores.items():
                yield ScoreEntry(MIX, name, float(replicates[0]), _if_several(replicates))
        for period, scores in zip(periods, self.voxels.by_period, strict=bool(periods)):
            for entry in _voxel_entries(period, scores):
                yield entry if entry.score == "egvs" else entry._replace(replicates=None)
        if self.targets is not None:
            for period, values in zip(periods, self.targets.by_period, strict=bool(periods)):
                for name, value in values.items():
                    yield ScoreEntry(period, name, value, None)


def _voxel_entries(period: str, scores: SiteScore) -> Iterator[ScoreEntry]:
    yield ScoreEntry(period, "egvs", scores.egvs, scores.replicates)
    shares = {"entropy_seen": np.array([scores.entropy_seen]), **scores.shares}
    for name, replicates in shares.items():
        yield ScoreEntry(period, name, float(replicates[0]), _if_several(replicates))


def _if_several(replicates: FloatArray) -> FloatArray | None:
    return replicates if len(replicates) > 1 else None


@dataclass(frozen=True, eq=False)
class ScoreColumn:
    """One score of n sites.

    Attributes
    ----------
    name
        Name of the score.
    values
        (n,) float64; NaN where the score is not defined.
    replicates
        The score of all traffic, then with each group of blocks left out, then with each detector left out where the
        score depends on several, (n, 1 + k) float64; None without replicates.
    groups
        The groups that are left out, k in all.
    """

    name: str
    values: FloatArray
    replicates: FloatArray | None = None
    groups: tuple[BlockGroups, ...] = ()

    @property
    def rank(self) -> NDArray[np.uint32]:
        """Rank of each site, 1 for the best, (n,)."""
        return ranks(self.values)

    @cached_property
    def estimate(self) -> ScoreUncertainty | None:
        """Standard errors and comparisons; None where they are unknown."""
        if self.replicates is None or np.isnan(self.replicates).any():
            return None
        return ScoreUncertainty.of(self.replicates, self.groups)

    @property
    def se(self) -> FloatArray:
        """Standard errors, (n,) float64; NaN where they are unknown."""
        if self.estimate is None:
            return np.full(len(self.values), math.nan)
        return self.estimate.se

    @property
    def beats_next(self) -> FloatArray:
        """Probability that each site is better than the next in rank, (n,) float64; NaN where it is unknown."""
        if self.estimate is None:
            return np.full(len(self.values), math.nan)
        return beats_next(self.estimate)

    @property
    def behind_best(self) -> LagBehindBest:
        """How each site compares with the best one; NaN where it is unknown."""
        if self.estimate is None:
            unknown = np.full(len(self.values), math.nan)
            return LagBehindBest(unknown, unknown, unknown)
        return lag_behind_best(self.estimate)

    @property
    def has_detectors(self) -> bool:
        """Whether standard errors contain differences between detectors."""
        return any(group.are_detectors for group in self.groups)

    @property
    def best(self) -> frozenset[int]:
        """Indices of the sites with the highest score; empty where scores are NaN."""
        if not len(self.values):
            return frozenset()
        return frozenset(np.flatnonzero(self.values == self.values.max()).tolist())


@dataclass(frozen=True, eq=False)
class ScoreTable:
    """The scores of all sites.

    Attributes
    ----------
    table
        Columns ``site``, ``period``, ``replicate``, ``score``, ``value``, in the order of the sites.
    sites
        Names of the sites, n.
    periods
        Names of the periods; empty where the traffic has none.
    groups
        Period -> groups of blocks that are left out there in turn; nothing where there are no standard errors.
    limits
        Period -> highest EGVS that any site could reach.
    score_groups
        Score -> groups that are left out in the mix after those of the traffic: the detectors of the score.
    """

    table: pa.Table
    sites: tuple[str, ...]
    periods: tuple[str, ...] = ()
    groups: Mapping[str, tuple[BlockGroups, ...]] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    score_groups: Mapping[str, tuple[BlockGroups, ...]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        scores: Iterable[SiteScores],
        groups: Mapping[str, tuple[BlockGroups, ...]],
        limits: Mapping[str, float] | None = None,
        periods: Sequence[str] = (),
        score_groups: Mapping[str, tuple[BlockGroups, ...]] | None = None,
    ) -> ScoreTable:
        """Make the table from the scores of each site; other parameters are the attributes of the same name."""
        sites = []
        columns: dict[str, list[Any]] = {"site": [], "period": [], "replicate": [], "score": [], "value": []}
        for site_scores in scores:
            sites.append(site_scores.site)
            for entry in site_scores.entries(periods):
                numbers = [ALL_TRAFFIC]
                values = [entry.value]
                if entry.replicates is not None:
                    numbers += [JACKKNIFE_TOTAL, *range(1, len(entry.replicates))]
                    values += entry.replicates.tolist()
                columns["site"] += [site_scores.site] * len(values)
                columns["period"] += [entry.period] * len(values)
                columns["replicate"] += numbers
                columns["score"] += [entry.score] * len(values)
                columns["value"] += values
        types = {"replicate": pa.int32(), "value": pa.float64()}
        table = pa.table({name: pa.array(rows, types.get(name, pa.string())) for name, rows in columns.items()})
        return cls(table, tuple(sites), tuple(periods), groups, limits or {}, score_groups or {})

    def column(self, score: str, period: str = MIX) -> ScoreColumn:
        """Return one score of all sites in the mix, or in a period."""
        import pyarrow.compute as pc

        is_score = pc.equal(self.table.column("score"), score)
        rows = self.table.filter(pc.and_(is_score, pc.equal(self.table.column("period"), period)))
        replicate = rows.column("replicate").to_numpy()
        values = rows.column("value").to_numpy()
        groups = self.groups.get(period, ())
        if groups and period == MIX:
            groups += self.score_groups.get(score, ())
        replicates = None
        if groups and (len(values) > len(self.sites) or not self.sites):
            n_replicates = 1 + sum(len(record.frames) for record in groups)
            replicates = values[replicate != ALL_TRAFFIC].reshape(len(self.sites), n_replicates)
        return ScoreColumn(score, values[replicate == ALL_TRAFFIC], replicates, groups)

    def by_period(self, score: str) -> dict[str, ScoreColumn]:
        """Return one score of all sites in each period."""
        return {period: self.column(score, period) for period in self.periods}


def write_scores_by_period(
    path: Path, scores: ScoreTable, rank_by: str, additional: Sequence[str], metadata: Mapping[str, Any]
) -> None:
    """Write ``scores_by_period.parquet``, one row group per period; remove an old file where there are no periods.

    Parameters
    ----------
    path
        The file.
    scores
        Scores of all sites.
    rank_by
        Score that the sites are ranked by.
    additional
        Scores that have a column, beside EGVS and the share of entropy.
    metadata
        Metadata of the file.
    """
    if not scores.periods:
        path.unlink(missing_ok=True)
        return
    more = [name for name in additional if name != "entropy_seen"]
    extra = {name: pa.array([0.0]) for name in filter(is_plugin_score, more)}  # the schema cannot name it
    has_errors = all(period in scores.groups for period in scores.periods)
    optional = tuple(name for name in more if name not in extra)
    if has_errors:
        optional = ("egvs_se", "egvs_bias", *optional)
    with parquet.artefact_writer(path, "scores_by_period", optional, extra=extra) as file:
        for period in scores.periods:
            egvs = scores.column("egvs", period)
            columns: dict[str, Any] = {
                "period": [period] * len(scores.sites),
                "site": scores.sites,
                "egvs": egvs.values,
                "egvs_limit": np.full(len(scores.sites), scores.limits[period]),
                "rank": scores.column(rank_by, period).rank,
                "entropy_seen": scores.column("entropy_seen", period).values,
            }
            if has_errors and egvs.estimate is not None:
                columns |= {"egvs_se": egvs.estimate.se, "egvs_bias": egvs.estimate.bias}
            columns |= {name: scores.column(name, period).values for name in more}
            file.write(columns)
        file.describe(metadata)


def warn_all_zero(column: ScoreColumn, gamma: float, limit: float) -> Iterator[Diagnostic]:
    """Warn that the score that ranks is 0 at every site; ``limit`` is the highest EGVS of any site."""
    if np.any(column.values > 0):
        return
    key = "sites"
    reason = "no beam crosses a voxel with traffic"
    hint = "Check poses, sensors and the region of interest."
    if gamma == 0:
        key = "score.gamma"
        reason = "gamma is 0"
        hint = "Set gamma above 0."
    elif limit == 0:
        key = "roi"
        reason = "the traffic in the region never changes"
        hint = "Move or enlarge the region of interest."
    problem = f"{column.name} is 0 at every site, so there is no ranking: {reason}"
    yield Diagnostic("no ranking", f"{SCENARIO_FILE}: {key}", problem, hint)


def warn_blind_sites(column: ScoreColumn, sites: Sequence[str], returned_shares: FloatArray) -> Iterator[Diagnostic]:
    """Warn about sites with a score of 0 where others score more, for example inside a building without a floor.

    Parameters
    ----------
    column
        The score that ranks.
    sites
        Names of the sites.
    returned_shares
        Share of the beams of each site towards the region that meet something, (n,) float64.
    """
    if not np.any(column.values > 0):
        return  # warn_all_zero
    blind = np.flatnonzero(column.values == 0).tolist()
    if not blind:
        return
    listed = list_first([f"{sites[i]} ({100 * returned_shares[i]:.0f} %)" for i in blind], _MAX_LISTED_SITES)
    problem = f"{column.name} is 0 at {listed}; in brackets, the beams that end on the static world"
    hint = "Check whether each stands inside a building (a mesh without a floor is no closed solid) or looks away."
    yield Diagnostic("blind sites", f"{SCENARIO_FILE}: sites", problem, hint)


def warn_additional_all_zero(column: ScoreColumn) -> Iterator[Diagnostic]:
    """Warn that a score that does not rank is 0 at every site."""
    if len(column.values) and not np.any(column.values != 0):
        problem = f"{column.name} is 0 at every site, so it does not distinguish them"
        yield Diagnostic("no other score", f"{SCENARIO_FILE}: score", problem, "Check sites, sensors and effects.")


def warn_no_standard_error(column: ScoreColumn) -> Iterator[Diagnostic]:
    """Warn that the standard error of a score is unknown, although the scenario requests standard errors."""
    if column.replicates is None or column.estimate is not None or np.isnan(column.values).any():
        return
    groups = sum(len(record.frames) for record in column.groups)
    problem = f"{column.name} has no standard error: all vehicles in the region are in one of {groups} blocks of frames"
    yield Diagnostic("no standard error", f"{SCENARIO_FILE}: traffic", problem, "Record more traffic.")
