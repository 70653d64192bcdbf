"""What was found from a site: points on each vehicle of each frame, and the boxes of each detector; kept in the store.

The store's unit is one site and one detector. ``points`` is a detector that gives no boxes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import schemas, tables
from pipeline.artefacts.traffic_frames import BOX
from pipeline.core import files
from pipeline.validation.sweeps import Detections

POINTS = "points"
"""The name under which points on vehicles are asked for."""


@dataclass(frozen=True)
class FoundPoints:
    """Points on the vehicles of each frame that a detector should find.

    Attributes
    ----------
    points
        One array a frame, (vehicles,) int64, in the order of
        :meth:`pipeline.artefacts.traffic_frames.TrafficFrame.wanted`.
    """

    points: tuple[NDArray[np.int64], ...]

    def write(self, path: Path, about: dict[str, Any]) -> None:
        """As ``points.parquet``."""
        frame = _frames_of([len(its) for its in self.points])
        columns = {"frame": frame, "points": np.concatenate([np.empty(0, np.int64), *self.points])}
        tables.write(path, "points", columns, {"schema": schemas.VERSION, "frames": len(self.points), **about})

    @classmethod
    def read(cls, path: Path) -> FoundPoints:
        """From ``points.parquet``."""
        table, about = tables.read(path, "points")
        frame = table.column("frame").to_numpy().astype(np.int64)
        points = table.column("points").to_numpy().astype(np.int64)
        return cls(tuple(np.split(points, np.searchsorted(frame, np.arange(1, about["frames"])))))


@dataclass(frozen=True)
class FoundBoxes:
    """Detections of each frame, those whose centre lies in the region of interest."""

    frames: tuple[Detections, ...]

    @property
    def digest(self) -> str:
        """Hash of all boxes and scores."""
        return files.hash_of([[its.boxes.tolist(), its.scores.tolist()] for its in self.frames])

    def write(self, path: Path, about: dict[str, Any]) -> None:
        """As ``detections.parquet``."""
        frame = _frames_of([len(its.scores) for its in self.frames])
        boxes = np.concatenate([np.empty((0, len(BOX))), *(its.boxes for its in self.frames)])
        scores = np.concatenate([np.empty(0), *(its.scores for its in self.frames)])
        columns = {"frame": frame, **dict(zip(BOX, boxes.T, strict=True)), "score": scores}
        tables.write(path, "detections", columns, {"schema": schemas.VERSION, "frames": len(self.frames), **about})

    @classmethod
    def read(cls, path: Path) -> FoundBoxes:
        """From ``detections.parquet``."""
        table, about = tables.read(path, "detections")
        starts = np.searchsorted(table.column("frame").to_numpy().astype(np.int64), np.arange(1, about["frames"]))
        boxes = np.split(np.column_stack([table.column(name).to_numpy() for name in BOX]), starts)
        scores = np.split(table.column("score").to_numpy(), starts)
        return cls(tuple(Detections(b, s) for b, s in zip(boxes, scores, strict=True)))


Found = FoundPoints | FoundBoxes


def _frames_of(counts: Sequence[int]) -> NDArray[np.int64]:
    return np.repeat(np.arange(len(counts)), counts)
