"""A user's XML, read safely and piece by piece.

Says in which encoding an XML file is written, and hands its bytes out as UTF-8.

An XML parser knows UTF-8, UTF-16, Latin-1 and ASCII. Files declare others: Shift_JIS and EUC-JP are everyday in Japan.
Those of :data:`DECODED_ENCODINGS` are decoded here, by Python's own tables; any other one is refused, UTF-7 above
all, in which
plain letters may stand for markup.

A user's XML file is read without trusting it, and without holding it whole.

Steps: undo gzip where the first two bytes say so; bring other encodings to UTF-8
(:mod:`egvs.formats.xml`); parse with defusedxml, which refuses entities and document types; hand out one
child of the root at a time and forget it. What a packed file holds, and how large and how deep a child is, has a bound.
Whatever is wrong with the file becomes an :class:`InputError` that names it (for a copy: that names what the user
named).
"""

from __future__ import annotations

import codecs
import gzip
import io
import re
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, cast
from xml.etree.ElementTree import Element, ParseError, TreeBuilder

from egvs.core import files, limits
from egvs.core.errors import InputError
from egvs.core.reading import translate_errors

PARSER_ENCODINGS = frozenset({"utf-8", "utf-16", "iso8859-1", "ascii"})
"""Python's names of what an XML parser reads itself."""

DECODED_ENCODINGS = frozenset(
    {"cp932", "euc_jp", "iso2022_jp", "gb18030", "gbk", "gb2312", "big5", "euc_kr", "koi8-r"}
    | {f"cp125{n}" for n in range(9)}
    | {f"iso8859-{n}" for n in range(2, 17)}
)
"""Python's names of what is decoded here."""

SUPPORTED_ENCODINGS = "UTF-8, UTF-16, Shift_JIS, EUC-JP, ISO-8859-x, windows-125x, GB18030, Big5 or EUC-KR"
_WHATWG_SUPERSETS = {"shift_jis": "cp932", "gb2312": "gb18030", "gbk": "gb18030"}
"""What is declared as one of these is in practice, and by the WHATWG's Encoding Standard, its superset."""
_ALIASES = {"windows-31j": "cp932", "x-sjis": "cp932"}

_ENCODING_DECLARATION = re.compile(rb"""(?:\xef\xbb\xbf)?<\?xml[^>]*?\bencoding\s*=\s*["']([^"']{0,80})["']""")
_DECLARATION_BYTES = 512
_UTF_16_STARTS = (b"\xff\xfe", b"\xfe\xff", b"<\x00", b"\x00<")


def detect_encoding(start: bytes) -> str | None:
    """Python's name of the encoding that the ``start`` of an XML file shows; None for one that nobody knows."""
    if start.startswith(_UTF_16_STARTS):
        return "utf-16"
    declared = _ENCODING_DECLARATION.match(start[:_DECLARATION_BYTES])
    if declared is None:
        return "utf-8"
    try:
        name = declared[1].decode("ascii").lower()
        name = codecs.lookup(_ALIASES.get(name, name)).name
    except (LookupError, UnicodeDecodeError, ValueError):
        return None
    name = _WHATWG_SUPERSETS.get(name, name)
    return name if name in PARSER_ENCODINGS | DECODED_ENCODINGS else None


class Utf8Reader:
    """A file in another encoding, to be read as UTF-8; UnicodeDecodeError where its bytes are no text."""

    def __init__(self, file: IO[bytes], encoding: str) -> None:
        self._file, self._decoder = file, codecs.getincrementaldecoder(encoding)()

    def read(self, size: int) -> bytes:
        """At least one byte, of about ``size`` of the file's own; none at its end."""
        while chunk := self._file.read(size):
            if text := self._decoder.decode(chunk):
                return text.encode("utf-8")
        return self._decoder.decode(b"", final=True).encode("utf-8")


_GZIP_MAGIC = b"\x1f\x8b"
_HEAD_BYTES = 512
_MAX_DEPTH = 100
"""Elements in one another; of what is read here, none needs ten."""


def is_gzip(path: Path) -> bool:
    """Whether the file's first bytes are those of gzip, whatever its name says."""
    with files.open_input(path) as file:
        return file.read(2) == _GZIP_MAGIC


@contextmanager
def open_bounded(path: Path, name: Path | None = None) -> Iterator[IO[bytes]]:
    """The file's bytes, unzipped; a damaged gzip, or one that holds too much, becomes an InputError."""
    try:
        if not is_gzip(path):
            with files.open_input(path) as file:
                yield file
        else:
            with files.open_input(path) as file, gzip.open(file) as packed:
                yield cast(IO[bytes], io.BufferedReader(_BoundedReader(cast(IO[bytes], packed), name or path), 1 << 17))
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        problem = f"is a damaged gzip file ({error})"
        raise InputError(name or path, problem, "a whole file; fetch or make it again") from None


def read_line(file: IO[bytes], where: object) -> bytes:
    """The next line of a file; InputError where it is too long to be one."""
    most = limits.ELEMENT.maximum * limits.MB
    line = file.readline(most + 1)
    limits.ELEMENT.check_bytes(where, len(line), "has a line without end")
    return line


def iter_elements(
    path: Path, root: str, name: Path | None = None, on_root: Callable[[Element], None] | None = None
) -> Iterator[Element]:
    """The children of the root element one by one, each whole; a child is forgotten when the next is asked for.
    ``on_root`` gets the root, with its attributes, before the first child.

    Raises
    ------
    InputError
        When the root is not ``root`` (where that is not empty), the XML is malformed or declares entities or a
        document type, a child is too large or too deep, its gzip is damaged, or its encoding is not known.
    """
    from defusedxml.common import DefusedXmlException
    from defusedxml.ElementTree import DefusedXMLParser, iterparse

    place = name or path
    encoding = file_encoding(path, place)
    own = encoding in PARSER_ENCODINGS
    with open_bounded(path, name) as file, translate_errors(place, "a whole XML file"):
        meter = _ElementMeter(file if own else Utf8Reader(file, encoding), place)
        parser = DefusedXMLParser(target=TreeBuilder(), encoding=None if own else "utf-8", forbid_dtd=True)
        events: Iterator[tuple[str, Any]] = iterparse(meter, ("start", "end"), parser)
        try:
            _, top = next(events)
            if root and top.tag != root:
                raise InputError(place, f"its root is <{top.tag}>", f"a file whose root is <{root}>")
            if on_root is not None:
                on_root(top)
            depth = 0
            for event, element in events:
                depth += 1 if event == "start" else -1
                if depth > _MAX_DEPTH:
                    raise InputError(place, f"elements stand more than {_MAX_DEPTH} deep in one another", "flatter XML")
                if event == "end" and depth == 0:
                    meter.since = 0
                    yield element
                    top.clear()
        except ParseError as error:
            raise InputError(place, f"is not well-formed XML: {error}", "a whole XML file") from None
        except DefusedXmlException:
            what = "declares XML entities or a document type, which are refused"
            raise InputError(place, what, "a file without <!DOCTYPE ...>") from None


def scan_attribute_values(path: Path, attribute: str) -> Iterator[bytes]:
    """A quick look at the values of an attribute, as they stand in the file; nothing is parsed, comments are not told
    apart. InputError where one is too long."""
    start = f"{attribute}=".encode()
    whole = re.compile(start + rb"""(?:"([^"]*)"|'([^']*)')""")
    with open_bounded(path) as file:
        left = b""
        while chunk := file.read(1 << 20):
            data, end = left + chunk, 0
            for found in whole.finditer(data):
                yield found[1] or found[2] or b""
                end = found.end()
            begun = data.rfind(start, end)
            left = data[begun - 1 if begun > 0 else 0 :] if begun >= 0 else data[-len(start) :]
            limits.ELEMENT.check_bytes(path, len(left), "has a value without end")


def file_encoding(path: Path, name: Path | None = None) -> str:
    """Python's name of the encoding of an XML file; InputError where it is not one that is read."""
    with open_bounded(path, name) as file:
        start = file.read(_HEAD_BYTES)
    if (encoding := detect_encoding(start)) is None:
        declared = start.partition(b"?>")[0].decode("ascii", "replace")
        raise InputError(name or path, f"is in an encoding that is not read ({declared}?>)", SUPPORTED_ENCODINGS)
    return encoding


def copy_as_utf8(path: Path, to: Path) -> None:
    """Write a file in another encoding anew, in UTF-8 and without the declaration that says otherwise."""
    with open_bounded(path) as file, to.open("wb") as copy:
        text = Utf8Reader(file, file_encoding(path))
        start = text.read(_HEAD_BYTES)
        while b"?>" not in start and (more := text.read(_HEAD_BYTES)):
            start += more
            limits.ELEMENT.check_bytes(path, len(start), "has no end of its declaration")
        copy.write(start.partition(b"?>")[2])
        while chunk := text.read(1 << 20):
            copy.write(chunk)


class _BoundedReader(io.RawIOBase):
    """What a packed file holds, up to the bound; beyond, InputError."""

    def __init__(self, file: IO[bytes], where: object) -> None:
        self._file, self._place, self._bytes = file, where, 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        chunk = self._file.read(len(buffer))
        self._bytes += len(chunk)
        limits.UNPACKED.check_bytes(
            self._place, self._bytes, f"holds more than {limits.UNPACKED.maximum:,} MB, unpacked"
        )
        buffer[: len(chunk)] = chunk
        return len(chunk)


class _ElementMeter:
    """Counts what is read since the last child; InputError where one is too large to be held."""

    def __init__(self, file: IO[bytes] | Utf8Reader, where: object) -> None:
        self._file, self._place, self.since = file, where, 0
        self._most = limits.ELEMENT.maximum

    def read(self, size: int) -> bytes:
        chunk = self._file.read(size)
        self.since += len(chunk)
        if self.since > self._most * limits.MB + size:
            found = f"has an element, or a text, of more than {self._most:,} MB"
            raise InputError(self._place, found, limits.ELEMENT.hint)
        return chunk
