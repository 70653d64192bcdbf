"""Meshes of other people: damaged or hostile ones are refused by one message, and trimesh prints nothing."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh

from egvs.core.errors import InputError
from egvs.formats.meshes import MESH_FORMATS, load_mesh

BOX = trimesh.creation.box((1, 2, 3))


def written(kind: str, **how: str) -> bytes:
    """A box as a file of a kind."""
    if kind == "gltf":
        parts = trimesh.Scene(BOX).export(file_type="gltf", embed_buffers=True)
        return parts["model.gltf"]
    data = BOX.export(file_type=kind, **how)
    return data.encode() if isinstance(data, str) else data


def a_gltf(**parts: object) -> bytes:
    """A glTF with something else in it."""
    return json.dumps(json.loads(written("gltf")) | parts).encode()


def a_glb(described: object) -> bytes:
    text = json.dumps(described).encode()
    return b"glTF" + struct.pack("<IIII", 2, 20 + len(text), len(text), 0x4E4F534A) + text


ASCII_PLY = written("ply", encoding="ascii")
WHOLE = {"ascii.ply": ASCII_PLY, "text.stl": written("stl_ascii")} | {
    f"m.{kind}": written(kind) for kind in MESH_FORMATS
}
ZEROS = {"componentType": 5126, "type": "VEC3", "count": 10**9}
PLACED = [{"mesh": 0} for _ in range(1000)]


def hostile() -> Iterator[tuple[str, bytes, str]]:
    """(name, content, what the message says)."""
    yield "m.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 9999999999\nend_header\n", "in 1 bytes"
    yield "m.ply", ASCII_PLY[:-20], r"says that it holds 8 of 'vertex' and 12 of 'face' in 1\d lines"
    yield "m.ply", WHOLE["m.ply"][:-20], "cannot be loaded"
    yield "m.ply", ASCII_PLY.replace(b"-0.5", b"-0.5x", 1), "cannot be loaded"
    yield "m.ply", b"ply\n", "m.ply"
    yield "m.stl", WHOLE["m.stl"][:-20], "m.stl"
    yield "m.stl", WHOLE["text.stl"].replace(b"0.5", b"0.x", 1), "cannot be loaded"
    yield "m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "m.obj"
    yield "m.obj", b"v 0 0\nf 1 2 3\n", "m.obj"
    yield "m.obj", b"v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", "line 2: 'v 1 0' has fewer than three coordinates"
    yield "m.obj", b"v 0 0 0\nv 1 0 \\\n0\nv 0 1 \n.0 0\nf 1 2 3\n", "line 5: '.0 0' is of no kind of line"
    yield "m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n.0 6\nf 1 2 3\n", "line 4: '.0 6' is of no kind of line"
    yield "m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2 0/1/0\n", "line 5: 'f 1 2 0' names vertex 0"
    yield "m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 7 65\n", "line 5: 'f 7 65' is a face of fewer than three"
    yield "m.obj", b"\x80\x81\xff\xfe" * 100, "m.obj"
    yield "m.off", b"OFF\n3 1 0\n0 0 0\n", "m.off"
    yield "m.glb", WHOLE["m.glb"][:-20], "cannot be loaded"
    yield "m.glb", b"glTF", "cannot be loaded"
    yield (
        "m.glb",
        a_glb({"accessors": [ZEROS]}),
        r"its accessors name more than that\. The limit is 1,000 MB; set EGVS_MAX_UNPA",
    )
    yield "m.glb", a_glb([[[]]]), "m.glb"
    yield "m.gltf", a_gltf(accessors=[ZEROS]), "EGVS_MAX_UNPACKED_MB"
    yield "m.gltf", a_gltf(accessors=[{"count": "many"}]), "an accessor's count is 'many'"
    yield (
        "m.gltf",
        a_gltf(nodes=PLACED),
        r"12,000 triangles\. The limit is 5,000 triangles; set EGVS_MAX_TRIANGLES",
    )
    yield "m.gltf", b"[" * 100_000, "it is nested too deeply"
    yield "m.gltf", a_gltf(buffers=[{"uri": "../../none.bin", "byteLength": 12}]), "cannot be loaded"
    yield "m.3mf", b"PK", "is of the kind '.3mf'; one of .ply, .obj"
    yield "m.zip", b"PK", "is of the kind '.zip'"
    yield "m", b"", "is of the kind ''"
    yield "m.ply", WHOLE["m.stl"], "cannot be loaded"


@pytest.mark.parametrize(("name", "data", "said"), list(hostile()))
def test_what_is_no_mesh_is_refused(
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    data: bytes,
    said: str,
) -> None:
    monkeypatch.setenv("EGVS_MAX_TRIANGLES", "5000")
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=said) as refused:
        load_mesh(tmp_path / name, str(tmp_path / name))
    assert str(refused.value).startswith(f"{tmp_path / name}: ")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", WHOLE)
def test_what_is_whole_is_loaded(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(WHOLE[name])
    mesh = load_mesh(tmp_path / name, name)
    assert len(mesh.faces) == 12
    np.testing.assert_allclose(mesh.extents, (1, 2, 3), atol=1e-6)


@pytest.mark.parametrize("name", WHOLE)
def test_damage_is_told_or_harmless(tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str) -> None:
    """No damage of a byte or an end ends otherwise than in a mesh or a message."""
    rng, whole = np.random.default_rng(7), WHOLE[name]
    for _ in range(60):
        data = bytearray(whole)
        if rng.random() < 0.3:
            del data[int(rng.integers(len(data))) :]
        else:
            for at in rng.integers(len(data), size=rng.integers(1, 4)):
                data[at] = rng.integers(256)
        (tmp_path / name).write_bytes(data)
        try:
            mesh = load_mesh(tmp_path / name, name)
            assert mesh.faces.max() < len(mesh.vertices)
        except InputError as refused:
            assert str(refused).startswith(f"{name}: ")
    assert capfd.readouterr() == ("", "")
