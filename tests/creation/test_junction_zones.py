"""Zones of a junction: those of a small map with sidewalks, and of a roundabout."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import shapely

from egvs.creation import junction_zones
from egvs.creation.junction_zones import Zone
from egvs.scenario import loading
from egvs.scoring import zones
from tests.creation.new_scenarios import create_scenario

SMALL = Path(__file__).parent / "data" / "small.osm"
ROUNDABOUT = Path(__file__).parents[2] / "scenarios" / "roundabout" / "network.net.xml"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[Zone, ...]]:
    folder = tmp_path_factory.mktemp("zones") / "made"
    return folder, create_scenario(folder, SMALL, walk=True).region.zones


@pytest.mark.slow
def test_crossroads_has_a_zone_of_each_kind_on_each_side(made: tuple[Path, tuple[Zone, ...]]) -> None:
    names = {zone.name for zone in made[1]}
    for side, street in (("north", "North"), ("east", "East"), ("south", "North"), ("west", "East")):
        assert f"{street} Street ({side}) crosswalk" in names
        assert f"{side} sidewalk" in names
        assert f"{street} Street ({side}) stop line" in names
        assert f"{street} Street ({side}) approach" in names
    assert "conflict area" in names
    assert len(names) == len(made[1])


@pytest.mark.slow
def test_zones_lie_where_their_names_say(made: tuple[Path, tuple[Zone, ...]]) -> None:
    """One lane of 3.2 m leads in from each side, so a stop line has 32 m2."""
    area = {zone.name: zone.area for zone in made[1]}
    middle = area["conflict area"].centroid
    assert area["North Street (north) crosswalk"].centroid.y > middle.y + 3
    assert area["East Street (west) crosswalk"].centroid.x < middle.x - 3
    stop = area["East Street (west) stop line"]
    assert stop.area == pytest.approx(32.0, abs=0.1)
    assert stop.centroid.x < area["East Street (west) crosswalk"].centroid.x  # vehicles wait before the crosswalk
    assert stop.difference(area["East Street (west) approach"].buffer(0.02)).is_empty
    assert area["conflict area"].intersection(stop).area < 0.5


def test_zones_stay_in_the_region(made: tuple[Path, tuple[Zone, ...]]) -> None:
    (west, south), (east, north) = zones.region_bounds_m(loading.load(made[0]))
    region = shapely.box(west, south, east, north).buffer(0.02)
    assert all(region.covers(zone.area) for zone in made[1])
    assert all(zone.area.is_valid for zone in made[1])


def test_file_of_the_scenario_has_the_zones(made: tuple[Path, tuple[Zone, ...]]) -> None:
    areas = zones.reported_zones(loading.load(made[0]))
    assert list(areas) == [zone.name for zone in made[1]]
    for zone in made[1]:
        assert areas[zone.name].symmetric_difference(zone.area).area < 0.05
    document = json.loads((made[0] / "zones.geojson").read_text())
    assert document["features"][0]["properties"] == {"name": "conflict area", "kind": "conflict area"}


@pytest.mark.slow
def test_roundabout_has_its_ring_as_conflict_area(tmp_path: Path) -> None:
    made = create_scenario(tmp_path / "made", ROUNDABOUT)
    area = {zone.name: zone.area for zone in made.region.zones}
    assert made.junction.ring is not None
    assert area["conflict area"].buffer(1.0).covers(shapely.Point(made.junction.at_m)) is False  # the island
    assert shapely.convex_hull(area["conflict area"]).covers(shapely.Point(made.junction.at_m))
    assert sum(zone.kind == "stop line" for zone in made.region.zones) == 4


def test_equal_names_are_numbered() -> None:
    box = shapely.box(0, 0, 1, 1)
    named = junction_zones._with_distinct_names([Zone("a", "k", box), Zone("a", "k", box), Zone("b", "k", box)])
    assert [zone.name for zone in named] == ["a", "a 2", "b"]
