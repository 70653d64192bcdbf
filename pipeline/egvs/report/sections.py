"""Sections of the page on the results of other commands: ``egvs place``, ``egvs accuracy``.

A result is shown if it was computed from the same inputs as the run (:func:`_is_current`).

:func:`ranking_disagreement` compares the EGVS with the recommended score by the evidence of the validation study
(:mod:`egvs.results.study_results`); a setting that was not measured is not in it.
"""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import chain
from pathlib import Path
from typing import Any

from egvs.artefacts.readers import read_accuracy, read_placement
from egvs.artefacts.run_folder import ACCURACY_FILES, PLACEMENT_FILES
from egvs.artefacts.run_record import StageRecord, is_current
from egvs.artefacts.tpog import Tpog
from egvs.core.errors import Diagnostic
from egvs.core.wording import format_percent
from egvs.drawing import maps, svg_figures
from egvs.drawing.maps import Backdrop, PlannedPole
from egvs.drawing.svg_figures import CurveStep
from egvs.report import plan_answer
from egvs.results.labels import SCORE_LABELS, ScoreLabel, join_names
from egvs.results.plans import PlanStep, plan_steps
from egvs.results.ranking import MapSite, Pole, RankedSite
from egvs.results.study_results import STUDY
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import DEFAULT_SCORE, FROM_SENSOR
from egvs.scenario.signal_config import ASSUMED_PLANS
from egvs.sensors.sites import Pose, Site
from egvs.traffic.movements import MovementNames
from egvs.traffic.network import read_net_xml
from egvs.traffic.signal_descriptions import ASSUMED_SOURCE, plan_title

COMPARED_SITES = 3
"""Number of best sites that :func:`ranking_disagreement` compares."""

RHO_RANGE = (
    "{:.2f} to {:.2f}, depending on junction and detector; among sites of equal height, {:.2f} to {:.2f}".format(
        *STUDY.larger_study.rho, *STUDY.larger_study.rho_at_equal_height
    )
)
"""Rank correlation of the recommended score with detection, over the held-out junctions and the detectors of the larger
study (docs/validity.md)."""

FROM_SENSOR_NOTE = (
    "This detector measures heights from the sensor, and the score for it was tested at "
    f"{STUDY.heights_from_sensor.sites} sites of one junction only (docs/validity.md)."
)

NAMED_POLES = 5
"""Poles at the head of the ranking whose location in a lane is stated with the result."""

_FURTHER_SITES = re.compile(r" and \d+ more$")
"""End of the location of a warning that is the same for several sites."""

_SITES_ON_LANES = "sites on lanes"
"""Rule of the warnings of a check about sites in lanes or junctions."""

_TRAFFIC = re.compile(r"\btraffic\b(?! (?:light|sign))", re.IGNORECASE)
"""Found in entries of the key ``assumed`` on traffic; traffic lights and signs are not traffic."""


def _is_current(metadata: Mapping[str, Any], stages: Mapping[str, StageRecord]) -> bool:
    """Whether a result was computed from the same inputs as the run."""
    return is_current(metadata["stages"], stages)


def _read_base64(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode("ascii")


# ---- what the ranking rests on


def assumptions(scenario: Scenario, plans: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return what a scenario assumes rather than measures: its key ``assumed``, and traffic without any count.

    Parameters
    ----------
    scenario
        The scenario. Where it has plans of signals, those that are still assumed are named, if there are any.
    plans
        Plans of the signals in the region, from the summary of the traffic
        (:func:`egvs.traffic.signal_descriptions.describe_signals`).
    """
    traffic = scenario.traffic
    assumed = scenario.assumed
    if traffic.signals and plans:
        remaining = [plan_title(plan) for plan in plans if plan["source"] == ASSUMED_SOURCE]
        named = (f"{ASSUMED_PLANS} of {join_names(remaining)}",) if remaining else ()
        assumed = tuple(chain.from_iterable(named if entry == ASSUMED_PLANS else (entry,) for entry in assumed))
    has_demand = traffic.network is None or bool(traffic.counts or traffic.routes)
    if has_demand or any(period.counts or period.routes for period in traffic.periods):
        return assumed
    return (*assumed, "traffic (random trips)")


def describe_poles_on_road(poles: Iterable[Pole], warnings: Iterable[Diagnostic]) -> list[str]:
    """Return a phrase for each pole in a lane or junction, e.g. ``"k02 stands in a lane of Main Street"``.

    Parameters
    ----------
    poles
        The poles.
    warnings
        Warnings of a run; those of the rule :data:`_SITES_ON_LANES` name sites.
    """
    where_of_site = {}
    for warning in warnings:
        if warning.rule != _SITES_ON_LANES:
            continue
        _, _, site = warning.where.partition(": site ")
        if site:
            where_of_site[_FURTHER_SITES.sub("", site)] = warning.problem.partition(" is ")[2]
        else:  # a list of all further sites
            for name in warning.problem.partition(": ")[2].split(", "):
                where_of_site[name] = "in a lane or junction"

    phrases = []
    for pole in poles:
        where = next((where_of_site[site.site] for site in pole.sites if site.site in where_of_site), None)
        if where is not None:
            phrases.append(f"{pole.name} stands {where}")
    return phrases


def describe_caveats(
    scenario: Scenario, result: str, poles_on_road: Sequence[str] = (), plans: Sequence[Mapping[str, Any]] = ()
) -> str:
    """Return what to check before one trusts a result, in one sentence; empty where there is nothing.

    Parameters
    ----------
    scenario
        Its assumptions are listed.
    result
        ``"ranking"`` or ``"plan"``.
    poles_on_road
        From :func:`describe_poles_on_road`.
    plans
        Plans of signals, as for :func:`assumptions`.
    """
    caveats = []
    if poles_on_road:
        caveats.append(join_names(poles_on_road))
    assumed = assumptions(scenario, plans)
    if assumed:
        caveats.append(f"assumed, not measured: {'; '.join(assumed)}")
    if not caveats:
        return ""
    return f"Before you trust this {result}: {'; '.join(caveats)}."


def assumes_flows(scenario: Scenario) -> bool:
    """Return whether the key ``assumed`` says that the traffic, hence the flows in ``counts``, is assumed."""
    return any(_TRAFFIC.search(entry) for entry in scenario.assumed)


def describe_counts(scenario: Scenario, network: Path | None) -> dict[str, str]:
    """Return the movement of each traffic count in words, by its location in the summary of the traffic.

    Parameters
    ----------
    scenario
        The counts.
    network
        The simulated network; None if the run folder has none.
    """
    periods = {name: period.traffic for name, period in scenario.by_period().items() if period.traffic.counts}
    if network is None or not periods:
        return {}
    x_m, y_m, _ = scenario.roi.center_m
    flows = [count for traffic in periods.values() for count in traffic.counts]
    names = MovementNames(read_net_xml(network), (x_m, y_m), flows)
    movements = {}
    for name, traffic in periods.items():
        period = f" ({name})" if name else ""
        for count in traffic.counts:
            movements[f"{count.title}{period}"] = names.describe(count.edge or count.from_edge or "", count.to_edge)
    return movements


# ---- evidence of the validation study


def egvs_setting(gamma: float, voxel_m: float, *, moving_occlusion: bool = False) -> str:
    """Return the key of an EGVS setting in :attr:`egvs.results.study_results.FirstStudy.rho`."""
    occlusion = "moving occlusion, " if moving_occlusion else ""
    return f"egvs (gamma {gamma:g}, {occlusion}voxel {voxel_m:g})"


def ranking_disagreement(
    sites: Sequence[RankedSite],
    egvs: str,
    rho: Mapping[str, Mapping[str, float]] = STUDY.first_study.rho,
    detectors: Sequence[str] = (),
) -> str:
    """Return sentences if the EGVS and the recommended score have different best sites; empty otherwise.

    Parameters
    ----------
    sites
        Sites with both scores; the result is empty if one is missing.
    egvs
        The EGVS setting of the run, from :func:`egvs_setting`.
    rho
        The evidence, by score and detector; that of the first study by default.
    detectors
        Detectors that the recommended score stands for.
    """
    by_egvs, by_other = best_sites(sites, "egvs"), best_sites(sites, DEFAULT_SCORE)
    if not by_egvs or not by_other or (by_egvs[0] == by_other[0] and set(by_egvs) == set(by_other)):
        return ""
    noun = SCORE_LABELS[DEFAULT_SCORE].noun
    evidence = FROM_SENSOR_NOTE if FROM_SENSOR in detectors else _describe_evidence(noun, egvs, rho)
    return f"The best sites by EGVS are {join_names(by_egvs)}; by {noun} they are {join_names(by_other)}. {evidence}"


def best_sites(sites: Sequence[RankedSite], name: str) -> tuple[str, ...]:
    """Return the best sites by one score, equal ones in the order of the sites; empty if a value is missing."""
    values = [site.value_of(name) for site in sites]
    if any(value is None for value in values):
        return ()
    ranked = sorted(zip(sites, values, strict=True), key=lambda pair: -float(pair[1] or 0.0))
    return tuple(site.site for site, _ in ranked[:COMPARED_SITES])


def _describe_evidence(noun: str, egvs: str, rho: Mapping[str, Mapping[str, float]]) -> str:
    """Sentences on how well both scores predicted detection in the study."""
    recommended, this_egvs = rho.get(DEFAULT_SCORE, {}), rho.get(egvs, {})
    detectors = [detector for detector in recommended if detector in this_egvs]
    if not detectors:
        text = "How well this setting of the EGVS predicts detection was not measured."
        if recommended:
            text += f" The rank correlation of {noun} with detection is {RHO_RANGE}; see docs/validity.md."
        return text

    is_better = [recommended[detector] > this_egvs[detector] for detector in detectors]
    if all(is_better):
        verdict = f"{noun} was the better predictor of detection"
    elif any(is_better):
        verdict = "neither score was consistently the better predictor of detection"
    else:
        verdict = "the EGVS was the better predictor of detection"
    values = join_names([f"{recommended[name]:.2f} against {this_egvs[name]:.2f} ({name})" for name in detectors])
    where = "At the held-out junctions of the validation study"
    return f"{where}, {verdict}: mean rank correlation {values}. That of {noun} is {RHO_RANGE}; see docs/validity.md."


# ---- egvs place


@dataclass(frozen=True)
class PlanRow:
    """One sensor of a plan: the columns of ``placement.parquet`` that the page shows."""

    order: int
    site: str
    pole: str
    sensor: str
    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float
    pitch_deg: float
    roll_deg: float
    forced: bool
    gain: float
    score: float
    cost: float
    loss: float
    score_se: float = math.nan
    gain_se: float = math.nan

    @classmethod
    def from_row(cls, row: Mapping[str, Any]) -> PlanRow:
        """Return a row of ``placement.parquet``; standard errors are NaN where it has none."""
        return cls(**{field.name: row[field.name] for field in fields(cls) if field.name in row})

    @property
    def mount(self) -> Site:
        """The sensor as a site, with the name of its candidate."""
        pose = Pose(self.x_m, self.y_m, self.z_m, self.yaw_deg, self.pitch_deg, self.roll_deg)
        return Site(self.site, pose, self.sensor)


@dataclass(frozen=True)
class CurveRow:
    """The best plan of each number of sensors; ``share`` is its part of the score of all candidates together."""

    step: PlanStep
    sites: tuple[str, ...]
    share: float
    certificate: float
    cost: float


@dataclass(frozen=True)
class PlacementSummary:
    """Results of ``egvs place``.

    Attributes
    ----------
    by
        Label of the joint score.
    picks
        Sensors in the order of the plan.
    curve
        Best plans of 1, 2, ... sensors.
    joint, together
        Joint score of the plan, and of all candidates together.
    errors_from
        How the standard errors were computed; or the reason why there are none.
    answer
        How many sensors are enough, in one or two sentences; may be empty.
    cost
        Total cost; 0 without costs.
    candidates
        Number of candidates.
    proof
        What is proved about the plan, in a sentence.
    objective
        What the plan maximises, if not the joint score; empty otherwise.
    zones
        Zones with a minimum share.
    before
        Joint score before the sensors were moved; None if they were not.
    map, chart
        Figures, SVG text.
    """

    by: ScoreLabel
    picks: tuple[PlanRow, ...]
    curve: tuple[CurveRow, ...]
    joint: float
    together: float
    errors_from: str
    answer: str
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
        """Read the plan in a run folder; None if there is none of this run.

        Parameters
        ----------
        out
            The run folder.
        stages
            Records of the stages of the run.
        candidates, tpog, backdrop
            Contents of the map.
        """
        result = read_placement(*(out / name for name in PLACEMENT_FILES))
        if result is None:
            return None
        rows, curve_rows, metadata = result
        if not _is_current(metadata, stages):
            return None
        plan = metadata["plan"]
        by, joint = SCORE_LABELS[plan["score"]], plan["joint"]
        picks = tuple(PlanRow.from_row(row) for row in rows)
        names = ", ".join(pick.site for pick in picks)
        before = None
        if "moves" in plan:
            before = plan["moves"]["before"]
        occupied = tpog.counts.sum(axis=2) / tpog.frames
        poles = _planned_poles(picks, joint, by)
        steps, objective = plan_steps(curve_rows), describe_objective(plan["asked"])
        curve = _curve(steps, curve_rows, plan["together"] or math.inf)
        installed = [plan_answer.InstalledSite(pick.site, pick.score, pick.score_se) for pick in picks]
        answer = plan_answer.describe_count(
            steps,
            by,
            plans=[plan_answer.CurvePlan(row.sites, row.cost) for row in curve],
            installed=[] if before is not None else installed,
            has_budget=plan["asked"]["budget"] is not None,
            objective=objective,
            next_count=plan_answer.next_count(steps, len(picks), plan["candidates"], plan["asked"]),
        )
        return cls(
            by=by,
            picks=picks,
            curve=curve,
            joint=joint,
            together=plan["together"],
            errors_from=plan.get("standard_errors", "the plan was made by an older version of egvs place"),
            answer=answer,
            cost=plan["cost"],
            candidates=plan["candidates"],
            proof=_describe_proof(plan, len(picks)),
            objective=objective,
            zones=tuple(plan["zones"]),
            before=before,
            map=maps.plan_map(tpog.grid, occupied, backdrop, candidates, poles, f"Map of the plan: {names}."),
            chart=_curve_chart(curve_rows, plan),
        )

    @property
    def share(self) -> float:
        """Joint score as a share of that of all candidates together."""
        if not self.together:
            return 0.0
        return self.joint / self.together

    @property
    def assumption(self) -> str:
        """What the joint score assumes, in a sentence; may be empty."""
        return plan_answer.describe_joint_score(self.by, len(self.picks))

    @property
    def has_errors(self) -> bool:
        """Whether there are standard errors."""
        return not any(math.isnan(row.step.score_se) for row in self.curve)

    @property
    def joint_text(self) -> str:
        """Joint score of the plan with its standard error and its unit."""
        se = self.picks[-1].score_se if self.picks else math.nan
        return f"{self.by.with_error(self.joint, se)} {self.by.unit}".rstrip()


def _curve(steps: Sequence[PlanStep], rows: Sequence[Mapping[str, Any]], together: float) -> tuple[CurveRow, ...]:
    curve = []
    for step, row in zip(steps, rows, strict=True):
        sites = tuple(json.loads(row["sites"]))
        certificate = _certificate(row["value"], row["bound"])
        curve.append(CurveRow(step, sites, step.score / together, certificate, row["cost"]))
    return tuple(curve)


def _curve_chart(rows: Sequence[Mapping[str, Any]], plan: Mapping[str, Any]) -> str:
    together = plan["together"] or math.inf
    if plan["asked"]["objective"] == "worst":
        together = 1.0  # the values of this objective are shares already
    steps = [CurveStep(row["count"], row["value"] / together, row["bound"] / together) for row in rows]
    alt = "Score of the best plan for each number of sensors, and its upper bound."
    return svg_figures.sensor_count_chart(steps, alt)


def _certificate(value: float, bound: float) -> float:
    """Share of the best possible value that is proved to be reached; 1 up to the rounding of bounds."""
    if bound <= value * (1.0 + 2e-9):
        return 1.0
    return value / bound


def _describe_proof(plan: Mapping[str, Any], sensors: int) -> str:
    if plan["fewest_is_proved"] is None:
        if plan["is_best"]:
            return "it is proved that no plan within the rules is better"
        percent = math.floor(1e4 * plan["certificate"]) / 1e2
        return f"the plan is proved to reach at least {percent:.2f} % of the best possible score"
    if sensors == 1:
        return "one sensor is enough"
    fewer = "1 sensor is" if sensors == 2 else f"{sensors - 1} sensors are"
    if plan["fewest_is_proved"]:
        return f"it is proved that {fewer} not enough"
    return f"it is not proved that {fewer} not enough"


def describe_objective(request: Mapping[str, Any]) -> str:
    """What the plan maximises, if not the joint score; empty otherwise."""
    parts = []
    if request["objective"] == "worst":
        parts.append("the score in the period with the lowest share")
    if request["survives"]:
        parts.append("the score that remains if the most important sensor fails")
    return " and ".join(parts)


def _planned_poles(picks: Sequence[PlanRow], joint: float, by: ScoreLabel) -> list[PlannedPole]:
    """One mark per location; sensors at the same location share it."""
    picks_of: dict[tuple[float, float], list[PlanRow]] = {}
    for pick in picks:
        picks_of.setdefault((pick.x_m, pick.y_m), []).append(pick)
    poles = []
    for (x_m, y_m), members in picks_of.items():
        name = members[0].site
        if len(members) > 1:
            name += f" +{len(members) - 1}"
        gain = 0.0
        if joint:
            gain = sum(pick.gain for pick in members) / joint
        numbers, sensors = [], []
        for pick in members:
            numbers.append(str(pick.order))
            sensor = f"{pick.order}. {pick.site}, {pick.z_m:g} m high, adds {by.value(pick.gain)} {by.unit}"
            sensors.append(sensor.strip())
        poles.append(
            PlannedPole(x_m, y_m, ", ".join(numbers), f"{name}: {format_percent(gain, 0)}", "; ".join(sensors))
        )
    return poles


# ---- egvs accuracy


@dataclass(frozen=True)
class StudiedSetting:
    """One setting of an accuracy study: the columns of ``accuracy.parquet`` that the page shows."""

    setting: str
    kind: str
    overrides: str
    seconds: float
    draws: int
    probability: float
    loss_points: float
    loss_se_points: float
    error: float
    best: str
    front: bool
    recommended: bool

    @property
    def is_listed(self) -> bool:
        """Whether the page shows it."""
        return self.kind == "scenario" or self.front or self.recommended

    @property
    def label(self) -> str:
        """Name in a sentence or a table."""
        return "the scenario’s own setting" if self.kind == "scenario" else self.setting


@dataclass(frozen=True)
class StudySummary:
    """Results of ``egvs accuracy``: the settings that the page shows, and the figure (PNG in base 64)."""

    settings: tuple[StudiedSetting, ...]
    best: StudiedSetting
    tolerance_points: float
    score_tolerance: float | None
    figure: str

    @classmethod
    def read(cls, out: Path, stages: Mapping[str, StageRecord]) -> StudySummary | None:
        """Read the study in a run folder; None if there is none of this run."""
        table, figure = (out / name for name in ACCURACY_FILES)
        if not figure.is_file():
            return None
        study = read_accuracy(table)
        if study is None:
            return None
        rows, metadata = study
        if not _is_current(metadata, stages):
            return None
        names = [field.name for field in fields(StudiedSetting)]
        settings = [StudiedSetting(**{name: row[name] for name in names}) for row in rows]
        listed = tuple(setting for setting in settings if setting.is_listed)
        best = next(setting for setting in settings if setting.recommended)
        return cls(listed, best, metadata["tolerance"], metadata.get("score_tolerance"), _read_base64(figure))

    @property
    def is_within(self) -> bool:
        """Whether the recommended setting is within the tolerance."""
        if self.score_tolerance is not None:
            return self.best.error <= self.score_tolerance
        return self.best.loss_points <= self.tolerance_points

    @property
    def tolerance_text(self) -> str:
        """The tolerance with its unit."""
        if self.score_tolerance is not None:
            return f"{100 * self.score_tolerance:g} % of the score"
        return f"{self.tolerance_points:g} percentage points of vehicles found"
