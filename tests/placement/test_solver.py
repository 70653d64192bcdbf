"""Plans, bounds and proofs, compared with all subsets of small random problems."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from egvs.placement import branch_and_bound, solver
from egvs.placement.problem import Demand, PlanRules, Problem
from tests.placement.instances import (
    Instance,
    all_plans,
    draw_degenerate_problem,
    draw_problem,
    make_matrix,
    make_term,
    value_of,
)


def ignore_progress(_: int) -> None:
    pass


def best_value(instance: Instance) -> float | None:
    """Return the largest value of all plans that meet the demands; None if there is none."""
    best = None
    for plan in all_plans(instance.problem):
        is_met, value = value_of(instance.problem, plan, instance.hits)
        if is_met and (best is None or value > best):
            best = value
    return best


@pytest.mark.slow
@pytest.mark.parametrize("start", range(0, 2000, 100))
def test_exact_plan_is_best_and_bounds_hold(start: int) -> None:
    """2,000 problems of all kinds: the exact plan is the best to the last bit, and no certificate is wrong."""
    for seed in range(start, start + 100):
        instance = draw_problem(seed)
        problem, rules = instance.problem, instance.problem.rules
        if not rules.allows(rules.forced):
            continue  # rejected before solving
        best = best_value(instance)
        solution = solver.best_plan(problem, search_all=False, time_limit_s=0.0, on_progress=ignore_progress)
        bounds = solver.term_bounds(problem, solution.point.plan_value)
        proved = branch_and_bound.search_all_plans(problem, solution.point.plan, bounds, time_limit_s=60.0)
        assert proved.is_complete, seed
        for plan, plan_value in ((solution.order, solution.point.plan_value), (proved.plan, proved.plan_value)):
            is_met, value = value_of(problem, plan, instance.hits)
            assert rules.allows(plan), seed
            assert plan_value.value == value, seed
            assert is_met == (plan_value.met >= 0.0), seed
        if best is None:
            assert proved.plan_value.met < 0.0, seed
            continue
        assert proved.plan_value.met >= 0.0, seed
        assert proved.plan_value.value == best, seed
        assert solution.point.bound >= best, seed
        assert solution.point.certificate <= 1.0, seed
        if problem.is_plain and np.isinf(rules.budget) and rules.most_per_pole >= 7:
            assert solution.point.plan_value.value >= (1 - 1 / math.e) * best * (1 - 1e-12), seed


@pytest.mark.slow
def test_smallest_plan_is_smallest() -> None:
    """If it is proved, no subset with one sensor less reaches the share."""
    n_proved = 0
    for seed in range(150):
        instance = draw_problem(seed)
        problem = instance.problem
        if not problem.is_plain or not problem.rules.allows(problem.rules.forced):
            continue
        joint_of_all = problem.coverage_state(problem.candidates.tolist()).value(problem.joint)
        demand = Demand(problem.joint, 0.7 * joint_of_all)
        solution = solver.smallest_plan(
            Problem(problem.joint, problem.objective, (demand,), problem.rules),
            time_limit_s=30.0,
            on_progress=ignore_progress,
        )
        sizes = []
        for plan in all_plans(problem):
            if value_of(problem, plan, instance.hits)[1] >= demand.least * (1 - 1e-12):
                sizes.append(len(plan))
        if solution is None:
            assert not sizes, seed
            continue
        assert solution.fewest_is_proved
        n_proved += 1
        assert len(solution.order) == max(min(sizes), 1), seed
    assert n_proved > 20


@pytest.mark.slow
def test_bound_holds_when_time_runs_out() -> None:
    for seed in range(60):
        instance = draw_problem(seed)
        problem = instance.problem
        if problem.demands or not problem.rules.allows(problem.rules.forced):
            continue
        solution = solver.best_plan(problem, search_all=True, time_limit_s=0.0, on_progress=ignore_progress)
        best = best_value(instance)
        assert best is not None
        assert solution.point.bound >= best, seed


@pytest.mark.slow
@pytest.mark.parametrize("start", range(0, 150, 50))
def test_degenerate_problems(start: int) -> None:
    """The plan is the best one; bounds hold even if the search is interrupted; no larger plan is worse."""
    for seed in range(start, start + 50):
        instance = draw_degenerate_problem(seed)
        problem = instance.problem
        if not problem.rules.allows(problem.rules.forced):
            continue
        plans = [(len(plan), *value_of(problem, plan, instance.hits)) for plan in all_plans(problem)]
        for limit_s in (0.0, 60.0):
            solution = solver.best_plan(problem, search_all=True, time_limit_s=limit_s, on_progress=ignore_progress)
            plan_value = solution.point.plan_value
            assert problem.rules.allows(solution.order), seed
            expected = value_of(problem, solution.order, instance.hits)
            assert (plan_value.met >= 0.0, plan_value.value) == expected, seed
            for smaller, larger in zip(solution.curve, solution.curve[1:], strict=False):
                assert smaller.plan_value <= larger.plan_value, seed
            for point in solution.curve:
                assert len(point.plan) <= point.count, seed
                values = [value for size, is_met, value in plans if is_met and size <= point.count]
                assert point.bound >= max(values, default=0.0), seed
        best = max((value for _, is_met, value in plans if is_met), default=None)
        assert (plan_value.met >= 0.0) == (best is not None), seed
        if best is not None:
            assert plan_value.value == best, seed


@pytest.mark.slow
def test_smallest_plan_of_degenerate_problems() -> None:
    for seed in range(100):
        instance = draw_degenerate_problem(seed)
        problem = instance.problem
        if problem.demands or not problem.rules.allows(problem.rules.forced):
            continue
        joint_of_all = problem.coverage_state(problem.candidates.tolist()).value(problem.joint)
        for share in (0.3, 1.0):
            with_demand = replace(problem, demands=(Demand(problem.joint, share * joint_of_all),))
            sizes = [len(plan) for plan in all_plans(with_demand) if value_of(with_demand, plan, instance.hits)[0]]
            solution = solver.smallest_plan(with_demand, time_limit_s=30.0, on_progress=ignore_progress)
            assert (solution is None) == (not sizes), seed
            if solution is not None:
                assert solution.fewest_is_proved, seed
                assert len(solution.order) <= max(1, min(sizes)), seed


def make_rules(count: int, cost: list[float], budget: float = np.inf) -> PlanRules:
    """Return rules for candidates with one pole each."""
    n, costs = len(cost), np.array(cost)
    positions_m = np.zeros((n, 3))
    return PlanRules(count, budget, costs, 0 * costs, np.arange(n), (), np.zeros(n, dtype=bool), n, positions_m, 0.0)


@pytest.mark.slow
def test_finds_many_cheap_sensors_instead_of_expensive_one() -> None:
    """Greedy by gain chooses the expensive sensor and exhausts the budget; by gain per cost it chooses all others."""
    hits = np.zeros((21, 23), dtype=int)
    hits[0, :3], hits[range(1, 21), range(3, 23)] = 1, 1
    term = make_term("", make_matrix(hits), np.ones(23), scale=1.0)
    problem = Problem(term, (term,), (), make_rules(21, [20.0, *[1.0] * 20], 20.0))
    solution = solver.best_plan(problem, search_all=False, time_limit_s=0.0, on_progress=ignore_progress)
    assert (solution.point.plan_value.value, solution.point.count, len(solution.curve)) == (20.0, 20, 20)


def test_adds_sensors_for_zone_even_without_gain() -> None:
    hits = np.ones((5, 4), dtype=int)
    visibility = make_matrix(hits)
    term = make_term("", visibility, np.ones(4), scale=1.0)
    zone = make_term("zone", visibility, np.full(4, 1 / 12), scale=3.0, each_once=True)
    zone = replace(zone, exact=lambda totals: float((totals >= 3).mean()))
    problem = Problem(term, (term,), (Demand(zone, 1.0),), make_rules(5, [0.0] * 5))
    solution = solver.best_plan(problem, search_all=False, time_limit_s=0.0, on_progress=ignore_progress)
    assert (solution.order, solution.point.plan_value.met) == ((0, 1, 2), 0.0)


def test_best_single_sensor_is_proved_without_search() -> None:
    """The largest gain is a bound of all plans with one sensor, for any curve."""
    n_proved = 0
    for seed in range(150):
        problem = draw_problem(seed).problem.with_count(1)
        if not problem.is_plain or problem.rules.forced or np.isfinite(problem.rules.budget):
            continue
        solution = solver.best_plan(problem, search_all=False, time_limit_s=0.0, on_progress=ignore_progress)
        assert solution.point.certificate == 1.0, seed
        assert solution.is_best
        n_proved += 1
    assert n_proved > 20
