"""Labelled sweeps that are made here, with losses that are known."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds.simulation import BodyCaster, VehicleMeshes, builtin_bodies
from egvs.core.grid import FloatArray
from egvs.extensions.validation import kitti
from egvs.formats import pcd
from egvs.sensors.return_model import ReturnModel
from egvs.sensors.sensor import CATALOGUE, rotation_world_sensor
from egvs.sensors.sites import Pose

SENSOR = "OS1-64 BH 2048"
POSE = Pose(0.0, 0.0, 7.0, 0.0, -1.5, 0.8)
CAR_M = (4.4, 1.85, 1.5)


@dataclass(frozen=True)
class Twin:
    """Sweeps and their labels, in the sensor's frame.

    Attributes
    ----------
    points_m
        Points of each sweep, (n, 3) float64.
    boxes
        Cars of each sweep, (m, 7) float64.
    """

    points_m: list[FloatArray]
    boxes: list[FloatArray]


def random_cars(rng: np.random.Generator, count: int) -> FloatArray:
    """Return cars on level ground in the world frame, 16 to 60 m from the sensor, none near another, (count, 7)."""
    cars: list[tuple[float, ...]] = []
    while len(cars) < count:
        range_m, azimuth = rng.uniform(16.0, 60.0), rng.uniform(-math.pi, math.pi)
        x, y = range_m * math.cos(azimuth), range_m * math.sin(azimuth)
        if all(math.hypot(x - car[0], y - car[1]) > 7.0 for car in cars):
            cars.append((x, y, 0.5 * CAR_M[2], *CAR_M, rng.uniform(-math.pi, math.pi)))
    return np.array(cars)


def make_twin(model: ReturnModel | None, seed: int, sweeps: int = 3, cars: int = 20) -> Twin:
    """Return sweeps of cars, of which returns are drawn with a model of losses; all returns for None."""
    rng = np.random.default_rng(seed)
    sensor = CATALOGUE[SENSOR]
    rotation = rotation_world_sensor(*POSE.angles_deg)
    directions, nominal = sensor.directions(*POSE.angles_deg), sensor.directions()
    range_m = np.full(len(directions), float(sensor.range_m))
    down = directions[:, 2] < 0.0
    range_m[down] = np.minimum(range_m[down], -POSE.z_m / directions[down, 2])
    caster = BodyCaster(directions, VehicleMeshes.from_parts(builtin_bodies()))
    twin = Twin([], [])
    for number in range(sweeps):
        world = random_cars(rng, cars)
        names = tuple(f"{number}-{row}" for row in range(cars))
        frame = TrafficFrame(number, names, ("passenger",) * cars, world, np.zeros(cars))
        hits = caster.cast(frame, POSE.position_m, range_m.copy(), np.zeros(len(range_m)))
        returned = (hits.owner >= 0) | (range_m < sensor.range_m)
        if model is not None:
            lost = rng.random(len(range_m)) >= model.probability(hits.range_m, 0.03)
            returned &= (hits.owner < 0) | ~lost
        noisy_m = hits.range_m + 0.02 * rng.standard_normal(len(range_m))
        twin.points_m.append((nominal * noisy_m[:, None])[returned])
        boxes = world.copy()
        boxes[:, :3] = (world[:, :3] - POSE.position_m) @ rotation
        front = np.column_stack([np.cos(world[:, 6]), np.sin(world[:, 6]), np.zeros(cars)]) @ rotation
        boxes[:, 6] = np.arctan2(front[:, 1], front[:, 0])
        twin.boxes.append(boxes)
    return twin


def write_pcd(folder: Path, twin: Twin) -> list[Path]:
    """Write each sweep as PCD."""
    paths = []
    for number, points_m in enumerate(twin.points_m):
        paths.append(folder / f"sweep{number}.pcd")
        pcd.write(paths[-1], points_m)
    return paths


def write_openlabel(folder: Path, twin: Twin) -> list[Path]:
    """Write labels as one OpenLABEL file for each sweep, in TUMTraf's dialect."""
    paths = []
    for number, boxes in enumerate(twin.boxes):
        objects: dict[str, Any] = {}
        for row, (x, y, z, length, width, height, yaw) in enumerate(boxes.tolist()):
            values = [x, y, z, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2), length, width, height]
            data = {"name": f"CAR_{row}", "type": "CAR", "cuboid": {"name": "shape3D", "val": values}}
            objects[f"{number}-{row}"] = {"object_data": data}
        frame = {"frame_properties": {"timestamp": 1000.0 + number}, "objects": objects}
        paths.append(folder / f"sweep{number}.json")
        paths[-1].write_text(json.dumps({"openlabel": {"metadata": {}, "frames": {"0": frame}}}), encoding="utf-8")
    return paths


def write_dair(folder: Path, twin: Twin) -> list[Path]:
    """Write labels as one DAIR file for each sweep."""
    paths = []
    for number, boxes in enumerate(twin.boxes):
        rows = []
        for row, (x, y, z, length, width, height, yaw) in enumerate(boxes.tolist()):
            size = {"l": length, "w": width, "h": height}
            item = {"3d_location": {"x": x, "y": y, "z": z}, "3d_dimensions": size, "rotation": yaw}
            rows.append({"type": "Car", "track_id": f"{number}-{row}", **item})
        paths.append(folder / f"sweep{number}.json")
        paths[-1].write_text(json.dumps(rows), encoding="utf-8")
    return paths


def write_kitti(folder: Path, twin: Twin) -> list[Path]:
    """Write labels in KITTI's format."""
    paths = []
    for number, boxes in enumerate(twin.boxes):
        paths.append(folder / f"sweep{number}.txt")
        paths[-1].write_text(kitti.format_labels(["Car"] * len(boxes), boxes), encoding="utf-8")
    return paths


def write_table(path: Path, twin: Twin, yaw_sign: float = 1.0, yaw_from_rad: float = 0.0) -> Path:
    """Write all labels as one CSV table with columns of other names, and headings of another convention."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["sweep", "class", "cx", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad", "id"])
        for number, boxes in enumerate(twin.boxes):
            for row, (*centre_and_size, yaw) in enumerate(boxes.tolist()):
                heading = yaw_sign * (yaw - yaw_from_rad)
                writer.writerow([f"sweep{number}.pcd", "car", *centre_and_size, heading, f"{number}-{row}"])
    return path
