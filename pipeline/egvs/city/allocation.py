"""A budget shared among junctions.

What a junction could get: the best plan of 1, 2, ... sensors that is found there, and what none exceeds.

Shares one count, or one budget, among junctions, and says what is proved of it.

Junctions are independent of one another, so a city's joint score is the sum of theirs, and all that is to be decided is
which of its plans each junction gets: a knapsack with one choice a junction, solved exactly by dynamic programming. For
a count that takes junctions times count squared steps. Were every junction's gains falling, taking the largest gain
again and again would give the same; plans of more sensors need not hold those of fewer, so it is not taken for granted.

What no plan exceeds is the same knapsack over the junctions' bounds; for a budget its relaxation, in which the last
step may be taken in part (Sinha and Zoltners 1979).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from egvs.city.results import mean_vehicles, score_factor
from egvs.city.tasks import SCENE_CACHE, Job, RunSettings, catch_input_errors
from egvs.core.errors import InputError
from egvs.placement import problem_builder, solver
from egvs.placement.branch_and_bound import BOUND_ROUNDING
from egvs.placement.problem import PlanRules, Problem
from egvs.placement.problem_builder import PlacementProblem
from egvs.scenario.model import Scenario
from egvs.sensors.sites import Site
from egvs.stages.inputs import open_folder


@dataclass(frozen=True)
class JunctionSensor:
    """One sensor of a plan: what it adds to the joint score of those before it, and to the cost."""

    site: Site
    is_forced: bool
    gain: float
    cost: float


@dataclass(frozen=True)
class JunctionPlan:
    """Sensors at one junction, in the order in which they would be put up; their joint score, and what they cost."""

    sensors: tuple[JunctionSensor, ...]
    value: float
    cost: float

    @property
    def count(self) -> int:
        """How many sensors."""
        return len(self.sensors)


@dataclass(frozen=True)
class JunctionPlans:
    """What one junction could get.

    Attributes
    ----------
    junction
        Its name.
    plans
        Those that were found, of fewest sensors first; the first one holds what is there already, or nothing.
    bounds
        What no plan of at most 0, 1, ... sensors exceeds, as far as plans were looked for.
    min_costs
        What no plan of so many sensors costs less than.
    together
        The joint score of all candidates; no plan exceeds it.
    is_complete
        Whether further sensors would add nothing, or are none.
    """

    junction: str
    plans: tuple[JunctionPlan, ...]
    bounds: tuple[float, ...]
    min_costs: tuple[float, ...]
    together: float
    is_complete: bool

    @property
    def max_count(self) -> int:
        """The number of sensors up to which plans were looked for."""
        return len(self.bounds) - 1

    def bound(self, count: int) -> float:
        """What no plan of at most so many sensors exceeds. Beyond :attr:`most`: m of n sensors of a plan, well chosen,
        are worth at least m/n of it, since gains fall."""
        if count <= self.max_count:
            return self.bounds[count]
        if self.is_complete:
            return self.bounds[-1]
        return min(self.together, self.bounds[-1] * count / max(1, self.max_count)) if self.max_count else self.together

    def times(self, factor: float) -> JunctionPlans:
        """The same where all that is added up counts so much more."""
        if factor == 1.0:
            return self
        plans = (
            replace(
                plan, value=plan.value * factor, sensors=tuple(replace(p, gain=p.gain * factor) for p in plan.sensors)
            )
            for plan in self.plans
        )
        bounds = tuple(bound * factor for bound in self.bounds)
        return replace(self, plans=tuple(plans), bounds=bounds, together=self.together * factor)


def check_additive_config(scenario: Scenario) -> None:
    """InputError where a scenario asks for what cannot be added up over junctions."""
    wanted = scenario.placement
    idle = {
        "zones": bool(wanted.zones), "survives": bool(wanted.survives), "objective": wanted.objective != "mean",
        "reach": wanted.reach is not None, "refine": wanted.refine is not None, "budget": wanted.budget is not None,
        "count": wanted.count is not None,
    }  # fmt: skip
    if named := [key for key, is_there in idle.items() if is_there]:
        found = "a plan of the whole city adds up joint scores, and shares one count or budget"
        raise InputError(f"{scenario.file}: placement.{named[0]}", found, f"no such key; egvs place {scenario.folder}")


@catch_input_errors
def junction_plans(job: Job, settings: RunSettings, most: int, costs_count: bool) -> JunctionPlans:
    """What a junction could get, up to ``most`` sensors; ``costs_count`` asks for what they cost, and for single
    sensors that are cheaper than the best one."""
    with settings.applied(), SCENE_CACHE.borrow(settings.token, job) as built:
        built.ensure_artefacts()
        scenario = built.work.scenario
        check_additive_config(scenario)
        if costs_count:  # with a budget, somebody has to say what a candidate costs
            placement = scenario.placement.model_copy(update={"budget": _UNLIMITED_BUDGET})
            scenario = scenario.model_copy(update={"placement": placement})
        work = open_folder(scenario, built.work.folder.path, jobs=1)
        factor = score_factor(scenario.score.rank_by, mean_vehicles(job.out))
        return plan_junction(
            problem_builder.build_problem(work, lambda _: None), job.junction, most, singles=costs_count
        ).times(factor)


_UNLIMITED_BUDGET = 1e15


def plan_junction(
    placement_problem: PlacementProblem, junction: str, most: int, *, singles: bool = False
) -> JunctionPlans:
    """Plans of up to ``most`` sensors of a problem, whatever they cost; with ``singles`` also those of one sensor of
    which none that is cheaper is worth more."""
    rules = placement_problem.problem.rules
    free = int(np.count_nonzero(~rules.excluded))
    count = min(max(most, len(rules.forced), 1), free)
    problem = replace(placement_problem.problem, rules=replace(rules, budget=np.inf, count=count))
    curve = solver.best_plan(problem, search_all=False, time_limit_s=0.0, on_progress=lambda _: None).curve
    there = make_junction_plan(problem, placement_problem.sites, rules.forced)
    plans = [
        there,
        *(
            make_junction_plan(problem, placement_problem.sites, solver.greedy_order(problem, point.plan))
            for point in curve
        ),
    ]
    if singles and len(rules.forced) < count:
        plans += [
            make_junction_plan(problem, placement_problem.sites, (*rules.forced, one))
            for one in _efficient_candidates(problem)
        ]
    return JunctionPlans(
        junction,
        tuple(plans),
        (*[there.value] * curve[0].count, *(point.bound for point in curve)),
        min_costs_by_count(rules),
        placement_problem.joint_of_all * (1.0 + BOUND_ROUNDING),
        count == free or curve[-1].count < count,
    )


def make_junction_plan(problem: Problem, sites: Sequence[Site], chosen: Sequence[int]) -> JunctionPlan:
    """Some candidates in an order, with what each adds."""
    seen, rules, picks = problem.coverage_state(), problem.rules, []
    value = seen.value(problem.joint)
    for number, one in enumerate(chosen):
        seen.add(one)
        before, value = value, seen.value(problem.joint)
        cost = rules.cost_of(chosen[: number + 1]) - rules.cost_of(chosen[:number])
        picks.append(JunctionSensor(sites[one], one in rules.forced, value - before, cost))
    return JunctionPlan(tuple(picks), value, rules.cost_of(chosen))


def _efficient_candidates(problem: Problem) -> list[int]:
    """Candidates of which none that costs less, or the same, adds more to what is there already."""
    rules = problem.rules
    candidates = np.flatnonzero(rules.allowed_additions(rules.forced))
    gains = problem.coverage_state(rules.forced).gains(problem.joint, candidates)
    cost, best, found = rules.further_cost(rules.forced)[candidates], 0.0, []
    for at in np.lexsort((-gains, cost)).tolist():
        if gains[at] > best:
            best = float(gains[at])
            found.append(int(candidates[at]))
    return found


def min_costs_by_count(rules: PlanRules) -> tuple[float, ...]:
    """What no plan of 0, 1, ... sensors costs less than: each is as cheap as any, at poles as cheap as any."""
    others = np.setdiff1d(np.flatnonzero(~rules.excluded), rules.forced)
    alone = np.sort(rules.cost[others]) if rules.most_per_pole == 1 and not rules.forced else None
    sensors = np.sort((rules.cost - rules.pole_cost)[others]) if alone is None else alone
    pole = 0.0 if rules.forced or alone is not None or not len(others) else float(rules.pole_cost[others].min())
    new = np.arange(len(sensors) + 1)
    cost = np.append(0.0, np.cumsum(sensors)) + pole * -(-new // rules.most_per_pole)
    return (*[0.0] * len(rules.forced), *cost.tolist())


Floats = NDArray[np.float64]

_MAX_STATES = 100_000
"""Costs that are told apart on the way to a budget; of more, those of a hundred-thousandth of it are taken for one,
the best of them."""

_COST_TOLERANCE = 1e-9
"""Costs are sums of decimal numbers: a budget is exceeded by more than this share of it."""


@dataclass(frozen=True)
class Allocation:
    """Which plan each junction gets.

    Attributes
    ----------
    chosen
        Index into :attr:`JunctionPlans.plans` of each junction, in their order.
    value
        The sum of joint scores.
    bound
        What no plan of the city exceeds.
    curve
        Of a count: the best sum and the bound for 0, 1, ... sensors, (count + 1, 2) float64; empty for a budget.
    """

    chosen: tuple[int, ...]
    value: float
    bound: float
    curve: Floats


def allocate_count(junctions: Sequence[JunctionPlans], count: int) -> Allocation:
    """The best choice of at most ``count`` sensors in all, those that are there already among them."""
    best, choice = np.full(count + 1, -math.inf), []
    best[:] = 0.0
    for its in junctions:
        tried = np.full((len(its.plans), count + 1), -math.inf)
        for number, plan in enumerate(its.plans):
            if plan.count <= count:
                tried[number, plan.count :] = best[: count + 1 - plan.count] + plan.value
        choice.append(tried.argmax(axis=0))
        best = tried.max(axis=0)
    chosen, left = [], count
    for its, of in zip(reversed(junctions), reversed(choice), strict=True):
        chosen.append(int(of[left]))
        left -= its.plans[chosen[-1]].count
    bounds = np.maximum(_bounds_by_count(junctions, count), best)
    return Allocation(tuple(reversed(chosen)), float(best[-1]), float(bounds[-1]), np.column_stack([best, bounds]))


def _bounds_by_count(junctions: Sequence[JunctionPlans], count: int) -> Floats:
    best = np.zeros(count + 1)
    for its in junctions:
        bound = np.array([its.bound(number) for number in range(min(count, len(its.min_costs) - 1) + 1)])
        more = np.full(count + 1, -math.inf)
        for number, value in enumerate(bound.tolist()):
            more[number:] = np.maximum(more[number:], best[: count + 1 - number] + value)
        best = more
    return best


def allocate_budget(junctions: Sequence[JunctionPlans], budget: float) -> Allocation:
    """The best choice that costs no more than ``budget`` in all."""
    limit = budget * (1.0 + _COST_TOLERANCE)
    costs, values = np.zeros(1), np.zeros(1)
    steps: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    for its in junctions:
        cost = (costs[None, :] + np.array([plan.cost for plan in its.plans])[:, None]).ravel()
        value = (values[None, :] + np.array([plan.value for plan in its.plans])[:, None]).ravel()
        kept = _pareto_front(cost, value, limit)
        steps.append((kept // len(costs), kept % len(costs)))
        costs, values = cost[kept], value[kept]
    at, chosen = len(values) - 1, []
    for plan, before in reversed(steps):
        chosen.append(int(plan[at]))
        at = int(before[at])
    value = float(values[-1])
    return Allocation(tuple(reversed(chosen)), value, max(value, relaxed_bound(junctions, limit)), np.empty((0, 2)))


def _pareto_front(cost: Floats, value: Floats, limit: float) -> NDArray[np.int64]:
    """Those within the limit of which none that costs no more is worth as much, by ascending cost."""
    order = np.lexsort((-value, cost))
    order = order[cost[order] <= limit]
    best = np.maximum.accumulate(np.append(-math.inf, value[order]))
    kept = order[value[order] > best[:-1]]
    if len(kept) > _MAX_STATES:
        bucket = np.floor(cost[kept] / limit * _MAX_STATES)
        kept = kept[np.append(bucket[1:] != bucket[:-1], True)]  # the last of each is worth most
    return kept


def relaxed_bound(junctions: Sequence[JunctionPlans], limit: float) -> float:
    """What no choice within a limit of cost exceeds: each junction's bounds over least costs, made concave, taken step
    by step, the steepest first, the last one in part."""
    total, steps = 0.0, []
    for its in junctions:
        points = _upper_hull([(cost, its.bound(number)) for number, cost in enumerate(its.min_costs) if cost <= limit])
        total += points[0][1]
        steps += [(b[1] - a[1], b[0] - a[0]) for a, b in pairwise(points)]
    left = limit
    for gain, cost in sorted(steps, key=lambda step: -step[0] / step[1]):
        share = min(1.0, left / cost)
        total += share * gain
        left -= share * cost
        if not left > 0.0:
            break
    return total


def _upper_hull(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The upper hull of (cost, value), from the cheapest on, as far as it rises."""
    best: dict[float, float] = {}
    for cost, value in points:
        best[cost] = max(value, best.get(cost, -math.inf))
    hull: list[tuple[float, float]] = []
    for cost, value in sorted(best.items()):
        if hull and value <= hull[-1][1]:
            continue
        while len(hull) > 1 and _turns_up(hull[-2], hull[-1], (cost, value)):
            hull.pop()
        hull.append((cost, value))
    return hull


def _turns_up(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    """Whether b lies on or below the line from a to c."""
    return (b[1] - a[1]) * (c[0] - a[0]) <= (c[1] - a[1]) * (b[0] - a[0])
