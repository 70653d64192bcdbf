"""The complete study: what is measured, in which order, and the tables."""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.validity import (
    agreement,
    failures,
    heights,
    junctions,
    low_models,
    poses,
    recommended_score,
    undefined_values,
)
from benchmarks.validity.agreement import WORDS
from benchmarks.validity.detector_sites import FAST, first_places, sites_of
from benchmarks.validity.junctions import StudyJunction
from benchmarks.validity.measurement import Part
from benchmarks.validity.pools import SEED, Pools
from benchmarks.validity.record import FURTHER_BOX_MEASURES, Record, measures_of
from benchmarks.validity.tables import Cell, Column, Table, number
from egvs.clouds.sweeps import POINT_COUNTS_NAME
from egvs.extensions.validation.correlation import RESAMPLES
from egvs.extensions.validation.results import ScoreName
from egvs.sensors.sites import Site

FRAMES, SENSOR_FRAMES = 250, 60
APART_S, SENSOR_APART_S = 7.0, 29.0
"""Seconds between frames: half an hour of traffic in total, not a multiple of signal cycles (71 to 137 s)."""

SENSORS = ("VLP-16", "VLP-32C", "OS1-64", "OS1-128")
"""Sensors compared at the first locations of the grid of the training junctions."""

_CORE_MS = {POINT_COUNTS_NAME: 4.0, "cluster": 25.0}
_OTHER_CORE_MS = 80.0
"""Estimated processor time per frame and site."""


@dataclass(frozen=True)
class Extent:
    """How much is measured.

    Attributes
    ----------
    frames, sensor_frames
        Frames of held-out traffic, for all parts and for the comparison of sensors (0: no comparison).
    places
        Locations of the grid.
    """

    frames: int = FRAMES
    sensor_frames: int = SENSOR_FRAMES
    places: int = poses.PLACES


def parts(each: Sequence[StudyJunction], detectors: Sequence[str], extent: Extent, folder: Path) -> list[Part]:
    """Return every junction with its own sensor, then the training junctions with several sensors."""
    fast = [name for name in detectors if name in FAST]
    parts_ = []
    for junction in each:
        sites = (*junction.given, *junction.grid)
        detectors_by_site = {
            name: names for name in detectors if (names := frozenset(s.name for s in sites_of(name, junction)))
        }
        sensor, frames = junction.scenario.sites.sensor, (extent.frames, APART_S)
        parts_.append(_part(junction, junction.name, sensor, sites, detectors_by_site, frames, folder))
    for junction in each:
        if junction.role == "training" and extent.sensor_frames:
            for sensor in SENSORS:
                sites = first_places(junction.grid)
                detectors_by_site = {name: frozenset(site.name for site in sites) for name in fast}
                name = f"{junction.name}-{sensor}"
                frames = extent.sensor_frames, SENSOR_APART_S
                parts_.append(_part(junction, name, sensor, sites, detectors_by_site, frames, folder, ("egvs",)))
    return parts_


def _part(
    junction: StudyJunction, name: str, sensor: str, sites: tuple[Site, ...],
    detectors_by_site: dict[str, frozenset[str]], frames: tuple[int, float], folder: Path,
    scores: tuple[str, ...] | None = None,
) -> Part:  # fmt: skip
    scenario = junctions.with_sites(junction.scenario, sites, folder / f"{name}.sites.csv", sensor if scores else None)
    given = frozenset(site.name for site in junction.given)
    return Part(name, junction.name, junction.role, sensor, scenario, sites, given, detectors_by_site, *frames, scores)


def estimated_s(part: Part) -> float:
    """Return the approximate processor seconds of the detectors."""
    each = {name: _CORE_MS.get(name, _OTHER_CORE_MS) * len(sites) for name, sites in part.detectors.items()}
    return sum(each.values()) * part.frames / 1e3


def tables_of(records: Sequence[Record], with_sensors: Sequence[Record], detectors: Sequence[str]) -> Iterator[Table]:
    """Yield all tables. Detectors that are used for mounting heights only have no coefficients."""
    known = recommended_score.without_later_scores(records)
    every = [Pools(known, name) for name in detectors if name not in low_models.NAMES]
    each = [pools for pools in every if pools.records]
    yield measured_table(records, detectors)
    yield undefined_values.table(each, known)
    for pools in each:
        yield from agreement.by_setting(pools)
    for pools in each:
        yield from agreement.by_kind_of_site(pools)
    yield agreement.chosen_gamma(each)
    if with_sensors:
        yield from agreement.by_sensor(with_sensors, [name for name in detectors if name in FAST])
    yield heights.table(known, detectors)
    for pools in each:
        yield from agreement.ranked(pools)
    yield from failures.tables(each)
    yield from recommended_score.tables(records, detectors)


def measured_table(records: Sequence[Record], detectors: Sequence[str]) -> Table:
    """Return what was measured, how much is detected, and the standard errors."""
    rows: list[list[Cell]] = []
    for record in records:
        for name in (name for name in detectors if name in record.detections):
            for measure in (*measures_of(name), *(FURTHER_BOX_MEASURES if name != POINT_COUNTS_NAME else ())):
                estimates = record.detections[name][measure]
                given = sum(record.sites[site].is_given for site in estimates.sites)
                values = np.array([estimates.values, estimates.se]) * 100.0
                rows.append([
                    record.junction, record.role, given, len(estimates.sites) - given, record.frames,
                    number(record.objects / record.frames), name, WORDS[measure], number(float(values[0].min())),
                    number(float(values[0].mean())), number(float(values[0].max())), number(float(values[1].mean())),
                ])  # fmt: skip
    head = [Column("junction"), Column("role"), Column("given sites", "whole"), Column("grid", "whole"),
            Column("frames", "whole"), Column("vehicles per frame", "one"), Column("detector"), Column("measure"),
            Column("worst site", "one"), Column("mean", "one"), Column("best site", "one"),
            Column("mean standard error", "one")]  # fmt: skip
    caption = (
        "Number of sites that each detector was run at, and what it detected, in per cent (AP is R40;"
        " log points times 100)."
    )
    return Table("0 measured", "What was measured", caption, head, rows)


def preface(
    records: Sequence[Record], with_sensors: Sequence[Record], detectors: Sequence[str], without: Sequence[str]
) -> list[str]:
    """Return the conditions of the study: detectors, frames, seeds, and what is missing."""
    seeds = "; ".join(f"{r.junction}: TPOG {r.seeds['TPOG']}, held-out traffic {r.seeds['unseen']}" for r in records)
    parts_ = [
        f"Detectors: {', '.join(detectors)}. Frames: {', '.join(f'{r.junction} {r.frames}' for r in records)}"
        + (f"; sensors compared on {with_sensors[0].frames}" if with_sensors else "")
        + f". Seeds: {seeds}; {RESAMPLES} resamples of seed {SEED}.",
    ]
    if without:
        parts_.append("Without: " + "; ".join(without) + ".")
    if any(record.junction in junctions.OSM.values() for record in records):
        parts_.append("Map data of the junctions from OpenStreetMap (c) OpenStreetMap contributors, ODbL.")
    return parts_


def costs(folder: Path, names: Sequence[str]) -> Table:
    """Return milliseconds per site of every score: the mean of the junctions' medians."""
    each: dict[str, list[float]] = {}
    for path in (folder / f"{name}.costs.json" for name in names):
        for score, by in json.loads(path.read_text(encoding="utf-8")).items():
            for parameters, ms in by.items():
                each.setdefault(str(ScoreName(score, parameters)), []).append(ms)
    rows: list[list[Cell]] = [[name, round(statistics.mean(values), 1)] for name, values in each.items()]
    caption = (
        "Milliseconds of one core per site, each score as if it were the only one. Mean over the junctions of"
        " [the study](validity.md), on a machine that was busy with it. Other machines and later versions differ."
    )
    return Table("costs", "Milliseconds per site", caption, [Column("score"), Column("ms per site", "one")], rows)
