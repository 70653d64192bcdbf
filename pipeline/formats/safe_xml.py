"""A user's XML file is read without trusting it, and without holding it whole.

Steps: undo gzip where the first two bytes say so; parse with defusedxml, which refuses entities and document types;
hand out one child of the root at a time and forget it. Whatever is wrong with the file becomes an
:class:`InputError` that names it (for a copy: that names what the user named).
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, cast
from xml.etree.ElementTree import Element, ParseError

from pipeline.core.errors import InputError

_GZIP = b"\x1f\x8b"


def is_gzip(path: Path) -> bool:
    """Whether the file's first bytes are those of gzip, whatever its name says."""
    with path.open("rb") as file:
        return file.read(2) == _GZIP


@contextmanager
def opened(path: Path, name: Path | None = None) -> Iterator[IO[bytes]]:
    """The file's bytes, unzipped; a damaged gzip becomes an InputError."""
    try:
        with gzip.open(path) if is_gzip(path) else path.open("rb") as file:
            yield cast(IO[bytes], file)
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        problem = f"is a damaged gzip file ({error})"
        raise InputError(name or path, problem, "a whole file; fetch or make it again") from None


def children(
    path: Path, root: str, name: Path | None = None, on_root: Callable[[Element], None] | None = None
) -> Iterator[Element]:
    """The children of the root element one by one, each whole; a child is forgotten when the next is asked for.
    ``on_root`` gets the root, with its attributes, before the first child.

    Raises
    ------
    InputError
        When the root is not ``root`` (where that is not empty), the XML is malformed or declares entities or a
        document type, or its gzip is damaged.
    """
    from defusedxml.common import DefusedXmlException
    from defusedxml.ElementTree import iterparse

    with opened(path, name) as file:
        path = name or path
        events: Iterator[tuple[str, Any]] = iterparse(file, events=("start", "end"), forbid_dtd=True)
        try:
            _, top = next(events)
            if root and top.tag != root:
                raise InputError(path, f"its root is <{top.tag}>", f"a file whose root is <{root}>")
            if on_root is not None:
                on_root(top)
            depth = 0
            for event, element in events:
                depth += 1 if event == "start" else -1
                if event == "end" and depth == 0:
                    yield element
                    top.clear()
        except ParseError as error:
            raise InputError(path, f"is not well-formed XML: {error}", "a whole XML file") from None
        except DefusedXmlException:
            what = "declares XML entities or a document type, which are refused"
            raise InputError(path, what, "a file without <!DOCTYPE ...>") from None
