"""What does it cost a plain run that other people's files are not trusted?

``python -m benchmarks.guards`` runs the shipped junction whole, in a fresh folder and without a store, and adds up the
processor time of what stands between files and SUMO: inputs are looked for among what is written, files are read before
they are copied, SUMO is started by a launcher that confines it, and its files are checked for their end. What a start
costs is measured apart, with a program that does nothing. Shares of one run, so that a busy machine matters little.
"""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import egvs
from egvs.runs import run as runs_run
from egvs.traffic import recording, sandbox, sumo, user_files

SCENARIO = Path(__file__).resolve().parent.parent / "scenarios" / "nishishinjuku"
STARTS, MOST = 15, 0.03
GUARDS = {
    "inputs looked for": (runs_run, "check_no_overwrite"),
    "files read before they are copied": (user_files, "copy_checked"),
    "ends of SUMO's files": (recording, "check_complete"),
}
START = "launcher of SUMO"


def rows() -> list[tuple[str, str, str, bool]]:
    """What guards cost, as a share of a run; what is wanted; and whether it is so."""
    spent_s, whole_s = run(SCENARIO)
    share = sum(spent_s.values()) / whole_s
    return [("guards, share of a plain run", f"{share:.2%}", f"<= {MOST:.0%}", share <= MOST)]


def run(scenario: Path) -> tuple[dict[str, float], float]:
    """Processor seconds of each guard in a whole run, and of the run; kernels were compiled before."""
    for _ in range(2):
        with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ, EGVS_STORE=""), accounted() as spent_s:
            before_s = _busy_s()
            egvs.run(egvs.load(scenario), Path(folder) / "run", jobs=1)
            whole_s = _busy_s() - before_s
    return spent_s, whole_s


@contextmanager
def accounted() -> Iterator[dict[str, float]]:
    """Processor seconds of each guard within the block, filled as they are spent."""
    spent_s = defaultdict[str, float](float)

    def timed(name: str, guard: Callable[..., Any]) -> Callable[..., Any]:
        def work(*arguments: Any) -> Any:
            start_s = time.process_time()
            try:
                return guard(*arguments)
            finally:
                spent_s[name] += time.process_time() - start_s

        return work

    one_s, started = launcher_s(), sumo._start_program

    def counted(command: Sequence[str], *more: Any) -> Any:
        spent_s[START] += one_s
        return started(command, *more)

    with ExitStack() as patches:
        for name, (module, guard) in GUARDS.items():
            patches.enter_context(patch.object(module, guard, timed(name, getattr(module, guard))))
        patches.enter_context(patch.object(sumo, "_start_program", counted))
        yield spent_s


def launcher_s() -> float:
    """Processor seconds that a start by the launcher takes more than one without it."""
    program, launcher = ["/bin/true"], [sys.executable, "-I", "-S", sandbox.__file__, os.curdir, str(os.getpid())]
    taken: dict[bool, list[float]] = {False: [], True: []}
    for _ in range(STARTS):
        for by_launcher, several in taken.items():
            before_s = _busy_s(resource.RUSAGE_CHILDREN)
            subprocess.run([*launcher, *program] if by_launcher else program, stdin=subprocess.DEVNULL, check=True)
            several.append(_busy_s(resource.RUSAGE_CHILDREN) - before_s)
    return statistics.median(taken[True]) - statistics.median(taken[False])


def _busy_s(*whose: int) -> float:
    used = [resource.getrusage(who) for who in whose or (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(its.ru_utime + its.ru_stime for its in used)


if __name__ == "__main__":
    found_s, all_s = run(SCENARIO)
    for what, seconds in found_s.items():
        print(f"{1000 * seconds:8.1f} ms  {seconds / all_s:7.3%}  {what}")
    print(f"{1000 * sum(found_s.values()):8.1f} ms  {sum(found_s.values()) / all_s:7.3%}  of {all_s:.1f} s in all")
