"""Dask cluster, task graph, waiting for results.

Where tasks run: processes of this machine, or a cluster whose scheduler is named; all of it is Dask's.

One graph of Dask's for a whole city: large junctions are cut, small ones are joined.

Runs the junctions of a city on a cluster: sizes them, builds one graph, and waits for its ends.

Nothing here decides what comes out: tasks bring stages up to date as ``egvs run`` does, each from the store where it is
there. So a run that was broken off, wherever, goes on when it is started again.
"""

from __future__ import annotations

import logging
import re
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from egvs.city import tasks
from egvs.city.tasks import Job, JobFailure, JobResult, RunSettings, program_id
from egvs.core import plugins, runtime
from egvs.core.errors import EgvsError, InputError, RunError
from egvs.core.runtime import ProgressCallback, no_progress
from egvs.runs import store
from egvs.runs.store import RemoteStore

if TYPE_CHECKING:
    from dask.delayed import Delayed
    from distributed import Client, Future


LOCAL_CLUSTER = "local"
ADDRESSES = ("tcp://", "tls://")

# malloc's thresholds: by Dask's own, every larger array goes back to the system at once, and its pages are asked for
# anew at each site, which takes a third of a worker's time and no less memory.
_DASK_SETTINGS = {
    "distributed.scheduler.allowed-failures": 5,
    "distributed.worker.daemon": True,
    "distributed.worker.profile.enabled": False,
    "distributed.nanny.pre-spawn-environ.DASK_LOGGING__DISTRIBUTED": "critical",
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 2**25,
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 2**27,
    "distributed.comm.timeouts.connect": "20s",
}

_LOGGERS = ("distributed", "distributed.client", "tornado.application")
"""Loggers that have levels of their own."""

_MAX_PROCESSES = 1000
"""Processes on one machine."""

LOOK_S = 5.0
"""So often a run that hears nothing looks after the processes of this machine."""

_GONE_S, _MOST_TIMES = 60.0, 3
"""A process that is away for so long is replaced; so often, while nothing is done."""


@contextmanager
def connect(where: str, *, memory_limit: str = "auto") -> Iterator[Client]:
    """A client of the cluster that ``--cluster`` names.

    Parameters
    ----------
    where
        ``local``: a process a core of this machine; ``processes=N``; or the address of a scheduler, ``tcp://host:8786``.
    memory_limit
        Of a process on this machine, as Dask writes it; a process that takes more is ended. Its share of the machine's
        memory by default.

    Raises
    ------
    InputError
        For a word that is none of these, or where no scheduler answers.
    MissingExtraError
        Where Dask is not installed.
    """
    check_cluster(where)
    count = _process_count(where)
    import dask
    from distributed import Client, LocalCluster  # before the settings: what it adds to them is to stay

    with dask.config.set(_DASK_SETTINGS):
        for name in _LOGGERS:  # what goes wrong is told by the run
            logging.getLogger(name).setLevel(logging.CRITICAL)
        if count is None:
            try:
                client = Client(where, timeout="20s", set_as_default=False)
            except (OSError, ValueError) as error:
                right = "the address of a running dask scheduler"
                raise InputError(f"--cluster {where}", f"no scheduler answers there ({error})", right) from None
            with client:
                yield client
            return
        with (
            LocalCluster(
                n_workers=count, threads_per_worker=1, processes=True, host="127.0.0.1", memory_limit=memory_limit,
                dashboard_address="127.0.0.1:0",
            ) as cluster,
            Client(cluster, set_as_default=False) as client,
        ):  # fmt: skip
            yield client


class LocalWorkers:
    """The processes of a cluster on this machine: Dask starts one again that was ended, but not when it is ended while
    it starts; then nobody would do its work, and the run would wait for ever. Of another cluster nothing is asked.

    Parameters
    ----------
    client
        Of the cluster.
    """

    def __init__(self, client: Client) -> None:
        self._client, self._times = client, 0
        self._last_check = self._last_complete = time.monotonic()

    def note_progress(self) -> None:
        """Something was done."""
        self._times = 0

    def replace_lost(self) -> None:
        """Replace processes that are away for long, if it is time to look; RunError where that was of no use."""
        cluster, now = self._client.cluster, time.monotonic()
        if cluster is None or now - self._last_check < LOOK_S:
            return
        self._last_check = now
        there = {its["name"] for its in self._client.scheduler_info(n_workers=-1)["workers"].values()}
        gone = [name for name in cluster.worker_spec if name not in there]
        if not gone:
            self._last_complete = now
        elif now - self._last_complete > _GONE_S:
            if self._times == _MOST_TIMES:
                found = f"{len(gone)} processes of this machine ended as soon as they were started"
                raise RunError(f"{found}; mostly memory is wanting: fewer processes; what is done is kept")
            self._last_complete, self._times = now, self._times + 1
            count = len(cluster.worker_spec)
            for name in gone:
                del cluster.worker_spec[name]
            cluster.scale(count)


def check_cluster(where: str) -> None:
    """InputError for a word that names no cluster; MissingExtraError where Dask is not installed."""
    _process_count(where)
    plugins.require_libraries("a city run", "cluster", "dask", "distributed", "fsspec")


def _process_count(where: str) -> int | None:
    """How many processes on this machine; None for the address of a scheduler."""
    if where == LOCAL_CLUSTER:
        return runtime.thread_count(None)
    if where.startswith(ADDRESSES) and len(where) > len(ADDRESSES[0]):
        return None
    match = re.fullmatch(r"processes=([0-9]{1,4})", where)
    if match is None or not 1 <= int(match[1]) <= _MAX_PROCESSES:
        right = (
            f"local, processes=N (1 to {_MAX_PROCESSES}), or the address of a scheduler, for example tcp://host:8786"
        )
        raise InputError("--cluster", repr(where)[:80], right)
    return int(match[1])


LEAST_BEAMS, MOST_BEAMS = 2**24, 2**25
"""Beams of a task: 2**24 take some ten seconds, beside which what a task costs by itself does not count."""

TASKS_PER_WORKER = 4
"""So many tasks for each worker, where they are large enough."""

EMPTY_BEAMS = 2**21
"""What a junction's other stages take, as beams."""


def beams_per_task(beams: Mapping[str, int], workers: int) -> int:
    """How much work is put into one task; a power of two, so that a run that goes on mostly cuts as it did before."""
    wanted = sum(beams.values()) // max(1, TASKS_PER_WORKER * workers)
    return int(min(MOST_BEAMS, max(LEAST_BEAMS, 1 << max(0, wanted.bit_length() - 1))))


def part_count(beams: int, most: int) -> int:
    """Into how many parts a junction's sites are cut; 1 where it is run whole."""
    return 1 if beams <= most else -(-beams // most)


def join_jobs(jobs: Sequence[Job], beams: Mapping[str, int], most: int) -> Iterator[tuple[Job, ...]]:
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


def build_graph(
    jobs: Sequence[Job], beams: Mapping[str, int], settings: RunSettings, workers: int
) -> dict[Delayed, tuple[Job, ...]]:
    """The ends of the graph, each with the junctions that it answers for as a list of Done or Failed.

    Parameters
    ----------
    beams
        Of each junction, see :func:`egvs.city.tasks.estimate_beams`.
    """
    from dask import delayed

    most = beams_per_task(beams, workers)
    small = [job for job in jobs if part_count(beams[job.junction], most) == 1]
    ends: dict[Delayed, tuple[Job, ...]] = {}
    for job in jobs:
        if (count := part_count(beams[job.junction], most)) > 1:
            name = f"{job.junction}-{settings.token}"
            prepared = delayed(tasks.prepare_junction, pure=False)(job, settings, dask_key_name=f"prepare-{name}")
            scored = [
                delayed(tasks.score_part, pure=False)(
                    job, settings, (number, count), prepared, dask_key_name=f"score-{name}-{number}"
                )
                for number in range(count)
            ]
            ends[delayed(tasks.finish_junction, pure=False)(job, settings, scored, dask_key_name=f"finish-{name}")] = (
                job,
            )
    for group in join_jobs(small, beams, most):
        name = f"{group[0].junction}-{settings.token}"
        ends[delayed(tasks.run_junctions, pure=False)(group, settings, dask_key_name=f"run-{name}")] = group
    return ends


T = TypeVar("T")

DoneCallback = Callable[[JobResult], None]
"""Called with each junction as it is done."""


def run_jobs(
    client: Client,
    jobs: Sequence[Job],
    settings: RunSettings | None = None,
    *,
    on_done: DoneCallback = lambda _: None,
    progress: ProgressCallback = no_progress,
) -> None:
    """Run junctions, each into its own folder; ``settings`` is :func:`make_run_settings`'s, asked for here when None.

    Raises
    ------
    EgvsError
        Where junctions cannot be run, with what each of them says; all others are done by then.
    RunError
        Where the cluster is lost, or a worker is ended again and again.
    """
    settings = settings or make_run_settings()
    sizes = dict(map_junctions(client, tasks.estimate_beams, jobs, settings))
    beams = {job.junction: size for job, size in sizes.items() if isinstance(size, int)}
    failed = [its for its in sizes.values() if isinstance(its, JobFailure)]
    sound = [job for job in jobs if job.junction in beams]
    progress("junctions", 0, len(jobs))
    done = 0
    with _watch_scheduler(client):
        ends = build_graph(sound, beams, settings, _worker_count(client))
        futures = client.compute(list(ends))
        names = {future.key: group for future, group in zip(futures, ends.values(), strict=True)}
        for future in _as_finished(client, futures):
            for its in _task_result(future, [job.junction for job in names[future.key]]):
                done += 1
                progress("junctions", done, len(jobs))
                if isinstance(its, JobFailure):
                    failed.append(its)
                else:
                    on_done(its)
    raise_failures(failed, len(jobs))


def map_junctions(
    client: Client, task: Callable[..., T], jobs: Iterable[Job], settings: RunSettings, *more: Any
) -> Iterator[tuple[Job, T]]:
    """One task a junction, its answers as they come."""
    with _watch_scheduler(client):
        of = {client.submit(task, job, settings, *more, pure=False): job for job in jobs}
        for future in _as_finished(client, list(of)):
            yield of[future], _task_result(future, [of[future].junction])


def make_run_settings() -> RunSettings:
    """What holds for all tasks: this program, and the store; InputError where there is none, or it is out of reach."""
    place, most_bytes = store.read_store_settings()
    if place is None:
        found = "empty, so that there is no store: what workers make for one another is kept there"
        raise InputError(store.STORE_VARIABLE, found, "a folder that all workers see")
    if (url := store.remote_url()) is not None:
        RemoteStore(url).check()
    return RunSettings(uuid.uuid4().hex[:8], program_id(), url or str(place.absolute()), most_bytes)


def raise_failures(failed: Sequence[JobFailure], junctions: int) -> None:
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


def _worker_count(client: Client) -> int:
    threads: dict[str, int] = client.nthreads()
    return max(1, sum(threads.values()))


def _as_finished(client: Client, futures: list[Future]) -> Iterator[Future]:
    """Futures as they are done, while there are workers; see :class:`egvs.city.scheduler.LocalWorkers`."""
    from distributed import wait

    left, crew = list(futures), LocalWorkers(client)
    while left:
        crew.replace_lost()
        try:
            with client.as_current():
                done = wait(left, timeout=LOOK_S, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            continue
        crew.note_progress()
        yield from (future for future in left if future in done)
        left = [future for future in left if future not in done]


def _task_result(future: Future, junctions: Sequence[str]) -> Any:
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
def _watch_scheduler(client: Client) -> Iterator[None]:
    """RunError where the scheduler is lost within the block."""
    from concurrent.futures import CancelledError

    from distributed.comm import CommClosedError

    address = client.scheduler.address if client.scheduler is not None else "?"
    try:
        yield
    except (CancelledError, CommClosedError, TimeoutError):
        found = f"the scheduler at {address} was lost"
        raise RunError(f"{found}; run the same command again to go on from what is done") from None
