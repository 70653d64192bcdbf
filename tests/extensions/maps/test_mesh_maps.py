"""Meshes of other programs: aligned by two points, turned upright, divided into closed pieces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
import trimesh

from egvs.core.errors import InputError
from egvs.creation.map_parts import Alignment, MapContext
from egvs.extensions.maps.buildings import mesh_maps

QUARTER_TURN = Alignment(np.array([[0.0, 0.0], [10.0, 0.0]]), np.array([[100.0, 50.0], [100.0, 60.0]]))
"""The origin goes to (100, 50), east becomes north."""

CONTEXT = MapContext(None, shapely.box(0, 0, 200, 200), QUARTER_TURN)


def block(x_m: float, y_m: float) -> trimesh.Trimesh:
    """A block of 4 m along x, 2 m along y, from the ground to 6 m."""
    return trimesh.creation.box((4, 2, 6), trimesh.transformations.translation_matrix((x_m + 2, y_m + 1, 3)))


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "glb"])
def test_pieces_are_turned_and_moved(tmp_path: Path, suffix: str) -> None:
    scene = trimesh.util.concatenate([block(0, 0), block(20, 0)])
    if suffix == "glb":  # its y axis points up
        scene.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    path = tmp_path / f"town.{suffix}"
    scene.export(path)
    result = mesh_maps.read_solids([path], CONTEXT)
    assert [(mesh.name, mesh.kind, mesh.is_closed) for mesh in result.meshes] == [
        ("town_0", "mesh", True), ("town_1", "mesh", True),
    ]  # fmt: skip
    assert not result.has_absolute_heights
    first, second = result.meshes
    np.testing.assert_allclose(first.vertices_m.min(axis=0), [98, 50, 0], atol=1e-5)
    np.testing.assert_allclose(first.vertices_m.max(axis=0), [100, 54, 6], atol=1e-5)
    np.testing.assert_allclose(second.vertices_m.max(axis=0), [100, 74, 6], atol=1e-5)
    assert result.notes == (("town.glb: its y axis is taken as up, as glTF defines it.",) if suffix == "glb" else ())


def test_open_pieces_are_one_surface_and_far_ones_are_left_out(tmp_path: Path) -> None:
    lid = block(0, 0)
    lid.update_faces(np.arange(len(lid.faces)) > 1)
    trimesh.util.concatenate([lid, block(1000, 0), block(20, 0)]).export(tmp_path / "a.ply")
    block(0, 0).export(tmp_path / "b.ply")
    (tmp_path / "c").mkdir()
    block(20, 0).export(tmp_path / "c" / "b.ply")
    result = mesh_maps.read_solids([tmp_path / "a.ply", tmp_path / "b.ply", tmp_path / "c" / "b.ply"], CONTEXT)
    assert [(mesh.name, len(mesh.faces), mesh.is_closed) for mesh in result.meshes] == [
        ("a_2", 12, True), ("a_surface", 10, False), ("b_0", 12, True), ("b_0#2", 12, True),
    ]  # fmt: skip
    assert result.counts.dropped == {"out_of_range": {"mesh": 1}}
    assert result.counts.objects == {"mesh": 4}


def test_needs_an_alignment_and_triangles(tmp_path: Path) -> None:
    block(0, 0).export(tmp_path / "a.ply")
    with pytest.raises(InputError, match=r"a.ply: the file declares no coordinate reference system. .*--align"):
        mesh_maps.read_solids([tmp_path / "a.ply"], MapContext(None, CONTEXT.window))
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"a.obj: expected a triangle mesh, got 1 triangles without area"):
        mesh_maps.read_solids([tmp_path / "a.obj"], CONTEXT)
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 1e30 0\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"a.obj: vertex 2: expected finite coordinates, at most 1e\+08 m"):
        mesh_maps.read_solids([tmp_path / "a.obj"], CONTEXT)
