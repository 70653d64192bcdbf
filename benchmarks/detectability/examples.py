"""What detectors do at one junction of the study, beside what is seen of each vehicle from the same sites.

Steps: bring the unseen traffic of the study; count what each site sees of its vehicles, from the empty scan; let each
detector look (what the store has is not looked at again); say which vehicles it found, and its AP.

A vehicle-frame is found in a view (from above, in space) where any detection overlaps it by more than :data:`IOU`: as
vehicles do not stand in one another, no detection overlaps two by so much, and matching would say the same.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.detectability.fitting import Examples, Floats
from benchmarks.validity.measuring import Part
from benchmarks.validity.record import BOXED
from egvs.core import runtime
from egvs.core.errors import InputError
from egvs.core.runtime import ProgressCallback, no_progress
from egvs.kernels.detection import OVERLAP_TOLERANCE
from egvs.scoring.target_scores import detectability_features
from egvs.scoring.targets import TargetRecord, detection_probability, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from egvs.sensors.sites import Site
from egvs.validation import detection_metrics
from egvs.validation.detection_metrics import ALL_OBJECTS, IOUS, VIEWS, paired_overlap
from egvs.validation.detector_runs import SiteDetectionTask, run_detectors
from egvs.validation.detectors.base import Detector
from egvs.validation.held_out_traffic import HeldOutTraffic, prepare_held_out_traffic
from egvs.validation.sweeps import DetectedBoxes, DetectorResult

IOU = IOUS[0]
AP = BOXED[0]
"""By which a vehicle is found, and what foretelling is held against."""


@dataclass(frozen=True, eq=False)
class JunctionExamples:
    """What each detector did at one junction.

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
    """Every vehicle-frame of a junction, as seen from each site, and whether it was found.

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
        unseen = prepare_held_out_traffic(
            part.scenario, Path(temporary), part.frames, apart_s=part.apart_s, jobs=jobs, progress=progress
        )
        record = TargetRecord.of(list(unseen.read()), part.scenario.roi.grid)
        if not len(record):
            found = f"no vehicle has its centre in the region of interest in {unseen.frames} frames of unseen traffic"
            raise InputError(f"{part.scenario.file}: roi", found, "traffic that passes the region, or more --frames")
        features = _features(unseen, record, jobs, progress)
        by_detector = {}
        for name, detector in detectors.items():
            sites = [site for site in unseen.scene.sites if site.name in part.detectors[name]]
            found_from = run_detectors(sites, SiteDetectionTask(unseen, {name: detector}), jobs=jobs, progress=progress)
            hits = [hits_of(record, _boxes(its[name])) for its in found_from.values()]
            seen = [features[site] for site in found_from]
            by_detector[name] = Examples(seen, hits, _ap(unseen, found_from, name))
    sensors = tuple(sorted({site.sensor for site in unseen.scene.sites}))
    return JunctionExamples(part.name, sensors, len(record), by_detector)


def _features(
    unseen: HeldOutTraffic, record: TargetRecord, jobs: int | None, progress: ProgressCallback
) -> dict[str, Floats]:
    """What a model learns from, of each site."""
    scanner, sites = Scanner(unseen.scene), unseen.scene.sites

    def of(site: Site) -> Floats:
        beams = Beams.of(scanner.scan_site(site))
        return detectability_features(visible_targets(record, beams, detection_probability(unseen.scene, beams.sensor)))

    found: dict[str, Floats] = {}
    for site, its in zip(sites, runtime.map_ordered(of, sites, runtime.thread_count(jobs)), strict=True):
        found[site.name] = its
        progress("sites seen from", len(found), len(sites))
    return found


def _boxes(found: DetectorResult) -> list[Floats]:
    assert isinstance(found, DetectedBoxes)
    return [its.boxes for its in found.frames]


def hits_of(record: TargetRecord, found: Sequence[Floats]) -> Floats:
    """Share of the two views in which each vehicle-frame is found, (n,) float64: 0, 0.5 or 1.

    Parameters
    ----------
    found
        Detections of each frame of the record, (m, 7) float64 each, as
        :data:`egvs.artefacts.traffic_frames.BOX_COLUMNS`.
    """
    each = np.split(record.boxes, np.searchsorted(record.frame, np.arange(1, len(record.numbers))))
    return np.concatenate([_overlapped(boxes, its) for boxes, its in zip(each, found, strict=True)])


def _overlapped(boxes: Floats, found: Floats) -> Floats:
    box, its = (number.ravel() for number in np.indices((len(boxes), len(found))))
    overlap = paired_overlap(boxes[box], found[its]).reshape(len(VIEWS), len(boxes), len(found))
    shares: Floats = (overlap > IOU + OVERLAP_TOLERANCE).any(axis=2).mean(axis=0)
    return shares


def _ap(unseen: HeldOutTraffic, found: Mapping[str, Mapping[str, DetectorResult]], name: str) -> list[float]:
    """AP of a detector, of each site."""
    rows, _ = detection_metrics.measure_detection(list(unseen.read()), unseen.scene.roi, found)
    of = {row.site: row.measures[AP].value for row in rows if row.detector == name and row.objects_of == ALL_OBJECTS}
    return [of[site] for site in found]
