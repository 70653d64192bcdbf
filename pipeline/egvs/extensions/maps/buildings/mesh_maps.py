"""Reader of triangle meshes: glTF, OBJ, PLY, STL, OFF.

These formats have no reference system, so their files need an alignment (``--align``). Their unit is the metre. In glTF
the y axis points up (glTF 2.0, 3.4) and -z north; in the other formats z points up. Heights count from the ground: on a
slope, z = 0 of a file is the ground below the middle of its meshes.

Each closed piece of a file is a mesh of its own, so that a point inside can be recognised; the rest is one open mesh.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from egvs.core.grid import FloatArray
from egvs.creation.map_parts import OUT_OF_RANGE, ImportCounts, MapContext, MappedMesh, SolidMap
from egvs.formats import meshes
from egvs.scenario.fields import MAX_COORDINATE_M

if TYPE_CHECKING:
    import trimesh

_KIND = "mesh"
_Y_UP = (".gltf", ".glb")


def can_open(path: Path, head: bytes) -> bool:
    """Return whether a file is a mesh; a PLY without faces is a point cloud."""
    suffix = path.suffix.lower()
    if suffix == ".ply":
        return has_faces(head)
    return suffix.removeprefix(".") in meshes.MESH_FORMATS


def has_faces(head: bytes) -> bool:
    """Return whether the header of a PLY file declares faces."""
    declared = re.search(rb"element face +(\d+)", head.partition(b"end_header")[0])
    return declared is not None and int(declared[1]) > 0


def read_solids(paths: Sequence[Path], context: MapContext) -> SolidMap:
    """Return the meshes in the window; InputError when a file is damaged, or no alignment is given."""
    counts = ImportCounts()
    notes = []
    mapped: list[MappedMesh] = []
    for path in paths:
        mesh, _ = meshes.load_clean_mesh(path, MAX_COORDINATE_M)
        if path.suffix.lower() in _Y_UP:
            notes.append(f"{path.name}: its y axis is taken as up, as glTF defines it.")
        mapped += _pieces(mesh, _to_world(mesh, path, context), path.stem, context, counts)
    return SolidMap(meshes=tuple(_number_equal_names(mapped)), counts=counts, notes=tuple(notes))


def _to_world(mesh: trimesh.Trimesh, path: Path, context: MapContext) -> FloatArray:
    """Return the vertices (n, 3): x and y in the world frame, z as in the file, in metres."""
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    if path.suffix.lower() in _Y_UP:
        vertices = vertices[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
    xy_m = context.to_world(vertices[:, :2], None, str(path))
    return np.column_stack([xy_m, vertices[:, 2] * context.height_unit(None, str(path)).metres])


def _pieces(
    mesh: trimesh.Trimesh, vertices_m: FloatArray, stem: str, context: MapContext, counts: ImportCounts
) -> Iterator[MappedMesh]:
    """Yield the closed pieces of a mesh in the window, then the rest."""
    faces = np.asarray(mesh.faces, dtype=np.int64)
    closed_pieces, rest = meshes.divide_mesh(mesh)
    parts = [(f"{stem}_{number}", triangles, True) for number, triangles in closed_pieces.items()]
    if len(rest):
        parts.append((f"{stem}_surface", rest, False))
    for name, triangles, closed in parts:
        used, corners = np.unique(faces[triangles], return_inverse=True)
        low, high = vertices_m[used, :2].min(axis=0), vertices_m[used, :2].max(axis=0)
        if not context.window.intersects(shapely.box(*low, *high)):
            counts.drop(_KIND, OUT_OF_RANGE)
            continue
        counts.objects[_KIND] += 1
        counts.heights.setdefault(_KIND, Counter())["geometry"] += 1
        yield MappedMesh(name, _KIND, vertices_m[used], corners.reshape(-1, 3), closed, group=stem)


def _number_equal_names(mapped: Sequence[MappedMesh]) -> Iterator[MappedMesh]:
    """Yield meshes with names that differ."""
    times: Counter[str] = Counter()
    for mesh in mapped:
        times[mesh.name] += 1
        name = mesh.name if times[mesh.name] == 1 else f"{mesh.name}#{times[mesh.name]}"
        yield replace(mesh, name=name)
