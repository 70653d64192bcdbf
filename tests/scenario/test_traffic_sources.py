"""Sources of traffic in [traffic] and in its periods."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from egvs.scenario.traffic_config import TrafficConfig


@pytest.mark.parametrize(
    ("source", "of_period"),
    [
        ({"tracks": ("a.csv",)}, {"fcd": "b.xml"}),
        ({"tracks": ("a.csv",)}, {"sumocfg": "b.sumocfg"}),
        ({"fcd": "a.xml"}, {"sumocfg": "b.sumocfg"}),
        ({"network": "a.net.xml"}, {"tracks": ("b.csv",)}),
    ],
)
def test_source_of_a_period_replaces_that_of_traffic(source: dict[str, Any], of_period: dict[str, Any]) -> None:
    """The first period has a source of its own, the second that of [traffic]."""
    periods = [{"name": "first", **of_period}, {"name": "second"}]
    traffic = TrafficConfig(**source, periods=periods)  # type: ignore[arg-type]
    ((key, value),) = source.items()
    ((period_key, period_value),) = of_period.items()
    assert getattr(traffic, key) == value
    assert getattr(traffic, period_key) is None
    first, second = (period.apply_to(traffic) for period in traffic.periods)
    assert (getattr(first, key), getattr(first, period_key)) == (None, period_value)
    assert (getattr(second, key), getattr(second, period_key)) == (value, None)


def test_source_of_the_first_period_serves_where_traffic_has_none() -> None:
    traffic = TrafficConfig(periods=[{"name": "first", "fcd": "b.xml"}])  # type: ignore[list-item]
    assert traffic.fcd == "b.xml"


def test_two_sources_are_an_error() -> None:
    with pytest.raises(ValidationError, match=r"expected exactly one of .*, got fcd and tracks"):
        TrafficConfig(fcd="a.xml", tracks=("b.csv",))
