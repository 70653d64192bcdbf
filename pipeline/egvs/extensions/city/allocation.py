"""Allocate a number of sensors, or a budget, to the junctions of a city.

Each junction contributes its best plans of 1, 2, ... sensors, and an upper bound for all its other plans
(:func:`junction_plans`, on workers). Junctions are independent, so the city's joint score is the sum of theirs. What
remains is to choose one plan per junction: a multiple-choice knapsack problem, solved exactly by dynamic programming.
For a count this takes (junctions x count^2) steps. A greedy choice would be exact only if the gains of each junction
decreased, which is not guaranteed, because the best plan of three sensors need not contain the best two.

The upper bound for the city is the same knapsack problem with the bounds of the junctions; for a budget its linear
relaxation, in which the last step may be taken in part (P. Sinha and A. A. Zoltners, The multiple-choice knapsack
problem, Operations Research 27, 1979).
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.extensions.city.replicates import CityBlocks, JointReplicates
from egvs.extensions.city.results import mean_vehicles, score_factor
from egvs.extensions.city.tasks import SCENE_CACHE, Job, RunSettings, catch_input_errors
from egvs.placement import plan as placement_plan
from egvs.placement import problem_builder, solver
from egvs.placement.branch_and_bound import BOUND_ROUNDING
from egvs.placement.problem import PlanRules, Problem
from egvs.placement.problem_builder import PlacementProblem
from egvs.results.plans import PlannedSensor
from egvs.runs.run_context import open_folder
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import PlacementConfig

_UNLIMITED_BUDGET = 1e15

_MAX_STATES = 100_000
"""Maximum number of costs that the dynamic programming for a budget distinguishes. With more, costs within a
1 / _MAX_STATES of the budget are merged, and the best of them is kept."""

CURVE_STEPS = 40
"""Number of costs of a curve for a budget."""

_COST_TOLERANCE = 1e-9
"""Costs are sums of decimal numbers: a budget is exceeded if the cost is higher by more than this share."""


@dataclass(frozen=True)
class JunctionPlan:
    """Sensors at one junction, in the order of installation.

    Attributes
    ----------
    sensors
        The sensors.
    value, cost
        Their joint score, and their cost.
    replicates
        The joint score of the first 0, 1, ... n of them, of all traffic and with each group of blocks left out,
        (n + 1, 1 + k) float64; None where there are no standard errors.
    """

    sensors: tuple[PlannedSensor, ...]
    value: float
    cost: float
    replicates: FloatArray | None = field(default=None, compare=False)

    @property
    def count(self) -> int:
        """Number of sensors."""
        return len(self.sensors)


@dataclass(frozen=True)
class JunctionPlans:
    """The plans that one junction may get.

    Attributes
    ----------
    junction
        Name of the junction.
    plans
        From the fewest sensors on; the first one has only the forced sensors.
    bounds
        Upper bounds of all plans of at most 0, 1, ... sensors.
    min_costs
        Lower bounds of the cost of 0, 1, ... sensors.
    joint_of_all
        Joint score of all candidates, which no plan exceeds.
    is_complete
        Whether no plan of more sensors is better.
    """

    junction: str
    plans: tuple[JunctionPlan, ...]
    bounds: tuple[float, ...]
    min_costs: tuple[float, ...]
    joint_of_all: float
    is_complete: bool

    @property
    def max_count(self) -> int:
        """Maximum number of sensors for which plans were computed."""
        return len(self.bounds) - 1

    def bound(self, count: int) -> float:
        """Return an upper bound of all plans of at most ``count`` sensors.

        Beyond :attr:`max_count` it follows from submodularity: the best m of the n sensors of a plan reach at least m/n
        of its joint score.
        """
        if count <= self.max_count:
            return self.bounds[count]
        if self.is_complete:
            return self.bounds[-1]
        if self.max_count == 0:
            return self.joint_of_all
        return min(self.joint_of_all, self.bounds[-1] * count / self.max_count)

    def scaled(self, factor: float) -> JunctionPlans:
        """Return the same plans with all joint scores multiplied by a factor; without replicates."""
        if factor == 1.0:
            return self
        plans = []
        for plan in self.plans:
            sensors = tuple(replace(sensor, gain=sensor.gain * factor) for sensor in plan.sensors)
            plans.append(replace(plan, value=plan.value * factor, sensors=sensors, replicates=None))
        bounds = tuple(bound * factor for bound in self.bounds)
        return replace(self, plans=tuple(plans), bounds=bounds, joint_of_all=self.joint_of_all * factor)

    def with_replicates(self, replicates: JointReplicates) -> JunctionPlans:
        """Return the same plans with replicates."""
        plans = []
        for plan in self.plans:
            plans.append(replace(plan, replicates=replicates.of_order([sensor.site for sensor in plan.sensors])))
        return replace(self, plans=tuple(plans))


class CurvePoint(NamedTuple):
    """The best allocation within a limit.

    Attributes
    ----------
    limit
        Maximum number of sensors, or maximum cost.
    chosen
        Index into :attr:`JunctionPlans.plans` for each junction.
    value
        Sum of the joint scores.
    bound
        Upper bound of all plans of the city within the limit.
    """

    limit: float
    chosen: tuple[int, ...]
    value: float
    bound: float


@dataclass(frozen=True)
class Allocation:
    """The plan that each junction gets.

    Attributes
    ----------
    curve
        The best allocations within ascending limits. For a count: of as many sensors as are forced, one more, and so
        on. For a budget: of at most :data:`CURVE_STEPS` costs, evenly spread. The last one is within the full limit.
    """

    curve: tuple[CurvePoint, ...]

    @property
    def chosen(self) -> tuple[int, ...]:
        """Index into :attr:`JunctionPlans.plans` for each junction, within the full limit."""
        return self.curve[-1].chosen

    @property
    def value(self) -> float:
        """Sum of the joint scores, within the full limit."""
        return self.curve[-1].value

    @property
    def bound(self) -> float:
        """Upper bound of all plans of the city within the full limit."""
        return self.curve[-1].bound


class CostPoint(NamedTuple):
    """A cost, and the most that can be reached with it."""

    cost: float
    value: float


def check_additive_config(scenario: Scenario) -> None:
    """Raise an InputError if ``[placement]`` has settings that cannot be summed over junctions."""
    config, default = scenario.placement, PlacementConfig()
    for key in ("zones", "survives", "objective", "reach", "refine", "budget", "count"):
        if getattr(config, key) != getattr(default, key):
            raise InputError(
                scenario.locate(f"placement.{key}"),
                "has no effect in a city, where joint scores are summed and one count or budget is shared",
                f"Remove the key, or use {shlex.join(['egvs', 'place', str(scenario.folder)])}.",
            )


@catch_input_errors
def junction_plans(
    job: Job, settings: RunSettings, max_count: int, with_costs: bool, blocks: CityBlocks | None = None
) -> JunctionPlans:
    """Compute the plans of a junction; a task of a worker.

    Parameters
    ----------
    job, settings
        The junction, and the settings of the city run.
    max_count
        Maximum number of sensors.
    with_costs
        Whether costs are needed, and single sensors that are cheaper than the best one.
    blocks
        Blocks of frames for replicates; without replicates when None.
    """
    with settings.applied(), SCENE_CACHE.borrow(settings.token, job) as scene:
        scene.ensure_artefacts()
        scenario = scene.context.scenario
        check_additive_config(scenario)
        if with_costs:  # with a budget, unknown costs are an error
            placement = scenario.placement.model_copy(update={"budget": _UNLIMITED_BUDGET})
            scenario = scenario.model_copy(update={"placement": placement})
        context = open_folder(scenario, scene.context.folder.path, jobs=1)
        problem = problem_builder.build_problem(context, lambda _: None)
        vehicles = mean_vehicles(job.out)
        plans = plan_junction(problem, job.junction, max_count, with_single_sensors=with_costs)
        plans = plans.scaled(score_factor(scenario.score.rank_by, vehicles))
        if blocks is None:
            return plans
        return plans.with_replicates(JointReplicates(context, problem, blocks, vehicles))


def plan_junction(
    placement_problem: PlacementProblem, junction: str, max_count: int, *, with_single_sensors: bool = False
) -> JunctionPlans:
    """Solve the placement problem of a junction for 1, 2, ... sensors, at any cost.

    Parameters
    ----------
    placement_problem
        The problem of the junction.
    junction
        Name of the junction.
    max_count
        Maximum number of sensors.
    with_single_sensors
        Whether to add the plans with one sensor that no cheaper sensor beats.
    """
    rules = placement_problem.problem.rules
    n_candidates = int(np.count_nonzero(~rules.excluded))
    count = min(max(max_count, len(rules.forced), 1), n_candidates)
    problem = replace(placement_problem.problem, rules=replace(rules, budget=np.inf, count=count))
    curve = solver.best_plan(problem, search_all=False, time_limit_s=0.0, on_progress=lambda _: None).curve

    orders = [rules.forced]
    orders += [solver.greedy_order(problem, point.plan) for point in curve]
    if with_single_sensors and len(rules.forced) < count:
        orders += [(*rules.forced, candidate) for candidate in _efficient_candidates(problem)]
    plans = []
    for order in orders:
        sensors = placement_plan.planned_sensors(problem, [placement_problem.sites[i] for i in order], order)
        value = problem.coverage_state(order).value(problem.joint)
        plans.append(JunctionPlan(tuple(sensors), value, problem.rules.cost_of(order)))

    bounds_below_curve = [plans[0].value] * curve[0].count
    return JunctionPlans(
        junction,
        tuple(plans),
        (*bounds_below_curve, *(point.bound for point in curve)),
        min_costs_by_count(rules),
        placement_problem.joint_of_all * (1.0 + BOUND_ROUNDING),
        is_complete=count == n_candidates or curve[-1].count < count,
    )


def _efficient_candidates(problem: Problem) -> list[int]:
    """Return the candidates that add more to the forced sensors than any other of at most the same cost."""
    rules = problem.rules
    candidates = np.flatnonzero(rules.allowed_additions(rules.forced))
    gains = problem.coverage_state(rules.forced).gains(problem.joint, candidates)
    cost = rules.further_cost(rules.forced)[candidates]
    efficient, best_gain = [], 0.0
    for i in np.lexsort((-gains, cost)).tolist():
        if gains[i] > best_gain:
            best_gain = float(gains[i])
            efficient.append(int(candidates[i]))
    return efficient


def min_costs_by_count(rules: PlanRules) -> tuple[float, ...]:
    """Return lower bounds of the cost of 0, 1, ... sensors: the cheapest sensors at the cheapest poles."""
    others = np.setdiff1d(np.flatnonzero(~rules.excluded), rules.forced)
    if rules.most_per_pole == 1 and not rules.forced:  # every sensor pays for a pole of its own
        sensor_costs, pole_cost = np.sort(rules.cost[others]), 0.0
    else:
        sensor_costs, pole_cost = np.sort((rules.cost - rules.pole_cost)[others]), 0.0
        if not rules.forced and len(others):  # more sensors can hang on the pole of a forced one for free
            pole_cost = float(rules.pole_cost[others].min())
    n_poles = -(-np.arange(len(sensor_costs) + 1) // rules.most_per_pole)
    costs = np.append(0.0, np.cumsum(sensor_costs)) + pole_cost * n_poles
    return (*[0.0] * len(rules.forced), *costs.tolist())


def allocate_sensors(junctions: Sequence[JunctionPlans], count: int) -> Allocation:
    """Return the best allocation of at most ``count`` sensors, forced ones included."""
    best = np.zeros(count + 1)
    choices: list[IntArray] = []
    for junction in junctions:
        values = np.full((len(junction.plans), count + 1), -math.inf)
        for i, plan in enumerate(junction.plans):
            if plan.count <= count:
                values[i, plan.count :] = best[: count + 1 - plan.count] + plan.value
        choices.append(values.argmax(axis=0))
        best = values.max(axis=0)

    bounds = np.maximum(_bounds_by_count(junctions, count), best)
    curve = []
    for limit in np.flatnonzero(best > -math.inf).tolist():
        chosen = _chosen_plans(junctions, choices, limit)
        curve.append(CurvePoint(limit, chosen, float(best[limit]), float(bounds[limit])))
    return Allocation(tuple(curve))


def _chosen_plans(junctions: Sequence[JunctionPlans], choices: Sequence[IntArray], count: int) -> tuple[int, ...]:
    """Return the plan of each junction, from the choices of the dynamic programming for each remaining count."""
    chosen: list[int] = []
    for junction, choice in zip(reversed(junctions), reversed(choices), strict=True):
        chosen.append(int(choice[count]))
        count -= junction.plans[chosen[-1]].count
    return tuple(reversed(chosen))


def _bounds_by_count(junctions: Sequence[JunctionPlans], count: int) -> FloatArray:
    """Return the upper bounds of all plans of the city with at most 0, 1, ... sensors, shape (count + 1,)."""
    best = np.zeros(count + 1)
    for junction in junctions:
        extended = np.full(count + 1, -math.inf)
        for number in range(min(count, len(junction.min_costs) - 1) + 1):
            extended[number:] = np.maximum(extended[number:], best[: count + 1 - number] + junction.bound(number))
        best = extended
    return best


def allocate_budget(junctions: Sequence[JunctionPlans], budget: float) -> Allocation:
    """Return the best allocation whose cost is at most ``budget``."""
    limit = budget * (1.0 + _COST_TOLERANCE)
    costs, values = np.zeros(1), np.zeros(1)
    steps: list[tuple[IntArray, IntArray]] = []  # for each state: the plan, and the state before it
    for junction in junctions:
        plan_costs = np.array([plan.cost for plan in junction.plans])
        plan_values = np.array([plan.value for plan in junction.plans])
        new_costs = (costs[None, :] + plan_costs[:, None]).ravel()
        new_values = (values[None, :] + plan_values[:, None]).ravel()
        states = _pareto_front(new_costs, new_values, limit)
        steps.append((states // len(costs), states % len(costs)))
        costs, values = new_costs[states], new_values[states]

    curve = []
    for step_limit in np.linspace(0.0, limit, CURVE_STEPS + 1).tolist():
        state = int(np.searchsorted(costs, step_limit, side="right")) - 1  # forced sensors cost nothing, so >= 0
        value = float(values[state])
        bound = max(value, relaxed_bound(junctions, step_limit))
        curve.append(CurvePoint(step_limit, _plans_of_state(steps, state), value, bound))
    return Allocation(tuple(curve))


def _plans_of_state(steps: Sequence[tuple[IntArray, IntArray]], state: int) -> tuple[int, ...]:
    """Return the plan of each junction that leads to a state of the dynamic programming."""
    chosen: list[int] = []
    for plan_of_state, state_before in reversed(steps):
        chosen.append(int(plan_of_state[state]))
        state = int(state_before[state])
    return tuple(reversed(chosen))


def _pareto_front(costs: FloatArray, values: FloatArray, limit: float) -> IntArray:
    """Return the states within the limit that no other of at most the same cost equals, by ascending cost."""
    order = np.lexsort((-values, costs))
    order = order[costs[order] <= limit]
    best_before = np.maximum.accumulate(np.append(-math.inf, values[order]))[:-1]
    front = order[values[order] > best_before]
    if len(front) > _MAX_STATES:
        bucket = np.floor(costs[front] / limit * _MAX_STATES)
        front = front[np.append(bucket[1:] != bucket[:-1], True)]  # the last one of each bucket is the best
    return front


def relaxed_bound(junctions: Sequence[JunctionPlans], limit: float) -> float:
    """Return an upper bound of all allocations within a cost limit.

    The bounds of each junction over its minimum costs are replaced by their upper hull. Steps along all hulls are taken
    by descending slope, the last one in part.
    """
    total = 0.0
    steps: list[CostPoint] = []
    for junction in junctions:
        points = []
        for number, cost in enumerate(junction.min_costs):
            if cost <= limit:
                points.append(CostPoint(cost, junction.bound(number)))
        hull = _upper_hull(points)
        total += hull[0].value
        steps += [CostPoint(b.cost - a.cost, b.value - a.value) for a, b in pairwise(hull)]

    remaining = limit
    for step in sorted(steps, key=lambda step: -step.value / step.cost):
        share = min(1.0, remaining / step.cost)
        total += share * step.value
        remaining -= share * step.cost
        if remaining <= 0.0:
            break
    return total


def _upper_hull(points: Sequence[CostPoint]) -> list[CostPoint]:
    """Return the upper hull, from the lowest cost on, as far as it rises."""
    best: dict[float, float] = {}
    for point in points:
        best[point.cost] = max(point.value, best.get(point.cost, -math.inf))
    hull: list[CostPoint] = []
    for point in [CostPoint(cost, value) for cost, value in sorted(best.items())]:
        if hull and point.value <= hull[-1].value:
            continue
        while len(hull) > 1 and _turns_up(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    return hull


def _turns_up(a: CostPoint, b: CostPoint, c: CostPoint) -> bool:
    """Return whether b is on or below the line from a to c."""
    return (b.value - a.value) * (c.cost - a.cost) <= (c.value - a.value) * (b.cost - a.cost)
