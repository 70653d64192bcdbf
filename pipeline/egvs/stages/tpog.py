"""The tpog stage: from trajectories and the static world to ``tpog.parquet``.

Steps: read ``trajectories.parquet`` a few hundred frames at a time; count occupancy block by block
(:mod:`egvs.scoring.occupancy`); leave out the voxels that static geometry fills; write the sparse counts. Blocks
are consecutive and of equal length; counts of several TPOGs on one grid add up. Frames at the end of a finished file
that fill no block are left out and told.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts import parquet
from egvs.artefacts.frame_boxes import FrameBoxes, read_boxes
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.tpog import PeriodBlocks, frame_multiplicities
from egvs.core.errors import WARNINGS_KEY, InputError
from egvs.core.grid import Grid
from egvs.core.runtime import ProgressCallback
from egvs.scenario.model import Scenario
from egvs.scoring import occupancy
from egvs.scoring.occupancy import autocorrelation_time, count_blocks, static_voxels
from egvs.stages.base import Stage, StageContext, StageDependencies, Summary


def dependencies(work: StageContext) -> StageDependencies:
    """Grid and blocks; the trajectories and the statics by hash."""
    scenario = work.scenario
    settings = {
        "name": scenario.name,
        "grid": scenario.roi.grid.to_json(),
        "tpog": scenario.tpog.model_dump(mode="json"),
        **({"weights": weights} if (weights := _weights(scenario)) else {}),
    }
    return StageDependencies(settings, work.digests(RunFolder.trajectories.name, RunFolder.statics.name))


def _weights(scenario: Scenario) -> dict[str, float]:
    return {period.name: period.weight for period in scenario.traffic.periods}


def run(work: StageContext, inputs: StageDependencies) -> Summary:
    """Count occupancy and write ``tpog.parquet``.

    Returns
    -------
    dict
        ``occupied_voxels``, ``static_voxels`` (left out), ``boxes_in_roi`` (mean a frame, of the mix); ``left_over``
        where a finished file's frames are no whole number of blocks; warnings.
    """
    source, scenario = work.folder.trajectories, work.scenario
    grid, filled = scenario.roi.grid, static_voxels(work.world, scenario.roi.grid)
    counting = _BlockWriter(np.flatnonzero(filled))
    with parquet.artefact_writer(work.folder.tpog, "tpog") as file:
        periods, in_roi, first_block, left_over = [], list[float](), 0, 0
        by_period = scenario.by_period()
        for name, frames, boxes in _recorded_boxes(source, grid):
            over = _leftover_frames(by_period.get(name, scenario), frames)
            block_frames = (frames - over) // scenario.tpog.blocks
            blocks = count_blocks(boxes, grid, block_frames, scenario.tpog.blocks)
            boxes_near = counting.write(file, blocks, first_block, work.progress)
            in_roi.append(int(boxes_near.sum()) / (frames - over))
            periods.append(PeriodBlocks(name, 1.0, frames - over, block_frames, autocorrelation_time(boxes_near)))
            first_block, left_over = first_block + scenario.tpog.blocks, left_over + over
        periods = _with_weights(periods, scenario)
        file.describe(work.metadata(inputs, grid=grid.to_json(), **_frame_metadata(periods)))
    mean = float(np.average(in_roi, weights=[period.weight for period in periods]))
    doubts = [
        *occupancy.warn_empty_region(mean, source),
        *occupancy.warn_empty_periods(dict(zip((period.name for period in periods), in_roi, strict=True))),
        *occupancy.warn_traffic_through_solids(counting.hidden, counting.visible, counting.solid, grid, work.world),
    ]
    summary: Summary = {
        "occupied_voxels": int(counting.ever.sum()) if counting.ever is not None else 0,
        "static_voxels": len(counting.solid),
        "boxes_in_roi": mean,
        "memory_frames": ", ".join(f"{p.name} {p.memory_frames:g}" for p in periods)
        if len(periods) > 1
        else periods[0].memory_frames,
        WARNINGS_KEY: [finding.to_json() for finding in doubts],
    }
    if left_over:
        total = sum(period.frames for period in periods) + left_over
        blocks_alike = f"so that {scenario.tpog.blocks} blocks are alike"
        summary["left_over"] = f"the last {left_over} of {total} frames, {blocks_alike}"
    return summary


@dataclass
class _BlockWriter:
    """Writes blocks, and adds up what is said of them: rows hidden in solids, and seen, in all blocks."""

    solid: NDArray[np.int64]
    hidden: NDArray[np.int64] = field(init=False)
    visible: int = 0
    ever: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        self.hidden = np.zeros(len(self.solid), dtype=np.int64)

    def write(
        self,
        file: parquet.ArtefactWriter,
        blocks: Iterator[tuple[NDArray[np.int32], NDArray[np.int64]]],
        first_block: int,
        progress: ProgressCallback,
    ) -> NDArray[np.int64]:
        """Write one period's blocks, numbered from ``first_block`` on; boxes near the region in each frame."""
        boxes = []
        for block, (counts, boxes_near) in enumerate(blocks, start=first_block):
            self.hidden += counts.ravel()[self.solid]
            counts.ravel()[self.solid] = 0
            rows = _sparse_counts(block, counts)
            file.write(rows)
            self.visible += int(rows["count"].sum())
            self.ever = (counts > 0) | (False if self.ever is None else self.ever)
            boxes.append(boxes_near)
            progress("blocks", block + 1, 0)
        return np.concatenate(boxes)


def _recorded_boxes(source: Path, grid: Grid) -> Iterator[tuple[str, int, Iterator[FrameBoxes]]]:
    """Name, frames and boxes of each period, its frames counted from 0; without a name where there are no periods."""
    about = parquet.read_metadata(source, "trajectories")
    if "periods" not in about:
        yield "", int(about["frames"]), read_boxes(source, grid)
        return
    start = 0
    for period in about["periods"]:
        frames = int(period["frames"])
        yield period["name"], frames, _from_zero(read_boxes(source, grid, np.arange(start, start + frames)), start)
        start += frames


def _from_zero(batches: Iterator[FrameBoxes], start: int) -> Iterator[FrameBoxes]:
    return (FrameBoxes(batch.frame - start, batch.values) for batch in batches)


def _leftover_frames(scenario: Scenario, frames: int) -> int:
    """Frames that make no whole number of blocks; InputError unless a finished file was taken as it is."""
    blocks, over = scenario.tpog.blocks, frames % scenario.tpog.blocks
    if over == frames or (over and scenario.traffic.frames is not None):
        found = f"{blocks} does not divide the {frames} frames recorded"
        raise InputError(f"{scenario.file}: tpog.blocks", found, f"a divisor, or at most {frames}")
    return over


def _with_weights(periods: list[PeriodBlocks], scenario: Scenario) -> list[PeriodBlocks]:
    """The periods with their weights."""
    named = _weights(scenario)
    weights = [named.get(period.name, 1.0) for period in periods]
    often = frame_multiplicities(weights, [period.frames for period in periods], f"{scenario.file}: traffic")
    return [replace(p, weight=weight, times=number) for p, weight, number in zip(periods, weights, often, strict=True)]


def _frame_metadata(periods: list[PeriodBlocks]) -> dict[str, Any]:
    """What metadata says of frames and blocks."""
    if not periods[0].name:
        one = periods[0]
        return {"frames": one.frames, "block_frames": one.block_frames, "memory_frames": one.memory_frames}
    frames = sum(period.frames * period.times for period in periods)
    return {"frames": frames, "periods": [period.to_json() for period in periods]}


def _sparse_counts(block: int, counts: NDArray[np.int32]) -> dict[str, Any]:
    flat = np.flatnonzero(counts)
    ix, iy, iz = np.unravel_index(flat, counts.shape)
    return {
        "block": np.full(len(flat), block, dtype=np.uint16),
        "ix": ix.astype(np.int32),
        "iy": iy.astype(np.int32),
        "iz": iz.astype(np.int32),
        "count": counts.ravel()[flat].astype(np.uint32),
    }


STAGE = Stage(
    "tpog",
    __name__,
    dependencies,
    run,
    reads=(RunFolder.trajectories, RunFolder.statics),
    code=("egvs.world.mesh",),
)
