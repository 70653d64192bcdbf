r"""The files of one site of a dataset: point clouds, labels, split, and a summary.

A box is labelled if a point of the sweep is on it, wherever it is: a detector that is trained on these labels must not
learn that vehicles outside the region of interest are background. ``objects.csv`` contains all boxes, visible or not,
and marks the ground truth of ``egvs validate`` (vehicles whose centre is in the region of interest).

**Level frame** of exported points and boxes: its origin is the sensor, its z axis is vertical. A sensor may be tilted,
but boxes of KITTI and OpenPCDet have no angle except their heading. So points are rotated by the sensor's roll and
pitch, and its yaw remains: x is level and points along the site's yaw, y to the left, z up. For an untilted sensor this
is exactly the sensor's frame.

.. math:: p_{level} = R_y(-pitch)\, R_x(roll)\, p_{sensor}, \qquad p_{world} = R_z(yaw)\, p_{level} + t
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds.simulation import CloudSimulator, sweep_rng
from egvs.core import files
from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.core.progress import ProgressCallback
from egvs.core.threads import map_ordered
from egvs.extensions.validation import detector_results, kitti
from egvs.extensions.validation.held_out_traffic import HeldOutTraffic
from egvs.extensions.validation.kitti import wrap_angle
from egvs.formats import pcd, ply
from egvs.sensors.sensor import rotation_world_sensor
from egvs.sensors.sites import Pose

Points = NDArray[np.float32]
Owner = NDArray[np.int32]

TRAINING_SHARE = 0.8
"""Share of the frames that are for training, from the first one; the others are for validation."""

MIN_POINTS_TO_PASTE = 10
"""Points of an object from which OpenPCDet may paste it into other frames."""

OBJECT_COLUMNS = (
    *("frame", "object", "vehicle", "part", "kind", "class", "points", "in_roi"),
    *("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad", "pitch_rad"),
)
"""Columns of ``objects.csv``, one row per box and frame."""


@dataclass(frozen=True)
class Layout:
    """The files of one dataset format.

    Attributes
    ----------
    points, suffix
        Folder and suffix of the point clouds.
    write_points
        Writes one cloud: points (n, 4) float32, and the row of the box that each is on, -1 for none.
    point_bytes
        Size of one point.
    points_description
        For the README.
    labels, label_text
        Folder of the labels, and a function that returns the text of one file from classes and boxes (n, 7); empty and
        None for a format without labels.
    labels_description
        For the README.
    calibration
        Text of each file in ``calib``; empty for a format without calibrations.
    """

    points: str
    suffix: str
    write_points: Callable[[Path, Points, Owner], None]
    point_bytes: int
    points_description: str
    labels: str = ""
    label_text: Callable[[Sequence[str], FloatArray], str] | None = None
    labels_description: str = ""
    calibration: str = ""

    def write_frame(
        self, folder: Path, name: str, points: Points, owner: Owner, classes: Sequence[str], boxes: FloatArray
    ) -> None:
        """Write the points and the labelled boxes of a frame."""
        self.write_points(folder / self.points / f"{name}{self.suffix}", points, owner)
        if self.label_text is not None:
            text = self.label_text(classes, boxes)
            (folder / self.labels / f"{name}.txt").write_bytes(text.encode())
        if self.calibration:
            (folder / "calib" / f"{name}.txt").write_bytes(self.calibration.encode())

    @property
    def folders(self) -> tuple[str, ...]:
        """All folders of a site."""
        folders = [self.points, "ImageSets"]
        if self.labels:
            folders.append(self.labels)
        if self.calibration:
            folders.append("calib")
        return tuple(folders)


def _write_bin(path: Path, points: Points, _: Owner) -> None:
    path.write_bytes(points.astype("<f4").tobytes())


def _write_npy(path: Path, points: Points, _: Owner) -> None:
    np.save(path, points.astype("<f4"))


def _write_ply(path: Path, points: Points, owner: Owner) -> None:
    ply.write_columns(path, _point_columns(points, owner))


def _write_pcd(path: Path, points: Points, owner: Owner) -> None:
    pcd.write_columns(path, _point_columns(points, owner))


def _point_columns(points: Points, owner: Owner) -> dict[str, NDArray[np.generic]]:
    x, y, z, intensity = points.T
    return {"x": x, "y": y, "z": z, "intensity": intensity, "object": owner}


def openpcdet_lines(classes: Sequence[str], boxes: FloatArray) -> str:
    """Return the text of a file ``labels/*.txt``: ``x y z dx dy dz heading name``."""
    lines = []
    for box, name in zip(boxes.tolist(), classes, strict=True):
        lines.append(" ".join(f"{value:.6f}" for value in box) + f" {name}\n")
    return "".join(lines)


_COLUMNS_DESCRIPTION = (
    "x, y, z, `intensity` (float32) and `object` (int32): its number in `objects.csv`, -1 on the static world"
)

LAYOUTS: Mapping[str, Layout] = {
    "kitti": Layout(
        points="velodyne",
        suffix=".bin",
        write_points=_write_bin,
        point_bytes=16,
        points_description="little-endian float32, four per point: x, y, z, intensity",
        labels="label_2",
        label_text=kitti.format_labels,
        labels_description="as in KITTI: class, truncated, occluded, alpha, 2D box, height width length, x y z of the "
        "centre of the bottom in the camera frame, rotation about its y axis. There is no image: truncated and "
        "occluded are 0, the 2D box is always 0 0 50 50",
        calibration=kitti.CALIBRATION,
    ),
    "openpcdet": Layout(
        points="points",
        suffix=".npy",
        write_points=_write_npy,
        point_bytes=16,
        points_description="NumPy arrays (n, 4) float32: x, y, z, intensity",
        labels="labels",
        label_text=openpcdet_lines,
        labels_description="one line per box: `x y z dx dy dz heading name` (centre, length, width, height, heading)",
    ),
    "ply": Layout("points", ".ply", _write_ply, 20, _COLUMNS_DESCRIPTION),
    "pcd": Layout("points", ".pcd", _write_pcd, 20, _COLUMNS_DESCRIPTION),
}
"""Formats by the name that ``--format`` takes."""


@dataclass(frozen=True)
class LevelFrame:
    """The level frame of one pose."""

    pose: Pose

    @property
    def T_world_level(self) -> FloatArray:
        """Transform of points from this frame to the world frame, (4, 4) float64."""
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_world_sensor(self.pose.yaw_deg, 0.0, 0.0)
        matrix[:3, 3] = self.pose.position_m
        return matrix

    @property
    def T_level_sensor(self) -> FloatArray:
        """Transform of points from the sensor's frame to this frame, (4, 4) float64."""
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_world_sensor(0.0, self.pose.pitch_deg, self.pose.roll_deg)
        return matrix

    def points(self, points: Points) -> Points:
        """Convert points of the sensor's frame, x, y, z, intensity (n, 4), to this frame."""
        _, pitch_deg, roll_deg = self.pose.angles_deg
        if pitch_deg == 0.0 and roll_deg == 0.0:
            return points
        level = points.copy()
        level[:, :3] = _rotate(self.T_level_sensor[:3, :3], points[:, :3].astype(np.float64))
        return level

    def boxes(self, boxes: FloatArray) -> FloatArray:
        """Convert boxes of the world frame (n, 7) to this frame, with headings from -pi to pi."""
        yaw_deg, _, _ = self.pose.angles_deg
        relative_m = boxes[:, :3] - np.asarray(self.pose.position_m)
        level = boxes.copy()
        level[:, :3] = _rotate(rotation_world_sensor(yaw_deg, 0.0, 0.0).T, relative_m)
        level[:, 6] = wrap_angle(boxes[:, 6] - np.radians(yaw_deg))
        return level

    def world_boxes(self, boxes: FloatArray) -> FloatArray:
        """Convert boxes of this frame (n, 7) to the world frame."""
        yaw_deg, _, _ = self.pose.angles_deg
        rotated_m = _rotate(rotation_world_sensor(yaw_deg, 0.0, 0.0), boxes[:, :3])
        world = boxes.copy()
        world[:, :3] = rotated_m + np.asarray(self.pose.position_m)
        world[:, 6] = wrap_angle(boxes[:, 6] + np.radians(yaw_deg))
        return world


def box_corners(boxes: FloatArray) -> FloatArray:
    """Return the eight corners of each upright box (n, 7), (n, 8, 3)."""
    signs = np.array(list(product((-0.5, 0.5), repeat=3)))
    local = boxes[:, None, 3:6] * signs
    cos = np.cos(boxes[:, 6:7])
    sin = np.sin(boxes[:, 6:7])
    x = local[..., 0] * cos - local[..., 1] * sin
    y = local[..., 0] * sin + local[..., 1] * cos
    return np.stack([x, y, local[..., 2]], axis=-1) + boxes[:, None, :3]


def _rotate(matrix: FloatArray, points: FloatArray) -> FloatArray:
    """Rotate points (n, 3). Written out, because BLAS may sum in another order on another machine."""
    return points[:, :1] * matrix[:, 0] + points[:, 1:2] * matrix[:, 1] + points[:, 2:3] * matrix[:, 2]


@dataclass
class SiteSummary:
    """Summary of the files of a site, written as ``about.json``.

    Attributes
    ----------
    site, sensor, pose, range_sigma_m
        The site, its sensor, and the noise of its ranges.
    T_world_level, T_level_sensor
        See :class:`LevelFrame`.
    train, val, empty
        Frames of the split; frames without a labelled box are in neither.
    points
        Number of points of all frames.
    boxes, labelled, in_roi, in_roi_labelled
        Number of boxes of all frames; of those with at least one point; of vehicles whose centre is in the region of
        interest; of those of them with at least one point.
    classes, by_size
        Number of labelled boxes by class; of those whose vClass is that of cars, and which are too long for one.
    pasted
        Number of boxes in training frames with at least :data:`MIN_POINTS_TO_PASTE` points, by class.
    anchors
        Mean length, width, height and z of the bottom in the level frame of the labelled boxes, by class.
    low_m, high_m
        Bounding box of all labelled boxes in the region of interest, in the level frame; of all labelled boxes where
        none is in the region; empty where there are none.
    """

    site: str
    sensor: str
    pose: dict[str, float]
    range_sigma_m: float
    T_world_level: list[list[float]]
    T_level_sensor: list[list[float]]
    train: list[str] = field(default_factory=list)
    val: list[str] = field(default_factory=list)
    empty: list[str] = field(default_factory=list)
    points: int = 0
    boxes: int = 0
    labelled: int = 0
    in_roi: int = 0
    in_roi_labelled: int = 0
    classes: Counter[str] = field(default_factory=Counter)
    by_size: Counter[str] = field(default_factory=Counter)
    pasted: Counter[str] = field(default_factory=Counter)
    anchors: dict[str, list[float]] = field(default_factory=dict)
    low_m: list[float] = field(default_factory=list)
    high_m: list[float] = field(default_factory=list)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.train) + len(self.val) + len(self.empty)

    def to_json(self) -> dict[str, Any]:
        """Return the contents of ``about.json``, with the number of frames of each list."""
        counts = {name: len(getattr(self, name)) for name in ("train", "val", "empty")}
        return vars(self) | {"frames": self.frames} | counts

    def add_frame(self, frame: _WrittenFrame, *, in_training: bool) -> None:
        """Count a frame."""
        visible = frame.visible
        if not visible.any():
            self.empty.append(frame.name)
        elif in_training:
            self.train.append(frame.name)
        else:
            self.val.append(frame.name)
        self.points += frame.points
        self.boxes += len(visible)
        self.labelled += int(visible.sum())
        self.in_roi += int(frame.in_roi.sum())
        self.in_roi_labelled += int((visible & frame.in_roi).sum())
        for row in np.flatnonzero(visible):
            self.classes[frame.classes[row]] += 1
            is_car = frame.frame.kinds[row] in detector_results.CAR_VCLASSES
            if is_car and frame.classes[row] not in ("Car", "Trailer"):
                self.by_size[frame.classes[row]] += 1
        if in_training:
            rows = np.flatnonzero(frame.points_on_box >= MIN_POINTS_TO_PASTE)
            self.pasted.update(frame.classes[row] for row in rows)


@dataclass(frozen=True)
class _WrittenFrame:
    """A frame whose files are written.

    Attributes
    ----------
    frame, name
        The frame, and the name of its files.
    points
        Number of points.
    classes, boxes, points_on_box, in_roi
        Of all boxes of the frame, in the level frame.
    """

    frame: TrafficFrame
    name: str
    points: int
    classes: tuple[str, ...]
    boxes: FloatArray
    points_on_box: IntArray
    in_roi: BoolArray

    @property
    def visible(self) -> BoolArray:
        """Which boxes have at least one point, and so a label."""
        return self.points_on_box > 0

    def object_rows(self) -> list[list[str]]:
        """Return its rows of ``objects.csv``."""
        frame = self.frame
        part = frame.part.tolist()
        pitch = frame.pitch_rad.tolist()
        rows = []
        for row, box in enumerate(self.boxes.tolist()):
            identity = [self.name, str(row), frame.vehicles[row], str(part[row]), frame.kinds[row], self.classes[row]]
            counts = [str(self.points_on_box[row]), str(int(self.in_roi[row]))]
            rows.append([*identity, *counts, *(f"{value:.6f}" for value in (*box, pitch[row]))])
        return rows


def frame_name(number: int) -> str:
    """Return the name of a frame's files without a suffix: its number in the recording."""
    return f"{number:06d}"


def write_site(
    folder: Path,
    record: HeldOutTraffic,
    simulator: CloudSimulator,
    layout: Layout,
    threads: int,
    progress: ProgressCallback,
) -> SiteSummary:
    """Write all frames of a site.

    Parameters
    ----------
    folder
        The folder to create.
    record
        The traffic.
    simulator
        Simulates the point clouds of the site.
    layout
        The format.
    threads
        Number of threads.
    progress
        Receives the number of written frames.
    """
    for name in layout.folders:
        (folder / name).mkdir(parents=True)
    view = simulator.view
    frame = LevelFrame(view.pose)
    summary = SiteSummary(
        view.site, view.sensor.name, asdict(view.pose), view.sensor.range_sigma_m,
        frame.T_world_level.tolist(), frame.T_level_sensor.tolist(),
    )  # fmt: skip
    training = set(record.numbers[: max(1, int(TRAINING_SHARE * record.frames + 1e-9))].tolist())
    write_frame = partial(_write_frame, folder, record, simulator, layout)

    all_labels = _Extent()
    labels_in_roi = _Extent()
    size_sums: dict[str, FloatArray] = {}
    with (folder / "objects.csv").open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(OBJECT_COLUMNS)
        for done, written in enumerate(map_ordered(write_frame, record.read(), threads), 1):
            rows.writerows(written.object_rows())
            summary.add_frame(written, in_training=written.frame.number in training)
            all_labels.add(written.boxes[written.visible])
            labels_in_roi.add(written.boxes[written.visible & written.in_roi])
            _add_sizes(size_sums, written)
            progress("frames", done, record.frames)

    extent = labels_in_roi if labels_in_roi.has_boxes else all_labels
    summary.low_m, summary.high_m = extent.bounds()
    for name in sorted(size_sums):
        summary.anchors[name] = (size_sums[name] / summary.classes[name]).round(2).tolist()
    for name in ("train", "val", "empty"):
        lines = [f"{frame}\n" for frame in getattr(summary, name)]
        (folder / "ImageSets" / f"{name}.txt").write_bytes("".join(lines).encode())
    files.write_text(folder / "about.json", json.dumps(summary.to_json(), indent=2, sort_keys=True) + "\n")
    return summary


def _write_frame(
    folder: Path, record: HeldOutTraffic, simulator: CloudSimulator, layout: Layout, frame: TrafficFrame
) -> _WrittenFrame:
    """Simulate and write the point cloud of a frame, with its labels."""
    view = simulator.view
    level = LevelFrame(view.pose)
    cloud = simulator.sweep(frame, sweep_rng(record.scenario.seed, view.site, frame.number))
    boxes = level.boxes(frame.boxes)
    classes = detector_results.frame_classes(frame)
    points_on_box = cloud.points_on(len(boxes))
    labelled = np.flatnonzero(points_on_box)
    name = frame_name(frame.number)
    points = level.points(cloud.sweep.points)
    layout.write_frame(folder, name, points, cloud.owner, [classes[row] for row in labelled], boxes[labelled])
    in_roi = np.zeros(len(boxes), dtype=np.bool_)
    in_roi[frame.target_rows(record.scene.roi)] = True
    return _WrittenFrame(frame, name, len(points), classes, boxes, points_on_box, in_roi)


class _Extent:
    """Bounding box of boxes."""

    def __init__(self) -> None:
        self._low = np.full(3, np.inf)
        self._high = np.full(3, -np.inf)

    @property
    def has_boxes(self) -> bool:
        """Whether any box was added."""
        return bool(np.isfinite(self._low).all())

    def add(self, boxes: FloatArray) -> None:
        """Extend it by boxes (n, 7)."""
        if len(boxes):
            corners = box_corners(boxes).reshape(-1, 3)
            self._low = np.minimum(self._low, corners.min(axis=0))
            self._high = np.maximum(self._high, corners.max(axis=0))

    def bounds(self) -> tuple[list[float], list[float]]:
        """Return the lowest and the highest x, y, z, rounded to millimetres; empty lists without boxes."""
        if not self.has_boxes:
            return [], []
        return self._low.round(3).tolist(), self._high.round(3).tolist()


def _add_sizes(size_sums: dict[str, FloatArray], written: _WrittenFrame) -> None:
    """Add length, width, height and z of the bottom of each labelled box to the sum of its class."""
    for row in np.flatnonzero(written.visible):
        box = written.boxes[row]
        name = written.classes[row]
        size_sums[name] = size_sums.get(name, np.zeros(4)) + np.append(box[3:6], box[2] - box[5] / 2)
