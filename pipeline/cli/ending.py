"""How the program ends: what went wrong becomes one message and an exit code, and what was printed is out.

Whatever standard output and standard error are (closed, in Latin-1, a pipe that nobody reads), they spoil no run.
"""

from __future__ import annotations

import errno
import io
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

from pipeline.core.errors import EgvsError, InputError, cut
from pipeline.core.files import FULL
from pipeline.core.findings import FindingsError

_FAILED = EgvsError.exit_code
_INTERRUPTED = 130
"""Exit code after Ctrl-C."""

_OPEN_FLAGS = (os.O_RDONLY, os.O_WRONLY, os.O_WRONLY)
"""Of standard input, output and error."""

_USERS = (FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError)
"""What the system says of a file that the user can put right."""

_NO_NAME = (errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL)
"""What the system says of a name that is none of a file."""

_LESS = "larger voxels, a smaller region, fewer beams or fewer --jobs take less"


@contextmanager
def told() -> Iterator[None]:
    """Errors within the block are told in one message, and end the program."""
    _open_streams()
    try:
        yield
    except EgvsError as error:
        for warning in error.warnings if isinstance(error, FindingsError) else ():
            print(f"warning: {warning}", file=sys.stderr)
        _fail(str(error), error.exit_code)
    except BrokenPipeError:  # who reads what is printed has read enough
        _drop(sys.stdout)
        sys.exit(_FAILED)
    except OSError as error:
        _fail(*of_system(error))
    except MemoryError as error:
        _fail(f"there is not enough memory for this ({error or 'none is left'}); {_LESS}", _FAILED)
    except SystemExit as end:  # typer's own way to end, of an interrupt too
        if end.code == _INTERRUPTED:
            _fail("interrupted; run the same command again to go on from the last whole stage", _INTERRUPTED)
        _flush()
        raise


def of_system(error: OSError) -> tuple[str, int]:
    """The message and the exit code of what the system has against a file."""
    what = error.strerror or str(error)
    name = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else None
    if error.errno in FULL:
        what = os.strerror(error.errno)  # Arrow says more, and less clearly
        places = [Path(name)] if name else [Path.cwd(), Path(tempfile.gettempdir())]
        room = ", ".join(f"{_room_mb(place):,.1f} MB are free in {_there(place)}" for place in places)
        return f"{name or 'standard output, or a file'}: {what} ({room})", _FAILED
    if name is not None and (isinstance(error, _USERS) or error.errno in _NO_NAME):
        return f"{name}: {what}", InputError.exit_code
    return f"{name or 'system'}: {what}", _FAILED


def _there(path: Path) -> Path:
    """The nearest folder that is there."""
    return next(folder for folder in (path, *path.absolute().parents) if folder.is_dir())


def _room_mb(path: Path) -> float:
    return shutil.disk_usage(_there(path)).free / 1e6


def _open_streams() -> None:
    """Put nothing where a stream is closed, else the next file that is opened would get its number; and have a stream
    print what its encoding does not know as escapes.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, _OPEN_FLAGS[number])
            if descriptor != number:
                os.dup2(descriptor, number)
                os.close(descriptor)
            setattr(sys, name, open(number, "r" if number == 0 else "w", encoding="utf-8", closefd=False))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _flush() -> None:
    """Have out what was printed, as long as it can be told that it did not get out."""
    try:
        sys.stdout.flush()
    except OSError as error:
        _drop(sys.stdout)
        if error.errno == errno.EPIPE:
            sys.exit(_FAILED)
        _fail(f"standard output: {error.strerror}", _FAILED)


def _drop(stream: object) -> None:
    """Nothing more gets out of a stream: Python would try once more at its end, and complain."""
    if isinstance(stream, io.TextIOWrapper):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _fail(message: str, code: int) -> NoReturn:
    print(f"egvs: {cut(message)}", file=sys.stderr)
    sys.exit(code)
