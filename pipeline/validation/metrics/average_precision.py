r"""Average precision, as KITTI defines it, of a detector at a site, with its standard errors.

The matching of :mod:`pipeline.validation.metrics.matching` gives a score to each object that was found. Of these, in
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
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.core.findings import Finding
from pipeline.kernels import matching as kernel
from pipeline.validation.metrics.leave_out import BLOCKS, Estimate, blocks_of
from pipeline.validation.metrics.matching import Matches, Record
from pipeline.validation.metrics.overlap import VIEWS

STEPS = 40
"""Steps of recall."""

IOUS = (0.7, 0.5)
"""Overlaps that a match must exceed: the paper's and KITTI's for cars, and one for a cruder detector."""

KINDS = ("ap_{}_r11", "ap_{}_r40", "recall_{}")
"""The measures of a view, in the order of :func:`curve`."""


@dataclass(frozen=True)
class Subset:
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

    def of(self, record: Record) -> NDArray[np.bool_]:
        """Which objects of a record count, (n,) bool."""
        enough = record.points >= self.points
        return enough & record.is_car if self.cars else enough


SUBSETS = (Subset(""), Subset("cars", cars=True), *(Subset(f"points_{least}", points=least) for least in (1, 5, 20)))


def name_of(kind: str, view: str, iou: float, subset: Subset) -> str:
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
        By :func:`name_of`, with views ``bev``, ``3d`` and ``combined`` (of AP alone).
    """

    frames: int
    objects: dict[str, NDArray[np.int64]]
    measures: dict[str, Estimate]

    def doubts(self, place: str) -> list[Finding]:
        """Which measures are not defined, or have no standard error, as warnings."""
        found = []
        for name, counts in self.objects.items():
            what = _IN_WORDS[name]
            if not counts.any():
                text = f"no {what} in {self.frames} frames: there is no average precision"
            elif np.count_nonzero(counts) == 1:
                text = f"the only {what} are in one of {len(counts)} blocks of frames: there is no standard error"
            else:
                continue
            found.append(Finding("average precision", place, text, "more frames"))
        return found


_IN_WORDS = {
    its.name: "cars" if its.cars else f"vehicles with {its.points} points or more" if its.points else "vehicles"
    for its in SUBSETS
}


def evaluate(record: Record, blocks: int = BLOCKS) -> Evaluation:
    """Every measure of a site and detector, with each block of frames left out.

    Raises
    ------
    InputError
        For fewer frames than blocks.
    """
    block = blocks_of(record.frames, blocks)
    order = np.argsort(-record.scores, kind="stable")
    ranked = Ranked.of(record.scores[order], block[record.found_frame[order]], blocks)
    objects: dict[str, NDArray[np.int64]] = {}
    measures: dict[str, Estimate] = {}
    for subset in SUBSETS:
        wanted = subset.of(record)
        counts = np.bincount(block[record.object_frame[wanted]], minlength=blocks)
        objects[subset.name] = counts
        for iou in IOUS:
            for name, values in _values(record, ranked, order, subset, wanted, counts, iou):
                measures[name] = Estimate.of(values, np.bincount(block))
    return Evaluation(record.frames, objects, measures)


def _values(
    record: Record,
    ranked: Ranked,
    order: NDArray[np.int64],
    subset: Subset,
    wanted: NDArray[np.bool_],
    counts: NDArray[np.int64],
    iou: float,
) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Names of the measures of one subset and bound, and each of all frames and with each block left out."""
    views = []
    for view in VIEWS:
        its = record.match(view, iou, wanted)
        its = Matches(its.scored[order], its.true_step[order], its.false_step[order])
        views.append(ranked.measures(its, counts))
        yield from ((name_of(kind, view, iou, subset), column) for kind, column in zip(KINDS, views[-1].T, strict=True))
    for kind, column in zip(KINDS[:2], (views[0] + views[1]).T[:2], strict=True):
        yield name_of(kind, "combined", iou, subset), column


@dataclass(frozen=True)
class Ranked:
    """The detections of a record, the highest score first.

    Attributes
    ----------
    kept
        Whether each counts, with all frames and with each block left out, (1 + blocks, m) bool.
    last
        Row of the last detection that has the same score, (m,) int64.
    """

    kept: NDArray[np.bool_]
    last: NDArray[np.int64]

    @classmethod
    def of(cls, scores: NDArray[np.float64], block: NDArray[np.int64], blocks: int) -> Ranked:
        """From scores, descending, and the block of each."""
        left_out = np.arange(-1, blocks)
        return cls(block != left_out[:, None], np.searchsorted(-scores, -scores, side="right") - 1)

    def measures(self, matches: Matches, counts: NDArray[np.int64]) -> NDArray[np.float64]:
        """The measures of :data:`KINDS`, (1 + blocks, 3): of all frames, then with each block left out.

        Parameters
        ----------
        matches
            In the order of the detections here.
        counts
            Objects that count, of each block.
        """
        values = np.empty((len(self.kept), len(KINDS)))
        objects = counts.sum() - np.concatenate([[0], counts])
        for row, kept in enumerate(self.kept):
            thresholds = self.last[_thresholds(np.flatnonzero(matches.scored & kept), int(objects[row]))]
            true = np.cumsum(np.where(kept, matches.true_step, 0))[thresholds]
            false = np.cumsum(np.where(kept, matches.false_step, 0))[thresholds]
            values[row] = curve(true, false, int(objects[row]))
        return values


def _thresholds(scored: NDArray[np.int64], objects: int) -> NDArray[np.int64]:
    """Which of the detections that objects took are thresholds, by KITTI's rule."""
    if not objects:
        return scored[:0]
    times = -(-(STEPS + 1) // objects)
    rows = np.empty(STEPS + 1, np.int64)
    filled = kernel.threshold_rows(times * len(scored), times * objects, STEPS, rows)
    return scored[rows[:filled] // times]


def curve(true: NDArray[np.int64], false: NDArray[np.int64], objects: int) -> tuple[float, float, float]:
    """AP R11, AP R40 and recall from true and false positives at the thresholds, the highest first."""
    if not objects:
        return np.nan, np.nan, np.nan
    precision = np.zeros(STEPS + 1)
    precision[: len(true)] = true / (true + false)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    recall = float(true[-1] / objects) if len(true) else 0.0
    return float(best[:: STEPS // 10].mean()), float(best[1:].mean()), recall
