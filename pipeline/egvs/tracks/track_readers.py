"""Find the reader of a file of recorded tracks: entry points of the group ``egvs.tracks``."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Sequence
from pathlib import Path

from egvs.core import files, plugins
from egvs.core.errors import InputError
from egvs.tracks.model import HEAD_BYTES, TrackReader

GROUP = "egvs.tracks"

_GZIP = b"\x1f\x8b"


def find_reader(path: Path) -> TrackReader:
    """Return the reader of a file, the first in the order of names that accepts it.

    Raises
    ------
    InputError
        When the file does not exist, or no reader accepts it.
    """
    reader = _find(path)
    if reader is None:
        raise InputError(path, "the format of the tracks is unknown", f"Formats: {describe_formats()}.")
    return reader


def can_read(path: Path) -> bool:
    """Return whether a reader accepts a file; InputError when it does not exist."""
    return _find(path) is not None


def _find(path: Path) -> TrackReader | None:
    head = _read_head(path)
    for name in plugins.plugin_names(GROUP):
        reader: TrackReader = plugins.load_plugin(GROUP, name)
        if reader.can_open(path, head):
            return reader
    return None


def source_files(path: Path) -> Sequence[Path]:
    """Return a file of tracks and the files beside it that its reader needs."""
    return [path, *find_reader(path).companions(path)]


def describe_formats() -> str:
    """Return the names of the formats that can be read."""
    return ", ".join(plugins.load_plugin(GROUP, name).NAME for name in plugins.plugin_names(GROUP))


def _read_head(path: Path) -> bytes:
    """Return the first bytes of a file, after gunzip where possible."""
    if not path.is_file():
        raise InputError(path, "no such file", "Check the path.")
    with files.open_input(path) as content:
        head: bytes = content.read(HEAD_BYTES)
    if not head.startswith(_GZIP):
        return head
    try:
        with files.open_input(path) as content, gzip.open(content) as unzipped:
            return unzipped.read(HEAD_BYTES)
    except (EOFError, OSError, zlib.error):  # damaged: its reader says so
        return head
