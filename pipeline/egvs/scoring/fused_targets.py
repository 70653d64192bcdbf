r"""What several sensors together see of the vehicles of a record, for detection in their fused point clouds.

The points that sensors have on a vehicle are added *before* the model of detection sees them
(:func:`egvs.scoring.target_scores.detection_chances`), as a detector receives the fused cloud. So the second sensor
counts for what the first one lacks: two sensors that see the same side add points, but no side and no length.

Of each vehicle-frame i with what each sensor s sees of it:

=====================================  =============================================================================
quantity                               of the fused points
=====================================  =============================================================================
points, points on sides                the sum over sensors
length share, width share              between the lowest and the highest coordinate of the points of any sensor
hole                                   the longest run of slices of the length in which no sensor has a point
with losses of returns                 expected spans and holes: a slice has no point with the product over sensors
range, depression, angle of view       of the sensor with most points; of equal ones the nearest
gap to the neighbours, length          of the vehicle, the same for all sensors
=====================================  =============================================================================

The first three rows are exact: sums, extremes and a bit for each slice of the vehicle contain all that these quantities
need of the points (:class:`egvs.scoring.targets.TargetVisibility`). A fused cloud has no single range, depression and
angle of view, and the model was trained with single sensors; ``cluster``, too, fits a box as seen from the sensor with
most points on it. With the highest probability over the views of all sensors instead, the level is worse for
``cluster`` and better for ``pointpillars`` (docs/placement.md).

Limits: clocks and calibration of all sensors are exact. A fused hole may be longer than that of each sensor, where one
sees the front only and the other the rear only; and a nearer, steeper sensor may have most points. The probability of
detection may therefore be lower than with one of the sensors alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from egvs.core.grid import FloatArray, IntArray
from egvs.scoring.targets import SliceMisses, TargetVisibility, slice_misses, spans_and_holes


def fuse_targets(views: Sequence[TargetVisibility]) -> TargetVisibility:
    """Return what several sensors see together; it does not depend on their order.

    Parameters
    ----------
    views
        What each sensor sees of the same record, at least one.

    Raises
    ------
    ValueError
        Without a sensor, or if the sensors see different records.
    """
    if not views:
        raise ValueError("expected at least one sensor, got none")
    record = views[0].record
    if any(view.record is not record for view in views):
        raise ValueError("expected sensors that see the same record of traffic")

    best, rows = _best_views(views), np.arange(len(record))
    low_m = np.min([view.bounds_m[:, 0] for view in views], axis=0)
    high_m = np.max([view.bounds_m[:, 1] for view in views], axis=0)
    bounds_m = np.stack([low_m, high_m], axis=1)
    slices: NDArray[np.uint64] = np.bitwise_or.reduce([view.slices for view in views])
    misses = _fused_misses(views)
    spans, hole_m = spans_and_holes(record, bounds_m, slices, misses)
    return TargetVisibility(
        record=record,
        points=_sum([view.points for view in views]),
        points_alone=_sum([view.points_alone for view in views]),
        points_on_sides=_sum([view.points_on_sides for view in views]),
        length_share=spans[:, 0],
        width_share=spans[:, 1],
        hole_m=hole_m,
        range_m=np.array([view.range_m for view in views])[best, rows],
        depression_deg=np.array([view.depression_deg for view in views])[best, rows],
        side=np.array([view.side for view in views])[best, rows],
        bounds_m=bounds_m,
        slices=slices,
        misses=misses,
    )


def _fused_misses(views: Sequence[TargetVisibility]) -> SliceMisses | None:
    """Return the probability that a slice has no point of any sensor; None if no sensor loses returns."""
    if all(view.misses is None for view in views):
        return None
    misses = np.sort([slice_misses(view) for view in views], axis=0)
    fused: NDArray[np.float32] = np.multiply.reduce(misses, axis=0)
    return SliceMisses(np.arange(len(fused)), fused)


def _best_views(views: Sequence[TargetVisibility]) -> IntArray:
    """Return the sensor with most points on each vehicle-frame, of equal ones the nearest, (n,) int64."""
    # further keys only make equal points and ranges independent of the order of sensors
    keys = (
        np.array([-view.side for view in views]),
        np.array([view.depression_deg for view in views]),
        np.array([view.range_m for view in views]),
        np.array([-view.points for view in views]),
    )
    best: IntArray = np.lexsort(keys, axis=0)[0]
    return best


def _sum(amounts: Sequence[FloatArray]) -> FloatArray:
    """Return the sum over sensors, (n,); in ascending order, so that it does not depend on theirs."""
    total: FloatArray = np.sort(np.array(amounts), axis=0).sum(axis=0)
    return total
