"""Frames of recorded traffic, and the boxes that sites should see in them.

A frame has every box of a recorded moment. Targets are the vehicles whose centre is in the region of interest: one box
per vehicle (each part of an articulated vehicle has its own box), whether or not a beam meets it. Pedestrians and
bicycles are in the frame, and hide what is behind them, but are not vehicles.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa

from egvs.artefacts import parquet
from egvs.artefacts.frame_boxes import NON_VEHICLE_KINDS, check_frame_order
from egvs.core.grid import BoolArray, FloatArray, IntArray, Roi


def read_trajectories(path: str | Path) -> pa.Table:
    """Read ``trajectories.parquet`` as an Arrow table."""
    return parquet.read_artefact(Path(path), "trajectories")[0]


BOX_COLUMNS = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
"""Columns of a box of ground truth or of a detection: centre in the world frame, size, heading."""


@dataclass(frozen=True)
class TrafficFrame:
    """Every box of one frame.

    Attributes
    ----------
    number
        Number of the frame in its record.
    vehicles, kinds
        SUMO's id and vClass of each box.
    boxes
        Boxes as :data:`BOX_COLUMNS`, (n, 7) float64.
    pitch_rad
        Pitch of each box, nose up, (n,) float64.
    part
        0, or 1.. for the rear parts of an articulated vehicle, (n,) int64; all 0 by default.
    """

    number: int
    vehicles: tuple[str, ...]
    kinds: tuple[str, ...]
    boxes: FloatArray
    pitch_rad: FloatArray
    part: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    def __post_init__(self) -> None:
        if not len(self.part):
            object.__setattr__(self, "part", np.zeros(len(self.boxes), dtype=np.int64))

    def several_parts(self) -> BoolArray:
        """Return which boxes belong to vehicles with more than one part, (n,) bool."""
        vehicles = np.array(self.vehicles, dtype=np.str_)
        return np.isin(vehicles, vehicles[self.part > 0])

    def are_vehicles(self) -> BoolArray:
        """Return which boxes are vehicles or parts of them, (n,) bool."""
        return np.isin(self.kinds, list(NON_VEHICLE_KINDS), invert=True)

    def target_rows(self, roi: Roi, people: Collection[str] = ()) -> IntArray:
        """Return the rows of the targets: vehicles whose centre is in the region of interest (half-open, as voxels).

        ``people`` names those of :data:`NON_VEHICLE_KINDS` that are targets too.
        """
        centre = self.boxes[:, :3] - np.asarray(roi.origin_m)
        inside = ((centre >= 0.0) & (centre < np.asarray(roi.size_m))).all(axis=1)
        return np.flatnonzero(inside & (self.are_vehicles() | np.isin(self.kinds, list(people))))


def spaced_frames(recorded: int, count: int) -> IntArray:
    """Return ``count`` evenly spaced frames of 0 to ``recorded`` - 1, the middles of equal parts, ascending int64.

    All frames where ``count`` is 0, or not below their number.
    """
    if count == 0 or count >= recorded:
        return np.arange(recorded, dtype=np.int64)
    return (2 * np.arange(count, dtype=np.int64) + 1) * recorded // (2 * count)


def read_frames(path: Path, numbers: IntArray) -> Iterator[TrafficFrame]:
    """Yield some frames of ``trajectories.parquet``, in order; also those without any box.

    Parameters
    ----------
    path
        The file.
    numbers
        Numbers of the frames, ascending.

    Raises
    ------
    InputError
        For a file that is corrupt or out of order.
    """
    columns = ["frame", "vehicle", "part", "kind", *BOX_COLUMNS, "pitch_rad"]
    remaining = list(numbers.tolist())
    with parquet.open_artefact(path, "trajectories") as (file, _):
        last_frame = -1
        for group in range(file.num_row_groups):
            table = parquet.read_row_group(file, group, path, columns)
            frame = table.column("frame").to_numpy().astype(np.int64)
            if not len(frame):
                continue
            check_frame_order(path, frame, last_frame)
            last_frame = int(frame[-1])
            values = np.column_stack([table.column(name).to_numpy() for name in (*BOX_COLUMNS, "pitch_rad")])
            part = table.column("part").to_numpy().astype(np.int64)
            while remaining and remaining[0] <= last_frame:
                number = remaining.pop(0)
                rows = slice(*np.searchsorted(frame, [number, number + 1]).tolist())
                vehicles = table.column("vehicle")[rows].to_pylist()  # of these rows only: making text is slow
                kinds = table.column("kind")[rows].to_pylist()
                pitch_rad = values[rows, 7].copy()
                yield TrafficFrame(
                    number, tuple(vehicles), tuple(kinds), values[rows, :7], pitch_rad, part[rows].copy()
                )
    for number in remaining:
        yield TrafficFrame(number, (), (), np.empty((0, 7)), np.empty(0))
