"""A run resumes, reproduces and keeps its promises."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import signal
import time
from pathlib import Path

import pytest

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.checksums import add_checksum
from egvs.artefacts.run_folder import STAGE_NAMES
from egvs.core import files
from egvs.core.errors import InputError, RunError
from egvs.results.ranking import RankedSite
from egvs.runs import run, stage_registry, verification
from egvs.runs.run import lock_run_folder
from egvs.world import ray_casting
from tests import processes
from tests.conftest import fcd, write_mini

ROOT = Path(__file__).resolve().parents[2]
DATA = (
    "statics.ply",
    "scans.parquet",
    "trajectories.parquet",
    "tpog.parquet",
    "scores.parquet",
    "levels.parquet",
    "blindspots.parquet",
)


def digests(out: Path) -> dict[str, str]:
    return {name: files.hash_file(out / name) for name in DATA}


def states(scenario: egvs.Scenario, out: Path, **options: object) -> dict[str, str]:
    """Run, and say of each stage whether it ran or was skipped."""
    seen: dict[str, str] = {}
    run.run(scenario, out, listener=lambda stage, state, _: seen.__setitem__(stage, state), **options)  # type: ignore[arg-type]
    return seen


@pytest.fixture
def done(mini: Path, tmp_path: Path) -> tuple[Path, Path]:
    """A scenario folder and the folder of its finished run."""
    out = tmp_path / "out"
    egvs.run(egvs.load(mini), out)
    return mini, out


def test_record_names_all_artefacts(done: tuple[Path, Path]) -> None:
    _, out = done
    record = json.loads((out / "run.json").read_text())
    assert list(record["stages"]) == list(STAGE_NAMES)
    for stage in record["stages"].values():
        for name, digest in stage["artefacts"].items():
            assert files.hash_file(out / name) == digest
        assert set(stage["cost"]) == {"seconds", "peak_mb"}
    assert record["scenario"]["roi"]["voxel_m"] == 0.5
    assert record["scenario"]["tpog"] == {"blocks": 4}
    assert set(DATA) | {"report.html"} == {n for s in record["stages"].values() for n in s["artefacts"]}
    assert not list(out.glob(".*.partial"))


def test_columns_and_metadata_match_schemas(done: tuple[Path, Path]) -> None:
    _, out = done
    for name in ("trajectories", "tpog", "scans", "scores"):
        table, about = parquet.read_artefact(out / f"{name}.parquet", name)
        assert table.num_rows > 0
        assert {"schema", "scenario", "inputs", "seed"} <= set(about)
    sites = parquet.read_metadata(out / "scans.parquet", "scans")["sites"]
    assert [s["site"] for s in sites] == ["pole_a", "pole_b"]
    assert set(sites[0]) == {
        "site", "pole", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg", "sensor", "beams", "beams_in_roi",
        "returns",
    }  # fmt: skip
    about = parquet.read_metadata(out / "tpog.parquet", "tpog")
    assert about["grid"] == {"origin_m": [0.0, -10.0, 0.0], "voxel_m": 0.5, "shape": [80, 40, 10]}
    assert (about["frames"], about["block_frames"]) == (40, 10)


@pytest.mark.slow
def test_second_run_skips_every_stage(done: tuple[Path, Path], run_egvs) -> None:
    mini, out = done
    before = {p.name: p.stat().st_mtime_ns for p in out.iterdir() if p.is_file() and not p.name.startswith(".")}
    assert set(states(egvs.load(mini), out).values()) == {"skipped"}
    code, printed, said = run_egvs("run", mini, "--out", out)
    assert code == 0
    assert said.count("unchanged") == len(STAGE_NAMES)
    assert "\nno stage ran: no input has changed since the last run\n" in said
    assert "pole_a" in printed
    assert before == {p.name: p.stat().st_mtime_ns for p in out.iterdir() if p.is_file() and not p.name.startswith(".")}


CHANGES = {
    "score.gamma=9": {"score", "report"},
    "roi.voxel_m=0.25": {"tpog", "score", "report"},
    "tpog.blocks=5": {"tpog", "score", "report"},
    "sites.yaw_deg=3": {"check", "scan", "score", "report"},
    "traffic.frames=20": {"check", "traffic", "tpog", "score", "report"},
    "statics.ground=false": {"check", "statics", "scan", "tpog", "score", "report"},
}


@pytest.mark.slow
@pytest.mark.parametrize(("change", "again"), CHANGES.items(), ids=CHANGES.keys())
def test_changed_setting_runs_dependent_stages(
    done: tuple[Path, Path], tmp_path: Path, change: str, again: set[str]
) -> None:
    mini, out = done
    scenario = egvs.load(mini, [change])
    assert {stage for stage, state in states(scenario, out).items() if state == "done"} == again
    fresh = tmp_path / "fresh"
    egvs.run(scenario, fresh)
    assert digests(out) == digests(fresh)  # nothing of the earlier run shows


@pytest.mark.slow
@pytest.mark.parametrize("option", [(), ("--all",), ("--top", 1), ("--verbose",)])
def test_run_without_changes_prints_what_complete_run_printed(
    mini: Path, tmp_path: Path, run_egvs, option: tuple[object, ...]
) -> None:
    command = ("run", mini, "--out", tmp_path / "out", *option)
    _, printed, said = run_egvs(*command)
    assert "no stage ran" not in said
    code, printed_again, said = run_egvs(*command)
    assert (code, printed_again) == (0, printed)
    assert "no stage ran" in said


CHANGED_FILES = {
    "base/sites.csv": {"check", "scan"},
    "base/statics.geojson": {"check", "statics", "scan"},
    "base/fcd.csv": {"check", "traffic"},
    "base/wall.obj": {"statics", "scan"},
    "base/paint.mtl": {"statics", "scan"},
    "derived/fcd.csv": {"check", "traffic"},
}
"""File -> stages that run again at least, after something was appended to it, or it was added."""


@pytest.mark.slow
@pytest.mark.parametrize("name", CHANGED_FILES)
def test_changed_file_runs_dependent_stages(tmp_path: Path, name: str) -> None:
    base = write_mini(tmp_path / "base")
    (base / "wall.obj").write_text("mtllib paint.mtl\nv 1 9 0\nv 2 9 0\nv 1 9 3\nf 1 2 3\n")
    text = (base / "scenario.toml").read_text()
    (base / "scenario.toml").write_text(text.replace("[tpog]", '[[statics.meshes]]\nfile = "wall.obj"\n\n[tpog]'))
    (tmp_path / "derived").mkdir()
    (tmp_path / "derived" / "scenario.toml").write_text('extends = "../base"\nname = "derived"\n')
    scenario, out = egvs.load(tmp_path / "derived"), tmp_path / "out"
    egvs.run(scenario, out)

    path = tmp_path / name
    content = path.read_text() if path.exists() else "newmtl a" if path.suffix == ".mtl" else fcd()
    path.write_text(content + "\n")
    assert {stage for stage, state in states(scenario, out).items() if state == "done"} >= CHANGED_FILES[name]


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        ("roi.center_m=[900, 0, 2.5]",),  # the check refuses it
        ("traffic.frames=4000",),  # the finished file has fewer; the stages before are as they were
    ],
)
def test_rejected_run_leaves_folder_unchanged(done: tuple[Path, Path], settings: tuple[str, ...], run_egvs) -> None:
    scenario, out = done
    before = {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}
    code, _, said = run_egvs("run", scenario, "--out", out, *(word for its in settings for word in ("--set", its)))
    assert code == 2, said
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()} == before
    assert verification.verify(out) == []


@pytest.mark.slow
def test_interrupted_run_records_one_scenario(done: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Of what was made by then, and of no score of the scenario before; what did not change is not made again."""
    mini, out = done
    other, make = egvs.load(mini, ["statics.ground=false", "traffic.frames=20"]), stage_registry.run_stage

    def fails(name: str, *rest: object, **options: object) -> object:
        if name == "traffic":
            raise RunError("traffic: it does not keep what is promised")
        return make(name, *rest, **options)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(stage_registry, "run_stage", fails)
        with pytest.raises(RunError):
            run.run(other, out)
    record = json.loads((out / "run.json").read_text())
    assert (record["scenario"]["statics"]["ground"], list(record["stages"])) == (False, ["check", "statics", "scan"])
    with pytest.raises(InputError, match="the stage traffic has not been run"):
        verification.verify(out)
    again = states(egvs.load(mini, ["statics.ground=false"]), out)
    assert (again["statics"], again["scan"], again["traffic"]) == ("skipped", "skipped", "fetched")
    assert verification.verify(out) == []


@pytest.mark.slow
def test_scoring_again_casts_nothing(done: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    mini, out = done
    casts = []
    monkeypatch.setattr(ray_casting.Caster, "scan", lambda *_: casts.append(1))
    for change in ("score.gamma=2.5", "roi.voxel_m=0.25", "traffic.frames=20"):
        egvs.run(egvs.load(mini, [change]), out)
    assert casts == []


@pytest.mark.slow
def test_scores_are_the_same_without_stored_scans(done: tuple[Path, Path], tmp_path: Path) -> None:
    mini, out = done
    lean = tmp_path / "lean"
    egvs.run(egvs.load(mini, ["scan.keep=false"]), lean)
    assert not (lean / "scans.parquet").exists()
    assert egvs.read_scores(lean / "scores.parquet") == egvs.read_scores(out / "scores.parquet")


@pytest.mark.slow
def test_number_of_threads_changes_no_byte(done: tuple[Path, Path], tmp_path: Path) -> None:
    mini, out = done
    for jobs in (1, 3):
        other = tmp_path / str(jobs)
        egvs.run(egvs.load(mini), other, jobs=jobs)
        assert digests(other) == digests(out)


@pytest.mark.slow
def test_verify_names_altered_artefact(done: tuple[Path, Path], tmp_path: Path, run_egvs) -> None:
    mini, out = done
    moved, source = tmp_path / "elsewhere" / "run", tmp_path / "elsewhere" / "scenario"
    shutil.copytree(out, moved)
    shutil.copytree(mini, source)
    code, printed, said = run_egvs("verify", moved, "--scenario", source)
    assert (code, "byte for byte" in printed) == (0, True), said + printed
    data = bytearray((moved / "tpog.parquet").read_bytes())
    data[len(data) // 2] ^= 1
    (moved / "tpog.parquet").write_bytes(bytes(data))
    code, printed, _ = run_egvs("verify", moved, "--scenario", source)
    assert code == 1
    assert re.search(r"tpog.parquet was altered", printed)
    assert "scans.parquet" not in printed


@pytest.mark.slow
def test_verify_reports_changed_scenario(done: tuple[Path, Path], run_egvs) -> None:
    mini, out = done
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\npole_a,11,12,3\npole_b,30.5,-12,3\n")
    code, printed, _ = run_egvs("verify", out)
    assert code == 1
    assert "scans.parquet differs" in printed


def test_verify_rejects_unfinished_run(done: tuple[Path, Path]) -> None:
    _, out = done
    record = json.loads((out / "run.json").read_text())
    del record["stages"]["score"]
    (out / "run.json").write_text(json.dumps(add_checksum(record)))
    with pytest.raises(InputError, match="the stage score has not been run"):
        verification.verify(out)


def test_rejects_second_run_in_same_folder(done: tuple[Path, Path]) -> None:
    mini, out = done
    with lock_run_folder(out), pytest.raises(RunError, match="another run is using this folder"):
        egvs.run(egvs.load(mini), out)


def test_rejects_file_that_is_no_record(done: tuple[Path, Path]) -> None:
    mini, out = done
    (out / "run.json").write_text("[]")
    with pytest.raises(InputError, match="is not a run record"):
        egvs.run(egvs.load(mini), out)


@pytest.mark.slow
@pytest.mark.parametrize("key", ["scenario", "scenario_folder", "egvs", "seed"])
def test_rejects_record_with_invalid_value(done: tuple[Path, Path], key: str, run_egvs) -> None:
    mini, out = done
    record = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps(add_checksum(record | {key: [None]})))
    for arguments in (("run", mini, "--out", out), ("verify", out)):
        code, _, said = run_egvs(*arguments)
        assert (code, f"'{key}' is" in said) == (2, True), said


@pytest.mark.slow
def test_rejects_damaged_record(done: tuple[Path, Path], run_egvs) -> None:
    mini, out = done
    text = (out / "run.json").read_text()
    for old, new in (('"peak_mb": ', '"peak_mb": 1'), ('"triangles"', '"triangle"'), ("4", '"4"'), ("9", "9" * 5000)):
        assert old in text
        (out / "run.json").write_text(text.replace(old, new, 1))
        for arguments in (("run", mini, "--out", out), ("verify", out)):
            code, _, said = run_egvs(*arguments)
            assert (code, said.startswith(f"egvs: {out / 'run.json'}: ")) == (2, True), said
            assert "Remove it and run again" in said


@pytest.mark.slow
def test_single_stage_drops_stages_of_other_settings(done: tuple[Path, Path], run_egvs) -> None:
    mini, out = done
    assert run_egvs("score", mini, "--out", out, "--set", "score.gamma=7", "--set", "sites.yaw_deg=5")[0] == 0
    code, _, said = run_egvs("verify", out)
    assert (code, "the stage check has not been run" in said) == (2, True), said
    assert run_egvs("run", mini, "--out", out)[0] == 0
    assert run_egvs("verify", out)[0] == 0


def test_rejects_folder_in_place_of_artefact(mini: Path, tmp_path: Path, run_egvs) -> None:
    (tmp_path / "out" / "scans.parquet").mkdir(parents=True)
    code, _, said = run_egvs("run", mini, "--out", tmp_path / "out")
    assert (code, "scans.parquet: expected a file, got a folder" in said) == (2, True), said
    assert not list((tmp_path / "out").glob(".*.partial"))


@pytest.mark.slow
def test_notebook_lines_of_the_readme_run(mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    code = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert code is not None
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "scenarios", tmp_path / "scenarios")
    names: dict[str, object] = {}
    exec(code.group(1), names)  # the README's own words
    assert names["tpog"].p.max() <= 1.0  # type: ignore[attr-defined]
    assert 0.0 < names["rated"].scores["expected_detections"] < 1.0  # type: ignore[attr-defined]


def test_editor_schema_is_not_stale() -> None:
    from egvs.scenario.loading import json_schema

    assert (ROOT / "data_schemas" / "scenario.schema.json").read_text(encoding="utf-8") == json_schema(), (
        "run: make schema"
    )


@pytest.mark.slow
def test_seed_changes_only_random_artefacts(mini: Path, tmp_path: Path, run_egvs) -> None:
    out = tmp_path / "out"
    assert run_egvs("run", mini, "--out", out, "--set", "seed=5")[0] == 0
    before = {name: (out / name).read_bytes() for name in ("statics.ply", "scans.parquet")}
    code, _, said = run_egvs("run", mini, "--out", out, "--set", "seed=6")
    assert code == 0
    assert re.search(r"scan +unchanged", said)
    assert {name: (out / name).read_bytes() for name in before} == before
    assert run_egvs("verify", out)[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize("by", ["egvs", "seen_well", "points_on_target", "entropy_seen"])
@pytest.mark.parametrize("width", [80, 120, 190])
def test_ranking_fits_terminal_width(mini: Path, tmp_path: Path, width: int, by: str) -> None:
    """No number is cut, on the narrowest terminal too."""
    from rich.console import Console

    from egvs.cli.run_tables import ranking_table

    egvs.run(egvs.load(mini, [f"score.rank_by={by}"]), tmp_path)
    table = egvs.read_scores(tmp_path / "scores.parquet")
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(ranking_table(RankedSite.read(tmp_path / "scores.parquet"), width))
    text = console.export_text()
    assert "…" not in text
    assert all(len(line) <= width for line in text.splitlines())
    if by == "egvs" or width > 130:
        assert all(f"{value:.1f}" in text for value in table["egvs"].to_pylist())
    told = (lambda value: f"{value:.2f}") if by == "points_on_target" else (lambda value: f"{100 * value:.1f} %")
    assert by == "egvs" or all(told(value) in text for value in table[by].to_pylist())


@pytest.mark.slow
@pytest.mark.parametrize("words", [("run",), ("accuracy", "--budget", "20s")])
def test_interrupt_prints_message(tmp_path: Path, words: tuple[str, ...]) -> None:
    """It comes while SUMO is at work, which is seen by what SUMO writes."""
    out = tmp_path / "out"
    scenario = ROOT / "scenarios" / "nishishinjuku"
    started = processes.Started(processes.EGVS, words[0], scenario, "--out", out, *words[1:])
    while not list(out.rglob("fcd.csv")) and started.process.is_alive():
        time.sleep(0.01)  # decides nothing: SUMO simulates for longer than a look takes
    os.kill(started.process.pid, signal.SIGINT)
    done = started.ended()
    assert done.returncode == 130, done.stderr
    assert "egvs: interrupted; run the same command again" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_record_of_earlier_version_has_no_stages(done: tuple[Path, Path]) -> None:
    """Its stages are run again, or fetched; there is nothing to verify."""
    mini, out = done
    record = json.loads((out / "run.json").read_text())
    for stage in record["stages"].values():
        stage["said"] = stage.pop("summary")
        del stage["files"]
    del record["own_sha256"]
    (out / "run.json").write_text(json.dumps(record | {"effects": []}))
    with pytest.raises(InputError, match="the stage check has not been run"):
        verification.verify(out)
    assert set(states(egvs.load(mini), out).values()) == {"fetched"}
    assert verification.verify(out) == []
    assert not {"effects", "said"} & json.loads((out / "run.json").read_text()).keys()


@pytest.mark.slow
def test_prints_best_sites_and_counts_others(mini: Path, tmp_path: Path, run_egvs) -> None:
    rows = [f"p{i:02d},{2 + i},12,{3 + i / 8}" for i in range(9)]
    (mini / "sites.csv").write_text("\n".join(["site,x_m,y_m,z_m", *rows]) + "\n")

    def listed(*words: object) -> list[str]:
        code, printed, error = run_egvs(*words, "--out", tmp_path / "out")
        assert code == 0, error
        return [line.split()[1] for line in printed.splitlines() if re.match(r"\s*\d+\s+p\d\d", line)]

    best = listed("run", mini)
    ranked = listed("score", mini)
    assert (len(ranked), best) == (9, ranked[:5])
    assert listed("run", mini, "--top", 4) == ranked[:4]
    assert listed("score", mini, "--top", 4) == ranked[:4]
    assert listed("run", mini, "--all") == ranked + ranked, "the complete ranking, and the poles"
    assert "... and 5 more; omit --top" in run_egvs("score", mini, "--out", tmp_path / "out", "--top", 4)[1]
    assert "omit --top" not in run_egvs("score", mini, "--out", tmp_path / "out", "--top", 9)[1]
    assert run_egvs("run", mini, "--top", 0)[0] == 2
