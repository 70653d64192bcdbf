"""The places of a network in words: a made-up junction by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egvs.scoring.road_locations import RoadLocation, RoadLocations, describe_lane, describe_turn, disambiguate
from egvs.traffic.directions import compass
from tests.scoring.roads import GRID, NETWORK, read


def words_of_lanes(places: RoadLocations) -> dict[tuple[float, ...], list[str]]:
    """What the lane that starts somewhere is called."""
    return {
        tuple(lane.points_m[0].tolist()): [places.locations[i].words for i in its]
        for lane, its in zip(places.lanes, places.locations_of_lane, strict=True)
    }


def test_lanes_of_an_approach_are_called_by_where_they_lead(tmp_path: Path) -> None:
    said = words_of_lanes(RoadLocations.of(read(tmp_path), GRID.roi))
    assert said[15.1, -4.8] == ["High Street (west), straight lane", "High Street (west) approach"]
    assert said[15.1, -1.6] == ["High Street (west), left-turn lane", "High Street (west) approach"]


def test_a_road_that_is_cut_in_two_is_one_approach(tmp_path: Path) -> None:
    said = words_of_lanes(RoadLocations.of(read(tmp_path), GRID.roi))
    far = ["High Street (west), left-and-straight lane further back", "High Street (west) approach"]
    assert said[-15.0, -4.8] == said[15.0, -4.8] == far  # and what lies between the pieces belongs to the first


def test_roads_that_leave_the_region_are_exits_and_others_pass(tmp_path: Path) -> None:
    said = words_of_lanes(RoadLocations.of(read(tmp_path), GRID.roi))
    assert said[36.0, -4.8] == ["High Street (east), exit lane", "High Street (east) exit"]
    assert said[35.0, 4.0] == ["north, exit lane", "north exit"]
    assert said[120.0, 1.6] == ["High Street (westbound road), lane", "High Street (westbound road)"]


def test_in_the_junction_the_approach_and_the_turn_are_named_to_its_end(tmp_path: Path) -> None:
    said = words_of_lanes(RoadLocations.of(read(tmp_path), GRID.roi))
    assert said[30.0, -4.8] == ["High Street (west), straight movement through the junction"]
    assert said[30.0, -1.6] == said[33.0, -1.0] == ["High Street (west), left turn in the junction"]


def test_crossings_and_sidewalks_are_not_lanes(tmp_path: Path) -> None:
    found = RoadLocations.of(read(tmp_path), GRID.roi)
    ((strip, place),) = found.crossings
    assert found.locations[place].words == "east crosswalk"
    assert (strip.width_m, found.locations[place].at_m) == (4.0, (38.0, -3.5))
    assert len(found.lanes) == 11 and not any(place.name in ("near_0", ":j_w0_0") for place in found.locations)


def test_lanes_that_lead_the_same_way_are_counted_from_the_kerb(tmp_path: Path) -> None:
    text = NETWORK.replace('dir="l"', 'dir="s"')
    said = words_of_lanes(RoadLocations.of(read(tmp_path, text), GRID.roi))
    assert said[15.1, -4.8][0] == "High Street (west), straight lane 1 of 2 from the kerb"
    assert said[15.1, -1.6][0] == "High Street (west), straight lane 2 of 2 from the kerb"


def test_a_road_round_in_circles_ends(tmp_path: Path) -> None:
    text = """<net version="1.20">
    <edge id="a" from="x" to="y"><lane id="a_0" index="0" length="9" shape="10,0 20,0"/></edge>
    <edge id="b" from="y" to="x"><lane id="b_0" index="0" length="9" shape="20,0 20,5 10,5 10,0"/></edge>
    <connection from="a" to="b" fromLane="0" toLane="0" dir="s" state="M"/>
    <connection from="b" to="a" fromLane="0" toLane="0" dir="s" state="M"/>
</net>
"""
    assert len(RoadLocations.of(read(tmp_path, text), GRID.roi).lanes) == 2


@pytest.mark.parametrize(
    ("turns", "words"),
    [
        ((), "lane"),
        (("straight",), "straight lane"),
        (("left",), "left-turn lane"),
        (("straight", "left"), "left-and-straight lane"),
        (("right", "straight"), "straight-and-right lane"),
        (("left", "right", "straight"), "lane for all directions"),
        (("U-turn",), "U-turn lane"),
        (("U-turn", "right"), "right-turn lane"),
    ],
)
def test_lanes_in_words(turns: tuple[str, ...], words: str) -> None:
    assert describe_lane(turns) == words


def test_turns_in_words() -> None:
    assert [describe_turn(turn) for turn in ("left", "straight", "U-turn", "")] == [
        "left turn in the junction",
        "straight movement through the junction",
        "U-turn in the junction",
        "movement through the junction",
    ]


def test_the_compass_has_eight_points() -> None:
    angles = np.radians([0, 22, 23, 90, 180, -179, 225, 270, 315, 337.6])
    points = [compass(np.array([np.cos(a), np.sin(a)])) for a in angles]
    assert points == [
        "east", "east", "north-east", "north", "west", "west", "south-west", "south", "south-east", "east",
    ]  # fmt: skip


def test_equal_descriptions_are_made_distinct_by_compass_point_or_name() -> None:
    places = [
        RoadLocation("lane", name, "lane", at) for name, at in (("a", (1.2, 2.0)), ("b", (1.3, 2.0)), ("c", (9.0, 2.0)))
    ]
    assert [place.words for place in disambiguate([*places, RoadLocation("exit", "d", "exit", (0.0, 0.0))])] == [
        "lane (near x = 1 m, y = 2 m) (a)",
        "lane (near x = 1 m, y = 2 m) (b)",
        "lane (near x = 9 m, y = 2 m)",
        "exit",
    ]
