"""Columns of a sites file that are the user's own (``fid``, ``owner``, ``note``): carried through to the scores.

A column that looks like one of the program's own that the file lacks is refused as misspelt: taken for a note, it
would turn no sensor.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from pipeline.core.errors import InputError
from pipeline.scenario.near_names import misspelt

Value = str | int | float | bool | None

_NAME = re.compile(r"[^\x00-\x1f]{1,80}")
_NUMBER = re.compile(r"-?(0|[1-9][0-9]{0,17})(\.[0-9]+)?")  # "007" is a name


def own_columns(place: str, row: Mapping[str, Any], known: Collection[str]) -> dict[str, Value]:
    """What a site's row says beyond the ``known`` columns; lists and tables as JSON text.

    InputError when a column looks like a known one that the row lacks, or has no sound name.
    """
    if (found := misspelt(row, known)) is not None:
        wrong, meant = found
        right = f"did you mean {meant}? A column of your own may have any name that is less like it"
        raise InputError(place, f"unknown column {wrong!r}", right)
    own = {name: value for name, value in row.items() if name not in known}
    for name in own:
        if not _NAME.fullmatch(name):
            raise InputError(place, f"a column is named {name[:80]!r}", "a name of 1 to 80 characters")
    return {name: _plain(value) for name, value in own.items()}


def with_numbers(rows: Iterable[dict[str, Any]], known: Collection[str]) -> list[dict[str, Any]]:
    """Rows of a CSV, with numbers instead of texts in those columns beyond the ``known`` that hold numbers alone.

    An empty cell is None.
    """
    all_rows = list(rows)
    for name in {name for row in all_rows for name in row} - set(known):
        texts = [row[name].strip() for row in all_rows if row.get(name)]
        matches = [_NUMBER.fullmatch(text) for text in texts]
        kind = str if None in matches else int if not any(m and m[2] for m in matches) else float
        for row in all_rows:
            text = row.get(name)
            row[name] = kind(text) if text else None
    return all_rows


def _plain(value: Any) -> Value:
    """A value that a column can hold."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        return str(value)
    if isinstance(value, list | dict):
        return json.dumps(value, ensure_ascii=True)
    return value if isinstance(value, str | int | float | bool) else None
