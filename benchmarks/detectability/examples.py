"""Detections at one junction of the study, with what is visible of each vehicle from the same sites.

Steps: simulate the held-out traffic of the study; compute what each site sees of its vehicles, from the empty scan; run
each detector (cached results are reused); determine which vehicles it found, and its AP.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.across_junctions import detections
from benchmarks.detectability.fitting import Examples, Floats
from benchmarks.validity.measurement import Part
from benchmarks.validity.record import BOXED
from egvs.core.errors import InputError
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.threads import map_ordered, thread_count
from egvs.scoring.target_scores import detectability_features
from egvs.scoring.targets import TargetRecord, detection_probability, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from egvs.sensors.sites import Site
from egvs.validation import detection_metrics
from egvs.validation.detection_metrics import ALL_OBJECTS
from egvs.validation.detector_runs import SiteDetectionTask, run_detectors
from egvs.validation.detectors.base import Detector
from egvs.validation.held_out_traffic import HeldOutTraffic, prepare_held_out_traffic
from egvs.validation.sweeps import DetectedBoxes, DetectorResult

AP = BOXED[0]
"""The measure that predictions are compared with."""


@dataclass(frozen=True, eq=False)
class JunctionExamples:
    """Results of each detector at one junction.

    Attributes
    ----------
    sensors
        Of the sites.
    vehicle_frames
        Of the unseen traffic, the same for all sites.
    by_detector
        At the sites that each looked from.
    """

    name: str
    sensors: tuple[str, ...]
    vehicle_frames: int
    by_detector: Mapping[str, Examples]


def examples_of(
    part: Part,
    detectors: Mapping[str, Detector],
    folder: Path,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
) -> JunctionExamples:
    """Return every vehicle in every frame of a junction, as visible from each site, and whether it was found.

    Parameters
    ----------
    part
        A junction of the study, with the sites that each detector looks from.
    folder
        For what is needed meanwhile.

    Raises
    ------
    InputError
        For traffic without any vehicle in the region of interest.
    """
    with tempfile.TemporaryDirectory(prefix=".work-", dir=folder) as temporary:
        held_out = prepare_held_out_traffic(
            part.scenario, Path(temporary), part.frames, apart_s=part.apart_s, jobs=jobs, progress=progress
        )
        record = TargetRecord.of(list(held_out.read()), part.scenario.roi.grid)
        if not len(record):
            results = (
                f"no vehicle has its centre in the region of interest in {held_out.frames} frames of held-out traffic"
            )
            raise InputError(
                f"{part.scenario.file}: roi", results, "Use traffic that passes the region, or more --frames."
            )
        features = _features(held_out, record, jobs, progress)
        by_detector = {}
        for name, detector in detectors.items():
            sites = [site for site in held_out.scene.sites if site.name in part.detectors[name]]
            results_by_site = run_detectors(
                sites, SiteDetectionTask(held_out, {name: detector}), jobs=jobs, progress=progress
            )
            hits = [hits_of(record, _boxes(result[name])) for result in results_by_site.values()]
            site_features = [features[site] for site in results_by_site]
            by_detector[name] = Examples(site_features, hits, _ap(held_out, results_by_site, name))
    sensors = tuple(sorted({site.sensor for site in held_out.scene.sites}))
    return JunctionExamples(part.name, sensors, len(record), by_detector)


def _features(
    held_out: HeldOutTraffic, record: TargetRecord, jobs: int | None, progress: ProgressCallback
) -> dict[str, Floats]:
    """Return the features of a model, for each site."""
    scanner, sites = Scanner(held_out.scene), held_out.scene.sites

    def of(site: Site) -> Floats:
        beams = Beams.of(scanner.scan_site(site))
        return detectability_features(
            visible_targets(record, beams, detection_probability(held_out.scene, beams.sensor))
        )

    results: dict[str, Floats] = {}
    for site, result in zip(sites, map_ordered(of, sites, thread_count(jobs)), strict=True):
        results[site.name] = result
        progress("visibility of sites", len(results), len(sites))
    return results


def _boxes(results: DetectorResult) -> list[Floats]:
    assert isinstance(results, DetectedBoxes)
    return [result.boxes for result in results.frames]


def hits_of(record: TargetRecord, results: Sequence[Floats]) -> Floats:
    """Return the share of the two views in which each vehicle of a record is found; see :func:`detections.hits_of`."""
    each = np.split(record.boxes, np.searchsorted(record.frame, np.arange(1, len(record.numbers))))
    return detections.hits_of(each, results)


def _ap(held_out: HeldOutTraffic, results: Mapping[str, Mapping[str, DetectorResult]], name: str) -> list[float]:
    """Return the AP of a detector at each site."""
    rows, _ = detection_metrics.measure_detection(list(held_out.read()), held_out.scene.roi, results)
    of = {row.site: row.measures[AP].value for row in rows if row.detector == name and row.objects_of == ALL_OBJECTS}
    return [of[site] for site in results]
