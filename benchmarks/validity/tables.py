"""Tables of the study: typed columns, rows of numbers as they are kept, and the page that shows them.

A cell is a text, a number, or a number with its interval (value, low, high); what is not defined is None and shown as a
dash. Numbers are rounded before they are kept, so that last digits of sums do not travel on.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from pipeline.core import files
from pipeline.validation.statistics.intervals import Interval

Form = Literal["text", "whole", "one", "two"]
Cell = str | float | int | None | list[float | None]

_DIGITS = {"whole": 0, "one": 1, "two": 2}
KEPT_DIGITS = 4


@dataclass(frozen=True)
class Column:
    """A column: its heading, and how many digits its numbers have."""

    heading: str
    form: Form = "text"


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes
    ----------
    name
        As the text and the figures name it.
    section
        Heading that it stands under.
    caption
        What it shows.
    """

    name: str
    section: str
    caption: str
    columns: list[Column]
    rows: list[list[Cell]]

    def column(self, heading: str) -> list[Any]:
        """The cells of a column."""
        place = [column.heading for column in self.columns].index(heading)
        return [row[place] for row in self.rows]


def with_interval(value: float, interval: Interval) -> Cell:
    """A number with its interval of 95 %."""
    return None if math.isnan(value) else [_kept(value), _kept(interval.low), _kept(interval.high)]


def number(value: float) -> Cell:
    """A number."""
    return _kept(value)


def _kept(value: float) -> float | None:
    return None if math.isnan(value) else round(float(value), KEPT_DIGITS) + 0.0


def shown(cell: Cell, form: Form) -> str:
    """A cell as text."""
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return cell.replace("|", "\\|")
    if isinstance(cell, list):
        value, low, high = (shown(part, form) for part in cell)
        return value if cell[1] is None else f"{value} ({low} to {high})"
    digits = _DIGITS[form]
    return f"{round(cell, digits) + 0.0:.{digits}f}"


def markdown(table: Table) -> str:
    """A table with its caption."""
    align = ["---" if column.form == "text" else "---:" for column in table.columns]
    body = [[shown(cell, column.form) for cell, column in zip(row, table.columns, strict=True)] for row in table.rows]
    lines = [[column.heading for column in table.columns], align, *body]
    drawn = "".join("| " + " | ".join(line) + " |\n" for line in lines)
    return f"{table.caption}\n\n{drawn}"


def page(title: str, preface: Sequence[str], tables: Sequence[Table]) -> str:
    """All tables as one page of Markdown, in their order, under the headings of their sections."""
    parts, section = [f"# {title}\n", *(f"{text}\n" for text in preface)], ""
    for table in tables:
        if table.section != section:
            section = table.section
            parts.append(f"## {section}\n")
        parts.append(markdown(table))
    return "\n".join(parts)


def write(path: Path, preface: Sequence[str], tables: Sequence[Table]) -> None:
    """Keep preface and tables as JSON, one row a line."""
    out = ["{", f' "preface": {_json(list(preface))},', ' "tables": [']
    for number_, table in enumerate(tables):
        head = {key: value for key, value in asdict(table).items() if key != "rows"}
        rows = ",\n".join(f"   {_json(row)}" for row in table.rows)
        comma = "," if number_ + 1 < len(tables) else ""
        out.append(f'  {_json(head)[:-1]}, "rows": [\n{rows}\n  ]}}{comma}')
    with files.aside(path) as partial:
        partial.write_text("\n".join([*out, " ]", "}"]) + "\n", encoding="utf-8")


def read(path: Path) -> tuple[list[str], list[Table]]:
    """The inverse of :func:`write`."""
    value = json.loads(path.read_text(encoding="utf-8"))
    tables = [Table(**(its | {"columns": [Column(**column) for column in its["columns"]]})) for its in value["tables"]]
    return value["preface"], tables


def _json(value: object) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)
