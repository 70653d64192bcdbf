"""The order of sites, poles, close runners-up, and the sentences about them.

The ranking of the sites: their order, the best, those that come close, the extremes.

The sentences and numbers of the report, in plain words.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import pyarrow as pa

from egvs.artefacts import parquet
from egvs.artefacts.readers import DISTINCT_PROBABILITY
from egvs.core.errors import InputError
from egvs.report.formatting import SCORE_LABELS, ScoreLabel, format_count, format_number, format_percent
from egvs.report.svg_figures import MapSite
from egvs.scenario.score_config import DEFAULT_SCORE

CLOSE_SHARE = 0.01
"""Sites within this share of the best score are named beside it."""


@dataclass(frozen=True)
class RankedSite(MapSite):
    """What is shown of a row of ``scores.parquet``; see its schema for units.

    ``egvs_se`` and ``beats_next`` are None where no standard errors were computed, longitude and latitude where nobody
    knows where the world frame lies. ``others`` are the scores that stand beside the EGVS, with value and standard
    error.
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
    longitude_deg: float | None = None
    latitude_deg: float | None = None
    user_columns: tuple[tuple[str, str], ...] = ()
    """The user's own columns of the sites file and what stands there, as texts."""
    rank_by: str = "egvs"
    others: tuple[tuple[str, float, float | None], ...] = ()

    @classmethod
    def all_of(cls, scores: pa.Table, rank_by: str = "egvs") -> tuple[RankedSite, ...]:
        """The rows of ``scores.parquet``, in its order; ``rank_by`` is what its metadata says."""
        names = [column.name for column in fields(cls) if column.name in scores.column_names]
        known = {*parquet.column_names("scores"), *names}
        foreign = [name for name in scores.column_names if name not in known]
        rows, own = scores.select(names).to_pylist(), scores.select(foreign).to_pylist()
        texts = (tuple((name, _format_user_value(value)) for name, value in values.items()) for values in own)
        others = _other_scores(scores)
        return tuple(
            cls(
                **{name: _none_if_nan(value) for name, value in row.items()},
                user_columns=its,
                rank_by=rank_by,
                others=values,
            )
            for row, its, values in zip(rows, texts, others, strict=True)
        )

    @classmethod
    def read(cls, path: Path) -> tuple[RankedSite, ...]:
        """From ``scores.parquet``."""
        scores, about = parquet.read_artefact(path, "scores")
        return cls.all_of(scores, about.get("rank_by", "egvs"))

    @property
    def by(self) -> ScoreLabel:
        """The score that ranks."""
        return SCORE_LABELS[self.rank_by]

    @property
    def score(self) -> float:
        """Its value of the score that ranks."""
        value = self.value_of(self.rank_by)
        return self.egvs if value is None else value

    @property
    def score_se(self) -> float | None:
        """The standard error of the score that ranks; None where it is not known."""
        return (
            self.egvs_se if self.rank_by == "egvs" else next((s for n, _, s in self.others if n == self.rank_by), None)
        )

    def value_of(self, name: str) -> float | None:
        """Its value of a score; None where there is none, or it is not defined."""
        known = {"egvs": self.egvs, "entropy_seen": self.entropy_seen} | {n: value for n, value, _ in self.others}
        value: float | None = _none_if_nan(known.get(name))
        return value

    @property
    def is_separable(self) -> bool:
        """Whether the site is told apart from the one below it, as far as is known."""
        return self.beats_next is None or self.beats_next >= DISTINCT_PROBABILITY


def _other_scores(scores: pa.Table) -> list[tuple[tuple[str, float, float | None], ...]]:
    """The scores beside the EGVS that have a column of their own, site by site."""
    columns = scores.select(
        [name for name in scores.column_names if name.removesuffix("_se") in SCORE_LABELS]
    ).to_pydict()
    names = [name for name in SCORE_LABELS if name != "egvs" and name in columns]
    return [tuple((n, columns[n][i],
    _none_if_nan(columns[n + "_se"][i]) if n + "_se" in columns else None) for n in names)
            for i in range(len(scores))]  # fmt: skip


def _none_if_nan(value: Any) -> Any:
    """A value, None where it is not a number."""
    return None if isinstance(value, float) and math.isnan(value) else value


def _format_user_value(value: object) -> str:
    """A value of a user's own column as text; empty where there is none."""
    return "" if value is None else f"{value:.12g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Pole:
    """The candidates of one place, by rank; at least one."""

    name: str
    sites: tuple[RankedSite, ...]

    @property
    def best(self) -> RankedSite:
        """The best candidate there."""
        return self.sites[0]

    @property
    def gain(self) -> float | None:
        """By how much its best candidate beats its worst, as a share of the worst; None for one, or from nothing."""
        worst = self.sites[-1].score
        return self.best.score / worst - 1 if len(self.sites) > 1 and worst > 0 else None

    @property
    def user_columns(self) -> tuple[str, ...]:
        """What the user's own columns say there; several texts of one column side by side."""
        columns = zip(*(site.user_columns for site in self.sites), strict=True)
        return tuple(", ".join(filter(None, dict.fromkeys(text for _, text in column))) for column in columns)


def companion_score(sites: Sequence[RankedSite]) -> ScoreLabel | None:
    """The score that is shown beside the one that ranks these sites: the EGVS; where that ranks, the recommended one or
    the share of vehicles seen well. None where that has no values."""
    names = (DEFAULT_SCORE, "seen_well") if sites and sites[0].rank_by == "egvs" else ("egvs",)
    return next((SCORE_LABELS[n] for n in names if sites and all(site.value_of(n) is not None for site in sites)), None)


def group_by_pole(by_rank: Iterable[RankedSite]) -> tuple[Pole, ...]:
    """The poles, the one with the best candidate first, of candidates by rank."""
    grouped: dict[str, list[RankedSite]] = {}
    for site in by_rank:
        grouped.setdefault(site.pole, []).append(site)
    return tuple(Pole(name, tuple(sites)) for name, sites in grouped.items())


@dataclass(frozen=True)
class Ranking:
    """Sites by rank, those of equal rank in the order of the sites; at least one.

    The ``best`` are those of rank 1, the ``close`` ones follow within ``CLOSE`` of the best score.
    """

    sites: tuple[RankedSite, ...]
    best: tuple[RankedSite, ...]
    close: tuple[RankedSite, ...]

    @classmethod
    def read(cls, path: Path) -> Ranking:
        """From ``scores.parquet``; InputError when it holds no site."""
        scored = RankedSite.read(path)
        if not scored:
            raise InputError(path, "holds no site", "at least one; run the score stage again")
        sites = tuple(sorted(scored, key=lambda s: s.rank))
        best = tuple(s for s in sites if s.rank == 1)
        near = (1 - CLOSE_SHARE) * best[0].score
        return cls(sites, best, tuple(s for s in sites if s.rank > 1 and s.score >= near > 0))

    @property
    def last(self) -> RankedSite:
        """The worst site."""
        return self.sites[-1]

    @cached_property
    def poles(self) -> tuple[Pole, ...]:
        """The poles, the one with the best candidate first."""
        return group_by_pole(self.sites)

    @property
    def user_column_names(self) -> tuple[str, ...]:
        """The user's own columns of the sites file."""
        return tuple(name for name, _ in self.sites[0].user_columns)

    @property
    def is_tie(self) -> bool:
        """Whether no site is better than another."""
        return len(self.best) == len(self.sites)

    @property
    def extremes(self) -> tuple[RankedSite, ...]:
        """The best and the worst site; one where they score the same."""
        return self.sites[:1] if self.is_tie else (self.sites[0], self.last)

    @property
    def has_errors(self) -> bool:
        """Whether standard errors were computed."""
        return self.sites[0].egvs_se is not None

    @property
    def by(self) -> ScoreLabel:
        """The score that ranks."""
        return self.best[0].by

    @property
    def companion_score(self) -> ScoreLabel | None:
        """The score that is shown beside it: the EGVS, or the recommended one where that ranks; None where it has no
        values."""
        return companion_score(self.sites)

    @property
    def is_located(self) -> bool:
        """Whether longitude and latitude are known."""
        return self.sites[0].latitude_deg is not None

    @cached_property
    def shared_ranks(self) -> set[int]:
        """Ranks that several sites have."""
        return {rank for rank, count in Counter(s.rank for s in self.sites).items() if count > 1}

    def of_best(self, site: RankedSite) -> float:
        """A score as a share of the best one; 0 where that is 0."""
        top = self.best[0].score
        return site.score / top if top > 0 else 0.0


def headline(ranking: Ranking, has_traffic: bool) -> str:
    """The outcome in one sentence."""
    best, others = ranking.best, len(ranking.sites) - 1
    top = best[0]
    if not has_traffic:
        return "No traffic in the region: the sites cannot be ranked"
    if not top.score > 0:
        return "No site sees anything of the traffic" if others else f"{top.site} sees nothing of the traffic"
    sees = f"sees {format_percent(top.entropy_seen)} of the traffic’s uncertainty"
    if top.rank_by != "egvs":
        sees = top.by.sentence(top.score)
    if not others:
        return f"{top.site}, the only site, {sees}"
    if ranking.is_tie:
        same = f"All {len(best)} sites score the same"
        return f"{same}: each {sees}" if top.rank_by != "egvs" or len({s.entropy_seen for s in best}) == 1 else same
    if len(best) > 1:
        few = len(best) <= 4
        names = ", ".join(s.site for s in best[:-1]) if few else f"{top.site} and {len(best) - 2} others"
        return f"{names} and {best[-1].site} share the first place of {others + 1}: {top.site} {sees}"
    outcome = f"{top.site} is the best of {others + 1} sites"
    return outcome if top.rank_by == "egvs" else f"{outcome}: it {sees}"


def lead(ranking: Ranking) -> str:
    """By how much the best leads, and who comes close; nothing where nobody leads."""
    if ranking.is_tie or not ranking.best[0].score > 0:
        return ""
    second = ranking.sites[len(ranking.best)]
    behind = 1 - ranking.of_best(second)
    by = f"{behind:.1%}" if behind >= 0.0005 else "less than 0.1%"
    subject, whose = ("It leads", "its") if len(ranking.best) == 1 else ("They lead", "their")
    text = f"{subject} {second.site}, the next, by {by} of {whose} score."
    if not ranking.best[-1].is_separable:  # the last of the best is the one beside the next
        text += " With this much traffic they cannot be told apart."
    if len(ranking.close) > 1:
        names = ", ".join(s.site for s in ranking.close[:4])
        more = f" and {len(ranking.close) - 4} more" if len(ranking.close) > 4 else ""
        text += f" Within {CLOSE_SHARE:.0%} of the best are {len(ranking.close)} others: {names}{more}."
    return text


def entropy_seen_note(ranking: Ranking) -> str:
    """What entropy seen says beside the EGVS; nothing where another score ranks."""
    top, most = (max(sites, key=lambda site: site.entropy_seen) for sites in (ranking.best, ranking.sites))
    if ranking.is_tie or top.rank_by != "egvs" or not top.egvs > 0:
        return ""
    if most.entropy_seen - top.entropy_seen < 0.0005:
        it = "It" if len(ranking.best) == 1 else top.site
        return f"{it} also sees most of the traffic’s uncertainty, {format_percent(top.entropy_seen)}."
    return (
        f"{most.site}, rank {most.rank}, sees more of the traffic’s uncertainty "
        f"({format_percent(most.entropy_seen)} against "
        f"{format_percent(top.entropy_seen)}), but with fewer beams on it. A voxel counts as "
        f"seen from one beam on, and one beam detects no vehicle."
    )


def site_caption(site: RankedSite, visible_voxels: int, voxels: int) -> str:
    """One site in numbers."""
    return (
        f"{site.site}: rank {site.rank}, {site.by.with_noun(site.score)}, at x = {format_number(site.x_m)} m, "
        f"y = {format_number(site.y_m)} m, z = {format_number(site.z_m)} m, with a {site.sensor}. "
        f"It sees {format_count(visible_voxels)} of {format_count(voxels)} uncertain voxels. "
        f"{format_count(site.returns)} of its {format_count(site.beams_in_roi)} beams towards the region end on "
        f"the ground "
        f"or on what stands there."
    )


def share_of_limit(site: RankedSite) -> float | None:
    """A score as a share of what no site could exceed."""
    limit = site.egvs_limit
    return site.egvs / limit if limit > 0 and math.isfinite(limit) else None
