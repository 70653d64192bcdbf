"""Assumed flows of a junction."""

from pathlib import Path

import numpy as np
import pytest

from egvs.importers import junctions
from egvs.importers.junctions import JunctionRegion
from egvs.traffic.network import Edge, Lane, Permission
from tests.traffic.test_demand import LOOP_NET


# --- assumed traffic -----------------------------------------------------------------------------------------------
def test_flows_equal_hand_computed_balance() -> None:
    """A crossing of a main street (600 each way) and a side street (40): nobody turns back."""
    may = np.ones((4, 4)) - np.eye(4)
    expected = [600.0, 40.0, 600.0, 40.0]
    rates = junctions.balance_flows(may, expected, expected)
    assert rates.sum(axis=1) == pytest.approx(expected) and rates.sum(axis=0) == pytest.approx(expected, rel=1e-3)
    assert np.diag(rates) == pytest.approx(0)
    assert rates[0, 2] > 500 and rates == pytest.approx(rates.T, rel=1e-2)


@pytest.mark.parametrize(
    ("kind", "per_lane_h"),
    [
        ("highway.secondary", 200), ("highway.primary_link", 250), ("highway.secondary|railway.tram", 200),
        ("cycleway.lane|highway.tertiary", 150), ("highway.track", 40), ("railway.tram", 40), ("", 40),
    ],
)  # fmt: skip
def test_road_class_sets_flow_per_lane(kind: str, per_lane_h: float) -> None:
    """Of its three lanes one is for people on foot."""
    on_foot, cars = Permission(frozenset({"pedestrian"}), frozenset()), Permission(None, frozenset())
    lanes = tuple(Lane("0,0 9,0", "lane", None, 9.0, permission) for permission in (on_foot, cars, cars))
    assert junctions.edge_flow_h(Edge("e", "", "a", "b", "", lanes, kind)) == 2 * per_lane_h


def test_inflow_is_met_where_outflow_cannot_be() -> None:
    rates = junctions.balance_flows(np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 0.0]]), [100, 50, 30], [10, 200])
    assert rates.tolist() == [[100, 0], [50, 0], [0, 0]]


def test_turn_that_is_only_possible_with_a_loop_gets_no_flow(tmp_path: Path) -> None:
    """All that comes in, 40 an hour from each of two streets, goes on; nobody turns round through the signal."""
    path = tmp_path / "loop.net.xml"
    path.write_text(LOOP_NET)
    streets = junctions.read_streets(path)
    flows = junctions.assumed_flows(streets, JunctionRegion((15.0, 0.0), (90.0, 90.0)))
    assert {(flow.title, flow.per_hour) for flow in flows} == {("in to on", 40.0), ("side to on", 40.0)}
