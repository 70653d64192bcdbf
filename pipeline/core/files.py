"""Files appear whole or not at all, and are known by their hashes.

A file is written aside first (``.<name>.partial``), then renamed, so that a killed run leaves no half-written artefact.
Folders for work in the system's temporary directory are held by a lock, so that the next program removes those of one
that was killed.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from pipeline.core.errors import InputError

FULL = (errno.ENOSPC, errno.EDQUOT)
"""What the system says where a disk, or a user's share of it, is full."""

_SCRATCH, _CHANCES = "egvs-work-", 10


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """What the system says against writing a file names it: Python's files and Arrow's leave that open."""
    try:
        yield
    except OSError as error:
        if error.errno in FULL and error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def aside(path: Path) -> Iterator[Path]:
    """Yield a path to write to; rename it to ``path`` when the block ends well, remove it when it does not."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    _refuse_folder(path)
    partial.unlink(missing_ok=True)  # what a killed run left, or a link: nothing is written through one
    try:
        with naming(path):
            yield partial
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


@contextmanager
def scratch() -> Iterator[Path]:
    """A folder for work in the system's temporary directory; removed at the end, those of killed programs at once."""
    parent = Path(tempfile.gettempdir())
    _clear(parent)
    for chances in reversed(range(_CHANCES)):
        with tempfile.TemporaryDirectory(prefix=_SCRATCH, dir=parent, ignore_cleanup_errors=True) as name:
            held = _held(Path(name))
            if held is None and chances:  # another program took it for one that was left, before it was held
                continue
            try:
                with naming(Path(name)):
                    yield Path(name)
            finally:
                if held is not None:  # there is nothing that could hold it on a disk that knows no locks
                    os.close(held)
            return


@cache
def _clear(parent: Path) -> None:
    """Remove the folders for work of programs that were killed; once in a process."""
    for left in parent.glob(f"{_SCRATCH}*"):
        if (held := _held(left)) is not None:
            try:
                shutil.rmtree(left, ignore_errors=True)
            finally:
                os.close(held)


def _held(folder: Path) -> int | None:
    """A descriptor that holds a folder of one's own until it is closed; None where it is another's, held, or gone."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            status = os.fstat(descriptor)
            if status.st_uid == os.geteuid() and os.path.samestat(status, folder.stat()):
                return descriptor
        os.close(descriptor)
    return None


def make_room(path: Path) -> None:
    """Make the folder of a file that is written after long work, and see that it takes files.

    Raises
    ------
    InputError
        Where it could not be written.
    """
    see_room(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(path, error) from None


def see_room(path: Path) -> None:
    """See that a file could be written, in a folder that may not be there yet; nothing is made.

    Raises
    ------
    InputError
        Where it could not.
    """
    try:
        _refuse_folder(path)
        with tempfile.TemporaryFile(dir=next(folder for folder in path.parents if folder.exists())):
            pass
    except OSError as error:
        raise _unwritable(path, error) from None


def _unwritable(path: Path, error: OSError) -> InputError:
    return InputError(path, f"cannot be written ({error.strerror})", "a file in a folder of yours")


def _refuse_folder(path: Path) -> None:
    if path.is_dir():
        raise InputError(path, "is a folder", "a file, or nothing, where an artefact is written")


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all (UTF-8, line ends as given)."""
    with aside(path) as partial:
        partial.write_bytes(text.encode("utf-8"))


def sha256_of(path: Path) -> str:
    """Hex digest of a file's bytes; InputError when it is not there."""
    if not path.is_file():
        raise InputError(path, "no such file", f"run the stage that makes {path.name} first")
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_of(value: Any) -> str:
    """Hex digest of a JSON value, independent of the order of its keys."""
    return hashlib.sha256(canonical_json(value)).hexdigest()


def canonical_json(value: Any) -> bytes:
    """A JSON value as bytes that do not depend on the order of its keys."""
    return json_text(value, sort_keys=True, separators=(",", ":")).encode("utf-8")


def json_text(value: Any, **how: Any) -> str:
    """A JSON value as text, written as :func:`json.dumps` is told; "inf", "-inf" and "nan" stand for the numbers that
    JSON does not know.
    """
    try:
        return json.dumps(value, ensure_ascii=False, allow_nan=False, **how)
    except ValueError:
        return json.dumps(_with_words(value), ensure_ascii=False, allow_nan=False, **how)


def _with_words(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, Mapping):
        return {key: _with_words(part) for key, part in value.items()}
    return [_with_words(part) for part in value] if isinstance(value, list | tuple) else value
