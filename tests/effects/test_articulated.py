"""Articulated vehicles, on finished FCD files."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.effects import articulated
from egvs.effects.articulated import Articulated
from egvs.scenario.effects_config import ArticulatedParameters
from egvs.stages import traffic
from egvs.traffic import trajectories
from egvs.traffic.vehicle_boxes import VehicleSize
from tests.effects.road_helpers import GRADE, KINDS, read_rows, road_scenario, run_and_read
from tests.stage_runner import run_stage


def finished_scenario(folder, poses, effects, period_s=0.25, **keys):
    """A scenario of a finished file with one bendy bus at (x, y, angle in degrees) in each frame, None where it is
    missing."""
    folder.mkdir(exist_ok=True)
    head = (
        "timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type;vehicle_speed;vehicle_slope;vehicle_z"
    )
    lines = [f"{i * period_s:.3f};car;-900;{i};0;car;1;0;0" for i in range(len(poses))]
    for i, pose in enumerate(poses):
        if pose is not None:
            x, y, angle, *slope_z = pose
            tail = ";".join(str(v) for v in slope_z or (0, 0))
            lines[i] += f"\n{i * period_s:.3f};v;{x:.9f};{y:.9f};{angle:.9f};bendy;5;{tail}"
    (folder / "f.csv").write_text("\n".join([head, *lines, ""]))
    metadata = {"fcd": "f.csv", "frames": len(poses), "frame_period_s": period_s, "warmup_s": 0, "kinds": KINDS}
    return road_scenario(folder, effects, **(metadata | keys))


def bus_rows(out, part):
    r = read_rows(out)
    mine = (r["vehicle"] == "v") & (r["part"] == part)
    return {name: values[mine] for name, values in r.items()}


PARTS = {"articulated": {"kinds": {"bendy": {"parts_m": [10.6, 7.5], "axles_m": [5.0]}}}}


@pytest.mark.parametrize("angle", [0, 90, 180, 270, 53.130102354])
def test_parts_are_in_line_on_a_straight_road(tmp_path, angle):
    way = np.array([math.sin(math.radians(angle)), math.cos(math.radians(angle))])
    poses = [(*(way * 1.3 * i), angle) for i in range(60)]
    run_stage(traffic, finished_scenario(tmp_path, poses, PARTS), tmp_path / "out")
    front, rear = bus_rows(tmp_path / "out", 0), bus_rows(tmp_path / "out", 1)
    assert np.abs(rear["yaw_rad"] - front["yaw_rad"]).max() < 2e-9
    assert set(front["length_m"]) == {10.6} and set(rear["length_m"]) == {7.5}
    ends = np.array([[p[0], p[1]] for p in poses])
    for part, middle in ((front, 5.3), (rear, 18.75 - 3.75)):
        assert np.column_stack([part["x_m"], part["y_m"]]) == pytest.approx(ends - middle * way, abs=2e-6)


@pytest.mark.parametrize("turn", [1, -1], ids=["left", "right"])
def test_rear_part_settles_at_the_analytic_angle_on_a_circle(tmp_path, turn):
    """The front part is fixed to the circle, so that its joint runs on a circle too: hand-checkable."""
    radius, step = 15.0, 0.06
    poses = []
    for i in range(400):
        phi = turn * step * i
        poses.append(
            (
                radius * math.cos(phi),
                radius * math.sin(phi),
                math.degrees(-phi) if turn > 0 else 180 - math.degrees(phi),
            )
        )
    run_stage(traffic, finished_scenario(tmp_path, poses, PARTS), tmp_path / "out")
    front, rear = bus_rows(tmp_path / "out", 0), bus_rows(tmp_path / "out", 1)
    hinge = 10.6 + 0.65 / 2
    # the joint lies on the tangent behind the bumper; its own direction is turned against the front's heading by
    # atan(hinge / R)
    joint_radius = math.hypot(radius, hinge)
    expected = math.asin(5.0 / joint_radius) + math.atan(hinge / radius)
    angle = np.angle(np.exp(1j * (front["yaw_rad"] - rear["yaw_rad"])))
    assert angle[0] == 0
    assert turn * angle[-50:] == pytest.approx(expected, abs=1e-4)


@pytest.mark.slow
@given(st.floats(-3.1, 3.1), st.floats(-3, 3), st.floats(0.01, 5), st.floats(0.5, 12))
def test_analytic_step_agrees_with_many_small_steps(heading, direction, way, axle):
    """The closed form against a plain integration of d theta = sin(psi - theta) ds / d (Heun, 4000 steps)."""
    theta, n = heading, 4000
    for _ in range(n):
        slope_1 = math.sin(direction - theta) / axle
        slope_2 = math.sin(direction - theta - slope_1 * way / n) / axle
        theta += (slope_1 + slope_2) / 2 * way / n
    result = articulated.follow(heading, way * math.cos(direction), way * math.sin(direction), 0.0, axle)
    assert abs(math.remainder(result - theta, math.tau)) < 1e-4


def test_frame_period_changes_little_on_an_arc():
    one = articulated.follow(
        0.0, 2 * math.sin(0.2) * 10 * math.cos(0.2), 2 * math.sin(0.2) * 10 * math.sin(0.2), 0.4, 6.0
    )
    two = 0.0
    for i in range(2):
        chord, along = 2 * 10 * math.sin(0.1), 0.2 * i + 0.1
        two = articulated.follow(two, chord * math.cos(along), chord * math.sin(along), 0.2, 6.0)
    assert one == pytest.approx(two, abs=1e-4)


def test_groups_do_not_matter_and_returning_vehicle_starts_straight(tmp_path, monkeypatch):
    poses = [(20 * math.cos(0.05 * i), 20 * math.sin(0.05 * i), -math.degrees(0.05 * i)) for i in range(120)]
    poses[70] = None
    complete = run_and_read(finished_scenario(tmp_path, poses, PARTS), tmp_path / "whole")[0]
    front, rear = bus_rows(tmp_path / "whole", 0), bus_rows(tmp_path / "whole", 1)
    assert front["yaw_rad"][70] == rear["yaw_rad"][70] and abs(front["yaw_rad"][69] - rear["yaw_rad"][69]) > 0.2
    monkeypatch.setattr(trajectories, "GROUP_FRAMES", 7)
    assert run_and_read(finished_scenario(tmp_path, poses, PARTS), tmp_path / "cut")[0] == complete
    one, other = read_rows(tmp_path / "whole"), read_rows(tmp_path / "cut")
    assert all(np.array_equal(one[name], other[name]) for name in one)
    assert complete["articulated"]["vehicles"] == 1 and complete["vehicles"] == {"fewest": 1, "most": 2, "different": 2}
    assert complete["overlapping_pairs"] == 0  # parts of one vehicle, which touch at the joint, are no overlap


def test_longer_axles_follow_closer_and_three_parts_follow_each_other(tmp_path):
    poses = [(20 * math.cos(0.05 * i), 20 * math.sin(0.05 * i), -math.degrees(0.05 * i)) for i in range(200)]
    angles = []
    for axle in (3.0, 6.0):
        kinds = {"bendy": {"parts_m": [8, 5, 5], "axles_m": [axle, axle]}}
        run_stage(traffic, finished_scenario(tmp_path, poses, {"articulated": {"kinds": kinds}}), tmp_path / "out")
        yaw = [bus_rows(tmp_path / "out", part)["yaw_rad"][-1] for part in range(3)]
        angles.append([math.remainder(yaw[i] - yaw[i + 1], math.tau) for i in range(2)])
    assert all(
        b > a > 0 for a, b in zip(*angles, strict=True)
    )  # the angle at each joint grows with the axle's distance


def test_long_bus_gets_parts_automatically():
    sizes = {
        name: VehicleSize(length, 2.5, 3, vclass)
        for name, vclass, length in (
            ("a", "bus", 18.75),
            ("b", "bus", 12),
            ("c", "trailer", 16.5),
            ("d", "passenger", 20),
        )
    }
    result = Articulated(ArticulatedParameters()).geometries(sizes, "place")
    assert set(result) == {"a", "c"}
    assert result["a"].lengths_m == pytest.approx((10.6, 7.5)) and result["a"].starts_m[1] == pytest.approx(11.25)
    assert result["c"].lengths_m == pytest.approx((6, 10.5)) and result["c"].hinges_m == (4.5,)
    assert result["c"].axles_m == pytest.approx((7.7,))
    assert Articulated(ArticulatedParameters(auto=False)).geometries(sizes, "place") == {}


def test_parts_follow_the_slope_of_a_finished_file(tmp_path):
    """Without a network there is no surface: the parts lie along the slope that the file gives."""
    degrees, p = math.degrees(math.atan(GRADE)), math.atan(GRADE)
    poses = [(1.0 * i, 0, 90, degrees, 100 + GRADE * i) for i in range(20)]
    run_stage(traffic, finished_scenario(tmp_path, poses, PARTS), tmp_path / "out")
    rear = bus_rows(tmp_path / "out", 1)
    middle, front_x = 18.75 - 3.75, np.arange(20.0)
    assert rear["pitch_rad"] == pytest.approx(p, abs=1e-9)
    assert rear["x_m"] == pytest.approx(front_x - middle * math.cos(p), abs=2e-6)
    assert rear["z_m"] == pytest.approx(100 + GRADE * front_x - middle * math.sin(p) + 3.1 / 2, abs=2e-6)


@pytest.mark.slow
def test_parts_are_in_line_on_a_hill(hill_run):
    """Composition: each part stands on the grade by itself, behind the one that pulls it."""
    r = hill_run[1]
    rear = np.flatnonzero((r["part"] == 1) & (np.abs(r["x_m"] - 300) < 100))
    assert rear.size > 20 and hill_run[0]["articulated"]["vehicles"] > 1
    front = rear - 1
    assert np.array_equal(r["vehicle"][rear], r["vehicle"][front])
    assert np.abs(r["pitch_rad"][rear]) == pytest.approx(math.atan(GRADE), abs=2e-4)
    apart = np.sqrt(sum((r[k][rear] - r[k][front]) ** 2 for k in ("x_m", "y_m", "z_m")))
    assert apart == pytest.approx((10.6 + 7.5) / 2 + 0.65, abs=2e-3)
