"""Do the intervals of single runs hold the truth as often as they say, on a scenario of yours?

``python -m benchmarks.intervals SCENARIO [SEEDS] [KEY=VALUE...]`` runs the scenario with as many seeds (32) and prints
how far scores scatter between them, what the standard errors of single runs say, and in what share of cases the 90 %
intervals hold the score of all runs taken together.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from egvs.core.progress import no_progress
from egvs.scenario.loading import load
from egvs.studies.measurement import SettingRunner
from egvs.studies.score_errors import compare_seeds

SEEDS = 32


def print_seed(name: str, state: str, details: dict[str, Any]) -> None:
    """Print a line for each seed."""
    print(f"{name}: {state} {details.get('why', '')}", file=sys.stderr)


def main() -> None:
    """Run, and print."""
    scenario, *more = sys.argv[1:]
    count = int(more.pop(0)) if more and more[0].isdigit() else SEEDS
    with tempfile.TemporaryDirectory() as folder:
        runner = SettingRunner(Path(scenario), tuple(more), Path(folder), 1, no_progress)
        comparison = compare_seeds(runner, load(scenario, more), count, print_seed)
    if comparison is None:
        print("fewer than two runs succeeded")
        return
    truth = np.array(comparison.truth)
    print(f"{comparison.seeds} seeds of {comparison.frames} frames, {len(comparison.sites)} sites")
    for what, values in (("scatter between runs", comparison.between), ("standard errors", comparison.within)):
        shares = 100 * np.array(values) / truth
        print(f"{what}: {shares.min():.1f} to {shares.max():.1f} % of the score")
    for what, values in (("bias", comparison.bias), ("bias expected", comparison.expected_bias)):
        print(f"{what}: {100 * (np.array(values) / truth).mean():+.1f} % on average")
    print(f"90 % intervals contain the score in {comparison.covered:.1%} of cases")


if __name__ == "__main__":
    main()
