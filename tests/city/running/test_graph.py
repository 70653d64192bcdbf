"""How a city is cut into tasks: large junctions are cut, small ones joined, and nothing is lost or done twice."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.city import scheduler, tasks
from egvs.city.scheduler import check_cluster
from egvs.city.tasks import Job, RunSettings
from egvs.core.errors import InputError

ORDER = RunSettings("token", "program", "/store", 1e9)


def jobs(count: int) -> list[Job]:
    return [Job(f"j{i}", Path(f"/city/j{i}"), Path(f"/out/j{i}")) for i in range(count)]


@given(st.integers(0, 5000), st.integers(1, 300))
def test_parts_are_all_sites_once_and_alike(count: int, number: int) -> None:
    cut = tasks.split_sites(count, number)
    assert [i for part in cut for i in range(count)[part]] == list(range(count))
    sizes = [part.stop - part.start for part in cut]
    assert max(sizes) - min(sizes) <= 1


@given(st.lists(st.integers(1, 2**28), min_size=1, max_size=60), st.integers(1, 64))
def test_every_junction_is_in_one_end(beams: list[int], workers: int) -> None:
    every = jobs(len(beams))
    of = {job.junction: its for job, its in zip(every, beams, strict=True)}
    ends = scheduler.build_graph(every, of, ORDER, workers)
    assert sorted(job.junction for group in ends.values() for job in group) == sorted(of)


def test_a_large_junction_is_cut_and_small_ones_are_joined() -> None:
    every, m = jobs(5), 2**21
    beams = dict(zip((job.junction for job in every), (m, 100 * m, m, m, 9 * m), strict=True))
    assert scheduler.beams_per_task(beams, 2) == 8 * m  # an eighth of 112 million, as a power of two
    assert scheduler.part_count(beams["j1"], 8 * m) == 13
    small = [every[i] for i in (0, 2, 3)]  # 2 m each, with what a junction takes by itself
    assert [[job.junction for job in group] for group in scheduler.join_jobs(small, beams, 5 * m)] == [
        ["j0", "j2"],
        ["j3"],
    ]
    ends = scheduler.build_graph(every, beams, ORDER, 2)
    tasks = {end.key.split("-")[0] for end in ends}
    assert tasks == {"finish", "run"}


@pytest.mark.parametrize(("workers", "task"), [(1, 2**25), (2, 2**25), (8, 2**25), (100, 2**24)])
def test_tasks_are_neither_tiny_nor_endless(workers: int, task: int) -> None:
    assert scheduler.beams_per_task({"a": 2**31}, workers) == task
    assert scheduler.beams_per_task({"a": 1}, workers) == scheduler.LEAST_BEAMS


@pytest.mark.parametrize(
    "where", ["", "lokal", "processes=0", "processes=two", "processes=5000", "tcp://", "host:8786"]
)
def test_what_is_no_cluster_is_refused(where: str) -> None:
    with pytest.raises(InputError, match=r"local, processes=N .1 to 1000., or the address of a scheduler"):
        check_cluster(where)


@pytest.mark.parametrize("where", ["local", "processes=2", "tcp://host:8786", "tls://host:8786"])
def test_what_is_a_cluster_is_taken(where: str) -> None:
    check_cluster(where)
