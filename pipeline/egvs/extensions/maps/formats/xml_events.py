"""Read large XML files event by event, with memory that does not grow with the file.

A handler gets the start and the end of each element. Its names have no prefix: a prefix need not be declared, and files
of one format use different ones. Expat of the standard library parses; document types, and thereby entities, are
rejected. Encodings and gzip are those of :mod:`egvs.formats.xml`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Protocol
from xml.parsers import expat

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.reading import COMPLETE_FILE, translate_errors
from egvs.formats import xml
from egvs.formats.xml import MAX_DEPTH, PARSER_ENCODINGS, Utf8Reader

_CHUNK_BYTES = 1 << 16
_MAX_NAMES = 1000


class EventHandler(Protocol):
    """What is done with the elements of a file."""

    def start(self, tag: str, attributes: Mapping[str, str]) -> bool:
        """Handle the start of an element; return whether its text is needed."""
        raise NotImplementedError

    def end(self, tag: str, text: str) -> None:
        """Handle the end of an element; ``text`` is empty unless it was needed, or after child elements."""
        raise NotImplementedError


def local_name(name: str) -> str:
    """Return a name without its prefix: ``Building`` for ``bldg:Building``."""
    return name.rpartition(":")[2]


def iter_events(path: Path, root: str, handler: EventHandler) -> Iterator[None]:
    """Parse a file; yields after each chunk of it, so that the caller can use what the handler has collected.

    Parameters
    ----------
    path
        The file.
    root
        Expected name of the root element, without prefix.
    handler
        Gets the elements, the root included.

    Raises
    ------
    InputError
        When the root has another name, the XML is malformed, declares entities or a document type, is nested too
        deeply, or has an attribute or a text that is too long; when its gzip is damaged or its encoding is unknown.
    """
    encoding = xml.file_encoding(path)
    with xml.open_bounded(path) as file, translate_errors(path):
        is_decoded = encoding not in PARSER_ENCODINGS
        source = Utf8Reader(file, encoding) if is_decoded else file
        parser = _EventParser(path, root, handler, "utf-8" if is_decoded else None)
        while chunk := source.read(_CHUNK_BYTES):
            parser.feed(chunk)
            yield
        parser.feed(b"", is_last=True)
        yield


class _EventParser:
    """Passes the events of expat on, within limits."""

    def __init__(self, path: Path, root: str, handler: EventHandler, encoding: str | None) -> None:
        self._path, self._root, self._handler = path, root, handler
        self._depth = 0
        self._tags: dict[str, str] = {}
        self._text: list[str] = []
        self._text_size = 0
        self._bytes_since_event = 0
        self._max_bytes = limits.ELEMENT.maximum * limits.MB
        self._parser = expat.ParserCreate(encoding)
        self._parser.buffer_text = True
        self._parser.StartElementHandler = self._on_start
        self._parser.EndElementHandler = self._on_end
        self._parser.StartDoctypeDeclHandler = self._reject_doctype
        self._parser.EntityDeclHandler = self._reject_doctype

    def feed(self, chunk: bytes, *, is_last: bool = False) -> None:
        self._bytes_since_event += len(chunk)
        self._check_size(self._bytes_since_event - _CHUNK_BYTES)
        try:
            self._parser.Parse(chunk, is_last)
        except expat.ExpatError as error:
            raise InputError(self._path, f"is not well-formed XML: {error}", COMPLETE_FILE) from None

    def _on_start(self, name: str, attributes: dict[str, str]) -> None:
        self._bytes_since_event = 0
        tag = self._tag(name)
        if self._depth == 0 and tag != self._root:
            raise InputError(self._path, f"expected the root element <{self._root}>, got <{tag}>", "Check the file.")
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise InputError(self._path, f"elements are nested more than {MAX_DEPTH} deep", COMPLETE_FILE)
        is_text_needed = self._handler.start(tag, attributes)
        self._text.clear()
        self._text_size = 0
        self._parser.CharacterDataHandler = self._on_text if is_text_needed else None

    def _on_end(self, name: str) -> None:
        self._bytes_since_event = 0
        self._depth -= 1
        self._parser.CharacterDataHandler = None
        self._handler.end(self._tag(name), "".join(self._text))
        self._text.clear()

    def _tag(self, name: str) -> str:
        """Return :func:`local_name`, remembered for the names that all files of a format have."""
        tag = self._tags.get(name)
        if tag is None:
            tag = local_name(name)
            if len(self._tags) < _MAX_NAMES:
                self._tags[name] = tag
        return tag

    def _on_text(self, text: str) -> None:
        self._bytes_since_event = 0
        self._text.append(text)
        self._text_size += len(text)
        self._check_size(self._text_size)

    def _check_size(self, size: int) -> None:
        if size > self._max_bytes:
            problem = f"has a tag or text of more than {limits.ELEMENT.maximum:,} MB"
            raise InputError(self._path, problem, limits.ELEMENT.hint)

    def _reject_doctype(self, *_: object) -> None:
        problem = "declares XML entities or a document type, which are not allowed"
        raise InputError(self._path, problem, "Remove <!DOCTYPE ...> from the file.")
