"""Tables of the study, from its Parquet records alone.

1. What was measured: traffic, AP, its standard error, reliability and ceiling.
2. By junction and detector: rho, rho within heights and within sensors, regret, and the first three, of the main score
   and the baselines.
3. The same over junctions of a role, with intervals that resample junctions.
4. The main score minus each baseline, with the same resamples.
5. Rho within each height.
6. Rho within each sensor, over junctions.
7. All scores.
8. The aims of the protocol, over junctions.
9. The same at each junction, and each height.
10. The level: the share of vehicles that candidates are expected to find, and the share that was found.
11. The reliability of the model's probabilities.
12. Parts: source, time, machine.
13. EGVS by gamma, voxel size and moving occlusion.

Rows of detectors that took part in training the score and of others are marked.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.stats import rankdata

from benchmarks.across_junctions import calibration, table_files
from benchmarks.across_junctions.detections import AP
from benchmarks.across_junctions.egvs_settings import DEFAULT, SETTINGS, Setting
from benchmarks.across_junctions.models.figures import Curves, draw_reliability
from benchmarks.across_junctions.protocol import MIN_SITES_OF_A_HEIGHT, ROLES, Protocol, check_frozen, frozen_again
from benchmarks.across_junctions.records import VEHICLES, JunctionRecord, junction_names, read_junction
from benchmarks.across_junctions.statistics import (
    MIN_SITES_OF_A_SENSOR,
    POINTS,
    RESAMPLES,
    DetectedJunction,
    Estimate,
    over_junctions,
    rho,
    standard_errors,
)
from benchmarks.across_junctions.table_files import Cell, Column, Table, number, with_interval
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.extensions.validation.correlation import MeasureValues
from egvs.scoring.target_scores import DETECTORS

UNSEEN_ROLES = tuple(role for role in ROLES if role != "training")

MAIN = "expected_detections"
"""Its variant with the mean of all detectors is the one that the aims are for."""

FITTED_BASELINES = HEIGHT, SENSOR, SENSOR_HEIGHT = "height", "sensor", "sensor and height"
"""Baselines that know nothing of a place: fitted to the ranks of AP at the training junctions."""

EGVS_2, EGVS_10 = (str(Setting(gamma, DEFAULT.voxel_m, False)) for gamma in (2.0, 10.0))

FIXED_BASELINES = ("mean_points", "points_on_target", "seen_well", EGVS_2, EGVS_10)

POOLED_AIM, HEIGHT_AIM, OF_CEILING = 0.93, 0.85, 0.95
REGRET_MEDIAN_AIM, REGRET_WORST_AIM = 3.0, 8.0
LEVEL_MEAN_AIM, LEVEL_WORST_AIM = 5.0, 10.0
"""Aims at the held-out junctions: each rho, or this share of the ceiling where that is lower; regret, and the root mean
square error of the level, in points."""

REACHED, MISSED, UNDECIDED = "reached", "missed", "undecided"


def write_tables(
    records_folder: Path, out: Path, protocol: Protocol, protocol_digest: str, resamples: int = RESAMPLES
) -> list[str]:
    """Write all tables as CSV and Markdown, and reliability diagrams, and return what to print.

    Parameters
    ----------
    protocol, protocol_digest
        What should have been measured, and its hash.

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
    study = Study(records_folder, records, protocol, protocol_digest, resamples)
    made = list(study.tables())
    preface = study.preface()
    table_files.write(out, preface, made)
    (out / "tables.md").write_text(table_files.page("The larger study", preface, made), encoding="utf-8")
    diagrams = {out / f"reliability_{detector}.png": detector for detector in study.reliability}
    for path, detector in diagrams.items():
        draw_reliability(path, detector, study.reliability[detector], "predicted by the shipped models")
    return [*preface, f"{out}: {len(made)} tables", *map(str, diagrams)]


class Study:
    """All records, and the tables made from them.

    Parameters
    ----------
    folder
        Folder of the records.
    records
        Of the junctions, those of each role together. Junctions without the main score are listed, and the detections
        of training junctions are used for the baselines that are fitted to them; they are in no other table.
    """

    def __init__(
        self,
        folder: Path,
        records: Sequence[JunctionRecord],
        protocol: Protocol,
        protocol_digest: str,
        resamples: int = RESAMPLES,
    ) -> None:
        self.folder = folder
        self.measured = list(records)
        self.records = [record for record in records if any(name.startswith(MAIN) for name in record.scores)]
        self.protocol, self.protocol_digest = protocol, protocol_digest
        self.detectors = sorted({name for record in records for name in record.detections})
        baselines = TrainedBaselines(records, self.detectors)
        self.junctions = {
            (record.name, detector): _detected(record, detector, baselines.of(record, detector), resamples)
            for record in self.records
            for detector in self.detectors
            if detector in record.detections
        }
        self._estimates: dict[tuple[str, str, str, str], Estimate] = {}

    def preface(self) -> list[str]:
        """Return the conditions of the study, and what to know before trusting its numbers."""
        infos = [info for record in self.measured for info in record.infos.values()]
        hours = sum(info.seconds for info in infos) / 3600
        machines = sorted({f"{info.machine['processor']}, {info.machine['cores']} cores" for info in infos})
        texts = [
            f"{len(self.measured)} junctions, detectors {', '.join(self.detectors) or 'none'}; {len(infos)} parts,"
            f" {hours:.2f} hours on {'; '.join(machines)}."
        ]
        if any(info.is_trial for info in infos):
            texts.append("A trial: fewer frames or candidates than the protocol says. No result.")
        texts.append(f"Protocol: {', '.join(sorted({info.protocol for info in infos}))}.")
        for part in sorted({info.part for info in infos}):
            digests = {info.source for info in infos if info.part == part}
            if len(digests) > 1:
                texts.append(f"Parts {part} were measured with {len(digests)} versions of the source.")
        texts += [f"INCOMPLETE: {problem}." for problem in self.missing()]
        if any(record.role == "held out" for record in self.measured):
            texts += [f"Frozen again after a held-out junction was measured: {reason}" for reason in frozen_again()]
            texts += _freeze_problems()
        for info in infos:
            texts += [f"{info.junction}: skipped {reason}" for reason in info.skipped]
            texts += [f"{info.junction} {info.part} was measured again: {reason}" for reason in info.again]
        return texts

    def missing(self) -> list[str]:
        """Return what the aims need and is not there, or was measured under another protocol."""
        texts = []
        by_name = {record.name: record for record in self.measured}
        for junction in self.protocol.junctions:
            if junction.role != "held out":
                continue
            if junction.name not in by_name:
                texts.append(f"{junction.name} was not measured")
                continue
            record = by_name[junction.name]
            texts += [
                f"{junction.name} was not measured with {detector}"
                for detector in self.protocol.detectors.held_out
                if detector not in record.detections
            ]
            texts += [f"{junction.name} has no part {VEHICLES}"] if VEHICLES not in record.infos else []
            texts += [
                f"{junction.name} {part} was measured under another protocol"
                for part, info in record.infos.items()
                if info.protocol != self.protocol_digest
            ]
            if not any(name.startswith(MAIN) for name in record.scores):
                texts.append(f"{junction.name} has no {MAIN}")
        return texts

    # ---- estimates

    def pairs(self, role: str) -> Iterator[tuple[str, list[JunctionRecord]]]:
        """Yield each detector with the junctions of a role where it was run."""
        for detector in self.detectors:
            records = [r for r in self.records if r.role == role and (r.name, detector) in self.junctions]
            if records:
                yield detector, records

    def scores(self, records: Sequence[JunctionRecord]) -> list[str]:
        """Return the main score, in all its variants, and the baselines, as far as all these junctions have them."""
        known = self.all_scores(records)
        main = [name for name in known if name == MAIN or name.startswith(f"{MAIN} ")]
        return [*main, *self.baselines(records)]

    def baselines(self, records: Sequence[JunctionRecord]) -> list[str]:
        """Return the baselines that all these junctions have."""
        known = self.all_scores(records)
        return [*self.fitted_baselines(records), *(name for name in FIXED_BASELINES if name in known)]

    def fitted_baselines(self, records: Sequence[JunctionRecord]) -> list[str]:
        """Return the baselines that are fitted to other training junctions; none where there are no others."""
        names = {record.name for record in records}
        of = [junction for (name, _), junction in self.junctions.items() if name in names]
        return [baseline for baseline in FITTED_BASELINES if all(baseline in junction.scores for junction in of)]

    def all_scores(self, records: Sequence[JunctionRecord]) -> list[str]:
        """Return the scores that all these junctions have, in the order of the first."""
        first, *others = (record.scores for record in records)
        return [name for name in first if all(name in other for other in others)]

    def main(self, records: Sequence[JunctionRecord]) -> str:
        """Return the name of the score that the aims are for: with the most detectors."""
        return max(self.variants(records), key=lambda name: name.count("+"))

    def variants(self, records: Sequence[JunctionRecord]) -> list[str]:
        """Return the variants of the main score that all these junctions have: one for each choice of detectors."""
        variants = [name for name in self.all_scores(records) if name.startswith(MAIN)]
        if not variants:
            raise InputError("scores", f"no {MAIN} at all of {', '.join(r.name for r in records)}", "Measure them.")
        return variants

    def levels(self, role: str) -> Iterator[tuple[tuple[str, ...], list[tuple[JunctionRecord, calibration.Level]]]]:
        """Yield detectors, each alone and those with a model together, with their level at each junction of a role."""
        records = [record for record in self.records if record.role == role]
        for detectors in (*((detector,) for detector in self.detectors), DETECTORS):
            each = [record for record in records if set(detectors) <= set(record.detections)]
            if each:
                yield detectors, [(r, calibration.level(r, detectors, self.main([r]))) for r in each]

    def estimate(self, record: JunctionRecord, detector: str, score: str, kind: str) -> Estimate:
        """Return a statistic of :data:`STATISTICS` at one junction."""
        key = record.name, detector, score, kind
        if key not in self._estimates:
            self._estimates[key] = STATISTICS[kind](self.junctions[record.name, detector], score)
        return self._estimates[key]

    def over(self, records: Sequence[JunctionRecord], detector: str, score: str, kind: str) -> Estimate:
        """Return the mean over junctions."""
        each = {record.name: self.estimate(record, detector, score, kind) for record in records}
        return over_junctions(each)

    @cached_property
    def reliability(self) -> dict[str, Curves]:
        """The reliability of each detector at the junctions that did not train the score."""
        unseen = [record for record in self.records if record.role in UNSEEN_ROLES]
        each = {detector: calibration.reliability(self.folder, unseen, detector) for detector in self.detectors}
        return {detector: curves for detector, curves in each.items() if curves}

    # ---- tables

    def tables(self) -> Iterator[Table]:
        """Yield all tables."""
        yield self._measured()
        yield self._by_junction()
        yield self._over_junctions()
        yield self._differences()
        yield self._by_height()
        yield self._by_sensor()
        yield self._all_scores()
        yield self._aims()
        yield self._aims_by_junction()
        yield self._level()
        yield self._reliability()
        yield self._parts()
        yield self._by_setting()

    def _measured(self) -> Table:
        rows: list[list[Cell]] = []
        for (name, detector), junction in self.junctions.items():
            record = next(record for record in self.records if record.name == name)
            info = record.infos[detector]
            ap = junction.ap.values * POINTS
            rows.append([
                name, record.role, detector, _trained(detector), info.frames, info.vehicles, info.vehicle_frames,
                len(record.sites), int((ap == 0.0).sum()), number(float(np.nanmin(ap))), number(float(np.nanmean(ap))),
                number(float(np.nanmax(ap))), number(float(np.nanmean(standard_errors(junction.ap)) * POINTS)),
                number(junction.reliability()), number(junction.ceiling()),
                number(junction.ceiling_within_heights(MIN_SITES_OF_A_HEIGHT)),
            ])  # fmt: skip
        head = [Column("junction"), Column("role"), Column("detector"), Column("trained the score"),
                Column("frames", "whole"), Column("different vehicles", "whole"), Column("vehicle-frames", "whole"),
                Column("candidates", "whole"), Column("with AP 0", "whole"), Column("worst AP", "one"),
                Column("mean AP", "one"), Column("best AP", "one"), Column("mean standard error", "one"),
                Column("reliability", "two"), Column("ceiling of rho", "two"),
                Column("ceiling within heights", "two")]  # fmt: skip
        caption = (
            "AP is the mean of BEV and 3D (R40, IoU 0.7), in points of 100. Reliability: rho of AP between two halves"
            " of the frames, corrected by Spearman-Brown; the ceiling is its square root, less what equal AP costs."
        )
        return Table("1 measured", "1. What was measured", caption, head, rows)

    def _by_junction(self) -> Table:
        rows: list[list[Cell]] = []
        for role in ROLES:
            for detector, records in self.pairs(role):
                for record in records:
                    junction = self.junctions[record.name, detector]
                    for score in self.scores(records):
                        cells = [_cell(self.estimate(record, detector, score, kind)) for kind in RHOS]
                        rows.append([
                            record.name, role, detector, _trained(detector), score, *cells,
                            number(self.estimate(record, detector, score, REGRET).value),
                            number(junction.crossed_regret(score)), number(junction.best_in_first(score)),
                            number(junction.best_in_first_resampled(score)),
                        ])  # fmt: skip
        head = [Column("junction"), Column("role"), Column("detector"), Column("trained the score"), Column("score"),
                *(Column(kind, "two") for kind in RHOS), Column("regret", "one"), Column("crossed regret", "one"),
                Column("best in first three", "two"), Column("share of resampled frames", "two")]  # fmt: skip
        caption = (
            "By junction. Rho with measured AP; intervals of 95 % resample candidates and blocks of frames (within"
            f" sensors: frames only). Heights of at least {MIN_SITES_OF_A_HEIGHT} candidates, sensors of at least"
            f" {MIN_SITES_OF_A_SENSOR}. Regret in points of AP: as measured (too high), and crossed between halves of"
            " the frames (too low). Height, sensor, and both: fitted to the ranks of AP at the training junctions (at"
            " one of these, to those of the others)."
        )
        return Table("2 by junction", "2. By junction", caption, head, rows)

    def _over_junctions(self) -> Table:
        rows: list[list[Cell]] = []
        for role in ROLES:
            for detector, records in self.pairs(role):
                for score in self.scores(records):
                    of_score = [self.junctions[record.name, detector] for record in records]
                    lost = [self.estimate(record, detector, score, REGRET).value for record in records]
                    each = [self.estimate(record, detector, score, RHO).value for record in records]
                    rows.append([
                        role, detector, _trained(detector), score, len(records),
                        *(_cell(self.over(records, detector, score, kind)) for kind in RHOS), _least(each),
                        _most(each), number(float(np.median(lost))), number(float(np.max(lost))),
                        number(float(np.median([junction.crossed_regret(score) for junction in of_score]))),
                        number(float(np.mean([junction.best_in_first(score) for junction in of_score]))),
                    ])  # fmt: skip
        head = [Column("role"), Column("detector"), Column("trained the score"), Column("score"),
                Column("junctions", "whole"), *(Column(f"mean {kind}", "two") for kind in RHOS),
                Column("lowest rho", "two"), Column("highest rho", "two"), Column("median regret", "one"),
                Column("worst regret", "one"), Column("median crossed regret", "one"),
                Column("best in first three", "two")]  # fmt: skip
        caption = (
            "Over junctions. Nominal intervals of 95 % of means resample junctions, candidates and blocks of frames."
            " Lowest, highest and worst are extremes of noisy values."
        )
        return Table("3 over junctions", "3. Over junctions", caption, head, rows)

    def _differences(self) -> Table:
        rows: list[list[Cell]] = []
        for role in ROLES:
            for detector, records in self.pairs(role):
                main = self.main(records)
                for baseline in self.baselines(records):
                    cells: list[Cell] = []
                    for kind in (*RHOS, REGRET):
                        each = {
                            record.name: self.estimate(record, detector, main, kind).minus(
                                self.estimate(record, detector, baseline, kind)
                            )
                            for record in records
                        }
                        limits = (-POINTS, POINTS) if kind == REGRET else (-2.0, 2.0)
                        cells.append(_cell(over_junctions(each, limits=limits)))
                    rows.append([role, detector, _trained(detector), baseline, len(records), *cells])
        head = [Column("role"), Column("detector"), Column("trained the score"), Column("baseline"),
                Column("junctions", "whole"), *(Column(kind, "two") for kind in RHOS),
                Column("regret", "one")]  # fmt: skip
        caption = (
            "The main score minus a baseline, mean over junctions; both have the same resamples. Above 0 the main score"
            " is better, for regret below 0."
        )
        return Table("4 differences", "4. Differences from the baselines", caption, head, rows)

    def _by_height(self) -> Table:
        rows: list[list[Cell]] = []
        for role in ROLES:
            for detector, records in self.pairs(role):
                for record in records:
                    junction = self.junctions[record.name, detector]
                    for score in self.scores(records):
                        for height, estimate in _by_height(junction, score).items():
                            ceiling = junction.ceiling(junction.heights == float(height))
                            rows.append([record.name, detector, score, height, estimate.count, _cell(estimate),
                                         number(ceiling)])  # fmt: skip
        head = [Column("junction"), Column("detector"), Column("score"), Column("height, m"),
                Column("candidates", "whole"), Column("rho", "two"), Column("ceiling", "two")]  # fmt: skip
        caption = f"Rho among candidates of equal height; undefined below {MIN_SITES_OF_A_HEIGHT} candidates."
        return Table("5 by height", "5. Within each height", caption, head, rows)

    def _by_sensor(self) -> Table:
        rows: list[list[Cell]] = []
        for role in ROLES:
            for detector, records in self.pairs(role):
                for score in self.scores(records):
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
        return Table("6 by sensor", "6. Within each sensor", caption, head, rows)

    def _sensors_of(self, name: str, detector: str, score: str) -> dict[str, Estimate]:
        junction = self.junctions[name, detector]
        return junction.by_group(score, junction.sensors, MIN_SITES_OF_A_SENSOR)

    def _all_scores(self) -> Table:
        rows: list[list[Cell]] = []
        for role in ROLES:
            for detector, records in self.pairs(role):
                for score in (*self.fitted_baselines(records), *self.all_scores(records)):
                    values = [self._rho(record, detector, score) for record in records]
                    defined = [value for value in values if math.isfinite(value)]
                    mean = float(np.mean(defined)) if defined else float("nan")
                    rows.append([role, detector, score, len(defined), number(mean), _least(values), _most(values)])
        head = [Column("role"), Column("detector"), Column("score"), Column("junctions", "whole"),
                Column("mean rho", "two"), Column("lowest", "two"), Column("highest", "two")]  # fmt: skip
        caption = (
            "Every installed score with each of its parameters; without intervals. No score may be chosen from this"
            " table: the highest of many values at held-out junctions is too high."
        )
        return Table("7 all scores", "7. All scores", caption, head, rows)

    def _rho(self, record: JunctionRecord, detector: str, score: str) -> float:
        junction = self.junctions[record.name, detector]
        rows = junction.defined(score)
        if int(rows.sum()) < 3:
            return float("nan")
        return float(rho(junction.scores[score][rows][None, :], junction.ap.values[rows][None, :])[0])

    def _aims(self) -> Table:
        rows: list[list[Cell]] = []
        for detector, records in self.pairs("held out"):
            main = self.main(records)
            junctions = [self.junctions[record.name, detector] for record in records]
            ceilings = [junction.ceiling() for junction in junctions]
            within = [junction.ceiling_within_heights(MIN_SITES_OF_A_HEIGHT) for junction in junctions]
            start: list[Cell] = [detector, _trained(detector), main, len(records)]
            for kind, aim, ceiling in ((RHO, POOLED_AIM, ceilings), (WITHIN_HEIGHTS, HEIGHT_AIM, within)):
                estimate = self.over(records, detector, main, kind)
                limit = _limit(aim, float(np.mean(ceiling)))
                outcome = _outcome_of_rho(estimate, limit) if self.is_complete(records) else UNDECIDED
                rows.append([*start, f"mean {kind}", _cell(estimate), None, number(aim), number(limit), outcome])
            lost = [self.estimate(record, detector, main, REGRET).value for record in records]
            crossed = [junction.crossed_regret(main) for junction in junctions]
            for name, summary, aim in (("median", np.median, REGRET_MEDIAN_AIM), ("worst", np.max, REGRET_WORST_AIM)):
                loss = float(summary(lost)), float(summary(crossed))
                rows.append([*start, f"{name} regret", *self._loss_aim(records, *loss, aim)])
        rows += self._level_aims()
        head = [Column("detector"), Column("trained the score"), Column("score"), Column("junctions", "whole"),
                Column("what"), Column("value", "two"), Column("crossed or corrected", "two"), Column("aim", "two"),
                Column("limit", "two"), Column("outcome")]  # fmt: skip
        caption = (
            f"Aims over the held-out junctions: mean rho of {POOLED_AIM}, and {HEIGHT_AIM} within heights, or"
            f" {OF_CEILING:.0%} of the mean ceiling where that is lower; regret of at most {REGRET_MEDIAN_AIM:g} points"
            f" in the median and {REGRET_WORST_AIM:g} at worst. Rho: {REACHED} if the whole interval is above the"
            f" limit, {MISSED} if it is below. Regret: {REACHED} if the measured one is within the aim, {MISSED} if"
            f" the crossed one is not. Error of the level, of detectors that have a model: the root mean square error"
            f" of the upper half of the candidates, at most {LEVEL_MEAN_AIM:g} points in the mean over junctions and"
            f" {LEVEL_WORST_AIM:g} at worst; {MISSED} if the one without the noise of the share found is above."
            f" Everything is {UNDECIDED} until all of the protocol's held-out junctions are there."
        )
        return Table("8 aims", "8. Aims", caption, head, rows)

    def _level_aims(self) -> Iterator[list[Cell]]:
        for detectors, each in self.levels("held out"):
            if not set(detectors) <= set(DETECTORS):
                continue
            records = [record for record, _ in each]
            start: list[Cell] = [", ".join(detectors), "yes", each[0][1].score, len(each)]
            measured = [level.rms_error for _, level in each]
            corrected = [level.corrected_rms_error for _, level in each]
            for name, summary, aim in (("mean", np.mean, LEVEL_MEAN_AIM), ("worst", np.max, LEVEL_WORST_AIM)):
                loss = float(summary(measured)), float(summary(corrected))
                yield [*start, f"{name} error of the level", *self._loss_aim(records, *loss, aim)]

    def _loss_aim(self, records: Sequence[JunctionRecord], measured: float, least: float, aim: float) -> list[Cell]:
        """Return the cells of a loss: as measured (too high), without its noise, aim and limit, and outcome."""
        outcome = _outcome_of_loss(measured, least, aim) if self.is_complete(records) else UNDECIDED
        return [number(measured), number(least), number(aim), number(aim), outcome]

    def is_complete(self, records: Sequence[JunctionRecord]) -> bool:
        """Return whether these are all held-out junctions of the protocol."""
        wanted = {junction.name for junction in self.protocol.junctions if junction.role == "held out"}
        return {record.name for record in records} == wanted

    def _aims_by_junction(self) -> Table:
        rows: list[list[Cell]] = []
        for detector, records in self.pairs("held out"):
            main = self.main(records)
            for record in records:
                junction = self.junctions[record.name, detector]
                start: list[Cell] = [record.name, detector, _trained(detector)]
                value = self.estimate(record, detector, main, RHO).value
                rows.append([*start, "rho", *_compare_with_aim(value, POOLED_AIM, junction.ceiling())])
                for height, of_height in _by_height(junction, main).items():
                    ceiling = junction.ceiling(junction.heights == float(height))
                    cells = _compare_with_aim(of_height.value, HEIGHT_AIM, ceiling)
                    rows.append([*start, f"rho at {height} m", *cells])
        head = [Column("junction"), Column("detector"), Column("trained the score"), Column("what"),
                Column("value", "two"), Column("limit", "two"), Column("reached")]  # fmt: skip
        caption = (
            "The same aims for single values, which were not what the protocol decides by: with this number of"
            " candidates, some values below the limit are expected even where the score is good everywhere."
        )
        return Table("9 aims by junction", "9. Aims at each junction", caption, head, rows)

    def _level(self) -> Table:
        rows: list[list[Cell]] = []
        for role in UNSEEN_ROLES:
            for detectors, each in self.levels(role):
                for record, level in each:
                    predicted = calibration.predicted_share(self.folder, record, detectors)
                    rows.append([
                        record.name, role, ", ".join(detectors), level.score, len(level.error),
                        number(float(level.expected.mean())), number(predicted), number(float(level.found.mean())),
                        number(float(level.error.mean())), number(level.rms_error),
                        number(level.corrected_rms_error), number(float(level.error[level.upper_half].mean())),
                        number(level.first_error),
                    ])  # fmt: skip
        head = [Column("junction"), Column("role"), Column("detector"), Column("score"),
                Column("candidates", "whole"), Column("expected", "one"), Column("expected of the unseen", "one"),
                Column("found", "one"), Column("mean error", "one"), Column("upper half: RMS error", "one"),
                Column("without noise", "one"), Column("upper half: mean error", "one"),
                Column("error of the first", "one")]  # fmt: skip
        caption = (
            "Shares of vehicles in points of 100, means over candidates: expected from the traffic behind the score;"
            " expected by the same models from the unseen traffic; found there (mean of recall from above and in 3D,"
            " IoU 0.7). Errors are expected minus found. The upper half are the candidates with the highest expected"
            " shares; the first is the candidate with the highest main score."
        )
        return Table("10 level", "10. Level", caption, head, rows)

    def _reliability(self) -> Table:
        rows: list[list[Cell]] = [
            [name, detector, number(part["chance"]), number(part["found"]), int(part["vehicle_frames"])]
            for detector, curves in self.reliability.items()
            for name, curve in curves.items()
            for part in curve
        ]
        head = [Column("junction"), Column("detector"), Column("probability", "two"),
                Column("share found", "two"), Column("vehicle-frames", "whole")]  # fmt: skip
        caption = (
            "Vehicle-frames of the unseen traffic with points, at all candidates (each counts once for each), in ten"
            " bins of the probability by the shipped models: the mean probability of each bin, and the share found."
        )
        return Table("11 reliability", "11. Reliability", caption, head, rows)

    def _parts(self) -> Table:
        rows: list[list[Cell]] = [
            [record.name, part, info.frames, info.candidates, number(info.seconds / 60), info.source[:12],
             info.protocol[:12], f"{info.machine['processor']}, {info.machine['cores']} cores"]
            for record in self.measured
            for part, info in record.infos.items()
        ]  # fmt: skip
        head = [Column("junction"), Column("part"), Column("frames", "whole"), Column("candidates", "whole"),
                Column("minutes", "one"), Column("source"), Column("protocol"), Column("machine")]  # fmt: skip
        return Table("12 parts", "12. Parts", "What was measured, by which source, on which machine.", head, rows)

    def _by_setting(self) -> Table:
        rows: list[list[Cell]] = []
        for role in ROLES:
            for detector, records in self.pairs(role):
                for setting in SETTINGS:
                    score = str(setting)
                    measured = [record for record in records if score in record.scores]
                    if measured:
                        cells = [_cell(self.over(measured, detector, score, kind)) for kind in (RHO, WITHIN_HEIGHTS)]
                        occlusion = "yes" if setting.occlusion else "no"
                        rows.append([role, detector, number(setting.voxel_m), occlusion, f"{setting.gamma:g}",
                                     len(measured), *cells])  # fmt: skip
        head = [Column("role"), Column("detector"), Column("voxel, m", "two"), Column("moving occlusion"),
                Column("gamma"), Column("junctions", "whole"), Column("mean rho", "two"),
                Column("mean rho within heights", "two")]  # fmt: skip
        caption = (
            "EGVS by gamma, voxel size and moving occlusion: mean over the junctions that have the setting (a region"
            " must be a whole number of voxels high). Nominal intervals of 95 % resample junctions, candidates and"
            " blocks of frames. No setting may be chosen from the held-out junctions: the highest of many is too high."
        )
        return Table("13 settings", "13. EGVS by gamma and voxel size", caption, head, rows)


RHO, WITHIN_HEIGHTS, WITHIN_SENSORS = "rho", "rho within heights", "rho within sensors"
GIVEN_BOTH, REGRET = "rho given sensor and height", "regret"

RHOS = (RHO, WITHIN_HEIGHTS, WITHIN_SENSORS, GIVEN_BOTH)

STATISTICS: dict[str, Callable[[DetectedJunction, str], Estimate]] = {
    RHO: lambda junction, score: junction.rho(score),
    WITHIN_HEIGHTS: lambda junction, score: junction.in_groups(score, junction.heights, MIN_SITES_OF_A_HEIGHT),
    WITHIN_SENSORS: lambda junction, score: junction.in_groups(score, junction.sensors, MIN_SITES_OF_A_SENSOR),
    GIVEN_BOTH: lambda junction, score: junction.rho_given_sensor_and_height(score),
    REGRET: lambda junction, score: junction.regret(score),
}
"""Statistics of a score at one junction, in the order of the columns."""


class TrainedBaselines:
    """Orders of candidates by sensor and height alone, fitted to the ranks of AP at the training junctions.

    A rank counts as a share of the candidates, from 0 to 1. *Sensor* is the mean share of a sensor, *height* the slope
    of the share over the height above the junction's mean, and *sensor and height* the least-squares sum of both. A
    detector that was not run at training junctions gets the mean over the others. A training junction gets what is
    fitted to the others.

    Parameters
    ----------
    records
        Of all junctions; those of other roles are not used.
    """

    def __init__(self, records: Sequence[JunctionRecord], detectors: Sequence[str]) -> None:
        self._sensors = sorted({sensor for record in records for sensor in record.sensors})
        self._training = [record for record in records if record.role == "training"]
        self._detectors = detectors

    def of(self, record: JunctionRecord, detector: str) -> dict[str, FloatArray]:
        """Return the baselines of the candidates of a junction, by name; none without other training junctions."""
        others = [each for each in self._training if each.name != record.name]
        detectors = [name for name in self._detectors if any(name in each.detections for each in others)]
        used = [detector] if detector in detectors else detectors
        fits = [self._fit([each for each in others if name in each.detections], name) for name in used]
        if not fits:
            return {}
        effects = self._effects(record.sensors, record.height_m)
        return {name: effects @ np.mean([fit[name] for fit in fits], axis=0) for name in fits[0]}

    def _effects(self, sensors: Sequence[str], height_m: FloatArray) -> FloatArray:
        """Return a column for each sensor, and the height above the mean of the junction, since shares have the same
        mean at each."""
        is_sensor = np.array([[sensor == name for name in self._sensors] for sensor in sensors], dtype=np.float64)
        return np.column_stack([is_sensor, height_m - height_m.mean()])

    def _fit(self, records: Sequence[JunctionRecord], detector: str) -> dict[str, FloatArray]:
        """Return the weights of the columns of :meth:`_effects`, by baseline."""
        shares, effects = [], []
        for record in records:
            ap = record.detections[detector][AP].values
            rows = np.isfinite(ap)
            ranks = rankdata(ap[rows])
            shares.append((ranks - 0.5) / max(len(ranks), 1))
            effects.append(self._effects(record.sensors, record.height_m)[rows])
        share, effect = np.concatenate(shares), np.concatenate(effects)
        count = len(self._sensors)

        def solve(columns: Sequence[int]) -> FloatArray:
            weights = np.zeros(count + 1)
            weights[columns] = np.linalg.lstsq(effect[:, columns], share, rcond=None)[0]
            return weights

        slope = np.zeros(count + 1)
        height = effect[:, count]
        slope[count] = (height @ share) / (height @ height) if height.any() else 0.0
        return {HEIGHT: slope, SENSOR: solve(range(count)), SENSOR_HEIGHT: solve(range(count + 1))}


def _freeze_problems() -> list[str]:
    """Return in what score, detectors or statistics differ from those that were frozen."""
    try:
        check_frozen()
    except InputError as problem:
        return [f"NOT AS FROZEN: {problem}"]
    return []


def _detected(
    record: JunctionRecord, detector: str, baselines: Mapping[str, FloatArray], resamples: int
) -> DetectedJunction:
    measure = record.detections[detector][AP]
    return DetectedJunction(
        record.name, MeasureValues(measure.values, measure.left_out), measure.halves, {**record.scores, **baselines},
        record.height_m, np.array(record.sensors, dtype=np.str_), resamples,
    )  # fmt: skip


def _by_height(junction: DetectedJunction, score: str) -> dict[str, Estimate]:
    return junction.by_group(score, junction.heights, MIN_SITES_OF_A_HEIGHT)


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


def _limit(aim: float, ceiling: float) -> float:
    """Return the aim, or the share of the ceiling where that is lower; the aim without a ceiling."""
    return aim if math.isnan(ceiling) else min(aim, OF_CEILING * ceiling)


def _outcome_of_rho(estimate: Estimate, limit: float) -> str:
    interval = estimate.interval
    if math.isnan(interval.low):
        return UNDECIDED
    if interval.low >= limit:
        return REACHED
    return MISSED if interval.high < limit else UNDECIDED


def _outcome_of_loss(measured: float, least: float, aim: float) -> str:
    if measured <= aim:
        return REACHED
    return MISSED if least > aim else UNDECIDED


def _compare_with_aim(value: float, aim: float, ceiling: float) -> list[Cell]:
    """Return a value, its limit, and whether it is reached; undecided without a value or a ceiling."""
    if math.isnan(value) or math.isnan(ceiling):
        return [number(value), None, UNDECIDED]
    limit = _limit(aim, ceiling)
    return [number(value), number(limit), "yes" if value >= limit else "no"]
