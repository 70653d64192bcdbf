"""The section of the page on the plan of ``egvs place``: its proof, a map, and the score for each number of sensors."""

from __future__ import annotations

import math
from collections.abc import Sequence

from egvs.artefacts.tpog import Tpog
from egvs.core.wording import format_percent
from egvs.drawing import maps, svg_figures
from egvs.drawing.maps import Backdrop, PlannedPole
from egvs.drawing.svg_figures import CurveStep
from egvs.report import plan_answer
from egvs.results.plans import PlannedSensor, SensorPlan
from egvs.results.ranking import RankedSite


def plan_values(
    plan: SensorPlan, candidates: Sequence[RankedSite], tpog: Tpog, backdrop: Backdrop
) -> dict[str, SensorPlan | str]:
    """Return what the page shows of a plan, by the names of the template: the plan, sentences, and figures (SVG text).

    Parameters
    ----------
    plan
        The plan.
    candidates, tpog, backdrop
        Contents of the map.
    """
    occupied = tpog.counts.sum(axis=2) / tpog.frames
    alt = f"Map of the plan: {', '.join(sensor.site for sensor in plan.sensors)}."
    return {
        "plan": plan,
        "plan_proof": _describe_proof(plan),
        "plan_objective": plan_answer.describe_objective(plan.request),
        "plan_answer": plan_answer.describe_plan_count(plan),
        "plan_assumption": plan_answer.describe_joint_score(plan.by, len(plan.sensors)),
        "plan_map": maps.plan_map(tpog.grid, occupied, backdrop, candidates, _planned_poles(plan), alt),
        "plan_chart": _curve_chart(plan),
    }


def _curve_chart(plan: SensorPlan) -> str:
    whole = plan.joint_of_all or math.inf
    if plan.request["objective"] == "worst":
        whole = 1.0  # the values of this objective are shares already
    steps = [CurveStep(step.count, step.value / whole, step.bound / whole) for step in plan.curve]
    alt = "Score of the best plan for each number of sensors, and its upper bound."
    return svg_figures.sensor_count_chart(steps, alt)


def _describe_proof(plan: SensorPlan) -> str:
    sensors = len(plan.sensors)
    if plan.fewest_is_proved is None:
        if plan.is_best:
            return "it is proved that no plan within the rules is better"
        percent = math.floor(1e4 * plan.certificate) / 1e2
        return f"the plan is proved to reach at least {percent:.2f} % of the best possible score"
    if sensors == 1:
        return "one sensor is enough"
    fewer = "1 sensor is" if sensors == 2 else f"{sensors - 1} sensors are"
    if plan.fewest_is_proved:
        return f"it is proved that {fewer} not enough"
    return f"it is not proved that {fewer} not enough"


def _planned_poles(plan: SensorPlan) -> list[PlannedPole]:
    """One mark per location; sensors at the same location share it."""
    sensors_at: dict[tuple[float, float], list[PlannedSensor]] = {}
    for sensor in plan.sensors:
        sensors_at.setdefault((sensor.x_m, sensor.y_m), []).append(sensor)
    poles = []
    for (x_m, y_m), members in sensors_at.items():
        name = members[0].site
        if len(members) > 1:
            name += f" +{len(members) - 1}"
        gain = 0.0
        if plan.joint:
            gain = sum(sensor.gain for sensor in members) / plan.joint
        numbers, details = [], []
        for sensor in members:
            numbers.append(str(sensor.order))
            adds = plan.by.with_unit(sensor.gain)
            details.append(f"{sensor.order}. {sensor.site}, {sensor.z_m:g} m high, adds {adds}")
        poles.append(
            PlannedPole(x_m, y_m, ", ".join(numbers), f"{name}: {format_percent(gain, 0)}", "; ".join(details))
        )
    return poles
