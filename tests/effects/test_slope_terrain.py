"""The ground beyond the roads from ``statics.terrain``."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import egvs
from egvs.artefacts import parquet
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.creation.terrain.draping import drape_network
from egvs.creation.terrain.ground_heights import ground_points
from egvs.effects.slope import Slope, read_ground_points
from egvs.formats import ply
from egvs.scenario.effects_config import SlopeParameters
from egvs.scenario.loading import scenario_from_dict
from egvs.scenario.model import Scenario
from egvs.stages import statics, traffic
from egvs.traffic import network
from egvs.world import terrain
from egvs.world.mesh import read_ply
from tests.creation.draped_roads import Function
from tests.effects.road_helpers import SMALL, road_scenario
from tests.stage_runner import inputs_of, run_stage


def cutting_m(y_m: FloatArray) -> FloatArray:
    """The road, 12 m wide on each side, lies in a cutting with slopes of 1 : 5."""
    return np.maximum(np.abs(y_m) - 12, 0.0) / 5


def grid_points(step_m: float = 4.0) -> FloatArray:
    x, y = np.meshgrid(np.arange(0, 601, step_m), np.arange(-100, 101, step_m))
    return np.column_stack([x.ravel(), y.ravel(), cutting_m(y.ravel())])


def scenario_in(folder: Path, road: Path, points_m: FloatArray, **keys: Any) -> Scenario:
    shutil.copy(road / "road.net.xml", folder)
    ply.write(folder / "terrain.ply", points_m)
    values = road_scenario(folder, **SMALL).model_dump(mode="json")
    values["statics"] = {"terrain": "terrain.ply"}
    return scenario_from_dict(values | keys, folder, str(folder / "scenario.toml"))


@pytest.mark.slow
@pytest.mark.system
def test_ground_is_the_terrain_beyond_the_roads(flat_road: Path, tmp_path: Path) -> None:
    roads = network.read_net_xml(flat_road / "road.net.xml")
    ground = terrain.triangulate_ground(roads, beyond_m=grid_points())
    x = np.linspace(20, 580, 57)
    for y in (-60.0, -30.0, 30.0, 60.0):
        assert ground.height_m(x, np.full(57, y)) == pytest.approx(np.full(57, cutting_m(np.array(y))), abs=1e-9)
    for y in (-3.0, 0.0, 3.0):
        assert ground.height_m(x, np.full(57, y)) == pytest.approx(np.zeros(57), abs=1e-9)
    flat = terrain.triangulate_ground(roads)
    assert np.ptp(flat.vertices_m[:, 2]) == 0


def test_heights_near_repeated_points_are_those_of_the_plane() -> None:
    """SciPy does not say which triangles are at repeated points."""
    rng = np.random.default_rng(5)
    xy_m = rng.uniform(0, 10, (8, 2))[rng.integers(8, size=200)]
    points_m = np.column_stack([np.concatenate([xy_m, [[0, 0], [10, 0], [0, 10], [10, 10]]]), np.zeros(204)])
    points_m[:, 2] = 0.1 * points_m[:, 0] - 0.2 * points_m[:, 1] + 3
    low_m, high_m = np.zeros(2), np.full(2, 10.0)
    ground = terrain.TerrainSurface(points_m, terrain.triangulate(points_m, low_m), low_m, high_m)
    x_m, y_m = rng.uniform(0.01, 9.99, (2, 500))
    assert ground.height_m(x_m, y_m) == pytest.approx(0.1 * x_m - 0.2 * y_m + 3, abs=1e-9)


@pytest.mark.system
def test_lanes_far_above_the_terrain_are_no_ground(hill_road: Path) -> None:
    """The hill road rises to 12 m over a terrain at z = 0: where it is more than 1.5 m above, it is a bridge."""
    roads = network.read_net_xml(hill_road / "road.net.xml")
    ground = terrain.triangulate_ground(roads, beyond_m=grid_points() * [1, 1, 0])
    below = ground.height_m(np.array([300.0, 400.0, 550.0]), np.array([0.0, 2.0, 0.0]))
    assert below == pytest.approx([0, 0, 0], abs=1e-9)
    assert ground.height_m(np.array([175.0]), np.array([2.0])) == pytest.approx([1.0], abs=0.1)  # still on it


@pytest.mark.system
def test_statics_have_the_terrain_and_depend_on_it(flat_road: Path, tmp_path: Path) -> None:
    scene = scenario_in(tmp_path, flat_road, grid_points())
    assert Slope(SlopeParameters()).acts(scene) == (True, "the ground beyond the roads is terrain.ply")
    result = run_stage(statics, scene, tmp_path / "out")
    assert result["notes"] == ["slope: on, the ground follows the network's roads, and terrain.ply beyond them"]
    world = read_ply(tmp_path / "out" / "statics.ply")[0]
    is_middle = (np.abs(world.vertices_m[:, 0] - 300) < 200) & (np.abs(world.vertices_m[:, 1]) < 90)
    x, y, z = world.vertices_m[is_middle].T
    assert len(x) > 1000 and z == pytest.approx(cutting_m(y), abs=1e-3)
    for stage in (statics, traffic):
        before = inputs_of(stage, scene, tmp_path).files["terrain"]
        ply.write(tmp_path / "terrain.ply", grid_points(5.0))
        assert inputs_of(stage, scene, tmp_path).files["terrain"] != before
        ply.write(tmp_path / "terrain.ply", grid_points())


@pytest.mark.system
def test_terrain_needs_a_network(tmp_path: Path) -> None:
    (tmp_path / "f.csv").write_text("x")
    ply.write(tmp_path / "terrain.ply", grid_points(50.0))
    values = road_scenario(tmp_path, **(SMALL | {"network": None, "fcd": "f.csv"})).model_dump(mode="json")
    values["statics"] = {"terrain": "terrain.ply"}
    scene = scenario_from_dict(values, tmp_path, "scenario.toml")
    with pytest.raises(InputError, match=r"statics\.terrain: the traffic has no network\. Set traffic\.roads"):
        Slope(SlopeParameters()).acts(scene)


@pytest.mark.parametrize(("points_m", "message"), [
    (np.empty((0, 3)), "the header declares 0 points"),
    (np.array([[0, 0, 0], [1, np.nan, 2]]), "expected points with coordinates up to 1e[+]08 m, got point 1"),
    (np.array([[1e12, 0, 0.0]]), "expected points.*got point 0"),
])  # fmt: skip
def test_rejects_points_that_are_no_ground(points_m: FloatArray, message: str, tmp_path: Path) -> None:
    ply.write(tmp_path / "terrain.ply", points_m)
    with pytest.raises(InputError, match=r"terrain\.ply: statics\.terrain: " + message):
        read_ground_points(tmp_path / "terrain.ply")


def test_rejects_damaged_files_and_too_many_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "terrain.ply").write_bytes(b"ply\nformat ascii 1.0\n")
    with pytest.raises(InputError, match=r"statics\.terrain: not a PLY file"):
        read_ground_points(tmp_path / "terrain.ply")
    ply.write(tmp_path / "terrain.ply", grid_points())
    monkeypatch.setenv("EGVS_MAX_POINTS", "100")
    with pytest.raises(InputError, match="EGVS_MAX_POINTS"):
        read_ground_points(tmp_path / "terrain.ply")


@pytest.mark.parametrize("points_m", [np.zeros((1, 3)), np.column_stack([np.arange(9.0)] * 2 + [np.zeros(9)])])
def test_terrain_without_an_area_leaves_the_roads(points_m: FloatArray, flat_road: Path) -> None:
    roads = network.read_net_xml(flat_road / "road.net.xml")
    ground = terrain.triangulate_ground(roads, beyond_m=points_m)
    assert ground.height_m(np.array([300.0]), np.array([0.0])) == pytest.approx([0.0])


@pytest.mark.system
@pytest.mark.slow
def test_draped_scenario_runs_to_a_ranking(flat_road: Path, tmp_path: Path) -> None:
    """A flat network laid on a ground that rises by 5 % along the road, and by 10 % across beyond it."""
    ground = Function(lambda x, y: 80 + 0.05 * x + 0.1 * np.maximum(np.abs(y) - 12, 0.0))
    text = (flat_road / "road.net.xml").read_text()
    draped = drape_network(text, ground, (300.0, 0.0))
    (tmp_path / "road.net.xml").write_text(draped.text)
    from shapely.geometry import box

    points = ground_points(ground, box(0, -150, 600, 150), 5.0)
    ply.write(tmp_path / "terrain.ply", points - np.array([0, 0, draped.zero_height_m]))
    sites = "site,x_m,y_m,z_m\nlow,290,10,4\nhigh,310,-10,6\nfar,320,30,8\n"
    (tmp_path / "sites.csv").write_text(sites)
    values = road_scenario(tmp_path, **(SMALL | {"frames": 120})).model_dump(mode="json")
    values |= {"statics": {"terrain": "terrain.ply"}, "sites": {"file": "sites.csv"}}
    values["roi"] |= {"center_m": [300, 0, 2], "size_m": [60, 40, 8]}
    scene = scenario_from_dict(values, tmp_path, str(tmp_path / "scenario.toml"))
    egvs.run(scene, tmp_path / "out", jobs=1)
    scores, _ = parquet.read_artefact(tmp_path / "out" / "scores.parquet", "scores")
    assert sorted(scores["rank"].to_pylist()) == [1, 2, 3] and min(scores["egvs"].to_pylist()) > 0
    boxes, _ = parquet.read_artefact(tmp_path / "out" / "trajectories.parquet", "trajectories")
    x, z, height, pitch, yaw = (
        np.array(boxes[k].to_pylist()) for k in ("x_m", "z_m", "height_m", "pitch_rad", "yaw_rad")
    )
    is_car = np.abs(pitch) > 0
    assert is_car.sum() > 500
    assert (z - height / 2)[is_car] == pytest.approx(0.05 * (x - 300)[is_car], abs=0.02)
    assert np.sign(pitch[is_car]) == pytest.approx(np.sign(np.cos(yaw[is_car])))
    world = read_ply(tmp_path / "out" / "statics.ply")[0]
    near = (np.abs(world.vertices_m[:, 0] - 300) < 100) & (np.abs(world.vertices_m[:, 1]) < 100)
    x, y, z = world.vertices_m[near].T
    expected = 0.05 * (x - 300) + 0.1 * np.maximum(np.abs(y) - 12, 0)
    assert z == pytest.approx(expected, abs=0.02) and len(x) > 1000


@pytest.mark.slow
def test_far_point_of_a_terrain_costs_no_time(flat_road: Path) -> None:
    """The rim of the ground has a point each 50 m, but not on a side of 40,000 km."""
    roads = network.read_net_xml(flat_road / "road.net.xml")
    far = np.concatenate([grid_points(), [[40.0, 4e7, 0.0]]])
    ground = terrain.triangulate_ground(roads, beyond_m=far)
    assert len(ground.vertices_m) < len(grid_points()) + 20_000
    assert ground.height_m(np.array([300.0]), np.array([0.0])) == pytest.approx([0.0], abs=1e-6)
