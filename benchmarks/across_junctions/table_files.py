"""Tables of the study: typed columns, rows of rounded numbers, CSV files, and Markdown.

A cell is a text, a number, or a number with its interval (value, low, high). An undefined value is None, an empty
field in CSV and a dash in Markdown. Numbers are rounded before they are stored, so that the last digits of sums do not
matter.
"""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from egvs.core import files
from egvs.extensions.validation.correlation import ConfidenceInterval

Form = Literal["text", "whole", "one", "two"]
Cell = str | float | int | None | list[float | None]

_DIGITS = {"whole": 0, "one": 1, "two": 2}
SAVED_DIGITS = 4

INDEX = "tables.json"
"""Beside the CSV files: preface, captions and columns."""


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


def with_interval(value: float, interval: ConfidenceInterval) -> Cell:
    """A number with its interval of 95 %."""
    return None if math.isnan(value) else [number(value), number(interval.low), number(interval.high)]


def number(value: float) -> float | None:
    """A number as it is saved; None if undefined."""
    return None if math.isnan(value) else round(float(value), SAVED_DIGITS) + 0.0


def format_number(cell: Cell, form: Form) -> str:
    """A cell as text."""
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return cell.replace("|", "\\|")
    if isinstance(cell, list):
        value, low, high = (format_number(part, form) for part in cell)
        return value if cell[1] is None else f"{value} ({low} to {high})"
    digits = _DIGITS[form]
    return f"{round(cell, digits) + 0.0:.{digits}f}"


def markdown(table: Table) -> str:
    """A table with its caption."""
    align = ["---" if column.form == "text" else "---:" for column in table.columns]
    body = [
        [format_number(cell, column.form) for cell, column in zip(row, table.columns, strict=True)]
        for row in table.rows
    ]
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


def write(folder: Path, preface: Sequence[str], tables: Sequence[Table]) -> None:
    """Write tables as CSV files, and ``tables.json`` with the preface, the captions and the columns of each file.

    Tables of one section with the same columns share a file; its first column names the table. An interval takes three
    columns: value, low, high.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.csv"):
        old.unlink()

    stacked: dict[str, list[Table]] = {}
    listed: list[dict[str, str]] = []
    for table in tables:
        file = _file_of(table, stacked)
        stacked.setdefault(file, []).append(table)
        listed.append({"name": table.name, "section": table.section, "caption": table.caption, "file": file})
    columns = {file: _described_columns(group) for file, group in stacked.items()}
    for file, group in stacked.items():
        _write_csv(folder / file, group, columns[file])

    with files.atomic_write(folder / INDEX) as partial:
        index = {"preface": list(preface), "tables": listed, "columns": columns}
        text = json.dumps(index, ensure_ascii=False, indent=1)
        partial.write_text(text + "\n", encoding="utf-8")


def read(folder: Path) -> tuple[list[str], list[Table]]:
    """Read preface and tables, the inverse of :func:`write`."""
    index = json.loads((folder / INDEX).read_text(encoding="utf-8"))
    rows = {file: _read_csv(folder / file, columns) for file, columns in index["columns"].items()}
    tables = []
    for listed in index["tables"]:
        columns = [Column(column["heading"], column["form"]) for column in index["columns"][listed["file"]]]
        mine = [row for name, row in rows[listed["file"]] if name == listed["name"]]
        tables.append(Table(listed["name"], listed["section"], listed["caption"], columns, mine))
    return index["preface"], tables


def file_names(folder: Path) -> list[str]:
    """The file of each table, in the order of the tables."""
    index = json.loads((folder / INDEX).read_text(encoding="utf-8"))
    return [listed["file"] for listed in index["tables"]]


def _file_of(table: Table, stacked: dict[str, list[Table]]) -> str:
    """The file of the section, or a file named after the table where that one has other columns."""
    file = f"{_slug(table.section)}.csv"
    if file in stacked and stacked[file][0].columns != table.columns:
        file = f"{_slug(table.name)}.csv"
    return file


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def _described_columns(group: Sequence[Table]) -> list[dict[str, Any]]:
    """Heading and form of each column, and whether its numbers have intervals."""
    described = []
    for position, column in enumerate(group[0].columns):
        cells = [row[position] for table in group for row in table.rows]
        has_interval = any(isinstance(cell, list) for cell in cells)
        described.append({"heading": column.heading, "form": column.form, "interval": has_interval})
    return described


def _write_csv(path: Path, group: Sequence[Table], columns: Sequence[dict[str, Any]]) -> None:
    header = ["table"]
    for column in columns:
        heading = column["heading"]
        header += [heading, f"{heading} low", f"{heading} high"] if column["interval"] else [heading]
    with files.atomic_write(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for table in group:
            for row in table.rows:
                line: list[Any] = [table.name]
                for cell, column in zip(row, columns, strict=True):
                    if column["interval"]:
                        line += cell if isinstance(cell, list) else [cell, None, None]
                    else:
                        line.append(cell)
                writer.writerow(line)


def _read_csv(path: Path, columns: Sequence[dict[str, Any]]) -> list[tuple[str, list[Cell]]]:
    """Name of the table and cells of each row."""
    with path.open(encoding="utf-8", newline="") as file:
        lines = list(csv.reader(file))[1:]
    rows = []
    for line in lines:
        texts = iter(line)
        name = next(texts)
        cells: list[Cell] = []
        for column in columns:
            if column["form"] == "text":
                cells.append(next(texts) or None)
            elif column["interval"]:
                interval = [_number_or_none(next(texts)) for _ in range(3)]
                cells.append(None if interval[0] is None else interval)
            else:
                cells.append(_number_or_none(next(texts)))
        rows.append((name, cells))
    return rows


def _number_or_none(text: str) -> float | None:
    if not text:
        return None
    return int(text) if text.lstrip("-").isdecimal() else float(text)
