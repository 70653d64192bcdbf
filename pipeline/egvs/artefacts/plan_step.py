"""The best plan of each number of sensors: a row of ``curve.parquet``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

ERROR_COLUMNS = ("score_se", "gain_se", "beats_previous")
"""Columns of ``curve.parquet`` that exist where standard errors are known."""


@dataclass(frozen=True)
class PlanStep:
    """The best plan that was found with at most so many sensors, and what it adds to the plan before it.

    Attributes
    ----------
    count
        Maximum number of sensors.
    score
        Joint score.
    gain
        What it adds to the joint score of the plan before it; the first plan adds to no sensor. The two plans need not
        share sensors.
    met
        Whether the plan meets all requirements.
    score_se, gain_se
        Standard errors of ``score`` and ``gain``; NaN where they are unknown.
    beats_previous
        Probability that the plan truly scores higher than the plan before it; NaN where it is unknown.
    """

    count: int
    score: float
    gain: float
    met: bool
    score_se: float = math.nan
    gain_se: float = math.nan
    beats_previous: float = math.nan


def plan_steps(rows: Sequence[Mapping[str, Any]]) -> tuple[PlanStep, ...]:
    """Return the steps of the rows of ``curve.parquet``."""
    steps = []
    score_before = 0.0
    for row in rows:
        errors = {name: row[name] for name in ERROR_COLUMNS if name in row}
        steps.append(PlanStep(row["count"], row["score"], row["score"] - score_before, row["met"], **errors))
        score_before = row["score"]
    return tuple(steps)
