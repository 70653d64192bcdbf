"""What the files of each format look like: where points and labels of a frame go, and how they are written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.formats import kitti, pcd, ply

Points = NDArray[np.float32]
Owner = NDArray[np.int32]


@dataclass(frozen=True)
class Layout:
    """One format.

    Attributes
    ----------
    points, suffix
        Folder and suffix of the clouds.
    write_points
        Writes one cloud: points (n, 4) float32, and the object that each lies on, -1 for none.
    point_bytes
        Of one point.
    labels, label_text
        Folder of the labels, and the text of one file by classes and boxes (n, 7); empty and None where there is none.
    calibration
        The text of each file in ``calib``; empty where there is none.
    about_points, about_labels
        For people.
    """

    points: str
    suffix: str
    write_points: Callable[[Path, Points, Owner], None]
    point_bytes: int
    about_points: str
    labels: str = ""
    label_text: Callable[[Sequence[str], NDArray[np.float64]], str] | None = None
    about_labels: str = ""
    calibration: str = ""

    def write_frame(
        self, folder: Path, name: str, points: Points, owner: Owner, classes: Sequence[str], boxes: NDArray[np.float64]
    ) -> None:
        """Write a frame: its points, and its labelled boxes."""
        self.write_points(folder / self.points / f"{name}{self.suffix}", points, owner)
        if self.label_text is not None:
            text = self.label_text(classes, boxes)
            (folder / self.labels / f"{name}.txt").write_bytes(text.encode())
        if self.calibration:
            (folder / "calib" / f"{name}.txt").write_bytes(self.calibration.encode())

    @property
    def folders(self) -> tuple[str, ...]:
        """All folders of a site."""
        return tuple(filter(None, (self.points, self.labels, "calib" if self.calibration else "", "ImageSets")))


def _bin(path: Path, points: Points, _: Owner) -> None:
    path.write_bytes(points.astype("<f4").tobytes())


def _npy(path: Path, points: Points, _: Owner) -> None:
    np.save(path, points.astype("<f4"))


def _columns(points: Points, owner: Owner) -> dict[str, NDArray[np.generic]]:
    x, y, z, intensity = points.T
    return {"x": x, "y": y, "z": z, "intensity": intensity, "object": owner}


def openpcdet_lines(classes: Sequence[str], boxes: NDArray[np.float64]) -> str:
    """The text of a file ``labels/*.txt``: ``x y z dx dy dz heading name``."""
    rows = (" ".join(f"{value:.6f}" for value in box) for box in boxes.tolist())
    return "".join(f"{row} {name}\n" for row, name in zip(rows, classes, strict=True))


_OWNED = "x, y, z, `intensity` (float32) and `object` (int32): its number in `objects.csv`, -1 on the static world"
LAYOUTS: Mapping[str, Layout] = {
    "kitti": Layout(
        "velodyne",
        ".bin",
        _bin,
        16,
        "little-endian float32, four a point: x, y, z, intensity",
        "label_2",
        kitti.lines,
        "KITTI's: class, truncated, occluded, alpha, rectangle in the picture, height width length, x y z of the "
        "middle of the bottom in the camera's frame, turn about its y axis. There is no picture: truncated and "
        "occluded are 0, the rectangle is always 0 0 50 50",
        kitti.CALIBRATION,
    ),
    "openpcdet": Layout(
        "points",
        ".npy",
        _npy,
        16,
        "NumPy arrays (n, 4) float32: x, y, z, intensity",
        "labels",
        openpcdet_lines,
        "one line a box: `x y z dx dy dz heading name`, the box's centre, length, width, height, heading",
    ),
    "ply": Layout(
        "points", ".ply", lambda path, points, owner: ply.write_columns(path, _columns(points, owner)), 20, _OWNED
    ),
    "pcd": Layout(
        "points", ".pcd", lambda path, points, owner: pcd.write_columns(path, _columns(points, owner)), 20, _OWNED
    ),
}
"""By the name that ``--format`` takes."""
