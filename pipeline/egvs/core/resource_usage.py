"""Time and memory of a block of code: wall seconds, processor seconds, and peak memory.

Linux can reset the peak; elsewhere it is the highest so far. Blocks may overlap, also in several threads: processor
seconds and memory are those of the whole process meanwhile.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egvs.core import platform

_PROC_CLEAR_REFS = Path("/proc/self/clear_refs")

_peak_before_reset_mb = 0.0
"""Highest memory of this process before its peak was last reset."""

_unfinished: dict[int, ResourceUsage] = {}
"""The blocks that have not ended, by number: a peak that is reset for another block was theirs as well."""

_lock = threading.Lock()
"""Held while the peak is reset, and while :data:`_unfinished` changes."""


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
    usage = ResourceUsage()
    with _lock:
        resettable = _reset_peak()
        _unfinished[id(usage)] = usage
    usage.held_mb = _status_mb("VmRSS:") if resettable else platform.peak_memory_mb()
    start, busy = time.perf_counter(), _cpu_seconds()
    try:
        yield usage
    finally:
        usage.seconds = time.perf_counter() - start
        usage.busy_s = _cpu_seconds() - busy
        with _lock:
            del _unfinished[id(usage)]
            usage.peak_mb = max(usage.peak_mb, _status_mb("VmHWM:") if resettable else platform.peak_memory_mb())


def process_peak_mb() -> float:
    """Return the highest memory of this process since its start, in MB of 2**20 bytes."""
    now_mb = peak_memory_of(os.getpid()) or platform.peak_memory_mb()
    return max(_peak_before_reset_mb, now_mb)


def peak_memory_of(process: int) -> float | None:
    """Return the highest memory of a running process so far, in MB of 2**20 bytes; None where it is not known."""
    try:
        return _status_mb("VmHWM:", process)
    except (OSError, StopIteration):  # no Linux, or the process has just ended
        return None


def processor_seconds_of(process: int) -> float | None:
    """Return the processor time of a running process so far; None where it is not known.

    Source: proc(5), /proc/pid/stat: the name in parentheses may contain spaces; utime and stime are fields 14 and 15.
    """
    try:
        fields = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    except OSError:  # no Linux, or the process has just ended
        return None
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


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
    global _peak_before_reset_mb
    _peak_before_reset_mb = process_peak_mb()
    now_mb = peak_memory_of(os.getpid()) or platform.peak_memory_mb()
    for usage in _unfinished.values():
        usage.peak_mb = max(usage.peak_mb, now_mb)
    try:
        _PROC_CLEAR_REFS.write_text("5", encoding="utf-8")
    except OSError:
        return False
    return True


def _status_mb(name: str, process: int | str = "self") -> float:
    lines = Path(f"/proc/{process}/status").read_text(encoding="utf-8").splitlines()
    line = next(line for line in lines if line.startswith(name))
    return int(line.split()[1]) / 1024
