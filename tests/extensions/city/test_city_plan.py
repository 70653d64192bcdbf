"""The curve of a city with its standard errors, and the order of installation, on plans made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from egvs.artefacts.tpog import PeriodBlocks
from egvs.core.grid import FloatArray
from egvs.extensions.city import allocation, city_plan
from egvs.extensions.city.allocation import JunctionPlan, JunctionPlans
from egvs.extensions.city.replicates import CityBlocks
from egvs.results.plans import PlannedSensor

BLOCKS = 10
CITY_BLOCKS = CityBlocks((PeriodBlocks("", 1.0, 1000, 100, 1.0),))


def leave_out(blocks: FloatArray) -> FloatArray:
    """Return the mean of block values, and the means without each block."""
    without = [np.delete(blocks, g).mean() for g in range(len(blocks))]
    return np.array([blocks.mean(), *without])


def make_sensors(junction: str, gains: list[float]) -> tuple[PlannedSensor, ...]:
    sensors = []
    for number, gain in enumerate(gains, start=1):
        score = sum(gains[:number])
        site = f"{junction}{number}"
        sensors.append(
            PlannedSensor(number, site, site, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0, "VLP-16", False, gain, score, 1.0)
        )
    return tuple(sensors)


def make_junction(name: str, gains_of_plans: list[list[float]], variation: FloatArray | None) -> JunctionPlans:
    """Return a junction with plans of 0, 1, ... sensors; block b of each score is the score times variation[b]."""
    plans = []
    for gains in ([], *gains_of_plans):
        replicates = None
        if variation is not None:
            scores = np.append(0.0, np.cumsum(gains))
            replicates = np.array([leave_out(score * variation) for score in scores])
        plans.append(JunctionPlan(make_sensors(name, gains), sum(gains), float(len(gains)), replicates))
    values = tuple(plan.value for plan in plans)
    costs = tuple(map(float, range(len(plans))))
    return JunctionPlans(name, tuple(plans), values, costs, values[-1], True)


def standard_error(blocks: FloatArray) -> float:
    """Standard error of a mean of independent blocks."""
    return float(blocks.std(ddof=1) / math.sqrt(len(blocks)))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_standard_error_includes_correlation_between_junctions(sign: float) -> None:
    rng = np.random.default_rng(5)
    noise = rng.normal(0.0, 0.1, BLOCKS)
    noise -= noise.mean()
    own = rng.normal(0.0, 0.02, BLOCKS)
    own -= own.mean()
    a, b = 1.0 + noise, 1.0 + sign * noise + own
    junctions = [make_junction("a", [[6.0], [6.0, 2.0]], a), make_junction("b", [[5.0], [5.0, 1.0]], b)]
    shares = allocation.allocate_sensors(junctions, 3)
    plan = city_plan.make_city_plan(junctions, shares, "expected_detections", {"count": 3.0}, (), CITY_BLOCKS)
    assert plan.has_errors
    assert plan.errors_from.startswith("10 blocks of 100 frames")

    widening = CITY_BLOCKS.uncertainty(np.array([leave_out(a)])).strata[0].widening
    expected = [0.0, *(standard_error(blocks) for blocks in (6 * a, 6 * a + 5 * b, 8 * a + 5 * b))]
    assert [point.score_se for point in plan.curve] == pytest.approx([widening * se for se in expected], rel=1e-9)
    independent = widening * math.hypot(8 * standard_error(a), 5 * standard_error(b))
    if sign > 0:  # busy at the same time: the sum varies more than independent junctions would
        assert plan.curve[-1].score_se > 1.2 * independent
    else:
        assert plan.curve[-1].score_se < 0.5 * independent


def test_phases_compare_order_of_installation_with_best_plan() -> None:
    # The best two sensors of a are not among the best one: 7 alone, but 6 + 4 together.
    junctions = [make_junction("a", [[7.0], [6.0, 4.0]], None), make_junction("b", [[5.0]], None)]
    shares = allocation.allocate_sensors(junctions, 3)
    plan = city_plan.make_city_plan(junctions, shares, "egvs", {"count": 3.0}, (1, 3), "no blocks")
    assert [point.score for point in plan.curve] == [0.0, 7.0, 12.0, 15.0]
    assert [point.installed for point in plan.curve] == [0.0, 6.0, 11.0, 15.0]
    assert [(sensor.site, plan.phase_of(sensor)) for sensor in plan.sensors] == [("a1", 1), ("b1", 2), ("a2", 2)]
    first, second = plan.by_phase
    assert [sensor.site for sensor in first.sensors] == ["a1"]
    assert [sensor.site for sensor in second.sensors] == ["b1", "a2"]
    assert first.loss == pytest.approx(1 / 7)
    assert second.loss == 0.0
    assert not plan.has_errors
    assert plan.errors_from == "no blocks"
    assert all(math.isnan(point.score_se) for point in plan.curve)


def test_curve_of_budget_has_costs() -> None:
    junctions = [make_junction("a", [[6.0], [6.0, 2.0]], None), make_junction("b", [[5.0]], None)]
    shares = allocation.allocate_budget(junctions, 2.0)
    plan = city_plan.make_city_plan(junctions, shares, "egvs", {"budget": 2.0}, (), "none")
    scores = {round(point.limit, 3): (point.score, point.sensors, point.cost) for point in plan.curve}
    assert scores[0.0] == (0.0, 0, 0.0)
    assert scores[1.0] == (6.0, 1, 1.0)
    assert scores[2.0] == (11.0, 2, 2.0)
    assert all(point.bound >= point.score for point in plan.curve)
    assert math.isnan(plan.curve[-1].installed)


def test_installed_error_is_that_of_the_first_sensors() -> None:
    variation = 1.0 + np.linspace(-0.2, 0.2, BLOCKS)
    junction = make_junction("a", [[7.0], [6.0, 4.0]], variation)
    plan = city_plan.make_city_plan(
        [junction], allocation.allocate_sensors([junction], 2), "egvs", {"count": 2.0}, (), CITY_BLOCKS
    )
    best, installed = plan.curve[1], plan.curve[1].installed_se
    assert installed == pytest.approx(best.score_se * 6 / 7)
