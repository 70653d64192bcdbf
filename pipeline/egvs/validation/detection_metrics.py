r"""Matching, precision, recall, AP with standard errors; detection.parquet.

Estimates how far a measure may be off because the frames are few, and keeps what that is known from.

Frames are cut into blocks of neighbours: what is detected in one frame is much like what is detected in the next. The
measure is computed again with each block left out: the delete-a-group jackknife. With k blocks of m_g of T frames, h_g
= T / m_g, the measure of all frames and with block g left out (Busing, Meijer, van der Leeden, Statistics and Computing
9, 1999),

.. math:: P_g = h_g \theta - (h_g - 1) \theta_{(g)}, \qquad \tilde\theta = \sum_g P_g / h_g, \qquad
          se^2 = \frac{1}{k} \sum_g \frac{(P_g - \tilde\theta)^2}{h_g - 1}

All sites have the same frames and blocks, so that a correlation over sites can resample blocks of all sites together.

How much of two boxes is common to both: intersection over union, from above and in space.

From above (BEV) boxes are rotated rectangles, and the overlap is area over area. In space it is volume over volume: the
shared area times the shared height. Boxes stand upright, pitch is left out, as in KITTI.

.. math:: IoU_{BEV} = \frac{A_{ab}}{A_a + A_b - A_{ab}}, \qquad
          IoU_{3D} = \frac{A_{ab} h_{ab}}{V_a + V_b - A_{ab} h_{ab}}

Which detections are true: every frame's detections are matched to its objects, as KITTI's evaluation does.

Written from the published semantics of KITTI's object benchmark (Geiger, Lenz, Urtasun, "Are we ready for autonomous
driving?", CVPR 2012, and its development kit of 2017 for boxes from above and in space). Frame by frame:

1. *First pass*, over all detections: each object in turn takes, of the detections that overlap it by more than the
   bound and that no other object took, the one with the highest score. These scores make the thresholds.
2. *Second pass*, at a threshold, over the detections whose score reaches it: each object in turn takes the free
   detection that overlaps it most. An object that takes one is a true positive; a detection that none took is false.
3. *Objects that do not count* (KITTI: other difficulty, or a van where cars are asked for) take part in both, and what
   they take is neither true nor false. So a box that sits well on a bus is no error of a detector of vehicles when cars
   alone are asked for; a box that fits neither bus nor car is one.

KITTI leaves to the order of lines in a file who comes first. Here the order has no say: objects that count come before
those that do not, then objects go by their numbers and detections by score, then by their numbers. Equal scores enter
together. "More than" means by 1e-9 more.

The second pass changes only where the threshold passes a score of the frame, so one call gives it for all thresholds.

Average precision, as KITTI defines it, of a detector at a site, with its standard errors.

The matching of :mod:`egvs.validation.detection_metrics` gives a score to each object that was found. Of these, in
descending order, KITTI takes as thresholds those that come nearest to the recalls 0, 1/40 .. 1, and counts true and
false positives at each. The precision at a step is the best one at this or any higher recall (0 where recall was not
reached), and

.. math:: AP_{R11} = \frac{1}{11} \sum_{r \in \{0, .1 .. 1\}} p(r), \qquad
          AP_{R40} = \frac{1}{40} \sum_{r \in \{1/40, 2/40 .. 1\}} p(r)

(Geiger et al. 2012; Simonelli et al., "Disentangling monocular 3D object detection", ICCV 2019, for R40). All are
shares from 0 to 1. *Combined* is the sum of the two views, 0 to 2. *Recall* is the share of objects found at the lowest
threshold.

**Fewer than 41 objects** have no 41 recalls: KITTI's rule runs out of scores, and would give 2/11 to five objects that
are all found. Every frame is then counted as often as makes at least 41 objects, which changes no precision and no
recall. From 41 objects on the rule is KITTI's to the letter.

**No objects**: every measure is NaN. None found: 0.

How much is detected from each site: findings against the ground truth, as ``detection.parquet``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.traffic_frames import BOX_COLUMNS, TrafficFrame
from egvs.core.errors import Diagnostic, InputError
from egvs.core.grid import Roi
from egvs.kernels import detection
from egvs.validation.sweeps import (
    CAR_VCLASSES,
    POINT_COUNTS_NAME,
    DetectedBoxes,
    Detections,
    DetectorResult,
    PointCounts,
)

BLOCKS = 10
"""Blocks of frames, unless asked otherwise."""


@dataclass(frozen=True)
class JackknifeEstimate:
    """A measure, and how far it may be off.

    Attributes
    ----------
    value
        Of all frames; NaN where it is not defined.
    left_out
        With each block left out, (blocks,) float64; NaN where it is not defined.
    se
        Standard error; NaN where one of these is not defined.
    """

    value: float
    left_out: NDArray[np.float64]
    se: float

    @classmethod
    def of(cls, values: NDArray[np.float64], block_frames: NDArray[np.int64]) -> JackknifeEstimate:
        """From the measure of all frames, then with each block left out, (1 + blocks,), and the frames of each."""
        value, left_out = values[0], values[1:]
        h = block_frames.sum() / block_frames
        pseudo = h * value - (h - 1.0) * left_out
        centre = (pseudo / h).sum()
        return cls(float(value), left_out, float(np.sqrt(((pseudo - centre) ** 2 / (h - 1.0)).mean())))


def frame_blocks(frames: int, blocks: int = BLOCKS) -> NDArray[np.int64]:
    """The block of each frame, (frames,) int64: neighbours, whose numbers differ by one at most.

    Raises
    ------
    InputError
        For fewer frames than blocks.
    """
    if frames < blocks:
        raise InputError("--frames", f"{frames}", f"at least {blocks}: standard errors come from {blocks} blocks")
    return np.arange(frames, dtype=np.int64) * blocks // frames


View = Literal["bev", "3d"]

VIEWS: tuple[View, ...] = ("bev", "3d")


def paired_overlap(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Overlap of box k of a with box k of b.

    Parameters
    ----------
    a, b
        (n, 7) float64, as :data:`egvs.artefacts.traffic_frames.BOX_COLUMNS`.

    Returns
    -------
    NDArray
        In the order of :data:`VIEWS`, (2, n) float64, 0 to 1; 0 for boxes without any area or volume.
    """
    found = np.empty((len(VIEWS), len(a)))
    detection.overlap_each(np.ascontiguousarray(a, np.float64), np.ascontiguousarray(b, np.float64), found[0], found[1])
    return found


@dataclass(frozen=True)
class GroundTruth:
    """Ground truth of one frame.

    Attributes
    ----------
    boxes
        (n, 7) float64, as :data:`egvs.artefacts.traffic_frames.BOX_COLUMNS`.
    is_car
        (n,) bool.
    points
        How many points of the sweep lie on each, (n,) int64.
    """

    boxes: NDArray[np.float64]
    is_car: NDArray[np.bool_]
    points: NDArray[np.int64]

    @classmethod
    def of(cls, frame: TrafficFrame, points: NDArray[np.int64], roi: Roi) -> GroundTruth:
        """The vehicles of a frame that a detector should find; ``points`` are those on each of the frame's boxes."""
        return cls.of_counted(frame, points[frame.target_rows(roi)], roi)

    @classmethod
    def of_counted(cls, frame: TrafficFrame, points: NDArray[np.int64], roi: Roi) -> GroundTruth:
        """The same from the points on these vehicles alone."""
        rows = frame.target_rows(roi)
        cars = np.array([frame.kinds[row] in CAR_VCLASSES for row in rows], dtype=np.bool_)
        return cls(frame.boxes[rows], cars, points)


@dataclass(frozen=True)
class Matches:
    """What of the detections of a :class:`EvaluationFrames` is true, all three (m,) in its order.

    Attributes
    ----------
    scored
        Bool: taken in the first pass by an object that counts.
    true_step, false_step
        Int64: how many more true and false positives there are in the frame once this detection is let in, after those
        before it; of equal scores the sum counts.
    """

    scored: NDArray[np.bool_]
    true_step: NDArray[np.int64]
    false_step: NDArray[np.int64]


@dataclass(frozen=True)
class EvaluationFrames:
    """Objects and detections of all frames of a site, in an order that does not depend on how they were given.

    Attributes
    ----------
    object_frame, found_frame
        Position of its frame in the record, of each object (n,) and each detection (m,); int64, ascending.
    is_car, points
        Of the objects, (n,).
    scores
        Of the detections, (m,) float64, descending in each frame.
    frames
        How many there are.
    """

    object_frame: NDArray[np.int64]
    detection_frame: NDArray[np.int64]
    is_car: NDArray[np.bool_]
    points: NDArray[np.int64]
    scores: NDArray[np.float64]
    frames: int
    _starts: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]
    _overlap: NDArray[np.float64]

    @classmethod
    def of(cls, objects: Sequence[GroundTruth], detections: Sequence[Detections]) -> EvaluationFrames:
        """From the objects and the detections of every frame, in the order of the frames.

        Raises
        ------
        InputError
            For a box or a score that is no finite number, or a negative size.
        """
        at = _frame_of_rows([len(frame.boxes) for frame in objects])
        boxes = np.concatenate([np.empty((0, 7)), *(frame.boxes for frame in objects)])
        cars = np.concatenate([np.empty(0, np.bool_), *(frame.is_car for frame in objects)])
        points = np.concatenate([np.empty(0, np.int64), *(frame.points for frame in objects)])
        order = np.lexsort((points, cars, *boxes.T[::-1], at))
        at_found = _frame_of_rows([len(frame.boxes) for frame in detections])
        found_boxes = np.concatenate([np.empty((0, 7)), *(frame.boxes for frame in detections)])
        scores = np.concatenate([np.empty(0), *(frame.scores for frame in detections)])
        _check_arrays(at_found, found_boxes, scores)
        surest = np.lexsort((*found_boxes.T[::-1], -scores, at_found))
        starts = _frame_starts(at, at_found, len(objects))
        overlap = np.empty((len(VIEWS), starts[2][-1]))
        detection.overlap_frames(boxes[order], starts[0], found_boxes[surest], starts[1], starts[2], overlap)
        return cls(at, at_found, cars[order], points[order], scores[surest], len(objects), starts, overlap)

    def match(self, view: View, iou: float, counted: NDArray[np.bool_]) -> Matches:
        """Match all frames.

        Parameters
        ----------
        iou
            The overlap that a match must exceed.
        counted
            Which objects count, (n,) bool.
        """
        count = len(self.scores)
        found = Matches(np.zeros(count, np.bool_), np.zeros(count, np.int64), np.zeros(count, np.int64))
        detection.match_frames(
            *self._starts,
            self._overlap[VIEWS.index(view)],
            counted,
            iou,
            found.scored,
            found.true_step,
            found.false_step,
        )
        return found


def _frame_of_rows(counts: Sequence[int]) -> NDArray[np.int64]:
    """The frame of each row, where frames have these many rows."""
    return np.repeat(np.arange(len(counts), dtype=np.int64), np.asarray(counts, dtype=np.int64))


def _frame_starts(
    objects: NDArray[np.int64], detections: NDArray[np.int64], frames: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Where the objects, the detections and their pairs begin of each frame, and where the last ends."""
    counts = [np.bincount(rows, minlength=frames) for rows in (objects, detections)]
    each = (*counts, counts[0] * counts[1])
    objects_at, found_at, pairs_at = (np.concatenate([[0], np.cumsum(count)]).astype(np.int64) for count in each)
    return objects_at, found_at, pairs_at


def _check_arrays(frame: NDArray[np.int64], boxes: NDArray[np.float64], scores: NDArray[np.float64]) -> None:
    values = np.column_stack([boxes, scores])
    wrong = ~np.isfinite(values)
    wrong[:, 3:6] |= values[:, 3:6] < 0.0
    if wrong.any():
        row, column = (int(k[0]) for k in np.nonzero(wrong))
        place = f"detection {row - int(np.searchsorted(frame, frame[row]))} of frame {frame[row]}"
        name = (*BOX_COLUMNS, "score")[column]
        right = "a length of at least 0" if 3 <= column < 6 else "a finite number"
        raise InputError(place, f"{name} is {values[row, column]:g}", right)


RECALL_STEPS = 40
"""Steps of recall."""

IOUS = (0.7, 0.5)
"""Overlaps that a match must exceed: the paper's and KITTI's for cars, and one for a cruder detector."""

MEASURE_NAMES = ("ap_{}_r11", "ap_{}_r40", "recall_{}")
"""The measures of a view, in the order of :func:`ap_and_recall`."""


@dataclass(frozen=True)
class ObjectSubset:
    """Which objects count; the others take detections out of the count.

    Attributes
    ----------
    name
        As columns end; empty for all vehicles.
    cars
        Whether cars alone count.
    points
        How many points of the sweep an object must have.
    """

    name: str
    cars: bool = False
    points: int = 0

    def of(self, record: EvaluationFrames) -> NDArray[np.bool_]:
        """Which objects of a record count, (n,) bool."""
        enough = record.points >= self.points
        return enough & record.is_car if self.cars else enough


SUBSETS = (
    ObjectSubset(""),
    ObjectSubset("cars", cars=True),
    *(ObjectSubset(f"points_{least}", points=least) for least in (1, 5, 20)),
)


def measure_name(kind: str, view: str, iou: float, subset: ObjectSubset) -> str:
    """As ``ap_bev_r40_iou70`` or ``recall_3d_iou50_points_5``."""
    return "_".join([kind.format(view), f"iou{round(100 * iou)}", *filter(None, [subset.name])])


@dataclass(frozen=True)
class Evaluation:
    """How well a detector does at a site.

    Attributes
    ----------
    frames
        How many were looked at.
    objects
        How many objects count in each block of frames, (blocks,) int64, by the name of their subset.
    measures
        By :func:`measure_name`, with views ``bev``, ``3d`` and ``combined`` (of AP alone).
    """

    frames: int
    objects: dict[str, NDArray[np.int64]]
    measures: dict[str, JackknifeEstimate]

    def warnings(self, location: str) -> list[Diagnostic]:
        """Which measures are not defined, or have no standard error, as warnings."""
        found = []
        for name, counts in self.objects.items():
            what = _SUBSET_LABELS[name]
            if not counts.any():
                text = f"no {what} in {self.frames} frames: there is no average precision"
            elif np.count_nonzero(counts) == 1:
                text = f"the only {what} are in one of {len(counts)} blocks of frames: there is no standard error"
            else:
                continue
            found.append(Diagnostic("average precision", location, text, "more frames"))
        return found


_SUBSET_LABELS = {
    its.name: "cars" if its.cars else f"vehicles with {its.points} points or more" if its.points else "vehicles"
    for its in SUBSETS
}


def evaluate(record: EvaluationFrames, blocks: int = BLOCKS) -> Evaluation:
    """Every measure of a site and detector, with each block of frames left out.

    Raises
    ------
    InputError
        For fewer frames than blocks.
    """
    block = frame_blocks(record.frames, blocks)
    order = np.argsort(-record.scores, kind="stable")
    ranked = RankedDetections.of(record.scores[order], block[record.detection_frame[order]], blocks)
    objects: dict[str, NDArray[np.int64]] = {}
    measures: dict[str, JackknifeEstimate] = {}
    for subset in SUBSETS:
        wanted = subset.of(record)
        counts = np.bincount(block[record.object_frame[wanted]], minlength=blocks)
        objects[subset.name] = counts
        for iou in IOUS:
            for name, values in _measure_values(record, ranked, order, subset, wanted, counts, iou):
                measures[name] = JackknifeEstimate.of(values, np.bincount(block))
    return Evaluation(record.frames, objects, measures)


def _measure_values(
    record: EvaluationFrames,
    ranked: RankedDetections,
    order: NDArray[np.int64],
    subset: ObjectSubset,
    counted: NDArray[np.bool_],
    counts: NDArray[np.int64],
    iou: float,
) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Names of the measures of one subset and bound, and each of all frames and with each block left out."""
    views = []
    for view in VIEWS:
        its = record.match(view, iou, counted)
        its = Matches(its.scored[order], its.true_step[order], its.false_step[order])
        views.append(ranked.measures(its, counts))
        yield from (
            (measure_name(kind, view, iou, subset), column)
            for kind, column in zip(MEASURE_NAMES, views[-1].T, strict=True)
        )
    for kind, column in zip(MEASURE_NAMES[:2], (views[0] + views[1]).T[:2], strict=True):
        yield measure_name(kind, "combined", iou, subset), column


@dataclass(frozen=True)
class RankedDetections:
    """The detections of a record, the highest score first.

    Attributes
    ----------
    included
        Whether each counts, with all frames and with each block left out, (1 + blocks, m) bool.
    last
        Row of the last detection that has the same score, (m,) int64.
    """

    included: NDArray[np.bool_]
    last: NDArray[np.int64]

    @classmethod
    def of(cls, scores: NDArray[np.float64], block: NDArray[np.int64], blocks: int) -> RankedDetections:
        """From scores, descending, and the block of each."""
        left_out = np.arange(-1, blocks)
        return cls(block != left_out[:, None], np.searchsorted(-scores, -scores, side="right") - 1)

    def measures(self, matches: Matches, counts: NDArray[np.int64]) -> NDArray[np.float64]:
        """The measures of :data:`MEASURE_NAMES`, (1 + blocks, 3): of all frames, then with each block left out.

        Parameters
        ----------
        matches
            In the order of the detections here.
        counts
            Objects that count, of each block.
        """
        values = np.empty((len(self.included), len(MEASURE_NAMES)))
        objects = counts.sum() - np.concatenate([[0], counts])
        for row, kept in enumerate(self.included):
            thresholds = self.last[_score_thresholds(np.flatnonzero(matches.scored & kept), int(objects[row]))]
            true = np.cumsum(np.where(kept, matches.true_step, 0))[thresholds]
            false = np.cumsum(np.where(kept, matches.false_step, 0))[thresholds]
            values[row] = ap_and_recall(true, false, int(objects[row]))
        return values


def _score_thresholds(scored: NDArray[np.int64], objects: int) -> NDArray[np.int64]:
    """Which of the detections that objects took are thresholds, by KITTI's rule."""
    if not objects:
        return scored[:0]
    times = -(-(RECALL_STEPS + 1) // objects)
    rows = np.empty(RECALL_STEPS + 1, np.int64)
    filled = detection.threshold_rows(times * len(scored), times * objects, RECALL_STEPS, rows)
    return scored[rows[:filled] // times]


def ap_and_recall(true: NDArray[np.int64], false: NDArray[np.int64], objects: int) -> tuple[float, float, float]:
    """AP R11, AP R40 and recall from true and false positives at the thresholds, the highest first."""
    if not objects:
        return np.nan, np.nan, np.nan
    precision = np.zeros(RECALL_STEPS + 1)
    precision[: len(true)] = true / (true + false)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    recall = float(true[-1] / objects) if len(true) else 0.0
    return float(best[:: RECALL_STEPS // 10].mean()), float(best[1:].mean()), recall


DETECTION_TABLE = RunFolder.detection.name
POINT_THRESHOLDS = (1, 5, 10, 20, 50)
"""Points of a vehicle that make it seen."""

ALL_OBJECTS = "vehicles"
"""What the set of all objects is called."""

_COUNTED_POINTS = (1, 5, 20)


@dataclass(frozen=True)
class SiteDetection:
    """What one detector finds from one site, of one set of objects.

    Attributes
    ----------
    objects_of
        The set: ``vehicles``, ``cars``, ``points_1`` ..
    objects, objects_with
        How many objects count; of these, by the fewest points.
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


def measure_detection(
    frames: Sequence[TrafficFrame], roi: Roi, results: Mapping[str, Mapping[str, DetectorResult]]
) -> tuple[list[SiteDetection], list[Diagnostic]]:
    """Every row of ``detection.parquet``, and what is not defined.

    Parameters
    ----------
    results
        By site and detector; of each site with its points.
    """
    rows, doubts = list[SiteDetection](), list[tuple[str, str, Diagnostic]]()
    for site, its in results.items():
        points = its[POINT_COUNTS_NAME]
        assert isinstance(points, PointCounts)
        objects = [GroundTruth.of_counted(frame, on, roi) for frame, on in zip(frames, points.points, strict=True)]
        nothing = EvaluationFrames.of(objects, [Detections.empty()] * len(objects))
        seen = [_point_measures(nothing, subset) for subset in SUBSETS]
        for name, what in its.items():
            precise: Mapping[str, JackknifeEstimate] = {}
            if isinstance(what, DetectedBoxes):
                evaluation = evaluate(EvaluationFrames.of(objects, what.frames))
                doubts += [(site, name, doubt) for doubt in evaluation.warnings("")]
                precise = evaluation.measures
            for subset, by_points in zip(SUBSETS, seen, strict=True):
                on = nothing.points[subset.of(nothing)]
                with_ = {least: int((on >= least).sum()) for least in _COUNTED_POINTS}
                own = {column: precise.get(_subset_column(column, subset), UNDEFINED) for column in AP_MEASURES}
                rows.append(
                    SiteDetection(site, name, subset.name or ALL_OBJECTS, len(frames), len(on), with_, own | by_points)
                )
    return rows, _merge_warnings(doubts)


def _merge_warnings(warnings: Sequence[tuple[str, str, Diagnostic]]) -> list[Diagnostic]:
    """What is the same of several sites is told once; ``warnings`` are of a site and a detector."""
    sites: dict[tuple[str, Diagnostic], list[str]] = {}
    for site, detector, doubt in warnings:
        sites.setdefault((detector, doubt), []).append(site)
    return [
        replace(doubt, where=f"detector {detector}, site{'s' if len(its) > 1 else ''} {', '.join(its)}")
        for (detector, doubt), its in sites.items()
    ]


def write_detection(path: Path, rows: Sequence[SiteDetection], metadata: Mapping[str, Any]) -> None:
    """Write ``detection.parquet``."""
    parquet.write_artefact(
        path, "detection", {"site": [row.site for row in rows], **detection_columns(rows)}, dict(metadata)
    )


def detection_columns(rows: Sequence[SiteDetection]) -> dict[str, list[Any]]:
    """All columns but the site's, by name."""
    columns: dict[str, list[Any]] = {
        "detector": [row.detector for row in rows],
        "objects_of": [row.objects_of for row in rows],
        "frames": [row.frames for row in rows],
        "objects": [row.objects for row in rows],
    }
    for least in _COUNTED_POINTS:
        columns[f"objects_{least}"] = [row.objects_with[least] for row in rows]
    for name in MEASURES:
        columns[name] = [row.measures[name].value for row in rows]
        columns[f"{name}_se"] = [row.measures[name].se for row in rows]
    return columns


AP_MEASURES = tuple(
    f"{kind}_iou{round(100 * iou)}"
    for iou in IOUS
    for kind in (
        *(f"ap_{view}_{steps}" for view in (*VIEWS, "combined") for steps in ("r11", "r40")),
        *(f"recall_{view}" for view in VIEWS),
    )
)
"""Measures of boxes."""

POINT_MEASURES = (*(f"seen_{least}" for least in POINT_THRESHOLDS), "log_points")
"""Measures that need no boxes."""

MEASURES = (*AP_MEASURES, *POINT_MEASURES)
"""Columns of ``detection.parquet`` with a standard error each."""

UNDEFINED = JackknifeEstimate(math.nan, np.full(BLOCKS, math.nan), math.nan)


def _subset_column(column: str, subset: ObjectSubset) -> str:
    return f"{column}_{subset.name}" if subset.name else column


def _point_measures(record: EvaluationFrames, subset: ObjectSubset) -> dict[str, JackknifeEstimate]:
    """Shares of objects with so many points, and the mean of log(1 + points), with each block of frames left out."""
    wanted = subset.of(record)
    block = frame_blocks(record.frames)
    values = np.column_stack([record.points[:, None] >= np.array(POINT_THRESHOLDS), np.log1p(record.points)])[wanted]
    kept = block[record.object_frame[wanted]] != np.arange(-1, BLOCKS)[:, None]
    count = kept.sum(axis=1)
    with np.errstate(invalid="ignore"):
        means = kept.astype(np.float64) @ values / count[:, None]
    return {
        name: JackknifeEstimate.of(column, np.bincount(block))
        for name, column in zip(POINT_MEASURES, means.T, strict=True)
    }
