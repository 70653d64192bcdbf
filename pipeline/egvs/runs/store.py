"""The store: results of stages cached by a hash of their inputs (:mod:`egvs.runs.stage_keys`).

The cache is a folder on this machine, by default in the user's cache, and optionally a store shared by machines::

    <store>/<stage>-<key>/          artefacts, companions, and entry.json: hashes (also its own), summary, cost
    <store>/.locks/<stage>-<key>    held by the process that makes this entry; others wait for it, then use the entry
    <store>/.work/                  entries that are incomplete, or being removed
    <store>/.lock                   shared by those who read or add an entry, exclusive for those who remove one
    <store>/.usage                  size and number of all entries, as counted by those who add one
    <store>/.in_use/<token>         a city run in progress: entries that it has used stay

An entry is written in ``.work``, then renamed: it is either complete or absent, even if a process is killed. The hash
of every file is checked when an entry is used; a damaged entry is removed and computed again. The least recently used
entries are removed when all together exceed a limit. Other files in the folder are ignored. A store that cannot be
written is reported once, and not used further.

Adding an entry does not list the others: it adds to the size in ``.usage``. This size may be wrong, for example after a
kill between adding an entry and counting it. So it only decides when to list all entries, which corrects it: after as
many new entries as there are, once a day, when the file is missing or damaged, and before entries are removed.

A shared store is any file system that fsspec knows (``s3://``, ``gs://``, ``file://``, ...), with the same folders of
entries; ``entry.json`` is written last. What the folder lacks is fetched from there, and new entries are put there.
Locks only work on one machine: two machines that make the same entry at once both write the same bytes. An entry
without ``entry.json`` does not count; one with other hashes is removed.
"""

from __future__ import annotations

import json
import math
import os
import posixpath
import re
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from egvs.artefacts.run_folder import STAGE_NAMES
from egvs.core import files, plugins
from egvs.core.cache_folder import user_cache_folder, user_cache_path
from egvs.core.errors import InputError
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.reading import translate_errors
from egvs.core.resource_usage import ResourceUsage
from egvs.runs import locks
from egvs.runs.locks import locked
from egvs.runs.stage_registry import StageResult

ENTRY_FILE = "entry.json"
"""Record of an entry; written last."""

_EXTRA_FOLDER = ".egvs"
"""Folder in a shared store of files that belong to no entry."""

_LOCATION_HINT = "Check that this machine may read and write there, and install its library (s3fs for s3://)."


class RemoteStore:
    """Entries at a URL. Each method raises InputError where the URL cannot be reached."""

    def __init__(self, url: str) -> None:
        plugins.require_libraries(f"a store at {url}", "cluster", "fsspec")
        self.url = url
        import fsspec

        with translate_errors(url, _LOCATION_HINT, "cannot be reached"):
            fs, root = fsspec.core.url_to_fs(url)
        self._fs: Any = fs
        self._root: str = root.rstrip("/")

    def check(self) -> None:
        """Check that files can be written, read and removed there."""
        self.write_file("probe", b"egvs")
        if self.read_file("probe") != b"egvs":
            raise InputError(self.url, "does not return the bytes that were written", _LOCATION_HINT)
        self.remove_file("probe")

    def write_file(self, name: str, content: bytes) -> None:
        """Write a file that belongs to no entry."""
        path = self._path(_EXTRA_FOLDER, name)
        with translate_errors(self.url, _LOCATION_HINT, "cannot be written"):
            self._fs.makedirs(posixpath.dirname(path), exist_ok=True)
            self._fs.pipe_file(path, content)

    def read_file(self, name: str) -> bytes:
        """Return the content of a file that belongs to no entry."""
        with translate_errors(self.url, _LOCATION_HINT, "cannot be read"):
            self._fs.invalidate_cache()
            content: bytes = self._fs.cat_file(self._path(_EXTRA_FOLDER, name))
        return content

    def remove_file(self, name: str) -> None:
        """Remove a file that belongs to no entry."""
        with translate_errors(self.url, _LOCATION_HINT, "cannot be written"):
            self._fs.rm_file(self._path(_EXTRA_FOLDER, name))

    def fetch(self, name: str, folder: Path) -> bool:
        """Copy the files of an entry into a folder; return False where there is no such entry, or it is damaged."""
        with translate_errors(self.url, _LOCATION_HINT, "cannot be read"):
            try:
                content = self._fs.cat_file(self._path(name, ENTRY_FILE))
            except FileNotFoundError:
                return False
            digests = _parse_digests(content)
            if digests is None or not self._fetch_files(name, digests, folder):
                self._fs.rm(self._path(name), recursive=True)
                return False
        (folder / ENTRY_FILE).write_bytes(content)
        return True

    def _fetch_files(self, name: str, digests: dict[str, str], folder: Path) -> bool:
        for file, digest in digests.items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            try:
                self._fs.get_file(self._path(name, file), str(folder / file))
            except FileNotFoundError:
                return False
            if files.hash_file(folder / file) != digest:
                return False
        return True

    def put(self, name: str, folder: Path, names: Iterable[str]) -> None:
        """Save the files of an entry, unless it exists already."""
        with translate_errors(self.url, _LOCATION_HINT, "cannot be written"):
            self._fs.invalidate_cache()
            if self._fs.exists(self._path(name, ENTRY_FILE)):
                return
            for file in (*names, ENTRY_FILE):
                path = self._path(name, file)
                self._fs.makedirs(posixpath.dirname(path), exist_ok=True)
                self._fs.put_file(str(folder / file), path)

    def remove(self, name: str) -> None:
        """Remove an entry, if it exists."""
        with translate_errors(self.url, _LOCATION_HINT, "cannot be written"):
            self._fs.invalidate_cache()
            if self._fs.exists(self._path(name)):
                self._fs.rm(self._path(name), recursive=True)

    def _path(self, *parts: str) -> str:
        return posixpath.join(self._root, *parts)


def _parse_digests(content: bytes) -> dict[str, str] | None:
    """Name -> sha256 of the files of an entry; None where its record is invalid."""
    try:
        value = json.loads(content)
        digests = {**value["artefacts"], **value["companions"]}
    except (ValueError, LookupError, TypeError, RecursionError):
        return None
    for name, digest in digests.items():
        path = PurePosixPath(str(name))
        if path.is_absolute() or ".." in path.parts or not path.parts or not isinstance(digest, str):
            return None
    return digests


STORE_VARIABLE, MAX_GB_VARIABLE = "EGVS_STORE", "EGVS_STORE_MAX_GB"
"""Environment variables: location of the store (a folder, or a URL that machines share; empty for no store), and the
largest size of its folder."""

DEFAULT_MAX_GB = 10.0

_PRUNED_SHARE = 0.9
"""A store that exceeds its limit is reduced to this share of it, so that entries are removed rarely."""

_MIN_PUTS, _MAX_PUTS = 100, 10_000
"""All entries are listed after as many new ones as there are, within these limits."""

_MAX_COUNT_AGE_S = 86_400.0
"""All entries are listed when the last list is older."""

_PRUNE_AGAIN_S, _PRUNE_AGAIN_SHARE = 600.0, 0.1
"""A store that could not be reduced, because its entries are in use, is listed again after this time, or after growing
by this share of its limit."""

_IN_USE_S, _TOUCH_INTERVAL_S = 3600.0, 60.0
"""A run whose file in ``.in_use`` was not touched for this time has been killed; how often it is touched."""

_CLOCK_TOLERANCE_S = 600.0
"""Clocks of machines may differ by this time."""

_OVERRIDE: ContextVar[tuple[str, float] | None] = ContextVar("_OVERRIDE", default=None)


@contextmanager
def use_store(location: str, bound_bytes: float) -> Iterator[None]:
    """Use this store in this thread during the block, whatever the environment variables are."""
    before = _OVERRIDE.set((location, bound_bytes))
    try:
        yield
    finally:
        _OVERRIDE.reset(before)


def read_store_settings() -> tuple[Path | None, float]:
    """Return the folder of the store on this machine, None without a store, and its largest size in bytes."""
    override = _OVERRIDE.get()
    if override is not None:
        return _local_folder(override[0]), override[1]
    text = os.environ.get(MAX_GB_VARIABLE)
    try:
        bound_gb = DEFAULT_MAX_GB if text is None else float(text)
    except ValueError:
        bound_gb = math.nan
    if not 0 <= bound_gb < math.inf:
        raise InputError(MAX_GB_VARIABLE, f"expected a number of GB, got {text!r}", "Set a number such as 10.")
    return _local_folder(_store_location()), bound_gb * 1e9


def remote_url() -> str | None:
    """Return the URL of the shared store; None where the store is a folder, or there is none."""
    location = _store_location()
    if location is None or not _is_url(location):
        return None
    return location


def _store_location() -> str | None:
    override = _OVERRIDE.get()
    if override is not None:
        return override[0]
    return os.environ.get(STORE_VARIABLE)


def _local_folder(location: str | None) -> Path | None:
    """The folder on this machine: :func:`default_folder` where the location is a URL or not set."""
    if location is None or _is_url(location):
        return default_folder()
    return Path(location) if location else None


def default_folder() -> Path:
    """Return the folder of the store in the user's cache, which all runs of a user share."""
    return (user_cache_folder() or user_cache_path()) / "store"


def _is_url(location: str) -> bool:
    return "://" in location


@contextmanager
def entries_in_use(folder: Path, token: str) -> Iterator[None]:
    """Keep all entries of a store that are used during the block, by any process.

    Parameters
    ----------
    folder
        Folder of the store.
    token
        Name of the run, unique.
    """
    runs_folder, stop = folder / _IN_USE_FOLDER, threading.Event()
    if runs_folder.is_symlink():
        raise InputError(runs_folder, "is a symbolic link, and nothing is written through links", "Remove it.")
    path = runs_folder / token

    def touch() -> None:
        while not stop.wait(_TOUCH_INTERVAL_S):
            with suppress(OSError):
                path.touch()

    with suppress(OSError):  # reported when an entry cannot be written
        runs_folder.mkdir(parents=True, exist_ok=True)
        path.write_text(repr(time.time()), encoding="utf-8")
        _remove_ended_runs(runs_folder)
    thread = threading.Thread(target=touch, name="store", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _remove_ended_runs(folder: Path) -> None:
    """Remove what killed runs left in ``.in_use``."""
    for path in folder.iterdir():
        with suppress(OSError):
            if re.fullmatch("[0-9a-f]{8}", path.name) and time.time() - path.stat().st_mtime > _MAX_COUNT_AGE_S:
                path.unlink()


def check_outside_store(folder: Path) -> None:
    """Raise InputError where a run folder is the folder of the store, or lies in it.

    The run would wait forever for a lock that it holds itself.
    """
    store, _ = read_store_settings()
    if store is not None and Path(os.path.realpath(folder)).is_relative_to(os.path.realpath(store)):
        raise InputError(folder, f"is the store ({store}) or inside it", "Use a folder outside the store.")


_HASH_FIELD = "sha256"
"""Key in the record of an entry with the hash of all other keys."""

ENTRY_KINDS = (*STAGE_NAMES, "points", "detections", "part", "scene", "trial")
"""Kinds of entries: stages, detections and points of a site, parts of a score, checks of a scene, and simulations that
find the traffic of a new city."""

_ENTRY_NAME = re.compile(rf"({'|'.join(ENTRY_KINDS)})-[0-9a-f]{{32}}")
"""Name of the folder of an entry; folders with other names do not belong to the store and are never changed."""

_WORK_FOLDER_NAME = re.compile(rf"{_ENTRY_NAME.pattern}|removed-{_ENTRY_NAME.pattern}-[0-9]+-[0-9]+")
"""Names of folders in ``.work`` and of files in ``.locks``."""


_USAGE_BYTES = 256
"""Size of the file ``.usage``."""

_IN_USE_FOLDER = ".in_use"


@dataclass(frozen=True)
class StoreEntry:
    """An entry of the store.

    Attributes
    ----------
    folder
        Folder of its files.
    stage, key
        The stage, and the hash of its inputs.
    made
        Result of the stage, with the cost of making it.
    bytes
        Size of all artefacts and companions.
    created, last_used
        Seconds since the epoch.
    """

    folder: Path
    stage: str
    key: str
    made: StageResult
    bytes: int
    created: float
    last_used: float


@dataclass(frozen=True)
class _StoreUsage:
    """Size of all entries, as counted.

    Attributes
    ----------
    bytes, entries
        Size and number of entries.
    puts
        Entries that were added since all were listed.
    counted_at, pruned_at
        When all entries were listed, and when entries were last removed, in seconds since the epoch.
    pruned_to
        Size after entries were last removed.
    """

    bytes: int
    entries: int
    puts: int = 0
    counted_at: float = 0.0
    pruned_to: int = 0
    pruned_at: float = 0.0

    @classmethod
    def read(cls, descriptor: int | None) -> _StoreUsage | None:
        """Return the content of the file; None if it is missing, empty or damaged."""
        if descriptor is None:
            return None
        os.lseek(descriptor, 0, os.SEEK_SET)
        try:
            usage = cls(**json.loads(os.read(descriptor, _USAGE_BYTES)))
            is_valid = all(isinstance(value, int | float) and value >= 0 for value in asdict(usage).values())
        except (ValueError, TypeError, RecursionError):
            return None
        return usage if is_valid else None

    def write(self, descriptor: int | None) -> None:
        """Write the file, which always has the same size, in one piece."""
        if descriptor is None:
            return
        os.lseek(descriptor, 0, os.SEEK_SET)
        os.write(descriptor, json.dumps(asdict(self)).ljust(_USAGE_BYTES - 1).encode() + b"\n")

    def is_old(self) -> bool:
        """Return whether all entries should be listed again."""
        age_s = time.time() - self.counted_at
        max_puts = min(max(_MIN_PUTS, self.entries - self.puts), _MAX_PUTS)
        return self.puts > max_puts or not 0 <= age_s <= _MAX_COUNT_AGE_S

    def is_above(self, most_bytes: float) -> bool:
        """Return whether the store exceeds its limit, and trying to reduce it is not in vain."""
        if self.bytes <= most_bytes:
            return False
        has_grown = self.bytes > self.pruned_to + _PRUNE_AGAIN_SHARE * most_bytes
        is_long_ago = abs(time.time() - self.pruned_at) > _PRUNE_AGAIN_S
        return self.pruned_to <= most_bytes or has_grown or is_long_ago


class _DamagedEntry(Exception):
    """An entry is not as it was written."""


def _print_to_stderr(message: str) -> None:
    print(f"egvs: {message}", file=sys.stderr)


class Store:
    """A folder of entries that processes share.

    Parameters
    ----------
    folder
        The folder; None for a store that saves nothing.
    bound_bytes
        Largest size of all entries together.
    note
        Called with a message for the user: an entry was damaged, or the store cannot be written.
    remote
        Shared store: missing entries are fetched from it, and new ones are put there.
    """

    def __init__(
        self,
        folder: Path | None,
        bound_bytes: float = DEFAULT_MAX_GB * 1e9,
        note: Callable[[str], None] = _print_to_stderr,
        remote: RemoteStore | None = None,
    ) -> None:
        self.folder = folder
        self.bound_bytes = bound_bytes
        self._note = note
        self._can_write = folder is not None
        self._remote = remote
        if folder is not None:
            with suppress(OSError):  # reported when an entry cannot be written
                self._clear_work(folder)

    @classmethod
    def default(cls) -> Store:
        """Return the store that ``EGVS_STORE`` names, by default :func:`default_folder`."""
        url = remote_url()
        return cls(*read_store_settings(), remote=None if url is None else RemoteStore(url))

    def check(self, *, changed: bool) -> None:
        """Raise InputError where the folder is a file, or there is no store although it is to be ``changed``."""
        if self.folder is None and changed:
            raise InputError(STORE_VARIABLE, "is empty, so there is no store", "Set it to the folder of the store.")
        if self.folder is not None and _exists_as(Path.is_file, self.folder):
            raise InputError(self.folder, "is a file", f"Set {STORE_VARIABLE} to the folder of the store.")

    # ---- one entry

    def take(self, stage: str, key: str, out: Path, *, link: bool = False) -> StoreEntry | None:
        """Restore the files of an entry in ``out``; return None where there is no such entry, or it was damaged.

        ``link`` makes hard links instead of copies: for folders in which files are replaced, never changed.
        """
        if self.folder is None or not self.has(stage, key):
            return None
        folder = self._entry_folder(stage, key)
        try:
            with self._shared():
                entry = _read_entry(folder)
                for name, digest in entry.made.files.items():
                    _restore_file(folder / name, out / name, digest, link)
                with suppress(OSError):  # a read-only store
                    os.utime(folder / ENTRY_FILE)
                return entry
        except _DamagedEntry as damage:
            self._note(f"{folder}: the cached {stage} is damaged ({damage}) and will be made again")
        with suppress(OSError), locked(self.folder / ".lock"):
            self._remove(folder)
        return None

    def has(self, stage: str, key: str) -> bool:
        """Return whether there is an entry in the folder, which may be damaged."""
        return self.folder is not None and _exists_as(Path.is_dir, self._entry_folder(stage, key))

    def fetch(self, stage: str, key: str) -> None:
        """Copy an entry from the shared store into the folder, if it is missing there; within its :meth:`maker`."""
        if self._remote is None or not self._can_write or self.folder is None:
            return
        final = self._entry_folder(stage, key)
        if final.exists():
            return
        work = self.folder / ".work" / final.name
        try:
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir(parents=True)
            if self._call_remote(lambda remote: remote.fetch(final.name, work)):
                usage = self._add(work, final, _read_entry(work).bytes)
                if usage.is_above(self.bound_bytes):
                    self._prune_unused()
        except _DamagedEntry as damage:
            self._note(f"{self._remote.url}: the cached {stage} is damaged ({damage}) and will be made again")
        except OSError as error:
            self._stop_writing(error)
        finally:
            shutil.rmtree(work, ignore_errors=True)

    @contextmanager
    def maker(
        self, stage: str, key: str, *, wait: bool = True, progress: ProgressCallback = no_progress
    ) -> Iterator[bool]:
        """Make an entry exclusively during the block; yield False if another process makes it, only without ``wait``.

        A store that cannot be written excludes nobody.
        """
        if not self._can_write or self.folder is None:
            yield True
            return
        lock = self.folder / ".locks" / self._entry_folder(stage, key).name
        try:
            lock.parent.mkdir(parents=True, exist_ok=True)
            locks.create_lock(lock)
        except OSError as error:
            self._stop_writing(error)
            yield True
            return
        with locked(lock, wait=False, remove=True) as is_locked:
            if is_locked or not wait:
                yield is_locked
                return
        progress("waits for another run that makes the same", 0, 0)
        with locked(lock, remove=True):
            yield True

    def put(self, stage: str, key: str, out: Path, result: StageResult, *, link: bool = False) -> None:
        """Save the result of a stage in ``out``; within its :meth:`maker`.

        An entry with the same digests stays; one with other digests is wrong, since the result was just made from
        inputs that were verified, and is replaced.

        Raises
        ------
        InputError
            When a file of the result was changed or replaced after it was written.
        """
        if not self._can_write or self.folder is None:
            return
        final = self._entry_folder(stage, key)
        if final.exists() and not self._removed_wrong(final, stage, result):
            return
        work = self.folder / ".work" / final.name
        try:
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir(parents=True)
            for name in result.files:
                _copy_or_link(out / name, work / name, link)
                if files.hash_file(work / name) != result.files[name]:
                    raise InputError(out / name, "was changed while it was in use", "Repeat the command.")
            (work / ENTRY_FILE).write_text(_entry_to_json(stage, key, work, result), encoding="utf-8")
            usage = self._add(work, final, sum((work / name).stat().st_size for name in result.files))
            self._call_remote(lambda remote: remote.put(final.name, final, result.files))
            if usage.is_above(self.bound_bytes):
                self._prune_unused()
        except OSError as error:
            self._stop_writing(error)
        finally:
            shutil.rmtree(work, ignore_errors=True)

    def _removed_wrong(self, final: Path, stage: str, result: StageResult) -> bool:
        """Remove an entry whose digests are not those of a result, here and in the shared store; return whether."""
        assert self.folder is not None
        try:
            if _read_entry(final).made.artefacts == result.artefacts:
                return False
        except _DamagedEntry:
            pass
        self._note(f"{final}: the cached {stage} is not what its inputs give and is replaced")
        with locked(self.folder / ".lock"):
            self._remove(final)
        self._call_remote(lambda remote: remote.remove(final.name))
        return True

    # ---- all entries

    def entries(self) -> list[StoreEntry]:
        """Return all valid entries, the most recently used first."""
        valid = []
        for folder in self._folders():
            with suppress(_DamagedEntry):
                valid.append(_read_entry(folder))
        return sorted(valid, key=lambda entry: entry.last_used, reverse=True)

    def prune(self, most_bytes: float) -> list[StoreEntry]:
        """Remove the least recently used entries until the others fit into ``most_bytes`` (below 0: all).

        Entries that a city run in progress has used are kept, unless all are to be removed. Returns the removed ones.
        """
        if self.folder is None or not self._folders() or sum(entry.bytes for entry in self.entries()) <= most_bytes:
            return []
        with locked(self.folder / ".lock"):
            return self._remove_oldest(most_bytes)

    def usage_bytes(self) -> int:
        """Return the size of all entries, as counted; 0 where there is no store."""
        if self.folder is None or not _exists_as(Path.is_dir, self.folder):
            return 0
        try:
            with self._usage_file() as descriptor:
                usage = _StoreUsage.read(descriptor)
        except OSError:
            usage = None
        return (usage or self._list_usage()).bytes

    def _add(self, work: Path, final: Path, n_bytes: int) -> _StoreUsage:
        """Move a complete entry to its place, and count it; list all entries if their size is unknown or old."""
        with self._shared(), self._usage_file() as descriptor:
            work.rename(final)
            usage = _StoreUsage.read(descriptor)
            if usage is not None:
                usage = replace(usage, bytes=usage.bytes + n_bytes, entries=usage.entries + 1, puts=usage.puts + 1)
            if usage is None or usage.is_old():
                usage = self._list_usage()
            usage.write(descriptor)
        return usage

    def _list_usage(self) -> _StoreUsage:
        entries = self.entries()
        return _StoreUsage(sum(entry.bytes for entry in entries), len(entries), counted_at=time.time())

    def _prune_unused(self) -> None:
        """Reduce a store that exceeds its limit, unless another process has done it meanwhile."""
        assert self.folder is not None
        with locked(self.folder / ".lock"):
            with self._usage_file() as descriptor:
                usage = _StoreUsage.read(descriptor)
            if usage is None or usage.is_above(self.bound_bytes):
                self._remove_oldest(self.bound_bytes, _PRUNED_SHARE * self.bound_bytes)

    def _remove_oldest(self, most_bytes: float, target_bytes: float | None = None) -> list[StoreEntry]:
        """Remove entries that are not in use if all exceed ``most_bytes``, down to ``target_bytes`` if possible.

        The caller has the exclusive lock of the store.
        """
        entries = self.entries()
        for folder in set(self._folders()) - {entry.folder for entry in entries}:
            self._remove(folder)  # damaged
        total = sum(entry.bytes for entry in entries)
        target = most_bytes if target_bytes is None else target_bytes
        removed: list[StoreEntry] = []
        if total > most_bytes:
            in_use_since = math.inf if most_bytes < 0 else self._in_use_since()
            while entries and total > target and entries[-1].last_used < in_use_since:
                if total <= most_bytes and len(entries) == 1:
                    break
                removed.append(entries.pop())
                total -= removed[-1].bytes
                self._remove(removed[-1].folder)
        now = time.time()
        with suppress(OSError), self._usage_file() as descriptor:
            _StoreUsage(total, len(entries), counted_at=now, pruned_to=total, pruned_at=now).write(descriptor)
        return removed

    def _in_use_since(self) -> float:
        """Return the start of the first city run in progress, in seconds since the epoch; infinity without one."""
        assert self.folder is not None
        start = math.inf
        with suppress(OSError):
            for path in (self.folder / _IN_USE_FOLDER).iterdir():
                with suppress(OSError, ValueError):
                    if time.time() - path.stat().st_mtime < _IN_USE_S + _CLOCK_TOLERANCE_S:
                        start = min(start, float(path.read_text(encoding="utf-8")) - _CLOCK_TOLERANCE_S)
        return start

    @contextmanager
    def _usage_file(self) -> Iterator[int | None]:
        """Lock the record of the size; yield its descriptor, None where another user owns it."""
        assert self.folder is not None
        try:
            descriptor = locks.open_lock(self.folder / ".usage")
        except PermissionError:
            yield None
            return
        try:
            locks.wait_for_lock(descriptor, math.inf)
            yield descriptor
        finally:
            os.close(descriptor)

    def _folders(self) -> list[Path]:
        """Folders of all entries, also of damaged ones."""
        if self.folder is None or not _exists_as(Path.is_dir, self.folder):
            return []
        return [path for path in self.folder.iterdir() if _ENTRY_NAME.fullmatch(path.name) and path.is_dir()]

    def _entry_folder(self, stage: str, key: str) -> Path:
        assert self.folder is not None
        return self.folder / f"{stage}-{key[:32]}"

    def _remove(self, folder: Path) -> None:
        """Remove an entry; the caller has the exclusive lock of the store."""
        assert self.folder is not None
        removed = self.folder / ".work" / f"removed-{folder.name}-{os.getpid()}-{time.monotonic_ns()}"
        removed.parent.mkdir(exist_ok=True)
        with suppress(FileNotFoundError):  # another process was first
            folder.rename(removed)
        shutil.rmtree(removed, ignore_errors=True)

    @contextmanager
    def _shared(self) -> Iterator[None]:
        """Keep processes that remove entries out during the block."""
        assert self.folder is not None
        with ExitStack() as stack:
            with suppress(OSError):  # a read-only store without a lock file
                stack.enter_context(locked(self.folder / ".lock", shared=True))
            yield

    def _clear_work(self, folder: Path) -> None:
        """Remove what killed processes left; processes at work hold their lock.

        InputError where the folder ``.work`` or ``.locks`` is a symbolic link.
        """
        for path in (folder / ".work", folder / ".locks"):
            if path.is_symlink():
                raise InputError(path, "is a symbolic link, and nothing is written through links", "Remove it.")
        names = {path.name for name in (".work", ".locks") for path in (folder / name).glob("*")}
        for name in filter(_WORK_FOLDER_NAME.fullmatch, names):
            with suppress(OSError), locked(folder / ".locks" / name, wait=False, remove=True) as is_locked:
                if is_locked:
                    shutil.rmtree(folder / ".work" / name, ignore_errors=True)

    def _call_remote(self, call: Callable[[RemoteStore], bool | None]) -> bool | None:
        """Call the shared store; if that fails, report it once and continue without it."""
        if self._remote is None:
            return None
        try:
            return call(self._remote)
        except InputError as error:
            self._remote = None
            self._note(f"{error} The run continues without it.")
            return None

    def _stop_writing(self, error: OSError) -> None:
        """Report that the store cannot be written, and do not try it again."""
        self._can_write = False
        self._note(
            f"{self.folder}: the store cannot be written ({error.strerror or error}); the run continues without it"
        )


def _exists_as(kind: Callable[[Path], bool], path: Path) -> bool:
    """Whether a path is a file or a folder; False where it is too long, or leads through a forbidden folder."""
    try:
        return kind(path)
    except OSError:
        return False


def _restore_file(stored: Path, path: Path, digest: str, link: bool) -> None:
    """Restore a file, completely or not at all; :class:`_DamagedEntry` when its digest is another one."""
    if not (stored.is_file() and os.access(stored, os.R_OK)):
        raise _DamagedEntry(f"{stored.name} is missing or cannot be read")
    with files.atomic_write(path) as partial:
        if link:
            path.unlink(missing_ok=True)  # to rename one name of a file over another one does nothing
        try:
            _copy_or_link(stored, partial, link)
        except OSError as error:
            error.filename, error.filename2 = str(path), None  # the full disk is that of the new file
            raise
        if files.hash_file(partial) != digest:
            raise _DamagedEntry(f"{stored.name} was changed")


def _copy_or_link(path: Path, other: Path, link: bool) -> None:
    """Copy a file, or link it if requested and possible."""
    other.parent.mkdir(parents=True, exist_ok=True)
    if link:
        other.unlink(missing_ok=True)
        with suppress(OSError):
            os.link(path, other)
            return
    shutil.copyfile(path, other)


def _entry_to_json(stage: str, key: str, folder: Path, result: StageResult) -> str:
    sizes = {name: (folder / name).stat().st_size for name in result.files}
    record = {"stage": stage, "key": key, **asdict(result), "bytes": sizes, "created": time.time()}
    record[_HASH_FIELD] = files.hash_json(record)
    return files.to_json_text(record, indent=1) + "\n"


def _read_entry(folder: Path) -> StoreEntry:
    try:
        value = json.loads((folder / ENTRY_FILE).read_text(encoding="utf-8"))
        if value.pop(_HASH_FIELD) != files.hash_json(value):
            raise _DamagedEntry(f"{ENTRY_FILE} was changed")
        last_used = (folder / ENTRY_FILE).stat().st_mtime
        artefacts, companions, summary = (dict(value[name]) for name in ("artefacts", "companions", "summary"))
        result = StageResult(artefacts, companions, summary, ResourceUsage(**value["cost"]))
        size = sum(int(size) for size in value["bytes"].values())
        entry = StoreEntry(folder, value["stage"], value["key"], result, size, float(value["created"]), last_used)
        name = f"{entry.stage}-{entry.key[:32]}"
    except (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        raise _DamagedEntry(f"{ENTRY_FILE}: {error}") from None
    if folder.name != name:
        raise _DamagedEntry(f"{ENTRY_FILE} belongs to {name}")
    return entry
