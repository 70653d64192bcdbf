"""Digests of files, and the contents of input files: what is hashed is what is parsed.

A run has one :class:`Digests`, which hashes each file once and reads each input file once. If the user edits a file
meanwhile, the run goes on with what it has read, or ends with an error. Files that the run writes itself, in its folder
or in temporary folders, are read each time.

Files that did not change since an earlier run are not read again. Like git, this compares the size, the times of the
last change (mtime and ctime), the inode and the device of a file with those from when it was hashed. A file is hashed
again where

- any of them differs, as those of a copied or edited file do;
- its mtime is less than :data:`RACY_NS` older than its digest: an edit soon afterwards could leave the same mtime;
- its file system is not known to be a local one of Linux (:data:`LOCAL_FILE_SYSTEMS`): the times and inodes of network
  file systems, and of those that are unknown, are not trusted. On other operating systems, every file is hashed.
"""

from __future__ import annotations

import hashlib
import io
import os
import stat
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from typing import Any

from egvs.core import files
from egvs.core.errors import InputError

RACY_NS = 2_000_000_000
"""The coarsest time stamps of local file systems are 2 s (FAT)."""

LOCAL_FILE_SYSTEMS = frozenset({"btrfs", "exfat", "ext2", "ext3", "ext4", "f2fs", "tmpfs", "vfat", "xfs", "zfs"})
"""Names in ``/proc/self/mountinfo`` of file systems on this machine, whose inodes and times can be trusted."""

MAX_HELD_BYTES = 128_000_000
"""Size of all input files together that are held in memory."""

_MOUNTS = Path("/proc/self/mountinfo")

Stamp = tuple[int, int, int, int, int]
"""Size, mtime and ctime in ns, inode, device."""

Entries = dict[str, list[Any]]
"""By real path: the stamp of a file, the time in ns when it was hashed, and its digest."""


class Digests:
    """The SHA-256 of each file, computed once, and the contents of input files, read once.

    Parameters
    ----------
    folder
        Run folder: its files are written by the run, so their contents are not held in memory.
    recorded
        Digests that ``run.json`` records, "" for an artefact that no stage recorded. A file with another digest is
        refused.
    earlier
        Entries of an earlier run.

    Attributes
    ----------
    entries
        What a later run may trust.
    """

    def __init__(
        self,
        folder: Path | None = None,
        *,
        recorded: Mapping[Path, str] | None = None,
        earlier: Entries | None = None,
    ) -> None:
        self._folder = None if folder is None else os.path.realpath(folder)
        self._recorded = {os.path.realpath(path): digest for path, digest in (recorded or {}).items()}
        self._earlier = earlier or {}
        self._digests: dict[str, str] = {}
        self._contents: dict[str, bytes] = {}
        self._held_bytes = 0
        self.entries: Entries = {}

    def of(self, path: Path) -> str:
        """Return the SHA-256 hex digest of a file, which is computed once until :meth:`forget`.

        Raises
        ------
        InputError
            When the file does not exist, or differs from the one in ``run.json``.
        """
        name = os.path.realpath(path)
        if not self._is_in_folder(name) and files.is_temporary(Path(name)):
            return files.hash_file(path)
        if name not in self._digests:
            digest = self._earlier_digest(name)
            if digest is None:
                stamp, hashed_ns = _file_stamp(name), time.time_ns()
                digest = files.hash_file(path)
                self._add_entry(name, stamp, hashed_ns, digest)
            self._check_recorded(name, path, digest)
            self._digests[name] = digest
        return self._digests[name]

    def open(self, path: Path) -> io.BufferedReader | io.BytesIO:
        """Open a file to read its bytes; an input file that fits is held in memory.

        Raises
        ------
        InputError
            When the file was changed after it had been hashed.
        """
        name = os.path.realpath(path)
        if name not in self._contents:
            if not self._can_hold(path, name):
                return path.open("rb")
            stamp, hashed_ns = _file_stamp(name), time.time_ns()
            content = path.read_bytes()
            digest = hashlib.sha256(content).hexdigest()
            if self._digests.setdefault(name, digest) != digest:
                raise InputError(path, "was changed while it was in use", "Repeat the command.")
            self._add_entry(name, stamp, hashed_ns, digest)
            self._contents[name] = content
            self._held_bytes += len(content)
        return io.BytesIO(self._contents[name])

    def forget(self, *paths: Path) -> None:
        """Forget files, or all files in folders, that are about to be written."""
        for written in map(os.path.realpath, paths):
            for digests in (self._digests, self._recorded):
                for file in list(digests):
                    if Path(file).is_relative_to(written):
                        del digests[file]

    def _is_in_folder(self, name: str) -> bool:
        return self._folder is not None and Path(name).is_relative_to(self._folder)

    def _can_hold(self, path: Path, name: str) -> bool:
        """Whether a file is an input file, and fits into memory."""
        if self._is_in_folder(name) or files.is_temporary(Path(name)):
            return False
        status = path.stat()
        return stat.S_ISREG(status.st_mode) and self._held_bytes + status.st_size <= MAX_HELD_BYTES

    def _earlier_digest(self, name: str) -> str | None:
        """Return the digest of an earlier run; None if the file may have changed since."""
        if name not in self._earlier or not Path(name).is_file():
            return None
        *recorded, hashed_ns, digest = self._earlier[name]
        stamp = _file_stamp(name)
        if stamp is None or recorded != list(stamp) or stamp[1] + RACY_NS > hashed_ns:
            return None
        self.entries[name] = self._earlier[name]
        return str(digest)

    def _add_entry(self, name: str, stamp: Stamp | None, hashed_ns: int, digest: str) -> None:
        """Note the digest of a file for a later run, unless the file changed while it was read."""
        if stamp is not None and _file_stamp(name) == stamp:
            self.entries[name] = [*stamp, hashed_ns, digest]

    def _check_recorded(self, name: str, path: Path, digest: str) -> None:
        """InputError where an artefact is not the one that ``run.json`` records."""
        recorded = self._recorded.get(name, digest)
        hint = 'Repeat "egvs run" to create it.'
        if recorded == "":
            raise InputError(path, "was not created by any stage recorded in run.json", hint)
        if recorded != digest:
            problem = f"was altered or replaced (sha256 {digest[:12]}, in run.json {recorded[:12]})"
            raise InputError(path, problem, hint)


_IN_USE: ContextVar[Digests | None] = ContextVar("_IN_USE", default=None)


@contextmanager
def use_digests(digests: Digests) -> Iterator[Digests]:
    """Let :func:`open_input` and :func:`hash_input` use these digests and contents in the block."""
    token = _IN_USE.set(digests)
    try:
        yield digests
    finally:
        _IN_USE.reset(token)


def open_input(path: Path) -> io.BufferedReader | io.BytesIO:
    """Open an input file to read its bytes; in a run, as :meth:`Digests.open`."""
    digests = _IN_USE.get()
    return path.open("rb") if digests is None else digests.open(path)


def hash_input(path: Path) -> str:
    """Return the SHA-256 hex digest of an input file; in a run, as :meth:`Digests.of`."""
    digests = _IN_USE.get()
    return files.hash_file(path) if digests is None else digests.of(path)


def _file_stamp(name: str) -> Stamp | None:
    """Return what changes when a file is written; None where it cannot be trusted."""
    try:
        status = Path(name).stat()
    except OSError:
        return None
    if not stat.S_ISREG(status.st_mode) or status.st_dev not in _local_devices():
        return None
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino, status.st_dev


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
