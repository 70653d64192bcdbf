"""What a worker says about itself before it gets tasks, and what is wrong with it.

:func:`describe_worker` runs on the worker, :func:`find_problems` in the program that started the city run. The two
programs may differ, which is the point of asking. So answers consist of built-in types, and this module imports little:
a worker answers before it imports the libraries that tasks need.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import socket
import tempfile
import uuid
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import NamedTuple, TypedDict

from egvs._version import __version__
from egvs.core.errors import EgvsError
from egvs.core.package_data import SCHEMAS, data_folder

TOKEN_PREFIX = ".egvs-worker-check-"
"""Beginning of the names of token files. The program that starts a run writes one into each folder that workers must
see, and removes it at the end."""

MIN_FREE_BYTES = 32_000_000
"""A worker with less free disk space gets no tasks: the artefacts of one junction would fill the disk."""

_PACKAGE_FOLDER = Path(__file__).resolve().parents[2]
_NO_SOURCE = frozenset({"__pycache__", SCHEMAS, "scenarios"})
"""Folders in the package that are no source; an installed package contains the schemas, a checkout does not."""


class Problem(NamedTuple):
    """What is wrong with a worker, and what to do about it."""

    text: str
    hint: str


@dataclass(frozen=True)
class Requirements:
    """What every worker must have.

    Attributes
    ----------
    token
        Text in the token files.
    folders
        Folders with a token file.
    writable
        The folder in which tasks write, one of ``folders``.
    libraries
        Libraries of which every worker must have the same version as this program.
    store_url
        URL of the shared store with a token file; None for a store that is a folder.
    """

    token: str
    folders: tuple[str, ...]
    writable: str
    libraries: tuple[str, ...] = ()
    store_url: str | None = None

    @property
    def token_name(self) -> str:
        """Name of the token files."""
        return f"{TOKEN_PREFIX}{self.token}"


class WorkerAnswer(TypedDict):
    """What a worker says about itself.

    The keys are ``host``; ``program`` (versions by name, see :func:`program_versions`); ``invisible`` (folders without
    the token file); ``unwritable`` (errors by folder); ``free_bytes`` (free disk space by folder).
    """

    host: str
    program: dict[str, str]
    invisible: list[str]
    unwritable: dict[str, str]
    free_bytes: dict[str, int]


@cache
def library_names() -> tuple[str, ...]:
    """Return the names of the installed libraries that results depend on."""
    from egvs.runs import stage_keys  # not on workers, where it would delay the answer

    libraries = stage_keys.source_digest("egvs.runs.run").libraries
    return tuple(stage_keys.library_versions(libraries))


def program_versions(libraries: Sequence[str]) -> dict[str, str]:
    """Return what must be equal for equal results: versions of program, Python and libraries, digest of the source."""
    python = ".".join(platform.python_version_tuple()[:2])
    versions = {"egvs": __version__, "source": _source_digest(), "python": python}
    for name in libraries:
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


@cache
def _source_digest() -> str:
    """Return a digest of all files of the package and of its schemas: two checkouts of one version may differ."""
    digest = hashlib.sha256()
    for root in (_PACKAGE_FOLDER, data_folder(SCHEMAS)):
        for path in sorted(_source_files(root), key=lambda path: path.relative_to(root).as_posix()):
            digest.update(f"{path.relative_to(root).as_posix()}\n{path.stat().st_size}\n".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _source_files(root: Path) -> Iterator[Path]:
    for folder, subfolders, names in os.walk(root):
        subfolders[:] = [name for name in subfolders if name not in _NO_SOURCE and not name.startswith(".")]
        for name in names:
            if not name.startswith("."):
                yield Path(folder, name)


def describe_worker(
    token_name: str, token: str, folders: Sequence[str], writable: str, libraries: Sequence[str], url: str | None
) -> WorkerAnswer:
    """Describe this worker; the parameters are the fields of :class:`Requirements`."""
    invisible = [folder for folder in folders if not _has_token(Path(folder, token_name), token)]
    if url is not None and not _has_remote_token(url, token_name, token):
        invisible.append(url)
    unwritable = {}
    if writable not in invisible:
        error = _write_error(Path(writable, f"{token_name}-{uuid.uuid4().hex[:8]}"))
        if error:
            unwritable[writable] = error
    free_bytes = {}
    for folder in (writable, tempfile.gettempdir()):
        with suppress(OSError):
            free_bytes[folder] = shutil.disk_usage(folder).free
    return {
        "host": socket.gethostname(),
        "program": program_versions(libraries),
        "invisible": invisible,
        "unwritable": unwritable,
        "free_bytes": free_bytes,
    }


def _has_token(path: Path, token: str) -> bool:
    try:
        return path.read_text(encoding="utf-8") == token
    except (OSError, ValueError):
        return False


def _has_remote_token(url: str, name: str, token: str) -> bool:
    from egvs.runs.store import RemoteStore  # it imports much

    try:
        return RemoteStore(url).read_file(name) == token.encode()
    except (EgvsError, OSError):
        return False


def _write_error(path: Path) -> str:
    try:
        path.write_text("", encoding="utf-8")
        path.unlink()
    except OSError as error:
        return error.strerror or str(error)
    return ""


def find_problems(answer: WorkerAnswer, requirements: Requirements) -> list[Problem]:
    """Return what is wrong with a worker, compared with this program.

    Parameters
    ----------
    answer
        From :func:`describe_worker`.
    requirements
        What the worker must have.
    """
    problems = list(_program_problems(answer["program"], program_versions(requirements.libraries)))
    for location in answer["invisible"]:
        if location == requirements.store_url:
            problems.append(Problem(f"{location} is not readable", "Give every machine access to this store."))
        else:
            hint = "Put this folder on a disk that all machines see under the same path."
            problems.append(Problem(f"{location} is not visible", hint))
    for folder, error in answer["unwritable"].items():
        problems.append(Problem(f"{folder} is not writable ({error})", "Allow every machine to write there."))
    for folder, free in answer["free_bytes"].items():
        if free < MIN_FREE_BYTES:
            problem = (
                f"{folder}: expected at least {MIN_FREE_BYTES / 1e6:.0f} MB of free disk space, got {free / 1e6:.1f} MB"
            )
            problems.append(
                Problem(problem, "Remove files, or use a folder on a larger disk (for temporary files, set TMPDIR).")
            )
    return problems


def _program_problems(actual: dict[str, str], expected: dict[str, str]) -> Iterator[Problem]:
    differences = []
    for name in {**expected, **actual}:
        if expected.get(name) != actual.get(name):
            differences.append(f"{name}: expected {expected.get(name, 'none')}, got {actual.get(name, 'none')}")
    if not differences:
        return
    if [name for name in {**expected, **actual} if expected.get(name) != actual.get(name)] == ["source"]:
        differences.append("the version is the same, but the source code is not")
    hint = "Install the same version on every machine, and restart the worker."
    yield Problem(f"the program differs from the one that started the run ({'; '.join(differences)})", hint)
