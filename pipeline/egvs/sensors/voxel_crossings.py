"""Voxels that each beam of a scan crosses, with the ranges at which the beam enters and leaves them.

Counting hits is not enough where an effect says what share of a beam reaches a voxel: every crossing is listed with its
range. Crossings come in blocks of some ten thousand, so that a block stays in the processor's cache.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from egvs.core.grid import FloatArray, Grid, IntArray, Vec3
from egvs.kernels import hits

_MAX_CROSSINGS = 2**16  # upper bound of a block, which bounds the memory; about a third of it is used


@dataclass(frozen=True)
class Crossings:
    """Crossings of some beam pieces of one site, piece after piece, in order of range.

    Attributes
    ----------
    sensor_m
        The sensor in the grid frame, (3,) float64.
    grid
        The grid of the voxels.
    rows
        The pieces, as a slice of the scan's rows.
    first
        Crossings first[i] to first[i + 1] belong to piece i, (rows + 1,) int64.
    ends_m
        End of each piece relative to the sensor, (rows, 3) float64.
    cells
        Flat index of the voxel of each crossing, (k,) int64.
    enter_m, leave_m
        Range from the sensor where the piece enters and leaves the voxel, (k,) float64.
    """

    sensor_m: FloatArray
    grid: Grid
    rows: slice
    first: IntArray
    ends_m: FloatArray
    cells: IntArray
    enter_m: FloatArray
    leave_m: FloatArray

    @property
    def piece(self) -> IntArray:
        """Piece of each crossing, (k,) int64, from 0."""
        return np.repeat(np.arange(len(self.first) - 1), np.diff(self.first))


@dataclass(frozen=True)
class TransmittanceSteps:
    """Ranges at which the transmitted share of beam pieces drops; it is 1 at the sensor.

    Attributes
    ----------
    rows
        Row of the scan of each piece, (n,) int64.
    first
        Drops first[i] to first[i + 1] belong to piece rows[i], (n + 1,) int64.
    range_m
        Range from the sensor of each drop, ascending along a piece, (k,) float64.
    share
        Share of the beam that reaches voxels entered beyond that range, (k,) float64.
    """

    rows: IntArray
    first: IntArray
    range_m: FloatArray
    share: FloatArray


def list_crossings(position_m: Vec3, ends_m: FloatArray, grid: Grid) -> Iterator[Crossings]:
    """Yield all crossings of the beams of a sensor, a few thousand beams at a time.

    Parameters
    ----------
    position_m
        The sensor in the world frame, metres.
    ends_m
        End of each beam relative to the sensor, along the world axes, (n, 3) float64.
    grid
        The grid of the voxels.
    """
    sensor_m = grid.to_grid_m(np.array(position_m))
    o, d = grid.segments(position_m, ends_m)
    shape = np.asarray(grid.shape, dtype=np.int64)
    max_per_beam = sum(grid.shape)
    step = max(1, _MAX_CROSSINGS // max_per_beam)
    for start in range(0, len(ends_m), step):
        rows = slice(start, min(start + step, len(ends_m)))
        ends = ends_m[rows]
        capacity = len(ends) * max_per_beam
        first = np.empty(len(ends) + 1, dtype=np.int64)
        cells = np.empty(capacity, dtype=np.int64)
        enter = np.empty(capacity)
        leave = np.empty(capacity)
        hits.list_crossings(o, d[rows], shape, grid.voxel_m, first, cells, enter, leave)
        total = int(first[-1])
        yield Crossings(sensor_m, grid, rows, first, ends, cells[:total], enter[:total], leave[:total])
