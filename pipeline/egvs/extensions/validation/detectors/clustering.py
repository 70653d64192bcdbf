"""Clustering of the foreground points of a sweep, ideally one cluster per road user.

Steps: average the points in small squares of the ground, so that a wall of points counts as its outline; cluster the
squares by DBSCAN (Ester, Kriegel, Sander, Xu, KDD 1996), with a neighbourhood that grows with the range, as the
distance between neighbouring beams does. The result does not depend on the order of the points.

Points of several sensors share the squares. The squares of each sensor are clustered by their range from this sensor;
squares of different sensors are linked where they are within the neighbourhood of a near one. All squares that are
linked in either way are one cluster.

Frame: the world's axes, x and y from the sensor (from the first of several), z from the ground, in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from egvs.core.errors import MissingBackendError
from egvs.core.grid import FloatArray, IntArray

SQUARE_M = 0.1
"""Edge of the squares: three standard deviations of a range with a specified accuracy of +-3 cm."""

ONE_SENSOR_M = np.zeros((1, 2))
"""Position of a single sensor: the origin."""

_NO_CLUSTER = -1


@dataclass(frozen=True)
class Density:
    """Parameters of the clustering.

    Attributes
    ----------
    reach_m, reach_per_range
        Largest distance of neighbours; along a beam, this share of the range where that is larger.
    core_squares
        Number of squares within its reach that make a square a core, from which a cluster grows.
    least_points
        Minimum number of points of a cluster.
    """

    reach_m: float = 0.6
    reach_per_range: float = 0.02
    core_squares: int = 1
    least_points: int = 5


@dataclass(frozen=True)
class Clusters:
    """Clusters of points, and of squares of the ground.

    Attributes
    ----------
    points_m
        Points of all clusters, (n, 3) float64, cluster by cluster.
    starts
        Where the points of each cluster start, and where the last one ends, (m + 1,) int64.
    squares_m
        Mean of the points of each square, (s, 2) float64, cluster by cluster.
    square_starts
        As ``starts``, for the squares.
    sensor
        Sensor of each point, (n,) int64.
    """

    points_m: FloatArray
    starts: IntArray
    squares_m: FloatArray
    square_starts: IntArray
    sensor: IntArray

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def cluster_of_point(self) -> IntArray:
        """The cluster of each point, (n,)."""
        return np.repeat(np.arange(len(self)), np.diff(self.starts))

    def with_origin(self, xy_m: FloatArray) -> Clusters:
        """Return the clusters relative to another origin."""
        if not xy_m.any():
            return self
        return replace(self, points_m=self.points_m - np.append(xy_m, 0.0), squares_m=self.squares_m - xy_m)

    @property
    def top_m(self) -> FloatArray:
        """Height of the highest point of each cluster, (m,)."""
        if not len(self):
            return np.empty(0)
        return np.maximum.reduceat(self.points_m[:, 2], self.starts[:-1])


def find_clusters(
    points_m: FloatArray, density: Density, sensor: IntArray | None = None, sensors_m: FloatArray = ONE_SENSOR_M
) -> Clusters:
    """Cluster points.

    Parameters
    ----------
    points_m
        (n, 3).
    density
        Parameters of the clustering.
    sensor
        Sensor of each point, (n,); the only one by default.
    sensors_m
        Positions of the sensors seen from above, (k, 2).

    Raises
    ------
    MissingBackendError
        If scikit-learn is not installed.
    """
    if sensor is None:
        sensor = np.zeros(len(points_m), dtype=np.int64)
    order = np.lexsort((sensor, *points_m.T))
    points_m = points_m[order]
    sensor = sensor[order]
    indices = np.floor(points_m[:, :2] / SQUARE_M).astype(np.int64)
    _, square = np.unique(indices[:, 0] * 2**32 + indices[:, 1], return_inverse=True)
    count = np.bincount(square)
    squares_m = np.column_stack([np.bincount(square, points_m[:, axis]) / count for axis in range(2)])

    label = _label_squares(squares_m, square, sensor, sensors_m, density)
    point_counts = np.bincount(label[square] + 1, minlength=1)[1:]
    label = _drop_small_clusters(label, point_counts, density.least_points)
    points, starts = _rows_by_cluster(label[square])
    squares, square_starts = _rows_by_cluster(label)
    return Clusters(points_m[points], starts, squares_m[squares], square_starts, sensor[points])


def _drop_small_clusters(label: IntArray, point_counts: IntArray, min_points: int) -> IntArray:
    """Return new labels, without the clusters that have fewer points."""
    is_large = point_counts >= min_points
    new_label = np.where(is_large, np.cumsum(is_large) - 1, _NO_CLUSTER)
    return np.append(new_label, _NO_CLUSTER)[label]  # index -1, no cluster, is the last


def _rows_by_cluster(label: IntArray) -> tuple[IntArray, IntArray]:
    """Return the rows of all clusters, cluster by cluster, and where each cluster starts."""
    order = np.argsort(label, kind="stable")
    starts = np.searchsorted(label[order], np.arange(label.max(initial=_NO_CLUSTER) + 2))
    return order[starts[0] :], starts - starts[0]


def _label_squares(
    squares_m: FloatArray, square: IntArray, sensor: IntArray, sensors_m: FloatArray, density: Density
) -> IntArray:
    """Return the cluster of each square, -1 for none; ``square`` and ``sensor`` are those of each point."""
    if len(sensors_m) == 1:
        return _dbscan(_scale_to_reach(squares_m, density), density)
    labels = [_dbscan(squares_m / density.reach_m, density)]
    for number, sensor_m in enumerate(sensors_m):
        rows = np.unique(square[sensor == number])
        label = np.full(len(squares_m), _NO_CLUSTER)
        label[rows] = _dbscan(_scale_to_reach(squares_m[rows] - sensor_m, density), density)
        labels.append(label)
    return _merge_labels(labels)


def _merge_labels(labels: list[IntArray]) -> IntArray:
    """Merge several labellings: squares that share a cluster in any, directly or through others, are one cluster."""
    count = len(labels[0])
    if not count:
        return labels[0]
    # A graph of squares and clusters, with an edge from each square to its cluster of each labelling.
    first_node = count + np.cumsum([0, *(label.max(initial=_NO_CLUSTER) + 1 for label in labels)])
    labelled_squares = [np.flatnonzero(label >= 0) for label in labels]
    nodes = [label[rows] + first for label, rows, first in zip(labels, labelled_squares, first_node[:-1], strict=True)]
    squares = np.concatenate(labelled_squares)
    edges = (squares, np.concatenate(nodes))
    graph = coo_array((np.ones(len(squares), dtype=np.int8), edges), shape=(first_node[-1], first_node[-1]))
    component = connected_components(graph, directed=False)[1]
    merged = np.full(count, _NO_CLUSTER)
    inside = np.unique(squares)
    merged[inside] = np.unique(component[inside], return_inverse=True)[1]
    return merged


def _dbscan(positions: FloatArray, density: Density) -> IntArray:
    """Return the cluster of each position, -1 for none; neighbours are at most 1 apart."""
    if not len(positions):
        return np.empty(0, dtype=np.int64)
    dbscan = _dbscan_class()(eps=1.0, min_samples=density.core_squares, algorithm="kd_tree")
    label: IntArray = dbscan.fit_predict(positions).astype(np.int64)
    return label


def _scale_to_reach(xy_m: FloatArray, density: Density) -> FloatArray:
    """Return positions in which a distance of 1 is the reach at the range of each."""
    range_m = np.maximum(np.hypot(xy_m[:, 0], xy_m[:, 1]), 1e-9)
    growth_start_m = density.reach_m / density.reach_per_range
    near = range_m / density.reach_m
    far = (1.0 + np.log(range_m / growth_start_m)) / density.reach_per_range
    scaled_range = np.where(range_m > growth_start_m, far, near)
    return xy_m * (scaled_range / range_m)[:, None]


def _dbscan_class() -> Any:
    try:
        from sklearn.cluster import DBSCAN
    except ImportError as error:
        problem = f"the detector cluster cannot start: {error}"
        raise MissingBackendError(f"{problem}. Install scikit-learn: pip install 'egvs[validate]'") from error
    return DBSCAN
