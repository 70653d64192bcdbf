r"""The detector ``cluster``: background subtraction, clusters, boxes, as is common for roadside sensors without a GPU.

Steps for a sweep: subtract the background beam by beam, and measure heights from the ground
(:mod:`egvs.extensions.validation.detectors.background`); cluster the points
(:mod:`egvs.extensions.validation.detectors.clustering`); fit a rectangle to each cluster by the closeness criterion
(:mod:`egvs.extensions.validation.kernels.detection`); find out what hides the rest of it; fit a box of a typical size,
which extends away from the sensor. People and bicycles are kinds of road users too, and are dropped at the end.

**Occlusion.** The empty scan contains walls, poles and trees, the sweep the other road users. Their nearest ranges are
stored in an image of azimuth and elevation. Beside a cluster, at its elevations, the image is followed as long as
something nearer covers it.

**Boxes.** For each cluster, every kind of road user in ``kinds.toml`` beside this module is tried, with its length
along either axis of the rectangle. Along an axis, the end that faces the sensor is fixed; where this end is the edge of
something that hides the rest, and not a side of the body, the other end is fixed. The lowest cost wins:

.. math:: C = \sum_{ends} \Big(\frac{r\,\Delta\alpha}{\sigma_s}\Big)^2 + \sum_{axes} \Big(\frac{\max(e - s, 0)}
          {\sigma_o}\Big)^2 + \Big(\frac{\max(s - e, 0)}{\sigma_u}\Big)^2 + \Big(\frac{h - t}{\sigma_h}\Big)^2 - 2 \ln q

with the azimuth :math:`\Delta\alpha` between the ends of the box and of the cluster, where nothing hides it; the extent
e of the cluster and the size s of the box along an axis; the height h of the box, the highest point t, and the share q
of the kind in traffic. So a box that beams have passed through has a higher cost than one that they could not have hit.

**Several sensors.** Each subtracts its own background; the foreground points of all are clustered together, over the
ground from all empty scans. A box is fitted as seen from the sensor with most points on the cluster. Ends that another
sensor shows to be sides are fixed as well; an axis with both ends fixed is as long as it appears, with :math:`\sigma_o`
for either deviation.

Frame: the world's axes from the sensor, also for a tilted sensor. Ranges are horizontal.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from egvs.clouds.sweeps import Detections, SiteView, Sweep
from egvs.core import files
from egvs.core.grid import BoolArray, FloatArray, IntArray, Roi
from egvs.core.special import cosdg, sindg
from egvs.extensions.validation.detectors import background
from egvs.extensions.validation.detectors.background import GroundMap, empty_scan_points
from egvs.extensions.validation.detectors.base import AtOneSite, suppress_overlaps
from egvs.extensions.validation.detectors.clustering import Clusters, Density, find_clusters
from egvs.extensions.validation.kernels import detection
from egvs.sensors.sensor import Sensor

KINDS_FILE = Path(__file__).with_name("kinds.toml")

N_HEADINGS = 90
"""Headings within a quarter turn that are tried for a rectangle."""

ON_SIDE_M = 0.05
"""Points nearer than this to a side are on it."""

CELL_DEG = 0.5, 1.0
"""Azimuth and elevation of a cell of the range image: a few beams of most sensors."""

CHANNELS_PER_CELL = 4.0
"""Cells are lower than that for a sensor with dense channels: this number of median spacings. Otherwise a low barrier
shares its cells with vehicles far behind and above it, and seems to hide the rest of them."""

NEARER_M = 0.5
"""An occluder is nearer by more than this."""

MAX_HIDDEN_DEG = 30.0
"""How far the range image is followed beside a cluster."""

HEIGHTS_M = 0.2, 5.0
"""Points below the first or above the second height over the ground are dropped."""

AROUND_M = 8.0
"""Points up to this distance from the region of interest are used: half a long vehicle."""

SCORE_POINTS, SCORE_COST = 100.0, 10.0
"""Points with which a score reaches 63 % of 1; cost of a box that reduces it by 63 %."""

_COLUMNS = round(360.0 / CELL_DEG[0])
_MIN_CELL_DEG = 0.1
_NO_OWNER = -1
_ON_END_M = 0.2  # points nearer than this to an end of a rectangle are on it
_SIDE_M = 0.5  # points on an end that extend this far show a side, even if the outermost one is at the hidden edge
_CORNERS = 0.5 * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])


@dataclass(frozen=True)
class Kinds:
    """Typical kinds of road users.

    Attributes
    ----------
    names
        Names of the k kinds.
    size_m
        Length, width, height, (k, 3) float64.
    share
        Relative frequency, (k,) float64.
    is_vehicle
        (k,) bool.
    """

    names: tuple[str, ...]
    size_m: FloatArray
    share: FloatArray
    is_vehicle: BoolArray


@cache
def load_kinds() -> Kinds:
    """Return the kinds of ``kinds.toml``."""
    with KINDS_FILE.open("rb") as file:
        rows = tomllib.load(file)["kind"]
    return Kinds(
        tuple(row["name"] for row in rows),
        np.array([row["size_m"] for row in rows], dtype=np.float64),
        np.array([row["share"] for row in rows], dtype=np.float64),
        np.array([row.get("vehicle", True) for row in rows], dtype=np.bool_),
    )


@dataclass(frozen=True)
class Rectangles:
    """The bounding rectangle of each cluster seen from above, at its best heading.

    Attributes
    ----------
    yaw_rad
        Direction of the first axis, 0 to pi/2, (m,) float64; the second is a quarter turn counter-clockwise from it.
    ends_m
        Low and high end along both axes, (m, 2, 2) float64.
    closeness
        How near the points are to two sides, 0 to 1, (m,) float64.
    """

    yaw_rad: FloatArray
    ends_m: FloatArray
    closeness: FloatArray

    def to_axes(self, k: int, xy_m: FloatArray) -> FloatArray:
        """Return positions (n, 2) along the axes of rectangle k."""
        cos = np.cos(self.yaw_rad[k])
        sin = np.sin(self.yaw_rad[k])
        return np.column_stack([cos * xy_m[:, 0] + sin * xy_m[:, 1], cos * xy_m[:, 1] - sin * xy_m[:, 0]])


def bounding_rectangles(xy_m: FloatArray, starts: IntArray) -> Rectangles:
    """Return the rectangles of clusters, whose points (n, 2) start at ``starts``, (m + 1,)."""
    degrees = np.arange(N_HEADINGS) * (90.0 / N_HEADINGS)
    clusters = len(starts) - 1
    heading = np.empty(clusters, np.int64)
    ends_m = np.empty((clusters, 4))
    closeness = np.empty(clusters)
    detection.fit_rectangles(xy_m, starts, cosdg(degrees), sindg(degrees), ON_SIDE_M, heading, ends_m, closeness)
    return Rectangles(np.deg2rad(degrees)[heading], ends_m.reshape(-1, 2, 2), closeness)


class _ImageCells(NamedTuple):
    """Cells of points in the range image, and their horizontal ranges, (n,) each."""

    column: IntArray
    row: IntArray
    range_m: FloatArray


def _image_cells(points_m: FloatArray, cell_deg: float) -> _ImageCells:
    range_m = np.hypot(points_m[:, 0], points_m[:, 1])
    azimuth_deg = np.rad2deg(np.arctan2(points_m[:, 1], points_m[:, 0]))
    elevation_deg = np.rad2deg(np.arctan2(points_m[:, 2], range_m))
    column = np.floor(azimuth_deg / CELL_DEG[0]).astype(np.int64) % _COLUMNS
    row = np.floor((elevation_deg + 90.0) / cell_deg).astype(np.int64)
    return _ImageCells(column, np.minimum(row, _image_rows(cell_deg) - 1), range_m)


def _image_rows(cell_deg: float) -> int:
    return math.ceil(180.0 / cell_deg)


def elevation_cell_deg(sensor: Sensor) -> float:
    """Return the height of a cell of the range image of a sensor."""
    spacing_deg = np.diff(np.sort(sensor.elevations_deg))
    if sensor.table is not None or not len(spacing_deg):
        return CELL_DEG[1]
    return float(min(CELL_DEG[1], max(CHANNELS_PER_CELL * np.median(spacing_deg), _MIN_CELL_DEG)))


@dataclass(frozen=True)
class RangeImage:
    """The nearest point in each cell of azimuth and elevation.

    Attributes
    ----------
    range_m
        Horizontal range, (azimuths, elevations) float64, infinite for an empty cell.
    owner
        Cluster of this point, -1 for none, (azimuths, elevations) int64.
    cell_deg
        Height of a cell.
    """

    range_m: FloatArray
    owner: IntArray
    cell_deg: float = CELL_DEG[1]

    @classmethod
    def from_points(cls, points_m: FloatArray, cell_deg: float = CELL_DEG[1]) -> RangeImage:
        """Return the image of points (n, 3) that belong to no cluster."""
        shape = _COLUMNS, _image_rows(cell_deg)
        empty = cls(np.full(shape, np.inf), np.full(shape, _NO_OWNER), cell_deg)
        return empty.with_points(points_m, np.full(len(points_m), _NO_OWNER))

    def with_points(self, points_m: FloatArray, owner: IntArray) -> RangeImage:
        """Return the image with more points, (n, 3), and the cluster of each.

        Of points with the same range, that of a cluster is stored.
        """
        cells = _image_cells(points_m, self.cell_deg)
        order = np.lexsort((owner, -cells.range_m))  # the nearest is written last
        column, row, range_m = cells.column[order], cells.row[order], cells.range_m[order]
        is_nearer = range_m <= self.range_m[column, row]
        nearer_cells = column[is_nearer], row[is_nearer]
        ranges = self.range_m.copy()
        owners = self.owner.copy()
        ranges[nearer_cells] = range_m[is_nearer]
        owners[nearer_cells] = owner[order][is_nearer]
        return RangeImage(ranges, owners, self.cell_deg)


@dataclass(frozen=True)
class AngularSpans:
    """Azimuths where clusters start and end, seen from the sensor, and how far they are hidden there.

    Attributes
    ----------
    middle_rad
        An azimuth within each cluster, (m,) float64.
    right_rad, left_rad
        Its ends, counter-clockwise from the middle, (m,) float64.
    hidden_rad
        How far an occluder extends beyond the right and the left end, (m, 2) float64, 0 without an occluder.
    """

    middle_rad: FloatArray
    right_rad: FloatArray
    left_rad: FloatArray
    hidden_rad: FloatArray


def angular_spans(points_m: FloatArray, clusters: Clusters, image: RangeImage) -> AngularSpans:
    """Return the spans of clusters.

    Parameters
    ----------
    points_m
        Points of the clusters, (n, 3), with z from the sensor.
    clusters
        The m clusters.
    image
        A range image with these points in it.
    """
    cells = _image_cells(points_m, image.cell_deg)
    azimuth = np.arctan2(points_m[:, 1], points_m[:, 0])
    middle = np.empty(len(clusters))
    right = np.empty(len(clusters))
    left = np.empty(len(clusters))
    hidden = np.empty((len(clusters), 2))
    for k in range(len(clusters)):
        rows = slice(clusters.starts[k], clusters.starts[k + 1])
        middle[k] = azimuth[rows][0]
        turn = _turn_from(middle[k], azimuth[rows])
        right[k] = turn.min()
        left[k] = turn.max()
        cluster = _ClusterCells(k, _ImageCells(cells.column[rows], cells.row[rows], cells.range_m[rows]))
        hidden[k, 0] = cluster.hidden_rad(image, turn.argmin(), -1)
        hidden[k, 1] = cluster.hidden_rad(image, turn.argmax(), 1)
    return AngularSpans(middle, right, left, hidden)


def _turn_from(middle_rad: float, azimuth_rad: FloatArray) -> FloatArray:
    """Return azimuths relative to another one, from -pi to pi."""
    return (azimuth_rad - middle_rad + np.pi) % (2 * np.pi) - np.pi


@dataclass(frozen=True)
class _ClusterCells:
    """A cluster's number, and the cells of its points."""

    number: int
    cells: _ImageCells

    def hidden_rad(self, image: RangeImage, outermost: np.intp, direction: int) -> float:
        """Return how far an occluder extends beyond the outermost point, to the left (1) or to the right (-1)."""
        column, row, range_m = self.cells
        end = column[outermost]
        at_end = np.abs((column - end + _COLUMNS // 2) % _COLUMNS - _COLUMNS // 2) <= 1
        rows = slice(row[at_end].min(), row[at_end].max() + 1)
        beside = (end + direction * np.arange(1, round(MAX_HIDDEN_DEG / CELL_DEG[0]) + 1)) % _COLUMNS
        is_nearer = image.range_m[beside, rows] < range_m[at_end].min() - NEARER_M
        hides = (is_nearer & (image.owner[beside, rows] != self.number)).any(axis=1)
        if not hides[:2].any():
            return 0.0
        hides[0] = True  # the edge of the occluder may share its cell with points that it does not hide
        cells = len(hides) if hides.all() else int(hides.argmin())
        return float(np.deg2rad(cells * CELL_DEG[0]))


def occluded_ends(clusters: Clusters, rectangles: Rectangles, spans: AngularSpans) -> BoolArray:
    """Return which ends of the rectangles are edges of an occluder, and not sides of bodies.

    Returns
    -------
    NDArray
        For the low and the high end along both axes, (m, 2, 2) bool.
    """
    ends = np.zeros((len(clusters), 2, 2), dtype=np.bool_)
    for k in np.flatnonzero((spans.hidden_rad > 0.0).any(axis=1)).tolist():
        xy_m = clusters.squares_m[clusters.square_starts[k] : clusters.square_starts[k + 1]]
        turn = _turn_from(spans.middle_rad[k], np.arctan2(xy_m[:, 1], xy_m[:, 0]))
        uv_m = rectangles.to_axes(k, xy_m)
        for outermost, is_hidden in zip((turn.argmin(), turn.argmax()), spans.hidden_rad[k] > 0.0, strict=True):
            for axis, end in np.ndindex(2, 2):
                on_end = np.abs(uv_m[:, axis] - rectangles.ends_m[k, axis, end]) < _ON_END_M
                if is_hidden and on_end[outermost] and np.ptp(uv_m[on_end, 1 - axis]) < _SIDE_M:
                    ends[k, axis, end] = True
    return ends


def visible_ends(clusters: Clusters, rectangles: Rectangles, sensors_m: FloatArray, excluded: int) -> BoolArray:
    """Return which ends of the rectangles other sensors show to be sides.

    Such a sensor faces the end, and its points on the end extend as far as on a side.

    Parameters
    ----------
    clusters, rectangles
        The m clusters and their rectangles.
    sensors_m
        Positions of the sensors seen from above, in the clusters' frame, (s, 2).
    excluded
        The sensor that is not used.

    Returns
    -------
    NDArray
        For the low and the high end along both axes, (m, 2, 2) bool.
    """
    ends = np.zeros((len(clusters), 2, 2), dtype=np.bool_)
    for k in range(len(clusters)):
        rows = slice(clusters.starts[k], clusters.starts[k + 1])
        uv_m = rectangles.to_axes(k, clusters.points_m[rows, :2])
        sensor = clusters.sensor[rows]
        sensors_uv_m = rectangles.to_axes(k, sensors_m)
        for other in np.setdiff1d(sensor, excluded).tolist():
            for axis, end in np.ndindex(2, 2):
                end_m = rectangles.ends_m[k, axis, end]
                beyond_m = (sensors_uv_m[other, axis] - end_m) * (1 if end else -1)
                on_end = (sensor == other) & (np.abs(uv_m[:, axis] - end_m) < _ON_END_M)
                if beyond_m > 0.0 and on_end.any() and np.ptp(uv_m[on_end, 1 - axis]) >= _SIDE_M:
                    ends[k, axis, end] = True
    return ends


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations in metres, and how they grow per metre of range.

    Attributes
    ----------
    end_m, end_per_range
        Of the ends of a box across the line of sight.
    over_m, under_m
        Of how much larger, and smaller, a cluster is than its box along an axis.
    height_m, height_per_range
        Of the highest point, relative to the top of the box.
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
        Row of the table of kinds, (m,) int64.
    cost
        C of the module's equation, (m,) float64.
    """

    boxes: FloatArray
    kind: IntArray
    cost: FloatArray


def fit_boxes(
    rectangles: Rectangles,
    hidden: BoolArray,
    visible: BoolArray,
    spans: AngularSpans,
    top_m: FloatArray,
    kinds: Kinds,
    tolerances: Tolerances,
) -> FittedBoxes:
    """Return the box of lowest cost for each cluster.

    Parameters
    ----------
    rectangles, spans
        Rectangle of each cluster, and its ends as seen from the sensor.
    hidden
        Which ends are edges of an occluder, (m, 2, 2).
    visible
        Which ends other sensors show to be sides, (m, 2, 2).
    top_m
        Height of the highest point above the ground, (m,).
    kinds
        Sizes to try.
    tolerances
        Standard deviations of the cost.
    """
    size_xy = kinds.size_m[:, :2]
    size = np.stack([size_xy, size_xy[:, ::-1]])[None]  # (1, turned, kind, axis): length along axis 0, or axis 1
    fixed = _fixed_ends(rectangles.ends_m, hidden, visible)
    centre = fixed.position_m[:, None, None, :] + 0.5 * fixed.direction[:, None, None, :] * size
    extent = rectangles.ends_m[..., 1] - rectangles.ends_m[..., 0]
    range_m = np.hypot(*rectangles.ends_m.mean(axis=2).T)

    cost = _end_cost(centre, size, rectangles.yaw_rad, spans, range_m, tolerances)
    cost += _size_cost(size, extent, fixed.is_complete, tolerances)
    height_sigma_m = tolerances.height_m + tolerances.height_per_range * range_m
    cost += (((kinds.size_m[:, 2] - top_m[:, None]) / height_sigma_m[:, None]) ** 2)[:, None]
    cost -= 2.0 * np.log(kinds.share / kinds.share.sum())

    best = cost.reshape(len(cost), cost[0].size if len(cost) else 1).argmin(axis=1)
    turned, kind = np.divmod(best, len(kinds.share))
    rows = np.arange(len(cost))
    u, v = centre[rows, turned, kind].T
    cos = np.cos(rectangles.yaw_rad)
    sin = np.sin(rectangles.yaw_rad)
    centre_m = cos * u - sin * v, sin * u + cos * v, 0.5 * kinds.size_m[kind, 2]
    boxes = np.column_stack([*centre_m, kinds.size_m[kind], rectangles.yaw_rad + turned * (0.5 * np.pi)])
    return FittedBoxes(boxes, kind, cost[rows, turned, kind])


class _FixedEnds(NamedTuple):
    """Where boxes are fixed along each axis, (m, 2) each.

    ``direction`` is where the box extends from there: 1, -1, or 0 for both ways. ``is_complete`` tells whether both
    ends are visible sides.
    """

    position_m: FloatArray
    direction: FloatArray
    is_complete: BoolArray


def _fixed_ends(ends_m: FloatArray, hidden: BoolArray, visible: BoolArray) -> _FixedEnds:
    """Return the fixed ends; the sensor is at 0 of both axes.

    A sensor between the ends sees both; where both are hidden, neither is known.
    """
    low_m = ends_m[..., 0]
    high_m = ends_m[..., 1]
    low_visible = (~hidden[..., 0] & (low_m > 0.0)) | visible[..., 0]
    high_visible = (~hidden[..., 1] & (high_m < 0.0)) | visible[..., 1]
    low_fixed = low_visible | (~hidden[..., 0] & hidden[..., 1])
    high_fixed = high_visible | (~hidden[..., 1] & hidden[..., 0])
    one_end = np.where(low_fixed, low_m, high_m)
    position_m = np.where(low_fixed ^ high_fixed, one_end, 0.5 * (low_m + high_m))
    return _FixedEnds(position_m, low_fixed.astype(np.float64) - high_fixed, low_visible & high_visible)


def _size_cost(size: FloatArray, extent: FloatArray, is_complete: BoolArray, tolerances: Tolerances) -> FloatArray:
    """Return the cost of boxes that are smaller or larger than their cluster, (m, 2, kinds)."""
    excess = size - extent[:, None, None, :]
    use_over = (excess < 0.0) | is_complete[:, None, None, :]
    deviation = np.where(use_over, excess / tolerances.over_m, excess / tolerances.under_m)
    cost: FloatArray = (deviation**2).sum(axis=3)
    return cost


def _end_cost(
    centre: FloatArray, size: FloatArray, yaw_rad: FloatArray, spans: AngularSpans, range_m: FloatArray,
    tolerances: Tolerances,
) -> FloatArray:  # fmt: skip
    """Return the cost of boxes whose ends differ from those of the cluster and its occluders, (m, 2, kinds)."""
    corners = centre[..., None, :] + _CORNERS * size[..., None, :]
    middle = spans.middle_rad - yaw_rad
    cos = np.cos(middle)[:, None, None, None]
    sin = np.sin(middle)[:, None, None, None]
    azimuth = np.arctan2(corners[..., 1] * cos - corners[..., 0] * sin, corners[..., 0] * cos + corners[..., 1] * sin)
    sigma_rad = tolerances.end_m / np.maximum(range_m, 1e-9) + tolerances.end_per_range
    cost = np.zeros(azimuth.shape[:3])
    right_and_left = (
        (-azimuth.min(axis=3), -spans.right_rad, spans.hidden_rad[:, 0]),
        (azimuth.max(axis=3), spans.left_rad, spans.hidden_rad[:, 1]),
    )
    for box_end, cluster_end, hidden in right_and_left:
        nearest = cluster_end[:, None, None]
        farthest = (cluster_end + hidden)[:, None, None]
        deviation = np.maximum(box_end - farthest, 0.0) + np.maximum(nearest - box_end, 0.0)
        cost += (deviation / sigma_rad[:, None, None]) ** 2
    return cost


@dataclass(frozen=True)
class Cluster:
    """Clusters of foreground points, completed to boxes. Its parameters were chosen on training junctions."""

    NAME: ClassVar[str] = "cluster"
    SOURCE: ClassVar[str] = "DBSCAN (Ester et al. 1996), L-shape by closeness (Zhang et al., IV 2017)"

    density: Density = field(default_factory=Density)
    tolerances: Tolerances = field(default_factory=Tolerances)

    @property
    def settings(self) -> dict[str, Any]:
        """Its parameters, and the sha256 of the table of kinds."""
        return asdict(self) | {"kinds": files.hash_file(KINDS_FILE)}

    def at_site(self, view: SiteView, roi: Roi) -> AtOneSite[ClusterAtSites]:
        """Prepare the detector for one site."""
        return AtOneSite(self.at_sites((view,), roi))

    def at_sites(self, views: Sequence[SiteView], roi: Roi) -> ClusterAtSites:
        """Prepare the detector for several sites."""
        ground = GroundMap.from_empty_scans(views, roi)
        images = []
        for view in views:
            points = empty_scan_points(view)
            above_ground = points[points[:, 2] - ground.height_m(points[:, :2]) > HEIGHTS_M[0]]
            relative_m = above_ground - np.asarray(view.pose.position_m)
            images.append(RangeImage.from_points(relative_m, elevation_cell_deg(view.sensor)))
        return ClusterAtSites(self, tuple(views), roi, ground, tuple(images))


class _VehicleBoxes(NamedTuple):
    """Boxes in the world frame (m, 7), their costs, and the number of points of their clusters, (m,)."""

    boxes: FloatArray
    cost: FloatArray
    points: IntArray


@dataclass(frozen=True)
class ClusterAtSites:
    """The detector at several sites.

    Attributes
    ----------
    detector
        Its parameters.
    views
        The sites.
    roi
        The region of interest.
    ground
        The ground from all empty scans.
    static_images
        For each site, the part of the static world that can hide vehicles.
    """

    detector: Cluster
    views: tuple[SiteView, ...]
    roi: Roi
    ground: GroundMap
    static_images: tuple[RangeImage, ...]

    @property
    def _sensors_m(self) -> FloatArray:
        """Positions of the sensors in the world frame, (k, 3)."""
        return np.array([view.pose.position_m for view in self.views])

    def detect(self, sweeps: Sequence[Sweep]) -> Detections:
        """Return the vehicles of one instant."""
        foreground = [_foreground_points(sweep, view) for sweep, view in zip(sweeps, self.views, strict=True)]
        points_m = np.concatenate(foreground)
        sensor = np.repeat(np.arange(len(foreground)), [len(points) for points in foreground])
        selected_m, rows = self._select_points(points_m)
        sensors_m = self._sensors_m[:, :2] - self._sensors_m[0, :2]
        clusters = find_clusters(selected_m, self.detector.density, sensor[rows], sensors_m)
        if not len(clusters):
            return Detections.empty()

        points_on = np.zeros((len(self.views), len(clusters)), dtype=np.int64)
        np.add.at(points_on, (clusters.sensor, clusters.cluster_of_point), 1)
        best_sensor = points_on.argmax(axis=0)
        by_sensor = []
        for sensor in np.unique(best_sensor).tolist():
            by_sensor.append(self._boxes_from_sensor(sensor, clusters, best_sensor == sensor, points_m))
        boxes, cost, points = (np.concatenate(arrays) for arrays in zip(*by_sensor, strict=True))
        return suppress_overlaps(Detections(boxes, box_scores(points, cost)), points)

    def _select_points(self, points_m: FloatArray) -> tuple[FloatArray, IntArray]:
        """Return the points in and around the region of interest at heights of vehicles, and their rows.

        x and y are from the first sensor, z from the ground.
        """
        low = np.asarray(self.roi.origin_m)[:2] - AROUND_M
        high = low + np.asarray(self.roi.size_m)[:2] + 2 * AROUND_M
        rows = np.flatnonzero(((points_m[:, :2] >= low) & (points_m[:, :2] <= high)).all(axis=1))
        above_m = points_m[rows, 2] - self.ground.height_m(points_m[rows, :2])
        in_range = (above_m > HEIGHTS_M[0]) & (above_m < HEIGHTS_M[1])
        rows = rows[in_range]
        return np.column_stack([points_m[rows, :2] - self._sensors_m[0, :2], above_m[in_range]]), rows

    def _boxes_from_sensor(
        self, k: int, clusters: Clusters, selected: BoolArray, points_m: FloatArray
    ) -> _VehicleBoxes:
        """Return the boxes of the selected clusters that are vehicles, as seen from sensor k."""
        sensor_m = self._sensors_m[k]
        clusters = clusters.with_origin(sensor_m[:2] - self._sensors_m[0, :2])
        cluster_points_m = clusters.points_m.copy()  # with z from the sensor
        cluster_points_m[:, 2] += self.ground.height_m(cluster_points_m[:, :2] + sensor_m[:2]) - sensor_m[2]
        image = self.static_images[k].with_points(points_m - sensor_m, np.full(len(points_m), _NO_OWNER))
        image = image.with_points(cluster_points_m, clusters.cluster_of_point)

        rectangles = bounding_rectangles(clusters.squares_m, clusters.square_starts)
        spans = angular_spans(cluster_points_m, clusters, image)
        hidden = occluded_ends(clusters, rectangles, spans)
        visible = visible_ends(clusters, rectangles, self._sensors_m[:, :2] - sensor_m[:2], k)
        kinds = load_kinds()
        fitted = fit_boxes(rectangles, hidden, visible, spans, clusters.top_m, kinds, self.detector.tolerances)
        rows = selected & kinds.is_vehicle[fitted.kind]
        boxes = fitted.boxes[rows]
        boxes[:, :2] += sensor_m[:2]
        boxes[:, 2] += self.ground.height_m(boxes[:, :2])
        return _VehicleBoxes(boxes, fitted.cost[rows], np.diff(clusters.starts)[rows])


def _foreground_points(sweep: Sweep, view: SiteView) -> FloatArray:
    """Return the foreground points of a sweep in the world frame, (n, 3)."""
    is_foreground = background.foreground_mask(sweep, view)
    return background.points_in_world(Sweep(sweep.points[is_foreground], sweep.beam[is_foreground]), view)


def box_scores(points: IntArray, cost: FloatArray) -> FloatArray:
    """Return scores from 0 to 1, by the number of points and the cost of the fit.

    A cost below 0, possible for a common kind, counts as 0.
    """
    return (1.0 - np.exp(-points / SCORE_POINTS)) * np.exp(-np.maximum(cost, 0.0) / SCORE_COST)
