"""Brings the runs of a city's junctions together: one table of junctions, one dataset of all their sites' scores.

OUT/junctions/<ID>/                     the run of a junction, as ``egvs run`` writes it
OUT/scores/junction=<ID>/scores.parquet its scores again: a dataset partitioned by junction
OUT/junctions.parquet                   one row a junction, the best first
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.artefacts import schemas, tables
from pipeline.artefacts.run_record import RunRecord
from pipeline.city.model import City, CityJunction
from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.report.ranking import ScoredSite
from pipeline.scoring.scorer import ranks

RUNS, SCORES, TABLE = "junctions", "scores", "junctions.parquet"
"""In the folder of a city run."""

_FILE, _KEY = "scores.parquet", "junction="


@dataclass(frozen=True)
class JunctionResult:
    """What came of one junction: how many sites, the best one, and the vehicles in its region at a time."""

    junction: CityJunction
    sites: int
    best: ScoredSite
    vehicles: float
    rank: int = 0

    @property
    def score(self) -> float:
        """Of the best site, by the score that ranks."""
        return self.best.score

    @property
    def gain(self) -> float:
        """What it brings to the city, see :func:`per_score`; nothing where its score is not defined."""
        return 0.0 if math.isnan(self.score) else self.score * per_score(self.best.rank_by, self.vehicles)


def per_score(rank_by: str, vehicles: float) -> float:
    """What a score is multiplied by, so that junctions can be compared and added up: EGVS are bits; means over a
    junction's own vehicles or voxels count by how many vehicles are there at a time."""
    return 1.0 if rank_by == "egvs" else vehicles


def vehicles_in(run: Path) -> float:
    """Vehicles in the region at a time, of a junction's run."""
    return float(RunRecord.read(run).stages["tpog"].summary["boxes_in_roi"])


def run_folder(out: Path, junction: str) -> Path:
    """The folder of a junction's run."""
    return out / RUNS / junction


def read_runs(out: Path, junctions: Sequence[CityJunction]) -> tuple[JunctionResult, ...]:
    """What came of junctions whose runs are whole, the best first; equal ones in the order of their table.

    Raises
    ------
    InputError
        Where a run is not there, is damaged, or ranks by another score than the others.
    """
    found = []
    for junction in junctions:
        sites = ScoredSite.read(run_folder(out, junction.id) / _FILE)
        best, vehicles = min(sites, key=lambda site: site.rank), vehicles_in(run_folder(out, junction.id))
        found.append(JunctionResult(junction, len(sites), best, vehicles))
    _check_alike(out, found)
    values = np.array([its.gain for its in found])
    ranked = zip(found, ranks(values).tolist(), strict=True)
    by_rank = [replace(its, rank=rank) for its, rank in ranked]
    return tuple(sorted(by_rank, key=lambda its: its.rank))


def _check_alike(out: Path, found: Sequence[JunctionResult]) -> None:
    """InputError where junctions rank by different scores: then none can be called the best."""
    first = found[0]
    for its in found:
        if its.best.rank_by != first.best.rank_by:
            place = f"{run_folder(out, its.junction.id) / _FILE}: score.rank_by"
            said = f"{its.best.rank_by}, and {first.best.rank_by} at {first.junction.id}"
            raise InputError(place, said, "one score by which all junctions of a city rank")


def write(out: Path, city: City, results: Sequence[JunctionResult]) -> tuple[Path, Path]:
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
        "schema": schemas.VERSION,
        "city": {"name": city.name, "attribution": city.attribution},
        "inputs": digest_of(out, [row.id for row in rows]),
        "seed": city.seed,
        "rank_by": best[0].rank_by,
    }
    tables.write(out / TABLE, "city", columns, about)
    return out / TABLE, out / SCORES


def digest_of(out: Path, names: Sequence[str]) -> str:
    """A hash of the scores of some junctions."""
    return files.hash_of({name: files.sha256_of(run_folder(out, name) / _FILE) for name in names})


def _write_scores(out: Path, results: Sequence[JunctionResult]) -> None:
    """The dataset, without junctions that are none of these."""
    names = {f"{_KEY}{its.junction.id}" for its in results}
    for left in (out / SCORES).glob(f"{_KEY}*"):
        if left.name not in names:
            shutil.rmtree(left)
    for its in results:
        with files.aside(out / SCORES / f"{_KEY}{its.junction.id}" / _FILE) as partial:
            shutil.copyfile(run_folder(out, its.junction.id) / _FILE, partial)


def read_scores(out: str | Path) -> pa.Table:
    """The scores of all sites of a city run as one table, its first column ``junction``; where junctions have different
    columns, null stands for what one does not have.

    Raises
    ------
    InputError
        Where the folder holds no city run, or a file is damaged.
    """
    folders = sorted((Path(out) / SCORES).glob(f"{_KEY}*"))
    if not folders:
        raise InputError(Path(out) / SCORES, "no scores there", "the folder of a finished egvs city run")
    parts = []
    for folder in folders:
        table, _ = tables.read(folder / _FILE, "scores")
        names = pa.array([folder.name.removeprefix(_KEY)] * table.num_rows, pa.string())
        parts.append(table.replace_schema_metadata(None).add_column(0, "junction", names))
    return pa.concat_tables(parts, promote_options="default")
