"""Tables of junctions, sites and planned sensors.

Brings the runs of a city's junctions together: one table of junctions, one dataset of all their sites' scores.

OUT/junctions/<ID>/                     the run of a junction, as ``egvs run`` writes it
OUT/scores/junction=<ID>/scores.parquet its scores again: a dataset partitioned by junction
OUT/junctions.parquet                   one row a junction, the best first

The plan of a city's sensors as ``plan.parquet`` holds it, for the page and for whoever puts sensors up.

What a sensor brings to a city, in words.
"""

from __future__ import annotations

import math
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.city.model import City, CityJunction
from egvs.core import files
from egvs.core.errors import InputError
from egvs.placement.branch_and_bound import BOUND_ROUNDING
from egvs.report.formatting import SCORE_LABELS
from egvs.report.ranking import RankedSite
from egvs.scoring.scorer import ranks

RUNS_FOLDER, SCORES_DATASET, JUNCTIONS_TABLE = "junctions", "scores", "junctions.parquet"
"""In the folder of a city run."""

_SCORES_FILE, _PARTITION_PREFIX = RunFolder.scores.name, "junction="


@dataclass(frozen=True)
class JunctionResult:
    """What came of one junction: how many sites, the best one, and the vehicles in its region at a time."""

    junction: CityJunction
    sites: int
    best: RankedSite
    vehicles: float
    rank: int = 0

    @property
    def score(self) -> float:
        """Of the best site, by the score that ranks."""
        return self.best.score

    @property
    def gain(self) -> float:
        """What it brings to the city, see :func:`score_factor`; nothing where its score is not defined."""
        return 0.0 if math.isnan(self.score) else self.score * score_factor(self.best.rank_by, self.vehicles)


def score_factor(rank_by: str, vehicles: float) -> float:
    """What a score is multiplied by, so that junctions can be compared and added up: EGVS are bits; means over a
    junction's own vehicles or voxels count by how many vehicles are there at a time."""
    return 1.0 if rank_by == "egvs" else vehicles


def mean_vehicles(run: Path) -> float:
    """Vehicles in the region at a time, of a junction's run."""
    return float(RunRecord.read(run).stages["tpog"].summary["boxes_in_roi"])


def junction_run_folder(out: Path, junction: str) -> Path:
    """The folder of a junction's run."""
    return out / RUNS_FOLDER / junction


def read_junction_results(out: Path, junctions: Sequence[CityJunction]) -> tuple[JunctionResult, ...]:
    """What came of junctions whose runs are whole, the best first; equal ones in the order of their table.

    Raises
    ------
    InputError
        Where a run is not there, is damaged, or ranks by another score than the others.
    """
    found = []
    for junction in junctions:
        sites = RankedSite.read(junction_run_folder(out, junction.id) / _SCORES_FILE)
        best, vehicles = min(sites, key=lambda site: site.rank), mean_vehicles(junction_run_folder(out, junction.id))
        found.append(JunctionResult(junction, len(sites), best, vehicles))
    _check_same_score(out, found)
    values = np.array([its.gain for its in found])
    ranked = zip(found, ranks(values).tolist(), strict=True)
    by_rank = [replace(its, rank=rank) for its, rank in ranked]
    return tuple(sorted(by_rank, key=lambda its: its.rank))


def _check_same_score(out: Path, results: Sequence[JunctionResult]) -> None:
    """InputError where junctions rank by different scores: then none can be called the best."""
    first = results[0]
    for its in results:
        if its.best.rank_by != first.best.rank_by:
            place = f"{junction_run_folder(out, its.junction.id) / _SCORES_FILE}: score.rank_by"
            said = f"{its.best.rank_by}, and {first.best.rank_by} at {first.junction.id}"
            raise InputError(place, said, "one score by which all junctions of a city rank")


def write_results(out: Path, city: City, results: Sequence[JunctionResult]) -> tuple[Path, Path]:
    """Write both; the paths of the table and of the dataset's folder."""
    _write_scores(out, results)
    rows, best = [its.junction for its in results], [its.best for its in results]
    columns: dict[str, Any] = {
        "rank": np.array([its.rank for its in results], dtype=np.uint32),
        "junction": [row.id for row in rows],
        "title": [row.title for row in rows],
        "x_m": [row.x_m for row in rows],
        "y_m": [row.y_m for row in rows],
        "longitude_deg": [row.lon_deg for row in rows],
        "latitude_deg": [row.lat_deg for row in rows],
        "signalised": [row.signalised for row in rows],
        "sites": np.array([its.sites for its in results], dtype=np.uint32),
        "best": [site.site for site in best],
        "sensor": [site.sensor for site in best],
        "gain": [its.gain for its in results],
        "vehicles": [its.vehicles for its in results],
        **{key: [getattr(site, key) for site in best] for key in ("score", "egvs", "egvs_limit", "entropy_seen")},
    }
    about = {
        "schema": parquet.SCHEMA_VERSION,
        "city": {"name": city.name, "attribution": city.attribution},
        "inputs": hash_scores(out, [row.id for row in rows]),
        "seed": city.seed,
        "rank_by": best[0].rank_by,
    }
    parquet.write_artefact(out / JUNCTIONS_TABLE, "city", columns, about)
    return out / JUNCTIONS_TABLE, out / SCORES_DATASET


def hash_scores(out: Path, names: Sequence[str]) -> str:
    """A hash of the scores of some junctions."""
    return files.hash_json({name: files.hash_file(junction_run_folder(out, name) / _SCORES_FILE) for name in names})


def _write_scores(out: Path, results: Sequence[JunctionResult]) -> None:
    """The dataset, without junctions that are none of these."""
    names = {f"{_PARTITION_PREFIX}{its.junction.id}" for its in results}
    for left in (out / SCORES_DATASET).glob(f"{_PARTITION_PREFIX}*"):
        if left.name not in names:
            shutil.rmtree(left)
    for its in results:
        with files.atomic_write(
            out / SCORES_DATASET / f"{_PARTITION_PREFIX}{its.junction.id}" / _SCORES_FILE
        ) as partial:
            shutil.copyfile(junction_run_folder(out, its.junction.id) / _SCORES_FILE, partial)


def read_city_scores(out: str | Path) -> pa.Table:
    """The scores of all sites of a city run as one table, its first column ``junction``; where junctions have different
    columns, null stands for what one does not have.

    Raises
    ------
    InputError
        Where the folder holds no city run, or a file is damaged.
    """
    folders = sorted((Path(out) / SCORES_DATASET).glob(f"{_PARTITION_PREFIX}*"))
    if not folders:
        raise InputError(Path(out) / SCORES_DATASET, "no scores there", "the folder of a finished egvs city run")
    parts = []
    for folder in folders:
        table, _ = parquet.read_artefact(folder / _SCORES_FILE, "scores")
        names = pa.array([folder.name.removeprefix(_PARTITION_PREFIX)] * table.num_rows, pa.string())
        parts.append(table.replace_schema_metadata(None).add_column(0, "junction", names))
    return pa.concat_tables(parts, promote_options="default")


PLAN_TABLE = "plan.parquet"

_PLAN_SCHEMA = "city_plan"
_ROUNDING_FACTOR = 1.0 + 2.0 * BOUND_ROUNDING
"""Bounds are raised by their rounding."""
_INPUT_STAGES = ("statics", "scan", "traffic", "tpog")


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
        The score that is added up, see :func:`egvs.city.results.score_factor`.
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
        return 1.0 if self.bound <= self.joint * _ROUNDING_FACTOR else self.joint / self.bound

    @property
    def cost(self) -> float:
        """Of all sensors."""
        return sum(sensor.cost for sensor in self.sensors)

    @property
    def by_junction(self) -> dict[str, int]:
        """How many sensors each junction gets, of those that get any."""
        return dict(Counter(sensor.junction for sensor in self.sensors))


def hash_plan_inputs(out: Path, junctions: Sequence[str]) -> str:
    """A hash of what a plan is made from: the stages of each junction's run."""
    keys = {}
    for name in sorted(junctions):
        stages = RunRecord.read(junction_run_folder(out, name)).stages
        keys[name] = [stages[stage].inputs for stage in _INPUT_STAGES]
    return files.hash_json(keys)


def write_plan(out: Path, city: City, plan: CityPlan, junctions: Sequence[str]) -> Path:
    """Write the plan; its path."""
    columns: dict[str, Any] = {
        its.name: [getattr(sensor, its.name) for sensor in plan.sensors] for its in fields(PlannedSensor)
    }
    columns["order"] = np.array(columns["order"], dtype=np.int32)
    told = {key: value for key, value in asdict(plan).items() if key != "sensors"}
    about = {
        "schema": parquet.SCHEMA_VERSION,
        "city": {"name": city.name, "attribution": city.attribution},
        "inputs": hash_plan_inputs(out, junctions),
        "seed": city.seed,
        "plan": {**told, "value": plan.joint, "certificate": plan.certificate, "cost": plan.cost},
    }
    parquet.write_artefact(out / PLAN_TABLE, _PLAN_SCHEMA, columns, about)
    return out / PLAN_TABLE


def read_plan(out: Path, junctions: Sequence[str]) -> CityPlan | None:
    """The plan of these junctions as they are now; None where there is none, or it was made from others."""
    path = out / PLAN_TABLE
    if not path.is_file():
        return None
    table, about = parquet.read_artefact(path, _PLAN_SCHEMA)
    if about["inputs"] != hash_plan_inputs(out, junctions):
        return None
    told = about["plan"]
    names = [its.name for its in fields(CityPlan) if its.name not in ("sensors", "curve")]
    sensors = tuple(PlannedSensor(**row) for row in table.to_pylist())
    curve = tuple((float(best), float(bound)) for best, bound in told["curve"])
    return CityPlan(sensors, **{name: told[name] for name in names}, curve=curve)


@dataclass(frozen=True)
class GainLabel:
    """What is added up over junctions: at the head of a column, on an axis, and how many digits it has."""

    head: str
    label: str
    digits: int

    def value(self, value: float) -> str:
        """In a table."""
        return f"{value:,.{self.digits}f}"


def gain_label(rank_by: str) -> GainLabel:
    """Of the score that ranks."""
    by = SCORE_LABELS[rank_by]
    if rank_by == "egvs":
        return GainLabel("EGVS bit", by.label, 0)
    if rank_by in _VEHICLE_LABELS:
        return GainLabel(_VEHICLE_LABELS[rank_by], f"{_VEHICLE_LABELS[rank_by]}, at a time", 2)
    return GainLabel(f"{by.head} × vehicles", f"{by.noun} times the vehicles there at a time", 2)


_VEHICLE_LABELS = {"expected_detections": "vehicles found", "seen_well": "vehicles seen well"}
