"""What ``egvs place`` prints at its end."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

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
    placed.sensors = ()
    assert "cost" not in [column.header for column in place._sensor_table(placed).columns]
    placed.curve_costs = (3000.0,)
    assert "cost" in [column.header for column in place._sensor_table(placed).columns]
