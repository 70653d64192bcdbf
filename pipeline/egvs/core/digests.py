"""Digests of files, and the contents of input files: what is hashed is what is parsed.

A run has one :class:`Digests`, which hashes each file once and reads each input file once. If the user edits a file
meanwhile, the run goes on with what it has read, or ends with an error. Artefacts, and files too large to be held in
memory, are compared with their digest when they are opened (:meth:`Digests.open`), and with their time stamps after the
work that depends on them (:meth:`Digests.check_unchanged`). So a file that is replaced meanwhile changes no result.

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
from contextlib import contextmanager, nullcontext
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
        self._collected: dict[str, Path] = {}
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
        self._collected[name] = path
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
                return self._open_unheld(path, name)
            stamp, hashed_ns = _file_stamp(name), time.time_ns()
            content = path.read_bytes()
            digest = hashlib.sha256(content).hexdigest()
            if self._digests.setdefault(name, digest) != digest:
                raise _changed_error(path)
            self._add_entry(name, stamp, hashed_ns, digest)
            self._contents[name] = content
            self._held_bytes += len(content)
        return io.BytesIO(self._contents[name])

    def _open_unheld(self, path: Path, name: str) -> io.BufferedReader:
        """Open a file that is not held, and compare what was opened with its digest.

        Nothing is compared for a file that the run writes itself, until its digest is known.
        """
        file = path.open("rb")
        try:
            status = os.fstat(file.fileno())
            is_own = self._is_in_folder(name) or files.is_temporary(Path(name))
            is_known = name in self._digests or name in self._recorded
            if not stat.S_ISREG(status.st_mode) or (is_own and not is_known):
                return file
            expected = self.of(path)
            stamp, hashed_ns = _stamp(status), time.time_ns()
            if not self._is_trusted(name, stamp, expected):
                digest = hashlib.file_digest(file, "sha256").hexdigest()
                file.seek(0)
                if digest != expected:
                    raise _changed_error(path)
                self._add_entry(name, stamp, hashed_ns, digest)
        except BaseException:
            file.close()
            raise
        return file

    def check_unchanged(self, paths: Mapping[str, Path] | None = None) -> None:
        """Check that files are still those that were hashed, after the work that has read them.

        Contents that are held in memory cannot change, so their files may.

        Parameters
        ----------
        paths
            Files by real path (:meth:`collect`); all files that were hashed if None.

        Raises
        ------
        InputError
            When a file was changed or replaced, even if it was replaced by the original in the end.
        """
        for name, path in list((self._collected if paths is None else paths).items()):
            if name in self._digests and name not in self._contents and not self._is_unchanged(name):
                raise _changed_error(path)

    @contextmanager
    def unchanged(self, *paths: Path) -> Iterator[None]:
        """Check files that the block reads by their names, perhaps in another process, as :meth:`check_unchanged`."""
        names = {os.path.realpath(path): path for path in paths if path.is_file()}
        hashed = {name: path for name, path in names.items() if name in self._digests}
        yield
        for name, path in hashed.items():
            if name in self._digests and not self._is_unchanged(name):
                raise _changed_error(path)

    @contextmanager
    def collect(self) -> Iterator[dict[str, Path]]:
        """Yield the files whose digests are requested in the block, by real path."""
        outer, self._collected = self._collected, {}
        try:
            yield self._collected
        finally:
            self._collected = outer | self._collected

    def expect(self, digests: Mapping[Path, str]) -> None:
        """Note the digests of files that were just written: other content under these names is refused."""
        for path, digest in digests.items():
            name = os.path.realpath(path)
            self._digests[name] = digest
            self.entries.pop(name, None)

    def forget(self, *paths: Path) -> None:
        """Forget files, or all files in folders, that are about to be written."""
        for written in map(os.path.realpath, paths):
            for known in (self._digests, self._recorded, self.entries):
                for file in list(known):
                    if Path(file).is_relative_to(written):
                        del known[file]

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
        entry = self._earlier.get(name)
        if entry is None or not Path(name).is_file() or not _is_current(entry, _file_stamp(name)):
            return None
        self.entries[name] = entry
        return str(entry[-1])

    def _is_trusted(self, name: str, stamp: Stamp | None, digest: str) -> bool:
        """Whether the stamp alone shows that a file has a digest."""
        entry = self.entries.get(name)
        return entry is not None and entry[-1] == digest and _is_current(entry, stamp)

    def _is_unchanged(self, name: str) -> bool:
        """Whether a file is the one that was hashed, and has been all the time.

        A new link to a file changes its ctime only; then, and where the stamp is too young, the file is hashed.
        """
        digest, entry, stamp = self._digests[name], self.entries.get(name), _file_stamp(name)
        if self._is_trusted(name, stamp, digest):
            return True
        if entry is not None and stamp is not None and not _is_same_file(entry, stamp):
            return False
        return Path(name).is_file() and files.hash_file(Path(name)) == digest

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


def forget_file(path: Path) -> None:
    """Forget a file that this program has read and is about to write again; in a run, as :meth:`Digests.forget`."""
    digests = _IN_USE.get()
    if digests is not None:
        digests.forget(path)


@contextmanager
def unchanged_inputs(*paths: Path) -> Iterator[None]:
    """Check, in a run, files that the block reads by their names, as :meth:`Digests.unchanged`."""
    digests = _IN_USE.get()
    with nullcontext() if digests is None else digests.unchanged(*paths):
        yield


def _changed_error(path: Path) -> InputError:
    return InputError(path, "was changed while it was in use", "Repeat the command.")


def _is_current(entry: list[Any], stamp: Stamp | None) -> bool:
    """Whether a file with a stamp still has the digest of an entry, as far as stamps can be trusted."""
    *recorded, hashed_ns, _ = entry
    return stamp is not None and recorded == list(stamp) and stamp[1] + RACY_NS <= hashed_ns


def _is_same_file(entry: list[Any], stamp: Stamp) -> bool:
    """Whether size, mtime, inode and device are those of an entry."""
    size, mtime_ns, _, inode, device, *_ = entry
    return (size, mtime_ns, inode, device) == (stamp[0], stamp[1], *stamp[3:])


def _file_stamp(name: str) -> Stamp | None:
    """Return what changes when a file is written; None where it cannot be trusted."""
    try:
        return _stamp(Path(name).stat())
    except OSError:
        return None


def _stamp(status: os.stat_result) -> Stamp | None:
    """Return the stamp of a file; None where it cannot be trusted."""
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
