"""What ``egvs place`` prints at its end."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from egvs.cli import place


def placed_with(*joint: float) -> Any:
    """A plan whose curve has these joint scores, for one sensor, two, ..."""
    curve = [SimpleNamespace(count=i + 1, plan_value=SimpleNamespace(joint=value)) for i, value in enumerate(joint)]
    return SimpleNamespace(solution=SimpleNamespace(curve=curve), curve_costs=(0.0,) * len(joint), refinement=None)


def test_last_sentence_says_what_the_last_sensor_adds() -> None:
    assert place.describe_last_gain(placed_with(50.0, 80.0, 80.4)) == "Going from 2 to 3 sensors adds 0.5%."


def test_one_sensor_or_zero_score_has_no_last_sentence() -> None:
    assert place.describe_last_gain(placed_with(50.0)) is None
    assert place.describe_last_gain(placed_with(0.0, 1.0)) is None


def planned(curve_sites: tuple[tuple[str, ...], ...], *sites: str) -> Any:
    placed = placed_with(*[50.0 + i for i in range(len(curve_sites))])
    placed.curve_sites = curve_sites
    placed.sensors = tuple(SimpleNamespace(site=site) for site in sites)
    return placed


def test_best_single_site_that_is_not_part_of_the_plan_is_named() -> None:
    text = place.describe_absent_best(planned((("a",), ("b", "c")), "b", "c"))
    assert text is not None
    assert text.startswith("The best single site, a, is not part of this plan")


def test_best_single_site_in_the_plan_or_a_single_sensor_needs_no_sentence() -> None:
    assert place.describe_absent_best(planned((("a",), ("a", "c")), "a", "c")) is None
    assert place.describe_absent_best(planned((("a",),), "a")) is None


def test_sensor_table_has_costs_only_where_they_are_set() -> None:
    placed = placed_with(50.0)
    placed.score, placed.sensors = "egvs", ()
    assert "cost" not in [column.header for column in place._sensor_table(placed).columns]
    placed.curve_costs = (3000.0,)
    assert "cost" in [column.header for column in place._sensor_table(placed).columns]


@pytest.mark.parametrize(
    ("score", "joint", "sentence"),
    [
        (
            "expected_detections",
            0.978704,
            "a: share of vehicles found 97.9%; proved: no plan within the rules is better",
        ),
        ("egvs", 35754.4, "a: EGVS 35,754 bit; proved: no plan within the rules is better"),
    ],
)
def test_plan_is_in_the_unit_of_its_score(score: str, joint: float, sentence: str) -> None:
    placed = placed_with(joint)
    placed.score, placed.joint_of_all, placed.sensors = score, 0.0, (SimpleNamespace(site="a"),)
    placed.solution.point = placed.solution.curve[0]
    placed.solution.is_best, placed.solution.fewest_is_proved = True, None
    assert place.describe_plan(placed) == sentence
