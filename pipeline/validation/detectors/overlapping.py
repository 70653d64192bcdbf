"""Two vehicles are never in one place: of detections that overlap, one stays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.validation.metrics.overlap import overlap_each
from pipeline.validation.sweeps import Detections

MOST_SHARED = 0.1
"""Of two boxes whose intersection over union, seen from above, is more, one is left out."""


def apart(found: Detections, weight: NDArray[np.float64] | NDArray[np.int64]) -> Detections:
    """The detections that hardly overlap a weightier one that stays; weightiest first, equals in their order.

    Parameters
    ----------
    weight
        (m,), what decides: scores, or numbers of points.
    """
    order = np.argsort(-weight, kind="stable")
    boxes = found.boxes[order]
    reach_m = 0.5 * np.hypot(boxes[:, 3], boxes[:, 4])
    kept = list[int]()
    for row in range(len(boxes)):
        away_m = np.hypot(*(boxes[kept, :2] - boxes[row, :2]).T)
        rivals = boxes[kept][away_m < reach_m[kept] + reach_m[row]]
        if not (overlap_each(np.repeat(boxes[row : row + 1], len(rivals), 0), rivals)[0] > MOST_SHARED).any():
            kept.append(row)
    return Detections(boxes[kept], found.scores[order][kept])
