"""Holds the static world in memory and on disk.

``statics.ply`` is one binary triangle mesh in the world frame (float64 vertices, metres) that any viewer opens. Each
face has an extra ``int solid``; the header's comments name the solids, so that a message can say which building a site
stands in.

PLY is read and written here by hand: the layout, with ``solid`` a face, is exact to the byte, which plyfile and trimesh
do not promise, and reading is one view of the file's bytes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.core import files
from egvs.core.errors import InputError

_VERTEX = np.dtype([("xyz", "<f8", 3)])
_FACE = np.dtype([("n", "u1"), ("corners", "<i4", 3), ("solid", "<i4")])


@dataclass(frozen=True)
class World:
    """Triangles with the solids that they belong to.

    Attributes
    ----------
    vertices_m
        (n, 3) float64, world frame, metres.
    faces
        (m, 3) int32, counter-clockwise seen from outside.
    solid_of_face
        (m,) int32, index into ``solids``.
    solids
        (name, kind) of each solid, e.g. ("tower_NE", "building").
    """

    vertices_m: NDArray[np.float64]
    faces: NDArray[np.int32]
    solid_of_face: NDArray[np.int32]
    solids: tuple[tuple[str, str], ...]

    @cached_property
    def triangles_m(self) -> NDArray[np.float64]:
        """Corners of each triangle, (m, 3, 3), world frame."""
        return self.vertices_m[self.faces]

    @cached_property
    def bounds_xy_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest x and y of each triangle, (m, 2) each."""
        return self.triangles_m[:, :, :2].min(axis=1), self.triangles_m[:, :, :2].max(axis=1)

    @cached_property
    def closed(self) -> NDArray[np.bool_]:
        """Which solids are closed: each directed edge of their triangles is met by its opposite. (solids,) bool."""
        edges = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
        owner = np.repeat(self.solid_of_face, 3)
        up = edges[:, 0] < edges[:, 1]
        low, high = edges.min(axis=1), edges.max(axis=1)
        order = np.lexsort((high, low, owner))
        owner, low, high, turn = owner[order], low[order], high[order], np.where(up, 1, -1)[order]
        starts = np.ones(len(owner), dtype=bool)
        starts[1:] = (np.diff(owner) != 0) | (np.diff(low) != 0) | (np.diff(high) != 0)
        first = np.flatnonzero(starts)
        balance = np.add.reduceat(turn, first) if len(first) else np.empty(0, dtype=np.int64)
        is_closed = np.zeros(len(self.solids), dtype=bool)
        is_closed[self.solid_of_face] = True
        is_closed[owner[first[balance != 0]]] = False
        return is_closed

    @cached_property
    def signs(self) -> NDArray[np.int64]:
        """+1 for solids whose triangles face outwards, -1 for inwards (negative volume); (solids,) int64."""
        t = self.triangles_m - (self.vertices_m.mean(axis=0) if len(self.vertices_m) else 0.0)
        volume = np.einsum("ij,ij->i", t[:, 0], np.cross(t[:, 1], t[:, 2]))
        total = np.zeros(len(self.solids))
        np.add.at(total, self.solid_of_face, volume)
        return np.where(total < 0, -1, 1)


def write_ply(path: Path, world: World, metadata: dict[str, Any]) -> None:
    """Write ``world`` as binary PLY; the metadata and the solids' names go into the header's comments."""
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment egvs {_line(metadata)}",
        *(f"comment solid {_line(list(solid))}" for solid in world.solids),
        f"element vertex {len(world.vertices_m)}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {len(world.faces)}",
        "property list uchar int vertex_indices",
        "property int solid",
        "end_header",
    ]
    vertices = np.empty(len(world.vertices_m), dtype=_VERTEX)
    vertices["xyz"] = world.vertices_m
    faces = np.empty(len(world.faces), dtype=_FACE)
    faces["n"], faces["corners"], faces["solid"] = 3, world.faces, world.solid_of_face
    with files.atomic_write(path) as partial, partial.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(vertices.tobytes())
        file.write(faces.tobytes())


def read_ply(path: Path) -> tuple[World, dict[str, Any]]:
    """Read what :func:`write_ply` wrote: the world and the metadata. InputError when the file is not such a one."""
    if not path.is_file():
        raise InputError(path, "no such file", f"run the stage that makes {path.name} first")
    head, end, body = path.read_bytes().partition(b"end_header\n")
    try:
        vertex_count, face_count, metadata, solids = _header(head.decode("ascii"))
        size = vertex_count * _VERTEX.itemsize
        if not end or vertex_count < 0 or len(body) != size + face_count * _FACE.itemsize:
            raise ValueError
    except (ValueError, LookupError, TypeError, RecursionError):
        raise InputError(path, "is not a whole statics.ply", "run the statics stage again") from None
    vertices = np.frombuffer(body, dtype=_VERTEX, count=vertex_count)
    faces = np.frombuffer(body, dtype=_FACE, offset=size)
    _check_indices(path, faces, vertex_count, len(solids))
    if not np.isfinite(vertices["xyz"]).all():
        raise InputError(path, "a vertex is no number", "finite coordinates; run the statics stage again")
    return World(vertices["xyz"].copy(), faces["corners"].copy(), faces["solid"].copy(), solids), metadata


def _header(text: str) -> tuple[int, int, dict[str, Any], tuple[tuple[str, str], ...]]:
    """Vertices, faces, metadata and solids that a header names; an exception of Python's where it is none of ours."""
    lines = text.splitlines()
    comments = [line.removeprefix("comment ").split(" ", 1) for line in lines if line.startswith("comment ")]
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element ")}
    word, metadata = comments[0][0], json.loads(comments[0][1])
    if word != "egvs" or not isinstance(metadata, dict):
        raise ValueError
    solids = tuple((str(n), str(k)) for n, k in (json.loads(text) for word, text in comments if word == "solid"))
    return counts["vertex"], counts["face"], metadata, solids


def _check_indices(path: Path, faces: NDArray[np.void], vertices: int, solids: int) -> None:
    """InputError unless every triangle is one, of vertices and a solid that are there."""
    right = "run the statics stage again"
    if bad := np.flatnonzero(faces["n"] != 3).tolist():
        raise InputError(path, f"face {bad[0]} has {faces['n'][bad[0]]} corners", f"triangles; {right}")
    for what, index, count in (("vertex", faces["corners"], vertices), ("solid", faces["solid"], solids)):
        if len(index) and not (index.min() >= 0 and index.max() < count):
            worst = index.min() if index.min() < 0 else index.max()
            raise InputError(path, f"a triangle names {what} {worst} of {count}", f"0 to {count - 1}; {right}")


def _line(value: Any) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
