r"""The traffic probabilistic occupancy grid (TPOG), its blocks and its periods.

Where the traffic has periods, the metadata says which blocks belong to which period, and how much each period counts in
the mix. With c_q the counts of period q over its T_q frames and w_q its weight, the mix is

.. math:: p(v) = \sum_q w_q c_q(v) / T_q \Big/ \sum_q w_q = \sum_q m_q c_q(v) \Big/ \sum_q m_q T_q

with the smallest whole numbers m_q in the ratio of w_q / T_q: it stays a count of frames, and its entropy exact.
Weights are the decimal numbers that the scenario writes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from math import gcd, lcm
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from egvs.artefacts import parquet
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, Grid, IntArray
from egvs.kernels.occupancy import accumulate

MAX_FRAMES = 2**32 - 1
"""Most frames of a mix, so that entropies keep their digits."""


@dataclass(frozen=True)
class PeriodBlocks:
    """The blocks of one period; they follow those of the periods before it. All blocks where there are no periods.

    Attributes
    ----------
    name, weight
        As in the scenario; the name is empty where there are no periods.
    frames, block_frames
        Number of recorded frames in the period, and in each of its blocks.
    memory_frames
        Autocorrelation time of the traffic.
    times
        How often each of its frames counts in the mix.
    seeds
        Number of independent simulations that share the frames and blocks equally, one after another.
    """

    name: str
    weight: float
    frames: int
    block_frames: int
    memory_frames: float
    times: int = 1
    seeds: int = 1

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return self.frames // self.block_frames

    def to_json(self) -> dict[str, Any]:
        """Return the entry of the metadata; ``seeds`` only where there are several."""
        values = asdict(self)
        if self.seeds == 1:
            del values["seeds"]
        return values


def frame_multiplicities(weights: Sequence[float], frames: Sequence[int], where: str) -> tuple[int, ...]:
    """Return how often a frame of each period counts in the mix.

    Parameters
    ----------
    weights, frames
        Weight of each period, and its number of frames.
    where
        Key of the traffic, for messages.

    Raises
    ------
    InputError
        When the weights have so many digits that the mix has too many frames.
    """
    shares = [Fraction(repr(weight)) / count for weight, count in zip(weights, frames, strict=True)]
    denominator = lcm(*(share.denominator for share in shares))
    scaled = [int(share * denominator) for share in shares]
    divisor = gcd(*scaled)
    smallest = tuple(value // divisor for value in scaled)
    total = sum(count * number for count, number in zip(smallest, frames, strict=True))
    if total > MAX_FRAMES:
        listed = f"weights {', '.join(f'{w:g}' for w in weights)} of {', '.join(map(str, frames))} frames"
        problem = f"{listed} need a mix of more than {MAX_FRAMES:,} frames"
        raise InputError(f"{where}.periods", problem, "Use weights with fewer digits or closer to each other.")
    return smallest


def periods_from_metadata(metadata: dict[str, Any], path: Path) -> tuple[PeriodBlocks, ...]:
    """Return the periods from the metadata of ``tpog.parquet``; one without a name where there are no periods."""
    if "periods" in metadata:
        periods = tuple(PeriodBlocks(**row) for row in metadata["periods"])
    else:
        seeds = metadata.get("seeds", 1)
        periods = (
            PeriodBlocks("", 1.0, metadata["frames"], metadata["block_frames"], metadata["memory_frames"], seeds=seeds),
        )
    for period in periods:
        if period.frames % period.block_frames:
            problem = f"{period.frames} frames do not fill blocks of {period.block_frames} frames"
            raise InputError(path, problem, "Create the file again.")
        if period.blocks % period.seeds:
            problem = f"{period.blocks} blocks cannot be shared by {period.seeds} simulations"
            raise InputError(path, problem, "Create the file again.")
    return periods


def block_multiplicities(periods: Sequence[PeriodBlocks], only: str | None = None) -> IntArray:
    """Return how often each block counts, (blocks,) int64: in the mix, or in the period ``only``."""
    numbers = []
    for period in periods:
        times = period.times if only is None else int(period.name == only)
        numbers.append(np.full(period.blocks, times, dtype=np.int64))
    return np.concatenate(numbers)


@dataclass(frozen=True)
class Tpog:
    """A Traffic Probabilistic Occupancy Grid.

    Attributes
    ----------
    grid
        Position and size of the voxels.
    frames
        Number of frames T.
    counts
        Number of frames in which each voxel is occupied, summed over all blocks, (nx, ny, nz) int64.
    """

    grid: Grid
    frames: int
    counts: IntArray

    @property
    def p(self) -> FloatArray:
        """Share of the frames in which each voxel is occupied, (nx, ny, nz) float64."""
        return self.counts / self.frames

    def __repr__(self) -> str:
        shape = " x ".join(str(count) for count in self.grid.shape)
        occupied = np.count_nonzero(self.counts)
        return f"Tpog({shape} voxels of {self.grid.voxel_m:g} m, {occupied:,} ever occupied in {self.frames:,} frames)"


def read_tpog(path: str | Path, period: str | None = None) -> Tpog:
    """Read ``tpog.parquet``.

    Parameters
    ----------
    path
        The file.
    period
        Name of a period; the mix of all periods if None.

    Raises
    ------
    InputError
        When the file is corrupt, a row lies outside the grid, or there is no such period.
    """
    path = Path(path)
    with parquet.open_artefact(path, "tpog") as (file, metadata):
        grid = Grid.from_json(metadata["grid"])
        periods = periods_from_metadata(metadata, path)
        frames = int(metadata["frames"])
        if period is not None:
            names = [record.name for record in periods]
            if period not in names:
                hint = (
                    f"The periods are {', '.join(names)}." if any(names) else "Its traffic has no periods: name none."
                )
                raise InputError(path, f"there is no period {period!r}", hint)
            frames = periods[names.index(period)].frames

        times = block_multiplicities(periods, period)
        counts = np.zeros(int(np.prod(grid.shape)), dtype=np.int64)
        for group in range(file.num_row_groups):  # one block each: memory does not grow with their number
            _add_block(parquet.read_row_group(file, group, path), path, grid, times, counts)
    if counts.max(initial=0) > frames:
        raise InputError(path, f"a voxel is occupied in {counts.max()} of {frames} frames", "Create the file again.")
    return Tpog(grid, frames, counts.reshape(grid.shape))


def _add_block(table: pa.Table, path: Path, grid: Grid, times: IntArray, counts: IntArray) -> None:
    """Add the rows of a block to the counts of all voxels, each row as often as its block counts."""
    index = [table.column(name).to_numpy() for name in ("ix", "iy", "iz")]
    for axis, values, size in zip("xyz", index, grid.shape, strict=True):
        if len(values) and not (values.min() >= 0 and values.max() < size):
            raise InputError(path, f"expected i{axis} from 0 to {size - 1}", "Create the file again.")
    if not len(table):
        return
    cells = np.ravel_multi_index(index, grid.shape)
    block = block_numbers(table, path, len(times))
    accumulate(cells, table.column("count").to_numpy().astype(np.int64) * times[block], counts)


def block_numbers(table: pa.Table, path: Path, blocks: int) -> NDArray[np.uint16]:
    """Return the block of each row of a TPOG; InputError where there is no such block."""
    block: NDArray[np.uint16] = table.column("block").to_numpy()
    if block.max(initial=0) >= blocks:
        raise InputError(path, f"expected blocks 0 to {blocks - 1}, got {block.max()}", "Create the file again.")
    return block


def read_periods(path: str | Path) -> tuple[PeriodBlocks, ...]:
    """Return the periods of ``tpog.parquet``; one without a name where it has none."""
    path = Path(path)
    return periods_from_metadata(parquet.read_metadata(path, "tpog"), path)
