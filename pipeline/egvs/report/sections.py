"""What other commands add to the page: plan, validation, accuracy study, evidence.

What validation found of the sites of a run: how far the order by EGVS and the order by detection agree.

What the study says of scores (docs/validity.md), and where two of them rank the first sites of a run otherwise.

The numbers stand here alone, taken from the study's tables: Spearman's rho of a score with what a detector finds, over
the sites of the junctions that chose nothing. What is not measured is not there, and nothing is said of it.

A plan of several sensors that was made of what a run ran on: who stands where, what each adds, what is proved.

An accuracy study of what a run ran on: the settings that the page shows, and the study's figure.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import combinations
from pathlib import Path
from typing import Any

from egvs.artefacts.readers import read_accuracy, read_placement, read_validation
from egvs.artefacts.run_folder import ACCURACY_FILES, PLACEMENT_FILES, VALIDATION_FILES
from egvs.artefacts.run_record import StageRecord
from egvs.artefacts.tpog import Tpog
from egvs.core.errors import Diagnostic, collect_warnings
from egvs.report import maps, svg_figures
from egvs.report.formatting import SCORE_LABELS, ScoreLabel
from egvs.report.maps import Backdrop, PlannedPole
from egvs.report.ranking import RankedSite
from egvs.report.svg_figures import CurveStep, MapSite
from egvs.scenario.score_config import DEFAULT_SCORE

_ALL_OBJECTS = "vehicles"
"""The set of all objects, in ``detection.parquet``."""

_MEASURE_LABELS = {
    "ap_combined_r40_iou70": "average precision from above plus that in space, up to 200 %",
    "seen_20": "vehicles with 20 points or more",
}
"""Measures in words."""


@dataclass(frozen=True)
class SiteDetection:
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
    sites: Mapping[str, SiteDetection]

    def agreement(self, scored: Sequence[RankedSite]) -> str:
        """How far the two orders agree, in a sentence."""
        tau, low, high = self.tau
        known = [(site.egvs, its.value) for site in scored if (its := self.sites[site.site]).value is not None]
        turns = [
            math.copysign(1.0, (a - c) * (b - d)) for (a, b), (c, d) in combinations(known, 2) if a != c and b != d
        ]
        if math.isnan(tau) or not turns:
            return f"{_format_sites(len(known))} with values: too few, or too much alike, to compare two orders."
        share = sum(turn > 0 for turn in turns) / len(turns)
        between = "" if math.isnan(low) else f", between {low:.2f} and {high:.2f} with 95 % confidence"
        return (
            f"Of {_format_sites(len(known))}, the order by EGVS and the order by detection agree in {share:.0%} "
            f"of pairs "
            f"(Kendall's tau {tau:.2f}{between})."
        )

    def judgement(self, scored: Sequence[RankedSite]) -> str:
        """What a planner may take from it."""
        tau, low, high = self.tau
        count = _format_sites(sum(its.value is not None for its in self.sites.values()))
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
    warnings
        What was not unseen, or is not defined.
    figure
        In base 64.
    """

    detectors: tuple[DetectorSummary, ...]
    frames: int
    objects: int
    apart_s: float
    warnings: tuple[Diagnostic, ...]
    figure: str

    @classmethod
    def read(cls, out: Path, stages: Mapping[str, StageRecord]) -> ValidationSummary | None:
        """The validation of what ``stages`` ran on; None where there is none."""
        detection, correlation, figure = (out / name for name in VALIDATION_FILES)
        found = read_validation(detection, correlation) if figure.is_file() else None
        if found is None:
            return None
        rows, correlations, about = found
        if any(name not in stages or stages[name].inputs != key for name, key in about["stages"].items()):
            return None
        mine = [row for row in rows if row["objects_of"] == _ALL_OBJECTS]
        own = [row for row in correlations if about["own_score"] == {key: row[key] for key in ("score", "parameters")}]
        shown = [(name, about["shown"][name]) for name in dict.fromkeys(row["detector"] for row in mine)]
        detectors = tuple(_detector_summary(name, measure, mine, own) for name, measure in shown)
        picture = base64.b64encode(figure.read_bytes()).decode("ascii")
        return cls(
            detectors, about["frames"], mine[0]["objects"], about["apart_s"], tuple(collect_warnings([about])), picture
        )


def _detector_summary(
    name: str, measure: str, rows: Sequence[Mapping[str, Any]], correlations: Sequence[Mapping[str, Any]]
) -> DetectorSummary:
    (row,) = (its for its in correlations if (its["detector"], its["measure"]) == (name, measure))
    tau = (row["kendall"], row["kendall_low"], row["kendall_high"])
    mine = [row for row in rows if row["detector"] == name]
    values = [row[measure] for row in mine if not math.isnan(row[measure])]
    sites = {row["site"]: _site_detection(row[measure], row[f"{measure}_se"], values) for row in mine}
    return DetectorSummary(name, _MEASURE_LABELS.get(measure, measure.replace("_", " ")), tau, sites)


def _site_detection(value: float, se: float, values: Sequence[float]) -> SiteDetection:
    if math.isnan(value):
        return SiteDetection(None, None, None)
    return SiteDetection(value, None if math.isnan(se) else se, 1 + sum(other > value for other in values))


def _format_sites(count: int) -> str:
    return f"{count} site{'' if count == 1 else 's'}"


COMPARED_SITES = 3
"""So many of the best sites are held against each other."""

RHO: Mapping[str, Mapping[str, float]] = json.loads(
    Path(__file__).with_name("sections.json").read_text(encoding="utf-8")
)
"""Score -> detector -> rho with AP (BEV + 3D, IoU 0.7), given sites and grid of these junctions together: the table of
all scores under F in docs/validity-tables.md. The EGVS goes by its setting, as :func:`egvs_setting` names it."""


def egvs_setting(gamma: float, voxel_m: float, *, moving_occlusion: bool = False) -> str:
    """The EGVS of a run, as :data:`RHO` names it."""
    return f"egvs (gamma {gamma:g}, {'moving occlusion, ' if moving_occlusion else ''}voxel {voxel_m:g})"


def ranking_disagreement(
    sites: Sequence[RankedSite], egvs: str, rho: Mapping[str, Mapping[str, float]] | None = None
) -> str:
    """Where the EGVS and the recommended score put other sites first: which ones, and which of the two goes better with
    detection; nothing where they agree, or a score is not there.

    Parameters
    ----------
    egvs
        The setting of the run's EGVS, see :func:`egvs_setting`.
    rho
        Evidence, :data:`RHO` by default.
    """
    by_egvs, by_other = (_first_sites(sites, name) for name in ("egvs", DEFAULT_SCORE))
    if not by_egvs or not by_other or (by_egvs[0] == by_other[0] and set(by_egvs) == set(by_other)):
        return ""
    noun = SCORE_LABELS[DEFAULT_SCORE].noun
    what = f"The EGVS has {_join_names(by_egvs)} first, {noun} has {_join_names(by_other)}"
    return f"{what}: {_verdict(noun, egvs, RHO if rho is None else rho)}"


def _first_sites(sites: Sequence[RankedSite], name: str) -> tuple[str, ...]:
    """The best sites by one score, those of equal scores in the order of the sites; none where a value is missing."""
    values = [site.value_of(name) for site in sites]
    if any(value is None for value in values):
        return ()
    ranked = sorted(zip(sites, values, strict=True), key=lambda its: -float(its[1] or 0.0))
    return tuple(site.site for site, _ in ranked[:COMPARED_SITES])


def _verdict(noun: str, egvs: str, rho: Mapping[str, Mapping[str, float]]) -> str:
    """Which of the two detection agrees with, as far as was measured."""
    theirs, own = rho.get(DEFAULT_SCORE, {}), rho.get(egvs, {})
    shared = [name for name in theirs if name in own]
    if not shared:
        known = " and ".join(f"{value:.2f} ({name})" for name, value in theirs.items())
        besides = f"; {noun} goes with it at rho {known}, see docs/validity.md" if known else ""
        return f"how well this setting of the EGVS goes with detection was not measured{besides}."
    numbers = " and ".join(f"{theirs[name]:.2f} against {own[name]:.2f} ({name})" for name in shared)
    better = [theirs[name] > own[name] for name in shared]
    who = noun if all(better) else "the EGVS" if not any(better) else "neither"
    where = "rho with what is detected at junctions that chose nothing"
    return f"detection agrees with {who}, {where}: {numbers}; see docs/validity.md."


def _join_names(names: Sequence[str]) -> str:
    return ", ".join(names[:-1]) + f" and {names[-1]}" if len(names) > 1 else names[0]


@dataclass(frozen=True)
class PlanRow:
    """One sensor of the plan: the columns of ``placement.parquet`` that the page shows."""

    order: int
    site: str
    pole: str
    sensor: str
    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float
    pitch_deg: float
    forced: bool
    gain: float
    score: float
    cost: float
    loss: float


@dataclass(frozen=True)
class CurveRow:
    """What the best plan of so many sensors is worth; shares of what all candidates together would be."""

    count: int
    sites: tuple[str, ...]
    share: float
    certificate: float
    cost: float


@dataclass(frozen=True)
class PlacementSummary:
    """What ``egvs place`` found.

    Attributes
    ----------
    by
        The joint score in words.
    picks
        In the order in which they would be put up.
    curve
        For 1, 2, ... sensors.
    proof
        What is proved, in a sentence.
    before
        The joint score as the candidates hang, where sensors were to move from there; None else.
    map, chart
        Figures, SVG text.
    """

    by: ScoreLabel
    picks: tuple[PlanRow, ...]
    curve: tuple[CurveRow, ...]
    joint: float
    together: float
    cost: float
    candidates: int
    proof: str
    objective: str
    zones: tuple[Mapping[str, Any], ...]
    before: float | None
    map: str
    chart: str

    @classmethod
    def read(
        cls,
        out: Path,
        stages: Mapping[str, StageRecord],
        candidates: Sequence[MapSite],
        tpog: Tpog,
        backdrop: Backdrop,
    ) -> PlacementSummary | None:
        """The plan in a run's folder; None where there is none of what ``stages`` ran on."""
        found = read_placement(*(out / name for name in PLACEMENT_FILES))
        if found is None:
            return None
        rows, points, about = found
        if any(name not in stages or stages[name].inputs != key for name, key in about["stages"].items()):
            return None
        picks = tuple(PlanRow(**{name: row[name] for name in PlanRow.__dataclass_fields__}) for row in rows)
        its = about["plan"]
        by, together = SCORE_LABELS[its["score"]], its["together"] or math.inf
        curve = tuple(
            CurveRow(
                row["count"],
                tuple(json.loads(row["sites"])),
                row["score"] / together,
                _certificate(row["value"], row["bound"]),
                row["cost"],
            )
            for row in points
        )
        whole = 1.0 if its["asked"]["objective"] == "worst" else together  # of which values are shares already
        steps = [CurveStep(row["count"], row["value"] / whole, row["bound"] / whole) for row in points]
        occupied = tpog.counts.sum(axis=2) / tpog.frames
        names = ", ".join(pick.site for pick in picks)
        return cls(
            by=by,
            picks=picks,
            curve=curve,
            joint=its["joint"],
            together=its["together"],
            cost=its["cost"],
            candidates=its["candidates"],
            proof=_describe_proof(its, len(picks)),
            objective=_describe_objective(its["asked"]),
            zones=tuple(its["zones"]),
            before=its["moves"]["before"] if "moves" in its else None,
            map=maps.plan_map(
                tpog.grid,
                occupied,
                backdrop,
                candidates,
                _planned_poles(picks, its["joint"], by),
                f"Map of the plan: {names}.",
            ),
            chart=svg_figures.sensor_count_chart(
                steps, "How much each number of sensors is worth, and what no plan of so many exceeds."
            ),
        )

    @property
    def share(self) -> float:
        """Of what all candidates together would be worth."""
        return self.joint / self.together if self.together else 0.0

    def lost(self, pick: PlanRow) -> float:
        """The share of the plan's score that goes when a sensor fails."""
        return pick.loss / self.joint if self.joint else 0.0


def _certificate(value: float, bound: float) -> float:
    """The share of the best possible that is proved; 1 up to the rounding of bounds."""
    return 1.0 if bound <= value * (1.0 + 2e-9) else value / bound


def _describe_proof(metadata: Mapping[str, Any], sensors: int) -> str:
    proved = f"at least {math.floor(1e4 * metadata['certificate']) / 1e2:.2f} % of the best possible is proved"
    if metadata["fewest_is_proved"] is not None:
        if sensors == 1:
            return "one is enough"
        fewer = f"{sensors - 1} sensor{'' if sensors == 2 else 's'}"
        return f"that {fewer} cannot reach it is {'proved' if metadata['fewest_is_proved'] else 'not proved'}"
    return "that no plan within the rules is better is proved" if metadata["is_best"] else proved


def _describe_objective(request: Mapping[str, Any]) -> str:
    """What was asked for, where it is not the joint score itself; empty else."""
    parts = ["the period that is seen worst"] if request["objective"] == "worst" else []
    parts += ["what is left when the sensor that is missed most has failed"] if request["survives"] else []
    return " and ".join(parts)


def _planned_poles(picks: Sequence[PlanRow], joint: float, by: ScoreLabel) -> list[PlannedPole]:
    """One mark a place; sensors at one place share it."""
    places: dict[tuple[float, float], list[PlanRow]] = {}
    for pick in picks:
        places.setdefault((pick.x_m, pick.y_m), []).append(pick)
    return [
        PlannedPole(
            x_m,
            y_m,
            ", ".join(str(pick.order) for pick in those),
            f"{those[0].site}{f' +{len(those) - 1}' if len(those) > 1 else ''}: {_gain_share(those, joint):.0%}",
            "; ".join(
                f"{p.order}. {p.site}, {p.z_m:g} m high, adds {by.value(p.gain)} {by.unit}".strip() for p in those
            ),
        )
        for (x_m, y_m), those in places.items()
    ]


def _gain_share(picks: Sequence[PlanRow], joint: float) -> float:
    return sum(pick.gain for pick in picks) / joint if joint else 0.0


@dataclass(frozen=True)
class StudiedSetting:
    """One setting of an accuracy study: the columns of ``accuracy.parquet`` that the page shows."""

    setting: str
    kind: str
    overrides: str
    seconds: float
    error: float
    error_se: float
    tau: float
    regret: float
    best_kept: bool
    default: bool
    front: bool
    recommended: bool


@dataclass(frozen=True)
class StudySummary:
    """What ``egvs accuracy`` found: the settings that the page shows, and the figure in base 64."""

    settings: tuple[StudiedSetting, ...]
    tolerance: float
    figure: str

    @classmethod
    def read(cls, out: Path, stages: Mapping[str, StageRecord]) -> StudySummary | None:
        """A study of what ``stages`` ran on: the scenario's own setting, the reference, the front, the default; None
        where there is no such study.
        """
        table, figure = (out / name for name in ACCURACY_FILES)
        study = read_accuracy(table) if figure.is_file() else None
        if study is None:
            return None
        rows, about = study
        if any(name not in stages or stages[name].inputs != key for name, key in about["stages"].items()):
            return None
        names = [column.name for column in fields(StudiedSetting)]
        settings = (StudiedSetting(**{name: row[name] for name in names}) for row in rows)
        kinds = ("scenario", "reference")
        shown = tuple(s for s in settings if s.kind in kinds or s.front or s.recommended or s.default)
        return cls(shown, about["tolerance"], base64.b64encode(figure.read_bytes()).decode("ascii"))

    @property
    def best(self) -> StudiedSetting | None:
        """The recommended setting."""
        return next((setting for setting in self.settings if setting.recommended), None)
