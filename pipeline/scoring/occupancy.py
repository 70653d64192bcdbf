r"""Counts in how many frames each voxel is occupied.

A voxel is occupied at a frame when a vehicle's box, made 0.1 mm smaller on each side, shares positive volume with it.
The Traffic Probabilistic Occupancy Grid (arXiv 2504.06772, section III) is :math:`p(v) = c(v) / T`, with :math:`c(v)`
the sum of counts over blocks and :math:`T` the number of frames. A voxel that static geometry fills has p = 1 and so no
entropy; it is left out.

Memory holds one block's counters and one batch of frames, however many frames there are.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.recorded_boxes import FrameBoxes
from pipeline.core.grid import Grid
from pipeline.kernels import boxes, solids
from pipeline.world.mesh import World


def count(batch: FrameBoxes, grid: Grid, frames: int) -> NDArray[np.int32]:
    """In how many frames each voxel is occupied, (nx, ny, nz) int32, for boxes (grid frame) of frames 0 .. frames -
    1."""
    counts, _ = next(count_blocks(iter([batch]), grid, frames, 1))
    return counts


def static_voxels(world: World, grid: Grid) -> NDArray[np.bool_]:
    """The voxels that static geometry fills, wholly or in part (deeper than 0.1 mm), (nx, ny, nz) bool."""
    shape = np.asarray(grid.shape, dtype=np.int64)
    triangles = grid.to_grid_m(world.triangles_m)
    near = _near(triangles, grid)
    filled = np.zeros(grid.shape, dtype=np.bool_)
    solids.touch(triangles[near], shape, grid.voxel_m, filled)
    closed = near & world.closed[world.solid_of_face]
    winding = np.zeros((*grid.shape[:2], grid.shape[2] + 1), dtype=np.int32)
    solids.wind(triangles[closed], world.signs[world.solid_of_face[closed]], shape, grid.voxel_m, winding)
    filled |= np.cumsum(winding, axis=2)[:, :, :-1] != 0
    return filled


def _near(triangles: NDArray[np.float64], grid: Grid) -> NDArray[np.bool_]:
    """Triangles above, below or in the grid (a winding number needs those above)."""
    size = np.asarray(grid.roi.size_m)[:2]
    corners = triangles[:, :, :2]
    near: NDArray[np.bool_] = ((corners.max(axis=1) >= 0) & (corners.min(axis=1) <= size)).all(axis=1)
    return near


def count_blocks(
    batches: Iterator[FrameBoxes], grid: Grid, block_frames: int, blocks: int
) -> Iterator[tuple[NDArray[np.int32], NDArray[np.int64]]]:
    """The counts (nx, ny, nz) of one block after another, and how many boxes were near the grid in each of its frames,
    (block_frames,)."""
    nx, ny, nz = grid.shape
    shape = np.asarray(grid.shape, dtype=np.int64)
    steps, seen = np.zeros((nz + 1, nx, ny), dtype=np.int32), np.full((3, nx, ny), -1, dtype=np.int64)
    batch = FrameBoxes(np.empty(0, dtype=np.int64), np.empty((0, 8)))
    for block in range(blocks):
        start, end = block * block_frames, (block + 1) * block_frames
        met = np.zeros(block_frames, dtype=np.int64)
        steps[:] = 0
        while True:
            here = int(np.searchsorted(batch.frame, end))
            near = near_grid(batch.values[:here], grid)
            met += np.bincount(batch.frame[:here][near] - start, minlength=block_frames)
            boxes.count_boxes(batch.frame[:here][near], batch.values[:here][near], shape, grid.voxel_m, steps, seen)
            batch = FrameBoxes(batch.frame[here:], batch.values[here:])
            if len(batch.frame):
                break
            following = next(batches, None)
            if following is None:
                break
            batch = following
        boxes.sum_layers(steps)
        yield np.ascontiguousarray(steps[:-1].transpose(1, 2, 0)), met


def near_grid(values: NDArray[np.float64], grid: Grid) -> NDArray[np.bool_]:
    """Boxes whose circumscribed ball meets the grid."""
    reach = 0.5 * np.sqrt((values[:, 5:8] ** 2).sum(axis=1))
    centre, size = values[:, :3], np.asarray(grid.roi.size_m)
    near: NDArray[np.bool_] = ((centre + reach[:, None] > 0) & (centre - reach[:, None] < size)).all(axis=1)
    return near
