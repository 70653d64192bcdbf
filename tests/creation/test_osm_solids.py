"""What a map calls a building: is it one, how high by its tags and its type, and what is counted of the others?"""

from __future__ import annotations

import pytest
from shapely.geometry import Point

from egvs.creation.map_parts import ImportCounts, MappedSolid
from egvs.creation.openstreetmap import solids as osm_solids
from egvs.creation.openstreetmap.solids import find_buildings
from egvs.formats.osm import Bounds, OsmExtract, Tags, Way

XY = {1: (0.0, 0.0), 2: (10.0, 0.0), 3: (10.0, 10.0), 4: (0.0, 10.0)}


def imported(*ways: Tags) -> tuple[list[MappedSolid], ImportCounts]:
    """The solids of squares with these tags."""
    squares = {number: Way(number, (1, 2, 3, 4, 1), tags) for number, tags in enumerate(ways)}
    nodes = {node: (0.0, 0.0) for node in XY}
    counts = ImportCounts()
    extract = OsmExtract(nodes, {}, squares, (), Bounds(0, 0, 1, 1), False)
    return list(find_buildings(extract, XY, counts)), counts


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
    assert not list(find_buildings(extract, XY, counts))
    assert counts.dropped == {"no_outline": {"building": 2}}
    assert not list(find_buildings(extract, XY, counts, Point(900, 900)))
    assert counts.dropped == {"no_outline": {"building": 2}}, "out of reach"


def test_object_on_wall_starts_above_it() -> None:
    """``min_height`` is the underside of barriers and poles, too."""
    tags = {"barrier": "fence", "min_height": "1.2", "height": "2.5"}
    lamp = {"highway": "street_lamp", "min_height": "3", "height": "8"}
    extract = OsmExtract(
        dict.fromkeys(XY, (0.0, 0.0)), {1: lamp}, {7: Way(7, (1, 2), tags)}, (), Bounds(0, 0, 1, 1), False
    )
    made = [
        *osm_solids.find_barriers(extract, XY, ImportCounts()),
        *osm_solids.find_poles(extract, XY, ImportCounts()),
    ]
    assert [(solid.kind, solid.base_m, solid.height_m) for solid in made] == [("barrier", 1.2, 2.5), ("pole", 3.0, 8.0)]
