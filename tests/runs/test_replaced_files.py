"""Files that another program replaces while a run works change no result: the run ends with an error."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

import egvs
from egvs.artefacts import checksums
from egvs.core import files
from egvs.core.errors import InputError
from egvs.placement import plan
from egvs.runs.stage_registry import STAGE_MODULES
from egvs.traffic.sumo_folder import NETWORK_FILE
from tests.conftest import write_mini

CHANGED = "was changed while it was in use"


@dataclass(frozen=True)
class TwoRuns:
    """A scenario; complete runs of it and of one with other traffic, buildings and heights, made without a store."""

    folder: Path
    expected: Path
    other: Path

    def scores(self, out: Path) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = pq.read_table(out / "scores.parquet").to_pylist()
        return rows


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> TwoRuns:
    folder = tmp_path_factory.mktemp("replaced")
    mini, changed = write_mini(folder / "mini"), write_mini(folder / "changed")
    (changed / "fcd.csv").write_text((mini / "fcd.csv").read_text().replace(";-2.0;", ";-6.0;"))
    (changed / "sites.csv").write_text((mini / "sites.csv").read_text().replace(",3\n", ",2\n"))
    (changed / "statics.geojson").write_text((mini / "statics.geojson").read_text().replace("[14, 5]", "[12, 5]"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EGVS_STORE", "")
        for scenario, out in ((mini, "expected"), (changed, "other")):
            egvs.run(egvs.load(scenario), folder / out)
    return TwoRuns(mini, folder / "expected", folder / "other")


def put_in_place(source: Path, target: Path) -> None:
    """Replace a file as programs that synchronise folders do, with the times of the original."""
    copy = target.with_name("copy")
    shutil.copyfile(source, copy)
    status = target.stat()
    os.utime(copy, ns=(status.st_atime_ns, status.st_mtime_ns))
    copy.replace(target)


def write_over(source: Path, target: Path) -> None:
    """Write other content into the same file, and set its times back."""
    status = target.stat()
    target.write_bytes(source.read_bytes())
    os.utime(target, ns=(status.st_atime_ns, status.st_mtime_ns))


REPLACEMENTS = {"replaced": put_in_place, "written over": write_over}
READERS = [
    ("tpog", "trajectories.parquet"),
    ("score", "tpog.parquet"),
    ("score", "scans.parquet"),
    ("score", "trajectories.parquet"),
]


@pytest.mark.slow
@pytest.mark.parametrize("how", REPLACEMENTS)
@pytest.mark.parametrize(("stage", "artefact"), READERS)
def test_artefact_replaced_before_its_reader(
    runs: TwoRuns, tmp_path: Path, stage: str, artefact: str, how: str
) -> None:
    scenario = egvs.load(runs.folder, ['score.others=["seen_well"]'] if artefact == "trajectories.parquet" else [])

    def listen(running: str, state: str, _: object) -> None:
        if (running, state) == (stage, "runs"):
            REPLACEMENTS[how](runs.other / artefact, tmp_path / "out" / artefact)

    with pytest.raises(InputError, match=f"{artefact}: {CHANGED}"):
        egvs.run(scenario, tmp_path / "out", listener=listen)
    assert not (tmp_path / "out" / "scores.parquet").exists()
    egvs.run(egvs.load(runs.folder), tmp_path / "clean")  # with the same store
    assert runs.scores(tmp_path / "clean") == runs.scores(runs.expected)


@pytest.mark.slow
def test_static_world_of_an_earlier_run_replaced_before_it_is_read(runs: TwoRuns, tmp_path: Path) -> None:
    egvs.run(egvs.load(runs.folder), tmp_path / "out")
    finer = egvs.load(runs.folder, ["sensors.small.azimuth_step_deg=2"])

    def listen(running: str, state: str, _: object) -> None:
        if (running, state) == ("statics", "skipped"):
            put_in_place(runs.other / "statics.ply", tmp_path / "out" / "statics.ply")

    with pytest.raises(InputError, match=CHANGED):
        egvs.run(finer, tmp_path / "out", listener=listen)


def at_end_of(stage: str, monkeypatch: pytest.MonkeyPatch, act: Callable[[Path], None]) -> None:
    """Call a function with the run folder when a stage has just written its artefacts."""
    module = import_module(STAGE_MODULES[stage])
    original = module.STAGE.run

    def run(context: Any, *arguments: Any, **options: Any) -> Any:
        summary = original(context, *arguments, **options)
        act(context.folder.path)
        return summary

    monkeypatch.setattr(module, "STAGE", replace(module.STAGE, run=run))


@pytest.mark.parametrize(
    ("stage", "artefact"), [("traffic", "trajectories.parquet"), ("scan", "scans.parquet"), ("tpog", "tpog.parquet")]
)
def test_artefact_replaced_as_soon_as_it_is_written(
    runs: TwoRuns, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: str, artefact: str
) -> None:
    with monkeypatch.context() as patch:
        at_end_of(stage, patch, lambda folder: put_in_place(runs.other / artefact, folder / artefact))
        with pytest.raises(InputError, match=f"{artefact}: {CHANGED}"):
            egvs.run(egvs.load(runs.folder), tmp_path / "out")
    egvs.run(egvs.load(runs.folder), tmp_path / "clean")
    assert runs.scores(tmp_path / "clean") == runs.scores(runs.expected)


def test_artefact_replaced_while_it_is_read_and_put_back(
    runs: TwoRuns, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The original is a file of its own when the stage ends: only its times show that another one was there."""

    def swap_and_put_back(folder: Path) -> None:
        kept = (folder / "tpog.parquet").read_bytes()
        put_in_place(runs.other / "tpog.parquet", folder / "tpog.parquet")
        (folder / "tpog.parquet").write_bytes(kept)

    at_end_of("score", monkeypatch, swap_and_put_back)
    with pytest.raises(InputError, match=f"tpog.parquet: {CHANGED}"):
        egvs.run(egvs.load(runs.folder), tmp_path / "out")


def test_large_input_replaced_while_a_stage_works(
    runs: TwoRuns, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("egvs.core.digests.MAX_HELD_BYTES", 10)
    mini = write_mini(tmp_path / "mini")
    at_end_of(
        "traffic", monkeypatch, lambda _: write_over(runs.folder.parent / "changed" / "fcd.csv", mini / "fcd.csv")
    )
    with pytest.raises(InputError, match=f"fcd.csv: {CHANGED}"):
        egvs.run(egvs.load(mini), tmp_path / "out")


@pytest.mark.slow
def test_network_replaced_while_sumo_reads_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = ['traffic.hold="at_most"', "traffic.frames=20", "traffic.warmup_s=5", "tpog.blocks=2", "roi.voxel_m=1"]
    roundabout = Path(__file__).parents[2] / "scenarios" / "roundabout"

    def replace_network(folder: Path) -> None:
        network = folder / "sumo" / NETWORK_FILE
        network.write_text(network.read_text(encoding="utf-8").replace('speed="13.89"', 'speed="8.33"', 1) + "\n")

    at_end_of("traffic", monkeypatch, replace_network)
    with pytest.raises(InputError, match=f"{NETWORK_FILE}: {CHANGED}"):
        egvs.run(egvs.load(roundabout, settings), tmp_path / "out")
    assert not (tmp_path / "out" / "tpog.parquet").exists()


def test_new_link_to_an_artefact_is_no_change(runs: TwoRuns, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    at_end_of("score", monkeypatch, lambda folder: os.link(folder / "tpog.parquet", tmp_path / "link"))
    egvs.run(egvs.load(runs.folder), tmp_path / "out")
    assert runs.scores(tmp_path / "out") == runs.scores(runs.expected)


@pytest.mark.parametrize("artefact", ["scans.parquet", "tpog.parquet"])
@pytest.mark.parametrize("after", [False, True])
def test_artefact_replaced_before_or_while_a_plan_is_made(
    runs: TwoRuns, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, artefact: str, after: bool
) -> None:
    original = plan.solve_placement
    out = tmp_path / "out"

    def solve(context: Any, **options: Any) -> Any:
        if after:
            placed = original(context, **options)
        put_in_place(runs.other / artefact, out / artefact)
        return placed if after else original(context, **options)

    monkeypatch.setattr(plan, "solve_placement", solve)
    with pytest.raises(InputError, match=f"{artefact}: was (changed|altered)"):
        plan.place(egvs.load(runs.folder, ["placement.count=1"]), out)
    assert not (out / "placement.parquet").exists()


def forge(folder: Path, name: str, source: Path) -> None:
    """Put an artefact of another run in place, and record its digest, as a run that had read other inputs would."""
    shutil.copyfile(source / name, folder / name)
    record = json.loads((folder / "run.json").read_text())
    for stage in record["stages"].values():
        if name in stage["artefacts"]:
            stage["artefacts"][name] = files.hash_file(folder / name)
    (folder / "run.json").write_text(files.to_json_text(checksums.add_checksum(record)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["scores.parquet", "scans.parquet"])
def test_rehash_finds_artefacts_that_do_not_belong_to_those_beside_them(
    runs: TwoRuns, tmp_path: Path, run_egvs: Any, name: str
) -> None:
    out = tmp_path / "out"
    shutil.copytree(runs.expected, out)
    forge(out, name, runs.other)
    code, _, printed = run_egvs("run", runs.folder, "--out", out, "--rehash")
    assert code == 0
    assert "the artefacts in the folder did not belong to those that they are made of; made again" in printed
    assert runs.scores(out) == runs.scores(runs.expected)
    assert "did not belong" not in run_egvs("run", runs.folder, "--out", out, "--rehash")[2]


@pytest.mark.slow
def test_rehash_replaces_wrong_entry_of_the_store(runs: TwoRuns, tmp_path: Path, store: Path, run_egvs: Any) -> None:
    egvs.run(egvs.load(runs.folder), tmp_path / "out")
    (entry,) = store.glob("score-*")
    shutil.copyfile(runs.other / "scores.parquet", entry / "scores.parquet")
    record = json.loads((entry / "entry.json").read_text())
    del record["sha256"]
    record["artefacts"]["scores.parquet"] = files.hash_file(entry / "scores.parquet")
    record["sha256"] = files.hash_json(record)
    (entry / "entry.json").write_text(json.dumps(record))
    egvs.run(egvs.load(runs.folder), tmp_path / "poisoned")
    assert runs.scores(tmp_path / "poisoned") == runs.scores(runs.other)
    run_egvs("run", runs.folder, "--out", tmp_path / "poisoned", "--rehash")
    egvs.run(egvs.load(runs.folder), tmp_path / "clean")
    for folder in ("poisoned", "clean"):
        assert runs.scores(tmp_path / folder) == runs.scores(runs.expected)
