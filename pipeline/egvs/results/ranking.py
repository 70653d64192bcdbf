"""Sites in the order of their scores, the poles that they are mounted on, and sentences about them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

from egvs.artefacts import parquet
from egvs.artefacts.readers import DISTINCT_PROBABILITY
from egvs.artefacts.run_record import StageRecord
from egvs.core.errors import InputError
from egvs.core.wording import by_number, format_percent, list_first
from egvs.results.labels import SCORE_LABELS, ScoreLabel, format_count, format_number, format_probability, join_names
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import DEFAULT_SCORE

CLOSE_SHARE = 0.01
"""The report names the sites whose score is this close to the best, as a share of the best score."""

MIN_RELEVANT_LEAD = 0.001
"""Poles whose scores differ by less are equally good; of shares as it is, of others relative to the best score."""

_MIN_LEAD = 0.0005
"""Shares that differ by less than this look the same with one decimal."""


class ScoreValue(NamedTuple):
    """A value of a score other than the EGVS, and its standard error (None if unknown)."""

    name: str
    value: float
    se: float | None


@dataclass(frozen=True)
class MapSite:
    """A candidate site on a map, with its score."""

    site: str
    x_m: float
    y_m: float
    z_m: float
    egvs: float
    rank: int

    @property
    def score(self) -> float:
        """Value of the score that ranks."""
        return self.egvs

    @property
    def by(self) -> ScoreLabel:
        """Label of the score that ranks."""
        return SCORE_LABELS["egvs"]


@dataclass(frozen=True)
class RankedSite(MapSite):
    """A row of ``scores.parquet``; its schema has the units.

    Attributes
    ----------
    egvs_se, beats_next, behind_best_se, best_beats
        None where no standard errors were computed; the last two also in files of earlier versions.
    behind_best_detectors_se
        None where no standard errors were computed, and for a score without several detectors.
    longitude_deg, latitude_deg
        None where the scenario has no reference system.
    user_columns
        Names and texts of the user's columns of the sites file.
    rank_by
        Name of the score that ranks.
    others
        Scores other than the EGVS.
    """

    pole: str
    yaw_deg: float
    pitch_deg: float
    roll_deg: float
    sensor: str
    egvs_limit: float
    beams_in_roi: int
    returns: int
    entropy_seen: float
    egvs_se: float | None = None
    beats_next: float | None = None
    behind_best_se: float | None = None
    behind_best_detectors_se: float | None = None
    best_beats: float | None = None
    longitude_deg: float | None = None
    latitude_deg: float | None = None
    user_columns: tuple[tuple[str, str], ...] = ()
    rank_by: str = "egvs"
    others: tuple[ScoreValue, ...] = ()

    @classmethod
    def from_table(cls, scores: pa.Table, rank_by: str = "egvs") -> tuple[RankedSite, ...]:
        """Return the rows of ``scores.parquet``, in its order.

        Parameters
        ----------
        scores
            The table.
        rank_by
            Name of the score that ranks; the metadata of the table has it.
        """
        names = [column.name for column in fields(cls) if column.name in scores.column_names]
        known = {*parquet.column_names("scores"), *names}
        user_names = [name for name in scores.column_names if name not in known]
        other_names = [name for name in SCORE_LABELS if name != "egvs" and name in scores.column_names]

        sites = []
        for row in scores.to_pylist():
            values = {name: _none_if_nan(row[name]) for name in names}
            user_columns = tuple((name, _format_extra_column(row[name])) for name in user_names)
            others = tuple(ScoreValue(name, row[name], _none_if_nan(row.get(f"{name}_se"))) for name in other_names)
            sites.append(cls(**values, user_columns=user_columns, rank_by=rank_by, others=others))
        return tuple(sites)

    @classmethod
    def read(cls, path: Path) -> tuple[RankedSite, ...]:
        """Read ``scores.parquet``."""
        scores, metadata = parquet.read_artefact(path, "scores")
        return cls.from_table(scores, metadata.get("rank_by", "egvs"))

    @property
    def is_lag_by_detectors(self) -> bool:
        """Whether most of the squared error of the difference to the best site is due to detectors."""
        if self.behind_best_se is None or self.behind_best_detectors_se is None:
            return False
        return 2.0 * self.behind_best_detectors_se**2 > self.behind_best_se**2

    @property
    def by(self) -> ScoreLabel:
        """Label of the score that ranks."""
        return SCORE_LABELS[self.rank_by]

    @property
    def score(self) -> float:
        """Value of the score that ranks."""
        value = self.value_of(self.rank_by)
        return self.egvs if value is None else value

    @property
    def score_se(self) -> float | None:
        """Standard error of the score that ranks; None if unknown."""
        if self.rank_by == "egvs":
            return self.egvs_se
        return next((other.se for other in self.others if other.name == self.rank_by), None)

    def value_of(self, name: str) -> float | None:
        """Return the value of a score; None where it was not computed, or is not defined."""
        values = {"egvs": self.egvs, "entropy_seen": self.entropy_seen}
        for other in self.others:
            values[other.name] = other.value
        value: float | None = _none_if_nan(values.get(name))
        return value

    @property
    def is_separable(self) -> bool:
        """Whether the site is known to be better than the next one, or standard errors are unknown."""
        return self.beats_next is None or self.beats_next >= DISTINCT_PROBABILITY

    @property
    def is_below_best(self) -> bool:
        """Whether the site is known to be worse than the best one, or the probability of that is unknown."""
        return self.best_beats is None or self.best_beats >= DISTINCT_PROBABILITY


def _none_if_nan(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


def _format_extra_column(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.12g}"
    return str(value)


@dataclass(frozen=True)
class Pole:
    """The candidate sites on one pole, the best first; at least one."""

    name: str
    sites: tuple[RankedSite, ...]

    @property
    def best(self) -> RankedSite:
        """The best site."""
        return self.sites[0]

    @property
    def gain_text(self) -> str:
        """Lead of the best site over the worst: in percentage points for shares, else in per cent of the worst.

        Empty for a single site, and for a score that is no share where the worst is 0.
        """
        if len(self.sites) == 1:
            return ""
        by, worst = self.best.by, self.sites[-1].score
        if by.is_share:
            return by.change(self.best.score - worst)
        if not worst > 0:
            return ""
        return format_percent(self.best.score / worst - 1)

    @property
    def user_columns(self) -> tuple[str, ...]:
        """Text of each of the user's columns; different texts of the sites are separated by commas."""
        columns = []
        for column in zip(*(site.user_columns for site in self.sites), strict=True):
            texts = dict.fromkeys(text for _, text in column if text)
            columns.append(", ".join(texts))
        return tuple(columns)


def companion_score(sites: Sequence[RankedSite]) -> ScoreLabel | None:
    """Return the score shown beside the one that ranks; None if it was not computed.

    Beside the EGVS it is the recommended score or, failing that, the share of vehicles seen well; beside any other
    score it is the EGVS.
    """
    if not sites:
        return None
    names = ["egvs"]
    if sites[0].rank_by == "egvs":
        names = [DEFAULT_SCORE, "seen_well"]
    for name in names:
        if all(site.value_of(name) is not None for site in sites):
            return SCORE_LABELS[name]
    return None


def group_by_pole(sites: Iterable[RankedSite]) -> tuple[Pole, ...]:
    """Return the poles of sites in the order of their ranks: the pole with the best site first."""
    sites_of_pole: dict[str, list[RankedSite]] = {}
    for site in sites:
        sites_of_pole.setdefault(site.pole, []).append(site)
    return tuple(Pole(name, tuple(members)) for name, members in sites_of_pole.items())


@dataclass(frozen=True)
class Ranking:
    """Sites by rank; at least one.

    Attributes
    ----------
    sites
        All sites; those of equal rank are in the order of the sites file.
    best
        The sites with the best score.
    close
        The other sites within :data:`CLOSE_SHARE` of the best score.
    """

    sites: tuple[RankedSite, ...]
    best: tuple[RankedSite, ...]
    close: tuple[RankedSite, ...]

    @classmethod
    def read(cls, path: Path) -> Ranking:
        """Read ``scores.parquet``; InputError if it has no site."""
        sites = RankedSite.read(path)
        if not sites:
            raise InputError(path, "expected at least one site, got none", "Run the score stage again.")
        return cls.of(sites)

    @classmethod
    def of(cls, sites: Iterable[RankedSite]) -> Ranking:
        """Return the ranking of some sites of a run, at least one; their ranks are those among all sites."""
        ordered = tuple(sorted(sites, key=lambda site: site.rank))
        best = tuple(site for site in ordered if site.rank == ordered[0].rank)
        near = (1 - CLOSE_SHARE) * best[0].score
        close = tuple(site for site in ordered[len(best) :] if site.score >= near > 0)
        return cls(ordered, best, close)

    @property
    def last(self) -> RankedSite:
        """The worst site."""
        return self.sites[-1]

    @cached_property
    def poles(self) -> tuple[Pole, ...]:
        """The poles, the one with the best site first."""
        return group_by_pole(self.sites)

    @property
    def user_column_names(self) -> tuple[str, ...]:
        """Names of the user's columns of the sites file."""
        return tuple(name for name, _ in self.sites[0].user_columns)

    @property
    def is_tie(self) -> bool:
        """Whether all sites have the same score."""
        return len(self.best) == len(self.sites)

    @property
    def extremes(self) -> tuple[RankedSite, ...]:
        """The best and the worst site; only one where all have the same score."""
        if self.is_tie:
            return self.sites[:1]
        return self.sites[0], self.last

    @property
    def has_errors(self) -> bool:
        """Whether standard errors were computed."""
        return self.sites[0].egvs_se is not None

    @property
    def by(self) -> ScoreLabel:
        """Label of the score that ranks."""
        return self.best[0].by

    @property
    def companion_score(self) -> ScoreLabel | None:
        """The score shown beside the one that ranks; None if it was not computed."""
        return companion_score(self.sites)

    @property
    def is_located(self) -> bool:
        """Whether longitude and latitude are known."""
        return self.sites[0].latitude_deg is not None

    @cached_property
    def shared_ranks(self) -> set[int]:
        """Ranks of several sites."""
        return {rank for rank, count in Counter(site.rank for site in self.sites).items() if count > 1}

    def share_of_best(self, site: RankedSite) -> float:
        """Return the score of a site as a share of the best score; 0 if that is 0."""
        best_score = self.best[0].score
        if not best_score > 0:
            return 0.0
        return site.score / best_score


def headline(ranking: Ranking, has_traffic: bool) -> str:
    """Return the result in one sentence."""
    best, count = ranking.best, len(ranking.sites)
    top = best[0]
    if not has_traffic:
        return "No traffic in the region: the sites cannot be ranked"
    if not top.score > 0:
        return "No site sees any of the traffic" if count > 1 else f"{top.site} sees none of the traffic"

    by_egvs = top.rank_by == "egvs"
    result = top.by.sentence(top.score)
    if by_egvs:
        result = f"sees {format_percent(top.entropy_seen)} of the traffic’s uncertainty"
    if count == 1:
        return f"{top.site}, the only site, {result}"
    if ranking.is_tie:
        text = f"All {count} sites score the same"
        if by_egvs and len({site.entropy_seen for site in best}) > 1:
            return text
        return f"{text}: each {result}"
    if len(best) > 4:
        return f"{top.site} and {len(best) - 1} others share first place among {count} sites: {top.site} {result}"
    if len(best) > 1:
        names = join_names([site.site for site in best])
        return f"{names} share first place among {count} sites: {top.site} {result}"
    text = f"{top.site} is the best of {count} sites"
    return text if by_egvs else f"{text}: it {result}"


def more_frames_hint(scenario: Scenario, by: ScoreLabel, recorded: int) -> str:
    """Return a sentence on the setting that reduces the standard errors of a score.

    It is ``score.sampled_frames`` for a score over vehicles of less than half of the recorded frames, otherwise longer
    traffic. Four times as many frames halve the errors, if they are independent.

    Parameters
    ----------
    scenario
        The scenario of the run.
    by
        The score that ranks.
    recorded
        Number of recorded frames.
    """
    sampled = scenario.score.sampled_frames
    if by.counts_vehicles and 2 * sampled < recorded:
        return f"More frames may separate them: --set score.sampled_frames={min(4 * sampled, recorded)}."
    if scenario.is_recorded:
        return "A longer recording may separate them."
    if scenario.traffic.periods:
        return "More traffic may separate them: longer periods, or more traffic.frames."
    return f"More traffic may separate them: --set traffic.frames={4 * recorded}."


def recorded_frames_hint(scenario: Scenario, ranking: Ranking, stages: Mapping[str, StageRecord]) -> str:
    """Return :func:`more_frames_hint` for a run with these records of its stages; empty without the traffic's.

    Where differences between detectors are most of the error of the lead over the best site on another pole, more
    frames do not help; then it names the option that compares the detectors.
    """
    rival = _best_on_another_pole(ranking)
    if rival is not None and rival.is_lag_by_detectors:
        options = " and ".join(f"--detector {name}" for name in scenario.score.ranking_detectors)
        return f"The detectors disagree about this difference, and more traffic does not change that: see {options}."
    if "traffic" not in stages:
        return ""
    return more_frames_hint(scenario, ranking.by, stages["traffic"].summary["frames"])


def lead(ranking: Ranking, hint: str = "") -> str:
    """Return sentences about the lead of the best site and the sites close to it; empty if none leads.

    Parameters
    ----------
    ranking
        The sites.
    hint
        Sentence on what helps where poles cannot be told apart; left out for mounts of one pole, and where the poles
        differ by less than :data:`MIN_RELEVANT_LEAD`.
    """
    if ranking.is_tie or not ranking.best[0].score > 0:
        return ""
    second = ranking.sites[len(ranking.best)]
    subject = by_number(len(ranking.best), "It leads", "They lead")
    text = f"{subject} the next site, {second.site}, by {_format_gap(ranking, second)}"
    text += f"{_format_probability(ranking, second, 'better')}."
    rival = _best_on_another_pole(ranking)
    # ``beats_next`` of the last of the best refers to the second
    is_separable = ranking.best[-1].is_separable and second.is_below_best
    if not is_separable:
        text += f" These {'poles' if second is rival else 'sites'} cannot be told apart."
    if rival is not None and rival is not second:
        text += f" The best site on another pole, {rival.site}, is behind by {_format_gap(ranking, rival)}"
        text += f"{_format_probability(ranking, rival, 'worse')}."
        is_separable = rival.is_below_best
        if not is_separable:
            text += " These poles cannot be told apart."
    if hint and rival is not None and not is_separable and _relative_gap(ranking, rival) >= MIN_RELEVANT_LEAD:
        text += f" {hint}"
    if len(ranking.close) > 1:
        names = list_first([site.site for site in ranking.close], 4)
        text += f" {len(ranking.close)} other sites score within {format_percent(CLOSE_SHARE, 0)} of the best: {names}."
    return text


def _best_on_another_pole(ranking: Ranking) -> RankedSite | None:
    """Return the best site that is on no pole of a best one; None without such a site."""
    best_poles = {site.pole for site in ranking.best}
    return next((site for site in ranking.sites if site.pole not in best_poles), None)


def _format_probability(ranking: Ranking, site: RankedSite, comparison: str) -> str:
    """Return how probable the lead of the best site is, in brackets; empty if that is unknown."""
    if site.best_beats is None:
        return ""
    owner = "it is" if len(ranking.best) == 1 or comparison == "worse" else "they are"
    return f" ({owner} truly {comparison} with a probability of {format_probability(site.best_beats)})"


def _relative_gap(ranking: Ranking, site: RankedSite) -> float:
    """Return how far a site is behind the best one: in share, or relative to the best score for scores in units."""
    best_score = ranking.best[0].score
    gap = best_score - site.score
    return gap if ranking.by.is_share else gap / best_score


def _format_gap(ranking: Ranking, second: RankedSite) -> str:
    """Return the lead of the best site: in percentage points for shares, relative to its score otherwise."""
    best_score = ranking.best[0].score
    is_share = ranking.by.is_share
    gap, error = _relative_gap(ranking, second), second.behind_best_se
    gap_text = f"{100.0 * gap:.1f}" if gap >= _MIN_LEAD else "less than 0.1"
    if error is not None:
        if not is_share:
            error /= best_score
        decimals = 1 if error >= _MIN_LEAD else 2
        gap_text = f"{100.0 * gap:.{decimals}f} ± {100.0 * error:.{decimals}f}"
    if is_share:
        return f"{gap_text} percentage points"
    owner = by_number(len(ranking.best), "its", "their")
    return f"{gap_text} % of {owner} score"


def entropy_seen_note(ranking: Ranking) -> str:
    """Return a sentence on the site that sees most entropy; empty if a score other than the EGVS ranks."""
    top = max(ranking.best, key=lambda site: site.entropy_seen)
    most = max(ranking.sites, key=lambda site: site.entropy_seen)
    if ranking.is_tie or top.rank_by != "egvs" or not top.egvs > 0:
        return ""
    if most.entropy_seen - top.entropy_seen < _MIN_LEAD:
        subject = "It" if len(ranking.best) == 1 else top.site
        return (
            f"{subject} also sees the largest share of the traffic’s uncertainty, {format_percent(top.entropy_seen)}."
        )
    return (
        f"{most.site}, rank {most.rank}, sees more of the traffic’s uncertainty "
        f"({format_percent(most.entropy_seen)} against {format_percent(top.entropy_seen)}), but with fewer beams. "
        "One beam is enough for a voxel to count as seen, but not to detect a vehicle."
    )


def site_caption(site: RankedSite, visible_voxels: int, voxels: int) -> str:
    """Return the position and the counts of one site."""
    return (
        f"{site.site}: rank {site.rank}, {site.by.with_noun(site.score)}, at x = {format_number(site.x_m)} m, "
        f"y = {format_number(site.y_m)} m, z = {format_number(site.z_m)} m, with a {site.sensor}. "
        f"It sees {format_count(visible_voxels)} of {format_count(voxels)} uncertain voxels. "
        f"{format_count(site.beams_in_roi)} of its beams can reach the region; {format_count(site.returns)} of "
        "them hit the ground or an object."
    )


def share_of_limit(site: RankedSite) -> float | None:
    """Return the EGVS as a share of its upper limit; None if there is no finite limit above 0."""
    limit = site.egvs_limit
    if not (limit > 0 and math.isfinite(limit)):
        return None
    return site.egvs / limit
