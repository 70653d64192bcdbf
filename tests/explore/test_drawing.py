"""Meshes, colours, rotations and vehicles are drawn as defined."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

import egvs
from egvs.artefacts.tpog import Tpog
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds import simulation as cloud_simulation
from egvs.core.grid import Grid, Roi
from egvs.explore import drawing, road_meshes
from egvs.sensors.sensor import rotation_world_sensor
from egvs.sensors.sites import Pose
from egvs.traffic.network import Lane, Permission
from egvs.world import static_world
from egvs.world.carriageway import Carriageway
from egvs.world.mesh import World

FAR = Roi((400_000.25, 3_900_000.0, 0.0), (40.0, 20.0, 5.0))


def test_drawing_origin_is_in_region_and_whole_metres() -> None:
    assert drawing.drawing_origin(FAR) == (400_020.0, 3_900_010.0, 0.0)


def test_solids_keep_their_triangles(mini: Path) -> None:
    world = static_world.build_world(egvs.load(mini), None)[0]
    meshes = drawing.solid_meshes(world, (20.0, 0.0, 0.0))
    assert set(meshes) == {kind for _, kind in world.solids}
    assert sum(len(mesh.faces) for mesh in meshes.values()) == len(world.faces)
    house = meshes["building"]
    assert house.points.dtype == np.float32
    assert (house.points.min(axis=0).tolist(), house.points.max(axis=0).tolist()) == ([-6, 5, 0], [-2, 8, 6])


def test_large_world_is_simplified_with_same_shape() -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=8.0)
    world = World(ball.vertices, ball.faces.astype(np.int32), np.zeros(len(ball.faces), np.int32), (("b", "tree"),))
    full, coarse = (
        drawing.solid_meshes(world, (0, 0, 0))["tree"],
        drawing.solid_meshes(world, (0, 0, 0), max_triangles=2_000)["tree"],
    )
    assert len(full.faces) == 20_480
    assert 500 < len(coarse.faces) <= 2_000
    assert np.allclose(np.linalg.norm(coarse.points, axis=1), 8.0, atol=0.2)
    again = trimesh.Trimesh(coarse.points, coarse.faces, process=False)
    assert again.is_watertight
    assert np.isclose(again.volume, ball.volume, rtol=0.06)  # wound as before


def test_simplified_world_has_no_duplicate_triangles() -> None:
    leaf = np.array([[0, 0, 0], [9, 0, 0], [0, 9, 0]], dtype=np.float64)
    far = np.array([[50.0, 0, 0], [50.1, 0, 0], [50, 0.1, 0]])  # smaller than a cell
    world = World(
        np.concatenate([leaf, leaf + 0.01, far]),
        np.arange(9, dtype=np.int32).reshape(3, 3), np.zeros(3, np.int32), (("l", "tree"),),
    )  # fmt: skip
    drawn = drawing.solid_meshes(world, (0, 0, 0), max_triangles=2)["tree"]
    assert np.allclose(drawn.points[drawn.faces], [leaf + 0.005])


def test_region_has_twelve_edges() -> None:
    result = drawing.roi_box_lines(FAR, drawing.drawing_origin(FAR))
    lengths = np.abs(np.diff(result, axis=1)).sum(axis=(1, 2))
    assert sorted(lengths.tolist()) == [5.0] * 4 + [20.0] * 4 + [40.0] * 4


def test_lane_is_a_strip_of_its_width_and_slope() -> None:
    lane = Lane("0,0,1 10,0,2 20,0,2", "lane", 3.0, 20.0, Permission(None, frozenset()))
    strip = road_meshes.lane_mesh(Carriageway(("lane",), (lane,)), (0.0, 0.0, 0.0))
    corners = strip.points[strip.faces].astype(np.float64)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2.0
    assert np.isclose(areas.sum(), 3.0 * (np.hypot(10.0, 1.0) + 10.0))
    assert sorted({round(float(y), 3) for y in strip.points[:, 1]}) == [-1.5, 1.5]
    assert np.allclose(strip.points[::2, 2], (1.03, 2.03, 2.03))


def test_two_lanes_share_no_corner() -> None:
    lane = Lane("0,0 10,0", "lane", 3.0, 10.0, Permission(None, frozenset()))
    both = road_meshes.lane_mesh(
        Carriageway(("a", "b"), (lane, Lane("0,9 10,9", "b", None, 10.0, lane.permission))), (0, 0, 0)
    )
    assert both.faces.max() == 7
    assert len(both.faces) == 4


def test_columns_sum_values_over_height() -> None:
    counts = np.zeros((2, 2, 3), dtype=np.int64)
    counts[0, 1] = (1, 1, 2)
    counts[1, 0, 2] = 1
    tpog = Tpog(Grid((10.0, 20.0, 0.0), 0.5, (2, 2, 3)), 4, counts)
    points, colours = drawing.column_points(tpog, tpog.p, (10.0, 20.0, 0.0))
    assert points[:, :2].tolist() == [[0.25, 0.75], [0.75, 0.25]]
    assert colours.tolist() == [[0x44, 0x01, 0x54], drawing.colour_scale([0.25, 1.0], 0.0)[0].tolist()]


def test_layers_lie_on_the_sloping_ground() -> None:
    """The ground rises by 1 m per 10 m to the east; a flat ground, and points beyond the ground, stay as they are."""
    corners = np.array([[0.0, 0, 5], [40, 0, 9], [40, 40, 9], [0, 40, 5]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    world = World(corners, faces, np.zeros(2, dtype=np.int32), (("ground", "ground"),))
    points = np.array([[10.0, 10, 0], [20, 15, 0], [60, 10, 0]], dtype=np.float32)
    zero_m = (0.0, 10.0, 5.0)
    lifted = drawing.lift_to_ground(points, world, zero_m)
    assert lifted == pytest.approx(np.array([[10, 10, 1 + drawing.LAYER_HEIGHT_M], [20, 15, 2.09], [60, 10, 0]]))
    level = World(corners * [1, 1, 0], faces, world.solid_of_face, world.solids)
    assert drawing.lift_to_ground(points, level, zero_m) is points


def test_colour_scale_is_darkest_for_highest_and_allows_equal_values() -> None:
    assert drawing.colour_scale([1.0, 3.0]).tolist() == [[0xFD, 0xE7, 0x25], [0x44, 0x01, 0x54]]
    assert len(set(map(tuple, drawing.colour_scale([2.0, 2.0]).tolist()))) == 1
    assert drawing.colour_scale([]).shape == (0, 3)


def test_difference_has_colour_of_larger_side() -> None:
    grid = Grid((0.0, 0.0, 0.0), 1.0, (4, 1, 2))
    tpog = Tpog(grid, 10, np.zeros(grid.shape, dtype=np.int64))
    this, other = np.zeros(grid.shape), np.zeros(grid.shape)
    this[0, 0] = 1.0, 1.0  # 2 bits more
    this[1, 0, 0] = other[1, 0, 1] = 0.5  # as much
    other[2, 0, 1] = 1.0  # 1 bit less
    colours = (0, 0, 200), (200, 0, 0), (100, 100, 100)
    points, result = drawing.difference_points(tpog, this, other, (0.0, 0.0, 0.0), colours)
    assert points[:, 0].tolist() == [0.5, 1.5, 2.5]
    assert result.tolist() == [[0, 0, 200], [100, 100, 100], [170, 30, 30]]


ANGLES = st.tuples(st.floats(-180, 180), st.floats(-89.9, 89.9), st.floats(-180, 180))


def matrix(wxyz: tuple[float, float, float, float]) -> np.ndarray:
    """Return the rotation matrix of a quaternion, by rotating each axis: q v q*."""
    w, u = wxyz[0], np.array(wxyz[1:])
    return np.column_stack([v + 2 * np.cross(u, np.cross(u, v) + w * v) for v in np.eye(3)])


@pytest.mark.slow
@given(ANGLES)
def test_quaternion_rotates_like_beams(angles: tuple[float, float, float]) -> None:
    turned = matrix(drawing.pose_quaternion(Pose(0, 0, 0, *angles)))
    assert np.allclose(turned, rotation_world_sensor(*angles), atol=1e-12)


@given(ANGLES)
def test_angles_of_quaternion_are_restored(angles: tuple[float, float, float]) -> None:
    again = drawing.quaternion_to_yaw_pitch_roll_deg(drawing.pose_quaternion(Pose(0, 0, 0, *angles)))
    away = [math.remainder(a - b, 360.0) for a, b in zip(again, angles, strict=True)]
    assert np.allclose(away, 0.0, atol=1e-6)


@pytest.mark.parametrize("pitch", [90.0, -90.0])
@pytest.mark.parametrize(("yaw", "roll"), [(0.0, 0.0), (30.0, 0.0), (-120.0, 50.0)])
def test_vertical_sensor_has_equivalent_angles(yaw: float, pitch: float, roll: float) -> None:
    result = drawing.quaternion_to_yaw_pitch_roll_deg(drawing.pose_quaternion(Pose(0, 0, 0, yaw, pitch, roll)))
    assert result[1:] == (pitch, 0.0)
    assert np.allclose(rotation_world_sensor(*result), rotation_world_sensor(yaw, pitch, roll), atol=1e-6)


def test_values_that_are_not_dragged_stay_exact() -> None:
    pose = Pose(1 / 3, 2 / 3, 5.0, 37.123456, -12.3456, 179.999)
    wxyz = drawing.pose_quaternion(pose)
    assert drawing.dragged_pose(pose, pose.position_m, wxyz) == pose
    lifted = drawing.dragged_pose(pose, (pose.x_m, pose.y_m, 6.23456), wxyz)
    assert lifted == Pose(1 / 3, 2 / 3, 6.235, 37.123456, -12.3456, 179.999)
    turned = drawing.dragged_pose(
        pose, pose.position_m, drawing.pose_quaternion(Pose(0, 0, 0, 40.0, -12.3456, 179.999))
    )
    assert turned == Pose(1 / 3, 2 / 3, 5.0, 40.0, -12.3456, 179.999)


def test_yaw_above_180_degrees_is_not_changed() -> None:
    pose = Pose(0, 0, 3, 270.0)
    assert drawing.dragged_pose(pose, pose.position_m, drawing.pose_quaternion(pose)) == pose


BOXES = np.array([[10.0, 20.0, 0.75, 4.5, 1.8, 1.5, 0.0], [1000.0, -5.0, 1.5, 12.0, 2.5, 3.0, math.pi / 2]])


def frame(pitch_rad: float = 0.0) -> TrafficFrame:
    return TrafficFrame(0, ("a", "b"), ("passenger", "bus"), BOXES, np.array([0.0, pitch_rad]))


def test_vehicle_fills_its_box() -> None:
    one = drawing.vehicle_mesh(
        frame(), ["sedan", "bus"], cloud_simulation.builtin_bodies(), np.array([True, False]), (8.0, 0.0, 0.0)
    )
    assert np.allclose(one.points.min(axis=0), [2 - 2.25, 20 - 0.9, 0.0], atol=1e-5)
    assert np.allclose(one.points.max(axis=0), [2 + 2.25, 20 + 0.9, 1.5], atol=1e-5)
    turned = drawing.vehicle_mesh(
        frame(), ["sedan", "bus"], cloud_simulation.builtin_bodies(), np.array([False, True]), (1000.0, 0.0, 0.0)
    )
    assert np.allclose(turned.points.min(axis=0), [-1.25, -11.0, 0.0], atol=1e-5)
    assert np.allclose(turned.points.max(axis=0), [1.25, 1.0, 3.0], atol=1e-5)
    assert one.faces.max() == len(one.points) - 1
    both = drawing.vehicle_mesh(
        frame(), ["sedan", "bus"], cloud_simulation.builtin_bodies(), np.array([True, True]), (0.0, 0.0, 0.0)
    )
    assert len(both.faces) == len(one.faces) + len(turned.faces)


def test_pitch_lifts_the_front_of_a_vehicle() -> None:
    level, up = (
        drawing.vehicle_mesh(
            frame(pitch),
            ["sedan", "bus"],
            cloud_simulation.builtin_bodies(),
            np.array([False, True]),
            (1000.0, -5.0, 1.5),
        )
        for pitch in (0.0, 0.1)
    )
    front = level.points[:, 1] > 5.9  # it drives north
    assert front.any()
    assert np.allclose(up.points[front, 2] - level.points[front, 2], 6.0 * math.sin(0.1), atol=0.03)


def test_mesh_without_vehicles_is_empty() -> None:
    none = drawing.vehicle_mesh(
        frame(), ["sedan", "bus"], cloud_simulation.builtin_bodies(), np.array([False, False]), (0.0, 0.0, 0.0)
    )
    assert (none.points.shape, none.faces.shape) == ((0, 3), (0, 3))


def test_people_are_not_counted_as_vehicles() -> None:
    frame = TrafficFrame(3, ("a", "b", "c"), ("passenger", "pedestrian", "bicycle"), np.zeros((3, 7)), np.zeros(3))
    masks = ([True, True, False], [True, False, False], [False, True, True])
    counts = [drawing._count_road_users(frame, np.array(selected)) for selected in masks]
    assert counts == ["1 vehicle, 1 person", "1 vehicle", "0 vehicles, 2 people"]
