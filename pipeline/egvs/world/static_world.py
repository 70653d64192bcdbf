"""Builds the static world of a scenario as one triangle mesh.

Steps: read footprints (:mod:`egvs.world.footprints`) and extrude them between ``base_m`` and ``height_m``; take
meshes apart into closed solids and open surfaces; lay a ground plane at z = 0. World frame, metres.

Where a ground that goes up and down is given, it is laid instead, and both heights of a footprint count from the ground
below its centre; what stands on the ground reaches down to the lowest of it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.core.errors import WARNINGS_KEY, Diagnostic, InputError
from egvs.core.reading import translate_errors
from egvs.core.runtime import ProgressCallback, no_progress
from egvs.formats import meshes
from egvs.formats.georeference import Georeference
from egvs.formats.meshes import are_closed, mesh_components
from egvs.scenario.fields import MAX_COORDINATE_M
from egvs.scenario.model import MeshConfig, Scenario
from egvs.world import geolocation
from egvs.world.footprints import Footprint, read_geojson
from egvs.world.map_features import SolidTypes
from egvs.world.mesh import World
from egvs.world.sumo_polygons import read_poly_xml
from egvs.world.terrain import GroundSource, TerrainSurface

Floats = NDArray[np.float64]

GROUND_MARGIN_M = 500.0
"""How far the ground plane goes on beyond everything; no sensor in the catalogue reaches farther."""


@dataclass(frozen=True)
class BuildCounts:
    """What was built (solids a kind), mended, left out, and is doubtful; shown to the user, kept in ``run.json``."""

    built: Counter[str] = field(default_factory=Counter)
    repaired: Counter[str] = field(default_factory=Counter)
    ignored: Counter[str] = field(default_factory=Counter)
    warnings: list[Diagnostic] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """As the stage reports it."""
        counts = {"built": self.built, "mended": self.repaired, "left_out": self.ignored}
        told = {WARNINGS_KEY: [warning.to_json() for warning in self.warnings]} if self.warnings else {}
        return {key: dict(sorted(counter.items())) for key, counter in counts.items()} | told


def build_world(
    scenario: Scenario, ground: GroundSource | None = None, progress: ProgressCallback = no_progress
) -> tuple[World, BuildCounts]:
    """The static world of a scenario, on a flat ground where no other is given; and what went into it.

    InputError when a file that the scenario names is not sound.
    """
    model, builder, world = scenario.statics, _Builder(), geolocation.scenario_georeference(scenario)
    read = [read_geojson(scenario.find(name, "statics.footprints"), world) for name in model.footprints]
    types = SolidTypes(model.polygon_types)
    polygons = [scenario.find(name, "statics.polygons") for name in model.polygons]
    read += [read_poly_xml(path, types, model.polygon_height_m, world) for path in polygons]
    for file in read:
        builder.counts.repaired.update(file.repaired)
        builder.counts.ignored.update(file.ignored)
        builder.counts.warnings.extend(file.warnings)
    footprints = [footprint for file in read for footprint in file.footprints]
    surface = None if ground is None else ground.ground(scenario, *_extent_m(scenario, footprints))
    for done, footprint in enumerate(footprints):
        standing = footprint if surface is None else _lift_to_surface(surface, footprint)
        builder.add(*_extrude(standing), footprint.name, footprint.kind)
        progress("footprints", done + 1, len(footprints))
    for mesh in model.meshes:
        _add_mesh(builder, scenario.find(mesh.file, "statics.meshes"), mesh, world)
    if model.ground:
        laid = _add_plane(builder, scenario) if surface is None else (surface.vertices_m, surface.faces)
        builder.add(*laid, "ground", "ground")
    return builder.world(), builder.counts


@dataclass
class _Builder:
    """Collects solids into one mesh, and counts."""

    vertices: list[Floats] = field(default_factory=list)
    faces: list[NDArray[np.int64]] = field(default_factory=list)
    solids: list[tuple[str, str]] = field(default_factory=list)
    counts: BuildCounts = field(default_factory=BuildCounts)
    _count: int = 0

    def add(self, vertices_m: Floats, faces: NDArray[np.int64], name: str, kind: str, form: str = "") -> None:
        """Add one solid; counted under its kind, and its ``form`` where that is no closed one."""
        self.vertices.append(np.asarray(vertices_m, dtype=np.float64))
        self.faces.append(np.asarray(faces, dtype=np.int64) + self._count)
        self.solids.append((name, kind))
        self._count += len(vertices_m)
        self.counts.built[kind + form] += 1

    def world(self) -> World:
        owner = [np.full(len(f), i, dtype=np.int32) for i, f in enumerate(self.faces)]
        return World(
            np.concatenate([np.empty((0, 3)), *self.vertices]),
            np.concatenate([np.empty((0, 3), dtype=np.int64), *self.faces]).astype(np.int32),
            np.concatenate([np.empty(0, dtype=np.int32), *owner]),
            tuple(self.solids),
        )


def _extrude(footprint: Footprint) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices and faces (outwards) of a closed prism over the footprint."""
    import trimesh

    mesh = trimesh.creation.extrude_polygon(footprint.polygon, footprint.height_m - footprint.base_m, engine="earcut")
    return np.asarray(mesh.vertices) + np.array([0.0, 0.0, footprint.base_m]), np.asarray(mesh.faces)


def _add_mesh(builder: _Builder, path: Path, model: MeshConfig, world: Georeference) -> None:
    """Each closed piece of a mesh becomes a solid, so that sites inside can be told; the rest stays one surface."""
    mesh = meshes.load_mesh(path, str(path))
    near = (np.abs(mesh.vertices) <= MAX_COORDINATE_M).all(axis=1)
    if not near.all():
        bad, right = int(np.flatnonzero(~near)[0]), f"finite coordinates, at most {MAX_COORDINATE_M:g} m"
        raise InputError(f"{path}: vertex {bad}", f"{mesh.vertices[bad].tolist()}", right)
    faces = len(mesh.faces)
    with translate_errors(path, meshes.MESH_HINT, "cannot be taken apart"):
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    if len(mesh.faces) == 0:
        raise InputError(path, f"none of its {faces} triangles has an area", "a triangle mesh")
    if dropped := faces - len(mesh.faces):
        builder.counts.repaired["degenerate or doubled triangles dropped"] += dropped
    triangles, vertices_m = np.asarray(mesh.faces, dtype=np.int64), _to_world(mesh.vertices, model, path, world)
    piece = mesh_components(mesh.face_adjacency, len(triangles))
    closed = are_closed(triangles, piece)
    order = np.argsort(piece, kind="stable")
    ends = np.cumsum(np.bincount(piece))
    for number in np.flatnonzero(closed).tolist():
        its = order[ends[number - 1] if number else 0 : ends[number]]
        used, corners = np.unique(triangles[its], return_inverse=True)
        builder.add(vertices_m[used], corners.reshape(-1, 3), f"{path.stem}_{number}", model.kind)
    if len(rest := order[~closed[piece[order]]]):
        name, form = f"{path.stem}_surface", " (open surface)"
        builder.add(vertices_m, triangles[rest], name, model.kind, form)


def _to_world(vertices_m: Floats, model: MeshConfig, path: Path, world: Georeference) -> Floats:
    """A mesh's vertices (n, 3) in the world frame: moved by its offset, then brought from its own system, if any."""
    placed: Floats = np.add(vertices_m, model.offset_m, dtype=np.float64)
    if model.system is None:
        world.check_metres(placed[:, :2], str(path), "Set offset_m, epsg or origin_deg beside the mesh's file.")
        return placed
    hint = "Set the epsg or the origin_deg that the mesh was made with."
    reading = world.read_coordinates(placed[:, :2], str(path), model.system, hint)
    return np.column_stack([reading.to_world(placed[:, :2]), placed[:, 2]])


def _add_plane(builder: _Builder, scenario: Scenario) -> tuple[Floats, NDArray[np.int64]]:
    """Two triangles at z = 0, facing up, well beyond the region of interest and everything that stands."""
    box = scenario.roi.box
    corners = np.array([box.origin_m, np.add(box.origin_m, box.size_m)])
    points = np.concatenate([corners, *builder.vertices])
    (x0, y0), (x1, y1) = points.min(axis=0)[:2] - GROUND_MARGIN_M, points.max(axis=0)[:2] + GROUND_MARGIN_M
    vertices = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])
    return vertices, np.array([[0, 1, 2], [0, 2, 3]])


def _extent_m(scenario: Scenario, footprints: Sequence[Footprint]) -> tuple[Floats, Floats]:
    """South-west and north-east corner (2,) of the ground: well beyond the region of interest and all footprints."""
    box = scenario.roi.box
    corners = np.array([box.origin_m, np.add(box.origin_m, box.size_m)])[:, :2]
    points = np.concatenate([corners, *(np.reshape(f.polygon.bounds, (2, 2)) for f in footprints)])
    return points.min(axis=0) - GROUND_MARGIN_M, points.max(axis=0) + GROUND_MARGIN_M


def _lift_to_surface(surface: TerrainSurface, footprint: Footprint) -> Footprint:
    """A footprint whose heights count from the ground."""
    centre = np.array([[footprint.polygon.centroid.x, footprint.polygon.centroid.y]])
    ground = float(surface.height_m(centre[:, 0], centre[:, 1])[0])
    base = ground + footprint.base_m
    if footprint.base_m <= 0:
        base = min(base, surface.lowest_m(np.asarray(footprint.polygon.exterior.coords)))
    return replace(footprint, base_m=base, height_m=ground + footprint.height_m)
