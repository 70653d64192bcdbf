"""Cost of checks on input files, as a share of a plain run.

``python -m benchmarks.file_checks`` runs the shipped junction without a cache, and adds up the processor time of: the
check that no input is overwritten, reading files before they are copied, the launcher that confines SUMO, and the check
that SUMO's files are complete. The cost of the launcher is measured with a program that does nothing.
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
from egvs.core import sandbox
from egvs.runs import run as runs_run
from egvs.traffic import recording, sumo, user_files

SCENARIO = Path(__file__).resolve().parent.parent / "scenarios" / "nishishinjuku"
STARTS, MAX_SHARE = 15, 0.03
CHECKS = {
    "inputs not overwritten": (runs_run, "check_no_overwrite"),
    "files read before they are copied": (user_files, "copy_checked"),
    "SUMO's files are complete": (recording, "check_complete"),
}
START = "launcher of SUMO"


def rows() -> list[tuple[str, str, str, bool]]:
    """Return the share of the checks in a run, its limit, and whether it is below the limit."""
    spent_s, run_s = run(SCENARIO)
    share = sum(spent_s.values()) / run_s
    return [("checks, share of a plain run", f"{share:.2%}", f"<= {MAX_SHARE:.0%}", share <= MAX_SHARE)]


def run(scenario: Path) -> tuple[dict[str, float], float]:
    """Return processor seconds of each check in a run, and of the run, with compiled kernels."""
    for _ in range(2):
        with (
            tempfile.TemporaryDirectory() as folder,
            patch.dict(os.environ, EGVS_STORE=""),
            measure_checks() as spent_s,
        ):
            before_s = _busy_s()
            egvs.run(egvs.load(scenario), Path(folder) / "run", jobs=1)
            run_s = _busy_s() - before_s
    return spent_s, run_s


@contextmanager
def measure_checks() -> Iterator[dict[str, float]]:
    """Measure processor seconds of each check within the block."""
    spent_s = defaultdict[str, float](float)

    def timed(name: str, check: Callable[..., Any]) -> Callable[..., Any]:
        def work(*arguments: Any) -> Any:
            start_s = time.process_time()
            try:
                return check(*arguments)
            finally:
                spent_s[name] += time.process_time() - start_s

        return work

    one_s, started = launcher_s(), sumo._start_program

    def counted(command: Sequence[str], *more: Any) -> Any:
        spent_s[START] += one_s
        return started(command, *more)

    with ExitStack() as patches:
        for name, (module, check) in CHECKS.items():
            patches.enter_context(patch.object(module, check, timed(name, getattr(module, check))))
        patches.enter_context(patch.object(sumo, "_start_program", counted))
        yield spent_s


def launcher_s() -> float:
    """Return the additional processor seconds of starting a program with the launcher."""
    program, launcher = ["/bin/true"], [sys.executable, "-I", "-S", sandbox.__file__, "write=.", str(os.getpid())]
    times_s: dict[bool, list[float]] = {False: [], True: []}
    for _ in range(STARTS):
        for by_launcher, seconds_taken in times_s.items():
            before_s = _busy_s(resource.RUSAGE_CHILDREN)
            subprocess.run([*launcher, *program] if by_launcher else program, stdin=subprocess.DEVNULL, check=True)
            seconds_taken.append(_busy_s(resource.RUSAGE_CHILDREN) - before_s)
    return statistics.median(times_s[True]) - statistics.median(times_s[False])


def _busy_s(*whose: int) -> float:
    used = [resource.getrusage(who) for who in whose or (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


if __name__ == "__main__":
    check_s, all_s = run(SCENARIO)
    for what, seconds in check_s.items():
        print(f"{1000 * seconds:8.1f} ms  {seconds / all_s:7.3%}  {what}")
    print(f"{1000 * sum(check_s.values()):8.1f} ms  {sum(check_s.values()) / all_s:7.3%}  of {all_s:.1f} s in total")
