"""Long work tells how far it is."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called with (what is counted, done, total) as work goes on, from any thread."""


def silent(_what: str, _done: int, _total: int) -> None:
    """A :data:`Progress` that shows nothing."""
