"""Lists which voxels each beam of a scan crosses, and at which range.

Where an effect says what gets as far as a voxel, counting is not enough: every crossing is listed with its range, some
ten thousand at a time, so that they stay near the processor.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.core.grid import Grid
from pipeline.kernels import crossings as kernels

_ROOM = 2**16  # crossings that are listed at once at most: bounds the memory; about a third of it is used


@dataclass(frozen=True)
class Crossings:
    """Crossings of some beam pieces of one site, piece after piece, along each.

    Attributes
    ----------
    sensor_m
        Where the sensor is in the grid's frame, (3,) float64.
    grid
        The grid of the voxels.
    rows
        Which pieces of the scan these are, as a slice of its rows.
    first
        Crossings first[i] to first[i + 1] belong to piece i, (rows + 1,) int64.
    ends_m
        Where each piece ends seen from the sensor, (rows, 3) float64.
    cells
        Flat index of the voxel of each crossing, (k,) int64.
    enter_m, leave_m
        Range from the sensor where the piece enters and leaves the voxel, (k,) float64.
    """

    sensor_m: NDArray[np.float64]
    grid: Grid
    rows: slice
    first: NDArray[np.int64]
    ends_m: NDArray[np.float64]
    cells: NDArray[np.int64]
    enter_m: NDArray[np.float64]
    leave_m: NDArray[np.float64]

    @property
    def piece(self) -> NDArray[np.int64]:
        """The piece of each crossing, (k,) int64, from 0."""
        return np.repeat(np.arange(len(self.first) - 1), np.diff(self.first))


@dataclass(frozen=True)
class Falls:
    """Where the shares of some beam pieces fall: 1 at the sensor, less behind each fall.

    Attributes
    ----------
    rows
        Which pieces of the scan these are, (n,) int64.
    first
        Falls first[i] to first[i + 1] belong to piece rows[i], (n + 1,) int64.
    range_m, share
        Range from the sensor of each fall, ascending along a piece; the share that gets as far as voxels that are
        entered further away. (k,) float64 each.
    """

    rows: NDArray[np.int64]
    first: NDArray[np.int64]
    range_m: NDArray[np.float64]
    share: NDArray[np.float64]


def listed(position_m: tuple[float, float, float], ends_m: NDArray[np.float64], grid: Grid) -> Iterator[Crossings]:
    """All crossings of the beams of a sensor at ``position_m`` (world frame), a few thousand beams at a time."""
    sensor_m = grid.to_grid_m(np.array(position_m))
    o, d = grid.segments(position_m, ends_m)
    shape = np.asarray(grid.shape, dtype=np.int64)
    step = max(1, _ROOM // sum(grid.shape))
    for start in range(0, len(ends_m), step):
        rows = slice(start, min(start + step, len(ends_m)))
        ends = ends_m[rows]
        first, room = np.empty(len(ends) + 1, dtype=np.int64), len(ends) * sum(grid.shape)
        cells, enter, leave = np.empty(room, dtype=np.int64), np.empty(room), np.empty(room)
        kernels.crossings(o, d[rows], shape, grid.voxel_m, first, cells, enter, leave)
        total = int(first[-1])
        yield Crossings(sensor_m, grid, rows, first, ends, cells[:total], enter[:total], leave[:total])
