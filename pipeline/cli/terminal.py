"""How wide a terminal is taken to be, and how values look in words; what all tables share."""

from __future__ import annotations

import sys
from typing import Any

from rich.console import Console

NARROW, WIDE = 110, 190
"""Terminals below ``NARROW`` columns get fewer columns of tables; those of about ``WIDE`` get all."""


def console(file_width: int, *, soft_wrap: bool = True) -> Console:
    """Standard output: as wide as the terminal, or ``file_width`` columns where it goes to a file."""
    return Console(width=None if sys.stdout.isatty() else file_width, highlight=False, soft_wrap=soft_wrap)


def in_words(values: dict[str, Any]) -> str:
    """A table of values in one line, without those that are empty."""
    return "; ".join(
        f"{key.replace('_', ' ')} {value_in_words(value)}"
        for key, value in values.items()
        if value not in ("", [], {}, None)
    )


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
