"""Tables that people type or make in a spreadsheet: CSV in the forms that offices write, and workbooks.

Text is UTF-8, UTF-16 with a byte order mark, or Windows-1252. The first row with values is the header; a first line
``sep=;`` names the separator, which otherwise is the one of comma, semicolon and tab that the header has most of. Rows
and columns without any value are skipped, as spreadsheets keep those that were emptied.

``8,5`` is the number 8.5. Where each such cell of a table could also be a number of thousands (``1,500``), the table is
rejected; so is one with decimal commas where each cell with a point could be (``1.500``).

Workbooks (xlsx, xls, ods) are read by :mod:`egvs.formats.workbooks`. Of several sheets, one must have the expected
header. A cell with the error of a formula (``#REF!``) is an error in any column.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from egvs.core import limits
from egvs.core.errors import InputError, raise_together
from egvs.core.numbers import number_or_nan
from egvs.core.wording import list_first
from egvs.formats import workbooks
from egvs.formats.workbooks import MAX_COLUMNS

CheckHeader = Callable[[list[str]], list[str]]
"""Returns the names of columns under which values are given; raises an InputError where they are not valid."""

Parsed = TypeVar("Parsed")

SUFFIXES = (".csv", ".xlsx", ".xls", ".ods")
_WORKBOOK_SIGNATURES = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1")  # ZIP (xlsx, ods), OLE (xls)
_CONTROL_CHARACTER = re.compile("[\x00-\x08\x0e-\x1f]")
_SEPARATORS = (",", ";", "\t")
_SEPARATOR_LINE = re.compile(r'"?sep=(.)"?', re.IGNORECASE)
_COMMA_NUMBER = re.compile(r"[+-]?[0-9]+,[0-9]+([eE][+-]?[0-9]+)?")
_THOUSANDS = re.compile(r"[+-]?[1-9][0-9]{0,2}[,.][0-9]{3}")
_POINT_NUMBER = re.compile(r"[+-]?[0-9]+\.[0-9]+([eE][+-]?[0-9]+)?")
_FORMULA_ERROR = re.compile(rf"#[^\W\d][\w/]*[!?]|#N/A|#NV|Err:5[0-9]{{2}}|{workbooks.NO_VALUE}")
_MARKUP = re.compile(r"\s*<(?:[!?]|html|table)", re.IGNORECASE)
_SAVE_HINT = "Save it as CSV in UTF-8."
_MAX_NAMED = 5
_MAX_ABOVE = 10
"""Rows that may be above the names of the columns by mistake."""


@dataclass(frozen=True)
class TableRows:
    """The rows of a table below its header.

    Attributes
    ----------
    rows
        Where each row is, for messages, and its values by column, without blanks around them.
    errors
        What is wrong with the other rows.
    """

    rows: list[tuple[str, dict[str, str]]]
    errors: list[InputError]


def parse_rows(
    path: Path, check_header: CheckHeader, parse: Callable[[str, dict[str, str]], Iterable[Parsed]]
) -> list[Parsed]:
    """Parse the rows of a table; the errors of all rows are raised together.

    Parameters
    ----------
    path, check_header
        As in :func:`read_rows`.
    parse
        Returns what a row stands for; its arguments are where the row is, for messages, and its values by column.

    Raises
    ------
    InputError
        As :func:`read_rows`, when a row has another number of values than the header, and the errors of ``parse``.
    """
    table = read_rows(path, check_header)
    errors = list(table.errors)
    parsed: list[Parsed] = []
    for where, values in table.rows:
        try:
            parsed += parse(where, values)
        except InputError as error:
            errors.append(error)
    raise_together(errors, "table")
    return parsed


def read_rows(path: Path, check_header: CheckHeader) -> TableRows:
    """Return the rows of a CSV file or a workbook that have values.

    Parameters
    ----------
    path
        The file, at most :data:`egvs.core.limits.DOCUMENT`. Lines and rows are counted from 1.
    check_header
        Called with the names of the columns; of a workbook, once for each sheet with values.

    Raises
    ------
    InputError
        When the file is too large, is no table, two columns have the same name, or commas in numbers can have two
        meanings.
    MissingExtraError
        For a workbook, if calamine is not installed.
    """
    data = limits.read_bytes(path, limits.DOCUMENT)
    if data.startswith(_WORKBOOK_SIGNATURES):
        table, header = _choose_sheet(path, list(_read_workbook(path)), check_header)
    else:
        table = _read_text(path, data)
        header = check_header(table.header)
    for name in header:
        if header.count(name) > 1:
            raise InputError(f"{table.where}: header", f"two columns are called {name!r}", "Rename or remove one.")
    _use_decimal_points(table)
    rows, errors = [], list(table.errors)
    for number, cells in table.rows:
        where = table.locate(number)
        row = dict(zip(header, cells, strict=True))
        failed = [name for name in row if _FORMULA_ERROR.fullmatch(row[name])]
        errors += [_formula_error(f"{where}: {name}", row[name]) for name in failed]
        if not failed:
            rows.append((where, row))
    return TableRows(rows, errors)


def is_plain_csv(head: bytes) -> bool:
    """Return whether a file that begins with these bytes has commas between columns, and is no workbook or UTF-16."""
    first = head.removeprefix(b"\xef\xbb\xbf").lstrip().partition(b"\n")[0]
    return not any(mark in first for mark in (b";", b"\t", b"\0")) and not head.startswith(
        (*_WORKBOOK_SIGNATURES, b"\xff\xfe", b"\xfe\xff")
    )


def read_cells(path: Path) -> list[list[str]]:
    """Return header and rows of a table with any kind of header, or none; numbers have decimal points.

    Raises
    ------
    InputError
        As :func:`read_rows`.
    """
    data = limits.read_bytes(path, limits.DOCUMENT)
    if data.startswith(_WORKBOOK_SIGNATURES):
        table, header = _choose_sheet(path, list(_read_workbook(path)), lambda names: names)
    else:
        table = _read_text(path, data)
        header = table.header
    raise_together(table.errors, "table")
    _use_decimal_points(table)
    first = [cell.replace(",", ".") if _COMMA_NUMBER.fullmatch(cell) else cell for cell in header]
    return [first, *(cells for _, cells in table.rows)]


def _formula_error(where: str, text: str) -> InputError:
    if text == workbooks.NO_VALUE:
        return InputError(where, text, "Open the table in a spreadsheet program, and save it.")
    return InputError(where, f"expected a value, got the formula error {text}", "Correct the formula.")


# ---- cells


@dataclass(frozen=True)
class _Table:
    """A table with its header and, by their numbers, the rows that have values; columns without a name are left out."""

    where: str
    unit: str
    header: list[str]
    rows: list[tuple[int, list[str]]]
    errors: list[InputError]

    def locate(self, number: int) -> str:
        return f"{self.where}: {self.unit} {number}"


def _make_table(where: str, unit: str, rows: Iterable[tuple[int, list[str]]]) -> _Table:
    """Return a table of the rows that have values, without columns that have none."""
    rows = [(number, [cell.strip() for cell in cells]) for number, cells in rows]
    rows = [(number, cells) for number, cells in rows if any(cells)]
    if not rows:
        raise InputError(where, "expected a header and rows, got no values", "Write one row per item.")
    first, header = rows.pop(0)
    names_row = _names_below(header, rows[:_MAX_ABOVE])
    if names_row is not None:
        title = next(cell for cell in header if cell)
        problem = f"expected the names of the columns, got {title[:80]!r}"
        hint = f"Remove what is above the names ({unit} {names_row}?), or check the separators."
        raise InputError(f"{where}: {unit} {first}", problem, hint)
    if len(header) > MAX_COLUMNS:
        problem = f"expected at most {MAX_COLUMNS} columns, got {len(header):,}"
        raise InputError(where, problem, "Remove columns that are not needed.")
    used = {column for _, cells in rows for column, cell in enumerate(cells) if cell}
    for column in sorted(used):
        if column < len(header) and not header[column]:
            number, value = next((n, cells[column]) for n, cells in rows if len(cells) > column and cells[column])
            problem = f"column {column + 1} has no name, but {unit} {number} has the value {value[:80]!r} there"
            raise InputError(f"{where}: header", problem, "Name or remove the column.")
    columns = [column for column, name in enumerate(header) if name]
    table = _Table(where, unit, [header[column] for column in columns], [], [])
    for number, cells in rows:
        if len(cells) > columns[-1] and not any(cells[len(header) :]):
            table.rows.append((number, [cells[column] for column in columns]))
        else:
            problem = f"expected {columns[-1] + 1} values, got {len(cells)}"
            hint = "Check the separators, and the quotes around values with one."
            table.errors.append(InputError(table.locate(number), problem, hint))
    return table


def _names_below(header: list[str], rows: list[tuple[int, list[str]]]) -> int | None:
    """Return the number of the row that probably has the names of the columns, if ``header`` is a title above it.

    It has more values than the header, which has a single one, or else no number among them.
    """
    titles = sum(map(bool, header))
    for number, cells in rows:
        texts = [cell for cell in cells if cell]
        is_all_text = all(math.isnan(number_or_nan(cell.replace(",", "."))) for cell in texts)
        if len(texts) > titles and (titles == 1 or is_all_text):
            return number
    return None


def _use_decimal_points(table: _Table) -> None:
    """Replace decimal commas by points; InputError where they, or the points beside them, can separate thousands."""
    with_comma = _find_cells(table, _COMMA_NUMBER)
    if not with_comma:
        return
    for numbers in (with_comma, _find_cells(table, _POINT_NUMBER)):
        if numbers and all(_THOUSANDS.fullmatch(cells[column]) for _, column, cells in numbers):
            number, column, cells = numbers[0]
            value = cells[column]
            problem = f"{value} can mean {re.sub('[,.]', '', value)} or {value.replace(',', '.')}"
            where = f"{table.locate(number)}: {table.header[column]}"
            raise InputError(where, problem, "Use no separators of thousands, and a decimal point.")
    for _, column, cells in with_comma:
        cells[column] = cells[column].replace(",", ".")


def _find_cells(table: _Table, pattern: re.Pattern[str]) -> list[tuple[int, int, list[str]]]:
    """Return row number, column and row of each cell that a pattern matches."""
    return [
        (number, column, cells)
        for number, cells in table.rows
        for column, cell in enumerate(cells)
        if pattern.fullmatch(cell)
    ]


# ---- text


def _read_text(path: Path, data: bytes) -> _Table:
    text = _decode(path, data)
    if _MARKUP.match(text):
        raise InputError(path, "expected a table, got HTML or XML", "Save it as a workbook (xlsx) or as CSV.")
    first_line, _, rest = text.partition("\n")
    skipped = 0
    named = _SEPARATOR_LINE.fullmatch(first_line.strip(" \r"))
    if named is not None:
        text, skipped, separator = rest, 1, named[1]
    else:
        lines = [line for line in text.splitlines() if line.strip(" ,;\t")]
        header = lines[0] if lines else ""
        separator = max(_SEPARATORS, key=header.count)
        names = next((line for line in lines[1:_MAX_ABOVE] if any(map(line.count, _SEPARATORS))), "")
        if names and separator not in names:  # the first line is a title, in which there may be a comma
            separator = max(_SEPARATORS, key=names.count)
        if "|" in header and not header.count(separator):
            raise InputError(path, "the columns are separated by '|'", "Use commas or semicolons.")
    table = csv.reader(io.StringIO(text, newline=""), delimiter=separator, skipinitialspace=True, strict=True)
    try:
        rows = [(table.line_num + skipped, cells) for cells in _rows_with_values(path, table)]
    except csv.Error as error:
        line = table.line_num + skipped
        raise InputError(f"{path}: line {line}", f"is not CSV ({error})", "Check the quotes.") from None
    return _make_table(str(path), "line", rows)


def _rows_with_values(path: Path, table: Iterable[list[str]]) -> Iterator[list[str]]:
    count = 0
    for cells in table:
        if any(cells):
            count += 1
            workbooks.check_row_count(path, count)
            yield cells


def _decode(path: Path, data: bytes) -> str:
    encoding = "utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        try:
            text = data.decode("cp1252")
        except UnicodeDecodeError:
            text = "\0"
        if encoding == "utf-16" or _CONTROL_CHARACTER.search(text):
            raise InputError(path, f"is no text in a known encoding (byte {error.start})", _SAVE_HINT) from None
    if control := _CONTROL_CHARACTER.search(text):
        raise InputError(path, f"is no text: it has the control character {control[0]!r}", _SAVE_HINT)
    return text


# ---- workbooks


def _choose_sheet(path: Path, sheets: list[_Table], check_header: CheckHeader) -> tuple[_Table, list[str]]:
    """Return the only sheet with values, or the only one with a valid header; and that header."""
    if not sheets:
        raise InputError(path, "expected a table, got a workbook without values", "Write one row per item.")
    if len(sheets) == 1:
        return sheets[0], check_header(sheets[0].header)
    accepted = []
    errors = []
    for sheet in sheets:
        try:
            accepted.append((sheet, check_header(sheet.header)))
        except InputError as error:
            errors.append(error)
    if not accepted:
        raise_together(errors, "table")
    if len(accepted) > 1:
        names = list_first([sheet.where.removeprefix(f"{path}: sheet ") for sheet, _ in accepted], _MAX_NAMED)
        problem = f"expected one sheet with this kind of table, got {len(accepted)} ({names})"
        raise InputError(path, problem, "Keep one of them, or save it as CSV.")
    return accepted[0]


def _read_workbook(path: Path) -> Iterator[_Table]:
    """Yield the visible sheets that have values."""
    sheets = workbooks.read_sheets(path)
    for name, rows in sheets.items():
        where = str(path) if len(sheets) == 1 else f"{path}: sheet {name!r}"
        yield _make_table(where, "row", rows)
