"""Columns of voxels by lane, in bins along it, and the distance of two distributions over them.

World frame, metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from egvs.core.grid import FloatArray, Grid, IntArray
from egvs.scoring.road_locations import LANE, TURN, RoadLocations, disambiguate
from egvs.traffic import network

BIN_M = 2.5
"""Length of a bin along a lane."""

MIN_BINS = 3
"""A lane with fewer bins in the region is left out."""


@dataclass(frozen=True, eq=False)
class LaneBins:
    """Columns of the grid by lane.

    Attributes
    ----------
    lane
        Lane of each column, an index into ``names``, (nx * ny,) int64; -1 for none.
    bin
        Bin of each column, numbered over all lanes, (nx * ny,) int64; -1 for none.
    lane_of_bin
        Lane of each bin.
    names, words
        Id and description of each lane.
    """

    lane: IntArray
    bin: IntArray
    lane_of_bin: IntArray
    names: tuple[str, ...]
    words: tuple[str, ...]


def column_centres_m(grid: Grid) -> FloatArray:
    """Return x, y of the middle of each column, (nx * ny, 2), world frame."""
    axes = [grid.origin_m[axis] + (np.arange(grid.shape[axis]) + 0.5) * grid.voxel_m for axis in (0, 1)]
    return np.column_stack([values.ravel() for values in np.meshgrid(*axes, indexing="ij")])


def lane_bins(roads: network.Network, grid: Grid, covered: FloatArray) -> LaneBins:
    """Assign the columns of a grid to lanes and bins.

    Parameters
    ----------
    roads
        The network.
    grid
        The grid.
    covered
        1 for columns that count, (nx * ny,).
    """
    locations = RoadLocations.of(roads, grid.roi)
    centres_m = column_centres_m(grid)
    lane = np.full(len(centres_m), -1, dtype=np.int64)
    along_m = np.full(len(centres_m), np.nan)
    nearest_m = np.full(len(centres_m), np.inf)
    owners = []
    for number, middle in enumerate(locations.lanes):
        owner = locations.locations_of_lane[number][0]
        owners.append(owner if locations.locations[owner].by in (LANE, TURN) else -1)
        line = shapely.LineString(middle.points_m)
        low_m, high_m = middle.points_m.min(axis=0) - middle.width_m, middle.points_m.max(axis=0) + middle.width_m
        near = np.flatnonzero(((centres_m >= low_m) & (centres_m <= high_m)).all(axis=1) & (covered > 0))
        if not near.size or line.length == 0.0:
            continue
        points = shapely.points(centres_m[near])
        distance_m = shapely.distance(line, points)
        better = (distance_m <= middle.width_m / 2.0) & (distance_m < nearest_m[near])
        lane[near[better]], nearest_m[near[better]] = number, distance_m[better]
        along_m[near[better]] = shapely.line_locate_point(line, points[better])

    location = np.where(lane >= 0, np.array([*owners, -1])[lane], -1)
    located = np.flatnonzero(location >= 0)
    keys = np.column_stack([location[located], lane[located], np.floor(along_m[located] / BIN_M)]).astype(np.int64)
    unique, number_of = np.unique(keys, axis=0, return_inverse=True)
    used, lane_of_bin, counts = np.unique(unique[:, 0], return_inverse=True, return_counts=True)
    is_long = counts[lane_of_bin] >= MIN_BINS
    new_bin = np.where(is_long, np.cumsum(is_long) - 1, -1)
    long_enough = np.flatnonzero(counts >= MIN_BINS)
    new_lane = np.full(used.size, -1, dtype=np.int64)
    new_lane[long_enough] = np.arange(long_enough.size)
    column_lane, column_bin = np.full(lane.size, -1, dtype=np.int64), np.full(lane.size, -1, dtype=np.int64)
    column_bin[located] = new_bin[number_of.ravel()]
    column_lane[located] = new_lane[lane_of_bin][number_of.ravel()]
    described = disambiguate([locations.locations[index] for index in used[long_enough]])
    return LaneBins(
        column_lane, column_bin, new_lane[lane_of_bin][is_long],
        tuple(each.name for each in described), tuple(each.words for each in described),
    )  # fmt: skip


def sum_groups(values: FloatArray, group: IntArray, n_groups: int) -> FloatArray:
    sums = np.zeros((n_groups, values.shape[1]))
    np.add.at(sums, group, values)
    return sums


def mean_groups(values: FloatArray, group: IntArray, n_groups: int) -> FloatArray:
    return sum_groups(values, group, n_groups) / np.bincount(group, minlength=n_groups)[:, None]


def lane_distances(first: FloatArray, second: FloatArray, lane_of_bin: IntArray) -> FloatArray:
    """Return the Jensen-Shannon distance of each lane, (n_lanes, m); NaN for a lane without traffic.

    Parameters
    ----------
    first, second
        Occupancy of the bins, (n_bins, m) each.
    lane_of_bin
        Lane of each bin, (n_bins,).
    """
    n_lanes = int(lane_of_bin.max(initial=-1)) + 1
    with np.errstate(divide="ignore", invalid="ignore"):
        p, q = (values / sum_groups(values, lane_of_bin, n_lanes)[lane_of_bin] for values in (first, second))
        middle = (p + q) / 2.0
        terms = [np.where(part == 0.0, 0.0, part * np.log2(part / middle)) for part in (p, q)]
    divergence = sum_groups((terms[0] + terms[1]) / 2.0, lane_of_bin, n_lanes)
    return np.sqrt(np.clip(divergence, 0.0, 1.0))
