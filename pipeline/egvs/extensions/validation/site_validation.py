"""Validates the scores of a run: ``egvs validate``.

Steps: check the scenario; record traffic that the TPOG was not computed from; run each detector at each site; measure
detection; compute every score; correlate scores with detection; compare the ranking with detection
(:mod:`egvs.extensions.validation.ranking_evidence`).

Writes ``detection.parquet``, ``surrogates.parquet``, ``correlation.parquet`` and ``validation.png`` into the folder of
the run. Their bytes depend on the scenario and the program only.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from egvs.artefacts import checksums, parquet
from egvs.core import files, plugins
from egvs.core.errors import InputError, check_list
from egvs.core.grid import FloatArray
from egvs.core.progress import ProgressCallback, no_progress
from egvs.extensions.validation import detection_metrics, kitti_results, ranking_evidence, results, surrogates
from egvs.extensions.validation.correlation import CorrelationStudy, JunctionScores, MeasureValues
from egvs.extensions.validation.detection_metrics import ALL_OBJECTS, SiteDetection
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME, DetectedBoxes, detections_in_roi
from egvs.extensions.validation.detector_runs import DetectionListener, SiteDetectionTask, run_detectors
from egvs.extensions.validation.detectors import base
from egvs.extensions.validation.files import CHECKSUMS, CORRELATION, DETECTION, FIGURE, SURROGATES
from egvs.extensions.validation.held_out_traffic import FrameSampling, HeldOutTraffic
from egvs.extensions.validation.kitti_results import NO_KITTI_FILES, KittiFiles
from egvs.extensions.validation.ranking_evidence import SiteRanking
from egvs.extensions.validation.results import ScoreAgreement, ScoreName, Validation
from egvs.extensions.validation.surrogates import Surrogates
from egvs.extensions.validation.validation_run import ValidationRun, validation_metadata, validation_run
from egvs.runs import run as runs
from egvs.runs import stage_keys, stage_registry
from egvs.runs.run_context import open_folder
from egvs.scenario.model import Scenario
from egvs.sensors.sites import Site
from egvs.statistics.ranks import COEFFICIENT_KINDS

BoxesBySite = Mapping[str, Mapping[str, DetectedBoxes]]
"""Boxes of other detectors, by site and detector."""


def validate_sites(
    scenario: Scenario,
    out: str | Path,
    *,
    sampling: FrameSampling,
    detectors: Sequence[str] = (POINT_COUNTS_NAME,),
    kitti: KittiFiles = NO_KITTI_FILES,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    listener: DetectionListener | None = None,
) -> Validation:
    """Validate the scores of a scenario's sites.

    Parameters
    ----------
    out
        The run's folder.
    sampling
        Frames of held-out traffic.
    detectors
        Names of detectors; points on vehicles are always counted.
    kitti
        KITTI results of further detectors, and whether to write ground truth and detections as KITTI files.
    jobs
        Number of processes; one per core when None. With several, a script needs ``if __name__ == "__main__":``.
    listener
        Receives the progress of the detectors.

    Raises
    ------
    InputError
        If the check finds an error, a detector is unknown, the traffic has too few frames or no vehicle in the region
        of interest, or the KITTI results do not belong to these sites and frames.
    """
    plugins.require_libraries("egvs validate", "validate", "matplotlib")
    check_list("detectors", detectors)
    out = Path(out)
    chosen = {name: base.make_detector(name) for name in dict.fromkeys(detectors) if name != POINT_COUNTS_NAME}
    _check_no_input_overwritten(scenario, out, kitti)

    with validation_run(scenario, out, sampling, jobs=jobs, progress=progress) as run:
        record = run.record
        external = _read_external_boxes(kitti.detections, record, chosen)
        task = SiteDetectionTask(record, chosen)
        detected = run_detectors(record.scene.sites, task, jobs=jobs, progress=progress, listener=listener)
        by_site = {site: {**by_detector, **external.get(site, {})} for site, by_detector in detected.items()}

        rows, undefined = detection_metrics.measure_detection(run.frames, record.scene.roi, by_site)
        scores = surrogates.compute_surrogates(scenario, run.folder / "scores", jobs=jobs, progress=progress)
        agreements = correlate_scores(record.scene.sites, scenario, rows, scores)
        ranking = SiteRanking.compute(open_folder(scenario, run.folder / "scores", jobs=jobs, progress=progress))
        sites = record.scene.sites
        heights_m = ranking_evidence.mounting_heights_m(record.scene)
        check = ranking_evidence.check_ranking(scenario, ranking, rows, [site.pole for site in sites], heights_m)
        warnings = (*run.warnings, *undefined, *scores.skipped)
        validation = Validation(tuple(rows), scores, tuple(agreements), warnings, run.sample, ranking.values, check)

        _write_artefacts(out, run, scenario, validation, external)
        if kitti.keep:
            kitti_results.write_kitti_results(out / kitti_results.KITTI_FOLDER, record, run.frames, by_site)
        return replace(validation, report=runs.refresh_report(out))


def _check_no_input_overwritten(scenario: Scenario, out: Path, kitti: KittiFiles) -> None:
    """Raise an InputError if an output would overwrite an input."""
    if not kitti.keep:
        runs.check_no_overwrite(scenario, out)
        return
    runs.check_no_overwrite(scenario, out, (kitti_results.KITTI_FOLDER, kitti_results.PARTIAL_FOLDER))
    kitti_folder = (out / kitti_results.KITTI_FOLDER).resolve()
    if kitti.detections is not None and kitti.detections.resolve().is_relative_to(kitti_folder):
        raise InputError(
            f"--detections {kitti.detections}",
            "the folder would be overwritten by --keep",
            "Copy the folder elsewhere, or omit --keep.",
        )


def _read_external_boxes(folder: Path | None, record: HeldOutTraffic, chosen: Iterable[str]) -> BoxesBySite:
    """Return the boxes of other detectors whose centre lies in the region of interest."""
    if folder is None:
        return {}
    sites = record.scene.sites
    by_detector = kitti_results.read_kitti_results(folder, {site.name: site.pose for site in sites}, record.numbers)
    for name in by_detector:
        if name in (POINT_COUNTS_NAME, *chosen):
            raise InputError(
                "--detections",
                f"the folder has results of {name!r}, which also runs here",
                "Rename the folder of results, or omit the detector.",
            )

    boxes: dict[str, dict[str, DetectedBoxes]] = {site.name: {} for site in sites}
    for name, by_site in by_detector.items():
        for site_name, frames in by_site.items():
            in_roi = tuple(detections_in_roi(detections, record.scene.roi) for detections in frames)
            boxes[site_name][name] = DetectedBoxes(in_roi)
    return boxes


def correlate_scores(
    sites: Sequence[Site], scenario: Scenario, rows: Sequence[SiteDetection], scores: Surrogates
) -> list[ScoreAgreement]:
    """Correlate every score with every measure of every detector, over all vehicles.

    Parameters
    ----------
    sites
        The sites; those on one pole are resampled together.
    rows
        Detection at each site.
    scores
        Scores of each site.

    Returns
    -------
    list of ScoreAgreement
        By detector, measure and score.
    """
    site_names = tuple(site.name for site in sites)
    poles = tuple(site.pole for site in sites)
    values = _values_by_score(site_names, scores)
    values_by_text = {str(name): site_values for name, site_values in values.items()}

    agreements = []
    for detector in dict.fromkeys(row.detector for row in rows):
        detector_rows = [row for row in rows if row.detector == detector and row.objects_of == ALL_OBJECTS]
        measure_names = results.correlated_measures(detector)
        measures = {}
        for measure in measure_names:
            measures[measure] = MeasureValues.from_estimates([row.measures[measure] for row in detector_rows])
        junction = JunctionScores(scenario.name, site_names, values_by_text, measures, poles)
        study = CorrelationStudy([junction], scenario.seed)
        by_kind = {}
        for kind in COEFFICIENT_KINDS:  # the study is quickest in this order
            for measure in measure_names:
                for name in values:
                    by_kind[kind, measure, name] = study.correlation(str(name), measure, kind)
        for measure in measure_names:
            for name in values:
                coefficients = {kind: by_kind[kind, measure, name] for kind in COEFFICIENT_KINDS}
                agreements.append(ScoreAgreement(name, detector, measure, coefficients))
    return agreements


def _values_by_score(sites: Sequence[str], scores: Surrogates) -> dict[ScoreName, FloatArray]:
    """Return each score's values at the sites, with the sign changed where less is better; NaN where missing."""
    row_of_site = {site: number for number, site in enumerate(sites)}
    values: dict[ScoreName, FloatArray] = {}
    for row in scores.rows:
        name = ScoreName(row.score, row.parameters_json)
        if name not in values:
            values[name] = np.full(len(sites), np.nan)
        values[name][row_of_site[row.site]] = row.sign * row.value
    return values


def _write_artefacts(
    out: Path, run: ValidationRun, scenario: Scenario, validation: Validation, external: BoxesBySite
) -> None:
    """Write all artefacts or none: they are written to a temporary folder, then renamed."""
    metadata = _site_metadata(run, scenario, validation, external)
    folder = run.folder / "done"
    folder.mkdir()
    detection_metrics.write_detection(folder / DETECTION.name, validation.detections, metadata)
    validation.surrogates.write(folder / SURROGATES.name, scenario)
    _write_correlation(folder / CORRELATION.name, validation, metadata)
    results.write_figure(folder / FIGURE.name, scenario, validation)
    checksums.write_checksums(folder / CHECKSUMS.name, sorted(folder.iterdir()))
    for path in sorted(folder.iterdir()):
        path.replace(out / path.name)


def _site_metadata(
    run: ValidationRun, scenario: Scenario, validation: Validation, external: BoxesBySite
) -> dict[str, Any]:
    """Return the metadata of all artefacts; the report uses it to find the run that they belong to."""
    record = run.record
    detectors = list(dict.fromkeys(row.detector for row in validation.detections))
    egvs = validation.egvs_score(scenario)
    inputs = [record.keys, record.numbers.tolist(), detectors, validation.surrogates.inputs]
    metadata = validation_metadata(scenario, record, validation.sample, detectors, validation.warnings)
    metadata["inputs"] = files.hash_json(inputs)
    metadata["stages"] = _stage_keys(scenario, run.folder / "scores")
    metadata["own_score"] = {"score": egvs.score, "parameters": egvs.parameters}
    metadata["ranking"] = validation.check.to_json()
    if external:
        metadata["given"] = {}
    for site, by_detector in external.items():
        metadata["given"][site] = {name: boxes.digest for name, boxes in by_detector.items()}
    return metadata


def _stage_keys(scenario: Scenario, folder: Path) -> dict[str, str]:
    """Return the keys of the stages of a run whose artefacts the scores were computed from."""
    context = open_folder(scenario, folder)
    return {name: stage_keys.stage_key(name, context).key for name in stage_registry.RANKING_STAGES}


def _write_correlation(path: Path, validation: Validation, metadata: dict[str, Any]) -> None:
    columns: dict[str, list[Any]] = defaultdict(list)
    for agreement in validation.agreements:
        columns["score"].append(agreement.score.score)
        columns["parameters"].append(agreement.score.parameters)
        columns["detector"].append(agreement.detector)
        columns["measure"].append(agreement.measure)
        columns["n"].append(agreement.by_kind[COEFFICIENT_KINDS[0]].sites)
        for kind in COEFFICIENT_KINDS:
            correlation = agreement.by_kind[kind]
            columns[kind].append(correlation.value)
            columns[f"{kind}_low"].append(correlation.interval.low)
            columns[f"{kind}_high"].append(correlation.interval.high)
    parquet.write_artefact(path, "correlation", columns, metadata)
