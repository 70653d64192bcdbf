"""Does every box lie where SUMO's vehicle is, with its type's size?"""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.core.errors import InputError
from egvs.traffic import vehicle_boxes
from tests.traffic.helpers import SIZES, group_of


@pytest.mark.parametrize(
    ("angle", "centre", "yaw"),
    [
        (0, (0, 8), math.pi / 2),
        (90, (-2, 10), 0),
        (180, (0, 12), -math.pi / 2),
        (270, (2, 10), math.pi),
        (360, (0, 8), math.pi / 2),
    ],
    ids=["north", "east", "south", "west", "north again"],
)
def test_box_lies_half_a_length_behind_the_front_bumper(angle, centre, yaw):
    one = np.ones(1)
    x, y, z = vehicle_boxes.box_centres(0 * one, 10 * one, 0 * one, angle * one, 0 * one, 4 * one, 1.5 * one)
    assert (x[0], y[0], z[0]) == (*centre, 0.75)
    assert not np.signbit([v for v in (x[0], y[0], z[0]) if v == 0]).any()
    assert vehicle_boxes.yaw_from_angle(angle * one)[0] == pytest.approx(yaw, abs=1e-9)


def test_uphill_the_centre_is_lower_than_the_bumper():
    one = np.ones(1)
    x, y, z = vehicle_boxes.box_centres(0 * one, 0 * one, 100 * one, 90 * one, 30 * one, 4 * one, 2 * one)
    assert (x[0], y[0], z[0]) == pytest.approx((-2 * math.cos(math.pi / 6), 0, 100 - 1 + 1), abs=1e-6)


@given(st.floats(-720, 720))
def test_yaw_is_in_its_interval_and_points_where_the_angle_points(angle):
    yaw = vehicle_boxes.yaw_from_angle(np.array([angle]))[0]
    assert -math.pi < yaw <= math.pi
    assert math.cos(yaw) == pytest.approx(math.sin(math.radians(angle)), abs=2e-9)
    assert math.sin(yaw) == pytest.approx(math.cos(math.radians(angle)), abs=2e-9)


def test_boxes_are_sorted_by_frame_and_vehicle_and_carry_their_types_size():
    rows = [
        (0, "b", "car", 0, 0, 0, 1),
        (0, "a10", "bus", 9, 0, 0, 1),
        (0, "a9", "car", 20, 0, 0, 1),
        (1, "b", "car", 0, 1, 0, 1),
    ]
    found = vehicle_boxes.boxes_from_bumpers(group_of(rows), SIZES, 1.0, "place")
    columns = found.columns()
    assert columns["vehicle"].to_pylist() == ["a10", "a9", "b", "b"]
    assert columns["kind"].to_pylist() == ["bus", "passenger", "passenger", "passenger"]
    assert found.length_m.tolist() == [12, 4, 4, 4]
    assert found.height_m.tolist() == [3, 1.5, 1.5, 1.5]
    assert found.z_m.tolist() == [1.5, 0.75, 0.75, 0.75]


def test_a_type_without_a_size_is_named():
    with pytest.raises(InputError, match=r"the size of vehicle type 'tram' is unknown.*known: bus, car"):
        vehicle_boxes.boxes_from_bumpers(group_of([(0, "v", "tram", 0, 0, 0, 1)]), SIZES, 1.0, "place")


@pytest.mark.parametrize("width_m", [1e-300, 1e6, float("inf"), float("nan")])
def test_a_size_that_no_vehicle_has_is_named(width_m):
    sizes = {"car": dataclasses.replace(SIZES["car"], width_m=width_m)}
    with pytest.raises(
        InputError, match=r"place: vehicle type 'car' has width_m = .*at least 0.001 m and at most 2000 m"
    ):
        vehicle_boxes.boxes_from_bumpers(group_of([(0, "v", "car", 0, 0, 0, 1)]), sizes, 1.0, "place")


def test_a_vehicle_twice_in_a_frame_is_named():
    with pytest.raises(InputError, match="vehicle 'v' is twice in frame 3"):
        vehicle_boxes.boxes_from_bumpers(group_of([(3, "v", "car", 0, 0, 0, 1)] * 2), SIZES, 1.0, "place")


def test_speed_comes_from_the_way_where_the_file_gives_none():
    nan = float("nan")
    rows = [
        (0, "v", "car", 0, 0, 0, nan),
        (1, "v", "car", 0, 3, 0, nan),
        (2, "v", "car", 0, 4, 0, nan),
        (2, "w", "car", 9, 9, 0, nan),
    ]
    found = vehicle_boxes.boxes_from_bumpers(group_of(rows), SIZES, 0.5, "place")
    assert found.speed_m_s[:3].tolist() == [6, 2, 2]
    assert np.isnan(found.speed_m_s[3])
