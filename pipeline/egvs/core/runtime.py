"""The running process: time and memory of a block, threads, progress callbacks, and SUMO's location.

:func:`measure_usage` measures wall seconds, processor seconds and peak memory. Linux can reset the peak; elsewhere it
is the highest so far. :func:`map_ordered` spreads work over threads; results come back in the order of the work, and
only a few are in memory at once.
"""

from __future__ import annotations

import ctypes
import gc
import importlib.util
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from egvs.core import platform
from egvs.core.errors import MissingBackendError

_PROC_STATUS, _PROC_CLEAR_REFS = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@dataclass
class ResourceUsage:
    """Time and memory of a block; filled when it ends."""

    seconds: float = 0.0
    busy_s: float = 0.0
    """Processor seconds of this process and of the child processes that it waited for (SUMO)."""
    peak_mb: float = 0.0
    held_mb: float = 0.0
    """Memory of the process when the block began; on other systems than Linux, the highest until then."""

    def to_json(self) -> dict[str, Any]:
        """The form in a run's record, rounded to the precision of such a measurement."""
        return {"seconds": round(self.seconds, 3), "peak_mb": round(self.peak_mb, 1)}


@contextmanager
def measure_usage() -> Iterator[ResourceUsage]:
    """Measure a block; the yielded object is filled at its end."""
    usage, resettable = ResourceUsage(), _reset_peak()
    usage.held_mb = _status_mb("VmRSS:") if resettable else platform.peak_memory_mb()
    start, busy = time.perf_counter(), _cpu_seconds()
    try:
        yield usage
    finally:
        usage.seconds = time.perf_counter() - start
        usage.busy_s = _cpu_seconds() - busy
        usage.peak_mb = _status_mb("VmHWM:") if resettable else platform.peak_memory_mb()


def release_memory() -> None:
    """Return unused memory to the system, so that the next measured peak is that of its own block."""
    gc.collect(1)  # a full collection would take 50 ms
    if (arrow := sys.modules.get("pyarrow")) is not None:
        arrow.default_memory_pool().release_unused()
    if sys.platform.startswith("linux") and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        trim(0)  # glibc's


def _cpu_seconds() -> float:
    return sum(os.times()[:4])


def _reset_peak() -> bool:
    try:
        _PROC_CLEAR_REFS.write_text("5")
    except OSError:
        return False
    return True


def _status_mb(name: str) -> float:
    line = next(line for line in _PROC_STATUS.read_text().splitlines() if line.startswith(name))
    return int(line.split()[1]) / 1024


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


ProgressCallback = Callable[[str, int, int], None]
"""Called with (what is counted, number done, total) during the work, from any thread."""


def no_progress(_what: str, _done: int, _total: int) -> None:
    """A :data:`ProgressCallback` that shows nothing."""


def sumo_home() -> Path:
    """Return SUMO's folder: the environment variable SUMO_HOME, else the installed package."""
    if home := os.environ.get("SUMO_HOME"):
        return Path(home)
    spec = importlib.util.find_spec("sumo")
    if spec is None or not spec.submodule_search_locations:
        raise MissingBackendError("SUMO is not installed: set SUMO_HOME, or pip install eclipse-sumo")
    return Path(spec.submodule_search_locations[0])
