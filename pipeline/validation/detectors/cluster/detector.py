"""The detector ``cluster``: what roadside practice uses without a GPU.

Steps of a sweep: take the background off, beam by beam (:mod:`pipeline.validation.detectors.background`); count heights
from the ground (:mod:`pipeline.validation.detectors.ground`); cluster; fit a rectangle to each cluster; see what hides
the rest of it; complete it to the nearest kind, away from the sensor. People and bicycles are kinds too, and left out.

With several sensors each takes its own background off, by its own empty scan; the new points of all are clustered
together, in the world's axes, over the ground that all empty scans show. A cluster with the points of all is then
completed as the sensor sees it that has most points on it: away from that one, by what hides it from there, and
between the ends that other sensors show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pipeline.core import files
from pipeline.core.grid import Roi
from pipeline.validation.detectors import background
from pipeline.validation.detectors.cluster import hiding, kinds
from pipeline.validation.detectors.cluster.clustering import Clusters, Density, clusters_of
from pipeline.validation.detectors.cluster.completing import Tolerances, complete
from pipeline.validation.detectors.cluster.hiding import RangeImage
from pipeline.validation.detectors.cluster.l_shape import rectangles
from pipeline.validation.detectors.ground import GroundMap, empty_points
from pipeline.validation.detectors.overlapping import apart
from pipeline.validation.sweeps import Detections, SiteView, Sweep

Floats = NDArray[np.float64]

HEIGHTS_M = 0.2, 5.0
"""Points lower than the first or higher than the second above the ground are left out."""

AROUND_M = 8.0
"""Points this far from the region of interest, or nearer, are looked at: half a long vehicle."""

MANY_POINTS, MUCH_COST = 100.0, 10.0
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
        return asdict(self) | {"kinds": files.sha256_of(kinds.FILE)}

    def at(self, view: SiteView, roi: Roi) -> ClusterAtSite:
        """The detector at one site."""
        return ClusterAtSite(self.together((view,), roi))

    def together(self, views: Sequence[SiteView], roi: Roi) -> ClusterAtSites:
        """The detector at several sites."""
        ground, still = GroundMap.together(views, roi), []
        for view in views:
            points = empty_points(view)
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
        each = [_new(sweep, view) for sweep, view in zip(sweeps, self.views, strict=True)]
        points_m, sensor = np.concatenate(each), np.repeat(np.arange(len(each)), [len(its) for its in each])
        near_m, kept = self._near_the_ground(points_m)
        from_first_m = self._at_m[:, :2] - self._at_m[0, :2]
        clusters = clusters_of(near_m, self.detector.density, sensor[kept], from_first_m)
        if not len(clusters):
            return Detections.none()
        points_on = np.zeros((len(self.views), len(clusters)), dtype=np.int64)
        np.add.at(points_on, (clusters.sensor, clusters.of_point), 1)
        best = points_on.argmax(axis=0)
        found = [self._seen_from(k, clusters, best == k, points_m) for k in np.unique(best).tolist()]
        boxes, cost, points = (np.concatenate(its) for its in zip(*found, strict=True))
        return apart(Detections(boxes, scores(points, cost)), points)

    def _near_the_ground(self, points_m: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """The points in and round the region of interest, x, y from the first sensor, z from the ground; which."""
        low = np.asarray(self.roi.origin_m)[:2] - AROUND_M
        high = low + np.asarray(self.roi.size_m)[:2] + 2 * AROUND_M
        rows = np.flatnonzero(((points_m[:, :2] >= low) & (points_m[:, :2] <= high)).all(axis=1))
        above_m = points_m[rows, 2] - self.ground.height_m(points_m[rows, :2])
        kept = (above_m > HEIGHTS_M[0]) & (above_m < HEIGHTS_M[1])
        rows = rows[kept]
        return np.column_stack([points_m[rows, :2] - self._at_m[0, :2], above_m[kept]]), rows

    def _seen_from(
        self, k: int, clusters: Clusters, wanted: NDArray[np.bool_], points_m: Floats
    ) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """Boxes in the world frame, costs and points of some clusters that are vehicles, as one sensor sees them."""
        sensor_m = self._at_m[k]
        clusters = clusters.from_place(sensor_m[:2] - self._at_m[0, :2])
        own_m = clusters.points_m.copy()
        own_m[:, 2] += self.ground.height_m(own_m[:, :2] + sensor_m[:2]) - sensor_m[2]
        image = self.still[k].with_points(points_m - sensor_m, np.full(len(points_m), -1))
        image = image.with_points(own_m, clusters.of_point)
        found = rectangles(clusters.squares_m, clusters.square_starts)
        spans = hiding.spans_of(own_m, clusters, image)
        hidden = hiding.hidden_ends(clusters, found, spans)
        table = kinds.kinds()
        shown = hiding.shown_ends(clusters, found, self._at_m[:, :2] - sensor_m[:2], k)
        done = complete(found, hidden, shown, spans, clusters.top_m, table, self.detector.tolerances)
        rows = wanted & table.is_vehicle[done.kind]
        boxes = done.boxes[rows]
        boxes[:, :2] += sensor_m[:2]
        boxes[:, 2] += self.ground.height_m(boxes[:, :2])
        return boxes, done.cost[rows], np.diff(clusters.starts)[rows]


def _new(sweep: Sweep, view: SiteView) -> Floats:
    """What is new since a sensor's empty scan, in the world frame, (n, 3)."""
    new = background.new_in(sweep, view)
    return background.in_world(Sweep(sweep.points[new], sweep.beam[new]), view)


def scores(points: NDArray[np.int64], cost: Floats) -> Floats:
    """How sure boxes are, 0 to 1: by their points and how well they fit; a cost below 0, of a common kind, is 0."""
    score: Floats = (1.0 - np.exp(-points / MANY_POINTS)) * np.exp(-np.maximum(cost, 0.0) / MUCH_COST)
    return score
