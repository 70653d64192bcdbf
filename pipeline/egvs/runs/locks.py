"""Locks between processes; the system releases them when a process ends, however it ends."""

from __future__ import annotations

import errno
import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from egvs.core import platform
from egvs.core.errors import InputError

_PAUSE_S = 0.05


@contextmanager
def locked(path: Path, *, shared: bool = False, wait: bool = True, remove: bool = False) -> Iterator[bool]:
    """Lock a file during the block; yield whether it is locked.

    Parameters
    ----------
    path
        Lock file; it is created if it does not exist.
    shared
        Allow other shared locks; the file need not be writable.
    wait
        Wait until the lock is free; else yield False when it is not.
    remove
        Remove the file at the end. A process that waited for it then locks the new file of that name.
    """
    while True:
        descriptor = open_lock(path, shared=shared)
        try:
            if not wait_for_lock(descriptor, math.inf if wait else 0.0, shared=shared):
                yield False
                return
            if not is_current_lock(descriptor, path):
                continue
            try:
                yield True
            finally:
                if remove:
                    with suppress(PermissionError):  # Windows removes no open file
                        path.unlink(missing_ok=True)
            return
        finally:
            os.close(descriptor)


def create_lock(path: Path) -> None:
    """Create a lock file if it does not exist; InputError where it is a symbolic link."""
    os.close(open_lock(path))


def open_lock(path: Path, *, shared: bool = False) -> int:
    """Return the descriptor of a lock file, created if it does not exist; InputError where it is a symbolic link."""
    try:
        if not platform.OPEN_NO_LINK and path.is_symlink():
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
        try:
            return os.open(path, os.O_RDWR | os.O_CREAT | platform.OPEN_NO_LINK, 0o666)
        except PermissionError:
            if not shared:
                raise
        return os.open(path, os.O_RDONLY | platform.OPEN_NO_LINK)
    except OSError as error:
        if error.errno == errno.ELOOP:
            problem = "is a symbolic link, and nothing is written through links"
            raise InputError(path, problem, "Remove it.") from None
        raise


def wait_for_lock(descriptor: int, timeout_s: float, *, shared: bool = False) -> bool:
    """Lock an open file; return False where it is not free in time."""
    deadline = time.monotonic() + timeout_s
    while not platform.try_lock(descriptor, shared=shared):
        if time.monotonic() >= deadline:
            return False
        time.sleep(_PAUSE_S)
    return True


def is_current_lock(descriptor: int, path: Path) -> bool:
    """Whether the locked file is still the one at ``path``; the process that held the lock may have removed it."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
