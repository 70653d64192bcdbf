"""Vehicle boxes of ``trajectories.parquet``, some complete frames at a time, in the frame of a grid."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from egvs.artefacts import parquet
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, Grid, IntArray

NON_VEHICLE_KINDS = frozenset({"pedestrian", "bicycle", "scooter", "wheelchair"})
"""SUMO vClasses that are not vehicles, and not expected to be detected as such."""

PITCHED_BOX_COLUMNS = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad", "length_m", "width_m", "height_m")

UNKNOWN_BOXES_KEY = "unknown_boxes"
"""Key of the metadata with the gaps in recorded tracks during which positions are unknown, only where there are some;
see ``RecordedTracks.unknown_boxes`` of the extension tracks."""

MIN_BOX_M, MAX_BOX_M = 1e-3, 2000.0
"""Limits of the sizes of a box: it must stay a box when it is made smaller on each side, and no train is longer."""


@dataclass(frozen=True)
class FrameBoxes:
    """Vehicle boxes of some complete frames.

    Attributes
    ----------
    frame
        Frame of each box, (n,) int64, ascending.
    values
        Boxes as :data:`PITCHED_BOX_COLUMNS`, (n, 8) float64; the centre is in the frame of the grid.
    """

    frame: IntArray
    values: FloatArray


def read_boxes(path: Path, grid: Grid, frames: IntArray | None = None) -> Iterator[FrameBoxes]:
    """Yield the boxes of ``trajectories.parquet``, row group by row group (each has complete frames).

    Parameters
    ----------
    path
        The file.
    grid
        Grid whose frame the centres are converted to.
    frames
        Only these frames, ascending; row groups without any of them are not read.

    Raises
    ------
    InputError
        For a file that is corrupt or out of order, or an invalid box.
    """
    with parquet.open_artefact(path, "trajectories") as (file, _):
        reader = BoxReader(path, grid)
        column = file.schema_arrow.get_field_index("frame")
        for group in range(file.num_row_groups):
            statistics = file.metadata.row_group(group).column(column).statistics
            if frames is not None and not _may_contain(statistics, frames):
                continue
            table = parquet.read_row_group(file, group, path, ["frame", *PITCHED_BOX_COLUMNS])
            if table.num_rows:
                yield reader.read(table, frames)


class BoxReader:
    """Reads the row groups of ``trajectories.parquet`` in their order; parameters as of :func:`read_boxes`."""

    def __init__(self, path: Path, grid: Grid) -> None:
        self._path, self._grid = path, grid
        self._last_frame = -1

    def read(self, table: pa.Table, frames: IntArray | None = None) -> FrameBoxes:
        """Return the boxes of the next row group, which is not empty; InputError as of :func:`read_boxes`."""
        frame = table.column("frame").to_numpy().astype(np.int64)
        check_frame_order(self._path, frame, self._last_frame)
        self._last_frame = int(frame[-1])
        selected = slice(None) if frames is None else np.isin(frame, frames)
        values = np.column_stack([table.column(name).to_numpy()[selected] for name in PITCHED_BOX_COLUMNS])
        _check_box_values(self._path, frame[selected], values)
        values[:, :3] = self._grid.to_grid_m(values[:, :3])
        return FrameBoxes(frame[selected], values)


def check_frame_order(path: Path, frame: IntArray, last_frame: int) -> None:
    """Raise InputError unless the frames of a row group ascend and follow the last frame of the group before."""
    if np.any(np.diff(frame) < 0) or frame[0] <= last_frame:
        raise InputError(path, f"frames are out of order near frame {frame[0]}", "Sort the rows by frame.")


def _may_contain(statistics: Any, frames: IntArray) -> bool:
    """Whether a row group may contain one of these frames; True where the file has no statistics."""
    if statistics is None or not statistics.has_min_max:
        return True
    return bool(np.searchsorted(frames, statistics.min) < np.searchsorted(frames, statistics.max, side="right"))


def _check_box_values(path: Path, frame: IntArray, values: FloatArray) -> None:
    sizes = values[:, 5:8]
    has_valid_size = ((sizes >= MIN_BOX_M) & (sizes <= MAX_BOX_M)).all(axis=1)
    is_valid = np.isfinite(values).all(axis=1) & has_valid_size
    if is_valid.all():
        return
    bad = int(np.flatnonzero(~is_valid)[0])
    shown = ", ".join(f"{name} = {value:g}" for name, value in zip(PITCHED_BOX_COLUMNS, values[bad], strict=True))
    problem = f"expected finite values and sizes from {MIN_BOX_M} m to {MAX_BOX_M:g} m, got {shown}"
    raise InputError(f"{path}: frame {frame[bad]}", problem, "Correct the recording, then run the traffic stage again.")
