"""Artefacts as arrays and tables, for notebooks, stages, and people who want to compute further.

Each reader checks what it reads and says which file is wrong. Tables come as Arrow tables (``.to_pandas()`` makes a
data frame of one), grids as NumPy arrays.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from pipeline.artefacts import checksums, tables
from pipeline.artefacts.periods import PeriodBlocks, periods_of, times_of_blocks
from pipeline.core.errors import InputError
from pipeline.core.grid import Grid
from pipeline.kernels.crossings import accumulate

SEPARABLE = 0.9
"""Neighbours in rank are told apart when the chance that the better is better (``beats_next``) reaches this."""

ACCURACY_SUMS, VALIDATION_SUMS, PLACEMENT_SUMS = "accuracy.sha256", "validation.sha256", "placement.sha256"
"""Checksums of what ``egvs accuracy``, ``egvs validate`` and ``egvs place`` leave."""


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
    with tables.reader(path, "tpog") as (file, about):
        grid, periods = Grid.from_json(about["grid"]), periods_of(about, path)
        names = [its.name for its in periods]
        if period is not None and period not in names:
            raise InputError(path, f"no period {period!r}", f"one of {', '.join(names)}")
        frames = int(about["frames"]) if period is None else periods[names.index(period)].frames
        times = times_of_blocks(periods, period)
        counts = np.zeros(int(np.prod(grid.shape)), dtype=np.int64)
        for group in range(file.num_row_groups):  # one block each: memory does not grow with their number
            table = tables.read_group(file, group, path)
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
    return periods_of(tables.read_metadata(path, "tpog"), path)


def read_scores(path: str | Path) -> pa.Table:
    """Read ``scores.parquet``."""
    return tables.read(Path(path), "scores")[0]


def read_scores_by_period(path: str | Path) -> pa.Table:
    """Read ``scores_by_period.parquet``, which a run leaves where its traffic has periods."""
    return tables.read(Path(path), "scores_by_period")[0]


def read_trajectories(path: str | Path) -> pa.Table:
    """Read ``trajectories.parquet``."""
    return tables.read(Path(path), "trajectories")[0]


def read_scans(path: str | Path) -> pa.Table:
    """Read ``scans.parquet``."""
    return tables.read(Path(path), "scans")[0]


def read_accuracy(path: str | Path) -> tuple[list[dict[str, Any]], dict[str, Any]] | None:
    """Rows and metadata of ``accuracy.parquet``; None where there is none."""
    path = Path(path)
    if not path.is_file():
        return None
    checksums.check(path.with_name(ACCURACY_SUMS), "remove it, or run egvs accuracy again")
    try:
        table, about = tables.read(path, "accuracy")
    except InputError as error:
        raise InputError(path, "is no accuracy study", f"remove it, or run egvs accuracy again ({error})") from None
    return table.to_pylist(), about


def read_placement(
    placement: str | Path, curve: str | Path
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], dict[str, Any]] | None:
    """Rows of ``placement.parquet`` and of ``curve.parquet``, and their metadata; None where one of them is not there,
    or they are of different plans."""
    paths = Path(placement), Path(curve)
    if not all(path.is_file() for path in paths):
        return None
    checksums.check(paths[0].with_name(PLACEMENT_SUMS), "remove it, or run egvs place again")
    found = []
    for path in paths:
        try:
            found.append(tables.read(path, path.stem))
        except InputError as error:
            raise InputError(path, "is no plan", f"remove it, or run egvs place again ({error})") from None
    (rows, about), (points, other) = found
    return None if about != other else (rows.to_pylist(), points.to_pylist(), about)


def read_validation(
    detection: str | Path, correlation: str | Path
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], dict[str, Any]] | None:
    """Rows of ``detection.parquet`` and of ``correlation.parquet``, and the latter's metadata; None where one of them
    is not there, or they are of different validations.
    """
    paths = Path(detection), Path(correlation)
    if not all(path.is_file() for path in paths):
        return None
    checksums.check(paths[0].with_name(VALIDATION_SUMS), "remove it, or run egvs validate again")
    found = []
    for path in paths:
        try:
            found.append(tables.read(path, path.stem))
        except InputError as error:
            right = f"remove it, or run egvs validate again ({error})"
            raise InputError(path, "is not what egvs validate writes", right) from None
    (detected, one), (correlated, about) = found
    return (detected.to_pylist(), correlated.to_pylist(), about) if one["inputs"] == about["inputs"] else None


def read_visibility(path: str | Path, site: str) -> NDArray[np.float64]:
    """Hits of one site in every voxel, (nx, ny, nz) float64, from ``visibility.parquet``."""
    path = Path(path)
    table, about = tables.read(path, "visibility")
    mine = table.filter(pc.equal(table.column("site"), site))
    if len(mine) == 0 and site not in {s["site"] for s in about["sites"]}:
        raise InputError(path, f"no site {site!r}", "a site that score.keep_visibility names")
    hits = np.zeros(Grid.from_json(about["grid"]).shape)
    hits[tuple(mine.column(name).to_numpy() for name in ("ix", "iy", "iz"))] = mine.column("hits").to_numpy()
    return hits
