"""Processor time of every command: cold, warm, and up to date.

``python -m benchmarks.verbs --csv docs/data/command_times.csv`` measures the commands of :data:`VERBS` on the shipped
roundabout with few frames, or on a small OpenStreetMap extract, and writes the table, which docs/scaling.md shows.
With names of commands, it measures those and replaces their rows; the other rows stay.

- *cold*: no kernel is compiled, and the store is empty
- *warm*: the kernels are compiled, and the store is empty
- *up to date*: the same command again in the same folder, for commands that keep their results

Each command runs in a fresh copy of a folder with what it needs, for example a finished run. Seconds are processor
time of the process and of those that it started. A command that was not measured has an empty row, for example because
its libraries are not installed.
"""

from __future__ import annotations

import argparse
import csv
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tests.extensions.hardware.installation.simulated_scan import simulate_scan

from benchmarks.simulated_sweeps import Truth, simulate_sweep
from egvs.extensions.hardware.installation.planned_sites import PlannedSites
from egvs.formats import point_clouds
from egvs.sensors.sensor import CATALOGUE

ROOT = Path(__file__).resolve().parent.parent
SCENARIO = ROOT / "scenarios" / "roundabout"
EXTRACT = ROOT / "tests" / "creation" / "data" / "small.osm"
HEADINGS = ("command", "cold s", "warm s", "up to date s")

REPEATS = 3
"""A quick command is measured so often, and the median counts."""

QUICK_S = 2.0

SHORT = """extends = "../roundabout"

[traffic]
frames = 200

[what_if.works]
share = 0.2
boxes = [{x_m = 22, y_m = 20, length_m = 6, width_m = 2.5, height_m = 2.6}]
"""
"""The scenario of most commands."""


@dataclass(frozen=True)
class Verb:
    """A command that is measured.

    Attributes
    ----------
    command_line
        What follows ``egvs``.
    saves_results
        Whether it saves results that the same command uses again.
    is_server
        Whether it serves a page; it is stopped as soon as it prints the address.
    """

    command_line: str
    saves_results: bool = False
    is_server: bool = False

    @property
    def arguments(self) -> list[str]:
        """The arguments of ``egvs``."""
        return self.command_line.split()

    @property
    def name(self) -> str:
        """The name of the command, without its arguments."""
        return " ".join(self.arguments[: 2 if self.arguments[0] == "city" else 1])


ACCEPTED_SITE, SCAN = "kerb_NW", "scan.pcd"
"""The site of ``egvs accept``, and a simulated scan of its sensor."""

VERBS = (
    Verb("new imported --from small.osm"),
    Verb("demo example"),
    Verb("check short"),
    Verb("run short --out new", saves_results=True),
    Verb("place short --out run --count 2", saves_results=True),
    Verb("explore run --no-browser --port 0", saves_results=True, is_server=True),
    Verb("desk . --no-browser --port 0", is_server=True),
    Verb("compare run other"),
    Verb("what-if short", saves_results=True),
    Verb("city new town --from small.osm --junctions all"),
    Verb("city traffic city", saves_results=True),
    Verb("city run city --out new --cluster processes=1", saves_results=True),
    Verb("city place city --out city_run --count 2 --cluster processes=1", saves_results=True),
    Verb("city compare city_run city_other"),
    Verb("validate short --out run --frames 20 --detector points", saves_results=True),
    Verb("accuracy short --out run --budget 20s", saves_results=True),
    Verb("effects short --out run"),
    Verb("scores"),
    Verb("clouds short --out clouds --frames 20"),
    Verb("train short --out model.onnx --steps 10 --frames 10"),
    Verb("traffic short --out run"),
    Verb("statics short --out run"),
    Verb("tpog short --out run"),
    Verb("scan short --out run"),
    Verb("score short --out run"),
    Verb("report short --out run"),
    Verb("sheets run"),
    Verb(f"accept run --site {ACCEPTED_SITE} --scan {SCAN}"),
    Verb("runs ."),
    Verb("export run --to geojson"),
    Verb("figure run --what ranking"),
    Verb("sensors"),
    Verb("sensor fit sweep.npz --name mast"),
    Verb("verify run"),
    Verb("store"),
)

PREPARATION = {
    "run": "run short --out run",
    "other": "run short --out other --set score.gamma=5",
    "city": "city new city --from small.osm --junctions all",
    "city_run": "city place city --out city_run --count 2 --cluster processes=1",
    "city_other": "city place city --out city_other --count 2 --cluster processes=1 --set score.gamma=5",
}
"""Folders that commands read, and the commands that make them, in order."""


class MissingLibraryError(Exception):
    """A command needs libraries that are not installed."""


class CommandError(Exception):
    """A command ended with an error."""


@dataclass(frozen=True)
class Caches:
    """Where a command finds results of earlier runs, and compiled kernels; by default, those of the package."""

    store: Path
    kernels: Path | None = None

    def environment(self) -> dict[str, str]:
        """Return the environment variables of the command; bytecode is written, as after installing."""
        variables = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        variables["EGVS_STORE"] = str(self.store)
        if self.kernels is not None:
            variables["NUMBA_CACHE_DIR"] = str(self.kernels)
        return variables


def processor_s(verb: Verb, folder: Path, caches: Caches) -> float:
    """Run a command in a folder; return the processor time of its process and of those that it started, seconds.

    Raises
    ------
    MissingLibraryError
        When a library of an extra is missing.
    CommandError
        When the command fails.
    """
    command = [sys.executable, "-m", "egvs", *verb.arguments]
    with tempfile.TemporaryFile("w+", encoding="utf-8") as errors:
        process = subprocess.Popen(
            command, cwd=folder, env=caches.environment(), stdout=subprocess.PIPE, stderr=errors, text=True
        )
        assert process.stdout is not None
        for line in process.stdout:
            if verb.is_server and line.startswith("http"):
                process.send_signal(signal.SIGINT)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        process.stdout.close()
        errors.seek(0)
        message = errors.read()
    if "Run pip install" in message:
        raise MissingLibraryError(message.strip())
    if process.returncode:
        raise CommandError(f"egvs {verb.command_line}: exit code {process.returncode}\n{message}")
    return usage.ru_utime + usage.ru_stime


def prepare(folder: Path, store: Path, verbs: Iterable[Verb]) -> None:
    """Make a folder with everything that some commands need."""
    folder.mkdir()
    shutil.copytree(SCENARIO, folder / SCENARIO.name)
    shutil.copy(EXTRACT, folder)
    sweep = simulate_sweep(CATALOGUE["VLP-32C"], Truth(), np.random.default_rng(0))
    np.savez(folder / "sweep.npz", sweep=sweep.astype(np.float32))
    (folder / "short").mkdir()
    (folder / "short" / "scenario.toml").write_text(SHORT, encoding="utf-8")
    needed = {argument for verb in verbs for argument in verb.arguments}
    if needed & {"city_run", "city_other"}:
        needed.add("city")
    for name, command_line in PREPARATION.items():
        if name in needed:
            processor_s(Verb(command_line), folder, Caches(store))
    if SCAN in needed:
        planned = PlannedSites.open(folder / "run")
        site = planned.site(ACCEPTED_SITE)
        scan = simulate_scan(planned.session.scene, planned.sensor(site), site.pose, site.pose)
        point_clouds.write_points(folder / SCAN, scan)


@dataclass(frozen=True)
class Row:
    """Processor time of a command, seconds; None where it has no such time."""

    verb: Verb
    cold_s: float
    warm_s: float
    up_to_date_s: float | None

    def cells(self) -> list[str]:
        """Return the row as text."""
        up_to_date = "-" if self.up_to_date_s is None else f"{self.up_to_date_s:.2f}"
        return [f"egvs {self.verb.command_line}", f"{self.cold_s:.2f}", f"{self.warm_s:.2f}", up_to_date]


def measure(verb: Verb, prepared: Path, work: Path) -> Row:
    """Measure a command in copies of the prepared folder."""
    work.mkdir()
    caches = [Caches(work / f"store{number}", work / "kernels") for number in range(1 + REPEATS)]
    cold_s = processor_s(verb, _copy(prepared, work / "cold"), caches[0])

    warm_s: list[float] = []
    for number in range(1, 1 + REPEATS):
        folder = _copy(prepared, work / f"warm{number}")
        warm_s.append(processor_s(verb, folder, caches[number]))
        if warm_s[-1] > QUICK_S:
            break

    up_to_date_s = None
    if verb.saves_results:
        times_s = [processor_s(verb, folder, caches[number])]
        while times_s[-1] <= QUICK_S and len(times_s) < REPEATS:
            times_s.append(processor_s(verb, folder, caches[number]))
        up_to_date_s = statistics.median(times_s)
    return Row(verb, cold_s, statistics.median(warm_s), up_to_date_s)


def _copy(folder: Path, to: Path) -> Path:
    return Path(shutil.copytree(folder, to, symlinks=True))


def update_table(path: Path, measured: Iterable[Row]) -> None:
    """Replace the rows of measured commands in a table, which has a row for each of :data:`VERBS`, in this order."""
    old: list[list[str]] = []
    if path.exists():
        with path.open(encoding="utf-8", newline="") as file:
            old = list(csv.reader(file))[1:]
    rows = {row[0]: row for row in [*old, *(row.cells() for row in measured)]}
    commands = [f"egvs {verb.command_line}" for verb in VERBS]
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(
            [HEADINGS, *(rows.get(command, [command, "", "", ""]) for command in commands)]
        )


def main(arguments: list[str] | None = None) -> None:
    """Measure the commands, and print or write the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.verbs", description=__doc__)
    parser.add_argument(
        "verbs", nargs="*", metavar="VERB", help='names of commands, for example "city run"; all if none'
    )
    parser.add_argument("--csv", type=Path, metavar="FILE", help="replace the rows of these commands in this table")
    chosen = parser.parse_args(arguments)
    known = [verb.name for verb in VERBS]
    unknown = set(chosen.verbs) - set(known)
    if unknown:
        parser.error(f"expected names of commands ({', '.join(known)}), got {', '.join(sorted(unknown))}")

    measured = [verb for verb in VERBS if not chosen.verbs or verb.name in chosen.verbs]
    rows = []
    left_out = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare(folder / "prepared", folder / "store", measured)
        for number, verb in enumerate(measured):
            try:
                rows.append(measure(verb, folder / "prepared", folder / str(number)))
            except MissingLibraryError:
                left_out.append(verb.name)
                continue
            print(*rows[-1].cells(), sep="   ", flush=True)
            shutil.rmtree(folder / str(number))
            if chosen.csv is not None:
                update_table(chosen.csv, rows[-1:])
    if left_out:
        print(f"left out: {', '.join(left_out)}")


if __name__ == "__main__":
    main()
