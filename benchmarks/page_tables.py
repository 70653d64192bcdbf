"""Tables of the documentation that commands write, row by row, between two marks of a page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

Cells = tuple[str, ...]
"""A row as text."""


def replace_between(page: Path, marks: tuple[str, str], make: Callable[[str], str]) -> None:
    """Replace what stands between the marks of a page.

    Parameters
    ----------
    page
        A text file.
    marks
        The lines before and after.
    make
        Returns the new text from the old one.

    Raises
    ------
    ValueError
        Unless the page has one pair of marks.
    """
    start, end = marks
    text = page.read_text(encoding="utf-8")
    before, _, rest = text.partition(start)
    old, _, after = rest.partition(end)
    if (text.count(start), text.count(end)) != (1, 1) or end not in rest:
        raise ValueError(f"{page}: expected one pair of marks {start} {end}")
    page.write_text(f"{before}{start}\n{make(old)}\n{end}{after}", encoding="utf-8")


def read_rows(table: str, columns: int) -> list[Cells]:
    """Return the rows below the head of a Markdown table; lines with another number of cells are no rows.

    Examples
    --------
    >>> read_rows("| a | b |\\n|---|---|\\n| 1 | 2 |", 2)
    [('1', '2')]
    """
    _, _, body = table.partition("|---")
    rows = []
    for line in body.splitlines()[1:]:
        cells = tuple(cell.strip() for cell in line.strip().removeprefix("|").removesuffix("|").split("|"))
        if line.startswith("|") and len(cells) == columns:
            rows.append(cells)
    return rows


def merge_rows(rows: Iterable[Cells], new: Iterable[Cells], key_columns: int = 1) -> list[Cells]:
    """Return rows with new ones: each replaces the row with the same first cells, or is added at the end."""
    by_key = {row[:key_columns]: row for row in rows}
    by_key |= {row[:key_columns]: row for row in new}
    return list(by_key.values())


def format_table(headings: Cells, rows: Iterable[Cells], text_columns: Sequence[int] = (0,)) -> str:
    """Return a Markdown table; numbers are aligned to the right, the text columns to the left."""
    rule = "".join("|---" if column in text_columns else "|---:" for column in range(len(headings))) + "|"
    return "\n".join(["| " + " | ".join(headings) + " |", rule, *("| " + " | ".join(row) + " |" for row in rows)])
