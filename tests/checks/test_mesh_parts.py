"""Whatever a mesh's file pulls in is an input: another buffer makes other statics."""

from pathlib import Path

import pytest
import trimesh

import pipeline
from pipeline.checks.mesh_parts import pulled_in
from pipeline.core import files
from pipeline.runs import workflow


@pytest.mark.system
def test_another_buffer_makes_the_statics_anew(mini: Path, tmp_path: Path) -> None:
    out, scenario = tmp_path / "out", mini / "scenario.toml"
    scenario.write_text(scenario.read_text() + '\n[[statics.meshes]]\nfile = "box.gltf"\nkind = "building"\n')

    def lay(height_m: float) -> None:
        box = trimesh.creation.box((2, 2, height_m))
        box.apply_translation((8, -8, height_m / 2))
        for name, data in trimesh.Scene(box).export(file_type="gltf").items():
            (mini / ("box.gltf" if name == "model.gltf" else name)).write_bytes(data)

    def statics() -> tuple[str, str]:
        seen: dict[str, str] = {}
        workflow.run(pipeline.load(mini), out, listener=lambda stage, state, _: seen.__setitem__(stage, state))
        return seen["check"], seen["statics"]

    lay(3.0)
    statics()
    mesh, first = (mini / "box.gltf").read_bytes(), files.sha256_of(out / "statics.ply")
    assert [part.suffix for part in pulled_in(mini / "box.gltf")] == [".bin"] * len(list(mini.glob("*.bin")))
    lay(4.0)
    (mini / "box.gltf").write_bytes(mesh)
    assert statics() == ("done", "done")
    assert files.sha256_of(out / "statics.ply") != first


@pytest.mark.parametrize("text", ["", "{", "[]", '{"buffers": 3}', '{"buffers": [{"uri": 5}, 7]}', "[" * 100_000])
def test_a_damaged_file_pulls_in_nothing(tmp_path: Path, text: str) -> None:
    for name in ("a.gltf", "a.glb", "a.obj"):
        (tmp_path / name).write_text(text)
        assert pulled_in(tmp_path / name) == []


def test_parts_of_glb_and_obj(tmp_path: Path) -> None:
    (tmp_path / "b.bin").write_bytes(b"")
    body = b'{"buffers": [{"uri": "b.bin"}, {"uri": "data:,"}, {"uri": "absent.bin"}]}'
    (tmp_path / "a.glb").write_bytes(b"glTF" + bytes(8) + len(body).to_bytes(4, "little") + b"JSON" + body)
    (tmp_path / "a.obj").write_text("mtllib b.bin\nv 0 0 0\n")
    assert [part.name for part in pulled_in(tmp_path / "a.glb")] == ["b.bin"]
    assert [part.name for part in pulled_in(tmp_path / "a.obj")] == ["b.bin"]
