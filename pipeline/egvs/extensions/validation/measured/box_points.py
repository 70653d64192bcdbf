"""Count the points of a sweep in labelled boxes."""

from __future__ import annotations

import numpy as np

from egvs.core.grid import FloatArray, IntArray

MARGIN_M = 0.1
"""Points up to this far beyond the sides and the roof of a box are on it: three standard deviations of a range."""

BOTTOM_M = 0.15
"""The lowest part of a box, which may hold returns from the road, is left out."""


def owners_of_points(points_m: FloatArray, boxes: FloatArray) -> IntArray:
    """Return the box that each point is in, (n,) int64; -1 for none, the first of several.

    Parameters
    ----------
    points_m
        (n, 3) float64, in the frame of the boxes; NaN where there was no return.
    boxes
        Centre, length, width, height, heading about z, (m, 7) float64. Their lowest :data:`BOTTOM_M` is left out.
    """
    owner = np.full(len(points_m), -1, dtype=np.int64)
    for row in range(len(boxes) - 1, -1, -1):
        owner[are_inside(points_m, boxes[row])] = row
    return owner


def points_in_boxes(points_m: FloatArray, boxes: FloatArray) -> IntArray:
    """Return the number of points in each box, (m,) int64; parameters as of :func:`owners_of_points`."""
    counts = [np.count_nonzero(are_inside(points_m, box)) for box in boxes]
    return np.array(counts, dtype=np.int64)


def are_inside(points_m: FloatArray, box: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return which points are in a box (7,), above its lowest part, (n,) bool."""
    length, width, height, yaw = box[3:].tolist()
    half_length, half_width, half_height = 0.5 * length + MARGIN_M, 0.5 * width + MARGIN_M, 0.5 * height + MARGIN_M
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y, z = (points_m - box[:3]).T
    inside: np.ndarray[tuple[int], np.dtype[np.bool_]]
    with np.errstate(invalid="ignore"):
        inside = (np.abs(cos * x + sin * y) <= half_length) & (np.abs(cos * y - sin * x) <= half_width)
        inside &= (z <= half_height) & (z >= BOTTOM_M - 0.5 * height)
    return inside
