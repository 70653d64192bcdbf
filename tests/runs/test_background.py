"""SUMO simulates in the background while a run checks, builds and scans; nothing else changes.

Evidence: runs with and without a stage in the background, compared byte by byte; a program in place of SUMO that reads
from a pipe, so that a test knows that it runs, and that it has ended. Nothing waits for a clock.
"""

from __future__ import annotations

import io
import json
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent import futures
from dataclasses import replace
from functools import partial, partialmethod
from pathlib import Path
from typing import Any

import pytest

import egvs
from egvs.artefacts.run_folder import STAGE_NAMES
from egvs.artefacts.run_record import RunRecord, StageRecord
from egvs.core import threads
from egvs.core.errors import InputError, RunError
from egvs.core.resource_usage import ResourceUsage
from egvs.runs import run, stage_keys, stage_registry
from egvs.runs.background import run_in_background
from egvs.runs.run_context import open_folder
from egvs.runs.store import Store
from egvs.stages import tpog
from egvs.traffic import sumo
from tests.traffic.helpers import fake_sumo

ROUNDABOUT = Path(__file__).parents[2] / "scenarios" / "roundabout"
SHORT = ['traffic.hold="at_most"', "traffic.frames=40", "traffic.warmup_s=5", "tpog.blocks=4", "roi.voxel_m=1"]
DATA = ("statics.ply", "scans.parquet", "trajectories.parquet", "tpog.parquet", "scores.parquet", "blindspots.parquet")

MEASURED = ("sumo_seconds", "sumo_peak_mb")
"""What the summary of the traffic has measured."""

DATED = "sumo/collisions.xml"
"""SUMO writes the date into it."""

Gate = Callable[[], None]


def load(*overrides: str) -> egvs.Scenario:
    return egvs.load(ROUNDABOUT, [*SHORT, *overrides])


def in_turn(patch: pytest.MonkeyPatch) -> None:
    """Let runs start no stage before its turn."""
    patch.setattr(run._Run, "key_to_simulate", lambda _: None)


def before(patch: pytest.MonkeyPatch, stage: str, gate: Gate) -> None:
    """Call a function when a stage begins."""
    run_stage = stage_registry.run_stage

    def run_gated(name: str, *rest: Any, **options: Any) -> stage_registry.StageResult:
        if name == stage:
            gate()
        return run_stage(name, *rest, **options)

    patch.setattr(stage_registry, "run_stage", run_gated)


def after_traffic(patch: pytest.MonkeyPatch, stage: str) -> None:
    """Let a stage begin only when the traffic stage has ended, with or without an error."""
    ended, run_stage = threading.Event(), stage_registry.run_stage

    def run_gated(name: str, *rest: Any, **options: Any) -> stage_registry.StageResult:
        if name == stage:
            assert ended.wait(timeout=60)
        try:
            return run_stage(name, *rest, **options)
        finally:
            if name == "traffic":
                ended.set()

    patch.setattr(stage_registry, "run_stage", run_gated)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def without_costs(record: RunRecord) -> dict[str, StageRecord]:
    """The records of all stages but the report, which shows what they cost."""
    stages = {}
    for name, stage in record.stages.items():
        if name != "report":
            stages[name] = replace(
                stage,
                summary={key: value for key, value in stage.summary.items() if key not in MEASURED},
                companions={file: digest for file, digest in stage.companions.items() if file != DATED},
                cost=ResourceUsage(),
            )
    return stages


class Simulation:
    """A program in place of SUMO, which reads from a pipe until it is killed."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        sumo.sumo_version()  # of the real one
        self._pipe = folder / "pipe"
        os.mkfifo(self._pipe)
        fake_sumo(folder, patch, f"exec cat {self._pipe}")
        self._writer: io.FileIO | None = None

    def wait_for_start(self) -> None:
        """Return when the program has opened the pipe."""
        self._writer = self._pipe.open("wb", buffering=0)

    @property
    def is_running(self) -> bool:
        """Whether the program still has the pipe open."""
        assert self._writer is not None, "the program has been started"
        try:
            self._writer.write(b"x")
        except BrokenPipeError:
            return False
        return True

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()


@pytest.fixture
def simulation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Simulation]:
    fake = Simulation(tmp_path, monkeypatch)
    yield fake
    fake.close()


def wait_for_simulation(patch: pytest.MonkeyPatch) -> None:
    """Let the check wait until SUMO has been started; without a background that would be never."""
    began, run_program = threading.Event(), sumo.run_program

    def begin(*rest: Any) -> str:
        began.set()
        return run_program(*rest)

    def wait() -> None:
        assert began.wait(timeout=60)

    patch.setattr(sumo, "run_program", begin)
    before(patch, "check", wait)


@pytest.mark.slow
def test_run_has_same_bytes_record_and_states_as_in_turn(
    tmp_path: Path, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    records: dict[str, RunRecord] = {}
    states: dict[str, list[tuple[str, str]]] = {"overlapped": [], "in turn": []}
    for name, prepare in (("overlapped", wait_for_simulation), ("in turn", in_turn)):
        with monkeypatch.context() as patch:
            patch.setenv("EGVS_STORE", str(store / name))
            prepare(patch)
            patch.setattr(tpog.BlocksAhead, "blocks", partialmethod(note_blocks, tpog.BlocksAhead.blocks, ahead := []))
            listener = partial(add_state, states[name])
            records[name] = run.run(load(), tmp_path / name, listener=listener)
            assert len(ahead) == (1 if name == "overlapped" else 0)
    assert list(records["overlapped"].stages) == list(STAGE_NAMES)
    assert states["overlapped"] == states["in turn"]
    assert without_costs(records["overlapped"]) == without_costs(records["in turn"])
    one, other = contents(tmp_path / "overlapped"), contents(tmp_path / "in turn")
    assert one.keys() == other.keys()
    measured = {"run.json", ".digests.json", "report.html", DATED}
    assert [name for name in one if one[name] != other[name] and name not in measured] == []
    assert set(DATA) < one.keys()


def test_stages_that_work_ahead_are_named() -> None:
    declared = {name for name in STAGE_NAMES if stage_registry.stage(name).ahead is not None}
    assert declared == stage_registry.AHEAD_STAGES


def note_blocks(self: tpog.BlocksAhead, blocks: Callable[..., Any], calls: list[tpog.BlocksAhead]) -> Any:
    """Note that blocks were counted while SUMO simulated, and return them."""
    calls.append(self)
    return blocks(self)


def add_state(states: list[tuple[str, str]], stage: str, state: str, _record: StageRecord | None) -> None:
    states.append((stage, state))


@pytest.mark.slow
def test_failed_check_ends_sumo_and_leaves_nothing(
    tmp_path: Path, store: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong, out = load("roi.center_m=[900, 0, 2.5]"), tmp_path / "out"
    with monkeypatch.context() as patch:
        in_turn(patch)
        with pytest.raises(InputError) as in_turn_error:
            run.run(wrong, out)
    before(monkeypatch, "check", simulation.wait_for_start)
    with pytest.raises(InputError) as error:
        run.run(wrong, out)
    assert not simulation.is_running
    assert str(error.value) == str(in_turn_error.value)
    assert not out.exists()
    assert contents(store) == {}


@pytest.mark.slow
def test_failed_check_leaves_earlier_run_as_it_was(
    tmp_path: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.delenv("SUMO_BINARY")
        run.run(load(), out)
    earlier = contents(out)
    assert "sumo/run.sumocfg" in earlier
    before(monkeypatch, "check", simulation.wait_for_start)
    with pytest.raises(InputError, match="no lane passes through the region"):
        run.run(load("roi.center_m=[900, 0, 2.5]", "traffic.frames=80"), out)
    assert not simulation.is_running
    assert contents(out) == earlier


def without_space(error: BaseException) -> str:
    """A message without how much of the disk is free."""
    return re.sub(r"[\d,.]+ MB", "", str(error))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("echo 'Error: it is broken' >&2; exit 1", "Error: it is broken"),
        ("exit 0", "fcd.csv"),  # which is not there
    ],
)
def test_error_of_traffic_is_raised_after_the_stages_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, message: str
) -> None:
    sumo.sumo_version()
    fake_sumo(tmp_path, monkeypatch, script)
    scenario, out = load(), tmp_path / "out"
    with monkeypatch.context() as patch:
        in_turn(patch)
        with pytest.raises((InputError, RunError, OSError)) as in_turn_error:
            run.run(scenario, out)
    sequential = contents(out)
    after_traffic(monkeypatch, "scan")
    states: list[tuple[str, str]] = []
    again = tmp_path / "again"
    again.mkdir()
    monkeypatch.setenv("EGVS_STORE", "")
    with pytest.raises(type(in_turn_error.value)) as error:
        run.run(scenario, again, listener=partial(add_state, states))
    assert message in str(error.value)
    assert without_space(error.value).replace(str(again), str(out)) == without_space(in_turn_error.value)
    done = [(stage, state) for stage in ("check", "statics", "scan") for state in ("runs", "done")]
    assert states == [*done, ("traffic", "runs")]
    assert list(json.loads((again / "run.json").read_text())["stages"]) == ["check", "statics", "scan"]
    assert contents(again).keys() == sequential.keys()  # what SUMO has read is there to look at


@pytest.mark.slow
def test_error_of_check_comes_before_an_earlier_one_of_traffic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sumo.sumo_version()
    fake_sumo(tmp_path, monkeypatch, "echo 'Error: it is broken' >&2; exit 1")
    after_traffic(monkeypatch, "check")
    with pytest.raises(InputError, match="no lane passes through the region"):
        run.run(load("roi.center_m=[900, 0, 2.5]"), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["check", "scan"])
def test_interrupt_ends_sumo(
    tmp_path: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch, stage: str
) -> None:
    out = tmp_path / "out"

    def interrupt() -> None:
        simulation.wait_for_start()
        raise KeyboardInterrupt

    before(monkeypatch, stage, interrupt)
    with pytest.raises(KeyboardInterrupt):
        run.run(load(), out)
    assert not simulation.is_running
    assert not (out / ".pending").exists()
    assert out.exists() == (stage == "scan")  # the stages before it are recorded


@pytest.mark.slow
def test_interrupt_while_the_run_waits_for_sumo(
    tmp_path: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    main = threading.main_thread().ident
    assert main is not None

    def listener(stage: str, _state: str, _record: StageRecord | None) -> None:
        if stage == "traffic":  # the run waits from now on, in this thread
            threading.Thread(target=interrupt).start()

    def interrupt() -> None:
        simulation.wait_for_start()
        signal.pthread_kill(main, signal.SIGINT)

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            run.run(load(), tmp_path / "out", listener=listener)
    finally:
        signal.signal(signal.SIGINT, handler)
    assert not simulation.is_running
    assert not (tmp_path / "out" / ".pending").exists()
    assert not (tmp_path / "out" / "sumo").exists()


@pytest.mark.slow
def test_what_a_killed_run_left_is_removed(tmp_path: Path, mini: Path) -> None:
    out = tmp_path / "out"
    run.run(egvs.load(mini), out)
    (out / ".pending" / "sumo").mkdir(parents=True)
    (out / ".pending" / "sumo" / "fcd.csv").write_text("half a file")
    run.run(egvs.load(mini), out)
    assert not (out / ".pending").exists()


def test_stage_that_another_process_makes_is_left_to_it(tmp_path: Path, store: Path) -> None:
    (tmp_path / "out").mkdir()
    context = open_folder(load(), tmp_path / "out")
    key = stage_keys.stage_key("traffic", context)
    shared = Store(store)
    with shared.maker("traffic", key.key), run_in_background("traffic", key, context, Store(store), {}) as stage:
        assert stage is None
    with run_in_background("traffic", None, context, Store(store), {}) as stage:
        assert stage is None
    with shared.maker("traffic", key.key, wait=False) as is_free:
        assert is_free


def test_progress_is_that_of_the_stage_whose_turn_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a stage that reports progress in the background, and again when the run waits for it."""
    reported, calls = [], []
    context = open_folder(load(), tmp_path, progress=lambda what, *_: reported.append((what, awaited.is_set())))
    first, awaited = threading.Event(), threading.Event()

    def work(_name: str, its: Any, _dependencies: Any) -> stage_registry.StageResult:
        its.progress("early", 1, 2)
        first.set()
        threads.checkpoint()
        calls.append(awaited.wait(timeout=60))
        its.progress("late", 2, 2)
        return stage_registry.StageResult({}, {}, {"done": True}, ResourceUsage())

    monkeypatch.setattr(stage_registry, "run_stage", work)
    key = stage_keys.StageKey("0" * 64, stage_keys.StageDependencies({}, {}))
    with run_in_background("traffic", key, context, Store(None), {}) as stage:
        assert stage is not None and first.is_set()
        wait = futures.wait

        def wait_for(*rest: Any) -> Any:
            awaited.set()
            return wait(*rest)

        monkeypatch.setattr(futures, "wait", wait_for)
        assert stage.result().summary == {"done": True}
    assert calls == [True]
    assert reported == [("late", True)]


@pytest.mark.slow
def test_folder_in_place_of_the_trajectories_is_not_removed(
    tmp_path: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out" / "trajectories.parquet"
    folder.mkdir(parents=True)
    (tmp_path / "out" / ".lock").touch()
    (folder / "mine").write_text("my work of years")
    with pytest.raises(InputError, match="expected a file, got a folder"):
        run.run(load(), tmp_path / "out")
    assert contents(folder) == {"mine": b"my work of years"}
