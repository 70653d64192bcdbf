"""Puts the new points of a sweep into clusters, one a road user where it goes well.

Steps: points are averaged over small squares of the ground, so that a wall of points counts as its outline; squares are
clustered by DBSCAN (Ester, Kriegel, Sander, Xu, KDD 1996), with a reach that grows with the range as the distance
between two beams does. The result does not depend on the order of the points.

Points of several sensors share the squares. Each sensor's squares are clustered by its own range; squares of different
sensors belong together where they are neighbours within the reach of a near one; what is linked either way is one.

Frame: the world's axes, x and y from the sensor (of several, from the first), z from the ground, in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from egvs.core.errors import MissingBackendError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SQUARE_M = 0.1
"""Edge of the squares: three standard deviations of a range whose maker says +-3 cm."""

_NO_CLUSTER = -1


@dataclass(frozen=True)
class Density:
    """What makes a cluster.

    Attributes
    ----------
    reach_m, reach_per_range
        How far apart neighbours may be: a distance, along a beam more where this share of the range is more.
    core_squares
        How many squares with points make a square within their reach a core, from which a cluster grows.
    least_points
        Of a cluster; one with fewer is left out.
    """

    reach_m: float = 0.6
    reach_per_range: float = 0.02
    core_squares: int = 1
    least_points: int = 5


@dataclass(frozen=True)
class Clusters:
    """Clusters of points, and of the squares of the ground that they stand on.

    Attributes
    ----------
    points_m
        Of all clusters, (n, 3) float64, cluster after cluster.
    starts
        Where the points of each cluster begin, and where the last end, (m + 1,) int64.
    squares_m
        Mean of the points of each square, (s, 2) float64, cluster after cluster.
    square_starts
        As ``starts``, of the squares.
    sensor
        Which sensor each point is of, (n,) int64.
    """

    points_m: Floats
    starts: Ints
    squares_m: Floats
    square_starts: Ints
    sensor: Ints

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def of_point(self) -> Ints:
        """The cluster of each point, (n,)."""
        return np.repeat(np.arange(len(self)), np.diff(self.starts))

    def from_position(self, at_m: Floats) -> Clusters:
        """The same as seen from another place, its x, y from here."""
        if not at_m.any():
            return self
        return replace(self, points_m=self.points_m - np.append(at_m, 0.0), squares_m=self.squares_m - at_m)

    @property
    def top_m(self) -> Floats:
        """The highest point of each cluster, (m,)."""
        if not len(self):
            return np.empty(0)
        found: Floats = np.maximum.reduceat(self.points_m[:, 2], self.starts[:-1])
        return found


ONE_SENSOR_M = np.zeros((1, 2))
"""Where a single sensor is: at the origin."""


def find_clusters(
    points_m: Floats, density: Density, sensor: Ints | None = None, sensors_m: Floats = ONE_SENSOR_M
) -> Clusters:
    """Cluster points (n, 3).

    Parameters
    ----------
    sensor
        Which sensor each point is of, (n,); the only one when None.
    sensors_m
        Where sensors are in plan, (k, 2).

    Raises
    ------
    MissingBackendError
        When scikit-learn is not installed.
    """
    sensor = np.zeros(len(points_m), dtype=np.int64) if sensor is None else sensor
    order = np.lexsort((sensor, *points_m.T))
    points_m, sensor = points_m[order], sensor[order]
    ids = np.floor(points_m[:, :2] / SQUARE_M).astype(np.int64)
    _, square = np.unique(ids[:, 0] * 2**32 + ids[:, 1], return_inverse=True)
    count = np.bincount(square)
    squares_m = np.column_stack([np.bincount(square, points_m[:, axis]) / count for axis in range(2)])
    label = _label_squares(squares_m, square, sensor, sensors_m, density)
    label = _drop_small_clusters(label, np.bincount(label[square] + 1, minlength=1)[1:], density.least_points)
    points, starts = _rows_by_cluster(label[square])
    squares, square_starts = _rows_by_cluster(label)
    return Clusters(points_m[points], starts, squares_m[squares], square_starts, sensor[points])


def _drop_small_clusters(label: Ints, points: Ints, least: int) -> Ints:
    """Labels counted anew, without the clusters that have fewer points."""
    large = points >= least
    anew = np.append(np.where(large, np.cumsum(large) - 1, _NO_CLUSTER), _NO_CLUSTER)
    found: Ints = anew[label]  # no cluster is the last
    return found


def _rows_by_cluster(label: Ints) -> tuple[Ints, Ints]:
    """The rows of all clusters, one after the other, and where each begins."""
    order = np.argsort(label, kind="stable")
    starts = np.searchsorted(label[order], np.arange(label.max(initial=_NO_CLUSTER) + 2))
    return order[starts[0] :], starts - starts[0]


def _label_squares(squares_m: Floats, square: Ints, sensor: Ints, sensors_m: Floats, density: Density) -> Ints:
    """The cluster of each square, -1 for none; ``square`` and ``sensor`` are those of each point."""
    if len(sensors_m) == 1:
        return _dbscan(_warped(squares_m, density), density)
    linked = [_dbscan(squares_m / density.reach_m, density)]
    for number, at_m in enumerate(sensors_m):
        rows = np.unique(square[sensor == number])
        label = np.full(len(squares_m), _NO_CLUSTER)
        label[rows] = _dbscan(_warped(squares_m[rows] - at_m, density), density)
        linked.append(label)
    return _merge_labels(linked)


def _merge_labels(labels: list[Ints]) -> Ints:
    """Clusters of those that share a cluster of any of several labellings, directly or through others; -1 for none."""
    count = len(labels[0])
    if not count:
        return labels[0]
    first = count + np.cumsum([0, *(label.max(initial=_NO_CLUSTER) + 1 for label in labels)])
    ends = [np.flatnonzero(label >= 0) for label in labels]
    squares = np.concatenate(ends)
    nodes = np.concatenate([label[rows] + start for label, rows, start in zip(labels, ends, first[:-1], strict=True)])
    links = coo_array((np.ones(len(squares), dtype=np.int8), (squares, nodes)), shape=(first[-1], first[-1]))
    found = np.full(count, _NO_CLUSTER)
    inside = np.unique(squares)
    found[inside] = np.unique(connected_components(links, directed=False)[1][inside], return_inverse=True)[1]
    return found


def _dbscan(places: Floats, density: Density) -> Ints:
    """The cluster of each place where a distance of 1 is the reach, -1 for none."""
    if not len(places):
        return np.empty(0, dtype=np.int64)
    found: Ints = _scikit_learn()(eps=1.0, min_samples=density.core_squares, algorithm="kd_tree").fit_predict(places)
    return found.astype(np.int64)


def _warped(xy_m: Floats, density: Density) -> Floats:
    """Places where a distance of 1 is the reach."""
    range_m = np.maximum(np.hypot(xy_m[:, 0], xy_m[:, 1]), 1e-9)
    grows_from_m = density.reach_m / density.reach_per_range
    there = range_m / density.reach_m
    there = np.where(range_m > grows_from_m, (1.0 + np.log(range_m / grows_from_m)) / density.reach_per_range, there)
    found: Floats = xy_m * (there / range_m)[:, None]
    return found


def _scikit_learn() -> Any:
    try:
        from sklearn.cluster import DBSCAN
    except ImportError as error:
        right = "pip install 'egvs[validate]' brings scikit-learn"
        raise MissingBackendError(f"the detector cluster cannot start: {error}; {right}") from error
    return DBSCAN
