"""The setting that an accuracy study recommends.

The cheapest setting that approximates the scenario's scores and whose expected loss is within the tolerance is
recommended; if no setting is within the tolerance, the one with the smallest expected loss. With a tolerance of the
score, its error counts instead of the loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from egvs.results.studies import APPROXIMATES, MEASURES, SCENARIO, SettingResult, Tolerance


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
