"""How sensors are shared among junctions: against every choice there is, and against what is proved."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.city import allocation
from egvs.city.allocation import JunctionPlan, JunctionPlans, JunctionSensor, min_costs_by_count
from egvs.placement.problem import PlanRules
from egvs.sensors.sites import Pose, Site

SITE = Site("s", Pose(0.0, 0.0, 3.0), "VLP-16")


def plan(count: int, value: float, cost: float) -> JunctionPlan:
    return JunctionPlan(
        (JunctionSensor(SITE, False, value / max(1, count), cost / max(1, count)),) * count, value, cost
    )


@st.composite
def junctions(draw: st.DrawFn) -> list[JunctionPlans]:
    """Junctions with plans whose gains need not fall, and bounds above them."""
    made = []
    for number in range(draw(st.integers(1, 4))):
        values = sorted(draw(st.lists(st.integers(0, 50), min_size=1, max_size=4)))
        prices = draw(st.lists(st.integers(1, 9), min_size=len(values), max_size=len(values)))
        plans = [plan(0, 0.0, 0.0)]
        plans += [plan(n, float(v), float(sum(prices[:n]))) for n, v in enumerate(values, start=1)]
        slack = draw(st.integers(0, 5))
        bounds = (0.0, *(float(value + slack) for value in values))
        cheapest = np.append(0.0, np.cumsum(sorted(prices)))
        made.append(
            JunctionPlans(f"j{number}", tuple(plans), bounds, tuple(cheapest.tolist()), values[-1] + slack, True)
        )
    return made


def every_choice(of: list[JunctionPlans]) -> list[tuple[float, int, float]]:
    """Value, sensors and cost of every choice of one plan a junction."""
    chosen = product(*(its.plans for its in of))
    return [(sum(p.value for p in c), sum(p.count for p in c), sum(p.cost for p in c)) for c in chosen]


@pytest.mark.slow
@given(junctions(), st.integers(1, 12))
def test_a_count_is_shared_as_well_as_can_be(of: list[JunctionPlans], count: int) -> None:
    shared = allocation.allocate_count(of, count)
    assert shared.value == max(value for value, sensors, _ in every_choice(of) if sensors <= count)
    picked = [its.plans[at] for its, at in zip(of, shared.chosen, strict=True)]
    assert sum(p.count for p in picked) <= count
    assert sum(p.value for p in picked) == shared.value
    best = max(
        sum(its.bound(n) for its, n in zip(of, numbers, strict=True))
        for numbers in product(*(range(len(its.min_costs)) for its in of))
        if sum(numbers) <= count
    )
    assert shared.bound == max(best, shared.value)
    for k, (value, bound) in enumerate(shared.curve):
        assert value == max(v for v, sensors, _ in every_choice(of) if sensors <= k)
        assert bound >= value


@given(junctions(), st.integers(1, 40))
def test_a_budget_is_spent_as_well_as_can_be(of: list[JunctionPlans], budget: int) -> None:
    shared = allocation.allocate_budget(of, float(budget))
    assert shared.value == max(value for value, _, cost in every_choice(of) if cost <= budget)
    picked = [its.plans[at] for its, at in zip(of, shared.chosen, strict=True)]
    assert sum(p.cost for p in picked) <= budget
    assert sum(p.value for p in picked) == shared.value
    for numbers in product(*(range(len(its.min_costs)) for its in of)):
        if sum(its.min_costs[n] for its, n in zip(of, numbers, strict=True)) <= budget:
            assert sum(its.bound(n) for its, n in zip(of, numbers, strict=True)) <= shared.bound + 1e-9


def test_sensors_that_are_there_already_are_part_of_every_choice() -> None:
    there = JunctionPlans(
        "a", (plan(2, 9.0, 0.0), plan(3, 10.0, 5.0)), (9.0, 9.0, 9.0, 10.0), (0.0, 0.0, 0.0, 5.0), 10.0, True
    )
    other = JunctionPlans("b", (plan(0, 0.0, 0.0), plan(1, 4.0, 5.0)), (0.0, 4.0), (0.0, 5.0), 4.0, True)
    assert allocation.allocate_count([there, other], 3).chosen == (0, 1)
    assert allocation.allocate_count([there, other], 2).chosen == (0, 0)
    assert allocation.allocate_budget([there, other], 4.9).chosen == (0, 0)
    assert allocation.allocate_budget([there, other], 5.0).value == 13.0


def test_more_sensors_than_were_asked_about_are_bounded() -> None:
    its = JunctionPlans(
        "a", (plan(0, 0.0, 0.0), plan(2, 8.0, 2.0)), (0.0, 5.0, 9.0), (0.0, 1.0, 2.0, 3.0, 4.0), 14.0, False
    )
    assert [its.bound(n) for n in range(5)] == [0.0, 5.0, 9.0, 13.5, 14.0]


def rules(cost: list[float], pole: list[float], most_per_pole: int, forced: tuple[int, ...] = ()) -> PlanRules:
    n = len(cost)
    return PlanRules(
        n, np.inf, np.array(cost), np.array(pole), np.arange(n) // 2, forced, np.zeros(n, bool), most_per_pole,
        np.zeros((n, 3)), 0.0,
    )  # fmt: skip


@pytest.mark.parametrize("most_per_pole", [1, 2])
@pytest.mark.parametrize("forced", [(), (0,)])
def test_no_plan_is_cheaper_than_the_least_cost(most_per_pole: int, forced: tuple[int, ...]) -> None:
    cost, pole = np.array([12.0, 14.0, 9.0, 20.0, 15.0, 11.0]), np.array([5.0, 5.0, 6.0, 6.0, 8.0, 8.0])
    cost[list(forced)] = pole[list(forced)] = 0.0
    its = rules(cost.tolist(), pole.tolist(), most_per_pole, forced)
    least = min_costs_by_count(its)
    for chosen in product((False, True), repeat=6):
        plan_ = [i for i, is_in in enumerate(chosen) if is_in]
        if its.allows(plan_):
            assert its.cost_of(plan_) >= least[len(plan_)] - 1e-12
