r"""Errors, rank agreement and seeds compared.

Settings of a study, compared: how far the scores of each are off, whether the ranking holds, what it costs.

Scores are compared as shares of ``egvs_limit``. With r_i of the reference and s_i of a setting, over the sites i,

.. math:: error = \max_i |s_i / r_i - 1|, \qquad regret = 1 - r_{b} / \max_i r_i

where b is the setting's best site. A setting of little traffic may be right by luck: it is *judged* by the larger of
its error and its own standard error (:mod:`egvs.scoring.standard_errors`), and the recommendation is the cheapest
setting that is judged to be within the tolerance; but the scenario's own setting, or else the program's default, where
that is within it too and the cheapest saves less than :data:`MIN_TIME_SAVING` of its time. Where the traffic is a
finished file,
nothing longer is to be had, and the error alone is judged. A setting that measures something else (voxel, gamma,
effects) has no error: it is compared with the scenario itself, on the same traffic, by ranking and regret.

Independent runs of one setting: do the standard errors, which a single run gives, say how far scores scatter?
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.tpog import Tpog
from egvs.core.errors import EgvsError
from egvs.runs.stages import RANKING_STAGES
from egvs.scenario.model import Scenario
from egvs.studies.measurement import SettingListener, SettingRunner, SettingScores
from egvs.studies.study_settings import APPROXIMATES, MEASURES, REFERENCE, SCENARIO, SCENARIO_AS_IS, Setting, is_default

MIN_TIME_SAVING = 0.2
"""Share of the seconds that another setting has to save to be recommended in place of one that nobody has to type."""


@dataclass(frozen=True)
class SettingResult:
    """One setting, compared; the columns of ``accuracy.parquet``, see its schema."""

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
    default: bool
    front: bool = False
    recommended: bool = False


def compare_setting(
    runner: SettingRunner, setting: Setting, scores: Mapping[str, SettingScores], *, could_last_longer: bool
) -> SettingResult:
    """Compare one setting with the others, whose ``scores`` are given by name.

    ``could_last_longer``: so could the traffic, so that its shortness is an error that time can mend.
    """
    its, own = scores[setting.name], scores[SCENARIO]
    against = own if setting.kind == MEASURES else scores.get(REFERENCE, own)
    beside = scores.get(setting.baseline, own)
    spent = {name: runner.times(name, its.stages[name]) for name in RANKING_STAGES}
    s, r = np.array(its.shares), np.array(against.shares)
    changes = relative_errors(s, r)
    error, error_se = float(changes.max(initial=0.0)), _largest_se(its)
    return SettingResult(
        setting=setting.name,
        kind=setting.kind,
        knob=setting.knob,
        overrides=" ".join(f"--set {shlex.quote(o)}" for o in setting.overrides),
        seconds=sum(median(cost.seconds) for cost in spent.values()),
        seconds_spread=sum(max(cost.seconds) - min(cost.seconds) for cost in spent.values()),
        busy_s=sum(median(cost.busy_s) for cost in spent.values()),
        repeats=min(len(cost.seconds) for cost in spent.values()),
        statics_s=median(spent["statics"].seconds),
        scan_s=median(spent["scan"].seconds),
        traffic_s=median(spent["traffic"].seconds),
        tpog_s=median(spent["tpog"].seconds),
        score_s=median(spent["score"].seconds),
        peak_mb=max(cost.peak_mb for cost in spent.values()),
        bytes=sum(cost.bytes for cost in spent.values()),
        error=error,
        error_se=error_se,
        error_rms=error * float(np.sqrt(np.mean((changes / error) ** 2))) if 0 < error < math.inf else error,
        own_change=float(relative_errors(s, np.array(beside.shares)).max(initial=0.0)),
        judged=max(error, error_se) if could_last_longer else error,
        tau=rank_agreement(s, r, "tau"),
        rho=rank_agreement(s, r, "rho"),
        best_kept=best_sites(s, 1) == best_sites(r, 1),
        best_three_kept=best_sites(s, 3) == best_sites(r, 3),
        regret=regret(s, r),
        default=is_default(runner.scenario(setting), runner.scenario(SCENARIO_AS_IS)),
    )  # fmt: skip


def _largest_se(scores: SettingScores) -> float:
    """Largest standard error, as a share of the site's score; not a number where the TPOG has one block."""
    shares = np.array(scores.shares)
    return float((np.array(scores.share_ses) / np.where(shares > 0, shares, np.inf)).max(initial=0.0))


def relative_errors(scores: NDArray[np.float64], reference: NDArray[np.float64]) -> NDArray[np.float64]:
    """|found / reference - 1| of each site; infinite where the reference alone is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        change: NDArray[np.float64] = np.where(scores == reference, 0.0, np.abs(scores / reference - 1.0))
    return change


def rank_agreement(scores: NDArray[np.float64], reference: NDArray[np.float64], kind: str) -> float:
    """Kendall's tau-b or Spearman's rho, ties shared; 1 where both tell nothing apart, 0 where one alone does not."""
    from scipy.stats import kendalltau, spearmanr

    flat = [len(np.unique(values)) < 2 for values in (scores, reference)]
    if any(flat):
        return float(all(flat))
    return float((kendalltau if kind == "tau" else spearmanr)(scores, reference).statistic)


def best_sites(scores: NDArray[np.float64], count: int) -> set[int]:
    """The ``count`` best sites, and all that tie with the last of them."""
    if not len(scores):
        return set()
    last = np.sort(scores)[::-1][min(count, len(scores)) - 1]
    return set(np.flatnonzero(scores >= last).tolist())


def regret(scores: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    """Share of the reference's best score that is lost by trusting the setting's best site (of several, the worst)."""
    most = reference.max(initial=0.0)
    return float(1.0 - min(reference[site] for site in best_sites(scores, 1)) / most) if most > 0 else 0.0


def mark_pareto_front(rows: list[SettingResult], tolerance: float) -> list[SettingResult]:
    """Mark the front and the recommended setting; sort."""
    rivals = [row for row in rows if row.kind in (APPROXIMATES, SCENARIO)]
    front = {row.setting for row in rivals if not any(_dominates(other, row) for other in rivals)}
    within = sorted((row for row in rivals if row.judged <= tolerance), key=lambda row: (row.seconds, row.setting))
    chosen = _recommended(within).setting if within else None
    marked = [replace(row, front=row.setting in front, recommended=row.setting == chosen) for row in rows]
    places = {SCENARIO: 0, REFERENCE: 1, APPROXIMATES: 2, MEASURES: 3}
    return sorted(marked, key=lambda row: (places[row.kind], row.seconds, row.setting))


def _recommended(within: Sequence[SettingResult]) -> SettingResult:
    """Of the settings within the tolerance, cheapest first: that one, unless the scenario's own or else the program's
    default is nearly as cheap."""
    cheapest = within[0]
    familiar = sorted(
        (row for row in within if row.kind == SCENARIO or row.default), key=lambda row: row.kind != SCENARIO
    )
    return next((row for row in familiar if cheapest.seconds > (1.0 - MIN_TIME_SAVING) * row.seconds), cheapest)


def _dominates(one: SettingResult, other: SettingResult) -> bool:
    """Whether ``one`` is as good in time and in error, and better in one of them."""
    its, others = (one.seconds, one.judged), (other.seconds, other.judged)
    return its != others and its[0] <= others[0] and its[1] <= others[1]


@dataclass(frozen=True)
class SeedComparison:
    """What independent runs of the same setting say of the standard errors; each (sites,)."""

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
    """Independent runs: how far scores scatter, what the standard errors said, and how often the intervals held the
    truth.

    None where fewer than two of them succeed.
    """
    settings: list[Setting] = []
    runs: list[SettingScores] = []
    counts: list[NDArray[np.int64]] = []
    for number in range(1, count + 1):
        setting = Setting(f"seed {scenario.seed + number}", "seed", "seed", (f"seed={scenario.seed + number}",))
        try:
            known = runner.known(setting)
            runs.append(known or runner.run(setting))
        except EgvsError as error:
            listener(setting.name, "skipped", {"why": str(error)})
            continue
        settings.append(setting)
        tpog = runner.tpog(setting)
        counts = [tpog.counts + sum(counts)]
        listener(setting.name, "kept" if known else "done", {"seconds": sum(runner.medians(runs[-1]).values())})
    if len(runs) < 2:
        return None
    merged = Tpog(tpog.grid, tpog.frames * len(runs), counts[0])
    truth = np.array(runner.scores_against(settings[0], merged))
    scores, ses, biases = (np.array([getattr(one, name) for one in runs]) for name in ("scores", "ses", "biases"))
    reach = np.array([[one.quantile] for one in runs]) * ses
    return SeedComparison(
        sites=runs[0].sites,
        seeds=len(runs),
        frames=tpog.frames,
        truth=truth.tolist(),
        between=scores.std(axis=0, ddof=1).tolist(),
        within=np.sqrt((ses**2).mean(axis=0)).tolist(),
        bias=(scores.mean(axis=0) - truth).tolist(),
        expected_bias=biases.mean(axis=0).tolist(),
        covered=float((np.abs(scores - biases - truth) <= reach).mean()),
    )
