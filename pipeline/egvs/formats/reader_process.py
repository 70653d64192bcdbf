"""Read a file in another process that may only read it, within limits of memory and time.

Libraries in C++ and Rust allocate as much memory as a damaged file asks for, print to the terminal, open whatever a
file names, and may end their process. Here they do so in a process of their own, which runs a module of this package as
a program: ``python -m MODULE PATH [ARGUMENTS...]``. It calls :func:`serve`, which writes what a generator yields to
standard output: each :class:`Block` as a line of JSON and the bytes of its content.

The process may read the named files and the files of Python, write to a temporary folder, and open no socket; it gets
only the environment variables of :data:`_VARIABLES`. :mod:`egvs.core.sandbox` says what enforces that, and where.
"""

from __future__ import annotations

import glob
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from egvs.core import files, limits, sandbox
from egvs.core.child_process import OUT_OF_MEMORY, Confinement, python_files, start_program
from egvs.core.digests import unchanged_inputs
from egvs.core.errors import InputError, MissingBackendError
from egvs.core.grid import FloatArray
from egvs.core.reading import COMPLETE_FILE, describe_exception

_ROOT = Path(__file__).resolve().parents[2]
"""Folder of the package ``egvs``, which the other process must find."""

_MAX_LINE = 1_000_000
_MAX_MESSAGE = 100_000
_LAST_LINES = 3
_VARIABLES = ("LANG", "LC_ALL", "LC_CTYPE", "LD_LIBRARY_PATH", "PATH", "PYTHONUTF8", "SYSTEMROOT", "TZ")
"""Environment variables that a reader gets; those of GDAL, PROJ and other libraries can name files and servers."""
_VARIABLE_PREFIXES = ("EGVS_", "OPENBLAS_")
_OUT_OF_TIME = getattr(signal, "SIGXCPU", 0)


@dataclass(frozen=True, eq=False)
class Block:
    """Values that JSON can represent, and bytes.

    Attributes
    ----------
    values
        Anything that the reader tells about the content.
    content
        Bytes, e.g. of float64 numbers.
    """

    values: dict[str, Any]
    content: bytes | memoryview = b""

    @classmethod
    def of_points(cls, values: dict[str, Any], points_m: FloatArray) -> Block:
        """Return a block of points, (n, 3) float64."""
        return cls(values, np.ascontiguousarray(points_m, dtype="<f8").tobytes())

    @property
    def points_m(self) -> FloatArray:
        """The content as points, (n, 3) float64."""
        return np.frombuffer(self.content, dtype="<f8").reshape(-1, 3)


def serve(read: Callable[[Path], Iterator[Block]], prepare: Callable[[], None] | None = None) -> None:
    """Write the blocks of a file to standard output; the program of the other process.

    Parameters
    ----------
    read
        Yields the blocks of a file.
    prepare
        Called first; it may start the process again.

    Notes
    -----
    An :class:`InputError` of the reader is raised again by :func:`read_blocks`. When anything else is raised, the
    process ends with exit code 1, and the reason is the last line of standard error.
    """
    path = Path(sys.argv[1])
    if prepare is not None:
        prepare()
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no part of the answer
    try:
        for block in read(path):
            _write_block(block, output)
        output.flush()
    except InputError as error:
        _write_block(Block({"where": error.where, "problem": error.problem, "hint": error.hint}), output)
        output.flush()
    except Exception as error:  # noqa: BLE001 - the libraries' exceptions have no common base
        print(f"\n{describe_exception(error)}", file=sys.stderr, flush=True)
    else:
        os._exit(0)
    os._exit(1)


def _write_block(block: Block, output: IO[bytes]) -> None:
    output.write(json.dumps([block.values, len(block.content)]).encode() + b"\n")
    output.write(block.content)


def read_blocks(
    module: str,
    path: Path,
    where: str,
    doing: str,
    arguments: Sequence[str] = (),
    companions: Sequence[Path] = (),
) -> Generator[Block, None, None]:
    """Yield the blocks that a module's :func:`serve` writes for a file.

    Parameters
    ----------
    module
        The module that the other process runs.
    path
        The file, or a folder.
    where
        The file, for messages.
    doing
        What failed, for messages, e.g. "cannot be read as E57".
    arguments
        Passed on to the module as ``sys.argv[2:]``.
    companions
        Other files that belong to this one, and may be read.

    Raises
    ------
    InputError
        When a pipe or a device has the name of the file with another suffix, as parts of files have; when the other
        process raises one, or fails, or needs more memory than
        :data:`egvs.core.limits.READER_MEMORY` or more time than :data:`egvs.core.limits.READER_TIME`.
    """
    _check_parts(path)
    command = [sys.executable, "-P", "-m", module, os.fspath(path.resolve()), *arguments]
    seconds = limits.READER_TIME.maximum + _size_mb(path)
    with (
        unchanged_inputs(path, *companions),
        files.temporary_folder() as folder,
        tempfile.TemporaryFile() as errors,
    ):
        confinement = Confinement(
            writable=folder,
            readable=(path.resolve(), *(part.resolve() for part in companions), *python_files()),
            has_network=False,
            memory_bytes=limits.READER_MEMORY.maximum * limits.MB,
            processor_s=seconds,
        )
        with start_program(command, folder, confinement, _environment(folder), subprocess.PIPE, errors) as reader:
            assert reader.stdout is not None
            yield from _blocks(reader.stdout, path, where)
            code = reader.wait()
        errors.seek(0)
        messages = errors.read(_MAX_MESSAGE).decode("utf-8", "replace").strip().splitlines()
    if code == -_OUT_OF_TIME:
        raise InputError(where, f"{doing} (its reader worked for more than {seconds:,} s)", limits.READER_TIME.hint)
    if code < 0:
        reason = "the file is damaged" if code == -signal.SIGSEGV else "it needed too much memory"
        problem = f"{doing} (its reader was killed by signal {-code}: {reason})"
        raise InputError(where, problem, limits.READER_MEMORY.hint)
    if code == sandbox.CANNOT_START:
        reason = messages[-1] if messages else "the process that started it has ended"
        raise MissingBackendError(f"{sys.executable} cannot be started: {reason}")
    if code and OUT_OF_MEMORY.search("\n".join(messages[-_LAST_LINES:])):
        raise InputError(where, f"{doing} (its reader needed too much memory)", limits.READER_MEMORY.hint)
    if code:
        raise InputError(where, f"{doing} ({messages[-1] if messages else 'its reader failed'})", COMPLETE_FILE)


def _check_parts(path: Path) -> None:
    """Raise an InputError for a pipe or a device that a library may open, since it is named like the file.

    Opening a pipe takes no processor time, and never ends.
    """
    for part in path.rglob("*") if path.is_dir() else path.parent.glob(f"{glob.escape(path.stem)}*"):
        if part.exists() and not (part.is_file() or part.is_dir()):
            raise InputError(part, "expected a file, got a pipe or a device", f"Remove it, or move {path.name} away.")


def _size_mb(path: Path) -> int:
    """Return the size of a file, or of the files of a folder, rounded up."""
    parts = path.rglob("*") if path.is_dir() else (path,)
    return math.ceil(sum(part.stat().st_size for part in parts if part.is_file()) / limits.MB)


def _environment(folder: Path) -> dict[str, str]:
    """Return the environment of a reader, which writes temporary files to a folder."""
    kept = {
        name: value for name, value in os.environ.items() if name in _VARIABLES or name.startswith(_VARIABLE_PREFIXES)
    }
    search_path = [str(_ROOT)]
    if os.environ.get("PYTHONPATH"):
        search_path.append(os.environ["PYTHONPATH"])
    # each thread of OpenBLAS takes memory from the limit, and readers need none
    return kept | {"PYTHONPATH": os.pathsep.join(search_path), "TMPDIR": str(folder), "OPENBLAS_NUM_THREADS": "1"}


def _blocks(stream: IO[bytes], path: Path, where: str) -> Iterator[Block]:
    """Yield blocks until the stream ends; raise the InputError that is in it."""
    while line := stream.readline(_MAX_LINE):
        block = _parse_block(line, stream)
        if block is None:
            return  # the process has ended in the middle
        values = block.values
        if "problem" in values:
            error_where = values["where"].replace(os.fspath(path.resolve()), where, 1) or where
            raise InputError(error_where, values["problem"], values["hint"])
        yield block


def _parse_block(line: bytes, stream: IO[bytes]) -> Block | None:
    """Return a block from its line and the stream behind it; None when the stream ends before the block does."""
    try:
        values, size = json.loads(line)
    except ValueError:
        return None
    content = stream.read(size)
    return Block(values, content) if len(content) == size else None
