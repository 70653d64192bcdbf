"""Ranking, plan and state of a run, as the page shows them: the numbers and the texts of the report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from egvs.artefacts import parquet
from egvs.artefacts.frame_boxes import read_boxes
from egvs.artefacts.run_folder import STAGE_NAMES, RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.core.errors import InputError, collect_warnings
from egvs.core.grid import Grid
from egvs.core.wording import format_percent
from egvs.placement import problem_builder
from egvs.report import sensor_text
from egvs.report.plan_section import plan_headline
from egvs.report.reliability import by_severity
from egvs.results.levels import read_levels
from egvs.results.plans import SensorPlan
from egvs.results.ranking import Ranking, describe_mount, site_titles
from egvs.runs import run_sources
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import PlacementConfig
from egvs.sensors.sites import Site

_NO_SCORES = ("placement", "costs", "what_if")
"""Beginnings of the keys of settings on which no score depends."""


MOST_SENSORS = 12
"""Sensors of the largest plan that the page offers."""

MOMENTS = 60
"""Moments of recorded traffic that the map shows, one after another, from the middle of the recording."""

MOST_VEHICLES = 200
"""Road users of a moment that the map shows: those nearest to the middle of the region of interest."""


def describe_run(folder: Path, scenario: Scenario) -> dict[str, Any]:
    """Return the state of the run of a scenario: none, partial, complete or outdated."""
    state: dict[str, Any] = {"state": "none", "missing": [], "changed": [], "has_plan": False, "plan_outdated": False}
    if not RunFolder(folder).has_record:
        return state
    try:
        record = RunRecord.read(folder)
        state["missing"] = [name for name in STAGE_NAMES if name not in record.stages]
        recorded = run_sources.recorded_scenario(folder)
        settings = run_sources.compared_settings(recorded, scenario)
        changed = [key for key in settings if not key.startswith(_NO_SCORES)]
        changed += run_sources.changed_files(folder, recorded)
        plan = SensorPlan.read(RunFolder(folder))
    except InputError as error:
        return {**state, "state": "partial", "changed": [error.problem]}
    state["changed"] = changed
    state["state"] = "partial" if "score" in state["missing"] else "outdated" if changed else "complete"
    state["has_plan"] = plan is not None
    state["plan_outdated"] = plan is not None and (
        bool(changed) or not plan.belongs_to(record.stages) or _placement_rules(plan.request) != _placement_rules(
            scenario.placement.model_dump(mode="json")
        )
    )  # fmt: skip
    return state


def _placement_rules(placement: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a plan must meet, without the request for one."""
    config = PlacementConfig.model_validate({**placement, **dict.fromkeys(("count", "budget", "reach"))})
    return config.model_dump(exclude={"refine"})


def describe_costs(scenario: Scenario, candidates: Sequence[Site]) -> dict[str, Any]:
    """Return what is paid for poles and sensors, and for the cheapest and the dearest plan; None where unknown."""
    sensor_costs = {site.sensor: scenario.costs.sensor.get(site.sensor) for site in candidates}
    costs = {
        "pole_cost": scenario.costs.pole, "sensor_costs": sensor_costs, "least": None, "most": None,
        "most_sensors": MOST_SENSORS,
    }  # fmt: skip
    try:
        rules = problem_builder.rules_from_config(scenario, candidates)
    except InputError:  # such as a cost that is not given
        return costs
    paid = np.where(rules.excluded, 0.0, rules.cost)
    if paid.any():
        of_poles = [paid[rules.pole == pole].max() for pole in np.unique(rules.pole)]
        costs |= {"least": float(paid[paid > 0.0].min()), "most": float(sum(sorted(of_poles)[-MOST_SENSORS:]))}
    return costs


def describe_ranking(folder: Path) -> dict[str, Any]:
    """Return the ranking of a run."""
    ranking = Ranking.read(RunFolder(folder).scores)
    by = ranking.by
    poles = []
    for rank, pole in enumerate(ranking.poles, start=1):
        best = pole.best
        se = math.nan if best.score_se is None else best.score_se
        poles.append({
            "rank": rank, "pole": pole.name, "site": best.site, "mount_text": describe_mount(best),
            "score": _finite(best.score), "score_text": by.with_unit(best.score, se),
        })  # fmt: skip
    warnings = by_severity(collect_warnings(stage.summary for stage in RunRecord.read(folder).stages.values()))
    return {"label": by.head, "noun": by.noun, "poles": poles, "warnings": [str(warning) for warning in warnings]}


def describe_traffic(folder: Path) -> dict[str, Any]:
    """Return moments of the traffic of a run: x, y, yaw, length and width of each road user, metres and radians."""
    recorded, path = run_sources.recorded_scenario(folder), RunFolder(folder).trajectories
    frames = int(parquet.read_metadata(path, "trajectories")["frames"])
    first = max(0, (frames - MOMENTS) // 2)
    wanted = np.arange(first, min(frames, first + MOMENTS))
    moments: list[list[list[float]]] = [[] for _ in wanted]
    for part in read_boxes(path, Grid((0.0, 0.0, 0.0), 1.0, (1, 1, 1)), wanted):
        away_m = np.hypot(*(part.values[:, :2] - recorded.roi.center_m[:2]).T)
        for frame in np.unique(part.frame):
            there = np.flatnonzero(part.frame == frame)
            nearest = there[np.argsort(away_m[there], kind="stable")[:MOST_VEHICLES]]
            moments[frame - first] = np.round(part.values[nearest][:, [0, 1, 3, 5, 6]], 2).tolist()
    period_s = recorded.traffic.frame_period_s
    return {"moments": moments, "first_s": round(first * period_s, 3), "period_s": period_s}


def describe_plan(folder: Path, scenario: Scenario, adds: Mapping[str, list[str]]) -> dict[str, Any] | None:
    """Return the plan of a run, with sentences on what each sensor ``adds``, by its site; None without a plan."""
    files = RunFolder(folder)
    plan = SensorPlan.read(files)
    if plan is None:
        return None
    by = plan.by
    groups = read_levels(files.levels, Ranking.read(files.scores).sites[0].site) if files.levels.is_file() else ()
    level = sensor_text.plan_level(scenario, [sensor.sensor for sensor in plan.sensors], groups)
    sensors = [
        {
            "order": each.order, "site": each.site, "pole": each.pole, "z_m": each.z_m, "pitch_deg": each.pitch_deg,
            "sensor": each.sensor, "cost": each.cost, "forced": each.forced, "adds_text": adds.get(each.site, []),
            "gain_text": by.change(each.gain, each.gain_se), "loss_text": by.change(each.loss),
        }
        for each in plan.sensors
    ]  # fmt: skip
    curve = [
        {"count": step.count, "score": _finite(step.score), "score_text": by.with_unit(step.score, step.score_se)}
        for step in plan.curve
    ]
    proof = "proved to be the best plan" if plan.is_best else (
        f"at least {format_percent(math.floor(plan.certificate * 1000) / 1000)} of the best possible score, proved"
    )  # fmt: skip
    return {
        "requested": {key: plan.request[key] for key in ("count", "budget", "reach") if plan.request.get(key)},
        "headline": plan_headline(plan, site_titles(plan.sensors), level),
        "label": by.head, "unit": "%" if by.is_share else by.unit, "change_unit": by.change_unit, "sensors": sensors,
        "curve": curve, "score_text": by.with_unit(plan.joint, plan.joint_se), "cost": plan.cost,
        "certificate": _finite(plan.certificate), "certificate_text": proof,
    }  # fmt: skip


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
