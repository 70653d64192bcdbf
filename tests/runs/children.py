"""Runs in processes of their own, forked from one that has imported everything, that can be killed at a chosen step.

A step is something that a run does to the files of its folder or of the store: it opens one to write, renames, links,
copies, removes or makes one. So a kill falls on a moment of the work, whatever the clock says.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.processes import CONTEXT

_STEPS = ("open", "os.rename", "os.link", "os.remove", "os.mkdir", "os.rmdir", "shutil.copyfile")


@dataclass
class Job:
    """One run of a scenario."""

    scenario: Path
    out: Path
    store: Path
    sets: Sequence[str] = ()
    kill_at: int | None = None
    steps: int = 0
    states: dict[str, str] = field(default_factory=dict)
    exit_code: int | None = None


class Child:
    """A running :class:`Job`; ``waits`` is set when it has to wait for another run."""

    def __init__(self, job: Job) -> None:
        self.job, self.waits = job, CONTEXT.Event()
        self._answer, sender = CONTEXT.Pipe(duplex=False)
        self.process = CONTEXT.Process(target=_work, args=(job, sender, self.waits))
        self.process.start()
        sender.close()

    def join(self) -> Job:
        """Wait for its end; the job with what came of it."""
        with suppress(EOFError):  # killed
            self.job.steps, self.job.states = self._answer.recv()
        self.process.join()
        self.job.exit_code = self.process.exitcode
        return self.job


def run(job: Job) -> Job:
    """Run a job to its end, or to its kill."""
    return Child(job).join()


def _work(job: Job, answer: Any, waits: Any) -> None:
    os.setpgid(0, 0)  # SUMO is killed too
    os.environ["EGVS_STORE"] = str(job.store)
    import egvs

    steps, states = 0, {}
    watched = (f"{job.out}{os.sep}", f"{job.store}{os.sep}")

    def step(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal steps
        if event not in _STEPS or (event == "open" and not _writes(arguments)):
            return
        if any(isinstance(a, str | Path) and str(a).startswith(watched) for a in arguments):
            steps += 1
            if steps == job.kill_at:
                os.killpg(0, signal.SIGKILL)

    def progress(what: str, _done: int, _total: int) -> None:
        if what.startswith("waits"):
            waits.set()

    sys.addaudithook(step)
    egvs.run(
        egvs.load(job.scenario, job.sets), job.out, jobs=1, progress=progress,
        listener=lambda stage, state, _: states.__setitem__(stage, state),
    )  # fmt: skip
    answer.send((steps, states))


def _writes(arguments: tuple[Any, ...]) -> bool:
    _, mode, flags = arguments
    return bool(flags & (os.O_WRONLY | os.O_RDWR)) or (isinstance(mode, str) and mode[0] in "wxa")
