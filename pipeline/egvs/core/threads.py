"""Threads: how many, work that is spread over them, and work that another thread may end.

:func:`map_ordered` returns results in the order of the work, and holds only a few in memory at once.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from threading import Event
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_ordered(work: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """Yield ``work(item)`` for each item in order, computed on ``threads`` threads; stops at the first error."""
    if threads == 1:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        running: deque[Future[Result]] = deque()
        try:
            for item in items:
                running.append(pool.submit(work, item))
                if len(running) > 2 * threads:
                    yield running.popleft().result()
            while running:
                yield running.popleft().result()
        finally:
            for future in running:
                future.cancel()


def thread_count(jobs: int | None) -> int:
    """Return ``jobs`` if it is set, else the number of cores that this process may use."""
    if jobs is not None:
        return max(1, jobs)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


_AT_CHECKPOINT: ContextVar[Callable[[], None] | None] = ContextVar("_AT_CHECKPOINT", default=None)


@contextmanager
def at_checkpoints(call: Callable[[], None]) -> Iterator[None]:
    """Call a function at each :func:`checkpoint` of the block; an error that it raises ends the work.

    Before it, what a block around this one calls is called.
    """
    outer = _AT_CHECKPOINT.get()

    def both() -> None:
        if outer is not None:
            outer()
        call()

    token = _AT_CHECKPOINT.set(both)
    try:
        yield
    finally:
        _AT_CHECKPOINT.reset(token)


def checkpoint() -> None:
    """Mark a moment at which this thread waits, and may be told to end."""
    call = _AT_CHECKPOINT.get()
    if call is not None:
        call()


@contextmanager
def run_in_thread(work: Callable[[], Result]) -> Iterator[Future[Result]]:
    """Run a function in a thread during the block; if it still runs then, it ends at its next :func:`checkpoint`."""
    is_over = Event()

    def check() -> None:
        if is_over.is_set():
            raise CancelledError

    def run() -> Result:
        with at_checkpoints(check):
            return work()

    with ThreadPoolExecutor(1, "block") as pool:
        try:
            yield pool.submit(copy_context().run, run)
        finally:
            is_over.set()
