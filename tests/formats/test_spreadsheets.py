"""Tables that people make: encodings, separators, emptied cells, workbooks, and all errors at once."""

from __future__ import annotations

import datetime
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from egvs.core.errors import InputError
from egvs.core.numbers import number_or_nan
from egvs.formats import workbooks
from egvs.formats.spreadsheets import parse_rows, read_rows
from tests.formats.workbooks import encrypted_workbook, write_ods, write_xls, write_xlsx

Row = tuple[str, dict[str, str]]


def read(path: Path) -> list[Row]:
    table = read_rows(path, lambda names: [name.casefold() for name in names])
    assert not table.errors
    return table.rows


def read_bytes(tmp_path: Path, content: bytes) -> list[Row]:
    path = tmp_path / "t.csv"
    path.write_bytes(content)
    return read(path)


TEXT = "A;b;name\r\n1; x ;Öl\r\n\r\n;;\r\n2;y;“a”"


@pytest.mark.parametrize(
    "content",
    [
        b"A,b,name\n1, x ,\xc3\x96l\n\n,,\n2,y,\xe2\x80\x9ca\xe2\x80\x9d\n",
        TEXT.encode("utf-8-sig"),
        TEXT.encode("utf-16"),
        b"\xfe\xff" + TEXT.encode("utf-16-be"),
        TEXT.encode("cp1252"),
        TEXT.replace(";", "\t").encode("utf-16"),
    ],
    ids=["UTF-8", "UTF-8 with BOM", "UTF-16", "UTF-16 big-endian", "Windows-1252", "tabs"],
)
def test_encodings_and_separators_give_the_same_rows(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "t.csv"
    first, second = read_bytes(tmp_path, content)
    assert first == (f"{path}: line 2", {"a": "1", "b": "x", "name": "Öl"})
    assert second == (f"{path}: line 5", {"a": "2", "b": "y", "name": "“a”"})


@pytest.mark.parametrize("first_line", ["sep=;", '"sep=;"', "SEP=;"])
def test_first_line_names_the_separator(tmp_path: Path, first_line: str) -> None:
    (row,) = read_bytes(tmp_path, f"{first_line}\r\na;b\r\n1;x,y\r\n".encode())
    assert row == (f"{tmp_path / 't.csv'}: line 3", {"a": "1", "b": "x,y"})


def test_emptied_rows_and_columns_are_skipped(tmp_path: Path) -> None:
    (row,) = read_bytes(tmp_path, b",,,,\na,,b,,\n,,,,\n1,,2,,\n,,,,\n")
    assert row == (f"{tmp_path / 't.csv'}: line 4", {"a": "1", "b": "2"})


def test_named_column_without_values_stays(tmp_path: Path) -> None:
    assert read_bytes(tmp_path, b"a,note\n1,\n")[0][1] == {"a": "1", "note": ""}


@pytest.mark.parametrize("content", [b"a;b\n8,5;-1,25\n1,500;2\n", b'a,b\n"8,5","-1,25"\n"1,500",2\n'])
def test_decimal_commas(tmp_path: Path, content: bytes) -> None:
    rows = [values for _, values in read_bytes(tmp_path, content)]
    assert rows == [{"a": "8.5", "b": "-1.25"}, {"a": "1.500", "b": "2"}]


def test_commas_in_other_texts_stay(tmp_path: Path) -> None:
    assert read_bytes(tmp_path, b"a;b\nx, y;1,2,3\n")[0][1] == {"a": "x, y", "b": "1,2,3"}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a,b\n1,2\n1\n", r"t.csv: line 3: expected 2 values, got 1. Check the separators"),
        (b"a,b\n1,2,3\n", r"t.csv: line 2: expected 2 values, got 3. Check the separators"),
        (b"a,,b,c\n1,2,3\n", r"t.csv: header: column 2 has no name, but line 2 has the value '2' there"),
        (b"a,,b,c\n1,,3\n", r"t.csv: line 2: expected 4 values, got 3"),
        (b"a,a\n1,2\n", r"t.csv: header: two columns are called 'a'"),
        (b'a,b\n"1"x,2\n', r"t.csv: line 2: is not CSV"),
        (b"a|b\n1|2\n", r"t.csv: the columns are separated by '\|'. Use commas or semicolons"),
        (b"a;b\n1;2,500\n", r"t.csv: line 2: b: 2,500 can mean 2500 or 2.500"),
        (b"a;b\n1;2,5\n1;1.500\n", r"t.csv: line 3: b: 1.500 can mean 1500 or 1.500"),
        (
            b"Sites of the town,,\n,,\na,b\n1,2\n",
            r"t.csv: line 1: .* got 'Sites of the town'. Remove what is above the names \(line 3\?\)",
        ),
        (b"# by hand\na,b\n1,2\n", r"t.csv: line 1: expected the names of the columns, got '# by hand'"),
        (
            b"Count of 12 May;Knoten 5;;;\n;;;;\nBearbeiter;Meier;;;\n;;;;\n"
            b"Street;Arm;Abbieger;Start;Count\nA;N;left;07:00;5\n",
            r"t.csv: line 1: expected the names of the columns, got 'Count of 12 May'. Remove .* \(line 5\?\)",
        ),
        (
            b"Crossing, north side\nMeier\n\na;b\n1;2\n",
            r"t.csv: line 1: .* got 'Crossing, north side'. .* \(line 4\?\)",
        ),
        (b"<html><table><tr><td>a</td></tr></table></html>", r"t.csv: expected a table, got HTML or XML"),
        (b'<?xml version="1.0"?><Workbook/>', r"t.csv: expected a table, got HTML or XML"),
        (b"", r"t.csv: expected a header and rows, got no values"),
        (b"a,b\n\x81,2\n", r"t.csv: is no text in a known encoding \(byte 4\)"),
        (b"a,b\n1\0,2\n", r"t.csv: is no text: it has the control character"),
        ("a;b\n1;2\n".encode("utf-16-le"), r"t.csv: is no text: it has the control character"),
        (b"\xff\xfea", r"t.csv: is no text in a known encoding"),
        (b",".join(b"c%d" % n for n in range(501)) + b"\n", r"t.csv: expected at most 500 columns, got 501"),
    ],
)
def test_mistakes_give_one_message(tmp_path: Path, content: bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse(tmp_path, content)


def parse(tmp_path: Path, content: bytes) -> list[float]:
    path = tmp_path / "t.csv"
    path.write_bytes(content)

    def parse_row(where: str, values: dict[str, str]) -> Iterator[float]:
        value = number_or_nan(values["a"])
        if not value > 0:
            raise InputError(f"{where}: a", f"expected a number above 0, got {values['a']!r}", "Correct it.")
        yield value

    return parse_rows(path, lambda names: names, parse_row)


def test_errors_of_all_rows_are_reported_together(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        parse(tmp_path, b"a,b\nx,1\n2,1\n3\n0,1\nx,2\n")
    assert str(caught.value).replace(str(tmp_path), "") == (
        "/t.csv: line 4: expected 2 values, got 1. Check the separators, and the quotes around values with one.\n"
        "/t.csv: line 2: a, line 6: a: expected a number above 0, got 'x'. Correct it.\n"
        "/t.csv: line 5: a: expected a number above 0, got '0'. Correct it."
    )


def test_large_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_DOCUMENT_MB", "1")
    with pytest.raises(InputError, match="EGVS_MAX_DOCUMENT_MB"):
        read_bytes(tmp_path, b"a,b\n" + b"1,2\n" * 300_000)


# ---- workbooks

ROWS = (
    ("site", "start", "x_m", "ok", None),
    (),
    ("k1", datetime.time(7, 15), 8.5, True, None),
    ("k2", "08:00", 7, "8,5"),
)


@pytest.mark.slow
@pytest.mark.system
def test_workbook(tmp_path: Path) -> None:
    path = tmp_path / "t.xlsx"
    write_xlsx(path, {"Sites": ROWS, "Draft": (("anything", 1),)}, hidden=("Draft",))
    assert read(path) == [
        (f"{path}: row 3", {"site": "k1", "start": "07:15", "x_m": "8.5", "ok": "true"}),
        (f"{path}: row 4", {"site": "k2", "start": "08:00", "x_m": "7", "ok": "8.5"}),
    ]


@pytest.mark.slow
@pytest.mark.system
def test_open_document(tmp_path: Path) -> None:
    path = tmp_path / "t.ods"
    write_ods(path, [("a", "b"), ("x", 1.5)])
    assert read(path) == [(f"{path}: row 2", {"a": "x", "b": "1.5"})]


@pytest.mark.slow
@pytest.mark.system
def test_sheet_with_the_expected_header_is_read(tmp_path: Path) -> None:
    def check_header(names: list[str]) -> list[str]:
        if names != ["a", "b"]:
            raise InputError("header", f"expected a, b, got {names}")
        return names

    path = tmp_path / "t.xlsx"
    table = (("a", "b"), (1, 2))
    write_xlsx(path, {"Notes": (("written by", "me"),), "Data": table})
    assert read_rows(path, check_header).rows == [(f"{path}: sheet 'Data': row 2", {"a": "1", "b": "2"})]
    write_xlsx(path, {"Old": table, "New": table})
    with pytest.raises(InputError, match=r"expected one sheet with this kind of table, got 2 \('Old', 'New'\)"):
        read_rows(path, check_header)
    write_xlsx(path, {"Notes": (("written by", "me"),)})
    with pytest.raises(InputError, match="expected a, b"):
        read_rows(path, check_header)


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("content", [b"PK\x03\x04damaged", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1damaged"])
def test_damaged_workbook(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "t.xlsx"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"t\.xlsx: cannot be read as a workbook"):
        read(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "suffix", [pytest.param(suffix, marks=pytest.mark.system) for suffix in ("xlsx", "ods", "xls")] + ["csv"]
)
def test_errors_of_formulas_are_named_in_any_column(tmp_path: Path, suffix: str) -> None:
    """A reader would see an empty cell, or 0."""
    path = tmp_path / f"t.{suffix}"
    rows = [("site", "x_m", "note"), ("k1", "#DIV/0!", "No. 1"), ("k2", 1.5, "#REF!"), ("k3", "#REF!", "#DIV/0!")]
    if suffix == "xlsx":
        write_xlsx(path, {"Other": (("x", "#REF!"),), "Sites": rows}, ["Other"])
    elif suffix == "csv":
        path.write_text("\n".join(",".join(map(str, row)) for row in rows))
    else:
        (write_ods if suffix == "ods" else write_xls)(path, rows)
    table = read_rows(path, lambda names: names)
    row = f"{path}: {'line' if suffix == 'csv' else 'row'}"
    assert table.rows == []
    assert [str(error) for error in table.errors] == [
        f"{row} 2: x_m: expected a value, got the formula error #DIV/0!. Correct the formula.",
        f"{row} 3: note: expected a value, got the formula error #REF!. Correct the formula.",
        f"{row} 4: x_m: expected a value, got the formula error #REF!. Correct the formula.",
        f"{row} 4: note: expected a value, got the formula error #DIV/0!. Correct the formula.",
    ]


@pytest.mark.slow
@pytest.mark.system
def test_archive_of_other_files_is_no_damaged_workbook(tmp_path: Path) -> None:
    path = tmp_path / "t.xlsx"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("sites.csv", "a,b\n1,2\n")
    with pytest.raises(InputError, match=r"t\.xlsx: expected a workbook, got a ZIP archive of other files. Unpack it"):
        read(path)


@pytest.mark.slow
@pytest.mark.system
def test_workbook_with_a_password_is_no_damaged_file(tmp_path: Path) -> None:
    path = tmp_path / "t.xlsx"
    path.write_bytes(encrypted_workbook())
    with pytest.raises(InputError, match=r"t\.xlsx: the workbook is protected by a password"):
        read(path)


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("</sheetData>", "</sheetData><mergeCells><mergeCell ref='B2:B3'/></mergeCells>",
         "sheet 'a': the cells of rows 2 to 3 and columns 2 to 2 are merged. Unmerge them"),
        ("<row r='3'", "<row r='3' hidden='1'", "sheet 'a': rows with values are hidden: 3. Show or delete them."),
    ],
)  # fmt: skip
def test_rejects_cells_that_a_reader_cannot_see(tmp_path: Path, before: str, after: str, message: str) -> None:
    path = _edited_workbook(tmp_path, before, after)
    with pytest.raises(InputError) as caught:
        read(path)
    assert message in str(caught.value)


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize(
    ("cell", "value"),
    [("<f>1+1</f>", None), ("<f>1+1</f><v>2</v>", "2"), ("<f>1+1</f><v></v>", None)],
)
def test_formula_without_a_value_is_no_empty_cell(tmp_path: Path, cell: str, value: str | None) -> None:
    """Programs that write workbooks do not compute."""
    path = _edited_workbook(tmp_path, "<c r='B2'><v>2</v></c>", f"<c r='B2'>{cell}</c>")
    if value is not None:
        assert read(path)[0][1] == {"a": "1", "b": value}
    else:
        (error,) = read_rows(path, list).errors
        assert str(error) == (
            f"{path}: row 2: b: a formula without a value. Open the table in a spreadsheet program, and save it."
        )


@pytest.mark.slow
@pytest.mark.system
def test_formula_may_give_an_empty_text(tmp_path: Path) -> None:
    path = _edited_workbook(tmp_path, "<c r='B2'><v>2</v></c>", "<c r='B2' t='str'><f>IF(A1>1,2,\"\")</f><v></v></c>")
    assert read(path)[0][1] == {"a": "1", "b": ""}


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        (" office:value-type='string'><text:p>x</", " table:number-rows-spanned='2'><text:p>x</",
         "sheet 'a': the cells of rows 2 to 3 and columns 1 to 1 are merged. Unmerge them"),
        ("<table:table-row><table:table-cell office:value-type='string'><text:p>x</",
         "<table:table-row table:visibility='filter'><table:table-cell office:value-type='string'><text:p>x</",
         "sheet 'a': rows with values are hidden: 2. Show or delete them."),
    ],
)  # fmt: skip
def test_rejects_cells_of_open_documents_that_a_reader_cannot_see(
    tmp_path: Path, before: str, after: str, message: str
) -> None:
    plain, path = tmp_path / "plain.ods", tmp_path / "t.ods"
    write_ods(plain, [("a", "b"), ("x", 1.5), ("y", 2.5)])
    _edit_archive(plain, path, before, after)
    with pytest.raises(InputError) as caught:
        read(path)
    assert message in str(caught.value)


@pytest.mark.slow
@pytest.mark.system
def test_rejects_hidden_rows_of_excel_97(tmp_path: Path) -> None:
    path = tmp_path / "t.xls"
    write_xls(path, [("a", "b"), ("x", 1.5), ("y", 2.5)])
    assert [cells for _, cells in read(path)] == [{"a": "x", "b": "1.5"}, {"a": "y", "b": "2.5"}]
    write_xls(path, [("a", "b"), ("x", 1.5), ("y", 2.5)], hidden=[2])
    with pytest.raises(InputError, match=r"sheet 'a': rows with values are hidden: 3\. Show or delete them"):
        read(path)


def _edited_workbook(folder: Path, before: str, after: str) -> Path:
    plain, path = folder / "plain.xlsx", folder / "t.xlsx"
    write_xlsx(plain, {"a": (("a", "b"), (1, 2), (3, 4))})
    _edit_archive(plain, path, before, after)
    return path


def _edit_archive(source: Path, target: Path, before: str, after: str) -> None:
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            new.writestr(name, old.read(name).decode().replace(before, after))


@pytest.mark.slow
@pytest.mark.system
def test_number_of_rows_has_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A million rows in a few kilobytes; lines without values do not count, and need no memory."""
    path = tmp_path / "t.xlsx"
    write_xlsx(path, {"a": (("a", "b"), (1, 2), ("x",))})
    far = tmp_path / "far.xlsx"
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(far, "w") as new:
        for name in old.namelist():
            new.writestr(name, old.read(name).replace(b"'A3'", b"'A600000'").replace(b"row r='3'", b"row r='600000'"))
    with pytest.raises(InputError, match=r"far\.xlsx: sheet 'a': has more than 500,000 rows"):
        read(far)
    monkeypatch.setattr(workbooks, "MAX_ROWS", 2)
    assert len(read_bytes(tmp_path, b"a,b\n" + b"\n" * 1000 + b"1,2\n")) == 1
    with pytest.raises(InputError, match="has more than 2 rows"):
        read_bytes(tmp_path, b"a,b\n1,2\n3,4\n")


@pytest.mark.slow
@pytest.mark.system
def test_cell_in_the_last_corner_needs_no_memory(tmp_path: Path) -> None:
    """A range of a million rows and 16,384 columns is rejected."""
    path = tmp_path / "t.xlsx"
    write_xlsx(path, {"a": (("a", "b"), (1, 2), ("x",))})
    corner = tmp_path / "corner.xlsx"
    _move_last_cell(path, corner)
    with pytest.raises(InputError, match=r"corner\.xlsx: .*(as a workbook|at most 500)"):
        read(corner)


def _move_last_cell(source: Path, target: Path) -> None:
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            content = old.read(name).replace(b"r='A3'", b"r='XFD1048576'").replace(b"<row r='3'", b"<row r='1048576'")
            new.writestr(name, content)
