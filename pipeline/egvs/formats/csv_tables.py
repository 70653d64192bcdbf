"""Small CSV tables with a header that users write by hand or in a spreadsheet: UTF-8, commas or semicolons."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator
from pathlib import Path

from egvs.core import limits
from egvs.core.errors import InputError

CheckHeader = Callable[[list[str]], list[str]]
"""Returns the names of columns under which values are given; raises an InputError where they are not valid."""


def read_rows(path: Path, check_header: CheckHeader) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield where each row is, for messages, and its values by column, without blanks around them.

    Rows without any value are skipped. The separator is the one that the header has more of.

    Parameters
    ----------
    path
        The file, at most :data:`egvs.core.limits.DOCUMENT`. Lines are counted from 1, which is the header.
    check_header
        Called once with the names of the columns, before the first row.

    Raises
    ------
    InputError
        When the file is too large or no UTF-8 or CSV, two columns have the same name, or a row has another number of
        values than the header.
    """
    try:
        text = limits.read_bytes(path, limits.DOCUMENT).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(path, f"is not UTF-8 text (byte {error.start})", "Save it as CSV in UTF-8.") from None
    first_line = text.partition("\n")[0]
    delimiter = ";" if first_line.count(";") > first_line.count(",") else ","
    table = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, skipinitialspace=True, strict=True)
    try:
        header = check_header([name.strip() for name in next(table, [])])
        for name in header:
            if header.count(name) > 1:
                raise InputError(f"{path}: header", f"two columns are called {name!r}", "Rename or remove one.")
        for cells in table:
            where = f"{path}: line {table.line_num}"
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) != len(header):
                problem = f"expected {len(header)} values, got {len(cells)}"
                raise InputError(where, problem, "Check the separators.")
            yield where, {name: cell.strip() for name, cell in zip(header, cells, strict=True)}
    except csv.Error as error:
        raise InputError(f"{path}: line {table.line_num}", f"is not CSV ({error})", "Check the quotes.") from None
