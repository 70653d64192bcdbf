"""Finds, starts and asks SUMO.

The only module that locates SUMO's programs or imports its Python tools (sumolib, traci), each inside the function that
needs it. Programs run as subprocesses in the folder that holds their files, so that no path gets into what they write.

What fails here is told with SUMO's own words and its exit code; a missing system library is named together with the
package that has it.
"""

from __future__ import annotations

import os
import re
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import IO, Any

from pipeline.core.errors import InputError, MissingBackendError, RunError
from pipeline.core.sumo_home import sumo_home
from pipeline.traffic.guarded import confined, endings

APT_LINE = "apt-get install libatomic1 libx11-6 libxext6 libxrender1 libgl1"
"""What SUMO's binaries need on a minimal Debian."""

_POLL_S = 0.1
_LISTENS_S = 0.02
_OPENS_WITHIN_S = 60.0
_ENDS_WITHIN_S = 10.0
_SHOWN_ERRORS, _SHOWN_SIGNS = 12, 300

_CRASHES = frozenset({signal.SIGSEGV, signal.SIGABRT, signal.SIGFPE, signal.SIGILL, getattr(signal, "SIGBUS", 0)})
"""Signals by which a program ends itself."""

_ANSWERS_WITHIN_S, _STEPS_WITHIN_S = 30.0, 600.0
"""How long somebody else's SUMO may take to answer first, and then each time: it may be paused by hand."""

_NO_TRACI = (struct.error, UnicodeDecodeError)
"""What reading an answer raises that is none of SUMO's."""


class RefusedError(RunError):
    """A program of SUMO refused what it was given: it ended by itself, with an error, or crashed."""


def binary(name: str) -> Path:
    """A program of SUMO in the environment, SUMO_HOME, wheel or PATH; MissingBackendError when it is in none."""
    import shutil

    import sumolib

    with _projections_kept():
        program = shutil.which(sumolib.checkBinary(name))
    if program is None:
        raise MissingBackendError(f"SUMO's program '{name}' was not found: set SUMO_HOME, or pip install eclipse-sumo")
    return Path(program)


@contextmanager
def _projections_kept() -> Iterator[None]:
    """Importing SUMO's wheel points this process at its data of projections, which not every library can read."""
    before = {name: os.environ.get(name) for name in ("PROJ_DATA", "PROJ_LIB")}
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)


def environment() -> dict[str, str]:
    """What SUMO's programs need: this process' own variables, SUMO_HOME, and where the wheel keeps PROJ's data."""
    home = sumo_home()
    proj = home / "data" / "proj"
    more = {"PROJ_DATA": str(proj), "PROJ_LIB": str(proj)} if proj.is_dir() else {}
    return {"SUMO_HOME": str(home), **more, **os.environ}


@cache
def version() -> str:
    """SUMO's version, e.g. ``"1.28.0"``: the wheel's where its binary is used, else what ``sumo --version`` prints."""
    program = binary("sumo")
    try:
        wheel = metadata.distribution("eclipse-sumo")
        if Path(str(wheel.locate_file("sumo"))).resolve() in program.resolve().parents:
            return wheel.version
    except metadata.PackageNotFoundError:
        pass
    return version_in(run("sumo", ["--version"], Path()))


def version_in(text: str) -> str:
    """The version number in what SUMO says about itself ("Eclipse SUMO sumo 1.28.0", or traci's "SUMO 1.28.0")."""
    number = re.search(r"\b[vV]?(\d+[._]\d+[._]\d+\S*)", text)
    if number is None:
        raise RunError(f"SUMO does not tell its version: {text.strip().splitlines()[:1]}")
    return number.group(1).replace("_", ".")


def vehicle_classes() -> frozenset[str]:
    """The names of all SUMO vClasses."""
    from sumolib.net.lane import SUMO_VEHICLE_CLASSES

    return frozenset(SUMO_VEHICLE_CLASSES)


def constants() -> Any:
    """The numbers that TraCI calls its variables by."""
    from traci import constants

    return constants


def run(
    name: str, arguments: Sequence[str], folder: Path, log: Path | None = None, watch: Callable[[], None] | None = None
) -> str:
    """Run a program of SUMO to its end and return what it printed.

    Parameters
    ----------
    name, arguments
        The program, e.g. ``"sumo"``, and its flags; file names are relative to ``folder``, where it runs.
    log
        Where to keep its warnings and errors.
    watch
        Called a few times a second while it runs.

    Raises
    ------
    RefusedError
        When it ends with an error, or crashes: its own error text and exit code. RunError when it is killed.
    MissingBackendError
        When it, or a system library that it needs, is not installed.
    """
    return _run(name, [str(binary(name)), *arguments], folder, log or Path(os.devnull), watch)


def netconvert(arguments: Sequence[str], folder: Path, name: str) -> None:
    """Have netconvert make the network ``name`` in a folder; raises what :func:`run` does, and RunError where it did
    not write the network to its end."""
    run("netconvert", [*arguments, "-o", name], folder)
    endings.check_xml(folder / name, "net")


def run_tool(name: str, arguments: Sequence[str], folder: Path) -> str:
    """Run one of SUMO's Python tools, e.g. ``"routeSampler.py"``, to its end and return what it printed; as :func:`run`
    does, it may write in its folder only.

    RunError when it ends with an error; MissingBackendError when it is not installed.
    """
    tool = sumo_home() / "tools" / name
    if not tool.is_file():
        raise MissingBackendError(f"SUMO's tool {name} is not in {tool.parent}: pip install eclipse-sumo")
    return _run(name, [sys.executable, "-B", str(tool), *arguments], folder, Path(os.devnull), None)


def _run(name: str, command: Sequence[str], folder: Path, log: Path, watch: Callable[[], None] | None) -> str:
    with log.open("wb") as errors:
        capture = subprocess.PIPE if str(log) == os.devnull else errors
        with _started(command, folder, subprocess.PIPE, capture) as process:
            printed, complaint = _wait(process, watch)
    if process.returncode:
        text = complaint if capture == subprocess.PIPE else log.read_bytes()
        raise failure(name, process.returncode, (text or b"").decode("utf-8", "replace"))
    return printed.decode("utf-8", "replace")


@contextmanager
def _started(command: Sequence[str], folder: Path, printed: Any, complaints: Any) -> Iterator[subprocess.Popen[bytes]]:
    """A program that ends with the block, and with this process. It may write in its folder only."""
    launcher = [sys.executable, "-I", "-S", confined.__file__, os.curdir, str(os.getpid())]
    reading, holding = os.pipe()
    try:
        process = subprocess.Popen(
            [*launcher, *command], cwd=folder, env=environment(), stdin=reading, stdout=printed,
            stderr=complaints,
        )  # fmt: skip
    except BaseException:
        os.close(holding)
        raise
    finally:
        os.close(reading)
    with process:
        try:
            yield process
        finally:
            os.close(holding)
            if confined.BECOMES_THE_PROGRAM:  # else the launcher kills it now
                process.kill()


def _wait(process: subprocess.Popen[bytes], watch: Callable[[], None] | None) -> tuple[bytes, bytes]:
    while True:
        try:
            return process.communicate(timeout=None if watch is None else _POLL_S)
        except subprocess.TimeoutExpired:
            assert watch is not None
            watch()


def failure(name: str, code: int, text: str) -> RunError:
    """The error for a program of SUMO that ended with exit code ``code`` and said ``text``."""
    missing = re.search(r"error while loading shared libraries: ([^:\s]+)", text)
    if missing:
        library = missing.group(1)
        return MissingBackendError(
            f"{name} cannot start, the system library {library} is missing; on Debian: {APT_LINE}"
        )
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if code == confined.CANNOT_START:
        return MissingBackendError(f"{name} cannot be started: {(lines or ['this process has ended'])[-1]}")
    errors = [line for line in lines if not line.startswith(("Warning", "Quitting", "pj_obj_create"))] or lines[-1:]
    how = f"ended with exit code {code}"
    if code < 0:
        how = f"{'crashed with' if -code in _CRASHES else 'was killed by'} signal {-code}"
    kind = RefusedError if code > 0 or -code in _CRASHES else RunError
    return kind("\n".join([f"{name} {how}:", *(f"  {line[:_SHOWN_SIGNS]}" for line in errors[:_SHOWN_ERRORS])]))


@contextmanager
def connected(host: str, port: int) -> Iterator[Any]:
    """A TraCI connection to a SUMO that is already running.

    InputError when nothing answers there, or not as SUMO does; RunError when SUMO ends the connection early, or falls
    silent.
    """
    import traci

    place = f"--traci {host}:{port}"
    connection = _connect(host, port)
    if connection is None:
        raise InputError(place, "no SUMO answers there", "start one with --remote-port first")
    try:
        try:
            connection.getVersion()
        except (*_NO_TRACI, traci.exceptions.TraCIException, traci.exceptions.FatalTraCIError):
            found = f"who listens there does not answer as SUMO does within {_ANSWERS_WITHIN_S:g} s"
            raise InputError(place, found, "the port that SUMO was given with --remote-port") from None
        connection._socket.settimeout(_STEPS_WITHIN_S)
        yield connection
    except traci.exceptions.FatalTraCIError as error:
        what = f"ended the connection, or did not answer for {_STEPS_WITHIN_S:g} s"
        raise RunError(f"SUMO at {host}:{port} {what}: {error}") from None
    except (*_NO_TRACI, traci.exceptions.TraCIException) as error:
        raise RunError(f"SUMO at {host}:{port} gave an answer that cannot be understood: {error}") from None
    finally:
        _close(connection)


def _close(connection: Any) -> None:
    """Close without a word when SUMO has hung up first."""
    import traci

    its = connection._socket
    with suppress(*_NO_TRACI, traci.exceptions.TraCIException, traci.exceptions.FatalTraCIError, OSError):
        connection.close(False)
    if its is not None:
        its.close()


@contextmanager
def served(arguments: Sequence[str], folder: Path) -> Iterator[Any]:
    """Start SUMO with a TraCI server, yield the connection, and end SUMO."""
    import traci
    from sumolib.miscutils import getFreeSocketPort

    port = getFreeSocketPort()
    # a file, because SUMO would wait for ever on a full pipe that nobody reads
    with tempfile.TemporaryFile() as complaints:
        command = [str(binary("sumo")), *arguments, "--remote-port", str(port)]
        with _started(command, folder, subprocess.DEVNULL, complaints) as process:
            try:
                connection = _attach(process, port)
                try:
                    yield connection
                finally:
                    _close(connection)
            except traci.exceptions.FatalTraCIError:
                raise _hung_up(process, complaints) from None


def _hung_up(process: subprocess.Popen[bytes], complaints: IO[bytes]) -> RunError:
    """Why SUMO closed its end: it says so on its way out."""
    try:
        process.wait(_ENDS_WITHIN_S)
    except subprocess.TimeoutExpired:
        return RunError("sumo closed its TraCI port, and did not say why")
    complaints.seek(0)
    return failure("sumo", process.returncode, complaints.read().decode("utf-8", "replace"))


def _attach(process: subprocess.Popen[bytes], port: int) -> Any:
    """Connect as soon as SUMO listens; traci's own retries wait a whole second and print."""
    import traci

    deadline = time.monotonic() + _OPENS_WITHIN_S
    while (connection := _connect("localhost", port)) is None:
        if process.poll() is not None:
            raise traci.exceptions.FatalTraCIError("sumo ended")
        if time.monotonic() > deadline:
            raise RunError(f"sumo did not open its TraCI port within {_OPENS_WITHIN_S:g} s")
        time.sleep(_LISTENS_S)
    connection._socket.settimeout(None)  # one of our own, which may think as long as it likes
    return connection


def _connect(host: str, port: int) -> Any:
    """A connection, or None where nobody listens (traci forgets to close the socket then: Python would warn of it)."""
    import traci

    patience_s = socket.getdefaulttimeout()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        try:
            socket.setdefaulttimeout(_ANSWERS_WITHIN_S)
            connection = traci.connect(port=port, host=host, numRetries=0)
        except (traci.exceptions.FatalTraCIError, OSError):
            return None
        finally:
            socket.setdefaulttimeout(patience_s)
    ends = connection._socket.getsockname(), connection._socket.getpeername()
    if ends[0] == ends[1]:  # TCP may connect a free local port to itself, and wait for ever
        connection._socket.close()
        return None
    return connection
