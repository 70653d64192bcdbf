"""Start other programs so that they end with this process, and within limits (:mod:`egvs.core.sandbox`)."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egvs.core import sandbox

_SYSTEM_FILES = ("/usr", "/lib", "/lib64", "/etc/ld.so.cache", "/etc/localtime", "/dev/urandom", "/dev/zero")
"""What the libraries of a system read, beside what they are asked to."""


OUT_OF_MEMORY = re.compile(
    r"bad_alloc|MemoryError|more memory|out ?of ?memory|cannot allocate|memory allocation|failed to map segment",
    re.IGNORECASE,
)
"""What programs write when an allocation fails, in C++, in Python, in Rust, in the XML parser Xerces,
and in the loader of libraries."""


@dataclass(frozen=True)
class Confinement:
    """What a program may do.

    Attributes
    ----------
    writable
        The folder that it may write to.
    readable
        Files and folders that it may read, beside the writable folder; None: all that its user may read.
    has_network
        Whether it may open sockets.
    memory_bytes
        Largest memory that it may allocate; None: no limit.
    processor_s
        Longest time of work, seconds; None: no limit.
    """

    writable: Path
    readable: tuple[Path, ...] | None = None
    has_network: bool = True
    memory_bytes: int | None = None
    processor_s: int | None = None

    def options(self) -> list[str]:
        """Return the options of the sandbox."""
        options = [f"write={self.writable}"]
        options += [f"read={path}" for path in self.readable or ()]
        if not self.has_network:
            options.append("sockets=no")
        if self.memory_bytes is not None:
            options.append(f"memory_bytes={self.memory_bytes}")
        if self.processor_s is not None:
            options.append(f"processor_s={self.processor_s}")
        return options


def python_files() -> tuple[Path, ...]:
    """Return the files and folders that Python, its packages and their system libraries consist of."""
    folders = [sys.prefix, sys.base_prefix, sys.exec_prefix, *sysconfig.get_paths().values(), *_SYSTEM_FILES]
    folders += [name for name in sys.path if name]
    existing = {Path(name).resolve() for name in folders if Path(name).exists()}
    return tuple(sorted(existing - {Path("/")}))


@contextmanager
def start_program(
    command: Sequence[str],
    folder: Path,
    confinement: Confinement,
    environment: Mapping[str, str],
    stdout: Any,
    stderr: Any,
) -> Iterator[subprocess.Popen[bytes]]:
    """Start a program that ends with the block, or with this process.

    Parameters
    ----------
    command
        The program, an absolute path, and its arguments.
    folder
        Its working directory; relative paths of the confinement start there.
    confinement
        What it may do.
    environment
        All its environment variables.
    stdout, stderr
        As of :class:`subprocess.Popen`.

    Yields
    ------
    subprocess.Popen
        The program. Its exit code is :data:`egvs.core.sandbox.CANNOT_START` if it could not be started.
    """
    launcher = [sys.executable, "-I", "-S", sandbox.__file__, *confinement.options(), str(os.getpid())]
    read_end, write_end = os.pipe()
    try:
        process = subprocess.Popen(
            [*launcher, *command], cwd=folder, env=environment, stdin=read_end, stdout=stdout, stderr=stderr
        )
    except BaseException:
        os.close(write_end)
        raise
    finally:
        os.close(read_end)
    with process:
        try:
            yield process
        finally:
            os.close(write_end)
            if sandbox.REPLACES_PROCESS:  # else the launcher kills the program when the pipe is closed
                process.kill()
