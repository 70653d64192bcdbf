"""Tells how much beside a cluster is hidden by something nearer, so that what is not seen there may be there.

What stands in the way is known: the empty scan has the walls, poles and trees, and the sweep has the other road users.
Their nearest ranges are put into an image of azimuth and elevation. Beside a cluster, at the elevations that it has
there, the image is walked for as long as something nearer stands in it.

Frame: the world's axes, from the sensor, so that a tilted sensor is as any other. Ranges are horizontal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.validation.detectors.cluster.clustering import Clusters
from pipeline.validation.detectors.cluster.l_shape import Rectangles

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

CELL_DEG = 0.5, 1.0
"""Azimuth and elevation of a cell: a few beams of most sensors."""

NEARER_M = 0.5
"""What hides is nearer by more than this."""

FARTHEST_DEG = 30.0
"""How far the image is walked."""

_SHAPE = round(360.0 / CELL_DEG[0]), round(180.0 / CELL_DEG[1])
_NOBODY = -1
_ON_END_M = 0.2  # as near to an end of a rectangle are the points that lie on that end
_SIDE_M = 0.5  # points on an end that are spread as far show a side, though the outermost one be at the hidden edge


@dataclass(frozen=True)
class RangeImage:
    """The nearest of some points in each cell.

    Attributes
    ----------
    range_m
        Horizontal range, (azimuths, elevations) float64, infinite where there is nothing.
    owner
        The cluster of that point, -1 for none, (azimuths, elevations) int64.
    """

    range_m: Floats
    owner: Ints

    @classmethod
    def of(cls, points_m: Floats) -> RangeImage:
        """From points (n, 3) of no cluster."""
        empty = cls(np.full(_SHAPE, np.inf), np.full(_SHAPE, _NOBODY))
        return empty.with_points(points_m, np.full(len(points_m), _NOBODY))

    def with_points(self, points_m: Floats, owner: Ints) -> RangeImage:
        """With more points, (n, 3), and the cluster of each. Of equally near ones a cluster's own stays."""
        column, row, range_m = _cells(points_m)
        order = np.lexsort((owner, -range_m))  # the nearest is written last
        at, range_m, owner = (column[order], row[order]), range_m[order], owner[order]
        nearer = range_m <= self.range_m[at]
        at = at[0][nearer], at[1][nearer]
        ranges, owners = self.range_m.copy(), self.owner.copy()
        ranges[at], owners[at] = range_m[nearer], owner[nearer]
        return RangeImage(ranges, owners)


@dataclass(frozen=True)
class Spans:
    """Where clusters begin and end, as the sensor sees them, and what is hidden beside them.

    Attributes
    ----------
    middle_rad
        An azimuth within each cluster, (m,) float64.
    right_rad, left_rad
        Its ends, counter-clockwise from the middle, (m,) float64.
    hidden_rad
        How far something nearer goes on beyond the right and the left end, (m, 2) float64, 0 for nothing.
    """

    middle_rad: Floats
    right_rad: Floats
    left_rad: Floats
    hidden_rad: Floats


def spans_of(points_m: Floats, clusters: Clusters, image: RangeImage) -> Spans:
    """The spans of clusters, whose points are ``points_m`` (n, 3), z from the sensor, in an image that has them."""
    column, row, range_m = _cells(points_m)
    azimuth = np.arctan2(points_m[:, 1], points_m[:, 0])
    middle, right, left = np.empty(len(clusters)), np.empty(len(clusters)), np.empty(len(clusters))
    hidden = np.empty((len(clusters), 2))
    for k in range(len(clusters)):
        rows = slice(clusters.starts[k], clusters.starts[k + 1])
        middle[k] = azimuth[rows][0]
        turn = (azimuth[rows] - middle[k] + np.pi) % (2 * np.pi) - np.pi
        right[k], left[k] = turn.min(), turn.max()
        own = _Own(k, column[rows], row[rows], range_m[rows])
        hidden[k] = own.hidden_rad(image, turn.argmin(), -1), own.hidden_rad(image, turn.argmax(), 1)
    return Spans(middle, right, left, hidden)


@dataclass(frozen=True)
class _Own:
    """The cells and ranges of a cluster's points."""

    number: int
    column: Ints
    row: Ints
    range_m: Floats

    def hidden_rad(self, image: RangeImage, outermost: np.intp, way: int) -> float:
        """How far what hides goes on beyond the outermost point, to the left (``way`` 1) or to the right (-1)."""
        end = self.column[outermost]
        at_end = np.abs((self.column - end + _SHAPE[0] // 2) % _SHAPE[0] - _SHAPE[0] // 2) <= 1
        low, high = self.row[at_end].min(), self.row[at_end].max() + 1
        beside = (end + way * np.arange(1, round(FARTHEST_DEG / CELL_DEG[0]) + 1)) % _SHAPE[0]
        nearer = image.range_m[beside, low:high] < self.range_m[at_end].min() - NEARER_M
        hides = (nearer & (image.owner[beside, low:high] != self.number)).any(axis=1)
        if not hides[:2].any():
            return 0.0
        hides[0] = True  # the edge of what hides may share its cell with what it leaves to see
        cells = len(hides) if hides.all() else int(hides.argmin())
        return float(np.deg2rad(cells * CELL_DEG[0]))


def hidden_ends(clusters: Clusters, found: Rectangles, spans: Spans) -> Bools:
    """Which ends of the rectangles are no sides of bodies, but where something hides the rest.

    Returns
    -------
    NDArray
        Of the low and the high end along both axes, (m, 2, 2) bool.
    """
    ends = np.zeros((len(clusters), 2, 2), dtype=np.bool_)
    for k in np.flatnonzero((spans.hidden_rad > 0.0).any(axis=1)).tolist():
        xy_m = clusters.squares_m[clusters.square_starts[k] : clusters.square_starts[k + 1]]
        turn = (np.arctan2(xy_m[:, 1], xy_m[:, 0]) - spans.middle_rad[k] + np.pi) % (2 * np.pi) - np.pi
        uv_m = found.along_axes(k, xy_m)
        for outermost, hidden in zip((turn.argmin(), turn.argmax()), spans.hidden_rad[k] > 0.0, strict=True):
            for axis, end in np.ndindex(2, 2):
                on_end = np.abs(uv_m[:, axis] - found.ends_m[k, axis, end]) < _ON_END_M
                ends[k, axis, end] |= hidden and on_end[outermost] and np.ptp(uv_m[on_end, 1 - axis]) < _SIDE_M
    return ends


def shown_ends(clusters: Clusters, found: Rectangles, sensors_m: Floats, but: int) -> Bools:
    """Which ends of the rectangles other sensors show: they face them, and have points on them spread as on a side.

    Parameters
    ----------
    sensors_m
        Where the sensors are in plan, in the clusters' frame, (s, 2).
    but
        The sensor that is left out.

    Returns
    -------
    NDArray
        Of the low and the high end along both axes, (m, 2, 2) bool.
    """
    ends = np.zeros((len(clusters), 2, 2), dtype=np.bool_)
    for k in range(len(clusters)):
        rows = slice(clusters.starts[k], clusters.starts[k + 1])
        uv_m, sensor = found.along_axes(k, clusters.points_m[rows, :2]), clusters.sensor[rows]
        from_m = found.along_axes(k, sensors_m)
        for other in np.setdiff1d(sensor, but).tolist():
            for axis, end in np.ndindex(2, 2):
                beyond_m = (from_m[other, axis] - found.ends_m[k, axis, end]) * (1 if end else -1)
                on_end = (sensor == other) & (np.abs(uv_m[:, axis] - found.ends_m[k, axis, end]) < _ON_END_M)
                if beyond_m > 0.0 and on_end.any():
                    ends[k, axis, end] |= np.ptp(uv_m[on_end, 1 - axis]) >= _SIDE_M
    return ends


def _cells(points_m: Floats) -> tuple[Ints, Ints, Floats]:
    """Column and row of points (n, 3) in the image, and their horizontal ranges."""
    range_m = np.hypot(points_m[:, 0], points_m[:, 1])
    azimuth_deg = np.rad2deg(np.arctan2(points_m[:, 1], points_m[:, 0]))
    elevation_deg = np.rad2deg(np.arctan2(points_m[:, 2], range_m))
    column = np.floor(azimuth_deg / CELL_DEG[0]).astype(np.int64) % _SHAPE[0]
    row = np.floor((elevation_deg + 90.0) / CELL_DEG[1]).astype(np.int64)
    return column, np.minimum(row, _SHAPE[1] - 1), range_m
