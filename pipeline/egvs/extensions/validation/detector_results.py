"""Classes of objects, and the files of what detectors found.

The class of a box follows from its SUMO vClass. SUMO's default vClass is passenger, also for types of buses and trucks
that name none; so a box with the vClass of a car that is too long for one has the class of its size. Where KITTI has a
name for the class, that name is used:

======================================================================== ==============
SUMO vClass                                                              class
======================================================================== ==============
passenger, taxi, evehicle, hov, private, vip, authority                  ``Car``
the same, longer than 6.5 m; from 10 to 15 m                             ``Truck``; ``Bus``
delivery, emergency                                                      ``Van``
truck, trailer, army                                                     ``Truck``
the rear parts of an articulated vehicle, except of a bus or a tram      ``Trailer``
bus, coach                                                               ``Bus``
tram, rail, rail_urban, rail_electric, rail_fast, subway, cable_car      ``Tram``
motorcycle, moped                                                        ``Motorcycle``
bicycle, scooter                                                         ``Cyclist``
pedestrian, wheelchair                                                   ``Pedestrian``
all others                                                               ``Misc``
======================================================================== ==============

Results are cached by site and detector: ``detections.parquet`` with the boxes of a detector, and ``points.parquet``
with the number of points on each vehicle. The latter belongs to ``points``, a detector that returns no boxes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egvs.artefacts import parquet
from egvs.artefacts.traffic_frames import BOX_COLUMNS, TrafficFrame
from egvs.clouds.simulation import BUS_LENGTHS_M
from egvs.clouds.sweeps import Detections
from egvs.core import files
from egvs.core.grid import FloatArray, IntArray, Roi

CLASSES = ("Car", "Van", "Truck", "Trailer", "Bus", "Tram", "Motorcycle", "Cyclist", "Pedestrian", "Misc")
"""All classes, in the order of listings."""

CAR_VCLASSES = frozenset({"passenger", "taxi", "evehicle", "hov", "private", "vip", "authority"})
"""SUMO vClasses of cars."""

_TRAM_VCLASSES = ("tram", "rail", "rail_urban", "rail_electric", "rail_fast", "subway", "cable_car")

_CLASS_BY_VCLASS = {
    **dict.fromkeys(CAR_VCLASSES, "Car"),
    "delivery": "Van",
    "emergency": "Van",
    "truck": "Truck",
    "trailer": "Truck",
    "army": "Truck",
    "bus": "Bus",
    "coach": "Bus",
    **dict.fromkeys(_TRAM_VCLASSES, "Tram"),
    "motorcycle": "Motorcycle",
    "moped": "Motorcycle",
    "bicycle": "Cyclist",
    "scooter": "Cyclist",
    "pedestrian": "Pedestrian",
    "wheelchair": "Pedestrian",
}


MAX_CAR_LENGTH_M = 6.5


def object_class(vclass: str, length_m: float, part: int = 0) -> str:
    """Return the class of a box; ``part`` is above 0 for the rear parts of an articulated vehicle."""
    name = _CLASS_BY_VCLASS.get(vclass, "Misc")
    if part and name not in ("Bus", "Tram"):
        return "Trailer"
    if vclass in CAR_VCLASSES and length_m > MAX_CAR_LENGTH_M:
        return "Bus" if BUS_LENGTHS_M[0] <= length_m <= BUS_LENGTHS_M[1] else "Truck"
    return name


def frame_classes(frame: TrafficFrame) -> tuple[str, ...]:
    """Return the class of each box of a frame."""
    return tuple(map(object_class, frame.kinds, frame.boxes[:, 3].tolist(), frame.part.tolist()))


def detections_in_roi(detections: Detections, roi: Roi) -> Detections:
    """Return the detections whose centre lies in the region of interest, seen from above."""
    xy_m = detections.boxes[:, :2] - np.asarray(roi.origin_m[:2])
    inside = ((xy_m >= 0.0) & (xy_m < np.asarray(roi.size_m[:2]))).all(axis=1)
    return Detections(detections.boxes[inside], detections.scores[inside])


POINT_COUNTS_NAME = "points"
"""The detector name under which points on vehicles are counted."""


@dataclass(frozen=True)
class PointCounts:
    """Number of points on the vehicles of each frame that a detector should find.

    Attributes
    ----------
    points
        One array per frame, (vehicles,) int64, in the order of
        :meth:`egvs.artefacts.traffic_frames.TrafficFrame.target_rows`.
    """

    points: tuple[IntArray, ...]

    def write(self, path: Path, metadata: dict[str, Any]) -> None:
        """Write ``points.parquet``."""
        frame = _frame_of_row([len(points) for points in self.points])
        columns = {"frame": frame, "points": np.concatenate([np.empty(0, np.int64), *self.points])}
        _write_frames(path, "points", columns, len(self.points), metadata)

    @classmethod
    def read(cls, path: Path) -> PointCounts:
        """Read ``points.parquet``."""
        table, metadata = parquet.read_artefact(path, "points")
        frame = table.column("frame").to_numpy().astype(np.int64)
        points = table.column("points").to_numpy().astype(np.int64)
        return cls(tuple(np.split(points, np.searchsorted(frame, np.arange(1, metadata["frames"])))))


@dataclass(frozen=True)
class DetectedBoxes:
    """Detections of each frame whose centre lies in the region of interest."""

    frames: tuple[Detections, ...]

    @property
    def digest(self) -> str:
        """Hash of all boxes and scores."""
        return files.hash_json([[frame.boxes.tolist(), frame.scores.tolist()] for frame in self.frames])

    def write(self, path: Path, metadata: dict[str, Any]) -> None:
        """Write ``detections.parquet``."""
        frame = _frame_of_row([len(detections.scores) for detections in self.frames])
        boxes = concatenate_boxes(detections.boxes for detections in self.frames)
        scores = np.concatenate([np.empty(0), *(detections.scores for detections in self.frames)])
        columns = {"frame": frame, **dict(zip(BOX_COLUMNS, boxes.T, strict=True)), "score": scores}
        _write_frames(path, "detections", columns, len(self.frames), metadata)

    @classmethod
    def read(cls, path: Path) -> DetectedBoxes:
        """Read ``detections.parquet``."""
        table, metadata = parquet.read_artefact(path, "detections")
        frame = table.column("frame").to_numpy().astype(np.int64)
        starts = np.searchsorted(frame, np.arange(1, metadata["frames"]))
        boxes = np.split(np.column_stack([table.column(name).to_numpy() for name in BOX_COLUMNS]), starts)
        scores = np.split(table.column("score").to_numpy(), starts)
        return cls(tuple(map(Detections, boxes, scores)))


DetectorResult = PointCounts | DetectedBoxes


def concatenate_boxes(boxes: Iterable[FloatArray]) -> FloatArray:
    """Return the boxes of all frames, (n, 7) float64, also where there is no frame."""
    return np.concatenate([np.empty((0, len(BOX_COLUMNS))), *boxes])


def _write_frames(path: Path, name: str, columns: dict[str, Any], frames: int, metadata: dict[str, Any]) -> None:
    parquet.write_artefact(path, name, columns, {"schema": parquet.SCHEMA_VERSION, "frames": frames, **metadata})


def _frame_of_row(counts: Sequence[int]) -> IntArray:
    """Return the frame of each row, where frames have these numbers of rows."""
    return np.repeat(np.arange(len(counts)), counts)
