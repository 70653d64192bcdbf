"""What a map calls a building: is it one, how high by its tags and its type, and what is counted of the others?"""

from __future__ import annotations

from collections import Counter

import pytest
from shapely.geometry import Point

from egvs.core.errors import InputError
from egvs.core.polygons import PairCount
from egvs.creation.junctions import Streets
from egvs.creation.map_parts import ImportCounts, MappedSolid
from egvs.creation.openstreetmap import solids as osm_solids
from egvs.creation.openstreetmap.solids import find_buildings
from egvs.formats.osm import Bounds, Member, OsmExtract, Relation, Tags, Way
from egvs.traffic.network import Location, Network
from tests.creation.small_maps import degrees

XY = {1: (0.0, 0.0), 2: (10.0, 0.0), 3: (10.0, 10.0), 4: (0.0, 10.0)}


def imported(*ways: Tags) -> tuple[list[MappedSolid], ImportCounts]:
    """The solids of squares with these tags."""
    squares = {number: Way(number, (1, 2, 3, 4, 1), tags) for number, tags in enumerate(ways)}
    nodes = {node: (0.0, 0.0) for node in XY}
    counts = ImportCounts()
    extract = OsmExtract(nodes, {}, squares, (), Bounds(0, 0, 1, 1), False)
    return list(find_buildings(extract, XY, counts, PairCount())), counts


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"building": "yes"}, ("building", 0, 9, "default")),
        ({"building": "apartments"}, ("building", 0, 9, "default")),
        ({"building": "garage"}, ("building", 0, 2.5, "type")),
        ({"building": "garages"}, ("building", 0, 2.5, "type")),
        ({"building": "shed"}, ("building", 0, 2.5, "type")),
        ({"building": "hut"}, ("building", 0, 2.5, "type")),
        ({"building": "kiosk"}, ("building", 0, 3, "type")),
        ({"building": "greenhouse"}, ("building", 0, 3, "type")),
        ({"building": "garage", "height": "4"}, ("building", 0, 4, "height")),
        ({"building": "roof"}, ("roof", 4.5, 5, "type")),
        ({"building": "canopy"}, ("roof", 4.5, 5, "type")),
        ({"building": "carport"}, ("roof", 2.2, 2.5, "type")),
        ({"building": "yes", "building:part": "roof"}, ("roof", 4.5, 5, "type")),
        ({"building:part": "yes"}, ("building", 0, 9, "default")),
        ({"building:part": "garage"}, ("building", 0, 2.5, "type")),
        ({"building": "no", "building:part": "yes"}, ("building", 0, 9, "default")),
        ({"man_made": "silo"}, ("building", 0, 9, "default")),
        ({"building": "roof", "height": "8"}, ("roof", 7.5, 8, "height")),
        ({"building": "roof", "height": "8", "min_height": "6"}, ("roof", 6, 8, "height")),
        ({"building": "roof", "min_height": "6"}, ("roof", 6, 6.5, "type")),
        ({"building": "yes", "building:levels": "3"}, ("building", 0, 9, "levels")),
        ({"building": "yes", "building:levels": "3", "roof:levels": "2"}, ("building", 0, 15, "levels")),
        ({"building": "yes", "building:levels": "3", "roof:levels": "0"}, ("building", 0, 9, "levels")),
        ({"building": "yes", "building:levels": "0", "roof:levels": "1"}, ("building", 0, 3, "levels")),
        ({"building": "yes", "building:levels": "2", "roof:height": "4.5"}, ("building", 0, 10.5, "levels")),
        ({"building": "yes", "height": "12", "roof:levels": "2"}, ("building", 0, 12, "height")),
        ({"building": "yes", "roof:levels": "2"}, ("building", 0, 9, "default")),  # nobody knows what is below
        ({"building": "yes", "height": "9", "min_height": "3"}, ("building", 3, 9, "height")),
        ({"building": "yes", "building:levels": "4", "building:min_level": "1"}, ("building", 3, 12, "levels")),
        ({"building": "yes", "min_height": "3"}, ("building", 3, 9, "default")),
        ({"building": "yes", "min_height": "12"}, ("building", 12, 15, "default")),  # a storey at least
    ],
)
def test_building_extent_follows_tags(tags: Tags, expected: tuple[str, float, float, str]) -> None:
    ((solid,), counts) = imported(tags)
    assert (solid.kind, solid.base_m, solid.height_m, solid.height_source) == pytest.approx(expected)
    assert not counts.unreadable


@pytest.mark.parametrize("value", ["no", "demolished", "razed", "proposed", "planned", "entrance", "underground"])
def test_counts_objects_that_are_not_buildings(value: str) -> None:
    solids, counts = imported({"building": value})
    assert not solids
    assert counts.not_modelled == {f"building={value}": 1}


@pytest.mark.parametrize(
    "tags",
    [
        {"building": "garage", "location": "underground"},
        {"building": "parking", "parking": "underground"},
        {"building": "yes", "building:levels": "0", "building:levels:underground": "2"},
    ],
)
def test_counts_underground_buildings(tags: Tags) -> None:
    solids, counts = imported(tags)
    assert not solids
    assert counts.dropped == {"underground": {"building": 1}}


@pytest.mark.parametrize(
    ("tags", "expected", "unreadable"),
    [
        ({"building": "yes", "height": "tall", "building:levels": "2"}, (0, 6), {"height": 1}),
        ({"building": "yes", "building:levels": "2-3"}, (0, 9), {"building:levels": 1}),
        ({"building": "yes", "building:levels": "2", "roof:levels": "some"}, (0, 6), {"roof:levels": 1}),
        ({"building": "yes", "building:levels": "0"}, (0, 9), {"building:levels": 1}),
        ({"building": "yes", "building:levels": "0.0000001"}, (0, 9), {"building:levels": 1}),
        ({"building": "yes", "height": "0.0000001"}, (0, 9), {"height": 1}),
        ({"building": "yes", "height": "5", "min_height": "4.9999999"}, (0, 5), {"base above top": 1}),
        ({"building": "yes", "height": "5", "min_height": "7"}, (0, 5), {"base above top": 1}),
        ({"building": "roof", "height": "5", "min_height": "7"}, (4.5, 5), {"base above top": 1}),
    ],
)
def test_counts_unreadable_tags(tags: Tags, expected: tuple[float, float], unreadable: dict[str, int]) -> None:
    ((solid,), counts) = imported(tags)
    assert (solid.base_m, solid.height_m) == expected
    assert counts.unreadable == unreadable


def test_counts_building_without_outline() -> None:
    counts = ImportCounts()
    points = {1: {"building": "yes"}, 2: {"man_made": "tower"}, 3: {"shop": "bakery"}, 4: {"building": "no"}}
    extract = OsmExtract({node: (0.0, 0.0) for node in XY}, points, {}, (), Bounds(0, 0, 1, 1), False)
    assert not list(find_buildings(extract, XY, counts, PairCount()))
    assert counts.dropped == {"no_outline": {"building": 2}}
    assert not list(find_buildings(extract, XY, counts, PairCount(), Point(900, 900)))
    assert counts.dropped == {"no_outline": {"building": 2}}, "out of reach"


def test_object_on_wall_starts_above_it() -> None:
    """``min_height`` is the underside of barriers and poles, too."""
    tags = {"barrier": "fence", "min_height": "1.2", "height": "2.5"}
    lamp = {"highway": "street_lamp", "min_height": "3", "height": "8"}
    extract = OsmExtract(
        dict.fromkeys(XY, (0.0, 0.0)), {1: lamp}, {7: Way(7, (1, 2), tags)}, (), Bounds(0, 0, 1, 1), False
    )
    made = [
        *osm_solids.find_barriers(extract, XY, ImportCounts(), PairCount()),
        *osm_solids.find_poles(extract, XY, ImportCounts()),
    ]
    assert [(solid.kind, solid.base_m, solid.height_m) for solid in made] == [("barrier", 1.2, 2.5), ("pole", 3.0, 8.0)]


def test_messages_name_the_file_and_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_CORNERS", "3")
    square = {5: Way(5, (1, 2, 3, 4, 1), {"building": "yes"})}
    extract = OsmExtract(dict.fromkeys(XY, (0.0, 0.0)), {}, square, (), Bounds(0, 0, 1, 1), False)
    with pytest.raises(InputError, match=r"^town\.osm: way 5: has 4 corners\. The limit is 3 corners"):
        list(find_buildings(extract, XY, ImportCounts(), PairCount("town.osm")))


def ring(
    number: int, at_m: tuple[float, float], tags: Tags, size_m: float = 10.0
) -> tuple[dict[int, tuple[float, float]], Way]:
    """A square and its nodes."""
    x, y = at_m
    corners = [(x, y), (x + size_m, y), (x + size_m, y + size_m), (x, y + size_m)]
    nodes = {10 * number + corner: point for corner, point in enumerate(corners)}
    return nodes, Way(number, (*nodes, 10 * number), tags)


def town() -> OsmExtract:
    """Objects in the window of 200 m around the middle, across its border, and far from it."""
    house = {"building": "yes"}
    rings = [
        ring(1, (0, 0), house),
        ring(2, (195, 0), house, 600.0),
        ring(3, (2000, 0), house | {"height": "tall"}),
        ring(4, (2100, 0), {"building": "roof"}),
        ring(5, (2200, 0), house),
        ring(6, (2200, 0), {"building:part": "yes"}),
        ring(7, (2300, 0), house, 50.0),
        ring(8, (2310, 10), {"building:part": "yes"}),
        ring(9, (2400, 0), house | {"location": "underground"}),
        ring(10, (2500, 0), {"building": "razed"}),
        ring(11, (2600, 0), {}),
        ring(12, (2605, 2), {}, 3.0),
        ring(13, (-50, -900), {"landuse": "forest"}, 1800.0),
        ring(14, (2700, 0), {"barrier": "wall"}),
        ring(15, (100, 100), {"building:part": "yes"}),
        ring(16, (-900, 100), house, 695.0),
    ]
    nodes = {number: degrees(at_m) for of_ring, _ in rings for number, at_m in of_ring.items()}
    ways = {way.id: way for _, way in rings}
    ways[17] = Way(17, (10, 30, 31), {"barrier": "fence"})
    ways[18] = Way(18, (30, 31, 32), house)
    ways[19] = Way(19, (30, 999, 31, 30), house)
    ways[20] = Way(20, (999, 998, 997, 999), house)
    members = (Member("way", 11, "outer"), Member("way", 12, "inner"))
    relations = (
        Relation(1, members, {"type": "multipolygon", "building": "yes"}),
        Relation(2, (Member("way", 13, "outer"), Member("way", 3, "outer")), {"type": "multipolygon"}),
    )
    return OsmExtract(nodes, {30: {"natural": "tree"}}, ways, relations, Bounds(51, 9, 53, 11), True)


def test_far_objects_are_counted_as_if_they_were_made() -> None:
    projection = "+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"
    streets = Streets(Network((), (), (), 0.0, Location(projection, (0.0, 0.0))), {}, ())
    lat_deg, lon_deg = degrees((0.0, 0.0))
    window = Point(streets.to_xy([lon_deg], [lat_deg])[0]).buffer(200.0)

    every, _ = osm_solids.map_solids(town(), streets)
    near, counts = osm_solids.map_solids(town(), streets, window=window)
    assert near == [solid for solid in every if window.intersects(solid.area)]
    assert {solid.name for solid in near} >= {"way/1", "way/2", "way/15", "way/17"}
    far = Counter(solid.kind for solid in every if not window.intersects(solid.area))
    assert counts.dropped.pop("out_of_range") == far - Counter(tree_trunk=1, tree_crown=1) + Counter(tree=1)
    assert counts.dropped == {"underground": {"building": 1}, "incomplete": {"building": 3}}
    assert counts.unreadable == {"height": 1} and counts.not_modelled == {"building=razed": 1}
