"""The static world as a triangle mesh, in memory and in ``statics.ply``.

``statics.ply`` is one binary triangle mesh in the world frame (float64 vertices, metres) that any viewer opens. Each
face has an additional ``int solid``; comments in the header name the solids, so that a message can tell which building
a site is in.

PLY is read and written here rather than with plyfile or trimesh: they do not guarantee the exact bytes, and reading is
one view of the file's bytes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from egvs.core import files
from egvs.core.digests import open_input
from egvs.core.errors import InputError
from egvs.core.grid import BoolArray, FloatArray, IntArray

_VERTEX = np.dtype([("xyz", "<f8", 3)])
_FACE = np.dtype([("n", "u1"), ("corners", "<i4", 3), ("solid", "<i4")])
_RUN_STATICS = "Run the statics stage again."


@dataclass(frozen=True)
class World:
    """Triangles and the solids that they belong to.

    Attributes
    ----------
    vertices_m
        (n, 3) float64, world frame, metres.
    faces
        (m, 3) int32, counter-clockwise from outside.
    solid_of_face
        (m,) int32, index into ``solids``.
    solids
        (name, kind) of each solid, e.g. ("tower_NE", "building").
    """

    vertices_m: FloatArray
    faces: NDArray[np.int32]
    solid_of_face: NDArray[np.int32]
    solids: tuple[tuple[str, str], ...]

    @cached_property
    def triangles_m(self) -> FloatArray:
        """Corners of each triangle, (m, 3, 3), world frame."""
        return self.vertices_m[self.faces]

    @cached_property
    def bounds_xy_m(self) -> tuple[FloatArray, FloatArray]:
        """Minimum and maximum x and y of each triangle, (m, 2) each."""
        return self.triangles_m[:, :, :2].min(axis=1), self.triangles_m[:, :, :2].max(axis=1)

    @cached_property
    def closed(self) -> BoolArray:
        """Whether each solid is closed: each directed edge of its triangles has an opposite one. (solids,) bool."""
        edges = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
        solid = np.repeat(self.solid_of_face, 3)
        direction = np.where(edges[:, 0] < edges[:, 1], 1, -1)
        low = edges.min(axis=1)
        high = edges.max(axis=1)
        order = np.lexsort((high, low, solid))
        solid = solid[order]
        starts = np.ones(len(solid), dtype=bool)
        starts[1:] = (np.diff(solid) != 0) | (np.diff(low[order]) != 0) | (np.diff(high[order]) != 0)
        first = np.flatnonzero(starts)
        is_closed = np.zeros(len(self.solids), dtype=bool)
        is_closed[self.solid_of_face] = True
        if len(first):
            is_unbalanced = np.add.reduceat(direction[order], first) != 0
            is_closed[solid[first[is_unbalanced]]] = False
        return is_closed

    @cached_property
    def signs(self) -> IntArray:
        """+1 for solids whose triangles face outwards, -1 for inwards (negative volume); (solids,) int64."""
        centre = self.vertices_m.mean(axis=0) if len(self.vertices_m) else 0.0
        t = self.triangles_m - centre
        volume = np.einsum("ij,ij->i", t[:, 0], np.cross(t[:, 1], t[:, 2]))
        total = np.zeros(len(self.solids))
        np.add.at(total, self.solid_of_face, volume)
        return np.where(total < 0, -1, 1)


def write_ply(path: Path, world: World, metadata: dict[str, Any]) -> None:
    """Write a world as binary PLY.

    Parameters
    ----------
    path
        The file.
    world
        The mesh; the names of its solids go into comments of the header.
    metadata
        Goes into a comment of the header, as JSON.
    """
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment egvs {_to_line(metadata)}",
        *(f"comment solid {_to_line(list(solid))}" for solid in world.solids),
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
    faces["n"] = 3
    faces["corners"] = world.faces
    faces["solid"] = world.solid_of_face
    with files.atomic_write(path) as partial, partial.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(vertices.tobytes())
        file.write(faces.tobytes())


def read_ply(path: Path) -> tuple[World, dict[str, Any]]:
    """Read a world and its metadata from a file that :func:`write_ply` wrote; InputError for any other file."""
    if not path.is_file():
        raise InputError(path, "no such file", f"Run the stage that writes {path.name} first.")
    with open_input(path) as file:
        head, end, body = file.read().partition(b"end_header\n")
    try:
        header = _parse_header(head.decode("ascii"))
        size = header.vertices * _VERTEX.itemsize
        if not end or header.vertices < 0 or len(body) != size + header.faces * _FACE.itemsize:
            raise ValueError
    except (ValueError, LookupError, TypeError, RecursionError):
        raise InputError(
            path, "expected a complete statics.ply, got a different or incomplete file", _RUN_STATICS
        ) from None
    vertices = np.frombuffer(body, dtype=_VERTEX, count=header.vertices)
    faces = np.frombuffer(body, dtype=_FACE, offset=size)
    wrong = np.flatnonzero(faces["n"] != 3)
    if len(wrong):
        problem = f"expected triangles, got {faces['n'][wrong[0]]} corners in face {wrong[0]}"
        raise InputError(path, problem, _RUN_STATICS)
    _check_indices(path, "vertex", faces["corners"], header.vertices)
    _check_indices(path, "solid", faces["solid"], len(header.solids))
    if not np.isfinite(vertices["xyz"]).all():
        raise InputError(path, "expected finite coordinates, got a vertex with nan or inf", _RUN_STATICS)
    world = World(vertices["xyz"].copy(), faces["corners"].copy(), faces["solid"].copy(), header.solids)
    return world, header.metadata


class _Header(NamedTuple):
    """Numbers of vertices and faces; metadata; name and kind of each solid."""

    vertices: int
    faces: int
    metadata: dict[str, Any]
    solids: tuple[tuple[str, str], ...]


def _parse_header(text: str) -> _Header:
    """Parse a header; a ValueError, LookupError or TypeError if :func:`write_ply` did not write it."""
    lines = text.splitlines()
    comments = [line.removeprefix("comment ").split(" ", 1) for line in lines if line.startswith("comment ")]
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element ")}
    metadata = json.loads(comments[0][1])
    if comments[0][0] != "egvs" or not isinstance(metadata, dict):
        raise ValueError
    solids = [json.loads(value) for word, value in comments if word == "solid"]
    return _Header(counts["vertex"], counts["face"], metadata, tuple((str(name), str(kind)) for name, kind in solids))


def _check_indices(path: Path, what: str, indices: NDArray[np.int32], count: int) -> None:
    """Raise an InputError unless all indices are below ``count``."""
    wrong = indices[(indices < 0) | (indices >= count)]
    if len(wrong):
        raise InputError(path, f"expected a {what} from 0 to {count - 1}, got {wrong[0]} in a triangle", _RUN_STATICS)


def _to_line(value: Any) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
