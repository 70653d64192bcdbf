"""Which runs can be exported."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from egvs.artefacts.checksums import add_checksum
from egvs.core import files
from egvs.core.grid import Roi
from egvs.formats.georeference import Georeference, WorldFrame
from egvs.world import geolocation
from tests.export.conftest import EPSG, OFFSET_M

Call = Callable[..., tuple[int, str, str]]


def test_rejects_a_missing_folder_and_a_folder_without_a_run(tmp_path: Path, run_egvs: Call) -> None:
    code, _, err = run_egvs("export", tmp_path / "none", "--to", "csv")
    assert (code, err) == (2, f"egvs: {tmp_path / 'none'}: no such folder. Give a folder written by egvs run.\n")
    code, _, err = run_egvs("export", tmp_path, "--to", "csv")
    assert (code, err) == (
        2,
        f"egvs: {tmp_path / 'run.json'}: no such file. Give a folder written by egvs run.\n",
    )


def test_rejects_an_unfinished_run_and_one_of_another_version(local: Path, tmp_path: Path, run_egvs: Call) -> None:
    """Without its seal a record is of another version."""
    shutil.copytree(local.parent, tmp_path / "copy")
    path = tmp_path / "copy" / "run" / "run.json"
    record = json.loads(path.read_text())
    for content, first in ((("check", "statics", "scan", "traffic", "tpog"), "score"), (None, "statics")):
        stages = {name: its for name, its in record["stages"].items() if content is None or name in content}
        value = {name: its for name, its in record.items() if name != "own_sha256"} | {"stages": stages}
        path.write_text(files.to_json_text(value if content is None else add_checksum(value)))
        code, _, err = run_egvs("export", path.parent, "--to", "csv", "--out", tmp_path / "out")
        problem = f"the stage {first} is not finished, or was run by another version of egvs"
        assert (code, err) == (2, f'egvs: {path}: {problem}. Run "egvs run" with the options of this folder.\n')
        assert not (tmp_path / "out").exists()


def test_rejects_a_run_from_before_the_scenario_had_a_reference_system(
    local: Path, tmp_path: Path, run_egvs: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    placed = Georeference(WorldFrame(f"EPSG:{EPSG}", OFFSET_M), Roi.around((0, 0, 0), (1, 1, 1)), "")
    monkeypatch.setattr(geolocation, "scenario_georeference", lambda scenario: placed)
    code, _, err = run_egvs("export", local, "--to", "csv", "--out", tmp_path / "out")
    problem = "its sites have no geographic position, but the scenario or its network has one"
    assert (code, err) == (2, f'egvs: {local / "scores.parquet"}: {problem}. Repeat "egvs run".\n')


def test_rejects_a_run_whose_scenario_has_moved(
    located: Path, tmp_path: Path, run_egvs: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved = Georeference(WorldFrame(f"EPSG:{EPSG}", (-550000.0, -5630001.0)), Roi.around((0, 0, 0), (1, 1, 1)), "")
    for now in (moved, Georeference(None, moved.roi, "")):
        monkeypatch.setattr(geolocation, "scenario_georeference", lambda scenario, now=now: now)
        code, _, err = run_egvs("export", located, "--to", "csv", "--out", tmp_path / "out")
        assert code == 2
        assert "scores.parquet: the geographic positions of its sites differ from those in the scenario" in err


@pytest.mark.parametrize("artefact", ["scores.parquet", "blindspots.parquet", "statics.ply"])
def test_rejects_a_damaged_artefact_and_writes_nothing(
    local: Path, tmp_path: Path, run_egvs: Call, artefact: str
) -> None:
    path, out = local / artefact, tmp_path / "out"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    try:
        code, _, err = run_egvs("export", local, "--to", "csv", "--out", out)
    finally:
        path.write_bytes(content)
    assert code == 2
    assert f"{path}: was altered or replaced" in err
    assert not out.exists()
