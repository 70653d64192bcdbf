"""Folders for what is compiled or downloaded once and used by later processes."""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import platformdirs

MAX_OLD_CACHES = 2
"""Number of caches of other sources that stay, the most recently used ones: a running program may need one."""

_DIGITS = 12
_HASH_BYTES = hashlib.sha256().digest_size


def find_cache_folder(package: Path, prefix: str, digest: str, chosen: str | None = None) -> Path | None:
    """Return the folder ``<prefix>-<digest>`` in the first of these that can be written, and remove old ones.

    These are the folder ``chosen``, or, if there is none, the package's ``__pycache__`` and the user's cache; then the
    temporary directory.

    Parameters
    ----------
    package
        Folder of the package whose sources are compiled.
    prefix, digest
        What is cached, and the hash of everything that it depends on.
    chosen
        The folder that the user named.

    Returns
    -------
    Path, or None
        None where no folder can be written.
    """
    name = f"{prefix}-{digest[:_DIGITS]}"
    for parent in _candidate_folders(package, chosen):
        if _is_writable_folder(parent / name):
            _remove_old_caches(parent, prefix, name)
            return parent / name
    return None


def user_cache_folder() -> Path | None:
    """Return the folder ``egvs`` in the user's cache, or else a private one in the temporary directory.

    None if neither can be written.
    """
    return next((folder for folder in _user_folders() if _is_writable_folder(folder)), None)


def _candidate_folders(package: Path, chosen: str | None) -> Iterator[Path]:
    if chosen:
        yield Path(chosen)
        yield from _temporary_folders()
    else:
        yield package / "__pycache__"
        yield from _user_folders()


def user_cache_path() -> Path:
    """Return the folder ``egvs`` in the user's cache, which may not exist."""
    return platformdirs.user_cache_path("egvs", appauthor=False)


def _user_folders() -> Iterator[Path]:
    if user_cache_path().is_absolute():  # not so for a user without a home
        yield user_cache_path()
    yield from _temporary_folders()


def _temporary_folders() -> Iterator[Path]:
    if not hasattr(os, "geteuid"):  # Windows, where the temporary folder is the user's
        return
    with suppress(OSError):
        temporary = Path(tempfile.gettempdir()) / f"egvs-{os.geteuid()}"
        temporary.mkdir(mode=0o700, exist_ok=True)
        status = temporary.lstat()
        is_private = status.st_uid == os.geteuid() and not status.st_mode & 0o022
        if stat.S_ISDIR(status.st_mode) and is_private:
            yield temporary  # nobody else can put a file there


def _is_writable_folder(folder: Path) -> bool:
    """Return whether a folder exists, or can be made, and files can be written to it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _remove_old_caches(parent: Path, prefix: str, name: str) -> None:
    with suppress(OSError):  # another process may be removing them too
        old = [path for path in parent.glob(f"{prefix}-" + "?" * _DIGITS) if path.name != name]
        old.sort(key=lambda path: path.stat().st_mtime)
        for path in old[:-MAX_OLD_CACHES]:
            shutil.rmtree(path, ignore_errors=True)


def read_checked(path: Path) -> bytes | None:
    """Return the content of a file of :func:`write_checked`; None where it is missing or damaged."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    digest, content = data[:_HASH_BYTES], data[_HASH_BYTES:]
    return content if hashlib.sha256(content).digest() == digest else None


def write_checked(path: Path, content: bytes) -> None:
    """Write a file that starts with the hash of its content, where the folder can be written."""
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".", delete=False) as file:
            try:
                file.write(hashlib.sha256(content).digest() + content)
                file.close()
                Path(file.name).replace(path)
            except BaseException:
                Path(file.name).unlink(missing_ok=True)
                raise
