"""Tables of what validation has to tell: which scores there are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from pipeline.cli.terminal import console, table

if TYPE_CHECKING:
    from pipeline.validation.surrogates.base import Value
    from pipeline.validation.surrogates.registry import Entry

_FILE_WIDTH = 160


def print_scores(entries: Iterable[Entry]) -> None:
    """Scores: formula in words, which way is better, what is tried, source; of one that cannot be loaded, why."""
    names = ("score", "formula", "better", "tried with", "source")
    rows = table(names, left=names, whole=("score", "better"))
    for entry in entries:
        score = entry.score
        if score is None:
            rows.add_row(entry.name, entry.problem, "broken", "", "")
            continue
        source = score.source + (f" (package {entry.package})" if entry.package else "")
        rows.add_row(score.name, score.formula, "more" if score.sign > 0 else "less", _tried(score.sweep), source)
    console(_FILE_WIDTH, soft_wrap=False).print(rows, markup=False)


def _tried(sweep: Mapping[str, tuple[Value, ...]]) -> str:
    return "; ".join(f"{name} {', '.join(_word(value) for value in values)}" for name, values in sweep.items())


def _word(value: Value) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:g}" if isinstance(value, float) else str(value)
