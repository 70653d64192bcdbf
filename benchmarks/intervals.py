"""Do the intervals of single runs hold the truth as often as they say, on a scenario of yours?

``python -m benchmarks.intervals SCENARIO [SEEDS] [KEY=VALUE...]`` runs the scenario with as many seeds (32) and prints
how far the EGVS scatters between them, what the standard errors of single runs say, and in what share of cases the 90 %
intervals hold the score of all runs taken together.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egvs.artefacts.tpog import Tpog, read_tpog
from egvs.core.errors import EgvsError
from egvs.core.grid import FloatArray
from egvs.core.progress import no_progress
from egvs.scenario.loading import load
from egvs.scoring.scorer import Scorer
from egvs.scoring.standard_errors import BlockJackknife, ScoreUncertainty
from egvs.stages.base import StageContext
from egvs.stages.site_scans import empty_scans
from egvs.studies.measurement import SettingRunner
from egvs.studies.study_settings import Setting

SEEDS = 32


@dataclass(frozen=True, eq=False)
class SeedScores:
    """EGVS of n sites from the traffic of one seed.

    Attributes
    ----------
    setting
        The seed as a setting.
    sites
        Names, (n,).
    scores
        Bits, (n,) float64.
    estimate
        Their standard errors and biases.
    tpog
        TPOG of the seed.
    """

    setting: Setting
    sites: tuple[str, ...]
    scores: FloatArray
    estimate: ScoreUncertainty
    tpog: Tpog


@dataclass(frozen=True, eq=False)
class SeedComparison:
    """Standard errors of single runs beside the scatter of independent runs of n sites.

    Attributes
    ----------
    truth
        Scores with the traffic of all runs together, (n,) float64.
    between, within
        Standard deviation of the scores of the runs, and root mean square of their standard errors, (n,) float64.
    bias, expected_bias
        Mean score less the truth, and mean of the estimated biases, (n,) float64.
    covered
        Share of the confidence intervals that contain the truth.
    """

    truth: FloatArray
    between: FloatArray
    within: FloatArray
    bias: FloatArray
    expected_bias: FloatArray
    covered: float


def score_seed(runner: SettingRunner, seed: int) -> SeedScores:
    """Run a scenario with a seed, and return its EGVS.

    Raises
    ------
    EgvsError
        When a stage fails, or if the TPOG has a single block, so that there are no standard errors.
    """
    setting = Setting(f"seed {seed}", "seed", "seed", (f"seed={seed}",))
    with runner.open_run(setting) as work:
        tpog = read_tpog(work.folder.tpog)
        jackknife = BlockJackknife.of(work.folder.tpog, tpog)
        if jackknife is None:
            raise EgvsError("tpog.blocks: standard errors need at least 2 blocks, got 1")
        scorer = Scorer(work.scene, tpog, work.folder.trajectories, jackknife)
        sites, replicates = [], []
        for scan in empty_scans(work):
            sites.append(scan.site.name)
            replicates.append(scorer.score(scan.beams).replicates)
    estimate = ScoreUncertainty.of(np.array(replicates), jackknife.groups)
    return SeedScores(setting, tuple(sites), np.array(replicates)[:, 0], estimate, tpog)


def run_seeds(runner: SettingRunner, first: int, count: int, report: Callable[[str], None]) -> list[SeedScores]:
    """Run a scenario with several seeds; those that fail are reported and left out."""
    runs = []
    for seed in range(first, first + count):
        try:
            runs.append(score_seed(runner, seed))
        except EgvsError as error:
            report(f"seed {seed}: left out: {error}")
            continue
        report(f"seed {seed}: done")
    return runs


def scores_against(work: StageContext, tpog: Tpog) -> FloatArray:
    """Return the EGVS of the scans of a run folder with another TPOG on its grid, (n,) float64."""
    scorer = Scorer(work.scene, tpog, work.folder.trajectories)
    return np.array([scorer.score(scan.beams).egvs for scan in empty_scans(work)])


def compare_seeds(runner: SettingRunner, runs: Sequence[SeedScores]) -> SeedComparison:
    """Compare the scatter of the scores of at least two seeds with their standard errors."""
    counts = np.sum([run.tpog.counts for run in runs], axis=0)
    first = runs[0].tpog
    with runner.open_run(runs[0].setting) as work:
        truth = scores_against(work, Tpog(first.grid, first.frames * len(runs), counts))
    scores = np.array([run.scores for run in runs])
    ses = np.array([run.estimate.se for run in runs])
    biases = np.array([run.estimate.bias for run in runs])
    half_widths = np.array([run.estimate.quantiles() for run in runs]) * ses
    return SeedComparison(
        truth=truth,
        between=scores.std(axis=0, ddof=1),
        within=np.sqrt((ses**2).mean(axis=0)),
        bias=scores.mean(axis=0) - truth,
        expected_bias=biases.mean(axis=0),
        covered=float((np.abs(scores - biases - truth) <= half_widths).mean()),
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, and print."""
    scenario, *more = sys.argv[1:] if arguments is None else arguments
    count = int(more.pop(0)) if more and more[0].isdigit() else SEEDS
    with tempfile.TemporaryDirectory() as folder:
        runner = SettingRunner(Path(scenario), tuple(more), Path(folder), 1, no_progress)
        first = load(scenario, more).seed + 1
        runs = run_seeds(runner, first, count, lambda line: print(line, file=sys.stderr))
        if len(runs) < 2:
            print("fewer than two runs succeeded")
            return
        comparison = compare_seeds(runner, runs)
    print(f"{len(runs)} seeds of {runs[0].tpog.frames} frames, {len(runs[0].sites)} sites")
    for what, values in (("scatter between runs", comparison.between), ("standard errors", comparison.within)):
        shares = 100 * values / comparison.truth
        print(f"{what}: {shares.min():.1f} to {shares.max():.1f} % of the score")
    for what, values in (("bias", comparison.bias), ("bias expected", comparison.expected_bias)):
        print(f"{what}: {100 * (values / comparison.truth).mean():+.1f} % on average")
    print(f"90 % intervals contain the score in {comparison.covered:.1%} of cases")


if __name__ == "__main__":
    main()
