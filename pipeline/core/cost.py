"""The cost of a piece of work: wall seconds, processor seconds, and the most memory that the process held meanwhile.

Linux lets that mark be reset; elsewhere it is the highest so far.
"""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@dataclass
class Cost:
    """Filled when the measured block ends."""

    seconds: float = 0.0
    busy_s: float = 0.0
    """Seconds that processors worked for this process and those that it waited for (SUMO), and for no other."""
    peak_mb: float = 0.0
    held_mb: float = 0.0
    """What the process held when the block began; elsewhere than on Linux, the highest until then."""

    def to_json(self) -> dict[str, Any]:
        """What a run's record says of it, rounded to what such a measurement is worth."""
        return {"seconds": round(self.seconds, 3), "peak_mb": round(self.peak_mb, 1)}


@contextmanager
def measured() -> Iterator[Cost]:
    """Measure the block; the yielded cost is filled at its end."""
    cost, resettable = Cost(), _reset()
    cost.held_mb = _status_mb("VmRSS:") if resettable else _peak_so_far_mb()
    start, busy = time.perf_counter(), _busy_s()
    try:
        yield cost
    finally:
        cost.seconds, cost.busy_s = time.perf_counter() - start, _busy_s() - busy
        cost.peak_mb = _status_mb("VmHWM:") if resettable else _peak_so_far_mb()


def let_go() -> None:
    """Give back memory that is kept for later, so that the peak of what follows, above what is held, is its own."""
    gc.collect(1)  # old objects are as old as the program: to look for garbage among them takes 50 ms
    if (arrow := sys.modules.get("pyarrow")) is not None:
        arrow.default_memory_pool().release_unused()
    if (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:  # glibc's
        trim(0)


def _busy_s() -> float:
    return sum(os.times()[:4])


def _reset() -> bool:
    try:
        _RESET.write_text("5")
    except OSError:
        return False
    return True


def _status_mb(name: str) -> float:
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(name))
    return int(line.split()[1]) / 1024


def _peak_so_far_mb() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024 * 1024 if sys.platform == "darwin" else 1024)
