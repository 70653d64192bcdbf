"""Whatever a mesh's file pulls in is an input: another buffer makes other statics."""

from pathlib import Path

import pytest
import trimesh

import egvs
from egvs.core import files
from egvs.formats.meshes import mesh_digests, referenced_files
from egvs.runs import run


@pytest.mark.slow
@pytest.mark.system
def test_changed_mesh_buffer_repeats_statics(mini: Path, tmp_path: Path) -> None:
    out, scenario = tmp_path / "out", mini / "scenario.toml"
    scenario.write_text(scenario.read_text() + '\n[[statics.meshes]]\nfile = "box.gltf"\nkind = "building"\n')

    def lay(height_m: float) -> None:
        box = trimesh.creation.box((2, 2, height_m))
        box.apply_translation((8, -8, height_m / 2))
        for name, data in trimesh.Scene(box).export(file_type="gltf").items():
            (mini / ("box.gltf" if name == "model.gltf" else name)).write_bytes(data)

    def statics() -> tuple[str, str]:
        seen: dict[str, str] = {}
        run.run(egvs.load(mini), out, listener=lambda stage, state, _: seen.__setitem__(stage, state))
        return seen["check"], seen["statics"]

    lay(3.0)
    statics()
    mesh, first = (mini / "box.gltf").read_bytes(), files.hash_file(out / "statics.ply")
    assert [part.suffix for part in referenced_files(mini / "box.gltf")] == [".bin"] * len(list(mini.glob("*.bin")))
    lay(4.0)
    (mini / "box.gltf").write_bytes(mesh)
    assert statics() == ("done", "done")
    assert files.hash_file(out / "statics.ply") != first


@pytest.mark.parametrize("text", ["", "{", "[]", '{"buffers": 3}', '{"buffers": [{"uri": 5}, 7]}', "[" * 100_000])
def test_damaged_mesh_references_no_file(tmp_path: Path, text: str) -> None:
    for name in ("a.gltf", "a.glb", "a.obj"):
        (tmp_path / name).write_text(text)
        assert referenced_files(tmp_path / name) == []


def test_referenced_files_of_glb_and_obj(tmp_path: Path) -> None:
    (tmp_path / "b.bin").write_bytes(b"")
    body = b'{"buffers": [{"uri": "b.bin"}, {"uri": "data:,"}, {"uri": "absent.bin"}]}'
    (tmp_path / "a.glb").write_bytes(b"glTF" + bytes(8) + len(body).to_bytes(4, "little") + b"JSON" + body)
    (tmp_path / "a.obj").write_text("mtllib b.bin\nv 0 0 0\n")
    assert [part.name for part in referenced_files(tmp_path / "a.glb")] == ["b.bin"]
    assert [part.name for part in referenced_files(tmp_path / "a.obj")] == ["b.bin"]


def test_textures_and_percent_encoded_names(tmp_path: Path) -> None:
    for name in ("skin of car.png", "b.png", "c.png", "not.png", "a b.bin"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "m.mtl").write_text(
        "newmtl x\nKd 1 1 1\nmap_Kd -s 1 1 1 b.png\n  map_Bump skin of car.png\nbump none.png\n"
    )
    (tmp_path / "a.obj").write_text("mtllib m.mtl\n# mtllib not.png\nv 0 0 0\n")
    assert [part.name for part in referenced_files(tmp_path / "a.obj")] == ["m.mtl", "b.png", "skin of car.png"]
    (tmp_path / "a.gltf").write_text('{"buffers": [{"uri": "a%20b.bin"}], "images": [{"uri": "sub/c.png"}]}')
    assert [part.name for part in referenced_files(tmp_path / "a.gltf")] == ["a b.bin", "c.png"]
    (tmp_path / "a.ply").write_bytes(b"ply\ncomment TextureFile c.png\nend_header\ncomment TextureFile b.png\n")
    assert [part.name for part in referenced_files(tmp_path / "a.ply")] == ["c.png"]


def test_impossible_file_name_is_ignored(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(b"mtllib " + b"x" * 5000 + b"\nmtllib \0\n")
    assert referenced_files(tmp_path / "a.obj") == []


def test_digests_distinguish_files_of_equal_name(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "t.bin").write_text(folder)
    (tmp_path / "m.gltf").write_text('{"buffers": [{"uri": "a/t.bin"}, {"uri": "b/t.bin"}]}')
    assert list(mesh_digests(tmp_path / "m.gltf", "mesh")) == ["mesh", "mesh: a/t.bin", "mesh: b/t.bin"]
    assert len(set(mesh_digests(tmp_path / "m.gltf", "mesh").values())) == 3
