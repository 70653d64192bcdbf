"""Plans of several sensors: the sensors of a plan, and the best plan of each number of sensors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

ERROR_COLUMNS = ("score_se", "gain_se", "beats_previous")
"""Columns of ``curve.parquet`` that exist where standard errors are known."""


@dataclass(frozen=True)
class PlannedSensor:
    """One sensor of a plan: a row of ``placement.parquet``, or of a city's ``plan.parquet``.

    Attributes
    ----------
    order
        1 for the first sensor: forced ones come first, then each time the one with the largest gain.
    site, pole
        Names of the candidate and of its pole.
    x_m, y_m, z_m
        Position in the world frame.
    yaw_deg, pitch_deg, roll_deg
        Orientation, as in :class:`egvs.sensors.sites.Pose`.
    sensor
        Name of the sensor model.
    forced
        Whether it is already installed.
    gain, score
        What it adds to the joint score of those before it, and the joint score with it.
    cost
        What it adds to the cost of those before it.
    loss
        What the joint score of the complete plan loses if this sensor fails; NaN in plans of a city.
    bound
        Upper bound of all plans with as many sensors as up to this one; NaN in plans of a city.
    moved_m
        Distance from the candidate's position; 0 without refinement.
    gain_by_refining
        What the joint score loses if this sensor alone returns to its candidate's pose; 0 without refinement.
    junction
        Name of the junction, in plans of a city.
    score_se, gain_se
        Standard errors of ``score`` and ``gain`` due to the finite traffic record; NaN where they are unknown, and in
        plans of a city.
    """

    order: int
    site: str
    pole: str
    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float
    pitch_deg: float
    roll_deg: float
    sensor: str
    forced: bool
    gain: float
    score: float
    cost: float
    loss: float = math.nan
    bound: float = math.nan
    moved_m: float = 0.0
    gain_by_refining: float = 0.0
    junction: str = ""
    score_se: float = math.nan
    gain_se: float = math.nan

    @property
    def marked_order(self) -> str:
        """The order, with a star if the sensor is already installed."""
        if self.forced:
            return f"{self.order}*"
        return str(self.order)


def plan_columns(sensors: Sequence[PlannedSensor]) -> dict[str, list[Any]]:
    """Return the columns of the table of these sensors, by name."""
    return {field.name: [getattr(sensor, field.name) for sensor in sensors] for field in fields(PlannedSensor)}


@dataclass(frozen=True)
class PlanStep:
    """The best plan that was found with at most so many sensors, and what it adds to the plan before it.

    A row of ``curve.parquet``.

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
