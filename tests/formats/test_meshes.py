"""Loading meshes: damaged or hostile files give one message; components are compared with trimesh."""

from __future__ import annotations

import base64
import json
import os
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh

from egvs.core.errors import InputError
from egvs.formats.meshes import MESH_FORMATS, are_closed, load_mesh, mesh_components, mesh_digests

BOX = trimesh.creation.box((1, 2, 3))
UNIT_BOX = trimesh.creation.box((1, 1, 1))


def box_file(kind: str, **options: str) -> bytes:
    """The content of a box's file."""
    if kind == "gltf":
        parts = trimesh.Scene(BOX).export(file_type="gltf", embed_buffers=True)
        return parts["model.gltf"]
    data = BOX.export(file_type=kind, **options)
    return data.encode() if isinstance(data, str) else data


def gltf_with(**parts: object) -> bytes:
    """A glTF of a box with other members."""
    return json.dumps(json.loads(box_file("gltf")) | parts).encode()


def glb_of(document: object) -> bytes:
    text = json.dumps(document).encode()
    return b"glTF" + struct.pack("<IIII", 2, 20 + len(text), len(text), 0x4E4F534A) + text


ASCII_PLY = box_file("ply", encoding="ascii")
COMPLETE_FILES = {"ascii.ply": ASCII_PLY, "text.stl": box_file("stl_ascii")} | {
    f"m.{kind}": box_file(kind) for kind in MESH_FORMATS
}
ZEROS = {"componentType": 5126, "type": "VEC3", "count": 10**9}
PLACED = [{"mesh": 0} for _ in range(1000)]


def hostile() -> Iterator[tuple[str, bytes, str]]:
    """Yield file name, content, and part of the message."""
    yield "m.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 9999999999\nend_header\n", "contains 1 bytes"
    yield (
        "m.ply",
        ASCII_PLY[:-20],
        r"the header declares 8 of 'vertex' and 12 of 'face', but the file contains 1\d lines",
    )
    yield "m.ply", COMPLETE_FILES["m.ply"][:-20], "cannot be loaded"
    yield "m.ply", ASCII_PLY.replace(b"-0.5", b"-0.5x", 1), "cannot be loaded"
    yield "m.ply", b"ply\n", "m.ply"
    yield "m.ply", ASCII_PLY.replace(b"element face", "element é".encode()), r"line \d: expected a header in ASCII"
    yield "m.stl", COMPLETE_FILES["m.stl"][:-20], "m.stl"
    yield "m.stl", COMPLETE_FILES["text.stl"].replace(b"0.5", b"0.x", 1), "cannot be loaded"
    yield "m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "m.obj"
    yield "m.obj", b"v 0 0\nf 1 2 3\n", "m.obj"
    yield "m.obj", b"v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", "line 2: 'v 1 0' has fewer than three coordinates"
    yield "m.obj", b"v 0 0 0\nv 1 0 \\\n0\nv 0 1 \n.0 0\nf 1 2 3\n", "line 5: '.0 0' does not start with a keyword"
    yield "m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n.0 6\nf 1 2 3\n", "line 4: '.0 6' does not start with a keyword"
    yield "m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2 0/1/0\n", "line 5: 'f 1 2 0' refers to vertex 0"
    yield "m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 -0 3\n", "line 4: 'f 1 -0' refers to vertex 0"
    yield "m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 7 65\n", "line 5: 'f 7 65' is a face with fewer than three"
    yield "m.obj", b"\x80\x81\xff\xfe" * 100, "m.obj"
    yield "m.off", b"OFF\n3 1 0\n0 0 0\n", "m.off"
    yield "m.glb", COMPLETE_FILES["m.glb"][:-20], "cannot be loaded"
    yield "m.glb", b"glTF", "cannot be loaded"
    yield (
        "m.glb",
        glb_of({"accessors": [ZEROS]}),
        r"its accessors declare too much data\. The limit is 1,000 MB; set EGVS_MAX_UNPA",
    )
    yield "m.glb", glb_of([[[]]]), "m.glb"
    yield "m.gltf", gltf_with(accessors=[ZEROS]), "EGVS_MAX_UNPACKED_MB"
    yield "m.gltf", gltf_with(accessors=[{"count": "many"}]), "an accessor's count is 'many'"
    yield (
        "m.gltf",
        gltf_with(nodes=PLACED),
        r"12,000 triangles\. The limit is 5,000 triangles; set EGVS_MAX_TRIANGLES",
    )
    yield "m.gltf", b"[" * 100_000, "it is nested too deeply"
    yield "m.gltf", gltf_with(buffers=[{"uri": "../../none.bin", "byteLength": 12}]), "cannot be loaded"
    yield "m.3mf", b"PK", "unknown mesh format '.3mf'. Use one of .ply, .obj"
    yield "m.zip", b"PK", "unknown mesh format '.zip'"
    yield "m", b"", "unknown mesh format ''"
    yield "m.ply", COMPLETE_FILES["m.stl"], "cannot be loaded"


@pytest.mark.parametrize(("name", "data", "message"), list(hostile()))
def test_rejects_damaged_or_hostile_mesh(
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    data: bytes,
    message: str,
) -> None:
    monkeypatch.setenv("EGVS_MAX_TRIANGLES", "5000")
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=message) as caught:
        load_mesh(tmp_path / name, str(tmp_path / name))
    assert str(caught.value).startswith(f"{tmp_path / name}: ")
    assert capfd.readouterr() == ("", "")


TEXTURED = b"mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n"


@pytest.mark.parametrize("pipe", ["m.mtl", "wall.png"])
def test_pipe_in_place_of_a_material_is_not_opened(tmp_path: Path, pipe: str) -> None:
    (tmp_path / "m.obj").write_bytes(TEXTURED)
    (tmp_path / "m.mtl").write_bytes(b"newmtl a\nmap_Kd wall.png\n")
    (tmp_path / pipe).unlink(missing_ok=True)
    os.mkfifo(tmp_path / pipe)
    assert len(load_mesh(tmp_path / "m.obj", "m.obj").faces) == 1


@pytest.mark.parametrize("name", ["points.bin", "../points.bin", "/dev/zero"])
def test_buffer_that_is_no_file_in_the_folder_is_not_opened(tmp_path: Path, name: str) -> None:
    document = json.loads(box_file("gltf"))
    document["buffers"][0]["uri"] = name
    folder = tmp_path / "meshes"
    folder.mkdir()
    (folder / "m.gltf").write_text(json.dumps(document))
    os.mkfifo(folder / "points.bin")
    (tmp_path / "points.bin").write_bytes(bytes(1000))
    with pytest.raises(InputError, match=f"m.gltf: cannot be loaded .*{name}' is no file in the folder of the mesh"):
        load_mesh(folder / "m.gltf", "m.gltf")


def folder_with_links(tmp_path: Path, uri: str) -> Path:
    """A glTF whose buffer is in the folder ``elsewhere``, which a link beside it leads to."""
    document = json.loads(box_file("gltf"))
    buffer = base64.b64decode(document["buffers"][0]["uri"].partition(",")[2])
    document["buffers"][0]["uri"] = uri
    folder, elsewhere = tmp_path / "meshes", tmp_path / "elsewhere" / "inside"
    folder.mkdir()
    elsewhere.mkdir(parents=True)
    (folder / "m.gltf").write_text(json.dumps(document))
    (elsewhere / "points.bin").write_bytes(buffer)
    (elsewhere.parent / "secret.bin").write_bytes(buffer)
    (folder / "linked").symlink_to(elsewhere)
    (folder / "linked.bin").symlink_to(elsewhere / "points.bin")
    return folder / "m.gltf"


@pytest.mark.parametrize("uri", ["linked.bin", "linked/points.bin"])
def test_link_counts_as_the_file_it_leads_to(tmp_path: Path, uri: str) -> None:
    path = folder_with_links(tmp_path, uri)
    assert len(load_mesh(path, "m.gltf").faces) == 12
    before = mesh_digests(path, "m")
    assert list(before) == ["m", f"m: {uri}"]
    (tmp_path / "elsewhere" / "inside" / "points.bin").write_bytes(b"other")
    assert mesh_digests(path, "m") != before


@pytest.mark.parametrize(
    "uri", ["linked/../secret.bin", "linked/../../elsewhere/secret.bin", "../elsewhere/secret.bin"]
)
def test_folder_above_a_link_is_not_opened(tmp_path: Path, uri: str) -> None:
    path = folder_with_links(tmp_path, uri)
    with pytest.raises(InputError, match=r"m\.gltf: cannot be loaded .*is no file in the folder of the mesh"):
        load_mesh(path, "m.gltf")


@pytest.mark.parametrize("name", COMPLETE_FILES)
def test_loads_every_format(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(COMPLETE_FILES[name])
    mesh = load_mesh(tmp_path / name, name)
    assert len(mesh.faces) == 12
    np.testing.assert_allclose(mesh.extents, (1, 2, 3), atol=1e-6)


@pytest.mark.parametrize("name", COMPLETE_FILES)
def test_random_damage_gives_mesh_or_input_error(tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str) -> None:
    rng = np.random.default_rng(7)
    for _ in range(60):
        data = bytearray(COMPLETE_FILES[name])
        if rng.random() < 0.3:
            del data[int(rng.integers(len(data))) :]
        else:
            for at in rng.integers(len(data), size=rng.integers(1, 4)):
                data[at] = rng.integers(256)
        (tmp_path / name).write_bytes(data)
        try:
            mesh = load_mesh(tmp_path / name, name)
            assert mesh.faces.max() < len(mesh.vertices)
        except InputError as error:
            assert str(error).startswith(f"{name}: ")
    assert capfd.readouterr() == ("", "")


def components_by_trimesh(mesh: trimesh.Trimesh) -> list[tuple[list[int], bool]]:
    """Return the triangles of each component, and whether it is closed, in the order of their first triangles."""
    parts = trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(mesh.faces)), min_len=1)
    components = []
    for part in sorted((np.sort(part) for part in parts), key=lambda part: int(part[0])):
        single = trimesh.Trimesh(mesh.vertices, mesh.faces[part], process=False)
        components.append((part.tolist(), bool(single.is_watertight and single.is_winding_consistent)))
    return components


def components_by_egvs(mesh: trimesh.Trimesh) -> list[tuple[list[int], bool]]:
    component = mesh_components(mesh.face_adjacency, len(mesh.faces))
    closed = are_closed(np.asarray(mesh.faces), component)
    return [(np.flatnonzero(component == number).tolist(), bool(closed[number])) for number in range(len(closed))]


def boxes_with_common_edge() -> trimesh.Trimesh:
    """Two boxes that share one edge, at which four triangles meet."""
    mesh = trimesh.util.concatenate([UNIT_BOX, UNIT_BOX.copy().apply_translation([1, 1, 0])])
    mesh.merge_vertices()
    return mesh


def shuffled_boxes(seed: int) -> trimesh.Trimesh:
    """Boxes, some without a triangle, some with a flipped one, their triangles in random order."""
    rng = np.random.default_rng(seed)
    boxes = [UNIT_BOX.copy().apply_translation([3 * i, 0, 0]) for i in range(12)]
    faces, start = [], 0
    for number, box in enumerate(boxes):
        box_faces = box.faces.copy()
        if number % 3 == 0:
            box_faces = box_faces[:-1]
        if number % 4 == 1:
            box_faces[0] = box_faces[0][::-1]
        faces.append(box_faces + start)
        start += len(box.vertices)
    return trimesh.Trimesh(
        np.concatenate([box.vertices for box in boxes]), rng.permutation(np.concatenate(faces)), process=False
    )


@pytest.mark.parametrize(
    "mesh",
    [
        UNIT_BOX,
        boxes_with_common_edge(),
        shuffled_boxes(1),
        shuffled_boxes(2),
        trimesh.Trimesh(UNIT_BOX.vertices, UNIT_BOX.faces[:1], process=False),
    ],
    ids=["box", "common edge", "shuffled", "shuffled, other seed", "one triangle"],
)
def test_components_agree_with_trimesh(mesh: trimesh.Trimesh) -> None:
    assert components_by_egvs(mesh) == components_by_trimesh(mesh)
