r"""The cluster detector: background, clusters, boxes.

Typical kinds of road users, from ``kinds.toml`` beside this module.

Rectangles of clusters, seen from above, by the closeness criterion (:mod:`egvs.kernels.detection`).

Tells how much beside a cluster is hidden by something nearer, so that what is not seen there may be there.

What stands in the way is known: the empty scan has the walls, poles and trees, and the sweep has the other road users.
Their nearest ranges are put into an image of azimuth and elevation. Beside a cluster, at the elevations that it has
there, the image is walked for as long as something nearer stands in it.

Frame: the world's axes, from the sensor, so that a tilted sensor is as any other. Ranges are horizontal.

Completes what is seen of a road user to the nearest kind, away from the sensor.

Of each cluster every kind of the table is tried, with its length along either axis of the rectangle. Along an axis, the
end that faces the sensor stays where it was seen; where that end is no side of the body, but the edge of what hides the
rest, the other end does. The smallest cost wins:

.. math:: C = \sum_{ends} \Big(\frac{r\,\Delta\alpha}{\sigma_s}\Big)^2 + \sum_{axes} \Big(\frac{\max(e - s, 0)}
          {\sigma_o}\Big)^2 + \Big(\frac{\max(s - e, 0)}{\sigma_u}\Big)^2 + \Big(\frac{h - t}{\sigma_h}\Big)^2 - 2 \ln q

with the azimuth :math:`\Delta\alpha` by which the box ends elsewhere than the cluster, as far as nothing hides it; the
extent e that was seen and the box's size s along an axis; its height h, the highest point t, and the kind's share q of
the traffic. So a box that beams have passed through loses to one that they could not have met.

Where another sensor shows an end that this one does not, it stays as well; an axis of which both ends stay is as long
as it is seen, with :math:`\sigma_o` either way.

The detector ``cluster``: what roadside practice uses without a GPU.

Steps of a sweep: take the background off, beam by beam (:mod:`egvs.validation.detectors.background`); count heights
from the ground (:mod:`egvs.validation.detectors.background`); cluster; fit a rectangle to each cluster; see what hides
the rest of it; complete it to the nearest kind, away from the sensor. People and bicycles are kinds too, and left out.

With several sensors each takes its own background off, by its own empty scan; the new points of all are clustered
together, in the world's axes, over the ground that all empty scans show. A cluster with the points of all is then
completed as the sensor sees it that has most points on it: away from that one, by what hides it from there, and
between the ends that other sensors show.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import cosdg, sindg

from egvs.core import files
from egvs.core.grid import Roi
from egvs.kernels import detection
from egvs.validation.detectors import background
from egvs.validation.detectors.background import GroundMap, empty_scan_points
from egvs.validation.detectors.base import suppress_overlaps
from egvs.validation.detectors.clustering import Clusters, Density, find_clusters
from egvs.validation.sweeps import Detections, SiteView, Sweep

KINDS_FILE = Path(__file__).with_name("kinds.toml")


@dataclass(frozen=True)
class Kinds:
    """A table of kinds.

    Attributes
    ----------
    size_m
        Length, width, height, (k, 3) float64.
    share
        How often each is met, (k,) float64, of any sum.
    is_vehicle
        (k,) bool.
    """

    names: tuple[str, ...]
    size_m: NDArray[np.float64]
    share: NDArray[np.float64]
    is_vehicle: NDArray[np.bool_]


@cache
def load_kinds() -> Kinds:
    """All kinds of the table."""
    with KINDS_FILE.open("rb") as file:
        rows = tomllib.load(file)["kind"]
    return Kinds(
        tuple(row["name"] for row in rows),
        np.array([row["size_m"] for row in rows], dtype=np.float64),
        np.array([row["share"] for row in rows], dtype=np.float64),
        np.array([row.get("vehicle", True) for row in rows], dtype=np.bool_),
    )


N_HEADINGS = 90
"""How many headings of a quarter turn are tried."""

ON_SIDE_M = 0.05
"""Points nearer than this lie on a side."""


@dataclass(frozen=True)
class Rectangles:
    """The smallest rectangle round each cluster, at its best heading.

    Attributes
    ----------
    yaw_rad
        Of the first axis, 0 to pi/2, (m,) float64; the second is a quarter turn further, counter-clockwise.
    ends_m
        Low and high end along both axes, (m, 2, 2) float64.
    closeness
        How near the points lie to two sides, 0 to 1, (m,) float64.
    """

    yaw_rad: Floats
    ends_m: Floats
    closeness: Floats

    def along_axes(self, k: int, xy_m: Floats) -> Floats:
        """Places (n, 2) along the axes of a rectangle."""
        c, s = np.cos(self.yaw_rad[k]), np.sin(self.yaw_rad[k])
        return np.column_stack([c * xy_m[:, 0] + s * xy_m[:, 1], c * xy_m[:, 1] - s * xy_m[:, 0]])


def bounding_rectangles(xy_m: Floats, starts: Ints) -> Rectangles:
    """The rectangles of clusters, whose points (n, 2) begin at ``starts``, (m + 1,)."""
    degrees = np.arange(N_HEADINGS) * (90.0 / N_HEADINGS)
    clusters = len(starts) - 1
    heading, ends_m, closeness = np.empty(clusters, np.int64), np.empty((clusters, 4)), np.empty(clusters)
    detection.fit_rectangles(xy_m, starts, cosdg(degrees), sindg(degrees), ON_SIDE_M, heading, ends_m, closeness)
    return Rectangles(np.deg2rad(degrees)[heading], ends_m.reshape(-1, 2, 2), closeness)


Bools = NDArray[np.bool_]

CELL_DEG = 0.5, 1.0
"""Azimuth and elevation of a cell: a few beams of most sensors."""

NEARER_M = 0.5
"""What hides is nearer by more than this."""

MAX_HIDDEN_DEG = 30.0
"""How far the image is walked."""

_SHAPE = round(360.0 / CELL_DEG[0]), round(180.0 / CELL_DEG[1])
_NO_OWNER = -1
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
        empty = cls(np.full(_SHAPE, np.inf), np.full(_SHAPE, _NO_OWNER))
        return empty.with_points(points_m, np.full(len(points_m), _NO_OWNER))

    def with_points(self, points_m: Floats, owner: Ints) -> RangeImage:
        """With more points, (n, 3), and the cluster of each. Of equally near ones a cluster's own stays."""
        column, row, range_m = _image_cells(points_m)
        order = np.lexsort((owner, -range_m))  # the nearest is written last
        at, range_m, owner = (column[order], row[order]), range_m[order], owner[order]
        nearer = range_m <= self.range_m[at]
        at = at[0][nearer], at[1][nearer]
        ranges, owners = self.range_m.copy(), self.owner.copy()
        ranges[at], owners[at] = range_m[nearer], owner[nearer]
        return RangeImage(ranges, owners)


@dataclass(frozen=True)
class AngularSpans:
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


def angular_spans(points_m: Floats, clusters: Clusters, image: RangeImage) -> AngularSpans:
    """The spans of clusters, whose points are ``points_m`` (n, 3), z from the sensor, in an image that has them."""
    column, row, range_m = _image_cells(points_m)
    azimuth = np.arctan2(points_m[:, 1], points_m[:, 0])
    middle, right, left = np.empty(len(clusters)), np.empty(len(clusters)), np.empty(len(clusters))
    hidden = np.empty((len(clusters), 2))
    for k in range(len(clusters)):
        rows = slice(clusters.starts[k], clusters.starts[k + 1])
        middle[k] = azimuth[rows][0]
        turn = (azimuth[rows] - middle[k] + np.pi) % (2 * np.pi) - np.pi
        right[k], left[k] = turn.min(), turn.max()
        own = _ClusterCells(k, column[rows], row[rows], range_m[rows])
        hidden[k] = own.hidden_rad(image, turn.argmin(), -1), own.hidden_rad(image, turn.argmax(), 1)
    return AngularSpans(middle, right, left, hidden)


@dataclass(frozen=True)
class _ClusterCells:
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
        beside = (end + way * np.arange(1, round(MAX_HIDDEN_DEG / CELL_DEG[0]) + 1)) % _SHAPE[0]
        nearer = image.range_m[beside, low:high] < self.range_m[at_end].min() - NEARER_M
        hides = (nearer & (image.owner[beside, low:high] != self.number)).any(axis=1)
        if not hides[:2].any():
            return 0.0
        hides[0] = True  # the edge of what hides may share its cell with what it leaves to see
        cells = len(hides) if hides.all() else int(hides.argmin())
        return float(np.deg2rad(cells * CELL_DEG[0]))


def occluded_ends(clusters: Clusters, fitted: Rectangles, spans: AngularSpans) -> Bools:
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
        uv_m = fitted.along_axes(k, xy_m)
        for outermost, hidden in zip((turn.argmin(), turn.argmax()), spans.hidden_rad[k] > 0.0, strict=True):
            for axis, end in np.ndindex(2, 2):
                on_end = np.abs(uv_m[:, axis] - fitted.ends_m[k, axis, end]) < _ON_END_M
                ends[k, axis, end] |= hidden and on_end[outermost] and np.ptp(uv_m[on_end, 1 - axis]) < _SIDE_M
    return ends


def visible_ends(clusters: Clusters, fitted: Rectangles, sensors_m: Floats, but: int) -> Bools:
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
        uv_m, sensor = fitted.along_axes(k, clusters.points_m[rows, :2]), clusters.sensor[rows]
        from_m = fitted.along_axes(k, sensors_m)
        for other in np.setdiff1d(sensor, but).tolist():
            for axis, end in np.ndindex(2, 2):
                beyond_m = (from_m[other, axis] - fitted.ends_m[k, axis, end]) * (1 if end else -1)
                on_end = (sensor == other) & (np.abs(uv_m[:, axis] - fitted.ends_m[k, axis, end]) < _ON_END_M)
                if beyond_m > 0.0 and on_end.any():
                    ends[k, axis, end] |= np.ptp(uv_m[on_end, 1 - axis]) >= _SIDE_M
    return ends


def _image_cells(points_m: Floats) -> tuple[Ints, Ints, Floats]:
    """Column and row of points (n, 3) in the image, and their horizontal ranges."""
    range_m = np.hypot(points_m[:, 0], points_m[:, 1])
    azimuth_deg = np.rad2deg(np.arctan2(points_m[:, 1], points_m[:, 0]))
    elevation_deg = np.rad2deg(np.arctan2(points_m[:, 2], range_m))
    column = np.floor(azimuth_deg / CELL_DEG[0]).astype(np.int64) % _SHAPE[0]
    row = np.floor((elevation_deg + 90.0) / CELL_DEG[1]).astype(np.int64)
    return column, np.minimum(row, _SHAPE[1] - 1), range_m


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_CORNERS = 0.5 * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])


@dataclass(frozen=True)
class Tolerances:
    """How far things may be off: standard deviations in metres, and what the range adds to them.

    Attributes
    ----------
    end_m, end_per_range
        Where a box ends, as the sensor sees it.
    over_m, under_m
        By how much more, and less, than the box's size is seen along an axis.
    height_m, height_per_range
        The highest point below the top of the box.
    """

    end_m: float = 0.15
    end_per_range: float = 0.003
    over_m: float = 0.2
    under_m: float = 3.0
    height_m: float = 0.15
    height_per_range: float = 0.006


@dataclass(frozen=True)
class FittedBoxes:
    """The boxes of clusters.

    Attributes
    ----------
    boxes
        (m, 7) float64, as :data:`egvs.artefacts.traffic_frames.BOX_COLUMNS`; from the sensor along the world's axes,
        z from the ground.
    kind
        Row of the table, (m,) int64.
    cost
        C above, (m,) float64.
    """

    boxes: Floats
    kind: Ints
    cost: Floats


def fit_boxes(
    fitted: Rectangles,
    hidden: NDArray[np.bool_],
    visible: NDArray[np.bool_],
    spans: AngularSpans,
    top_m: Floats,
    kinds: Kinds,
    tolerances: Tolerances,
) -> FittedBoxes:
    """The best box of each cluster.

    Parameters
    ----------
    found, hidden, spans
        Its rectangle, which ends of it are no sides, (m, 2, 2), and where it ends as the sensor sees it.
    visible
        Which ends other sensors show to be sides, (m, 2, 2).
    top_m
        Its highest point, from the ground, (m,).
    """
    along = kinds.size_m[:, :2]
    size = np.stack([along, along[:, ::-1]])[None]  # (1, turned, kind, axis): the length along axis 0, or along axis 1
    fixed_m, way, whole = _fixed_ends(fitted.ends_m, hidden, visible)
    centre = fixed_m[:, None, None, :] + 0.5 * way[:, None, None, :] * size
    extent = fitted.ends_m[..., 1] - fitted.ends_m[..., 0]
    range_m = np.hypot(*fitted.ends_m.mean(axis=2).T)
    cost = _end_cost(centre, size, fitted.yaw_rad, spans, range_m, tolerances)
    cost += _size_cost(size, extent, whole, tolerances)
    height_m = tolerances.height_m + tolerances.height_per_range * range_m
    cost += (((kinds.size_m[:, 2] - top_m[:, None]) / height_m[:, None]) ** 2)[:, None]
    cost -= 2.0 * np.log(kinds.share / kinds.share.sum())
    best = cost.reshape(len(cost), cost[0].size if len(cost) else 1).argmin(axis=1)
    turned, kind = np.divmod(best, len(kinds.share))
    rows = np.arange(len(cost))
    u, v = centre[rows, turned, kind].T
    c, s = np.cos(fitted.yaw_rad), np.sin(fitted.yaw_rad)
    place = c * u - s * v, s * u + c * v, 0.5 * kinds.size_m[kind, 2]
    boxes = np.column_stack([*place, kinds.size_m[kind], fitted.yaw_rad + turned * (0.5 * np.pi)])
    return FittedBoxes(boxes, kind, cost[rows, turned, kind])


def _fixed_ends(
    ends_m: Floats, hidden: NDArray[np.bool_], visible: NDArray[np.bool_]
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """What stays along each axis, which way the box goes on from there (0: both ways), whether both ends are sides that
    were seen; all (m, 2).

    The sensor is at 0 of both axes. One that is between the ends sees both; where both are hidden, neither is known.
    """
    low_m, high_m = ends_m[..., 0], ends_m[..., 1]
    low_seen = (~hidden[..., 0] & (low_m > 0.0)) | visible[..., 0]
    high_seen = (~hidden[..., 1] & (high_m < 0.0)) | visible[..., 1]
    low_stays = low_seen | (~hidden[..., 0] & hidden[..., 1])
    high_stays = high_seen | (~hidden[..., 1] & hidden[..., 0])
    one = np.where(low_stays, low_m, high_m)
    fixed_m = np.where(low_stays ^ high_stays, one, 0.5 * (low_m + high_m))
    return fixed_m, low_stays.astype(np.float64) - high_stays, low_seen & high_seen


def _size_cost(size: Floats, extent: Floats, is_complete: NDArray[np.bool_], tolerances: Tolerances) -> Floats:
    """What it costs that a box is smaller or larger than what is seen, (m, 2, kinds)."""
    larger = size - extent[:, None, None, :]
    off = np.where(
        (larger < 0.0) | is_complete[:, None, None, :], larger / tolerances.over_m, larger / tolerances.under_m
    )
    cost: Floats = (off**2).sum(axis=3)
    return cost


def _end_cost(
    centre: Floats, size: Floats, yaw_rad: Floats, spans: AngularSpans, range_m: Floats, tolerances: Tolerances
) -> Floats:
    """What it costs that a box ends elsewhere than its cluster and what hides it, (m, 2, kinds)."""
    corners = centre[..., None, :] + _CORNERS * size[..., None, :]
    middle = spans.middle_rad - yaw_rad
    c, s = np.cos(middle)[:, None, None, None], np.sin(middle)[:, None, None, None]
    azimuth = np.arctan2(corners[..., 1] * c - corners[..., 0] * s, corners[..., 0] * c + corners[..., 1] * s)
    right, left = -azimuth.min(axis=3), azimuth.max(axis=3)
    sigma_rad = tolerances.end_m / np.maximum(range_m, 1e-9) + tolerances.end_per_range
    cost = np.zeros(right.shape)
    for ends, seen, hidden in zip((right, left), (-spans.right_rad, spans.left_rad), spans.hidden_rad.T, strict=True):
        shown, most = seen[:, None, None], (seen + hidden)[:, None, None]
        off = np.maximum(ends - most, 0.0) + np.maximum(shown - ends, 0.0)
        cost += (off / sigma_rad[:, None, None]) ** 2
    return cost


HEIGHTS_M = 0.2, 5.0
"""Points lower than the first or higher than the second above the ground are left out."""

AROUND_M = 8.0
"""Points this far from the region of interest, or nearer, are looked at: half a long vehicle."""

SCORE_POINTS, SCORE_COST = 100.0, 10.0
"""Points with which a score has gone 63 % of the way to 1; cost of completing that takes 63 % of it away."""


@dataclass(frozen=True)
class Cluster:
    """Clusters of new points, completed to boxes. What it assumes was chosen on training junctions."""

    NAME: ClassVar[str] = "cluster"
    SOURCE: ClassVar[str] = "DBSCAN (Ester et al. 1996), L-shape by closeness (Zhang et al., IV 2017)"

    density: Density = field(default_factory=Density)
    tolerances: Tolerances = field(default_factory=Tolerances)

    @property
    def settings(self) -> dict[str, Any]:
        """Its parameters, and the sha256 of the table of kinds."""
        return asdict(self) | {"kinds": files.hash_file(KINDS_FILE)}

    def at(self, view: SiteView, roi: Roi) -> ClusterAtSite:
        """The detector at one site."""
        return ClusterAtSite(self.together((view,), roi))

    def together(self, views: Sequence[SiteView], roi: Roi) -> ClusterAtSites:
        """The detector at several sites."""
        ground, still = GroundMap.together(views, roi), []
        for view in views:
            points = empty_scan_points(view)
            upright = points[points[:, 2] - ground.height_m(points[:, :2]) > HEIGHTS_M[0]]
            still.append(RangeImage.of(upright - np.asarray(view.pose.position_m)))
        return ClusterAtSites(self, tuple(views), roi, ground, tuple(still))


@dataclass(frozen=True)
class ClusterAtSite:
    """The detector at one site."""

    joint: ClusterAtSites

    def detect(self, sweep: Sweep) -> Detections:
        """The vehicles of one sweep."""
        return self.joint.detect((sweep,))


@dataclass(frozen=True)
class ClusterAtSites:
    """The detector at some sites; ``still`` is what of the static world may hide vehicles, as each of them sees it."""

    detector: Cluster
    views: tuple[SiteView, ...]
    roi: Roi
    ground: GroundMap
    still: tuple[RangeImage, ...]

    @property
    def _at_m(self) -> Floats:
        """Where the sensors are in the world frame, (k, 3)."""
        return np.array([view.pose.position_m for view in self.views])

    def detect(self, sweeps: Sequence[Sweep]) -> Detections:
        """The vehicles of one instant."""
        each = [_foreground_points(sweep, view) for sweep, view in zip(sweeps, self.views, strict=True)]
        points_m, sensor = np.concatenate(each), np.repeat(np.arange(len(each)), [len(its) for its in each])
        near_m, kept = self._near_the_ground(points_m)
        from_first_m = self._at_m[:, :2] - self._at_m[0, :2]
        clusters = find_clusters(near_m, self.detector.density, sensor[kept], from_first_m)
        if not len(clusters):
            return Detections.empty()
        points_on = np.zeros((len(self.views), len(clusters)), dtype=np.int64)
        np.add.at(points_on, (clusters.sensor, clusters.of_point), 1)
        best = points_on.argmax(axis=0)
        found = [self._boxes_from_sensor(k, clusters, best == k, points_m) for k in np.unique(best).tolist()]
        boxes, cost, points = (np.concatenate(its) for its in zip(*found, strict=True))
        return suppress_overlaps(Detections(boxes, box_scores(points, cost)), points)

    def _near_the_ground(self, points_m: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """The points in and round the region of interest, x, y from the first sensor, z from the ground; which."""
        low = np.asarray(self.roi.origin_m)[:2] - AROUND_M
        high = low + np.asarray(self.roi.size_m)[:2] + 2 * AROUND_M
        rows = np.flatnonzero(((points_m[:, :2] >= low) & (points_m[:, :2] <= high)).all(axis=1))
        above_m = points_m[rows, 2] - self.ground.height_m(points_m[rows, :2])
        kept = (above_m > HEIGHTS_M[0]) & (above_m < HEIGHTS_M[1])
        rows = rows[kept]
        return np.column_stack([points_m[rows, :2] - self._at_m[0, :2], above_m[kept]]), rows

    def _boxes_from_sensor(
        self, k: int, clusters: Clusters, selected: NDArray[np.bool_], points_m: Floats
    ) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """Boxes in the world frame, costs and points of some clusters that are vehicles, as one sensor sees them."""
        sensor_m = self._at_m[k]
        clusters = clusters.from_position(sensor_m[:2] - self._at_m[0, :2])
        own_m = clusters.points_m.copy()
        own_m[:, 2] += self.ground.height_m(own_m[:, :2] + sensor_m[:2]) - sensor_m[2]
        image = self.still[k].with_points(points_m - sensor_m, np.full(len(points_m), -1))
        image = image.with_points(own_m, clusters.of_point)
        found = bounding_rectangles(clusters.squares_m, clusters.square_starts)
        spans = angular_spans(own_m, clusters, image)
        hidden = occluded_ends(clusters, found, spans)
        table = load_kinds()
        shown = visible_ends(clusters, found, self._at_m[:, :2] - sensor_m[:2], k)
        done = fit_boxes(found, hidden, shown, spans, clusters.top_m, table, self.detector.tolerances)
        rows = selected & table.is_vehicle[done.kind]
        boxes = done.boxes[rows]
        boxes[:, :2] += sensor_m[:2]
        boxes[:, 2] += self.ground.height_m(boxes[:, :2])
        return boxes, done.cost[rows], np.diff(clusters.starts)[rows]


def _foreground_points(sweep: Sweep, view: SiteView) -> Floats:
    """What is new since a sensor's empty scan, in the world frame, (n, 3)."""
    new = background.foreground_mask(sweep, view)
    return background.points_in_world(Sweep(sweep.points[new], sweep.beam[new]), view)


def box_scores(points: NDArray[np.int64], cost: Floats) -> Floats:
    """How sure boxes are, 0 to 1: by their points and how well they fit; a cost below 0, of a common kind, is 0."""
    score: Floats = (1.0 - np.exp(-points / SCORE_POINTS)) * np.exp(-np.maximum(cost, 0.0) / SCORE_COST)
    return score
