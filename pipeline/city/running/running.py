"""Runs the junctions of a city on a cluster: sizes them, builds one graph, and waits for its ends.

Nothing here decides what comes out: tasks bring stages up to date as ``egvs run`` does, each from the store where it is
there. So a run that was broken off, wherever, goes on when it is started again.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from pipeline.city.running import clusters, graph, tasks
from pipeline.city.running.jobs import Done, Failed, Job, Order, program
from pipeline.core.errors import EgvsError, InputError, RunError
from pipeline.core.progress import Progress, silent
from pipeline.runs import store_settings
from pipeline.runs.remote import Remote

if TYPE_CHECKING:
    from distributed import Client, Future

T = TypeVar("T")

Heard = Callable[[Done], None]
"""Called with each junction as it is done."""


def run(
    client: Client,
    jobs: Sequence[Job],
    order: Order | None = None,
    *,
    heard: Heard = lambda _: None,
    progress: Progress = silent,
) -> None:
    """Run junctions, each into its own folder; ``order`` is :func:`give_order`'s, asked for here when None.

    Raises
    ------
    EgvsError
        Where junctions cannot be run, with what each of them says; all others are done by then.
    RunError
        Where the cluster is lost, or a worker is ended again and again.
    """
    order = order or give_order()
    sizes = dict(each(client, tasks.beams, jobs, order))
    beams = {job.junction: size for job, size in sizes.items() if isinstance(size, int)}
    failed = [its for its in sizes.values() if isinstance(its, Failed)]
    sound = [job for job in jobs if job.junction in beams]
    progress("junctions", 0, len(jobs))
    done = 0
    with _watched(client):
        ends = graph.build(sound, beams, order, _workers(client))
        futures = client.compute(list(ends))
        names = {future.key: group for future, group in zip(futures, ends.values(), strict=True)}
        for future in _finished(client, futures):
            for its in _result(future, [job.junction for job in names[future.key]]):
                done += 1
                progress("junctions", done, len(jobs))
                if isinstance(its, Failed):
                    failed.append(its)
                else:
                    heard(its)
    tell(failed, len(jobs))


def each(
    client: Client, task: Callable[..., T], jobs: Iterable[Job], order: Order, *more: Any
) -> Iterator[tuple[Job, T]]:
    """One task a junction, its answers as they come."""
    with _watched(client):
        of = {client.submit(task, job, order, *more, pure=False): job for job in jobs}
        for future in _finished(client, list(of)):
            yield of[future], _result(future, [of[future].junction])


def give_order() -> Order:
    """What holds for all tasks: this program, and the store; InputError where there is none, or it is out of reach."""
    place, most_bytes = store_settings.read()
    if place is None:
        found = "empty, so that there is no store: what workers make for one another is kept there"
        raise InputError(store_settings.PLACE, found, "a folder that all workers see")
    if (url := store_settings.remote_url()) is not None:
        Remote(url).check()
    return Order(uuid.uuid4().hex[:8], program(), url or str(place.absolute()), most_bytes)


def tell(failed: Sequence[Failed], junctions: int) -> None:
    """EgvsError where there are any: all that they say, the exit code of wrong input where any is."""
    if not failed:
        return
    alike: dict[str, list[str]] = {}
    for its in failed:
        alike.setdefault(its.message, []).append(its.junction)
    lines = [f"junction{'s' * (len(names) > 1)} {', '.join(names)}: {what}" for what, names in alike.items()]
    if len(failed) < junctions:
        lines.append(f"{len(failed)} of {junctions} junctions failed; the others are done")
    error = EgvsError("\n".join(lines))
    error.exit_code = max(its.exit_code for its in failed)
    raise error


def _workers(client: Client) -> int:
    threads: dict[str, int] = client.nthreads()
    return max(1, sum(threads.values()))


def _finished(client: Client, futures: list[Future]) -> Iterator[Future]:
    """Futures as they are done, while there are workers; see :class:`pipeline.city.running.clusters.Crew`."""
    from distributed import wait

    left, crew = list(futures), clusters.Crew(client)
    while left:
        crew.look()
        try:
            with client.as_current():
                done = wait(left, timeout=clusters.LOOK_S, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            continue
        crew.works()
        yield from (future for future in left if future in done)
        left = [future for future in left if future not in done]


def _result(future: Future, junctions: Sequence[str]) -> Any:
    """What a task answered; RunError where workers ended in it again and again."""
    from distributed import KilledWorker

    try:
        return future.result()
    except KilledWorker as error:
        where = ", ".join(junctions)
        attempts = getattr(error, "allowed_failures", 0) + 1
        found = f"a worker was ended {attempts} times at this, mostly for want of memory"
        cure = "fewer processes, a machine with more memory, larger voxels or a smaller region; what is done is kept"
        raise RunError(f"junction {where}: {found}; {cure}") from None


@contextmanager
def _watched(client: Client) -> Iterator[None]:
    """RunError where the scheduler is lost within the block."""
    from concurrent.futures import CancelledError

    from distributed.comm import CommClosedError

    address = client.scheduler.address if client.scheduler is not None else "?"
    try:
        yield
    except (CancelledError, CommClosedError, TimeoutError):
        found = f"the scheduler at {address} was lost"
        raise RunError(f"{found}; run the same command again to go on from what is done") from None
