"""Progress callbacks: how a long computation reports how far it is."""

from __future__ import annotations

from collections.abc import Callable

ProgressCallback = Callable[[str, int, int], None]
"""Called with (what is counted, number done, total) during the work, from any thread."""


def no_progress(_what: str, _done: int, _total: int) -> None:
    """A :data:`ProgressCallback` that shows nothing."""
