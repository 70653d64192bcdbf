"""Processor time of commands that do no work, compared with the libraries that every command needs.

``python -m benchmarks.start_up`` runs the shipped roundabout once, then times ``egvs --help`` and the same run again,
in which nothing changed. Each is compared with importing the libraries that it needs. They are started in turns;
medians are printed. The bytecode of all modules is cached, as after installing.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

SCENARIO = Path(__file__).resolve().parent.parent / "scenarios" / "roundabout"
STARTS = 9

HELP, RUN = "egvs --help", "egvs run, all stages up to date"
LIBRARIES = {
    HELP: ("import typer.main, typer.rich_utils", 2.0),
    RUN: ("import typer.main, pydantic, pyarrow.parquet", 4.0),
}
"""For each command, the libraries that it needs, and how many times as long as their import it may take."""


def rows() -> list[tuple[str, str, str, bool]]:
    """Return the processor time of each command, its ratio to the import, the limit, and whether it is reached."""
    with tempfile.TemporaryDirectory() as folder:
        run = ["-m", "egvs", "run", str(SCENARIO), "--out", f"{folder}/run", "--set", "traffic.frames=100"]
        commands = {HELP: ["-m", "egvs", "--help"], RUN: run}
        processor_s(run)
        times_s: dict[str, list[float]] = defaultdict(list)
        for _ in range(STARTS):
            for what, command in commands.items():
                code = LIBRARIES[what][0]
                times_s[what].append(processor_s(command))
                times_s[code].append(processor_s(["-c", code]))
    result = []
    for what in commands:
        code, limit = LIBRARIES[what]
        took_s, imports_s = statistics.median(times_s[what]), statistics.median(times_s[code])
        ratio = took_s / imports_s
        measured = f"{took_s:.2f} s of processor time = {ratio:.2f} x its libraries"
        result.append((what, measured, f"{limit:.1f} x", ratio <= limit))
    return result


def processor_s(arguments: list[str]) -> float:
    """Return the processor time of Python in another process, seconds."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    before = os.times()
    subprocess.run(
        [sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment
    )
    after = os.times()
    return after.children_user - before.children_user + after.children_system - before.children_system


if __name__ == "__main__":
    for row in rows():
        print(*row, sep="   ")
