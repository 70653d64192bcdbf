"""Occupied voxels of recorded traffic, and warnings about empty regions and traffic inside solids.

A voxel is occupied in a frame if a vehicle's box, made 0.1 mm smaller on each side, shares positive volume with it.
The Traffic Probabilistic Occupancy Grid (arXiv 2504.06772, section III) is :math:`p(v) = c(v) / T`, with :math:`c(v)`
the sum of counts over blocks and :math:`T` the number of frames. A voxel that static geometry fills has p = 1 and so no
entropy; it is left out. The memory that is needed, for the counters of one block and one batch of frames, does not
depend on the number of frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts import parquet
from egvs.artefacts.frame_boxes import NON_VEHICLE_KINDS, FrameBoxes
from egvs.core.errors import Diagnostic
from egvs.core.grid import BoolArray, FloatArray, Grid, IntArray
from egvs.core.wording import format_percent
from egvs.kernels import occupancy
from egvs.scenario.model import SCENARIO_FILE
from egvs.world import clearances
from egvs.world.mesh import World

_MAX_SHARE_IN_GROUND = 0.25
"""On a slope, voxels that the ground cuts are both solid and below vehicles; more than this means a wrong height."""


class BlockCounts(NamedTuple):
    """Frames in which each voxel is occupied, (nx, ny, nz) int32; boxes near the grid by frame, (frames,) int64."""

    counts: NDArray[np.int32]
    boxes_per_frame: IntArray


def count_occupancy(batch: FrameBoxes, grid: Grid, frames: int) -> NDArray[np.int32]:
    """Return in how many frames each voxel is occupied, (nx, ny, nz) int32.

    ``batch`` holds the boxes (grid frame) of frames 0 to frames - 1.
    """
    return next(count_blocks(iter([batch]), grid, frames, 1)).counts


def count_blocks(batches: Iterator[FrameBoxes], grid: Grid, block_frames: int, blocks: int) -> Iterator[BlockCounts]:
    """Count the occupancy of one block of ``block_frames`` frames after another."""
    nx, ny, nz = grid.shape
    shape = np.asarray(grid.shape, dtype=np.int64)
    steps = np.zeros((nz + 1, nx, ny), dtype=np.int32)
    last_frame = np.full((3, nx, ny), -1, dtype=np.int64)
    batch = FrameBoxes(np.empty(0, dtype=np.int64), np.empty((0, 8)))
    for block in range(blocks):
        start, end = block * block_frames, (block + 1) * block_frames
        boxes_per_frame = np.zeros(block_frames, dtype=np.int64)
        steps[:] = 0
        while True:
            in_block = int(np.searchsorted(batch.frame, end))
            near = near_grid(batch.values[:in_block], grid)
            frame = batch.frame[:in_block][near]
            boxes_per_frame += np.bincount(frame - start, minlength=block_frames)
            occupancy.count_boxes(frame, batch.values[:in_block][near], shape, grid.voxel_m, steps, last_frame)

            batch = FrameBoxes(batch.frame[in_block:], batch.values[in_block:])
            if len(batch.frame):
                break  # the rest belongs to later blocks
            next_batch = next(batches, None)
            if next_batch is None:
                break
            batch = next_batch
        occupancy.sum_layers(steps)
        yield BlockCounts(np.ascontiguousarray(steps[:-1].transpose(1, 2, 0)), boxes_per_frame)


def near_grid(values: FloatArray, grid: Grid) -> BoolArray:
    """Return which boxes (n, 8), as ``FrameBoxes.values``, have a circumscribed ball that meets the grid."""
    radius = 0.5 * np.sqrt((values[:, 5:8] ** 2).sum(axis=1))
    centre = values[:, :3]
    size = np.asarray(grid.roi.size_m)
    near: BoolArray = ((centre + radius[:, None] > 0) & (centre - radius[:, None] < size)).all(axis=1)
    return near


def static_voxels(world: World, grid: Grid) -> BoolArray:
    """Return the voxels that static geometry fills, wholly or in part (deeper than 0.1 mm), (nx, ny, nz) bool."""
    shape = np.asarray(grid.shape, dtype=np.int64)
    triangles = grid.to_grid_m(world.triangles_m)

    # A winding number needs the triangles above the grid too, so only their plan is compared.
    corners = triangles[:, :, :2]
    size = np.asarray(grid.roi.size_m)[:2]
    near = ((corners.max(axis=1) >= 0) & (corners.min(axis=1) <= size)).all(axis=1)

    filled = np.zeros(grid.shape, dtype=np.bool_)
    occupancy.mark_triangle_voxels(triangles[near], shape, grid.voxel_m, filled)

    closed = near & world.closed[world.solid_of_face]
    signs = world.signs[world.solid_of_face[closed]]
    winding = np.zeros((*grid.shape[:2], grid.shape[2] + 1), dtype=np.int32)
    occupancy.add_winding_numbers(triangles[closed], signs, shape, grid.voxel_m, winding)
    filled |= np.cumsum(winding, axis=2)[:, :, :-1] != 0
    return filled


def has_people(trajectories: Path) -> bool:
    """Return whether boxes of ``trajectories.parquet`` are people on foot or on bicycles."""
    table, _ = parquet.read_artefact(trajectories, "trajectories", ["kind"])
    return not NON_VEHICLE_KINDS.isdisjoint(table.column("kind").unique().to_pylist())


def warn_empty_region(boxes: float, trajectories: Path, *, people: bool = False) -> Iterator[Diagnostic]:
    """Warn where fewer than two vehicles are in the region of interest on average; with ``people``, road users.

    Where there is none at all, the warning says where ``trajectories.parquet`` has vehicles instead.
    """
    rule, noun = "traffic in the region", "road user" if people else "vehicle"
    if boxes >= clearances.MIN_MEAN_VEHICLES:
        return
    if boxes == 0:
        problem = f"no {noun} ever enters the region{_traffic_extent(trajectories)}: the sites cannot be ranked"
        hint = "Move the region to where vehicles drive, add traffic, or check that both use the same coordinates."
        yield Diagnostic(rule, "roi", problem, hint)
    else:
        count = f"{boxes:.2g}"
        vehicles = f"1 {noun} is" if count == "1" else f"{count} {noun}s are"
        problem = f"{vehicles} in the region on average, so the ranking is based on very little traffic"
        hint = "If the streets are busier, correct [traffic]; otherwise record longer (traffic.frames)."
        yield Diagnostic(rule, "roi", problem, hint)


def _traffic_extent(trajectories: Path) -> str:
    """Return the extent of recorded vehicles as text; empty without vehicles."""
    table, _ = parquet.read_artefact(trajectories, "trajectories", ["x_m", "y_m"])
    if not table.num_rows:
        return ""
    x, y = table.column("x_m").to_numpy(), table.column("y_m").to_numpy()
    return f", all are between ({x.min():.0f}, {y.min():.0f}) and ({x.max():.0f}, {y.max():.0f})"


def warn_empty_periods(boxes: Mapping[str, float]) -> Iterator[Diagnostic]:
    """Warn about each period without a vehicle in the region, where another has some; boxes per frame by period."""
    if not any(boxes.values()):
        return
    for period, mean in boxes.items():
        if mean == 0:
            yield Diagnostic(
                "traffic in the region",
                f"{SCENARIO_FILE}: traffic.periods ({period})",
                "no vehicle ever enters the region of interest: the period only lowers the entropy of the mix",
                "Check that all periods use the same coordinates and that their traffic passes through the region.",
            )


def warn_traffic_through_solids(
    hidden: IntArray, visible: int, voxels: IntArray, grid: Grid, world: World
) -> Iterator[Diagnostic]:
    """Warn where vehicles occupy voxels that static geometry fills.

    Parameters
    ----------
    hidden
        Number of frames in which each voxel that static geometry fills is occupied, (k,).
    visible
        The same, summed over all other voxels.
    voxels
        Flat index of the voxels that static geometry fills, (k,).
    grid, world
        Grid of the voxels, and static geometry.
    """
    share = int(hidden.sum()) / max(1, int(hidden.sum()) + visible)
    if share <= clearances.MAX_SHARE_IN_SOLIDS:
        return
    worst = np.array(np.unravel_index(voxels[int(np.argmax(hidden))], grid.shape))
    at_m = np.asarray(grid.origin_m) + (worst + 0.5) * grid.voxel_m
    solid = _solid_at(world, at_m, grid.voxel_m)
    if not solid and share <= _MAX_SHARE_IN_GROUND:
        return
    point = ", ".join(f"{value:.1f}" for value in at_m)
    problem = f"{format_percent(share)} of the volume that vehicles occupy is inside solids, most often at ({point})"
    if solid:
        problem += f", in {solid}"
    yield Diagnostic("traffic through solids", "statics", problem, "Move the solids, or check the coordinates of both.")


def _solid_at(world: World, at_m: FloatArray, within_m: float) -> str:
    """Return the first solid with a triangle within a distance of a point along each axis; empty without one."""
    corners = world.triangles_m
    near = (corners.min(axis=1) <= at_m + within_m).all(axis=1) & (corners.max(axis=1) >= at_m - within_m).all(axis=1)
    for solid in np.unique(world.solid_of_face[near]):
        name, kind = world.solids[solid]
        if kind != "ground":
            return f"{name} ({kind})"
    return ""
