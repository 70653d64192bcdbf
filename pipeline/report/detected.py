"""What validation found of the sites of a run: how far the order by EGVS and the order by detection agree."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

from pipeline.artefacts.readers import read_validation
from pipeline.artefacts.run_record import StageRecord
from pipeline.core.findings import Finding, warnings_of
from pipeline.report.ranking import ScoredSite

VALIDATION = ("detection.parquet", "correlation.parquet", "validation.png")
"""Shown where the scores of the same settings and files were validated in the run's folder."""

_ALL = "vehicles"
"""The set of all objects, in ``detection.parquet``."""

_MEASURES = {
    "ap_combined_r40_iou70": "average precision from above plus that in space, up to 200 %",
    "seen_20": "vehicles with 20 points or more",
}
"""Measures in words."""


@dataclass(frozen=True)
class SiteDetected:
    """What a detector finds from a site.

    Attributes
    ----------
    value, se
        A share; None where it is not defined.
    rank
        1 is best, equal ones share a rank; None without a value.
    """

    value: float | None
    se: float | None
    rank: int | None


@dataclass(frozen=True)
class DetectorSummary:
    """How detection by one detector goes with the score.

    Attributes
    ----------
    measure
        What stands for detection, in words.
    tau
        Kendall's, with the ends of its interval of 95 %; not a number where they are not defined.
    sites
        By name.
    """

    name: str
    measure: str
    tau: tuple[float, float, float]
    sites: Mapping[str, SiteDetected]

    def agreement(self, scored: Sequence[ScoredSite]) -> str:
        """How far the two orders agree, in a sentence."""
        tau, low, high = self.tau
        known = [(site.egvs, its.value) for site in scored if (its := self.sites[site.site]).value is not None]
        turns = [
            math.copysign(1.0, (a - c) * (b - d)) for (a, b), (c, d) in combinations(known, 2) if a != c and b != d
        ]
        if math.isnan(tau) or not turns:
            return f"{_sites(len(known))} with values: too few, or too much alike, to compare two orders."
        share = sum(turn > 0 for turn in turns) / len(turns)
        between = "" if math.isnan(low) else f", between {low:.2f} and {high:.2f} with 95 % confidence"
        return (
            f"Of {_sites(len(known))}, the order by EGVS and the order by detection agree in {share:.0%} of pairs "
            f"(Kendall's tau {tau:.2f}{between})."
        )

    def judgement(self, scored: Sequence[ScoredSite]) -> str:
        """What a planner may take from it."""
        tau, low, high = self.tau
        count = _sites(sum(its.value is not None for its in self.sites.values()))
        if math.isnan(tau):
            return ""
        if math.isnan(low):
            verdict = f"How sure that is cannot be told from {count}."
        elif low <= 0.0 <= high:
            verdict = f"{count} do not tell: the interval holds 0, and chance alone may order sites like this."
        elif low > 0.0:
            verdict = "That is more than chance: a site with a higher score tends to detect more."
        else:
            verdict = "The score orders these sites the wrong way round: one with a higher score tends to detect less."
        best = self.sites[scored[0].site]
        where = "" if best.rank is None else f" The best by score, {scored[0].site}, has rank {best.rank} by detection."
        return verdict + where


@dataclass(frozen=True)
class ValidationSummary:
    """What ``egvs validate`` found, as the page shows it.

    Attributes
    ----------
    frames, objects
        Of the traffic that sites were judged by.
    apart_s
        Time between two frames, at least.
    doubts
        What was not unseen, or is not defined.
    figure
        In base 64.
    """

    detectors: tuple[DetectorSummary, ...]
    frames: int
    objects: int
    apart_s: float
    doubts: tuple[Finding, ...]
    figure: str

    @classmethod
    def read(cls, out: Path, stages: Mapping[str, StageRecord]) -> ValidationSummary | None:
        """The validation of what ``stages`` ran on; None where there is none."""
        detection, correlation, figure = (out / name for name in VALIDATION)
        found = read_validation(detection, correlation) if figure.is_file() else None
        if found is None:
            return None
        rows, correlations, about = found
        if any(name not in stages or stages[name].inputs != key for name, key in about["stages"].items()):
            return None
        mine = [row for row in rows if row["objects_of"] == _ALL]
        own = [row for row in correlations if about["own_score"] == {key: row[key] for key in ("score", "parameters")}]
        shown = [(name, about["shown"][name]) for name in dict.fromkeys(row["detector"] for row in mine)]
        detectors = tuple(_summary(name, measure, mine, own) for name, measure in shown)
        picture = base64.b64encode(figure.read_bytes()).decode("ascii")
        return cls(
            detectors, about["frames"], mine[0]["objects"], about["apart_s"], tuple(warnings_of([about])), picture
        )


def _summary(
    name: str, measure: str, rows: Sequence[Mapping[str, Any]], correlations: Sequence[Mapping[str, Any]]
) -> DetectorSummary:
    (row,) = (its for its in correlations if (its["detector"], its["measure"]) == (name, measure))
    tau = (row["kendall"], row["kendall_low"], row["kendall_high"])
    mine = [row for row in rows if row["detector"] == name]
    values = [row[measure] for row in mine if not math.isnan(row[measure])]
    sites = {row["site"]: _site(row[measure], row[f"{measure}_se"], values) for row in mine}
    return DetectorSummary(name, _MEASURES.get(measure, measure.replace("_", " ")), tau, sites)


def _site(value: float, se: float, values: Sequence[float]) -> SiteDetected:
    if math.isnan(value):
        return SiteDetected(None, None, None)
    return SiteDetected(value, None if math.isnan(se) else se, 1 + sum(other > value for other in values))


def _sites(count: int) -> str:
    return f"{count} site{'' if count == 1 else 's'}"
