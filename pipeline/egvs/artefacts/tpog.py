r"""The traffic probabilistic occupancy grid (TPOG): reading it, its blocks and its periods.

Periods in the metadata of a TPOG: which blocks are whose, and how much each counts in the mix.

With c_q the counts of period q over its T_q frames and w_q its weight, the mix is

.. math:: p(v) = \sum_q w_q c_q(v) / T_q \Big/ \sum_q w_q = \sum_q m_q c_q(v) \Big/ \sum_q m_q T_q

with the smallest whole numbers m_q in the ratio of w_q / T_q: it stays a count of frames, and its entropy exact.
Weights are the decimal numbers that the scenario writes.

Artefacts as arrays and tables, for notebooks, stages, and people who want to compute further.

Each reader checks what it reads and says which file is wrong. Tables come as Arrow tables (``.to_pandas()`` makes a
data frame of one), grids as NumPy arrays.
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
from egvs.core.grid import Grid
from egvs.kernels.occupancy import accumulate

MAX_FRAMES = 2**32 - 1
"""Of a mix, so that entropies keep their digits."""


@dataclass(frozen=True)
class PeriodBlocks:
    """The blocks of one period, those after the ones of the periods before it; all blocks where there are no periods.

    Attributes
    ----------
    name, weight
        As the scenario says.
    frames, block_frames
        Recorded in the period, and in each of its blocks.
    memory_frames
        The traffic's memory.
    times
        How often each of its frames counts in the mix.
    """

    name: str
    weight: float
    frames: int
    block_frames: int
    memory_frames: float
    times: int = 1

    @property
    def blocks(self) -> int:
        """How many."""
        return self.frames // self.block_frames

    def to_json(self) -> dict[str, Any]:
        """As the metadata holds it."""
        return asdict(self)


def frame_multiplicities(weights: Sequence[float], frames: Sequence[int], where: str) -> tuple[int, ...]:
    """How often a frame of each period counts; InputError where weights are so odd that a mix has too many frames."""
    shares = [Fraction(repr(weight)) / count for weight, count in zip(weights, frames, strict=True)]
    scaled = [int(share * lcm(*(share.denominator for share in shares))) for share in shares]
    smallest = tuple(value // gcd(*scaled) for value in scaled)
    total = sum(count * number for count, number in zip(smallest, frames, strict=True))
    if total > MAX_FRAMES:
        found = f"weights {', '.join(f'{w:g}' for w in weights)} of {', '.join(map(str, frames))} frames"
        what = f"{found} make a mix of more than {MAX_FRAMES:,} frames"
        raise InputError(f"{where}.periods", what, "weights with fewer digits, nearer to each other")
    return smallest


def periods_from_metadata(metadata: dict[str, Any], path: Path) -> tuple[PeriodBlocks, ...]:
    """From the metadata of ``tpog.parquet``; one without a name where there are no periods."""
    if "periods" not in metadata:
        whole = PeriodBlocks("", 1.0, metadata["frames"], metadata["block_frames"], metadata["memory_frames"])
        found: tuple[PeriodBlocks, ...] = (whole,)
    else:
        found = tuple(PeriodBlocks(**row) for row in metadata["periods"])
    for period in found:
        if period.frames % period.block_frames:
            what = f"{period.frames} frames in blocks of {period.block_frames}"
            raise InputError(path, what, "whole blocks; make it again")
    return found


def block_multiplicities(periods: Sequence[PeriodBlocks], only: str | None = None) -> NDArray[np.int64]:
    """How often each block counts, (blocks,): in the mix, or in one period alone."""
    numbers = [period.times if only is None else int(period.name == only) for period in periods]
    return np.repeat(np.array(numbers, dtype=np.int64), [period.blocks for period in periods])


@dataclass(frozen=True)
class Tpog:
    """A Traffic Probabilistic Occupancy Grid.

    Attributes
    ----------
    grid
        Where the voxels are.
    frames
        T, the number of frames.
    counts
        Frames in which each voxel is occupied, all blocks added up, (nx, ny, nz) int64.
    """

    grid: Grid
    frames: int
    counts: NDArray[np.int64]

    @property
    def p(self) -> NDArray[np.float64]:
        """Share of the frames in which each voxel is occupied, (nx, ny, nz) float64."""
        return self.counts / self.frames


def read_tpog(path: str | Path, period: str | None = None) -> Tpog:
    """Read ``tpog.parquet``: the mix of its periods, or one of them alone.

    InputError when it is corrupt, a row lies outside the grid, or it has no such period.
    """
    path = Path(path)
    with parquet.open_artefact(path, "tpog") as (file, about):
        grid, periods = Grid.from_json(about["grid"]), periods_from_metadata(about, path)
        names = [its.name for its in periods]
        if period is not None and period not in names:
            raise InputError(path, f"no period {period!r}", f"one of {', '.join(names)}")
        frames = int(about["frames"]) if period is None else periods[names.index(period)].frames
        times = block_multiplicities(periods, period)
        counts = np.zeros(int(np.prod(grid.shape)), dtype=np.int64)
        for group in range(file.num_row_groups):  # one block each: memory does not grow with their number
            table = parquet.read_row_group(file, group, path)
            index = [table.column(name).to_numpy() for name in ("ix", "iy", "iz")]
            for axis, (values, size) in enumerate(zip(index, grid.shape, strict=True)):
                if len(values) and not (values.min() >= 0 and values.max() < size):
                    raise InputError(path, f"i{'xyz'[axis]} leaves the grid", f"0 to {size - 1}")
            if len(table):
                flat, block = np.ravel_multi_index(index, grid.shape), block_numbers(table, path, len(times))
                accumulate(flat, table.column("count").to_numpy().astype(np.int64) * times[block], counts)
    if counts.max(initial=0) > frames:
        raise InputError(path, f"a voxel is occupied in {counts.max()} of {frames} frames", "counts up to the frames")
    return Tpog(grid, frames, counts.reshape(grid.shape))


def block_numbers(table: pa.Table, path: Path, blocks: int) -> NDArray[np.uint16]:
    """The blocks of rows of a TPOG; InputError where there is no such block."""
    block: NDArray[np.uint16] = table.column("block").to_numpy()
    if block.max(initial=0) >= blocks:
        raise InputError(path, f"block {block.max()} of {blocks}", f"0 to {blocks - 1}")
    return block


def read_periods(path: str | Path) -> tuple[PeriodBlocks, ...]:
    """The periods of ``tpog.parquet``; one without a name where it has none."""
    path = Path(path)
    return periods_from_metadata(parquet.read_metadata(path, "tpog"), path)
