"""Find, start and query SUMO (the only module that imports traci and sumolib).

Looks at the ends of files that a program of SUMO wrote: on a full disk it ends without a word or an error.

Finds, starts and asks SUMO.

The only module that locates SUMO's programs or imports its Python tools (sumolib, traci), each inside the function that
needs it. Programs run as subprocesses in the folder that holds their files, so that no path gets into what they write.

What fails here is told with SUMO's own words and its exit code; a missing system library is named together with the
package that has it.

Records the rows of floating car data from a SUMO that is already running, over TraCI.

Steps: check that its clock fits the scenario's; subscribe to everybody on the road; step it through the recording, and
give the rows of each frame as SUMO's own FCD file would have them. World frame and units as in SUMO; times are whole
milliseconds.
"""

from __future__ import annotations

import os
import re
import shutil
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

from egvs.core.errors import InputError, MissingBackendError, RunError
from egvs.core.runtime import sumo_home
from egvs.traffic import sandbox
from egvs.traffic.vehicle_boxes import VehicleSize

_TAIL_BYTES = 512


def check_table_complete(path: Path) -> None:
    """RunError where a table does not end with a line."""
    if not last_bytes(path).endswith(b"\n"):
        raise truncated_file_error(path)


def check_xml_complete(path: Path, root: str) -> None:
    """RunError where the root element of an XML file is not closed."""
    if re.search(rf"(</{root}>|<{root}[^<>]*/>)\s*\n\Z".encode(), last_bytes(path)) is None:
        raise truncated_file_error(path)


def truncated_file_error(path: Path) -> RunError:
    """The error for a file that SUMO did not write to its end."""
    free_mb = shutil.disk_usage(path.parent).free / 1e6
    return RunError(f"{path}: SUMO did not write it to its end; is the disk full? ({free_mb:,.0f} MB are free there)")


def last_bytes(path: Path) -> bytes:
    """The file's last bytes; none where there is no such file."""
    if not path.is_file():
        return b""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _TAIL_BYTES))
        return file.read()


APT_COMMAND = "apt-get install libatomic1 libx11-6 libxext6 libxrender1 libgl1"
"""What SUMO's binaries need on a minimal Debian."""

_POLL_S = 0.1
_LISTENS_S = 0.02
_OPENS_WITHIN_S = 60.0
_ENDS_WITHIN_S = 10.0
_MAX_ERRORS, _MAX_ERROR_LENGTH = 12, 300

_CRASHES = frozenset({signal.SIGSEGV, signal.SIGABRT, signal.SIGFPE, signal.SIGILL, getattr(signal, "SIGBUS", 0)})
"""Signals by which a program ends itself."""

_ANSWERS_WITHIN_S, _STEPS_WITHIN_S = 30.0, 600.0
"""How long somebody else's SUMO may take to answer first, and then each time: it may be paused by hand."""

_NO_TRACI = (struct.error, UnicodeDecodeError)
"""What reading an answer raises that is none of SUMO's."""


class SumoInputError(RunError):
    """A program of SUMO refused what it was given: it ended by itself, with an error, or crashed."""


def sumo_binary(name: str) -> Path:
    """A program of SUMO in the environment, SUMO_HOME, wheel or PATH; MissingBackendError when it is in none."""
    import shutil

    import sumolib

    with _preserve_proj_data():
        program = shutil.which(sumolib.checkBinary(name))
    if program is None:
        raise MissingBackendError(f"SUMO's program '{name}' was not found: set SUMO_HOME, or pip install eclipse-sumo")
    return Path(program)


@contextmanager
def _preserve_proj_data() -> Iterator[None]:
    """Importing SUMO's wheel points this process at its data of projections, which not every library can read."""
    before = {name: os.environ.get(name) for name in ("PROJ_DATA", "PROJ_LIB")}
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)


def sumo_environment() -> dict[str, str]:
    """What SUMO's programs need: this process' own variables, SUMO_HOME, and where the wheel keeps PROJ's data."""
    home = sumo_home()
    proj = home / "data" / "proj"
    more = {"PROJ_DATA": str(proj), "PROJ_LIB": str(proj)} if proj.is_dir() else {}
    return {"SUMO_HOME": str(home), **more, **os.environ}


@cache
def sumo_version() -> str:
    """SUMO's version, e.g. ``"1.28.0"``: the wheel's where its binary is used, else what ``sumo --version`` prints."""
    program = sumo_binary("sumo")
    try:
        wheel = metadata.distribution("eclipse-sumo")
        if Path(str(wheel.locate_file("sumo"))).resolve() in program.resolve().parents:
            return wheel.version
    except metadata.PackageNotFoundError:
        pass
    return parse_version(run_program("sumo", ["--version"], Path()))


def parse_version(text: str) -> str:
    """The version number in what SUMO says about itself ("Eclipse SUMO sumo 1.28.0", or traci's "SUMO 1.28.0")."""
    number = re.search(r"\b[vV]?(\d+[._]\d+[._]\d+\S*)", text)
    if number is None:
        raise RunError(f"SUMO does not tell its version: {text.strip().splitlines()[:1]}")
    return number.group(1).replace("_", ".")


def vehicle_classes() -> frozenset[str]:
    """The names of all SUMO vClasses."""
    from sumolib.net.lane import SUMO_VEHICLE_CLASSES

    return frozenset(SUMO_VEHICLE_CLASSES)


def traci_constants() -> Any:
    """The numbers that TraCI calls its variables by."""
    from traci import constants

    return constants


def run_program(
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
    return _run_command(name, [str(sumo_binary(name)), *arguments], folder, log or Path(os.devnull), watch)


def run_netconvert(arguments: Sequence[str], folder: Path, name: str) -> None:
    """Have netconvert make the network ``name`` in a folder; raises what :func:`run_program` does, and RunError where
    it did
    not write the network to its end."""
    run_program("netconvert", [*arguments, "-o", name], folder)
    check_xml_complete(folder / name, "net")


def run_tool(name: str, arguments: Sequence[str], folder: Path) -> str:
    """Run one of SUMO's Python tools, e.g. ``"routeSampler.py"``, to its end and return what it printed; as
    :func:`run_program`
    does, it may write in its folder only.

    RunError when it ends with an error; MissingBackendError when it is not installed.
    """
    tool = sumo_home() / "tools" / name
    if not tool.is_file():
        raise MissingBackendError(f"SUMO's tool {name} is not in {tool.parent}: pip install eclipse-sumo")
    return _run_command(name, [sys.executable, "-B", str(tool), *arguments], folder, Path(os.devnull), None)


def _run_command(name: str, command: Sequence[str], folder: Path, log: Path, watch: Callable[[], None] | None) -> str:
    with log.open("wb") as errors:
        capture = subprocess.PIPE if str(log) == os.devnull else errors
        with _start_program(command, folder, subprocess.PIPE, capture) as process:
            printed, complaint = _wait(process, watch)
    if process.returncode:
        text = complaint if capture == subprocess.PIPE else log.read_bytes()
        raise program_error(name, process.returncode, (text or b"").decode("utf-8", "replace"))
    return printed.decode("utf-8", "replace")


@contextmanager
def _start_program(
    command: Sequence[str], folder: Path, printed: Any, complaints: Any
) -> Iterator[subprocess.Popen[bytes]]:
    """A program that ends with the block, and with this process. It may write in its folder only."""
    launcher = [sys.executable, "-I", "-S", sandbox.__file__, os.curdir, str(os.getpid())]
    reading, holding = os.pipe()
    try:
        process = subprocess.Popen(
            [*launcher, *command], cwd=folder, env=sumo_environment(), stdin=reading, stdout=printed,
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
            if sandbox.REPLACES_PROCESS:  # else the launcher kills it now
                process.kill()


def _wait(process: subprocess.Popen[bytes], watch: Callable[[], None] | None) -> tuple[bytes, bytes]:
    while True:
        try:
            return process.communicate(timeout=None if watch is None else _POLL_S)
        except subprocess.TimeoutExpired:
            assert watch is not None
            watch()


def program_error(name: str, code: int, text: str) -> RunError:
    """The error for a program of SUMO that ended with exit code ``code`` and said ``text``."""
    missing = re.search(r"error while loading shared libraries: ([^:\s]+)", text)
    if missing:
        library = missing.group(1)
        return MissingBackendError(
            f"{name} cannot start, the system library {library} is missing; on Debian: {APT_COMMAND}"
        )
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if code == sandbox.CANNOT_START:
        return MissingBackendError(f"{name} cannot be started: {(lines or ['this process has ended'])[-1]}")
    errors = [line for line in lines if not line.startswith(("Warning", "Quitting", "pj_obj_create"))] or lines[-1:]
    how = f"ended with exit code {code}"
    if code < 0:
        how = f"{'crashed with' if -code in _CRASHES else 'was killed by'} signal {-code}"
    kind = SumoInputError if code > 0 or -code in _CRASHES else RunError
    return kind("\n".join([f"{name} {how}:", *(f"  {line[:_MAX_ERROR_LENGTH]}" for line in errors[:_MAX_ERRORS])]))


@contextmanager
def connect_traci(host: str, port: int) -> Iterator[Any]:
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
def serve_traci(arguments: Sequence[str], folder: Path) -> Iterator[Any]:
    """Start SUMO with a TraCI server, yield the connection, and end SUMO."""
    import traci
    from sumolib.miscutils import getFreeSocketPort

    port = getFreeSocketPort()
    # a file, because SUMO would wait for ever on a full pipe that nobody reads
    with tempfile.TemporaryFile() as complaints:
        command = [str(sumo_binary("sumo")), *arguments, "--remote-port", str(port)]
        with _start_program(command, folder, subprocess.DEVNULL, complaints) as process:
            try:
                connection = _attach(process, port)
                try:
                    yield connection
                finally:
                    _close(connection)
            except traci.exceptions.FatalTraCIError:
                raise _closed_by_sumo(process, complaints) from None


def _closed_by_sumo(process: subprocess.Popen[bytes], complaints: IO[bytes]) -> RunError:
    """Why SUMO closed its end: it says so on its way out."""
    try:
        process.wait(_ENDS_WITHIN_S)
    except subprocess.TimeoutExpired:
        return RunError("sumo closed its TraCI port, and did not say why")
    complaints.seek(0)
    return program_error("sumo", process.returncode, complaints.read().decode("utf-8", "replace"))


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


def query_size(connection: Any, name: str) -> VehicleSize:
    """One vehicle type's size over TraCI."""
    types = connection.vehicletype
    return VehicleSize(types.getLength(name), types.getWidth(name), types.getHeight(name), types.getVehicleClass(name))
