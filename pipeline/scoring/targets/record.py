"""The vehicles of recorded traffic that a site should see, and everything that stands in their way.

Steps: read some frames of ``trajectories.parquet``, evenly spread over the record; lay their boxes out as kernels take
them; work out once for all sites what depends on traffic alone.

To be seen are the vehicles of :meth:`pipeline.artefacts.traffic_frames.TrafficFrame.wanted`: centre in the region of
interest, a box each for the parts of an articulated one, nobody on foot or on a bicycle unless that is asked for. Each
such box in a frame is one *vehicle-frame*, a row here. All other boxes of a frame are in the way.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import tables, traffic_frames
from pipeline.artefacts.traffic_frames import NO_VEHICLES, TrafficFrame
from pipeline.core.grid import Grid
from pipeline.kernels import occlusion
from pipeline.kernels import targets as kernels

FRAMES = 250
"""Frames that are replayed, evenly spread over the record."""

_KERNEL_ORDER = [0, 1, 2, 6, 7, 3, 4, 5]
"""Columns of ``traffic_frames.BOX`` and pitch, as kernels take a box: centre, yaw, pitch, sizes."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class AllBoxes:
    """Every box of the replayed frames, as kernels take them, in the grid's frame.

    Attributes
    ----------
    starts
        Boxes starts[f] to starts[f + 1] are those of frame f, (frames + 1,) int64.
    values
        Centre, yaw, pitch, length, width, height, (b, 8) float64, metres and radians.
    low, high
        Corners of the upright box round each, (b, 3) float64, metres.
    """

    starts: Ints
    values: Floats
    low: Floats
    high: Floats

    @classmethod
    def of(cls, frames: Sequence[TrafficFrame], grid: Grid) -> AllBoxes:
        """From frames, in the world frame."""
        rows = [np.column_stack([frame.boxes, frame.pitch_rad])[:, _KERNEL_ORDER] for frame in frames]
        values = np.ascontiguousarray(np.concatenate([np.empty((0, 8)), *rows]))
        values[:, :3] = grid.to_grid_m(values[:, :3])
        low, high = np.empty((len(values), 3)), np.empty((len(values), 3))
        occlusion.bounds(values, low, high)
        return cls(np.append(0, np.cumsum([len(its) for its in rows], dtype=np.int64)), values, low, high)


@dataclass(frozen=True, eq=False)
class TargetRecord:
    """Vehicle-frames, frame after frame, in the order of the trajectories; n of them.

    Attributes
    ----------
    grid
        Its region of interest is where vehicles are to be seen.
    numbers
        Of the replayed frames in their record, (frames,) int64, ascending; with or without vehicles.
    frame
        Which of ``numbers`` each row belongs to, (n,) int64, ascending.
    vehicles, vehicle
        SUMO's identifiers, sorted; and which of them each row is, (n,) int64.
    kinds, kind
        SUMO's vClasses, sorted; and which of them each row is, (n,) int64.
    part
        0, or 1.. for the rear parts of an articulated vehicle, (n,) int64.
    boxes
        Centre in the world frame, length, width, height, heading, (n, 7) float64, as
        :data:`pipeline.artefacts.traffic_frames.BOX`.
    pitch_rad
        Nose up, (n,) float64.
    gap_m
        Smallest distance in plan from the box's rectangle to that of any other vehicle of the frame, in the region or
        not, (n,) float64; 0 where they overlap, infinity where there is none. The parts of an articulated vehicle are
        one another's neighbours, as they are boxes of their own; people are none.
    all_boxes, row
        Every box of the frames, and which of them each row is, (n,) int64.
    """

    grid: Grid
    numbers: Ints
    frame: Ints
    vehicles: tuple[str, ...]
    vehicle: Ints
    kinds: tuple[str, ...]
    kind: Ints
    part: Ints
    boxes: Floats
    pitch_rad: Floats
    gap_m: Floats
    all_boxes: AllBoxes
    row: Ints

    def __len__(self) -> int:
        """How many vehicle-frames."""
        return len(self.row)

    @property
    def are_people(self) -> NDArray[np.bool_]:
        """Which rows are on foot or on a bicycle, (n,)."""
        return np.array([kind in NO_VEHICLES for kind in self.kinds], dtype=np.bool_)[self.kind]

    @classmethod
    def of(cls, frames: Sequence[TrafficFrame], grid: Grid, people: Collection[str] = ()) -> TargetRecord:
        """From frames, in the order of their record; with ``people`` of these vClasses."""
        boxes = AllBoxes.of(frames, grid)
        wanted = [frame.wanted(grid.roi, people) for frame in frames]
        frame = np.repeat(np.arange(len(frames), dtype=np.int64), [len(rows) for rows in wanted])
        row = boxes.starts[frame] + np.concatenate([np.empty(0, dtype=np.int64), *wanted])
        vehicles, vehicle = _distinct(
            [[its.vehicles[i] for i in rows] for its, rows in zip(frames, wanted, strict=True)]
        )
        kinds, kind = _distinct([[its.kinds[i] for i in rows] for its, rows in zip(frames, wanted, strict=True)])
        motor = np.concatenate([np.empty(0, dtype=np.bool_), *(its.are_vehicles() for its in frames)])
        gap_m = _gaps(boxes, row, motor)
        world = np.concatenate([np.empty((0, 7)), *(its.boxes for its in frames)])[row]
        part = np.concatenate([np.empty(0, dtype=np.int64), *(its.part for its in frames)])[row]
        numbers = np.array([its.number for its in frames], dtype=np.int64)
        pitch = boxes.values[row, 4]
        return cls(grid, numbers, frame, vehicles, vehicle, kinds, kind, part, world, pitch, gap_m, boxes, row)

    @classmethod
    def read(cls, path: Path, grid: Grid, frames: int = FRAMES, people: Collection[str] = ()) -> TargetRecord:
        """From ``trajectories.parquet``: so many frames, evenly spread over all that were recorded; all when 0 or more
        are asked for. With ``people`` of these vClasses.

        Raises
        ------
        InputError
            For a file that is corrupt or out of order.
        """
        recorded = int(tables.read_metadata(path, "trajectories")["frames"])
        return cls.of(list(traffic_frames.read(path, traffic_frames.spread(recorded, frames))), grid, people)


def _distinct(names: Sequence[Sequence[str]]) -> tuple[tuple[str, ...], Ints]:
    """The different names of all frames, sorted, and which of them each is."""
    flat = [name for its in names for name in its]
    known = sorted(set(flat))
    place = {name: i for i, name in enumerate(known)}
    return tuple(known), np.array([place[name] for name in flat], dtype=np.int64)


def _gaps(boxes: AllBoxes, row: Ints, motor: NDArray[np.bool_]) -> Floats:
    """Gap to the nearest neighbour in plan, of the boxes in ``row``."""
    plan, gap_m = np.empty((len(boxes.values), 6)), np.empty(len(boxes.values))
    kernels.footprints(boxes.values, plan)
    asked = np.zeros(len(boxes.values), dtype=np.bool_)
    asked[row] = True
    kernels.gaps(boxes.starts, plan, asked, motor, gap_m)
    return gap_m[row]
