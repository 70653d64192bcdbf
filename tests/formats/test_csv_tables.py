"""CSV tables that users write: separators, numbers of lines, and one message for each mistake."""

from __future__ import annotations

from pathlib import Path

import pytest

from egvs.core.errors import InputError
from egvs.formats.csv_tables import read_rows


def read(tmp_path: Path, content: bytes) -> list[tuple[str, dict[str, str]]]:
    path = tmp_path / "t.csv"
    path.write_bytes(content)
    return list(read_rows(path, lambda names: [name.casefold() for name in names]))


@pytest.mark.parametrize("content", [b"A,b\n1, x \n\n,\n2,y\n", b"\xef\xbb\xbfA;b\r\n1; x \r\n\r\n;\r\n2;y"])
def test_rows_have_the_lines_of_the_file(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "t.csv"
    first, second = read(tmp_path, content)
    assert first == (f"{path}: line 2", {"a": "1", "b": "x"})
    assert second == (f"{path}: line 5", {"a": "2", "b": "y"})


def test_semicolons_allow_commas_in_values(tmp_path: Path) -> None:
    assert read(tmp_path, b"a;b\n1,5;2\n")[0][1] == {"a": "1,5", "b": "2"}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a,b\n1,2\n1\n", r"t.csv: line 3: expected 2 values, got 1. Check the separators"),
        (b"a,A\n1,2\n", r"t.csv: header: two columns are called 'a'"),
        (b"a,b\n\xff,2\n", r"t.csv: is not UTF-8 text \(byte 4\)"),
        (b'a,b\n"1"x,2\n', r"t.csv: line 2: is not CSV"),
    ],
)
def test_mistakes_give_one_message(tmp_path: Path, content: bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read(tmp_path, content)


def test_large_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_DOCUMENT_MB", "1")
    with pytest.raises(InputError, match="EGVS_MAX_DOCUMENT_MB"):
        read(tmp_path, b"a,b\n" + b"1,2\n" * 300_000)
