"""Frames of unseen traffic, and which of their boxes a detector should find.

A frame holds every box of a recorded moment. The ground truth are those vehicles whose centre is in the region of
interest: one box a vehicle (the parts of an articulated one have a box each), whether a beam meets it or not - a blind
spot is the site's fault. People on foot and on bicycles are in the frame, and in the way, but no vehicles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import tables
from pipeline.core.errors import InputError
from pipeline.core.grid import Roi

BOX = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
"""Columns of a box of ground truth or of a detection: its centre in the world frame, its size, its heading."""

CARS = frozenset({"passenger", "taxi", "evehicle", "hov", "private", "vip", "authority"})
"""SUMO vClasses that are cars."""

NO_VEHICLES = frozenset({"pedestrian", "bicycle", "scooter", "wheelchair"})
"""SUMO vClasses that no detector of vehicles is asked to find."""


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
        (n, 7) float64, as :data:`BOX`.
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

    def wanted(self, roi: Roi) -> NDArray[np.int64]:
        """The rows that are ground truth: vehicles whose centre is in the region of interest (half-open, as voxels)."""
        centre = self.boxes[:, :3] - np.asarray(roi.origin_m)
        inside = ((centre >= 0.0) & (centre < np.asarray(roi.size_m))).all(axis=1)
        motor = np.array([kind not in NO_VEHICLES for kind in self.kinds], dtype=np.bool_)
        return np.flatnonzero(inside & motor)


def read(path: Path, numbers: NDArray[np.int64]) -> Iterator[TrafficFrame]:
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
    columns = ["frame", "vehicle", "part", "kind", *BOX, "pitch_rad"]
    left = list(numbers.tolist())
    with tables.reader(path, "trajectories") as (file, _):
        last = -1
        for group in range(file.num_row_groups):
            table = tables.read_group(file, group, path, columns)
            frame = table.column("frame").to_numpy().astype(np.int64)
            if not len(frame):
                continue
            if np.any(np.diff(frame) < 0) or frame[0] <= last:
                raise InputError(path, f"frames are out of order near frame {frame[0]}", "rows sorted by frame")
            last = int(frame[-1])
            values = np.column_stack([table.column(name).to_numpy() for name in (*BOX, "pitch_rad")])
            part = table.column("part").to_numpy().astype(np.int64)
            names, kinds = table.column("vehicle").to_pylist(), table.column("kind").to_pylist()
            while left and left[0] <= last:
                number = left.pop(0)
                rows = slice(*np.searchsorted(frame, [number, number + 1]).tolist())
                boxes, pitch = values[rows, :7], values[rows, 7].copy()
                yield TrafficFrame(number, tuple(names[rows]), tuple(kinds[rows]), boxes, pitch, part[rows].copy())
    for number in left:
        yield TrafficFrame(number, (), (), np.empty((0, 7)), np.empty(0))
