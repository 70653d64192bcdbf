"""Python in a process of its own, without the seconds that its imports would take: forked from one that has them.

The process that is forked has imported this program's stages and the libraries that they use, and nothing else: no
effect, no reader of a format, no test. So what a child imports beyond that is seen in its ``sys.modules``, and what is
installed beside the program is found as by any other process. A test of the imports themselves starts a new process.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from subprocess import CompletedProcess

EGVS = "from egvs.cli.app import main; main()"

CONTEXT = multiprocessing.get_context("forkserver")
_STAGES = ("check", "traffic", "statics", "scan", "tpog", "score")
CONTEXT.set_forkserver_preload(
    ["egvs.runs.run", "egvs.report.page", "egvs.cli.app", "egvs.cli.run_tables", "pandas",
     "scipy.special", "trimesh", *(f"egvs.stages.{name}" for name in _STAGES)]
)  # fmt: skip


class Started:
    """``code`` at work as ``python -c`` would run it, in the present folder, with ``beside`` first on its path."""

    def __init__(self, code: str, *arguments: object, beside: Path | None = None) -> None:
        self._words = [str(word) for word in arguments]
        self._kept = tempfile.TemporaryDirectory()
        self._printed = [Path(self._kept.name, name) for name in ("out", "err")]
        self.process = CONTEXT.Process(
            target=_work,
            args=(code, self._words, beside, Path.cwd(), dict(os.environ), self._printed),
        )
        self.process.start()

    def ended(self) -> CompletedProcess[str]:
        """Wait for its end: how it ended, and what it printed."""
        self.process.join()
        with self._kept:
            said = [path.read_text() for path in self._printed]
        return CompletedProcess(self._words, self.process.exitcode or 0, *said)


def python(code: str, *arguments: object, beside: Path | None = None) -> CompletedProcess[str]:
    """Run ``code`` to its end."""
    return Started(code, *arguments, beside=beside).ended()


def run_egvs(*arguments: object, beside: Path | None = None) -> CompletedProcess[str]:
    """The command line in a process of its own that finds what is installed in the folder ``beside``."""
    return python(EGVS, *arguments, beside=beside)


def _work(
    code: str, arguments: list[str], beside: Path | None, folder: Path, environment: Mapping[str, str],
    printed: list[Path],
) -> None:  # fmt: skip
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it in what it starts in the background
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    for number, path in enumerate(printed, 1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), number)
    sys.stdout, sys.stderr = (open(number, "w", encoding="utf-8", closefd=False) for number in (1, 2))  # noqa: SIM115
    if beside:
        sys.path.insert(0, str(beside))
    sys.argv = ["-c", *arguments]
    exec(compile(code, "<string>", "exec"), {"__name__": "__main__"})
