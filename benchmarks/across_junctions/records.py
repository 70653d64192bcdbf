"""Records of the parts of the study, as Parquet: a part is one junction with one detector, its scores, or its vehicles.

=========================  ========================================================================================
``J.DETECTOR.parquet``     one row per candidate and measure: value, values with each block of frames left out, and of
                           the two halves of the frames
``J.DETECTOR.hits.parquet``  one row per candidate and vehicle-frame: share of the two views in which it was found, and
                           points on it in the sweep
``J.DETECTOR.boxes.parquet``  one row per detection: candidate, frame, box in the world frame, score
``J.scores.parquet``       one row per candidate and score: sign and value
``J.vehicles.parquet``     one row per vehicle-frame of the unseen traffic: vehicle, class, size
``J.features.parquet``     one row per candidate and vehicle-frame: what the candidate sees of it, and the features of
                           the model
``J.candidates.parquet``   one row per candidate: pose, height, sensor
``J.PART.json``            what the part depends on, the digest of the source, seconds and machine
=========================  ========================================================================================

Parquet files depend on neither clock nor machine, so a repeated part has the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray

SCORES, VEHICLES = "scores", "vehicles"
"""Names of the parts that belong to no detector."""

NOT_DETECTORS = (SCORES, VEHICLES)


@dataclass(frozen=True)
class PartInfo:
    """What a part depends on, and what it cost.

    Attributes
    ----------
    part
        A detector, or one of :data:`NOT_DETECTORS`.
    key
        Hash of everything that the part depends on.
    source
        Digest of the source of the program and of the study.
    settings
        Hash of the detector's settings, or of its model; empty for other parts.
    protocol
        Hash of the protocol.
    frames, apart_s, vehicles, vehicle_frames
        The unseen traffic: number of frames, least time between two, different vehicles, and vehicle-frames.
    seeds
        Of the traffic behind the scores, and of the unseen traffic.
    is_trial
        Whether fewer frames or candidates were used than the protocol says.
    seconds, busy_s
        Wall time, and processor time. A part that was interrupted counts only what was left to do.
    site_s
        Mean processor time of one candidate, for a detector; 0 where all candidates were cached, and for other parts.
    machine
        Processor, cores and libraries.
    skipped
        Scores that could not be computed, with the reason.
    again
        Reasons for which a part that is not of a training junction was measured more than once.
    """

    junction: str
    role: str
    part: str
    key: str
    source: str
    settings: str
    protocol: str
    frames: int
    apart_s: float
    vehicles: int
    vehicle_frames: int
    candidates: int
    seeds: dict[str, int]
    is_trial: bool
    seconds: float
    busy_s: float
    site_s: float
    machine: dict[str, Any]
    skipped: tuple[str, ...] = ()
    again: tuple[str, ...] = ()

    def write(self, folder: Path) -> None:
        """Write it as JSON. It is written last, so a part with it is complete."""
        files.write_text(
            info_path(folder, self.junction, self.part), json.dumps(asdict(self), indent=1, sort_keys=True) + "\n"
        )

    @classmethod
    def read(cls, path: Path) -> PartInfo:
        """Read what :meth:`write` wrote.

        Raises
        ------
        InputError
            For a file that is not such a record.
        """
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
            return cls(**(values | {name: tuple(values[name]) for name in ("skipped", "again")}))
        except (ValueError, TypeError, KeyError) as error:
            raise InputError(path, f"expected a record of the study, got an error: {error}", "Remove it.") from None


def info_path(folder: Path, junction: str, part: str) -> Path:
    """Return the path of the description of a part."""
    return folder / f"{junction}.{part}.json"


def write_table(path: Path, columns: Mapping[str, Any]) -> None:
    """Write columns as Parquet; lists of arrays become list columns."""
    arrays = {}
    for name, values in columns.items():
        is_list = len(values) > 0 and isinstance(values[0], np.ndarray)
        arrays[name] = (
            pa.array([row.tolist() for row in values], pa.list_(pa.float64())) if is_list else pa.array(values)
        )
    with files.atomic_write(path) as partial:
        pq.write_table(pa.table(arrays), partial, compression="zstd", version="2.6")


def read_table(path: Path) -> pa.Table:
    """Read a table of the study.

    Raises
    ------
    InputError
        If it is missing or damaged.
    """
    try:
        return pq.read_table(path)
    except (OSError, pa.ArrowInvalid) as error:
        raise InputError(path, f"expected a record of the study, got an error: {error}", "Measure it again.") from None


@dataclass(frozen=True, eq=False)
class MeasureRecord:
    """One measure of one detector at the candidates of a junction.

    Attributes
    ----------
    values
        (n,) float64, 0 to 1; NaN where undefined.
    left_out
        With each block of frames left out, (n, blocks) float64.
    halves
        Of the even and of the odd blocks of frames, (n, 2) float64.
    """

    values: FloatArray
    left_out: FloatArray
    halves: FloatArray


@dataclass(frozen=True, eq=False)
class JunctionRecord:
    """All that the tables need of one junction.

    Attributes
    ----------
    sites, height_m, sensors
        Name, height above the ground and sensor of each of the n candidates.
    scores
        Values of each score, (n,) float64, with a sign such that more is better; NaN where undefined. Empty where the
        part was not measured.
    detections
        By detector and measure.
    infos
        By part.
    """

    name: str
    role: str
    sites: tuple[str, ...]
    height_m: FloatArray
    sensors: tuple[str, ...]
    scores: Mapping[str, FloatArray]
    detections: Mapping[str, Mapping[str, MeasureRecord]]
    infos: Mapping[str, PartInfo]


def read_junction(folder: Path, name: str) -> JunctionRecord:
    """Read the records of a junction that are there.

    Raises
    ------
    InputError
        If nothing was measured there, or a file is damaged.
    """
    infos = {
        path.name.removeprefix(f"{name}.").removesuffix(".json"): PartInfo.read(path)
        for path in sorted(folder.glob(f"{name}.*.json"))
    }
    if not infos:
        raise InputError(folder, f"{name} has no records", f"Measure them: measure --junction {name}")
    candidates = read_table(folder / f"{name}.candidates.parquet").to_pydict()
    sites = tuple(candidates["site"])
    return JunctionRecord(
        name, next(iter(infos.values())).role, sites, np.array(candidates["height_m"]), tuple(candidates["sensor"]),
        _read_scores(folder, name, sites) if SCORES in infos else {},
        {part: _read_measures(folder, name, part, sites) for part in infos if part not in NOT_DETECTORS}, infos,
    )  # fmt: skip


def _read_scores(folder: Path, name: str, sites: tuple[str, ...]) -> dict[str, FloatArray]:
    rows = read_table(folder / f"{name}.{SCORES}.parquet").to_pylist()
    position = {site: number for number, site in enumerate(sites)}
    scores: dict[str, FloatArray] = {}
    for row in rows:
        scores.setdefault(row["score"], np.full(len(sites), np.nan))[position[row["site"]]] = row["sign"] * row["value"]
    return scores


def _read_measures(folder: Path, name: str, part: str, sites: tuple[str, ...]) -> dict[str, MeasureRecord]:
    rows = read_table(folder / f"{name}.{part}.parquet").to_pylist()
    of = {(row["measure"], row["site"]): row for row in rows}
    measures = {}
    for measure in dict.fromkeys(row["measure"] for row in rows):
        each = [of[measure, site] for site in sites]
        measures[measure] = MeasureRecord(
            np.array([row["value"] for row in each], dtype=np.float64),
            np.array([row["left_out"] for row in each], dtype=np.float64),
            np.array([[row["half_1"], row["half_2"]] for row in each], dtype=np.float64),
        )
    return measures


def junction_names(folder: Path) -> list[str]:
    """Return the names of the junctions with records, sorted."""
    return sorted({path.name.split(".")[0] for path in folder.glob("*.json")})
