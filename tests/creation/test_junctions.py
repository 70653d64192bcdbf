"""Assumed flows of a junction."""

from pathlib import Path

import numpy as np
import pytest

from egvs.creation import junctions
from egvs.creation.junctions import JunctionRegion
from egvs.creation.openstreetmap import street_network
from egvs.formats import osm
from egvs.traffic.network import Edge, Lane, Permission
from tests.creation.small_maps import street, write_map
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
        ("cycleway.lane|highway.tertiary", 150), ("highway.track", 40), ("railway.tram", 40), ("", 200),
        ("driving", 200),
    ],
)  # fmt: skip
def test_road_class_sets_flow_per_lane(kind: str, per_lane_h: float) -> None:
    """Of its three lanes one is for people on foot. Without a class, SUMO's default of 50 km/h is a secondary road."""
    on_foot, cars = Permission(frozenset({"pedestrian"}), frozenset()), Permission(None, frozenset())
    lanes = tuple(Lane("0,0 9,0", "lane", None, 9.0, permission) for permission in (on_foot, cars, cars))
    assert junctions.edge_flow_h(Edge("e", "", "a", "b", "", lanes, kind)) == 2 * per_lane_h


def test_inflow_is_met_where_outflow_cannot_be() -> None:
    rates = junctions.balance_flows(np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 0.0]]), [100, 50, 30], [10, 200])
    assert rates.tolist() == [[100, 0], [50, 0], [0, 0]]


def test_turn_that_is_only_possible_with_a_loop_gets_no_flow(tmp_path: Path) -> None:
    """All that comes in, 60 an hour from each of two streets with 40 km/h, goes on; nobody turns round."""
    path = tmp_path / "loop.net.xml"
    path.write_text(LOOP_NET)
    streets = junctions.read_streets(path)
    flows = junctions.assumed_flows(streets, JunctionRegion((15.0, 0.0), (90.0, 90.0)))
    assert {(flow.title, flow.per_hour) for flow in flows} == {("in to on", 60.0), ("side to on", 60.0)}


def test_street_that_merges_at_the_edge_of_the_region_brings_vehicles(tmp_path: Path) -> None:
    """The main street leaves the region 2 m behind the side street (6) that joins it: too little to be inside."""
    nodes = {1: (-400.0, 0.0), 2: (0.0, 0.0), 3: (28.0, 0.0), 4: (400.0, 0.0), 5: (0.0, 300.0), 6: (28.0, -300.0)}
    ways = [street("A Street", 1, 2, 3, 4), street("B Street", 2, 5), street("C Street", 3, 6)]
    path = write_map(tmp_path / "map.osm", nodes, ways)
    extract = osm.read_osm(path)
    flags = street_network.netconvert_flags(extract, lefthand=False, walk=False)
    _, streets, _ = street_network.build_network(extract, path, flags)
    x, y = next(j.at_m for j in streets.junctions if j.id == "2")
    flows = junctions.assumed_flows(streets, JunctionRegion((x, y), (60.0, 60.0)))
    edges = {edge.id: edge for edge in streets.network.edges}
    entries = {edges[flow.from_edge].from_node for flow in flows if flow.from_edge}
    exits = {edges[flow.to_edge].to_node for flow in flows if flow.to_edge}
    assert entries == exits == {"1", "4", "5", "6"}
    assert sum(flow.per_hour for flow in flows) == 4 * 150
