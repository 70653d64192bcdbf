"""Load triangle meshes (OBJ, PLY, STL, glTF) with trimesh, within limits.

Steps of :func:`load_mesh`: compare the sizes that the file declares with its actual size and the limits; load it with
trimesh; reject what trimesh could read only in part, which it reports in its log alone.

A glTF file of a few bytes can declare any amount: accessors of zeros, many accessors of one buffer, a mesh that is
placed many times (Khronos Group, glTF 2.0 specification, 3.6 and 4.4).

:func:`referenced_files` returns the files that a mesh needs: buffers and images of glTF and GLB, materials of OBJ and
their textures, textures of PLY.

:func:`mesh_components` and :func:`are_closed` split a mesh into connected components and tell which enclose a volume.
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

from egvs.core import limits, reading
from egvs.core.digests import hash_input, unchanged_inputs
from egvs.core.errors import InputError
from egvs.core.grid import BoolArray, IntArray
from egvs.core.platform import relative_path
from egvs.core.reading import translate_errors

if TYPE_CHECKING:
    import trimesh


_GLB, _HEADER_BYTES = b"glTF", 20
"""First bytes of a GLB, and size of the header before its JSON."""

_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_EXTERNAL_KEYS = ("buffers", "images")


def _parse_gltf_json(data: bytes) -> Any:
    """Return the JSON of a glTF or GLB; ValueError or RecursionError when it is damaged."""
    if data.startswith(_GLB):
        data = data[_HEADER_BYTES : _HEADER_BYTES + int.from_bytes(data[12:16], "little")]
    return json.loads(data)


def _check_gltf_size(path: Path, where: str, data: bytes) -> None:
    """Raise an InputError when a glTF file asks for more memory than the limits allow."""
    document = _parse_gltf_json(data)
    reading.check_depth(document)
    accessors = _objects_under(document, "accessors")
    meshes = _objects_under(document, "meshes")

    size = 0
    for accessor in accessors:
        size += _accessor_count(accessor) * _COMPONENT_BYTES.get(accessor.get("componentType", 0), 4)
    limits.UNPACKED.check_bytes(where, size, "its accessors declare too much data")

    corners = []
    for mesh in meshes:
        corners.append(sum(_corner_count(part, accessors) for part in _objects_under(mesh, "primitives")))
    placed = 0
    for node in _objects_under(document, "nodes"):
        index = node.get("mesh")
        if isinstance(index, int) and 0 <= index < len(corners):
            placed += corners[index]
    limits.TRIANGLES.check(where, max(placed, sum(corners)) // 3)

    external = [path.parent / uri for uri in _external_uris(document)]
    total = sum(file.stat().st_size for file in external if file.is_file())
    limits.FILE.check_bytes(where, total, "refers to larger files")


def _accessor_count(accessor: dict[str, Any]) -> int:
    count = accessor.get("count", 0)
    if not isinstance(count, int) or count < 0:
        raise ValueError(f"an accessor's count is {count!r}")
    return count


def _corner_count(primitive: dict[str, Any], accessors: list[dict[str, Any]]) -> int:
    """Return the number of triangle corners of a primitive: its indices, or its points if it has none."""
    attributes = primitive.get("attributes")
    points = attributes.get("POSITION") if isinstance(attributes, dict) else None
    index = primitive.get("indices", points)
    if isinstance(index, int) and 0 <= index < len(accessors):
        return _accessor_count(accessors[index])
    return 0


def _external_uris(document: Any) -> list[str]:
    """Return the files that a glTF document names; embedded data is left out."""
    uris = [part.get("uri") for key in _EXTERNAL_KEYS for part in _objects_under(document, key)]
    return [uri for uri in uris if isinstance(uri, str) and not uri.startswith("data:")]


def _objects_under(value: Any, key: str) -> list[dict[str, Any]]:
    """Return the objects in a list of a JSON object; none if it has no such list."""
    items = value.get(key) if isinstance(value, dict) else None
    if not isinstance(items, list):
        return []
    return [item for item in items if isinstance(item, dict)]


_MATERIALS = re.compile(rb"(?m)^[ \t]*mtllib[ \t]+(.+?)[ \t\r]*$")
_TEXTURES = re.compile(rb"(?mi)^[ \t]*(?:map_\w+|bump|disp|decal|refl|norm)[ \t]+(.+?)[ \t\r]*$")
_PLY_TEXTURES = re.compile(rb"(?m)^comment TextureFile[ \t]+(.+?)[ \t\r]*$")


def referenced_files(path: Path) -> list[Path]:
    """Return the existing files that a mesh's file names, in its order; none for a damaged file."""
    match path.suffix.lower():
        case ".gltf" | ".glb":
            try:
                uris = _external_uris(_parse_gltf_json(limits.read_bytes(path, limits.FILE)))
            except (ValueError, RecursionError):
                return []
            return _existing_files(path, [name for uri in uris for name in (uri, unquote(uri))])
        case ".obj":
            materials = _existing_files(path, _possible_names(_MATERIALS, limits.read_bytes(path, limits.FILE)))
            referenced = list(materials)
            for material in materials:
                names = _possible_names(_TEXTURES, limits.read_bytes(material, limits.FILE))
                referenced += _existing_files(material, names)
            return list(dict.fromkeys(referenced))
        case ".ply":
            head, _, _ = limits.read_bytes(path, limits.FILE).partition(b"end_header")
            return _existing_files(path, _possible_names(_PLY_TEXTURES, head))
    return []


def mesh_digests(path: Path, name: str) -> dict[str, str]:
    """Return the SHA-256 of a mesh's file under its ``name``, and of each file that it references."""
    digests = {name: hash_input(path)}
    for file in referenced_files(path):
        digests[f"{name}: {relative_path(file, path.parent)}"] = hash_input(file)
    return digests


def _existing_files(source: Path, names: Iterable[str]) -> list[Path]:
    """Return the files with these names, relative to the folder of ``source`` or directly in it; each once.

    Paths contain no ``..`` that leads back from inside the folder: behind a link, it would lead to another folder.
    """
    locations = [os.path.normpath(location) for name in names for location in (name, name.rpartition("/")[2])]
    return [path for path in dict.fromkeys(source.parent / location for location in locations) if _is_file(path)]


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # not a valid file name, or too long
        return False


def _possible_names(key: re.Pattern[bytes], data: bytes) -> list[str]:
    """Return what may be file names in the lines of a key: the rest of the line, with blanks, and each word of it."""
    lines = [match.decode("utf-8", "replace") for match in key.findall(data)]
    return [name for line in lines for name in (line, *line.split())]


SCENE_NODE = "egvs_world_z_up"
"""The node of an exported scene that turns the world frame, z up, to that of glTF, y up."""


def is_exported_scene(path: Path) -> bool:
    """Return whether a file is a scene that ``egvs export --to glb`` wrote; False for a damaged file."""
    if path.suffix.lower() not in (".gltf", ".glb"):
        return False
    try:
        document = _parse_gltf_json(limits.read_bytes(path, limits.FILE))
        return any(node.get("name") == SCENE_NODE for node in _objects_under(document, "nodes"))
    except (ValueError, RecursionError):
        return False


MESH_FORMATS = ("ply", "obj", "stl", "glb", "gltf", "off")
MESH_HINT = "Use a complete triangle mesh that trimesh can read: PLY, OBJ, STL, GLB."

_PLY_ELEMENT = re.compile(rb"(?m)^element[ \t]+(\S+)[ \t]+(\d+)[ \t\r]*$")
_OBJ_FAULTS = (
    (re.compile(rb"(?m)^[ \t]*[-+.0-9][^\n]*"), "does not start with a keyword"),
    (re.compile(rb"(?m)^v(?:[ \t]+[^ \t\r\n]+){0,2}[ \t\r]*$"), "has fewer than three coordinates"),
    (re.compile(rb"(?m)^f(?:[ \t]+[^ \t\r\n]+){0,2}[ \t\r]*$"), "is a face with fewer than three corners"),
    (re.compile(rb"(?m)^f[ \t](?:[^\n]*[ \t])?[-+]?0+(?=[ \t\r\n/]|\Z)"), "refers to vertex 0, but the first is 1"),
)
"""Lines that a reader could only guess at."""

_PARTIAL_LOAD_MESSAGES = ("failed to populate", "didn't decode")
"""Parts of trimesh's log messages after which it continues with part of the file."""

_TRUNCATED_MESSAGE = "string or file could not be read to its end"
"""numpy's warning for a text that stops being numbers."""


def load_mesh(path: Path, where: str) -> trimesh.Trimesh:
    """Load the triangles of a file, at least one, in the file's own frame, without any processing by trimesh.

    Raises
    ------
    InputError
        At ``where``, when the format is unknown, the file is damaged or exceeds a limit, or it has no triangles.
    """
    import trimesh

    kind = path.suffix.lower().removeprefix(".")
    if kind not in MESH_FORMATS:
        hint = f"Use one of {', '.join(f'.{name}' for name in MESH_FORMATS)}."
        raise InputError(where, f"unknown mesh format {path.suffix!r}", hint)
    with translate_errors(where, MESH_HINT, "cannot be loaded"):
        _check_size(path, where, kind)
        files = (path, *referenced_files(path))
        with _quiet_trimesh(where), np.errstate(all="ignore"), unchanged_inputs(*files):
            mesh = trimesh.load(path, force="mesh", process=False, resolver=_make_resolver(path))
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            raise InputError(where, "the file has no triangles", MESH_HINT)
        limits.TRIANGLES.check(where, max(len(mesh.faces), len(mesh.vertices) / 3))
        if mesh.vertices.ndim != 2 or mesh.vertices.shape[1] != 3:
            raise InputError(where, f"the vertices have the shape {mesh.vertices.shape}, not (n, 3)", MESH_HINT)
        for vertex in (mesh.faces.min(), mesh.faces.max()):
            if not 0 <= vertex < len(mesh.vertices):
                raise InputError(where, f"a triangle refers to vertex {vertex} of {len(mesh.vertices)}", MESH_HINT)
    return mesh


def _make_resolver(source: Path) -> trimesh.resolvers.Resolver:
    """Return what opens the files that a mesh names: regular files in its folder, within the limit of a mesh.

    Trimesh's own opens whatever has the name: a pipe or a device never ends.
    """
    from trimesh.resolvers import FilePathResolver

    folder = source.parent

    class Resolver(FilePathResolver):
        def get(self, name: str) -> bytes:
            for path in _existing_files(source, (name, name.strip(), unquote(name))):
                if path.is_relative_to(folder) and ".." not in path.relative_to(folder).parts:
                    return limits.read_bytes(path, limits.FILE)
            raise FileNotFoundError(f"{name[:80]!r} is no file in the folder of the mesh")

    return Resolver(str(source))


def _check_size(path: Path, where: str, kind: str) -> None:
    """Raise an InputError when a file declares more than it contains, or more than the limits allow."""
    data = limits.read_bytes(path, limits.FILE, where)
    if kind in ("glb", "gltf"):
        _check_gltf_size(path, where, data)
    elif kind == "obj":
        _check_obj(data, where)
    elif kind == "ply":
        _check_ply(data, where)


def _check_ply(data: bytes, where: str) -> None:
    """Raise an InputError when a PLY declares more elements than it has lines or bytes."""
    head, _, body = data.partition(b"end_header")
    if head.startswith(b"ply"):
        reading.check_ply_header(where, head.splitlines())
    counts = [(name.decode("latin-1"), int(digits[:18])) for name, digits in _PLY_ELEMENT.findall(head)]
    if b"format ascii" in head:
        actual, unit = len(body.splitlines()), "lines"
    else:
        actual, unit = len(body), "bytes"
    declared = sum(count for _, count in counts)
    if declared > actual:
        elements = " and ".join(f"{count} of {name!r}" for name, count in counts)
        raise InputError(where, f"the header declares {elements}, but the file contains {actual} {unit}", MESH_HINT)
    limits.TRIANGLES.check(where, declared / 4)


def _check_obj(data: bytes, where: str) -> None:
    """Raise an InputError when an OBJ has a line that a reader could only guess at."""
    joined = data.replace(b"\\\n", b"  ").replace(b"\\\r\n", b"   ")  # continued lines; the length stays
    for fault, description in _OBJ_FAULTS:
        match = fault.search(joined)
        if match is not None:
            line = data.count(b"\n", 0, match.start()) + 1
            text = match[0].strip()[:80].decode("utf-8", "replace")
            raise InputError(f"{where}: line {line}", f"{text!r} {description}", MESH_HINT)


@contextmanager
def _quiet_trimesh(where: str) -> Iterator[None]:
    """Keep trimesh's log and numpy's warning of a truncated text off the terminal.

    InputError when they report that only part of the mesh was loaded.
    """
    log = logging.getLogger("trimesh")
    collector = _LogCollector()
    propagates, log.propagate = log.propagate, False
    log.addHandler(collector)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", _TRUNCATED_MESSAGE, DeprecationWarning)
            yield
    finally:
        log.removeHandler(collector)
        log.propagate = propagates
    for message in collector.messages:
        if any(words in message for words in _PARTIAL_LOAD_MESSAGES):
            raise InputError(where, f"only part of it can be loaded ({message})", MESH_HINT)


class _LogCollector(logging.Handler):
    """Collects log messages."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(record.getMessage())


def load_clean_mesh(path: Path, most_m: float) -> tuple[trimesh.Trimesh, int]:
    """Load a mesh, with equal vertices merged and without triangles that have no area or occur twice.

    Parameters
    ----------
    path
        The file.
    most_m
        Largest coordinate.

    Returns
    -------
    mesh : trimesh.Trimesh
        With at least one triangle.
    dropped : int
        Number of triangles left out.

    Raises
    ------
    InputError
        When the file is damaged, a coordinate is not finite or too large, or no triangle is left.
    """
    mesh = load_mesh(path, str(path))
    far = np.flatnonzero(~(np.abs(mesh.vertices) <= most_m).all(axis=1))
    if len(far):
        expected = f"expected finite coordinates, at most {most_m:g} m"
        raise InputError(f"{path}: vertex {far[0]}", f"{expected}, got {mesh.vertices[far[0]].tolist()}")
    triangles = len(mesh.faces)
    with translate_errors(path, MESH_HINT, "cannot be divided into pieces"):
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    if len(mesh.faces) == 0:
        raise InputError(path, f"expected a triangle mesh, got {triangles} triangles without area")
    return mesh, triangles - len(mesh.faces)


def divide_mesh(mesh: trimesh.Trimesh) -> tuple[dict[int, IntArray], IntArray]:
    """Return the triangles of each closed component by its number, and all others, (n,) int64 each."""
    faces = np.asarray(mesh.faces, dtype=np.int64)
    component = mesh_components(mesh.face_adjacency, len(faces))
    is_closed = are_closed(faces, component)
    order = np.argsort(component, kind="stable")
    by_component = np.split(order, np.cumsum(np.bincount(component))[:-1])
    closed = {number: by_component[number] for number in np.flatnonzero(is_closed).tolist()}
    return closed, order[~is_closed[component[order]]]


def mesh_components(adjacent: IntArray, triangles: int) -> IntArray:
    """Return the component of each triangle, (m,) int64, numbered in the order of their first triangles.

    Triangles are connected where they share an edge that no third triangle has.

    Parameters
    ----------
    adjacent
        Pairs of such triangles, (n, 2) int64.
    triangles
        Number of triangles, m.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(adjacent), dtype=bool), adjacent.T), shape=(triangles, triangles))
    labels = connected_components(graph, directed=False)[1]
    _, first, label_index = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[label_index]


def are_closed(faces: IntArray, component: IntArray) -> BoolArray:
    """Return which components are closed, (components,).

    A component is closed when each of its edges is in exactly two of its triangles, in opposite directions.

    Parameters
    ----------
    faces
        Vertices of the triangles, (m, 3) int64.
    component
        Component of each triangle, (m,), from :func:`mesh_components`.
    """
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    owner = np.repeat(component, 3)
    low = edges.min(axis=1)
    high = edges.max(axis=1)
    order = np.lexsort((high, low, owner))
    keys = np.column_stack([owner, low, high])[order]
    starts = np.flatnonzero(np.insert((np.diff(keys, axis=0) != 0).any(axis=1), 0, True))
    direction = np.where(edges[:, 0] < edges[:, 1], 1, -1)[order]
    is_sound = (np.diff(starts, append=len(keys)) == 2) & (np.add.reduceat(direction, starts) == 0)
    closed = np.ones(int(component.max()) + 1, dtype=bool)
    closed[keys[starts[~is_sound], 0]] = False
    return closed
