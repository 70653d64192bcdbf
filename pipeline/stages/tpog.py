"""The tpog stage: from trajectories and the static world to ``tpog.parquet``.

Steps: read ``trajectories.parquet`` a few hundred frames at a time; count occupancy block by block
(:mod:`pipeline.scoring.occupancy`); leave out the voxels that static geometry fills; write the sparse counts. Blocks
are consecutive and of equal length; counts of several TPOGs on one grid add up. Frames at the end of a finished file
that fill no block are left out and told.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import tables
from pipeline.artefacts.recorded_boxes import read_boxes
from pipeline.checks import recorded
from pipeline.core.errors import InputError
from pipeline.core.findings import WARNINGS
from pipeline.scoring.memory import memory_frames
from pipeline.scoring.occupancy import count_blocks, static_voxels
from pipeline.stages.base import StageInputs, Summary, Workspace
from pipeline.stages.shared.world import world_of

NAME = "tpog"
ARTEFACTS = ("tpog.parquet",)


def inputs(work: Workspace) -> StageInputs:
    """Grid and blocks; the trajectories and the statics by hash."""
    scenario = work.scenario
    settings = {
        "name": scenario.name,
        "grid": scenario.roi.grid.to_json(),
        "tpog": scenario.tpog.model_dump(mode="json"),
    }
    return StageInputs(settings, work.digests("trajectories.parquet", "statics.ply"))


def run(work: Workspace, inputs: StageInputs) -> Summary:
    """Count occupancy and write ``tpog.parquet``.

    Returns
    -------
    dict
        ``occupied_voxels``, ``static_voxels`` (left out), ``boxes_in_roi`` (mean a frame); ``left_over`` where a
        finished file's frames are no whole number of blocks; warnings.
    """
    source, scenario = work.path("trajectories.parquet"), work.scenario
    grid, blocks = scenario.roi.grid, scenario.tpog.blocks
    frames = int(tables.read_metadata(source, "trajectories")["frames"])
    left_over = frames % blocks
    if left_over == frames or (left_over and scenario.traffic.frames is not None):
        found = f"{blocks} does not divide the {frames} frames recorded"
        raise InputError(f"{scenario.file}: tpog.blocks", found, f"a divisor, or at most {frames}")
    frames -= left_over
    filled = static_voxels(world_of(work), grid)
    solid, seen = np.flatnonzero(filled), 0
    hidden = np.zeros(len(solid), dtype=np.int64)
    block_frames, ever = frames // blocks, np.zeros(grid.shape, dtype=np.bool_)
    boxes: list[NDArray[np.int64]] = []
    with tables.writer(work.path(ARTEFACTS[0]), "tpog") as file:
        counted = count_blocks(read_boxes(source, grid), grid, block_frames, blocks)
        for block, (counts, boxes_near) in enumerate(counted):
            hidden += counts.ravel()[solid]
            counts[filled] = 0
            rows = _sparse(block, counts)
            file.write(rows)
            seen += int(rows["count"].sum())
            ever |= counts > 0
            boxes.append(boxes_near)
            work.progress("blocks", block + 1, blocks)
        in_roi = np.concatenate(boxes)
        memory = memory_frames(in_roi)
        about: dict[str, Any] = {"frames": frames, "block_frames": block_frames, "memory_frames": memory}
        file.describe(work.metadata(inputs, grid=grid.to_json(), **about))
    doubts = [
        *recorded.in_region(float(in_roi.mean()), source),
        *recorded.through_solids(hidden, seen, solid, grid, world_of(work)),
    ]
    summary: Summary = {
        "occupied_voxels": int(ever.sum()),
        "static_voxels": len(solid),
        "boxes_in_roi": float(in_roi.mean()),
        "memory_frames": memory,
        WARNINGS: [finding.to_json() for finding in doubts],
    }
    if left_over:
        summary["left_over"] = f"the last {left_over} of {frames + left_over} frames, so that {blocks} blocks are alike"
    return summary


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
