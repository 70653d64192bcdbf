"""What workers do, one function a kind of task. Each may run anywhere, any number of times, and gives the same bytes.

A small junction is run whole, some of them in one task. Of a large one the artefacts that sites are scored from are
made (:func:`prepare`), then its sites are scored in parts (:func:`score_part`), then its run is brought to its end
(:func:`finish`), which takes from the store what the others have put there, and makes what is missing. What a task
has left of memory, the next one gives back first: so a worker takes hardly more for many sites than for a few.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Any

from pipeline.city.running import parts
from pipeline.city.running.jobs import Done, Failed, Job, Order, told
from pipeline.city.running.keeping import KEPT
from pipeline.core.cost import let_go
from pipeline.runs import workflow
from pipeline.sensing import sensors, sites

_WAIT_S = 60.0
"""A worker that was killed, or was only taken for lost, may be at a junction for a moment more."""

SITE_BEAMS = 2**14
"""What a site takes beside its beams, as beams: few take less than adding up what all voxels are worth."""


@told
def beams(job: Job, order: Order) -> int:
    """The work of a junction's candidates: their beams, and as many more as a site by itself takes the time of."""
    with order.obeyed():
        scenario = job.scenario()
        candidates = sites.of(scenario)
        its = {name: sensors.of_scenario(name, scenario, "sites").beams for name in {s.sensor for s in candidates}}
        return sum(its[site.sensor] + SITE_BEAMS for site in candidates)


def run_whole(jobs: Sequence[Job], order: Order) -> list[Done | Failed]:
    """Run some junctions from beginning to end."""
    return [_run(job, order, {}) for job in jobs]


@told
def prepare(job: Job, order: Order) -> None:
    """Put into the store what sites are scored from."""
    with order.obeyed(), KEPT.lent(order.token, job) as built:
        built.bring()


@told
def score_part(job: Job, order: Order, part: tuple[int, int], prepared: Failed | None) -> int | Failed:
    """Score one of some parts of the sites, (number, of how many); how many sites that were."""
    if prepared is not None:
        return prepared
    let_go()
    with order.obeyed(), KEPT.lent(order.token, job) as built:
        scoring = built.ready()
        return parts.keep(scoring, built.score_key, parts.cut(len(scoring.names), part[1])[part[0]])


def finish(job: Job, order: Order, scored: Sequence[int | Failed]) -> Sequence[Done | Failed]:
    """The run of a junction whose sites were scored in parts."""
    failed = [its for its in scored if isinstance(its, Failed)]
    if failed:
        return failed[:1]
    KEPT.drop(order.token, job)
    return [_run(job, order, {"score": {"scored_elsewhere": parts.from_store(len(scored))}})]


@told
def _run(job: Job, order: Order, help_from: dict[str, dict[str, Any]]) -> Done:
    let_go()
    made: list[str] = []
    begin = perf_counter()
    with order.obeyed():
        record = workflow.run(
            job.scenario(), job.out, jobs=1, help_from=help_from, wait_s=_WAIT_S,
            listener=lambda stage, state, _: made.append(stage) if state == "done" else None,
        )  # fmt: skip
        return Done(job.junction, record.stages["score"].summary["sites"], perf_counter() - begin, tuple(made))
