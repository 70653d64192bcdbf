"""Rows of an accuracy study, and the setting that it recommends.

The cheapest setting that approximates the scenario's scores and whose expected loss is within the tolerance is
recommended; if no setting is within the tolerance, the one with the smallest expected loss. With a tolerance of the
score, its error counts instead of the loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from egvs.studies.study_settings import APPROXIMATES, MEASURES, SCENARIO


@dataclass(frozen=True)
class SettingResult:
    """One setting: a row of ``accuracy.parquet``, whose schema describes the columns."""

    setting: str
    kind: str
    knob: str
    overrides: str
    seconds: float
    statics_s: float
    scan_s: float
    traffic_s: float
    tpog_s: float
    score_s: float
    measured: bool
    frames: int
    sampled_frames: int
    draws: int
    probability: float
    probability_se: float
    loss_points: float
    loss_se_points: float
    error: float
    tau: float
    best: str
    best_share: float
    front: bool = False
    recommended: bool = False

    @property
    def label(self) -> str:
        """Name in a sentence."""
        return "the scenario's own setting" if self.kind == SCENARIO else self.setting

    @property
    def approximates(self) -> bool:
        """Whether it may be recommended: it gives the scenario's scores, with more or less accuracy."""
        return self.kind in (SCENARIO, APPROXIMATES)


@dataclass(frozen=True)
class Tolerance:
    """What a setting must meet.

    Attributes
    ----------
    loss_points
        Largest expected loss, in percentage points of vehicles found.
    score
        Largest relative error of the score, which counts instead if it is given.
    """

    loss_points: float
    score: float | None = None

    def admits(self, row: SettingResult) -> bool:
        """Whether a setting is within the tolerance."""
        if self.score is not None:
            return row.error <= self.score
        return row.loss_points <= self.loss_points

    def excess(self, row: SettingResult) -> float:
        """Return the loss or error that counts."""
        return row.loss_points if self.score is None else row.error


def mark_rows(rows: Sequence[SettingResult], tolerance: Tolerance) -> list[SettingResult]:
    """Mark the recommended setting and the Pareto front of seconds and loss, and sort by kind and seconds.

    Parameters
    ----------
    rows
        All settings, with that of the scenario.
    tolerance
        What a setting must meet.
    """
    candidates = [row for row in rows if row.approximates]
    admitted = [row for row in candidates if tolerance.admits(row)]
    if admitted:
        # of equally cheap settings the scenario's own, or else the one that loses least
        best = min(admitted, key=lambda row: (row.seconds, row.kind != SCENARIO, tolerance.excess(row), row.setting))
    else:
        best = min(candidates, key=lambda row: (tolerance.excess(row), row.seconds, row.setting))
    marked = []
    for row in rows:
        on_front = row.approximates and not any(_dominates(other, row, tolerance) for other in candidates)
        marked.append(replace(row, front=on_front, recommended=row.setting == best.setting))
    order = (SCENARIO, APPROXIMATES, MEASURES)
    return sorted(marked, key=lambda row: (order.index(row.kind), row.seconds, row.setting))


def _dominates(row: SettingResult, other: SettingResult, tolerance: Tolerance) -> bool:
    """Whether ``row`` is as good in time and in what counts, and better in one of them."""
    cost, other_cost = (row.seconds, tolerance.excess(row)), (other.seconds, tolerance.excess(other))
    return cost[0] <= other_cost[0] and cost[1] <= other_cost[1] and cost != other_cost


@dataclass(frozen=True)
class NeededTraffic:
    """Traffic that reaches the tolerance by the model; infinite if none does.

    Attributes
    ----------
    frames, seconds
        Number of frames, and processor seconds of a run with them.
    """

    frames: float
    seconds: float
