"""3D scenes: nodes and matrices as trimesh and USD read them, and one pose by hand in each convention.

The pose: at (1, 2, 3), yaw 90 degrees (north), pitch -10 degrees (nose down). Its front is (0, cos 10, -sin 10).
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from egvs.export import extrinsics
from egvs.export.export import export_run
from egvs.export.extrinsics import PosedSensor
from egvs.export.finished_run import ExportCrs
from egvs.export.scene_files import WORLD_NODE, SceneMesh, make_gltf, posed_sensors, scene_origin_m
from egvs.formats.georeference import WorldFrame
from egvs.results.plans import PlannedSensor
from egvs.sensors.sites import Pose
from tests.export.conftest import EPSG, OFFSET_M

COS, SIN = math.cos(math.radians(10.0)), math.sin(math.radians(10.0))
POSE = Pose(1.0, 2.0, 3.0, yaw_deg=90.0, pitch_deg=-10.0)
FRONT = [0.0, COS, -SIN]
LOCAL = ExportCrs("LOCAL", "local metres", None, is_degrees=False)


def entry(pose: Pose, reference: ExportCrs = LOCAL) -> dict[str, Any]:
    sensors = [PosedSensor("c01", "VLP-32C", pose, 1)]
    document = json.loads(json.dumps(extrinsics.extrinsics_document("test", sensors, np.zeros(3), reference)))
    sensor: dict[str, Any] = document["sensors"][0]
    return sensor


def apply_carla_rotation(rotation: dict[str, float], point: list[float]) -> list[float]:
    """What CARLA's Transform does with pitch, yaw and roll, in degrees, element by element."""
    cp, sp = math.cos(math.radians(rotation["pitch"])), math.sin(math.radians(rotation["pitch"]))
    cy, sy = math.cos(math.radians(rotation["yaw"])), math.sin(math.radians(rotation["yaw"]))
    cr, sr = math.cos(math.radians(rotation["roll"])), math.sin(math.radians(rotation["roll"]))
    x, y, z = point
    return [
        x * (cp * cy) + y * (cy * sp * sr - sy * cr) + z * (-cy * sp * cr - sy * sr),
        x * (cp * sy) + y * (sy * sp * sr + cy * cr) + z * (-sy * sp * cr + cy * sr),
        x * sp + y * (-cp * sr) + z * (cp * cr),
    ]


def rotate_by_quaternion(wxyz: list[float], point: list[float]) -> np.ndarray[Any, Any]:
    """v + 2 w (u x v) + 2 u x (u x v)."""
    w, u, v = wxyz[0], np.array(wxyz[1:]), np.array(point)
    return v + 2 * w * np.cross(u, v) + 2 * np.cross(u, np.cross(u, v))


def test_front_of_the_pose_by_hand_in_each_convention() -> None:
    sensor = entry(POSE)
    matrix = np.array(sensor["T_world_sensor"])
    assert matrix @ [0, 0, 0, 1] == pytest.approx([1, 2, 3, 1])
    assert matrix @ [1, 0, 0, 0] == pytest.approx([*FRONT, 0])
    assert matrix @ [0, 1, 0, 0] == pytest.approx([-1, 0, 0, 0])  # its left is west
    assert np.array(sensor["T_sensor_world"]) @ matrix == pytest.approx(np.eye(4))
    assert rotate_by_quaternion(sensor["quaternion_wxyz"], [1, 0, 0]) == pytest.approx(FRONT)
    assert sensor["quaternion_xyzw"] == [*sensor["quaternion_wxyz"][1:], sensor["quaternion_wxyz"][0]]
    gltf = np.array(sensor["T_gltf_sensor"])
    assert gltf @ [0, 0, 0, 1] == pytest.approx([1, 3, -2, 1])  # up is y, south is z
    assert gltf @ [1, 0, 0, 0] == pytest.approx([0, -SIN, -COS, 0])
    carla = sensor["carla"]
    assert carla["location"] == {"x": 1.0, "y": -2.0, "z": 3.0}
    assert apply_carla_rotation(carla["rotation"], [1, 0, 0]) == pytest.approx([0, -COS, -SIN])  # south is y
    lines = [[float(word) for word in line.split()] for line in sensor["cloudcompare_matrix"]]
    assert np.array(lines) == pytest.approx(matrix)
    assert sensor["bearing_deg"] == 0.0


@pytest.mark.parametrize("seed", range(20))
def test_carla_moves_points_as_the_world_frame_does(seed: int) -> None:
    """Points of the sensor with y reversed, moved by CARLA, are those of the world frame with y reversed."""
    random = np.random.default_rng(seed)
    pose = Pose(*random.uniform(-50, 50, 3).tolist(), *random.uniform(-180, 180, 3).tolist())
    sensor = entry(pose)
    x, y, z = random.uniform(-1, 1, 3).tolist()
    world = np.array(sensor["T_world_sensor"]) @ [x, y, z, 1]
    location = sensor["carla"]["location"]
    moved = np.add(apply_carla_rotation(sensor["carla"]["rotation"], [x, -y, z]), list(location.values()))
    assert moved == pytest.approx([world[0], -world[1], world[2]])
    assert np.array(sensor["T_carla_sensor"]) @ [x, -y, z, 1] == pytest.approx([*moved, 1])


def test_extrinsics_state_eastings() -> None:
    frame = WorldFrame(f"EPSG:{EPSG}", OFFSET_M)
    sensor = entry(POSE, ExportCrs(f"EPSG:{EPSG}", "UTM", frame, is_degrees=False))
    assert (sensor["easting_m"], sensor["northing_m"]) == (1 - OFFSET_M[0], 2 - OFFSET_M[1])
    assert "easting_m" not in entry(POSE)


def test_gltf_has_a_node_with_the_pose() -> None:
    import trimesh

    triangle = SceneMesh("ground", np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]]), np.array([[0, 1, 2]]))
    data = make_gltf([triangle], [PosedSensor("c01", "VLP-32C", POSE, 1)], np.zeros(3))
    scene = trimesh.load_scene(trimesh.util.wrap_as_stream(data), file_type="glb")
    matrix, _ = scene.graph["c01"]
    assert matrix @ [0, 0, 0, 1] == pytest.approx([1, 3, -2, 1])
    assert matrix @ [1, 0, 0, 0] == pytest.approx([0, -SIN, -COS, 0], abs=1e-6)
    in_world, _ = scene.graph.get("c01", WORLD_NODE)
    assert in_world @ [1, 0, 0, 0] == pytest.approx([*FRONT, 0], abs=1e-6)
    moved = trimesh.transform_points(scene.geometry["ground"].vertices, scene.graph["ground"][0])
    assert moved.tolist() == [[0, 0, 0], [4, 0, 0], [0, 0, -4]]


def test_scene_far_from_the_origin_gets_another_one() -> None:
    near, far = (SimpleNamespace(center_m=center) for center in ((20.0, 0.0, 2.5), (550020.0, 5630000.4, 2.5)))
    for roi, origin in ((near, [0, 0, 0]), (far, [550020, 5630000, 0])):
        run: Any = SimpleNamespace(scenario=SimpleNamespace(roi=roi))
        assert scene_origin_m(run).tolist() == origin


def test_exported_glb_opens_with_all_sites_and_solids(located: Path, tmp_path: Path) -> None:
    import trimesh

    done = export_run(located, "glb", out=tmp_path)
    assert [path.name for path in done.paths] == ["scene.glb", "extrinsics.json"]
    scene = trimesh.load_scene(tmp_path / "scene.glb")
    document = json.loads((tmp_path / "extrinsics.json").read_text())
    assert document["world_frame"]["offset_m"] == list(OFFSET_M)
    for sensor in document["sensors"]:
        assert scene.graph[sensor["site"]][0] == pytest.approx(np.array(sensor["T_gltf_sensor"]), abs=1e-6)
    assert {"building", "ground", "pole_a", "pole & <b>"} <= set(scene.graph.nodes_geometry)
    building = scene.geometry["building"]
    assert building.bounds[1, 2] == pytest.approx(6.0)  # vertices keep the axes of the world frame


@pytest.mark.slow
def test_exported_usd_has_the_poses(located: Path, tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="the extra egvs[usd] is not installed")
    from pxr import Usd, UsdGeom

    export_run(located, "usd", out=tmp_path)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    document = json.loads((tmp_path / "extrinsics.json").read_text())
    prims = {prim.GetCustomDataByKey("site"): prim for prim in stage.Traverse() if prim.HasCustomDataKey("site")}
    assert len(prims) == len(document["sensors"]) == 2
    for sensor in document["sensors"]:
        matrix = np.array(UsdGeom.Xformable(prims[sensor["site"]]).GetLocalTransformation()).T
        assert matrix == pytest.approx(np.array(sensor["T_world_sensor"]))
    assert stage.GetPrimAtPath("/World/Statics/building").IsValid()


def test_sensors_of_a_plan_have_their_poses_in_it(located: Path) -> None:
    pose = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    moved = PlannedSensor(1, "pole_a", "pole_a", *pose, "VLP-32C", forced=False, gain=1.0, score=1.0, cost=0.0)
    run: Any = SimpleNamespace(plan=SimpleNamespace(sensors=[moved]), artefact=lambda name: located / name)
    poses = {sensor.site: sensor.pose for sensor in posed_sensors(run)}
    assert poses["pole_a"] == Pose(1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    run.plan = None
    before = {sensor.site: sensor.pose for sensor in posed_sensors(run)}
    assert before["pole_a"] != poses["pole_a"]
    assert {site: pose for site, pose in poses.items() if site != "pole_a"} == {
        site: pose for site, pose in before.items() if site != "pole_a"
    }
