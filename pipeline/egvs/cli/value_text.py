"""Values of settings, and of the summaries of stages, as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def format_values(values: Mapping[str, Any]) -> str:
    """Return the entries of a mapping in one line, without empty ones."""
    shown = []
    for key, value in values.items():
        if value not in ("", [], {}, None):
            shown.append(f"{key.replace('_', ' ')} {format_value(value)}")
    return "; ".join(shown)


def format_value(value: Any) -> str:
    """Return a value as text; a mapping of counts as "3 pole, 2 sign"."""
    if isinstance(value, dict):
        return ", ".join(_format_entry(str(key).replace("_", " "), entry) for key, entry in value.items())
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return ", ".join(format_value(entry) for entry in value)
    return str(value)


def _format_entry(key: str, value: Any) -> str:
    if isinstance(value, dict):
        return f"{key} ({format_value(value)})"
    return f"{format_value(value)} {key}"
