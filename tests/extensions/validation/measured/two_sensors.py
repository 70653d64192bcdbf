"""Labels of two sensors of one place that are made here: each notices road users by a curve that is known."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core.grid import FloatArray
from egvs.extensions.validation import kitti
from egvs.extensions.validation.measured.comparison import visible_boxes
from egvs.extensions.validation.measured.sensor_site import boxes_in_world, in_the_open
from egvs.scoring.noticed import noticed_chances
from egvs.sensors.return_model import ReturnModel
from egvs.sensors.sensor import CATALOGUE, rotation_world_sensor
from egvs.sensors.sites import Pose

SENSOR = "OS1-64"
POSES = (Pose(0.0, 0.0, 7.5, 0.0, -1.6, 1.5), Pose(13.0, -5.0, 7.0, 35.0, -1.5, 1.0))
FIRST_S = 1_646_667_000.0

SIZES_M = {"CAR": (4.2, 1.9, 1.6), "TRUCK": (8.0, 2.6, 3.4), "PEDESTRIAN": (0.8, 0.7, 1.7)}
VCLASSES = {"CAR": "passenger", "TRUCK": "truck", "PEDESTRIAN": "pedestrian"}


@dataclass(frozen=True)
class Labels:
    """Boxes of one list in one sweep, in the sensor's frame: tracks, classes, (n, 7), time."""

    names: tuple[str, ...]
    classes: tuple[str, ...]
    boxes: FloatArray
    time_s: float


def make_traffic(seed: int, sweeps: int, step_s: float = 0.5) -> list[tuple[list[str], list[str], FloatArray]]:
    """Return road users on two crossing roads in the world frame: tracks, classes and boxes of each sweep."""
    rng = np.random.default_rng(seed)
    users = []
    for number in range(int(2 + sweeps * step_s * 0.6)):
        kind = rng.choice(["CAR", "CAR", "CAR", "TRUCK", "PEDESTRIAN"])
        angle = rng.choice([0.2, 0.2 + math.pi / 2, 0.2 + math.pi, 0.2 + 1.5 * math.pi])
        speed = 1.4 if kind == "PEDESTRIAN" else rng.uniform(6.0, 13.0)
        offset = rng.choice([-6.0, -2.5]) - (8.0 if kind == "PEDESTRIAN" else 0.0)
        users.append((f"{number}", kind, angle, speed, offset, rng.uniform(-8.0, sweeps * step_s)))
    frames = []
    for sweep in range(sweeps):
        names, kinds, boxes = [], [], []
        for name, kind, angle, speed, offset, start_s in users:
            along = -70.0 + speed * (sweep * step_s - start_s)
            if -70.0 <= along <= 70.0:
                x = along * math.cos(angle) - offset * math.sin(angle)
                y = along * math.sin(angle) + offset * math.cos(angle)
                size = SIZES_M[kind]
                names.append(name)
                kinds.append(kind)
                boxes.append((x, y, size[2] / 2, *size, angle))
        frames.append((names, kinds, np.array(boxes).reshape(-1, 7)))
    return frames


def make_lists(seed: int = 1, sweeps: int = 120, step_s: float = 1.0) -> tuple[list[Labels], list[Labels]]:
    """Return what two labellers noticed by the curves of people, 20 ms apart."""
    traffic = make_traffic(seed, sweeps, step_s)
    rng = np.random.default_rng(seed + 1)
    lists: list[list[Labels]] = []
    for delay_s, pose in zip((0.0, 0.02), POSES, strict=True):
        sensor = CATALOGUE[SENSOR]
        frames = []
        for number, (names, kinds, boxes) in enumerate(traffic):
            vclasses = tuple(VCLASSES[kind] for kind in kinds)
            frames.append(TrafficFrame(number, tuple(names), vclasses, boxes, np.zeros(len(boxes))))
        visible = visible_boxes(in_the_open(sensor, pose, ""), frames, ReturnModel.of(sensor))
        chances = np.zeros(sum(len(frame.boxes) for frame in frames))
        chances[visible.record.row] = noticed_chances(visible)
        labels, start = [], 0
        for number, (names, kinds, boxes) in enumerate(traffic):
            seen = rng.random(len(boxes)) < chances[start : start + len(boxes)]
            start += len(boxes)
            rows = np.flatnonzero(seen).tolist()
            in_sensor = to_sensor(pose, boxes[seen])
            in_sensor[:, :2] += 0.2 * rng.standard_normal((len(rows), 2))
            time_s = FIRST_S + number * step_s + delay_s
            labels.append(Labels(tuple(names[r] for r in rows), tuple(kinds[r] for r in rows), in_sensor, time_s))
        lists.append(labels)
    return lists[0], lists[1]


def to_sensor(pose: Pose, boxes: FloatArray) -> FloatArray:
    """Return boxes of the world in the frame of a sensor."""
    rotation = rotation_world_sensor(*pose.angles_deg)
    inside = boxes.copy()
    inside[:, :3] = (boxes[:, :3] - np.asarray(pose.position_m)) @ rotation
    front = np.column_stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6]), np.zeros(len(boxes))]) @ rotation
    inside[:, 6] = np.arctan2(front[:, 1], front[:, 0])
    assert np.allclose(boxes_in_world(pose, inside)[:, :3], boxes[:, :3])
    return inside


def write_openlabel(
    folder: Path, labels: list[Labels], pose: Pose | None, scores: list[FloatArray] | None = None
) -> Path:
    """Write one file for each sweep in TUMTraf's dialect, with a pose of the sensor if there is one."""
    folder.mkdir()
    name = f"s110_lidar_{folder.name}"
    systems: dict[str, Any] = {}
    if pose is not None:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation_world_sensor(*pose.angles_deg), pose.position_m
        where = {"matrix4x4": matrix.ravel().tolist()}
        systems[name] = {"type": "sensor_cs", "parent": "s110_base", "children": [], "pose_wrt_parent": where}
    for number, item in enumerate(labels):
        objects: dict[str, Any] = {}
        for row, (x, y, z, length, width, height, yaw) in enumerate(item.boxes.tolist()):
            values = [x, y, z, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2), length, width, height]
            cuboid: dict[str, Any] = {"name": "shape3D", "val": values}
            if scores is not None:
                cuboid["attributes"] = {"num": [{"name": "score", "val": float(scores[number][row])}]}
            objects[item.names[row]] = {"object_data": {"name": "", "type": item.classes[row], "cuboid": cuboid}}
        frame = {"frame_properties": {"timestamp": item.time_s}, "objects": objects}
        document = {"openlabel": {"metadata": {}, "coordinate_systems": systems, "frames": {"0": frame}}}
        seconds, nanoseconds = int(item.time_s), round(1e9 * (item.time_s % 1))
        path = folder / f"{seconds}_{nanoseconds:09d}_{name}.json"
        path.write_text(json.dumps(document), encoding="utf-8")
    return folder


def write_dair(folder: Path, labels: list[Labels]) -> Path:
    """Write one JSON list for each sweep, numbers as texts, without tracks."""
    folder.mkdir()
    for number, item in enumerate(labels):
        rows = []
        for cls, (x, y, z, length, width, height, yaw) in zip(item.classes, item.boxes.tolist(), strict=True):
            size = {"h": str(height), "w": str(width), "l": str(length)}
            place = {"x": str(x), "y": str(y), "z": str(z)}
            rows.append({"type": cls.capitalize(), "3d_dimensions": size, "3d_location": place, "rotation": str(yaw)})
        (folder / f"{number:06d}.json").write_text(json.dumps(rows), encoding="utf-8")
    return folder


def write_kitti(folder: Path, labels: list[Labels], scores: list[FloatArray] | None = None) -> Path:
    """Write one text file for each sweep, also for those without boxes."""
    folder.mkdir()
    for number, item in enumerate(labels):
        names = [cls.capitalize() for cls in item.classes]
        text = kitti.format_labels(names, item.boxes, None if scores is None else scores[number])
        (folder / f"{number:06d}.txt").write_text(text, encoding="utf-8")
    return folder


def write_table(path: Path, labels: list[Labels], scores: list[FloatArray] | None = None) -> Path:
    """Write all sweeps as one table, with times and names of columns of its own."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time_s", "label", "x_m", "y_m", "z_m", "l", "w", "h", "yaw_deg", "id", "score"])
        for number, item in enumerate(labels):
            for row, (*centre_and_size, yaw) in enumerate(item.boxes.tolist()):
                score = 1.0 if scores is None else scores[number][row]
                values = [*centre_and_size, math.degrees(yaw), item.names[row], score]
                writer.writerow([item.time_s, item.classes[row].lower(), *values])
    return path
