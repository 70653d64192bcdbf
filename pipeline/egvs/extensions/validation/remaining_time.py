"""Estimate how long the rest of some work takes, from what the work has taken so far.

There is no estimate before units of the same kind were measured, nor while they differ by more than a factor of
:data:`MAX_RATIO`: a wrong estimate is worse than none. The first unit of each worker does not count, because it also
loads and compiles.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence
from math import fsum

MAX_RATIO = 2.0
"""No estimate is given if the slowest measured unit took more than this times as long as the fastest."""

_MIN_UNITS = 2


class RemainingTime:
    """Estimates the time that is left.

    Parameters
    ----------
    units
        The kind of each unit of work; units of one kind are expected to take equally long.
    workers
        Number of units that run at the same time.
    """

    def __init__(self, units: Sequence[Hashable], workers: int) -> None:
        self._left = Counter(units)
        self._workers = max(workers, 1)
        self._unmeasured = self._workers  # units that end before any worker has begun its second one
        self._seconds: dict[Hashable, list[float]] = {}

    def unit_done(self, kind: Hashable, seconds: float) -> None:
        """Record a finished unit and the time that one worker took for it."""
        self._left[kind] -= 1
        if self._unmeasured:
            self._unmeasured -= 1
            return
        self._seconds.setdefault(kind, []).append(seconds)

    @property
    def seconds(self) -> float | None:
        """The time that is left; None if it cannot be estimated."""
        left = {kind: count for kind, count in self._left.items() if count}
        if sum(left.values()) <= self._workers:  # all of them are running already
            return None
        total_s = 0.0
        for kind, count in left.items():
            measured_s = self._seconds.get(kind, [])
            if len(measured_s) < _MIN_UNITS or max(measured_s) > MAX_RATIO * min(measured_s):
                return None
            total_s += count * fsum(measured_s) / len(measured_s)
        running = self._workers - 1  # while one unit ends, the others are half done on average
        share_left = (sum(left.values()) - 0.5 * running) / sum(left.values())
        return total_s * share_left / self._workers
