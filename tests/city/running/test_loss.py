"""A worker that is killed costs time, and no byte; and a process may run cities one after another."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from pipeline.city.running import clusters, running
from pipeline.city.running.jobs import Done, Job
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
