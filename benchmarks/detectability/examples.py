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
from pipeline.core import parallel
from pipeline.core.errors import InputError
from pipeline.core.progress import Progress, silent
from pipeline.kernels.matching import EXCEED
from pipeline.scoring.targets.detectability import features_of
from pipeline.scoring.targets.record import TargetRecord
from pipeline.scoring.targets.seen import noticed_in, see
from pipeline.scoring.visibility import Beams
from pipeline.sensing.scanner import Scanner
from pipeline.sensing.sites import Site
from pipeline.validation import detection
from pipeline.validation.detection import ALL
from pipeline.validation.detectors.base import Detector
from pipeline.validation.looking import Look, look_from
from pipeline.validation.metrics.average_precision import IOUS
from pipeline.validation.metrics.overlap import VIEWS, overlap_each
from pipeline.validation.site_findings import Found, FoundBoxes
from pipeline.validation.unseen_record import UnseenRecord, prepare

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
    progress: Progress = silent,
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
        unseen = prepare(
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
            found_from = look_from(sites, Look(unseen, {name: detector}), jobs=jobs, progress=progress)
            hits = [hits_of(record, _boxes(its[name])) for its in found_from.values()]
            seen = [features[site] for site in found_from]
            by_detector[name] = Examples(seen, hits, _ap(unseen, found_from, name))
    sensors = tuple(sorted({site.sensor for site in unseen.scene.sites}))
    return JunctionExamples(part.name, sensors, len(record), by_detector)


def _features(unseen: UnseenRecord, record: TargetRecord, jobs: int | None, progress: Progress) -> dict[str, Floats]:
    """What a model learns from, of each site."""
    scanner, sites = Scanner(unseen.scene), unseen.scene.sites

    def of(site: Site) -> Floats:
        beams = Beams.of(scanner.scan_site(site))
        return features_of(see(record, beams, noticed_in(unseen.scene, beams.sensor)))

    found: dict[str, Floats] = {}
    for site, its in zip(sites, parallel.in_order(of, sites, parallel.threads(jobs)), strict=True):
        found[site.name] = its
        progress("sites seen from", len(found), len(sites))
    return found


def _boxes(found: Found) -> list[Floats]:
    assert isinstance(found, FoundBoxes)
    return [its.boxes for its in found.frames]


def hits_of(record: TargetRecord, found: Sequence[Floats]) -> Floats:
    """Share of the two views in which each vehicle-frame is found, (n,) float64: 0, 0.5 or 1.

    Parameters
    ----------
    found
        Detections of each frame of the record, (m, 7) float64 each, as
        :data:`pipeline.artefacts.traffic_frames.BOX`.
    """
    each = np.split(record.boxes, np.searchsorted(record.frame, np.arange(1, len(record.numbers))))
    return np.concatenate([_overlapped(boxes, its) for boxes, its in zip(each, found, strict=True)])


def _overlapped(boxes: Floats, found: Floats) -> Floats:
    box, its = (number.ravel() for number in np.indices((len(boxes), len(found))))
    overlap = overlap_each(boxes[box], found[its]).reshape(len(VIEWS), len(boxes), len(found))
    shares: Floats = (overlap > IOU + EXCEED).any(axis=2).mean(axis=0)
    return shares


def _ap(unseen: UnseenRecord, found: Mapping[str, Mapping[str, Found]], name: str) -> list[float]:
    """AP of a detector, of each site."""
    rows, _ = detection.measured(list(unseen.read()), unseen.scene.roi, found)
    of = {row.site: row.measures[AP].value for row in rows if row.detector == name and row.objects_of == ALL}
    return [of[site] for site in found]
