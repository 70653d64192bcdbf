"""Matching of recorded vehicles to lanes."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from egvs.extensions.tracks import matching as track_matching
from egvs.extensions.tracks.matching import BREAK_COST, MatchedTracks, match_tracks
from tests.extensions.tracks.drives import LEFT, PERIOD_S, Drive, boxes_of, constant
from tests.traffic.crossing import read_network


def match(folder: Path, *drives: Drive) -> MatchedTracks:
    return match_tracks(boxes_of(drives), PERIOD_S, read_network(folder))


def edges(matched: MatchedTracks) -> list[str]:
    return [matched.lanes[number].edge for number in dict.fromkeys(matched.lane.tolist()) if number >= 0]


def test_lanes_lead_to_each_other(tmp_path: Path) -> None:
    lanes, following = track_matching.driven_lanes(read_network(tmp_path))
    after = {
        lane.edge: {lanes[number].edge for number in numbers} for lane, numbers in zip(lanes, following, strict=True)
    }
    assert after == {
        "in": {":c_0", ":c_1"}, ":c_0": {"out"}, ":c_1": {":c_2"}, ":c_2": {"north"}, "out": set(), "north": set(),
    }  # fmt: skip
    assert {(lane.source, lane.target, lane.turn) for lane in lanes if lane.is_inside} == {
        ("in", "out", "s"), ("in", "north", "l"),
    }  # fmt: skip


def test_vehicle_that_drives_straight_on(tmp_path: Path) -> None:
    matched = match(tmp_path, Drive(constant(10.0), 0.0, 22.0))
    assert edges(matched) == ["in", ":c_0", "out"]
    # after 10.5 s it is 105 m from its start, 5 m past the stop line
    row = int(np.flatnonzero(matched.time_s == 10.5)[0])
    assert matched.lanes[matched.lane[row]].edge == ":c_0"
    assert matched.at_m[row] == pytest.approx(5.0)
    assert matched.speed_m_s == pytest.approx(np.full(matched.time_s.size, 10.0))


def test_end_of_path_distinguishes_left_turn_from_straight_on(tmp_path: Path) -> None:
    """Both lanes begin with the same ten metres, in which only the rest of the way tells them apart."""
    matched = match(tmp_path, Drive(constant(4.0), 0.0, 54.0, LEFT))
    assert edges(matched) == ["in", ":c_1", ":c_2", "north"]


def test_vehicle_beside_the_lane_is_matched_and_one_far_away_is_not(tmp_path: Path) -> None:
    near = match(tmp_path, Drive(constant(10.0), 0.0, 8.0, ((-110.0, 2.0), (110.0, 2.0))))
    far = match(tmp_path, Drive(constant(10.0), 0.0, 8.0, ((-110.0, 6.0), (110.0, 6.0))))
    assert edges(near) == ["in"]
    assert (far.lane == -1).all()
    assert np.isnan(far.at_m).all()


def test_vehicle_in_the_other_direction_is_not_matched(tmp_path: Path) -> None:
    matched = match(tmp_path, Drive(constant(10.0), 0.0, 8.0, ((110.0, 0.0), (-110.0, 0.0))))
    assert (matched.lane == -1).all()


@pytest.mark.parametrize("seed", range(20))
def test_path_is_the_cheapest_of_all(seed: int) -> None:
    """An independent search through all sequences of lanes."""
    rng = np.random.default_rng(seed)
    costs = rng.choice([0.0, 2.0, BREAK_COST], size=(4, 4))
    steps = []
    for row in range(5):
        lanes = rng.choice(4, size=rng.integers(1, 4), replace=False)
        steps.append((row, lanes, rng.uniform(0.0, 8.0, lanes.size), np.zeros(lanes.size)))

    def cost(choice: tuple[int, ...]) -> float:
        near = sum(step[2][index] for step, index in zip(steps, choice, strict=True))
        lanes = [int(step[1][index]) for step, index in zip(steps, choice, strict=True)]
        return float(near + sum(costs[before, after] for before, after in itertools.pairwise(lanes)))

    cheapest = min(itertools.product(*(range(step[1].size) for step in steps)), key=cost)
    path = list(track_matching._most_likely_path(steps, costs))
    assert [lane for _, lane, _ in path] == [int(s[1][i]) for s, i in zip(steps, cheapest, strict=True)]
