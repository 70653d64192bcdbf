"""How wide a terminal is taken to be, and how tables and values look; what all output shares."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterable
from typing import Any, Literal

from rich.console import Console
from rich.table import Table

NARROW, WIDE = 110, 190
"""Terminals below ``NARROW`` columns get fewer columns of tables; those of about ``WIDE`` get all."""


def console(file_width: int, *, soft_wrap: bool = True) -> Console:
    """Standard output: as wide as the terminal, or ``file_width`` columns where it goes to a file.

    Nothing in a text is taken for a style or an emoji: names may have brackets and colons.
    """
    width = None if sys.stdout.isatty() else file_width
    return Console(width=width, highlight=False, markup=False, emoji=False, soft_wrap=soft_wrap)


def table(names: Iterable[str], left: Collection[str], whole: Collection[str] = (), *, fold: bool = True) -> Table:
    """An empty table without a frame: columns in ``left`` are aligned left, others right; those in ``whole`` stay on
    one line; what is too wide goes on below, or is cut where not ``fold``.
    """
    empty = Table(box=None, pad_edge=False)
    for name in names:
        side: Literal["left", "right"] = "left" if name in left else "right"
        empty.add_column(name, justify=side, no_wrap=name in whole, overflow="fold" if fold else "ellipsis")
    return empty


def in_words(values: dict[str, Any]) -> str:
    """A table of values in one line, without those that are empty."""
    shown = {key.replace("_", " "): value for key, value in values.items() if value not in ("", [], {}, None)}
    return "; ".join(f"{key} {value_in_words(value)}" for key, value in shown.items())


def value_in_words(value: Any) -> str:
    """One value in words; a table of counts as "3 pole, 2 sign"."""
    if isinstance(value, dict):
        parts = ((str(k).replace("_", " "), v) for k, v in value.items())
        return ", ".join(
            f"{k} ({value_in_words(v)})" if isinstance(v, dict) else f"{value_in_words(v)} {k}" for k, v in parts
        )
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return ", ".join(value_in_words(v) for v in value)
    return str(value)
