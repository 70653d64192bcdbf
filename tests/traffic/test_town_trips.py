"""Random trips through a whole town."""

from __future__ import annotations

import math
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.traffic import demand, town_trips
from egvs.traffic.demand import Trip
from egvs.traffic.network import Network, read_net_xml
from tests.traffic.helpers import car, drawn

STREETS = (
    ("in", "rim", "a", 0.0, -200.0, 0.0, 0.0, 2),
    ("out", "a", "rim2", 0.0, 0.0, -200.0, 0.0, 1),
    ("ab", "a", "b", 0.0, 0.0, 400.0, 0.0, 1),
    ("ba", "b", "a", 400.0, 0.0, 0.0, 0.0, 1),
    ("bc", "b", "c", 400.0, 0.0, 400.0, 200.0, 1),
    ("cb", "c", "b", 400.0, 200.0, 400.0, 0.0, 1),
    ("short", "c", "c2", 400.0, 200.0, 430.0, 200.0, 1),
    ("trohs", "c2", "c", 430.0, 200.0, 400.0, 200.0, 1),
    ("island", "d", "e", 900.0, 0.0, 1300.0, 0.0, 1),
)
LINKS = (
    ("in", "ab"), ("in", "out"), ("ba", "out"), ("ba", "ab"), ("ab", "bc"), ("ab", "ba"), ("bc", "short"), ("bc", "cb"),
    ("short", "trohs"), ("trohs", "cb"), ("cb", "ba"), ("cb", "bc"),
)  # fmt: skip


@pytest.fixture
def small_town(tmp_path: Path) -> Network:
    """A street from the rim (two lanes in, one lane out) to a, b and c, and a street that nothing joins."""
    lines = []
    for name, from_node, to_node, x0, y0, x1, y1, lanes in STREETS:
        length_m = math.hypot(x1 - x0, y1 - y0)
        lane_lines = "".join(
            f'<lane id="{name}_{i}" index="{i}" speed="10" length="{length_m}" shape="{x0},{y0} {x1},{y1}"/>'
            for i in range(lanes)
        )
        lines.append(f'<edge id="{name}" from="{from_node}" to="{to_node}">{lane_lines}</edge>')
    for source, target in LINKS:
        lines.append(f'<connection from="{source}" to="{target}" fromLane="0" toLane="0" dir="s"/>')
    path = tmp_path / "net.xml"
    path.write_text("<net>" + "\n".join(lines) + "</net>")
    return read_net_xml(path)


def probabilities(roads: Network, values: np.ndarray) -> dict[str, float]:
    return {edge.id: value for edge, value in zip(roads.edges, values.tolist(), strict=True) if value}


def test_ends_are_at_fringe_and_along_connected_streets(small_town: Network) -> None:
    """Streets of at least 50 m in proportion to length and lanes: 200 x 2, 400, 400, 200 and 200 m."""
    ends = town_trips.trip_ends(small_town, car(), drawn(), "place")
    assert probabilities(small_town, ends.fringe_origin) == {"in": 1.0}
    assert probabilities(small_town, ends.fringe_target) == {"out": 1.0}
    assert probabilities(small_town, ends.street_origin) == pytest.approx(
        {"in": 0.25, "ab": 0.25, "ba": 0.25, "bc": 0.125, "cb": 0.125}
    )
    assert set(probabilities(small_town, ends.street_target)) == {"out", "ab", "ba", "bc", "cb"}


def test_edge_weights_replace_lanes(small_town: Network) -> None:
    weights = {"ab": 0.0, "ba": 0.0, "bc": 3.0, "cb": 1.0, "in": 0.0}
    ends = town_trips.trip_ends(small_town, car(), drawn(edge_weights=weights), "place")
    assert not ends.fringe_origin.any()
    assert probabilities(small_town, ends.street_origin) == pytest.approx({"bc": 0.75, "cb": 0.25})


def test_half_of_the_ends_are_at_the_fringe(small_town: Network) -> None:
    traffic = drawn(kinds=(car(),), min_trip_m=0.0)
    ends = town_trips.trip_ends(small_town, car(), traffic, "place")
    trips = town_trips.draw_town_trips(small_town, traffic, [ends], 4000, np.random.default_rng(0), "place")
    from_fringe = Counter(trip.depart_m is None for trip in trips)
    assert from_fringe[True] == pytest.approx(2000, abs=250)  # trips that only go back are drawn again
    assert {trip.origin for trip in trips if trip.depart_m is None} == {"in"}
    assert {trip.target for trip in trips if trip.arrival_m is None} == {"out"}
    positions_m = {trip.origin: trip.depart_m for trip in trips if trip.depart_m is not None}
    assert positions_m == {"in": 100.0, "ab": 200.0, "ba": 200.0, "bc": 100.0, "cb": 100.0}


def test_same_generator_gives_same_trips_of_minimum_length(small_town: Network) -> None:
    traffic = drawn(kinds=(car(share=3), car(name="van", vclass="delivery")), min_trip_m=450.0)
    ends = [town_trips.trip_ends(small_town, kind, traffic, "place") for kind in traffic.kinds]
    draws = [
        town_trips.draw_town_trips(small_town, traffic, ends, 400, np.random.default_rng(5), "place") for _ in range(2)
    ]
    assert draws[0] == draws[1]
    assert Counter(trip.kind for trip in draws[0])["car"] == pytest.approx(300, abs=40)
    edges = {edge.id: edge for edge in small_town.edges}
    for trip in draws[0]:
        assert math.dist(edges[trip.origin].start_m, edges[trip.target].end_m) >= 450.0
        assert edges[trip.origin].from_node != edges[trip.target].to_node


def test_rejects_town_without_trips_of_minimum_length(small_town: Network) -> None:
    traffic = drawn(kinds=(car(),), min_trip_m=2000.0)
    ends = town_trips.trip_ends(small_town, car(), traffic, "place")
    with pytest.raises(InputError, match=r"place\.kinds: kind 'car' .* cannot make any trip of at least 2000 m"):
        town_trips.draw_town_trips(small_town, traffic, [ends], 5, np.random.default_rng(0), "place")


@pytest.mark.slow
def test_every_trip_has_a_route_and_keeps_its_positions(town: Path, tmp_path: Path) -> None:
    roads = read_net_xml(town / "net.xml")
    (tmp_path / "net.xml").write_text((town / "net.xml").read_text())
    (tmp_path / "vtypes.xml").write_text(demand.vtypes_xml([car()]))
    traffic = drawn(kinds=(car(),))
    ends = town_trips.trip_ends(roads, car(), traffic, "place")
    trips = town_trips.draw_town_trips(roads, traffic, [ends], 200, np.random.default_rng(0), "place")
    routed = demand.route_trips(trips, tmp_path, "net.xml", "vtypes.xml")
    assert [trip.number for trip in routed] == list(range(200))
    text = demand.routes_xml(routed, np.arange(200.0))
    assert len(re.findall(r' departPos="\d', text)) == sum(trip.depart_m is not None for trip in trips) > 50
    assert len(re.findall(r' arrivalPos="\d', text)) == sum(trip.arrival_m is not None for trip in trips) > 50


def test_positions_are_written_only_where_given() -> None:
    assert Trip("car", "a", "b").positions_xml == ""
    assert Trip("car", "a", "b", 12.34, None).positions_xml == ' departPos="12.3"'
    assert Trip("car", "a", "b", 12.34, 5.0).positions_xml == ' departPos="12.3" arrivalPos="5.0"'
