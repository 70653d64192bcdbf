"""The store: what a stage once made, kept under the hash of everything that it depends on.

    <store>/<stage>-<key>/          artefacts, companions, and entry.json: hashes (its own too), summary, cost
    <store>/.locks/<stage>-<key>    held by the one process that makes this entry; others wait for it, then take it
    <store>/.work/                  what is not whole yet, or no longer
    <store>/.lock                   shared by those who read or lay down an entry, held alone by those who remove one

An entry is written aside, then renamed: it is there whole or not at all, whenever a process is killed. Every file's
hash is checked when it is taken, and that of entry.json whenever it is read; an entry that is damaged is removed, so
that it is made again. The entries used longest ago go first when all of them take more than a bound. What else lies in
the folder is left alone. A store that cannot be written is named once, and done without.

Behind the folder there may be another store that machines share (:mod:`pipeline.runs.remote`).
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from pipeline.artefacts.run_record import STAGES
from pipeline.core import files
from pipeline.core.cost import Cost
from pipeline.core.errors import InputError
from pipeline.core.progress import Progress, silent
from pipeline.runs import locking, store_settings
from pipeline.runs.locking import locked
from pipeline.runs.remote import ENTRY as _ENTRY
from pipeline.runs.remote import Remote
from pipeline.runs.stages import Made

_HASH = "sha256"
"""The key, in what the store notes of an entry, of the hash of all else in it."""

KINDS = (*STAGES, "points", "detections", "part")
"""What entries are of: stages, what was found from a site, and parts of a score."""

_NAME = re.compile(rf"({'|'.join(KINDS)})-[0-9a-f]{{32}}")
"""An entry's folder. A folder of any other name is not the store's own, and never touched."""

_WORK_NAME = re.compile(rf"{_NAME.pattern}|removed-{_NAME.pattern}-[0-9]+-[0-9]+")
"""What the store makes in its folders for work."""


@dataclass(frozen=True)
class Entry:
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
    made: Made
    bytes: int
    created: float
    last_used: float


class _Damaged(Exception):
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
        bound_bytes: float = store_settings.DEFAULT_MAX_GB * 1e9,
        note: Callable[[str], None] = _to_stderr,
        remote: Remote | None = None,
    ) -> None:
        self.folder, self.bound_bytes, self._note = folder, bound_bytes, note
        self._can_write, self._remote = folder is not None, remote
        if folder is not None:
            with suppress(OSError):  # which is named where it is in the way
                self._clear_work(folder)

    @classmethod
    def default(cls) -> Store:
        """Where ``EGVS_STORE`` says, else beside the runs."""
        url = store_settings.remote_url()
        return cls(*store_settings.read(), remote=None if url is None else Remote(url))

    def check(self, *, changed: bool) -> None:
        """InputError where the folder is a file, or where there is no store that could be ``changed``."""
        if self.folder is None and changed:
            raise InputError(store_settings.PLACE, "empty, so that there is no store", "the store's folder")
        if self.folder is not None and _is(Path.is_file, self.folder):
            raise InputError(self.folder, "is a file", f"the store's folder, which {store_settings.PLACE} names")

    # ---- one entry

    def take(self, stage: str, key: str, out: Path, *, link: bool = False) -> Entry | None:
        """Lay an entry's files into ``out``; None where there is no such entry, or it was damaged.

        ``link`` gives the files a second name instead of copying them: for folders in which files are replaced, never
        written into.
        """
        if self.folder is None or not _is(Path.is_dir, folder := self._place(stage, key)):
            return None
        try:
            with self._shared():
                entry = _read(folder)
                for name, digest in entry.made.files.items():
                    _lay(folder / name, out / name, digest, link)
                with suppress(OSError):  # a store that can only be read
                    os.utime(folder / _ENTRY)
                return entry
        except _Damaged as damage:
            self._note(f"{folder}: the kept {stage} is damaged ({damage}), and made again")
        with suppress(OSError), locked(self.folder / ".lock"):
            self._remove(folder)
        return None

    def fetch(self, stage: str, key: str) -> None:
        """Have an entry from the remote store in the folder, where it is there and not here; for its :meth:`maker`."""
        if self._remote is None or not self._can_write or self.folder is None:
            return
        if (final := self._place(stage, key)).exists():
            return
        work = self.folder / ".work" / final.name
        try:
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir(parents=True)
            if self._of_remote(lambda remote: remote.fetch(final.name, work)):
                _read(work)
                with self._shared():
                    work.rename(final)
        except _Damaged as damage:
            self._note(f"{self._remote.url}: the kept {stage} is damaged ({damage}), and made again")
        except OSError as error:
            self._do_without(error)
        finally:
            shutil.rmtree(work, ignore_errors=True)

    @contextmanager
    def maker(self, stage: str, key: str, *, wait: bool = True, progress: Progress = silent) -> Iterator[bool]:
        """Be the only one that makes an entry; yields whether one is (without ``wait`` another may be).

        A store that cannot be written keeps nobody apart.
        """
        if not self._can_write or self.folder is None:
            yield True
            return
        lock = self.folder / ".locks" / self._place(stage, key).name
        try:
            lock.parent.mkdir(parents=True, exist_ok=True)
            locking.make(lock)
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

    def put(self, stage: str, key: str, out: Path, made: Made, *, link: bool = False) -> None:
        """Keep what a stage made in ``out``, unless it is kept already; for its :meth:`maker`."""
        if not self._can_write or self.folder is None or (final := self._place(stage, key)).exists():
            return
        work = self.folder / ".work" / final.name
        try:
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir(parents=True)
            for name in made.files:
                _copy(out / name, work / name, link)
            (work / _ENTRY).write_text(_to_json(stage, key, work, made), encoding="utf-8")
            with self._shared():
                work.rename(final)
            self._of_remote(lambda remote: remote.put(final.name, final, made.files))
            self.prune(self.bound_bytes)
        except OSError as error:
            self._do_without(error)
        finally:
            shutil.rmtree(work, ignore_errors=True)

    # ---- all entries

    def entries(self) -> list[Entry]:
        """All that are sound, the one used last first."""
        sound = []
        for folder in self._folders():
            with suppress(_Damaged):
                sound.append(_read(folder))
        return sorted(sound, key=lambda entry: entry.last_used, reverse=True)

    def prune(self, most_bytes: float) -> list[Entry]:
        """Remove those used longest ago until the others take at most ``most_bytes`` (below 0: all); those gone."""
        removed: list[Entry] = []
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
        if self.folder is None or not _is(Path.is_dir, self.folder):
            return []
        return [path for path in self.folder.iterdir() if _NAME.fullmatch(path.name) and path.is_dir()]

    def _place(self, stage: str, key: str) -> Path:
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
                raise InputError(path, "is a symbolic link, and nothing is written through one", "remove it")
        places = [place for name in (".work", ".locks") if (place := folder / name).is_dir()]
        names = {path.name for place in places for path in place.iterdir()}
        for name in filter(_WORK_NAME.fullmatch, names):
            with suppress(OSError), locked(folder / ".locks" / name, wait=False, remove=True) as free:
                if free:
                    shutil.rmtree(folder / ".work" / name, ignore_errors=True)

    def _of_remote(self, ask: Callable[[Remote], bool | None]) -> bool | None:
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


def _is(kind: Callable[[Path], bool], path: Path) -> bool:
    """Whether there is a file or a folder; not where the path is too long, or leads through what is closed."""
    try:
        return kind(path)
    except OSError:
        return False


def _lay(kept: Path, path: Path, digest: str, link: bool) -> None:
    """One file into a run's folder, whole or not at all; :class:`_Damaged` when it is not as it was kept."""
    if not (kept.is_file() and os.access(kept, os.R_OK)):
        raise _Damaged(f"{kept.name} is missing, or cannot be read")
    with files.aside(path) as partial:
        if link:
            path.unlink(missing_ok=True)  # to rename one name of a file over another one does nothing
        try:
            _copy(kept, partial, link)
        except OSError as error:
            error.filename, error.filename2 = str(path), None  # else a full disk is blamed on the file that is read
            raise
        if files.sha256_of(partial) != digest:
            raise _Damaged(f"{kept.name} has other bytes than were kept")


def _copy(path: Path, other: Path, link: bool) -> None:
    """A file under another name: a second name where ``link`` asks for it and the disk allows it, else a copy."""
    other.parent.mkdir(parents=True, exist_ok=True)
    if link:
        other.unlink(missing_ok=True)
        with suppress(OSError):
            os.link(path, other)
            return
    shutil.copyfile(path, other)


def _to_json(stage: str, key: str, folder: Path, made: Made) -> str:
    sizes = {name: (folder / name).stat().st_size for name in made.files}
    about = {"stage": stage, "key": key, **asdict(made), "bytes": sizes, "created": time.time()}
    about[_HASH] = files.hash_of(about)
    return files.json_text(about, indent=1) + "\n"


def _read(folder: Path) -> Entry:
    try:
        value = json.loads((folder / _ENTRY).read_text(encoding="utf-8"))
        if value.pop(_HASH) != files.hash_of(value):
            raise _Damaged(f"{_ENTRY} says something else than was written")
        last_used = (folder / _ENTRY).stat().st_mtime
        artefacts, companions, summary = (dict(value[name]) for name in ("artefacts", "companions", "summary"))
        made = Made(artefacts, companions, summary, Cost(**value["cost"]))
        size = sum(int(size) for size in value["bytes"].values())
        entry = Entry(folder, value["stage"], value["key"], made, size, float(value["created"]), last_used)
        name = f"{entry.stage}-{entry.key[:32]}"
    except (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        raise _Damaged(f"{_ENTRY}: {error}") from None
    if folder.name != name:
        raise _Damaged(f"{_ENTRY} is of {name}")
    return entry
