"""Writes the static world and the sensors as a 3D scene: glTF (``scene.glb``) or USD (``scene.usdc``).

Both have one mesh per kind of solid (building, tree, ground, ...) and one node per sensor, at its pose, with a small
marker: a body and a cone along its front. The poses in all conventions are in ``extrinsics.json``
(:mod:`egvs.export.extrinsics`).

- glTF has y up. The node ``egvs_world_z_up`` turns the scene; all nodes below it have the axes of the world frame, so
  the matrix of a sensor's node is ``T_scene_sensor``.
- USD states z up and metres per unit on the stage; its matrices are for row vectors, the transposes of those here.

Vertices of glTF and USD are float32. Far from the origin, they would lose millimetres; there the scene gets another
origin (:func:`scene_origin_m`), which is stated in ``extrinsics.json``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from egvs.artefacts.run_folder import RunFolder
from egvs.core import files
from egvs.core.grid import FloatArray, IntArray
from egvs.drawing.basemap import solid_group
from egvs.export.extrinsics import (
    R_GLTF_WORLD,
    PosedSensor,
    extrinsics_document,
    transform_world_sensor,
)
from egvs.export.finished_run import ExportCrs, FinishedRun
from egvs.formats.meshes import SCENE_NODE
from egvs.results.ranking import RankedSite

if TYPE_CHECKING:
    import trimesh

    from egvs.world.mesh import World


GLTF_FILE, USD_FILE, EXTRINSICS_FILE = "scene.glb", "scene.usdc", "extrinsics.json"
WORLD_NODE = SCENE_NODE

MAX_FLOAT32_M = 8192.0
"""Below this distance from the origin, float32 resolves 0.5 mm."""

_COLOURS = {
    "ground": (126, 132, 128), "building": (196, 190, 180), "tree": (92, 138, 82), "sensor": (232, 89, 12),
}  # fmt: skip
_OTHER_COLOUR = (140, 146, 156)


@dataclass(frozen=True)
class SceneMesh:
    """The triangles of one kind of solid: ``vertices_m`` (n, 3) in the scene frame, ``faces`` (m, 3)."""

    kind: str
    vertices_m: FloatArray
    faces: IntArray

    @property
    def colour(self) -> tuple[int, int, int]:
        """RGB, 0 to 255."""
        if solid_group(self.kind, math.inf) == "green":
            return _COLOURS["tree"]
        return _COLOURS.get(self.kind, _OTHER_COLOUR)


def write_scene(folder: Path, run: FinishedRun, reference: ExportCrs, *, is_usd: bool) -> Iterator[Path]:
    """Write the scene and its extrinsics to a folder; yield the files.

    Parameters
    ----------
    folder
        An existing folder.
    run
        The run.
    reference
        The reference system that ``extrinsics.json`` states.
    is_usd
        Whether the scene is USD instead of glTF.
    """
    run.artefact(RunFolder.statics.name)
    sensors = posed_sensors(run)
    origin_m = scene_origin_m(run)
    meshes = scene_meshes(run.work.world, origin_m)
    path = folder / (USD_FILE if is_usd else GLTF_FILE)
    if is_usd:
        _write_usd(path, meshes, sensors, origin_m)
    else:
        path.write_bytes(make_gltf(meshes, sensors, origin_m))
    yield path
    document = extrinsics_document(run.scenario.name, sensors, origin_m, reference)
    (folder / EXTRINSICS_FILE).write_text(files.to_json_text(document, indent=1) + "\n", encoding="utf-8")
    yield folder / EXTRINSICS_FILE


def posed_sensors(run: FinishedRun) -> list[PosedSensor]:
    """Return the sensors of all sites of a run, in the order of its scores; those of a plan at their poses in it."""
    plan = run.plan
    planned = {} if plan is None else {sensor.site: sensor.mount.pose for sensor in plan.sensors}
    sites = RankedSite.read(run.artefact(RunFolder.scores.name))
    return [PosedSensor(site.site, site.sensor, planned.get(site.site, site.pose), site.rank) for site in sites]


def scene_origin_m(run: FinishedRun) -> FloatArray:
    """Return the origin of the scene in the world frame, (3,): 0, or the centre of the region if that is far away."""
    center_m = np.round(np.asarray(run.scenario.roi.center_m, dtype=np.float64))
    if np.abs(center_m).max() <= MAX_FLOAT32_M:
        return np.zeros(3)
    return np.array([center_m[0], center_m[1], 0.0])


def scene_meshes(world: World, origin_m: FloatArray) -> list[SceneMesh]:
    """Return one mesh per kind of solid, in the order of their names."""
    meshes = []
    kinds = np.array([kind for _, kind in world.solids], dtype=str)
    for kind in sorted(set(kinds.tolist())):
        faces = world.faces[kinds[world.solid_of_face] == kind]
        if len(faces):
            used, numbers = np.unique(faces, return_inverse=True)
            meshes.append(SceneMesh(kind, world.vertices_m[used] - origin_m, numbers.reshape(-1, 3).astype(np.int64)))
    return meshes


def make_gltf(meshes: Sequence[SceneMesh], sensors: Sequence[PosedSensor], origin_m: FloatArray) -> bytes:
    """Return a scene as binary glTF; parameters as those of the module."""
    import trimesh

    scene: Any = trimesh.Scene()
    to_gltf = np.eye(4)
    to_gltf[:3, :3] = R_GLTF_WORLD
    scene.graph.update(frame_to=WORLD_NODE, frame_from=scene.graph.base_frame, matrix=to_gltf)
    used: set[str] = {WORLD_NODE, scene.graph.base_frame}
    for mesh in meshes:
        name = _unique(mesh.kind, used)
        _add(scene, name, trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False), np.eye(4), mesh.colour)
    marker = _marker()
    for sensor in sensors:
        name = _unique(sensor.site, used)
        _add(scene, name, marker.copy(), _scene_matrix(sensor, origin_m), _COLOURS["sensor"])
    exported: bytes = scene.export(file_type="glb")
    return exported


def _add(scene: Any, name: str, mesh: trimesh.Trimesh, matrix: FloatArray, colour: tuple[int, int, int]) -> None:
    import trimesh

    visual: Any = trimesh.visual
    material = visual.material.PBRMaterial(
        name=name, baseColorFactor=[*colour, 255], metallicFactor=0.0, roughnessFactor=0.9, doubleSided=True
    )
    mesh.visual = visual.TextureVisuals(material=material)
    scene.add_geometry(mesh, node_name=name, geom_name=name, parent_node_name=WORLD_NODE, transform=matrix)


def _scene_matrix(sensor: PosedSensor, origin_m: FloatArray) -> FloatArray:
    """T_scene_sensor, (4, 4)."""
    matrix = transform_world_sensor(sensor.pose)
    matrix[:3, 3] -= origin_m
    return matrix


def _marker() -> trimesh.Trimesh:
    """A body of 0.2 m, and a cone of 0.6 m along the front (x), in the sensor's frame."""
    import trimesh

    body = trimesh.creation.cylinder(radius=0.1, height=0.2, sections=16)
    to_front = np.array([[0.0, 0.0, 1.0, 0.1], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    cone = trimesh.creation.cone(radius=0.06, height=0.5, sections=12, transform=to_front)
    count = len(body.vertices)
    return trimesh.Trimesh(
        np.concatenate([body.vertices, cone.vertices]), np.concatenate([body.faces, cone.faces + count]), process=False
    )


def _unique(name: str, used: set[str]) -> str:
    unique, number = name, 2
    while unique in used:
        unique, number = f"{name}_{number}", number + 1
    used.add(unique)
    return unique


def _write_usd(path: Path, meshes: Sequence[SceneMesh], sensors: Sequence[PosedSensor], origin_m: FloatArray) -> None:
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    world = UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    used: set[str] = set()
    UsdGeom.Scope.Define(stage, "/World/Statics")
    for mesh in meshes:
        _usd_mesh(stage, f"/World/Statics/{_usd_name(mesh.kind, used)}", mesh)
    UsdGeom.Scope.Define(stage, "/World/Sensors")
    marker = _marker()
    shape = SceneMesh("sensor", np.asarray(marker.vertices), np.asarray(marker.faces, dtype=np.int64))
    for sensor in sensors:
        prim = f"/World/Sensors/{_usd_name(sensor.site, used)}"
        node = UsdGeom.Xform.Define(stage, prim)
        node.AddTransformOp().Set(Gf.Matrix4d(*_scene_matrix(sensor, origin_m).T.ravel().tolist()))
        node.GetPrim().SetCustomDataByKey("site", sensor.site)
        node.GetPrim().SetCustomDataByKey("sensor", sensor.sensor)
        _usd_mesh(stage, f"{prim}/marker", shape)
    stage.GetRootLayer().Save()


def _usd_mesh(stage: Any, prim: str, mesh: SceneMesh) -> None:
    from pxr import UsdGeom, Vt

    shape = UsdGeom.Mesh.Define(stage, prim)
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(mesh.vertices_m.astype(np.float32)))
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, dtype=np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.astype(np.int32).ravel()))
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateDoubleSidedAttr(True)
    extent = np.stack([mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)]).astype(np.float32)
    shape.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent))
    colour = np.array([mesh.colour], dtype=np.float32) / np.float32(255.0)
    shape.CreateDisplayColorAttr(Vt.Vec3fArray.FromNumpy(colour))


def _usd_name(name: str, used: set[str]) -> str:
    """Return a valid name of a prim: ASCII letters, digits and underscores."""
    valid = re.sub(r"[^A-Za-z0-9_]", "_", name)
    if not re.match(r"[A-Za-z_]", valid):
        valid = f"_{valid}"
    return _unique(valid, used)
