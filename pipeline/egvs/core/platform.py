"""What differs between operating systems: file locks, links, paths, memory, and the limits of a process.

Linux and macOS have the modules ``fcntl`` and ``resource``; Windows has ``msvcrt``, whose locks are always exclusive.
"""

from __future__ import annotations

import os
import sys
from pathlib import PurePath

try:
    import fcntl
    import resource
except ImportError:  # Windows
    HAS_POSIX = False
else:
    HAS_POSIX = True

if sys.platform == "win32":
    import msvcrt

OPEN_NO_LINK = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
"""Flags of ``os.open`` that refuse a symbolic link, where the system knows them."""

_LOCKED_BYTE = 1 << 30
"""Windows locks bytes of a file: one far behind its end."""


def try_lock(descriptor: int, *, shared: bool = False) -> bool:
    """Lock an open file until it is closed, or its process ends.

    Parameters
    ----------
    descriptor
        Of a file that is open for writing, unless the lock is shared.
    shared
        Allow other shared locks (not on Windows).

    Returns
    -------
    bool
        False when another process holds the lock.
    """
    try:
        if HAS_POSIX:
            fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        elif sys.platform == "win32":
            os.lseek(descriptor, _LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        elif not shared:
            os.lockf(descriptor, os.F_TLOCK, 0)
    except (BlockingIOError, PermissionError):
        return False
    return True


def is_own_file(status: os.stat_result) -> bool:
    """Return whether a file belongs to this user; always True on Windows, which has no user numbers."""
    return not hasattr(os, "geteuid") or status.st_uid == os.geteuid()


def relative_path(path: PurePath, folder: PurePath) -> str:
    """Return a path relative to a folder, with slashes; the path itself if it is on another drive of Windows."""
    try:
        relative = os.path.relpath(path, folder)
    except ValueError:
        return path.as_posix()
    return type(path)(relative).as_posix()


def peak_memory_mb() -> float:
    """Return the highest memory of this process so far, in MB of 2**20 bytes."""
    if HAS_POSIX:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return float(peak) / (1024 * 1024 if sys.platform == "darwin" else 1024)
    import psutil

    memory = psutil.Process().memory_info()
    return float(getattr(memory, "peak_wset", memory.rss)) / (1024 * 1024)


def address_space_limit_mb() -> float | None:
    """Return the limit of this process's address space, in MB; None where there is none."""
    if not HAS_POSIX:
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit / 1e6


def raise_open_file_limit(count: int) -> None:
    """Let this process open so many files, as far as the system allows; Windows allows thousands anyway."""
    if not HAS_POSIX:
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= count:
        return
    if hard == resource.RLIM_INFINITY or hard >= count:
        resource.setrlimit(resource.RLIMIT_NOFILE, (count, hard))
