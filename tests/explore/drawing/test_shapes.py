"""What the page draws: the right triangles, near a zero of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

import egvs
from egvs.artefacts.tpog import Tpog
from egvs.core.grid import Grid, Roi
from egvs.explore import controls, drawing
from egvs.explore.session import PoseScore
from egvs.sensors.sites import Pose, Site
from egvs.traffic.network import Lane, Permission
from egvs.world import static_world
from egvs.world.carriageway import Carriageway
from egvs.world.mesh import World

FAR = Roi((400_000.25, 3_900_000.0, 0.0), (40.0, 20.0, 5.0))


def test_the_zero_is_near_the_region_and_whole() -> None:
    assert drawing.drawing_origin(FAR) == (400_020.0, 3_900_010.0, 0.0)


def test_solids_keep_their_triangles(mini: Path) -> None:
    world = static_world.build_world(egvs.load(mini), None)[0]
    meshes = drawing.solid_meshes(world, (20.0, 0.0, 0.0))
    assert set(meshes) == {kind for _, kind in world.solids}
    assert sum(len(mesh.faces) for mesh in meshes.values()) == len(world.faces)
    house = meshes["building"]
    assert house.points.dtype == np.float32
    assert (house.points.min(axis=0).tolist(), house.points.max(axis=0).tolist()) == ([-6, 5, 0], [-2, 8, 6])


def test_a_large_world_is_drawn_coarser_and_looks_alike() -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=8.0)
    world = World(ball.vertices, ball.faces.astype(np.int32), np.zeros(len(ball.faces), np.int32), (("b", "tree"),))
    whole, coarse = (
        drawing.solid_meshes(world, (0, 0, 0))["tree"],
        drawing.solid_meshes(world, (0, 0, 0), most=2_000)["tree"],
    )
    assert len(whole.faces) == 20_480
    assert 500 < len(coarse.faces) <= 2_000
    assert np.allclose(np.linalg.norm(coarse.points, axis=1), 8.0, atol=0.2)
    again = trimesh.Trimesh(coarse.points, coarse.faces, process=False)
    assert again.is_watertight
    assert np.isclose(again.volume, ball.volume, rtol=0.06)  # wound as before


def test_two_leaves_in_one_cell_are_drawn_once() -> None:
    leaf = np.array([[0, 0, 0], [9, 0, 0], [0, 9, 0]], dtype=np.float64)
    far = np.array([[50.0, 0, 0], [50.1, 0, 0], [50, 0.1, 0]])  # smaller than a cell
    world = World(
        np.concatenate([leaf, leaf + 0.01, far]),
        np.arange(9, dtype=np.int32).reshape(3, 3), np.zeros(3, np.int32), (("l", "tree"),),
    )  # fmt: skip
    drawn = drawing.solid_meshes(world, (0, 0, 0), most=2)["tree"]
    assert np.allclose(drawn.points[drawn.faces], [leaf + 0.005])


def test_a_region_has_twelve_edges() -> None:
    found = drawing.region_edges(FAR, drawing.drawing_origin(FAR))
    lengths = np.abs(np.diff(found, axis=1)).sum(axis=(1, 2))
    assert sorted(lengths.tolist()) == [5.0] * 4 + [20.0] * 4 + [40.0] * 4


def test_a_lane_is_a_strip_of_its_width_that_climbs_with_it() -> None:
    lane = Lane("0,0,1 10,0,2 20,0,2", "lane", 3.0, 20.0, Permission(None, frozenset()))
    strip = drawing.lane_mesh(Carriageway(("lane",), (lane,)), (0.0, 0.0, 0.0))
    corners = strip.points[strip.faces].astype(np.float64)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2.0
    assert np.isclose(areas.sum(), 3.0 * (np.hypot(10.0, 1.0) + 10.0))
    assert sorted({round(float(y), 3) for y in strip.points[:, 1]}) == [-1.5, 1.5]
    assert np.allclose(strip.points[::2, 2], (1.03, 2.03, 2.03))


def test_two_lanes_share_no_corner() -> None:
    lane = Lane("0,0 10,0", "lane", 3.0, 10.0, Permission(None, frozenset()))
    both = drawing.lane_mesh(
        Carriageway(("a", "b"), (lane, Lane("0,9 10,9", "b", None, 10.0, lane.permission))), (0, 0, 0)
    )
    assert both.faces.max() == 7
    assert len(both.faces) == 4


def test_columns_add_up_what_is_over_them() -> None:
    counts = np.zeros((2, 2, 3), dtype=np.int64)
    counts[0, 1] = (1, 1, 2)
    counts[1, 0, 2] = 1
    tpog = Tpog(Grid((10.0, 20.0, 0.0), 0.5, (2, 2, 3)), 4, counts)
    points, colours = drawing.column_points(tpog, tpog.p, (10.0, 20.0, 0.0))
    assert points[:, :2].tolist() == [[0.25, 0.75], [0.75, 0.25]]
    assert colours.tolist() == [[0x44, 0x01, 0x54], drawing.colour_scale([0.25, 1.0], 0.0)[0].tolist()]


def test_the_scale_is_dark_for_the_best_and_bears_equal_scores() -> None:
    assert drawing.colour_scale([1.0, 3.0]).tolist() == [[0xFD, 0xE7, 0x25], [0x44, 0x01, 0x54]]
    assert len(set(map(tuple, drawing.colour_scale([2.0, 2.0]).tolist()))) == 1
    assert drawing.colour_scale([]).shape == (0, 3)


def test_a_rating_is_told_in_words() -> None:
    site = Site("a_b", Pose(0, 0, 3), "small")
    candidate = PoseScore(site, {"egvs": 200.0, "entropy_seen": 0.5}, 2)
    moved = PoseScore(Site("a_b", Pose(0, 0, 4), "small"), {"egvs": 250.0, "entropy_seen": 0.6}, 1)
    text = controls.describe_score(moved, "egvs", candidate, 7)
    assert text.startswith("## 250.0 (+25.0%)\n\nrank 1 of 7 by egvs\n")
    assert "| entropy\\_seen | 60.00% |" in text
    assert "a\\_b" in controls.ranking_table([candidate], "egvs")
    assert controls.describe_score(candidate, "egvs", candidate, 7).startswith("## 200.0\n")


def test_a_difference_has_the_colour_of_who_sees_more() -> None:
    grid = Grid((0.0, 0.0, 0.0), 1.0, (4, 1, 2))
    tpog = Tpog(grid, 10, np.zeros(grid.shape, dtype=np.int64))
    this, other = np.zeros(grid.shape), np.zeros(grid.shape)
    this[0, 0] = 1.0, 1.0  # 2 bits more
    this[1, 0, 0] = other[1, 0, 1] = 0.5  # as much
    other[2, 0, 1] = 1.0  # 1 bit less
    colours = (0, 0, 200), (200, 0, 0), (100, 100, 100)
    points, found = drawing.difference_points(tpog, this, other, (0.0, 0.0, 0.0), colours)
    assert points[:, 0].tolist() == [0.5, 1.5, 2.5]
    assert found.tolist() == [[0, 0, 200], [100, 100, 100], [170, 30, 30]]
