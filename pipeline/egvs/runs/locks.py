"""Locks that keep processes apart; each goes with its process, however that ends."""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from egvs.core.errors import InputError

_NO_LINK = os.O_CLOEXEC | os.O_NOFOLLOW
_PAUSE_S = 0.05


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
        descriptor = _open_lock(path, shared)
        try:
            if not _try_lock(descriptor, kind):
                yield False
                return
            if not _is_current_lock(descriptor, path):
                continue
            try:
                yield True
            finally:
                if remove:
                    path.unlink(missing_ok=True)
            return
        finally:
            os.close(descriptor)


def create_lock(path: Path) -> None:
    """Make a lock file where there is none; InputError where it is a symbolic link."""
    os.close(_open_lock(path, shared=False))


def _open_lock(path: Path, shared: bool) -> int:
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
            found = "is a symbolic link, and nothing is written through links"
            raise InputError(path, found, "Remove it.") from None
        raise


def _try_lock(descriptor: int, kind: int) -> bool:
    try:
        fcntl.flock(descriptor, kind)
    except BlockingIOError:
        return False
    return True


def _is_current_lock(descriptor: int, path: Path) -> bool:
    """Whether the file that is held is the one that stands at ``path``: its holder before may have removed it."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
