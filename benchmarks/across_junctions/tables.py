"""Tables of the study, from its Parquet records alone.

1. What was measured: traffic, AP, its standard error, reliability and ceiling.
2. By junction and detector: rho, rho within heights and within sensors, regret, and the first three, of the main score
   and the baselines.
3. The same over junctions of a role, with intervals that resample junctions.
4. Rho within each height.
5. Rho within each sensor, over junctions.
6. All scores.
7. The aims of the protocol.
8. Parts: source, time, machine.

Rows of detectors that took part in training the score and of others are marked.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.across_junctions.protocol import MIN_SITES_OF_A_HEIGHT, ROLES
from benchmarks.across_junctions.records import AP, JunctionRecord, junction_names, read_junction
from benchmarks.across_junctions.statistics import (
    MIN_SITES_OF_A_SENSOR,
    POINTS,
    RESAMPLES,
    DetectedJunction,
    Estimate,
    mean_of,
    median_of,
    over_junctions,
    regret,
    rho,
)
from benchmarks.validity import tables
from benchmarks.validity.pools import DEFAULT, Setting
from benchmarks.validity.tables import Cell, Column, Table, number, with_interval
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.scoring.target_scores import DETECTORS
from egvs.validation.correlation import MeasureValues

MAIN = "expected_detections"
HEIGHT = "height"

EGVS_2, EGVS_10 = (str(Setting(gamma, DEFAULT.voxel_m, False)) for gamma in (2.0, 10.0))

FIXED_BASELINES = ("mean_points", "points_on_target", EGVS_2, EGVS_10)

POOLED_AIM, HEIGHT_AIM, OF_CEILING = 0.93, 0.85, 0.95
REGRET_MEDIAN_AIM, REGRET_WORST_AIM = 3.0, 8.0
"""Aims at the held-out junctions: each rho, or this share of the ceiling where that is lower; regret in points."""


def write_tables(records_folder: Path, out: Path, resamples: int = RESAMPLES) -> list[str]:
    """Write all tables as CSV and Markdown, and return what to print.

    Raises
    ------
    InputError
        Without any records, or where a file is damaged.
    """
    names = junction_names(records_folder)
    if not names:
        raise InputError(records_folder, "expected records, got none", "Measure first: across_junctions measure.")
    records = [read_junction(records_folder, name) for name in names]
    records.sort(key=lambda record: (ROLES.index(record.role), record.name))
    study = Study(records, resamples)
    made = list(study.tables())
    preface = study.preface()
    tables.write(out, preface, made)
    (out / "tables.md").write_text(tables.page("The larger study", preface, made), encoding="utf-8")
    return [*preface, f"{out}: {len(made)} tables"]


class Study:
    """All records, and the tables made from them.

    Parameters
    ----------
    records
        Of the junctions, those of each role together.
    """

    def __init__(self, records: Sequence[JunctionRecord], resamples: int = RESAMPLES) -> None:
        self.records = list(records)
        self.detectors = sorted({name for record in records for name in record.detections})
        height_sign = self._height_sign()
        self.junctions = {
            (record.name, detector): _detected(record, detector, height_sign[detector], resamples)
            for record in self.records
            for detector in self.detectors
            if detector in record.detections
        }
        self._estimates: dict[tuple[str, str, str, str], Estimate] = {}

    def _height_sign(self) -> dict[str, float]:
        """Return for each detector whether higher candidates are better, 1 or -1, at the training junctions."""
        signs: dict[str, float] = {}
        for detector in self.detectors:
            each = [
                rho(record.height_m[None, :], record.detections[detector][AP].values[None, :])[0]
                for record in self.records
                if record.role == "training" and detector in record.detections
            ]
            each = [value for value in each if math.isfinite(value)]
            if not each:  # a detector that is run at held-out junctions only: as for those that are not
                each = [value for other, value in signs.items() if other != detector]
            signs[detector] = 1.0 if each and sum(each) > 0.0 else -1.0
        return signs

    @property
    def sources(self) -> set[str]:
        """Digests of the source, by which all parts of one kind should be measured."""
        return {f"{part}: {info.source}" for record in self.records for part, info in record.infos.items()}

    def preface(self) -> list[str]:
        """Return the conditions of the study, and what to know before trusting its numbers."""
        infos = [info for record in self.records for info in record.infos.values()]
        hours = sum(info.seconds for info in infos) / 3600
        machines = sorted({f"{info.machine['processor']}, {info.machine['cores']} cores" for info in infos})
        texts = [
            f"{len(self.records)} junctions, detectors {', '.join(self.detectors) or 'none'}; {len(infos)} parts,"
            f" {hours:.2f} hours on {'; '.join(machines)}."
        ]
        if any(info.is_trial for info in infos):
            texts.append("A trial: fewer frames or candidates than the protocol says. No result.")
        protocols = {info.protocol for info in infos}
        texts.append(f"Protocol: {', '.join(sorted(protocols))}.")
        for part in sorted({info.part for info in infos}):
            digests = {info.source for info in infos if info.part == part}
            if len(digests) > 1:
                texts.append(f"Parts {part} were measured with {len(digests)} versions of the source.")
        return texts

    # ---- estimates

    def pairs(self, role: str) -> Iterator[tuple[str, list[JunctionRecord]]]:
        """Yield each detector with the junctions of a role where it was run."""
        for detector in self.detectors:
            records = [r for r in self.records if r.role == role and (r.name, detector) in self.junctions]
            if records:
                yield detector, records

    def scores(self) -> list[str]:
        """Return the main score, in all its variants, and the baselines, as far as every junction has them."""
        known = self.all_scores()
        main = [name for name in known if name == MAIN or name.startswith(f"{MAIN} ")]
        return [*main, HEIGHT, *(name for name in FIXED_BASELINES if name in known)]

    def all_scores(self) -> list[str]:
        """Return the scores that every junction has, in their order."""
        first, *others = (record.scores for record in self.records)
        return [name for name in first if all(name in other for other in others)]

    def estimate(self, record: JunctionRecord, detector: str, score: str, kind: str) -> Estimate:
        """Return a statistic of :data:`STATISTICS` at one junction."""
        key = record.name, detector, score, kind
        if key not in self._estimates:
            self._estimates[key] = STATISTICS[kind](self.junctions[record.name, detector], score)
        return self._estimates[key]

    def over(self, records: Sequence[JunctionRecord], detector: str, score: str, kind: str,
             summary: Callable[[FloatArray], FloatArray] = mean_of) -> Estimate:  # fmt: skip
        """Return the mean, or another summary, over junctions."""
        each = {record.name: self.estimate(record, detector, score, kind) for record in records}
        return over_junctions(each, summary, limits=(0.0, POINTS) if kind == "regret" else (-1.0, 1.0))

    # ---- tables

    def tables(self) -> Iterator[Table]:
        """Yield all tables."""
        yield self._measured()
        yield self._by_junction()
        yield self._over_junctions()
        yield self._by_height()
        yield self._by_sensor()
        yield self._all_scores()
        yield self._aims()
        yield self._parts()

    def _measured(self) -> Table:
        rows: list[list[Cell]] = []
        for (name, detector), junction in self.junctions.items():
            record = next(record for record in self.records if record.name == name)
            info = record.infos[detector]
            ap = junction.ap.values * POINTS
            rows.append([
                name, record.role, detector, _trained(detector), info.frames, info.vehicles, info.vehicle_frames,
                len(record.sites), number(float(np.nanmin(ap))), number(float(np.nanmean(ap))),
                number(float(np.nanmax(ap))), number(float(np.nanmean(_standard_errors(junction.ap)) * POINTS)),
                number(junction.reliability()), number(junction.ceiling()),
            ])  # fmt: skip
        head = [Column("junction"), Column("role"), Column("detector"), Column("trained the score"),
                Column("frames", "whole"), Column("different vehicles", "whole"), Column("vehicle-frames", "whole"),
                Column("candidates", "whole"), Column("worst AP", "one"), Column("mean AP", "one"),
                Column("best AP", "one"), Column("mean standard error", "one"), Column("reliability", "two"),
                Column("ceiling of rho", "two")]  # fmt: skip
        caption = (
            "AP is the mean of BEV and 3D (R40, IoU 0.7), in points of 100. Reliability: rho of AP between two halves"
            " of the frames, corrected by Spearman-Brown; the ceiling is its square root."
        )
        return Table("1 measured", "1. What was measured", caption, head, rows)

    def _by_junction(self) -> Table:
        rows: list[list[Cell]] = []
        for role in ROLES:
            for detector, records in self.pairs(role):
                for record in records:
                    junction = self.junctions[record.name, detector]
                    for score in self.scores():
                        cells = [_cell(self.estimate(record, detector, score, kind)) for kind in STATISTICS]
                        rows.append([
                            record.name, role, detector, _trained(detector), score, *cells,
                            number(junction.best_in_first(score)),
                        ])  # fmt: skip
        head = [Column("junction"), Column("role"), Column("detector"), Column("trained the score"), Column("score"),
                Column("rho", "two"), Column("rho within heights", "two"), Column("rho within sensors", "two"),
                Column("regret", "one"), Column("P(best in first three)", "two")]  # fmt: skip
        caption = (
            "By junction. Regret in points of AP. Intervals of 95 % resample candidates and blocks of frames (within"
            f" sensors: frames only). Heights of at least {MIN_SITES_OF_A_HEIGHT} candidates, sensors of at least"
            f" {MIN_SITES_OF_A_SENSOR}. Height alone counts in the direction that was better at the training junctions."
        )
        return Table("2 by junction", "2. By junction", caption, head, rows)

    def _over_junctions(self) -> Table:
        rows: list[list[Cell]] = []
        for role in ROLES:
            for detector, records in self.pairs(role):
                for score in self.scores():
                    each = {
                        kind: [self.estimate(record, detector, score, kind).value for record in records]
                        for kind in STATISTICS
                    }
                    first = [self.junctions[record.name, detector].best_in_first(score) for record in records]
                    rows.append([
                        role, detector, _trained(detector), score, len(records),
                        _cell(self.over(records, detector, score, "rho")), _least(each["rho"]), _most(each["rho"]),
                        _cell(self.over(records, detector, score, "rho within heights")),
                        _least(each["rho within heights"]),
                        _cell(self.over(records, detector, score, "rho within sensors")),
                        _cell(self.over(records, detector, score, "regret", median_of)), _most(each["regret"]),
                        number(float(np.mean(first))),
                    ])  # fmt: skip
        head = [Column("role"), Column("detector"), Column("trained the score"), Column("score"),
                Column("junctions", "whole"), Column("mean rho", "two"), Column("lowest", "two"),
                Column("highest", "two"), Column("mean rho within heights", "two"),
                Column("lowest within heights", "two"), Column("mean rho within sensors", "two"),
                Column("median regret", "one"), Column("worst regret", "one"),
                Column("mean P(best in first three)", "two")]  # fmt: skip
        caption = "Over junctions. Intervals of 95 % resample junctions, candidates and blocks of frames."
        return Table("3 over junctions", "3. Over junctions", caption, head, rows)

    def _by_height(self) -> Table:
        rows: list[list[Cell]] = []
        for (name, detector), junction in self.junctions.items():
            for score in self.scores():
                for height, estimate in junction.by_group(score, junction.heights, MIN_SITES_OF_A_HEIGHT).items():
                    ceiling = junction.ceiling(junction.heights == float(height))
                    rows.append([name, detector, score, height, estimate.count, _cell(estimate), number(ceiling)])
        head = [Column("junction"), Column("detector"), Column("score"), Column("height, m"),
                Column("candidates", "whole"), Column("rho", "two"), Column("ceiling", "two")]  # fmt: skip
        caption = f"Rho among candidates of equal height, {MIN_SITES_OF_A_HEIGHT} or more."
        return Table("4 by height", "4. Within each height", caption, head, rows)

    def _by_sensor(self) -> Table:
        rows: list[list[Cell]] = []
        for role in ROLES:
            for detector, records in self.pairs(role):
                for score in self.scores():
                    each = [self._sensors_of(record.name, detector, score) for record in records]
                    for sensor in sorted({name for entry in each for name in entry}):
                        of = {str(i): entry[sensor] for i, entry in enumerate(each) if sensor in entry}
                        estimate = over_junctions(of)
                        rows.append([role, detector, score, sensor, estimate.count, _cell(estimate)])
        head = [Column("role"), Column("detector"), Column("score"), Column("sensor"), Column("junctions", "whole"),
                Column("mean rho", "two")]  # fmt: skip
        caption = (
            f"Mean over junctions of rho among the candidates of one sensor ({MIN_SITES_OF_A_SENSOR} or more per"
            " junction: few, so single values mean little). Intervals resample junctions and frames."
        )
        return Table("5 by sensor", "5. Within each sensor", caption, head, rows)

    def _sensors_of(self, name: str, detector: str, score: str) -> dict[str, Estimate]:
        junction = self.junctions[name, detector]
        return junction.by_group(score, junction.sensors, MIN_SITES_OF_A_SENSOR)

    def _all_scores(self) -> Table:
        rows: list[list[Cell]] = []
        for role in ROLES:
            for detector, records in self.pairs(role):
                for score in [HEIGHT, *self.all_scores()]:
                    values = [self._rho(record, detector, score) for record in records]
                    defined = [value for value in values if math.isfinite(value)]
                    mean = float(np.mean(defined)) if defined else float("nan")
                    rows.append([role, detector, score, len(defined), number(mean), _least(values), _most(values)])
        head = [Column("role"), Column("detector"), Column("score"), Column("junctions", "whole"),
                Column("mean rho", "two"), Column("lowest", "two"), Column("highest", "two")]  # fmt: skip
        caption = "Every installed score with each of its parameters; without intervals."
        return Table("6 all scores", "6. All scores", caption, head, rows)

    def _rho(self, record: JunctionRecord, detector: str, score: str) -> float:
        junction = self.junctions[record.name, detector]
        rows = junction.defined(score)
        if int(rows.sum()) < 3:
            return float("nan")
        return float(rho(junction.scores[score][rows][None, :], junction.ap.values[rows][None, :])[0])

    def _aims(self) -> Table:
        rows: list[list[Cell]] = []
        main = [name for name in self.scores() if name.startswith(MAIN)]
        for detector, records in self.pairs("held out"):
            for score in main:
                for record in records:
                    rows += self._aims_at(record, detector, score)
                lost = [self.estimate(record, detector, score, "regret").value for record in records]
                for what, value, aim in (
                    ("regret, median", float(np.median(lost)), REGRET_MEDIAN_AIM),
                    ("regret, worst", max(lost), REGRET_WORST_AIM),
                ):
                    met = "yes" if value <= aim else "no"
                    rows.append([f"{len(records)} junctions", detector, _trained(detector), score, what,
                                 number(value), number(aim), met])  # fmt: skip
        head = [Column("junction"), Column("detector"), Column("trained the score"), Column("score"), Column("aim"),
                Column("value", "two"), Column("limit", "two"), Column("reached")]  # fmt: skip
        caption = (
            f"Aims at the held-out junctions: rho of {POOLED_AIM}, and {HEIGHT_AIM} among candidates of equal height,"
            f" or {OF_CEILING:.0%} of the ceiling where that is lower; regret of at most {REGRET_MEDIAN_AIM:g} points"
            f" in the median and {REGRET_WORST_AIM:g} at worst."
        )
        return Table("7 aims", "7. Aims", caption, head, rows)

    def _aims_at(self, record: JunctionRecord, detector: str, score: str) -> Iterator[list[Cell]]:
        junction = self.junctions[record.name, detector]
        start: list[Cell] = [record.name, detector, _trained(detector), score]
        estimate = self.estimate(record, detector, score, "rho")
        yield [*start, "rho", *_compare_with_aim(estimate.value, POOLED_AIM, junction.ceiling())]
        for height, of_height in junction.by_group(score, junction.heights, MIN_SITES_OF_A_HEIGHT).items():
            ceiling = junction.ceiling(junction.heights == float(height))
            yield [*start, f"rho at {height} m", *_compare_with_aim(of_height.value, HEIGHT_AIM, ceiling)]

    def _parts(self) -> Table:
        rows: list[list[Cell]] = [
            [record.name, part, info.frames, info.candidates, number(info.seconds / 60), info.source[:12],
             info.protocol[:12], f"{info.machine['processor']}, {info.machine['cores']} cores"]
            for record in self.records
            for part, info in record.infos.items()
        ]  # fmt: skip
        head = [Column("junction"), Column("part"), Column("frames", "whole"), Column("candidates", "whole"),
                Column("minutes", "one"), Column("source"), Column("protocol"), Column("machine")]  # fmt: skip
        return Table("8 parts", "8. Parts", "What was measured, by which source, on which machine.", head, rows)


STATISTICS: dict[str, Callable[[DetectedJunction, str], Estimate]] = {
    "rho": lambda junction, score: junction.estimate(score, rho),
    "rho within heights": lambda junction, score: junction.in_groups(score, junction.heights, MIN_SITES_OF_A_HEIGHT),
    "rho within sensors": lambda junction, score: junction.in_groups(score, junction.sensors, MIN_SITES_OF_A_SENSOR),
    "regret": lambda junction, score: junction.estimate(score, regret),
}
"""Statistics of a score at one junction, in the order of the columns."""


def _detected(record: JunctionRecord, detector: str, height_sign: float, resamples: int) -> DetectedJunction:
    measure = record.detections[detector][AP]
    scores = {**record.scores, HEIGHT: height_sign * record.height_m}
    return DetectedJunction(
        record.name, MeasureValues(measure.values, measure.left_out), measure.halves, scores, record.height_m,
        np.array(record.sensors, dtype=np.str_), resamples,
    )  # fmt: skip


def _standard_errors(measure: MeasureValues) -> FloatArray:
    """Return the jackknife's standard error of each candidate, (n,)."""
    blocks = measure.left_out.shape[1]
    spread = measure.left_out - measure.left_out.mean(axis=1, keepdims=True)
    errors: FloatArray = np.sqrt((blocks - 1) / blocks * (spread**2).sum(axis=1))
    return errors


def _trained(detector: str) -> str:
    return "yes" if detector in DETECTORS else "no"


def _cell(estimate: Estimate) -> Cell:
    return with_interval(estimate.value, estimate.interval)


def _least(values: Sequence[float]) -> Cell:
    defined = [value for value in values if math.isfinite(value)]
    return number(min(defined)) if defined else None


def _most(values: Sequence[float]) -> Cell:
    defined = [value for value in values if math.isfinite(value)]
    return number(max(defined)) if defined else None


def _compare_with_aim(value: float, aim: float, ceiling: float) -> list[Cell]:
    """Return a value, its limit, and whether it is reached; without a ceiling, the aim is the limit."""
    limit = aim if math.isnan(ceiling) else min(aim, OF_CEILING * ceiling)
    return [number(value), number(limit), "yes" if value >= limit else "no"]
