"""What each candidate sees of the vehicle-frames of the unseen traffic, and which of them a detector finds there."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.across_junctions.detections import AP
from benchmarks.across_junctions.models.additive_model import DIRECTIONS, TargetFeatures
from benchmarks.across_junctions.models.comparison import SiteRows, models_for
from benchmarks.across_junctions.records import VEHICLES, JunctionRecord, read_table
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.scoring.target_scores import FEATURES, uncorrected_model


def read_rows(folder: Path, record: JunctionRecord, detector: str) -> list[SiteRows]:
    """Return the rows of each candidate; one whose AP is undefined is left out.

    The shipped probability is that of the detector's own model, or the mean over all models for a detector that has
    none.

    Raises
    ------
    InputError
        If a record is missing or damaged, or the rows of its parts differ.
    """
    seen = read_table(folder / f"{record.name}.features.parquet")
    if missing := [name for name in DIRECTIONS if name not in seen.column_names]:
        path = folder / f"{record.name}.features.parquet"
        raise InputError(path, f"has no column {missing[0]}", "Measure the part vehicles again.")
    found = read_table(folder / f"{record.name}.{detector}.hits.parquet")
    traffics = {
        (info.frames, info.vehicles, info.vehicle_frames, tuple(info.seeds.items()))
        for info in (record.infos[VEHICLES], record.infos[detector])
    }
    if seen["site"] != found["site"] or seen["row"] != found["row"] or len(traffics) > 1:
        problem = f"its rows are not those of {record.name}.{detector}.hits.parquet"
        raise InputError(folder / f"{record.name}.features.parquet", problem, "Measure both parts again.")
    count = seen.num_rows // len(record.sites)
    ap = record.detections[detector][AP].values
    rows = []
    for number, site in enumerate(record.sites):
        of_site = seen.slice(number * count, count)
        columns = {name: of_site[name].to_numpy().astype(np.float64) for name in DIRECTIONS}
        hits = found["hits"].slice(number * count, count).to_numpy().astype(np.float64)
        features = TargetFeatures(columns, of_site["vehicle_class"].to_numpy().astype(np.int64))
        if np.isfinite(ap[number]):
            group = f"{record.height_m[number]:g} m"
            rows.append(SiteRows(site, group, features, hits, _shipped(detector, columns), float(ap[number])))
    return rows


def _shipped(detector: str, columns: dict[str, FloatArray]) -> FloatArray:
    """Return the probability of each vehicle-frame by the models without correction for streets; 0 without a point."""
    features = np.column_stack([columns[name] for name in FEATURES])
    chances = np.mean([uncorrected_model(name).chances(features) for name in models_for([detector])], axis=0)
    return np.where(columns["log_points"] > 0.0, chances, 0.0)
