"""Allocating sensors to junctions, compared with all possible choices."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.extensions.city import allocation
from egvs.extensions.city.allocation import JunctionPlan, JunctionPlans, min_costs_by_count
from egvs.placement.problem import PlanRules
from egvs.results.plans import PlannedSensor


def make_plan(count: int, value: float, cost: float) -> JunctionPlan:
    gain, sensor_cost = value / max(1, count), cost / max(1, count)
    sensor = PlannedSensor(1, "s", "s", 0.0, 0.0, 3.0, 0.0, 0.0, 0.0, "VLP-16", False, gain, gain, sensor_cost)
    return JunctionPlan((sensor,) * count, value, cost)


@st.composite
def junctions(draw: st.DrawFn) -> list[JunctionPlans]:
    """Return junctions whose gains need not decrease, with bounds above their plans."""
    result = []
    for number in range(draw(st.integers(1, 4))):
        values = sorted(draw(st.lists(st.integers(0, 50), min_size=1, max_size=4)))
        prices = draw(st.lists(st.integers(1, 9), min_size=len(values), max_size=len(values)))
        plans = [make_plan(0, 0.0, 0.0)]
        plans += [make_plan(n, float(v), float(sum(prices[:n]))) for n, v in enumerate(values, start=1)]
        slack = draw(st.integers(0, 5))
        bounds = (0.0, *(float(value + slack) for value in values))
        cheapest = np.append(0.0, np.cumsum(sorted(prices)))
        result.append(
            JunctionPlans(f"j{number}", tuple(plans), bounds, tuple(cheapest.tolist()), values[-1] + slack, True)
        )
    return result


def all_choices(junctions: list[JunctionPlans]) -> list[tuple[float, int, float]]:
    """Return value, number of sensors and cost of each choice of one plan per junction."""
    chosen = product(*(junction.plans for junction in junctions))
    return [(sum(p.value for p in c), sum(p.count for p in c), sum(p.cost for p in c)) for c in chosen]


@pytest.mark.slow
@given(junctions(), st.integers(1, 12))
def test_allocates_count_optimally(junctions: list[JunctionPlans], count: int) -> None:
    allocated = allocation.allocate_sensors(junctions, count)
    assert allocated.value == max(value for value, sensors, _ in all_choices(junctions) if sensors <= count)
    plans = [junction.plans[i] for junction, i in zip(junctions, allocated.chosen, strict=True)]
    assert sum(p.count for p in plans) <= count
    assert sum(p.value for p in plans) == allocated.value
    best = max(
        sum(junction.bound(n) for junction, n in zip(junctions, numbers, strict=True))
        for numbers in product(*(range(len(junction.min_costs)) for junction in junctions))
        if sum(numbers) <= count
    )
    assert allocated.bound == max(best, allocated.value)
    for k, (limit, chosen, value, bound) in enumerate(allocated.curve):
        assert limit == k
        assert sum(junction.plans[i].value for junction, i in zip(junctions, chosen, strict=True)) == value
        assert sum(junction.plans[i].count for junction, i in zip(junctions, chosen, strict=True)) <= k
        assert value == max(v for v, sensors, _ in all_choices(junctions) if sensors <= k)
        assert bound >= value


@pytest.mark.slow
@given(junctions(), st.integers(1, 40))
def test_allocates_budget_optimally(junctions: list[JunctionPlans], budget: int) -> None:
    allocated = allocation.allocate_budget(junctions, float(budget))
    assert allocated.value == max(value for value, _, cost in all_choices(junctions) if cost <= budget)
    plans = [junction.plans[i] for junction, i in zip(junctions, allocated.chosen, strict=True)]
    assert sum(p.cost for p in plans) <= budget
    assert sum(p.value for p in plans) == allocated.value
    for numbers in product(*(range(len(junction.min_costs)) for junction in junctions)):
        if sum(junction.min_costs[n] for junction, n in zip(junctions, numbers, strict=True)) <= budget:
            assert (
                sum(junction.bound(n) for junction, n in zip(junctions, numbers, strict=True)) <= allocated.bound + 1e-9
            )


def test_every_choice_has_forced_sensors() -> None:
    forced = JunctionPlans(
        "a", (make_plan(2, 9.0, 0.0), make_plan(3, 10.0, 5.0)), (9.0, 9.0, 9.0, 10.0), (0.0, 0.0, 0.0, 5.0), 10.0, True
    )
    other = JunctionPlans("b", (make_plan(0, 0.0, 0.0), make_plan(1, 4.0, 5.0)), (0.0, 4.0), (0.0, 5.0), 4.0, True)
    assert allocation.allocate_sensors([forced, other], 3).chosen == (0, 1)
    assert allocation.allocate_sensors([forced, other], 2).chosen == (0, 0)
    assert allocation.allocate_budget([forced, other], 4.9).chosen == (0, 0)
    assert allocation.allocate_budget([forced, other], 5.0).value == 13.0


def test_bounds_more_sensors_than_planned() -> None:
    junction = JunctionPlans(
        "a", (make_plan(0, 0.0, 0.0), make_plan(2, 8.0, 2.0)), (0.0, 5.0, 9.0), (0.0, 1.0, 2.0, 3.0, 4.0), 14.0, False
    )
    assert [junction.bound(n) for n in range(5)] == [0.0, 5.0, 9.0, 13.5, 14.0]


def make_rules(cost: list[float], pole: list[float], most_per_pole: int, forced: tuple[int, ...] = ()) -> PlanRules:
    n = len(cost)
    return PlanRules(
        n, np.inf, np.array(cost), np.array(pole), np.arange(n) // 2, forced, np.zeros(n, bool), most_per_pole,
        np.zeros((n, 3)), 0.0,
    )  # fmt: skip


@pytest.mark.parametrize("most_per_pole", [1, 2])
@pytest.mark.parametrize("forced", [(), (0,)])
def test_no_planis_cheaper_than_min_cost(most_per_pole: int, forced: tuple[int, ...]) -> None:
    cost, pole = np.array([12.0, 14.0, 9.0, 20.0, 15.0, 11.0]), np.array([5.0, 5.0, 6.0, 6.0, 8.0, 8.0])
    cost[list(forced)] = pole[list(forced)] = 0.0
    rules = make_rules(cost.tolist(), pole.tolist(), most_per_pole, forced)
    min_costs = min_costs_by_count(rules)
    for chosen in product((False, True), repeat=6):
        plan = [i for i, is_in in enumerate(chosen) if is_in]
        if rules.allows(plan):
            assert rules.cost_of(plan) >= min_costs[len(plan)] - 1e-12
