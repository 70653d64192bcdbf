"""Boxes from front-bumper points."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.artefacts import parquet
from egvs.core.errors import InputError
from egvs.stages import traffic
from egvs.traffic import sumo, vehicle_boxes
from tests.stage_runner import run_stage
from tests.traffic.helpers import SIZES, SMALL, group_of, scenario


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
def test_box_is_half_a_length_behind_the_front_bumper(angle, centre, yaw):
    one = np.ones(1)
    x, y, z = vehicle_boxes.box_centres(0 * one, 10 * one, 0 * one, angle * one, 0 * one, 4 * one, 1.5 * one)
    assert (x[0], y[0], z[0]) == (*centre, 0.75)
    assert not np.signbit([v for v in (x[0], y[0], z[0]) if v == 0]).any()
    assert vehicle_boxes.yaw_from_angle(angle * one)[0] == pytest.approx(yaw, abs=1e-9)


def test_centre_is_below_the_bumper_uphill():
    one = np.ones(1)
    x, y, z = vehicle_boxes.box_centres(0 * one, 0 * one, 100 * one, 90 * one, 30 * one, 4 * one, 2 * one)
    assert (x[0], y[0], z[0]) == pytest.approx((-2 * math.cos(math.pi / 6), 0, 100 - 1 + 1), abs=1e-6)


@given(st.floats(-720, 720))
def test_yaw_is_normalised_and_has_the_direction_of_the_angle(angle):
    yaw = vehicle_boxes.yaw_from_angle(np.array([angle]))[0]
    assert -math.pi < yaw <= math.pi
    assert math.cos(yaw) == pytest.approx(math.sin(math.radians(angle)), abs=2e-9)
    assert math.sin(yaw) == pytest.approx(math.cos(math.radians(angle)), abs=2e-9)


def test_boxes_are_sorted_and_have_the_size_of_their_type():
    rows = [
        (0, "b", "car", 0, 0, 0, 1),
        (0, "a10", "bus", 9, 0, 0, 1),
        (0, "a9", "car", 20, 0, 0, 1),
        (1, "b", "car", 0, 1, 0, 1),
    ]
    result = vehicle_boxes.boxes_from_bumpers(group_of(rows), SIZES, 1.0, "place")
    columns = result.columns()
    assert columns["vehicle"].to_pylist() == ["a10", "a9", "b", "b"]
    assert columns["kind"].to_pylist() == ["bus", "passenger", "passenger", "passenger"]
    assert result.length_m.tolist() == [12, 4, 4, 4]
    assert result.height_m.tolist() == [3, 1.5, 1.5, 1.5]
    assert result.z_m.tolist() == [1.5, 0.75, 0.75, 0.75]


def test_rejects_type_without_size():
    with pytest.raises(InputError, match=r"the size of vehicle type 'tram' is unknown.*known: bus, car"):
        vehicle_boxes.boxes_from_bumpers(group_of([(0, "v", "tram", 0, 0, 0, 1)]), SIZES, 1.0, "place")


@pytest.mark.parametrize("width_m", [1e-300, 1e6, float("inf"), float("nan")])
def test_rejects_implausible_size(width_m):
    sizes = {"car": dataclasses.replace(SIZES["car"], width_m=width_m)}
    with pytest.raises(
        InputError, match=r"place: vehicle type 'car' has width_m = .*at least 0.001 m and at most 2000 m"
    ):
        vehicle_boxes.boxes_from_bumpers(group_of([(0, "v", "car", 0, 0, 0, 1)]), sizes, 1.0, "place")


def test_rejects_vehicle_twice_in_a_frame():
    with pytest.raises(InputError, match="vehicle 'v' occurs twice in frame 3"):
        vehicle_boxes.boxes_from_bumpers(group_of([(3, "v", "car", 0, 0, 0, 1)] * 2), SIZES, 1.0, "place")


def test_missing_speed_is_computed_from_positions():
    nan = float("nan")
    rows = [
        (0, "v", "car", 0, 0, 0, nan),
        (1, "v", "car", 0, 3, 0, nan),
        (2, "v", "car", 0, 4, 0, nan),
        (2, "w", "car", 9, 9, 0, nan),
    ]
    result = vehicle_boxes.boxes_from_bumpers(group_of(rows), SIZES, 0.5, "place")
    assert result.speed_m_s[:3].tolist() == [6, 2, 2]
    assert np.isnan(result.speed_m_s[3])


NODES = """<nodes><node id="a" x="0" y="0" z="0"/><node id="b" x="400" y="0" z="40"/>
<node id="c" x="800" y="0" z="40"/></nodes>"""


EDGES = """<edges><edge id="ab" from="a" to="b" numLanes="2"/><edge id="bc" from="b" to="c" numLanes="2"/></edges>"""


@pytest.mark.slow
def test_boxes_on_a_slope_are_pitched_and_on_the_road(tmp_path):
    (tmp_path / "n.nod.xml").write_text(NODES)
    (tmp_path / "e.edg.xml").write_text(EDGES)
    sumo.run_program("netconvert", ["-n", "n.nod.xml", "-e", "e.edg.xml", "-o", "hill.net.xml"], tmp_path)
    keys = SMALL | {"network": "hill.net.xml", "vehicles": 8, "frames": 120, "hold": "at_most"}
    run_stage(traffic, scenario(tmp_path, **keys), tmp_path / "out")
    table, _ = parquet.read_artefact(tmp_path / "out" / "trajectories.parquet", "trajectories")
    uphill = [r for r in table.to_pylist() if 20 < r["x_m"] < 380]
    assert len(uphill) > 50
    for r in uphill:
        assert r["pitch_rad"] == pytest.approx(math.atan(0.1), abs=1e-3)
        assert r["z_m"] - r["height_m"] / 2 == pytest.approx(0.1 * r["x_m"], abs=0.05)
        assert r["yaw_rad"] == pytest.approx(0, abs=1e-2)
