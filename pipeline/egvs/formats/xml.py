"""Read a user's XML safely and in pieces, in any common encoding.

Steps: decompress gzip, recognised by the first two bytes; convert encodings that XML parsers do not know to UTF-8;
parse with expat, reject document types, and thereby entities; yield one child of the root at a time and forget it.
The decompressed size, and the size and depth of a child, are limited. Whatever is wrong with the file becomes an
:class:`InputError` that names it.

An XML parser knows UTF-8, UTF-16, Latin-1 and ASCII. Other encodings are common, such as Shift_JIS and EUC-JP in Japan:
those of :data:`DECODED_ENCODINGS` are decoded with Python's tables. All others are rejected, above all UTF-7, in which
plain letters may stand for markup.
"""

from __future__ import annotations

import codecs
import gzip
import io
import re
import zlib
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import IO, Any, cast
from xml.etree.ElementTree import Element, ParseError, TreeBuilder, XMLParser

from egvs.core import limits
from egvs.core.digests import open_input
from egvs.core.errors import InputError
from egvs.core.reading import COMPLETE_FILE, translate_errors

PARSER_ENCODINGS = frozenset({"utf-8", "utf-16", "iso8859-1", "ascii"})
"""Python's names of the encodings that an XML parser reads itself."""

DECODED_ENCODINGS = frozenset(
    {"cp932", "euc_jp", "iso2022_jp", "gb18030", "gbk", "gb2312", "big5", "euc_kr", "koi8-r"}
    | {f"cp125{n}" for n in range(9)}
    | {f"iso8859-{n}" for n in range(2, 17)}
)
"""Python's names of the encodings that are decoded here."""

_ENCODING_HINT = (
    "Save it in UTF-8, UTF-16, Shift_JIS, EUC-JP, ISO-8859-x, windows-125x, GB18030, Big5 or EUC-KR, and declare it."
)
_WHATWG_SUPERSETS = {"shift_jis": "cp932", "gb2312": "gb18030", "gbk": "gb18030"}
"""Declared encodings that in practice, and in the WHATWG's Encoding Standard, mean a superset."""
_ALIASES = {"windows-31j": "cp932", "x-sjis": "cp932"}

_ENCODING_DECLARATION = re.compile(rb"""(?:\xef\xbb\xbf)?<\?xml[^>]*?\bencoding\s*=\s*["']([^"']{0,80})["']""")
_HEAD_BYTES = 512
_CHUNK_BYTES = 1 << 16
_UTF_16_STARTS = (b"\xff\xfe", b"\xfe\xff", b"<\x00", b"\x00<")


def detect_encoding(start: bytes) -> str | None:
    """Return Python's name of the encoding that the ``start`` of an XML file declares; None if it is unknown."""
    if start.startswith(_UTF_16_STARTS):
        return "utf-16"
    declared = _ENCODING_DECLARATION.match(start[:_HEAD_BYTES])
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
    """Reads a file in another encoding as UTF-8; UnicodeDecodeError when its bytes are no text."""

    def __init__(self, file: IO[bytes], encoding: str) -> None:
        self._file, self._decoder = file, codecs.getincrementaldecoder(encoding)()

    def read(self, size: int) -> bytes:
        """Return at least one byte, from about ``size`` bytes of the file; none at its end."""
        while chunk := self._file.read(size):
            text = self._decoder.decode(chunk)
            if text:
                return text.encode("utf-8")
        return self._decoder.decode(b"", final=True).encode("utf-8")


_GZIP_MAGIC = b"\x1f\x8b"
MAX_DEPTH = 100
"""Nesting of elements; no file that is read here needs ten levels."""


def is_gzip(path: Path) -> bool:
    """Return whether the file starts like gzip, whatever its name."""
    with open_input(path) as file:
        return file.read(2) == _GZIP_MAGIC


@contextmanager
def open_bounded(path: Path, name: Path | None = None) -> Iterator[IO[bytes]]:
    """Open a file to read its decompressed bytes.

    InputError when its gzip is damaged or holds too much. Messages contain ``name``, the user's file, for a copy.
    """
    where = name or path
    try:
        with open_input(path) as file:
            if not is_gzip(path):
                yield file
                return
            with gzip.open(file) as unpacked:
                bounded = _BoundedReader(cast(IO[bytes], unpacked), where)
                yield cast(IO[bytes], io.BufferedReader(bounded, 1 << 17))
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise InputError(where, f"damaged gzip file ({error})", COMPLETE_FILE) from None


def read_line(file: IO[bytes], where: object) -> bytes:
    """Return the next line of a file; InputError when it is too long."""
    limit = limits.ELEMENT.maximum * limits.MB
    line = file.readline(limit + 1)
    limits.ELEMENT.check_bytes(where, len(line), "has an unterminated line")
    return line


def iter_elements(
    path: Path, root: str, name: Path | None = None, on_root: Callable[[Element], None] | None = None
) -> Iterator[Element]:
    """Yield the children of the root element one by one, and forget them.

    Parameters
    ----------
    path
        The file.
    root
        Expected tag of the root; any if empty.
    name
        The user's file, for messages, if ``path`` is a copy.
    on_root
        Called with the root and its attributes before the first child.

    Raises
    ------
    InputError
        When the root has another tag, the XML is malformed or declares entities or a document type, a child is too
        large or too deep, its gzip is damaged, or its encoding is unknown.
    """
    children = _Children(name or path, root)
    for meter in _parse(path, name, children):
        if on_root is not None and children.root is not None:
            on_root(children.root)
            on_root = None
        if children.complete:
            meter.bytes_since_child = 0
        yield from children.pop()


def read_root_tag(path: Path) -> str:
    """Return the tag of the root, with its namespace as in ``{http://...}kml``; errors are those of iter_elements."""
    children = _Children(path, "")
    with closing(_parse(path, None, children)) as chunks:
        root = next(children.root for _ in chunks if children.root is not None)
        return str(root.tag)


def scan_tags(path: Path, root: str, on_tag: Callable[[str, dict[str, str]], None], name: Path | None = None) -> None:
    """Call a function with the name and the attributes of each element, the root's first; texts are left out.

    Much faster than :func:`iter_elements`. Parameters and errors are the same, but elements may be nested.
    """
    tags, count = _Tags(name or path, root, on_tag), 0
    for meter in _parse(path, name, tags):
        if tags.count > count:
            count, meter.bytes_since_child = tags.count, 0


def _parse(path: Path, name: Path | None, target: _Tags) -> Generator[_ElementMeter, None, None]:
    """Parse a file; yields after each piece of it what counts its bytes."""
    where = name or path
    encoding = file_encoding(path, where)
    with open_bounded(path, name) as file, translate_errors(where):
        is_decoded = encoding not in PARSER_ENCODINGS
        meter = _ElementMeter(Utf8Reader(file, encoding) if is_decoded else file, where)
        parser = XMLParser(target=target, encoding="utf-8" if is_decoded else None)
        try:
            while chunk := meter.read(_CHUNK_BYTES):
                parser.feed(chunk)
                yield meter
            parser.close()
        except ParseError as error:
            raise InputError(where, f"is not well-formed XML: {error}", COMPLETE_FILE) from None
        yield meter


class _Tags:
    """Passes the start of each element on; the target of a parser.

    Parameters
    ----------
    where
        The file, for messages.
    root
        Expected tag of the root; any if empty.
    on_tag
        Called with the name and the attributes of each element.
    """

    def __init__(self, where: object, root: str, on_tag: Callable[[str, dict[str, str]], object]) -> None:
        self._where, self._expected_root, self._on_tag = where, root, on_tag
        self.count, self._most = 0, limits.XML_ELEMENTS.maximum

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        if self.count == 0 and self._expected_root and tag != self._expected_root:
            problem = f"expected the root element <{self._expected_root}>, got <{tag}>"
            raise InputError(self._where, problem, "Check the file name.")
        self.count += 1
        if self.count > self._most:
            limits.XML_ELEMENTS.check(self._where, self.count, f"has more than {self._most:,} elements")
        self._on_tag(tag, attributes)

    def doctype(self, *_: object) -> None:
        problem = "declares XML entities or a document type, which are not allowed"
        raise InputError(self._where, problem, "Remove <!DOCTYPE ...> from the file.")


class _Children(_Tags):
    """Builds the children of the root element."""

    def __init__(self, where: object, root: str) -> None:
        super().__init__(where, root, self._open)
        self._builder, self._depth = TreeBuilder(), 0
        self.root: Element | None = None
        self.complete: list[Element] = []
        self.data, self.close = self._builder.data, self._builder.close

    def _open(self, tag: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise InputError(self._where, f"elements are nested more than {MAX_DEPTH} deep", COMPLETE_FILE)
        element = self._builder.start(tag, attributes)
        self.root = element if self.root is None else self.root

    def end(self, tag: str) -> None:
        self._depth -= 1
        element = self._builder.end(tag)
        if self._depth == 1:
            self.complete.append(element)

    def pop(self) -> list[Element]:
        """Return the children that are complete, and forget them."""
        complete, self.complete = self.complete, []
        if complete and self.root is not None:
            self.root.clear()
        return complete


def scan_attribute_values(path: Path, attribute: str) -> Iterator[bytes]:
    """Yield the raw values of an attribute without parsing the file; values in comments are included.

    InputError when a value is too long.
    """
    start = f"{attribute}=".encode()
    value = re.compile(start + rb"""(?:"([^"]*)"|'([^']*)')""")
    with open_bounded(path) as file:
        rest = b""
        while chunk := file.read(1 << 20):
            data = rest + chunk
            end = 0
            for match in value.finditer(data):
                yield match[1] or match[2] or b""
                end = match.end()
            # A value, or the attribute's name, may continue in the next chunk.
            begin = data.rfind(start, end)
            rest = data[-len(start) :] if begin < 0 else data[max(begin - 1, 0) :]
            limits.ELEMENT.check_bytes(path, len(rest), "has an unterminated value")


def file_encoding(path: Path, name: Path | None = None) -> str:
    """Return Python's name of the encoding of an XML file; InputError when it is not supported."""
    with open_bounded(path, name) as file:
        start = file.read(_HEAD_BYTES)
    encoding = detect_encoding(start)
    if encoding is None:
        declaration = start.partition(b"?>")[0].decode("ascii", "replace")
        raise InputError(name or path, f"unsupported encoding ({declaration}?>)", _ENCODING_HINT)
    return encoding


class _BoundedReader(io.RawIOBase):
    """The content of a compressed file; InputError when it exceeds the limit."""

    def __init__(self, file: IO[bytes], where: object) -> None:
        self._file, self._where, self._bytes = file, where, 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        chunk = self._file.read(len(buffer))
        self._bytes += len(chunk)
        problem = f"holds more than {limits.UNPACKED.maximum:,} MB after decompression"
        limits.UNPACKED.check_bytes(self._where, self._bytes, problem)
        buffer[: len(chunk)] = chunk
        return len(chunk)


class _ElementMeter:
    """Counts the bytes read since the last child; InputError when a child is too large to be held in memory."""

    def __init__(self, file: IO[bytes] | Utf8Reader, where: object) -> None:
        self._file, self._where, self.bytes_since_child = file, where, 0
        self._max_mb = limits.ELEMENT.maximum

    def read(self, size: int) -> bytes:
        chunk = self._file.read(size)
        self.bytes_since_child += len(chunk)
        if self.bytes_since_child > self._max_mb * limits.MB + size:
            problem = f"has an element or text of more than {self._max_mb:,} MB"
            raise InputError(self._where, problem, limits.ELEMENT.hint)
        return chunk
