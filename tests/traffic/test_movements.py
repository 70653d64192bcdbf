"""Movements of a network in words: a made-up junction by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from egvs.core.errors import InputError
from egvs.scenario.traffic_config import CountConfig
from egvs.traffic.approach_names import ApproachNames
from egvs.traffic.approaches import ApproachIndex
from egvs.traffic.movements import MovementNames
from tests.scoring.roads import NETWORK, read

CENTER_M = (33.0, -2.0)


@pytest.mark.parametrize(
    ("from_edge", "to_edge", "expected"),
    [
        ("near", "out", "High Street (west), straight on"),
        ("near", "up", "High Street (west), left to an unnamed street"),
        ("far", "up", "High Street (west), left to an unnamed street"),
        ("back", "up", "High Street (east), right to an unnamed street"),
        ("near", "back", "High Street (west), U-turn to High Street"),
        ("up", "back", "south, left to High Street"),
        ("back", None, "High Street (east)"),
    ],
)
def test_describes_movement(tmp_path: Path, from_edge: str, to_edge: str | None, expected: str) -> None:
    assert MovementNames(read(tmp_path), CENTER_M).describe(from_edge, to_edge) == expected


def test_turn_of_a_connection_goes_before_the_directions(tmp_path: Path) -> None:
    text = NETWORK.replace(
        'from="near" to="up" fromLane="2" toLane="0" via=":j_1_0" dir="l"',
        'from="near" to="up" fromLane="2" toLane="0" via=":j_1_0" dir="s"',
    )
    assert text != NETWORK
    words = MovementNames(read(tmp_path, text), CENTER_M).describe("near", "up")
    assert words == "High Street (west), straight on to an unnamed street"


def test_street_name_is_one_line_without_double_escapes(tmp_path: Path) -> None:
    text = NETWORK.replace('name="High Street"', 'name="A &amp;amp; B&#10;C&#x7f;"')
    assert MovementNames(read(tmp_path, text), CENTER_M).describe("back", None) == "A & B C (east)"


def test_directions_are_those_at_the_junction(tmp_path: Path) -> None:
    """Vehicles come from the north, turn, and drive 50 m to the east before they reach the junction."""
    text = NETWORK.replace("-15,-4.8 15,-4.8", "-20,60 -20,-4.8").replace('to="p" name="High', 'to="p" name="Side')
    for y_m in ("-8", "-4.8", "-1.6"):
        text = text.replace(f'shape="15,{y_m} 30', f'shape="-20,{y_m} 30').replace(
            f'shape="15.1,{y_m} 30', f'shape="-20,{y_m} 30'
        )
    words = MovementNames(read(tmp_path, text), CENTER_M).describe("far", "up")
    assert words == "High Street (west), left to an unnamed street"


SLIP_LANE = """<net version="1.20">
    <edge id="in" from="w" to="f"><lane id="in_0" index="0" length="100" shape="-120,0 -20,0"/></edge>
    <edge id="main" from="f" to="j"><lane id="main_0" index="0" length="18" shape="-20,0 -2,0"/></edge>
    <edge id="slip" from="f" to="m"><lane id="slip_0" index="0" length="25" shape="-20,0 0,-15"/></edge>
    <edge id="down" from="j" to="m"><lane id="down_0" index="0" length="18" shape="0,-2 0,-15"/></edge>
    <edge id="east" from="j" to="e"><lane id="east_0" index="0" length="100" shape="2,0 100,0"/></edge>
    <edge id="south" from="m" to="s"><lane id="south_0" index="0" length="80" shape="0,-15 0,-100"/></edge>
    <junction id="f" type="priority" x="-20" y="0" incLanes="" intLanes="" shape="-20,-1 -20,1"/>
    <junction id="j" type="traffic_light" x="0" y="0" incLanes="" intLanes="" shape="-2,-2 2,-2 2,2 -2,2"/>
    <junction id="m" type="priority" x="0" y="-15" incLanes="" intLanes="" shape="-1,-15 1,-15"/>
    <connection from="in" to="main" fromLane="0" toLane="0" dir="s" state="M"/>
    <connection from="in" to="slip" fromLane="0" toLane="0" dir="r" state="M"/>
    <connection from="main" to="east" fromLane="0" toLane="0" dir="s" state="M"/>
    <connection from="slip" to="south" fromLane="0" toLane="0" dir="s" state="M"/>
    <connection from="down" to="south" fromLane="0" toLane="0" dir="s" state="M"/>
</net>
"""
"""A lane for right turns beside the signals: it leaves the approach from the west 20 m before them."""

SLIP_FLOWS = (
    CountConfig(from_edge="in", to_edge="south", per_hour=60.0),
    CountConfig(from_edge="in", to_edge="east", per_hour=40.0),
)


def test_right_turns_on_a_slip_lane_have_the_approach_of_their_edge(tmp_path: Path) -> None:
    """All movements of an edge lie on the side that zones and signals name, that of the edge to the signals."""
    roads = read(tmp_path, SLIP_LANE)
    names = MovementNames(roads, (0.0, 0.0), SLIP_FLOWS)
    assert [names.describe("in", to) for to in ("south", "east")] == [
        "west, right to an unnamed street",
        "west, straight on",
    ]
    assert ApproachNames(roads).approach("main") == "west"
    index = ApproachIndex.of_flows(SLIP_FLOWS, names)
    assert index.titles == ["west"]
    (right,) = index.find("", "west", ["right"], "counts.csv")
    assert right.flow is SLIP_FLOWS[0]
    alone = MovementNames(roads, (0.0, 0.0), SLIP_FLOWS[:1])
    assert alone.describe("in", "south") == "north-west, straight on"  # nothing else is known of its edge


def test_one_approach_has_one_name_and_aliases(tmp_path: Path) -> None:
    """The name of a side street is another name of the approach, and a count without a turn is of all its turns."""
    text = SLIP_LANE.replace('id="slip" from="f" to="m"', 'id="slip" from="f" to="m" name="Mill Lane"')
    text = text.replace('id="in" from="w" to="f"', 'id="in" from="w" to="f" name="Back Lane"')
    text = text.replace('id="main" from="f" to="j"', 'id="main" from="f" to="j" name="High Street"')
    names = MovementNames(read(tmp_path, text), (0.0, 0.0), SLIP_FLOWS)
    assert names.describe("in", "south") == "High Street (west), right to an unnamed street"
    assert names.describe("in", None) == "High Street (west)"
    index = ApproachIndex.of_flows(SLIP_FLOWS, names)
    assert index.titles == ["High Street (west)"]
    for street in ("High Street", "Mill Ln", "back lane", "Back Lane (west)"):
        moves = index.find(street, "west", [], "counts.csv")
        assert [move.flow.per_hour for move in moves] == [60.0, 40.0]
    assert index.parse_approach("Back Lane (west)", "counts.csv") == ("High Street", "west")
    with pytest.raises(InputError, match=r"no approach of the junction is called 'Ring'. The approaches are: High"):
        index.find("Ring", "west", [], "counts.csv")
