"""What does it cost a plain run that other people's files are not trusted?

``python -m benchmarks.guards [TURNS]`` runs the shipped junction whole, in fresh folders and without a store, in turn
with everything that stands between files and SUMO, and without: files are copied unread, SUMO is started as it is,
neither inputs among what is written nor the ends of SUMO's files are looked for. Processor seconds of this process and
of SUMO; about a minute.
"""

from __future__ import annotations

import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pipeline
from pipeline.runs import workflow
from pipeline.traffic import recording, sumo
from pipeline.traffic.guarded import copies

SCENARIO = Path(__file__).resolve().parent.parent / "scenarios" / "nishishinjuku"
TURNS, MOST = 7, 1.03


def rows() -> list[tuple[str, str, str, bool]]:
    """What guards cost, as a ratio; what is wanted; and whether it is so."""
    ratio = statistics.median(ratios(TURNS))
    return [("a plain run, guarded : without guards", f"{ratio:.3f}", f"<= {MOST}", ratio <= MOST)]


def ratios(turns: int) -> list[float]:
    """Processor seconds of a run with guards as shares of those of one without, turn by turn; which goes first
    changes."""
    once()  # compiled, and loaded
    found = []
    for turn in range(turns):
        if turn % 2:
            plain_s, guarded_s = once(without_guards), once()
        else:
            guarded_s, plain_s = once(), once(without_guards)
        found.append(guarded_s / plain_s)
    return found


def once(guards: Callable[[], Any] = ExitStack) -> float:
    """Processor seconds of a whole run."""
    with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ, EGVS_STORE=""), guards():
        before = _busy_s()
        pipeline.run(pipeline.load(SCENARIO), Path(folder) / "run", jobs=1)
        return _busy_s() - before


@contextmanager
def without_guards() -> Iterator[None]:
    """No guard is at work within the block."""

    @contextmanager
    def started(
        command: Sequence[str], folder: Path, printed: Any, complaints: Any
    ) -> Iterator[subprocess.Popen[bytes]]:
        with subprocess.Popen(
            command, cwd=folder, env=sumo.environment(), stdin=subprocess.DEVNULL, stdout=printed, stderr=complaints
        ) as process:
            yield process

    def copied(path: Path, to: Path) -> list[str]:
        shutil.copyfile(path, to)
        return []

    with (
        patch.object(sumo, "_started", started),
        patch.object(copies, "copy", copied),
        patch.object(recording, "check_whole", lambda prepared: None),
        patch.object(workflow, "keep_inputs", lambda scenario, folder: None),
    ):
        yield


def _busy_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(its.ru_utime + its.ru_stime for its in used)


if __name__ == "__main__":
    every = ratios(int(sys.argv[1]) if len(sys.argv) > 1 else TURNS)
    least, median, most = min(every), statistics.median(every), max(every)
    print(f"guarded : without guards, {len(every)} turns: {least:.3f}, {median:.3f}, {most:.3f}")
