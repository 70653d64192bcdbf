"""Digests of files that have not changed since they were hashed, so that an unchanged file is not read again.

Like git, a run compares the size, the times of the last change (mtime and ctime), the inode and the device of each file
with those from when it was hashed. A file is hashed again where

- any of them differs, as those of a copied or edited file do;
- its mtime is less than :data:`RACY_NS` older than its digest: an edit soon afterwards could leave the same mtime;
- its file system is not known to be a local one of Linux (:data:`LOCAL_FILE_SYSTEMS`): the times and inodes of network
  file systems, and of those that are unknown, are not trusted. On other operating systems, every file is hashed.

The cache is ``.digests.json`` in the run folder. It contains the files of the last run in this folder. It only decides
whether a file is read again, and may be removed at any time; a damaged one is ignored.
"""

from __future__ import annotations

import json
import os
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from egvs.artefacts.run_folder import RunFolder
from egvs.core import files

RACY_NS = 2_000_000_000
"""The coarsest time stamps of local file systems are 2 s (FAT)."""

LOCAL_FILE_SYSTEMS = frozenset({"btrfs", "exfat", "ext2", "ext3", "ext4", "f2fs", "tmpfs", "vfat", "xfs", "zfs"})
"""Names in ``/proc/self/mountinfo`` of file systems on this machine, whose inodes and times can be trusted."""

_MOUNTS = Path("/proc/self/mountinfo")

Stamp = tuple[int, int, int, int, int]
"""Size, mtime and ctime in ns, inode, device."""


class DigestCache:
    """The digests of the files that one run hashes.

    Parameters
    ----------
    folder
        The run folder, which has the cache of the run before.
    """

    def __init__(self, folder: RunFolder) -> None:
        self._path = folder.digests
        self._before = _read_entries(self._path)
        self._entries: dict[str, list[Any]] = {}

    def digest(self, path: Path, hash_content: Callable[[Path], str]) -> str:
        """Return the sha256 of a file: the cached one if the file is unchanged, else that of ``hash_content``."""
        name = os.path.realpath(path)
        stamp = file_stamp(name)
        if stamp is None:
            return hash_content(path)
        for entries in (self._entries, self._before):
            entry = entries.get(name)
            if entry is not None and _is_current(entry, stamp):
                self._entries[name] = entry
                digest: str = entry[-1]
                return digest

        hashed_ns = time.time_ns()
        digest = hash_content(path)
        if file_stamp(name) == stamp:  # else it changed while it was read
            self._entries[name] = [*stamp, hashed_ns, digest]
        return digest

    def save(self) -> None:
        """Write the cache, if it changed."""
        entries = {name: entry for name, entry in sorted(self._entries.items()) if Path(name).exists()}
        if entries == self._before:
            return
        with suppress(OSError):  # a cache that cannot be written costs time, nothing else
            files.write_text(self._path, files.to_json_text(files.add_checksum({"files": entries})) + "\n")


def forget_digests(folder: Path) -> None:
    """Remove the cache of a run folder: the next run hashes every file."""
    RunFolder(folder).digests.unlink(missing_ok=True)


@contextmanager
def remember_digests(folder: RunFolder) -> Iterator[None]:
    """Hash only files that changed since the last run in a folder; save the digests if the block ends well."""
    digests = DigestCache(folder)
    with files.use_digests(digests.digest):
        yield
    digests.save()


def file_stamp(name: str) -> Stamp | None:
    """Return what changes when a file is written; None where it cannot be trusted."""
    status = Path(name).stat()
    if not stat.S_ISREG(status.st_mode) or status.st_dev not in _local_devices():
        return None
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino, status.st_dev


def _is_current(entry: list[Any], stamp: Stamp) -> bool:
    """Whether a file is as it was when it was hashed, and was not written shortly before."""
    *recorded, hashed_ns, _ = entry
    return recorded == list(stamp) and stamp[1] + RACY_NS <= hashed_ns


@cache
def _local_devices() -> frozenset[int]:
    """Return the devices of the mounted local file systems; none where the system does not list them."""
    if not _MOUNTS.is_file():
        return frozenset()
    devices = set()
    for line in _MOUNTS.read_text(encoding="utf-8", errors="replace").splitlines():
        mount, _, source = line.partition(" - ")
        if source.partition(" ")[0] in LOCAL_FILE_SYSTEMS:
            major, minor = mount.split(" ")[2].split(":")
            devices.add(os.makedev(int(major), int(minor)))
    return frozenset(devices)


def _read_entries(path: Path) -> dict[str, list[Any]]:
    """Return the entries of a cache; none where there is no cache, or it is damaged."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    if not files.has_valid_checksum(value):
        return {}
    entries: dict[str, list[Any]] = value["files"]
    return entries
