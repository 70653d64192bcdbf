"""Results cached by a hash of their inputs; local and remote.

A store on any file system that fsspec knows (``s3://``, ``gs://``, ``file://``, ...), shared by machines.

    <url>/<stage>-<key>/            the same files as an entry of a store's folder has; entry.json is written last

It stands behind a store's folder on this machine: what is not there is fetched, and what was made here is put. Locks
are this machine's alone: two machines that make the same at once both put it, which is the same bytes twice. An entry
without entry.json is none; one whose files have other hashes than it says is removed. Nothing else is ever removed.

Where the store is, and how much it may hold: what the environment says of it.

The store: what a stage once made, kept under the hash of everything that it depends on.

    <store>/<stage>-<key>/          artefacts, companions, and entry.json: hashes (its own too), summary, cost
    <store>/.locks/<stage>-<key>    held by the one process that makes this entry; others wait for it, then take it
    <store>/.work/                  what is not whole yet, or no longer
    <store>/.lock                   shared by those who read or lay down an entry, held alone by those who remove one

An entry is written aside, then renamed: it is there whole or not at all, whenever a process is killed. Every file's
hash is checked when it is taken, and that of entry.json whenever it is read; an entry that is damaged is removed, so
that it is made again. The entries used longest ago go first when all of them take more than a bound. What else lies in
the folder is left alone. A store that cannot be written is named once, and done without.

Behind the folder there may be another store that machines share (:mod:`egvs.runs.store`).
"""

from __future__ import annotations

import json
import math
import os
import posixpath
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from egvs.artefacts.run_folder import STAGE_NAMES
from egvs.core import files, plugins
from egvs.core.errors import InputError
from egvs.core.reading import translate_errors
from egvs.core.runtime import ProgressCallback, ResourceUsage, no_progress
from egvs.runs import locks
from egvs.runs.locks import locked
from egvs.runs.stages import StageResult

ENTRY_FILE = "entry.json"
"""What the store notes of an entry; written last."""

_EXPECTED_LOCATION = "a place that this machine may read and write, and the library of its kind (s3fs for s3://)"


class RemoteStore:
    """Entries at a URL. Each method raises InputError where the place cannot be reached."""

    def __init__(self, url: str) -> None:
        plugins.require_libraries(f"a store at {url}", "cluster", "fsspec")
        self.url = url
        import fsspec

        with translate_errors(url, _EXPECTED_LOCATION, "cannot be reached"):
            fs, root = fsspec.core.url_to_fs(url)
        self._fs: Any = fs
        self._root: str = root.rstrip("/")

    def check(self) -> None:
        """See that files can be written, read and removed there."""
        probe = self._path(".egvs", "probe")
        with translate_errors(self.url, _EXPECTED_LOCATION, "cannot be written"):
            self._fs.makedirs(posixpath.dirname(probe), exist_ok=True)
            self._fs.pipe_file(probe, b"egvs")
            self._fs.invalidate_cache()
            if self._fs.cat_file(probe) != b"egvs":
                raise InputError(self.url, "gives back other bytes than were written", _EXPECTED_LOCATION)
            self._fs.rm_file(probe)

    def fetch(self, name: str, folder: Path) -> bool:
        """Lay an entry's files into a folder; whether there is such an entry, whole and sound."""
        with translate_errors(self.url, _EXPECTED_LOCATION, "cannot be read"):
            try:
                about = self._fs.cat_file(self._path(name, ENTRY_FILE))
            except FileNotFoundError:
                return False
            digests = _parse_digests(about)
            if digests is None or not self._fetch_files(name, digests, folder):
                self._fs.rm(self._path(name), recursive=True)
                return False
        (folder / ENTRY_FILE).write_bytes(about)
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
        """Keep an entry's files, unless it is kept already."""
        with translate_errors(self.url, _EXPECTED_LOCATION, "cannot be written"):
            self._fs.invalidate_cache()
            if self._fs.exists(self._path(name, ENTRY_FILE)):
                return
            for file in (*names, ENTRY_FILE):
                path = self._path(name, file)
                self._fs.makedirs(posixpath.dirname(path), exist_ok=True)
                self._fs.put_file(str(folder / file), path)

    def _path(self, *parts: str) -> str:
        return posixpath.join(self._root, *parts)


def _parse_digests(content: bytes) -> dict[str, str] | None:
    """Name -> sha256 of an entry's files, as its record says; None where that is no record of ours."""
    try:
        value = json.loads(content)
        digests = {**value["artefacts"], **value["companions"]}
    except (ValueError, LookupError, TypeError, RecursionError):
        return None
    named = [PurePosixPath(str(name)) for name in digests]
    if any(path.is_absolute() or ".." in path.parts or not path.parts for path in named):
        return None
    return digests if all(isinstance(digest, str) for digest in digests.values()) else None


STORE_VARIABLE, MAX_GB_VARIABLE = "EGVS_STORE", "EGVS_STORE_MAX_GB"
"""Environment variables: where the store is (empty for none; a folder, or a URL that machines share), and how much its
folder may hold."""

DEFAULT_FOLDER = Path("runs", ".store")
DEFAULT_MAX_GB = 10.0

_OVERRIDE: ContextVar[tuple[str, float] | None] = ContextVar("_ORDERED", default=None)


@contextmanager
def use_store(location: str, bound_bytes: float) -> Iterator[None]:
    """Within the block, this thread's store is there, whatever the environment says."""
    before = _OVERRIDE.set((location, bound_bytes))
    try:
        yield
    finally:
        _OVERRIDE.reset(before)


def read_store_settings() -> tuple[Path | None, float]:
    """The store's folder on this machine, None for no store; and its bound in bytes."""
    if (ordered := _OVERRIDE.get()) is not None:
        return _local_folder(ordered[0]), ordered[1]
    most = os.environ.get(MAX_GB_VARIABLE)
    try:
        bound_gb = DEFAULT_MAX_GB if most is None else float(most)
    except ValueError:
        bound_gb = math.nan
    if not 0 <= bound_gb < math.inf:
        raise InputError(MAX_GB_VARIABLE, f"{most!r}", "how many GB the store may hold, for example 10")
    return _local_folder(_store_location()), bound_gb * 1e9


def remote_url() -> str | None:
    """The URL of the store that machines share; None where it is a folder, or there is none."""
    place = _store_location()
    return place if place is not None and _is_url(place) else None


def _store_location() -> str | None:
    ordered = _OVERRIDE.get()
    return os.environ.get(STORE_VARIABLE) if ordered is None else ordered[0]


def _local_folder(location: str | None) -> Path | None:
    """The folder on this machine: beside the runs where the store's place is a URL, or is not said."""
    if location is None or _is_url(location):
        return DEFAULT_FOLDER
    return Path(location) if location else None


def _is_url(location: str) -> bool:
    return "://" in location


def check_outside_store(folder: Path) -> None:
    """InputError where a run's folder is the store's, or lies in it.

    A run would wait for ever on a lock that it holds itself.
    """
    store, _ = read_store_settings()
    if store is not None and Path(os.path.realpath(folder)).is_relative_to(os.path.realpath(store)):
        raise InputError(folder, f"is the store ({store}), or lies in it", "a folder outside of the store")


_HASH_FIELD = "sha256"
"""The key, in what the store notes of an entry, of the hash of all else in it."""

ENTRY_KINDS = (*STAGE_NAMES, "points", "detections", "part")
"""What entries are of: stages, what was found from a site, and parts of a score."""

_ENTRY_NAME = re.compile(rf"({'|'.join(ENTRY_KINDS)})-[0-9a-f]{{32}}")
"""An entry's folder. A folder of any other name is not the store's own, and never touched."""

_WORK_FOLDER_NAME = re.compile(rf"{_ENTRY_NAME.pattern}|removed-{_ENTRY_NAME.pattern}-[0-9]+-[0-9]+")
"""What the store makes in its folders for work."""


@dataclass(frozen=True)
class StoreEntry:
    """What the store holds of one stage.

    Attributes
    ----------
    made
        What came of the stage; the cost is that of making it.
    bytes
        Of all files, artefacts and companions.
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


class _DamagedEntry(Exception):
    """An entry is not as it was written."""


def _to_stderr(message: str) -> None:
    print(f"egvs: {message}", file=sys.stderr)


class Store:
    """A folder of entries that processes share.

    Parameters
    ----------
    folder
        None for a store that keeps nothing.
    bound_bytes
        What all entries together may take.
    note
        Called with what a user should know: that an entry was damaged, or that the store cannot be written.
    remote
        Where entries come from that are not in the folder, and where those go that are put into it.
    """

    def __init__(
        self,
        folder: Path | None,
        bound_bytes: float = DEFAULT_MAX_GB * 1e9,
        note: Callable[[str], None] = _to_stderr,
        remote: RemoteStore | None = None,
    ) -> None:
        self.folder, self.bound_bytes, self._note = folder, bound_bytes, note
        self._can_write, self._remote = folder is not None, remote
        if folder is not None:
            with suppress(OSError):  # which is named where it is in the way
                self._clear_work(folder)

    @classmethod
    def default(cls) -> Store:
        """Where ``EGVS_STORE`` says, else beside the runs."""
        url = remote_url()
        return cls(*read_store_settings(), remote=None if url is None else RemoteStore(url))

    def check(self, *, changed: bool) -> None:
        """InputError where the folder is a file, or where there is no store that could be ``changed``."""
        if self.folder is None and changed:
            raise InputError(STORE_VARIABLE, "empty, so that there is no store", "the store's folder")
        if self.folder is not None and _exists_as(Path.is_file, self.folder):
            raise InputError(self.folder, "is a file", f"the store's folder, which {STORE_VARIABLE} names")

    # ---- one entry

    def take(self, stage: str, key: str, out: Path, *, link: bool = False) -> StoreEntry | None:
        """Lay an entry's files into ``out``; None where there is no such entry, or it was damaged.

        ``link`` gives the files a second name instead of copying them: for folders in which files are replaced, never
        written into.
        """
        if self.folder is None or not _exists_as(Path.is_dir, folder := self._entry_folder(stage, key)):
            return None
        try:
            with self._shared():
                entry = _read_entry(folder)
                for name, digest in entry.made.files.items():
                    _restore_file(folder / name, out / name, digest, link)
                with suppress(OSError):  # a store that can only be read
                    os.utime(folder / ENTRY_FILE)
                return entry
        except _DamagedEntry as damage:
            self._note(f"{folder}: the kept {stage} is damaged ({damage}), and made again")
        with suppress(OSError), locked(self.folder / ".lock"):
            self._remove(folder)
        return None

    def fetch(self, stage: str, key: str) -> None:
        """Have an entry from the remote store in the folder, where it is there and not here; for its :meth:`maker`."""
        if self._remote is None or not self._can_write or self.folder is None:
            return
        if (final := self._entry_folder(stage, key)).exists():
            return
        work = self.folder / ".work" / final.name
        try:
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir(parents=True)
            if self._of_remote(lambda remote: remote.fetch(final.name, work)):
                _read_entry(work)
                with self._shared():
                    work.rename(final)
        except _DamagedEntry as damage:
            self._note(f"{self._remote.url}: the kept {stage} is damaged ({damage}), and made again")
        except OSError as error:
            self._do_without(error)
        finally:
            shutil.rmtree(work, ignore_errors=True)

    @contextmanager
    def maker(
        self, stage: str, key: str, *, wait: bool = True, progress: ProgressCallback = no_progress
    ) -> Iterator[bool]:
        """Be the only one that makes an entry; yields whether one is (without ``wait`` another may be).

        A store that cannot be written keeps nobody apart.
        """
        if not self._can_write or self.folder is None:
            yield True
            return
        lock = self.folder / ".locks" / self._entry_folder(stage, key).name
        try:
            lock.parent.mkdir(parents=True, exist_ok=True)
            locks.create_lock(lock)
        except OSError as error:
            self._do_without(error)
            yield True
            return
        with locked(lock, wait=False, remove=True) as mine:
            if mine or not wait:
                yield mine
                return
        progress("waits for another run that makes the same", 0, 0)
        with locked(lock, remove=True):
            yield True

    def put(self, stage: str, key: str, out: Path, made: StageResult, *, link: bool = False) -> None:
        """Keep what a stage made in ``out``, unless it is kept already; for its :meth:`maker`."""
        if not self._can_write or self.folder is None or (final := self._entry_folder(stage, key)).exists():
            return
        work = self.folder / ".work" / final.name
        try:
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir(parents=True)
            for name in made.files:
                _copy_or_link(out / name, work / name, link)
            (work / ENTRY_FILE).write_text(_entry_to_json(stage, key, work, made), encoding="utf-8")
            with self._shared():
                work.rename(final)
            self._of_remote(lambda remote: remote.put(final.name, final, made.files))
            self.prune(self.bound_bytes)
        except OSError as error:
            self._do_without(error)
        finally:
            shutil.rmtree(work, ignore_errors=True)

    # ---- all entries

    def entries(self) -> list[StoreEntry]:
        """All that are sound, the one used last first."""
        sound = []
        for folder in self._folders():
            with suppress(_DamagedEntry):
                sound.append(_read_entry(folder))
        return sorted(sound, key=lambda entry: entry.last_used, reverse=True)

    def prune(self, most_bytes: float) -> list[StoreEntry]:
        """Remove those used longest ago until the others take at most ``most_bytes`` (below 0: all); those gone."""
        removed: list[StoreEntry] = []
        if self.folder is None or sum(entry.bytes for entry in self.entries()) <= most_bytes or not self._folders():
            return removed
        with locked(self.folder / ".lock"):
            kept = self.entries()
            for folder in set(self._folders()) - {entry.folder for entry in kept}:
                self._remove(folder)  # damaged
            while kept and sum(entry.bytes for entry in kept) > most_bytes:
                removed.append(kept.pop())
                self._remove(removed[-1].folder)
        return removed

    def _folders(self) -> list[Path]:
        """Entries, damaged ones too."""
        if self.folder is None or not _exists_as(Path.is_dir, self.folder):
            return []
        return [path for path in self.folder.iterdir() if _ENTRY_NAME.fullmatch(path.name) and path.is_dir()]

    def _entry_folder(self, stage: str, key: str) -> Path:
        assert self.folder is not None
        return self.folder / f"{stage}-{key[:32]}"

    def _remove(self, folder: Path) -> None:
        """Take an entry away, whole; for those who hold the store alone."""
        assert self.folder is not None
        aside = self.folder / ".work" / f"removed-{folder.name}-{os.getpid()}-{time.monotonic_ns()}"
        aside.parent.mkdir(exist_ok=True)
        with suppress(FileNotFoundError):  # somebody else was first
            folder.rename(aside)
        shutil.rmtree(aside, ignore_errors=True)

    @contextmanager
    def _shared(self) -> Iterator[None]:
        """Keep out those who remove entries."""
        assert self.folder is not None
        with ExitStack() as held:
            with suppress(OSError):  # a store that can only be read, and in which nobody ever wrote with locks
                held.enter_context(locked(self.folder / ".lock", shared=True))
            yield

    def _clear_work(self, folder: Path) -> None:
        """Remove what killed processes left; who is still at work holds its lock.

        InputError where a folder for work, or a lock, is a symbolic link.
        """
        for path in (folder / ".work", folder / ".locks"):
            if path.is_symlink():
                raise InputError(path, "is a symbolic link, and nothing is written through links", "Remove it.")
        places = [place for name in (".work", ".locks") if (place := folder / name).is_dir()]
        names = {path.name for place in places for path in place.iterdir()}
        for name in filter(_WORK_FOLDER_NAME.fullmatch, names):
            with suppress(OSError), locked(folder / ".locks" / name, wait=False, remove=True) as free:
                if free:
                    shutil.rmtree(folder / ".work" / name, ignore_errors=True)

    def _of_remote(self, ask: Callable[[RemoteStore], bool | None]) -> bool | None:
        """What the remote store answers; one that is refused is named once, and done without."""
        if self._remote is None:
            return None
        try:
            return ask(self._remote)
        except InputError as error:
            self._remote = None
            self._note(f"{error}; the run goes on without it")
            return None

    def _do_without(self, error: OSError) -> None:
        self._can_write = False
        self._note(
            f"{self.folder}: the store cannot be written ({error.strerror or error}); the run goes on without it"
        )


def _exists_as(kind: Callable[[Path], bool], path: Path) -> bool:
    """Whether there is a file or a folder; not where the path is too long, or leads through what is closed."""
    try:
        return kind(path)
    except OSError:
        return False


def _restore_file(stored: Path, path: Path, digest: str, link: bool) -> None:
    """One file into a run's folder, whole or not at all; :class:`_DamagedEntry` when it is not as it was kept."""
    if not (stored.is_file() and os.access(stored, os.R_OK)):
        raise _DamagedEntry(f"{stored.name} is missing, or cannot be read")
    with files.atomic_write(path) as partial:
        if link:
            path.unlink(missing_ok=True)  # to rename one name of a file over another one does nothing
        try:
            _copy_or_link(stored, partial, link)
        except OSError as error:
            error.filename, error.filename2 = str(path), None  # else a full disk is blamed on the file that is read
            raise
        if files.hash_file(partial) != digest:
            raise _DamagedEntry(f"{stored.name} has other bytes than were kept")


def _copy_or_link(path: Path, other: Path, link: bool) -> None:
    """A file under another name: a second name where ``link`` asks for it and the disk allows it, else a copy."""
    other.parent.mkdir(parents=True, exist_ok=True)
    if link:
        other.unlink(missing_ok=True)
        with suppress(OSError):
            os.link(path, other)
            return
    shutil.copyfile(path, other)


def _entry_to_json(stage: str, key: str, folder: Path, made: StageResult) -> str:
    sizes = {name: (folder / name).stat().st_size for name in made.files}
    about = {"stage": stage, "key": key, **asdict(made), "bytes": sizes, "created": time.time()}
    about[_HASH_FIELD] = files.hash_json(about)
    return files.to_json_text(about, indent=1) + "\n"


def _read_entry(folder: Path) -> StoreEntry:
    try:
        value = json.loads((folder / ENTRY_FILE).read_text(encoding="utf-8"))
        if value.pop(_HASH_FIELD) != files.hash_json(value):
            raise _DamagedEntry(f"{ENTRY_FILE} says something else than was written")
        last_used = (folder / ENTRY_FILE).stat().st_mtime
        artefacts, companions, summary = (dict(value[name]) for name in ("artefacts", "companions", "summary"))
        made = StageResult(artefacts, companions, summary, ResourceUsage(**value["cost"]))
        size = sum(int(size) for size in value["bytes"].values())
        entry = StoreEntry(folder, value["stage"], value["key"], made, size, float(value["created"]), last_used)
        name = f"{entry.stage}-{entry.key[:32]}"
    except (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        raise _DamagedEntry(f"{ENTRY_FILE}: {error}") from None
    if folder.name != name:
        raise _DamagedEntry(f"{ENTRY_FILE} is of {name}")
    return entry
