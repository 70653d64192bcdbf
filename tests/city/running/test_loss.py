"""A worker that is killed costs time, and no byte; and a process may run cities one after another."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import suppress
from pathlib import Path

import pytest
from benchmarks.city import workers

from egvs.city import scheduler
from egvs.city.tasks import Job, JobResult
from egvs.core.errors import RunError
from tests.city.running.test_running import alone, assert_same

pytestmark = pytest.mark.slow


def test_a_killed_worker_costs_no_byte(jobs: list[Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    killed: list[int] = []

    def kill(done: JobResult) -> None:
        """End the only worker once the first junctions are done."""
        if not killed:
            killed.extend(client.run(os.getpid).values())
            os.kill(killed[0], signal.SIGKILL)

    monkeypatch.setattr("egvs.city.scheduler.LEAST_BEAMS", 1)
    monkeypatch.setattr("egvs.city.scheduler.MOST_BEAMS", 4096)  # every junction is cut
    with scheduler.connect("processes=1") as client:
        scheduler.run_jobs(client, jobs, on_done=kill)
    assert killed
    for job in jobs:
        alone(job, tmp_path / f"alone {job.junction}", monkeypatch)
        assert_same(job, tmp_path / f"alone {job.junction}")
    again: list[JobResult] = []
    with scheduler.connect("processes=1") as client:
        scheduler.run_jobs(client, jobs, on_done=again.append)
    assert [its.made for its in again] == [()] * 3


def test_a_worker_that_dask_does_not_start_again_is_replaced(jobs: list[Job], monkeypatch: pytest.MonkeyPatch) -> None:
    """As where it is killed a second time before it is quite there."""

    async def fails() -> None:
        raise RuntimeError("the process ended before it was there")

    monkeypatch.setattr(scheduler, "LOOK_S", 0.5)
    monkeypatch.setattr(scheduler, "_GONE_S", 8.0)
    done: list[JobResult] = []
    with scheduler.connect("processes=1") as client:
        (nanny,) = client.cluster.workers.values()
        monkeypatch.setattr(nanny, "instantiate", fails)
        (killed,) = workers()
        os.kill(killed, signal.SIGKILL)
        scheduler.run_jobs(client, jobs, on_done=done.append)
        assert killed not in workers()
    assert len(done) == 3


def test_workers_that_never_start_are_told(jobs: list[Job], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduler, "LOOK_S", 0.2)
    monkeypatch.setattr(scheduler, "_GONE_S", 1.0)
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
            with pytest.raises(RunError, match="ended as soon as they were started"):
                scheduler.run_jobs(client, jobs)
        finally:
            ended.set()
            killer.join()
