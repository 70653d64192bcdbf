"""Read the sheets of workbooks (xlsx, xls, ods) with calamine (``pip install 'egvs[tables]'``).

calamine runs in another process (:mod:`egvs.formats.reader_process`), which this module also is the program of. The
values that a spreadsheet has computed are read. What calamine does not tell is read from the XML of xlsx and ods files,
and by xlrd from xls files: errors of formulas, formulas without a value, merged cells and hidden rows. Merged cells and
hidden rows are rejected: only one of the cells has the value, and nothing says whether the rows count.
"""

from __future__ import annotations

import datetime
import json
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from xml.etree.ElementTree import Element

from egvs.core import limits, plugins
from egvs.core.errors import InputError
from egvs.core.wording import list_first
from egvs.formats.reader_process import Block, read_blocks, serve

MAX_COLUMNS, MAX_ROWS = 500, 500_000

NO_VALUE = "a formula without a value"
"""Text of a cell whose formula was never computed."""

_MODULE = "egvs.formats.workbooks"
_CELL_POSITION = re.compile(r"([A-Z]{1,3})([0-9]{1,7})")
_MAX_NAMED = 5


def read_sheets(path: Path) -> dict[str, list[tuple[int, list[str]]]]:
    """Return the rows of each visible sheet with values, by its name: their numbers from 1, and their cells as text.

    Raises
    ------
    InputError
        When the file is no workbook, or too large.
    MissingExtraError
        If calamine is not installed.
    """
    plugins.require_libraries(f"{path.name}: reading a workbook", "tables", "python_calamine", "xlrd")
    sheets: dict[str, list[tuple[int, list[str]]]] = {}
    size = 0
    for block in read_blocks(_MODULE, path, str(path), "cannot be read as a workbook"):
        size += len(block.content)
        limits.DOCUMENT.check_bytes(path, size, f"has tables of {size / limits.MB:,.0f} MB")
        sheets.setdefault(block.values["sheet"], []).append((block.values["row"], json.loads(bytes(block.content))))
    return sheets


def check_row_count(path: object, count: int) -> None:
    """Raise an InputError for a table of more than :data:`MAX_ROWS` rows."""
    if count > MAX_ROWS:
        raise InputError(path, f"has more than {MAX_ROWS:,} rows", "Use a smaller table.")


# ---- in the other process


@dataclass
class _SheetDetails:
    """What calamine does not tell of a sheet.

    Attributes
    ----------
    texts
        Errors of formulas, and formulas without a value, by row (from 1) and column (from 0).
    hidden_rows
        Their numbers.
    merged
        Top left and bottom right cells of merged cells, all from 0.
    """

    texts: dict[int, dict[int, str]] = field(default_factory=dict)
    hidden_rows: list[int] = field(default_factory=list)
    merged: list[tuple[tuple[int, int], tuple[int, int]]] = field(default_factory=list)


def _read_workbook(path: Path) -> Iterator[Block]:
    from python_calamine import CalamineWorkbook, PasswordError, SheetTypeEnum, SheetVisibleEnum

    if _is_archive_of_other_files(path):
        raise InputError(path, "expected a workbook, got a ZIP archive of other files", "Unpack it.")
    try:
        book = CalamineWorkbook.from_path(path)
    except PasswordError:
        raise InputError(path, "the workbook is protected by a password", "Save it without one.") from None
    visible = [
        sheet.name
        for sheet in book.sheets_metadata
        if sheet.visible == SheetVisibleEnum.Visible and sheet.typ == SheetTypeEnum.WorkSheet
    ]
    all_details = _read_details(path, visible)
    count = 0
    for name in visible:
        content = book.get_sheet_by_name(name)
        details = all_details.get(name, _SheetDetails())
        if content.start is None or content.end is None:
            continue
        where = f"{path}: sheet {name!r}"
        first_row, first_column = content.start
        columns = content.end[1] + 1 - first_column
        if columns > MAX_COLUMNS:
            problem = f"expected at most {MAX_COLUMNS} columns, got {columns:,}"
            raise InputError(where, problem, "Remove columns that are not needed.")
        check_row_count(where, content.end[0] + 1 - first_row)
        for (top, left), (bottom, right) in [*(content.merged_cell_ranges or ()), *details.merged]:
            problem = f"the cells of rows {top + 1} to {bottom + 1} and columns {left + 1} to {right + 1} are merged"
            raise InputError(where, problem, "Unmerge them, and fill each cell.")
        used_rows = []
        for number, cells in enumerate(content.iter_rows(), start=first_row + 1):
            texts = [_cell_text(cell) for cell in cells]
            for column, text in details.texts.get(number, {}).items():
                if 0 <= column - first_column < columns:
                    texts[column - first_column] = text
            if any(texts):
                count += 1
                check_row_count(path, count)
                used_rows.append(number)
                yield Block({"sheet": name, "row": number}, json.dumps(texts).encode())
        hidden = sorted(set(details.hidden_rows) & set(used_rows))
        if hidden:
            problem = f"rows with values are hidden: {list_first(list(map(str, hidden)), _MAX_NAMED)}"
            raise InputError(where, problem, "Show or delete them.")


def _is_archive_of_other_files(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as archive:
            return not {"[Content_Types].xml", "content.xml"} & set(archive.namelist())
    except zipfile.BadZipFile:
        return False


def _read_details(path: Path, sheets: list[str]) -> dict[str, _SheetDetails]:
    if not zipfile.is_zipfile(path):
        return _read_xls_details(path)
    with zipfile.ZipFile(path) as archive:
        members = set(archive.namelist())
        if "content.xml" in members:
            return _read_ods_details(archive)
        found = {sheet: _sheet_member(archive, sheet) for sheet in sheets}
        return {sheet: _read_xlsx_details(archive, member) for sheet, member in found.items() if member in members}


def _read_xlsx_details(archive: zipfile.ZipFile, member: str) -> _SheetDetails:
    from defusedxml.ElementTree import iterparse

    details = _SheetDetails()
    with archive.open(member) as content:
        for _, element in iterparse(content, ("end",)):
            tag = element.tag.rpartition("}")[2]
            if tag == "c":
                text = _unread_text(element)
                position = _CELL_POSITION.fullmatch(element.get("r", ""))
                if text and position is not None:
                    column = reduce(lambda number, letter: 26 * number + ord(letter) - 64, position[1], 0) - 1
                    details.texts.setdefault(int(position[2]), {})[column] = text
            elif tag == "row":
                if element.get("hidden") in ("1", "true") and element.get("r", "").isdecimal():
                    details.hidden_rows.append(int(element.get("r")))
                element.clear()
    return details


def _unread_text(cell: Element) -> str:
    """Return the error of a cell's formula, or that it has no value; empty for other cells."""
    parts = {child.tag.rpartition("}")[2]: child.text or "" for child in cell}
    if cell.get("t") == "e":
        return parts.get("v", "") or "#ERROR!"
    is_text = cell.get("t") == "str"  # may be empty
    return NO_VALUE if "f" in parts and not parts.get("v") and not is_text else ""


def _read_ods_details(archive: zipfile.ZipFile) -> dict[str, _SheetDetails]:
    from defusedxml.ElementTree import iterparse

    all_details: dict[str, _SheetDetails] = {}
    details, row, column = _SheetDetails(), 0, 0
    with archive.open("content.xml") as content:
        for event, element in iterparse(content, ("start", "end")):
            attributes = {key.rpartition("}")[2]: value for key, value in element.attrib.items()}
            match event, element.tag.rpartition("}")[2]:
                case "start", "table":
                    details, row = _SheetDetails(), 0
                    all_details[attributes.get("name", "")] = details
                case "start", "table-row":
                    column = 0
                case "end", "table-cell" | "covered-table-cell":
                    if text := _ods_error(element, attributes):
                        details.texts.setdefault(row + 1, {})[column] = text
                    right = column + int(attributes.get("number-columns-spanned", 1)) - 1
                    bottom = row + int(attributes.get("number-rows-spanned", 1)) - 1
                    if (right, bottom) != (column, row):
                        details.merged.append(((row, column), (bottom, right)))
                    column += int(attributes.get("number-columns-repeated", 1))
                case "end", "table-row":
                    count = int(attributes.get("number-rows-repeated", 1))
                    if attributes.get("visibility", "visible") != "visible":
                        details.hidden_rows += range(row + 1, row + 1 + min(count, MAX_ROWS))
                    row += count
                    element.clear()
    return all_details


def _ods_error(cell: Element, attributes: dict[str, str]) -> str:
    """Return the error of a cell's formula, for which LibreOffice writes the value 0; or that it has no value."""
    text = "".join(part.text or "" for part in cell if part.tag.endswith("}p"))
    if "formula" not in attributes:
        return ""
    types = [value for key, value in cell.attrib.items() if key.endswith("}value-type")]
    if "error" in types:
        return text or "#ERROR!"
    return "" if types or text else NO_VALUE


def _read_xls_details(path: Path) -> dict[str, _SheetDetails]:
    import xlrd

    all_details = {}
    with xlrd.open_workbook(path, formatting_info=True) as book:
        for sheet in book.sheets():
            details = all_details[sheet.name] = _SheetDetails()
            details.hidden_rows = [row + 1 for row, info in sheet.rowinfo_map.items() if info.hidden]
            for row in range(sheet.nrows):
                for column, kind in enumerate(sheet.row_types(row)):
                    if kind == xlrd.XL_CELL_ERROR:
                        text = xlrd.error_text_from_code.get(sheet.cell_value(row, column), "#ERROR!")
                        details.texts.setdefault(row + 1, {})[column] = text
    return all_details


def _sheet_member(archive: zipfile.ZipFile, sheet: str) -> str:
    """Return the name of the file in an xlsx file that has a sheet; empty if the sheet is missing."""
    from defusedxml.ElementTree import parse

    try:
        with archive.open("xl/workbook.xml") as workbook, archive.open("xl/_rels/workbook.xml.rels") as links:
            sheets = {entry.get("name"): entry for entry in parse(workbook).iter() if entry.tag.endswith("}sheet")}
            targets = {link.get("Id"): link.get("Target", "") for link in parse(links).iter()}
    except KeyError:
        return ""
    target = next((targets[value] for value in sheets[sheet].attrib.values() if value in targets), "")
    return target.removeprefix("/") if target.startswith("/") else f"xl/{target}"


def _cell_text(value: object) -> str:
    """Return a cell as it would be written in CSV."""
    match value:
        case bool():
            return str(value).lower()
        case float() if value.is_integer() and abs(value) < 1e15:
            return str(int(value))
        case datetime.timedelta():
            minutes, seconds = divmod(round(value.total_seconds()), 60)
            return _clock_text(minutes // 60, minutes % 60, seconds)
        case datetime.datetime() | datetime.date():
            return value.isoformat()
        case datetime.time():
            return _clock_text(value.hour, value.minute, value.second)
    return str(value)


def _clock_text(hours: int, minutes: int, seconds: int) -> str:
    return f"{hours:02d}:{minutes:02d}" + (f":{seconds:02d}" if seconds else "")


if __name__ == "__main__":
    serve(_read_workbook)
