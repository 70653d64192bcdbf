"""Plans, bounds and proofs against trying every subset."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pipeline.placement.solving import exact, planning
from pipeline.placement.solving.problem import Demand
from tests.placement.solving.instances import drawn, every_plan, value_of


def unheard(_: int) -> None:
    """Of progress."""


def best_of_all(its) -> float | None:
    """The largest value of all plans that meet the demands; None where none does."""
    values = [
        value for plan in every_plan(its.problem) for met, value in [value_of(its.problem, plan, its.hits)] if met
    ]
    return max(values, default=None)


@pytest.mark.parametrize("start", range(0, 2000, 100))
def test_no_plan_is_better_than_the_one_that_is_proved_and_no_bound_is_exceeded(start: int) -> None:
    """2,000 problems of every kind: the exact plan is the best to the last bit, and no certificate is wrong."""
    for seed in range(start, start + 100):
        its = drawn(seed)
        if not its.problem.rules.keeps(its.problem.rules.forced):
            continue  # refused before a plan is looked for
        best = best_of_all(its)
        solution = planning.best(its.problem, search_all=False, time_limit_s=0.0, heard=unheard)
        bounds = planning.bounds_of(its.problem, solution.point.worth)
        proved = exact.search(its.problem, solution.point.plan, bounds, time_limit_s=60.0)
        assert proved.is_whole, seed
        for plan, worth in ((solution.order, solution.point.worth), (proved.plan, proved.worth)):
            met, value = value_of(its.problem, plan, its.hits)
            assert its.problem.rules.keeps(plan), seed
            assert worth.value == value, seed
            assert met == (worth.met >= 0.0), seed
        if best is None:
            assert proved.worth.met < 0.0, seed
            continue
        assert proved.worth.met >= 0.0, seed
        assert proved.worth.value == best, seed
        assert solution.point.bound >= best, seed
        assert solution.point.certificate <= 1.0, seed
        if its.problem.is_plain and np.isinf(its.problem.rules.budget) and its.problem.rules.most_per_pole >= 7:
            assert solution.point.worth.value >= (1 - 1 / math.e) * best * (1 - 1e-12), seed


def test_the_fewest_that_reach_a_share_are_the_fewest() -> None:
    """One sensor less cannot, where that is said to be proved; by trying every subset."""
    proved = 0
    for seed in range(150):
        its = drawn(seed)
        problem = its.problem
        if not problem.is_plain or not problem.rules.keeps(problem.rules.forced):
            continue
        together = problem.together(problem.candidates.tolist()).value(problem.joint)
        asked = Demand(problem.joint, 0.7 * together)
        found = planning.fewest(
            type(problem)(problem.joint, problem.objective, (asked,), problem.rules), time_limit_s=30.0, heard=unheard
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
        if its.problem.demands or not its.problem.rules.keeps(its.problem.rules.forced):
            continue
        found = planning.best(its.problem, search_all=True, time_limit_s=0.0, heard=unheard)
        best = best_of_all(its)
        assert best is not None
        assert found.point.bound >= best, seed
