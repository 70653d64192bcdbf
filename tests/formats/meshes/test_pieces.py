"""Pieces of a mesh, held against trimesh, one piece at a time."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from egvs.formats.meshes import are_closed, mesh_components

BOX = trimesh.creation.box((1, 1, 1))


def slowly(mesh: trimesh.Trimesh) -> list[tuple[list[int], bool]]:
    """Each piece's triangles, and whether it is closed, in the order of their first triangles."""
    parts = trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(mesh.faces)), min_len=1)
    found = []
    for part in sorted((np.sort(part) for part in parts), key=lambda part: int(part[0])):
        alone = trimesh.Trimesh(mesh.vertices, mesh.faces[part], process=False)
        found.append((part.tolist(), bool(alone.is_watertight and alone.is_winding_consistent)))
    return found


def quickly(mesh: trimesh.Trimesh) -> list[tuple[list[int], bool]]:
    piece = mesh_components(mesh.face_adjacency, len(mesh.faces))
    closed = are_closed(np.asarray(mesh.faces), piece)
    return [(np.flatnonzero(piece == number).tolist(), bool(closed[number])) for number in range(len(closed))]


def along_an_edge() -> trimesh.Trimesh:
    """Two boxes that share the corners of one edge, which four triangles meet at."""
    mesh = trimesh.util.concatenate([BOX, BOX.copy().apply_translation([1, 1, 0])])
    mesh.merge_vertices()
    return mesh


def shuffled(seed: int) -> trimesh.Trimesh:
    """Boxes, some without a triangle, some with one turned round, their triangles in any order."""
    rng = np.random.default_rng(seed)
    boxes = [BOX.copy().apply_translation([3 * i, 0, 0]) for i in range(12)]
    faces, start = [], 0
    for number, box in enumerate(boxes):
        its = box.faces.copy()
        its = its[:-1] if number % 3 == 0 else its
        its[0] = its[0][::-1] if number % 4 == 1 else its[0]
        faces.append(its + start)
        start += len(box.vertices)
    every = np.concatenate(faces)
    return trimesh.Trimesh(np.concatenate([box.vertices for box in boxes]), rng.permutation(every), process=False)


@pytest.mark.parametrize(
    "mesh",
    [BOX, along_an_edge(), shuffled(1), shuffled(2), trimesh.Trimesh(BOX.vertices, BOX.faces[:1], process=False)],
    ids=["box", "along an edge", "shuffled", "shuffled otherwise", "one triangle"],
)
def test_pieces_are_those_that_trimesh_finds(mesh: trimesh.Trimesh) -> None:
    assert quickly(mesh) == slowly(mesh)
