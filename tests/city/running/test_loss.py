"""A worker that is killed costs time, and no byte; and a process may run cities one after another."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import suppress
from pathlib import Path

import pytest

from benchmarks.city import workers
from pipeline.city.running import clusters, running
from pipeline.city.running.jobs import Done, Job
from pipeline.core.errors import RunError
from tests.city.running.test_running import alone, assert_same

pytestmark = pytest.mark.slow


def test_a_killed_worker_costs_no_byte(jobs: list[Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    killed: list[int] = []

    def kill(done: Done) -> None:
        """End the only worker once the first junctions are done."""
        if not killed:
            killed.extend(client.run(os.getpid).values())
            os.kill(killed[0], signal.SIGKILL)

    monkeypatch.setattr("pipeline.city.running.graph.LEAST_BEAMS", 1)
    monkeypatch.setattr("pipeline.city.running.graph.MOST_BEAMS", 4096)  # every junction is cut
    with clusters.connected("processes=1") as client:
        running.run(client, jobs, heard=kill)
    assert killed
    for job in jobs:
        alone(job, tmp_path / f"alone {job.junction}", monkeypatch)
        assert_same(job, tmp_path / f"alone {job.junction}")
    again: list[Done] = []
    with clusters.connected("processes=1") as client:
        running.run(client, jobs, heard=again.append)
    assert [its.made for its in again] == [()] * 3


def test_a_worker_that_dask_does_not_start_again_is_replaced(jobs: list[Job], monkeypatch: pytest.MonkeyPatch) -> None:
    """As where it is killed a second time before it is quite there."""

    async def fails() -> None:
        raise RuntimeError("the process ended before it was there")

    monkeypatch.setattr(clusters, "LOOK_S", 0.5)
    monkeypatch.setattr(clusters, "_GONE_S", 8.0)
    done: list[Done] = []
    with clusters.connected("processes=1") as client:
        (nanny,) = client.cluster.workers.values()
        monkeypatch.setattr(nanny, "instantiate", fails)
        (killed,) = workers()
        os.kill(killed, signal.SIGKILL)
        running.run(client, jobs, heard=done.append)
        assert killed not in workers()
    assert len(done) == 3


def test_workers_that_never_start_are_told(jobs: list[Job], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clusters, "LOOK_S", 0.2)
    monkeypatch.setattr(clusters, "_GONE_S", 1.0)
    ended = threading.Event()

    def kill() -> None:
        while not ended.wait(0.05):
            for pid in workers():
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)

    with clusters.connected("processes=1") as client:
        killer = threading.Thread(target=kill)
        killer.start()
        try:
            with pytest.raises(RunError, match="ended as soon as they were started"):
                running.run(client, jobs)
        finally:
            ended.set()
            killer.join()
