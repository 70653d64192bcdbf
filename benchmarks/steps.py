"""Check whether the length of SUMO's step biases the scores.

``python -m benchmarks.steps [SEEDS]`` runs the shipped junction with each step and several seeds (16), with 5000 frames
1 s apart, and compares each site's mean share of the limit with that at 0.25 s. Runs are independent: t is the
difference divided by its standard error. Seconds are those of the traffic stage, as shares of those at 0.25 s. Takes
about ten minutes on two cores.
"""

from __future__ import annotations

import os
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from egvs.artefacts import parquet
from egvs.core.progress import no_progress
from egvs.core.threads import thread_count
from egvs.runs.stage_keys import stage_key
from egvs.runs.stage_registry import RANKING_STAGES
from egvs.studies.measurement import SettingRunner
from egvs.studies.study_settings import Setting

SCENARIO = Path(__file__).resolve().parent.parent / "scenarios" / "nishishinjuku"
TRAFFIC = ("traffic.frames=5000", "traffic.frame_period_s=1.0")
STEPS_S, REFERENCE_S, FIRST_SEED, SEEDS = (0.1, 0.25, 0.5, 1.0), 0.25, 100, 16


def trial(step_s: float, seed: int) -> tuple[list[str], list[float], float]:
    """Return sites, their shares of the limit, and seconds of the traffic stage, of one run."""
    os.environ["EGVS_STORE"] = ""  # nothing may come from the cache
    with tempfile.TemporaryDirectory() as folder:
        runner = SettingRunner(SCENARIO, TRAFFIC, Path(folder), 1, no_progress)
        setting = Setting("run", "seed", "seed", (f"seed={seed}", f"traffic.step_s={step_s}"))
        with runner.open_run(setting, RANKING_STAGES) as work:
            key = stage_key("traffic", work).key
            scores = parquet.read_artefact(work.folder.scores, "scores")[0].to_pydict()
            traffic_s = runner.stage_times("traffic", key).seconds[0]
    shares = np.array(scores["egvs"]) / np.array(scores["egvs_limit"])
    return scores["site"], shares.tolist(), traffic_s


def change(shares: Any, reference: Any) -> tuple[Any, Any]:
    """Return relative change of the mean over runs, and t, of each site; shares are (runs, sites)."""
    mean = reference.mean(axis=0)
    error = np.sqrt((shares.var(axis=0, ddof=1) + reference.var(axis=0, ddof=1)) / len(shares)) / mean
    relative = shares.mean(axis=0) / mean - 1.0
    return relative, np.divide(relative, error, out=np.zeros_like(relative), where=error > 0)


def main() -> None:
    """Run, and print a table."""
    seeds = range(FIRST_SEED, FIRST_SEED + int(sys.argv[1] if len(sys.argv) > 1 else SEEDS))
    with ProcessPoolExecutor(thread_count(None), mp_context=get_context("spawn")) as pool:
        futures = {(step, seed): pool.submit(trial, step, seed) for seed in seeds for step in STEPS_S}
        scores = {key: future.result() for key, future in futures.items()}
    sites = scores[STEPS_S[0], FIRST_SEED][0]
    shares = {step: np.array([scores[step, seed][1] for seed in seeds]) for step in STEPS_S}
    seconds = {step: float(np.median([scores[step, seed][2] for seed in seeds])) for step in STEPS_S}
    print(f"{len(seeds)} seeds; standard deviation between them {_span(100 * _scatter(shares[REFERENCE_S]))} %")
    print("step s | seconds, share of 0.25 s | largest change % | at site | t | mean change %")
    for step in STEPS_S:
        relative, t = change(shares[step], shares[REFERENCE_S])
        worst = int(np.abs(relative).argmax())
        ratio = seconds[step] / seconds[REFERENCE_S]
        print(
            f"{step} | {ratio:.2f} | {100 * relative[worst]:+.1f} | {sites[worst]} | {t[worst]:+.1f}"
            f" | {100 * relative.mean():+.1f}"
        )


def _scatter(shares: Any) -> Any:
    return shares.std(axis=0, ddof=1) / shares.mean(axis=0)


def _span(values: Any) -> str:
    return f"{values.min():.1f} to {values.max():.1f}"


if __name__ == "__main__":
    main()
