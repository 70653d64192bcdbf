"""Kernels compiled beside a run, in another process: only in the first run after installing.

Compiling takes longer than SUMO at a small junction, and a process compiles one kernel at a time. So if no kernel has
been compiled yet, another process compiles those of the stage that has most, while this one compiles those of the
stages before it. Both share the cache of compiled kernels (:mod:`egvs.kernels.kernel_cache`). The other process works
through the functions :attr:`egvs.stages.base.Stage.prepare` from the first to the last; when this one reaches the
stage, it begins with the last. If the other process fails, this one compiles all of them.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Collection

from egvs.core.threads import thread_count
from egvs.kernels import jit
from egvs.runs import stage_registry

STAGE = "score"
"""The stage with most kernels."""


class KernelCompiler:
    """Compiles the kernels of :data:`STAGE` in another process, which ends with the block."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._is_decided = False

    def __enter__(self) -> KernelCompiler:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def before(self, stage: str, next_stages: Collection[str]) -> None:
        """Start the other process if it is worthwhile, or share its work and wait for its end.

        Parameters
        ----------
        stage
            The stage that is about to run.
        next_stages
            The stages that will follow.
        """
        if stage == STAGE and self._process is not None:
            for prepare in reversed(stage_registry.stage(stage).prepare[1:]):
                prepare()
            self._process.wait()
        if STAGE in next_stages and not self._is_decided:
            self._is_decided = True
            if thread_count(None) > 1 and not jit.has_compiled_kernels():
                self._process = _start()


def _start() -> subprocess.Popen[bytes]:
    command = [sys.executable, "-P", "-m", "egvs.runs.kernel_compiler"]
    devnull = subprocess.DEVNULL
    return subprocess.Popen(command, stdin=devnull, stdout=devnull, stderr=devnull)


def main() -> None:
    """Compile the kernels of :data:`STAGE`."""
    for prepare in stage_registry.stage(STAGE).prepare:
        prepare()


if __name__ == "__main__":
    main()
