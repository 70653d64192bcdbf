"""Which lane a vehicle drives on: by hand, and against shapely, lane by lane."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from egvs.scoring.road_locations import SAME_WAY_RAD, MiddleLine, fronts_m, match_lanes


def line(*points, width_m=3.2) -> MiddleLine:
    return MiddleLine(np.array(points, dtype=np.float64), width_m)


EAST, EAST_TOO, WEST = line((0, 0), (50, 0)), line((0, 3.2), (50, 3.2)), line((50, 6.4), (0, 6.4))


def test_the_front_is_half_a_length_ahead():
    boxes = np.array([(10, 5, 1, 4, 2, 1.5, 0), (10, 5, 1, 4, 2, 1.5, math.pi / 2), (0, 0, 1, 2, 1, 1, math.pi)])
    np.testing.assert_allclose(fronts_m(boxes), [(12, 5), (10, 7), (-1, 0)], atol=1e-12)


def test_a_vehicle_is_on_the_lane_whose_middle_is_nearest():
    lanes = [EAST, EAST_TOO, WEST]
    at = np.array([(10, 0.3), (10, 2.9), (10, 1.59), (10, 1.61), (10, -1.5), (10, -1.7)])
    assert match_lanes(at, np.zeros(6), lanes).tolist() == [0, 1, 0, 1, 0, -1]


def test_it_leads_the_same_way():
    at = np.full((4, 2), (10.0, 6.4))
    yaw = np.array([math.pi, -math.pi, math.pi - 0.9 * SAME_WAY_RAD, 0.0])
    assert match_lanes(at, yaw, [EAST, EAST_TOO, WEST]).tolist() == [2, 2, 2, -1]


def test_heading_decides_where_roads_cross():
    lanes = [line((0, 0), (10, 0)), line((5, -5), (5, 5))]
    assert match_lanes(np.full((2, 2), (5.0, 0.0)), np.array([0.1, math.pi / 2]), lanes).tolist() == [0, 1]


def test_of_two_that_are_as_near_it_is_the_first():
    assert match_lanes(np.array([[3.0, 0.0]]), np.zeros(1), [EAST, EAST]).tolist() == [0]


def test_a_point_that_comes_twice_in_a_line_has_no_heading():
    assert match_lanes(np.array([[5.0, 1.0]]), np.zeros(1), [line((0, 0), (5, 0), (5, 0), (10, 0))]).tolist() == [0]


def test_round_the_outside_of_a_bend_either_piece_leads_the_way():
    bend = line((0, 0), (10, 0), (10, 10))
    at, yaw = np.full((3, 2), (10.5, -0.5)), np.array([0.0, math.pi / 2, math.pi])
    assert match_lanes(at, yaw, [bend]).tolist() == [0, 0, -1]


def test_no_vehicles_and_no_lanes():
    assert match_lanes(np.empty((0, 2)), np.empty(0), [EAST]).shape == (0,)
    assert match_lanes(np.array([[1.0, 0.0]]), np.zeros(1), []).tolist() == [-1]


def slowly(at, yaw, lanes):
    """Every vehicle against every lane, with shapely's distances."""
    best, least = -1, math.inf
    for number, lane in enumerate(lanes):
        whole = shapely.LineString(lane.points_m)
        distance = whole.distance(shapely.Point(at))
        pieces = [shapely.LineString(pair) for pair in zip(lane.points_m[:-1], lane.points_m[1:], strict=True)]
        near = [piece.coords for piece in pieces if piece.distance(shapely.Point(at)) <= distance + 1e-6]
        headings = [math.atan2(y1 - y0, x1 - x0) for (x0, y0), (x1, y1) in near]
        turned = min(abs(math.remainder(yaw - heading, 2 * math.pi)) for heading in headings)
        if distance <= lane.width_m / 2 and turned <= SAME_WAY_RAD and distance < least - 1e-9:
            best, least = number, distance
    return best


@pytest.mark.slow
@given(st.integers(0, 10_000))
def test_against_shapely(seed):
    rng = np.random.default_rng(seed)
    lanes = [
        MiddleLine(np.cumsum(rng.uniform(-6, 12, (rng.integers(2, 6), 2)), axis=0), rng.uniform(2, 4)) for _ in range(6)
    ]
    at, yaw = rng.uniform(-5, 25, (40, 2)), rng.uniform(-7, 7, 40)
    assert match_lanes(at, yaw, lanes).tolist() == [slowly(*one, lanes) for one in zip(at, yaw, strict=True)]


def test_lane_without_length_has_no_direction_and_no_vehicles() -> None:
    """Roads that meet in one point: SUMO's lane inside the junction has the same point twice."""
    point = line((5, 0), (5, 0))
    assert match_lanes(np.array([[5.0, 0.0]]), np.zeros(1), [point, EAST]).tolist() == [1]
    assert match_lanes(np.array([[5.0, 0.0]]), np.zeros(1), [point]).tolist() == [-1]
