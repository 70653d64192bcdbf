"""What stands at the junction, as triangles?

Steps: read footprints (GeoJSON polygons, lines, points; SUMO .poly.xml) and meshes; mend or refuse what is not sound,
and count what was mended; extrude footprints between ``base_m`` and ``height_m``; lay a ground plane at z = 0; write it
all as one triangle mesh, ``statics.ply``, in the world frame in metres.

``height_m`` is the z of the top, ``base_m`` (default 0) the z of the underside. Points are discs of ``radius_m``, lines
are strips of that half width. Where the network has relief, the ground follows its roads
(:mod:`pipeline.effects.traffic.slope`), and both heights count from the ground below the footprint's centre; what
stands on the ground reaches down to the lowest of it."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.core.progress import Progress, silent
from pipeline.formats import safe_xml as safexml
from pipeline.scenario.models import MeshModel, Scenario
from pipeline.scenario.types import FARTHEST_M
from pipeline.stages.base import metadata
from pipeline.traffic import network
from pipeline.world.mesh import World, write_ply

if TYPE_CHECKING:
    from shapely import Polygon
    from shapely.geometry.base import BaseGeometry

    from pipeline.effects.traffic.slope import Surface

NAME = "statics"
ARTEFACTS = ("statics.ply",)

GROUND_MARGIN_M = 500.0
"""How far the ground plane goes on beyond everything; more than any sensor in the catalogue reaches."""

_QUARTER_SIDES = 4  # a disc is a regular polygon of four times as many sides


@dataclass(frozen=True)
class Footprint:
    """A polygon (world frame, metres, may have holes) that is extruded from ``base_m`` to ``height_m``."""

    name: str
    kind: str
    polygon: Polygon
    base_m: float
    height_m: float


@dataclass
class Tally:
    """What was built, mended and left out; shown to the user and kept in ``run.json``."""

    built: Counter[str]
    mended: Counter[str]
    left_out: Counter[str]

    @classmethod
    def empty(cls) -> Tally:
        """A tally of nothing."""
        return cls(Counter(), Counter(), Counter())


def inputs(scenario: Scenario, out: Path) -> dict[str, Any]:
    """The statics settings, the region of interest (for the ground's extent), and the files' hashes."""
    del out
    model = scenario.statics
    named = [*(("footprints", f) for f in model.footprints), *(("polygons", f) for f in model.polygons),
             *(("meshes", m.file) for m in model.meshes)]  # fmt: skip
    box = scenario.roi.box
    hilly = {"surface": files.sha256_of(path)} if (path := _hilly(scenario)) is not None else {}
    return {
        "settings": {
            "name": scenario.name,
            "statics": model.model_dump(mode="json"),
            "roi": [box.origin_m, box.size_m],
        },
        "files": {name: files.sha256_of(scenario.find(name, f"statics.{key}")) for key, name in named} | hilly,
    }


def run(scenario: Scenario, out: Path, *, jobs: int | None = None, progress: Progress = silent) -> dict[str, Any]:
    """Build the static world and write ``statics.ply``.

    Returns
    -------
    dict
        ``triangles``; ``built`` (solids a kind), ``mended`` and ``left_out`` (how often each mend or omission was
        needed).
    """
    del jobs
    read = inputs(scenario, out)
    tally = Tally.empty()
    world = build(scenario, tally, progress)
    write_ply(out / ARTEFACTS[0], world, metadata(scenario, read, seed=None))
    notes = {"notes": ["slope: on, the ground follows the network's roads"]} if "surface" in read["files"] else {}
    return {
        "triangles": len(world.faces),
        "solids": len(world.solids),
        "built": dict(sorted(tally.built.items())),
        "mended": dict(sorted(tally.mended.items())),
        "left_out": dict(sorted(tally.left_out.items())),
        **notes,
    }


def build(scenario: Scenario, tally: Tally, progress: Progress = silent) -> World:
    """The static world of a scenario; ``tally`` is filled."""
    model = scenario.statics
    footprints: list[Footprint] = []
    for name in model.footprints:
        footprints += _geojson(scenario.find(name, "statics.footprints"), tally)
    for name in model.polygons:
        footprints += _poly_xml(scenario.find(name, "statics.polygons"), model.polygon_height_m, tally)
    builder = _Builder()
    if (surface := _surface(scenario, footprints)) is not None:
        footprints = [_on(surface, footprint) for footprint in footprints]
    for done, footprint in enumerate(footprints):
        builder.add(*_extrude(footprint), footprint.name, footprint.kind)
        tally.built[footprint.kind] += 1
        progress("footprints", done + 1, len(footprints))
    for mesh in model.meshes:
        _add_mesh(builder, scenario.find(mesh.file, "statics.meshes"), mesh, tally)
    if model.ground:
        laid = _ground(builder, scenario) if surface is None else (surface.vertices_m, surface.faces)
        builder.add(*laid, "ground", "ground")
        tally.built["ground"] += 1
    return builder.world()


class _Builder:
    """Collects solids into one mesh."""

    def __init__(self) -> None:
        self.vertices: list[NDArray[np.float64]] = []
        self.faces: list[NDArray[np.int64]] = []
        self.solids: list[tuple[str, str]] = []
        self._count = 0

    def add(self, vertices_m: NDArray[np.float64], faces: NDArray[np.int64], name: str, kind: str) -> None:
        self.vertices.append(np.asarray(vertices_m, dtype=np.float64))
        self.faces.append(np.asarray(faces, dtype=np.int64) + self._count)
        self.solids.append((name, kind))
        self._count += len(vertices_m)

    def world(self) -> World:
        owner = [np.full(len(f), i, dtype=np.int32) for i, f in enumerate(self.faces)]
        return World(
            np.concatenate([np.empty((0, 3)), *self.vertices]),
            np.concatenate([np.empty((0, 3), dtype=np.int64), *self.faces]).astype(np.int32),
            np.concatenate([np.empty(0, dtype=np.int32), *owner]),
            tuple(self.solids),
        )


def _geojson(path: Path, tally: Tally) -> Iterator[Footprint]:
    """Footprints of a GeoJSON FeatureCollection in world-frame metres."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(path, f"is not valid JSON: {error}", "a GeoJSON FeatureCollection") from None
    if not isinstance(document, dict) or not isinstance(document.get("features"), list):
        raise InputError(path, "has no list of features", "a GeoJSON FeatureCollection in world-frame metres")
    for number, feature in enumerate(document["features"]):
        place = f"{path}: feature {number}"
        if not isinstance(feature, dict) or not isinstance(feature.get("properties") or {}, dict):
            raise InputError(place, "is not a GeoJSON feature", "an object with geometry and properties")
        properties = feature.get("properties") or {}
        name = str(properties.get("name", f"{path.stem}_{number}"))
        place = f"{place} ({name})"
        height, base = _metres(properties, "height_m", place), _metres(properties, "base_m", place, 0.0)
        if not height > base:
            raise InputError(place, f"height_m = {height:g} with base_m = {base:g}", "a top above the underside")
        kind = str(properties.get("kind", "footprint"))
        for part in _polygons(feature.get("geometry"), properties, place, tally):
            yield Footprint(name, kind, part, base, height)


def _metres(properties: dict[str, Any], key: str, place: str, default: float | None = None) -> float:
    value = properties.get(key, default)
    if value is None:
        raise InputError(place, f"{key} is missing", "a number of metres")
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= FARTHEST_M:
        raise InputError(f"{place}: {key}", f"{value!r}", f"a finite number of metres, at most {FARTHEST_M:g}")
    return float(value)


def _polygons(geometry: Any, properties: dict[str, Any], place: str, tally: Tally) -> list[Polygon]:
    """The polygons of one feature: lines and points buffered, dirt mended, multi-part geometries taken apart."""
    import shapely

    try:
        with np.errstate(invalid="ignore"):  # what is no number is refused below
            shape: BaseGeometry = shapely.geometry.shape(geometry)
        coordinates = shapely.get_coordinates(shape)
    except (
        shapely.errors.ShapelyError,
        TypeError,
        ValueError,
        KeyError,
        AttributeError,
        IndexError,
        RecursionError,
    ) as error:
        raise InputError(f"{place}: geometry", f"cannot be understood ({error})", "a GeoJSON geometry") from None
    if shape.is_empty or not np.isfinite(coordinates).all():
        raise InputError(f"{place}: geometry", "is empty or has a coordinate that is no number", "finite metres")
    if np.abs(coordinates).max() > FARTHEST_M:
        raise InputError(
            f"{place}: geometry",
            f"lies {np.abs(coordinates).max():g} m from the world's zero",
            f"within {FARTHEST_M:g} m",
        )
    if shapely.has_z(shape) and np.any(shapely.get_coordinates(shape, include_z=True)[:, 2] != 0):
        raise InputError(
            f"{place}: geometry", "has z coordinates", "two coordinates a point; heights go into base_m, height_m"
        )
    if shape.geom_type.endswith(("Point", "LineString")):
        radius = _metres(properties, "radius_m", place)
        if radius <= 0:
            raise InputError(f"{place}: radius_m", f"{radius:g}", "above 0")
        shape = shape.buffer(
            radius, quad_segs=_QUARTER_SIDES, cap_style="flat" if "Line" in shape.geom_type else "round"
        )
    elif "Polygon" not in shape.geom_type:
        raise InputError(
            f"{place}: geometry", f"is a {shape.geom_type}", "a Polygon, LineString or Point, or their Multi forms"
        )
    parts = [p for p in shapely.get_parts(_sound(shape, place, tally)) if "Polygon" in p.geom_type]
    if not parts:
        raise InputError(f"{place}: geometry", "encloses no area", "a polygon with three corners that are not in line")
    return parts


def _sound(shape: BaseGeometry, place: str, tally: Tally) -> BaseGeometry:
    """Mend what has one meaning only (doubled points, rings that touch themselves); refuse what has two."""
    import shapely

    if not shapely.is_valid(shape):
        reason = shapely.is_valid_reason(shape)
        if not reason.startswith("Ring Self-intersection"):
            raise InputError(
                f"{place}: geometry", f"is not a sound polygon ({reason})", "rings that do not cross, holes inside"
            )
        shape = shapely.make_valid(shape)
        tally.mended["rings that touched themselves"] += 1
    clean = shapely.remove_repeated_points(shape)
    tally.mended["doubled points"] += len(shapely.get_coordinates(shape)) - len(shapely.get_coordinates(clean))
    tally.mended += Counter()  # drops zero entries
    return shapely.orient_polygons(clean)


def _poly_xml(path: Path, height_m: float, tally: Tally) -> Iterator[Footprint]:
    """Footprints of a SUMO .poly.xml; a ``height`` parameter overrides the default height."""
    for number, element in enumerate(safexml.children(path, "additional")):
        if element.tag != "poly":
            tally.left_out[f"<{element.tag}> of .poly.xml"] += 1
            continue
        name = element.get("id", f"{path.stem}_{number}")
        place = f"{path}: poly {name}"
        if element.get("geo", "false").lower() in ("true", "1"):
            raise InputError(place, "has longitude and latitude (geo)", "a shape in the network's metres")
        try:
            points = [tuple(float(v) for v in pair.split(",")[:2]) for pair in element.get("shape", "").split()]
            top = next((float(p.get("value", "")) for p in element if p.get("key") == "height"), height_m)
        except ValueError as error:
            raise InputError(
                place, f"has a value that is no number ({error})", "shape='x,y x,y ...' in metres"
            ) from None
        if element.get("fill", "false").lower() not in ("true", "1") or len(points) < 3:
            tally.left_out["lines of .poly.xml"] += 1
            continue
        ring = [*points, points[0]]
        for part in _polygons({"type": "Polygon", "coordinates": [ring]}, {}, place, tally):
            yield Footprint(name, element.get("type", "polygon"), part, 0.0, top)


def _extrude(footprint: Footprint) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices and faces (outwards) of a closed prism over the footprint."""
    import trimesh

    mesh = trimesh.creation.extrude_polygon(footprint.polygon, footprint.height_m - footprint.base_m, engine="earcut")
    return np.asarray(mesh.vertices) + np.array([0.0, 0.0, footprint.base_m]), np.asarray(mesh.faces)


def _add_mesh(builder: _Builder, path: Path, model: MeshModel, tally: Tally) -> None:
    """A mesh file: each closed piece becomes a solid of its own, so that sites inside can be told; the rest stays
    surface."""
    import trimesh

    try:
        mesh = trimesh.load(path, force="mesh", process=False)
    except (ValueError, LookupError, OSError, NotImplementedError, AttributeError, TypeError, ImportError) as error:
        raise InputError(path, f"cannot be loaded ({error})", "a mesh that trimesh reads: PLY, OBJ, STL, GLB") from None
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError(path, "holds no triangles", "a triangle mesh")
    near = (np.abs(mesh.vertices) <= FARTHEST_M).all(axis=1)
    if not near.all():
        bad = int(np.flatnonzero(~near)[0])
        raise InputError(
            f"{path}: vertex {bad}", f"{mesh.vertices[bad].tolist()}", f"finite coordinates, at most {FARTHEST_M:g} m"
        )
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise InputError(path, f"a triangle names vertex {mesh.faces.max()} of {len(mesh.vertices)}", "a whole mesh")
    faces = len(mesh.faces)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    if len(mesh.faces) == 0:
        raise InputError(path, f"none of its {faces} triangles has an area", "a triangle mesh")
    if dropped := faces - len(mesh.faces):
        tally.mended["degenerate or doubled triangles dropped"] += dropped
    pieces = trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(mesh.faces)), min_len=1)
    offset, surface = np.asarray(model.offset_m), [np.empty(0, dtype=np.int64)]
    for number, piece in enumerate(sorted((np.sort(p) for p in pieces), key=lambda p: int(p[0]))):
        part = trimesh.Trimesh(mesh.vertices, mesh.faces[piece], process=False)
        if part.is_watertight and part.is_winding_consistent:
            part.remove_unreferenced_vertices()
            builder.add(part.vertices + offset, part.faces, f"{path.stem}_{number}", model.kind)
            tally.built[model.kind] += 1
        else:
            surface.append(piece)
    if len(rest := np.concatenate(surface)):
        builder.add(mesh.vertices + offset, mesh.faces[rest], f"{path.stem}_surface", model.kind)
        tally.built[f"{model.kind} (open surface)"] += 1


def _ground(builder: _Builder, scenario: Scenario) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Two triangles at z = 0, facing up, well beyond the region of interest and everything that stands."""
    box = scenario.roi.box
    corners = np.array([box.origin_m, np.add(box.origin_m, box.size_m)])
    points = np.concatenate([corners, *builder.vertices])
    (x0, y0), (x1, y1) = points.min(axis=0)[:2] - GROUND_MARGIN_M, points.max(axis=0)[:2] + GROUND_MARGIN_M
    vertices = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])
    return vertices, np.array([[0, 1, 2], [0, 2, 3]])


def _hilly(scenario: Scenario) -> Path | None:
    """The network that the ground follows; None where it is flat, which imports no effect."""
    path = network.path_of(scenario)
    if path is None or not network.may_have_heights(path):
        return None
    from pipeline.effects.traffic import slope

    return path if slope.decide(scenario)[0] else None


def _surface(scenario: Scenario, footprints: list[Footprint]) -> Surface | None:
    """The ground over the region of interest and everything that stands, and well beyond, where the network has
    relief."""
    if (path := _hilly(scenario)) is None:
        return None
    from pipeline.effects.traffic import slope

    box = scenario.roi.box
    corners = [np.array([box.origin_m, np.add(box.origin_m, box.size_m)])[:, :2]]
    points = np.concatenate([*corners, *(np.reshape(f.polygon.bounds, (2, 2)) for f in footprints)])
    return slope.ground(path, points.min(axis=0) - GROUND_MARGIN_M, points.max(axis=0) + GROUND_MARGIN_M)


def _on(surface: Surface, footprint: Footprint) -> Footprint:
    """A footprint whose heights count from the ground."""
    centre = np.array([[footprint.polygon.centroid.x, footprint.polygon.centroid.y]])
    ground = float(surface.height_m(centre[:, 0], centre[:, 1])[0])
    base = ground + footprint.base_m
    if footprint.base_m <= 0:
        base = min(base, surface.lowest_m(np.asarray(footprint.polygon.exterior.coords)))
    return replace(footprint, base_m=base, height_m=ground + footprint.height_m)
