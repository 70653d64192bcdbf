"""One graph of Dask's for a whole city: large junctions are cut, small ones are joined."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from pipeline.city.running import tasks
from pipeline.city.running.jobs import Job, Order

if TYPE_CHECKING:
    from dask.delayed import Delayed

LEAST_BEAMS, MOST_BEAMS = 2**24, 2**25
"""Beams of a task: 2**24 take some ten seconds, beside which what a task costs by itself does not count."""

ROUNDS = 4
"""So many tasks for each worker, where they are large enough."""

EMPTY_BEAMS = 2**21
"""What a junction's other stages take, as beams."""


def beams_a_task(beams: Mapping[str, int], workers: int) -> int:
    """How much work is put into one task; a power of two, so that a run that goes on mostly cuts as it did before."""
    wanted = sum(beams.values()) // max(1, ROUNDS * workers)
    return int(min(MOST_BEAMS, max(LEAST_BEAMS, 1 << max(0, wanted.bit_length() - 1))))


def parts_of(beams: int, most: int) -> int:
    """Into how many parts a junction's sites are cut; 1 where it is run whole."""
    return 1 if beams <= most else -(-beams // most)


def joined(jobs: Sequence[Job], beams: Mapping[str, int], most: int) -> Iterator[tuple[Job, ...]]:
    """Small junctions, some of them together, in their order."""
    group: list[Job] = []
    filled = 0
    for job in jobs:
        its = beams[job.junction] + EMPTY_BEAMS
        if group and filled + its > most:
            yield tuple(group)
            group, filled = [], 0
        group.append(job)
        filled += its
    if group:
        yield tuple(group)


def build(jobs: Sequence[Job], beams: Mapping[str, int], order: Order, workers: int) -> dict[Delayed, tuple[Job, ...]]:
    """The ends of the graph, each with the junctions that it answers for as a list of Done or Failed.

    Parameters
    ----------
    beams
        Of each junction, see :func:`pipeline.city.running.tasks.beams`.
    """
    from dask import delayed

    most = beams_a_task(beams, workers)
    small = [job for job in jobs if parts_of(beams[job.junction], most) == 1]
    ends: dict[Delayed, tuple[Job, ...]] = {}
    for job in jobs:
        if (count := parts_of(beams[job.junction], most)) > 1:
            name = f"{job.junction}-{order.token}"
            prepared = delayed(tasks.prepare, pure=False)(job, order, dask_key_name=f"prepare-{name}")
            scored = [
                delayed(tasks.score_part, pure=False)(
                    job, order, (number, count), prepared, dask_key_name=f"score-{name}-{number}"
                )
                for number in range(count)
            ]
            ends[delayed(tasks.finish, pure=False)(job, order, scored, dask_key_name=f"finish-{name}")] = (job,)
    for group in joined(small, beams, most):
        name = f"{group[0].junction}-{order.token}"
        ends[delayed(tasks.run_whole, pure=False)(group, order, dask_key_name=f"run-{name}")] = group
    return ends
