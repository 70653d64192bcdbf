"""Recall the output of a complete run as long as nothing that the run depends on has changed.

Computing the keys of the stages takes most of the time of a run in which nothing has changed: it imports the stages,
reads the sites, the solids and the network, and hashes the source of the program. So a run records

- every input file that it looked for, opened or hashed (:func:`egvs.core.files.observe_files`): its sha256, or whether
  it existed, and where its links lead;
- every file in the run folder by sha256, and every folder and link there;
- a hash of everything else: the source of the program, the installed distributions, Python, the environment variables,
  the working directory, the arguments of the command, and the terminal.

If all of this is the same, the keys of all stages are, too, and so is what the command prints. Digests are those of
:mod:`egvs.runs.digest_cache`: a file whose stamp is new is hashed. No record is saved where plug-ins are used, where a
file changed during the run, or where the run depends on the output of another program.

The record is ``.unchanged-<hash of the command>.json`` in the run folder. It may be removed at any time.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from egvs.artefacts.run_folder import RUNS, UNCHANGED_PATTERN, RunFolder
from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.package_data import SCHEMAS, data_folder
from egvs.runs import locks
from egvs.runs.digest_cache import RACY_NS, DigestCache, file_stamp

_PACKAGE = Path(__file__).resolve().parent.parent

_VOLATILE_VARIABLES = frozenset({"_", "OLDPWD", "PWD", "SHLVL"})
"""Environment variables that shells change from command to command. The working directory is compared by itself."""

_FILE, _FOLDER = "file", "folder"
"""Kinds of entries of a run folder."""

_MAX_FILES = 5000
"""With more files in its folder, a run is not recorded: comparing them would take longer than computing the keys."""


@dataclass
class ObservedFiles:
    """The input files that a run looked for, opened or hashed; a :data:`egvs.core.files.FileObserver`.

    Attributes
    ----------
    states
        By absolute path: the sha256 of the content, or, where only the existence was asked for, ``PRESENT`` or
        ``ABSENT``.
    changed
        Files that changed during the run.
    is_complete
        False where the run used something other than files.
    """

    states: dict[str, str] = field(default_factory=dict)
    changed: set[str] = field(default_factory=set)
    is_complete: bool = True

    def __call__(self, path: Path | None, state: str) -> None:
        """Add what was observed of a file."""
        if path is None:
            self.is_complete = False
            return
        name = str(path.absolute())
        before = self.states.setdefault(name, state)
        if state == before or (state == files.PRESENT and before != files.ABSENT):
            return
        self.states[name] = state
        if before != files.PRESENT:
            self.changed.add(name)

    def digest(self, path: Path) -> str | None:
        """Return the sha256 of a file as it was observed; None where it was not hashed, or changed."""
        name = str(path.absolute())
        state = self.states.get(name)
        return None if name in self.changed or state in (files.PRESENT, files.ABSENT) else state

    def drop_temporary(self) -> None:
        """Forget files in temporary folders of this program, which follow from the others and no longer exist."""
        for name in list(self.states):
            if files.is_temporary(Path(name)):
                del self.states[name]
                self.changed.discard(name)


@dataclass(frozen=True)
class Output:
    """What a run without changes prints."""

    stdout: str
    stderr: str


class RunMemory:
    """The record of one command.

    Parameters
    ----------
    command
        Arguments of the command, and properties of the terminal that its output depends on.
    out
        The run folder; None where it follows from the scenario.
    """

    def __init__(self, command: Sequence[str], out: Path | None) -> None:
        digest = files.hash_json([str(Path.cwd()), *command])
        self._name = UNCHANGED_PATTERN.replace("*", digest[:16])
        self._out = out
        self._state = _hash_surroundings(command)
        self._observed: ObservedFiles | None = None

    def recall(self) -> Output | None:
        """Return what the command printed, if it would do nothing and print the same again; else None."""
        if self._state is None:
            return None
        for path in self._candidates():
            record = _read_record(path)
            if record.get("state") != self._state:
                continue
            folder = RunFolder(path.parent)
            with suppress(InputError, OSError), locks.locked(folder.lock, wait=False) as is_locked:
                if is_locked and _is_unchanged(record, folder):
                    os.utime(folder.lock)  # as a run does
                    return Output(record["stdout"], record["stderr"])
        return None

    @contextmanager
    def observe(self) -> Iterator[None]:
        """Observe which files the run in the block reads."""
        self._observed = ObservedFiles()
        with files.observe_files(self._observed):
            yield
        self._observed.drop_temporary()

    def save(self, folder: Path, digests: Mapping[str, str], output: Output) -> None:
        """Record a complete run that was observed, if everything that it depends on is known.

        Parameters
        ----------
        folder
            The run folder.
        digests
            Name -> sha256 of the files in the folder that the stages wrote, from the record of the run.
        output
            What the command prints if it is repeated.
        """
        observed = self._observed
        if self._state is None or observed is None or not observed.is_complete:
            return
        # without a record, the next run only takes longer
        with suppress(InputError, OSError, UnicodeError), locks.locked(RunFolder(folder).lock, wait=False) as is_locked:
            if not is_locked:  # another run has begun
                return
            entries = _list_folder(folder)
            home = os.path.realpath(folder)
            if entries is None or any(not _is_within(name, home) for name in observed.changed):
                return

            states = {name: state for name, state in observed.states.items() if not _is_within(name, home)}
            with files.use_digests(DigestCache(RunFolder(folder)).digest):
                for name, kind in entries.items():
                    if kind == _FILE:
                        path = (folder / name).absolute()
                        states[str(path)] = digests.get(name) or observed.digest(path) or files.hash_file(path)
            record = {
                "state": self._state,
                "folder": home,
                "entries": entries,
                "files": states,
                "links": {name: real for name in states if (real := os.path.realpath(name)) != name},
                "stdout": output.stdout,
                "stderr": output.stderr,
            }
            text = files.to_json_text(files.add_checksum(record)) + "\n"
            for other in folder.glob(UNCHANGED_PATTERN):
                other.unlink()
            files.write_text(folder / self._name, text)

    def _candidates(self) -> list[Path]:
        """Return the records of this command; one per run folder, where the folder depends on the scenario."""
        if self._out is not None:
            return [self._out / self._name]
        return sorted(RUNS.glob(f"*/{self._name}"))


def _is_within(name: str, folder: str) -> bool:
    """Whether a file is in a folder, or in one of its folders; links are followed."""
    return Path(os.path.realpath(name)).is_relative_to(folder)


def _read_record(path: Path) -> dict[str, Any]:
    """Return a record; an empty one where it is damaged."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    if not files.has_valid_checksum(record):
        return {}
    return dict(record)


def _is_unchanged(record: Mapping[str, Any], folder: RunFolder) -> bool:
    """Whether all files are as they were."""
    if os.path.realpath(folder.path) != record["folder"] or _list_folder(folder.path) != record["entries"]:
        return False
    digests = DigestCache(folder)
    with files.use_digests(digests.digest):
        for name, state in record["files"].items():
            if os.path.realpath(name) != record["links"].get(name, name) or not _has_state(Path(name), state):
                return False
    digests.save()
    return True


def _has_state(path: Path, state: str) -> bool:
    if not path.is_file():
        return state == files.ABSENT
    return state == files.PRESENT or (state != files.ABSENT and files.hash_file(path) == state)


def _list_folder(folder: Path) -> dict[str, str] | None:
    """Return the kind of each file and folder in a run folder, and where each link leads; None for too many.

    Files that say nothing about the results are left out.
    """
    entries: dict[str, str] = {}
    pending = [str(folder)]
    while pending:
        with os.scandir(pending.pop()) as children:
            for child in children:
                name = Path(child.path).relative_to(folder).as_posix()
                if child.is_symlink():
                    entries[name] = f"link to {Path(child.path).readlink()}"
                elif child.is_dir():
                    entries[name] = _FOLDER
                    pending.append(child.path)
                elif not _is_bookkeeping(name):
                    entries[name] = _FILE
        if len(entries) > _MAX_FILES:
            return None
    return dict(sorted(entries.items()))


def _is_bookkeeping(name: str) -> bool:
    hidden = (RunFolder.lock.name, RunFolder.digests.name)
    return name in hidden or Path(name).match(UNCHANGED_PATTERN)


def _hash_surroundings(command: Sequence[str]) -> str | None:
    """Hash everything but the input files that a run depends on; None where a change could go unnoticed."""
    program = _hash_program()
    if program is None:
        return None
    variables = {name: value for name, value in os.environ.items() if name not in _VOLATILE_VARIABLES}
    return files.hash_json(
        {
            "program": program,
            "python": [sys.version, sys.executable, sys.path],
            "distributions": _installed_distributions(),
            "variables": variables,
            "folder": str(Path.cwd()),
            "command": list(command),
        }
    )


def _hash_program() -> str | None:
    """Hash the stamps of all files of this package, or their contents where stamps cannot be trusted.

    Returns
    -------
    str, or None
        None where a file cannot be read, or was written so shortly before that a further change might leave its stamp
        as it is.
    """
    digest = hashlib.sha256()
    newest_ns = 0
    try:
        for path in (*_package_files(str(_PACKAGE)), *_package_files(str(data_folder(SCHEMAS)))):
            stamp = file_stamp(path)
            if stamp is None:
                digest.update(f"{path} {hashlib.sha256(Path(path).read_bytes()).hexdigest()}\n".encode())
            else:
                newest_ns = max(newest_ns, stamp[1])
                digest.update(f"{path} {stamp}\n".encode())
    except OSError:  # a file is being edited, or a link leads nowhere
        return None
    if newest_ns + RACY_NS > time.time_ns():
        return None
    return digest.hexdigest()


def _package_files(folder: str) -> list[str]:
    """Return the paths of all files of a package, without compiled ones."""
    paths = []
    with os.scandir(folder) as children:
        for child in sorted(children, key=lambda child: child.name):
            if child.is_dir():
                if child.name != "__pycache__":
                    paths += _package_files(child.path)
            else:
                paths.append(child.path)
    return paths


def _installed_distributions() -> list[tuple[str, int]]:
    """Return the folders of metadata of all distributions on the path, and when each was written.

    Their names have the versions of the libraries; their entry points declare plug-ins.
    """
    distributions = []
    for folder in sys.path:
        with suppress(OSError), os.scandir(folder or os.curdir) as children:
            for child in children:
                if child.name.endswith((".dist-info", ".egg-info", ".egg-link", ".pth")):
                    distributions.append((child.path, child.stat().st_mtime_ns))
    return sorted(distributions)
