"""Junctions on a cluster: how work is split into tasks, results equal to separate runs, killed workers.

Junctions are compared byte by byte with runs of their own, with another store.
"""

from __future__ import annotations

import json
import math
import os
import signal
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from benchmarks.city import workers
from hypothesis import given
from hypothesis import strategies as st

from egvs.core.errors import EgvsError, InputError, RunError
from egvs.extensions.city import scheduler, tasks
from egvs.extensions.city.scheduler import check_cluster
from egvs.extensions.city.tasks import Job, JobResult, RunSettings
from egvs.runs.store import Store
from tests.extensions.city.conftest import OVERRIDES, assert_same_run, run_separately

pytestmark = pytest.mark.system
SETTINGS = RunSettings("token", "program", "/store", 1e9)
ARTEFACTS = ("statics.ply", "trajectories.parquet", "tpog.parquet", "scores.parquet", "visibility.parquet")


def make_jobs(count: int) -> list[Job]:
    return [Job(f"j{i}", Path(f"/city/j{i}"), Path(f"/out/j{i}")) for i in range(count)]


@pytest.mark.slow
@given(st.lists(st.integers(1, 2**28), min_size=1, max_size=60), st.integers(1, 64))
def test_graph_has_every_junction_once(beams: list[int], workers: int) -> None:
    all_jobs = make_jobs(len(beams))
    beams_of_junction = {job.junction: number for job, number in zip(all_jobs, beams, strict=True)}
    graph = scheduler.build_graph(all_jobs, beams_of_junction, SETTINGS, workers)
    assert sorted(job.junction for group in graph.values() for job in group) == sorted(beams_of_junction)


def test_splits_large_junctions_and_groups_small_ones() -> None:
    all_jobs, m = make_jobs(5), 2**21
    beams = dict(zip((job.junction for job in all_jobs), (m, 100 * m, m, m, 9 * m), strict=True))
    assert scheduler.beams_per_task(beams, 2) == 8 * m  # an eighth of 117 m, as a power of two
    assert scheduler.part_count(beams["j1"], 8 * m) == 13
    small = [all_jobs[i] for i in (0, 2, 3)]  # 2 m each, with the work that does not depend on beams
    groups = scheduler.group_jobs(small, beams, 5 * m)
    assert [[job.junction for job in group] for group in groups] == [["j0", "j2"], ["j3"]]
    graph = scheduler.build_graph(all_jobs, beams, SETTINGS, 2)
    assert {task.key.split("-")[0] for task in graph} == {"finish", "run"}


@pytest.mark.parametrize(("workers", "beams"), [(1, 2**25), (2, 2**25), (8, 2**25), (100, 2**22), (1000, 2**20)])
def test_limits_size_of_tasks(workers: int, beams: int) -> None:
    assert scheduler.beams_per_task({"a": 2**31}, workers) == beams
    assert scheduler.beams_per_task({"a": 1}, workers) == scheduler.MIN_TASK_BEAMS


def busy_share(beams: dict[str, int], workers: int) -> float:
    """Return the share of the time in which workers are busy, if tasks take as long as they have beams.

    A quarter of the work of a junction that does not depend on its sites is before its sites are scored, the rest after
    that. A free worker takes the first task that can start, those of split junctions before the others.
    """
    prepare, finish = scheduler.JUNCTION_BEAMS // 4, 3 * scheduler.JUNCTION_BEAMS // 4
    max_beams = scheduler.beams_per_task(beams, workers)
    parts = {name: scheduler.part_count(work, max_beams) for name, work in beams.items()}
    small_jobs = [job for job in make_jobs(len(beams)) if parts[job.junction] == 1]
    groups = list(scheduler.group_jobs(small_jobs, beams, max_beams))
    whole = [sum(beams[job.junction] + scheduler.JUNCTION_BEAMS for job in group) for group in groups]

    ready = [(0, prepare, name, "prepare") for name in beams if parts[name] > 1]
    ready += [(0, work, "", "whole") for work in whole]
    free, scored = [0] * workers, dict.fromkeys(beams, 0)
    while ready:
        ready.sort(key=lambda task: max(task[0], min(free)))
        start, work, name, kind = ready.pop(0)
        worker = free.index(min(free))
        end = free[worker] = max(start, free[worker]) + work
        if kind == "prepare":
            ready += [(end, beams[name] // parts[name], name, "score")] * parts[name]
        if kind == "score":
            scored[name] += 1
            if scored[name] == parts[name]:
                ready.append((end, finish, name, "finish"))
    return (sum(beams.values()) + scheduler.JUNCTION_BEAMS * len(beams)) / (workers * max(free))


VLP_32C_SITES = 108 * (57_600 + tasks.SITE_BEAMS)
"""Work of a junction with 108 candidates."""


@pytest.mark.parametrize(
    ("junctions", "workers", "share"), [(1, 2, 0.8), (11, 2, 0.9), (23, 8, 0.95), (23, 64, 0.7), (300, 64, 0.9)]
)
def test_tasks_keep_workers_busy(junctions: int, workers: int, share: float) -> None:
    beams = {f"j{i}": VLP_32C_SITES for i in range(junctions)}
    assert busy_share(beams, workers) > share


def test_64_workers_score_one_town_in_three_rounds() -> None:
    beams = {f"j{i}": VLP_32C_SITES for i in range(23)}
    n_parts = 23 * scheduler.part_count(VLP_32C_SITES, scheduler.beams_per_task(beams, 64))
    assert n_parts == 184  # 2.9 times 64


@pytest.mark.parametrize(
    "cluster", ["", "lokal", "processes=0", "processes=two", "processes=5000", "tcp://", "host:8786"]
)
def test_rejects_invalid_cluster(cluster: str) -> None:
    with pytest.raises(InputError, match=r"local, processes=N .1 to 1000., or the address of a scheduler"):
        check_cluster(cluster)


@pytest.mark.parametrize("cluster", ["local", "processes=2", "tcp://host:8786", "tls://host:8786"])
def test_accepts_valid_cluster(cluster: str) -> None:
    check_cluster(cluster)


@pytest.mark.slow
def test_split_junction_equals_separate_run(
    client: Any, jobs: list[Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = Job("c", jobs[2].folder, jobs[2].out, OVERRIDES)
    monkeypatch.setattr(scheduler, "MIN_TASK_BEAMS", 2**15)
    monkeypatch.setattr(
        scheduler, "MAX_TASK_BEAMS", 2**15
    )  # 2,880 beams and 16,384 per site: three parts of four sites
    done: list[JobResult] = []
    scheduler.run_jobs(client, [job], on_done=done.append)
    assert [(result.junction, result.sites) for result in done] == [("c", 4)]
    assert set(done[0].stages_run) == {"check", "score", "report"}  # the others were run in other tasks
    run_separately(job, tmp_path / "separate", monkeypatch)
    assert_same_run(job, tmp_path / "separate")
    assert all((job.out / name).is_file() for name in ARTEFACTS)


@pytest.mark.slow
def test_grouped_junctions_equal_separate_runs(
    client: Any, jobs: list[Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scheduler.run_jobs(client, jobs)
    run_separately(jobs[1], tmp_path / "separate", monkeypatch)
    assert_same_run(jobs[1], tmp_path / "separate")
    again: list[JobResult] = []
    scheduler.run_jobs(client, jobs, on_done=again.append)
    assert {result.stages_run for result in again} == {()}


@pytest.mark.slow
def test_failed_junction_does_not_stop_others(client: Any, jobs: list[Job]) -> None:
    (jobs[1].folder / "sites.csv").write_text("site,x_m,y_m,z_m\npole,ten,12,3\n")
    with pytest.raises(EgvsError) as caught:
        scheduler.run_jobs(client, jobs)
    assert caught.value.exit_code == 2
    assert "junction b: " in str(caught.value)
    assert "'ten'" in str(caught.value)
    assert "1 of 3 junctions failed; the others are done" in str(caught.value)
    assert (jobs[0].out / "scores.parquet").is_file()
    assert not (jobs[1].out / "scores.parquet").exists()


def test_needs_store(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_STORE", "")
    with pytest.raises(InputError, match="EGVS_STORE: is empty, so there is no store"):
        scheduler.make_run_settings()


def test_store_is_absolute_path(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("EGVS_STORE", "results/store")
    assert scheduler.make_run_settings().store == str(tmp_path / "results" / "store")


def test_jobs_and_settings_are_small(jobs: list[Job]) -> None:
    import pickle

    assert len(pickle.dumps((jobs[0], scheduler.make_run_settings()))) < 2000
    assert json.dumps(scheduler.make_run_settings().token)


def test_reports_lost_scheduler(client: Any) -> None:
    from concurrent.futures import CancelledError

    with (
        pytest.raises(RunError, match=r"was lost.*Run the same command again to continue"),
        scheduler._watch_scheduler(client),
    ):
        raise CancelledError


@pytest.mark.slow
def test_killed_worker_changes_no_byte(jobs: list[Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    killed: list[int] = []

    def kill(_done: JobResult) -> None:
        """Kill the only worker when the first junction is done."""
        if not killed:
            killed.extend(client.run(os.getpid).values())
            os.kill(killed[0], signal.SIGKILL)

    monkeypatch.setattr("egvs.extensions.city.scheduler.MIN_TASK_BEAMS", 1)
    monkeypatch.setattr("egvs.extensions.city.scheduler.MAX_TASK_BEAMS", 4096)  # every junction is split
    with scheduler.connect("processes=1") as client:
        scheduler.run_jobs(client, jobs, on_done=kill)
    assert killed
    for job in jobs:
        run_separately(job, tmp_path / f"separate {job.junction}", monkeypatch)
        assert_same_run(job, tmp_path / f"separate {job.junction}")
    again: list[JobResult] = []
    with scheduler.connect("processes=1") as client:
        scheduler.run_jobs(client, jobs, on_done=again.append)
    assert [result.stages_run for result in again] == [()] * 3


@pytest.mark.slow
def test_replaces_worker_that_dask_does_not_restart(jobs: list[Job], monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the process were killed a second time while it starts."""

    async def fail() -> None:
        raise RuntimeError("the process ended while it started")

    monkeypatch.setattr(scheduler, "CHECK_INTERVAL_S", 0.5)
    monkeypatch.setattr(scheduler, "_MAX_ABSENCE_S", 8.0)
    done: list[JobResult] = []
    with scheduler.connect("processes=1") as client:
        (nanny,) = client.cluster.workers.values()
        monkeypatch.setattr(nanny, "instantiate", fail)
        (killed,) = workers()
        os.kill(killed, signal.SIGKILL)
        scheduler.run_jobs(client, jobs, on_done=done.append)
        assert killed not in workers()
    assert len(done) == 3


@pytest.mark.slow
def test_reports_workers_that_never_start(jobs: list[Job], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduler, "CHECK_INTERVAL_S", 0.2)
    monkeypatch.setattr(scheduler, "_MAX_ABSENCE_S", 1.0)
    ended = threading.Event()

    def kill() -> None:
        while not ended.wait(0.05):
            for pid in workers():
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)

    with scheduler.connect("processes=1") as client:
        killer = threading.Thread(target=kill)
        killer.start()
        try:
            with pytest.raises(RunError, match="died at start-up"):
                scheduler.run_jobs(client, jobs)
        finally:
            ended.set()
            killer.join()


def test_store_grows_with_city_unless_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("EGVS_STORE_MAX_GB", raising=False)
    assert scheduler.make_run_settings(23).store_bytes == 10e9
    assert scheduler.make_run_settings(10_000).store_bytes == 1e12
    monkeypatch.setenv("EGVS_STORE_MAX_GB", "2")
    assert scheduler.make_run_settings(10_000).store_bytes == 2e9


def test_warns_about_small_store_and_disk(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert list(scheduler.expected_size_messages(store, 10e9, 23)) == []
    (message,) = scheduler.expected_size_messages(store, 0.5e9, 23)
    expected = "the results of 23 junctions take about 0.92 GB, more than the limit of 0.5 GB. Try 1.8."
    assert message == f"EGVS_STORE_MAX_GB: {expected}"
    (message,) = scheduler.expected_size_messages(store, math.inf, 10**9)
    assert message.startswith(f"{store}: the results of 1,000,000,000 junctions take about 4e+07 GB, and ")
    monkeypatch.setattr(Store, "usage_bytes", lambda _: 3e9)
    (message,) = scheduler.store_size_messages(store, 2e9)
    assert message.startswith(f"EGVS_STORE_MAX_GB: expected results of at most 2 GB in {store}, got 3 GB.")
    assert message.endswith("Try 3.6.")
    assert list(scheduler.store_size_messages(store, 4e9)) == []
