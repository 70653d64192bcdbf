"""Which recorded light governs which road, from how recorded road users move."""

from __future__ import annotations

import numpy as np
import pytest

from egvs.extensions.tracks.new.signal_assignment import (
    Approach,
    Crossing,
    RecordedMotion,
    RecordedPeople,
    green_share,
    guess_lights,
)
from egvs.extensions.tracks.new.signals import SignalRecord


def record(green_from_s: float, green_to_s: float) -> SignalRecord:
    """Return ten cycles of 40 s with one green, no yellow."""
    starts_s, states = [0.0], ["r"]
    for cycle in range(10):
        starts_s += [40.0 * cycle + green_from_s, 40.0 * cycle + green_to_s]
        states += ["G", "r"]
    return SignalRecord(np.array(starts_s), tuple(states), 400.0)


LIGHTS = {"a": record(5.0, 15.0), "b": record(25.0, 35.0), "c": record(5.0, 15.0), "pedestrian d": record(1.0, 39.0)}
"""Light c always shows what a shows."""

WEST, EAST, SOUTH, NORTH = (
    Approach("from_west", np.array([(-10.0, -2.0), (-10.0, 2.0)]), 0.0),
    Approach("from_east", np.array([(10.0, 2.0), (10.0, -2.0)]), np.pi),
    Approach("from_south", np.array([(2.0, -10.0), (-2.0, -10.0)]), np.pi / 2),
    Approach("from_north", np.array([(-2.0, 10.0), (2.0, 10.0)]), -np.pi / 2),
)


def crossings(start: str, target: str, *times_s: float) -> tuple[Crossing, ...]:
    return tuple(Crossing(start, target, time_s) for time_s in times_s)


def test_vehicles_drive_in_the_green_of_their_light() -> None:
    """Five vehicles pass at 6 s of a cycle, in a's green; one of six passes on red; the opposite road has none."""
    motion = RecordedMotion(crossings("from_west", "x", *(40.0 * k + 6.0 for k in range(5)), 20.0))
    guesses = guess_lights([WEST, EAST], LIGHTS, motion)
    assert [(guess.from_edge, guess.to_edge, guess.light) for guess in guesses] == [
        ("from_west", "x", "a"), ("from_west", "", "a"), ("from_east", "", "a"),
    ]  # fmt: skip
    assert guesses[0].reason == "83 % of 6 vehicles pass in its green or yellow; next light 0 %"
    assert green_share({("from_west", "x"): "a"}, LIGHTS, motion) == (5, 6)
    assert green_share({("from_west", "other"): "a"}, LIGHTS, motion) == (0, 0)


def test_turns_with_a_light_of_their_own() -> None:
    """Left turns go in b's green, straight ones in a's; together neither light has enough."""
    straight = crossings("from_west", "x", *(40.0 * k + 6.0 for k in range(5)))
    left = crossings("from_west", "y", *(40.0 * k + 30.0 for k in range(5)))
    guesses = guess_lights([WEST], LIGHTS, RecordedMotion(straight + left))
    assert {(guess.to_edge, guess.light) for guess in guesses} == {("x", "a"), ("y", "b")}


def test_shortest_green_of_equal_shares() -> None:
    """All vehicles pass in the green of both; the long green proves less."""
    lights = {"long": record(2.0, 38.0), "short": record(5.0, 15.0)}
    motion = RecordedMotion(crossings("from_west", "x", *(40.0 * k + 6.0 for k in range(5))))
    assert {guess.light for guess in guess_lights([WEST], lights, motion)} == {"short"}


@pytest.mark.parametrize("times_s", [(6.0, 46.0, 86.0, 126.0), (6.0, 46.0, 86.0, 20.0, 22.0, 60.0)])
def test_few_or_contradicting_vehicles_decide_nothing(times_s: tuple[float, ...]) -> None:
    assert guess_lights([WEST], LIGHTS, RecordedMotion(crossings("from_west", "x", *times_s))) == []


def test_one_light_decides_nothing() -> None:
    motion = RecordedMotion(crossings("from_west", "x", *(40.0 * k + 6.0 for k in range(5))))
    assert guess_lights([WEST], {"a": LIGHTS["a"], "c": LIGHTS["c"]}, motion) == []


def walkers(*groups: tuple[int, float, tuple[float, float]]) -> RecordedPeople:
    """Return people who each stand for 1 s at a place: how many, when in the cycle, and where; one in each cycle."""
    track, time_s, xy_m = [], [], []
    for count, at_s, location_m in groups:
        for _ in range(count):
            track += [len(set(track))] * 10
            time_s += [40.0 * (track[-1] % 10) + at_s + 0.1 * step for step in range(10)]
            xy_m += [location_m] * 10
    return RecordedPeople(np.array(track), np.array(time_s), np.array(xy_m))


def test_people_cross_in_the_green_of_others() -> None:
    """Nine cross the west arm in b's green, three in a's; so a governs west and east, b the others: 75 %."""
    people = walkers((9, 28.0, (-8.0, -1.0)), (3, 8.0, (-8.0, -1.0)), (5, 20.0, (-8.0, -1.0)), (5, 8.0, (-30.0, 0.0)))
    guesses = guess_lights([WEST, EAST, SOUTH, NORTH], LIGHTS, RecordedMotion(people=people))
    assert {guess.from_edge: guess.light for guess in guesses} == {
        "from_west": "a", "from_east": "a", "from_south": "b", "from_north": "b",
    }  # fmt: skip
    assert guesses[0].reason.startswith("75 % of the time that 12 people walked on lanes")


@pytest.mark.parametrize("others", [2, 8])
def test_few_or_undecided_people_decide_nothing(others: int) -> None:
    people = walkers((7, 28.0, (-8.0, -1.0)), (others, 8.0, (-8.0, -1.0)))
    assert guess_lights([WEST, EAST, SOUTH, NORTH], LIGHTS, RecordedMotion(people=people)) == []


def test_people_do_not_decide_three_roads_in_two_axes_of_three_lights() -> None:
    people = walkers((12, 28.0, (-8.0, -1.0)))
    lights = {**LIGHTS, "e": record(16.0, 20.0)}
    assert guess_lights([WEST, EAST, SOUTH], lights, RecordedMotion(people=people)) == []
