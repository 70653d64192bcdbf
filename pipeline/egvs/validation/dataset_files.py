r"""Files of one site: clouds, labels, split, level frame.

What the files of each format look like: where points and labels of a frame go, and how they are written.

The frame that exported points and boxes stand in: the sensor's place, its yaw, and a z axis that is up.

A sensor may be tilted, but a box of KITTI or OpenPCDet has no angle save its heading about the vertical. So points are
turned by the sensor's roll and pitch, and the yaw is left: x is level and points along the site's yaw, y to the left,
z up. For a sensor that is not tilted this is the sensor's own frame, to the bit.

.. math:: p_{level} = R_y(-pitch)\, R_x(roll)\, p_{sensor}, \qquad p_{world} = R_z(yaw)\, p_{level} + t

Writes the folder of one site: clouds, labels, the split, every box of every frame, and what there is of it.

A box is labelled when a beam of the sweep met it, wherever it is: a detector that is trained on these labels must not
be told that a car outside the region of interest is none. ``objects.csv`` has all boxes, seen or not, and says which
are ground truth of validation (vehicles whose centre is in the region of interest).
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core import files
from egvs.core.runtime import ProgressCallback, map_ordered
from egvs.formats import kitti, pcd, ply
from egvs.formats.kitti import wrap_angle
from egvs.sensors.sensor import rotation_world_sensor
from egvs.sensors.sites import Pose
from egvs.validation import sweeps
from egvs.validation.cloud_simulation import CloudSimulator, sweep_rng
from egvs.validation.held_out_traffic import HeldOutTraffic

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
    points_description: str
    labels: str = ""
    label_text: Callable[[Sequence[str], NDArray[np.float64]], str] | None = None
    labels_description: str = ""
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


def _write_bin(path: Path, points: Points, _: Owner) -> None:
    path.write_bytes(points.astype("<f4").tobytes())


def _write_npy(path: Path, points: Points, _: Owner) -> None:
    np.save(path, points.astype("<f4"))


def _point_columns(points: Points, owner: Owner) -> dict[str, NDArray[np.generic]]:
    x, y, z, intensity = points.T
    return {"x": x, "y": y, "z": z, "intensity": intensity, "object": owner}


def openpcdet_lines(classes: Sequence[str], boxes: NDArray[np.float64]) -> str:
    """The text of a file ``labels/*.txt``: ``x y z dx dy dz heading name``."""
    rows = (" ".join(f"{value:.6f}" for value in box) for box in boxes.tolist())
    return "".join(f"{row} {name}\n" for row, name in zip(rows, classes, strict=True))


_COLUMNS_NOTE = (
    "x, y, z, `intensity` (float32) and `object` (int32): its number in `objects.csv`, -1 on the static world"
)
LAYOUTS: Mapping[str, Layout] = {
    "kitti": Layout(
        "velodyne",
        ".bin",
        _write_bin,
        16,
        "little-endian float32, four a point: x, y, z, intensity",
        "label_2",
        kitti.format_labels,
        "KITTI's: class, truncated, occluded, alpha, rectangle in the picture, height width length, x y z of the "
        "middle of the bottom in the camera's frame, turn about its y axis. There is no picture: truncated and "
        "occluded are 0, the rectangle is always 0 0 50 50",
        kitti.CALIBRATION,
    ),
    "openpcdet": Layout(
        "points",
        ".npy",
        _write_npy,
        16,
        "NumPy arrays (n, 4) float32: x, y, z, intensity",
        "labels",
        openpcdet_lines,
        "one line a box: `x y z dx dy dz heading name`, the box's centre, length, width, height, heading",
    ),
    "ply": Layout(
        "points",
        ".ply",
        lambda path, points, owner: ply.write_columns(path, _point_columns(points, owner)),
        20,
        _COLUMNS_NOTE,
    ),
    "pcd": Layout(
        "points",
        ".pcd",
        lambda path, points, owner: pcd.write_columns(path, _point_columns(points, owner)),
        20,
        _COLUMNS_NOTE,
    ),
}
"""By the name that ``--format`` takes."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LevelFrame:
    """The level frame of one pose."""

    pose: Pose

    @property
    def T_world_level(self) -> Floats:
        """Brings points of this frame into the world's, (4, 4) float64."""
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_world_sensor(self.pose.yaw_deg, 0.0, 0.0)
        matrix[:3, 3] = self.pose.position_m
        return matrix

    def points(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Points of the sensor's frame, x, y, z, intensity (n, 4), in this one."""
        _, pitch_deg, roll_deg = self.pose.angles_deg
        if pitch_deg == 0.0 and roll_deg == 0.0:
            return points
        level = points.copy()
        level[:, :3] = _transform(rotation_world_sensor(0.0, pitch_deg, roll_deg), points[:, :3].astype(np.float64))
        return level

    def boxes(self, boxes: Floats) -> Floats:
        """Boxes of the world frame (n, 7) in this one; headings from -pi to pi."""
        yaw_deg, _, _ = self.pose.angles_deg
        level = boxes.copy()
        level[:, :3] = _transform(
            rotation_world_sensor(yaw_deg, 0.0, 0.0).T, boxes[:, :3] - np.asarray(self.pose.position_m)
        )
        level[:, 6] = wrap_angle(boxes[:, 6] - np.radians(yaw_deg))
        return level

    def world_boxes(self, boxes: Floats) -> Floats:
        """The inverse of :meth:`boxes`."""
        yaw_deg, _, _ = self.pose.angles_deg
        world = boxes.copy()
        world[:, :3] = _transform(rotation_world_sensor(yaw_deg, 0.0, 0.0), boxes[:, :3]) + np.asarray(
            self.pose.position_m
        )
        world[:, 6] = wrap_angle(boxes[:, 6] + np.radians(yaw_deg))
        return world


def box_corners(boxes: Floats) -> Floats:
    """The eight corners of each upright box (n, 7), (n, 8, 3)."""
    signs = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    spread = boxes[:, None, 3:6] * signs
    cos, sin = np.cos(boxes[:, 6:7]), np.sin(boxes[:, 6:7])
    x, y = spread[..., 0] * cos - spread[..., 1] * sin, spread[..., 0] * sin + spread[..., 1] * cos
    found: Floats = np.stack([x, y, spread[..., 2]], axis=-1) + boxes[:, None, :3]
    return found


def _transform(matrix: Floats, points: Floats) -> Floats:
    """Written out: a BLAS may sum in another order on another machine."""
    found: Floats = points[:, :1] * matrix[:, 0] + points[:, 1:2] * matrix[:, 1] + points[:, 2:3] * matrix[:, 2]
    return found


TRAINING_SHARE = 0.8
"""Share of the frames, the first ones, that are for training; the others are for validation."""

MIN_POINTS_TO_PASTE = 10
"""Points of an object that OpenPCDet may paste into other frames."""

OBJECT_COLUMNS = (
    *("frame", "object", "vehicle", "part", "kind", "class", "points", "in_roi"),
    *("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad", "pitch_rad"),
)
"""Of ``objects.csv``, one row a box a frame."""


@dataclass
class SiteSummary:
    """What was written of a site.

    Attributes
    ----------
    train, val, empty
        Frames of the split; those without a labelled object are in neither.
    boxes, labelled, in_roi, in_roi_labelled
        Boxes of all frames; those with at least one point; vehicles whose centre is in the region of interest; those
        of them with at least one point.
    classes
        Labelled boxes by class.
    pasted
        Of the frames for training, those with at least :data:`MIN_POINTS_TO_PASTE` points by class.
    anchors
        Length, width, height and z of the bottom in the level frame by class, means over the labelled boxes.
    low_m, high_m
        The smallest box round all labelled boxes in the region of interest, in the level frame; of all labelled ones
        where none is in it, of nothing where there are none.
    """

    site: str
    sensor: str
    pose: dict[str, float]
    range_sigma_m: float
    T_world_level: list[list[float]]
    train: list[str] = field(default_factory=list)
    val: list[str] = field(default_factory=list)
    empty: list[str] = field(default_factory=list)
    points: int = 0
    boxes: int = 0
    labelled: int = 0
    in_roi: int = 0
    in_roi_labelled: int = 0
    classes: Counter[str] = field(default_factory=Counter)
    pasted: Counter[str] = field(default_factory=Counter)
    anchors: dict[str, list[float]] = field(default_factory=dict)
    low_m: list[float] = field(default_factory=list)
    high_m: list[float] = field(default_factory=list)

    @property
    def frames(self) -> int:
        """How many frames there are."""
        return len(self.train) + len(self.val) + len(self.empty)

    def to_json(self) -> dict[str, Any]:
        """As ``about.json`` holds it: lists of frames as their numbers."""
        counts = {name: len(getattr(self, name)) for name in ("train", "val", "empty")}
        return vars(self) | {"frames": self.frames} | counts


@dataclass(frozen=True)
class _WrittenFrame:
    """A frame whose files are written, as the site's folder sums it up."""

    frame: TrafficFrame
    name: str
    cloud: int
    classes: tuple[str, ...]
    on_box: NDArray[np.int64]
    level: NDArray[np.float64]
    in_roi: NDArray[np.bool_]


def frame_name(number: int) -> str:
    """The name of a frame's files, without a suffix: its number in the record."""
    return f"{number:06d}"


def write_site(
    folder: Path,
    record: HeldOutTraffic,
    simulator: CloudSimulator,
    layout: Layout,
    threads: int,
    progress: ProgressCallback,
) -> SiteSummary:
    """Write all frames of a site into a folder, which is made.

    Parameters
    ----------
    progress
        Told of the frames of this site.
    """
    for name in layout.folders:
        (folder / name).mkdir(parents=True)
    view, level = simulator.view, LevelFrame(simulator.view.pose)
    pose = asdict(view.pose)
    matrix = level.T_world_level.tolist()
    about = SiteSummary(view.site, view.sensor.name, pose, view.sensor.range_sigma_m, matrix)

    def write(frame: TrafficFrame) -> _WrittenFrame:
        taken = simulator.sweep(frame, sweep_rng(record.scenario.seed, view.site, frame.number))
        boxes, kinds = level.boxes(frame.boxes), sweeps.frame_classes(frame)
        on_box = taken.points_on(len(boxes))
        seen = np.flatnonzero(on_box)
        name, points = frame_name(frame.number), level.points(taken.sweep.points)
        layout.write_frame(folder, name, points, taken.owner, [kinds[i] for i in seen], boxes[seen])
        wanted = np.zeros(len(boxes), dtype=np.bool_)
        wanted[frame.target_rows(record.scene.roi)] = True
        return _WrittenFrame(frame, name, len(points), kinds, on_box, boxes, wanted)

    training = set(record.numbers[: max(1, int(TRAINING_SHARE * record.frames + 1e-9))].tolist())
    within, around, sums = _Extent(), _Extent(), dict[str, NDArray[np.float64]]()
    with (folder / "objects.csv").open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(OBJECT_COLUMNS)
        for done, written in enumerate(map_ordered(write, record.read(), threads), 1):
            rows.writerows(_object_rows(written))
            _add_to_summary(about, written, in_training=written.frame.number in training)
            seen = written.on_box > 0
            around.add(written.level[seen])
            within.add(written.level[seen & written.in_roi])
            _add_sizes(sums, written, seen)
            progress("frames", done, record.frames)
    about.low_m, about.high_m = within.bounds() or around.bounds() or ([], [])
    about.anchors = {name: (sums[name] / about.classes[name]).round(2).tolist() for name in sorted(sums)}
    for name in ("train", "val", "empty"):
        _write_lines(folder / "ImageSets" / f"{name}.txt", getattr(about, name))
    files.write_text(folder / "about.json", json.dumps(about.to_json(), indent=2, sort_keys=True) + "\n")
    return about


class _Extent:
    """Grows round boxes."""

    def __init__(self) -> None:
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)

    def add(self, boxes: NDArray[np.float64]) -> None:
        """Hold these boxes (n, 7) too."""
        if len(boxes):
            at = box_corners(boxes).reshape(-1, 3)
            self._low, self._high = np.minimum(self._low, at.min(axis=0)), np.maximum(self._high, at.max(axis=0))

    def bounds(self) -> tuple[list[float], list[float]] | None:
        """Lowest and highest x, y, z, in whole millimetres; None round nothing."""
        if not np.isfinite(self._low).all():
            return None
        return self._low.round(3).tolist(), self._high.round(3).tolist()


def _object_rows(written: _WrittenFrame) -> list[list[str]]:
    """Rows of ``objects.csv``."""
    frame, found = written.frame, []
    pitch, part = frame.pitch_rad.tolist(), frame.part.tolist()
    for at, box in enumerate(written.level.tolist()):
        who = [written.name, str(at), frame.vehicles[at], str(part[at]), frame.kinds[at], written.classes[at]]
        counts = [str(written.on_box[at]), str(int(written.in_roi[at]))]
        found.append([*who, *counts, *(f"{value:.6f}" for value in (*box, pitch[at]))])
    return found


def _add_to_summary(summary: SiteSummary, written: _WrittenFrame, *, in_training: bool) -> None:
    seen = written.on_box > 0
    split = summary.empty if not seen.any() else summary.train if in_training else summary.val
    split.append(written.name)
    summary.points += written.cloud
    summary.boxes += len(seen)
    summary.labelled += int(seen.sum())
    summary.in_roi += int(written.in_roi.sum())
    summary.in_roi_labelled += int((seen & written.in_roi).sum())
    summary.classes.update(written.classes[i] for i in np.flatnonzero(seen))
    if in_training:
        summary.pasted.update(written.classes[i] for i in np.flatnonzero(written.on_box >= MIN_POINTS_TO_PASTE))


def _add_sizes(sums: dict[str, NDArray[np.float64]], written: _WrittenFrame, visible: NDArray[np.bool_]) -> None:
    """Sums of length, width, height and z of the bottom by class grow by the boxes that are seen."""
    for at in np.flatnonzero(visible):
        box, name = written.level[at], written.classes[at]
        sums[name] = sums.get(name, np.zeros(4)) + np.append(box[3:6], box[2] - box[5] / 2)


def _write_lines(path: Path, lines: Sequence[str]) -> None:
    path.write_bytes("".join(f"{line}\n" for line in lines).encode())
