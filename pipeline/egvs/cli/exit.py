"""How the program ends: errors become one message and an exit code, and an interrupt is never lost.

Standard output and standard error may be closed, full, in another encoding, or a pipe that nobody reads; none of this
may break a run. An interrupt that arrives while a module is imported is delayed until the import is done: trimesh wraps
imports in ``except BaseException``, which would take a KeyboardInterrupt for a missing library, and the run would
continue.
"""

from __future__ import annotations

import errno
import io
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn

from egvs.core.errors import DiagnosticsError, EgvsError, InputError, truncate_text
from egvs.core.files import DISK_FULL_ERRNOS

_FAILED = EgvsError.exit_code
_INTERRUPTED = 130
"""Exit code after Ctrl-C."""

_STANDARD_STREAMS = (("stdin", os.O_RDONLY, "r"), ("stdout", os.O_WRONLY, "w"), ("stderr", os.O_WRONLY, "w"))
"""Name, flags and mode of each stream, in the order of their descriptors."""

_USER_ERRORS = (FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError)
"""Errors about files that the user can correct."""

_BAD_NAME_ERRNOS = (errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL)
"""Errors about names that cannot be names of files."""

SURROGATES = "surrogates not allowed"
"""Reason of the error of a text that is not Unicode, because it is the name of a file that is not UTF-8."""

_NO_MEMORY_TEXTS = ("failed to map segment", "cannot allocate memory", "cannot create shared object descriptor")
"""What the loader of the system says where memory for a library is missing."""

_MEMORY_HINT = "Use larger voxels, a smaller region, fewer beams or fewer --jobs."


@contextmanager
def report_errors() -> Iterator[None]:
    """Print an error of the block as one message, and end the program with its exit code."""
    _open_streams()
    try:
        yield
    except EgvsError as error:
        if isinstance(error, DiagnosticsError):
            for warning in error.warnings:
                print(f"warning: {warning}", file=sys.stderr)
        _fail(str(error), error.exit_code)
    except BrokenPipeError:  # the reader of the pipe has closed it
        _discard_stream(sys.stdout)
        sys.exit(_FAILED)
    except OSError as error:
        try:
            sys.stdout.flush()
        except OSError:
            _discard_stream(sys.stdout)
        _fail(*describe_os_error(error))
    except UnicodeEncodeError as error:
        if error.reason != SURROGATES:
            raise
        _fail(f"{error.object}: the name of the file is not UTF-8. Rename it.", InputError.exit_code)
    except ImportError as error:
        if not any(text in str(error) for text in _NO_MEMORY_TEXTS):
            raise
        _fail(f"not enough memory ({error}). {_MEMORY_HINT}", _FAILED)
    except MemoryError as error:
        _fail(f"not enough memory ({error or 'none is left'}). {_MEMORY_HINT}", _FAILED)
    except SystemExit as end:  # raised by typer, also after an interrupt
        if end.code == _INTERRUPTED:
            _fail("interrupted; run the same command again to continue after the last finished stage", _INTERRUPTED)
        _flush()
        raise


def describe_os_error(error: OSError) -> tuple[str, int]:
    """Return the message and the exit code for an error of the operating system."""
    reason = error.strerror or str(error)
    name = None
    if isinstance(error.filename, str | bytes):
        name = os.fsdecode(error.filename)
    if error.errno in DISK_FULL_ERRNOS:
        reason = os.strerror(error.errno)  # shorter and clearer than Arrow's text
        paths = [Path.cwd(), Path(tempfile.gettempdir())]
        if name:
            paths = [Path(name)]
        free = ", ".join(map(_describe_free_space, paths))
        return f"{name or 'standard output, or a file'}: {reason} ({free})", _FAILED
    if name is None:
        return f"system: {reason}", _FAILED
    if isinstance(error, _USER_ERRORS) or error.errno in _BAD_NAME_ERRNOS:
        return f"{name}: {reason}", InputError.exit_code
    return f"{name}: {reason}", _FAILED


def _describe_free_space(path: Path) -> str:
    folder = next(folder for folder in (path, *path.absolute().parents) if folder.is_dir())
    return f"{shutil.disk_usage(folder).free / 1e6:,.1f} MB are free in {folder}"


def _open_streams() -> None:
    """Open the null device in place of closed streams, and escape characters that an encoding lacks.

    Otherwise the next file that is opened would get the number of a closed stream.
    """
    for number, (name, flags, mode) in enumerate(_STANDARD_STREAMS):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, flags)
            if descriptor != number:
                os.dup2(descriptor, number)
                os.close(descriptor)
            setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _flush() -> None:
    """Flush standard output while a failure can still be reported."""
    try:
        sys.stdout.flush()
    except OSError as error:
        _discard_stream(sys.stdout)
        if error.errno == errno.EPIPE:
            sys.exit(_FAILED)
        _fail(f"standard output: {error.strerror}", _FAILED)


def _discard_stream(stream: object) -> None:
    """Redirect a stream to the null device; otherwise Python would try to flush it at exit, and complain."""
    if isinstance(stream, io.TextIOWrapper):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _fail(message: str, code: int) -> NoReturn:
    print(f"egvs: {truncate_text(message)}", file=sys.stderr)
    sys.exit(code)


_RETRY_S = 0.02
_IMPORTS = "<frozen importlib._bootstrap>"


@contextmanager
def after_imports() -> Iterator[None]:
    """Raise KeyboardInterrupt at Ctrl-C, as Python does, but only where no import is under way."""
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:  # ignored, for example: leave it so
        yield
        return
    if not hasattr(signal, "SIGALRM"):  # Windows has no timer that could raise the interrupt later
        yield
        return
    before = {number: signal.signal(number, _interrupt) for number in (signal.SIGINT, signal.SIGALRM)}
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)


def _interrupt(_number: int, frame: FrameType | None) -> None:
    while frame is not None:
        if frame.f_code.co_filename == _IMPORTS:
            signal.setitimer(signal.ITIMER_REAL, _RETRY_S)  # calls this function again, as SIGALRM
            return
        frame = frame.f_back
    raise KeyboardInterrupt
