"""The store: whole whatever happens to it, shared by all runs, bounded, and never believed where it is damaged.

Evidence: real runs in processes of their own, started together or killed at steps of their work; entries that are cut,
changed and removed; the program with one line changed. Nothing waits for a clock.
"""

from __future__ import annotations

import errno
import json
import math
import os
import random
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.run_folder import STAGE_NAMES
from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.resource_usage import ResourceUsage
from egvs.runs import run, stage_keys, stage_registry, verification
from egvs.runs.stage_registry import StageResult
from egvs.runs.store import Store, StoreEntry
from tests.runs import children
from tests.runs.children import Child, Job

ROOT = Path(__file__).resolve().parents[2]
DATA = ("statics.ply", "scans.parquet", "trajectories.parquet", "tpog.parquet", "scores.parquet")


def states(scenario: egvs.Scenario, out: Path, **options: object) -> dict[str, str]:
    """Run, and say of each stage whether it was skipped, fetched or made."""
    seen: dict[str, str] = {}
    run.run(scenario, out, listener=lambda stage, state, _: seen.__setitem__(stage, state), **options)  # type: ignore[arg-type]
    return seen


def digests(out: Path) -> dict[str, str]:
    return {name: files.hash_file(out / name) for name in DATA}


def assert_whole(store: Path) -> list[StoreEntry]:
    """Every entry is there whole, and nothing else is."""
    kept = Store(store, note=pytest.fail)
    entries = kept.entries()
    assert {entry.folder for entry in entries} == {path for path in store.iterdir() if path.name[0] != "."}
    for entry in entries:
        for name, digest in entry.made.files.items():
            assert files.hash_file(entry.folder / name) == digest
    for place in (".work", ".locks"):
        assert not (store / place).is_dir() or not list((store / place).iterdir())
    return entries


@pytest.fixture
def done(mini: Path, tmp_path: Path) -> tuple[egvs.Scenario, Path]:
    """A scenario, and the folder of its finished run."""
    scenario = egvs.load(mini)
    assert set(states(scenario, tmp_path / "out").values()) == {"done"}
    return scenario, tmp_path / "out"


@pytest.fixture(scope="module")
def junction(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped junction, cut down to a second's work: SUMO runs in it."""
    folder = tmp_path_factory.mktemp("junction") / "junction"
    shutil.copytree(ROOT / "scenarios" / "nishishinjuku", folder)
    text = (folder / "scenario.toml").read_text()
    for long, short in (
        ("frames = 5000", "frames = 20"),
        ("warmup_s = 300", "warmup_s = 20"),
        ("vehicles = 50", "vehicles = 5"),
        ("voxel_m = 0.25", "voxel_m = 1.0"),
        ('"statics.geojson"', ""),
    ):
        assert long in text
        text = text.replace(long, short)
    (folder / "scenario.toml").write_text(text)
    (folder / "sites.csv").write_text("".join((folder / "sites.csv").read_text().splitlines(keepends=True)[:3]))
    return folder


@pytest.mark.slow
def test_a_second_folder_makes_nothing(
    junction: Path, tmp_path: Path, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is simulated, cast or counted, and the folder holds the same plain files, SUMO's among them."""
    scenario = egvs.load(junction)
    one, other = tmp_path / "one", tmp_path / "other"
    assert set(states(scenario, one).values()) == {"done"}

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a stage was made")

    with monkeypatch.context() as patched:
        patched.setattr(stage_registry, "run_stage", refuse)
        assert set(states(scenario, other).values()) == {"fetched"}
        assert set(states(scenario, other).values()) == {"skipped"}
    names = {p.relative_to(one).as_posix() for p in one.rglob("*") if p.is_file()}
    assert {"sumo/run.sumocfg", *DATA, "report.html"} < names
    for name in names - {"run.json", ".lock", ".digests.json"}:
        assert (other / name).read_bytes() == (one / name).read_bytes()
    assert (
        json.loads((other / "run.json").read_text())["stages"] == json.loads((one / "run.json").read_text())["stages"]
    )
    assert verification.verify(other) == []
    (other / "tpog.parquet").write_bytes(b"of the user's own")  # which harms the store not
    assert_whole(store)


@pytest.mark.slow
def test_files_read_by_sumo_and_the_report_are_checked_against_their_digests(
    junction: Path, tmp_path: Path, run_egvs
) -> None:
    out, scenario = tmp_path / "out", egvs.load(junction)
    states(scenario, out)
    network, routes = out / "sumo" / "network.net.xml", out / "sumo" / "trips.rou.xml"
    whole = network.read_bytes()
    kept = json.loads((out / "run.json").read_text())["stages"]["traffic"]["companions"]
    assert kept["sumo/network.net.xml"] == files.hash_file(network)
    network.write_bytes(whole.replace(b"speed", b"sqeed", 1))
    routes.write_text("<routes/>")
    (out / "sumo" / "vtypes.add.xml").unlink()
    code, _, error = run_egvs("report", junction, "--out", out)
    assert (code, error.split(" (")[0]) == (2, f"egvs: {network}: was altered or replaced")
    assert sorted(verification.verify(out))[:2] == [
        f"sumo/{path.name} was altered after the run" for path in (network, routes)
    ]
    again = {name: "skipped" for name in STAGE_NAMES} | {"traffic": "fetched"}
    assert states(scenario, out) == again
    assert network.read_bytes() == whole
    assert verification.verify(out) == []


@pytest.mark.slow
def test_a_changed_and_a_former_setting(done: tuple[egvs.Scenario, Path]) -> None:
    """What a folder held before it was run with other settings comes back from the store."""
    scenario, out = done
    before = digests(out)
    changed = egvs.load(scenario.folder, ["score.gamma=9"])
    again = {"score": "done", "report": "done"}
    assert states(changed, out) == {**dict.fromkeys(STAGE_NAMES, "skipped"), **again}
    assert states(scenario, out) == {**dict.fromkeys(STAGE_NAMES, "skipped"), **dict.fromkeys(again, "fetched")}
    assert digests(out) == before


@pytest.mark.slow
def test_a_file_that_the_stored_stage_does_not_have_is_removed(mini: Path, tmp_path: Path) -> None:
    """Hits of sites are kept by one setting, and not by the other."""
    plain, seen = egvs.load(mini), egvs.load(mini, ['score.keep_visibility="all"'])
    egvs.run(plain, tmp_path / "plain")
    egvs.run(seen, tmp_path / "out")
    assert (tmp_path / "out" / "visibility.parquet").exists()
    assert states(plain, tmp_path / "out")["score"] == "fetched"
    assert not (tmp_path / "out" / "visibility.parquet").exists()


@pytest.mark.slow
def test_a_stage_with_options_runs_and_is_not_stored(done: tuple[egvs.Scenario, Path], tmp_path: Path, store) -> None:
    scenario, _ = done
    options = {"score": {"audit": True}}
    assert states(scenario, tmp_path / "other", options=options)["score"] == "done"
    before = assert_whole(store)
    states(egvs.load(scenario.folder, ["score.gamma=9"]), tmp_path / "third", options=options)
    assert {e.stage for e in assert_whole(store) if e.folder not in {b.folder for b in before}} == {"report"}


@pytest.mark.slow
def test_a_stage_called_by_itself_runs_and_is_stored(done: tuple[egvs.Scenario, Path], tmp_path: Path) -> None:
    scenario, out = done
    seen: list[str] = []
    run.run_one("statics", scenario, out, listener=lambda _, state, __: seen.append(state))
    assert seen == ["runs", "done"]
    other = egvs.load(scenario.folder, ["statics.ground=false"])
    run.run_one("statics", other, out)
    assert states(other, tmp_path / "other")["statics"] == "fetched"


def a_changed_byte(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def edited(how: Callable[[dict], object], rehash: bool = False) -> Callable[[Path], object]:
    """A note of which a value was changed by hand."""

    def edit(path: Path) -> None:
        how(value := json.loads(path.read_text(encoding="utf-8")))
        if rehash:
            del value["sha256"]
            value["sha256"] = files.hash_json(value)
        path.write_text(json.dumps(value), encoding="utf-8")

    return edit


DAMAGE = {
    "a changed byte": ("tpog-*/tpog.parquet", a_changed_byte),
    "an artefact cut short": ("tpog-*/tpog.parquet", cut),
    "a missing artefact": ("tpog-*/tpog.parquet", Path.unlink),
    "no note": ("tpog-*/entry.json", Path.unlink),
    "an empty note": ("tpog-*/entry.json", lambda path: path.write_text("")),
    "a note of something else": ("tpog-*/entry.json", lambda path: path.write_text("[]")),
    "a note with holes": ("tpog-*/entry.json", lambda path: path.write_text('{"stage": "tpog", "artefacts": {}}')),
    "a note without its hash": ("tpog-*/entry.json", edited(lambda note: note.pop("sha256"))),
    "another summary": ("tpog-*/entry.json", edited(lambda note: note["summary"].popitem())),
    "no artefacts": ("tpog-*/entry.json", edited(lambda note: note.update(artefacts={}))),
    "a key that is a number": ("tpog-*/entry.json", edited(lambda note: note.update(key=5), rehash=True)),
    "a time beyond all times": ("tpog-*/entry.json", edited(lambda note: note.update(created=10**400), rehash=True)),
    "a lone surrogate": ("tpog-*/entry.json", edited(lambda note: note["summary"].update(best="\ud800"))),
    "costs of something else": ("tpog-*/entry.json", edited(lambda note: note.update(cost=[]), rehash=True)),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", DAMAGE)
def test_a_damaged_entry_is_named_and_made_again(
    done: tuple[egvs.Scenario, Path], tmp_path: Path, store: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    scenario, out = done
    pattern, damage = DAMAGE[case]
    (path,) = store.glob(pattern)
    damage(path)
    expected = {**dict.fromkeys(STAGE_NAMES, "fetched"), "tpog": "done"}
    found = states(scenario, tmp_path / "other")
    del found["report"], expected["report"]  # which shows what the tpog cost
    assert found == expected
    said = capsys.readouterr().err
    assert "the cached tpog is damaged" in said and "Traceback" not in said
    assert digests(tmp_path / "other") == digests(out)
    assert_whole(store)
    assert states(scenario, tmp_path / "third")["tpog"] == "fetched"


@pytest.mark.slow
@pytest.mark.parametrize("case", DAMAGE)
def test_a_damaged_entry_is_cleared(done: tuple[egvs.Scenario, Path], store: Path, run_egvs, case: str) -> None:
    pattern, damage = DAMAGE[case]
    (path,) = store.glob(pattern)
    damage(path)
    assert run_egvs("store")[0] == 0
    assert run_egvs("store", "--clear")[0] == 0
    assert not list(store.glob("*-*"))


def test_a_full_disk_is_the_destinations(
    done: tuple[egvs.Scenario, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_egvs
) -> None:
    """A copy that cannot be written is not blamed on the store's file, which was only read."""

    def full(path: Path, other: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path), None, str(other))

    monkeypatch.setattr(shutil, "copyfile", full)
    code, _, said = run_egvs("run", done[0].folder, "--out", other := tmp_path / "other")
    told = f"egvs: {other / 'statics.ply'}: No space left on device ("
    assert (code, said.splitlines()[-1].startswith(told)) == (1, True)
    assert said.endswith(f" MB are free in {tmp_path})\n")  # the empty folder of the run is gone


@pytest.mark.slow
def test_several_at_once_make_every_stage_once(mini: Path, tmp_path: Path, store: Path) -> None:
    running = [Child(Job(mini, tmp_path / str(number), store)) for number in range(4)]
    jobs = [child.join() for child in running]
    assert [job.exit_code for job in jobs] == [0] * 4
    for stage in STAGE_NAMES:
        assert sorted(job.states[stage] for job in jobs) == ["done"] + ["fetched"] * 3, stage
    assert len({tuple(digests(job.out).values()) for job in jobs}) == 1
    assert len(assert_whole(store)) == len(STAGE_NAMES)


@pytest.mark.slow
def test_the_second_run_waits_and_fetches_the_entry(
    done: tuple[egvs.Scenario, Path], tmp_path: Path, store: Path
) -> None:
    scenario, out = done
    kept = Store(store)
    entry = next(entry for entry in kept.entries() if entry.stage == "statics")
    kept.prune(-1)
    with kept.maker("statics", entry.key):
        child = Child(Job(scenario.folder, tmp_path / "other", store))
        assert child.waits.wait(timeout=120)
        kept.put("statics", entry.key, out, entry.made)
    job = child.join()
    assert (job.exit_code, job.states["statics"], job.states["scan"]) == (0, "fetched", "done")
    assert_whole(store)


@pytest.mark.slow
@pytest.mark.parametrize("kills", [5, pytest.param(20, marks=pytest.mark.nightly)])
def test_killed_at_some_steps_the_store_is_whole_and_the_next_run_ends_in_the_same_bytes(
    junction: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kills: int
) -> None:
    whole = children.run(Job(junction, tmp_path / "whole", tmp_path / "store"))
    assert (whole.exit_code, set(whole.states.values())) == (0, {"done"})
    assert whole.steps > 50
    steps = random.Random(20).sample(range(1, whole.steps), kills)
    for step in steps:
        out, store = tmp_path / str(step), tmp_path / f"store{step}"
        assert children.run(Job(junction, out, store, kill_at=step)).exit_code == -signal.SIGKILL
        for path in out.glob("*.p*"):  # whatever is there under its own name is whole
            if path.suffix in (".parquet", ".ply"):
                assert files.hash_file(path) == files.hash_file(whole.out / path.name)
        if store.exists():
            assert_whole(store)
        monkeypatch.setenv("EGVS_STORE", str(store))
        egvs.run(egvs.load(junction), out)
        assert digests(out) == digests(whole.out)
        assert not list(out.glob(".*.partial"))
        assert len(assert_whole(store)) >= len(STAGE_NAMES)


@pytest.mark.slow
def test_the_least_recently_used_entry_is_removed_first(
    done: tuple[egvs.Scenario, Path], store: Path, tmp_path: Path
) -> None:
    kept = Store(store)
    for age, entry in enumerate(sorted(kept.entries(), key=lambda e: e.stage)):
        os.utime(entry.folder / "entry.json", (1e9 - age, 1e9 - age))
    kept.take("traffic", next(e.key for e in kept.entries() if e.stage == "traffic"), tmp_path / "taken")
    order = [entry.stage for entry in kept.entries()]
    assert order == ["traffic", *sorted(set(STAGE_NAMES) - {"traffic"})]
    sizes = {entry.stage: entry.bytes for entry in kept.entries()}
    removed = kept.prune(sum(sizes[stage] for stage in ("traffic", "check", "report", "scan")))
    assert [entry.stage for entry in removed] == ["tpog", "statics", "score"]
    assert [entry.stage for entry in assert_whole(store)] == ["traffic", "check", "report", "scan"]
    assert len(kept.prune(-1)) == 4
    assert not assert_whole(store)


def test_the_bound_holds_from_the_first_entry_on(
    mini: Path, tmp_path: Path, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EGVS_STORE_MAX_GB", "0.00015")
    scenario = egvs.load(mini)
    assert set(states(scenario, tmp_path / "out").values()) == {"done"}
    entries = assert_whole(store)
    assert 0 < sum(entry.bytes for entry in entries) <= 1.5e5 and len(entries) < len(STAGE_NAMES)
    monkeypatch.setenv("EGVS_STORE_MAX_GB", "lots")
    with pytest.raises(InputError, match="EGVS_STORE_MAX_GB: expected a number of GB, got 'lots'"):
        egvs.run(scenario, tmp_path / "other")
    assert not (tmp_path / "other").exists()


@pytest.mark.slow
@pytest.mark.parametrize("place", ["file", "file/store", "l" * 300, "/".join(["long"] * 2000)])
def test_a_store_that_cannot_be_written_is_named_once(
    mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_egvs, place: str
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("EGVS_STORE", str(tmp_path / place))
    code, _, said = run_egvs("run", mini, "--out", tmp_path / "out")
    assert (code, said.count("the store cannot be written"), said.count("from store")) == (0, 1, 0)
    assert run_egvs("statics", mini, "--out", tmp_path / "out")[0] == 0
    assert run_egvs("store")[0] == (2 if place == "file" else 0)


@pytest.mark.slow
def test_invalid_store_settings_are_named(
    tmp_path: Path, store: Path, monkeypatch: pytest.MonkeyPatch, run_egvs
) -> None:
    for words in (("--clear", "--prune"), ("--clear", "--prune", "--max", "2G")):
        code, _, said = run_egvs("store", *words)
        assert (code, "--clear: cannot be combined with --prune" in said) == (2, True), said
    assert run_egvs("store", "--clear", "--max", "2G")[0] == 2
    (tmp_path / "file").write_text("")
    for place, words, message in (
        (tmp_path / "file", (), f"{tmp_path / 'file'}: is a file"),
        (tmp_path / "file", ("--clear",), "is a file"),
        ("", ("--clear",), "EGVS_STORE: is empty, so there is no store"),
        ("", ("--prune",), "there is no store"),
    ):
        monkeypatch.setenv("EGVS_STORE", str(place))
        code, printed, said = run_egvs("store", *words)
        assert (code, printed, message in said) == (2, "", True), said


@pytest.mark.slow
def test_an_empty_name_is_no_store(
    done: tuple[egvs.Scenario, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_egvs
) -> None:
    scenario, _ = done
    monkeypatch.setenv("EGVS_STORE", "")
    assert set(states(scenario, tmp_path / "other").values()) == {"done"}
    assert run_egvs("store")[1].strip() == "EGVS_STORE is empty: results are not cached"


def test_the_default_store_is_the_users_and_serves_all_working_folders(
    mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("EGVS_STORE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for folder, state in (("one", "done"), ("other", "fetched")):
        (tmp_path / folder).mkdir()
        monkeypatch.chdir(tmp_path / folder)
        assert set(states(egvs.load(mini), Path("runs/mini")).values()) == {state}
        assert [path.name for path in Path("runs").iterdir()] == ["mini"]
    assert len(assert_whole(tmp_path / "cache" / "egvs" / "store")) == len(STAGE_NAMES)


@pytest.mark.slow
def test_the_command_line_lists_prunes_and_clears(done: tuple[egvs.Scenario, Path], store: Path, run_egvs) -> None:
    code, printed, _ = run_egvs("store")
    assert code == 0
    assert {line.split()[0] for line in printed.splitlines()} == {"stage", *STAGE_NAMES, f"{store}:"}
    assert "7 entries" in printed and "of at most 10 GB" in printed
    assert "removed 0 entries" in run_egvs("store", "--prune")[1]
    largest = max(entry.bytes for entry in Store(store).entries())
    assert run_egvs("store", "--prune", "--max", f"{largest / 1e3}K")[0] == 0
    assert 0 < len(assert_whole(store)) < 6
    assert "0 entries, 0 B remain" in run_egvs("store", "--clear")[1]
    cases = ((("--max", "2G"), "without --prune"), (("--prune", "--max", "much"), "expected a size, got 'much'"))
    for words, message in cases:
        code, _, said = run_egvs("store", *words)
        assert (code, message in said) == (2, True), said


def test_foreign_files_in_the_store_are_not_touched(
    mini: Path, tmp_path: Path, store: Path, run_egvs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder that somebody else uses, and names as the store where its own lie is not lost."""
    (removed := store / ".work" / f"removed-scan-{'0' * 32}-1-2").mkdir(parents=True)
    (store / ".locks").mkdir()
    (damaged := store / f"scan-{'0' * 32}").mkdir()
    others = ("photos/a", f"photos-{'0' * 32}/a", "scan-2024/a", ".work/mine/a", ".locks/mine", ".hidden/a")
    for name in others:
        (store / name).parent.mkdir(exist_ok=True)
        (store / name).write_text("of somebody else")
    monkeypatch.setenv("EGVS_STORE_MAX_GB", "0.00015")
    egvs.run(egvs.load(mini), tmp_path / "out")
    assert not removed.exists() and not damaged.exists()
    for words in (("--prune", "--max", "1K"), ("--clear",)):
        damaged.mkdir()
        assert run_egvs("store", *words)[0] == 0
        assert Store(store).entries() == []
    assert not damaged.exists()
    assert {name: (store / name).read_text() for name in others} == dict.fromkeys(others, "of somebody else")


@pytest.mark.parametrize("name", ["store", "store/mine", "elsewhere/../store", "link", "link/mine"])
@pytest.mark.parametrize("verb", ["run", "statics", "accuracy"])
def test_a_run_does_not_go_into_the_store(
    mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_egvs, verb: str, name: str
) -> None:
    """It would wait for ever on its own lock."""
    monkeypatch.delenv("EGVS_STORE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (store := tmp_path / "egvs" / "store").mkdir(parents=True)
    (tmp_path / "egvs" / "link").symlink_to(store)
    code, _, said = run_egvs(verb, mini, "--out", tmp_path / "egvs" / name)
    assert (code, said.count(f"the store ({store}) or inside it")) == (2, 1), said
    assert not list(store.iterdir())


@pytest.mark.slow
def test_a_run_prints_which_stages_it_fetched(done: tuple[egvs.Scenario, Path], tmp_path: Path, run_egvs) -> None:
    scenario, _ = done
    code, printed, said = run_egvs("run", scenario.folder, "--out", tmp_path / "other")
    assert (code, said.count("from store")) == (0, len(STAGE_NAMES)), said
    assert "nothing to do" not in printed


CHANGED_LINES = {
    "kernels/traversal.py": {"score", "report"},
    "kernels/ray_triangle.py": {"check", "scan", "score", "report"},
    "kernels/occupancy.py": {"check", "scan", "tpog", "score", "report"},
    "sensors/sensor.py": {"check", "scan", "score"},
    "stages/traffic.py": {"traffic"},
    "world/mesh.py": {"check", "statics", "scan", "tpog", "score", "report"},
    "effects/rain.py": {"check", "score", "report"},
    "effects/fog.py": set(),
    "formats/csv_points.py": {"scan"},
    "formats/pcd.py": set(),
    "studies/accuracy.py": set(),
    "data_schemas/tpog.schema.json": {"tpog"},
}


@pytest.mark.slow
def test_one_changed_line_repeats_the_stages_that_depend_on_it(
    mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And nothing else: a stage whose source is another one, and that writes what it wrote before, changes no later
    one, but for the report, which shows what stages cost. The program's text is that of a copy, so that nothing is
    compiled anew.
    """
    copy = tmp_path / "egvs"
    shutil.copytree(ROOT / "pipeline" / "egvs", copy, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "data_schemas", copy / "data_schemas")
    monkeypatch.setattr(stage_keys, "_ROOT", copy)
    monkeypatch.setattr(parquet, "schema_folder", lambda: copy / "data_schemas")

    def forget() -> None:
        for remembered in (stage_keys.source_digest, stage_keys._digest_module, stage_keys._module_path):
            remembered.cache_clear()

    def made() -> set[str]:
        forget()
        found = states(scenario, tmp_path / "out")
        assert set(found.values()) <= {"done", "skipped"}
        return {stage for stage, state in found.items() if state == "done"}

    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,points\npole_a,10,12,3,\npole_b,30.5,-12,3,measured.csv\n")
    (mini / "measured.csv").write_text("x_m,y_m,z_m\n30.5,0,0\n")
    scenario = egvs.load(mini, ["effects.rain.rate_mm_h=20"])
    assert made() == set(STAGE_NAMES)
    assert made() == set()
    for name, again in CHANGED_LINES.items():
        path = copy / name
        path.write_text(path.read_text(encoding="utf-8") + "\n", encoding="utf-8")
        assert made() - {"report"} == again - {"report"}, name
    forget()


@pytest.mark.parametrize("name", [".lock", ".locks", ".work", ".locks/statics-" + "0" * 32])
def test_locks_and_folders_for_work_are_no_links(mini: Path, tmp_path: Path, store: Path, run_egvs, name: str) -> None:
    (tmp_path / "mine").write_text("kept")
    (store / name).parent.mkdir(parents=True, exist_ok=True)
    (store / name).symlink_to(tmp_path / "mine")
    code, _, error = run_egvs("run", mini, "--out", tmp_path / "out")
    what = "is a symbolic link, and nothing is written through links. Remove it."
    assert (code, error.splitlines()[-1]) == (2, f"egvs: {store / name}: {what}")
    assert (tmp_path / "mine").read_text() == "kept"


def test_the_record_of_an_entry_is_json(tmp_path: Path, store: Path) -> None:
    kept, out = Store(store), tmp_path / "out"
    out.mkdir()
    (out / "a").write_text("a")
    made = StageResult({"a": files.hash_file(out / "a")}, {}, {"longest": math.inf}, ResourceUsage())
    kept.put("tpog", "0" * 64, out, made)
    (entry,) = kept.entries()
    assert "Infinity" not in (entry.folder / "entry.json").read_text()
    assert entry.made.summary == {"longest": "inf"}
