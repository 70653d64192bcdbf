"""What does moving occlusion cost and change, and how far off is the model of independent voxels?

``python -m benchmarks.occlusion SCENARIO RUN`` compares, on the artefacts of a finished run, the score of each site
without moving occlusion, with recorded frames replayed, and with voxels taken as independent. Other effects that the
scenario names stay on.
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
from egvs.scenario.effects_config import EffectsConfig
from egvs.scenario.model import Scenario
from egvs.scoring.scorer import Scorer, ranks
from egvs.stages.inputs import get_scene, open_folder
from egvs.stages.site_scans import empty_scans

Compared = dict[str, Any]


@dataclass(frozen=True)
class Setting:
    """One way to score: scores (sites,), seconds a site on one thread, and for a replay the boxes ignored at each
    site."""

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
    """Scores of all sites with ``[effects.moving_occlusion]`` as given (None: without); kernels are compiled
    beforehand."""
    others = scenario.effects.without("moving_occlusion").model_dump()
    wanted = others if parameters is None else {**others, "moving_occlusion": parameters}
    work = open_folder(scenario.with_effects(EffectsConfig.from_dict(wanted)), out)
    tpog, trajectories, found = read_tpog(out / "tpog.parquet"), out / "trajectories.parquet", list(empty_scans(work))
    scorer = Scorer(get_scene(work), tpog, trajectories)
    scorer.score(found[0].beams)
    start = time.perf_counter()
    egvs = [scorer.score(scan.beams).egvs for scan in found]
    took = (time.perf_counter() - start) / len(found)
    occlusion = work.scenario.effects.moving_occlusion
    ignored = [0] * len(found)
    if occlusion is not None and occlusion.method == "frames":
        replay = read_replay(trajectories, tpog.grid, occlusion.frames)
        ignored = [
            replay.count_boxes_around(tpog.grid.to_grid_m(np.array(scan.site.pose.position_m))) for scan in found
        ]
    return Setting([scan.site.name for scan in found], np.array(egvs), took, ignored)


def _error(found: float, true: float) -> float | None:
    """Relative error; 0 where both are 0, None where only the true value is."""
    if found == true:
        return 0.0
    return (found - true) / true if true else None


def _tau(a: NDArray[np.float64], b: NDArray[np.float64]) -> float | None:
    if len(np.unique(a)) < 2 or len(np.unique(b)) < 2:
        return None
    return float(kendalltau(a, b).statistic)


def show(compared: Compared, console: Console) -> None:
    """Print what :func:`compare` returns."""
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
        kept = row["frames"] / row["plain"] if row["plain"] else 1.0
        error = "" if row["error"] is None else f"{row['error']:+.1%}"
        order = f"{row['rank_plain']}, {row['rank_frames']}, {row['rank_independent']}"
        table.add_row(row["site"], plain, frames, f"{kept:.3f}", independent, error, order, str(row["ignored"]))
    console.print(table)
    console.print(
        "Kendall's tau: " + "; ".join(f"{pair} {tau:.3f}" for pair, tau in compared["tau"].items() if tau is not None)
    )
    console.print("seconds a site: " + "; ".join(f"{name} {took:.3f}" for name, took in compared["seconds"].items()))


def main() -> None:
    """Compare for 50, 500 and all frames."""
    scenario, out, console = egvs.load(sys.argv[1]), Path(sys.argv[2]), Console(width=132)
    for frames in (50, 500, 0):
        console.print(f"frames = {frames or 'all'}")
        show(compare(scenario, out, frames=frames), console)


if __name__ == "__main__":
    main()
