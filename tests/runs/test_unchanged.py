"""A run in which nothing has changed prints what it printed before, without computing keys; changes are noticed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import egvs.runs.run
from egvs.artefacts.run_folder import UNCHANGED_PATTERN
from egvs.artefacts.run_record import RunRecord
from egvs.cli import repeat
from egvs.core import files
from egvs.runs import digest_cache, stage_keys, unchanged
from tests.conftest import collection, write_mini

pytestmark = pytest.mark.slow

BASE, DERIVED = "base", "derived"


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The run folders in which keys were computed, as opposed to those of recalled runs."""
    folders: list[Path] = []
    run = egvs.runs.run.run

    def count(scenario: Any, out: Path, **options: Any) -> Any:
        folders.append(out)
        return run(scenario, out, **options)

    monkeypatch.setattr(egvs.runs.run, "run", count)
    return folders


@pytest.fixture(scope="module")
def common_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of all tests here: only the first one computes the stages."""
    return tmp_path_factory.mktemp("common")


@pytest.fixture
def folder(tmp_path: Path, common_store: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, with the scenario "mini", and "derived", which extends "base" and has an OBJ mesh."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("EGVS_STORE", str(common_store))
    write_mini(tmp_path / "mini")
    base = write_mini(tmp_path / BASE)
    (base / "wall.obj").write_text("mtllib paint.mtl\nv 1 9 0\nv 2 9 0\nv 1 9 3\nf 1 2 3\n")
    text = (base / "scenario.toml").read_text()
    meshes = '[[statics.meshes]]\nfile = "wall.obj"\n\n[tpog]'
    (base / "scenario.toml").write_text(text.replace("[tpog]", meshes))
    (tmp_path / DERIVED).mkdir()
    (tmp_path / DERIVED / "scenario.toml").write_text(f'extends = "../{BASE}"\nname = "derived"\n')
    return tmp_path


RUN_MINI = ("run", "mini", "--out", "out")
RUN_DERIVED = ("run", DERIVED)


def test_recalled_run_prints_the_same_as_computed_one(folder: Path, runs: list[Path], run_egvs: Callable) -> None:
    _, first_out, first_err = run_egvs(*RUN_MINI)
    recalled = run_egvs(*RUN_MINI)
    assert len(runs) == 1
    assert recalled[1] == first_out
    assert "no stage ran" in recalled[2] and "no stage ran" not in first_err

    next((folder / "out").glob(UNCHANGED_PATTERN)).unlink()
    assert run_egvs(*RUN_MINI) == recalled
    assert len(runs) == 2


@pytest.mark.parametrize("option", [("--all",), ("--top", 1), ("--verbose",), ("--jobs", 1)])
def test_run_with_other_options_prints_their_output(
    folder: Path, runs: list[Path], run_egvs: Callable, option: tuple[object, ...]
) -> None:
    run_egvs(*RUN_MINI)
    computed = run_egvs(*RUN_MINI, *option)
    assert run_egvs(*RUN_MINI, *option) == computed
    has_other_output = option[0] != "--jobs"
    assert len(runs) == 1 + has_other_output


@pytest.mark.parametrize("option", ["--rehash", "--audit"])
def test_options_that_recompute_are_not_recalled(
    folder: Path, runs: list[Path], run_egvs: Callable, option: str
) -> None:
    run_egvs(*RUN_MINI)
    run_egvs(*RUN_MINI, option)
    assert len(runs) == 2


def test_run_in_default_folder_is_recalled(folder: Path, runs: list[Path], run_egvs: Callable) -> None:
    for settings in ((), ("--set", "score.gamma=3")):
        run_egvs(*RUN_DERIVED, *settings)
        run_egvs(*RUN_DERIVED, *settings)
    assert [folder.as_posix() for folder in runs] == ["runs/derived", "runs/derived@gamma=3"]


def edit(name: str) -> Callable[[Path], object]:
    """Change one byte of a file, but neither its size nor its times."""

    def change(folder: Path) -> None:
        path = folder / name
        status = path.stat()
        content = bytearray(path.read_bytes())
        content[-2] ^= 1
        path.write_bytes(bytes(content))
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))

    return change


def append_comment(name: str) -> Callable[[Path], object]:
    """Change a file without changing what it means."""
    return lambda folder: (folder / name).write_text((folder / name).read_text() + "\n")


def write(name: str, content: str = "x") -> Callable[[Path], object]:
    """Write a file that was not there."""

    def change(folder: Path) -> None:
        assert not (folder / name).exists()
        (folder / name).write_text(content)

    return change


def write_long_ago(name: str) -> Callable[[Path], object]:
    """Write a file whose stamp is trusted."""

    def change(folder: Path) -> None:
        write(name)(folder)
        os.utime(folder / name, (1e9, 1e9))

    return change


def link_to_copy(name: str) -> Callable[[Path], object]:
    """Put a link to a copy where a file was."""

    def change(folder: Path) -> None:
        (folder / name).rename(folder / "copy")
        (folder / name).symlink_to(folder / "copy")

    return change


CHANGES = {
    "scenario": append_comment("derived/scenario.toml"),
    "scenario it extends": append_comment("base/scenario.toml"),
    "sites": append_comment("base/sites.csv"),
    "solids": append_comment("base/statics.geojson"),
    "mesh": append_comment("base/wall.obj"),
    "traffic": append_comment("base/fcd.csv"),
    "file that hides one of the base": write("derived/statics.geojson", collection()),
    "file that a mesh names": write("base/paint.mtl", "newmtl a\n"),
    "input becomes a link": link_to_copy("base/sites.csv"),
    "artefact": edit("runs/derived/tpog.parquet"),
    "report": edit("runs/derived/report.html"),
    "artefact is missing": lambda folder: (folder / "runs/derived/scans.parquet").unlink(),
    "folder of another": lambda folder: (folder / "runs/derived/export").mkdir(),
    "link in the run folder": lambda folder: (folder / "runs/derived/more").symlink_to(folder),
    "result of a study": write("runs/derived/accuracy.sha256", ""),
    "module of the program": edit("program/module.py"),
    "another module": write_long_ago("program/other.py"),
    "schema of artefacts": edit("schemas/scores.schema.json"),
    "library": lambda folder: (folder / "libraries" / "plugin-1.0.dist-info").mkdir(),
    "environment": lambda _: os.environ.update(EGVS_MAX_SITES="1000"),
}


@pytest.fixture
def program(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a run depend on a small program, its schemas and libraries in the working directory."""
    monkeypatch.setenv("EGVS_MAX_SITES", "2000")
    for name in ("program/module.py", "schemas/scores.schema.json", "libraries/numpy-1.0.dist-info/METADATA"):
        path = folder / name
        path.parent.mkdir(parents=True)
        path.write_text("text\n")
        os.utime(path, (1e9, 1e9))
    monkeypatch.setattr(unchanged, "_PACKAGE", folder / "program")
    monkeypatch.setattr(unchanged, "data_folder", lambda _: folder / "schemas")
    monkeypatch.syspath_prepend(folder / "libraries")


@pytest.mark.usefixtures("program")
@pytest.mark.parametrize("what", CHANGES)
def test_change_is_noticed(folder: Path, runs: list[Path], run_egvs: Callable, what: str) -> None:
    run_egvs(*RUN_DERIVED)
    run_egvs(*RUN_DERIVED)
    assert len(runs) == 1
    CHANGES[what](folder)
    state = unchanged.RunMemory(["run"], None)._state
    run_egvs(*RUN_DERIVED)
    assert len(runs) == 2
    assert state is not None  # a changed program is another program, not an unknown one


def test_same_bytes_written_again_are_no_change(folder: Path, runs: list[Path], run_egvs: Callable) -> None:
    run_egvs(*RUN_DERIVED)
    for name in ("base/sites.csv", "derived/scenario.toml", "runs/derived/scores.parquet"):
        content = (folder / name).read_bytes()
        (folder / name).unlink()
        (folder / name).write_bytes(content)
    run_egvs(*RUN_DERIVED)
    assert len(runs) == 1


def test_run_in_a_locked_folder_is_not_recalled(folder: Path, run_egvs: Callable) -> None:
    run_egvs(*RUN_MINI)
    with unchanged.locks.locked(folder / "out" / ".lock"):
        code, out, err = run_egvs(*RUN_MINI)
    assert code == 1 and "another run is using this folder" in err and not out


@pytest.mark.parametrize("content", ["", "{}", "[1]", '{"state": "a", "own_sha256": "0"}'])
def test_damaged_record_is_ignored(folder: Path, runs: list[Path], run_egvs: Callable, content: str) -> None:
    run_egvs(*RUN_MINI)
    next((folder / "out").glob(UNCHANGED_PATTERN)).write_text(content)
    code, _, _ = run_egvs(*RUN_MINI)
    assert code == 0 and len(runs) == 2


def test_forged_output_is_ignored(folder: Path, runs: list[Path], run_egvs: Callable) -> None:
    run_egvs(*RUN_MINI)
    path = next((folder / "out").glob(UNCHANGED_PATTERN))
    path.write_text(path.read_text().replace("pole_b is the best", "pole_a is the best"))
    assert "pole_b is the best" in run_egvs(*RUN_MINI)[1]
    assert len(runs) == 2


def test_failed_run_is_not_recalled(folder: Path, runs: list[Path], run_egvs: Callable) -> None:
    (folder / "mini" / "sites.csv").write_text("site,x_m,y_m\n")
    results = [run_egvs(*RUN_MINI) for _ in range(2)]
    assert results[0] == results[1] and results[0][0] == 2
    assert len(runs) == 2


def test_program_edited_just_now_is_not_trusted(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unchanged, "_PACKAGE", folder / "base")
    monkeypatch.setattr(digest_cache, "_local_devices", lambda: frozenset({folder.stat().st_dev}))
    assert unchanged._hash_program() is None
    for path in (folder / "base").iterdir():
        os.utime(path, (1e9, 1e9))
    assert unchanged._hash_program() is not None


def test_program_on_unknown_file_system_is_compared_by_content(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unchanged, "_PACKAGE", folder / "base")
    monkeypatch.setattr(digest_cache, "_local_devices", frozenset)
    before = unchanged._hash_program()
    assert before is not None
    edit("base/sites.csv")(folder)
    assert unchanged._hash_program() not in (None, before)


def save_observed(folder: Path, work: Callable[[], object]) -> list[Path]:
    """The records in a folder after work that was observed."""
    memory = unchanged.RunMemory(["run"], folder)
    with memory.observe():
        work()
    memory.save(folder, {}, unchanged.Output("", ""))
    return list(folder.glob(UNCHANGED_PATTERN))


def test_run_that_depends_on_more_than_files_is_not_recalled(folder: Path) -> None:
    assert not save_observed(folder / "mini", lambda: files.tell_observers(None))
    os.mkfifo(folder / "pipe")
    assert not save_observed(folder / "mini", lambda: files.observe_content(folder / "pipe"))
    assert save_observed(folder / "mini", lambda: files.hash_file(folder / "base" / "sites.csv"))


def test_plug_ins_are_not_recalled(folder: Path) -> None:
    scenario = egvs.load(folder / "mini")
    assert not save_observed(folder / "mini", lambda: stage_keys.program_inputs("score", scenario, ("trimesh",)))
    assert save_observed(folder / "mini", lambda: stage_keys.program_inputs("score", scenario))


def test_input_that_changed_during_the_run_is_not_recalled(folder: Path) -> None:
    path = folder / "base" / "sites.csv"

    def read_twice() -> None:
        files.hash_file(path)
        path.write_text("changed")
        files.hash_file(path)

    assert not save_observed(folder / "mini", read_twice)


def test_temporary_files_are_left_out(folder: Path) -> None:
    def convert() -> None:
        with files.temporary_folder() as folder:
            (folder / "network").write_text("<net/>")
            files.hash_file(folder / "network")

    (record,) = save_observed(folder / "mini", convert)
    assert not any(name.endswith("network") for name in json.loads(record.read_text())["files"])


LIST_OPENED_FILES = """
import json, os, sys
opened = set()
def note(event, arguments):
    if event == "open" and isinstance(arguments[0], (str, bytes)):
        opened.add(os.path.realpath(os.fsdecode(arguments[0])))
from egvs.cli.app import main
sys.addaudithook(note)
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
print()
print(json.dumps(sorted(opened)))
"""

ROUNDABOUT = Path(__file__).parents[2] / "scenarios" / "roundabout"
SHORT = ('traffic.hold="at_most"', "traffic.frames=40", "traffic.warmup_s=5", "tpog.blocks=4", "roi.voxel_m=1")
RUN_ROUNDABOUT = ("run", str(ROUNDABOUT), *(part for setting in SHORT for part in ("--set", setting)))


@pytest.mark.parametrize("arguments", [RUN_DERIVED, RUN_ROUNDABOUT], ids=["derived", "roundabout"])
def test_record_has_every_file_that_a_run_without_changes_opens(folder: Path, arguments: tuple[str, ...]) -> None:
    command = [sys.executable, "-c", LIST_OPENED_FILES, *arguments, "--out", "out"]
    subprocess.run(command, check=True, capture_output=True)
    record_path = next((folder / "out").glob(UNCHANGED_PATTERN))
    record_path.unlink()
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert "no stage ran" in done.stderr

    opened = {Path(name) for name in json.loads(done.stdout.splitlines()[-1])}
    known = {Path(os.path.realpath(name)) for name in json.loads(record_path.read_text())["files"]}
    program = Path(egvs.__file__).resolve().parent
    schemas = program.parents[1] / "data_schemas"
    elsewhere = [Path(sys.prefix), Path(sys.base_prefix), program, schemas, Path("/proc"), Path("/dev"), Path("/sys")]
    inputs = {name for name in opened if not any(name.is_relative_to(folder) for folder in elsewhere)}
    probes_of_tempfile = {name for name in inputs if name.parent == Path(tempfile.gettempdir())}
    of_the_run = {
        name for name in inputs if name.name.startswith((".lock", ".digests", "..digests", ".unchanged", "..unchanged"))
    }
    assert any(name.name == "scenario.toml" for name in inputs)
    assert inputs - probes_of_tempfile - of_the_run <= known


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
def test_run_folder_with_a_pipe_is_not_recorded(folder: Path) -> None:
    os.mkfifo(folder / "mini" / "pipe")
    assert not save_observed(folder / "mini", lambda: None)


def test_broken_link_in_the_program_is_no_error(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / BASE / ".#module.py").symlink_to("nowhere")
    monkeypatch.setattr(unchanged, "_PACKAGE", folder / BASE)
    assert unchanged.RunMemory(["run"], folder / "mini").recall() is None


def test_run_is_recorded_unless_another_one_followed_in_its_folder(folder: Path, run_egvs: Callable) -> None:
    """The other run may have the same artefacts, but another scenario."""
    assert run_egvs(*RUN_MINI)[0] == 0
    record = RunRecord.read(folder / "out")
    assert repeat._is_recorded(repeat.FinishedRun(folder / "out", record, ""))
    other = replace(record, overrides={"description": "other"})
    assert not repeat._is_recorded(repeat.FinishedRun(folder / "out", other, ""))
