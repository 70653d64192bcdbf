"""The whole study: what is measured, in which order, and what is made of it."""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.validity import agreement, failures, foretold, gaps, heights, junctions, low_models, poses
from benchmarks.validity.agreement import WORDS
from benchmarks.validity.junctions import StudyJunction
from benchmarks.validity.looking_from import FAST, first_places, sites_of
from benchmarks.validity.measuring import Part
from benchmarks.validity.pools import SEED, Pools
from benchmarks.validity.record import BESIDE_BOXED, Record, measures_of
from benchmarks.validity.tables import Cell, Column, Table, number
from egvs.sensors.sites import Site
from egvs.validation.correlation import RESAMPLES
from egvs.validation.results import ScoreName
from egvs.validation.sweeps import POINT_COUNTS_NAME

FRAMES, SENSOR_FRAMES = 250, 60
APART_S, SENSOR_APART_S = 7.0, 29.0
"""Between two frames: half an hour of traffic in all, for signals turn in 71 to 137 s; in step with none of them."""

SENSORS = ("VLP-16", "VLP-32C", "OS1-64", "OS1-128")
"""Compared at the first places of the grid of the training junctions."""

_CORE_MS = {POINT_COUNTS_NAME: 4.0, "cluster": 25.0}
_OTHER_CORE_MS = 80.0
"""Of one core, a frame: what the plan reckons with."""


@dataclass(frozen=True)
class Extent:
    """How much is measured.

    Attributes
    ----------
    frames, sensor_frames
        Of unseen traffic; of that where sensors are compared, which 0 leaves out.
    places
        Of the grid.
    """

    frames: int = FRAMES
    sensor_frames: int = SENSOR_FRAMES
    places: int = poses.PLACES


def parts(each: Sequence[StudyJunction], detectors: Sequence[str], extent: Extent, folder: Path) -> list[Part]:
    """What is measured: every junction with its own sensor, then the training junctions with several sensors."""
    fast = [name for name in detectors if name in FAST]
    found = []
    for junction in each:
        sites = (*junction.given, *junction.grid)
        looks = {name: its for name in detectors if (its := frozenset(s.name for s in sites_of(name, junction)))}
        sensor, frames = junction.scenario.sites.sensor, (extent.frames, APART_S)
        found.append(_part(junction, junction.name, sensor, sites, looks, frames, folder))
    for junction in each:
        if junction.role == "training" and extent.sensor_frames:
            for sensor in SENSORS:
                sites = first_places(junction.grid)
                looks = {name: frozenset(site.name for site in sites) for name in fast}
                name = f"{junction.name}-{sensor}"
                frames = extent.sensor_frames, SENSOR_APART_S
                found.append(_part(junction, name, sensor, sites, looks, frames, folder, ("egvs",)))
    return found


def _part(
    junction: StudyJunction, name: str, sensor: str, sites: tuple[Site, ...], looks: dict[str, frozenset[str]],
    frames: tuple[int, float], folder: Path, scores: tuple[str, ...] | None = None,
) -> Part:  # fmt: skip
    scenario = junctions.posed(junction.scenario, sites, folder / f"{name}.sites.csv", sensor if scores else None)
    given = frozenset(site.name for site in junction.given)
    return Part(name, junction.name, junction.role, sensor, scenario, sites, given, looks, *frames, scores)


def reckoned_s(part: Part) -> float:
    """Seconds of one core that looking takes, roughly."""
    each = {name: _CORE_MS.get(name, _OTHER_CORE_MS) * len(sites) for name, sites in part.detectors.items()}
    return sum(each.values()) * part.frames / 1e3


def tables_of(records: Sequence[Record], with_sensors: Sequence[Record], detectors: Sequence[str]) -> Iterator[Table]:
    """Every table of the page. Detectors that are there for mounting heights alone have no coefficients."""
    known = foretold.before(records)
    every = [Pools(known, name) for name in detectors if name not in low_models.NAMES]
    each = [pools for pools in every if pools.records]
    yield measured_table(records, detectors)
    yield gaps.table(each, known)
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
    yield from foretold.tables(records, detectors)


def measured_table(records: Sequence[Record], detectors: Sequence[str]) -> Table:
    """What was looked at, how much is detected there, and how sure that is."""
    rows: list[list[Cell]] = []
    for record in records:
        for name in (name for name in detectors if name in record.detections):
            for measure in (*measures_of(name), *(BESIDE_BOXED if name != POINT_COUNTS_NAME else ())):
                its = record.detections[name][measure]
                given = sum(record.sites[site].is_given for site in its.sites)
                values = np.array([its.values, its.se]) * 100.0
                rows.append([
                    record.junction, record.role, given, len(its.sites) - given, record.frames,
                    number(record.objects / record.frames), name, WORDS[measure], number(float(values[0].min())),
                    number(float(values[0].mean())), number(float(values[0].max())), number(float(values[1].mean())),
                ])  # fmt: skip
    head = [Column("junction"), Column("role"), Column("given sites", "whole"), Column("grid", "whole"),
            Column("frames", "whole"), Column("vehicles per frame", "one"), Column("detector"), Column("measure"),
            Column("worst site", "one"), Column("mean", "one"), Column("best site", "one"),
            Column("mean standard error", "one")]  # fmt: skip
    caption = (
        "Number of sites that each detector was run at, and what it detected, in per cent (AP is BEV + 3D, up to 200;"
        " log points times 100)."
    )
    return Table("0 measured", "What was measured", caption, head, rows)


def preface(
    records: Sequence[Record], with_sensors: Sequence[Record], detectors: Sequence[str], without: Sequence[str]
) -> list[str]:
    """The conditions of the study: detectors, frames, seeds, and what is missing."""
    seeds = "; ".join(f"{r.junction}: TPOG {r.seeds['TPOG']}, held-out traffic {r.seeds['unseen']}" for r in records)
    found = [
        f"Detectors: {', '.join(detectors)}. Frames: {', '.join(f'{r.junction} {r.frames}' for r in records)}"
        + (f"; sensors compared on {with_sensors[0].frames}" if with_sensors else "")
        + f". Seeds: {seeds}; {RESAMPLES} resamples of seed {SEED}.",
    ]
    if without:
        found.append("Without: " + "; ".join(without) + ".")
    if any(record.junction in junctions.OSM.values() for record in records):
        found.append("Map data of the junctions from OpenStreetMap (c) OpenStreetMap contributors, ODbL.")
    return found


def costs(folder: Path, names: Sequence[str]) -> Table:
    """Milliseconds per site of every score: the mean of the junctions' medians."""
    each: dict[str, list[float]] = {}
    for path in (folder / f"{name}.costs.json" for name in names):
        for score, by in json.loads(path.read_text(encoding="utf-8")).items():
            for parameters, ms in by.items():
                each.setdefault(str(ScoreName(score, parameters)), []).append(ms)
    rows: list[list[Cell]] = [[name, round(statistics.mean(its), 1)] for name, its in each.items()]
    caption = (
        "Milliseconds of one core per site, each score as if it were the only one. Mean over the junctions of"
        " [the study](validity.md), on a machine that was busy with it. Other machines and later versions differ."
    )
    return Table("costs", "Milliseconds per site", caption, [Column("score"), Column("ms per site", "one")], rows)
