"""Recorded frames: boxes near a grid, vehicles of a frame.

Artefacts as arrays and tables, for notebooks, stages, and people who want to compute further.

Each reader checks what it reads and says which file is wrong. Tables come as Arrow tables (``.to_pandas()`` makes a
data frame of one), grids as NumPy arrays.

Reads the vehicle boxes of a recording back, some whole frames at a time, in a grid's own frame.

Frames of recorded traffic, and which of their boxes a site should see.

A frame holds every box of a recorded moment. To be seen are those vehicles whose centre is in the region of interest:
one box a vehicle (the parts of an articulated one have a box each), whether a beam meets it or not - a blind spot is
the site's fault. People on foot and on bicycles are in the frame, and in the way, but no vehicles.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from egvs.artefacts import parquet
from egvs.core.errors import InputError
from egvs.core.grid import Roi


def read_trajectories(path: str | Path) -> pa.Table:
    """Read ``trajectories.parquet``."""
    return parquet.read_artefact(Path(path), "trajectories")[0]


BOX_COLUMNS = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
"""Columns of a box of ground truth or of a detection: its centre in the world frame, its size, its heading."""

NON_VEHICLE_KINDS = frozenset({"pedestrian", "bicycle", "scooter", "wheelchair"})
"""SUMO vClasses that are no vehicles: nobody who looks for vehicles is asked to find them."""


@dataclass(frozen=True)
class TrafficFrame:
    """Every box of one frame.

    Attributes
    ----------
    number
        Of the frame in its record.
    vehicles, kinds
        SUMO's identifier and vClass of each box.
    boxes
        (n, 7) float64, as :data:`BOX_COLUMNS`.
    pitch_rad
        Nose up, (n,) float64.
    part
        0, or 1.. for the rear parts of an articulated vehicle, (n,) int64; all 0 where it is not given.
    """

    number: int
    vehicles: tuple[str, ...]
    kinds: tuple[str, ...]
    boxes: NDArray[np.float64]
    pitch_rad: NDArray[np.float64]
    part: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    def __post_init__(self) -> None:
        if not len(self.part):
            object.__setattr__(self, "part", np.zeros(len(self.boxes), dtype=np.int64))

    def several_parts(self) -> NDArray[np.bool_]:
        """Which boxes are of vehicles with more than one part, (n,)."""
        jointed = {name for name, part in zip(self.vehicles, self.part.tolist(), strict=True) if part}
        return np.array([name in jointed for name in self.vehicles], dtype=np.bool_)

    def are_vehicles(self) -> NDArray[np.bool_]:
        """Which boxes are vehicles or parts of them, (n,)."""
        return np.array([kind not in NON_VEHICLE_KINDS for kind in self.kinds], dtype=np.bool_)

    def target_rows(self, roi: Roi, people: Collection[str] = ()) -> NDArray[np.int64]:
        """The rows that are to be seen: vehicles whose centre is in the region of interest (half-open, as voxels), and
        those of :data:`NON_VEHICLE_KINDS` that ``people`` names."""
        centre = self.boxes[:, :3] - np.asarray(roi.origin_m)
        inside = ((centre >= 0.0) & (centre < np.asarray(roi.size_m))).all(axis=1)
        named = np.array([kind in people for kind in self.kinds], dtype=np.bool_)
        return np.flatnonzero(inside & (self.are_vehicles() | named))


def spaced_frames(recorded: int, count: int) -> NDArray[np.int64]:
    """Some of the frames 0 .. recorded - 1, evenly spaced: the middles of ``count`` equal parts; all when 0 or more
    are wanted."""
    if count == 0 or count >= recorded:
        return np.arange(recorded, dtype=np.int64)
    return (2 * np.arange(count, dtype=np.int64) + 1) * recorded // (2 * count)


def read_frames(path: Path, numbers: NDArray[np.int64]) -> Iterator[TrafficFrame]:
    """Some frames of ``trajectories.parquet``, in order; a frame without any box is told as such.

    Parameters
    ----------
    numbers
        Of the frames, ascending.

    Raises
    ------
    InputError
        For a file that is corrupt or out of order.
    """
    columns = ["frame", "vehicle", "part", "kind", *BOX_COLUMNS, "pitch_rad"]
    left = list(numbers.tolist())
    with parquet.open_artefact(path, "trajectories") as (file, _):
        last = -1
        for group in range(file.num_row_groups):
            table = parquet.read_row_group(file, group, path, columns)
            frame = table.column("frame").to_numpy().astype(np.int64)
            if not len(frame):
                continue
            if np.any(np.diff(frame) < 0) or frame[0] <= last:
                raise InputError(path, f"frames are out of order near frame {frame[0]}", "rows sorted by frame")
            last = int(frame[-1])
            values = np.column_stack([table.column(name).to_numpy() for name in (*BOX_COLUMNS, "pitch_rad")])
            part = table.column("part").to_numpy().astype(np.int64)
            names, kinds = table.column("vehicle"), table.column("kind")
            while left and left[0] <= last:
                number = left.pop(0)
                rows = slice(*np.searchsorted(frame, [number, number + 1]).tolist())
                boxes, pitch, its_part = values[rows, :7], values[rows, 7].copy(), part[rows].copy()
                vehicles = tuple(names[rows].to_pylist())  # of these rows alone: text is slow to make
                yield TrafficFrame(number, vehicles, tuple(kinds[rows].to_pylist()), boxes, pitch, its_part)
    for number in left:
        yield TrafficFrame(number, (), (), np.empty((0, 7)), np.empty(0))
