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


def test_sensor_table_has_costs_only_where_they_are_set() -> None:
    placed = placed_with(50.0)
    placed.sensors = ()
    assert "cost" not in [column.header for column in place._sensor_table(placed).columns]
    placed.curve_costs = (3000.0,)
    assert "cost" in [column.header for column in place._sensor_table(placed).columns]
