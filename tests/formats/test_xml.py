"""Reading a user's XML: many encodings are supported; elements that are too large or too deep are rejected."""

from __future__ import annotations

import gzip
from collections.abc import Iterator
from pathlib import Path

import pytest

from egvs.core.errors import InputError
from egvs.formats import xml

ONE_MB = b" " * 1_000_000


@pytest.fixture(autouse=True)
def low_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_ELEMENT_MB", "1")
    monkeypatch.setenv("EGVS_MAX_UNPACKED_MB", "5")


def names(folder: Path, data: bytes) -> list[str | None]:
    """Return the attribute ``name`` of each child."""
    (folder / "a.xml").write_bytes(data)
    return [child.get("name") for child in xml.iter_elements(folder / "a.xml", "net")]


@pytest.mark.parametrize(
    ("declared", "codec"),
    [
        ("Shift_JIS", "cp932"),
        ("shift-jis", "cp932"),
        ("Windows-31J", "cp932"),
        ("EUC-JP", "euc_jp"),
        ("ISO-2022-JP", "iso2022_jp"),
        ("GB2312", "gb18030"),
        ("UTF-8", "utf-8"),
        ("UTF-8", "utf-8-sig"),
        ("UTF-16", "utf-16"),
    ],
)
def test_reads_other_encodings(tmp_path: Path, declared: str, codec: str) -> None:
    text = f'<?xml version="1.0" encoding="{declared}"?>\n<net>' + '<edge name="西新宿表口"/>' * 3000 + "</net>"
    assert names(tmp_path, text.encode(codec)) == ["西新宿表口"] * 3000


def test_reads_windows_1252(tmp_path: Path) -> None:
    assert names(tmp_path, b"<?xml version='1.0' encoding='windows-1252'?><net><e name='\x80'/></net>") == ["€"]


@pytest.mark.parametrize("declared", ["utf-7", "UTF-7", "idna", "rot13", "unicode_escape", "none-such", "utf-32"])
def test_rejects_unsupported_encoding(tmp_path: Path, declared: str) -> None:
    data = f'<?xml version="1.0" encoding="{declared}"?><net/>'.encode()
    with pytest.raises(InputError, match=rf'a.xml: unsupported encoding .*"{declared}"\?>.*Shift_JIS'):
        names(tmp_path, data)


def test_rejects_bytes_that_are_no_text(tmp_path: Path) -> None:
    data = b'<?xml version="1.0" encoding="Shift_JIS"?><net><e name="\x81"/></net>'
    with pytest.raises(InputError, match=r"a.xml: cannot be read \(it is not cp932 text: byte \d+ is 0x81\)"):
        names(tmp_path, data)


def hostile() -> Iterator[tuple[str, bytes, str]]:
    """Yield name, content and message of files that would take much memory."""
    element = "has an element or text of more than 1 MB. The limit is 1 MB; set EGVS_MAX_ELEMENT_MB to raise it"
    yield "text of the root", b"<net>" + ONE_MB * 3 + b"</net>", element
    yield "text between children", b"<net><e/>" + ONE_MB * 3 + b"<e/></net>", element
    yield "rows in one step", b"<net><e>" + b"<v a='1'/>" * 150_000 + b"</e></net>", element
    yield "an attribute", b"<net><e a='" + ONE_MB * 3 + b"'/></net>", element
    yield "a comment", b"<net><!--" + ONE_MB * 3 + b"--></net>", element
    yield "before the root", ONE_MB * 3 + b"<net/>", element
    yield "deep", b"<net>" + b"<e>" * 5000 + b"</e>" * 5000 + b"</net>", "nested more than 100 deep"
    many = b"<net>" + (b"<e/>" + b" " * 900_000) * 6 + b"</net>"
    packed = "holds more than 5 MB after decompression. The limit is 5 MB; set EGVS_MAX_UNPACKED_MB to raise it"
    yield "a bomb", gzip.compress(many, mtime=0), packed
    yield "a bomb without an end", gzip.compress(b"<net>" + ONE_MB * 3, mtime=0), element


@pytest.mark.slow
@pytest.mark.parametrize(("data", "message"), [case[1:] for case in hostile()], ids=[case[0] for case in hostile()])
def test_rejects_large_elements(tmp_path: Path, data: bytes, message: str) -> None:
    with pytest.raises(InputError) as caught:
        names(tmp_path, data)
    assert str(caught.value).startswith(f"{tmp_path / 'a.xml'}: ")
    assert message in str(caught.value)


def test_reads_long_file_of_small_children(tmp_path: Path) -> None:
    data = b"<net>" + (b"<e/>" + b" " * 400_000) * 10 + b"</net>"
    assert len(names(tmp_path, data)) == 10
    assert len(names(tmp_path, gzip.compress(data, mtime=0))) == 10


def test_read_line_rejects_line_without_end(tmp_path: Path) -> None:
    (tmp_path / "fcd.csv.gz").write_bytes(gzip.compress(b"1;2" * 700_000, mtime=0))
    with xml.open_bounded(tmp_path / "fcd.csv.gz") as file, pytest.raises(InputError, match="has an unterminated line"):
        xml.read_line(file, "fcd.csv.gz")


def test_scan_attribute_values_finds_values_across_chunks(tmp_path: Path) -> None:
    """A mebibyte is read at a time; values cross each border."""
    values = [f"{i:07d}," * 9000 for i in range(50)]
    text = "".join(
        f"<lane id='{i}' shape{mark}{v}{mark[1:]} width='3'/>\n" for i, v in enumerate(values) for mark in ('="', "='")
    )
    (tmp_path / "n.net.xml").write_text(text + "<e shape=")
    scanned = [value.decode() for value in xml.scan_attribute_values(tmp_path / "n.net.xml", "shape")]
    assert scanned == [value for value in values for _ in range(2)]


def test_scan_attribute_values_rejects_value_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_ELEMENT_MB", "1")
    (tmp_path / "n.net.xml").write_bytes(b"<net><e shape='" + b"1,2 " * 1_000_000)
    with pytest.raises(InputError, match=r"n.net.xml: has an unterminated value. The limit is 1 MB"):
        list(xml.scan_attribute_values(tmp_path / "n.net.xml", "shape"))
