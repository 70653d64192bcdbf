"""Results of a city run: the table of junctions, the scores of all sites, and the plan of the city.

OUT/junctions/<ID>/                     the run of a junction, as ``egvs run`` writes it
OUT/scores/junction_<ID>.parquet        its scores, with a column of the junction: the files are one dataset
OUT/junctions.parquet                   one row per junction, the largest gain first
OUT/plan.parquet                        one row per sensor of the city's plan
OUT/curve.parquet                       the best plans for fewer sensors, or lower costs
OUT/costs.json                          times of the last run, and the peak memory of its processes
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
from egvs.core import files
from egvs.core.errors import InputError
from egvs.extensions.city.model import City, CityJunction
from egvs.results.labels import SCORE_LABELS
from egvs.results.plans import PlannedSensor, plan_columns, proved_share
from egvs.results.ranking import RankedSite
from egvs.scoring.scorer import ranks

RUNS_FOLDER, SCORES_DATASET, JUNCTIONS_TABLE = "junctions", "scores", "junctions.parquet"
PLAN_TABLE, CURVE_TABLE = "plan.parquet", "curve.parquet"
"""In the folder of a city run."""

_JUNCTION_COLUMN = "junction"
_SCORES_PREFIX = f"{_JUNCTION_COLUMN}_"
"""The junction is not in the name of a folder, ``junction=007``, because readers of datasets make 7 of it."""

_PLAN_SCHEMA, _CURVE_SCHEMA = "city_plan", "city_curve"
_INPUT_STAGES = ("statics", "scan", "traffic", "tpog")
"""The stages that a plan is made from."""

"""Bounds are larger than the optimum by their rounding."""

_VEHICLE_LABELS = {"expected_detections": "vehicles found", "seen_well": "vehicles seen well"}


@dataclass(frozen=True)
class JunctionResult:
    """The result of one junction.

    Attributes
    ----------
    junction
        The junction.
    sites
        Number of candidate sites.
    best
        The best site.
    vehicles
        Average number of vehicles in the region of interest.
    rank
        By gain; 1 for the best.
    """

    junction: CityJunction
    sites: int
    best: RankedSite
    vehicles: float
    rank: int = 0

    @property
    def score(self) -> float:
        """Score of the best site."""
        return self.best.score

    @property
    def gain(self) -> float:
        """Gain of the first sensor for the city, see :func:`score_factor`; 0 if the score is undefined."""
        if math.isnan(self.score):
            return 0.0
        return self.score * score_factor(self.best.rank_by, self.vehicles)


@dataclass(frozen=True)
class BudgetPoint:
    """The best plan of a city within a number of sensors, or a cost: a row of ``curve.parquet``.

    Attributes
    ----------
    limit
        Maximum number of sensors, or maximum cost.
    sensors, cost
        Number and cost of the sensors of the best plan.
    score, score_se
        Its joint score, and the standard error of the score; NaN where it is unknown.
    bound
        Upper bound of all plans within the limit.
    installed, installed_se
        For a number of sensors: the joint score of the first ones of the complete plan in the order of installation,
        and its standard error; NaN for a cost.
    """

    limit: float
    sensors: int
    cost: float
    score: float
    score_se: float
    bound: float
    installed: float = math.nan
    installed_se: float = math.nan


@dataclass(frozen=True)
class Phase:
    """Sensors that are installed together.

    Attributes
    ----------
    number
        1 for the first phase.
    sensors
        Its sensors.
    point
        The plan after this phase, and the best plan of as many sensors.
    """

    number: int
    sensors: tuple[PlannedSensor, ...]
    point: BudgetPoint

    @property
    def loss(self) -> float:
        """Share of the best score of as many sensors that the order of installation costs."""
        if not self.point.score > 0.0:
            return 0.0
        return max(0.0, 1.0 - self.point.installed / self.point.score)


@dataclass(frozen=True)
class CityPlan:
    """Sensors for a city, and the certificate of the plan.

    Attributes
    ----------
    sensors
        In the order of installation.
    rank_by
        Name of the score that is summed over junctions, see :func:`score_factor`.
    requested
        ``{"count": n}`` or ``{"budget": cost}``.
    joint, bound
        Sum of the joint scores, and the upper bound of all plans.
    joint_of_all
        Sum of the joint scores of all candidates.
    candidates, junctions
        Number of candidates and of junctions to choose from.
    curve
        The best plans within smaller limits, and within the full one.
    phases
        Number of sensors after each phase, ascending; empty without phases.
    errors_from
        How standard errors were computed; without standard errors, the reason.
    has_errors
        Whether the curve has standard errors.
    """

    sensors: tuple[PlannedSensor, ...]
    rank_by: str
    requested: Mapping[str, float]
    joint: float
    bound: float
    joint_of_all: float
    candidates: int
    junctions: int
    curve: tuple[BudgetPoint, ...] = ()
    phases: tuple[int, ...] = ()
    errors_from: str = ""
    has_errors: bool = False

    @property
    def by_phase(self) -> tuple[Phase, ...]:
        """The phases; empty without any."""
        points = {point.limit: point for point in self.curve}
        phases, start = [], 0
        for number, end in enumerate(self.phases, start=1):
            phases.append(Phase(number, self.sensors[start:end], points[end]))
            start = end
        return tuple(phases)

    def phase_of(self, sensor: PlannedSensor) -> int:
        """Return the number of the phase in which a sensor is installed; 1 without phases."""
        return 1 + sum(end < sensor.order for end in self.phases)

    @property
    def certificate(self) -> float:
        """Proved share of the best possible sum; 1 up to the rounding of bounds."""
        return proved_share(self.joint, self.bound)

    @property
    def cost(self) -> float:
        """Cost of all sensors."""
        return sum(sensor.cost for sensor in self.sensors)

    @property
    def by_junction(self) -> dict[str, int]:
        """Number of sensors of each junction that gets any."""
        return dict(Counter(sensor.junction for sensor in self.sensors))


@dataclass(frozen=True)
class GainLabel:
    """Name of a gain in a table (``head``) and on an axis, and its number of digits."""

    head: str
    label: str
    digits: int

    def value(self, value: float) -> str:
        """Format a gain for a table."""
        return f"{value:,.{self.digits}f}"


def gain_label(rank_by: str) -> GainLabel:
    """Return the label of the gains by a score."""
    score = SCORE_LABELS[rank_by]
    if rank_by == "egvs":
        return GainLabel("EGVS bit", score.label, 0)
    if rank_by in _VEHICLE_LABELS:
        return GainLabel(_VEHICLE_LABELS[rank_by], f"{_VEHICLE_LABELS[rank_by]}, on average", 2)
    return GainLabel(f"{score.head} × vehicles", f"{score.noun} times the average number of vehicles", 2)


def counts_vehicles(rank_by: str) -> bool:
    """Return whether the gains by a score are numbers of vehicles."""
    return rank_by in _VEHICLE_LABELS


def has_noticed(results: Sequence[JunctionResult]) -> bool:
    """Return whether it is known for each junction what people notice from its best site."""
    return all(result.best.noticed is not None for result in results)


def score_factor(rank_by: str, vehicles: float) -> float:
    """Return the factor that makes scores of different junctions comparable and additive.

    EGVS is in bits. Other scores are means over a junction's own vehicles or voxels; they are multiplied by the average
    number of vehicles in its region of interest.
    """
    return 1.0 if rank_by == "egvs" else vehicles


def mean_vehicles(run: Path) -> float:
    """Return the average number of vehicles in the region of interest, from the folder of a run."""
    return float(RunRecord.read(run).stages["tpog"].summary["boxes_in_roi"])


def junction_run_folder(out: Path, junction: str) -> Path:
    """Return the folder of a junction's run in the folder of a city run."""
    return out / RUNS_FOLDER / junction


def _scores_path(out: Path, junction: str) -> Path:
    return junction_run_folder(out, junction) / RunFolder.scores.name


def read_junction_results(out: Path, junctions: Sequence[CityJunction]) -> tuple[JunctionResult, ...]:
    """Read the results of junctions whose runs are complete.

    Parameters
    ----------
    out
        The folder of the city run.
    junctions
        The junctions.

    Returns
    -------
    tuple of JunctionResult
        The largest gain first; equal ones in the given order.

    Raises
    ------
    InputError
        When a run is missing or damaged, or ranks by another score than the others.
    """
    unranked = []
    for junction in junctions:
        sites = RankedSite.read(_scores_path(out, junction.id))
        best = min(sites, key=lambda site: site.rank)
        vehicles = mean_vehicles(junction_run_folder(out, junction.id))
        unranked.append(JunctionResult(junction, len(sites), best, vehicles))

    first = unranked[0]
    for result in unranked:
        if result.best.rank_by != first.best.rank_by:
            problem = f"expected {first.best.rank_by}, as for junction {first.junction.id}, got {result.best.rank_by}"
            hint = "Rank all junctions of a city by the same score."
            raise InputError(f"{_scores_path(out, result.junction.id)}: score.rank_by", problem, hint)

    rank_of_gain = ranks(np.array([result.gain for result in unranked])).tolist()
    ranked = [replace(result, rank=rank) for result, rank in zip(unranked, rank_of_gain, strict=True)]
    return tuple(sorted(ranked, key=lambda result: result.rank))


def write_results(out: Path, city: City, results: Sequence[JunctionResult]) -> tuple[Path, Path]:
    """Write the table of junctions and the dataset of scores; return the file, and the folder of the dataset."""
    names = [result.junction.id for result in results]
    _write_scores(out, names)
    rows = [_table_row(result) for result in results]
    columns: dict[str, Any] = {column: [row[column] for row in rows] for column in rows[0]}
    metadata = {**_common_metadata(city, hash_scores(out, names)), "rank_by": results[0].best.rank_by}
    optional: tuple[str, ...] = ()
    if has_noticed(results):
        shares = [result.best.noticed for result in results if result.best.noticed is not None]
        columns |= {
            "noticed": [share.value for share in shares],
            "noticed_low": [share.low for share in shares],
            "noticed_high": [share.high for share in shares],
        }
        optional = parquet.optional_columns("city")
    with parquet.artefact_writer(out / JUNCTIONS_TABLE, "city", optional) as file:
        file.write(columns)
        file.describe(metadata)
    return out / JUNCTIONS_TABLE, out / SCORES_DATASET


def _table_row(result: JunctionResult) -> dict[str, Any]:
    junction, best = result.junction, result.best
    return {
        "rank": result.rank,
        "junction": junction.id,
        "title": junction.title,
        "x_m": junction.x_m,
        "y_m": junction.y_m,
        "longitude_deg": junction.lon_deg,
        "latitude_deg": junction.lat_deg,
        "signalised": junction.signalised,
        "sites": result.sites,
        "best": best.site,
        "sensor": best.sensor,
        "gain": result.gain,
        "vehicles": result.vehicles,
        "score": best.score,
        "egvs": best.egvs,
        "egvs_limit": best.egvs_limit,
        "entropy_seen": best.entropy_seen,
    }


def _common_metadata(city: City, inputs: str) -> dict[str, Any]:
    return {
        "schema": parquet.SCHEMA_VERSION,
        "city": {"name": city.name, "attribution": city.attribution},
        "inputs": inputs,
        "seed": city.seed,
    }


def hash_scores(out: Path, junctions: Sequence[str]) -> str:
    """Return a hash of the scores of some junctions."""
    return files.hash_json({name: files.hash_file(_scores_path(out, name)) for name in junctions})


def _write_scores(out: Path, junctions: Sequence[str]) -> None:
    """Write the dataset of scores; remove the files of other junctions, and the folders that earlier versions wrote."""
    dataset = out / SCORES_DATASET
    for folder in dataset.glob(f"{_JUNCTION_COLUMN}=*"):
        shutil.rmtree(folder)
    paths = {dataset / f"{_SCORES_PREFIX}{name}.parquet": name for name in junctions}
    for path in dataset.glob(f"{_SCORES_PREFIX}*"):
        if path not in paths:
            path.unlink()
    for path, name in paths.items():
        _write_junction_scores(_scores_path(out, name), path, name)


def _write_junction_scores(source: Path, path: Path, junction: str) -> None:
    """Copy a table of scores, with the junction as another column; a user's column of this name is renamed."""
    table, metadata = parquet.read_artefact(source, "scores")
    columns = dict(zip(table.column_names, table.columns, strict=True))
    users_column = columns.pop(_JUNCTION_COLUMN, None)
    if users_column is not None:
        columns[f"given_{_JUNCTION_COLUMN}"] = users_column
    optional = tuple(name for name in parquet.optional_columns("scores") if name in columns)
    extra = {name: column for name, column in columns.items() if name not in parquet.column_names("scores")}
    extra[_JUNCTION_COLUMN] = pa.array([junction] * table.num_rows, pa.string())
    with parquet.artefact_writer(path, "scores", optional, extra) as file:
        file.write(columns | extra)
        file.describe(metadata)


def read_city_scores(out: str | Path) -> pa.Table:
    """Read the scores of all sites of a city run as one table.

    Parameters
    ----------
    out
        The folder of the city run.

    Returns
    -------
    pyarrow.Table
        The first column is ``junction``. If junctions have different columns, missing values are null.

    Raises
    ------
    InputError
        When the folder has no city run, or a file is damaged.
    """
    paths = sorted((Path(out) / SCORES_DATASET).glob(f"{_SCORES_PREFIX}*"))
    if not paths:
        hint = "Give the folder of a finished egvs city run."
        raise InputError(Path(out) / SCORES_DATASET, "there are no scores in this folder", hint)
    tables = []
    for path in paths:
        table, _ = parquet.read_artefact(path, "scores")
        others = [name for name in table.column_names if name != _JUNCTION_COLUMN]
        tables.append(table.select([_JUNCTION_COLUMN, *others]).replace_schema_metadata(None))
    return pa.concat_tables(tables, promote_options="default")


def hash_plan_inputs(out: Path, junctions: Sequence[str]) -> str:
    """Return a hash of the stages of each junction's run that a plan is made from."""
    keys = {}
    for name in sorted(junctions):
        stages = RunRecord.read(junction_run_folder(out, name)).stages
        keys[name] = [stages[stage].inputs for stage in _INPUT_STAGES]
    return files.hash_json(keys)


def write_plan(out: Path, city: City, plan: CityPlan, junctions: Sequence[str]) -> tuple[Path, Path]:
    """Write ``plan.parquet`` and ``curve.parquet``; return their paths. ``junctions`` are those of the city run."""
    summary = {
        "rank_by": plan.rank_by,
        "asked": dict(plan.requested),
        "joint": plan.joint,
        "bound": plan.bound,
        "together": plan.joint_of_all,
        "candidates": plan.candidates,
        "junctions": plan.junctions,
        "value": plan.joint,
        "certificate": plan.certificate,
        "cost": plan.cost,
        "phases": list(plan.phases),
        "standard_errors": {"known": plan.has_errors, "from": plan.errors_from},
    }
    metadata = {**_common_metadata(city, hash_plan_inputs(out, junctions)), "plan": summary}
    rows = [asdict(point) for point in plan.curve]
    curve = {field.name: [row[field.name] for row in rows] for field in fields(BudgetPoint)}
    columns = {**plan_columns(plan.sensors), "phase": [plan.phase_of(sensor) for sensor in plan.sensors]}
    parquet.write_artefact(out / CURVE_TABLE, _CURVE_SCHEMA, curve, metadata)
    parquet.write_artefact(out / PLAN_TABLE, _PLAN_SCHEMA, columns, metadata)
    return out / PLAN_TABLE, out / CURVE_TABLE


def read_plan(out: Path, junctions: Sequence[str]) -> CityPlan | None:
    """Return the plan in a folder; None if there is none, or it was made from other runs or junctions."""
    if not (out / PLAN_TABLE).is_file() or not (out / CURVE_TABLE).is_file():
        return None
    table, metadata = parquet.read_artefact(out / PLAN_TABLE, _PLAN_SCHEMA)
    curve, curve_metadata = parquet.read_artefact(out / CURVE_TABLE, _CURVE_SCHEMA)
    if metadata["inputs"] != hash_plan_inputs(out, junctions) or metadata["plan"] != curve_metadata["plan"]:
        return None
    plan = metadata["plan"]
    errors = plan["standard_errors"]
    return CityPlan(
        sensors=tuple(PlannedSensor(**row) for row in table.drop_columns(["phase"]).to_pylist()),
        rank_by=plan["rank_by"],
        requested=plan["asked"],
        joint=plan["joint"],
        bound=plan["bound"],
        joint_of_all=plan["together"],
        candidates=plan["candidates"],
        junctions=plan["junctions"],
        curve=tuple(BudgetPoint(**row) for row in curve.to_pylist()),
        phases=tuple(plan["phases"]),
        errors_from=errors["from"],
        has_errors=errors["known"],
    )
