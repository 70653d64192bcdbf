"""Benchmarks with limits: how fast the program is, compared with what it must reach.

``make bench`` runs all of them on the shipped junction and prints one table; ``make bench BENCH="--json FILE"`` also
writes the results, with machine and commit (:mod:`benchmarks.records`). Kernels are compiled before anything is
timed; what is compared is measured in turns; medians are printed. Machines differ and are noisy, but ratios less so.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import egvs
from benchmarks import (
    alternatives,
    casting,
    clouds,
    culling,
    detection,
    effects,
    file_checks,
    first_run,
    site_costs,
    stability,
    start_up,
)
from benchmarks.losses import OFF
from benchmarks.records import LIMITS_TABLE, Record, limit_results, table_results
from benchmarks.scenes import run_stage
from egvs.artefacts.tpog import read_tpog
from egvs.core.errors import EgvsError
from egvs.core.files import check_writable
from egvs.core.threads import map_ordered
from egvs.kernels import traversal
from egvs.scoring.scorer import Scorer
from egvs.scoring.visibility import Beams, HitCounter, to_voxel_units
from egvs.sensors.scanner import Scanner
from egvs.sensors.sites import Site
from egvs.stages import scene_inputs, tpog
from egvs.world.mesh import read_ply

ROOT = Path(__file__).resolve().parent.parent
SCENARIO = ROOT / "scenarios" / "nishishinjuku"
REPEATS = 7
MOST_BESIDE_SUMO_S = 2.5
"""What a run of all stages may take beside the simulation."""


def seconds(work: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Return the median wall time of a call, after one call that is not counted."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def once(work: Callable[[], Any]) -> float:
    """Return the wall time of one call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def every(work: Callable[[Site], object], sites: Iterable[Site], threads: int = 1) -> None:
    """Call a function for every site."""
    for _ in map_ordered(work, sites, threads):
        pass


def run_egvs(*arguments: str) -> tuple[float, float]:
    """Run the command line in another process; return wall seconds and peak memory in MB."""
    code = (
        "import resource, sys; from egvs.cli.app import main\n"
        "try: main()\n"
        "finally: print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024, file=sys.stderr)"
    )
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        env=os.environ | {"EGVS_STORE": ""},  # nothing may come from the cache
    )
    return time.perf_counter() - start, float(done.stderr.split()[-1])


def time_run(folder: Path) -> tuple[list[tuple[str, str, str, bool]], float]:
    """Time a complete run without cached results; also return SUMO's own seconds for comparison."""
    run_egvs(
        "run",
        str(SCENARIO),
        "--out",
        str(folder / "warm"),
        "--set",
        "traffic.frames=50",
        "--set",
        "traffic.warmup_s=50",
    )
    took, peak = run_egvs("run", str(SCENARIO), "--out", str(folder / "run"))
    record = json.loads((folder / "run" / "run.json").read_text())
    sumo = record["stages"]["traffic"]["summary"]["sumo_seconds"]
    help_s = statistics.median(run_egvs("--help")[0] for _ in range(5))
    beside_s = took - sumo
    return [
        (
            "egvs run nishishinjuku, all stages",
            f"{took:.2f} s = SUMO + {beside_s:.2f} s",
            f"SUMO + {MOST_BESIDE_SUMO_S} s",
            beside_s <= MOST_BESIDE_SUMO_S,
        ),
        ("  SUMO alone", f"{sumo:.2f} s", "", True),
        ("  peak memory of egvs", f"{peak:.0f} MB", "1024 MB", peak < 1024),
        ("egvs --help", f"{help_s:.3f} s", "0.3 s", help_s < 0.3),
    ], sumo


def occupancy(folder: Path, sumo: float) -> list[tuple[str, str, str, bool]]:
    """Time the stage tpog: from trajectories.parquet to tpog.parquet."""
    scenario = egvs.load(SCENARIO)
    took = seconds(lambda: run_stage(tpog, scenario, folder / "run"))
    share = took / sumo
    return [("tpog, 5000 frames x 50 vehicles", f"{took:.3f} s = {share:.1%} of SUMO's time", "20 %", share < 0.20)]


def sites(folder: Path) -> list[tuple[str, str, str, bool]]:
    """Time scan and score of single sites: from static world and TPOG in memory to a score."""
    scenario, run = egvs.load(SCENARIO, [OFF]), folder / "run"
    scene = scene_inputs.resolve_scene(scenario, read_ply(run / "statics.ply")[0])
    occupancy_grid = read_tpog(run / "tpog.parquet")
    scanner, scorer, visibility = Scanner(scene), Scorer(scene, occupancy_grid), HitCounter(scene, occupancy_grid)
    beams = {site: Beams.of(scanner.scan_site(site)) for site in scene.sites}
    hits = np.zeros(int(np.prod(occupancy_grid.grid.shape)), dtype=np.uint32)

    def score_one(site: Site) -> float:
        return scorer.score(scanner.scan_site(site)).egvs

    def traverse_one(site: Site) -> None:
        o, d, shape = to_voxel_units(beams[site], occupancy_grid.grid)
        hits.fill(0)
        traversal.count_hits(o, d, shape, occupancy_grid.grid.voxel_m, hits)

    site_s = statistics.median(seconds(partial(score_one, site)) for site in scene.sites)
    traversal_s = statistics.median(seconds(partial(traverse_one, site)) for site in scene.sites)
    times: dict[str, list[float]] = {"1": [], "2": [], "bare": [], "plain": []}
    for _ in range(REPEATS):
        for threads in (1, 2):
            times[str(threads)].append(once(partial(every, score_one, scene.sites * 4, threads)))
        times["bare"].append(once(partial(every, traverse_one, scene.sites)))
        times["plain"].append(once(partial(every, lambda site: visibility.borrowed_hits(beams[site]), scene.sites)))
    gain = statistics.median(a / b for a, b in zip(times["1"], times["2"], strict=True))
    extra = statistics.median(a / b for a, b in zip(times["plain"], times["bare"], strict=True))
    return [
        ("scan + score of a site, one thread, median", f"{site_s * 1e3:.1f} ms", "20 ms", site_s < 0.020),
        ("  of which the traversal", f"{traversal_s * 1e3:.1f} ms", "13 ms", traversal_s < 0.013),
        ("  two threads against one", f"{gain:.2f} x", "1.7 x", gain >= 1.7),
        ("  scene without effects, compared with the bare traversal", f"{extra:.3f} x", "1.03 x", extra <= 1.03),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run all benchmarks, print the tables, and write them on request; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__.split("\n")[0])
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the results, with machine and commit")
    options = parser.parse_args(arguments)
    try:
        if options.json is not None:
            check_writable(options.json)  # before the minutes that the benchmarks take
        rows = measure_limits()
        print_limits(rows)
        tables = {title: print_table(title, measure()) for title, measure in FURTHER_TABLES.items()}
        if options.json is not None:
            Record.of([*limit_results(rows), *table_results(tables)]).write(options.json)
    except EgvsError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def measure_limits() -> list[tuple[str, str, str, bool]]:
    """Run all benchmarks that have limits; return what, measured value, limit, and whether it is reached."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        rows, sumo = time_run(folder)
        rows += occupancy(folder, sumo) + sites(folder) + effects.rows(folder / "run") + detection.rows()
        return rows + clouds.rows(SCENARIO, folder / "run") + start_up.rows() + first_run.rows()


def print_limits(rows: Iterable[tuple[str, str, str, bool]]) -> None:
    """Print the table of benchmarks that have limits."""
    title = f"egvs {egvs.__version__}, {os.cpu_count()} cores: {LIMITS_TABLE}"
    table = Table("what", "measured", "must reach", "reached", title=title, box=None)
    for what, measured, bound, reached in rows:
        table.add_row(what, measured, bound, ("yes" if reached else "NO") if bound else "")
    Console(width=140, highlight=False).print(table)


def print_table(title: str, rows: Sequence[tuple[Any, ...]]) -> Sequence[tuple[Any, ...]]:
    """Print a table without limits, and return its rows."""
    console = Console(width=140, highlight=False)
    console.print(f"\n{title}")
    for row in rows:
        console.print("  " + "   ".join(f"{value:.3f}" if isinstance(value, float) else str(value) for value in row))
    return rows


FURTHER_TABLES: dict[str, Callable[[], Sequence[tuple[Any, ...]]]] = {
    "cost of scores and of measuring detection, processor time per site": site_costs.rows,
    "cost of stable decisions": stability.rows,
    "cost of exact hits": casting.rows,
    "savings by culling triangles and beams that cannot meet": culling.rows,
    "cost of checking files": file_checks.rows,
    "cost and errors of alternative methods": alternatives.rows,
}
"""Title to the function that measures the rows; the first cell is a name."""


if __name__ == "__main__":
    sys.exit(main())
