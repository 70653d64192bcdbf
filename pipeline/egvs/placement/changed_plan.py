"""The joint score of a plan after a change, with its error: among other solids, or with other sensors."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from egvs.artefacts.tpog import read_periods
from egvs.core.wording import number_of
from egvs.placement.plan_error import UNKNOWN_ERROR, PlanErrors, PlanReplicates
from egvs.placement.problem import CoverageState, CoverageTerm, VisibilityMatrix
from egvs.placement.problem_builder import View, build_problem, make_objective, read_tpogs
from egvs.results.plans import SensorPlan
from egvs.scoring.visibility import Beams
from egvs.sensors.sites import Site
from egvs.stages.base import StageContext


@dataclass(frozen=True)
class ChangedPlan:
    """The joint score of a plan after a change, with standard errors; NaN where they are unknown.

    Attributes
    ----------
    joint, joint_se
        The joint score.
    change_se
        Of its difference from that of the plan, paired by blocks of frames and detectors.
    """

    joint: float
    joint_se: float
    change_se: float


def score_in_other_world(context: StageContext, plan: SensorPlan, changed: StageContext) -> ChangedPlan:
    """Return the joint score of a plan among other solids.

    Parameters
    ----------
    context
        The run that the plan belongs to.
    plan
        The plan, whose empty scans are simulated.
    changed
        A run with the same traffic and candidates among other solids.

    Raises
    ------
    InputError
        If a sensor of the plan cannot be scanned or scored.
    """
    sites = [sensor.mount for sensor in plan.sensors]
    chosen = range(len(sites))
    term, view = joint_term(context, sites)
    other_term, other_view = joint_term(changed, sites)
    candidates = build_problem(context, lambda _: None)
    errors, error = PlanErrors(context, replace(candidates, views=(view,))), UNKNOWN_ERROR
    if errors.are_known:
        periods = read_periods(changed.folder.tpog)
        replicates = PlanReplicates(changed, replace(candidates, views=(other_view,)), periods)
        (row,) = replicates.of_plans(other_term, [chosen], sites, moved=True)
        error = errors.of_change(term, sites, row)
    return ChangedPlan(CoverageState([other_term], chosen).value(other_term), error.score_se, error.gain_se)


def describe_in_other_world(
    context: StageContext, plan: SensorPlan, changed: StageContext, impossible: Collection[str]
) -> str:
    """Return a sentence on what other solids change of the joint score of a plan.

    Parameters
    ----------
    context, plan, changed
        As in :func:`score_in_other_world`.
    impossible
        Candidates that are not possible among these solids.
    """
    plan_text = f"the plan of {number_of(len(plan.sensors), 'sensor')}"
    if gone := [sensor.pole or sensor.site for sensor in plan.sensors if sensor.site in impossible]:
        return f"{plan_text} is not possible: the solids rule out {gone[0]}."
    if any(sensor.mount.points for sensor in plan.sensors):
        return f"what changes for {plan_text} is unknown, since an empty scan was measured."
    score, by = score_in_other_world(context, plan, changed), plan.by
    before, after = by.with_unit(plan.joint, plan.joint_se), by.with_unit(score.joint, score.joint_se)
    change = f"{by.change(score.joint - plan.joint, score.change_se)} {by.change_unit}".rstrip()
    return f"{plan_text} changes from {before} to {after} (by {change})."


def joint_term(context: StageContext, sites: Sequence[Site]) -> tuple[CoverageTerm, View]:
    """Return the joint score of some sensors, scanned anew, and what turned their scans into its cells."""
    objective = make_objective(context, read_tpogs(context))
    rows = [objective.view.row(Beams.of(context.inputs.scanner.scan_site(site))) for site in sites]
    return objective.terms(VisibilityMatrix.of(rows, objective.view.n_cells))[""], objective.view
