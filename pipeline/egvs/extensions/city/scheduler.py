"""Run the junctions of a city on a Dask cluster: processes of this machine, or the workers of a running scheduler.

:class:`SceneTasks` prepare the scenes of junctions while their traffic is simulated.

Steps of :func:`run_jobs`: ask the workers (:mod:`egvs.extensions.city.worker_pool`); estimate the work of each
junction; build one graph of tasks, in which large junctions are split and small ones are grouped; wait for the results,
and replace local processes that are lost.

Dask decides only where and when a task runs. Tasks bring stages up to date as ``egvs run`` does and use the store, so
an interrupted run continues where it stopped.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import socket
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from egvs.core import plugins
from egvs.core.errors import EgvsError, InputError, RunError
from egvs.core.main_guard import check_main_guard
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.threads import thread_count
from egvs.core.wording import by_number
from egvs.extensions.city import tasks
from egvs.extensions.city.tasks import Job, JobFailure, JobResult, Part, RunSettings, SceneResult, program_id
from egvs.extensions.city.worker_check import Requirements, library_names
from egvs.extensions.city.worker_pool import WorkerPool, connected_workers, print_to_stderr, writable_folders
from egvs.runs import store
from egvs.runs.store import RemoteStore, Store

if TYPE_CHECKING:
    from dask.delayed import Delayed
    from distributed import Client, Future

T = TypeVar("T")

DoneCallback = Callable[[JobResult], None]
"""Called with each junction when its run is complete."""

LOCAL_CLUSTER = "local"
ADDRESS_PREFIXES = ("tcp://", "tls://")

MIN_TASK_BEAMS, MAX_TASK_BEAMS = 2**20, 2**25
"""Limits of the work of a task. 2**20 beams take one to two seconds, about three times as long as loading the scene."""

TASKS_PER_WORKER = 4
"""Number of tasks per worker, if they are large enough."""

JUNCTION_BEAMS = 2**21
"""Work of the other stages of a junction, in beams."""

TYPICAL_JUNCTION_BYTES, STORE_BYTES_PER_JUNCTION = 40e6, 100e6
"""Results of a junction with 108 candidates and 5,000 frames, and space in the store for each junction by default."""

CHECK_INTERVAL_S = 5.0
"""How often a run that waits for results checks the processes of this machine."""

_MAX_ABSENCE_S, _MAX_REPLACEMENTS = 60.0, 3
"""A process that is missing for longer is replaced, at most this often without any result in between."""

_MAX_PROCESSES = 1000

# With Dask's own thresholds of malloc, every larger array returns to the system at once, and its pages are requested
# again at each site. This takes a third of a worker's time and saves no memory.
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


@contextmanager
def connect(cluster: str, *, memory_limit: str = "auto") -> Iterator[Client]:
    """Connect to a cluster, which is started if it is one of this machine.

    Parameters
    ----------
    cluster
        ``local`` (one process per core), ``processes=N``, or the address of a scheduler such as ``tcp://host:8786``.
    memory_limit
        Of each local process, as Dask writes it; a process that exceeds it is killed. By default its share of the
        machine's memory.

    Raises
    ------
    InputError
        When the text is none of these, or no scheduler answers.
    MissingExtraError
        When Dask is not installed.
    """
    check_cluster(cluster)
    count = _process_count(cluster)
    import dask
    from distributed import Client, LocalCluster  # before the settings: the import adds settings that must stay

    with dask.config.set(_DASK_SETTINGS):
        for name in _LOGGERS:  # the run reports errors itself
            logging.getLogger(name).setLevel(logging.CRITICAL)
        if count is None:
            try:
                client = Client(cluster, timeout="20s", set_as_default=False)
            except (OSError, ValueError) as error:
                hint = "Give the address of a running Dask scheduler."
                raise InputError(f"--cluster {cluster}", f"no scheduler answers ({error})", hint) from None
            with client:
                yield client
            return
        check_main_guard()
        with (
            LocalCluster(
                n_workers=count, threads_per_worker=1, processes=True, host="127.0.0.1", memory_limit=memory_limit,
                dashboard_address="127.0.0.1:0",
            ) as local_cluster,
            Client(local_cluster, set_as_default=False) as client,
        ):  # fmt: skip
            yield client


def check_cluster(cluster: str) -> None:
    """Raise an InputError for an invalid name of a cluster, or a MissingExtraError if Dask is not installed."""
    _process_count(cluster)
    plugins.require_libraries("a city run", "cluster", "dask", "distributed", "fsspec")


def _process_count(cluster: str) -> int | None:
    """Return the number of local processes; None for the address of a scheduler."""
    if cluster == LOCAL_CLUSTER:
        return thread_count(None)
    if cluster.startswith(ADDRESS_PREFIXES) and len(cluster) > len(ADDRESS_PREFIXES[0]):
        return None
    match = re.fullmatch(r"processes=([0-9]{1,4})", cluster)
    if match is None or not 1 <= int(match[1]) <= _MAX_PROCESSES:
        expected = f"local, processes=N (1 to {_MAX_PROCESSES}), or the address of a scheduler"
        problem = f"expected {expected}, got {repr(cluster)[:80]}"
        raise InputError("--cluster", problem, "Use an address such as tcp://host:8786.")
    return int(match[1])


class LocalWorkers:
    """The worker processes of a cluster on this machine; other clusters are ignored.

    Dask restarts a process that was killed, but not if it is killed again while it starts. Its tasks would then wait
    for ever.

    Parameters
    ----------
    client
        Client of the cluster.
    """

    def __init__(self, client: Client) -> None:
        self._client, self._replacements = client, 0
        self._last_check = self._last_complete = time.monotonic()

    def note_progress(self) -> None:
        """Record that a task has finished."""
        self._replacements = 0

    def replace_lost(self) -> None:
        """Replace processes that are missing for long; raise a RunError if that did not help.

        The processes are checked every :data:`CHECK_INTERVAL_S` at most.
        """
        cluster, now = self._client.cluster, time.monotonic()
        if cluster is None or now - self._last_check < CHECK_INTERVAL_S:
            return
        self._last_check = now
        running = {worker["name"] for worker in connected_workers(self._client).values()}
        missing = [name for name in cluster.worker_spec if name not in running]
        if not missing:
            self._last_complete = now
            return
        if now - self._last_complete <= _MAX_ABSENCE_S:
            return
        if self._replacements == _MAX_REPLACEMENTS:
            raise RunError(
                f"{len(missing)} worker processes died at start-up, usually for lack of memory. "
                "Use fewer processes; finished results are kept."
            )
        self._last_complete = now
        self._replacements += 1
        count = len(cluster.worker_spec)
        for name in missing:
            del cluster.worker_spec[name]
        cluster.scale(count)


def beams_per_task(beams: Mapping[str, int], workers: int) -> int:
    """Return the work of one task, in beams.

    It is a power of two, so that an interrupted run, or one with some more sites, is usually split in the same way.

    Parameters
    ----------
    beams
        Work of each junction, see :func:`egvs.extensions.city.tasks.estimate_beams`.
    workers
        Number of workers.
    """
    total = sum(beams.values()) + JUNCTION_BEAMS * len(beams)
    target = total // max(1, TASKS_PER_WORKER * workers)
    power_of_two = 1 << max(0, target.bit_length() - 1)
    return int(min(MAX_TASK_BEAMS, max(MIN_TASK_BEAMS, power_of_two)))


def part_count(beams: int, max_beams: int) -> int:
    """Return the number of parts into which the sites of a junction are split, with at most ``max_beams`` of work."""
    return max(1, -(-beams // max_beams))


def group_jobs(jobs: Sequence[Job], beams: Mapping[str, int], max_beams: int) -> Iterator[tuple[Job, ...]]:
    """Yield groups of small junctions, in order, with at most ``max_beams`` of work if there are several."""
    group: list[Job] = []
    group_beams = 0
    for job in jobs:
        job_beams = beams[job.junction] + JUNCTION_BEAMS
        if group and group_beams + job_beams > max_beams:
            yield tuple(group)
            group, group_beams = [], 0
        group.append(job)
        group_beams += job_beams
    if group:
        yield tuple(group)


def build_graph(
    jobs: Sequence[Job], beams: Mapping[str, int], settings: RunSettings, workers: int
) -> dict[Delayed, tuple[Job, ...]]:
    """Build the graph of tasks.

    Parameters
    ----------
    jobs
        The junctions.
    beams
        Work of each junction, see :func:`egvs.extensions.city.tasks.estimate_beams`.
    settings
        Settings of the city run.
    workers
        Number of workers.

    Returns
    -------
    dict
        The last tasks of the graph, each with the junctions of its results.
    """
    max_beams = beams_per_task(beams, workers)
    small_jobs = []
    graph: dict[Delayed, tuple[Job, ...]] = {}
    for job in jobs:
        n_parts = part_count(beams[job.junction], max_beams)
        if n_parts > 1:
            graph[_split_job(job, settings, n_parts)] = (job,)
        else:
            small_jobs.append(job)
    for group in group_jobs(small_jobs, beams, max_beams):
        name = f"run-{group[0].junction}-{settings.token}"
        graph[_delay(tasks.run_junctions, name, group, settings)] = group
    return graph


def _split_job(job: Job, settings: RunSettings, n_parts: int) -> Delayed:
    name = f"{job.junction}-{settings.token}"
    prepared = _delay(tasks.prepare_junction, f"prepare-{name}", job, settings)
    scored = []
    for number in range(n_parts):
        part = Part(number, n_parts)
        scored.append(_delay(tasks.score_part, f"score-{name}-{number}", job, settings, part, prepared))
    return _delay(tasks.finish_junction, f"finish-{name}", job, settings, scored)


def _delay(task: Callable[..., Any], name: str, *args: Any) -> Delayed:
    from dask import delayed

    return delayed(task, pure=False)(*args, dask_key_name=name)


@dataclass(frozen=True)
class Cluster:
    """A cluster whose workers were asked, and the settings of the tasks that they run; see :func:`checked_workers`."""

    client: Client
    settings: RunSettings
    workers: WorkerPool


@contextmanager
def checked_workers(
    client: Client,
    folders: Sequence[Path],
    n_junctions: int,
    on_message: Callable[[str], None] = print_to_stderr,
) -> Iterator[Cluster]:
    """Ask all workers whether they can run a city; ask those that join within the block before they get tasks.

    Parameters
    ----------
    client
        Client of the cluster.
    folders
        Folders that workers must see: those that tasks read, and last the one in which they write.
    n_junctions
        Number of junctions, for the size of the store.
    on_message
        Called with messages for the user, e.g. about workers that get no tasks; also from another thread.

    Raises
    ------
    InputError
        When no connected worker is acceptable.
    """
    settings = make_run_settings(n_junctions)
    url = store.remote_url()
    store_folder = store.default_folder() if url is not None else Path(settings.store)
    for message in expected_size_messages(store_folder, settings.store_bytes, n_junctions):
        on_message(message)
    shared_folders = writable_folders([*folders, store_folder] if url is None else folders)
    out = str(folders[-1].absolute())
    requirements = Requirements(settings.token, tuple(shared_folders), out, library_names(), url)
    pool = WorkerPool(client, requirements, on_message)
    with store.entries_in_use(store_folder, settings.token), ExitStack() as stack:
        with _watch_scheduler(client):
            stack.enter_context(pool.watched(LocalWorkers(client).replace_lost))
        yield Cluster(client, settings, pool)
        for message in store_size_messages(store_folder, settings.store_bytes):
            on_message(message)


def job_folders(jobs: Sequence[Job]) -> list[Path]:
    """Return the folder that contains the scenarios of all jobs, and the one that contains their runs."""
    inputs = os.path.commonpath([job.folder.parent for job in jobs])
    outputs = os.path.commonpath([job.out.parent for job in jobs])
    return [Path(inputs), Path(outputs)]


def run_jobs(
    client: Client,
    jobs: Sequence[Job],
    *,
    on_done: DoneCallback = lambda _: None,
    progress: ProgressCallback = no_progress,
    cluster: Cluster | None = None,
) -> None:
    """Run junctions, each into its own folder.

    Parameters
    ----------
    client
        Client of the cluster.
    jobs
        The junctions.
    on_done, progress
        Called with each junction when its run is complete, and with the number of finished junctions.
    cluster
        From :func:`checked_workers`, which is called when None.

    Raises
    ------
    EgvsError
        When junctions failed, with their messages; all others are complete by then.
    RunError
        When the scheduler is lost, or workers are killed again and again.
    """
    if cluster is None:
        with checked_workers(client, job_folders(jobs), len(jobs)) as checked:
            run_jobs(client, jobs, on_done=on_done, progress=progress, cluster=checked)
        return

    settings = cluster.settings
    beams: dict[str, int] = {}
    failures: list[JobFailure] = []
    for job, result in map_junctions(cluster, tasks.estimate_beams, jobs):
        if isinstance(result, JobFailure):
            failures.append(result)
        else:
            beams[job.junction] = result

    n_done = 0
    progress("junctions", n_done, len(jobs))
    with _watch_scheduler(client):
        n_workers = cluster.workers.thread_count()
        graph = build_graph([job for job in jobs if job.junction in beams], beams, settings, n_workers)
        futures = client.compute(list(graph), resources=cluster.workers.resources)
        group_of_key = {future.key: group for future, group in zip(futures, graph.values(), strict=True)}
        for future in _as_finished(cluster, futures):
            for result in _task_result(future, [job.junction for job in group_of_key[future.key]]):
                n_done += 1
                progress("junctions", n_done, len(jobs))
                if isinstance(result, JobFailure):
                    failures.append(result)
                else:
                    on_done(result)
    raise_failures(failures, len(jobs))


def map_junctions(cluster: Cluster, task: Callable[..., T], jobs: Iterable[Job], *args: Any) -> Iterator[tuple[Job, T]]:
    """Run one task per junction; yield the results in the order in which they finish.

    Parameters
    ----------
    cluster
        From :func:`checked_workers`.
    task
        Called with a job, the settings of the city run, and ``args``.
    jobs
        The junctions.
    """
    client, resources = cluster.client, cluster.workers.resources
    with _watch_scheduler(client):
        jobs_by_future = {}
        for job in jobs:
            future = client.submit(task, job, cluster.settings, *args, pure=False, resources=resources)
            jobs_by_future[future] = job
        for future in _as_finished(cluster, list(jobs_by_future)):
            job = jobs_by_future[future]
            yield job, _task_result(future, [job.junction])


class SceneTasks:
    """Tasks that prepare the scenes of junctions while this program simulates their traffic, see :meth:`start`.

    At the end of the block, tasks that have not ended are cancelled: the runs of their junctions do the work.

    Parameters
    ----------
    cluster
        From :func:`checked_workers`.
    jobs
        The junctions.

    Attributes
    ----------
    start_s, end_s
        When the tasks were submitted, and when the last one ended (:func:`time.perf_counter`).
    """

    def __init__(self, cluster: Cluster, jobs: Sequence[Job]) -> None:
        self._cluster, self._jobs = cluster, jobs
        self._futures: list[Future] = []
        self.start_s = self.end_s = time.perf_counter()

    def __enter__(self) -> SceneTasks:
        return self

    def start(self) -> None:
        """Submit the tasks; some workers get none, so that a core is left for SUMO."""
        client, pool = self._cluster.client, self._cluster.workers
        addresses = workers_beside_sumo(pool.accepted(), socket.gethostname(), thread_count(None))
        self.start_s = self.end_s = time.perf_counter()
        with _watch_scheduler(client):
            for job in self._jobs:
                future = client.submit(
                    tasks.prepare_scene, job, self._cluster.settings,
                    pure=False, resources=pool.resources, workers=addresses,
                )  # fmt: skip
                future.add_done_callback(self._note_end)
                self._futures.append(future)

    def results(self) -> list[SceneResult]:
        """Return the results of the tasks that have ended; a failed one is repeated in the run of its junction."""
        with _watch_scheduler(self._cluster.client):
            results = [future.result() for future in self._futures if future.status == "finished"]
        return [result for result in results if isinstance(result, SceneResult)]

    def _note_end(self, future: Future) -> None:
        if future.status == "finished":
            self.end_s = time.perf_counter()

    def __exit__(self, *_error: object) -> None:
        unfinished = [future for future in self._futures if not future.done()]
        with suppress(OSError, TimeoutError):  # a lost scheduler is reported where results are awaited
            self._cluster.client.cancel(unfinished)


def workers_beside_sumo(hosts: Mapping[str, str], sumo_host: str, cores: int) -> list[str]:
    """Return the workers that may work while SUMO runs: on its host one fewer than there are cores, and all others.

    Parameters
    ----------
    hosts
        Host of each worker, by address.
    sumo_host
        Host on which SUMO runs.
    cores
        Number of its cores.
    """
    beside = [address for address, host in hosts.items() if host == sumo_host]
    elsewhere = [address for address in hosts if address not in beside]
    n_beside = cores - 1
    if not elsewhere:
        n_beside = max(1, n_beside)
    return [*elsewhere, *beside[:n_beside]]


def make_run_settings(n_junctions: int = 1) -> RunSettings:
    """Return settings for a new city run.

    The largest size of the store grows with the city, unless ``EGVS_STORE_MAX_GB`` is set.

    Raises
    ------
    InputError
        When there is no store, or it cannot be reached.
    """
    folder, max_bytes = store.read_store_settings()
    if folder is None:
        problem = "is empty, so there is no store; a city run needs one to pass results between workers"
        raise InputError(store.STORE_VARIABLE, problem, "Set it to a folder that all workers can access.")
    url = store.remote_url()
    if url is not None:
        RemoteStore(url).check()
    if store.MAX_GB_VARIABLE not in os.environ:
        max_bytes = max(max_bytes, n_junctions * STORE_BYTES_PER_JUNCTION)
    scan_bytes = 0.0
    if url is None:  # to send scans to a shared store and back takes longer than to repeat them
        scan_bytes = _room_for_scans(folder, max_bytes, n_junctions) / n_junctions
    return RunSettings(uuid.uuid4().hex[:8], program_id(), url or str(folder.absolute()), max_bytes, scan_bytes)


def _room_for_scans(folder: Path, max_bytes: float, n_junctions: int) -> float:
    """Return the part of the store that the results of a city leave, at most half of the free disk."""
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    free_bytes = shutil.disk_usage(existing).free
    return max(0.0, min(max_bytes - n_junctions * TYPICAL_JUNCTION_BYTES, free_bytes / 2))


def expected_size_messages(folder: Path, max_bytes: float, n_junctions: int) -> Iterator[str]:
    """Yield a message if the results of a city will probably exceed the store or the disk.

    Parameters
    ----------
    folder
        Folder of the store.
    max_bytes
        Largest size of the store.
    n_junctions
        Number of junctions.
    """
    expected_bytes = n_junctions * TYPICAL_JUNCTION_BYTES
    expected = f"the results of {n_junctions:,} junctions take about {expected_bytes / 1e9:.3g} GB"
    if expected_bytes > max_bytes:
        limit = f"more than the limit of {max_bytes / 1e9:.3g} GB"
        yield f"{store.MAX_GB_VARIABLE}: {expected}, {limit}. Try {2 * expected_bytes / 1e9:.2g}."
    with suppress(OSError):
        free_bytes = shutil.disk_usage(folder).free + Store(folder).usage_bytes()
        if expected_bytes > free_bytes:
            yield f"{folder}: {expected}, and {free_bytes / 1e9:.3g} GB are available. Use a larger disk."


def store_size_messages(folder: Path, max_bytes: float) -> Iterator[str]:
    """Yield a message if the entries that a city run uses exceed the largest size of the store.

    Parameters
    ----------
    folder
        Folder of the store.
    max_bytes
        Largest size of the store.
    """
    used_bytes = Store(folder).usage_bytes()
    if used_bytes > max_bytes:
        used_gb, max_gb = used_bytes / 1e9, max_bytes / 1e9
        yield (
            f"{store.MAX_GB_VARIABLE}: expected results of at most {max_gb:.3g} GB in {folder}, got {used_gb:.3g} GB. "
            f"All were kept for this city; a later run removes some. Try {1.2 * used_gb:.2g}."
        )


def raise_failures(failures: Sequence[JobFailure], n_junctions: int) -> None:
    """Raise an EgvsError with all messages, each text once, if any of ``n_junctions`` junctions failed."""
    if not failures:
        return
    junctions_by_message: dict[str, list[str]] = {}
    for failure in failures:
        junctions_by_message.setdefault(failure.message, []).append(failure.junction)
    lines = []
    for message, names in junctions_by_message.items():
        noun = by_number(len(names), "junction", "junctions")
        lines.append(f"{noun} {', '.join(names)}: {message}")
    if len(failures) < n_junctions:
        lines.append(f"{len(failures)} of {n_junctions} junctions failed; the others are done")
    error = EgvsError("\n".join(lines))
    error.exit_code = max(failure.exit_code for failure in failures)  # wrong input wins
    raise error


def _as_finished(cluster: Cluster, futures: list[Future]) -> Iterator[Future]:
    """Yield futures in the order in which they finish; replace local workers that are lost meanwhile."""
    from distributed import wait

    remaining, workers = list(futures), LocalWorkers(cluster.client)
    while remaining:
        workers.replace_lost()
        cluster.workers.check()
        try:
            with cluster.client.as_current():
                done = wait(remaining, timeout=CHECK_INTERVAL_S, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            continue
        workers.note_progress()
        yield from (future for future in remaining if future in done)
        remaining = [future for future in remaining if future not in done]


def _task_result(future: Future, junctions: Sequence[str]) -> Any:
    """Return the result of a task; raise a RunError if workers were killed again and again while running it."""
    from distributed import KilledWorker

    try:
        return future.result()
    except KilledWorker as error:
        attempts = getattr(error, "allowed_failures", 0) + 1
        raise RunError(
            f"junction {', '.join(junctions)}: a worker was killed {attempts} times, usually for lack of memory. "
            "Use fewer processes, more memory, larger voxels or a smaller region; finished results are kept."
        ) from None


@contextmanager
def _watch_scheduler(client: Client) -> Iterator[None]:
    """Raise a RunError if the scheduler is lost within the block."""
    from concurrent.futures import CancelledError

    from distributed.comm import CommClosedError

    address = client.scheduler.address if client.scheduler is not None else "?"
    try:
        yield
    except (CancelledError, CommClosedError, TimeoutError):
        message = f"the connection to the scheduler at {address} was lost. Run the same command again to continue."
        raise RunError(message) from None
