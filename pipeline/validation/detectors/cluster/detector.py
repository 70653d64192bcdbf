"""The detector ``cluster``: what roadside practice uses without a GPU.

Steps of a sweep: take the background off, beam by beam (:mod:`pipeline.validation.detectors.background`); count heights
from the ground (:mod:`pipeline.validation.detectors.ground`); cluster; fit a rectangle to each cluster; see what hides
the rest of it; complete it to the nearest kind, away from the sensor. People and bicycles are kinds too, and left out.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pipeline.core import files
from pipeline.core.grid import Roi
from pipeline.validation.detectors import background
from pipeline.validation.detectors.cluster import hiding, kinds
from pipeline.validation.detectors.cluster.clustering import Clusters, Density, clusters_of
from pipeline.validation.detectors.cluster.completing import Completed, Tolerances, complete
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
        ground, points = GroundMap.of(view, roi), empty_points(view)
        upright = points[points[:, 2] - ground.height_m(points[:, :2]) > HEIGHTS_M[0]]
        return ClusterAtSite(self, view, roi, ground, RangeImage.of(upright - np.asarray(view.pose.position_m)))


@dataclass(frozen=True)
class ClusterAtSite:
    """The detector at one site; ``still`` is what of the static world may hide vehicles."""

    detector: Cluster
    view: SiteView
    roi: Roi
    ground: GroundMap
    still: RangeImage

    def detect(self, sweep: Sweep) -> Detections:
        """The vehicles of one sweep."""
        new = background.new_in(sweep, self.view)
        points_m = background.in_world(Sweep(sweep.points[new], sweep.beam[new]), self.view)
        sensor_m = np.asarray(self.view.pose.position_m)
        clusters = clusters_of(self._near_the_ground(points_m), self.detector.density)
        if not len(clusters):
            return Detections.none()
        own_m = clusters.points_m.copy()
        own_m[:, 2] += self.ground.height_m(own_m[:, :2] + sensor_m[:2]) - sensor_m[2]
        image = self.still.with_points(points_m - sensor_m, np.full(len(points_m), -1))
        image = image.with_points(own_m, clusters.of_point)
        found = rectangles(clusters.squares_m, clusters.square_starts)
        spans = hiding.spans_of(own_m, clusters, image)
        hidden = hiding.hidden_ends(clusters, found, spans)
        table = kinds.kinds()
        boxes = complete(found, hidden, spans, clusters.top_m, table, self.detector.tolerances)
        return self._detections(boxes, clusters, table.is_vehicle)

    def _near_the_ground(self, points_m: Floats) -> Floats:
        """The points in and round the region of interest: x, y from the sensor, z from the ground."""
        low = np.asarray(self.roi.origin_m)[:2] - AROUND_M
        high = low + np.asarray(self.roi.size_m)[:2] + 2 * AROUND_M
        points_m = points_m[((points_m[:, :2] >= low) & (points_m[:, :2] <= high)).all(axis=1)]
        above_m = points_m[:, 2] - self.ground.height_m(points_m[:, :2])
        kept = (above_m > HEIGHTS_M[0]) & (above_m < HEIGHTS_M[1])
        xy_m = points_m[kept, :2] - np.asarray(self.view.pose.position_m)[:2]
        return np.column_stack([xy_m, above_m[kept]])

    def _detections(self, found: Completed, clusters: Clusters, is_vehicle: NDArray[np.bool_]) -> Detections:
        """Those that are vehicles, in the world frame, with scores."""
        vehicles = is_vehicle[found.kind]
        boxes = found.boxes[vehicles]
        boxes[:, :2] += np.asarray(self.view.pose.position_m)[:2]
        boxes[:, 2] += self.ground.height_m(boxes[:, :2])
        points = np.diff(clusters.starts)[vehicles]
        return apart(Detections(boxes, scores(points, found.cost[vehicles])), points)


def scores(points: NDArray[np.int64], cost: Floats) -> Floats:
    """How sure boxes are, 0 to 1: by their points and how well they fit; a cost below 0, of a common kind, is 0."""
    score: Floats = (1.0 - np.exp(-points / MANY_POINTS)) * np.exp(-np.maximum(cost, 0.0) / MUCH_COST)
    return score
