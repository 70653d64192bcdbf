"""What the page says of the plan of ``egvs place``: headline, proof, and the score for each number of sensors."""

from __future__ import annotations

import math
from collections.abc import Mapping

from egvs.core.wording import number_of
from egvs.drawing import svg_figures
from egvs.drawing.maps import PlannedPole
from egvs.drawing.svg_figures import CurveStep
from egvs.report import plan_answer
from egvs.results.labels import join_names
from egvs.results.levels import DetectionLevel
from egvs.results.plans import PlannedSensor, SensorPlan

_MAX_NAMED = 3
"""With more sensors, a headline names their poles only."""


def plan_values(plan: SensorPlan) -> dict[str, SensorPlan | str]:
    """Return what the page shows of a plan, by the names of the template: the plan, sentences, a chart (SVG text)."""
    return {
        "plan": plan,
        "plan_proof": _describe_proof(plan),
        "plan_objective": plan_answer.describe_objective(plan.request),
        "plan_answer": plan_answer.describe_plan_count(plan),
        "plan_assumption": plan_answer.describe_joint_score(plan.by, len(plan.sensors)),
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


def plan_headline(plan: SensorPlan, titles: Mapping[str, str], found: DetectionLevel) -> str:
    """Return the plan and what it achieves in one sentence; sensors are named where they are few.

    Parameters
    ----------
    plan
        The plan, of at least one sensor.
    titles
        What people call its sensors (:func:`egvs.results.ranking.site_titles`).
    found
        As for :func:`egvs.report.plan_answer.describe_share`.
    """
    count = len(plan.sensors)
    names = "; ".join(titles[sensor.site] for sensor in plan.sensors)
    if count > _MAX_NAMED:
        names = join_names(list(dict.fromkeys(sensor.pole for sensor in plan.sensors)))
    return f"The plan of {number_of(count, 'sensor')} {plan_answer.describe_share(plan, found)}: {names}"


def planned_poles(plan: SensorPlan) -> list[PlannedPole]:
    """Return a mark for each location of a plan; sensors at the same location share it."""
    sensors_at: dict[tuple[float, float], list[PlannedSensor]] = {}
    for sensor in plan.sensors:
        sensors_at.setdefault((sensor.x_m, sensor.y_m), []).append(sensor)
    poles = []
    for (x_m, y_m), members in sensors_at.items():
        numbers, details = [], []
        for sensor in members:
            numbers.append(str(sensor.order))
            adds = plan.by.with_unit(sensor.gain)
            details.append(f"{sensor.order}. {sensor.site}, {sensor.z_m:g} m high, adds {adds}")
        poles.append(PlannedPole(x_m, y_m, ", ".join(numbers), members[0].pole, "; ".join(details)))
    return poles
