"""Runs the command line on many mutants in one process, which costs a tenth of a process for each.

A process is forked for each kind of file; it calls the command line again and again, with a limit of memory. A mutant
that ends the process, by a crash, by memory or by time, is a fault, and another process goes on behind it. What
``egvs check`` reads, too, is read by it instead of ``egvs run``.

Rankings are not compared; :mod:`tests.fuzz.cases` compares them.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path

from tests.fuzz import cases
from tests.fuzz.cases import Verdict
from tests.fuzz.kinds import Kind
from tests.fuzz.mutating import mutant

WELL = ("refused", "read")
MOST_BYTES = 1 << 30
"""What one mutant may add to the resident memory."""

MOST_SECONDS = 20.0
"""Of processor time for one mutant, without that of other processes."""


def judge_all(kind: Kind, folder: Path, seed: int, numbers: Sequence[int]) -> Iterator[tuple[int, Verdict]]:
    """Yield the verdict of each mutant of a kind, by its number."""
    base, case = folder / "base", folder / "case"
    base.mkdir(parents=True)
    kind.make(base)
    for arguments in kind.before:
        if (ended := cases.run(base, arguments)).code != 0:
            raise AssertionError(ended.err)
    left = list(numbers)
    while left:
        read_end, write_end = os.pipe()
        sys.stdout.flush()
        shutil.rmtree(case, ignore_errors=True)
        shutil.copytree(base, case)
        if not (child := os.fork()):
            os.close(read_end)
            _work(kind, case, seed, left, write_end)
        os.close(write_end)
        with os.fdopen(read_end, encoding="utf-8") as lines:
            for line in lines:
                number, *values = json.loads(line)
                assert number == left.pop(0)
                yield number, Verdict(*values)
        _, status = os.waitpid(child, 0)
        code = os.waitstatus_to_exitcode(status)
        if code != 0:
            name = "out of time" if code == -signal.SIGPROF else f"the process ended with {code}"
            yield left.pop(0), Verdict(name)


def _work(kind: Kind, folder: Path, seed: int, numbers: Sequence[int], write_end: int) -> None:
    """Judge mutants in this process, which was forked for them; never returns."""
    code = 70
    try:
        os.chdir(folder)
        (folder / ".tmp").mkdir(exist_ok=True)
        os.environ |= {"EGVS_STORE": "", "TMPDIR": str(folder / ".tmp"), "COLUMNS": "160"}
        tempfile.tempdir = None
        cases.limit_process()
        files = sorted(folder.glob(kind.file))
        sound = {file: file.read_bytes() for file in files}
        verb = ("check", *kind.verb[1:2]) if kind.checked else kind.verb
        existing = {path.name for path in folder.iterdir()}
        first, out, err = _call(verb)
        assert first == 0, (kind.name, first, out, err)
        with os.fdopen(write_end, "w", encoding="utf-8") as lines:
            for number in numbers:
                for path in folder.iterdir():
                    if path.name not in existing:
                        (shutil.rmtree if path.is_dir() else os.remove)(path)
                rng = random.Random(f"{seed}/{kind.name}/{number}")
                file = rng.choice(files)
                file.write_bytes(mutant(rng, sound[file]))
                verdict = _judge(kind, file, verb)
                file.write_bytes(sound[file])
                values = (number, verdict.name, verdict.told, verdict.peak_bytes, verdict.busy_s)
                lines.write(json.dumps(values) + "\n")
                lines.flush()
        code = 0
    except BaseException:  # noqa: BLE001 - nothing behind it may run in this process
        traceback.print_exc()
    finally:
        os._exit(code)


def _judge(kind: Kind, file: Path, verb: Sequence[str]) -> Verdict:
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak starts again
    before, begun = _resident_bytes("VmRSS"), time.process_time()
    signal.setitimer(signal.ITIMER_PROF, MOST_SECONDS)
    code, out, err = _call(verb)
    signal.setitimer(signal.ITIMER_PROF, 0)
    busy_s, peak_bytes = time.process_time() - begun, _resident_bytes("VmHWM") - before
    ended = cases.Ended(code, out, err, 0, busy_s)
    verdict = cases.fault_of(ended)
    if verdict is None and peak_bytes > MOST_BYTES:
        verdict = Verdict("memory", f"{peak_bytes / 2**30:.1f} GB")
    if verdict is None and code == 0:
        verdict = Verdict("read")
    if verdict is None and verb[0] == "check" and code == 1 and not err:  # what it finds, it prints
        verdict = cases.refused(kind, file, cases.Ended(2, out, err, 0, busy_s))
    if verdict is None:
        verdict = cases.refused(kind, file, ended)
    return Verdict(verdict.name, verdict.told, peak_bytes, busy_s)


def _call(arguments: Sequence[str]) -> tuple[int, str, str]:
    """Exit code of the command line, and what it printed."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    sys.argv = ["egvs", *arguments]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cases.command_line(arguments)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        except BaseException:  # noqa: BLE001 - whatever it is, it is a traceback that a user would have seen
            traceback.print_exc()
            code = 70
    return code, out.getvalue(), err.getvalue()


def _resident_bytes(key: str) -> int:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{key}:"))
