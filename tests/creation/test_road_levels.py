"""Roads above and below a junction."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from shapely.geometry import LineString

from egvs.core.polygons import PairCount
from egvs.creation import junctions, road_levels
from egvs.creation.map_parts import ImportCounts, MappedSolid
from egvs.creation.openstreetmap import solids, street_network
from egvs.formats import osm
from egvs.traffic import network as road_network
from tests.creation.new_scenarios import create_scenario

SMALL = Path(__file__).parent / "data" / "small.osm"
"""A cross of the streets 1001 (west to east) and 1002 (south to north) at node 1."""

XY = tuple[float, float]

FLYOVER: list[XY] = [(-180, -10), (-60, -20), (60, 20), (190, 40)]
"""Metres east and north of the cross."""


def degrees(east_m: float, north_m: float) -> tuple[float, float]:
    lat_deg = 52.0 + math.degrees(north_m / street_network.EARTH_M)
    return lat_deg, 10.0 + math.degrees(east_m / street_network.EARTH_M / math.cos(math.radians(52.0)))


class Extract:
    """The small extract with further ways; those with the numbers of existing nodes meet its streets."""

    def __init__(self) -> None:
        self.nodes: list[str] = []
        self.ways: list[str] = []
        self.changes: list[tuple[str, str]] = []

    def draw(self, number: int, points: list[XY | int], **tags: str) -> Extract:
        refs = []
        for index, point in enumerate(points):
            if isinstance(point, int):
                refs.append(point)
                continue
            refs.append(number * 100 + index)
            lat_deg, lon_deg = degrees(*point)
            self.nodes.append(f'<node id="{refs[-1]}" lat="{lat_deg:.7f}" lon="{lon_deg:.7f}"/>\n')
        members = "".join(f'<nd ref="{ref}"/>' for ref in refs)
        texts = "".join(f'<tag k="{key.replace("__", ":")}" v="{value}"/>' for key, value in tags.items())
        self.ways.append(f'<way id="{number}">{members}{texts}</way>\n')
        return self

    def tag(self, way: int, **tags: str) -> Extract:
        texts = "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        self.changes.append((f'<way id="{way}">', texts))
        return self

    def write(self, path: Path) -> Path:
        text = SMALL.read_text(encoding="utf-8")
        for way, tags in self.changes:
            start = text.index(way)
            end = text.index("</way>", start)
            text = text[:end] + tags + text[end:]
        for first, lines in (("<way ", self.nodes), ("<relation ", self.ways)):
            start = text.index(first)
            text = text[:start] + "".join(lines) + text[start:]
        path.write_text(text, encoding="utf-8")
        return path


def with_flyover(**tags: str) -> Extract:
    """Return the cross with a road that leaves street 1001 in the west and meets it again in the east."""
    flyover = Extract().draw(9001, [101, *FLYOVER[:1]], highway="primary")
    flyover.draw(9002, [900101, *FLYOVER[1:]], highway="primary", name="High Road", **tags)
    return flyover.draw(9003, [900203, 102], highway="primary")


def other_levels(path: Path) -> road_levels.OtherLevels:
    """Return what is above and below the junction at node 1."""
    extract = osm.read_osm(path)
    flags = street_network.netconvert_flags(extract, lefthand=False, walk=False)
    _, streets, _ = street_network.build_network(extract, path, flags)
    junction = next(junction for junction in streets.junctions if junction.id == "1")
    return road_levels.find_other_levels(extract, streets, junction, junctions.region_around(junction).area)


def ids(ways: tuple[osm.Way, ...]) -> list[int]:
    return [way.id for way in ways]


def decks_of(folder: Path) -> list[dict[str, Any]]:
    features = json.loads((folder / "statics.geojson").read_text(encoding="utf-8"))["features"]
    return [feature for feature in features if feature["properties"]["kind"] == "bridge"]


@pytest.mark.slow
def test_flyover_is_no_traffic_but_a_deck(tmp_path: Path) -> None:
    path = with_flyover(bridge="yes", layer="1", lanes="4").write(tmp_path / "flyover.osm")
    plain = create_scenario(tmp_path / "plain", SMALL)
    made = create_scenario(tmp_path / "flyover", path)

    assert made.flows == plain.flows
    region = made.region.roi.area
    roads = road_network.read_net_xml(tmp_path / "flyover" / "network.net.xml").edges
    inside = {edge.id.lstrip("-").partition("#")[0] for edge in roads if made.streets.areas[edge.id].intersects(region)}
    assert inside == {"1001", "1002"}
    note = "Roads on another level are left out of the traffic in the region of interest: High Road (bridge)."
    assert note in made.notes
    assert "No height is given for 1 of 1 bridge deck: 5 m assumed." in made.notes

    (deck,) = decks_of(tmp_path / "flyover")
    assert {key: deck["properties"][key] for key in ("height_m", "base_m", "radius_m")} == {
        "height_m": 6.0, "base_m": 5.0, "radius_m": 8.0,
    }  # fmt: skip
    assert LineString(deck["geometry"]["coordinates"]).intersects(region)


@pytest.mark.parametrize(
    ("tags", "top_m", "base_m", "source"),
    [
        ({}, 6.0, 5.0, "default"),
        ({"height": "8"}, 8.0, 7.0, "height"),
        ({"height": "8", "min_height": "6.5"}, 8.0, 6.5, "height"),
        ({"min_height": "7"}, 8.0, 7.0, "default"),
    ],
)
def test_deck_is_at_its_tagged_height(tags: dict[str, str], top_m: float, base_m: float, source: str) -> None:
    (deck,) = make_decks({"highway": "primary", **tags})
    assert (deck.height_m, deck.base_m, deck.height_source) == (top_m, base_m, source)


@pytest.mark.parametrize(
    ("tags", "width_m"),
    [
        ({"highway": "primary"}, 9.0),
        ({"highway": "primary", "oneway": "yes"}, 5.5),
        ({"highway": "primary", "lanes": "4"}, 16.0),
        ({"highway": "primary", "lanes": "4", "width": "20"}, 20.0),
        ({"highway": "footway"}, 3.0),
        ({"railway": "rail"}, 5.0),
    ],
)
def test_width_of_deck(tags: dict[str, str], width_m: float) -> None:
    (deck,) = make_decks(tags)
    assert deck.radius_m == width_m / 2


def make_decks(tags: dict[str, str]) -> list[MappedSolid]:
    """Return the deck of a bridge 50 m long."""
    way = osm.Way(1, (1, 2), {"bridge": "yes", **tags})
    return list(solids.make_decks([way], {1: (0.0, 0.0), 2: (50.0, 0.0)}, ImportCounts(), PairCount()))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tags", "title", "decks"),
    [
        ({"tunnel": "yes"}, "High Road (tunnel)", []),
        ({"tunnel": "yes", "layer": "-2"}, "High Road (tunnel)", []),
        ({"layer": "-1"}, "High Road (layer -1)", []),
        ({"layer": "1"}, "High Road (layer 1)", []),
        ({"bridge": "viaduct"}, "High Road (bridge)", [9002]),
    ],
)
def test_road_on_another_level_is_left_out(tmp_path: Path, tags: dict[str, str], title: str, decks: list[int]) -> None:
    others = other_levels(with_flyover(**tags).write(tmp_path / "town.osm"))
    assert (ids(others.roads), others.road_titles, ids(others.decks)) == ([9002], [title], decks)


@pytest.mark.slow
@pytest.mark.parametrize("tags", [{}, {"tunnel": "building_passage"}, {"bridge": "no"}, {"layer": "0"}])
def test_road_at_ground_level_stays(tmp_path: Path, tags: dict[str, str]) -> None:
    assert other_levels(with_flyover(**tags).write(tmp_path / "town.osm")) == road_levels.OtherLevels()


@pytest.mark.slow
def test_street_that_leaves_over_a_river_stays(tmp_path: Path) -> None:
    town = Extract().draw(9001, [1, (20, 20)], highway="primary")
    town.draw(9002, [900101, (60, 60)], highway="primary", bridge="yes", layer="1")
    town.draw(9003, [(10, 30), (40, 60)], highway="footway", bridge="yes", layer="1")
    assert other_levels(town.write(tmp_path / "river.osm")) == road_levels.OtherLevels()


@pytest.mark.slow
def test_junction_on_a_bridge_loses_the_road_below(tmp_path: Path) -> None:
    town = with_flyover().tag(1001, bridge="yes", layer="1").tag(1002, bridge="yes", layer="1")
    others = other_levels(town.write(tmp_path / "above.osm"))
    assert (ids(others.roads), ids(others.decks)) == ([9002], [])


@pytest.mark.slow
def test_junction_on_a_bridge_becomes_a_scenario(tmp_path: Path) -> None:
    town = with_flyover().tag(1001, bridge="yes", layer="1").tag(1002, bridge="yes", layer="1")
    plain = create_scenario(tmp_path / "plain", SMALL)
    made = create_scenario(tmp_path / "above", town.write(tmp_path / "above.osm"))
    assert made.flows == plain.flows and made.poles == plain.poles
    assert not decks_of(tmp_path / "above")


@pytest.mark.slow
def test_motorway_below_a_street_of_the_junction_is_left_out(tmp_path: Path) -> None:
    """Street 1001 stays, although it is the bridge: it belongs to the junction."""
    town = Extract().tag(1001, bridge="yes", layer="1")
    town.draw(9001, [(25, -300), (25, 300)], highway="motorway", ref="A 4")
    others = other_levels(town.write(tmp_path / "motorway.osm"))
    assert (ids(others.roads), others.road_titles, ids(others.decks)) == ([9001], ["A 4 (layer 0)"], [])


@pytest.mark.slow
def test_underpass_that_starts_in_the_region_is_left_out(tmp_path: Path) -> None:
    town = Extract().draw(9001, [1, (-25, -8)], highway="primary")
    town.draw(9002, [900101, (0, -5), (25, -8)], highway="primary", tunnel="yes", layer="-1", name="Underpass")
    others = other_levels(town.write(tmp_path / "underpass.osm"))
    assert others.road_titles == ["Underpass (tunnel)"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tags", "decks"),
    [
        ({"railway": "rail"}, [9001]),
        ({"highway": "footway"}, [9001]),
        ({"railway": "abandoned"}, []),
        ({"highway": "construction"}, []),
        ({"waterway": "canal"}, []),
    ],
)
def test_bridges_of_railways_and_paths_are_decks(tmp_path: Path, tags: dict[str, str], decks: list[int]) -> None:
    town = Extract().draw(9001, [(-40, -15), (40, -15)], bridge="yes", layer="1", **tags)
    others = other_levels(town.write(tmp_path / "rail.osm"))
    assert (ids(others.roads), ids(others.decks)) == ([], decks)


@pytest.mark.slow
def test_pieces_outside_the_region_stay_in_the_network(tmp_path: Path) -> None:
    path = with_flyover(bridge="yes").write(tmp_path / "flyover.osm")
    made = create_scenario(tmp_path / "made", path)
    edges = {edge.id.lstrip("-") for edge in made.streets.network.edges}
    assert edges & {"9001", "9002", "9003"}
