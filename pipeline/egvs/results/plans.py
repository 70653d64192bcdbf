"""Plans of several sensors: what ``egvs place`` finds, writes and reads again.

:class:`SensorPlan` is the plan for the command line, the report, exports and the explorer.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from egvs.artefacts.readers import ZoneVisibility, read_placement
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import StageRecord, have_inputs
from egvs.results.labels import SCORE_LABELS, ScoreLabel
from egvs.results.levels import NoticedShare
from egvs.sensors.sites import Pose, Site

ERROR_COLUMNS = ("score_se", "gain_se", "beats_previous")
"""Columns of ``curve.parquet`` that exist where standard errors are known."""

_TIGHT = 1.0 + 2e-9
"""A bound that exceeds a value by less is tight: both are rounded (``egvs.placement.branch_and_bound``)."""


def proved_share(value: float, bound: float) -> float:
    """Return the share of the best possible value that is proved to be reached, given an upper bound of it."""
    if bound <= value * _TIGHT:
        return 1.0
    return value / bound


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

    @property
    def mount(self) -> Site:
        """The sensor as a site, with the name of its candidate."""
        pose = Pose(self.x_m, self.y_m, self.z_m, self.yaw_deg, self.pitch_deg, self.roll_deg)
        return Site(self.site, pose, self.sensor)


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
    sites, cost
        Names of its sites, and their cost (0 without costs).
    value, bound
        The objective, and an upper bound of it for every such plan; NaN where the plan is not the best one of a search.
    """

    count: int
    score: float
    gain: float
    met: bool
    score_se: float = math.nan
    gain_se: float = math.nan
    beats_previous: float = math.nan
    sites: tuple[str, ...] = ()
    cost: float = 0.0
    value: float = math.nan
    bound: float = math.nan

    @property
    def certificate(self) -> float:
        """Proved share of the best possible objective, 0 to 1."""
        return proved_share(self.value, self.bound)


def plan_steps(rows: Sequence[Mapping[str, Any]]) -> tuple[PlanStep, ...]:
    """Return the steps of the rows of ``curve.parquet``."""
    steps = []
    score_before = 0.0
    for row in rows:
        values = {**row, "sites": tuple(json.loads(row["sites"]))}
        steps.append(PlanStep(gain=row["score"] - score_before, **values))
        score_before = row["score"]
    return tuple(steps)


def curve_columns(steps: Sequence[PlanStep]) -> dict[str, list[Any]]:
    """Return the columns of ``curve.parquet``, by name."""
    columns = {field.name: [getattr(step, field.name) for step in steps] for field in fields(PlanStep)}
    del columns["gain"]
    columns["sites"] = [json.dumps(list(step.sites), ensure_ascii=False) for step in steps]
    return columns


@dataclass(frozen=True)
class ZoneCoverage:
    """How a plan covers a required zone.

    Attributes
    ----------
    name
        Name of the zone.
    seen, share
        The share of the zone's entropy that the plan sees, and the required share.
    by
        Number of sensors that have to see it.
    """

    name: str
    seen: float
    share: float
    by: int


@dataclass(frozen=True)
class RefinementSummary:
    """What the refinement of a plan's poses did.

    Attributes
    ----------
    joint_before
        Joint score of the plan at the poses of its candidates.
    value_before, value_after
        The objective (:attr:`egvs.placement.problem.PlanValue.value`) before and after. It never drops; the joint score
        may.
    poses_tried, poses_infeasible
        Number of poses that were tried, and of those that break a rule or cannot be scanned.
    turns
        Number of turns; each moves one sensor.
    seconds
        Duration; NaN in a plan that was read, because equal plans are equal files.
    """

    joint_before: float
    value_before: float
    value_after: float
    poses_tried: int
    poses_infeasible: int
    turns: int
    seconds: float = math.nan


@dataclass(frozen=True)
class FusedPlan:
    """What a plan is expected to find in the fused point clouds of its sensors.

    Attributes
    ----------
    steps
        The first sensor, the first two, and so on, in the order of installation.
    better_sites
        Sites that are expected to find more together, reached by swaps of one sensor at a time; empty where no swap
        finds more.
    better
        What they find; ``gain`` is what they find more than the plan. None without ``better_sites``.
    searched
        Whether swaps were tried.
    noticed
        What people would notice in the fused clouds of all sensors of the plan; None if unknown.
    """

    steps: tuple[PlanStep, ...]
    better_sites: tuple[str, ...] = ()
    better: PlanStep | None = None
    searched: bool = False
    noticed: NoticedShare | None = None


def _fused_step(count: int, score: float, score_se: float | None) -> PlanStep:
    """Return the joint score of the first sensors in fused clouds, from the metadata of a plan."""
    return PlanStep(count, score, math.nan, True, math.nan if score_se is None else score_se)


@dataclass(frozen=True)
class SensorPlan:
    """A plan of several sensors and its certificate.

    Attributes
    ----------
    sensors
        In the order of installation: forced ones first, then each time the one with the largest gain.
    curve
        The best plans of 1, 2, ... sensors; the last one is this plan, with the candidates at their original poses.
    score
        Name of the joint score.
    request
        The ``[placement]`` that the plan solves, JSON values.
    joint
        Joint score of the plan.
    joint_of_all
        Joint score of all candidates that are not excluded.
    cost
        Cost of the plan; 0 without costs.
    candidates
        Number of candidates that are not excluded.
    zones
        The required zones.
    is_best
        Whether it is proved that no plan is better.
    fewest_is_proved
        Whether it is proved that one sensor fewer cannot meet the requirements; None if this was not requested.
    forbids_more
        The rules that forbid any further sensor, e.g. ``"the limit of 1 sensor per pole (most_per_pole)"``; empty if
        one may be added.
    errors_from
        How the standard errors were computed; or the reason why there are none.
    stages
        Keys of the stages that the plan was made from, by name; empty before it is written.
    refinement
        With refined poses, what the refinement did; ``sensors``, ``joint``, ``cost`` and ``zones`` are those after it.
    fused
        What the sensors are expected to find in their fused point clouds; None without sensors, and for joint scores
        that do not take sensors as independent. A plan that was read has its steps only.
    zone_results
        What the sensors find together in the zones of ``[score] zones``; empty in a plan that was read.
    files
        The files that were written; empty in a plan that was read.
    """

    sensors: tuple[PlannedSensor, ...]
    curve: tuple[PlanStep, ...]
    score: str
    request: Mapping[str, Any]
    joint: float
    joint_of_all: float
    cost: float
    candidates: int
    zones: tuple[ZoneCoverage, ...]
    is_best: bool
    fewest_is_proved: bool | None
    forbids_more: str = ""
    errors_from: str = ""
    stages: Mapping[str, str] = field(default_factory=dict)
    refinement: RefinementSummary | None = None
    fused: FusedPlan | None = None
    zone_results: tuple[ZoneVisibility, ...] = ()
    files: tuple[Path, ...] = ()

    @classmethod
    def read(cls, folder: RunFolder) -> SensorPlan | None:
        """Read the plan in a run folder; None if there is none.

        Raises
        ------
        InputError
            If a file is damaged or was changed.
        """
        result = read_placement(folder.placement, folder.curve)
        if result is None:
            return None
        rows, curve_rows, metadata = result
        plan = metadata["plan"]
        refinement = None
        if "moves" in plan:
            moves = plan["moves"]
            names = ("before", "value_before", "value", "tried", "impossible", "turns")
            refinement = RefinementSummary(*(moves[name] for name in names))
        fused = None
        if "fused" in plan:
            fused = FusedPlan(tuple(_fused_step(count, *values) for count, values in enumerate(plan["fused"], start=1)))
        return cls(
            sensors=tuple(PlannedSensor(**row) for row in rows),
            curve=plan_steps(curve_rows),
            score=plan["score"],
            request=plan["asked"],
            joint=plan["joint"],
            joint_of_all=plan["together"],
            cost=plan["cost"],
            candidates=plan["candidates"],
            zones=tuple(ZoneCoverage(**zone) for zone in plan["zones"]),
            is_best=plan["is_best"],
            fewest_is_proved=plan["fewest_is_proved"],
            forbids_more=plan.get("forbids_more", ""),
            errors_from=plan.get("standard_errors", "the plan was made by an older version of egvs place"),
            stages=metadata["stages"],
            refinement=refinement,
            fused=fused,
        )

    def to_json(self) -> dict[str, Any]:
        """Return what the metadata of ``placement.parquet`` and ``curve.parquet`` says about the plan."""
        last = self.curve[-1]
        plan = {
            "score": self.score,
            "asked": self.request,
            "candidates": self.candidates,
            "joint": self.joint,
            "value": last.value,
            "bound": last.bound,
            "certificate": self.certificate,
            "together": self.joint_of_all,
            "cost": self.cost,
            "is_best": self.is_best,
            "fewest_is_proved": self.fewest_is_proved,
            "zones": [asdict(zone) for zone in self.zones],
            "standard_errors": self.errors_from,
        }
        if self.forbids_more:
            plan["forbids_more"] = self.forbids_more
        if self.fused is not None:
            plan["fused"] = [
                [None if math.isnan(value) else value for value in (step.score, step.score_se)]
                for step in self.fused.steps
            ]
        if self.refinement is not None:  # without its duration: equal plans are equal files
            plan["moves"] = {
                "before": self.refinement.joint_before,
                "value_before": self.refinement.value_before,
                "value": self.refinement.value_after,
                "tried": self.refinement.poses_tried,
                "impossible": self.refinement.poses_infeasible,
                "turns": self.refinement.turns,
            }
        return plan

    def belongs_to(self, stages: Mapping[str, StageRecord]) -> bool:
        """Whether the plan was made from the same traffic, sites and settings as a run with these stages."""
        return have_inputs(stages, self.stages)

    @property
    def by(self) -> ScoreLabel:
        """Label of the joint score."""
        return SCORE_LABELS[self.score]

    @property
    def certificate(self) -> float:
        """Proved share of the best possible objective."""
        return self.curve[-1].certificate

    @property
    def has_errors(self) -> bool:
        """Whether there are standard errors."""
        return not any(math.isnan(step.score_se) for step in self.curve)

    @property
    def joint_se(self) -> float:
        """Standard error of the joint score of the plan; NaN where it is unknown, and without sensors."""
        if not self.sensors:
            return math.nan
        return self.sensors[-1].score_se

    def share_of_all(self, joint: float) -> float:
        """Return a joint score as a share of that of all candidates together."""
        if not self.joint_of_all > 0:
            return 0.0
        return joint / self.joint_of_all
