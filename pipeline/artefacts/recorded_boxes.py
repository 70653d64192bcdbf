"""Reads the vehicle boxes of a recording back, some whole frames at a time, in a grid's own frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import tables
from pipeline.core.errors import InputError
from pipeline.core.grid import Grid

COLUMNS = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad", "length_m", "width_m", "height_m")
SMALLEST_M, LARGEST_M = 1e-3, 2000.0
"""What is smaller than this is no box: it must stay one when it is made smaller on each side; what is larger than any
train, no vehicle."""


@dataclass(frozen=True)
class FrameBoxes:
    """Vehicle boxes of some whole frames."""

    frame: NDArray[np.int64]
    """(n,), ascending."""
    values: NDArray[np.float64]
    """(n, 8), as ``COLUMNS``; the centre in the grid's frame."""


def read_boxes(path: Path, grid: Grid, wanted: NDArray[np.int64] | None = None) -> Iterator[FrameBoxes]:
    """Boxes of ``trajectories.parquet``, row group by row group (each holds whole frames).

    Parameters
    ----------
    wanted
        Only these frames, ascending; row groups that hold none of them are not read.

    Raises
    ------
    InputError
        For a file that is corrupt or out of order, or a box that is none.
    """
    with tables.reader(path, "trajectories") as (file, _):
        last, column = -1, file.schema_arrow.get_field_index("frame")
        for group in range(file.num_row_groups):
            statistics = file.metadata.row_group(group).column(column).statistics
            if wanted is not None and not _may_hold(statistics, wanted):
                continue
            table = tables.read_group(file, group, path, ["frame", *COLUMNS])
            if not len(frame := table.column("frame").to_numpy().astype(np.int64)):
                continue
            if np.any(np.diff(frame) < 0) or frame[0] <= last:
                raise InputError(path, f"frames are out of order near frame {frame[0]}", "rows sorted by frame")
            last = int(frame[-1])
            kept = slice(None) if wanted is None else np.isin(frame, wanted)
            values = np.column_stack([table.column(name).to_numpy()[kept] for name in COLUMNS])
            _check(path, frame[kept], values)
            values[:, :3] = grid.to_grid_m(values[:, :3])
            yield FrameBoxes(frame[kept], values)


def _may_hold(statistics: Any, wanted: NDArray[np.int64]) -> bool:
    """Whether a row group may hold one of these frames; yes where the file does not say which it holds."""
    if statistics is None or not statistics.has_min_max:
        return True
    return bool(np.searchsorted(wanted, statistics.min) < np.searchsorted(wanted, statistics.max, side="right"))


def _check(path: Path, frame: NDArray[np.int64], values: NDArray[np.float64]) -> None:
    of_vehicles = (values[:, 5:8] >= SMALLEST_M) & (values[:, 5:8] <= LARGEST_M)
    sound = np.isfinite(values).all(axis=1) & of_vehicles.all(axis=1)
    if not sound.all():
        bad = int(np.flatnonzero(~sound)[0])
        shown = ", ".join(f"{name} = {value:g}" for name, value in zip(COLUMNS, values[bad], strict=True))
        raise InputError(
            f"{path}: frame {frame[bad]}",
            f"a box with {shown}",
            f"finite values, sizes of at least {SMALLEST_M} m and at most {LARGEST_M:g} m",
        )
