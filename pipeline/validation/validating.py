"""Asks what detectors find from each site, and which score foretells it; the whole of ``egvs validate``.

Steps: check the scenario; bring traffic that the TPOG never saw; look from each site with each detector; measure what
was found; work out every score; correlate. ``detection.parquet``, ``surrogates.parquet``, ``correlation.parquet`` and
``validation.png`` go into the run's folder. All of them are the same bytes whenever scenario and program are the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import checksums, schemas, tables
from pipeline.artefacts.readers import VALIDATION_SUMS
from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.core.findings import WARNINGS, seen_from
from pipeline.core.progress import Progress, silent
from pipeline.runs import stage_keys
from pipeline.runs.guarding import keep_inputs
from pipeline.runs.locking import alone
from pipeline.runs.stages import RANKING
from pipeline.runs.workflow import bring, refresh_report
from pipeline.scenario.models import Scenario
from pipeline.sensing.sites import Site
from pipeline.stages.base import Workspace
from pipeline.validation import detection, figure, keeping, unseen_traffic
from pipeline.validation.agreement import BOXED, COUNTED, Agreement, ScoreName, Validation, main_measure
from pipeline.validation.detection import ALL, SiteDetection
from pipeline.validation.detectors import kitti_results, registry
from pipeline.validation.detectors.base import Detector
from pipeline.validation.looking import Look, LookListener, look_from
from pipeline.validation.metrics.matching import within
from pipeline.validation.preparing import checked, not_unseen, refuse_empty, workshop
from pipeline.validation.site_findings import POINTS, FoundBoxes
from pipeline.validation.statistics.coefficients import KINDS
from pipeline.validation.statistics.correlation import Study
from pipeline.validation.statistics.junctions import Junction, Measured
from pipeline.validation.surrogates import gathering
from pipeline.validation.surrogates.gathering import Surrogates
from pipeline.validation.unseen_record import UnseenRecord, prepare

CORRELATION = "correlation.parquet"


def validate(
    scenario: Scenario,
    out: Path,
    *,
    frames: int,
    detectors: Sequence[str] = (POINTS,),
    detections: Path | None = None,
    keep: bool = False,
    jobs: int | None = None,
    progress: Progress = silent,
    listener: LookListener | None = None,
) -> Validation:
    """Validate the scores of a scenario's sites.

    Parameters
    ----------
    out
        The run's folder.
    frames
        Of unseen traffic.
    detectors
        Names; points on vehicles are always counted.
    detections
        A folder with KITTI results of further detectors, see :mod:`pipeline.validation.detectors.kitti_results`.
    keep
        Also write ground truth and detections, see :mod:`pipeline.validation.keeping`.
    listener
        Hears how far the looking is.

    Raises
    ------
    InputError
        What the check refuses; an unknown detector; more frames than traffic has; no vehicle in the region of interest;
        results that are not of these sites and frames.
    """
    chosen = {name: registry.make(name) for name in dict.fromkeys(detectors) if name != POINTS}
    _keep_inputs(scenario, out, detections, keep=keep)
    with alone(out), workshop(out) as folder:
        doubts = checked(scenario, folder / "check", progress)
        record = prepare(scenario, folder / "unseen", frames, jobs=jobs, progress=progress)
        watched = list(record.read())
        refuse_empty(scenario, record, watched)
        given = _given(detections, record, chosen)
        look = Look(record, chosen)
        found = look_from(record.scene.sites, look, jobs=jobs, progress=progress, listener=listener)
        found = {site: {**its, **given.get(site, {})} for site, its in found.items()}
        rows, undefined = detection.measured(watched, record.scene.roi, found)
        surrogates = gathering.surrogates_of(scenario, folder / "scores", jobs=jobs, progress=progress)
        agreements = correlated(record.scene.sites, scenario, rows, surrogates)
        told = (*doubts, *not_unseen(scenario), *undefined, *surrogates.skipped)
        done = Validation(tuple(rows), surrogates, tuple(agreements), told)
        _write(out, folder, scenario, record, done, given)
        if keep:
            keeping.write(out / keeping.FOLDER, record, watched, found)
        return replace(done, report=refresh_report(out))


def _keep_inputs(scenario: Scenario, out: Path, detections: Path | None, *, keep: bool) -> None:
    """InputError where something that is read lies where something is written."""
    keep_inputs(scenario, out, (keeping.FOLDER, keeping.ASIDE) if keep else ())
    if keep and detections is not None and detections.resolve().is_relative_to((out / keeping.FOLDER).resolve()):
        found = "lies where --keep writes anew"
        raise InputError(f"--detections {detections}", found, "a copy of it elsewhere, or no --keep")


def _given(
    folder: Path | None, record: UnseenRecord, chosen: Mapping[str, Detector]
) -> dict[str, dict[str, FoundBoxes]]:
    """The boxes of other detectors by site and detector, those whose centre lies in the region of interest."""
    if folder is None:
        return {}
    results = kitti_results.read(folder, {site.name: site.pose for site in record.scene.sites}, record.numbers)
    if twice := [name for name in results if name in (POINTS, *chosen)]:
        found = f"results of {twice[0]!r}, which is looked with too"
        raise InputError("--detections", found, "a folder of another name, or not both")
    by_site: dict[str, dict[str, FoundBoxes]] = {site.name: {} for site in record.scene.sites}
    for name, each in results.items():
        for site_name, frames in each.items():
            by_site[site_name][name] = FoundBoxes(tuple(within(its, record.scene.roi) for its in frames))
    return by_site


def correlated(
    sites: Sequence[Site], scenario: Scenario, rows: Sequence[SiteDetection], surrogates: Surrogates
) -> list[Agreement]:
    """Every score against every measure of every detector, over all vehicles. Sites of a pole are drawn together."""
    names, poles = tuple(site.name for site in sites), tuple(site.pole for site in sites)
    scores = _by_score(names, surrogates)
    found = []
    for detector in dict.fromkeys(row.detector for row in rows):
        mine = [row for row in rows if row.detector == detector and row.objects_of == ALL]
        compared = COUNTED if detector == POINTS else BOXED
        measures = {name: Measured.of([row.measures[name] for row in mine]) for name in compared}
        by_name = {str(name): values for name, values in scores.items()}
        junction = Junction(scenario.name, names, by_name, measures, poles)
        study = Study([junction], scenario.seed)
        by_kind = {
            (kind, measure, name): study.correlation(str(name), measure, kind)
            for kind in KINDS
            for measure in compared
            for name in scores
        }
        found += [
            Agreement(name, detector, measure, {kind: by_kind[kind, measure, name] for kind in KINDS})
            for measure in compared
            for name in scores
        ]
    return found


def _by_score(sites: Sequence[str], surrogates: Surrogates) -> dict[ScoreName, NDArray[np.float64]]:
    """Each score's values over the sites, turned so that more is better."""
    place = {site: number for number, site in enumerate(sites)}
    found: dict[ScoreName, NDArray[np.float64]] = {}
    for row in surrogates.rows:
        name = ScoreName(row.score, row.parameters_json)
        found.setdefault(name, np.full(len(sites), np.nan))[place[row.site]] = row.sign * row.value
    return found


def _write(
    out: Path,
    folder: Path,
    scenario: Scenario,
    record: UnseenRecord,
    done: Validation,
    given: Mapping[str, Mapping[str, FoundBoxes]],
) -> None:
    """All artefacts or none: they are made aside, then renamed."""
    aside = folder / "done"
    aside.mkdir()
    about = _about(folder / "scores", scenario, record, done)
    if given:
        about["given"] = {site: {name: its.digest for name, its in by.items()} for site, by in given.items()}
    detection.write(aside / detection.ARTEFACT, done.detections, about)
    done.surrogates.write(aside / gathering.ARTEFACT, scenario)
    _write_correlation(aside / CORRELATION, done, about)
    figure.draw(aside / figure.ARTEFACT, scenario, done)
    checksums.write(aside / VALIDATION_SUMS, sorted(aside.iterdir()))
    for made in sorted(aside.iterdir()):
        made.replace(out / made.name)


def _about(folder: Path, scenario: Scenario, record: UnseenRecord, done: Validation) -> dict[str, Any]:
    """Metadata; what the report must know to show this beside the run that it is of, and to no other."""
    own, detectors = done.own_score(scenario), dict.fromkeys(row.detector for row in done.detections)
    warnings = {WARNINGS: [doubt.to_json() for doubt in done.doubts]}
    return {
        "schema": schemas.VERSION,
        "scenario": {"name": scenario.name, "hash": files.hash_of(scenario.model_dump(mode="json"))},
        "seed": scenario.seed,
        "unseen_seed": record.scenario.seed,
        "frames": record.frames,
        "apart_s": unseen_traffic.APART_S,
        "inputs": files.hash_of([record.keys, record.numbers.tolist(), list(detectors), done.surrogates.inputs]),
        "stages": _stages(scenario, folder),
        "own_score": {"score": own.score, "parameters": own.parameters},
        "shown": {detector: main_measure(detector) for detector in detectors},
        **seen_from(scenario.folder, warnings),
    }


def _stages(scenario: Scenario, folder: Path) -> dict[str, str]:
    """The keys of a run's stages, from the artefacts that the scores were worked out of."""
    work = Workspace(scenario, folder)
    bring(work, "tpog")  # the last one there may have other voxels
    return {name: stage_keys.inputs(name, work).key for name in RANKING}


def _write_correlation(path: Path, done: Validation, about: dict[str, Any]) -> None:
    columns: dict[str, list[Any]] = {
        "score": [its.score.score for its in done.agreements],
        "parameters": [its.score.parameters for its in done.agreements],
        "detector": [its.detector for its in done.agreements],
        "measure": [its.measure for its in done.agreements],
        "n": [its.by_kind[KINDS[0]].sites for its in done.agreements],
    }
    for kind in KINDS:
        each = [its.by_kind[kind] for its in done.agreements]
        columns[kind] = [its.value for its in each]
        columns[f"{kind}_low"] = [its.interval.low for its in each]
        columns[f"{kind}_high"] = [its.interval.high for its in each]
    tables.write(path, "correlation", columns, about)
