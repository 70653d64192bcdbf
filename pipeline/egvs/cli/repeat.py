"""Print the output of a command again, without repeating its work, where nothing has changed since.

See :mod:`egvs.runs.unchanged`.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from egvs.runs.unchanged import Output, RunMemory

if TYPE_CHECKING:
    from egvs.artefacts.run_record import RunRecord


@dataclass(frozen=True)
class FinishedRun:
    """A complete run, and what its command prints to standard error if it is repeated."""

    folder: Path
    record: RunRecord
    stderr: str


def print_or_run(arguments: Sequence[str], out: Path | None, run: Callable[[], FinishedRun]) -> None:
    """Print what a command printed before, if it would print the same again; else run it.

    Parameters
    ----------
    arguments
        The arguments of the command that its output depends on.
    out
        The run folder; None where it follows from the scenario.
    run
        Runs all stages and prints the results.
    """
    memory = RunMemory([*arguments, *_terminal_properties()], out)
    output = memory.recall()
    if output is not None:
        print(output.stderr, end="", file=sys.stderr, flush=True)
        print(output.stdout, end="")
        return

    with memory.observe(), _copy_stdout() as stdout:
        finished = run()
    digests: dict[str, str] = {}
    for stage in finished.record.stages.values():
        digests |= stage.artefacts | stage.companions
    if _is_recorded(finished):  # else another run has been in the folder since
        memory.save(finished.folder, digests, Output(stdout.getvalue(), finished.stderr))


def _is_recorded(finished: FinishedRun) -> bool:
    """Return whether the folder of a run still has its record."""
    from egvs.artefacts.run_record import RunRecord

    present = RunRecord.read(finished.folder)
    keys, present_keys = (
        {name: (stage.inputs, stage.artefacts) for name, stage in record.stages.items()}
        for record in (finished.record, present)
    )
    is_same_scenario = (present.scenario, present.overrides) == (finished.record.scenario, finished.record.overrides)
    return is_same_scenario and present_keys == keys


def _terminal_properties() -> list[str]:
    """Return what the form of printed tables depends on, besides environment variables."""
    properties = [str(sys.stdout.encoding)]
    for stream in (sys.stdin, sys.stdout, sys.stderr):
        properties.append(str(stream.isatty()))
        with suppress(OSError, ValueError):  # no terminal, or no file
            properties.append(str(os.get_terminal_size(stream.fileno())))
    return properties


@contextmanager
def _copy_stdout() -> Iterator[io.StringIO]:
    """Copy what is printed within the block."""
    copy = io.StringIO()
    with redirect_stdout(_Tee(sys.stdout, copy)):
        yield copy


class _Tee(io.TextIOBase):
    """A stream that also writes to a second one; in all else it is like the first one."""

    def __init__(self, stream: TextIO, copy: io.StringIO) -> None:
        self._stream = stream
        self._copy = copy

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """The encoding of the stream."""
        return self._stream.encoding

    def write(self, text: str) -> int:
        """Write to both streams."""
        self._copy.write(text)
        return self._stream.write(text)

    def flush(self) -> None:
        """Flush the stream."""
        self._stream.flush()

    def isatty(self) -> bool:
        """Return whether the stream is a terminal."""
        return self._stream.isatty()

    def fileno(self) -> int:
        """Return the descriptor of the stream."""
        return self._stream.fileno()
