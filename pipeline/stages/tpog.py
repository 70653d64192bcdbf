r"""In what share of the frames is each voxel occupied?

Steps: read ``trajectories.parquet`` a few hundred frames at a time; move boxes to the grid's frame; count, block by
block, the frames in which a box shrunk by 0.1 mm shares positive volume with a voxel; leave out the voxels that static
geometry fills; write the sparse counts as ``tpog.parquet``.

The Traffic Probabilistic Occupancy Grid (arXiv 2504.06772, section III) is :math:`p(v) = c(v) / T`, with :math:`c(v)`
the sum of counts over blocks and :math:`T` the number of frames. Blocks are consecutive and of equal length; counts of
several TPOGs on one grid add up. A voxel that static geometry fills has p = 1 and so no entropy; it is left out.

Memory holds one block's counters and one batch of frames, however many frames there are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.artefacts import tables
from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.core.grid import Grid
from pipeline.core.progress import Progress, silent
from pipeline.kernels import boxes, solids
from pipeline.scenario.models import Scenario
from pipeline.stages.base import metadata
from pipeline.world.mesh import World, read_ply

NAME = "tpog"
ARTEFACTS = ("tpog.parquet",)

_BOX = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad", "length_m", "width_m", "height_m")
_SMALLEST_M = 10 * boxes.SHRINK_M


@dataclass(frozen=True)
class Boxes:
    """Vehicle boxes of some whole frames: ``frame`` (n,) int64; ``values`` (n, 8) float64 as the columns in
    ``_BOX``."""

    frame: NDArray[np.int64]
    values: NDArray[np.float64]


def inputs(scenario: Scenario, out: Path) -> dict[str, Any]:
    """Grid and blocks; the trajectories and the statics by hash."""
    return {
        "settings": {
            "name": scenario.name,
            "grid": scenario.roi.grid.to_json(),
            "tpog": scenario.tpog.model_dump(mode="json"),
        },
        "files": {name: files.sha256_of(out / name) for name in ("trajectories.parquet", "statics.ply")},
    }


def run(scenario: Scenario, out: Path, *, jobs: int | None = None, progress: Progress = silent) -> dict[str, Any]:
    """Count occupancy and write ``tpog.parquet``.

    Returns
    -------
    dict
        ``occupied_voxels``, ``static_voxels`` (left out), ``boxes_in_roi`` (mean a frame).
    """
    del jobs
    source = out / "trajectories.parquet"
    world, _ = read_ply(out / "statics.ply")
    read, grid, blocks = inputs(scenario, out), scenario.roi.grid, scenario.tpog.blocks
    frames = int(tables.read_metadata(source, "trajectories")["frames"])
    if frames % blocks:
        raise InputError(
            f"{scenario.file}: tpog.blocks", f"{blocks} does not divide the {frames} frames recorded", "a divisor"
        )
    filled = static_voxels(world, grid)
    block_frames, in_roi, ever = frames // blocks, 0, np.zeros(grid.shape, dtype=np.bool_)
    with tables.writer(out / ARTEFACTS[0], "tpog") as file:
        for block, (counts, met) in enumerate(_blocks(_read(source, grid), grid, block_frames, blocks)):
            counts[filled] = 0
            file.write(_sparse(block, counts))
            ever |= counts > 0
            in_roi += met
            progress("blocks", block + 1, blocks)
        file.describe(metadata(scenario, read, grid=grid.to_json(), frames=frames, block_frames=block_frames))
    return {
        "occupied_voxels": int(ever.sum()),
        "static_voxels": int(filled.sum()),
        "boxes_in_roi": in_roi / frames,
    }


def count(batch: Boxes, grid: Grid, frames: int) -> NDArray[np.int32]:
    """In how many frames each voxel is occupied, (nx, ny, nz) int32, for boxes (grid frame) of frames 0 .. frames -
    1."""
    counts, _ = next(_blocks(iter([batch]), grid, frames, 1))
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


def _blocks(
    batches: Iterator[Boxes], grid: Grid, block_frames: int, blocks: int
) -> Iterator[tuple[NDArray[np.int32], int]]:
    """The counts (nx, ny, nz) of one block after another, and how many boxes were near the grid."""
    nx, ny, nz = grid.shape
    shape = np.asarray(grid.shape, dtype=np.int64)
    steps, seen = np.zeros((nz + 1, nx, ny), dtype=np.int32), np.full((3, nx, ny), -1, dtype=np.int64)
    batch = Boxes(np.empty(0, dtype=np.int64), np.empty((0, 8)))
    for block in range(blocks):
        met, end = 0, (block + 1) * block_frames
        steps[:] = 0
        while True:
            here = int(np.searchsorted(batch.frame, end))
            near = _in_reach(batch.values[:here], grid)
            met += int(near.sum())
            boxes.count_boxes(batch.frame[:here][near], batch.values[:here][near], shape, grid.voxel_m, steps, seen)
            batch = Boxes(batch.frame[here:], batch.values[here:])
            if len(batch.frame):
                break
            following = next(batches, None)
            if following is None:
                break
            batch = following
        boxes.sum_layers(steps)
        yield np.ascontiguousarray(steps[:-1].transpose(1, 2, 0)), met


def _in_reach(values: NDArray[np.float64], grid: Grid) -> NDArray[np.bool_]:
    """Boxes whose circumscribed ball meets the grid."""
    reach = 0.5 * np.sqrt((values[:, 5:8] ** 2).sum(axis=1))
    centre, size = values[:, :3], np.asarray(grid.roi.size_m)
    near: NDArray[np.bool_] = ((centre + reach[:, None] > 0) & (centre - reach[:, None] < size)).all(axis=1)
    return near


def _read(path: Path, grid: Grid) -> Iterator[Boxes]:
    """Boxes of a trajectories file in the grid's frame, row group by row group (each holds whole frames)."""
    with tables.reader(path, "trajectories") as (file, _):
        last = -1
        for group in range(file.num_row_groups):
            table = tables.read_group(file, group, path, ["frame", *_BOX])
            batch = _boxes(table, grid, path)
            if len(batch.frame) == 0:
                continue
            if np.any(np.diff(batch.frame) < 0) or batch.frame[0] <= last:
                raise InputError(path, f"frames are out of order near frame {batch.frame[0]}", "rows sorted by frame")
            last = int(batch.frame[-1])
            yield batch


def _boxes(table: pa.Table, grid: Grid, path: Path) -> Boxes:
    values = np.column_stack([table.column(name).to_numpy() for name in _BOX])
    frame = table.column("frame").to_numpy().astype(np.int64)
    sound = np.isfinite(values).all(axis=1) & (values[:, 5:8] >= _SMALLEST_M).all(axis=1)
    if not sound.all():
        bad = int(np.flatnonzero(~sound)[0])
        shown = ", ".join(f"{name} = {value:g}" for name, value in zip(_BOX, values[bad], strict=True))
        raise InputError(
            f"{path}: frame {frame[bad]}", f"a box with {shown}", f"finite values, sizes of at least {_SMALLEST_M} m"
        )
    values[:, :3] = grid.to_grid_m(values[:, :3])
    return Boxes(frame, values)


def _sparse(block: int, counts: NDArray[np.int32]) -> dict[str, Any]:
    flat = np.flatnonzero(counts)
    ix, iy, iz = np.unravel_index(flat, counts.shape)
    return {
        "block": np.full(len(flat), block, dtype=np.uint16),
        "ix": ix.astype(np.int32),
        "iy": iy.astype(np.int32),
        "iz": iz.astype(np.int32),
        "count": counts.ravel()[flat].astype(np.uint32),
    }
