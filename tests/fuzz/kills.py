"""Kills runs at random moments, and runs them again: the same bytes must come of it each time.

Every second kill takes the whole group of processes, as a terminal or a batch system does; every other one the program
alone, as the kernel does when memory runs out: SUMO has to end by itself then. One run in four is killed twice.
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
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from tests.fuzz import bases, cases
from tests.fuzz.cases import Verdict

SAME = "same bytes"
_RUN = ("run", "scenario", "--out", "out", "--jobs", "1")
_UNLIKE = frozenset({"run.json", "report.html", ".lock", ".digests.json"})
"""What holds durations, times of files, or nothing."""

_ENDS_WITHIN_S = 10.0
_COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)


def kill(number: int, seed: int, folder: Path) -> Counter[str]:
    """Kill ``number`` runs of a small scenario in which SUMO runs; how often which verdict was given."""
    base, case, counts = folder / "base", folder / "case", Counter[str]()
    base.mkdir(parents=True)
    bases.routed(base)
    shutil.copytree(base, case)
    begun = time.perf_counter()
    ended = cases.run(case, _RUN, store=True)
    lasts_s = time.perf_counter() - begun
    if ended.code != 0:
        raise AssertionError(ended.err)
    right = dict(_bytes_in(case))
    for attempt in range(number):
        rng = random.Random(f"{seed}/kill/{attempt}")
        shutil.rmtree(case)
        shutil.copytree(base, case)
        moments = [rng.uniform(0, 1.05 * lasts_s) for _ in range(1 + (attempt % 4 == 3))]
        verdict = _killed(case, moments, alone=attempt % 2 == 1) or _again(case, right)
        counts[verdict.name] += 1
        if verdict.name != SAME:
            at = ", ".join(f"{moment:.3f} s" for moment in moments)
            print(f"  {verdict.name}: kill {attempt} of seed {seed} at {at}: {verdict.told}", flush=True)
    return counts


def _killed(case: Path, moments: list[float], *, alone: bool) -> Verdict | None:
    """Begin a run and kill it, once for each moment; a verdict where something outlived it."""
    for moment in moments:
        sys.stdout.flush()
        if not (child := os.fork()):
            cases.become(case, _RUN, [case / ".out", case / ".err"], store=True)
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


def _again(case: Path, right: dict[str, str]) -> Verdict:
    """Run to the end, and compare."""
    ended = cases.run(case, _RUN, store=True)
    if ended.code != 0 or "Traceback" in ended.err:
        return Verdict(f"exit code {ended.code}", ended.err[-300:])
    found = dict(_bytes_in(case))
    if unlike := sorted(name for name in right.keys() | found.keys() if right.get(name) != found.get(name)):
        return Verdict("other bytes", ", ".join(unlike))
    if kept := [path.name for path in (case / "store" / ".work").glob("*")]:
        return Verdict("the store is not clear", ", ".join(kept))
    return Verdict(SAME)


def _bytes_in(case: Path) -> Iterator[tuple[str, str]]:
    """Name and hash of every file in the run's folder that does not depend on the clock."""
    for path in sorted((case / "out").rglob("*")):
        if path.is_file() and path.name not in _UNLIKE:
            data = path.read_bytes()
            if path.suffix == ".xml":
                data = _COMMENT.sub(b"", data)  # the date, by SUMO
            yield path.relative_to(case).as_posix(), hashlib.sha256(data).hexdigest()
