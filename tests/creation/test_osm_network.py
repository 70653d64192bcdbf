"""Streets of an extract, cut at a circle around the junction."""

import math
from pathlib import Path

import pytest

from egvs.creation.openstreetmap import street_network
from egvs.formats.osm import Bounds, OsmExtract, Way

CENTRE = (52.0, 10.0)


def node(east_m: float, north_m: float) -> tuple[float, float]:
    """Latitude, longitude of a place beside the middle."""
    lat = CENTRE[0] + math.degrees(north_m / street_network.EARTH_M)
    return lat, CENTRE[1] + math.degrees(east_m / street_network.EARTH_M / math.cos(math.radians(CENTRE[0])))


def extract(ways: dict[int, list[tuple[float, float]]], tags: dict[int, dict[str, str]] | None = None) -> OsmExtract:
    """Streets through places in metres beside the middle; equal places are one node."""
    places = list(dict.fromkeys(to_metres for way in ways.values() for to_metres in way))
    nodes = {i: node(*point) for i, point in enumerate(places, 1)}
    made = {
        name: Way(
            name,
            tuple(places.index(point) + 1 for point in way),
            (tags or {}).get(name, {"highway": "primary"}),
        )
        for name, way in ways.items()
    }
    return OsmExtract(nodes, {}, made, (), Bounds(51, 9, 53, 11), True)


def lines_m(cut: OsmExtract) -> dict[int, list[tuple[float, float]]]:
    """Where each way leads, metres beside the middle."""
    shrink = math.cos(math.radians(CENTRE[0]))

    def to_metres(lat: float, lon: float) -> tuple[float, float]:
        east, north = math.radians(lon - CENTRE[1]) * shrink, math.radians(lat - CENTRE[0])
        return round(east * street_network.EARTH_M, 1), round(north * street_network.EARTH_M, 1)

    return {name: [to_metres(*cut.nodes[n]) for n in way.nodes] for name, way in cut.ways.items()}


def test_streets_end_on_the_circle() -> None:
    cut = street_network.cut_surroundings(
        extract({7: [(-500, 0), (0, 0), (80, 0)], 8: [(0, -90), (0, 0), (0, 200)]}), CENTRE, 100
    )
    assert lines_m(cut) == {7: [(-100, 0), (0, 0), (80, 0)], 8: [(0, -90), (0, 0), (0, 100)]}


@pytest.mark.system
def test_streets_without_tags_have_notes_and_a_name(tmp_path: Path) -> None:
    """Two main roads cross; netconvert assumes two lanes each way and 100 km/h where their tags say nothing."""
    ways: dict[int, list[tuple[float, float]]] = {7: [(-100, 0), (0, 0), (100, 0)], 8: [(0, -100), (0, 0), (0, 100)]}
    tags = {7: {"highway": "primary", "ref": "B 62", "lanes": "2", "maxspeed": "50"}, 8: {"highway": "primary"}}
    network = street_network.build_network(extract(ways, tags), tmp_path / "map.osm", street_network.NETCONVERT_FLAGS)
    assert {edge.name for edge in network.streets.network.edges} == {"B 62", ""}
    assert network.notes == (
        "Numbers of lanes that the map does not state are assumed by road class: 2 for 4 edges.",
        "Speed limits that the map does not state are assumed by road class: 100 km/h for 4 edges.",
    )


def test_longer_piece_of_street_keeps_its_id() -> None:
    way = [(-50, 0), (0, 0), (60, 0), (300, 0), (300, 80), (0, 80), (0, 70)]
    joining = [(0, 0), (0, 70)]
    cut = lines_m(street_network.cut_surroundings(extract({7: way, 9: joining}), CENTRE, 100))
    assert cut == {7: [(-50, 0), (0, 0), (60, 0), (100, 0)], 9: joining, 10: [(60, 80), (0, 80), (0, 70)]}


def test_cuts_street_across_circle_without_node_inside() -> None:
    ways = {7: [(-300, 60), (300, 60)], 8: [(0, 0), (0, 50)]}
    everything = lines_m(street_network.cut_surroundings(extract(ways, {8: {"highway": "footway"}}), CENTRE, 100))
    assert everything[8] == ways[8]  # a path goes where it likes
    assert everything[7] == [(-80, 60), (80, 60)]


def test_drops_roads_connected_only_outside_circle() -> None:
    ways = {7: [(0, 0), (300, 0)], 8: [(0, 60), (300, 60)], 9: [(300, 0), (300, 60)], 10: [(5, 5), (9, 5), (5, 9)]}
    cut = street_network.cut_surroundings(extract(ways, {10: {"building": "yes"}}), CENTRE, 100)
    assert lines_m(cut) == {7: [(0, 0), (100, 0)], 10: ways[10]}
    assert street_network.cut_surroundings(extract(ways), CENTRE, 1000).ways.keys() >= {7, 8, 9}
