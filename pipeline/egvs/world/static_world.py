"""Build the static world of a scenario as one triangle mesh.

Steps: read footprints (:mod:`egvs.world.footprints`) and extrude them from ``base_m`` to ``height_m``; divide meshes
into closed solids and open surfaces; add a ground plane at z = 0. World frame, metres.

A ground with relief replaces the plane. Then both heights of a footprint are relative to the ground below its centre,
and objects that stand on the ground reach down to its lowest point along their outline. Footprints that state heights
of the world frame (``z_datum``), such as exported ones, stay as they are.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from egvs.core.errors import WARNINGS_KEY, Diagnostic, InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.core.progress import ProgressCallback, no_progress
from egvs.formats import meshes
from egvs.formats.georeference import Georeference
from egvs.scenario.fields import MAX_COORDINATE_M
from egvs.scenario.model import MeshConfig, Scenario
from egvs.world import geolocation
from egvs.world.extrusion import extrude_polygon
from egvs.world.footprints import GROUND_DATUM, Footprint, read_footprints
from egvs.world.mesh import World

if TYPE_CHECKING:
    from egvs.world.terrain import GroundSource, TerrainSurface


GROUND_MARGIN_M = 500.0
"""Margin of the ground plane around everything; no sensor of the catalogue has a longer range."""


@dataclass(frozen=True)
class SolidSource:
    """The solids of a file, from the number ``first`` to before ``end``; ``key`` of the scenario names the file."""

    key: str
    name: str
    first: int
    end: int

    @property
    def where(self) -> str:
        """The key and the file, for messages."""
        return f"{self.key} = {self.name!r}"

    def zero_hint(self, change_m: float) -> str:
        """Return how to change where the heights of the file count from, by a number of metres."""
        change = f"{change_m:+,.1f} m"
        if self.key == MESHES:
            return f"Add {change} to the third number of its offset_m."
        if self.key == _POLYGONS:
            return f"Add {change} to its heights (height, min_height): they count from the ground."
        return f"Add {change} to base_m and height_m: they count from the ground, or with z_datum = 'world' from z = 0."


_FOOTPRINTS, _POLYGONS, MESHES = "statics.footprints", "statics.polygons", "statics.meshes"


@dataclass(frozen=True)
class BuildCounts:
    """What was built (solids by kind), repaired and left out, with counts; warnings; the solids of each file."""

    built: Counter[str] = field(default_factory=Counter)
    repaired: Counter[str] = field(default_factory=Counter)
    ignored: Counter[str] = field(default_factory=Counter)
    warnings: list[Diagnostic] = field(default_factory=list)
    sources: list[SolidSource] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """Return the form in the summary of a stage."""
        counts = {"built": self.built, "mended": self.repaired, "left_out": self.ignored}
        summary: dict[str, Any] = {key: dict(sorted(counter.items())) for key, counter in counts.items()}
        if self.warnings:
            summary[WARNINGS_KEY] = [warning.to_json() for warning in self.warnings]
        return summary


def build_world(
    scenario: Scenario, ground: GroundSource | None = None, progress: ProgressCallback = no_progress
) -> tuple[World, BuildCounts]:
    """Build the static world of a scenario.

    Parameters
    ----------
    scenario
        The scenario.
    ground
        Provides a ground with relief. By default, the ground is flat.
    progress
        Called for each footprint.

    Returns
    -------
    world, counts
        The mesh, and what it was made from.

    Raises
    ------
    InputError
        When a file of the scenario is invalid.
    """
    config = scenario.statics
    builder = _Builder()
    world = geolocation.scenario_georeference(scenario)
    files = [read_footprints(scenario.find(name, _FOOTPRINTS), world) for name in config.footprints]
    names = [(_FOOTPRINTS, name) for name in config.footprints]
    if config.polygons:
        from egvs.world.map_features import SolidTypes
        from egvs.world.sumo_polygons import read_poly_location, read_poly_xml

        types = SolidTypes(config.polygon_types)
        location = geolocation.network_location(scenario)
        for name in config.polygons:
            path = scenario.find(name, _POLYGONS)
            files.append(read_poly_xml(path, types, config.polygon_height_m, world, location))
            names.append((_POLYGONS, name))
            location = location or read_poly_location(path)
    footprints: list[Footprint] = []
    for (key, name), file in zip(names, files, strict=True):
        first = len(footprints)
        footprints += file.footprints
        builder.counts.sources.append(SolidSource(key, name, first, len(footprints)))
        builder.counts.repaired.update(file.repaired)
        builder.counts.ignored.update(file.ignored)
        builder.counts.warnings.extend(file.warnings)

    surface = None
    if ground is not None:
        surface = ground.ground(scenario, *_ground_extent_m(scenario, footprints))
    for done, footprint in enumerate(footprints):
        counts_from_ground = footprint.z_datum == GROUND_DATUM
        lifted = _lift_to_surface(surface, footprint) if surface is not None and counts_from_ground else footprint
        builder.add(*_extrude(lifted), footprint.name, footprint.kind)
        progress("footprints", done + 1, len(footprints))
    for mesh in config.meshes:
        first = len(builder.solids)
        _add_mesh(builder, scenario.find(mesh.file, MESHES), mesh, world)
        builder.counts.sources.append(SolidSource(MESHES, mesh.file, first, len(builder.solids)))
    if config.ground and surface is not None:
        builder.add(surface.vertices_m, surface.faces, "ground", "ground")
    elif config.ground:
        builder.add(*_ground_plane(builder, scenario), "ground", "ground")
    return builder.world(), builder.counts


@dataclass
class _Builder:
    """Collects solids in one mesh, and counts them."""

    vertices: list[FloatArray] = field(default_factory=list)
    faces: list[IntArray] = field(default_factory=list)
    solids: list[tuple[str, str]] = field(default_factory=list)
    counts: BuildCounts = field(default_factory=BuildCounts)
    _vertex_count: int = 0

    def add(self, vertices_m: FloatArray, faces: IntArray, name: str, kind: str, suffix: str = "") -> None:
        """Add a solid; it is counted as its kind with ``suffix``."""
        self.vertices.append(np.asarray(vertices_m, dtype=np.float64))
        self.faces.append(np.asarray(faces, dtype=np.int64) + self._vertex_count)
        self.solids.append((name, kind))
        self._vertex_count += len(vertices_m)
        self.counts.built[kind + suffix] += 1

    def world(self) -> World:
        solid_of_face = [np.full(len(faces), number, dtype=np.int32) for number, faces in enumerate(self.faces)]
        return World(
            np.concatenate([np.empty((0, 3)), *self.vertices]),
            np.concatenate([np.empty((0, 3), dtype=np.int64), *self.faces]).astype(np.int32),
            np.concatenate([np.empty(0, dtype=np.int32), *solid_of_face]),
            tuple(self.solids),
        )


def _extrude(footprint: Footprint) -> tuple[FloatArray, IntArray]:
    """Return vertices and faces (outwards) of a closed prism over a footprint."""
    vertices_m, faces = extrude_polygon(footprint.polygon, footprint.height_m - footprint.base_m)
    return vertices_m + np.array([0.0, 0.0, footprint.base_m]), faces


def _add_mesh(builder: _Builder, path: Path, config: MeshConfig, world: Georeference) -> None:
    """Add each closed piece of a mesh as a solid, so that sites inside are detected; the rest is one open surface."""
    if meshes.is_exported_scene(path):
        hint = "Use statics.ply of that run: the same solids in the world frame, z up, without sensors."
        raise InputError(path, "is the exported scene of a run, with y up and with its sensors and ground", hint)
    mesh, dropped = meshes.load_clean_mesh(path, MAX_COORDINATE_M)
    if dropped:
        builder.counts.repaired["degenerate or doubled triangles dropped"] += dropped

    triangles = np.asarray(mesh.faces, dtype=np.int64)
    vertices_m = _to_world(mesh.vertices, config, path, world)
    closed, rest = meshes.divide_mesh(mesh)
    for number, piece in closed.items():
        used, corners = np.unique(triangles[piece], return_inverse=True)
        builder.add(vertices_m[used], corners.reshape(-1, 3), f"{path.stem}_{number}", config.kind)
    if len(rest):
        builder.add(vertices_m, triangles[rest], f"{path.stem}_surface", config.kind, " (open surface)")


def _to_world(vertices_m: FloatArray, config: MeshConfig, path: Path, world: Georeference) -> FloatArray:
    """Return the vertices of a mesh (n, 3) in the world frame."""
    moved: FloatArray = np.add(vertices_m, config.offset_m, dtype=np.float64)
    if config.crs is None:
        world.check_metres(moved[:, :2], str(path), "Set offset_m, epsg or origin_deg beside the mesh's file.")
        return moved
    hint = "Set the epsg or the origin_deg that the mesh was made with."
    reading = world.read_coordinates(moved[:, :2], str(path), config.crs, hint)
    return np.column_stack([reading.to_world(moved[:, :2]), moved[:, 2]])


def _roi_corners_m(scenario: Scenario) -> FloatArray:
    """Return the lowest and the highest corner of the region of interest, (2, 3)."""
    box = scenario.roi.box
    return np.array([box.origin_m, np.add(box.origin_m, box.size_m)])


def _ground_plane(builder: _Builder, scenario: Scenario) -> tuple[FloatArray, IntArray]:
    """Return two triangles at z = 0, facing up, with a margin around the region of interest and all solids."""
    points = np.concatenate([_roi_corners_m(scenario), *builder.vertices])
    x0, y0 = points.min(axis=0)[:2] - GROUND_MARGIN_M
    x1, y1 = points.max(axis=0)[:2] + GROUND_MARGIN_M
    vertices = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])
    return vertices, np.array([[0, 1, 2], [0, 2, 3]])


def _ground_extent_m(scenario: Scenario, footprints: Sequence[Footprint]) -> tuple[FloatArray, FloatArray]:
    """Return the corners (2,) of the ground: with a margin around the region of interest and all footprints."""
    bounds = [np.reshape(footprint.polygon.bounds, (2, 2)) for footprint in footprints]
    points = np.concatenate([_roi_corners_m(scenario)[:, :2], *bounds])
    return points.min(axis=0) - GROUND_MARGIN_M, points.max(axis=0) + GROUND_MARGIN_M


def _lift_to_surface(surface: TerrainSurface, footprint: Footprint) -> Footprint:
    """Return a footprint with heights above the ground converted to z."""
    centre = footprint.polygon.centroid
    ground_m = float(surface.height_m(np.array([centre.x]), np.array([centre.y]))[0])
    base_m = ground_m + footprint.base_m
    if footprint.base_m <= 0:
        base_m = min(base_m, surface.lowest_m(np.asarray(footprint.polygon.exterior.coords)))
    return replace(footprint, base_m=base_m, height_m=ground_m + footprint.height_m)
