"""The tpog stage: from trajectories and the static world to ``tpog.parquet``.

Steps: read ``trajectories.parquet`` a few hundred frames at a time; count occupancy block by block
(:mod:`egvs.scoring.occupancy`); leave out the voxels that static geometry fills; write the sparse counts. Blocks are
consecutive and of equal length; counts of several TPOGs on one grid add up. While SUMO simulates, :class:`BlocksAhead`
counts them. Frames at the end of a finished file that
fill no block are left out, and reported.
"""

from __future__ import annotations

import queue
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from egvs.artefacts import parquet
from egvs.artefacts.frame_boxes import UNKNOWN_BOXES_KEY, BoxReader, FrameBoxes, read_boxes
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.tpog import PeriodBlocks, frame_multiplicities
from egvs.core.errors import WARNINGS_KEY, InputError
from egvs.core.grid import BoolArray, Grid, IntArray
from egvs.core.progress import ProgressCallback
from egvs.core.threads import checkpoint, run_in_thread
from egvs.scenario.model import Scenario
from egvs.scoring import occupancy
from egvs.scoring.occupancy import BlockCounts, count_blocks, static_voxels
from egvs.stages.base import Stage, StageContext, StageDependencies, Summary
from egvs.statistics.blocks import autocorrelation_time
from egvs.world.mesh import World

_WAIT_S = 0.1
"""Time between two looks whether the run has ended."""

if TYPE_CHECKING:
    from egvs.scoring.unknown_occupancy import UnknownOccupancy


def dependencies(context: StageContext) -> StageDependencies:
    """Return what the TPOG depends on: grid, blocks and weights; trajectories and statics by hash."""
    scenario = context.scenario
    settings = {
        "name": scenario.name,
        "grid": scenario.roi.grid.to_json(),
        "tpog": scenario.tpog.model_dump(mode="json"),
    }
    if scenario.traffic.periods:
        settings["weights"] = _weights(scenario)
    return StageDependencies(settings, context.digests(RunFolder.trajectories.name, RunFolder.statics.name))


def _weights(scenario: Scenario) -> dict[str, float]:
    return {period.name: period.weight for period in scenario.traffic.periods}


def run(context: StageContext, inputs: StageDependencies, ahead: BlocksAhead | None = None) -> Summary:
    """Count occupancy and write ``tpog.parquet``.

    Parameters
    ----------
    context
        The run folder, with trajectories and statics.
    inputs
        What the TPOG depends on.
    ahead
        Blocks of these trajectories, counted while they were written.

    Returns
    -------
    dict
        ``occupied_voxels``, ``static_voxels`` (left out), ``boxes_in_roi`` (mean per frame of the mix),
        ``memory_frames``; ``with_people`` where boxes are also people; ``unknown_gaps``, ``scaled_voxels`` and
        ``unknown_voxels`` where recorded tracks have long gaps; ``left_over`` where the frames of a finished file do
        not fill the blocks; warnings.
    """
    source = context.folder.trajectories
    scenario = context.scenario
    grid = scenario.roi.grid
    n_blocks = scenario.tpog.blocks
    by_period = scenario.by_period()
    writer = _BlockWriter(np.flatnonzero(static_voxels(context.world, grid)))
    periods: list[PeriodBlocks] = []
    boxes_in_roi = []
    left_over = 0
    unknown = _read_unknown(source, grid)
    first_frame = 0
    with parquet.artefact_writer(context.folder.tpog, "tpog") as file:
        for name, recorded, seeds, boxes in _recorded_periods(source, grid):
            unused = _leftover_frames(by_period.get(name, scenario), recorded)
            frames = recorded - unused
            if ahead is not None and ahead.frames == recorded:
                blocks = ahead.blocks()
            else:
                blocks = count_blocks(boxes, grid, frames // n_blocks, n_blocks)
            if unknown is not None:
                blocks = _known_blocks(blocks, unknown, first_frame)
            first_frame += recorded
            boxes_near = writer.write(file, blocks, n_blocks * len(periods), context.progress)
            boxes_in_roi.append(int(boxes_near.sum()) / frames)
            memory_frames = max(autocorrelation_time(series) for series in np.split(boxes_near, seeds))
            periods.append(PeriodBlocks(name, 1.0, frames, frames // n_blocks, memory_frames, seeds=seeds))
            left_over += unused
        periods = _with_weights(periods, scenario)
        file.describe(context.metadata(inputs, grid=grid.to_json(), **_frame_metadata(periods)))

    mean_boxes = float(np.average(boxes_in_roi, weights=[period.weight for period in periods]))
    people = occupancy.has_people(source)
    warnings = [
        *occupancy.warn_empty_region(mean_boxes, source, people=people),
        *occupancy.warn_empty_periods({p.name: boxes for p, boxes in zip(periods, boxes_in_roi, strict=True)}),
        *occupancy.warn_traffic_through_solids(writer.hidden, writer.visible, writer.solid, grid, context.world),
    ]
    memory: float | str = periods[0].memory_frames
    if len(periods) > 1:
        memory = ", ".join(f"{period.name} {period.memory_frames:g}" for period in periods)
    summary: Summary = {
        "occupied_voxels": int(np.sum(writer.occupied)),
        "static_voxels": len(writer.solid),
        "boxes_in_roi": mean_boxes,
        "memory_frames": memory,
        WARNINGS_KEY: [warning.to_json() for warning in warnings],
    }
    if people:
        summary["with_people"] = True
    if unknown is not None:
        summary |= unknown.summary()
    if left_over:
        total = sum(period.frames for period in periods) + left_over
        summary["left_over"] = f"the last {left_over} of {total} frames, so that {n_blocks} blocks are alike"
    return summary


def prepare() -> None:
    """Load or compile the kernels of the stage: count a box, and a triangle, in a single voxel."""
    grid = Grid((0.0, 0.0, 0.0), 1.0, (1, 1, 1))
    box = FrameBoxes(np.zeros(1, dtype=np.int64), np.array([[0.5, 0.5, 0.5, 0.0, 0.0, 1.0, 1.0, 1.0]]))
    occupancy.count_occupancy(box, grid, 1)
    face, solid = np.array([[0, 1, 2]], dtype=np.int32), np.zeros(1, dtype=np.int32)
    static_voxels(World(np.eye(3), face, solid, (("triangle", "wall"),)), grid)


class BlocksAhead:
    """Counts the blocks of a recording while its frames are written, in a thread of its own.

    Parameters
    ----------
    scenario
        The scenario; without periods, with a known number of frames that the blocks share.
    path
        The trajectories, for messages.

    Attributes
    ----------
    frames
        Number of frames that are expected.
    counting
        The thread that counts.
    """

    def __init__(self, scenario: Scenario, path: Path) -> None:
        assert scenario.traffic.frames is not None
        self.frames = scenario.traffic.frames
        self._grid, self._n_blocks = scenario.roi.grid, scenario.tpog.blocks
        self._reader = BoxReader(path, self._grid)
        self._rows: queue.SimpleQueue[pa.Table | None] = queue.SimpleQueue()
        self.counting: Future[list[_SparseBlock]] | None = None

    def add(self, rows: pa.Table) -> None:
        """Add the next row group."""
        self._rows.put(rows)

    def blocks(self) -> Iterator[BlockCounts]:
        """Yield the blocks, after the last row group was added."""
        assert self.counting is not None, "begun by count_ahead"
        self._rows.put(None)
        for flat, counts, boxes_per_frame in self.counting.result():
            dense = np.zeros(self._grid.shape, dtype=np.int32)
            dense.ravel()[flat] = counts
            yield BlockCounts(dense, boxes_per_frame)

    def count(self) -> list[_SparseBlock]:
        """Count until the last row group."""
        blocks = []
        for counts, boxes in count_blocks(self._boxes(), self._grid, self.frames // self._n_blocks, self._n_blocks):
            flat = np.flatnonzero(counts)
            blocks.append(_SparseBlock(flat, counts.ravel()[flat], boxes))
        return blocks

    def _boxes(self) -> Iterator[FrameBoxes]:
        while True:
            checkpoint()
            with suppress(queue.Empty):
                rows = self._rows.get(timeout=_WAIT_S)
                if rows is None:
                    return
                if rows.num_rows:
                    yield self._reader.read(rows)


@contextmanager
def count_ahead(context: StageContext) -> Iterator[BlocksAhead | None]:
    """Count the blocks of a simulation during the block; None for periods, whose numbers of frames are not known."""
    traffic = context.scenario.traffic
    if traffic.periods or traffic.frames is None or traffic.frames % context.scenario.tpog.blocks:
        yield None
        return
    blocks = BlocksAhead(context.scenario, context.folder.trajectories)
    with run_in_thread(blocks.count) as blocks.counting:
        yield blocks


class _SparseBlock(NamedTuple):
    """Voxels of a block that are occupied, their counts, and the number of boxes near the region in each frame."""

    flat: IntArray
    counts: NDArray[np.int32]
    boxes_per_frame: IntArray


@dataclass
class _BlockWriter:
    """Writes blocks, and adds up their counts: ``hidden`` in each solid voxel, ``visible`` in all others."""

    solid: IntArray
    hidden: IntArray = field(init=False)
    visible: int = 0
    occupied: BoolArray | bool = False

    def __post_init__(self) -> None:
        self.hidden = np.zeros(len(self.solid), dtype=np.int64)

    def write(
        self, file: parquet.ArtefactWriter, blocks: Iterator[BlockCounts], first_block: int, progress: ProgressCallback
    ) -> IntArray:
        """Write the blocks of one period; return the number of boxes near the region in each frame."""
        boxes = []
        for block, (counts, boxes_near) in enumerate(blocks, start=first_block):
            self.hidden += counts.ravel()[self.solid]
            counts.ravel()[self.solid] = 0
            rows = _sparse_counts(block, counts)
            file.write(rows)
            self.visible += int(rows["count"].sum())
            self.occupied = (counts > 0) | self.occupied
            boxes.append(boxes_near)
            progress("blocks", block + 1, 0)
        return np.concatenate(boxes)


def _read_unknown(trajectories: Path, grid: Grid) -> UnknownOccupancy | None:
    """Return what the recording does not know; None where it knows all positions."""
    metadata = parquet.read_metadata(trajectories, "trajectories")
    if not metadata.get(UNKNOWN_BOXES_KEY):
        return None

    from egvs.scoring.unknown_occupancy import UnknownOccupancy

    return UnknownOccupancy.from_metadata(metadata, grid)


def _known_blocks(blocks: Iterator[BlockCounts], unknown: UnknownOccupancy, first_frame: int) -> Iterator[BlockCounts]:
    """Yield blocks, with their counts adjusted for what the recording does not know."""
    for block in blocks:
        frames = block.boxes_per_frame.size
        unknown.adjust(block.counts, first_frame, frames)
        first_frame += frames
        yield block


class _RecordedPeriod(NamedTuple):
    """One period of the trajectories; its frames are counted from 0, and its name is empty without periods.

    Its simulations with seeds of their own follow one another.
    """

    name: str
    frames: int
    seeds: int
    boxes: Iterator[FrameBoxes]


def _recorded_periods(source: Path, grid: Grid) -> Iterator[_RecordedPeriod]:
    metadata = parquet.read_metadata(source, "trajectories")
    seeds = int(metadata.get("seeds", 1))
    if "periods" not in metadata:
        yield _RecordedPeriod("", int(metadata["frames"]), seeds, read_boxes(source, grid))
        return
    start = 0
    for period in metadata["periods"]:
        frames = int(period["frames"])
        boxes = read_boxes(source, grid, np.arange(start, start + frames))
        yield _RecordedPeriod(period["name"], frames, seeds, _count_from_zero(boxes, start))
        start += frames


def _count_from_zero(batches: Iterator[FrameBoxes], start: int) -> Iterator[FrameBoxes]:
    for batch in batches:
        yield FrameBoxes(batch.frame - start, batch.values)


def _leftover_frames(scenario: Scenario, frames: int) -> int:
    """Number of frames that fill no block; InputError unless a finished file is used as it is."""
    blocks = scenario.tpog.blocks
    unused = frames % blocks
    if unused == frames or (unused and scenario.traffic.frames is not None):
        problem = f"{blocks} does not divide the {frames} recorded frames"
        raise InputError(scenario.locate("tpog.blocks"), problem, f"Use a divisor of {frames}.")
    return unused


def _with_weights(periods: list[PeriodBlocks], scenario: Scenario) -> list[PeriodBlocks]:
    """The periods with their weights in the mix."""
    by_name = _weights(scenario)
    weights = [by_name.get(period.name, 1.0) for period in periods]
    times = frame_multiplicities(weights, [period.frames for period in periods], f"{scenario.file}: traffic")
    return [replace(p, weight=weight, times=number) for p, weight, number in zip(periods, weights, times, strict=True)]


def _frame_metadata(periods: list[PeriodBlocks]) -> dict[str, Any]:
    """Entries of the metadata about frames and blocks."""
    if not periods[0].name:
        one = periods[0]
        entries = {"frames": one.frames, "block_frames": one.block_frames, "memory_frames": one.memory_frames}
        if one.seeds > 1:
            entries["seeds"] = one.seeds
        return entries
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
    neutral_options=("ahead",),
    prepare=(prepare,),
    ahead=count_ahead,
)
