"""Positions of the points on vehicles, in the frame of each vehicle.

As in :mod:`egvs.scoring.targets`, the boxes of recorded frames are inserted into the empty scan of a site, and a beam
ends on the first box that it enters. That module counts these points; this one lists them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from egvs.core.grid import FloatArray, IntArray
from egvs.effects.returns import ReturnProbability
from egvs.kernels import vehicle_visibility
from egvs.scoring.targets import MAX_HITS, NO_LOSSES, TargetRecord, sort_beams
from egvs.scoring.visibility import Beams


class TargetPoints(NamedTuple):
    """Points on vehicles; k of them.

    Attributes
    ----------
    vehicle
        Row of the vehicle-frame that each point is on, (k,) int64.
    at_m
        Position from the centre of the vehicle's box along its length (to the front), its width (to the left) and its
        height, (k, 3) float64, metres.
    probability
        Probability that each is detected, times the weight of its beam, (k,) float64, above 0 and at most 1.
    """

    vehicle: IntArray
    at_m: FloatArray
    probability: FloatArray


def list_target_points(
    record: TargetRecord, beams: Beams, return_probability: ReturnProbability | None = None
) -> TargetPoints:
    """Return the points of one site on the vehicle-frames of a record, with occlusion by all other boxes.

    Parameters
    ----------
    record
        Recorded traffic.
    beams
        The site's empty scan.
    return_probability
        As for :func:`egvs.scoring.targets.visible_targets`. Points of probability 0 are left out, so the sum over the
        others is the expected number of points.
    """
    boxes, count = record.all_boxes, len(record.all_boxes.values)
    sensor_m = record.grid.to_grid_m(np.asarray(beams.pose.position_m))
    size_m = np.asarray(record.grid.roi.size_m)
    ordered = sort_beams(beams, 1)
    row_of_box = np.full(count, -1, dtype=np.int64)
    row_of_box[record.row] = np.arange(len(record.row))
    all_boxes = *boxes.between(sensor_m, size_m), boxes.values, boxes.low, boxes.high, row_of_box >= 0
    unused = np.zeros(count), np.zeros(count), np.zeros(count, dtype=np.uint64), *np.zeros((2, count, 2))
    capacity = max(MAX_HITS, len(ordered.length_m))
    hits = (np.empty(capacity, dtype=np.int64), np.empty(capacity, dtype=np.int64), *np.empty((3, capacity)))

    vehicles, positions_m, probabilities = [np.empty(0, dtype=np.int64)], [np.empty((0, 3))], [np.empty(0)]
    frame, nearest_m, alone = 0, ordered.length_m.copy(), np.zeros(count)
    while frame < len(record.numbers):
        frame, filled = vehicle_visibility.first_hits(
            frame, sensor_m, size_m, all_boxes, tuple(ordered), nearest_m, tuple(NO_LOSSES), (alone, *unused), hits
        )
        box, beam, range_m, along_m, across_m = (column[:filled] for column in hits)
        probability = ordered.weight[beam]
        if return_probability is not None:
            probability = probability * return_probability(range_m, record.reflectivity[row_of_box[box]])
        is_point = probability > 0.0
        box, beam, range_m = box[is_point], beam[is_point], range_m[is_point]
        from_centre_m = sensor_m + range_m[:, None] * ordered.directions[:, beam].T - boxes.values[box, :3]
        up_m = _up_m(from_centre_m, boxes.values[box, 3], boxes.values[box, 4])
        vehicles.append(row_of_box[box])
        positions_m.append(np.column_stack([along_m[is_point], across_m[is_point], up_m]))
        probabilities.append(probability[is_point])
    return TargetPoints(np.concatenate(vehicles), np.concatenate(positions_m), np.concatenate(probabilities))


def _up_m(from_centre_m: FloatArray, yaw_rad: FloatArray, pitch_rad: FloatArray) -> FloatArray:
    """Return the height of positions (k, 3) along the upward axis of boxes, whose nose is up by their pitch, (k,)."""
    forward_m = from_centre_m[:, 0] * np.cos(yaw_rad) + from_centre_m[:, 1] * np.sin(yaw_rad)
    return from_centre_m[:, 2] * np.cos(pitch_rad) - forward_m * np.sin(pitch_rad)
