"""Streets of an extract, cut at a circle around the junction."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egvs.creation import junctions
from egvs.creation.map_parts import RoadOptions
from egvs.creation.openstreetmap import street_network
from egvs.creation.openstreetmap.reader import OsmRoads
from egvs.formats.osm import Bounds, Member, OsmExtract, Relation, Way
from tests.creation.small_maps import degrees, street, write_map

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


def test_far_streets_are_dropped_with_their_turn_restrictions() -> None:
    streets = {
        7: [(-900, 0), (900, 0)],
        8: [(0, 40), (0, 300)],
        9: [(150, 160), (300, 160)],
        10: [(300, 160), (400, 0)],
    }
    house = {11: [(500, 500), (510, 500), (500, 510), (500, 500)]}
    restrictions = tuple(
        Relation(number, (Member("way", a, "from"), Member("way", b, "to")), {"type": "restriction"})
        for number, (a, b) in enumerate([(7, 8), (7, 9), (9, 10)])
    )
    every = replace(extract(streets | house, {11: {"building": "yes"}}), relations=restrictions)
    near = street_network.drop_far_streets(every, CENTRE, 100.0)
    assert sorted(near.ways) == [7, 8, 11]
    assert near.relations == restrictions[:1]
    assert street_network.drop_far_streets(every, CENTRE, math.inf) is every


@pytest.mark.slow  # netconvert reads a whole town
@pytest.mark.system
def test_network_around_a_position_is_that_of_the_complete_map(tmp_path: Path) -> None:
    """Streets of a grid, 150 m apart and 2.4 km wide; the frame may differ, for netconvert chooses it."""
    steps = range(17)
    nodes = {100 * x + y: (150.0 * (x - 8), 150.0 * (y - 8)) for x in steps for y in steps}
    ways = [street(f"east {y}", 100 * x + y, 100 * (x + 1) + y) for x in steps[:-1] for y in steps]
    ways += [street(f"north {x}", 100 * x + y, 100 * x + y + 1) for x in steps for y in steps[:-1]]
    path, middle = write_map(tmp_path / "map.osm", nodes, ways), degrees((0.0, 0.0))
    networks, n_edges = [], []
    for position in (None, middle):
        roads = OsmRoads.read(path, RoadOptions(at=position, righthand=True))
        (at_m,) = roads.streets.to_xy([middle[1]], [middle[0]])
        chosen = junctions.choose_nearby(junctions.nearest_junctions(roads.streets, at_m))
        assert chosen is not None
        streets = roads.around(chosen.junction, None).streets
        networks.append(
            {
                edge.id: [streets.to_degrees(np.array(lane.shape_m)[:, :2]) for lane in edge.lanes]
                for edge in streets.network.edges
            }
        )
        n_edges.append(len(roads.streets.network.edges))
    assert n_edges[1] < 0.6 * n_edges[0]
    assert networks[0].keys() == networks[1].keys()
    for edge, lanes in networks[0].items():
        np.testing.assert_allclose(lanes, networks[1][edge], atol=2e-7)  # 2 cm


@pytest.mark.system
def test_streets_without_tags_have_notes_and_a_name(tmp_path: Path) -> None:
    """Two main roads cross; netconvert assumes two lanes each way and 100 km/h where their tags say nothing."""
    ways: dict[int, list[tuple[float, float]]] = {7: [(-100, 0), (0, 0), (100, 0)], 8: [(0, -100), (0, 0), (0, 100)]}
    tags = {7: {"highway": "primary", "ref": "B 62", "lanes": "2", "maxspeed": "50"}, 8: {"highway": "primary"}}
    network = street_network.build_network(extract(ways, tags), tmp_path / "map.osm", street_network.NETCONVERT_FLAGS)
    assert {edge.name for edge in network.streets.network.edges} == {"B 62", ""}
    assert network.notes == (
        "Lanes assumed by road class: 2 for 4 edges.",
        "Speed limits assumed by road class: 100 km/h for 4 edges.",
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
