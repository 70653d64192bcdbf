"""Everything that differs between operating systems: file locks, links, memory, and the limits of a process.

Linux and macOS lock files with ``flock``. Elsewhere (Windows) the library filelock does: its locks are exclusive, so a
shared lock is exclusive there too. Functions that a system does not have are described where they are replaced.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
from pathlib import Path

import psutil

try:
    import fcntl
    import resource
except ImportError:  # Windows
    HAS_POSIX = False
else:
    HAS_POSIX = True

IS_LINUX = sys.platform.startswith("linux")

NO_LINK = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
"""Flags of ``os.open`` that refuse a symbolic link, where the system knows them."""

INTERRUPT_LATER = getattr(signal, "SIGALRM", None)
"""The signal of the process' timer; None where there is none (Windows)."""


class FileLock:
    """A lock on a file, held by one process at a time; it ends with the process, however that ends.

    Parameters
    ----------
    path
        The lock file; it is created where there is none.
    shared
        Other processes may hold the lock too, if they also share it. A file that cannot be written will do then.
    """

    def __init__(self, path: Path, *, shared: bool = False) -> None:
        self.path = path
        self._shared = shared
        self._descriptor: int | None = None
        self._other: object | None = None

    def try_acquire(self) -> bool:
        """Take the lock if it is free; return whether it is held now.

        Raises
        ------
        OSError
            When the file cannot be opened; ``errno.ELOOP`` for a symbolic link.
        """
        if HAS_POSIX:
            return self._try_flock()
        import filelock

        lock = filelock.FileLock(self.path)
        try:
            lock.acquire(timeout=0)
        except filelock.Timeout:
            return False
        self._other = lock
        return True

    def release(self) -> None:
        """Give the lock back; nothing happens where it is not held."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None
        if self._other is not None:
            self._other.release()  # type: ignore[attr-defined]
            self._other = None

    def _try_flock(self) -> bool:
        kind = fcntl.LOCK_SH if self._shared else fcntl.LOCK_EX
        while True:
            descriptor = _open_lock_file(self.path, self._shared)
            try:
                fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(descriptor)
                return False
            except BaseException:
                os.close(descriptor)
                raise
            if _is_current(descriptor, self.path):
                self._descriptor = descriptor
                return True
            os.close(descriptor)


def _open_lock_file(path: Path, shared: bool) -> int:
    if not NO_LINK and path.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | NO_LINK, 0o666)
    except PermissionError:
        if not shared:
            raise
    return os.open(path, os.O_RDONLY | NO_LINK)


def _is_current(descriptor: int, path: Path) -> bool:
    """Return whether an open file is the one at ``path``: the process that held it before may have removed it."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def owns(path: Path) -> bool:
    """Return whether a file or folder belongs to this user; Windows has no such number, so always True there."""
    if not hasattr(os, "geteuid"):
        return True
    return path.lstat().st_uid == os.geteuid()


def peak_memory_mb() -> float:
    """Return the highest memory of this process so far, in MB of 2^20 bytes."""
    if HAS_POSIX:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return float(peak) / (1024 * 1024 if sys.platform == "darwin" else 1024)
    memory = psutil.Process().memory_info()
    return float(getattr(memory, "peak_wset", memory.rss)) / (1024 * 1024)


def limit_memory(limit_bytes: int) -> None:
    """Let allocations of this process fail above a limit; Windows has no such limit."""
    if not HAS_POSIX:
        return
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    soft = limit_bytes if hard == resource.RLIM_INFINITY else min(hard, limit_bytes)
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def raise_open_file_limit(count: int) -> None:
    """Let this process open so many files, as far as the system allows; Windows allows thousands anyway."""
    if not HAS_POSIX:
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= count:
        return
    if hard == resource.RLIM_INFINITY or hard >= count:
        resource.setrlimit(resource.RLIMIT_NOFILE, (count, hard))
