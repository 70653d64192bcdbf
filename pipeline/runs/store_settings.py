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
"""Environment variables: where the store is (empty for none; a folder, or a URL that machines share), and how much its
folder may hold."""

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
    """The store's folder on this machine, None for no store; and its bound in bytes."""
    if (ordered := _ORDERED.get()) is not None:
        return _folder(ordered[0]), ordered[1]
    most = os.environ.get(MAX_GB)
    try:
        bound_gb = DEFAULT_MAX_GB if most is None else float(most)
    except ValueError:
        bound_gb = math.nan
    if not 0 <= bound_gb < math.inf:
        raise InputError(MAX_GB, f"{most!r}", "how many GB the store may hold, for example 10")
    return _folder(_place()), bound_gb * 1e9


def remote_url() -> str | None:
    """The URL of the store that machines share; None where it is a folder, or there is none."""
    place = _place()
    return place if place is not None and _is_url(place) else None


def _place() -> str | None:
    ordered = _ORDERED.get()
    return os.environ.get(PLACE) if ordered is None else ordered[0]


def _folder(place: str | None) -> Path | None:
    """The folder on this machine: beside the runs where the store's place is a URL, or is not said."""
    if place is None or _is_url(place):
        return DEFAULT_PLACE
    return Path(place) if place else None


def _is_url(place: str) -> bool:
    return "://" in place


def keep_out(folder: Path) -> None:
    """InputError where a run's folder is the store's, or lies in it.

    A run would wait for ever on a lock that it holds itself.
    """
    store, _ = read()
    if store is not None and Path(os.path.realpath(folder)).is_relative_to(os.path.realpath(store)):
        raise InputError(folder, f"is the store ({store}), or lies in it", "a folder outside of the store")
