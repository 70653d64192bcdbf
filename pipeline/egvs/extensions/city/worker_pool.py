"""The workers that may run the tasks of a city: each is asked when it connects, before it gets tasks.

A worker with another program, or without the folders of the run, answers wrongly and quickly, and would so take tasks
from all others. Therefore every task requires a Dask resource whose name is unique to the run. A worker receives this
resource when nothing is wrong with it (:mod:`egvs.extensions.city.worker_check`). All others stay connected, get no
tasks and are named in a message. A thread looks for new workers, so that those that join later, or restart, are asked
too.
"""

from __future__ import annotations

import asyncio
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future as ConcurrentFuture
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egvs.core.errors import EgvsError, InputError, RunError
from egvs.core.wording import by_number, list_first
from egvs.extensions.city import worker_check
from egvs.extensions.city.worker_check import Problem, Requirements
from egvs.runs.store import RemoteStore

if TYPE_CHECKING:
    from distributed import Client, Scheduler, Worker

POLL_INTERVAL_S = 0.5
"""How often the scheduler is asked for new workers."""

ANSWER_TIMEOUT_S = 20.0
"""A worker that does not answer in this time gets no tasks. The first answer includes importing the program."""

ASK_AGAIN_S = 10.0
"""A rejected worker is asked again after this time: a disk may have been mounted, or files removed."""

FIRST_ANSWER_S = 3.0
"""How long a run waits for all connected workers to answer before it starts with those that have answered."""

NO_WORKER_S = 5.0
"""If no worker is connected for this time, a message says that the run waits."""

FIRST_WORKER_S, MAX_WAIT_S = 8.0, 60.0
"""A run whose only workers are rejected ones ends after this time: before its first task, and later."""

_STALE_TOKEN_S = 86_400.0
"""Token files of killed programs are removed after this time."""

_UNLIMITED = 1e9
"""Amount of the resource: it never limits the number of tasks of a worker."""

_CALL_HINT = "Check the worker's log, and install the same version of egvs on every machine."


def print_to_stderr(message: str) -> None:
    """Print a message for the user."""
    print(f"egvs: {message}", file=sys.stderr)


def connected_workers(client: Client) -> dict[str, dict[str, Any]]:
    """Return what the scheduler knows of each connected worker, by address.

    ``Client.scheduler_info`` sometimes returns no workers, because a periodic callback of the client asks for none.
    """
    assert client.scheduler is not None
    workers: dict[str, dict[str, Any]] = client.sync(client.scheduler.identity, n_workers=-1)["workers"]
    return workers


@dataclass
class _WorkerState:
    """A connected worker.

    Attributes
    ----------
    threads
        Number of tasks that it runs at a time.
    host
        Name of its machine; empty before it has answered.
    answer
        The question that is being asked, or None.
    problems
        What is wrong with it; None before it has answered.
    answered_s
        Time of the last answer.
    reported
        The problems that the user knows.
    """

    threads: int
    host: str = ""
    answer: ConcurrentFuture[tuple[str, list[Problem]]] | None = None
    problems: list[Problem] | None = None
    answered_s: float = 0.0
    reported: list[Problem] = field(default_factory=list)

    @property
    def is_accepted(self) -> bool:
        return self.problems == []


class WorkerPool:
    """The workers of a cluster that may run the tasks of one run.

    Parameters
    ----------
    client
        Client of the cluster.
    requirements
        What every worker must have.
    on_message
        Called with messages about workers that get no tasks, also from another thread.
    """

    def __init__(
        self, client: Client, requirements: Requirements, on_message: Callable[[str], None] = print_to_stderr
    ) -> None:
        self._client, self._requirements, self._on_message = client, requirements, on_message
        self._workers: dict[str, _WorkerState] = {}
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._error: Exception | None = None
        self._last_accepted_s = time.monotonic()
        self._thread = threading.Thread(target=self._watch, name="workers", daemon=True)

    @property
    def resources(self) -> dict[str, float]:
        """Resources that every task must require."""
        return {self._resource: 1}

    @property
    def _resource(self) -> str:
        return f"egvs-{self._requirements.token}"

    def thread_count(self) -> int:
        """Return the number of tasks that all accepted workers run at a time, at least 1."""
        with self._lock:
            return max(1, sum(worker.threads for worker in self._workers.values() if worker.is_accepted))

    def accepted(self) -> dict[str, str]:
        """Return the hosts of all accepted workers, by address."""
        with self._lock:
            return {address: worker.host for address, worker in self._workers.items() if worker.is_accepted}

    @contextmanager
    def watched(self, on_wait: Callable[[], None] = lambda: None) -> Iterator[WorkerPool]:
        """Wait until a worker is accepted; ask workers that join within the block.

        Parameters
        ----------
        on_wait
            Called again and again while this waits; it may raise an error.

        Raises
        ------
        InputError
            When no connected worker is acceptable, or the scheduler lacks the program.
        """
        with ExitStack() as stack:
            stack.enter_context(_token_files(self._requirements))
            self._check_scheduler()
            self._thread.start()
            stack.callback(self._stop_watching)
            self._wait_for_first(on_wait)
            yield self

    def check(self) -> None:
        """Raise an InputError if for long only rejected workers have been connected."""
        self._check_watching()
        with self._lock:
            rejected = self._rejected()
            if self._has_accepted() or not rejected:
                self._last_accepted_s = time.monotonic()
                return
        if time.monotonic() - self._last_accepted_s > MAX_WAIT_S:
            raise self._no_worker_error(rejected)

    # ---- before the first task

    def _check_scheduler(self) -> None:
        """Raise an InputError if the scheduler cannot import the program: it has to read the tasks."""
        try:
            self._client.run_on_scheduler(worker_check.program_versions, ())
        except (ImportError, AttributeError) as error:
            where = f"the scheduler at {self._client.scheduler.address}"
            raise InputError(
                where, f"cannot import egvs ({error})", "Install egvs there, and restart the scheduler."
            ) from None

    def _wait_for_first(self, on_wait: Callable[[], None]) -> None:
        from distributed.comm import CommClosedError

        start_s = only_rejected_s = time.monotonic()
        is_reported = False
        while True:
            now_s = time.monotonic()
            with self._lock:
                has_accepted, rejected, n_workers = self._has_accepted(), self._rejected(), len(self._workers)
                has_all_answers = all(worker.problems is not None for worker in self._workers.values())
            if has_accepted and (has_all_answers or now_s - start_s > FIRST_ANSWER_S):
                return
            if not rejected or not has_all_answers:
                only_rejected_s = now_s
            if now_s - only_rejected_s > FIRST_WORKER_S:
                raise self._no_worker_error(rejected)
            if not n_workers and now_s - start_s > NO_WORKER_S and not is_reported:
                self._on_message("no worker is connected to the scheduler; the run waits for one")
                is_reported = True
            if self._client.status in ("closing", "closed"):
                raise CommClosedError("the scheduler was lost")
            self._check_watching()
            on_wait()
            time.sleep(0.05)

    def _no_worker_error(self, rejected: dict[str, _WorkerState]) -> InputError:
        lines = _describe_rejected(rejected)
        return InputError("--cluster", "no connected worker can run this city\n" + "\n".join(lines))

    def _check_watching(self) -> None:
        """Raise a RunError if the thread that asks workers has failed: no further worker would get tasks."""
        if self._error is not None:
            raise RunError(
                f"the check of workers failed ({type(self._error).__name__}: {self._error}). Start the run again"
            ) from self._error

    # ---- the thread that watches

    def _watch(self) -> None:
        try:
            while not self._stop.is_set():
                with suppress(OSError):  # a lost scheduler is reported where results are awaited
                    self._update()
                self._stop.wait(POLL_INTERVAL_S)
        except Exception as error:  # noqa: BLE001 - the thread of the run raises it
            if self._client.status not in ("closing", "closed"):
                self._error = error

    def _update(self) -> None:
        """Ask new workers, and report those that were rejected."""
        connected = connected_workers(self._client)
        with self._lock:
            for address in [address for address in self._workers if address not in connected]:
                del self._workers[address]
            for address, described in connected.items():
                worker = self._workers.setdefault(address, _WorkerState(int(described["nthreads"])))
                self._collect_answer(worker)
                if self._is_due(worker):
                    worker.answer = asyncio.run_coroutine_threadsafe(self._ask(address), self._client.loop.asyncio_loop)
            messages = self._unreported_changes()
        for message in messages:
            self._on_message(message)

    @staticmethod
    def _is_due(worker: _WorkerState) -> bool:
        if worker.answer is not None or worker.is_accepted:
            return False
        return worker.problems is None or time.monotonic() - worker.answered_s > ASK_AGAIN_S

    @staticmethod
    def _collect_answer(worker: _WorkerState) -> None:
        if worker.answer is None or not worker.answer.done():
            return
        error = worker.answer.exception()
        if error is None:
            worker.host, worker.problems = worker.answer.result()
        elif isinstance(error, TimeoutError):
            worker.problems = [Problem(f"no answer within {ANSWER_TIMEOUT_S:.0f} s", _CALL_HINT)]
        elif isinstance(error, OSError):  # it is about to be removed from the list, or will be asked again
            worker.problems = None
        else:
            worker.problems = [Problem(f"the check failed ({type(error).__name__}: {error})", _CALL_HINT)]
        worker.answer, worker.answered_s = None, time.monotonic()

    async def _ask(self, address: str) -> tuple[str, list[Problem]]:
        """Ask a worker, and let it run tasks if nothing is wrong; return its host and its problems."""
        required = self._requirements
        call: Any = self._client.run(  # a coroutine: this runs in the event loop of the client
            worker_check.describe_worker, required.token_name, required.token, required.folders, required.writable,
            required.libraries, required.store_url, workers=[address], on_error="return",
        )  # fmt: skip
        answer = (await asyncio.wait_for(call, ANSWER_TIMEOUT_S))[address]
        if isinstance(answer, Exception):
            raise answer
        problems = worker_check.find_problems(answer, required)
        if not problems:
            await self._client.run(_add_resource, self._resource, workers=[address])
            await self._client.run_on_scheduler(_assign_waiting_tasks)
        return answer["host"], problems

    def _stop_watching(self) -> None:
        self._stop.set()
        self._thread.join(timeout=2.0)

    # ---- the caller of these has the lock

    def _has_accepted(self) -> bool:
        return any(worker.is_accepted for worker in self._workers.values())

    def _rejected(self) -> dict[str, _WorkerState]:
        return {address: worker for address, worker in self._workers.items() if worker.problems}

    def _unreported_changes(self) -> list[str]:
        new = {address: worker for address, worker in self._rejected().items() if worker.problems != worker.reported}
        repaired = [address for address, worker in self._workers.items() if worker.is_accepted and worker.reported]
        for address in (*new, *repaired):
            self._workers[address].reported = list(self._workers[address].problems or ())
        return [*_describe_rejected(new), *(f"worker {address} gets tasks from now on" for address in repaired)]


def _describe_rejected(workers: dict[str, _WorkerState]) -> list[str]:
    """Return one line for all workers with the same problems."""
    by_problems: dict[tuple[Problem, ...], list[str]] = {}
    for address, worker in workers.items():
        name = f"{address} ({worker.host})" if worker.host else address
        by_problems.setdefault(tuple(worker.problems or ()), []).append(name)
    lines = []
    for problems, names in by_problems.items():
        noun, verb = by_number(len(names), "worker", "workers"), by_number(len(names), "gets", "get")
        shown = list_first(names, 3)
        hints = " ".join(dict.fromkeys(problem.hint for problem in problems))
        lines.append(f"{noun} {shown} {verb} no tasks: {'; '.join(problem.text for problem in problems)}. {hints}")
    return lines


async def _add_resource(name: str, dask_worker: Worker) -> None:
    """Let a worker run the tasks that require a resource."""
    await dask_worker.set_resources(**{name: _UNLIMITED})


def _assign_waiting_tasks(dask_scheduler: Scheduler) -> None:
    """Assign tasks that no worker could run; Dask does this for a new worker, not for one with a new resource.

    These methods of the scheduler are internal ones: Dask has no public call for this.
    """
    for worker in list(dask_scheduler.running):
        tasks = dask_scheduler.bulk_schedule_unrunnable_after_adding_worker(worker)
        dask_scheduler.transitions(tasks, stimulus_id=f"egvs-{time.time()}")


@contextmanager
def _token_files(requirements: Requirements) -> Iterator[None]:
    """Write the token files; remove them at the end."""
    name, token = requirements.token_name, requirements.token
    with ExitStack() as stack:
        for folder in requirements.folders:
            _remove_stale_tokens(Path(folder))
            path = Path(folder, name)
            path.write_text(token, encoding="utf-8")
            stack.callback(path.unlink, missing_ok=True)
        if requirements.store_url is not None:
            remote = RemoteStore(requirements.store_url)
            remote.write_file(name, token.encode())
            stack.callback(_remove_remote_token, remote, name)
        yield


def _remove_remote_token(remote: RemoteStore, name: str) -> None:
    with suppress(EgvsError):
        remote.remove_file(name)


def _remove_stale_tokens(folder: Path) -> None:
    for path in folder.glob(f"{worker_check.TOKEN_PREFIX}*"):
        with suppress(OSError):
            if time.time() - path.stat().st_mtime > _STALE_TOKEN_S:
                path.unlink()


def writable_folders(folders: Sequence[Path]) -> list[str]:
    """Return the folders in which this program can write files, as absolute paths; they are created if necessary."""
    names = []
    for folder in folders:
        probe = folder / f"{worker_check.TOKEN_PREFIX}probe"
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            probe.write_text("", encoding="utf-8")
            probe.unlink()
            names.append(str(folder.absolute()))
    return names
