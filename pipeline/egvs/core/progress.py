"""Progress callbacks: how a long computation reports how far it is."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

ProgressCallback = Callable[[str, int, int], None]
"""Called with (what is counted, number done, total) during the work, from any thread."""


def no_progress(_what: str, _done: int, _total: int) -> None:
    """A :data:`ProgressCallback` that shows nothing."""


class SummedProgress:
    """Reports the progress of several computations at the same time as one.

    Parameters
    ----------
    progress
        Is called with the sums over all parts that have reported.
    """

    def __init__(self, progress: ProgressCallback) -> None:
        self._progress = progress
        self._lock = Lock()
        self._states: dict[int, tuple[int, int]] = {}

    def part(self, number: int) -> ProgressCallback:
        """Return the callback of one of the computations; ``number`` identifies it."""

        def report(what: str, done: int, total: int) -> None:
            with self._lock:
                self._states[number] = done, total
                sums = [sum(values) for values in zip(*self._states.values(), strict=True)]
                self._progress(what, *sums)

        return report
