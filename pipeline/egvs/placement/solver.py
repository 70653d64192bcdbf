"""Solve placement problems: best plans, fewest sensors, the curve over the number of sensors, and certificates.

Steps, for 1, 2, ... sensors: a greedy plan; swaps until none helps; an upper bound on every plan of as many sensors
(:mod:`egvs.placement.branch_and_bound`); on request the exact search. The sensors of a plan are listed in greedy order:
the one with the largest gain first.

With a count alone, the greedy plan reaches at least 1 - 1/e of the optimum (Nemhauser, Wolsey and Fisher 1978). With
costs, the better of greedy by gain and greedy by gain per cost reaches at least (1 - 1/e) / 2 of it (Leskovec et al.
2007); starts from every single candidate are tried too if there are few. For the worst of several periods, the scores
are capped at a level that is found by bisection (Krause et al. 2008).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from time import perf_counter
from typing import NamedTuple

import numpy as np

from egvs.core.grid import FloatArray, IntArray
from egvs.placement import branch_and_bound
from egvs.placement.branch_and_bound import Bound, BoundSettings
from egvs.placement.problem import AdditionValues, CoverageState, Plan, PlanValue, Problem, tie_break_key
from egvs.results.plans import proved_share

SelectionRule = Callable[[CoverageState, IntArray, AdditionValues], tuple[FloatArray, ...]]
"""From a plan, some candidates, and its values with each: the sort keys of the candidates, the primary key last."""

SolverCallback = Callable[[int], None]
"""Called with the number of sensors for which a plan is known."""

TermBounds = tuple[Bound, ...]
"""One bound per term of the objective."""

MAX_BOUND_STEPS = 160
"""Maximum number of Frank-Wolfe steps for the bound of a plan."""

SUFFICIENT_GAP = 5e-4
"""A bound is good enough if it is above the plan by this share: a certificate of 99.95 %."""

_MAX_STARTS = 40
"""Up to so many candidates, plans with costs are also started from each single candidate."""

_MAX_PLANS_TO_SWAP = 20
"""So many of the best plans are improved by swaps."""

_N_LEVELS = 12
"""Number of bisection steps for the level of the worst period."""

_BATCH_SIZE = 16
"""Number of candidates whose gains are computed at once."""

_MIN_GAIN = 1e-12
"""Smaller relative gains count as zero."""


@dataclass(frozen=True)
class CurvePoint:
    """The best plan found with at most ``count`` sensors.

    Attributes
    ----------
    count
        Maximum number of sensors.
    plan
        Candidates, sorted.
    plan_value
        Value of the plan.
    bound
        Upper bound on ``plan_value.value`` of every such plan.
    """

    count: int
    plan: Plan
    plan_value: PlanValue
    bound: float

    @property
    def certificate(self) -> float:
        """Proved share of the best possible value, 0 to 1; 1 if the bound is tight up to rounding."""
        return proved_share(self.plan_value.value, self.bound)


@dataclass(frozen=True)
class Solution:
    """A plan and what is proved about it.

    Attributes
    ----------
    order
        Candidates of the plan in greedy order, forced ones first.
    curve
        Best plans of 1, 2, ... sensors; the last one is the plan.
    nodes
        Number of nodes of the exact search; 0 without it.
    is_best
        Whether it is proved that no plan is better (if proved by the bound alone: better by more than its rounding).
    fewest_is_proved
        Whether it is proved that one sensor fewer cannot meet the demands; None if this was not requested.
    """

    order: Plan
    curve: tuple[CurvePoint, ...]
    nodes: int = 0
    is_best: bool = False
    fewest_is_proved: bool | None = None

    @property
    def point(self) -> CurvePoint:
        """The point of the curve that belongs to the plan."""
        return self.curve[-1]


class BoundedPoint(NamedTuple):
    """A point of the curve, and the bounds on each term of the objective."""

    point: CurvePoint
    bounds: TermBounds


def best_plan(problem: Problem, *, search_all: bool, time_limit_s: float, on_progress: SolverCallback) -> Solution:
    """Return the best plan found within the rules.

    Parameters
    ----------
    problem
        The problem.
    search_all
        Search until the best plan is proved, or until the time limit.
    time_limit_s
        Time limit of that search.
    on_progress
        Called with the number of sensors for which a plan is known.
    """
    rules = problem.rules
    has_budget = not np.isinf(rules.budget)
    if has_budget:  # the plan decides how many sensors the budget buys
        smaller_points: list[CurvePoint] = []
        last, bounds = _curve_point(problem.with_count(rules.max_sensors), ())
    else:
        curve = _plan_curve(problem, rules.max_sensors, on_progress)
        last, bounds = curve[-1]
        smaller_points = [bounded.point for bounded in curve[:-1]]

    nodes = 0
    is_complete = False
    if search_all:
        result = branch_and_bound.search_all_plans(problem, last.plan, bounds, time_limit_s=time_limit_s)
        assert result.plan is not None
        nodes = result.nodes
        is_complete = result.is_complete
        bound = min(last.bound, result.bound)
        last = replace(last, plan=result.plan, plan_value=result.plan_value, bound=bound)

    if has_budget:
        smaller_points, last = _smaller_plans(problem, last, on_progress)
    is_best = is_complete or last.certificate >= 1.0
    return Solution(greedy_order(problem, last.plan), (*smaller_points, last), nodes, is_best)


def smallest_plan(problem: Problem, *, time_limit_s: float, on_progress: SolverCallback) -> Solution | None:
    """Return the plan with the fewest sensors that meets all demands; None if none was found within the rules.

    Parameters
    ----------
    problem
        The problem.
    time_limit_s
        Time limit for the proof that one sensor fewer is not enough.
    on_progress
        Called with the number of sensors for which a plan is known.
    """
    end_time = perf_counter() + time_limit_s
    curve: list[BoundedPoint] = []
    for count in range(_first_count(problem), problem.rules.max_sensors + 1):
        previous: Plan = curve[-1].point.plan if curve else ()
        curve.append(_curve_point(problem.with_count(count), previous))
        on_progress(count)
        plan = curve[-1].point.plan
        if curve[-1].point.plan_value.met >= 0.0:
            break
        if len(curve) > 1 and plan == previous and len(previous) < count - 1:
            return None  # no further sensor is allowed, or none helps
    else:
        return None

    points = [bounded.point for bounded in curve]
    is_proved = True
    nodes = 0
    while len(points) > 1:
        fewer = problem.with_count(points[-2].count)
        remaining_s = max(0.0, end_time - perf_counter())
        result = branch_and_bound.search_all_plans(fewer, None, curve[len(points) - 2].bounds, time_limit_s=remaining_s)
        nodes += result.nodes
        if result.plan is None:
            is_proved = result.is_complete
            break
        points.pop()
        points[-1] = replace(points[-1], plan=result.plan, plan_value=result.plan_value)
    order = greedy_order(problem, points[-1].plan)
    return Solution(order, tuple(points), nodes, fewest_is_proved=is_proved)


def _first_count(problem: Problem) -> int:
    """Number of sensors at which the curve starts."""
    return max(1, len(problem.rules.forced))


def _plan_curve(problem: Problem, max_count: int, on_progress: SolverCallback) -> list[BoundedPoint]:
    """Plans of 1, 2, ..., ``max_count`` sensors, or up to where no further sensor adds anything."""
    curve: list[BoundedPoint] = []
    greedy: Plan = ()
    if problem.is_plain and np.isinf(problem.rules.budget):
        greedy = greedy_plan(problem)
    for count in range(_first_count(problem), max_count + 1):
        smaller: Plan = curve[-1].point.plan if curve else ()
        curve.append(_curve_point(problem.with_count(count), smaller, greedy[:count]))
        on_progress(count)
        if problem.is_plain and not _can_improve(problem, curve[-1].point.plan):
            break
    return curve


def _smaller_plans(
    problem: Problem, last: CurvePoint, on_progress: SolverCallback
) -> tuple[list[CurvePoint], CurvePoint]:
    """Plans with fewer sensors than the best plan within a budget, and that plan, or a better one found on the way."""
    curve = [bounded.point for bounded in _plan_curve(problem, len(last.plan) - 1, on_progress)]
    better = [point for point in curve if point.plan_value > last.plan_value]
    if better:
        best = max(better, key=lambda point: point.plan_value)
        bound = max(last.bound, best.plan_value.value)
        last = replace(last, plan=best.plan, plan_value=best.plan_value, bound=bound)
    count = max(_first_count(problem), len(last.plan))
    return [point for point in curve if point.count < count], replace(last, count=count)


def _can_improve(problem: Problem, plan: Plan) -> bool:
    """Whether any candidate adds anything to a plan; if not, no plan is better."""
    state = problem.coverage_state(plan)
    return bool((state.gains(problem.joint, problem.candidates) > 0.0).any())


def _curve_point(problem: Problem, smaller: Plan, greedy: Plan = ()) -> BoundedPoint:
    """The best plan found, and bounds.

    Parameters
    ----------
    smaller
        The best plan of one sensor fewer, which is extended too.
    greedy
        The greedy plan, if it is known and no other start is needed.
    """
    plans: set[Plan] = set()
    if greedy:
        plans.add(tuple(sorted(greedy)))
    else:
        plans.add(best_heuristic_plan(problem))
    if smaller:
        plans.add(tuple(sorted(greedy_plan(problem, smaller))))
    plan = pick_best_plan(problem, sorted(plans))
    plan_value = problem.plan_value(plan)

    bounds = term_bounds(problem, plan_value)
    useful = np.union1d(np.array(plan, dtype=np.int64), np.concatenate([bound.candidates for bound in bounds]))
    if len(useful) > len(plan):
        swap_problem = problem.restricted_to(useful) if problem.is_plain else problem
        plan = improve_by_swaps(swap_problem, plan)
        plan_value = problem.plan_value(plan)
    bound = max(min(bound.value for bound in bounds), plan_value.value)
    return BoundedPoint(CurvePoint(problem.rules.count, plan, plan_value, bound), bounds)


def term_bounds(problem: Problem, known: PlanValue) -> TermBounds:
    """Return an upper bound on each term of the objective; ``known`` is the value of a known plan."""
    # A plan that must survive one failure is worth no more than the best plan of one sensor fewer.
    rules = problem.with_count(problem.rules.count - problem.survives).rules
    plan: Plan = rules.forced
    candidates = np.setdiff1d(problem.candidates, rules.forced).astype(np.int64)
    if problem.survives:
        plan = ()
        candidates = problem.candidates
    known_value = known.value if known.met >= 0.0 else -np.inf
    settings = BoundSettings(steps=MAX_BOUND_STEPS, threads=problem.threads, sufficient_gap=SUFFICIENT_GAP)

    state = problem.coverage_state(plan)
    bounds = []
    for term in problem.objective:
        bound = branch_and_bound.upper_bound(term, rules, plan, candidates, known_value, settings)
        # The sum of the largest gains is exact for one more sensor.
        largest_gains = rules.max_gain_sum(state.gains(term, candidates), candidates, plan).total
        bound_by_gains = (state.value(term) + largest_gains) * (1.0 + branch_and_bound.BOUND_ROUNDING)
        bounds.append(replace(bound, value=max(min(bound.value, bound_by_gains), known_value)))
    return tuple(bounds)


def greedy_order(problem: Problem, plan: Plan) -> Plan:
    """Sort a plan: forced candidates first, then always the one with the largest gain in the joint score."""
    state = problem.coverage_state()
    remaining = list(plan)
    while remaining:
        next_ones = [candidate for candidate in remaining if candidate in problem.rules.forced] or remaining
        gains = state.gains(problem.joint, np.array(next_ones, dtype=np.int64))
        state.add(next_ones[int(np.argmax(gains))])
        remaining.remove(state.chosen[-1])
    return tuple(state.chosen)


def best_heuristic_plan(problem: Problem) -> Plan:
    """Return the best plan of all heuristics, sorted."""
    plans = {tuple(sorted(plan)) for plan in _start_plans(problem)}
    by_value = sorted(sorted(plans, key=tie_break_key), key=problem.plan_value, reverse=True)
    improved = {improve_by_swaps(problem, plan) for plan in by_value[:_MAX_PLANS_TO_SWAP]}
    return pick_best_plan(problem, sorted(improved))


def pick_best_plan(problem: Problem, plans: Sequence[Plan]) -> Plan:
    """Return the best of some plans; of equal ones the one with the fewest sensors, then the lowest indices."""
    values = [problem.plan_value(plan) for plan in plans]
    best_value = max(values)
    best_plans = [plan for plan, value in zip(plans, values, strict=True) if value == best_value]
    return min(best_plans, key=tie_break_key)


def greedy_plan(problem: Problem, start: Plan = (), rule: SelectionRule | None = None) -> Plan:
    """Add one candidate after another until the rules or the gains end it.

    Parameters
    ----------
    problem
        The problem.
    start
        Candidates to start from; forced candidates come before them.
    rule
        How the next candidate is chosen; None: by the value of the plan with it.

    Returns
    -------
    Plan
        Candidates in the order in which they were added.
    """
    state = problem.coverage_state(tuple(dict.fromkeys((*problem.rules.forced, *start))))
    if rule is None and problem.is_plain:
        return _lazy_greedy_plan(problem, state)

    while True:
        candidates = np.flatnonzero(problem.rules.allowed_additions(state.chosen))
        if not len(candidates):
            break
        values = problem.values_with_each(state, candidates)
        if not _any_improves(values, problem.plan_value_of(state)):
            break
        sort_keys = values[::-1] if rule is None else rule(state, candidates, values)
        order = np.lexsort((-candidates, *sort_keys))
        state.add(int(candidates[order[-1]]))
    return tuple(state.chosen)


def _any_improves(values: AdditionValues, current: PlanValue) -> bool:
    """Whether any candidate raises any part of a plan's value."""
    for with_each, now in zip(values, astuple(current), strict=True):
        if (with_each > now + _MIN_GAIN * abs(now)).any():
            return True
    return False


def _lazy_greedy_plan(problem: Problem, state: CoverageState) -> Plan:
    """Greedy plan by the lazy evaluation of Minoux (1978).

    A gain never exceeds the candidate's gain for a smaller plan, so only candidates whose last known gain is large
    enough are evaluated again.
    """
    known_gains = np.full(len(problem.rules.cost), np.inf)
    while True:
        candidates = np.flatnonzero(problem.rules.allowed_additions(state.chosen))
        if not len(candidates):
            break
        order = candidates[np.argsort(-known_gains[candidates], kind="stable")]
        is_first_round = not np.isfinite(known_gains[order[0]])
        batch_size = len(order) if is_first_round else _BATCH_SIZE

        best_gain = 0.0
        best_candidate = -1
        n_evaluated = 0
        while n_evaluated < len(order) and known_gains[order[n_evaluated]] >= best_gain:
            batch = order[n_evaluated : n_evaluated + batch_size]
            known_gains[batch] = state.gains(problem.joint, batch)
            best_of_batch = int(batch[np.lexsort((batch, -known_gains[batch]))[0]])
            gain = float(known_gains[best_of_batch])
            if gain > best_gain or (gain == best_gain and best_of_batch < best_candidate):
                best_gain = gain
                best_candidate = best_of_batch
            n_evaluated += len(batch)
        if not best_gain > state.value(problem.joint) * _MIN_GAIN:
            break
        state.add(best_candidate)
    return tuple(state.chosen)


def _start_plans(problem: Problem) -> list[Plan]:
    """Greedy plans from several starts and by several rules."""
    rules = problem.rules
    plans = [greedy_plan(problem)]
    if np.isfinite(rules.budget):
        by_gain_per_cost = _gain_per_cost_rule(problem)
        plans.append(greedy_plan(problem, rule=by_gain_per_cost))
        if len(problem.candidates) <= _MAX_STARTS:
            for first in np.flatnonzero(rules.allowed_additions(rules.forced)).tolist():
                plans.append(greedy_plan(problem, (first,)))
                plans.append(greedy_plan(problem, (first,), by_gain_per_cost))
    if len(problem.objective) > 1:
        plans += _plans_by_levels(problem)
    return plans


def _gain_per_cost_rule(problem: Problem) -> SelectionRule:
    def by_gain_per_cost(state: CoverageState, candidates: IntArray, values: AdditionValues) -> tuple[FloatArray, ...]:
        cost = problem.rules.further_cost(state.chosen)[candidates]
        current = problem.plan_value_of(state)
        with np.errstate(divide="ignore", invalid="ignore"):
            gain_per_cost = np.where(cost > 0.0, np.maximum(values.value - current.value, 0.0) / cost, np.inf)
            met_gain = values.met - current.met
            met_per_cost = np.where(cost > 0.0, met_gain / cost, met_gain)
        return values.joint, gain_per_cost, met_per_cost

    return by_gain_per_cost


def _plans_by_levels(problem: Problem) -> list[Plan]:
    """Plans for the worst of several periods: greedy on the sum of the scores, each capped at a level."""
    all_candidates = problem.coverage_state(problem.candidates.tolist())
    low = 0.0
    high = min(all_candidates.value(term) for term in problem.objective)
    plans = []
    for _ in range(_N_LEVELS):
        level = 0.5 * (low + high)
        plan = greedy_plan(problem, rule=_capped_sum_rule(problem, level))
        plans.append(plan)
        state = problem.coverage_state(plan)
        if min(state.value(term) for term in problem.objective) >= level:
            low = level
        else:
            high = level
    return plans


def _capped_sum_rule(problem: Problem, level: float) -> SelectionRule:
    def by_capped_sum(state: CoverageState, candidates: IntArray, values: AdditionValues) -> tuple[FloatArray, ...]:
        capped = []
        for term in problem.objective:
            with_each = state.value(term) + state.gains(term, candidates)
            capped.append(np.minimum(with_each, level))
        return values.joint, np.sum(capped, axis=0), values.met

    return by_capped_sum


def improve_by_swaps(problem: Problem, plan: Plan) -> Plan:
    """Swap one sensor for the best other one, or add one, until nothing helps; return the sorted plan."""
    rules = problem.rules
    best = tuple(sorted(plan))
    best_value = problem.plan_value(plan)
    while True:
        movable = [candidate for candidate in best if candidate not in rules.forced]
        for removed in (None, *movable):
            rest = tuple(candidate for candidate in best if candidate != removed)
            swapped = _with_best_addition(problem, rest, removed)
            if swapped is None:
                continue
            swapped_value = problem.plan_value(swapped)
            if swapped_value > best_value and rules.allows(swapped):
                best = swapped
                best_value = swapped_value
                break
        else:
            return best


def _with_best_addition(problem: Problem, rest: Plan, removed: int | None) -> Plan | None:
    """A plan with its best addition other than ``removed``, sorted; None if there is none."""
    candidates = np.flatnonzero(problem.rules.allowed_additions(rest))
    if removed is not None:
        candidates = candidates[candidates != removed]
    if not len(candidates):
        return None
    values = problem.values_with_each(problem.coverage_state(rest), candidates)
    best = int(candidates[np.lexsort((-candidates, values.joint, values.value, values.met))[-1]])
    return tuple(sorted((*rest, best)))
