"""Find, start and query SUMO.

The only module that locates SUMO's programs and imports its Python tools (sumolib, traci), each inside the function
that needs it. Programs run as subprocesses in the folder of their files, so that their outputs contain no paths.

Errors quote SUMO's own message and exit code. For a missing system library, they name the package that has it. Outputs
are checked for completeness, because SUMO ends without an error on a full disk.
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
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import IO, Any

from egvs.core import limits, sandbox
from egvs.core.child_process import OUT_OF_MEMORY, Confinement, start_program
from egvs.core.errors import InputError, MissingBackendError, RunError
from egvs.core.resource_usage import processor_seconds_of
from egvs.core.sumo_home import sumo_home
from egvs.core.threads import checkpoint
from egvs.traffic.vehicle_boxes import VehicleSize

APT_COMMAND = "apt-get install libatomic1 libx11-6 libxext6 libxrender1 libgl1"
"""Installs what SUMO's binaries need on a minimal Debian."""

_WATCH_PERIOD_S = 0.1
_CONNECT_PERIOD_S = 0.02
_START_TIMEOUT_S = 60.0
_EXIT_TIMEOUT_S = 10.0

_ANSWER_TIMEOUT_S, _STEP_TIMEOUT_S = 30.0, 600.0
"""Timeouts for the first answer of a SUMO that was already running, and for each step: a user may pause it."""

_MAX_ERRORS, _MAX_ERROR_LENGTH = 12, 300
_TAIL_BYTES = 512

_CRASHES = frozenset({signal.SIGSEGV, signal.SIGABRT, signal.SIGFPE, signal.SIGILL, getattr(signal, "SIGBUS", 0)})
"""Signals of a program that crashed, in contrast to one that was killed."""

_OUT_OF_TIME = getattr(signal, "SIGXCPU", 0)

_MB_PER_INPUT_MB, _S_PER_INPUT_MB = 20, 10
"""Memory and time of a program, beside the limits. Measured: a grid of 4,900 junctions (49 MB) takes 346 MB and 4 s in
netconvert; with 20,000 vehicles and 1,400 time steps, 980 MB of the 2,980 MB and 450 s of the 2,500 s in SUMO."""

_PROTOCOL_ERRORS = (struct.error, UnicodeDecodeError)
"""What traci raises when an answer does not follow its protocol."""


_HUGE_PAGES = "glibc.malloc.hugetlb=1"
"""Lets glibc ask for larger memory pages: SUMO reads the data of all vehicles several times in each step."""


class SumoInputError(RunError):
    """A program of SUMO rejected its input: it ended with an error, crashed, or exceeded a limit.

    Attributes
    ----------
    limit
        The limit that was exceeded, which says nothing against the input; None for other reasons.
    """

    limit: limits.Limit | None = None

    def for_input(self, where: object, problem: str, hint: str) -> InputError:
        """Return this error for a file of the user.

        Parameters
        ----------
        where
            The file.
        problem
            What failed, in words.
        hint
            What to do about the file; left out where a limit was exceeded.
        """
        if self.limit is not None:
            return InputError(where, f"{problem}: {str(self).removesuffix(f'. {self.limit.hint}')}", self.limit.hint)
        return InputError(where, f"{problem}: {str(self).rstrip(':.')}", hint)


@dataclass(frozen=True)
class Allowance:
    """Memory and time that a program of SUMO may take.

    Attributes
    ----------
    memory_mb
        Memory in MB.
    work_s
        Processor time in seconds.
    """

    memory_mb: int
    work_s: int

    @classmethod
    def for_input(cls, folder: Path, time_steps: int = 0) -> Allowance:
        """Return the allowance for the files in a folder, and a number of time steps to simulate."""
        size_mb = sum(file.stat().st_size for file in folder.iterdir() if file.is_file()) // limits.MB
        work_s = limits.SUMO_TIME.maximum + _S_PER_INPUT_MB * size_mb + time_steps
        return cls(limits.SUMO_MEMORY.maximum + _MB_PER_INPUT_MB * size_mb, work_s)


def sumo_binary(name: str) -> Path:
    """Find a program of SUMO in the environment, SUMO_HOME, the wheel or PATH.

    Raises
    ------
    InputError
        When an environment variable names a program or a folder that does not exist.
    MissingBackendError
        When SUMO is not installed.
    """
    variable = f"{name.upper()}_BINARY"
    if named := os.environ.get(variable):
        program = shutil.which(named)
        if program is None:
            hint = "Set it to the path of the program, or unset it to use the installed one."
            raise InputError(variable, f"expected a program, got {named!r}", hint)
        return Path(program)
    program = _bundled_binary(name)
    if program is None:
        import sumolib  # takes 0.1 s, which a run without changes need not spend

        with _preserve_proj_data():
            program = shutil.which(sumolib.checkBinary(name))
    if program is None:
        raise MissingBackendError(f"SUMO's {name!r} was not found. Set SUMO_HOME, or run pip install eclipse-sumo")
    return Path(program)


def _bundled_binary(name: str) -> str | None:
    """Return a program in SUMO's folder; None where it is not there."""
    try:
        home = sumo_home()
    except MissingBackendError:
        return None
    return shutil.which(home / "bin" / name)


@contextmanager
def _preserve_proj_data() -> Iterator[None]:
    """Restore the variables that SUMO's wheel sets on import; other libraries may not read its PROJ data."""
    before = {name: os.environ.get(name) for name in ("PROJ_DATA", "PROJ_LIB")}
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)


def sumo_environment() -> dict[str, str]:
    """Return the environment for SUMO's programs.

    SUMO_HOME, the wheel's PROJ data, a setting of glibc's memory, and this process's variables, which take precedence.
    """
    home = sumo_home()
    defaults = {"SUMO_HOME": str(home), "GLIBC_TUNABLES": _HUGE_PAGES}
    proj = home / "data" / "proj"
    if proj.is_dir():
        defaults |= {"PROJ_DATA": str(proj), "PROJ_LIB": str(proj)}
    return {**defaults, **os.environ}


@cache
def sumo_version() -> str:
    """Return SUMO's version, e.g. ``"1.28.0"``: that of the wheel, or what ``sumo --version`` prints."""
    program = sumo_binary("sumo")
    try:
        wheel = metadata.distribution("eclipse-sumo")
        if Path(str(wheel.locate_file("sumo"))).resolve() in program.resolve().parents:
            return wheel.version
    except metadata.PackageNotFoundError:
        pass
    return parse_version(run_program("sumo", ["--version"], Path()))


def parse_version(text: str) -> str:
    """Find the version in the output of SUMO ("Eclipse SUMO sumo 1.28.0") or of traci ("SUMO 1.28.0")."""
    number = re.search(r"\b[vV]?(\d+[._]\d+[._]\d+\S*)", text)
    if number is None:
        raise RunError(f"expected a version of SUMO, got {text.strip().splitlines()[:1]}")
    return number.group(1).replace("_", ".")


COMMON_VEHICLE_CLASSES = frozenset(("bicycle", "bus", "delivery", "motorcycle", "passenger", "pedestrian", "truck"))
"""vClasses that every SUMO has: sumolib, which knows all of them, takes 0.1 s to load."""


def is_vehicle_class(name: str) -> bool:
    """Return whether SUMO has a vClass of this name."""
    return name in COMMON_VEHICLE_CLASSES or name in vehicle_classes()


def vehicle_classes() -> frozenset[str]:
    """Return SUMO's vClasses."""
    from sumolib.net.lane import SUMO_VEHICLE_CLASSES

    return frozenset(SUMO_VEHICLE_CLASSES)


def traci_constants() -> Any:
    """Return the module of TraCI's constants."""
    from traci import constants

    return constants


def run_program(
    name: str,
    arguments: Sequence[str],
    folder: Path,
    log: Path | None = None,
    watch: Callable[[int], None] | None = None,
    time_steps: int = 0,
) -> str:
    """Run a program of SUMO to its end. It may write to its folder only, within an :class:`Allowance`.

    Parameters
    ----------
    name, arguments
        The program, e.g. ``"sumo"``, and its arguments; file names are relative to ``folder``.
    folder
        Its working directory.
    log
        File for its warnings and errors.
    watch
        Called with the number of its process every 0.1 s while it runs.
    time_steps
        Number of time steps to simulate, each of which may take time.

    Returns
    -------
    str
        Its standard output.

    Raises
    ------
    SumoInputError
        When it ends with an error, crashes, or exceeds a limit.
    RunError
        When it is killed.
    MissingBackendError
        When it, or a system library that it needs, is not installed.
    """
    allowance = Allowance.for_input(folder, time_steps)
    command = [str(sumo_binary(name)), *arguments]
    return _run_command(name, command, folder, allowance, log or Path(os.devnull), watch)


def run_netconvert(arguments: Sequence[str], folder: Path, name: str) -> None:
    """Run netconvert, as :func:`run_program` does, and check that the network is complete.

    Parameters
    ----------
    arguments
        All arguments but the output file.
    folder
        Its working directory.
    name
        The network to write.
    """
    run_program("netconvert", [*arguments, "-o", name], folder)
    check_xml_complete(folder / name, "net")


def run_tool(name: str, arguments: Sequence[str], folder: Path) -> str:
    """Run one of SUMO's Python tools, as :func:`run_program` does.

    Parameters
    ----------
    name, arguments
        The tool, e.g. ``"routeSampler.py"``, and its arguments.
    folder
        Its working directory.
    """
    tool = sumo_home() / "tools" / name
    if not tool.is_file():
        raise MissingBackendError(f"SUMO's tool {name} is not in {tool.parent}. Run pip install eclipse-sumo")
    command = [sys.executable, "-B", str(tool), *arguments]
    return _run_command(name, command, folder, Allowance.for_input(folder), Path(os.devnull), None)


def _run_command(
    name: str,
    command: Sequence[str],
    folder: Path,
    allowance: Allowance,
    log: Path,
    watch: Callable[[int], None] | None,
) -> str:
    idle = _IdleWatch(name, folder)
    with log.open("wb") as log_file:
        has_log = str(log) != os.devnull
        stderr = log_file if has_log else subprocess.PIPE
        with _start_program(command, folder, allowance, subprocess.PIPE, stderr) as process:
            output, errors = _wait(process, idle, watch)
    if process.returncode:
        text = log.read_bytes() if has_log else errors
        raise program_error(name, process.returncode, text.decode("utf-8", "replace"), allowance)
    return output.decode("utf-8", "replace")


def _start_program(
    command: Sequence[str], folder: Path, allowance: Allowance, stdout: Any, stderr: Any
) -> AbstractContextManager[subprocess.Popen[bytes]]:
    """Start a program that may write to its folder only, and that ends with the block or with this process."""
    memory_bytes = allowance.memory_mb * limits.MB
    confinement = Confinement(writable=Path(os.curdir), memory_bytes=memory_bytes, processor_s=allowance.work_s)
    return start_program(command, folder, confinement, sumo_environment(), stdout, stderr)


def _wait(
    process: subprocess.Popen[bytes], idle: _IdleWatch, watch: Callable[[int], None] | None
) -> tuple[bytes, bytes]:
    """Return standard output and standard error of a process, at its end."""
    while True:
        checkpoint()
        try:
            return process.communicate(timeout=_WATCH_PERIOD_S)
        except subprocess.TimeoutExpired:
            idle.check(process.pid)
            if watch is not None:
                watch(process.pid)


class _IdleWatch:
    """Ends the wait for a program that does nothing: it takes no processor time, and no file in its folder changes.

    Where the system does not tell the processor time of other processes, the wait has no limit.

    Parameters
    ----------
    name
        The program.
    folder
        Its working directory.
    """

    def __init__(self, name: str, folder: Path) -> None:
        self._name, self._folder, self._limit_s = name, folder, limits.SUMO_IDLE.maximum
        self._state: tuple[object, ...] = ()
        self._changed_s = time.monotonic()

    def check(self, process: int) -> None:
        """Raise a SumoInputError if nothing has changed for too long."""
        busy_s = processor_seconds_of(process)
        sizes = []
        with suppress(FileNotFoundError):  # removed meanwhile
            sizes = [entry.stat().st_size for entry in os.scandir(self._folder) if entry.is_file(follow_symlinks=False)]
        state = (busy_s, len(sizes), sum(sizes))
        now_s = time.monotonic()
        if state != self._state or busy_s is None:
            self._state, self._changed_s = state, now_s
        elif now_s - self._changed_s > self._limit_s:
            problem = f"{self._name} has neither worked nor written anything for {self._limit_s:,} s"
            raise _limit_error(problem, limits.SUMO_IDLE)


def program_error(name: str, code: int, text: str, allowance: Allowance) -> RunError:
    """Return the error for a program of SUMO that failed.

    Parameters
    ----------
    name
        The program.
    code
        Exit code; negative for a signal.
    text
        Its standard error.
    allowance
        Memory and time that it had.
    """
    if code == -_OUT_OF_TIME:
        return _limit_error(f"{name} worked for more than {allowance.work_s:,} s", limits.SUMO_TIME)
    if code and OUT_OF_MEMORY.search(text):
        return _limit_error(f"{name} needed more than {allowance.memory_mb:,} MB of memory", limits.SUMO_MEMORY)
    missing = re.search(r"error while loading shared libraries: ([^:\s]+)", text)
    if missing:
        problem = f"{name} cannot start: the system library {missing.group(1)} is missing"
        return MissingBackendError(f"{problem}. On Debian, run {APT_COMMAND}")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if code == sandbox.CANNOT_START:
        reason = lines[-1] if lines else "the process that started it has ended"
        return MissingBackendError(f"{name} cannot be started: {reason}")

    errors = [line for line in lines if not line.startswith(("Warning", "Quitting", "pj_obj_create"))] or lines[-1:]
    kind: type[RunError] = SumoInputError
    if code > 0:
        problem = f"ended with exit code {code}"
    elif -code in _CRASHES:
        problem = f"crashed with signal {-code}"
    else:
        kind, problem = RunError, f"was killed by signal {-code}"
    return kind("\n".join([f"{name} {problem}:", *(f"  {line[:_MAX_ERROR_LENGTH]}" for line in errors[:_MAX_ERRORS])]))


def _limit_error(problem: str, limit: limits.Limit) -> SumoInputError:
    """Return the error for an exceeded limit."""
    error = SumoInputError(f"{problem}. {limit.hint}")
    error.limit = limit
    return error


@contextmanager
def connect_traci(host: str, port: int) -> Iterator[Any]:
    """Connect to a SUMO that is already running.

    Parameters
    ----------
    host, port
        Address of its TraCI server.

    Yields
    ------
    traci.connection.Connection
        The connection.

    Raises
    ------
    InputError
        When nothing answers there, or not as SUMO does.
    RunError
        When SUMO closes the connection, or stops answering.
    """
    import traci

    where = f"--traci {host}:{port}"
    connection = _connect(host, port)
    if connection is None:
        raise InputError(where, "no SUMO simulation answers there", "Start SUMO with --remote-port first.")
    try:
        try:
            connection.getVersion()
        except (*_PROTOCOL_ERRORS, traci.exceptions.TraCIException, traci.exceptions.FatalTraCIError):
            problem = f"the server there does not answer as SUMO does within {_ANSWER_TIMEOUT_S:g} s"
            raise InputError(where, problem, "Use the port that SUMO was given with --remote-port.") from None
        connection._socket.settimeout(_STEP_TIMEOUT_S)
        yield connection
    except traci.exceptions.FatalTraCIError as error:
        problem = f"closed the connection, or did not answer for {_STEP_TIMEOUT_S:g} s"
        raise RunError(f"SUMO at {host}:{port} {problem}: {error}") from None
    except (*_PROTOCOL_ERRORS, traci.exceptions.TraCIException) as error:
        raise RunError(f"SUMO at {host}:{port} gave an invalid answer: {error}") from None
    finally:
        _close(connection)


def _close(connection: Any) -> None:
    """Close a connection, even if SUMO closed it first."""
    import traci

    server = connection._socket
    with suppress(*_PROTOCOL_ERRORS, traci.exceptions.TraCIException, traci.exceptions.FatalTraCIError, OSError):
        connection.close(False)
    if server is not None:
        server.close()


@contextmanager
def serve_traci(arguments: Sequence[str], folder: Path) -> Iterator[Any]:
    """Start SUMO with a TraCI server, connect to it, and end it with the block.

    Parameters
    ----------
    arguments
        Arguments of ``sumo``.
    folder
        Its working directory.

    Yields
    ------
    traci.connection.Connection
        The connection.
    """
    import traci
    from sumolib.miscutils import getFreeSocketPort

    port = getFreeSocketPort()
    allowance = Allowance.for_input(folder)
    # a file, because SUMO would wait forever on a full pipe that nobody reads
    with tempfile.TemporaryFile() as stderr:
        command = [str(sumo_binary("sumo")), *arguments, "--remote-port", str(port)]
        with _start_program(command, folder, allowance, subprocess.DEVNULL, stderr) as process:
            try:
                connection = _attach(process, port, allowance)
                try:
                    yield connection
                finally:
                    _close(connection)
            except traci.exceptions.FatalTraCIError:
                raise _closed_error(process, stderr, allowance) from None


def _closed_error(process: subprocess.Popen[bytes], stderr: IO[bytes], allowance: Allowance) -> RunError:
    """Return the error for a SUMO that closed its TraCI server; it writes the reason before it ends."""
    try:
        process.wait(_EXIT_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return _limit_error(f"sumo did not answer for {allowance.work_s:,} s", limits.SUMO_TIME)
    stderr.seek(0)
    return program_error("sumo", process.returncode, stderr.read().decode("utf-8", "replace"), allowance)


def _attach(process: subprocess.Popen[bytes], port: int, allowance: Allowance) -> Any:
    """Connect as soon as SUMO listens. (traci's own retries wait a second each, and print.)"""
    import traci

    deadline = time.monotonic() + _START_TIMEOUT_S
    while (connection := _connect("localhost", port)) is None:
        if process.poll() is not None:
            raise traci.exceptions.FatalTraCIError("sumo ended")
        if time.monotonic() > deadline:
            raise RunError(f"sumo did not open its TraCI port within {_START_TIMEOUT_S:g} s")
        time.sleep(_CONNECT_PERIOD_S)
    connection._socket.settimeout(allowance.work_s)
    return connection


def _connect(host: str, port: int) -> Any:
    """Return a connection, or None where no server listens.

    Its socket is reached by a private name, here and above: traci has no other way to set a time limit.
    """
    import traci

    default_s = socket.getdefaulttimeout()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # traci does not close the socket of a failed connection
        try:
            socket.setdefaulttimeout(_ANSWER_TIMEOUT_S)
            connection = traci.connect(port=port, host=host, numRetries=0)
        except (traci.exceptions.FatalTraCIError, OSError):
            return None
        finally:
            socket.setdefaulttimeout(default_s)
    if connection._socket.getsockname() == connection._socket.getpeername():
        # TCP may connect a free local port to itself, which would wait forever
        connection._socket.close()
        return None
    return connection


def query_size(connection: Any, name: str) -> VehicleSize:
    """Query the size of a vehicle type over TraCI."""
    types = connection.vehicletype
    return VehicleSize(types.getLength(name), types.getWidth(name), types.getHeight(name), types.getVehicleClass(name))


def query_sizes(arguments: Sequence[str], folder: Path) -> dict[str, VehicleSize]:
    """Start SUMO with some arguments, and query the sizes of all vehicle types: defaults depend on the vClass."""
    with serve_traci([*arguments, "--route-steps", "0"], folder) as connection:
        return {name: query_size(connection, name) for name in connection.vehicletype.getIDList()}


def check_table_complete(path: Path) -> None:
    """Raise a RunError when the last line of a table is not complete."""
    if not read_tail(path).endswith(b"\n"):
        raise incomplete_file_error(path)


def check_xml_complete(path: Path, root: str) -> None:
    """Raise a RunError when the root element of an XML file is not closed."""
    if re.search(rf"(</{root}>|<{root}[^<>]*/>)\s*\n\Z".encode(), read_tail(path)) is None:
        raise incomplete_file_error(path)


def incomplete_file_error(path: Path) -> RunError:
    """Return the error for a file that SUMO did not write completely."""
    free_mb = shutil.disk_usage(path.parent).free / 1e6
    return RunError(f"{path}: SUMO wrote an incomplete file. Is the disk full? ({free_mb:,.0f} MB are free)")


def read_tail(path: Path) -> bytes:
    """Return the last 512 bytes of a file; empty where there is no file."""
    if not path.is_file():
        return b""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _TAIL_BYTES))
        return file.read()
