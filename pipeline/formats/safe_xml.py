"""A user's XML file is read without trusting it, and without holding it whole.

Steps: undo gzip where the first two bytes say so; bring other encodings to UTF-8
(:mod:`pipeline.core.reading.encodings`); parse with defusedxml, which refuses entities and document types; hand out one
child of the root at a time and forget it. What a packed file holds, and how large and how deep a child is, has a bound.
Whatever is wrong with the file becomes an :class:`InputError` that names it (for a copy: that names what the user
named).
"""

from __future__ import annotations

import gzip
import io
import re
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, cast
from xml.etree.ElementTree import Element, ParseError, TreeBuilder

from pipeline.core.errors import InputError
from pipeline.core.reading import limits
from pipeline.core.reading.encodings import IN_WORDS, OF_THE_PARSER, AsUtf8, encoding_of
from pipeline.core.reading.refusing import reading

_GZIP = b"\x1f\x8b"
_HEAD_BYTES = 512
_DEEPEST = 100
"""Elements in one another; of what is read here, none needs ten."""


def is_gzip(path: Path) -> bool:
    """Whether the file's first bytes are those of gzip, whatever its name says."""
    with path.open("rb") as file:
        return file.read(2) == _GZIP


@contextmanager
def opened(path: Path, name: Path | None = None) -> Iterator[IO[bytes]]:
    """The file's bytes, unzipped; a damaged gzip, or one that holds too much, becomes an InputError."""
    try:
        if not is_gzip(path):
            with path.open("rb") as file:
                yield file
        else:
            with gzip.open(path) as packed:
                yield cast(IO[bytes], io.BufferedReader(_Bounded(cast(IO[bytes], packed), name or path), 1 << 17))
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        problem = f"is a damaged gzip file ({error})"
        raise InputError(name or path, problem, "a whole file; fetch or make it again") from None


def line_of(file: IO[bytes], place: object) -> bytes:
    """The next line of a file; InputError where it is too long to be one."""
    most = limits.ELEMENT.most * limits.MB
    line = file.readline(most + 1)
    limits.ELEMENT.check_bytes(place, len(line), "has a line without end")
    return line


def children(
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
    encoding = encoding_of_file(path, place)
    own = encoding in OF_THE_PARSER
    with opened(path, name) as file, reading(place, "a whole XML file"):
        meter = _Meter(file if own else AsUtf8(file, encoding), place)
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
                if depth > _DEEPEST:
                    raise InputError(place, f"elements stand more than {_DEEPEST} deep in one another", "flatter XML")
                if event == "end" and depth == 0:
                    meter.since = 0
                    yield element
                    top.clear()
        except ParseError as error:
            raise InputError(place, f"is not well-formed XML: {error}", "a whole XML file") from None
        except DefusedXmlException:
            what = "declares XML entities or a document type, which are refused"
            raise InputError(place, what, "a file without <!DOCTYPE ...>") from None


def values_of(path: Path, attribute: str) -> Iterator[bytes]:
    """A quick look at the values of an attribute, as they stand in the file; nothing is parsed, comments are not told
    apart. InputError where one is too long."""
    start = f"{attribute}=".encode()
    whole = re.compile(start + rb"""(?:"([^"]*)"|'([^']*)')""")
    with opened(path) as file:
        left = b""
        while chunk := file.read(1 << 20):
            data, end = left + chunk, 0
            for found in whole.finditer(data):
                yield found[1] or found[2] or b""
                end = found.end()
            begun = data.rfind(start, end)
            left = data[begun - 1 if begun > 0 else 0 :] if begun >= 0 else data[-len(start) :]
            limits.ELEMENT.check_bytes(path, len(left), "has a value without end")


def encoding_of_file(path: Path, name: Path | None = None) -> str:
    """Python's name of the encoding of an XML file; InputError where it is not one that is read."""
    with opened(path, name) as file:
        start = file.read(_HEAD_BYTES)
    if (encoding := encoding_of(start)) is None:
        declared = start.partition(b"?>")[0].decode("ascii", "replace")
        raise InputError(name or path, f"is in an encoding that is not read ({declared}?>)", IN_WORDS)
    return encoding


def copy_as_utf8(path: Path, to: Path) -> None:
    """Write a file in another encoding anew, in UTF-8 and without the declaration that says otherwise."""
    with opened(path) as file, to.open("wb") as copy:
        text = AsUtf8(file, encoding_of_file(path))
        start = text.read(_HEAD_BYTES)
        while b"?>" not in start and (more := text.read(_HEAD_BYTES)):
            start += more
            limits.ELEMENT.check_bytes(path, len(start), "has no end of its declaration")
        copy.write(start.partition(b"?>")[2])
        while chunk := text.read(1 << 20):
            copy.write(chunk)


class _Bounded(io.RawIOBase):
    """What a packed file holds, up to the bound; beyond, InputError."""

    def __init__(self, file: IO[bytes], place: object) -> None:
        self._file, self._place, self._bytes = file, place, 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        chunk = self._file.read(len(buffer))
        self._bytes += len(chunk)
        limits.UNPACKED.check_bytes(self._place, self._bytes, f"holds more than {limits.UNPACKED.most:,} MB, unpacked")
        buffer[: len(chunk)] = chunk
        return len(chunk)


class _Meter:
    """Counts what is read since the last child; InputError where one is too large to be held."""

    def __init__(self, file: IO[bytes] | AsUtf8, place: object) -> None:
        self._file, self._place, self.since = file, place, 0
        self._most = limits.ELEMENT.most

    def read(self, size: int) -> bytes:
        chunk = self._file.read(size)
        self.since += len(chunk)
        if self.since > self._most * limits.MB + size:
            found = f"has an element, or a text, of more than {self._most:,} MB"
            raise InputError(self._place, found, limits.ELEMENT.right)
        return chunk
