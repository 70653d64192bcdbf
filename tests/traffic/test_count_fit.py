"""Counted flows are compared with simulated ones."""

from __future__ import annotations

import pytest

from egvs.scenario.traffic_config import CountConfig
from egvs.traffic.count_fit import count_fits, geh
from tests.traffic.helpers import drawn


def test_count_fits_by_edge_and_by_turn(tmp_path):
    def vehicle(name, edges, times):
        return f'<vehicle id="{name}" depart="0"><route edges="{edges}" exitTimes="{times}"/></vehicle>'

    (tmp_path / "driven.xml").write_text(
        "<routes>"
        + vehicle("fleet.0", "a b c", "90 110 120")  # leaves a before the first frame
        + vehicle("fleet.1", "a b c", "100 120 130")
        + vehicle("fleet.2", "a c", "150 -1")  # still on its way; c comes after a, with nothing between
        + vehicle("fleet.3", "c a", "150 199.5")
        + vehicle("truck.0", "a b", "150 160")
        + vehicle("fleet.4", "a b", "200 210")  # too late
        + '<person id="fleet.5" depart="0"><walk edges="a b" exitTimes="150 160"/></person>'
        + "</routes>"
    )
    expected = [
        {"edge": "a", "per_hour": 144}, {"edge": "b", "per_hour": 36}, {"edge": "b", "per_hour": 36, "kind": "truck"},
        {"from_edge": "a", "to_edge": "c", "per_hour": 0}, {"from_edge": "c", "to_edge": "a", "per_hour": 36},
    ]  # fmt: skip
    model = drawn(counts=tuple(CountConfig(**row) for row in expected))
    met = count_fits(model, tmp_path / "driven.xml", 100.0, 200.0)
    assert [c.simulated_per_h for c in met] == [36 * n for n in (3, 2, 1, 2, 1)]


def test_geh_of_known_flows():
    assert geh(100, 100) == geh(0, 0) == 0
    assert geh(400, 500) == pytest.approx((2 * 100**2 / 900) ** 0.5)
    assert geh(500, 400) == geh(400, 500)
