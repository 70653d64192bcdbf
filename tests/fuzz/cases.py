"""Runs the command line on one mutant, in a process of its own with limits, and judges how that ended.

The process is forked from this one, in which everything is imported and every kernel compiled, so that a case costs
what the program costs and nothing else. Verdicts that are well: ``refused`` (exit code 2, one message, which names the
file), ``same`` (the ranking of the file as it was), ``legal`` (another ranking of a file that other code reads, and
reads as something else than before), ``unkept`` (exit code 1: the traffic that such a file describes does not keep what
the scenario promises; with one message). Any other verdict is a fault.
"""

from __future__ import annotations

import gc
import hashlib
import itertools
import math
import os
import pickle
import re
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import CodeType

from tests.fuzz import read_signals, read_tracks
from tests.fuzz.kinds import Kind
from tests.fuzz.meaning import DAMAGED

MOST_SECONDS, _MOST_WAITING = 60.0, 300.0
"""Of processor time; and by the clock, for what waits, or has to share the machine."""

MOST_BYTES = 2 << 30
"""Of resident memory, that of SUMO too."""

_ADDRESSES = 6 << 30
"""Of address space beyond what this process has: what goes on allocating is ended before it takes the machine."""

_MOST_WRITTEN = 1 << 30
_LONGEST_MESSAGE = 4000
_ROW = re.compile(r"\bsite '?[^\s:']+'?(?: and \d+ more)?:")
"""A message may name a row, a site, in place of the file that it stands in."""

_TEMPORARY = re.compile(r"(?:\.tmp|\.pending)/")
"""In a message: a file that the user does not know."""
_PYTHON_WARNING = re.compile(r"^\S+:\d+: \w*Warning: ", re.MULTILINE)

_SCORES = ("egvs", "egvs_limit", "rank", "entropy_seen")
_NO_VEHICLE = ("no vehicle in the region", "so there is no ranking")
_OF_VEHICLES = ("expected_detections", "points_on_target", "seen_well")
WELL = ("refused", "same", "legal", "unkept")


@dataclass(frozen=True)
class Ended:
    """How the command line ended: exit code (below 0: a signal; None: out of time), what it printed, and what it took.

    ``peak_bytes`` is the largest resident memory of one of its processes, ``busy_s`` the processor time of all.
    """

    code: int | None
    out: str
    err: str
    peak_bytes: int
    busy_s: float


@dataclass(frozen=True)
class Verdict:
    """``name`` is one of WELL, or the fault; ``told`` the line that says most of it; and what the case took."""

    name: str
    told: str = ""
    peak_bytes: int = 0
    busy_s: float = 0.0


def run(folder: Path, arguments: Sequence[str], store: bool = False) -> Ended:
    """``egvs ARGUMENTS`` in ``folder``, in a process of its own."""
    printed = [folder / name for name in (".out", ".err")]
    (folder / ".tmp").mkdir(exist_ok=True)
    sys.stdout.flush()
    sys.stderr.flush()
    if not (child := os.fork()):
        become(folder, arguments, printed, store)
    code, peak, busy_s = _wait(child)
    out, err = (path.read_text(errors="replace") for path in printed)
    return Ended(code, out, err, peak, busy_s)


def become(folder: Path, arguments: Sequence[str], printed: Sequence[Path], store: bool) -> None:
    """The command line in this process, which was forked for it; never returns."""
    code = 70
    try:
        os.setpgid(0, 0)
        os.chdir(folder)
        for number, path in enumerate(printed, 1):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        sys.stdout, sys.stderr = (open(number, "w", encoding="utf-8", closefd=False) for number in (1, 2))  # noqa: SIM115
        os.environ |= {
            "EGVS_STORE": str(folder / "store") if store else "",
            "TMPDIR": str(folder / ".tmp"),
            "COLUMNS": "160",
        }
        tempfile.tempdir = None
        limit_process()
        command_line(arguments)
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:  # noqa: BLE001 - whatever it is, it is a traceback that a user would have seen
        traceback.print_exc()
    finally:
        with suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def command_line(arguments: Sequence[str]) -> None:
    """``egvs ARGUMENTS`` in this process, or a reader in place of a verb."""
    if arguments[0] == read_tracks.VERB:
        read_tracks.main(arguments[1:])
    elif arguments[0] == read_signals.VERB:
        read_signals.main(arguments[1:])
    else:
        sys.argv = ["egvs", *arguments]
        from egvs.cli.app import main

        main()


def limit_process() -> None:
    """Limit address space, files and dumps of this process."""
    mine = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[0]) * resource.getpagesize()
    most = mine + _ADDRESSES
    for what, limit in ((resource.RLIMIT_AS, most), (resource.RLIMIT_FSIZE, _MOST_WRITTEN), (resource.RLIMIT_CORE, 0)):
        resource.setrlimit(what, (limit, limit))


def _wait(child: int) -> tuple[int | None, int, float]:
    """Exit code, peak and processor time of a child, which is killed when its time is over."""
    descriptor, last = os.pidfd_open(child), time.monotonic() + _MOST_WAITING
    try:
        while not (ready := select.select([descriptor], [], [], 1.0)[0]):
            if time.monotonic() > last or _busy_s(child) > MOST_SECONDS:
                break
    finally:
        os.close(descriptor)
    if not ready:
        with suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)
    _, status, used = os.wait4(child, 0)
    with suppress(ProcessLookupError):  # SUMO ends with it, but later
        os.killpg(child, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(status) if ready else None
    return code, used.ru_maxrss * 1024, used.ru_utime + used.ru_stime


def _busy_s(process: int) -> float:
    """Processor time of a process and of those that it has waited for."""
    fields = Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


class Bench:
    """A kind of file, its sound base, and what the program makes of that."""

    def __init__(self, kind: Kind, folder: Path) -> None:
        self.kind, self._base, self._case = kind, folder / "base", folder / "case"
        self._base.mkdir(parents=True)
        kind.make(self._base)
        for arguments in kind.before:
            self._sound(self._base, arguments)
        self.files = sorted(self._base.glob(kind.file))
        if not self.files:
            raise FileNotFoundError(f"{kind.name}: no {kind.file}")
        self._lay()
        self._sound(self._case, kind.verb)
        self._outcome = self._outcome_of(self._case)

    def _sound(self, folder: Path, arguments: Sequence[str]) -> None:
        ended = run(folder, arguments, self.kind.store)
        if ended.code != 0:
            raise AssertionError(f"{self.kind.name}: egvs {' '.join(arguments)}: {ended.code}\n{ended.err}")

    def _lay(self) -> None:
        shutil.rmtree(self._case, ignore_errors=True)
        shutil.copytree(self._base, self._case)

    def judge(self, file: Path, data: bytes) -> Verdict:
        """What the program makes of ``data`` in place of one of :attr:`files`."""
        self._lay()
        (self._case / file.relative_to(self._base)).write_bytes(data)
        ended = run(self._case, self.kind.verb, self.kind.store)
        verdict = fault_of(ended) or self._answer(ended, file, data)
        return replace(verdict, peak_bytes=ended.peak_bytes, busy_s=ended.busy_s)

    def _answer(self, ended: Ended, file: Path, data: bytes) -> Verdict:
        last = next((line for line in reversed(ended.err.splitlines()) if line.strip()), "")
        if ended.code == 0 or (ended.code == 1 and self.kind.may_differ and not ended.err):
            return self._ranking(ended, file, data)
        if ended.code == 1 and self.kind.simulated and last.startswith("egvs: scenario/scenario.toml: traffic"):
            return self._if_it_says_something_else(file, data, Verdict("unkept", last[:300]))
        return refused(self.kind, file, ended)

    def _ranking(self, ended: Ended, file: Path, data: bytes) -> Verdict:
        try:
            outcome = self._outcome_of(self._case)
        except DAMAGED as error:
            return Verdict("result unreadable", repr(error)[:300])
        if repr(outcome) == repr(self._outcome):  # in which nan is nan
            return Verdict("same")
        if _has_nan(outcome, ended.out):
            return Verdict("NaN score", repr(outcome)[:300])
        return self._if_it_says_something_else(file, data, Verdict("legal"))

    def _if_it_says_something_else(self, file: Path, data: bytes, then: Verdict) -> Verdict:
        """``then`` where other code reads the mutant, and reads something else than before."""
        try:
            if self.kind.meaning(data) == self.kind.meaning(file.read_bytes()):
                return Verdict("changed, but means the same")
        except DAMAGED as error:
            return Verdict("read, but damaged", repr(error)[:300])
        return then

    def _outcome_of(self, folder: Path) -> list[object]:
        """What of the results is compared: scores of the sites, or the bytes of other results."""
        import pyarrow.parquet as pq

        paths = [sorted(folder.glob(name)) if "*" in name else [folder / name] for name in self.kind.results]
        return [
            pq.read_table(path).to_pydict() if path.suffix == ".parquet" else path.read_bytes()
            for path in itertools.chain.from_iterable(paths)
        ]


def refused(kind: Kind, file: Path, ended: Ended) -> Verdict:
    """The verdict of a message: one that names the user's file, and ends with the right code."""
    last = next((line for line in reversed(ended.err.splitlines()) if line.strip()), "")
    if ended.code != 2:
        return Verdict(f"exit code {ended.code}", last[:300])
    if len(ended.err) > _LONGEST_MESSAGE:
        return Verdict("long message", last[:300])
    said = ended.err + ended.out
    if not kind.names_others and file.name not in said and _ROW.search(said) is None:
        return Verdict("file not named", (last or ended.out)[:300])
    if match := _TEMPORARY.search(said):
        return Verdict("names a temporary file", said[max(0, match.start() - 200) : match.end() + 100])
    return Verdict("refused", (last or ended.out)[:300])


def fault_of(ended: Ended) -> Verdict | None:
    """What is a fault whatever the file was."""
    lines = (ended.err + ended.out).splitlines()
    last = next((line for line in reversed(lines) if line.strip()), "")[:300]
    if ended.code is None:
        return Verdict("out of time", last)
    if ended.code < 0:
        return Verdict(f"signal {-ended.code}", last)
    if any("Traceback (most recent call last)" in line for line in lines):
        return Verdict(
            "traceback", next((line for line in reversed(ended.err.splitlines()) if line.strip()), last)[:300]
        )
    if match := _PYTHON_WARNING.search(ended.err):
        return Verdict("warning of Python", ended.err[match.start() :][:300])
    if ended.peak_bytes > MOST_BYTES:
        return Verdict("memory", f"{ended.peak_bytes / 2**30:.1f} GB; {last}")
    return None


def _has_nan(outcome: Sequence[object], out: str) -> bool:
    """Whether a score is no number; means over vehicles are none where the run says that there is no vehicle."""
    names = _SCORES if any(said in out for said in _NO_VEHICLE) else (*_SCORES, *_OF_VEHICLES)
    tables = [table for table in outcome if isinstance(table, dict)]
    values = [value for table in tables for name in names for value in table.get(name, ())]
    return any(isinstance(value, float) and not math.isfinite(value) for value in values)


def warm_up(folder: Path) -> None:
    """Import everything and compile every kernel in this process, from which the others are forked."""
    import contextlib
    import io

    import jinja2
    import typer.main

    from egvs.cli.app import main
    from egvs.creation import assumed_traffic
    from tests.conftest import write_mini

    os.environ["EGVS_STORE"] = ""
    plain, compiled = jinja2.Environment.compile, {}

    def compile_once(environment: jinja2.Environment, *of: str) -> CodeType:
        """Of the report's page, for that is half the time of a case."""
        if of not in compiled:
            compiled[of] = plain(environment, *of)
        return compiled[of]

    jinja2.Environment.compile = compile_once
    typer.main.get_command = cache(typer.main.get_command)  # and so are the verbs, which are made anew at each call
    assumed_traffic.find_capacity = _remembered(assumed_traffic.find_capacity, folder / "capacities")
    printed = io.StringIO()
    for arguments in (
        ["run", str(write_mini(folder / "mini")), "--out", str(folder / "out"), "--jobs", "1"],
        *_maps(folder),
    ):
        sys.argv = ["egvs", *arguments]
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            try:
                main()
            except SystemExit as end:
                assert not end.code, printed.getvalue()
    gc.collect()
    gc.freeze()


def _maps(folder: Path) -> Iterator[list[str]]:
    """Arguments that make scenarios from maps of several formats, so that what reads them is imported."""
    from tests.fuzz import bases

    aligned = ["--align", "0,0=52.0,10.0", "--align", "0,100=52.000899,10.0"]
    makers = {
        "city.gml": bases.with_roads_map, "houses.gpkg": bases.vectors, "terrain.tif": bases.on_terrain,
        "survey.las": bases.surveyed, "survey.e57": bases.surveyed, "house.glb": bases.modelled,
    }  # fmt: skip
    for number, (name, make) in enumerate(makers.items()):
        maps = folder / f"maps{number}"
        maps.mkdir()
        make(name)(maps)
        arguments = ["new", str(maps / "made"), "--from", str(maps / "roads.net.xml"), str(maps / name)]
        yield [*arguments, "--vehicles-per-hour", "200", *(aligned if make in (bases.surveyed, bases.modelled) else ())]


def _remembered(function: Callable[..., object], folder: Path) -> Callable[..., object]:
    """The same results for the same arguments, in files, since the processes of the cases share nothing else.

    Trials of traffic are most of the time of a case, and mutants of what stands beside roads do not change them.
    """
    folder.mkdir()

    def remembering(*arguments: object) -> object:
        path = folder / hashlib.sha256(repr(arguments).encode("utf-8", "surrogatepass")).hexdigest()
        if not path.is_file():
            result = function(*arguments)
            part = path.with_suffix(f".{os.getpid()}")
            part.write_bytes(pickle.dumps(result))
            part.replace(path)
        return pickle.loads(path.read_bytes())

    return remembering
