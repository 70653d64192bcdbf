"""Read a file in another process, within a limit of memory.

Libraries in C++ and Rust allocate as much memory as a damaged file asks for, print to the terminal, and may end their
process. Here they do so in a process of their own, which runs a module of this package as a program:
``python -m MODULE PATH MEMORY_MB [ARGUMENTS...]``. It calls :func:`serve`, which writes what a generator yields to
standard output: each :class:`Block` as a line of JSON and the bytes of its points.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np

from egvs.core import limits, platform
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.reading import COMPLETE_FILE, describe_exception

_ROOT = Path(__file__).resolve().parents[2]
"""Folder of the package ``egvs``, which the other process must find."""

_MAX_LINE = 1_000_000
_MAX_MESSAGE = 100_000


@dataclass(frozen=True)
class Block:
    """Points, and values about them that JSON can represent.

    Attributes
    ----------
    values
        Anything that the reader tells about the points.
    points_m
        (n, 3) float64.
    """

    values: dict[str, Any]
    points_m: FloatArray = field(default_factory=lambda: np.empty((0, 3)))


def serve(read: Callable[[Path], Iterator[Block]]) -> None:
    """Write the blocks of a file to standard output; the program of the other process.

    Ends with exit code 1, and the reason as the last line of standard error, when the file cannot be read.
    """
    path, memory_mb = Path(sys.argv[1]), int(sys.argv[2])
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no part of the answer
    platform.limit_memory(memory_mb * limits.MB)
    try:
        for block in read(path):
            points = np.ascontiguousarray(block.points_m, dtype="<f8")
            output.write(json.dumps([block.values, len(points)]).encode() + b"\n")
            output.write(points.data)
        output.flush()
    except Exception as error:  # noqa: BLE001 - the libraries' exceptions have no common base
        print(f"\n{describe_exception(error)}", file=sys.stderr, flush=True)
        os._exit(1)


def read_blocks(
    module: str, path: Path, where: str, doing: str, arguments: Sequence[str] = ()
) -> Generator[Block, None, None]:
    """Yield the blocks that a module's :func:`serve` writes for a file.

    Parameters
    ----------
    module
        The module that the other process runs.
    path
        The file.
    where
        The file, for messages.
    doing
        What failed, for messages, e.g. "cannot be read as E57".
    arguments
        Passed on to the module as ``sys.argv[3:]``.

    Raises
    ------
    InputError
        When the other process fails, or needs more memory than :data:`egvs.core.limits.READER_MEMORY`.
    """
    command = [sys.executable, "-P", "-m", module, os.fspath(path.resolve()), str(limits.READER_MEMORY.maximum)]
    command += arguments
    with (
        tempfile.TemporaryFile() as errors,
        subprocess.Popen(command, env=_environment(), stdout=subprocess.PIPE, stderr=errors) as reader,
    ):
        assert reader.stdout is not None
        try:
            while line := reader.stdout.readline(_MAX_LINE):
                block = _parse_block(line, reader.stdout)
                if block is None:
                    break  # the process has ended in the middle
                yield block
        finally:
            if reader.poll() is None:
                reader.stdout.close()  # stops a reader that nobody listens to
        code = reader.wait()
        errors.seek(0)
        messages = errors.read(_MAX_MESSAGE).decode("utf-8", "replace").strip().splitlines()
    if code < 0:
        reason = "the file is damaged" if code == -signal.SIGSEGV else "it needed too much memory"
        problem = f"{doing} (its reader was killed by signal {-code}: {reason})"
        raise InputError(where, problem, limits.READER_MEMORY.hint)
    if code:
        raise InputError(where, f"{doing} ({messages[-1] if messages else 'its reader failed'})", COMPLETE_FILE)


def _environment() -> dict[str, str]:
    search_path = [str(_ROOT)]
    if os.environ.get("PYTHONPATH"):
        search_path.append(os.environ["PYTHONPATH"])
    return os.environ | {"PYTHONPATH": os.pathsep.join(search_path)}


def _parse_block(line: bytes, stream: IO[bytes]) -> Block | None:
    """Return a block from its line and the stream behind it; None when the stream ends before the block does."""
    try:
        values, count = json.loads(line)
    except ValueError:
        return None
    data = stream.read(24 * count)
    if len(data) < 24 * count:
        return None
    return Block(values, np.frombuffer(data, dtype="<f8").reshape(-1, 3))
