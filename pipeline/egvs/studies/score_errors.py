r"""Compare the settings of a study: errors of their scores, agreement of their rankings, and costs.

Scores are compared as shares of ``egvs_limit``. With the scores r_i of the reference and s_i of a setting at the sites
i, and b the best site of the setting,

.. math:: error = \max_i |s_i / r_i - 1|, \qquad regret = 1 - r_{b} / \max_i r_i

A setting with little traffic may have a small error by chance. Therefore ``judged``, the error that counts, is the
larger of its error and its standard error (:mod:`egvs.scoring.standard_errors`). The cheapest setting whose error is
within the tolerance is recommended. The scenario's own setting, or else the program's default, is recommended instead
if it is within the tolerance too, and if the cheapest saves less than :data:`MIN_TIME_SAVING` of its time. Traffic that
is a finished file cannot be longer, so only the error counts. A setting that measures something else (voxel, gamma,
effects) has no error: its ranking and regret are compared with those of the scenario, on the same traffic. Options of
the traffic are compared with the scenario too, beside other seeds (:mod:`egvs.studies.traffic_options`).

:func:`compare_seeds` compares the standard errors of single runs with the scatter of independent runs.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.tpog import Tpog
from egvs.core.errors import EgvsError
from egvs.runs.stage_registry import RANKING_STAGES
from egvs.scenario.model import Scenario
from egvs.studies.measurement import SettingListener, SettingRunner, SettingScores
from egvs.studies.study_settings import (
    APPROXIMATES,
    MEASURES,
    REFERENCE,
    SCENARIO,
    SCENARIO_AS_IS,
    TRAFFIC,
    Setting,
    is_default,
)

MIN_TIME_SAVING = 0.2
"""Share of time that a setting must save to be recommended instead of the scenario's own or the default."""


@dataclass(frozen=True)
class SettingResult:
    """One compared setting: a row of ``accuracy.parquet``, whose schema describes the columns."""

    setting: str
    kind: str
    knob: str
    overrides: str
    seconds: float
    seconds_spread: float
    busy_s: float
    repeats: int
    statics_s: float
    scan_s: float
    traffic_s: float
    tpog_s: float
    score_s: float
    peak_mb: float
    bytes: int
    error: float
    error_se: float
    error_rms: float
    own_change: float
    judged: float
    tau: float
    rho: float
    best_kept: bool
    best_three_kept: bool
    regret: float
    best: str
    tpog_change: float
    default: bool
    front: bool = False
    recommended: bool = False


def compare_setting(
    runner: SettingRunner,
    setting: Setting,
    scores: Mapping[str, SettingScores],
    *,
    could_last_longer: bool,
    tpog_change: float = math.nan,
) -> SettingResult:
    """Compare one setting with the reference, or with the scenario if it measures something else.

    Parameters
    ----------
    runner
        Knows the times of stages.
    setting
        The setting to compare.
    scores
        Scores of all settings by name.
    could_last_longer
        Whether longer traffic could be simulated, so that the standard error counts as an error.
    tpog_change
        Change of the TPOG by an option of the traffic.
    """
    result, unchanged = scores[setting.name], scores[SCENARIO]
    reference = unchanged
    if setting.kind not in (MEASURES, TRAFFIC):
        reference = scores.get(REFERENCE, unchanged)
    baseline = scores.get(setting.baseline, unchanged)
    costs = {name: runner.stage_times(name, result.stages[name]) for name in RANKING_STAGES}
    medians = {name: median(cost.seconds) for name, cost in costs.items()}
    shares, reference_shares = np.array(result.shares), np.array(reference.shares)
    changes = relative_errors(shares, reference_shares)
    error, error_se = float(changes.max(initial=0.0)), _largest_se(result)
    error_rms = error
    if 0 < error < math.inf:
        error_rms = error * float(np.sqrt(np.mean((changes / error) ** 2)))
    judged = error
    if could_last_longer:
        judged = max(error, error_se)
    return SettingResult(
        setting=setting.name,
        kind=setting.kind,
        knob=setting.knob,
        overrides=" ".join(f"--set {shlex.quote(override)}" for override in setting.overrides),
        seconds=sum(medians.values()),
        seconds_spread=sum(max(cost.seconds) - min(cost.seconds) for cost in costs.values()),
        busy_s=sum(median(cost.busy_s) for cost in costs.values()),
        repeats=min(len(cost.seconds) for cost in costs.values()),
        statics_s=medians["statics"],
        scan_s=medians["scan"],
        traffic_s=medians["traffic"],
        tpog_s=medians["tpog"],
        score_s=medians["score"],
        peak_mb=max(cost.peak_mb for cost in costs.values()),
        bytes=sum(cost.bytes for cost in costs.values()),
        error=error,
        error_se=error_se,
        error_rms=error_rms,
        own_change=float(relative_errors(shares, np.array(baseline.shares)).max(initial=0.0)),
        judged=judged,
        tau=rank_agreement(shares, reference_shares, "tau"),
        rho=rank_agreement(shares, reference_shares, "rho"),
        best_kept=best_sites(shares, 1) == best_sites(reference_shares, 1),
        best_three_kept=best_sites(shares, 3) == best_sites(reference_shares, 3),
        regret=regret(shares, reference_shares),
        best=", ".join(result.sites[site] for site in sorted(best_sites(shares, 1))),
        tpog_change=tpog_change,
        default=setting.kind != TRAFFIC and is_default(runner.scenario(setting), runner.scenario(SCENARIO_AS_IS)),
    )


def _largest_se(scores: SettingScores) -> float:
    """Largest standard error, as a share of the site's score; NaN if the TPOG has one block."""
    shares = np.array(scores.shares)
    return float((np.array(scores.share_ses) / np.where(shares > 0, shares, np.inf)).max(initial=0.0))


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


def mark_pareto_front(rows: list[SettingResult], tolerance: float) -> list[SettingResult]:
    """Mark the Pareto front and the recommended setting, and sort by kind and time.

    Parameters
    ----------
    rows
        Compared settings.
    tolerance
        Largest error of the recommended setting.
    """
    candidates = [row for row in rows if row.kind in (APPROXIMATES, SCENARIO)]
    accurate = [row for row in candidates if row.judged <= tolerance]
    accurate.sort(key=lambda row: (row.seconds, row.setting))
    recommended = None
    if accurate:
        recommended = _recommended(accurate).setting
    marked = []
    for row in rows:
        on_front = row in candidates and not any(_dominates(other, row) for other in candidates)
        marked.append(replace(row, front=on_front, recommended=row.setting == recommended))
    order = (SCENARIO, REFERENCE, APPROXIMATES, MEASURES, TRAFFIC)
    return sorted(marked, key=lambda row: (order.index(row.kind), row.seconds, row.setting))


def _recommended(accurate: Sequence[SettingResult]) -> SettingResult:
    """Return the first (cheapest) setting, unless the scenario's own or else the default is nearly as cheap."""
    cheapest = accurate[0]
    familiar = [row for row in accurate if row.kind == SCENARIO]
    familiar += [row for row in accurate if row.kind != SCENARIO and row.default]
    for row in familiar:
        if cheapest.seconds > (1.0 - MIN_TIME_SAVING) * row.seconds:
            return row
    return cheapest


def _dominates(row: SettingResult, other: SettingResult) -> bool:
    """Whether ``row`` is as good in time and in error, and better in one of them."""
    is_equal = (row.seconds, row.judged) == (other.seconds, other.judged)
    return row.seconds <= other.seconds and row.judged <= other.judged and not is_equal


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
        seconds = sum(runner.median_seconds(scores).values())
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
