"""A junction's surroundings are cut out of an extract, and the traffic assumed there does not depend on the cut."""

import math
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest

from pipeline.cli import app
from pipeline.core.errors import InputError
from pipeline.formats.osm import Bounds, Extract, Way
from pipeline.importers import assumed_traffic, surroundings
from pipeline.importers import openstreetmap as osm
from pipeline.scenario import loading
from pipeline.traffic.network import Edge, Lane, Permission

SMALL = Path(__file__).parent / "data" / "small.osm"
MIDDLE = (52.0, 10.0)


def node(east_m: float, north_m: float) -> tuple[float, float]:
    """Latitude, longitude of a place beside the middle."""
    lat = MIDDLE[0] + math.degrees(north_m / surroundings.EARTH_M)
    return lat, MIDDLE[1] + math.degrees(east_m / surroundings.EARTH_M / math.cos(math.radians(MIDDLE[0])))


def extract(ways: dict[int, list[tuple[float, float]]], tags: dict[int, dict[str, str]] | None = None) -> Extract:
    """Streets through places in metres beside the middle; equal places are one node."""
    places = list(dict.fromkeys(place for way in ways.values() for place in way))
    nodes = {i: node(*place) for i, place in enumerate(places, 1)}
    made = {
        name: Way(name, tuple(places.index(place) + 1 for place in way), (tags or {}).get(name, {"highway": "primary"}))
        for name, way in ways.items()
    }
    return Extract(nodes, {}, made, (), Bounds(51, 9, 53, 11), True)


def lines_m(cut: Extract) -> dict[int, list[tuple[float, float]]]:
    """Where each way leads, metres beside the middle."""
    shrink = math.cos(math.radians(MIDDLE[0]))

    def place(lat: float, lon: float) -> tuple[float, float]:
        east, north = math.radians(lon - MIDDLE[1]) * shrink, math.radians(lat - MIDDLE[0])
        return round(east * surroundings.EARTH_M, 1), round(north * surroundings.EARTH_M, 1)

    return {name: [place(*cut.nodes[n]) for n in way.nodes] for name, way in cut.ways.items()}


def test_streets_end_on_the_circle() -> None:
    cut = surroundings.cut_out(extract({7: [(-500, 0), (0, 0), (80, 0)], 8: [(0, -90), (0, 0), (0, 200)]}), MIDDLE, 100)
    assert lines_m(cut) == {7: [(-100, 0), (0, 0), (80, 0)], 8: [(0, -90), (0, 0), (0, 100)]}


def test_a_street_that_comes_back_is_cut_in_two_and_the_longer_piece_keeps_its_name() -> None:
    way = [(-50, 0), (0, 0), (60, 0), (300, 0), (300, 80), (0, 80), (0, 70)]
    joining = [(0, 0), (0, 70)]
    cut = lines_m(surroundings.cut_out(extract({7: way, 9: joining}), MIDDLE, 100))
    assert cut == {7: [(-50, 0), (0, 0), (60, 0), (100, 0)], 9: joining, 10: [(60, 80), (0, 80), (0, 70)]}


def test_a_street_across_the_circle_without_a_node_in_it() -> None:
    ways = {7: [(-300, 60), (300, 60)], 8: [(0, 0), (0, 50)]}
    everything = lines_m(surroundings.cut_out(extract(ways, {8: {"highway": "footway"}}), MIDDLE, 100))
    assert everything[8] == ways[8]  # a path goes where it likes
    assert everything[7] == [(-80, 60), (80, 60)]


def test_what_hangs_together_only_beyond_the_circle_is_left_out() -> None:
    ways = {7: [(0, 0), (300, 0)], 8: [(0, 60), (300, 60)], 9: [(300, 0), (300, 60)], 10: [(5, 5), (9, 5), (5, 9)]}
    cut = surroundings.cut_out(extract(ways, {10: {"building": "yes"}}), MIDDLE, 100)
    assert lines_m(cut) == {7: [(0, 0), (100, 0)], 10: ways[10]}
    assert surroundings.cut_out(extract(ways), MIDDLE, 1000).ways.keys() >= {7, 8, 9}


# --- assumed traffic -----------------------------------------------------------------------------------------------


def test_flows_are_balanced_by_hand() -> None:
    """A crossing of a main street (600 each way) and a side street (40): nobody turns back."""
    may = np.ones((4, 4)) - np.eye(4)
    wanted = [600.0, 40.0, 600.0, 40.0]
    rates = assumed_traffic.balanced(may, wanted, wanted)
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
def test_the_class_of_a_street_says_how_much_it_carries(kind: str, per_lane_h: float) -> None:
    """Of its three lanes one is for people on foot."""
    on_foot, cars = Permission(frozenset({"pedestrian"}), frozenset()), Permission(None, frozenset())
    lanes = tuple(Lane("0,0 9,0", "lane", None, 9.0, permission) for permission in (on_foot, cars, cars))
    assert assumed_traffic.flow_h(Edge("e", "", "a", "b", "", lanes, kind)) == 2 * per_lane_h


def test_what_comes_in_is_met_even_where_it_cannot_leave_as_wished() -> None:
    rates = assumed_traffic.balanced(np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 0.0]]), [100, 50, 30], [10, 200])
    assert rates.tolist() == [[100, 0], [50, 0], [0, 0]]


@pytest.mark.slow
def test_a_smaller_cut_changes_neither_sites_nor_flows(tmp_path: Path) -> None:
    made = {r: osm.new(tmp_path / str(r), SMALL, surroundings_m=r) for r in (120.0, 150.0, None)}
    lengths = [summary.streets.lane_length_m for summary in made.values()]
    assert lengths == sorted(lengths) and lengths[0] < 0.8 * lengths[-1]
    for name in ("sites.csv", "statics.geojson"):
        assert len({(tmp_path / str(r) / name).read_bytes() for r in made}) == 1
    flows = [sorted(flow.per_hour for flow in summary.flows) for summary in made.values()]
    assert flows[0] == flows[1] == flows[2] and len(flows[0]) == 12 and sum(flows[0]) > 500
    assert len({summary.roi for summary in made.values()}) == 1
    assert loading.load(tmp_path / "None").traffic.counts == made[None].flows


def test_the_help_names_the_radius_that_is_taken() -> None:
    (option,) = get_type_hints(app.new, include_extras=True)["surroundings"].__metadata__
    assert f": {osm.SURROUNDINGS_M:g} by default" in option.help


def test_surroundings_that_do_not_hold_the_junction_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--surroundings: 60 m; at least 100"):
        osm.new(tmp_path / "small", SMALL, surroundings_m=60.0)
    assert not (tmp_path / "small").exists()
