"""Atomic writing, temporary folders, hashes, and JSON text.

A file is first written to ``.<name>.partial``, then renamed, so that a killed run leaves no half-written artefact.
Temporary folders are locked while they are in use, so that the next program removes those of a killed one.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from egvs.core import platform
from egvs.core.errors import InputError

DISK_FULL_ERRNOS = (errno.ENOSPC, errno.EDQUOT)
"""Error numbers of a full disk or an exhausted quota."""

RUN_RECORD, RUN_LOCK = "run.json", ".lock"
"""Names of files in a run folder; the record is written at the end of the first stage."""

_TEMP_PREFIX, _MAX_ATTEMPTS = "egvs-work-", 10

_MIN_FREE_BYTES, _MIN_FREE_BYTES_AFTER_ERROR = 4096, 1_000_000
"""What a disk must still take that is not full; after an error, a library may have removed part of what it wrote."""


@contextmanager
def attach_filename(path: Path) -> Iterator[None]:
    """Name the file in the error of a full disk, which Python and Arrow leave out.

    The error of a copy names two files, the source first; the disk of the other one is full.
    """
    try:
        yield
    except OSError as error:
        if error.errno in DISK_FULL_ERRNOS and (error.filename is None or error.filename2 is not None):
            error.filename, error.filename2 = str(path), None
        raise


def check_utf8(where: str, name: str) -> None:
    """Check that the name of a file is UTF-8: records and artefacts contain names.

    Raises
    ------
    InputError
        At ``where``, when it is not.
    """
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        raise InputError(where, f"expected a name in UTF-8, got {name!r}", "Rename the file or the folder.") from None


@contextmanager
def check_disk_space(folder: Path, *errors: type[Exception]) -> Iterator[None]:
    """Raise the error of a full disk where another library, which writes to a folder, raises its own, or none at all.

    Parameters
    ----------
    folder
        The folder.
    *errors
        What the library raises.

    Raises
    ------
    OSError
        When the folder cannot take more.
    """
    try:
        yield
    except errors:
        _write_probe(folder, _MIN_FREE_BYTES_AFTER_ERROR)
        raise
    _write_probe(folder, _MIN_FREE_BYTES)


def _write_probe(folder: Path, n_bytes: int) -> None:
    with attach_filename(folder), tempfile.TemporaryFile(dir=folder) as file:
        file.write(b"0" * n_bytes)
        file.flush()


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a path to write to; rename it to ``path`` when the block ends well, remove it when it does not."""
    check_no_link(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    _check_not_folder(path)
    partial.unlink(missing_ok=True)  # of a killed run, or a link, which must not be followed
    try:
        with attach_filename(path):
            yield partial
        written = _WRITTEN.get()
        if written is not None and path.is_relative_to(written.folder):
            written.digests[path.relative_to(written.folder).as_posix()] = hash_file(partial)
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


class _WrittenFiles(NamedTuple):
    """Digests of the files that were written in a folder, by path in the folder."""

    folder: Path
    digests: dict[str, str]


_WRITTEN: ContextVar[_WrittenFiles | None] = ContextVar("_WRITTEN", default=None)


@contextmanager
def hash_written_files(folder: Path) -> Iterator[dict[str, str]]:
    """Yield the SHA-256 of each file, by path in a folder, that the block writes there with :func:`atomic_write`.

    A file is hashed before it gets its name, so that the digest is that of what was written, even if another program
    replaces the file at once.
    """
    written = _WrittenFiles(folder, {})
    token = _WRITTEN.set(written)
    try:
        yield written.digests
    finally:
        _WRITTEN.reset(token)


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Yield a temporary folder that is removed at the end; those of killed programs are removed first."""
    parent = Path(tempfile.gettempdir())
    _remove_stale_folders(parent)
    for attempts_left in reversed(range(_MAX_ATTEMPTS)):
        with tempfile.TemporaryDirectory(prefix=_TEMP_PREFIX, dir=parent, ignore_cleanup_errors=True) as name:
            lock = _try_lock(Path(name))
            if lock is None and attempts_left:  # another program took it for an abandoned one before it was locked
                continue
            try:
                with attach_filename(Path(name)):
                    yield Path(name)
            finally:
                if lock is not None:  # None on a file system without locks
                    os.close(lock)
            return


def is_temporary(path: Path) -> bool:
    """Return whether a path lies in a folder of :func:`temporary_folder`."""
    return any(part.startswith(_TEMP_PREFIX) for part in path.parts)


@cache
def _remove_stale_folders(parent: Path) -> None:
    """Remove the temporary folders of killed programs; once in a process."""
    for folder in parent.glob(f"{_TEMP_PREFIX}*"):
        lock = _try_lock(folder)
        if lock is None:
            continue
        try:
            shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(lock)


def _try_lock(folder: Path) -> int | None:
    """Lock a folder of this user until the descriptor is closed; None where it is not this user's, locked, or gone."""
    with suppress(OSError):  # Windows opens no folders: there, folders of killed programs stay
        descriptor = os.open(folder, os.O_RDONLY | getattr(os, "O_DIRECTORY", 0) | platform.OPEN_NO_LINK)
        with suppress(OSError):
            if platform.try_lock(descriptor):
                status = os.fstat(descriptor)
                if platform.is_own_file(status) and os.path.samestat(status, folder.stat()):
                    return descriptor
        os.close(descriptor)
    return None


def ensure_writable_folder(path: Path) -> None:
    """Make the folder of a file that will be written after long work, and check that it is writable.

    Raises
    ------
    InputError
        When the file could not be written.
    """
    check_writable(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _not_writable_error(path, error) from None


def check_writable(path: Path) -> None:
    """Check that a file could be written, in a folder that may not exist yet, without making anything.

    Raises
    ------
    InputError
        When it could not be written.
    """
    check_no_link(path)
    try:
        _check_not_folder(path)
        existing = next(folder for folder in path.parents if folder.exists())
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise _not_writable_error(path, error) from None


def _not_writable_error(path: Path, error: OSError) -> InputError:
    return InputError(path, f"cannot be written ({error.strerror})", "Choose a folder that you may write to.")


def check_no_link(path: Path) -> None:
    """Check that no folder between a run folder and a file in it is a symbolic link; the run folder may be one.

    Parameters
    ----------
    path
        The file, or a folder to be filled as ``path / "..."``; it need not exist, and need not be in a run folder.

    Raises
    ------
    InputError
        When writing the file would follow a link out of the run folder.
    """
    link = None
    for folder in path.absolute().parents:
        if (folder / RUN_RECORD).is_file() and link is not None:
            problem = "expected a folder of the run, got a symbolic link, through which nothing is written"
            raise InputError(link, problem, "Remove the link, or choose another folder.")
        if (folder / RUN_RECORD).is_file() or (folder / RUN_LOCK).is_file():
            return  # the lock alone: of a first run, or of another program
        if folder.is_symlink():
            link = folder


def remove_folder(folder: Path) -> None:
    """Remove a folder with all files in it, if there is one; of a symbolic link, the link."""
    if folder.is_symlink():
        folder.unlink()
    elif folder.exists():
        shutil.rmtree(folder)


def _check_not_folder(path: Path) -> None:
    if path.is_dir():
        raise InputError(path, "expected a file, got a folder", "Choose another name, or remove the folder.")


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically (UTF-8, line ends unchanged)."""
    with atomic_write(path) as partial:
        partial.write_bytes(text.encode("utf-8"))


def hash_file(path: Path) -> str:
    """Return the SHA-256 hex digest of a file as it is now; InputError when it does not exist."""
    if not path.is_file():
        raise InputError(path, "no such file", f"Run the stage that writes {path.name} first.")
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_json(value: Any) -> str:
    """Return the SHA-256 hex digest of a JSON value, independent of the order of its keys."""
    return hashlib.sha256(canonical_json(value)).hexdigest()


def canonical_json(value: Any) -> bytes:
    """Return a JSON value as bytes that do not depend on the order of its keys."""
    return to_json_text(value, sort_keys=True, separators=(",", ":")).encode("utf-8")


def to_json_text(value: Any, **options: Any) -> str:
    """Return a JSON value as text; the numbers that JSON lacks become "inf", "-inf" and "nan".

    Parameters
    ----------
    value
        The value.
    **options
        Options of :func:`json.dumps`.
    """
    try:
        return json.dumps(value, ensure_ascii=False, allow_nan=False, **options)
    except ValueError:
        return json.dumps(_replace_non_finite(value), ensure_ascii=False, allow_nan=False, **options)


def _replace_non_finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, Mapping):
        return {key: _replace_non_finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_non_finite(part) for part in value]
    return value
