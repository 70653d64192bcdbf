"""One long simulation, or several short ones? Time, true error and stated error of both, at some junctions.

``python -m benchmarks.simulations SCENARIO... [--repeats N] [--seeds N] [--to FILE.csv]`` runs each scenario N times
with its frames from one simulation and N times with the same frames from several (``traffic.seeds``), each time with
other seeds. The truth is the mean of all these runs. Runs that exist in the store are not repeated; their times are
those of the run that made them.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

import egvs
from egvs.artefacts.readers import read_scores
from egvs.core.grid import FloatArray
from egvs.runs.stage_registry import RANKING_STAGES

SCORES = ("expected_detections", "egvs")
BLOCKS = 10
"""Blocks of a run, or the next lower multiple of the number of simulations."""


@dataclass(frozen=True)
class Row:
    """Several runs of one junction with as many simulations each.

    Attributes
    ----------
    scenario, simulations
        The junction, and the number of simulations of a run.
    traffic_s
        Median wall seconds of the traffic stage.
    found_rmse, egvs_rmse
        Root mean square, over runs and sites, of the difference from the truth: percentage points, and per cent of the
        truth.
    found_stated, egvs_stated
        The same of the stated standard errors.
    choice_loss
        Mean loss from choosing the site that the run ranks first, in percentage points of vehicles found.
    """

    scenario: str
    simulations: int
    traffic_s: float
    found_rmse: float
    found_stated: float
    egvs_rmse: float
    egvs_stated: float
    choice_loss: float


def run_once(scenario: Path, simulations: int, seed: int, folder: Path, jobs: int) -> tuple[FloatArray, float]:
    """Run a scenario; return scores with standard errors (2, 2, sites) by name of the site, and traffic seconds."""
    blocks = simulations * (BLOCKS // simulations)
    settings = [f"seed={seed}", f"traffic.seeds={simulations}", f"tpog.blocks={blocks}"]
    settings.append("score.rank_by='expected_detections'")
    record = egvs.run(egvs.load(scenario, settings), folder, jobs=jobs, only=("check", *RANKING_STAGES))
    table = read_scores(folder / "scores.parquet").sort_by("site")
    columns = [[name, f"{name}_se"] for name in SCORES]
    values = np.array([[table.column(name).to_numpy() for name in pair] for pair in columns])
    return values, record.stages["traffic"].cost.seconds


def compare(scenario: Path, several: int, repeats: int, jobs: int, folder: Path) -> list[Row]:
    """Run a junction with one and with several simulations; return a row for each."""
    runs: dict[int, list[tuple[FloatArray, float]]] = {}
    for number, simulations in enumerate((1, several)):
        seeds = range(1000 * (number + 1), 1000 * (number + 1) + repeats)
        runs[simulations] = [run_once(scenario, simulations, seed, folder / "run", jobs) for seed in seeds]
    truth = np.mean([values[:, 0] for made in runs.values() for values, _ in made], axis=0)
    unit = np.array([np.full(truth.shape[1], 0.01), 0.01 * truth[1]])
    rows = []
    for simulations, made in runs.items():
        values = np.array([values for values, _ in made])
        errors = np.sqrt((((values[:, :, 0] - truth) / unit) ** 2).mean(axis=(0, 2)))
        stated = np.sqrt(((values[:, :, 1] / unit) ** 2).mean(axis=(0, 2)))
        chosen = truth[0][values[:, 0, 0].argmax(axis=1)]
        loss = 100.0 * float((truth[0].max() - chosen).mean())
        seconds = float(np.median([seconds for _, seconds in made]))
        measured = (errors[0], stated[0], errors[1], stated[1], loss)
        rows.append(Row(scenario.name, simulations, round(seconds, 1), *(round(float(value), 2) for value in measured)))
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Run all, and print a row as soon as it is there."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.simulations", description=__doc__.split("\n")[0])
    parser.add_argument("scenarios", type=Path, nargs="+")
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--jobs", type=int, default=2, help="simulations at a time")
    parser.add_argument("--to", type=Path, metavar="FILE.csv")
    options = parser.parse_args(arguments)
    names = [field.name for field in fields(Row)]
    print(*names, sep="\t")
    rows = []
    for scenario in options.scenarios:
        with tempfile.TemporaryDirectory() as folder:
            new = compare(scenario, options.seeds, options.repeats, options.jobs, Path(folder))
        rows += new
        for row in new:
            print(*asdict(row).values(), sep="\t", flush=True)
        if options.to is not None:
            with options.to.open("w", encoding="utf-8", newline="") as file:
                writer = csv.DictWriter(file, names, lineterminator="\n")
                writer.writeheader()
                writer.writerows(asdict(row) for row in rows)


if __name__ == "__main__":
    main()
