"""Vehicle boxes of ``trajectories.parquet``, some whole frames at a time, in a grid's own frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts import parquet
from egvs.core.errors import InputError
from egvs.core.grid import Grid

PITCHED_BOX_COLUMNS = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad", "length_m", "width_m", "height_m")
MIN_BOX_M, MAX_BOX_M = 1e-3, 2000.0
"""What is smaller than this is no box: it must stay one when it is made smaller on each side; what is larger than any
train, no vehicle."""


@dataclass(frozen=True)
class FrameBoxes:
    """Vehicle boxes of some whole frames."""

    frame: NDArray[np.int64]
    """(n,), ascending."""
    values: NDArray[np.float64]
    """(n, 8), as ``COLUMNS``; the centre in the grid's frame."""


def read_boxes(path: Path, grid: Grid, frames: NDArray[np.int64] | None = None) -> Iterator[FrameBoxes]:
    """Boxes of ``trajectories.parquet``, row group by row group (each holds whole frames).

    Parameters
    ----------
    frames
        Only these frames, ascending; row groups that hold none of them are not read.

    Raises
    ------
    InputError
        For a file that is corrupt or out of order, or a box that is none.
    """
    with parquet.open_artefact(path, "trajectories") as (file, _):
        last, column = -1, file.schema_arrow.get_field_index("frame")
        for group in range(file.num_row_groups):
            statistics = file.metadata.row_group(group).column(column).statistics
            if frames is not None and not _may_contain(statistics, frames):
                continue
            table = parquet.read_row_group(file, group, path, ["frame", *PITCHED_BOX_COLUMNS])
            if not len(frame := table.column("frame").to_numpy().astype(np.int64)):
                continue
            if np.any(np.diff(frame) < 0) or frame[0] <= last:
                raise InputError(path, f"frames are out of order near frame {frame[0]}", "rows sorted by frame")
            last = int(frame[-1])
            kept = slice(None) if frames is None else np.isin(frame, frames)
            values = np.column_stack([table.column(name).to_numpy()[kept] for name in PITCHED_BOX_COLUMNS])
            _check_box_values(path, frame[kept], values)
            values[:, :3] = grid.to_grid_m(values[:, :3])
            yield FrameBoxes(frame[kept], values)


def _may_contain(statistics: Any, frames: NDArray[np.int64]) -> bool:
    """Whether a row group may hold one of these frames; yes where the file does not say which it holds."""
    if statistics is None or not statistics.has_min_max:
        return True
    return bool(np.searchsorted(frames, statistics.min) < np.searchsorted(frames, statistics.max, side="right"))


def _check_box_values(path: Path, frame: NDArray[np.int64], values: NDArray[np.float64]) -> None:
    of_vehicles = (values[:, 5:8] >= MIN_BOX_M) & (values[:, 5:8] <= MAX_BOX_M)
    sound = np.isfinite(values).all(axis=1) & of_vehicles.all(axis=1)
    if not sound.all():
        bad = int(np.flatnonzero(~sound)[0])
        shown = ", ".join(f"{name} = {value:g}" for name, value in zip(PITCHED_BOX_COLUMNS, values[bad], strict=True))
        raise InputError(
            f"{path}: frame {frame[bad]}",
            f"a box with {shown}",
            f"finite values, sizes of at least {MIN_BOX_M} m and at most {MAX_BOX_M:g} m",
        )
