"""Scenes that workers check and scan while the traffic is simulated: used by the runs, no trace otherwise."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from benchmarks.city import workers

from egvs.core.errors import RunError
from egvs.extensions.city import city_run, costs, results, scheduler, tasks, traffic_split
from egvs.extensions.city.city_run import CityRunOptions
from egvs.extensions.city.model import City
from egvs.extensions.city.tasks import Job, JobResult, SceneResult
from egvs.world import static_world
from tests.extensions.city.conftest import OVERRIDES, assert_same_run, run_separately
from tests.extensions.city.real_cluster import wait_until

pytestmark = pytest.mark.system

record_period = traffic_split._record_period


def city_jobs(city: City, out: Path) -> list[Job]:
    return city_run.make_jobs(city, out, CityRunOptions())


def before_recording(monkeypatch: pytest.MonkeyPatch, action: Callable[[], None]) -> None:
    """Do something when the tasks have been submitted, before the traffic exists."""

    def record(*args: Any) -> Any:
        action()
        return record_period(*args)

    monkeypatch.setattr(traffic_split, "_record_period", record)


def test_scene_needs_no_stage_that_reads_traffic() -> None:
    assert tasks.stages_without_traffic() == ("statics", "scan")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("keep", "casts"),
    [("false", "egvs.stages.site_scoring.SiteScoring.all_sites"), ("true", "egvs.sensors.scanner.Scanner.scan_site")],
)
def test_run_uses_prepared_scene_and_gives_same_bytes(
    jobs: list[Job], keep: str, casts: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The traffic does not exist yet when the scene is prepared."""
    overrides = (*OVERRIDES, f"scan.keep={keep}")
    job = Job("c", jobs[2].folder, jobs[2].out, overrides)
    traffic = job.folder / "fcd.csv"
    traffic.rename(tmp_path / "fcd.csv")
    settings = scheduler.make_run_settings()
    prepared = tasks.prepare_scene(job, settings)
    assert isinstance(prepared, SceneResult)
    works = [tasks.SCENE_CHECK] if keep == "true" else [tasks.SCENE_CHECK, tasks.EARLY_SCANS]
    assert list(prepared.costs) == works
    assert not job.out.exists()

    (tmp_path / "fcd.csv").rename(traffic)
    with monkeypatch.context() as patch:
        patch.setattr(static_world, "build_world", None)
        patch.setattr(casts, None)
        (done,) = tasks.run_junctions([job], settings)
    assert isinstance(done, JobResult)
    run_separately(job, tmp_path / "separate", monkeypatch)
    assert_same_run(job, tmp_path / "separate")


@pytest.mark.slow
def test_changed_scene_is_prepared_again(jobs: list[Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the user had edited files while the traffic was simulated."""
    job, settings = Job("a", jobs[0].folder, jobs[0].out, ("scan.keep=false",)), scheduler.make_run_settings()
    tasks.prepare_scene(job, settings)
    sites = job.folder / "sites.csv"
    sites.write_text(sites.read_text() + "pole_new,13.25,-11,3.5\n")
    (done,) = tasks.run_junctions([job], settings)
    assert isinstance(done, JobResult)
    assert done.sites == 3
    run_separately(job, tmp_path / "separate", monkeypatch)
    assert_same_run(job, tmp_path / "separate")


@pytest.mark.slow
def test_large_scans_are_not_stored(jobs: list[Job], store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = Job("a", jobs[0].folder, jobs[0].out, ("scan.keep=false",))
    monkeypatch.setattr(scheduler, "_room_for_scans", lambda *_: 100.0)
    prepared = tasks.prepare_scene(job, scheduler.make_run_settings())
    assert isinstance(prepared, SceneResult)
    assert list(prepared.costs) == [tasks.SCENE_CHECK]
    assert not [path for path in store.rglob("scans.parquet")]


def test_no_room_for_scans_in_shared_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert 0 < scheduler.make_run_settings(23).scan_bytes <= (10e9 - 23 * 40e6) / 23
    monkeypatch.setenv("EGVS_STORE", f"file://{tmp_path}/shared")
    assert scheduler.make_run_settings(23).scan_bytes == 0


@pytest.mark.slow
def test_error_in_scene_is_reported_by_run(jobs: list[Job]) -> None:
    job, settings = jobs[1], scheduler.make_run_settings()
    sites = job.folder / "sites.csv"
    sites.write_text(sites.read_text() + "below,13.25,-11,-5\n")
    prepared = tasks.prepare_scene(job, settings)
    assert isinstance(prepared, SceneResult)
    assert list(prepared.costs) == [tasks.SCENE_CHECK]
    (failure,) = tasks.run_junctions([job], settings)
    assert isinstance(failure, tasks.JobFailure)
    assert "below" in failure.message


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
def test_scenes_are_prepared_before_traffic_is_recorded(
    city: City, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    folders: list[bool] = []

    def wait_for_scans() -> None:
        wait_until(lambda: len(list(store.glob("scan-*/scans.parquet"))) == 2)
        folders.append((out / results.RUNS_FOLDER).exists())

    before_recording(monkeypatch, wait_for_scans)
    ran = city_run.run_city(city, out)
    assert folders == [False]
    assert tasks.SCENE_CHECK in {stage.stage for stage in ran.costs.stages}
    parts = {part.part: part for part in ran.costs.parts}
    beside, traffic = parts[costs.SCENES_STEP], parts[costs.TRAFFIC_PART]
    assert traffic.start_s <= beside.start_s < beside.end_s <= traffic.end_s
    assert beside.within == costs.TRAFFIC_PART
    for job in city_jobs(city, out):
        run_separately(job, tmp_path / "separate" / job.junction, monkeypatch)
        assert_same_run(job, tmp_path / "separate" / job.junction)


_started: list[str] = []
_is_running, _release = threading.Event(), threading.Event()


def wait_for_release(job: Job, _settings: object) -> None:
    """Take the place of a task."""
    _started.append(job.junction)
    _is_running.set()
    _release.wait(60)


def count_tasks(dask_worker: Any) -> int:
    """Return the number of tasks of this test that run on a worker or wait there; called by Dask on each worker."""
    return sum(str(key).startswith("wait_for_release") for key in dask_worker.state.tasks)


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
def test_failed_simulation_cancels_tasks_and_leaves_nothing(
    city: City, client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One worker may work beside SUMO: the second task is waiting when the simulation fails."""

    def tasks_at_workers() -> int:
        return sum(client.run(count_tasks).values())

    def fail() -> None:
        _is_running.wait(60)
        wait_until(lambda: tasks_at_workers() == 2)
        raise RunError("SUMO has failed")

    monkeypatch.setattr(tasks, "prepare_scene", wait_for_release)
    monkeypatch.setattr(scheduler, "thread_count", lambda _: 2)
    before_recording(monkeypatch, fail)
    try:
        with pytest.raises(RunError, match="SUMO has failed"):
            city_run.run_city(city, tmp_path / "out")
        wait_until(lambda: tasks_at_workers() == 1)  # workers hear of it later
    finally:
        _release.set()
    assert client.submit(len, _started, pure=False, workers=[*client.scheduler_info()["workers"]]).result() == 1
    assert not [path for path in (tmp_path / "out").rglob("*") if path.name != ".lock"]
    assert not (city.folder / "traffic" / traffic_split.RECORD_FILE).exists()


@pytest.mark.slow
def test_worker_killed_beside_simulation_changes_no_byte(
    city: City, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill_worker() -> None:
        for pid in workers():
            os.kill(pid, signal.SIGKILL)

    before_recording(monkeypatch, kill_worker)
    city_run.run_city(city, tmp_path / "out", CityRunOptions(cluster="processes=1"))
    for job in city_jobs(city, tmp_path / "out"):
        run_separately(job, tmp_path / "separate" / job.junction, monkeypatch)
        assert_same_run(job, tmp_path / "separate" / job.junction)


@pytest.mark.parametrize(
    ("hosts", "cores", "expected"),
    [
        ({"a": "here", "b": "here"}, 2, ["a"]),
        ({"a": "here"}, 1, ["a"]),
        ({"a": "here", "b": "here", "c": "here"}, 8, ["a", "b", "c"]),
        ({"a": "here", "b": "there"}, 1, ["b"]),
        ({"a": "here", "b": "there"}, 2, ["b", "a"]),
    ],
)
def test_one_core_is_left_for_sumo(hosts: dict[str, str], cores: int, expected: list[str]) -> None:
    assert scheduler.workers_beside_sumo(hosts, "here", cores) == expected
