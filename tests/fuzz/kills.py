"""Kills commands at random moments, and repeats them: the same bytes must come of it each time.

Half of the kills take the whole group of processes, as a terminal or a batch system does; the others the program alone,
as the kernel does when memory runs out: SUMO has to end by itself then. One command in four is killed twice.
"""

from __future__ import annotations

import hashlib
import os
import random
import re
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz import bases, cases
from tests.fuzz.cases import Verdict

SAME = "same bytes"
_RUN = ("run", "scenario", "--out", "out", "--jobs", "1")
_VERIFY = ("verify", "out")
_NEW = ("new", "out", "--from", "roads.net.xml", "houses.geojson", "--vehicles-per-hour", "200")
_UNLIKE = frozenset({"run.json", "report.html", "results.json", ".lock", ".digests.json"})
"""What holds durations, times of files, or nothing."""

_ENDS_WITHIN_S = 10.0
_COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)
_CREATED = re.compile(rb"\d{4}-\d\d-\d\d")


@dataclass(frozen=True)
class Command:
    """A command that is killed.

    Attributes
    ----------
    make
        Writes what it reads.
    verb
        The command; what it makes lies in ``out``.
    before
        Commands that make what it reads.
    after
        Commands that must succeed when it has been repeated.
    creates
        Whether it makes a new folder, which is complete as soon as it exists, and is not made again.
    suffixes
        What is compared; all files if empty.
    """

    make: Callable[[Path], None]
    verb: tuple[str, ...]
    before: tuple[tuple[str, ...], ...] = ()
    after: tuple[tuple[str, ...], ...] = ()
    creates: bool = False
    suffixes: tuple[str, ...] = ()


COMMANDS = {
    "run": Command(bases.routed, _RUN, after=(_VERIFY,)),
    "new": Command(bases.with_roads_map("houses.geojson"), _NEW, creates=True),
    "place": Command(bases.priced, ("place", "scenario", "--out", "out"), (_RUN,), (_VERIFY,)),
    "export": Command(bases.priced, ("export", "out", "--to", "geojson"), (_RUN,), (_VERIFY,)),
    "city": Command(bases.city, ("city", "run", "town", "--cluster", "processes=1", "--out", "out"),
                    suffixes=(".parquet", ".csv")),
}  # fmt: skip
_TURNS = ("run", "new", "place", "export", "run", "new", "place", "export", "run", "city")
"""Which command is killed next; that of cities takes ten times as long as the others."""


def kill(number: int, seed: int, folder: Path) -> Counter[str]:
    """Kill ``number`` commands; how often which verdict was given."""
    benches: dict[str, _Bench] = {}
    counts = Counter[str]()
    for attempt in range(number):
        name = _TURNS[attempt % len(_TURNS)]
        if name not in benches:
            benches[name] = _Bench(COMMANDS[name], folder / name)
        rng = random.Random(f"{seed}/kill/{attempt}")
        moments = [rng.uniform(0, 1.05 * benches[name].lasts_s) for _ in range(1 + rng.randrange(4) // 3)]
        verdict = benches[name].judge(moments, alone=rng.random() < 0.5)
        counts[verdict.name] += 1
        if verdict.name != SAME:
            at = ", ".join(f"{moment:.3f} s" for moment in moments)
            print(f"  {verdict.name}: {name}, kill {attempt} of seed {seed} at {at}: {verdict.told}", flush=True)
    return counts


class _Bench:
    """A command, its inputs, and what it makes of them undisturbed."""

    def __init__(self, command: Command, folder: Path) -> None:
        self.command, self._base, self._case = command, folder / "base", folder / "case"
        self._base.mkdir(parents=True)
        command.make(self._base)
        for arguments in command.before:
            self._run(self._base, arguments)
        shutil.copytree(self._base, self._case)
        begun = time.perf_counter()
        self._run(self._case, command.verb)
        self.lasts_s = time.perf_counter() - begun
        self._expected = dict(self._files())
        assert self._expected, command

    def _run(self, folder: Path, arguments: tuple[str, ...]) -> None:
        ended = cases.run(folder, arguments, store=True)
        if ended.code != 0:
            raise AssertionError(ended.err)

    def judge(self, moments: list[float], *, alone: bool) -> Verdict:
        """Kill the command at some moments, and repeat it."""
        shutil.rmtree(self._case)
        shutil.copytree(self._base, self._case)
        return self._killed(moments, alone=alone) or self._repeated()

    def _killed(self, moments: list[float], *, alone: bool) -> Verdict | None:
        """Begin the command and kill it, once for each moment; a verdict where something outlived it."""
        for moment in moments:
            sys.stdout.flush()
            if not (child := os.fork()):
                cases.become(self._case, self.command.verb, [self._case / ".out", self._case / ".err"], store=True)
            with suppress(ProcessLookupError):
                os.setpgid(child, child)
            time.sleep(moment)
            with suppress(ProcessLookupError):
                (os.kill if alone else os.killpg)(child, signal.SIGKILL)
            os.waitpid(child, 0)
            if not _is_gone(child):
                os.killpg(child, signal.SIGKILL)
                return Verdict("something outlived it")
        return None

    def _repeated(self) -> Verdict:
        """Run the command to its end, and compare."""
        is_complete = self.command.creates and (self._case / "out").exists()
        for arguments in (*(() if is_complete else (self.command.verb,)), *self.command.after):
            ended = cases.run(self._case, arguments, store=True)
            if ended.code != 0 or "Traceback" in ended.err:
                return Verdict(f"exit code {ended.code} of {arguments[0]}", (ended.err or ended.out)[-300:])
        files = dict(self._files())
        names = self._expected.keys() | files.keys()
        if unlike := sorted(name for name in names if self._expected.get(name) != files.get(name)):
            return Verdict("other bytes", ", ".join(unlike))
        if rest := [path.name for path in (self._case / "store" / ".work").glob("*")]:
            return Verdict("the store is not clear", ", ".join(rest))
        if self.command.creates and (rest := sorted({path.name for path in self._case.glob(".out*")} - {".out"})):
            return Verdict("something is left beside it", ", ".join(rest))
        return Verdict(SAME)

    def _files(self) -> Iterator[tuple[str, str]]:
        """Name and hash of every file that the command made and that does not depend on the clock."""
        for path in sorted((self._case / "out").rglob("*")):
            if not path.is_file() or path.name in _UNLIKE:
                continue
            if self.command.suffixes and path.suffix not in self.command.suffixes:
                continue
            data = path.read_bytes()
            if path.suffix == ".xml":
                data = _COMMENT.sub(b"", data)  # the date, by SUMO
            if path.suffix == ".toml":
                data = _CREATED.sub(b"", data)
            yield path.relative_to(self._case).as_posix(), hashlib.sha256(data).hexdigest()


def _is_gone(group: int) -> bool:
    """Whether all processes of a group have ended, soon."""
    last = time.monotonic() + _ENDS_WITHIN_S
    while time.monotonic() < last:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.01)
    return False
