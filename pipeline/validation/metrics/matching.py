"""Which detections are true: every frame's detections are matched to its objects, as KITTI's evaluation does.

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
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.traffic_frames import BOX, TrafficFrame
from pipeline.core.errors import InputError
from pipeline.core.grid import Roi
from pipeline.kernels import matching as kernel
from pipeline.validation.classes import CARS
from pipeline.validation.metrics.overlap import VIEWS, View
from pipeline.validation.sweeps import Detections


@dataclass(frozen=True)
class Objects:
    """Ground truth of one frame.

    Attributes
    ----------
    boxes
        (n, 7) float64, as :data:`pipeline.artefacts.traffic_frames.BOX`.
    is_car
        (n,) bool.
    points
        How many points of the sweep lie on each, (n,) int64.
    """

    boxes: NDArray[np.float64]
    is_car: NDArray[np.bool_]
    points: NDArray[np.int64]

    @classmethod
    def of(cls, frame: TrafficFrame, points: NDArray[np.int64], roi: Roi) -> Objects:
        """The vehicles of a frame that a detector should find; ``points`` are those on each of the frame's boxes."""
        return cls.of_wanted(frame, points[frame.wanted(roi)], roi)

    @classmethod
    def of_wanted(cls, frame: TrafficFrame, points: NDArray[np.int64], roi: Roi) -> Objects:
        """The same from the points on these vehicles alone."""
        rows = frame.wanted(roi)
        cars = np.array([frame.kinds[row] in CARS for row in rows], dtype=np.bool_)
        return cls(frame.boxes[rows], cars, points)


def within(found: Detections, roi: Roi) -> Detections:
    """The detections whose centre lies in the region of interest, seen from above."""
    place = found.boxes[:, :2] - np.asarray(roi.origin_m[:2])
    inside = ((place >= 0.0) & (place < np.asarray(roi.size_m[:2]))).all(axis=1)
    return Detections(found.boxes[inside], found.scores[inside])


@dataclass(frozen=True)
class Matches:
    """What of the detections of a :class:`Record` is true, all three (m,) in its order.

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
class Record:
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
    found_frame: NDArray[np.int64]
    is_car: NDArray[np.bool_]
    points: NDArray[np.int64]
    scores: NDArray[np.float64]
    frames: int
    _starts: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]
    _overlap: NDArray[np.float64]

    @classmethod
    def of(cls, objects: Sequence[Objects], found: Sequence[Detections]) -> Record:
        """From the objects and the detections of every frame, in the order of the frames.

        Raises
        ------
        InputError
            For a box or a score that is no finite number, or a negative size.
        """
        at = _frame_of([len(frame.boxes) for frame in objects])
        boxes = np.concatenate([np.empty((0, 7)), *(frame.boxes for frame in objects)])
        cars = np.concatenate([np.empty(0, np.bool_), *(frame.is_car for frame in objects)])
        points = np.concatenate([np.empty(0, np.int64), *(frame.points for frame in objects)])
        order = np.lexsort((points, cars, *boxes.T[::-1], at))
        at_found = _frame_of([len(frame.boxes) for frame in found])
        found_boxes = np.concatenate([np.empty((0, 7)), *(frame.boxes for frame in found)])
        scores = np.concatenate([np.empty(0), *(frame.scores for frame in found)])
        _check(at_found, found_boxes, scores)
        surest = np.lexsort((*found_boxes.T[::-1], -scores, at_found))
        starts = _starts(at, at_found, len(objects))
        overlap = np.empty((len(VIEWS), starts[2][-1]))
        kernel.overlap_frames(boxes[order], starts[0], found_boxes[surest], starts[1], starts[2], overlap)
        return cls(at, at_found, cars[order], points[order], scores[surest], len(objects), starts, overlap)

    def match(self, view: View, iou: float, wanted: NDArray[np.bool_]) -> Matches:
        """Match all frames.

        Parameters
        ----------
        iou
            The overlap that a match must exceed.
        wanted
            Which objects count, (n,) bool.
        """
        count = len(self.scores)
        found = Matches(np.zeros(count, np.bool_), np.zeros(count, np.int64), np.zeros(count, np.int64))
        kernel.match_frames(
            *self._starts,
            self._overlap[VIEWS.index(view)],
            wanted,
            iou,
            found.scored,
            found.true_step,
            found.false_step,
        )
        return found


def _frame_of(counts: Sequence[int]) -> NDArray[np.int64]:
    """The frame of each row, where frames have these many rows."""
    return np.repeat(np.arange(len(counts), dtype=np.int64), np.asarray(counts, dtype=np.int64))


def _starts(
    objects: NDArray[np.int64], found: NDArray[np.int64], frames: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Where the objects, the detections and their pairs begin of each frame, and where the last ends."""
    counts = [np.bincount(rows, minlength=frames) for rows in (objects, found)]
    each = (*counts, counts[0] * counts[1])
    objects_at, found_at, pairs_at = (np.concatenate([[0], np.cumsum(count)]).astype(np.int64) for count in each)
    return objects_at, found_at, pairs_at


def _check(frame: NDArray[np.int64], boxes: NDArray[np.float64], scores: NDArray[np.float64]) -> None:
    values = np.column_stack([boxes, scores])
    wrong = ~np.isfinite(values)
    wrong[:, 3:6] |= values[:, 3:6] < 0.0
    if wrong.any():
        row, column = (int(k[0]) for k in np.nonzero(wrong))
        place = f"detection {row - int(np.searchsorted(frame, frame[row]))} of frame {frame[row]}"
        name = (*BOX, "score")[column]
        right = "a length of at least 0" if 3 <= column < 6 else "a finite number"
        raise InputError(place, f"{name} is {values[row, column]:g}", right)
