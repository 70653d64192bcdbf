"""Small workbooks (xlsx, ods, xls), written as spreadsheet programs write them."""

from __future__ import annotations

import datetime
import struct
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

Cell = str | float | bool | datetime.time | None
Rows = Sequence[Sequence[Cell]]

_TYPES = "http://schemas.openxmlformats.org/package/2006/content-types"
_MAIN = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
_LINKS = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
_PACKAGE = "http://schemas.openxmlformats.org/package/2006/relationships"
_MANIFEST = "<manifest xmlns='urn:oasis:names:tc:opendocument:xmlns:manifest:1.0'/>"
_STYLES = f'<styleSheet xmlns="{_MAIN}"><cellXfs><xf numFmtId="0"/><xf numFmtId="20"/></cellXfs></styleSheet>'  # h:mm


def write_xlsx(path: Path, sheets: Mapping[str, Rows], hidden: Sequence[str] = ()) -> None:
    """Write the sheets of a workbook; times of the day have the format h:mm, and texts with a # are errors."""
    names = list(sheets)
    entries = "".join(
        f"<sheet name={quoteattr(name)} state='{'hidden' if name in hidden else 'visible'}' sheetId='{n}' r:id='s{n}'/>"
        for n, name in enumerate(names)
    )
    links = "".join(
        f"<Relationship Id='s{n}' Type='{_LINKS}/worksheet' Target='sheet{n}.xml'/>" for n in range(len(names))
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("[Content_Types].xml", f"<Types xmlns='{_TYPES}'/>")
        office = f"<Relationship Id='w' Type='{_LINKS}/officeDocument' Target='xl/workbook.xml'/>"
        archive.writestr("_rels/.rels", f"<Relationships xmlns='{_PACKAGE}'>{office}</Relationships>")
        workbook = f"<workbook xmlns='{_MAIN}' xmlns:r='{_LINKS}'><sheets>{entries}</sheets></workbook>"
        archive.writestr("xl/workbook.xml", workbook)
        links += f"<Relationship Id='t' Type='{_LINKS}/styles' Target='styles.xml'/>"
        archive.writestr("xl/_rels/workbook.xml.rels", f"<Relationships xmlns='{_PACKAGE}'>{links}</Relationships>")
        archive.writestr("xl/styles.xml", _STYLES)
        for n, name in enumerate(names):
            rows = "".join(
                f"<row r='{r}'>{''.join(_xlsx_cell(cell, r, c) for c, cell in enumerate(cells))}</row>"
                for r, cells in enumerate(sheets[name], start=1)
            )
            archive.writestr(
                f"xl/sheet{n}.xml", f"<worksheet xmlns='{_MAIN}'><sheetData>{rows}</sheetData></worksheet>"
            )


def _xlsx_cell(value: Cell, row: int, column: int) -> str:
    where = f"r='{chr(65 + column)}{row}'"
    match value:
        case None:
            return ""
        case bool():
            return f"<c {where} t='b'><v>{int(value)}</v></c>"
        case str() if value.startswith("#"):
            return f"<c {where} t='e'><v>{value}</v></c>"
        case str():
            return f"<c {where} t='inlineStr'><is><t>{escape(value)}</t></is></c>"
        case datetime.time():
            return f"<c {where} s='1'><v>{(value.hour * 60 + value.minute) / 1440!r}</v></c>"
    return f"<c {where}><v>{value!r}</v></c>"


def write_ods(path: Path, rows: Rows) -> None:
    """Write a workbook with one sheet of texts and numbers; texts with a # are errors, and None is merged."""
    lines = "".join(f"<table:table-row>{''.join(map(_ods_cell, cells))}</table:table-row>" for cells in rows)
    names = {name: f"urn:oasis:names:tc:opendocument:xmlns:{name}:1.0" for name in ("office", "table", "text")}
    names["calcext"] = "urn:org:documentfoundation:names:experimental:calc:xmlns:calcext:1.0"
    spaces = " ".join(f"xmlns:{name}='{uri}'" for name, uri in names.items())
    sheet = f"<office:spreadsheet><table:table table:name='a'>{lines}</table:table></office:spreadsheet>"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("mimetype", "application/vnd.oasis.opendocument.spreadsheet")
        archive.writestr("META-INF/manifest.xml", _MANIFEST)
        content = f"<office:document-content {spaces}><office:body>{sheet}</office:body></office:document-content>"
        archive.writestr("content.xml", content)


def _ods_cell(value: Cell) -> str:
    if isinstance(value, str):
        kind = "office:value-type='string'"
        if value.startswith(("#", "Err:")):  # as LibreOffice writes them
            kind = "table:formula='of:=x' office:value-type='float' office:value='0' calcext:value-type='error'"
        return f"<table:table-cell {kind}><text:p>{escape(value)}</text:p></table:table-cell>"
    return f"<table:table-cell office:value-type='float' office:value='{value!r}'/>"


def write_xls(path: Path, rows: Rows, hidden: Sequence[int] = ()) -> None:
    """Write a workbook of Excel 97 with the sheet a: texts, numbers, and the errors #DIV/0! and #REF!; rows from 0."""
    stream = _biff(0x809, "<4H", 0x600, 5, 0, 0) + _biff(0xE0, "<20s", b"")
    start = len(stream) + 13 + 4  # after the next two records
    stream += _biff(0x85, "<IBBBB1s", start, 0, 0, 1, 0, b"a") + _biff(0xA, "")
    stream += _biff(0x809, "<4H", 0x600, 16, 0, 0)
    for row in hidden:
        stream += _biff(0x208, "<8H", row, 0, len(rows[row]), 255, 0, 0, 0x20, 0)
    for row, cells in enumerate(rows):
        for column, value in enumerate(cells):
            where = (row, column, 0)
            if isinstance(value, str) and value.startswith("#"):
                stream += _biff(0x205, "<3HBB", *where, {"#DIV/0!": 7, "#REF!": 23}[value], 1)
            elif isinstance(value, str):
                text = value.encode("latin-1")
                stream += _biff(0x204, f"<4HB{len(text)}s", *where, len(text), 0, text)
            elif value is not None:
                stream += _biff(0x203, "<3Hd", *where, value)
    path.write_bytes(_ole_file("Workbook", stream + _biff(0xA, "")))


def _biff(kind: int, layout: str, *values: object) -> bytes:
    content = struct.pack(layout, *values)
    return struct.pack("<2H", kind, len(content)) + content


def encrypted_workbook() -> bytes:
    """The OLE file of a workbook with a password: a folder with the stream EncryptedPackage, which has no meaning."""
    return _ole_file("EncryptedPackage", b"x")


def _ole_file(name: str, stream: bytes) -> bytes:
    """An OLE file with one stream of at most 4,096 bytes."""
    free, end, table = 0xFFFFFFFF, 0xFFFFFFFE, 0xFFFFFFFD
    head = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1".ljust(24, b"\0") + struct.pack("<5H6x", 62, 3, 0xFFFE, 9, 6)
    head += struct.pack("<9I", 0, 1, 1, 0, 4096, end, 0, end, 0) + struct.pack("<109I", 0, *[free] * 108)
    sectors = struct.pack("<128I", table, end, *range(3, 10), end, *[free] * 118)
    folder = _ole_entry("Root Entry", 5, 1, end, 0) + _ole_entry(name, 2, free, 2, 4096)
    return head + sectors + folder.ljust(512, b"\0") + stream.ljust(4096, b"\0")


def _ole_entry(name: str, kind: int, child: int, start: int, size: int) -> bytes:
    text = f"{name}\0".encode("utf-16-le")
    links = struct.pack("<HBB3I36x", len(text), kind, 1, 0xFFFFFFFF, 0xFFFFFFFF, child)
    return text.ljust(64, b"\0") + links + struct.pack("<IQ", start, size)
