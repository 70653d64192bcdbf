"""The store as a table: what is kept, how much it takes, when it was made and last used."""

from __future__ import annotations

import re
import sys
import time

from rich.console import Console
from rich.table import Table

from pipeline.core.errors import InputError
from pipeline.runs.store import Entry, Store

_UNITS = {"": 1.0, "K": 1e3, "M": 1e6, "G": 1e9, "T": 1e12}


def print_store(store: Store) -> None:
    """All entries, the one used last first; their total and its bound."""
    console = Console(width=None if sys.stdout.isatty() else 120, highlight=False, soft_wrap=True)
    if store.folder is None:
        console.print("EGVS_STORE is empty: nothing is kept")
        return
    entries, now = store.entries(), time.time()
    table = Table(box=None, pad_edge=False)
    for name in ("stage", "key", "size", "age", "last used"):
        table.add_column(name, justify="left" if name in ("stage", "key") else "right")
    for entry in entries:
        age, rest = _duration(now - entry.created), _duration(now - entry.last_used)
        table.add_row(entry.stage, entry.key[:12], _size(entry.bytes), age, f"{rest} ago")
    console.print(table)
    console.print(f"{store.folder}: {_total(entries)}, of at most {_size(store.bound_bytes)}", markup=False)


def print_removed(store: Store, removed: list[Entry]) -> None:
    """What was removed, and what is left."""
    print(f"{store.folder}: removed {_total(removed)}; {_total(store.entries())} are left")


def bytes_of(text: str) -> float:
    """A size such as 500M or 2G; InputError for anything else."""
    found = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)([KMGT]?)B?", text)
    if found is None:
        raise InputError("--max", repr(text), "a size, for example 500M or 2G")
    return float(found[1]) * _UNITS[found[2]]


def _total(entries: list[Entry]) -> str:
    return f"{len(entries)} entries, {_size(sum(entry.bytes for entry in entries))}"


def _size(size: float) -> str:
    unit, least = next(((u, n) for u, n in reversed(_UNITS.items()) if size >= n), ("", 1.0))
    return f"{size / least:.3g} {unit}B"


def _duration(seconds: float) -> str:
    for unit, least in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= least:
            return f"{seconds / least:.0f} {unit}"
    return f"{max(seconds, 0):.0f} s"
