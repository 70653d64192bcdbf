"""How fast is it, measured against what it must reach?

``make bench`` runs everything here on the shipped junction and prints ratios from this one run: machines differ and are noisy,
ratios less so. Kernels are compiled before anything is timed; repeats of what is compared are interleaved; medians are shown.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import pipeline
from benchmarks import casting, others, stability
from pipeline import score, survey, tpog
from pipeline.entropy import Field
from pipeline.kernels import march
from pipeline.ordered import in_order
from pipeline.results import read_tpog
from pipeline.world import read_ply

ROOT = Path(__file__).resolve().parent.parent
SCENARIO = ROOT / "scenarios" / "nishishinjuku"
REPEATS = 7


def seconds(work: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Median wall time of a call that was made once before."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def egvs(*arguments: str) -> tuple[float, float]:
    """Wall seconds and peak memory in MB of the command line in a process of its own."""
    code = (
        "import resource, sys; from pipeline.cli import main\n"
        "try: main()\n"
        "finally: print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024, file=sys.stderr)"
    )
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True, cwd=ROOT)
    return time.perf_counter() - start, float(done.stderr.split()[-1])


def whole_run(folder: Path) -> tuple[list[tuple[str, str, str, bool]], float]:
    """The main job from nothing, and the yardstick: SUMO's own seconds."""
    egvs("run", str(SCENARIO), "--out", str(folder / "warm"), "--set", "traffic.frames=50", "--set", "traffic.warmup_s=50")
    took, peak = egvs("run", str(SCENARIO), "--out", str(folder / "run"))
    record = json.loads((folder / "run" / "run.json").read_text())
    sumo = record["stages"]["traffic"]["said"]["sumo_seconds"]
    helped = statistics.median(egvs("--help")[0] for _ in range(5))
    allowed = 2 * sumo + 3
    return [
        ("egvs run nishishinjuku, everything", f"{took:.2f} s = {took / allowed:.2f} x (2 x SUMO + 3 s)", "1 x", took <= allowed),
        ("  SUMO alone", f"{sumo:.2f} s", "", True),
        ("  peak memory of egvs", f"{peak:.0f} MB", "1024 MB", peak < 1024),
        ("egvs --help", f"{helped:.3f} s", "0.3 s", helped < 0.3),
    ], sumo


def occupancy(folder: Path, sumo: float) -> list[tuple[str, str, str, bool]]:
    """From trajectories.parquet to tpog.parquet."""
    scenario = pipeline.load(SCENARIO)
    took = seconds(lambda: tpog.run(scenario, folder / "run"))
    share = took / sumo
    return [("tpog, 5000 frames x 50 vehicles", f"{took:.3f} s = {share:.1%} of SUMO's time", "20 %", share < 0.20)]


def sites(folder: Path) -> list[tuple[str, str, str, bool]]:
    """Scan and score, site by site: from the static world and the TPOG in memory to a score."""
    scenario, run = pipeline.load(SCENARIO), folder / "run"
    world, _ = read_ply(run / "statics.ply")
    grid_of = read_tpog(run / "tpog.parquet")
    field = Field.of(grid_of.counts, grid_of.frames, grid_of.grid)
    surveyed = survey.Survey(scenario, world)
    scans = [surveyed.scan(site) for site in surveyed.sites]
    grid = field.grid
    shape, origin = np.asarray(grid.shape, dtype=np.int64), np.asarray(grid.origin_m)
    hits = np.zeros(int(np.prod(grid.shape)), dtype=np.uint32)

    def score_one(site: Any) -> float:
        mine = np.zeros_like(hits)
        found = surveyed.scan(site)
        score.count_hits(found.about, found.scan.ends_m, field, mine)
        return field.score(mine, 10.0).egvs

    def march_one(scan: Any) -> None:
        o = (np.asarray(scan.site.position_m) - origin) / grid.voxel_m
        march.count_hits(o, scan.scan.ends_m / grid.voxel_m, shape, grid.voxel_m, hits)

    one, marching = [], []
    for site, scan in zip(surveyed.sites, scans, strict=True):
        one.append(seconds(lambda site=site: score_one(site)))
        marching.append(seconds(lambda scan=scan: march_one(scan)))
    many = surveyed.sites * 4
    times: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(REPEATS):
        for threads, taken in times.items():
            start = time.perf_counter()
            list(in_order(score_one, many, threads))
            taken.append(time.perf_counter() - start)
    gain = statistics.median(a / b for a, b in zip(times[1], times[2], strict=True))
    whole, part = statistics.median(one), statistics.median(marching)
    return [
        ("scan + score of a site, one thread, median", f"{whole * 1e3:.1f} ms", "20 ms", whole < 0.020),
        ("  of which the march", f"{part * 1e3:.1f} ms", "13 ms", part < 0.013),
        ("  two threads against one", f"{gain:.2f} x", "1.7 x", gain >= 1.7),
    ]


def main() -> None:
    """Measure all, print one table."""
    table = Table(
        "what", "measured", "must reach", "reached", title=f"egvs {pipeline.__version__}, {os.cpu_count()} cores", box=None
    )
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        rows, sumo = whole_run(folder)
        rows += occupancy(folder, sumo) + sites(folder)
    for what, measured, bound, reached in rows:
        table.add_row(what, measured, bound, ("yes" if reached else "NO") if bound else "")
    console = Console(width=140, highlight=False)
    console.print(table)
    for title, measure in (
        ("what stability costs", stability.rows),
        ("what exact hits cost", casting.rows),
        ("what other ways cost, and how wrong they are", others.rows),
    ):
        console.print(f"\n{title}")
        for row in measure():
            console.print("  " + "   ".join(f"{value:.3f}" if isinstance(value, float) else str(value) for value in row))


if __name__ == "__main__":
    main()
