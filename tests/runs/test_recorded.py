"""A single verb reads an artefact only as run.json names it: flipped bits and files of other runs are refused."""

from __future__ import annotations

import json
import random
import shutil
from pathlib import Path

import pytest

import egvs
from egvs.artefacts.checksums import add_checksum
from egvs.core import files
from egvs.core.errors import InputError
from egvs.runs import run
from egvs.runs.run_context import open_folder
from egvs.stages import scene_inputs
from egvs.studies.effect_study import EffectTrials

READ_BY = {
    "trajectories.parquet": ("tpog", "score", "report"),
    "statics.ply": ("scan", "tpog", "report"),
    "tpog.parquet": ("score", "report"),
    "scans.parquet": ("score", "report"),
    "scores.parquet": ("report",),
    "blindspots.parquet": ("report",),
}
PAIRS = [(name, verb) for name, verbs in READ_BY.items() for verb in verbs]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[egvs.Scenario, Path, Path]:
    """A scenario, its finished run, and one of other settings."""
    from tests.conftest import write_mini

    folder = tmp_path_factory.mktemp("recorded")
    scenario = egvs.load(write_mini(folder / "mini"))
    egvs.run(scenario, folder / "out")
    others = ["traffic.frames=20", "score.gamma=2", "statics.ground=false", "sensors.small.channels=4"]
    egvs.run(egvs.load(scenario.folder, others), folder / "other")
    return scenario, folder / "out", folder / "other"


@pytest.fixture
def out(runs: tuple[egvs.Scenario, Path, Path], tmp_path: Path) -> Path:
    """A copy of the finished run, in a folder of its own."""
    copy = Path(shutil.copytree(runs[1], tmp_path / "out"))
    record = json.loads((copy / "run.json").read_text())
    record["scenario_folder"] = str(runs[0].folder)
    (copy / "run.json").write_text(json.dumps(add_checksum(record)))
    return copy


def contents(folder: Path) -> dict[str, str]:
    return {path.name: files.hash_file(path) for path in folder.iterdir() if path.is_file()}


def answer(verb: str, scenario: egvs.Scenario, out: Path) -> str:
    with pytest.raises(InputError) as caught:
        run.run_one(verb, scenario, out)
    return str(caught.value)


@pytest.mark.parametrize(("name", "verb"), PAIRS)
def test_rejects_artefact_with_flipped_bit(runs, out: Path, name: str, verb: str) -> None:
    whole, draw = (out / name).read_bytes(), random.Random(f"{name} {verb}")
    for _ in range(5):
        data = bytearray(whole)
        data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
        (out / name).write_bytes(data)
        before = contents(out)
        said = answer(verb, runs[0], out)
        now, known = (files.hash_file(path / name)[:12] for path in (out, runs[1]))
        altered = (
            f'{out / name}: was altered or replaced (sha256 {now}, in run.json {known}). Repeat "egvs run" '
            "to create it."
        )
        assert said == altered
        assert contents(out) == before, "a refused verb wrote something"


@pytest.mark.parametrize(("name", "verb"), PAIRS)
def test_rejects_artefact_of_another_run(runs, out: Path, name: str, verb: str) -> None:
    scenario, _, other = runs
    shutil.copyfile(other / name, out / name)
    assert f"{out / name}: was altered or replaced" in answer(verb, scenario, out)


def test_rejects_artefact_that_no_stage_wrote(runs, tmp_path: Path, run_egvs) -> None:
    scenario, made, _ = runs
    fresh = tmp_path / "fresh"
    fresh.mkdir()
    for name in ("trajectories.parquet", "statics.ply"):
        shutil.copyfile(made / name, fresh / name)
    code, _, error = run_egvs("tpog", scenario.folder, "--out", fresh)
    what = 'was not created by any stage recorded in run.json. Repeat "egvs run" to create it.'
    assert (code, error) == (2, f"egvs: {fresh / 'trajectories.parquet'}: {what}\n")
    assert not (fresh / "tpog.parquet").exists()


def test_run_repairs_altered_artefact(runs, out: Path) -> None:
    for name in READ_BY:
        shutil.copyfile(runs[2] / name, out / name)
    run.run(runs[0], out)
    assert {name: contents(out)[name] for name in READ_BY} == {name: contents(runs[1])[name] for name in READ_BY}


@pytest.mark.slow
def test_single_stages_continue_from_existing_artefacts(runs, tmp_path: Path, run_egvs) -> None:
    scenario, made, _ = runs
    for verb in ("statics", "scan", "traffic", "tpog", "score", "report"):
        code, _, error = run_egvs(verb, scenario.folder, "--out", tmp_path / "out")
        assert code == 0, error
    for name in READ_BY:
        assert files.hash_file(tmp_path / "out" / name) == files.hash_file(made / name)


@pytest.mark.slow
def test_digest_of_read_artefact_is_known_after_setting_change(runs, out: Path, run_egvs) -> None:
    """Traffic of other settings is no longer what the scenario says, and its record goes; the file is still known."""
    for _ in range(2):
        code, _, error = run_egvs("score", runs[0].folder, "--out", out, "--set", "traffic.frames=20")
        assert code == 0, error
        assert "traffic" not in json.loads((out / "run.json").read_text())["stages"]


def test_report_is_not_refreshed_from_altered_artefacts(runs, out: Path) -> None:
    assert run.refresh_report(out) is not None
    before = contents(out)["report.html"]
    shutil.copyfile(runs[2] / "scores.parquet", out / "scores.parquet")
    assert run.refresh_report(out) is None
    assert contents(out)["report.html"] == before


@pytest.mark.parametrize("name", ["trajectories.parquet", "tpog.parquet", "statics.ply"])
def test_effect_study_rejects_altered_traffic(runs, out: Path, name: str) -> None:
    scene = scene_inputs.resolve_scene(runs[0], open_folder(runs[0], out).world)
    assert EffectTrials.from_run(scene, out) is not None
    shutil.copyfile(runs[2] / name, out / name)
    assert EffectTrials.from_run(scene, out) is None
