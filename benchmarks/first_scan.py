"""Processor time until the first scan of each kind of process, and of that scan.

``python -m benchmarks.first_scan --markdown docs/scaling.md`` runs the shipped roundabout once. Then it starts
processes with the modules of each command, which open the run and scan two sites, and writes the table between the
marks of the page. The first scan loads numba and the compiled kernels; the second shows what a scan takes by itself.

Kernels are compiled and bytecode is cached before anything is measured. The processes are started in turns, and the
shortest time of each counts, because other load makes processor times longer, never shorter. ``--earlier FOLDER`` also
measures another checkout of this repository.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.start_up import SCENARIO

ROOT = Path(__file__).resolve().parent.parent
MARKS = ("<!-- first scan -->", "<!-- end of first scan -->")
STARTS = 3

CODE = """
import json, sys, time
from importlib import import_module
from pathlib import Path
scenario, folder, modules, options = json.loads(sys.argv[1])
for module in modules:
    import_module(module)
import egvs
from egvs.sensors.scanner import Scanner
from egvs.runs.run_context import open_folder
scene = open_folder(egvs.load(scenario), Path(folder)).scene
marks_s = [time.process_time()]
if "numba" in options:
    import numba
    marks_s.append(time.process_time())
else:
    scanner = Scanner(scene, **options)
    for site in scene.sites[:2]:
        scanner.scan_site(site)
        marks_s.append(time.process_time())
print(json.dumps(marks_s))
"""
"""Prints the processor time since the start of the process: before the first scan, after it, and after the second."""


@dataclass(frozen=True)
class Process:
    """A kind of process: a name, the modules that it imports before it scans, and the options of its scanner."""

    name: str
    modules: tuple[str, ...]
    options: tuple[tuple[str, object], ...] = ()


PROCESSES = (
    Process("`egvs run`", ("egvs.runs.run", "egvs.stages.scan")),
    Process("`egvs place`", ("egvs.placement.plan", "egvs.placement.refinement")),
    Process("worker of `egvs city run`", ("egvs.extensions.city.tasks",)),
    Process(
        "`egvs validate`",
        ("egvs.extensions.validation.validation_run", "egvs.extensions.validation.detector_runs"),
        (("full_sweep", True),),
    ),
    Process("`egvs explore`", ("egvs.explore.session",), (("mounts", 1),)),
)
NUMBA = Process("numba", PROCESSES[0].modules, (("numba", True),))
"""Imports numba instead of scanning."""


@dataclass(frozen=True)
class Times:
    """Processor seconds until the first scan, of the first scan, and of the second."""

    start_s: float
    first_s: float
    second_s: float = 0.0


def measure(trees: Sequence[Path], starts: int = STARTS) -> list[dict[str, Times]]:
    """Return the shortest times of each kind of process, by its name, for each checkout of the repository."""
    with tempfile.TemporaryDirectory() as folder:
        runs: list[str] = []
        for tree in trees:
            runs.append(str(Path(folder) / f"run{len(runs)}"))
            _run_python(tree, ["-m", "egvs", "run", str(SCENARIO), "--out", runs[-1], "--set", "traffic.frames=100"])
        processes = (*PROCESSES, NUMBA)
        marks_s: dict[tuple[int, str], list[list[float]]] = {}
        for repeat in range(starts + 1):
            for number, tree in enumerate(trees):
                for process in processes:
                    arguments = json.dumps([str(SCENARIO), runs[number], process.modules, dict(process.options)])
                    marks = json.loads(_run_python(tree, ["-c", CODE, arguments]))
                    if repeat:  # the first turn compiles kernels and bytecode
                        marks_s.setdefault((number, process.name), []).append(marks)
    return [
        {process.name: _shortest(marks_s[number, process.name]) for process in processes}
        for number in range(len(trees))
    ]


def _shortest(marks_s: Sequence[Sequence[float]]) -> Times:
    """Return the shortest of each part."""
    parts = [(marks[0], *(after - before for before, after in itertools.pairwise(marks))) for marks in marks_s]
    return Times(*(min(values) for values in zip(*parts, strict=True)))


def _run_python(tree: Path, arguments: Sequence[str]) -> str:
    """Run Python with the package of a checkout; return what it prints."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPATH"] = str(tree / "pipeline")
    done = subprocess.run([sys.executable, *arguments], check=True, capture_output=True, text=True, env=environment)
    return done.stdout


def to_markdown(now: dict[str, Times], earlier: dict[str, Times] | None = None) -> str:
    """Return the table, and the time of importing numba; with the times of an earlier version where they are given."""
    headings = ["process", "start s", "first scan s", "second scan s"]
    if earlier is not None:
        headings += ["start s, earlier", "first scan s, earlier"]
    lines = [f"| {' | '.join(headings)} |", f"|---|{'---:|' * (len(headings) - 1)}"]
    for process in PROCESSES:
        times = now[process.name]
        cells = [times.start_s, times.first_s, times.second_s]
        if earlier is not None:
            cells += [earlier[process.name].start_s, earlier[process.name].first_s]
        lines.append(f"| {process.name} | {' | '.join(f'{cell:.2f}' for cell in cells)} |")
    return "\n".join([*lines, "", f"Importing numba takes {now[NUMBA.name].first_s:.2f} s of each first scan."])


def with_table(page: str, table: str) -> str:
    """Return a page with the table between the marks; ValueError where the page has no marks."""
    between = re.compile(f"(?<={MARKS[0]}\n).*(?={MARKS[1]})", re.DOTALL)
    if not between.search(page):
        raise ValueError(f"expected the lines {MARKS[0]} and {MARKS[1]} in the page")
    return between.sub(lambda _: f"{table}\n", page)


def main() -> None:
    """Measure, and print the table or write it into a page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--markdown", type=Path, help="a page with the marks of this table")
    parser.add_argument("--earlier", type=Path, help="another checkout of the repository, to compare with")
    options = parser.parse_args()
    trees = [ROOT] if options.earlier is None else [ROOT, options.earlier]
    table = to_markdown(*measure(trees))
    print(table)
    if options.markdown is not None:
        page = with_table(options.markdown.read_text(encoding="utf-8"), table)
        options.markdown.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
