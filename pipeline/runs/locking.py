"""Locks that keep processes apart; each goes with its process, however that ends."""

from __future__ import annotations

import errno
import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.core.errors import InputError, RunError
from pipeline.runs import store_settings

_NO_LINK = os.O_CLOEXEC | os.O_NOFOLLOW
_PAUSE_S = 0.05


@contextmanager
def alone(folder: Path, wait_s: float = 0.0) -> Iterator[None]:
    """Keep two runs out of one folder, and every run out of the store; the store's settings are right then.

    Another run's end is waited for so long; RunError where it is at work there then.
    """
    store_settings.keep_out(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = _open(folder / ".lock", shared=False)
    except OSError as error:
        raise InputError(folder, f"cannot be written ({error.strerror})", "a folder of yours") from None
    try:
        until = time.monotonic() + wait_s
        while not _take(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB):
            if time.monotonic() >= until:
                raise RunError(f"{folder}: another run is at work there")
            time.sleep(_PAUSE_S)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def locked(path: Path, *, shared: bool = False, wait: bool = True, remove: bool = False) -> Iterator[bool]:
    """Hold a lock file; yields whether it is held (without ``wait`` it may not be).

    Parameters
    ----------
    shared
        Others may share it; a file that cannot be written will do then.
    remove
        Remove the file at the end. Who waited for it then takes the one that stands in its place.
    """
    kind = (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB)
    while True:
        descriptor = _open(path, shared)
        try:
            if not _take(descriptor, kind):
                yield False
                return
            if not _is_still(descriptor, path):
                continue
            try:
                yield True
            finally:
                if remove:
                    path.unlink(missing_ok=True)
            return
        finally:
            os.close(descriptor)


def make(path: Path) -> None:
    """Make a lock file where there is none; InputError where it is a symbolic link."""
    os.close(_open(path, shared=False))


def _open(path: Path, shared: bool) -> int:
    """A lock file, made where there is none; InputError where it is a symbolic link."""
    try:
        try:
            return os.open(path, os.O_RDWR | os.O_CREAT | _NO_LINK, 0o666)
        except PermissionError:
            if not shared:
                raise
        return os.open(path, os.O_RDONLY | _NO_LINK)
    except OSError as error:
        if error.errno == errno.ELOOP:
            found = "is a symbolic link, and nothing is written through one"
            raise InputError(path, found, "remove it") from None
        raise


def _take(descriptor: int, kind: int) -> bool:
    try:
        fcntl.flock(descriptor, kind)
    except BlockingIOError:
        return False
    return True


def _is_still(descriptor: int, path: Path) -> bool:
    """Whether the file that is held is the one that stands at ``path``: its holder before may have removed it."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
