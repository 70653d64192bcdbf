"""Compare scores and rankings: relative errors, agreement, and standard errors against the scatter of seeds.

:func:`compare_seeds` compares the standard errors of single runs with the scatter of independent runs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.tpog import Tpog
from egvs.core.errors import EgvsError
from egvs.scenario.model import Scenario
from egvs.studies.measurement import SettingListener, SettingRunner, SettingScores
from egvs.studies.study_settings import Setting


def relative_errors(scores: NDArray[np.float64], reference: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return abs(score / reference - 1) of each site; infinite if only the reference is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        change: NDArray[np.float64] = np.where(scores == reference, 0.0, np.abs(scores / reference - 1.0))
    return change


def rank_agreement(scores: NDArray[np.float64], reference: NDArray[np.float64], kind: Literal["tau", "rho"]) -> float:
    """Return the correlation of two rankings.

    Parameters
    ----------
    scores, reference
        Scores of the same sites, (n,).
    kind
        ``"tau"`` for Kendall's tau-b, ``"rho"`` for Spearman's rho with shared ranks for ties.

    Returns
    -------
    float
        1 if all sites are equal in both, 0 if they are equal in one of them.
    """
    from scipy.stats import kendalltau, spearmanr

    is_constant = [len(np.unique(values)) < 2 for values in (scores, reference)]
    if any(is_constant):
        return float(all(is_constant))
    if kind == "tau":
        return float(kendalltau(scores, reference).statistic)
    return float(spearmanr(scores, reference).statistic)


def best_sites(scores: NDArray[np.float64], count: int) -> set[int]:
    """Return the indices of the ``count`` best sites, and of all that tie with the last of them."""
    if not len(scores):
        return set()
    last = np.sort(scores)[::-1][min(count, len(scores)) - 1]
    return set(np.flatnonzero(scores >= last).tolist())


def regret(scores: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    """Return the share of the best reference score that is lost at the best site by ``scores`` (the worst if several).

    Parameters
    ----------
    scores, reference
        Scores of the same sites, (n,).
    """
    highest = reference.max(initial=0.0)
    if highest <= 0:
        return 0.0
    return float(1.0 - min(reference[site] for site in best_sites(scores, 1)) / highest)


@dataclass(frozen=True)
class SeedComparison:
    """Standard errors of single runs beside the scatter of independent runs; lists have one value per site.

    Attributes
    ----------
    sites
        Names.
    seeds, frames
        Number of runs, and of frames in each run.
    truth
        Scores with the traffic of all runs together.
    between, within
        Standard deviation of the scores of the runs, and root mean square of their standard errors.
    bias, expected_bias
        Mean score less the truth, and mean of the estimated biases.
    covered
        Share of the confidence intervals that contain the truth.
    """

    sites: list[str]
    seeds: int
    frames: int
    truth: list[float]
    between: list[float]
    within: list[float]
    bias: list[float]
    expected_bias: list[float]
    covered: float


def compare_seeds(
    runner: SettingRunner, scenario: Scenario, count: int, listener: SettingListener
) -> SeedComparison | None:
    """Run a scenario with several seeds, and compare the scatter of the scores with their standard errors.

    Parameters
    ----------
    runner, scenario
        The scenario, and what runs its settings.
    count
        Number of seeds.
    listener
        Called after each run.

    Returns
    -------
    SeedComparison or None
        None if fewer than two runs succeed.
    """
    settings: list[Setting] = []
    runs: list[SettingScores] = []
    counts: NDArray[np.int64] | int = 0
    for number in range(1, count + 1):
        seed = scenario.seed + number
        setting = Setting(f"seed {seed}", "seed", "seed", (f"seed={seed}",))
        try:
            is_cached = runner.saved_scores(setting) is not None
            scores = runner.run(setting)
        except EgvsError as error:
            listener(setting.name, "skipped", {"why": str(error)})
            continue
        settings.append(setting)
        runs.append(scores)
        tpog = runner.tpog(setting)
        counts = tpog.counts + counts
        seconds = sum(runner.median_seconds(scores.stages).values())
        listener(setting.name, "kept" if is_cached else "done", {"seconds": seconds})
    if len(runs) < 2:
        return None

    merged = Tpog(tpog.grid, tpog.frames * len(runs), np.asarray(counts))
    truth = np.array(runner.scores_against(settings[0], merged))
    scores_by_run = np.array([run.scores for run in runs])
    ses = np.array([run.ses for run in runs])
    biases = np.array([run.biases for run in runs])
    half_widths = np.array([[run.quantile] for run in runs]) * ses
    return SeedComparison(
        sites=runs[0].sites,
        seeds=len(runs),
        frames=tpog.frames,
        truth=truth.tolist(),
        between=scores_by_run.std(axis=0, ddof=1).tolist(),
        within=np.sqrt((ses**2).mean(axis=0)).tolist(),
        bias=(scores_by_run.mean(axis=0) - truth).tolist(),
        expected_bias=biases.mean(axis=0).tolist(),
        covered=float((np.abs(scores_by_run - biases - truth) <= half_widths).mean()),
    )
