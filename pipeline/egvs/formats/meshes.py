"""OBJ, PLY, STL, glTF meshes within bounds; the files they pull in.

Reads the description of a glTF or GLB file, and how much it would have a program hold.

A description of a few bytes can ask for any amount: accessors of zeros, many accessors of one buffer, a mesh that is
placed many times. Source: the Khronos Group, glTF 2.0 specification, 3.6 and 4.4.

Files that a mesh's file pulls in: buffers and images of glTF and GLB; materials of OBJ, and the textures of these;
textures of PLY. They lie beside it.

Loads a user's triangle mesh with trimesh, within bounds, and tells in one message what is wrong with its file.

Steps: hold what the file says of itself against the file's size and the bounds; let trimesh load it, with its log kept
off the terminal; refuse what trimesh only half understood, which it says in its log alone.

Takes a triangle mesh apart into its pieces, and tells which of them are closed.

Triangles belong to one piece where they share an edge that no third one has. A piece is closed where each of its edges
is in exactly two of its triangles, which run along it in opposite directions.
"""

from __future__ import annotations

import json
import logging
import os
import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from egvs.core import files, limits, reading
from egvs.core.errors import InputError
from egvs.core.reading import translate_errors

if TYPE_CHECKING:
    import trimesh


_GLB, _HEADER_BYTES = b"glTF", 20
"""How a GLB starts, and what stands before its JSON."""

_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_MAX_COMPONENTS = 16  # values of a matrix


def read_gltf_json(data: bytes) -> Any:
    """The JSON of a glTF or GLB; ValueError or RecursionError where it is damaged."""
    if data.startswith(_GLB):
        data = data[_HEADER_BYTES : _HEADER_BYTES + int.from_bytes(data[12:16], "little")]
    return json.loads(data)


def check_gltf_size(path: Path, where: str, data: bytes) -> None:
    """InputError where the file would have more held than the bounds say; for the rest, what its JSON raises."""
    described = read_gltf_json(data)
    reading.check_depth(described)
    accessors, meshes = [list(_objects_under(described, key)) for key in ("accessors", "meshes")]
    held = sum(
        _accessor_count(accessor) * _MAX_COMPONENTS * _COMPONENT_BYTES.get(accessor.get("componentType", 0), 4)
        for accessor in accessors
    )
    limits.UNPACKED.check_bytes(where, held / _MAX_COMPONENTS, "its accessors name more than that")
    corners = [sum(_corner_count(part, accessors) for part in _objects_under(mesh, "primitives")) for mesh in meshes]
    placed = [node.get("mesh") for node in _objects_under(described, "nodes")]
    total = sum(corners[at] for at in placed if isinstance(at, int) and 0 <= at < len(corners))
    limits.TRIANGLES.check(where, max(total, sum(corners)) // 3)
    beside = [path.parent / uri for key in ("buffers", "images") for uri in _external_uris(described, key)]
    limits.FILE.check_bytes(where, sum(part.stat().st_size for part in beside if part.is_file()), "names larger files")


def _accessor_count(accessor: dict[str, Any]) -> int:
    count = accessor.get("count", 0)
    if not isinstance(count, int) or count < 0:
        raise ValueError(f"an accessor's count is {count!r}")
    return count


def _corner_count(primitive: dict[str, Any], accessors: list[dict[str, Any]]) -> int:
    """Corners of a primitive's triangles: its indices, or its points where it has none."""
    attributes = primitive.get("attributes")
    points = attributes.get("POSITION") if isinstance(attributes, dict) else None
    at = primitive.get("indices", points)
    return _accessor_count(accessors[at]) if isinstance(at, int) and 0 <= at < len(accessors) else 0


def _external_uris(described: Any, key: str) -> Iterator[str]:
    for part in _objects_under(described, key):
        uri = part.get("uri")
        if isinstance(uri, str) and not uri.startswith("data:"):
            yield uri


def _objects_under(value: Any, key: str) -> Iterator[dict[str, Any]]:
    found = value.get(key) if isinstance(value, dict) else None
    return (part for part in (found if isinstance(found, list) else []) if isinstance(part, dict))


_MATERIALS = re.compile(rb"(?m)^[ \t]*mtllib[ \t]+(.+?)[ \t\r]*$")
_TEXTURES = re.compile(rb"(?mi)^[ \t]*(?:map_\w+|bump|disp|decal|refl|norm)[ \t]+(.+?)[ \t\r]*$")
_PLY_TEXTURES = re.compile(rb"(?m)^comment TextureFile[ \t]+(.+?)[ \t\r]*$")


def referenced_files(path: Path) -> list[Path]:
    """What a mesh's file names and is there, in its order; of a damaged file nothing, which its reader tells."""
    match path.suffix.lower():
        case ".gltf" | ".glb":
            uris = _gltf_uris(_parse_gltf(limits.read_bytes(path, limits.FILE)))
            return _existing_files(path, (name for uri in uris for name in (uri, unquote(uri))))
        case ".obj":
            materials = _existing_files(path, _possible_names(_MATERIALS, limits.read_bytes(path, limits.FILE)))
            textures = [
                _existing_files(its, _possible_names(_TEXTURES, limits.read_bytes(its, limits.FILE)))
                for its in materials
            ]
            return list(dict.fromkeys([*materials, *(one for several in textures for one in several)]))
        case ".ply":
            head, _, _ = limits.read_bytes(path, limits.FILE).partition(b"end_header")
            return _existing_files(path, _possible_names(_PLY_TEXTURES, head))
    return []


def mesh_digests(path: Path, name: str) -> dict[str, str]:
    """The sha256 of a mesh's file under its ``name``, and of each file that it pulls in."""
    parts = {f"{name}: {os.path.relpath(part, path.parent)}": files.hash_file(part) for part in referenced_files(path)}
    return {name: files.hash_file(path), **parts}


def _existing_files(source: Path, names: Iterable[str]) -> list[Path]:
    """Those of some names that are files, seen from the folder of ``source``, or in that folder itself; each once."""
    paths = (source.parent / place for name in names for place in (name, name.rpartition("/")[2]))
    return [path for path in dict.fromkeys(paths) if _is_file(path)]


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long for a name, or none: nobody can read it
        return False


def _possible_names(key: re.Pattern[bytes], data: bytes) -> list[str]:
    """What may be a name in the lines of a key: all that follows it, for a name with blanks, and each word alone."""
    lines = [found.decode("utf-8", "replace") for found in key.findall(data)]
    return [name for line in lines for name in (line, *line.split())]


def _parse_gltf(data: bytes) -> Any:
    """The JSON of a glTF or GLB; None where it is damaged."""
    try:
        return read_gltf_json(data)
    except (ValueError, RecursionError):
        return None


def _gltf_uris(value: Any) -> list[str]:
    parts = [part for key in ("buffers", "images") for part in _json_list(value, key)]
    uris = [part.get("uri") for part in parts if isinstance(part, dict)]
    return [uri for uri in uris if isinstance(uri, str) and not uri.startswith("data:")]


def _json_list(value: Any, key: str) -> list[Any]:
    found = value.get(key) if isinstance(value, dict) else None
    return found if isinstance(found, list) else []


MESH_FORMATS = ("ply", "obj", "stl", "glb", "gltf", "off")
EXPECTED_MESH = "a mesh that trimesh reads: PLY, OBJ, STL, GLB"

_PLY_ELEMENT = re.compile(rb"(?m)^element[ \t]+(\S+)[ \t]+(\d+)[ \t\r]*$")
_OBJ_FAULTS = (
    (re.compile(rb"(?m)^[ \t]*[-+.0-9][^\n]*"), "is of no kind of line"),
    (re.compile(rb"(?m)^v(?:[ \t]+[^ \t\r\n]+){0,2}[ \t\r]*$"), "has fewer than three coordinates"),
    (re.compile(rb"(?m)^f(?:[ \t]+[^ \t\r\n]+){0,2}[ \t\r]*$"), "is a face of fewer than three corners"),
    (re.compile(rb"(?m)^f[ \t](?:[^\n]*[ \t])?0+(?=[ \t\r\n/]|\Z)"), "names vertex 0, and the first is 1"),
)
_PARTIAL_LOAD_MESSAGES = ("failed to populate", "didn't decode")
"""What trimesh goes on after, with a part of the file."""

_TRUNCATED_MESSAGE = "string or file could not be read to its end"
"""numpy's warning of a text that stops being numbers."""


def load_mesh(path: Path, where: str) -> trimesh.Trimesh:
    """The triangles of a file, at least one, in its own frame; an instance that trimesh has not processed.

    InputError at ``where`` where it is of an unknown kind, damaged, beyond a bound, or holds no triangle.
    """
    import trimesh

    kind = path.suffix.lower().removeprefix(".")
    if kind not in MESH_FORMATS:
        raise InputError(
            where, f"is of the kind {path.suffix!r}", f"one of {', '.join(f'.{name}' for name in MESH_FORMATS)}"
        )
    with translate_errors(where, EXPECTED_MESH, "cannot be loaded"):
        _check_size(path, where, kind)
        with _quiet_trimesh(where), np.errstate(all="ignore"):
            mesh = trimesh.load(path, force="mesh", process=False)
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            raise InputError(where, "holds no triangles", "a triangle mesh")
        limits.TRIANGLES.check(where, max(len(mesh.faces), len(mesh.vertices) / 3))
        if mesh.vertices.ndim != 2 or mesh.vertices.shape[1] != 3:
            raise InputError(where, f"its vertices have the shape {mesh.vertices.shape}", "x, y and z of each")
        if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
            wrong = mesh.faces.min() if mesh.faces.min() < 0 else mesh.faces.max()
            raise InputError(where, f"a triangle names vertex {wrong} of {len(mesh.vertices)}", "a whole mesh")
    return mesh


def _check_size(path: Path, where: str, kind: str) -> None:
    """InputError where a file says that it holds more than it can, or than the bounds allow."""
    data = limits.read_bytes(path, limits.FILE, where)
    if kind in ("glb", "gltf"):
        check_gltf_size(path, where, data)
    elif kind == "obj":
        _check_obj(data, where)
    elif kind == "ply":
        head, _, body = data.partition(b"end_header")
        counts = [(name.decode("latin-1"), int(digits[:18])) for name, digits in _PLY_ELEMENT.findall(head)]
        is_text = b"format ascii" in head
        lines = len(body.splitlines()) if is_text else len(body)
        if (declared := sum(count for _, count in counts)) > lines:
            told = " and ".join(f"{count} of {name!r}" for name, count in counts)
            raise InputError(
                where, f"says that it holds {told} in {lines} {'lines' if is_text else 'bytes'}", EXPECTED_MESH
            )
        limits.TRIANGLES.check(where, declared / 4)


def _check_obj(data: bytes, where: str) -> None:
    """InputError where an OBJ has a line that no reader should guess at: numbers of nothing, a vertex without three
    coordinates, a face of fewer corners or one that names vertex 0, where counting starts at 1."""
    joined = data.replace(b"\\\n", b"  ").replace(b"\\\r\n", b"   ")  # lines that go on
    for wrong, what in _OBJ_FAULTS:
        if (found := wrong.search(joined)) is not None:
            line = data.count(b"\n", 0, found.start()) + 1
            text = found[0].strip()[:80].decode("utf-8", "replace")
            raise InputError(f"{where}: line {line}", f"{text!r} {what}", EXPECTED_MESH)


@contextmanager
def _quiet_trimesh(where: str) -> Iterator[None]:
    """Keep trimesh's log, and numpy's warning of a text that ends early, off the terminal: what they say of half a mesh
    is an InputError."""
    log, kept = logging.getLogger("trimesh"), _LogCollector()
    propagates, log.propagate = log.propagate, False
    log.addHandler(kept)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", _TRUNCATED_MESSAGE, DeprecationWarning)
            yield
    finally:
        log.removeHandler(kept)
        log.propagate = propagates
    for told in kept.messages:
        if any(words in told for words in _PARTIAL_LOAD_MESSAGES):
            raise InputError(where, f"cannot be loaded whole ({told})", EXPECTED_MESH)


class _LogCollector(logging.Handler):
    """Keeps what is told."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(record.getMessage())


Ints = NDArray[np.int64]


def mesh_components(adjacent: Ints, triangles: int) -> Ints:
    """The number of each triangle's piece, (m,), in the order of the pieces' first triangles.

    ``adjacent`` (n, 2) are pairs of triangles that share an edge alone.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(adjacent), dtype=bool), adjacent.T), shape=(triangles, triangles))
    labels = connected_components(graph, directed=False)[1]
    _, first, which = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[which]


def are_closed(faces: Ints, piece: Ints) -> NDArray[np.bool_]:
    """Which pieces are closed, (pieces,); ``faces`` (m, 3), ``piece`` (m,) as :func:`mesh_components` gives it."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    owner, low, high = np.repeat(piece, 3), edges.min(axis=1), edges.max(axis=1)
    order = np.lexsort((high, low, owner))
    keys = np.column_stack([owner, low, high])[order]
    starts = np.flatnonzero(np.insert((np.diff(keys, axis=0) != 0).any(axis=1), 0, True))
    turn = np.where(edges[:, 0] < edges[:, 1], 1, -1)[order]
    sound = (np.diff(starts, append=len(keys)) == 2) & (np.add.reduceat(turn, starts) == 0)
    closed = np.ones(int(piece.max()) + 1, dtype=bool)
    closed[keys[starts[~sound], 0]] = False
    return closed
