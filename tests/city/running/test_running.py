"""A city's junctions come out as they would alone, however they are cut, joined, or lost on the way.

Evidence: the same junctions run alone, with a store of their own, compared byte by byte."""

from __future__ import annotations

import json
import shutil
import threading
from pathlib import Path
from typing import Any

import pytest

import egvs
from egvs.artefacts.run_folder import STAGE_NAMES
from egvs.artefacts.run_record import RunRecord
from egvs.city import scheduler, tasks
from egvs.city.tasks import Job, JobFailure, JobResult
from egvs.core.errors import EgvsError, InputError, RunError
from egvs.runs import run

DATA = ("statics.ply", "trajectories.parquet", "tpog.parquet", "scores.parquet", "visibility.parquet")
CUT = ("scan.keep=false", 'score.keep_visibility="all"', 'score.others=["seen_well", "coverage"]')


def alone(job: Job, out: Path, monkeypatch: pytest.MonkeyPatch) -> RunRecord:
    """The run of a junction by itself, with a store of its own."""
    with monkeypatch.context() as patch:
        patch.setenv("EGVS_STORE", str(out / "store"))
        return run.run(egvs.load(job.folder, job.sets), out / "run")


def assert_same(job: Job, out: Path) -> None:
    """Artefacts are the same, byte for byte, and so is what the record says of them, but for what it cost."""
    here, there = RunRecord.read(job.out), RunRecord.read(out / "run")
    for name in STAGE_NAMES:
        if name == "report":  # which shows costs
            continue
        a, b = here.stages[name], there.stages[name]
        assert (a.inputs, a.artefacts, a.summary, a.files) == (b.inputs, b.artefacts, b.summary, b.files)
    for name in (name for stage in here.stages.values() for name in stage.artefacts):
        if name != "report.html":
            assert (job.out / name).read_bytes() == (out / "run" / name).read_bytes()


@pytest.mark.slow
def test_a_junction_scored_in_parts_is_the_junction_run_alone(
    client: Any, jobs: list[Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = Job("c", jobs[2].folder, jobs[2].out, CUT)
    monkeypatch.setattr(scheduler, "LEAST_BEAMS", 2**15)
    monkeypatch.setattr(scheduler, "MOST_BEAMS", 2**15)  # 2,880 beams and 16,384 a site: three parts of four sites
    heard: list[JobResult] = []
    scheduler.run_jobs(client, [job], on_done=heard.append)
    assert [(its.junction, its.sites) for its in heard] == [("c", 4)]
    assert set(heard[0].made) == {"check", "score", "report"}  # the others were made in other tasks
    alone(job, tmp_path / "alone", monkeypatch)
    assert_same(job, tmp_path / "alone")
    assert all((job.out / name).is_file() for name in DATA)


@pytest.mark.slow
def test_small_junctions_are_the_junctions_run_alone(
    client: Any, jobs: list[Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scheduler.run_jobs(client, jobs)
    alone(jobs[1], tmp_path / "alone", monkeypatch)
    assert_same(jobs[1], tmp_path / "alone")
    again: list[JobResult] = []
    scheduler.run_jobs(client, jobs, on_done=again.append)
    assert {its.made for its in again} == {()}


@pytest.mark.slow
def test_parts_that_were_lost_are_scored_again(
    jobs: list[Job], tmp_path: Path, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, order = Job("c", jobs[2].folder, jobs[2].out, CUT), scheduler.make_run_settings()
    scored = [tasks.score_part(job, order, (number, 3), None) for number in range(3)]
    assert scored == [1, 1, 2]
    shutil.rmtree(next(store.glob("part-*")))
    (done,) = tasks.finish_junction(job, order, scored)
    assert isinstance(done, JobResult)
    alone(job, tmp_path / "alone", monkeypatch)
    assert_same(job, tmp_path / "alone")


@pytest.mark.slow
def test_one_bad_junction_stops_no_other(client: Any, jobs: list[Job]) -> None:
    (jobs[1].folder / "sites.csv").write_text("site,x_m,y_m,z_m\npole,ten,12,3\n")
    with pytest.raises(EgvsError) as refused:
        scheduler.run_jobs(client, jobs)
    assert refused.value.exit_code == 2
    assert "junction b: " in str(refused.value)
    assert "'ten'" in str(refused.value)
    assert "1 of 3 junctions failed; the others are done" in str(refused.value)
    assert (jobs[0].out / "scores.parquet").is_file()
    assert not (jobs[1].out / "scores.parquet").exists()


def test_a_part_of_a_junction_that_cannot_be_says_why(jobs: list[Job]) -> None:
    (jobs[0].folder / "fcd.csv").unlink()
    order = scheduler.make_run_settings()
    failed = tasks.prepare_junction(jobs[0], order)
    assert isinstance(failed, JobFailure)
    assert "fcd.csv" in failed.message
    assert tasks.score_part(jobs[0], order, (0, 2), failed) == failed
    assert list(tasks.finish_junction(jobs[0], order, [failed, failed])) == [failed]


def test_workers_have_the_same_program(jobs: list[Job], monkeypatch: pytest.MonkeyPatch) -> None:
    order = scheduler.make_run_settings()
    monkeypatch.setattr("egvs.city.tasks.__version__", "9.9.9")
    answer = tasks.estimate_beams(jobs[0], order)
    assert isinstance(answer, JobFailure)
    assert "this worker's egvs is not the one that gave the work (9.9.9," in answer.message


def test_a_city_run_needs_a_store(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_STORE", "")
    with pytest.raises(InputError, match="EGVS_STORE: empty, so that there is no store"):
        scheduler.make_run_settings()


def test_a_lost_scheduler_is_one_message(client: Any) -> None:
    from concurrent.futures import CancelledError

    with (
        pytest.raises(RunError, match=r"was lost.*run the same command again to go on"),
        scheduler._watch_scheduler(client),
    ):
        raise CancelledError


def test_a_worker_keeps_few_scenes(jobs: list[Job]) -> None:
    kept, folders = tasks.SceneCache(most=1), []
    for job in jobs:
        with kept.borrow("token", job) as built:
            folders.append(built.work.folder.path)
            with kept.borrow("token", job) as again:
                assert again is built
    assert [folder.is_dir() for folder in folders] == [False, False, True]
    with kept.borrow("another run", jobs[2]) as anew:
        assert anew.work.folder.path != folders[2]


def test_a_scene_that_nobody_will_ask_for_goes(jobs: list[Job]) -> None:
    kept = tasks.SceneCache()
    with kept.borrow("token", jobs[0]) as built:
        kept.drop("token", jobs[0])
        assert built.work.folder.path.is_dir()  # it is still lent
    kept.drop("another run", jobs[0])
    assert built.work.folder.path.is_dir()
    kept.drop("token", jobs[0])
    assert not built.work.folder.path.exists()
    kept.drop("token", jobs[0])


def test_the_order_names_a_place_that_other_folders_can_be_left_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("EGVS_STORE")
    assert scheduler.make_run_settings().store == str(tmp_path / "runs" / ".store")


def test_jobs_are_small_messages(jobs: list[Job]) -> None:
    import pickle

    assert len(pickle.dumps((jobs[0], scheduler.make_run_settings()))) < 2000
    assert json.dumps(scheduler.make_run_settings().token)


def test_a_junction_that_a_lost_worker_still_holds_is_waited_for(jobs: list[Job]) -> None:
    order, free = scheduler.make_run_settings(), threading.Event()

    def hold() -> None:
        with run.lock_run_folder(jobs[0].out):
            held.set()
            free.wait(30)

    held, holder = threading.Event(), threading.Thread(target=hold)
    holder.start()
    held.wait(30)
    threading.Timer(0.3, free.set).start()
    (done,) = tasks.run_junctions([jobs[0]], order)
    holder.join()
    assert isinstance(done, JobResult)
    assert done.sites == 2
