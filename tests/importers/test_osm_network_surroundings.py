"""A junction's surroundings are cut out of an extract, and the traffic assumed there does not depend on the cut."""

import math
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest

from egvs.cli import app
from egvs.core.errors import InputError
from egvs.formats.osm import Bounds, OsmExtract, Way
from egvs.importers import junctions, openstreetmap, osm_network
from egvs.scenario import loading
from egvs.traffic.network import Edge, Lane, Permission

SMALL = Path(__file__).parent / "data" / "small.osm"
MIDDLE = (52.0, 10.0)


def node(east_m: float, north_m: float) -> tuple[float, float]:
    """Latitude, longitude of a place beside the middle."""
    lat = MIDDLE[0] + math.degrees(north_m / osm_network.EARTH_M)
    return lat, MIDDLE[1] + math.degrees(east_m / osm_network.EARTH_M / math.cos(math.radians(MIDDLE[0])))


def extract(ways: dict[int, list[tuple[float, float]]], tags: dict[int, dict[str, str]] | None = None) -> OsmExtract:
    """Streets through places in metres beside the middle; equal places are one node."""
    places = list(dict.fromkeys(place for way in ways.values() for place in way))
    nodes = {i: node(*place) for i, place in enumerate(places, 1)}
    made = {
        name: Way(name, tuple(places.index(place) + 1 for place in way), (tags or {}).get(name, {"highway": "primary"}))
        for name, way in ways.items()
    }
    return OsmExtract(nodes, {}, made, (), Bounds(51, 9, 53, 11), True)


def lines_m(cut: OsmExtract) -> dict[int, list[tuple[float, float]]]:
    """Where each way leads, metres beside the middle."""
    shrink = math.cos(math.radians(MIDDLE[0]))

    def place(lat: float, lon: float) -> tuple[float, float]:
        east, north = math.radians(lon - MIDDLE[1]) * shrink, math.radians(lat - MIDDLE[0])
        return round(east * osm_network.EARTH_M, 1), round(north * osm_network.EARTH_M, 1)

    return {name: [place(*cut.nodes[n]) for n in way.nodes] for name, way in cut.ways.items()}


def test_streets_end_on_the_circle() -> None:
    cut = osm_network.cut_surroundings(
        extract({7: [(-500, 0), (0, 0), (80, 0)], 8: [(0, -90), (0, 0), (0, 200)]}), MIDDLE, 100
    )
    assert lines_m(cut) == {7: [(-100, 0), (0, 0), (80, 0)], 8: [(0, -90), (0, 0), (0, 100)]}


def test_longer_piece_of_street_keeps_its_id() -> None:
    way = [(-50, 0), (0, 0), (60, 0), (300, 0), (300, 80), (0, 80), (0, 70)]
    joining = [(0, 0), (0, 70)]
    cut = lines_m(osm_network.cut_surroundings(extract({7: way, 9: joining}), MIDDLE, 100))
    assert cut == {7: [(-50, 0), (0, 0), (60, 0), (100, 0)], 9: joining, 10: [(60, 80), (0, 80), (0, 70)]}


def test_cuts_street_across_circle_without_node_inside() -> None:
    ways = {7: [(-300, 60), (300, 60)], 8: [(0, 0), (0, 50)]}
    everything = lines_m(osm_network.cut_surroundings(extract(ways, {8: {"highway": "footway"}}), MIDDLE, 100))
    assert everything[8] == ways[8]  # a path goes where it likes
    assert everything[7] == [(-80, 60), (80, 60)]


def test_drops_roads_connected_only_outside_circle() -> None:
    ways = {7: [(0, 0), (300, 0)], 8: [(0, 60), (300, 60)], 9: [(300, 0), (300, 60)], 10: [(5, 5), (9, 5), (5, 9)]}
    cut = osm_network.cut_surroundings(extract(ways, {10: {"building": "yes"}}), MIDDLE, 100)
    assert lines_m(cut) == {7: [(0, 0), (100, 0)], 10: ways[10]}
    assert osm_network.cut_surroundings(extract(ways), MIDDLE, 1000).ways.keys() >= {7, 8, 9}


# --- assumed traffic -----------------------------------------------------------------------------------------------


def test_flows_equal_hand_computed_balance() -> None:
    """A crossing of a main street (600 each way) and a side street (40): nobody turns back."""
    may = np.ones((4, 4)) - np.eye(4)
    wanted = [600.0, 40.0, 600.0, 40.0]
    rates = junctions.balance_flows(may, wanted, wanted)
    assert rates.sum(axis=1) == pytest.approx(wanted) and rates.sum(axis=0) == pytest.approx(wanted, rel=1e-3)
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


@pytest.mark.slow
def test_smaller_surroundings_keep_sites_and_flows(tmp_path: Path) -> None:
    made = {r: openstreetmap.create_scenario(tmp_path / str(r), SMALL, surroundings_m=r) for r in (120.0, 150.0, None)}
    lengths = [summary.streets.lane_length_m for summary in made.values()]
    assert lengths == sorted(lengths) and lengths[0] < 0.8 * lengths[-1]
    for name in ("sites.csv", "statics.geojson"):
        assert len({(tmp_path / str(r) / name).read_bytes() for r in made}) == 1
    flows = [sorted(flow.per_hour for flow in summary.flows) for summary in made.values()]
    assert flows[0] == flows[1] == flows[2] and len(flows[0]) == 12 and sum(flows[0]) > 500
    assert len({summary.roi for summary in made.values()}) == 1
    assert loading.load(tmp_path / "None").traffic.counts == made[None].flows


def test_help_names_default_surroundings() -> None:
    (option,) = get_type_hints(app.new, include_extras=True)["surroundings"].__metadata__
    assert f"; {openstreetmap.SURROUNDINGS_M:g} by default" in option.help


def test_rejects_surroundings_smaller_than_junction(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--surroundings: expected at least 100 m, got 60 m"):
        openstreetmap.create_scenario(tmp_path / "small", SMALL, surroundings_m=60.0)
    assert not (tmp_path / "small").exists()
