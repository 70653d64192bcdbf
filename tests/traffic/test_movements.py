"""Movements of a network in words: a made-up junction by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

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
    assert words == "High Street (west) from Side Street, left to an unnamed street"
