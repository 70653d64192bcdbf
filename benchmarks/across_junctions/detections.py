"""The detector part of a junction: boxes, hits and measures of one detector at every candidate.

What a part depends on is narrower than what this program imports: static world and traffic by the keys of their
stages, sites, sensors, effects and detectors by value, and the source of the modules that compute
(:data:`COMPUTING`, with everything that they import) and that call them (:data:`CALLING`, their own text). A change of
a score or of the report changes no detection, so it does not make the study begin again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import mean
from typing import Any

import numpy as np

from benchmarks.across_junctions import study_detectors
from egvs.artefacts.traffic_frames import BOX_COLUMNS, TrafficFrame
from egvs.clouds import simulation as cloud_simulation
from egvs.clouds import sweeps
from egvs.clouds.sweeps import Detections
from egvs.core import files
from egvs.core.grid import FloatArray
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.resource_usage import ResourceUsage
from egvs.extensions.validation import detection_metrics, detector_runs, held_out_traffic
from egvs.extensions.validation.detection_metrics import (
    BLOCKS,
    IOUS,
    VIEWS,
    EvaluationFrames,
    GroundTruth,
    evaluate,
    frame_blocks,
    paired_overlap,
)
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME, DetectedBoxes, PointCounts
from egvs.extensions.validation.detector_runs import DetectionListener, SiteDetectionTask, run_detectors
from egvs.extensions.validation.held_out_traffic import HeldOutTraffic
from egvs.extensions.validation.kernels.detection import OVERLAP_TOLERANCE
from egvs.runs import stage_keys
from egvs.stages import scene_inputs

AP = "ap_mean_r40_iou70"
"""The main measure: the mean of BEV and 3D."""

MEASURES = (
    AP, "ap_bev_r40_iou70", "ap_3d_r40_iou70", "ap_mean_r40_iou50", f"{AP}_cars", f"{AP}_points_5", f"{AP}_points_20",
    "recall_bev_iou70", "recall_3d_iou70",
)  # fmt: skip

COMPUTING = (cloud_simulation.__name__, sweeps.__name__, detection_metrics.__name__, scene_inputs.__name__)
CALLING = (__name__, study_detectors.__name__, detector_runs.__name__, held_out_traffic.__name__)

Columns = dict[str, Any]


def source_digest(detector: str) -> str:
    """Return the digest of the source that a detector's results depend on."""
    computing = stage_keys.source_digest(*COMPUTING, type(study_detectors.make(detector)).__module__)
    calling = {module: stage_keys.text_digest(module) for module in CALLING}
    return files.hash_json([computing.digest, calling])


def settings_digest(detector: str) -> str:
    """Return the hash of a detector's settings, or of its model."""
    return files.hash_json(study_detectors.make(detector).settings)


def dependencies(held_out: HeldOutTraffic, detector: str = POINT_COUNTS_NAME) -> list[dict[str, Any]]:
    """Return what the results at each candidate depend on, besides the source; without a detector, those of sweeps."""
    detectors = {} if detector == POINT_COUNTS_NAME else {detector: study_detectors.make(detector)}
    task = SiteDetectionTask(held_out, detectors)
    return [task.settings(site, detector) for site in held_out.scene.sites]


class _SiteCosts(DetectionListener):
    """Collects the processor time of each candidate."""

    def __init__(self) -> None:
        self.busy_s: list[float] = []

    def site_done(self, site: str, detectors: Sequence[str], cost: ResourceUsage) -> None:
        """Add the cost of a candidate whose results were not cached."""
        if detectors:
            self.busy_s.append(cost.busy_s)


@dataclass(frozen=True)
class DetectorPart:
    """Tables of a detector at all candidates of a junction.

    Attributes
    ----------
    measures
        One row per candidate and measure.
    hits
        One row per candidate and vehicle-frame.
    boxes
        One row per detection.
    site_s
        Mean processor time of one candidate; 0 where all results were cached.
    """

    measures: Columns
    hits: Columns
    boxes: Columns
    site_s: float


def run(
    held_out: HeldOutTraffic, detector: str, *, jobs: int | None = None, progress: ProgressCallback = no_progress
) -> DetectorPart:
    """Run a detector at every candidate."""
    costs = _SiteCosts()
    task = SiteDetectionTask(held_out, {detector: study_detectors.make(detector)})
    results = run_detectors(held_out.scene.sites, task, jobs=jobs, progress=progress, listener=costs)
    frames = list(held_out.read())
    targets = [frame.boxes[frame.target_rows(held_out.scene.roi)] for frame in frames]
    measured: Columns = {name: [] for name in ("site", "measure", "value", "left_out", "half_1", "half_2")}
    hits: list[FloatArray] = []
    points: list[FloatArray] = []
    boxes: list[Columns] = []
    for site, by_detector in results.items():
        found, counted = by_detector[detector], by_detector[POINT_COUNTS_NAME]
        assert isinstance(found, DetectedBoxes) and isinstance(counted, PointCounts)
        for measure, values in measures_of(frames, counted, found, held_out).items():
            for name, value in zip(measured, (site, measure, *values), strict=True):
                measured[name].append(value)
        hits.append(hits_of(targets, [detections.boxes for detections in found.frames]))
        points.append(np.concatenate(counted.points))
        boxes.append(_box_columns(site, found.frames))
    count = sum(len(each) for each in targets)
    hit_columns = {
        "site": np.repeat(list(results), count),
        "row": np.tile(np.arange(count), len(results)),
        "hits": np.concatenate(hits).astype(np.float32),
        "points": np.concatenate(points).astype(np.int32),
    }
    box_columns = {name: np.concatenate([each[name] for each in boxes]) for name in boxes[0]}
    return DetectorPart(measured, hit_columns, box_columns, mean(costs.busy_s) if costs.busy_s else 0.0)


def _box_columns(site: str, frames: Sequence[Detections]) -> Columns:
    counts = [len(detections.scores) for detections in frames]
    values = np.concatenate([detections.boxes for detections in frames])
    return {
        "site": np.repeat([site], sum(counts)),
        "frame": np.repeat(np.arange(len(frames)), counts),
        **dict(zip(BOX_COLUMNS, values.T, strict=True)),
        "score": np.concatenate([detections.scores for detections in frames]),
    }


MeasuredValues = tuple[float, FloatArray, float, float]
"""Value, values without each block, and those of both halves."""


def measures_of(
    frames: Sequence[TrafficFrame], points: PointCounts, boxes: DetectedBoxes, held_out: HeldOutTraffic
) -> Mapping[str, MeasuredValues]:
    """Return every measure of a detector at one candidate, by name; see :data:`MeasuredValues`."""
    objects = [
        GroundTruth.from_frame(frame, on_vehicles, held_out.scene.roi)
        for frame, on_vehicles in zip(frames, points.points, strict=True)
    ]
    whole = evaluate(EvaluationFrames.from_frames(objects, boxes.frames)).measures
    halves = []
    for half in half_frames(len(objects)):
        part = EvaluationFrames.from_frames([objects[i] for i in half], [boxes.frames[i] for i in half])
        halves.append(evaluate(part).measures)
    first, second = halves
    return {name: (whole[name].value, whole[name].left_out, first[name].value, second[name].value) for name in MEASURES}


def half_frames(frames: int) -> tuple[list[int], list[int]]:
    """Return the frames of the even and of the odd blocks: both halves reach over the whole record."""
    block = frame_blocks(frames, BLOCKS)
    even, odd = (np.flatnonzero(block % 2 == parity).tolist() for parity in (0, 1))
    return even, odd


def hits_of(targets: Sequence[FloatArray], results: Sequence[FloatArray]) -> FloatArray:
    """Return the share of the two views in which each vehicle is found, (n,) float64: 0, 0.5 or 1.

    A vehicle is found in a view (from above, in space) if any detection overlaps it by more than the largest of
    :data:`egvs.extensions.validation.detection_metrics.IOUS`. Vehicles do not overlap each other, so no detection
    overlaps two by so much, and matching would give the same.

    Parameters
    ----------
    targets, results
        Boxes of the vehicles and of the detections of each frame, (m, 7) float64 each, as
        :data:`egvs.artefacts.traffic_frames.BOX_COLUMNS`.
    """
    each = [_overlapped(boxes, result) for boxes, result in zip(targets, results, strict=True)]
    return np.concatenate([np.empty(0), *each])


def _overlapped(boxes: FloatArray, results: FloatArray) -> FloatArray:
    box, result = (number.ravel() for number in np.indices((len(boxes), len(results))))
    overlap = paired_overlap(boxes[box], results[result]).reshape(len(VIEWS), len(boxes), len(results))
    shares: FloatArray = (overlap > IOUS[0] + OVERLAP_TOLERANCE).any(axis=2).mean(axis=0)
    return shares
