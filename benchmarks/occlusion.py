"""Cost and consequences of moving occlusion, and the error of assuming independent voxels.

``python -m benchmarks.occlusion SCENARIO RUN`` compares, for a finished run, the scores of each site without moving
occlusion, with recorded frames replayed, and with voxels that are assumed to be independent. Other effects of the
scenario stay on.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.stats import kendalltau

import egvs
from egvs.artefacts.tpog import read_tpog
from egvs.effects.moving_occlusion import read_replay
from egvs.runs.run_context import open_folder
from egvs.scenario.effects_config import EffectsConfig
from egvs.scenario.model import Scenario
from egvs.scoring.scorer import Scorer, ranks
from egvs.stages.site_scans import empty_scans

Compared = dict[str, Any]


@dataclass(frozen=True)
class Setting:
    """Results of one method: scores (sites,), seconds per site on one thread, and ignored boxes per site."""

    sites: list[str]
    egvs: NDArray[np.float64]
    seconds: float
    ignored: list[int]


def compare(scenario: Scenario, out: Path, *, frames: int = 500) -> Compared:
    """Score all sites of a run plainly, by frames, and by independent voxels.

    Parameters
    ----------
    frames
        Frames replayed; 0 for all.

    Returns
    -------
    dict
        ``rows``: a dict a site with ``site``, ``plain``, ``frames``, ``independent`` (scores, bits), ``rank_plain``,
        ``rank_frames``, ``rank_independent``, ``error`` (of ``independent`` against ``frames``, relative; None where
        only ``frames`` is 0), ``ignored`` (boxes that hold the sensor). ``tau``: Kendall's tau of the rankings, for
        ``plain`` and ``independent`` against ``frames`` and against each other; None where a ranking is all ties.
        ``seconds``: a site, for each way.
    """
    ways = {
        "plain": scored(scenario, out, None),
        "frames": scored(scenario, out, {"method": "frames", "frames": frames}),
        "independent": scored(scenario, out, {"method": "independent"}),
    }
    rank = {name: ranks(way.egvs) for name, way in ways.items()}
    rows = []
    for i, site in enumerate(ways["plain"].sites):
        row: Compared = {"site": site} | {name: float(way.egvs[i]) for name, way in ways.items()}
        row |= {f"rank_{name}": int(rank[name][i]) for name in ways}
        rows.append(row | {"error": _error(row["independent"], row["frames"]), "ignored": ways["frames"].ignored[i]})
    pairs = (("plain", "frames"), ("independent", "frames"), ("independent", "plain"))
    tau = {f"{a}, {b}": _tau(ways[a].egvs, ways[b].egvs) for a, b in pairs}
    return {"rows": rows, "tau": tau, "seconds": {name: way.seconds for name, way in ways.items()}}


def scored(scenario: Scenario, out: Path, parameters: dict[str, Any] | None) -> Setting:
    """Score all sites with parameters of ``[effects.moving_occlusion]`` (None: without), with compiled kernels."""
    others = scenario.effects.without("moving_occlusion").model_dump()
    effects = others if parameters is None else {**others, "moving_occlusion": parameters}
    work = open_folder(scenario.with_effects(EffectsConfig.from_dict(effects)), out)
    tpog, trajectories, scans = read_tpog(out / "tpog.parquet"), out / "trajectories.parquet", list(empty_scans(work))
    scorer = Scorer(work.scene, tpog, trajectories)
    scorer.score(scans[0].beams)
    start = time.perf_counter()
    egvs = [scorer.score(scan.beams).egvs for scan in scans]
    seconds = (time.perf_counter() - start) / len(scans)
    occlusion = work.scenario.effects.moving_occlusion
    ignored = [0] * len(scans)
    if occlusion is not None and occlusion.method == "frames":
        replay = read_replay(trajectories, tpog.grid, occlusion.frames)
        ignored = [
            replay.count_boxes_around(tpog.grid.to_grid_m(np.array(scan.site.pose.position_m))) for scan in scans
        ]
    return Setting([scan.site.name for scan in scans], np.array(egvs), seconds, ignored)


def _error(scans: float, true: float) -> float | None:
    """Return the relative error; 0 if both are 0, None if only the true value is 0."""
    if scans == true:
        return 0.0
    return (scans - true) / true if true else None


def _tau(a: NDArray[np.float64], b: NDArray[np.float64]) -> float | None:
    if len(np.unique(a)) < 2 or len(np.unique(b)) < 2:
        return None
    return float(kendalltau(a, b).statistic)


def show(compared: Compared, console: Console) -> None:
    """Print the result of :func:`compare`."""
    table = Table(
        "site",
        "plain",
        "frames",
        "frames/plain",
        "independent",
        "error",
        "ranks: plain, frames, independent",
        "ignored",
    )
    for row in compared["rows"]:
        plain, frames, independent = (f"{row[name]:.1f}" for name in ("plain", "frames", "independent"))
        ratio = row["frames"] / row["plain"] if row["plain"] else 1.0
        error = "" if row["error"] is None else f"{row['error']:+.1%}"
        order = f"{row['rank_plain']}, {row['rank_frames']}, {row['rank_independent']}"
        table.add_row(row["site"], plain, frames, f"{ratio:.3f}", independent, error, order, str(row["ignored"]))
    console.print(table)
    console.print(
        "Kendall's tau: " + "; ".join(f"{pair} {tau:.3f}" for pair, tau in compared["tau"].items() if tau is not None)
    )
    console.print(
        "seconds a site: " + "; ".join(f"{name} {seconds:.3f}" for name, seconds in compared["seconds"].items())
    )


def main() -> None:
    """Compare for 50, 500 and all frames."""
    scenario, out, console = egvs.load(sys.argv[1]), Path(sys.argv[2]), Console(width=132)
    for frames in (50, 500, 0):
        console.print(f"frames = {frames or 'all'}")
        show(compare(scenario, out, frames=frames), console)


if __name__ == "__main__":
    main()
