"""Plans, bounds and proofs against trying every subset."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from egvs.placement import branch_and_bound, solver
from egvs.placement.problem import Demand, PlanRules, Problem
from tests.placement.solving.instances import drawn, drawn_degenerate, every_plan, sight_of, term_of, value_of


def unheard(_: int) -> None:
    """Of progress."""


def best_of_all(its) -> float | None:
    """The largest value of all plans that meet the demands; None where none does."""
    values = [
        value for plan in every_plan(its.problem) for met, value in [value_of(its.problem, plan, its.hits)] if met
    ]
    return max(values, default=None)


@pytest.mark.slow
@pytest.mark.parametrize("start", range(0, 2000, 100))
def test_no_plan_is_better_than_the_one_that_is_proved_and_no_bound_is_exceeded(start: int) -> None:
    """2,000 problems of every kind: the exact plan is the best to the last bit, and no certificate is wrong."""
    for seed in range(start, start + 100):
        its = drawn(seed)
        if not its.problem.rules.allows(its.problem.rules.forced):
            continue  # refused before a plan is looked for
        best = best_of_all(its)
        solution = solver.best_plan(its.problem, search_all=False, time_limit_s=0.0, on_progress=unheard)
        bounds = solver.term_bounds(its.problem, solution.point.plan_value)
        proved = branch_and_bound.search_all_plans(its.problem, solution.point.plan, bounds, time_limit_s=60.0)
        assert proved.is_complete, seed
        for plan, worth in ((solution.order, solution.point.plan_value), (proved.plan, proved.plan_value)):
            met, value = value_of(its.problem, plan, its.hits)
            assert its.problem.rules.allows(plan), seed
            assert worth.value == value, seed
            assert met == (worth.met >= 0.0), seed
        if best is None:
            assert proved.plan_value.met < 0.0, seed
            continue
        assert proved.plan_value.met >= 0.0, seed
        assert proved.plan_value.value == best, seed
        assert solution.point.bound >= best, seed
        assert solution.point.certificate <= 1.0, seed
        if its.problem.is_plain and np.isinf(its.problem.rules.budget) and its.problem.rules.most_per_pole >= 7:
            assert solution.point.plan_value.value >= (1 - 1 / math.e) * best * (1 - 1e-12), seed


def test_the_fewest_that_reach_a_share_are_the_fewest() -> None:
    """One sensor less cannot, where that is said to be proved; by trying every subset."""
    proved = 0
    for seed in range(150):
        its = drawn(seed)
        problem = its.problem
        if not problem.is_plain or not problem.rules.allows(problem.rules.forced):
            continue
        together = problem.coverage_state(problem.candidates.tolist()).value(problem.joint)
        asked = Demand(problem.joint, 0.7 * together)
        found = solver.smallest_plan(
            type(problem)(problem.joint, problem.objective, (asked,), problem.rules),
            time_limit_s=30.0,
            on_progress=unheard,
        )
        reaching = [
            len(p) for p in every_plan(problem) if value_of(problem, p, its.hits)[1] >= asked.least * (1 - 1e-12)
        ]
        if found is None:
            assert not reaching, seed
            continue
        assert found.fewest_is_proved
        proved += 1
        assert len(found.order) == max(min(reaching), 1), seed
    assert proved > 20


def test_a_search_that_runs_out_of_time_proves_what_it_says() -> None:
    for seed in range(60):
        its = drawn(seed)
        if its.problem.demands or not its.problem.rules.allows(its.problem.rules.forced):
            continue
        found = solver.best_plan(its.problem, search_all=True, time_limit_s=0.0, on_progress=unheard)
        best = best_of_all(its)
        assert best is not None
        assert found.point.bound >= best, seed


@pytest.mark.slow
@pytest.mark.parametrize("start", range(0, 150, 50))
def test_degenerate_problems_are_solved_and_every_point_of_the_curve_holds(start: int) -> None:
    """The plan is the best one, whether the search ends or not no bound is exceeded, and no larger plan is worse."""
    for seed in range(start, start + 50):
        its = drawn_degenerate(seed)
        if not its.problem.rules.allows(its.problem.rules.forced):
            continue
        plans = [(len(plan), *value_of(its.problem, plan, its.hits)) for plan in every_plan(its.problem)]
        for limit_s in (0.0, 60.0):
            found = solver.best_plan(its.problem, search_all=True, time_limit_s=limit_s, on_progress=unheard)
            worth = found.point.plan_value
            assert its.problem.rules.allows(found.order), seed
            assert (worth.met >= 0.0, worth.value) == value_of(its.problem, found.order, its.hits), seed
            assert all(
                one.plan_value <= more.plan_value for one, more in zip(found.curve, found.curve[1:], strict=False)
            ), seed
            for point in found.curve:
                assert len(point.plan) <= point.count, seed
                values = [value for size, met, value in plans if met and size <= point.count]
                assert point.bound >= max(values, default=0.0), seed
        best = max((value for _, met, value in plans if met), default=None)
        assert (worth.met >= 0.0, worth.value) == (best is not None, best if best is not None else worth.value), seed


def test_the_fewest_of_degenerate_problems() -> None:
    for seed in range(100):
        its = drawn_degenerate(seed)
        problem = its.problem
        if problem.demands or not problem.rules.allows(problem.rules.forced):
            continue
        together = problem.coverage_state(problem.candidates.tolist()).value(problem.joint)
        for share in (0.3, 1.0):
            asked = replace(problem, demands=(Demand(problem.joint, share * together),))
            enough = [len(plan) for plan in every_plan(asked) if value_of(asked, plan, its.hits)[0]]
            found = solver.smallest_plan(asked, time_limit_s=30.0, on_progress=unheard)
            assert (found is None) == (not enough), seed
            assert found is None or (found.fewest_is_proved and len(found.order) <= max(1, min(enough))), seed


def rules_for(count: int, cost: list[float], budget: float = np.inf) -> PlanRules:
    """Of candidates with a pole each."""
    n, price = len(cost), np.array(cost)
    blank = np.zeros((n, 3))
    return PlanRules(count, budget, price, 0 * price, np.arange(n), (), np.zeros(n, dtype=bool), n, blank, 0.0)


@pytest.mark.slow
def test_many_cheap_ones_are_found_beside_a_dear_one_that_sees_more() -> None:
    """Greedy by gain alone takes the dear one and has nothing left; by gain per cost all the cheap ones."""
    hits = np.zeros((21, 23), dtype=int)
    hits[0, :3], hits[range(1, 21), range(3, 23)] = 1, 1
    term = term_of("", sight_of(hits), np.ones(23), scale=1.0)
    problem = Problem(term, (term,), (), rules_for(21, [20.0, *[1.0] * 20], 20.0))
    found = solver.best_plan(problem, search_all=False, time_limit_s=0.0, on_progress=unheard)
    assert (found.point.plan_value.value, found.point.count, len(found.curve)) == (20.0, 20, 20)


def test_a_second_sensor_is_put_up_for_a_zone_that_two_must_see_though_the_score_gains_nothing() -> None:
    hits = np.ones((5, 4), dtype=int)
    sight = sight_of(hits)
    term = term_of("", sight, np.ones(4), scale=1.0)
    zone = term_of("zone", sight, np.full(4, 1 / 12), scale=3.0, each_once=True)
    zone = replace(zone, exact=lambda totals: float((totals >= 3).mean()))
    problem = Problem(term, (term,), (Demand(zone, 1.0),), rules_for(5, [0.0] * 5))
    found = solver.best_plan(problem, search_all=False, time_limit_s=0.0, on_progress=unheard)
    assert (found.order, found.point.plan_value.met) == ((0, 1, 2), 0.0)


def test_of_one_sensor_the_best_is_proved_without_a_search() -> None:
    """By the gains alone, whatever the curve: no plan of one exceeds the largest."""
    proved = 0
    for seed in range(150):
        its = drawn(seed)
        problem = its.problem.with_count(1)
        if not problem.is_plain or problem.rules.forced or np.isfinite(problem.rules.budget):
            continue
        found = solver.best_plan(problem, search_all=False, time_limit_s=0.0, on_progress=unheard)
        assert found.point.certificate == 1.0, seed
        assert found.is_best
        proved += 1
    assert proved > 20
