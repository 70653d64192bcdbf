"""Loads a user's triangle mesh with trimesh, within bounds, and tells in one message what is wrong with its file.

Steps: hold what the file says of itself against the file's size and the bounds; let trimesh load it, with its log kept
off the terminal; refuse what trimesh only half understood, which it says in its log alone.
"""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.errors import InputError
from pipeline.core.reading import limits
from pipeline.core.reading.refusing import reading
from pipeline.formats.meshes import gltf

if TYPE_CHECKING:
    import trimesh

KINDS = ("ply", "obj", "stl", "glb", "gltf", "off")
A_MESH = "a mesh that trimesh reads: PLY, OBJ, STL, GLB"

_ELEMENT = re.compile(rb"(?m)^element[ \t]+(\S+)[ \t]+(\d+)[ \t\r]*$")
_WRONG_IN_OBJ = (
    (re.compile(rb"(?m)^[ \t]*[-+.0-9][^\n]*"), "is of no kind of line"),
    (re.compile(rb"(?m)^v(?:[ \t]+[^ \t\r\n]+){0,2}[ \t\r]*$"), "has fewer than three coordinates"),
    (re.compile(rb"(?m)^f(?:[ \t]+[^ \t\r\n]+){0,2}[ \t\r]*$"), "is a face of fewer than three corners"),
    (re.compile(rb"(?m)^f[ \t](?:[^\n]*[ \t])?0+(?=[ \t\r\n/]|\Z)"), "names vertex 0, and the first is 1"),
)
_HALF_UNDERSTOOD = ("failed to populate", "didn't decode")
"""What trimesh goes on after, with a part of the file."""

_HALF_READ = "string or file could not be read to its end"
"""numpy's warning of a text that stops being numbers."""


def load(path: Path, place: str) -> trimesh.Trimesh:
    """The triangles of a file, at least one, in its own frame; an instance that trimesh has not processed.

    InputError at ``place`` where it is of an unknown kind, damaged, beyond a bound, or holds no triangle.
    """
    import trimesh

    kind = path.suffix.lower().removeprefix(".")
    if kind not in KINDS:
        raise InputError(place, f"is of the kind {path.suffix!r}", f"one of {', '.join(f'.{name}' for name in KINDS)}")
    with reading(place, A_MESH, "cannot be loaded"):
        _check_size(path, place, kind)
        with _quietly(place), np.errstate(all="ignore"):
            mesh = trimesh.load(path, force="mesh", process=False)
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            raise InputError(place, "holds no triangles", "a triangle mesh")
        limits.TRIANGLES.check(place, max(len(mesh.faces), len(mesh.vertices) / 3))
        if mesh.vertices.ndim != 2 or mesh.vertices.shape[1] != 3:
            raise InputError(place, f"its vertices have the shape {mesh.vertices.shape}", "x, y and z of each")
        if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
            wrong = mesh.faces.min() if mesh.faces.min() < 0 else mesh.faces.max()
            raise InputError(place, f"a triangle names vertex {wrong} of {len(mesh.vertices)}", "a whole mesh")
    return mesh


def _check_size(path: Path, place: str, kind: str) -> None:
    """InputError where a file says that it holds more than it can, or than the bounds allow."""
    data = limits.read_bytes(path, limits.FILE, place)
    if kind in ("glb", "gltf"):
        gltf.check(path, place, data)
    elif kind == "obj":
        _check_obj(data, place)
    elif kind == "ply":
        head, _, body = data.partition(b"end_header")
        counts = [(name.decode("latin-1"), int(digits[:18])) for name, digits in _ELEMENT.findall(head)]
        is_text = b"format ascii" in head
        lines = len(body.splitlines()) if is_text else len(body)
        if (declared := sum(count for _, count in counts)) > lines:
            told = " and ".join(f"{count} of {name!r}" for name, count in counts)
            raise InputError(place, f"says that it holds {told} in {lines} {'lines' if is_text else 'bytes'}", A_MESH)
        limits.TRIANGLES.check(place, declared / 4)


def _check_obj(data: bytes, place: str) -> None:
    """InputError where an OBJ has a line that no reader should guess at: numbers of nothing, a vertex without three
    coordinates, a face of fewer corners or one that names vertex 0, where counting starts at 1."""
    joined = data.replace(b"\\\n", b"  ").replace(b"\\\r\n", b"   ")  # lines that go on
    for wrong, what in _WRONG_IN_OBJ:
        if (found := wrong.search(joined)) is not None:
            line = data.count(b"\n", 0, found.start()) + 1
            text = found[0].strip()[:80].decode("utf-8", "replace")
            raise InputError(f"{place}: line {line}", f"{text!r} {what}", A_MESH)


@contextmanager
def _quietly(place: str) -> Iterator[None]:
    """Keep trimesh's log, and numpy's warning of a text that ends early, off the terminal: what they say of half a mesh
    is an InputError."""
    log, kept = logging.getLogger("trimesh"), _Kept()
    propagates, log.propagate = log.propagate, False
    log.addHandler(kept)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", _HALF_READ, DeprecationWarning)
            yield
    finally:
        log.removeHandler(kept)
        log.propagate = propagates
    for told in kept.told:
        if any(words in told for words in _HALF_UNDERSTOOD):
            raise InputError(place, f"cannot be loaded whole ({told})", A_MESH)


class _Kept(logging.Handler):
    """Keeps what is told."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.told: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.told.append(record.getMessage())
