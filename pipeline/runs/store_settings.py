"""Where the store is, and how much it may hold: what the environment says of it."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from pipeline.core.errors import InputError

PLACE, MAX_GB = "EGVS_STORE", "EGVS_STORE_MAX_GB"
"""Environment variables: where the store is (empty for none), and how much it may hold."""

DEFAULT_PLACE = Path("runs", ".store")
DEFAULT_MAX_GB = 10.0


_ORDERED: ContextVar[tuple[str, float] | None] = ContextVar("_ORDERED", default=None)


@contextmanager
def using(place: str, bound_bytes: float) -> Iterator[None]:
    """Within the block, this thread's store is there, whatever the environment says."""
    before = _ORDERED.set((place, bound_bytes))
    try:
        yield
    finally:
        _ORDERED.reset(before)


def read() -> tuple[Path | None, float]:
    """The store's folder, None for no store; and its bound in bytes."""
    if (ordered := _ORDERED.get()) is not None:
        return Path(ordered[0]), ordered[1]
    place, most = os.environ.get(PLACE), os.environ.get(MAX_GB)
    try:
        bound_gb = DEFAULT_MAX_GB if most is None else float(most)
    except ValueError:
        bound_gb = math.nan
    if not 0 <= bound_gb < math.inf:
        raise InputError(MAX_GB, f"{most!r}", "how many GB the store may hold, for example 10")
    return (DEFAULT_PLACE if place is None else Path(place) if place else None), bound_gb * 1e9


def keep_out(folder: Path) -> None:
    """InputError where a run's folder is the store's, or lies in it.

    A run would wait for ever on a lock that it holds itself.
    """
    store, _ = read()
    if store is not None and Path(os.path.realpath(folder)).is_relative_to(os.path.realpath(store)):
        raise InputError(folder, f"is the store ({store}), or lies in it", "a folder outside of the store")
