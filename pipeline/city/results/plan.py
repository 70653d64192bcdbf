"""The plan of a city's sensors as ``plan.parquet`` holds it, for the page and for whoever puts sensors up."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artefacts import schemas, tables
from pipeline.artefacts.run_record import RunRecord
from pipeline.city.model import City
from pipeline.city.results.junctions import run_folder
from pipeline.core import files
from pipeline.placement.solving.bounds import ROUNDING

PLAN = "plan.parquet"

_ARTEFACT = "city_plan"
_WHOLE = 1.0 + 2.0 * ROUNDING
"""Bounds are raised by their rounding."""
_MADE_FROM = ("statics", "scan", "traffic", "tpog")


@dataclass(frozen=True)
class PlannedSensor:
    """A row of ``plan.parquet``; see its schema."""

    order: int
    junction: str
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


@dataclass(frozen=True)
class CityPlan:
    """Sensors for a city, and what is proved of them.

    Attributes
    ----------
    sensors
        In the order in which they would be put up.
    rank_by
        The score that is added up, see :func:`pipeline.city.results.junctions.per_score`.
    asked
        ``{"count": n}`` or ``{"budget": cost}``.
    joint, bound, together
        The sum of joint scores; what no plan exceeds; that of all candidates.
    candidates, junctions
        How many there are to choose from.
    curve
        Of a count: the best sum that was found and what none exceeds, for 0, 1, ... sensors.
    """

    sensors: tuple[PlannedSensor, ...]
    rank_by: str
    asked: Mapping[str, float]
    joint: float
    bound: float
    together: float
    candidates: int
    junctions: int
    curve: tuple[tuple[float, float], ...] = ()

    @property
    def certificate(self) -> float:
        """The share of the best possible that is proved; 1 up to the rounding of bounds."""
        return 1.0 if self.bound <= self.joint * _WHOLE else self.joint / self.bound

    @property
    def cost(self) -> float:
        """Of all sensors."""
        return sum(sensor.cost for sensor in self.sensors)

    @property
    def by_junction(self) -> dict[str, int]:
        """How many sensors each junction gets, of those that get any."""
        return dict(Counter(sensor.junction for sensor in self.sensors))


def made_from(out: Path, junctions: Sequence[str]) -> str:
    """A hash of what a plan is made from: the stages of each junction's run."""
    keys = {}
    for name in sorted(junctions):
        stages = RunRecord.read(run_folder(out, name)).stages
        keys[name] = [stages[stage].inputs for stage in _MADE_FROM]
    return files.hash_of(keys)


def write(out: Path, city: City, plan: CityPlan, junctions: Sequence[str]) -> Path:
    """Write the plan; its path."""
    columns: dict[str, Any] = {
        its.name: [getattr(sensor, its.name) for sensor in plan.sensors] for its in fields(PlannedSensor)
    }
    columns["order"] = np.array(columns["order"], dtype=np.int32)
    told = {key: value for key, value in asdict(plan).items() if key != "sensors"}
    about = {
        "schema": schemas.VERSION,
        "city": {"name": city.name, "attribution": city.attribution},
        "inputs": made_from(out, junctions),
        "seed": city.seed,
        "plan": {**told, "value": plan.joint, "certificate": plan.certificate, "cost": plan.cost},
    }
    tables.write(out / PLAN, _ARTEFACT, columns, about)
    return out / PLAN


def read(out: Path, junctions: Sequence[str]) -> CityPlan | None:
    """The plan of these junctions as they are now; None where there is none, or it was made from others."""
    path = out / PLAN
    if not path.is_file():
        return None
    table, about = tables.read(path, _ARTEFACT)
    if about["inputs"] != made_from(out, junctions):
        return None
    told = about["plan"]
    names = [its.name for its in fields(CityPlan) if its.name not in ("sensors", "curve")]
    sensors = tuple(PlannedSensor(**row) for row in table.to_pylist())
    curve = tuple((float(best), float(bound)) for best, bound in told["curve"])
    return CityPlan(sensors, **{name: told[name] for name in names}, curve=curve)
