"""Puts the new points of a sweep into clusters, one a road user where it goes well.

Steps: points are averaged over small squares of the ground, so that a wall of points counts as its outline; squares are
clustered by DBSCAN (Ester, Kriegel, Sander, Xu, KDD 1996), with a reach that grows with the range as the distance
between two beams does. The result does not depend on the order of the points.

Frame: the world's axes, x and y from the sensor, z from the ground, in metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.core.errors import MissingBackendError

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
    """

    points_m: Floats
    starts: Ints
    squares_m: Floats
    square_starts: Ints

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def of_point(self) -> Ints:
        """The cluster of each point, (n,)."""
        return np.repeat(np.arange(len(self)), np.diff(self.starts))

    @property
    def top_m(self) -> Floats:
        """The highest point of each cluster, (m,)."""
        if not len(self):
            return np.empty(0)
        found: Floats = np.maximum.reduceat(self.points_m[:, 2], self.starts[:-1])
        return found


def clusters_of(points_m: Floats, density: Density) -> Clusters:
    """Cluster points (n, 3).

    Raises
    ------
    MissingBackendError
        When scikit-learn is not installed.
    """
    points_m = points_m[np.lexsort(points_m.T)]
    ids = np.floor(points_m[:, :2] / SQUARE_M).astype(np.int64)
    _, square = np.unique(ids[:, 0] * 2**32 + ids[:, 1], return_inverse=True)
    count = np.bincount(square)
    squares_m = np.column_stack([np.bincount(square, points_m[:, axis]) / count for axis in range(2)])
    label = _dbscan(squares_m, density)
    label = _large_ones(label, np.bincount(label[square] + 1, minlength=1)[1:], density.least_points)
    points, starts = _in_order(label[square])
    squares, square_starts = _in_order(label)
    return Clusters(points_m[points], starts, squares_m[squares], square_starts)


def _large_ones(label: Ints, points: Ints, least: int) -> Ints:
    """Labels counted anew, without the clusters that have fewer points."""
    large = points >= least
    anew = np.append(np.where(large, np.cumsum(large) - 1, _NO_CLUSTER), _NO_CLUSTER)
    found: Ints = anew[label]  # no cluster is the last
    return found


def _in_order(label: Ints) -> tuple[Ints, Ints]:
    """The rows of all clusters, one after the other, and where each begins."""
    order = np.argsort(label, kind="stable")
    starts = np.searchsorted(label[order], np.arange(label.max(initial=_NO_CLUSTER) + 2))
    return order[starts[0] :], starts - starts[0]


def _dbscan(squares_m: Floats, density: Density) -> Ints:
    """The cluster of each square, -1 for none."""
    if not len(squares_m):
        return np.empty(0, dtype=np.int64)
    found: Ints = _scikit_learn()(eps=1.0, min_samples=density.core_squares, algorithm="kd_tree").fit_predict(
        _warped(squares_m, density)
    )
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
