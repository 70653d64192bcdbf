r"""Detection metrics: matching, recall and average precision with standard errors; ``detection.parquet``.

**Overlap** of two boxes: intersection over union, from above (BEV, rotated rectangles: area over area) and in 3D
(volume over volume: the common area times the common height). Boxes are upright; pitch is ignored, as in KITTI.

.. math:: IoU_{BEV} = \frac{A_{ab}}{A_a + A_b - A_{ab}}, \qquad
          IoU_{3D} = \frac{A_{ab} h_{ab}}{V_a + V_b - A_{ab} h_{ab}}

**Matching** follows the published rules of KITTI's object benchmark (Geiger, Lenz, Urtasun, "Are we ready for
autonomous driving?", CVPR 2012, and its development kit of 2017 for BEV and 3D). Frame by frame:

1. *First pass*, over all detections: each object takes, of the detections that overlap it by more than the minimum IoU
   and that no other object took, the one with the highest score. These scores are the candidates for thresholds.
2. *Second pass*, at a threshold, over the detections whose score reaches it: each object takes the free detection that
   overlaps it most. An object that takes one is a true positive; a detection that no object took is a false positive.
3. *Ignored objects* (KITTI: other difficulties, or vans where cars are evaluated) take part in both passes, and what
   they take is neither true nor false. So a box that fits a bus is no error of a vehicle detector where only cars are
   evaluated; a box that fits neither a bus nor a car is one.

In KITTI the order of lines in a file decides ties. Here the order of the input has no effect: evaluated objects come
before ignored ones, then objects are sorted by their values, and detections by score, then by their values. Detections
with equal scores pass a threshold together. "More than" means by more than 1e-9.

The result of the second pass changes only where the threshold passes a score of the frame, so one call computes it for
all thresholds.

**Average precision** as KITTI defines it. Of the scores from the first pass, in descending order, KITTI takes as
thresholds those nearest to the recalls 0, 1/40 .. 1, and counts true and false positives at each. The precision at a
step is the best one at this or any higher recall (0 where the recall is not reached), and

.. math:: AP_{R11} = \frac{1}{11} \sum_{r \in \{0, .1 .. 1\}} p(r), \qquad
          AP_{R40} = \frac{1}{40} \sum_{r \in \{1/40, 2/40 .. 1\}} p(r)

(Geiger et al. 2012; Simonelli et al., "Disentangling monocular 3D object detection", ICCV 2019, for R40), from 0 to 1.
*Mean* is the mean of BEV and 3D. *Recall* is the share of objects found at the lowest threshold.

With fewer than 41 objects there are no 41 recalls: KITTI's rule runs out of scores, and would give 2/11 to five objects
that are all found. Every frame is then counted as many times as are needed for 41 objects, which changes no precision
and no recall. From 41 objects on, the rule is exactly KITTI's. Without objects, every measure is NaN; where no object
is found, it is 0.

**Standard errors** come from the delete-a-group jackknife. Neighbouring frames are alike, so frames are divided into
blocks of neighbours, and the measure is computed again without each block. With k blocks of m_g of T frames, h_g = T /
m_g, the measure of all frames and without block g (Busing, Meijer, van der Leeden, Statistics and Computing 9, 1999),

.. math:: P_g = h_g \theta - (h_g - 1) \theta_{(g)}, \qquad \tilde\theta = \sum_g P_g / h_g, \qquad
          se^2 = \frac{1}{k} \sum_g \frac{(P_g - \tilde\theta)^2}{h_g - 1}

All sites have the same frames and blocks, so that a correlation over sites can resample blocks of all sites together.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from egvs.artefacts import parquet
from egvs.artefacts.traffic_frames import BOX_COLUMNS, TrafficFrame
from egvs.clouds.sweeps import Detections
from egvs.core.errors import Diagnostic, InputError
from egvs.core.grid import BoolArray, FloatArray, IntArray, Roi
from egvs.extensions.validation.detector_results import (
    CAR_VCLASSES,
    POINT_COUNTS_NAME,
    DetectedBoxes,
    DetectorResult,
    PointCounts,
    concatenate_boxes,
)
from egvs.extensions.validation.kernels import detection

BLOCKS = 10
"""Default number of blocks of frames."""

View = Literal["bev", "3d"]

VIEWS: tuple[View, ...] = ("bev", "3d")

RECALL_STEPS = 40

IOUS = (0.7, 0.5)
"""Minimum overlaps of a match: that of the paper and of KITTI for cars, and one for less accurate detectors."""

MEASURE_NAMES = ("ap_{}_r11", "ap_{}_r40", "recall_{}")
"""The measures of a view, in the order of :func:`ap_and_recall`."""

POINT_THRESHOLDS = (1, 5, 10, 20, 50)
"""Numbers of points from which a vehicle counts as visible."""

ALL_OBJECTS = "vehicles"
"""Name of the set of all objects."""

_COUNTED_POINTS = (1, 5, 20)


@dataclass(frozen=True)
class JackknifeEstimate:
    """A measure with its standard error.

    Attributes
    ----------
    value
        From all frames; NaN where it is undefined.
    left_out
        Without each block of frames, (blocks,) float64; NaN where it is undefined.
    se
        Standard error; NaN where one of these is undefined.
    """

    value: float
    left_out: FloatArray
    se: float

    @classmethod
    def from_values(cls, values: FloatArray, block_frames: IntArray) -> JackknifeEstimate:
        """Compute the standard error.

        Parameters
        ----------
        values
            The measure of all frames, then without each block, (1 + blocks,).
        block_frames
            Number of frames of each block, (blocks,).
        """
        value = values[0]
        left_out = values[1:]
        h = block_frames.sum() / block_frames
        pseudo = h * value - (h - 1.0) * left_out
        centre = (pseudo / h).sum()
        return cls(float(value), left_out, float(np.sqrt(((pseudo - centre) ** 2 / (h - 1.0)).mean())))


UNDEFINED = JackknifeEstimate(math.nan, np.full(BLOCKS, math.nan), math.nan)


def frame_blocks(frames: int, blocks: int = BLOCKS) -> IntArray:
    """Return the block of each frame, (frames,) int64: neighbours, in blocks of equal size up to one frame.

    Raises
    ------
    InputError
        For fewer frames than blocks.
    """
    if frames < blocks:
        problem = f"expected at least {blocks} frames, got {frames}"
        raise InputError("--frames", problem, f"Standard errors are computed from {blocks} blocks of frames.")
    return np.arange(frames, dtype=np.int64) * blocks // frames


def estimate_difference(first: JackknifeEstimate, second: JackknifeEstimate, frames: int) -> JackknifeEstimate:
    """Return the first measure minus the second, both of the same frames, with the error of the difference."""
    values = np.concatenate([[first.value - second.value], first.left_out - second.left_out])
    return JackknifeEstimate.from_values(values, np.bincount(frame_blocks(frames)))


def paired_overlap(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the overlap of box k of a with box k of b.

    Parameters
    ----------
    a, b
        (n, 7) float64, as :data:`egvs.artefacts.traffic_frames.BOX_COLUMNS`.

    Returns
    -------
    NDArray
        In the order of :data:`VIEWS`, (2, n) float64, 0 to 1; 0 for boxes without area or volume.
    """
    overlap = np.empty((len(VIEWS), len(a)))
    a = np.ascontiguousarray(a, np.float64)
    b = np.ascontiguousarray(b, np.float64)
    detection.overlap_each(a, b, overlap[0], overlap[1])
    return overlap


@dataclass(frozen=True)
class GroundTruth:
    """The vehicles of one frame that a detector should find.

    Attributes
    ----------
    boxes
        (n, 7) float64, as :data:`egvs.artefacts.traffic_frames.BOX_COLUMNS`.
    is_car
        (n,) bool.
    points
        Number of points of the sweep on each, (n,) int64.
    """

    boxes: FloatArray
    is_car: BoolArray
    points: IntArray

    @classmethod
    def from_frame(cls, frame: TrafficFrame, points: IntArray, roi: Roi) -> GroundTruth:
        """Return the vehicles in the region of interest; ``points`` is the number of points on each of them."""
        rows = frame.target_rows(roi)
        is_car = np.isin(frame.kinds, list(CAR_VCLASSES))
        return cls(frame.boxes[rows], is_car[rows], points)


@dataclass(frozen=True)
class Matches:
    """Which detections are true, each (m,), in the order of the detections of :class:`EvaluationFrames`.

    Attributes
    ----------
    scored
        Bool: taken in the first pass by an evaluated object.
    true_step, false_step
        Int64: by how much the numbers of true and false positives in the frame change when this detection is added to
        those before it; of equal scores the sum counts.
    """

    scored: BoolArray
    true_step: IntArray
    false_step: IntArray


class FrameStarts(NamedTuple):
    """Where the objects, the detections, and their pairs start for each frame, and end for the last, (frames + 1,)."""

    objects: IntArray
    detections: IntArray
    pairs: IntArray


@dataclass(frozen=True)
class EvaluationFrames:
    """Objects and detections of all frames of a site, in an order that does not depend on the order of the input.

    Attributes
    ----------
    object_frame, detection_frame
        Index of the frame of each object (n,) and each detection (m,); int64, ascending.
    is_car, points
        Of the objects, (n,).
    scores
        Of the detections, (m,) float64, descending in each frame.
    frames
        Number of frames.
    """

    object_frame: IntArray
    detection_frame: IntArray
    is_car: BoolArray
    points: IntArray
    scores: FloatArray
    frames: int
    _starts: FrameStarts
    _overlap: FloatArray

    @classmethod
    def from_frames(cls, objects: Sequence[GroundTruth], detections: Sequence[Detections]) -> EvaluationFrames:
        """Sort the objects and the detections of every frame, and compute their overlaps.

        Raises
        ------
        InputError
            For a box or a score that is not finite, or a negative size.
        """
        object_frame = _frame_of_rows([len(frame.boxes) for frame in objects])
        boxes = concatenate_boxes(frame.boxes for frame in objects)
        is_car = np.concatenate([np.empty(0, np.bool_), *(frame.is_car for frame in objects)])
        points = np.concatenate([np.empty(0, np.int64), *(frame.points for frame in objects)])
        order = np.lexsort((points, is_car, *boxes.T[::-1], object_frame))

        detection_frame = _frame_of_rows([len(frame.boxes) for frame in detections])
        detected_boxes = concatenate_boxes(frame.boxes for frame in detections)
        scores = np.concatenate([np.empty(0), *(frame.scores for frame in detections)])
        _check_detections(detection_frame, detected_boxes, scores)
        by_score = np.lexsort((*detected_boxes.T[::-1], -scores, detection_frame))

        starts = _frame_starts(object_frame, detection_frame, len(objects))
        overlap = np.empty((len(VIEWS), starts.pairs[-1]))
        detection.fill_overlaps(
            boxes[order], starts.objects, detected_boxes[by_score], starts.detections, starts.pairs, overlap
        )
        return cls(
            object_frame, detection_frame, is_car[order], points[order], scores[by_score], len(objects), starts, overlap
        )

    def match(self, view: View, iou: float, evaluated: BoolArray) -> Matches:
        """Match all frames.

        Parameters
        ----------
        view
            From above, or in 3D.
        iou
            The overlap that a match must exceed.
        evaluated
            Which objects are not ignored, (n,) bool.
        """
        count = len(self.scores)
        matches = Matches(np.zeros(count, np.bool_), np.zeros(count, np.int64), np.zeros(count, np.int64))
        overlap = self._overlap[VIEWS.index(view)]
        detection.match_frames(
            *self._starts, overlap, evaluated, iou, matches.scored, matches.true_step, matches.false_step
        )
        return matches


def _frame_of_rows(counts: Sequence[int]) -> IntArray:
    """Return the frame of each row, where frames have these numbers of rows."""
    return np.repeat(np.arange(len(counts), dtype=np.int64), np.asarray(counts, dtype=np.int64))


def _frame_starts(object_frame: IntArray, detection_frame: IntArray, frames: int) -> FrameStarts:
    objects = np.bincount(object_frame, minlength=frames)
    detections = np.bincount(detection_frame, minlength=frames)
    counts = (objects, detections, objects * detections)
    return FrameStarts(*(np.concatenate([[0], np.cumsum(count)]).astype(np.int64) for count in counts))


def _check_detections(frame: IntArray, boxes: FloatArray, scores: FloatArray) -> None:
    values = np.column_stack([boxes, scores])
    invalid = ~np.isfinite(values)
    invalid[:, 3:6] |= values[:, 3:6] < 0.0
    if invalid.any():
        row, column = np.argwhere(invalid)[0].tolist()
        where = f"detection {row - int(np.searchsorted(frame, frame[row]))} of frame {frame[row]}"
        name = (*BOX_COLUMNS, "score")[column]
        expected = "a length of at least 0" if 3 <= column < 6 else "a finite number"
        problem = f"{name}: expected {expected}, got {values[row, column]:g}"
        raise InputError(where, problem, "Correct the output of the detector.")


@dataclass(frozen=True)
class ObjectSubset:
    """A set of objects to evaluate; all others are ignored.

    Attributes
    ----------
    name
        Suffix of its columns; empty for all vehicles.
    label
        Name in messages.
    cars_only
        Whether only cars are evaluated.
    min_points
        Number of points of the sweep that an object must have.
    """

    name: str
    label: str
    cars_only: bool = False
    min_points: int = 0

    def select(self, frames: EvaluationFrames) -> BoolArray:
        """Return which objects are in the set, (n,) bool."""
        selected = frames.points >= self.min_points
        if self.cars_only:
            return selected & frames.is_car
        return selected


SUBSETS = (
    ObjectSubset("", "vehicles"),
    ObjectSubset("cars", "cars", cars_only=True),
    *(
        ObjectSubset(f"points_{points}", f"vehicles with {points} points or more", min_points=points)
        for points in _COUNTED_POINTS
    ),
)


def measure_name(kind: str, view: str, iou: float, subset: ObjectSubset) -> str:
    """Return a name like ``ap_bev_r40_iou70`` or ``recall_3d_iou50_points_5``."""
    name = f"{kind.format(view)}_iou{round(100 * iou)}"
    return f"{name}_{subset.name}" if subset.name else name


@dataclass(frozen=True)
class Evaluation:
    """The measures of a detector at a site.

    Attributes
    ----------
    frames
        Number of frames.
    objects
        Number of objects in each block of frames, (blocks,) int64, by subset.
    measures
        By :func:`measure_name`, with views ``bev``, ``3d`` and ``mean`` of both (AP only).
    """

    frames: int
    objects: dict[str, IntArray]
    measures: dict[str, JackknifeEstimate]

    def warnings(self, location: str) -> list[Diagnostic]:
        """Return a warning for each subset without measures, or without standard errors."""
        warnings = []
        for subset in SUBSETS:
            counts = self.objects[subset.name]
            if not counts.any():
                problem = f"no {subset.label} in {self.frames} frames, so average precision is undefined"
            elif np.count_nonzero(counts) == 1:
                problem = f"all {subset.label} are in one of {len(counts)} blocks of frames: no standard error"
            else:
                continue
            warnings.append(Diagnostic("average precision", location, problem, "Use more frames."))
        return warnings


def evaluate(frames: EvaluationFrames, blocks: int = BLOCKS) -> Evaluation:
    """Return every measure of a detector at a site, with all frames and without each block.

    Raises
    ------
    InputError
        For fewer frames than blocks.
    """
    block = frame_blocks(frames.frames, blocks)
    order = np.argsort(-frames.scores, kind="stable")
    ranked = RankedDetections.from_scores(frames.scores[order], block[frames.detection_frame[order]], blocks)
    objects: dict[str, IntArray] = {}
    measures: dict[str, JackknifeEstimate] = {}
    for subset in SUBSETS:
        evaluated = subset.select(frames)
        objects[subset.name] = np.bincount(block[frames.object_frame[evaluated]], minlength=blocks)
        for iou in IOUS:
            views = []
            for view in VIEWS:
                matches = frames.match(view, iou, evaluated)
                matches = Matches(matches.scored[order], matches.true_step[order], matches.false_step[order])
                views.append(ranked.measures(matches, objects[subset.name]))
            for name, values in _named_measures(views, iou, subset):
                measures[name] = JackknifeEstimate.from_values(values, np.bincount(block))
    return Evaluation(frames.frames, objects, measures)


def _named_measures(views: Sequence[FloatArray], iou: float, subset: ObjectSubset) -> Iterator[tuple[str, FloatArray]]:
    """Yield the names and values of the measures of both views, then their means."""
    for view, values in zip(VIEWS, views, strict=True):
        for kind, column in zip(MEASURE_NAMES, values.T, strict=True):
            yield measure_name(kind, view, iou, subset), column
    mean = (views[0] + views[1]) / 2.0
    for kind, column in zip(MEASURE_NAMES[:2], mean.T[:2], strict=True):
        yield measure_name(kind, "mean", iou, subset), column


@dataclass(frozen=True)
class RankedDetections:
    """The detections of all frames, by descending score.

    Attributes
    ----------
    included
        Whether each is included, with all frames and without each block, (1 + blocks, m) bool.
    last
        Row of the last detection with the same score, (m,) int64.
    """

    included: BoolArray
    last: IntArray

    @classmethod
    def from_scores(cls, scores: FloatArray, block: IntArray, blocks: int) -> RankedDetections:
        """Rank detections by their scores, descending, with the block of each."""
        left_out = np.arange(-1, blocks)
        return cls(block != left_out[:, None], np.searchsorted(-scores, -scores, side="right") - 1)

    def measures(self, matches: Matches, object_counts: IntArray) -> FloatArray:
        """Return the measures of :data:`MEASURE_NAMES`, with all frames and without each block, (1 + blocks, 3).

        Parameters
        ----------
        matches
            In the order of the detections here.
        object_counts
            Number of evaluated objects of each block.
        """
        values = np.empty((len(self.included), len(MEASURE_NAMES)))
        objects = object_counts.sum() - np.concatenate([[0], object_counts])
        for row, included in enumerate(self.included):
            thresholds = self.last[_score_thresholds(np.flatnonzero(matches.scored & included), int(objects[row]))]
            true = np.cumsum(np.where(included, matches.true_step, 0))[thresholds]
            false = np.cumsum(np.where(included, matches.false_step, 0))[thresholds]
            values[row] = ap_and_recall(true, false, int(objects[row]))
        return values


def _score_thresholds(scored: IntArray, objects: int) -> IntArray:
    """Return which of the detections that objects took give the thresholds, by KITTI's rule."""
    if not objects:
        return scored[:0]
    times = math.ceil((RECALL_STEPS + 1) / objects)
    rows = np.empty(RECALL_STEPS + 1, np.int64)
    filled = detection.threshold_rows(times * len(scored), times * objects, RECALL_STEPS, rows)
    return scored[rows[:filled] // times]


def ap_and_recall(true: IntArray, false: IntArray, objects: int) -> tuple[float, float, float]:
    """Return AP R11, AP R40 and recall from true and false positives at the thresholds, the highest first."""
    if not objects:
        return np.nan, np.nan, np.nan
    precision = np.zeros(RECALL_STEPS + 1)
    precision[: len(true)] = true / (true + false)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    recall = float(true[-1] / objects) if len(true) else 0.0
    return float(best[:: RECALL_STEPS // 10].mean()), float(best[1:].mean()), recall


def _ap_measures() -> Iterator[str]:
    for iou in IOUS:
        suffix = f"iou{round(100 * iou)}"
        for view in (*VIEWS, "mean"):
            yield f"ap_{view}_r11_{suffix}"
            yield f"ap_{view}_r40_{suffix}"
        for view in VIEWS:
            yield f"recall_{view}_{suffix}"


AP_MEASURES = tuple(_ap_measures())
"""Measures of detectors that return boxes."""

POINT_MEASURES = (*(f"seen_{points}" for points in POINT_THRESHOLDS), "log_points")
"""Measures of the number of points on vehicles."""

MEASURES = (*AP_MEASURES, *POINT_MEASURES)
"""Columns of ``detection.parquet`` with a standard error each."""


@dataclass(frozen=True)
class SiteDetection:
    """The measures of one detector at one site, for one set of objects.

    Attributes
    ----------
    site, detector
        Their names.
    objects_of
        The set of objects: ``vehicles``, ``cars``, ``points_1`` ..
    frames
        Number of frames.
    objects
        Number of objects in the set.
    objects_with
        Number of these objects, by minimum number of points.
    measures
        Columns of ``detection.parquet``.
    """

    site: str
    detector: str
    objects_of: str
    frames: int
    objects: int
    objects_with: Mapping[int, int]
    measures: Mapping[str, JackknifeEstimate]


class _SiteWarning(NamedTuple):
    site: str
    detector: str
    warning: Diagnostic


def measure_detection(
    frames: Sequence[TrafficFrame], roi: Roi, results: Mapping[str, Mapping[str, DetectorResult]]
) -> tuple[list[SiteDetection], list[Diagnostic]]:
    """Return every row of ``detection.parquet``, and warnings about undefined measures.

    Parameters
    ----------
    frames
        The validated frames.
    roi
        The region of interest.
    results
        By site and detector; each site has its points on vehicles.
    """
    rows: list[SiteDetection] = []
    warnings: list[_SiteWarning] = []
    for site, by_detector in results.items():
        points = by_detector[POINT_COUNTS_NAME]
        assert isinstance(points, PointCounts)
        objects = []
        for frame, on_vehicles in zip(frames, points.points, strict=True):
            objects.append(GroundTruth.from_frame(frame, on_vehicles, roi))
        without_boxes = EvaluationFrames.from_frames(objects, [Detections.empty()] * len(objects))
        point_measures = {subset.name: _point_measures(without_boxes, subset) for subset in SUBSETS}
        for name, result in by_detector.items():
            box_measures: Mapping[str, JackknifeEstimate] = {}
            if isinstance(result, DetectedBoxes):
                evaluation = evaluate(EvaluationFrames.from_frames(objects, result.frames))
                warnings += [_SiteWarning(site, name, warning) for warning in evaluation.warnings("")]
                box_measures = evaluation.measures
            for subset in SUBSETS:
                on_objects = without_boxes.points[subset.select(without_boxes)]
                measures = {}
                for column in AP_MEASURES:
                    full_name = f"{column}_{subset.name}" if subset.name else column
                    measures[column] = box_measures.get(full_name, UNDEFINED)
                measures |= point_measures[subset.name]
                counts = {minimum: int((on_objects >= minimum).sum()) for minimum in _COUNTED_POINTS}
                set_name = subset.name or ALL_OBJECTS
                rows.append(SiteDetection(site, name, set_name, len(frames), len(on_objects), counts, measures))
    return rows, _merge_warnings(warnings)


def _merge_warnings(warnings: Sequence[_SiteWarning]) -> list[Diagnostic]:
    """Combine equal warnings about several sites."""
    sites: dict[tuple[str, Diagnostic], list[str]] = {}
    for site, detector, warning in warnings:
        sites.setdefault((detector, warning), []).append(site)
    merged = []
    for (detector, warning), names in sites.items():
        plural = "s" if len(names) > 1 else ""
        merged.append(replace(warning, where=f"detector {detector}, site{plural} {', '.join(names)}"))
    return merged


def write_detection(path: Path, rows: Sequence[SiteDetection], metadata: Mapping[str, Any]) -> None:
    """Write ``detection.parquet``."""
    columns = {"site": [row.site for row in rows], **detection_columns(rows)}
    parquet.write_artefact(path, "detection", columns, dict(metadata))


def detection_columns(rows: Sequence[SiteDetection]) -> dict[str, list[Any]]:
    """Return all columns of the artefact by name, except that of the site."""
    columns: dict[str, list[Any]] = {}
    for name in ("detector", "objects_of", "frames", "objects"):
        columns[name] = [getattr(row, name) for row in rows]
    for minimum in _COUNTED_POINTS:
        columns[f"objects_{minimum}"] = [row.objects_with[minimum] for row in rows]
    for name in MEASURES:
        columns[name] = [row.measures[name].value for row in rows]
        columns[f"{name}_se"] = [row.measures[name].se for row in rows]
    return columns


def _point_measures(frames: EvaluationFrames, subset: ObjectSubset) -> dict[str, JackknifeEstimate]:
    """Return the shares of objects with a minimum number of points, and the mean of log(1 + points)."""
    selected = subset.select(frames)
    block = frame_blocks(frames.frames)
    is_visible = frames.points[:, None] >= np.array(POINT_THRESHOLDS)
    values = np.column_stack([is_visible, np.log1p(frames.points)])[selected]
    included = block[frames.object_frame[selected]] != np.arange(-1, BLOCKS)[:, None]
    count = included.sum(axis=1)
    with np.errstate(invalid="ignore"):
        means = included.astype(np.float64) @ values / count[:, None]
    estimates = {}
    for name, column in zip(POINT_MEASURES, means.T, strict=True):
        estimates[name] = JackknifeEstimate.from_values(column, np.bincount(block))
    return estimates
