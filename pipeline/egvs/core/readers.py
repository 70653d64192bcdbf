"""The table of readers: which module reads which file, without importing any reader.

A package declares its readers in one light module, as a tuple of :class:`Reader`, and names it by an entry point of the
group ``egvs.readers``::

    [project.entry-points."egvs.readers"]
    walls = "egvs_walls:READERS"

A file may be of a format if its name ends with one of the format's suffixes, or if it begins as files of the format
do; and, where the format states so, if it contains what they contain. Only then is the reader's module imported. If it
has a function ``can_open(path, head)``, that decides; of a damaged file it may raise an InputError.

Readers of this program are asked first, so an installed package cannot replace one of them; among those of one origin,
readers that look into the content come first: a Lanelet2 map is an OpenStreetMap file with lanelets.

The caller, e.g. :mod:`egvs.creation.map_readers`, defines which functions the modules of a kind have.
"""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import IO, Any, cast

from egvs.core import limits, plugins
from egvs.core.digests import open_input
from egvs.core.errors import InputError, MissingBackendError

GROUP = "egvs.readers"

FORMER_GROUPS = ("egvs.maps", "egvs.point_clouds", "egvs.tracks")
"""Groups of entry points that named readers before there was one table."""

KINDS = ("map", "tracks", "points", "sweeps", "labels")
"""What a file can hold."""

HEAD_BYTES = 4096
"""How much of a file is its beginning, after gunzip; of XML, counted from the root element."""

_MAX_PROLOG_BYTES = 16_000_000
"""How much may come before the root element: comments, licences, processing instructions, a document type."""

_XML_START = re.compile(rb"(?:\xef\xbb\xbf|\xff\xfe|\xfe\xff)?\s*<(.?)", re.DOTALL)
_PROLOG_PART = re.compile(
    rb"(?:\xef\xbb\xbf|\xff\xfe|\xfe\xff)?\s*"
    rb"(?:<\?.*?\?>|<!--.*?-->|<!DOCTYPE[^\[>]*+(?:\[(?:[^\]\"']++|\"[^\"]*+\"|'[^']*+')*+\][^>]*+)?>)\s*",
    re.DOTALL,
)
_GZIP = b"\x1f\x8b"
_CHUNK_BYTES, _OVERLAP_BYTES = 1 << 20, 256


@dataclass(frozen=True)
class Reader:
    """A file format, and the module that reads it.

    Attributes
    ----------
    name
        The format, for messages: "Lanelet2".
    kind
        One of :data:`KINDS`.
    module
        Full name of the module; imported only for a file that may be of this format.
    suffixes
        Endings of file names, lower case, with the dot; see :func:`with_gzip`.
    head
        Regular expression for the beginning of a file (:func:`read_head`).
    content
        Regular expression for some text (at most 256 bytes) that is somewhere in each file of the format.
    gives
        What the file holds, where a kind has several parts: "roads", "solids" or "terrain" of a map.
    """

    name: str
    kind: str
    module: str
    suffixes: tuple[str, ...] = ()
    head: bytes | None = None
    content: bytes | None = None
    gives: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"the reader {self.name!r} is of the kind {self.kind!r}; expected one of {KINDS}")
        for pattern in (self.head, self.content):
            re.compile(pattern or b"")

    def may_open(self, path: Path, head: bytes) -> bool:
        """Return whether a file may be of this format, by its name, its beginning and its content.

        A gzip file that is damaged may be of any format whose name or beginning it has: its reader reports the damage.
        """
        if not path.name.lower().endswith(self.suffixes) and not _matches(self.head, head):
            return False
        return self.content is None or _contains(path, self.content)


def with_gzip(*suffixes: str) -> tuple[str, ...]:
    """Return suffixes of files that may be gzipped: ``.osm`` and ``.osm.gz``."""
    return tuple(name for suffix in suffixes for name in (suffix, f"{suffix}.gz"))


def list_readers(kind: str) -> list[Reader]:
    """Return the readers of a kind, in the order in which they are asked; no reader is imported."""
    return [reader for reader in _table() if reader.kind == kind]


def find_reader(kind: str, path: Path) -> Reader | None:
    """Return the reader of a file; None if there is none.

    Parameters
    ----------
    kind
        One of :data:`KINDS`.
    path
        The file.

    Raises
    ------
    InputError
        When the file does not exist or cannot be read.
    MissingBackendError
        When a reader that may open the file cannot be imported.
    """
    head = read_head(path)
    for reader in list_readers(kind):
        if reader.may_open(path, head) and _confirms(reader, path, head):
            return reader
    return None


def describe_formats(kind: str, part: str | None = None) -> str:
    """Return the names of the formats of a kind, or of those that give one part, for messages."""
    names = [reader.name for reader in list_readers(kind) if part is None or part in reader.gives]
    return ", ".join(sorted(set(names), key=str.lower))


def load_reader(reader: Reader, required: tuple[str, ...] = (), expected: str = "") -> ModuleType:
    """Import the module of a reader.

    Parameters
    ----------
    reader
        The reader.
    required
        Functions that the caller needs.
    expected
        What a module of this kind is, for the message.

    Raises
    ------
    MissingBackendError
        When the module cannot be imported, or lacks a function: names the package that declares the reader.
    """
    try:
        module = import_module(reader.module)
    except (ImportError, SyntaxError) as error:
        raise reader_error(reader, str(error)) from error
    except (Exception, SystemExit) as error:  # a foreign module may do anything when it is imported
        raise reader_error(reader, f"its import raised {error!r}") from error
    missing = [name for name in required if not hasattr(module, name)]
    if missing:
        raise reader_error(reader, f"{reader.module} has no {', '.join(missing)}; expected {expected}")
    return module


def reader_package(reader: Reader) -> str:
    """Return the package that declares a reader."""
    return plugins.plugin_package(GROUP, _table()[reader])


def reader_error(reader: Reader, problem: str) -> MissingBackendError:
    """Make the error for a reader that cannot be used; it names the package and its entry point."""
    return plugins.plugin_error(GROUP, _table()[reader], f"the reader {reader.name!r}: {problem}")


def read_head(path: Path) -> bytes:
    """Return the first :data:`HEAD_BYTES` of a file, after gunzip where possible; InputError when it cannot be read.

    Of XML, the beginning is the root element, with as much behind its first tag: comments, licences and lists of
    namespaces may be long.
    """
    if not path.is_file():
        raise InputError(path, "no such file", "Check the path.")
    try:
        with open_input(path) as content:
            head: bytes = content.read(HEAD_BYTES)
            if not head.startswith(_GZIP):
                return _from_root(head, content)
    except OSError as error:
        problem = f"the file cannot be read ({error.strerror or error})"
        raise InputError(path, problem, "Check its permissions, or leave it out.") from None
    try:
        with open_input(path) as content, gzip.open(content) as unpacked:
            return _from_root(unpacked.read(HEAD_BYTES), cast(IO[bytes], unpacked))
    except (EOFError, OSError, zlib.error):  # damaged: its reader says so
        return head


def _from_root(head: bytes, rest: IO[bytes]) -> bytes:
    """Return the beginning of a file; of XML, from its root element to :data:`HEAD_BYTES` behind the root's first tag.

    Text in UTF-16 loses its zero bytes.
    """
    text = head.replace(b"\0", b"")
    if _XML_START.match(text) is None:
        return head
    size = len(text)
    while True:
        while part := _PROLOG_PART.match(text):
            text = text[part.end() :]
        start = _XML_START.match(text)
        has_root = start is not None and start[1] not in (b"?", b"!", b"")
        root_end = text.find(b">") if has_root else -1
        is_complete = 0 <= root_end <= len(text) - HEAD_BYTES
        chunk = b""
        if not is_complete and size <= _MAX_PROLOG_BYTES:
            with suppress(EOFError, gzip.BadGzipFile, zlib.error):  # damaged: its reader says so
                chunk = rest.read(_CHUNK_BYTES)
        if not chunk:
            return text[: max(root_end, 0) + HEAD_BYTES] if has_root else b""
        text += chunk.replace(b"\0", b"")
        size += len(chunk)


@cache
def _table() -> dict[Reader, str]:
    """Return all readers in the order in which they are asked, each with the name of its entry point."""
    _reject_former_groups()
    own: dict[Reader, str] = {}
    others: dict[Reader, str] = {}
    for name in plugins.plugin_names(GROUP):
        readers = plugins.load_rows(GROUP, name, Reader)
        is_own = plugins.plugin_package(GROUP, name) == plugins.PACKAGE_NAME
        (own if is_own else others).update(dict.fromkeys(readers, name))
    return dict(sorted(own.items(), key=_is_without_content)) | dict(sorted(others.items(), key=_is_without_content))


def _is_without_content(item: tuple[Reader, str]) -> bool:
    return item[0].content is None


def _reject_former_groups() -> None:
    for group in FORMER_GROUPS:
        for entry in entry_points(group=group):
            problem = f"the group {group} is now {GROUP}, whose entry points name a tuple of readers"
            raise plugins.plugin_error(group, entry.name, problem)


def _confirms(reader: Reader, path: Path, head: bytes) -> bool:
    """Return what the module of a reader says of a file that may be of its format; True if it says nothing."""
    can_open: Callable[[Path, bytes], bool] | None = getattr(load_reader(reader), "can_open", None)
    return can_open is None or can_open(path, head)


def _matches(pattern: bytes | None, head: bytes) -> bool:
    """Return whether a file begins like this; text in UTF-16 is searched without its zero bytes."""
    if pattern is None:
        return False
    return re.search(pattern, head) is not None or re.search(pattern, head.replace(b"\0", b"")) is not None


def _contains(path: Path, pattern: bytes) -> bool:
    """Return whether a pattern is in a file; True, too, if its gzip is damaged or too large: its reader says so."""
    try:
        return first_match(path, pattern) is not None
    except (EOFError, OSError, zlib.error):
        return True


def first_match(path: Path, pattern: bytes) -> bytes | None:
    """Return the first text (at most 256 bytes) of a file, after gunzip, that a regular expression matches.

    Raises
    ------
    OSError, EOFError, zlib.error
        When the file cannot be read, its gzip is damaged, or has more than :data:`egvs.core.limits.UNPACKED`.
    """
    search = re.compile(pattern).search
    size = 0
    with open_input(path) as file, _unpacked(file) as content:
        rest = b""
        while chunk := content.read(_CHUNK_BYTES):
            if match := search(rest + chunk):
                return match[0]
            rest = chunk[-_OVERLAP_BYTES:]
            size += len(chunk)
            if size > limits.UNPACKED.maximum * limits.MB:
                raise EOFError
    return None


def _unpacked(file: IO[Any]) -> AbstractContextManager[IO[bytes]]:
    is_packed = file.read(len(_GZIP)) == _GZIP
    file.seek(0)
    return cast(AbstractContextManager[IO[bytes]], gzip.open(file) if is_packed else file)
