"""How many sensors are enough, in sentences."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from egvs.report.plan_answer import describe_count, describe_joint_score, is_useful, next_count
from egvs.results.labels import SCORE_LABELS
from egvs.results.plans import PlannedSensor, PlanStep, SensorPlan

FOUND = SCORE_LABELS["expected_detections"]
EGVS = SCORE_LABELS["egvs"]
NO_limit: dict[str, Any] = {"budget": None, "reach": None, "objective": "joint", "survives": 0}


def steps_of(*scores: float, gain_se: float = math.nan, beats: float = math.nan) -> list[PlanStep]:
    """The plans of 1, 2, ... sensors with these joint scores."""
    steps = []
    for number, score in enumerate(scores, start=1):
        gain = score - (scores[number - 2] if number > 1 else 0.0)
        steps.append(PlanStep(number, score, gain, met=True, gain_se=gain_se, beats_previous=beats))
    return steps


def with_sites(steps: list[PlanStep], *plans: str, cost: float = 0.0) -> list[PlanStep]:
    """The plans of these sites, each a letter of which every one costs ``cost``."""
    return [replace(step, sites=tuple(sites), cost=cost * len(sites)) for step, sites in zip(steps, plans, strict=True)]


def sensor(site: str, score: float, score_se: float = math.nan) -> PlannedSensor:
    pose = (0.0, 0.0, 3.0, 0.0, 0.0, 0.0)
    return PlannedSensor(1, site, site, *pose, "OS1", False, gain=0.0, score=score, cost=0.0, score_se=score_se)


def plan_of(steps: list[PlanStep], sensors: int, candidates: int, **request: float) -> SensorPlan:
    return SensorPlan(
        (sensor("a", 0.9),) * sensors, tuple(steps), "expected_detections", NO_limit | request, joint=0.9,
        joint_of_all=1.0, cost=0.0, candidates=candidates, zones=(), is_best=True, fewest_is_proved=None,
    )  # fmt: skip


def test_says_how_many_are_enough() -> None:
    steps = steps_of(0.946, 0.992, 0.997, gain_se=0.002, beats=0.99)
    assert describe_count(steps, FOUND) == "Two are enough: a third adds 0.5 ± 0.2 percentage points."
    assert describe_count(steps_of(0.99, 0.9912), FOUND) == "One is enough: a second adds 0.1 percentage points."


def test_names_the_plan_that_is_enough_where_it_is_smaller_than_the_one_shown() -> None:
    steps = steps_of(0.946, 0.992, 0.998, gain_se=0.001, beats=0.99)
    assert describe_count(with_sites(steps, "a", "bc", "abc"), FOUND) == (
        "Two are enough (b and c): a third adds 0.6 ± 0.1 percentage points."
    )
    same = with_sites(steps, "a", "bc", "bc")  # a third sensor is not used
    assert describe_count(same, FOUND).startswith("Two are enough: a third")


def test_first_sites_of_a_larger_plan_are_compared_with_those_that_are_enough() -> None:
    steps = with_sites(steps_of(0.946, 0.992, 0.998, gain_se=0.001, beats=0.99), "a", "bc", "abc")
    installed = [sensor("a", 0.946), sensor("b", 0.99, 0.003), sensor("c", 0.998)]
    assert describe_count(steps, FOUND, installed=installed) == (
        "Two are enough (b and c): a third adds 0.6 ± 0.1 percentage points. The first two sites of the plan of three, "
        "a and b, reach 99.0 ± 0.3 % instead of 99.2 %: begin with them only if one more is to follow."
    )
    same = [sensor("c", 0.9), sensor("b", 0.992), sensor("a", 0.998)]
    assert "instead of" not in describe_count(steps, FOUND, installed=same)
    bought = describe_count(steps, FOUND, installed=installed, has_budget=True)
    assert bought.endswith("begin with them only if one more is to follow.")


def test_first_site_of_a_plan_is_compared_with_the_best_single_one() -> None:
    steps = with_sites(steps_of(0.946, 0.947, 0.948, gain_se=0.001, beats=0.6), "a", "bc", "bcd")
    installed = [sensor("b", 0.93), sensor("c", 0.947), sensor("d", 0.948)]
    assert describe_count(steps, FOUND, installed=installed).endswith(
        "The first site of the plan of three, b, reaches 93.0 % instead of 94.6 %: begin with it only if two more are "
        "to follow."
    )


def test_only_several_sensors_ranked_by_vehicles_found_assume_independence() -> None:
    assert "one independent detector per sensor" in describe_joint_score(FOUND, 2)
    assert describe_joint_score(FOUND, 1) == ""
    assert describe_joint_score(EGVS, 2) == ""


def test_plan_within_a_budget_is_not_contradicted() -> None:
    steps = with_sites(steps_of(0.946, 0.992, 0.998, gain_se=0.001, beats=0.99), "a", "bc", "abc", cost=1e4)
    assert describe_count(steps, FOUND, has_budget=True) == (
        "The budget buys three sensors; the third adds only 0.6 ± 0.1 percentage points, so two are enough: "
        "b and c for 20000."
    )
    assert describe_count(steps[:2], FOUND, has_budget=True).startswith("A second sensor adds 4.6 ")


def test_says_what_the_last_sensor_adds_where_it_is_still_useful() -> None:
    steps = steps_of(0.9455, 0.9922, gain_se=0.005, beats=0.999)
    assert describe_count(steps, FOUND, next_count=3) == (
        "A second sensor adds 4.7 ± 0.5 percentage points to the share of vehicles found: 99.2 %, against 94.5 % with "
        "one. Try --count 3 to see what a third adds."
    )
    assert describe_count(steps, FOUND).endswith("against 94.5 % with one.")


def test_bits_are_compared_with_the_score_of_the_plan() -> None:
    steps = steps_of(247397.0, 381218.0, gain_se=2100.0, beats=1.0)
    assert describe_count(steps, EGVS) == (
        "A second sensor adds 133,821 ± 2,100 bit (35.1 % of the plan's score) to EGVS: 381,218 bit, against "
        "247,397 bit with one."
    )
    steps = steps_of(39000.0, 39300.0, gain_se=50.0, beats=1.0)
    assert describe_count(steps, EGVS) == "One is enough: a second adds 300 ± 50 bit (0.8 % of the plan's score)."


def test_gain_that_may_be_chance_is_not_useful() -> None:
    steps = steps_of(0.80, 0.83, gain_se=0.03, beats=0.82)
    assert describe_count(steps, FOUND) == (
        "One is enough: a second adds 3.0 ± 3.0 percentage points, which may be chance."
    )
    assert is_useful(*steps_of(0.80, 0.83, beats=0.9), FOUND)
    assert is_useful(*steps_of(0.80, 0.83), FOUND)  # without standard errors, the size alone counts


def test_sensor_that_adds_nothing_or_next_to_nothing() -> None:
    assert describe_count(steps_of(0.9, 0.9), FOUND) == "One is enough: a second adds nothing."
    assert describe_count(steps_of(0.9, 0.9002), FOUND) == (
        "One is enough: a second adds less than 0.1 percentage points."
    )


def test_useful_sensor_after_one_that_is_not_counts() -> None:
    answer = describe_count(steps_of(0.80, 0.805, 0.90, 0.901), FOUND)
    assert answer.startswith("Three are enough: a fourth adds 0.1 ")


def test_sensor_that_meets_requirements_is_useful() -> None:
    first, second = steps_of(0.99, 0.992)
    assert describe_count([replace(first, met=False), second], FOUND) == (
        "A second sensor is needed to meet the requirements; it adds 0.2 percentage points."
    )


def test_names_the_rule_that_forbids_one_more() -> None:
    three = with_sites(steps_of(0.80, 0.90, 0.90), "a", "ab", "ab")
    limit = "the limit of 1 sensor per pole (most_per_pole)"
    rule = "The limit of 1 sensor per pole (most_per_pole) forbids a third sensor beside them."
    assert describe_count(three, FOUND, forbids_more=limit) == (
        "A second sensor adds 10.0 percentage points to the share of vehicles found: 90.0 %, against 80.0 % with one. "
        + rule
    )
    assert describe_count(three[:1], FOUND, forbids_more="a and b") == "A and b forbid a second sensor beside it."
    worst = describe_count(three, FOUND, objective="the worst period", forbids_more=limit)
    assert worst.endswith(f"the plan maximises the worst period. {rule}")
    plan = replace(plan_of(three[:2], sensors=2, candidates=4), forbids_more=limit)
    assert next_count(plan) is None


def test_other_objective_has_no_verdict() -> None:
    answer = describe_count(steps_of(0.848, 0.834), FOUND, objective="the score in the worst period", next_count=3)
    assert answer == (
        "A second sensor adds -1.4 percentage points to the share of vehicles found; the plan maximises the score in "
        "the worst period."
    )


def test_single_number_of_sensors_has_only_a_hint() -> None:
    assert describe_count(steps_of(0.9), FOUND) == ""
    assert describe_count(steps_of(0.9), FOUND, next_count=2) == "Try --count 2 to see what a second adds."


def test_next_count_only_where_the_count_is_the_limit() -> None:
    steps = steps_of(0.8, 0.9)
    assert next_count(plan_of(steps, 2, 13)) == 3
    assert next_count(plan_of(steps, 2, 2)) is None
    assert next_count(plan_of(steps, 1, 13)) is None  # a second one adds nothing
    assert next_count(plan_of(steps, 2, 13, budget=100.0)) is None
    assert next_count(plan_of(steps, 2, 13, reach=0.9)) is None


@pytest.mark.parametrize(
    ("count", "words"),
    [(8, "Seven are enough: an eighth"), (11, "Ten are enough: an 11th"), (13, "12 are enough: a 13th"),
     (22, "21 are enough: a 22nd")],
)  # fmt: skip
def test_numbers_are_words_up_to_ten(count: int, words: str) -> None:
    useful = [0.02 * number for number in range(1, count)]
    assert describe_count(steps_of(*useful, useful[-1]), FOUND).startswith(f"{words} adds nothing")
