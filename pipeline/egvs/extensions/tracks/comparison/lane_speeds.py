r"""Speeds of vehicles by lane, and the distance of two distributions of them.

The speed of a vehicle is the distance between two of its positions, the same time apart in both runs, divided by that
time; it counts for the lane at which the middle of the two lies. Each frame counts once, so a vehicle that stands
counts for as long as it stands.

- **Distance**: the Wasserstein distance of order 1 between the two distributions, the mean difference of their
  quantiles, m/s, with their cumulative distributions F and F':

  .. math:: W = \int \left| F(v) - F'(v) \right| \, dv

Speeds are counted in bins of :data:`BIN_M_S`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.compute as pc

from egvs.artefacts import traffic_frames
from egvs.artefacts.frame_boxes import NON_VEHICLE_KINDS
from egvs.core.grid import FloatArray, Grid, IntArray
from egvs.extensions.tracks.comparison.lane_bins import LaneBins
from egvs.scoring.standard_errors import BlockGroups

BIN_M_S = 0.5
"""Width of the bins of speeds."""

N_BINS = 140
"""Number of bins; faster vehicles are counted in the last."""

SPEED_INTERVAL_S = 1.0
"""Time between the two positions, or the frame period where that is longer."""

MIN_VEHICLES = 5
"""Lanes with fewer vehicles in one of the runs have no distance."""


@dataclass(frozen=True, eq=False)
class LaneSpeeds:
    """Speeds in one run.

    Attributes
    ----------
    counts
        Number of speeds by lane, bin and group of blocks, (n_lanes, :data:`N_BINS`, k).
    sums_m_s
        Sum of the speeds by lane and group, (n_lanes, k).
    vehicles
        Number of different vehicles on each lane, (n_lanes,).
    """

    counts: IntArray
    sums_m_s: FloatArray
    vehicles: IntArray

    @property
    def n_groups(self) -> int:
        """Number of groups of blocks."""
        return int(self.counts.shape[2])

    def replicates(self) -> FloatArray:
        """Return the counts of all frames, then with each group left out, (n_lanes, :data:`N_BINS`, 1 + k)."""
        total = self.counts.sum(axis=2, keepdims=True)
        return np.concatenate([total, total - self.counts], axis=2).astype(np.float64)

    def means_m_s(self) -> FloatArray:
        """Return the mean speed of each lane in the same form, (n_lanes, 1 + k); NaN without vehicles."""
        total = self.sums_m_s.sum(axis=1, keepdims=True)
        sums = np.hstack([total, total - self.sums_m_s])
        with np.errstate(invalid="ignore", divide="ignore"):
            means: FloatArray = sums / self.replicates().sum(axis=1)
        return means

    def cumulative(self, lane: int) -> FloatArray:
        """Return the share of speeds up to the end of each bin, (:data:`N_BINS`,)."""
        counts = self.counts[lane].sum(axis=1)
        shares: FloatArray = np.cumsum(counts) / counts.sum()
        return shares


def read_lane_speeds(
    path: Path, period_s: float, base_s: float, bins: LaneBins, grid: Grid, groups: BlockGroups
) -> LaneSpeeds:
    """Read the speeds of a run.

    Parameters
    ----------
    path
        ``trajectories.parquet``.
    period_s
        Its frame period.
    base_s
        Time between two positions.
    bins
        The lanes.
    grid
        The grid that they refer to.
    groups
        Groups of blocks, in the order of the frames.
    """
    table = traffic_frames.read_trajectories(path).select(["frame", "vehicle", "part", "kind", "x_m", "y_m"])
    is_vehicle = pc.invert(pc.is_in(table.column("kind"), value_set=pc.cast(sorted(NON_VEHICLE_KINDS), "string")))
    table = table.filter(pc.and_(is_vehicle, pc.equal(table.column("part"), 0)))
    frame = table.column("frame").to_numpy().astype(np.int64)
    vehicle = pc.dictionary_encode(table.column("vehicle")).combine_chunks().indices.to_numpy().astype(np.int64)
    xy_m = np.column_stack([table.column(name).to_numpy() for name in ("x_m", "y_m")]).astype(np.float64)
    steps = max(1, round(base_s / period_s))
    first, second = _pairs(frame, vehicle, steps)
    speed_m_s = np.hypot(*(xy_m[second] - xy_m[first]).T) / (steps * period_s)
    lane = _lanes_at((xy_m[first] + xy_m[second]) / 2.0, bins, grid)
    group = np.searchsorted(np.cumsum(groups.frames), frame[first], side="right")
    used = (lane >= 0) & (group < groups.frames.size)
    lane, group, speed_m_s, vehicle = lane[used], group[used], speed_m_s[used], vehicle[first][used]
    shape = len(bins.names), N_BINS, groups.frames.size
    counts, sums_m_s = np.zeros(shape, dtype=np.int64), np.zeros((shape[0], shape[2]))
    number = np.minimum((speed_m_s / BIN_M_S).astype(np.int64), N_BINS - 1)
    np.add.at(counts, (lane, number, group), 1)
    np.add.at(sums_m_s, (lane, group), speed_m_s)
    different = np.unique(np.column_stack([lane, vehicle]), axis=0)
    return LaneSpeeds(counts, sums_m_s, np.bincount(different[:, 0], minlength=shape[0]))


def speed_distances(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the Wasserstein distance of order 1 of each lane, m/s, (n_lanes, m); NaN for a lane without speeds.

    Parameters
    ----------
    first, second
        Numbers of speeds, (n_lanes, n_bins, m) each.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        cumulative = [np.cumsum(counts, axis=1) / counts.sum(axis=1, keepdims=True) for counts in (first, second)]
    distances: FloatArray = np.abs(cumulative[0] - cumulative[1]).sum(axis=1) * BIN_M_S
    return distances


def _pairs(frame: IntArray, vehicle: IntArray, steps: int) -> tuple[IntArray, IntArray]:
    """Return the rows of each vehicle that are so many frames apart."""
    span = int(frame.max(initial=0)) + steps + 1
    key = vehicle * span + frame
    order = np.argsort(key)
    position = np.minimum(np.searchsorted(key[order], key + steps), max(len(key) - 1, 0))
    following = order[position] if len(key) else order
    has_one = key[following] == key + steps
    return np.flatnonzero(has_one), following[has_one]


def _lanes_at(xy_m: FloatArray, bins: LaneBins, grid: Grid) -> IntArray:
    """Return the lane at each position, -1 for none."""
    cell = np.floor((xy_m - np.array(grid.origin_m[:2])) / grid.voxel_m).astype(np.int64)
    inside = ((cell >= 0) & (cell < np.array(grid.shape[:2]))).all(axis=1)
    lane = np.full(len(xy_m), -1, dtype=np.int64)
    lane[inside] = bins.lane[cell[inside, 0] * grid.shape[1] + cell[inside, 1]]
    return lane


def common_interval_s(periods_s: Sequence[float]) -> float:
    """Return the time between two positions of both runs: at least :data:`SPEED_INTERVAL_S` and each frame period."""
    return max(SPEED_INTERVAL_S, *periods_s)
