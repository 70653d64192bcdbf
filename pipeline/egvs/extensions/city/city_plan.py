"""The plan of a city from its allocation: the order of installation, and the curve with its standard errors.

Sensors are installed in the order of their gains. Within a junction that is the greedy order of its plan, whose gains
never increase, so the first sensors of the city are the best ones of this plan in that order. They need not be the best
plan of so many sensors: the best two sensors of a junction need not be among the best three. The curve has both scores.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from egvs.core.grid import FloatArray
from egvs.extensions.city.allocation import Allocation, JunctionPlan, JunctionPlans
from egvs.extensions.city.replicates import CityBlocks
from egvs.extensions.city.results import BudgetPoint, CityPlan
from egvs.placement.plan_error import SHORT_RECORD
from egvs.results.plans import PlannedSensor
from egvs.scoring.standard_errors import summarise_uncertainty


class _Errors(NamedTuple):
    """Standard errors of n scores, (n,) float64, NaN where they are unknown; and how they were computed, or why not."""

    se: FloatArray
    source: str
    are_known: bool


def make_city_plan(
    plans: Sequence[JunctionPlans],
    shares: Allocation,
    rank_by: str,
    requested: Mapping[str, float],
    phases: Sequence[int] = (),
    blocks: CityBlocks | str = "",
) -> CityPlan:
    """Return the plan of a city, its sensors in the order of installation.

    Parameters
    ----------
    plans
        The plans of each junction.
    shares
        The plan that each junction gets.
    rank_by, requested, phases
        As in :class:`egvs.extensions.city.results.CityPlan`.
    blocks
        The blocks of frames of the replicates, or the reason why there are no standard errors.
    """
    chosen = {plan.junction: plan.plans[i] for plan, i in zip(plans, shares.chosen, strict=True)}
    sensors, score = [], 0.0
    for number, sensor in enumerate(merge_by_gain({name: plan.sensors for name, plan in chosen.items()}), start=1):
        score += sensor.gain
        sensors.append(replace(sensor, order=number, score=score))

    best = [[plan.plans[i] for plan, i in zip(plans, point.chosen, strict=True)] for point in shares.curve]
    installed = []
    if "count" in requested:
        installed = [sensors[: int(point.limit)] for point in shares.curve]
    errors = _standard_errors(best, [_installed_plans(chosen, prefix) for prefix in installed], blocks)
    curve = []
    for i, (point, city) in enumerate(zip(shares.curve, best, strict=True)):
        row = BudgetPoint(
            limit=point.limit,
            sensors=sum(plan.count for plan in city),
            cost=sum(plan.cost for plan in city),
            score=point.value,
            score_se=float(errors.se[i]),
            bound=point.bound,
        )
        if installed:
            reached = installed[i][-1].score if installed[i] else 0.0
            row = replace(row, installed=reached, installed_se=float(errors.se[len(best) + i]))
        curve.append(row)
    return CityPlan(
        sensors=tuple(sensors),
        rank_by=rank_by,
        requested=requested,
        joint=shares.value,
        bound=shares.bound,
        joint_of_all=sum(junction.joint_of_all for junction in plans),
        candidates=sum(len(junction.min_costs) - 1 for junction in plans),
        junctions=len(plans),
        curve=tuple(curve),
        phases=tuple(phases),
        errors_from=errors.source,
        has_errors=errors.are_known,
    )


def merge_by_gain(sensors_by_junction: Mapping[str, Sequence[PlannedSensor]]) -> Iterator[PlannedSensor]:
    """Yield forced sensors first, then each time the next sensor of the junction where it adds most."""
    remaining = {name: list(sensors) for name, sensors in sensors_by_junction.items() if sensors}
    while remaining:
        name = max(remaining, key=lambda name: (remaining[name][0].forced, remaining[name][0].gain))
        yield replace(remaining[name].pop(0), junction=name)
        if not remaining[name]:
            del remaining[name]


def _installed_plans(chosen: Mapping[str, JunctionPlan], installed: Sequence[PlannedSensor]) -> list[JunctionPlan]:
    """Return the part of the plan of each junction that some sensors of the city install."""
    numbers = Counter(sensor.junction for sensor in installed)
    parts = []
    for name, plan in chosen.items():
        number = numbers[name]
        replicates = None if plan.replicates is None else plan.replicates[: number + 1]
        parts.append(replace(plan, sensors=plan.sensors[:number], replicates=replicates))
    return parts


def _standard_errors(
    best: Sequence[Sequence[JunctionPlan]], installed: Sequence[Sequence[JunctionPlan]], blocks: CityBlocks | str
) -> _Errors:
    """Estimate the standard errors of the joint scores of plans of the city, from the sums of their replicates."""
    cities = [*best, *installed]
    if isinstance(blocks, str):
        return _Errors(np.full(len(cities), math.nan), blocks, False)
    sums = []
    for city in cities:
        rows = [plan.replicates[-1] for plan in city if plan.replicates is not None]
        assert len(rows) == len(city)  # with blocks, every junction has replicates
        sums.append(np.sum(rows, axis=0))
    estimate = blocks.uncertainty(np.array(sums))
    source = str(summarise_uncertainty(estimate, [period.name for period in blocks.periods])["standard_errors_from"])
    if any(stratum.is_short or stratum.still_correlated for stratum in estimate.strata):
        source += SHORT_RECORD
    return _Errors(estimate.se, source, True)
