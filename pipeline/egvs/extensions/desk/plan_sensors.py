"""What each sensor of a plan finds that the others do not, and the score of a plan with another sensor on one pole."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from egvs.artefacts.readers import LocationVisibility, SiteBlindspots
from egvs.artefacts.tpog import read_tpog
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.wording import format_percent
from egvs.explore.session import site_blindspots
from egvs.placement.changed_plan import ChangedPlan, joint_term
from egvs.placement.plan_error import PlanErrors
from egvs.placement.problem import CoverageState
from egvs.placement.problem_builder import build_problem
from egvs.results.labels import join_names
from egvs.results.plans import SensorPlan
from egvs.scoring.blindspots import SpotVisibility, VehicleSpots
from egvs.scoring.zone_results import detection_probabilities
from egvs.stages.base import StageContext
from egvs.stages.plan_scans import plan_beams
from egvs.stages.site_scoring import TargetScorer

_STREETS, _PARTS = ("approach", "exit", "road"), ("lane", "turn", "crossing")
_MOST_NAMED = 2
_LEAST_SHARE = 0.005
"""A smaller share is written as 0 %."""


def exclusive_visibility(
    spots: VehicleSpots, points: Mapping[str, FloatArray], chances: Mapping[str, FloatArray]
) -> dict[str, SpotVisibility]:
    """Return what each sensor finds at each spot that no other one does; detections are independent.

    Parameters
    ----------
    spots
        Spots of n vehicle-frames.
    points, chances
        Points of each sensor on each vehicle-frame, and the probability that it finds it, (n,) float64, by its name.
    """
    found = {}
    for name, own in chances.items():
        missed = np.prod([1.0 - other for key, other in chances.items() if key != name], axis=0)
        found[name] = spots.visibility(points[name], own * missed)
    return found


def describe_additions(context: StageContext, plan: SensorPlan) -> dict[str, list[str]]:
    """Return sentences on what each sensor of a plan adds, by its site: shares as in ``blindspots.parquet``.

    Parameters
    ----------
    context
        The run that the plan belongs to.
    plan
        The plan.
    """
    score = context.scenario.score.model_copy(update={"blindspots": True})
    context = context.with_scenario(context.scenario.model_copy(update={"score": score}))
    grid = read_tpog(context.folder.tpog).grid
    targets = TargetScorer(context, grid)
    assert targets.spots is not None
    points, chances = {}, {}
    mounts = [sensor.mount for sensor in plan.sensors]
    for name, beams in plan_beams(context, mounts, moved=plan.refinement is not None):
        visible = targets.visible(beams)
        points[name], chances[name] = visible.points, detection_probabilities(visible, targets.detectors)
    found = exclusive_visibility(targets.spots, points, chances)
    return {name: describe_exclusive(site_blindspots(name, targets.spots, one, grid)) for name, one in found.items()}


def describe_exclusive(found: SiteBlindspots) -> list[str]:
    """Return where a sensor finds what no other one does (:func:`exclusive_visibility`): streets, then their parts."""
    if found.overall is None or found.overall.share < _LEAST_SHARE:
        return ["The other sensors find almost every vehicle that it finds."]
    streets = _largest(found.of_kind(*_STREETS))
    shares = [f"{_share(street)} on {street.words}" for street in streets]
    shares.append(f"{_share(found.overall)} of all vehicles")
    texts = [f"Vehicles that only this sensor finds: {join_names(shares)}."]
    parts = [part for part in found.of_kind(*_PARTS) if part.share not in {street.share for street in streets}]
    if largest := [f"{part.words} ({_share(part)})" for part in _largest(parts)]:  # an approach may be a single lane
        texts.append(f"Of other lanes, turns and crossings, most on {'; '.join(largest)}.")
    return texts


def _largest(worst_first: Sequence[LocationVisibility]) -> list[LocationVisibility]:
    return [location for location in worst_first[::-1][:_MOST_NAMED] if location.share >= _LEAST_SHARE]


def _share(location: LocationVisibility) -> str:
    return format_percent(location.share, 0)


def try_sensors(context: StageContext, plan: SensorPlan, changed: StageContext) -> ChangedPlan:
    """Return the joint score of a plan with the sensors that its candidates have in another scenario.

    Parameters
    ----------
    context
        The run that the plan belongs to.
    plan
        The plan; where it was refined, its sensors stay where that moved them.
    changed
        The same folder with a scenario that differs in sensors only.

    Raises
    ------
    InputError
        If no sensor is another one, or one cannot be scanned or scored.
    """
    by_name = {site.name: site for site in changed.scene.sites}
    sites = [sensor.mount for sensor in plan.sensors]
    tried = list(range(len(sites)))
    for number, planned in enumerate(plan.sensors):
        site = by_name[planned.site]
        if site.sensor == planned.sensor:
            continue
        if site.points is not None:
            problem = "its empty scan was measured, so that of another sensor is unknown"
            raise InputError(f"site {site.name}", problem, "Choose a pole whose scan is simulated.")
        pose = planned.mount.pose if plan.refinement is not None else site.pose
        tried[number] = len(sites)
        sites.append(replace(site, name=f"{site.name}@{site.sensor}", pose=pose))
    if len(sites) == len(plan.sensors):
        raise InputError("the plan", "its sensors are these already", "Choose another sensor for one of its poles.")

    term, view = joint_term(changed, sites)
    errors = PlanErrors(changed, replace(build_problem(context, lambda _: None), views=(view,)))
    plans = [tuple(range(len(plan.sensors))), tuple(tried)]
    error = errors.of_plans(term, plans, sites, moved=True)[1]
    return ChangedPlan(CoverageState([term], tried).value(term), error.score_se, error.gain_se)
