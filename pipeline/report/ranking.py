"""The ranking of the sites: their order, the best, those that come close, the extremes."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import pyarrow as pa

from pipeline.artefacts import schemas, tables
from pipeline.artefacts.readers import SEPARABLE
from pipeline.core.errors import InputError
from pipeline.report.drawing.map_frame import MapSite
from pipeline.report.score_words import SCORES, ScoreWords
from pipeline.scenario.score import RECOMMENDED

CLOSE = 0.01
"""Sites within this share of the best score are named beside it."""


@dataclass(frozen=True)
class ScoredSite(MapSite):
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
    own: tuple[tuple[str, str], ...] = ()
    """The user's own columns of the sites file and what stands there, as texts."""
    rank_by: str = "egvs"
    others: tuple[tuple[str, float, float | None], ...] = ()

    @classmethod
    def all_of(cls, scores: pa.Table, rank_by: str = "egvs") -> tuple[ScoredSite, ...]:
        """The rows of ``scores.parquet``, in its order; ``rank_by`` is what its metadata says."""
        names = [column.name for column in fields(cls) if column.name in scores.column_names]
        known = {*schemas.names("scores"), *names}
        foreign = [name for name in scores.column_names if name not in known]
        rows, own = scores.select(names).to_pylist(), scores.select(foreign).to_pylist()
        texts = (tuple((name, _text(value)) for name, value in values.items()) for values in own)
        others = _others(scores)
        return tuple(
            cls(**{name: _known(value) for name, value in row.items()}, own=its, rank_by=rank_by, others=values)
            for row, its, values in zip(rows, texts, others, strict=True)
        )

    @classmethod
    def read(cls, path: Path) -> tuple[ScoredSite, ...]:
        """From ``scores.parquet``."""
        scores, about = tables.read(path, "scores")
        return cls.all_of(scores, about.get("rank_by", "egvs"))

    @property
    def by(self) -> ScoreWords:
        """The score that ranks."""
        return SCORES[self.rank_by]

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
        value: float | None = _known(known.get(name))
        return value

    @property
    def is_separable(self) -> bool:
        """Whether the site is told apart from the one below it, as far as is known."""
        return self.beats_next is None or self.beats_next >= SEPARABLE


def _others(scores: pa.Table) -> list[tuple[tuple[str, float, float | None], ...]]:
    """The scores beside the EGVS that have a column of their own, site by site."""
    columns = scores.select([name for name in scores.column_names if name.removesuffix("_se") in SCORES]).to_pydict()
    names = [name for name in SCORES if name != "egvs" and name in columns]
    return [tuple((n, columns[n][i], _known(columns[n + "_se"][i]) if n + "_se" in columns else None) for n in names)
            for i in range(len(scores))]  # fmt: skip


def _known(value: Any) -> Any:
    """A value, None where it is not a number."""
    return None if isinstance(value, float) and math.isnan(value) else value


def _text(value: object) -> str:
    """A value of a user's own column as text; empty where there is none."""
    return "" if value is None else f"{value:.12g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Pole:
    """The candidates of one place, by rank; at least one."""

    name: str
    sites: tuple[ScoredSite, ...]

    @property
    def best(self) -> ScoredSite:
        """The best candidate there."""
        return self.sites[0]

    @property
    def gain(self) -> float | None:
        """By how much its best candidate beats its worst, as a share of the worst; None for one, or from nothing."""
        worst = self.sites[-1].score
        return self.best.score / worst - 1 if len(self.sites) > 1 and worst > 0 else None

    @property
    def own(self) -> tuple[str, ...]:
        """What the user's own columns say there; several texts of one column side by side."""
        columns = zip(*(site.own for site in self.sites), strict=True)
        return tuple(", ".join(filter(None, dict.fromkeys(text for _, text in column))) for column in columns)


def beside(sites: Sequence[ScoredSite]) -> ScoreWords | None:
    """The score that is shown beside the one that ranks these sites: the EGVS; where that ranks, the recommended one or
    the share of vehicles seen well. None where that has no values."""
    names = (RECOMMENDED, "seen_well") if sites and sites[0].rank_by == "egvs" else ("egvs",)
    return next((SCORES[n] for n in names if sites and all(site.value_of(n) is not None for site in sites)), None)


def poles_of(by_rank: Iterable[ScoredSite]) -> tuple[Pole, ...]:
    """The poles, the one with the best candidate first, of candidates by rank."""
    grouped: dict[str, list[ScoredSite]] = {}
    for site in by_rank:
        grouped.setdefault(site.pole, []).append(site)
    return tuple(Pole(name, tuple(sites)) for name, sites in grouped.items())


@dataclass(frozen=True)
class Ranking:
    """Sites by rank, those of equal rank in the order of the sites; at least one.

    The ``best`` are those of rank 1, the ``close`` ones follow within ``CLOSE`` of the best score.
    """

    sites: tuple[ScoredSite, ...]
    best: tuple[ScoredSite, ...]
    close: tuple[ScoredSite, ...]

    @classmethod
    def read(cls, path: Path) -> Ranking:
        """From ``scores.parquet``; InputError when it holds no site."""
        scored = ScoredSite.read(path)
        if not scored:
            raise InputError(path, "holds no site", "at least one; run the score stage again")
        sites = tuple(sorted(scored, key=lambda s: s.rank))
        best = tuple(s for s in sites if s.rank == 1)
        near = (1 - CLOSE) * best[0].score
        return cls(sites, best, tuple(s for s in sites if s.rank > 1 and s.score >= near > 0))

    @property
    def last(self) -> ScoredSite:
        """The worst site."""
        return self.sites[-1]

    @cached_property
    def poles(self) -> tuple[Pole, ...]:
        """The poles, the one with the best candidate first."""
        return poles_of(self.sites)

    @property
    def own_names(self) -> tuple[str, ...]:
        """The user's own columns of the sites file."""
        return tuple(name for name, _ in self.sites[0].own)

    @property
    def is_tie(self) -> bool:
        """Whether no site is better than another."""
        return len(self.best) == len(self.sites)

    @property
    def extremes(self) -> tuple[ScoredSite, ...]:
        """The best and the worst site; one where they score the same."""
        return self.sites[:1] if self.is_tie else (self.sites[0], self.last)

    @property
    def has_errors(self) -> bool:
        """Whether standard errors were computed."""
        return self.sites[0].egvs_se is not None

    @property
    def by(self) -> ScoreWords:
        """The score that ranks."""
        return self.best[0].by

    @property
    def beside(self) -> ScoreWords | None:
        """The score that is shown beside it: the EGVS, or the recommended one where that ranks; None where it has no
        values."""
        return beside(self.sites)

    @property
    def is_located(self) -> bool:
        """Whether longitude and latitude are known."""
        return self.sites[0].latitude_deg is not None

    @cached_property
    def shared_ranks(self) -> set[int]:
        """Ranks that several sites have."""
        return {rank for rank, count in Counter(s.rank for s in self.sites).items() if count > 1}

    def of_best(self, site: ScoredSite) -> float:
        """A score as a share of the best one; 0 where that is 0."""
        top = self.best[0].score
        return site.score / top if top > 0 else 0.0
