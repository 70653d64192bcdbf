"""TOML and JSON of other people are read within bounds, or refused by one message that names the file."""

from __future__ import annotations

from pathlib import Path

import pytest

from egvs.core import reading
from egvs.core.errors import InputError

DEEP = "[" * 5000 + "]" * 5000
DIGITS = "9" * 5000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"a = {DEEP}", "nested too deeply"),
        (f"a = {'[' * 101}{']' * 101}", "nested more than 100 deep"),
        (f"{'.'.join('a' * 3000)} = 1", "nested more than 100 deep"),
        (f"a = {DIGITS}", "a number has too many digits"),
        (f"a = 0x{'f' * 5000}", "a number has too many digits"),
        (f"a = [0x{'f' * 300}]", "a number has too many digits"),
        ("a = '\udcff'", "it is not utf-8 text: byte 5 is 0xff"),
        ("a = 1\na = 2", "Cannot overwrite a value"),
    ],
)
def test_rejects_invalid_toml(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "some.toml"
    file.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError) as refused:
        reading.read_toml(file)
    assert str(refused.value).startswith(f"{file}: is not valid TOML: ")
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("error", "hint"),
    [
        (MemoryError(), "Use a smaller file, or a machine with more memory."),
        (PermissionError(13, "Permission denied"), "Check the path and the permissions."),
        (EOFError("ended"), reading.COMPLETE_FILE),
        (OSError("Not a gzipped file"), reading.COMPLETE_FILE),
    ],
)
def test_only_the_content_of_a_file_makes_it_incomplete(error: Exception, hint: str) -> None:
    with pytest.raises(InputError) as translated, reading.translate_errors("a.bin"):
        raise error
    assert str(translated.value).startswith("a.bin: cannot be read (") and str(translated.value).endswith(hint)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (DEEP.encode(), "nested too deeply"),
        (b"[" * 101 + b"]" * 101, "nested more than 100 deep"),
        (DIGITS.encode(), "a number has too many digits"),
        (b"[" + b"9" * 301 + b"]", "a number has too many digits"),
        (b'{"a": {"b": 1, "c": 2, "b": 3}}', "the key 'b' occurs twice in one object"),
        (b'["\\ud800"]', "it is not valid text"),
        ('["駅"]'.encode("cp932"), "it is not utf-8 text: byte 2 is 0x89"),
        (b"{", "Expecting property name"),
    ],
)
def test_rejects_invalid_json(tmp_path: Path, data: bytes, message: str) -> None:
    file = tmp_path / "some.json"
    file.write_bytes(data)
    with pytest.raises(InputError) as refused:
        reading.read_json(file, "Write a list of stations.")
    assert str(refused.value).startswith(f"{file}: is not valid JSON: ")
    assert str(refused.value).endswith(". Write a list of stations.")
    assert message in str(refused.value)


def test_reads_valid_documents(tmp_path: Path) -> None:
    file = tmp_path / "some.json"
    file.write_text('\ufeff{"a": "\\ud83d\\ude00", "b": [[1e400], {}]}', encoding="utf-8")
    assert reading.read_json(file) == {"a": "😀", "b": [[float("inf")], {}]}
    toml = tmp_path / "some.toml"
    toml.write_bytes(b"a = 1\r\nb = '''x\r\ny'''\r\n")
    assert reading.read_toml(toml) == {"a": 1, "b": "x\ny"}


def test_rejects_large_document_without_opening_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_DOCUMENT_MB", "1")
    file = tmp_path / "large.json"
    with file.open("wb") as sparse:
        sparse.truncate(1_000_001)
    with pytest.raises(InputError, match=r"is a file of 1 MB\. The limit is 1 MB; set EGVS_MAX_DOCUMENT_MB"):
        reading.read_json(file)
