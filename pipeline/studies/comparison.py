r"""Settings of a study, compared: how far the scores of each are off, whether the ranking holds, what it costs.

Scores are compared as shares of ``egvs_limit``. With r_i of the reference and s_i of a setting, over the sites i,

.. math:: error = \max_i |s_i / r_i - 1|, \qquad regret = 1 - r_{b} / \max_i r_i

where b is the setting's best site. A setting of little traffic may be right by luck: it is *judged* by the larger of
its error and its own standard error (:mod:`pipeline.scoring.uncertainty`), and the recommendation is the cheapest
setting that is judged to be within the tolerance; but the scenario's own setting, or else the program's default, where
that is within it too and the cheapest saves less than :data:`WORTH` of its time. Where the traffic is a finished file,
nothing longer is to be had, and the error alone is judged. A setting that measures something else (voxel, gamma,
effects) has no error: it is compared with the scenario itself, on the same traffic, by ranking and regret.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np
from numpy.typing import NDArray

from pipeline.runs.stages import RANKING
from pipeline.studies.measuring import SettingRunner, SettingScores
from pipeline.studies.variants import APPROXIMATES, MEASURES, OWN, REFERENCE, SCENARIO, Setting, is_default

WORTH = 0.2
"""Share of the seconds that another setting has to save to be recommended in place of one that nobody has to type."""


@dataclass(frozen=True)
class Row:
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


def compare(
    runner: SettingRunner, setting: Setting, scores: Mapping[str, SettingScores], *, could_last_longer: bool
) -> Row:
    """Compare one setting with the others, whose ``scores`` are given by name.

    ``could_last_longer``: so could the traffic, so that its shortness is an error that time can mend.
    """
    its, own = scores[setting.name], scores[SCENARIO]
    against = own if setting.kind == MEASURES else scores.get(REFERENCE, own)
    beside = scores.get(setting.beside, own)
    spent = {name: runner.times(name, its.stages[name]) for name in RANKING}
    s, r = np.array(its.shares), np.array(against.shares)
    changes = relative(s, r)
    error, error_se = float(changes.max(initial=0.0)), _largest_se(its)
    return Row(
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
        own_change=float(relative(s, np.array(beside.shares)).max(initial=0.0)),
        judged=max(error, error_se) if could_last_longer else error,
        tau=agreement(s, r, "tau"),
        rho=agreement(s, r, "rho"),
        best_kept=best(s, 1) == best(r, 1),
        best_three_kept=best(s, 3) == best(r, 3),
        regret=regret(s, r),
        default=is_default(runner.scenario(setting), runner.scenario(OWN)),
    )  # fmt: skip


def _largest_se(scores: SettingScores) -> float:
    """Largest standard error, as a share of the site's score; not a number where the TPOG has one block."""
    shares = np.array(scores.shares)
    return float((np.array(scores.share_ses) / np.where(shares > 0, shares, np.inf)).max(initial=0.0))


def relative(found: NDArray[np.float64], reference: NDArray[np.float64]) -> NDArray[np.float64]:
    """|found / reference - 1| of each site; infinite where the reference alone is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        change: NDArray[np.float64] = np.where(found == reference, 0.0, np.abs(found / reference - 1.0))
    return change


def agreement(found: NDArray[np.float64], reference: NDArray[np.float64], kind: str) -> float:
    """Kendall's tau-b or Spearman's rho, ties shared; 1 where both tell nothing apart, 0 where one alone does not."""
    from scipy.stats import kendalltau, spearmanr

    flat = [len(np.unique(values)) < 2 for values in (found, reference)]
    if any(flat):
        return float(all(flat))
    return float((kendalltau if kind == "tau" else spearmanr)(found, reference).statistic)


def best(scores: NDArray[np.float64], count: int) -> set[int]:
    """The ``count`` best sites, and all that tie with the last of them."""
    if not len(scores):
        return set()
    last = np.sort(scores)[::-1][min(count, len(scores)) - 1]
    return set(np.flatnonzero(scores >= last).tolist())


def regret(found: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    """Share of the reference's best score that is lost by trusting the setting's best site (of several, the worst)."""
    most = reference.max(initial=0.0)
    return float(1.0 - min(reference[site] for site in best(found, 1)) / most) if most > 0 else 0.0


def judge(rows: list[Row], tolerance: float) -> list[Row]:
    """Mark the front and the recommended setting; sort."""
    rivals = [row for row in rows if row.kind in (APPROXIMATES, SCENARIO)]
    front = {row.setting for row in rivals if not any(_beats(other, row) for other in rivals)}
    within = sorted((row for row in rivals if row.judged <= tolerance), key=lambda row: (row.seconds, row.setting))
    chosen = _recommended(within).setting if within else None
    marked = [replace(row, front=row.setting in front, recommended=row.setting == chosen) for row in rows]
    places = {SCENARIO: 0, REFERENCE: 1, APPROXIMATES: 2, MEASURES: 3}
    return sorted(marked, key=lambda row: (places[row.kind], row.seconds, row.setting))


def _recommended(within: Sequence[Row]) -> Row:
    """Of the settings within the tolerance, cheapest first: that one, unless the scenario's own or else the program's
    default is nearly as cheap."""
    cheapest = within[0]
    familiar = sorted(
        (row for row in within if row.kind == SCENARIO or row.default), key=lambda row: row.kind != SCENARIO
    )
    return next((row for row in familiar if cheapest.seconds > (1.0 - WORTH) * row.seconds), cheapest)


def _beats(one: Row, other: Row) -> bool:
    """Whether ``one`` is as good in time and in error, and better in one of them."""
    its, others = (one.seconds, one.judged), (other.seconds, other.judged)
    return its != others and its[0] <= others[0] and its[1] <= others[1]
