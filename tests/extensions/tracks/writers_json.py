"""Write boxes in formats of recorded tracks in JSON, protobuf, Parquet and Feather, one function per format.

Boxes without a height of the centre get z = 0, and without a size 0, as these formats have no value for "unknown".
"""

from __future__ import annotations

import csv
import json
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import feather, parquet

from egvs.core.grid import FloatArray
from tests.extensions.tracks.writers import TrackRows

SENSOR = "s110_lidar_ouster_south"

CLASSES = ("car", "truck", "bus", "motorcycle", "bicycle", "pedestrian")
"""Classes that all formats here have, except for scenarios of Argoverse 2."""


def write_openlabel(folder: Path, rows: TrackRows) -> Path:
    """Write ASAM OpenLABEL, one file with all frames; precise to the last digit."""
    frames: dict[str, Any] = {}
    objects = {name: {"name": f"object {name}", "type": cls} for name, cls in zip(rows.name, rows.cls, strict=True)}
    for number, (time_s, indices) in enumerate(_by_time(rows)):
        boxes = {}
        for index in indices:
            cuboid = {"name": "box", "coordinate_system": "map", "val": _cuboid(rows, index)}
            boxes[rows.name[index]] = {"object_data": {"cuboid": [cuboid]}}
        frames[str(number)] = {"frame_properties": {"timestamp": time_s}, "objects": boxes}
    systems = {"map": {"type": "scene_cs", "parent": "", "children": []}}
    content = {"metadata": {"schema_version": "1.0.0"}, "coordinate_systems": systems}
    path = folder / "labels.json"
    path.write_text(json.dumps({"openlabel": {**content, "objects": objects, "frames": frames}}))
    return path


def sweep_name(time_s: float) -> str:
    """Return the name of TUMTraf's file of a sweep at a time."""
    seconds, nanoseconds = divmod(round(time_s * 1e9), 10**9)
    return f"{seconds:010d}_{nanoseconds:09d}_{SENSOR}.json"


def write_tumtraf(folder: Path, rows: TrackRows) -> Path:
    """Write TUMTraf's dialect of OpenLABEL, a file per sweep; return the first. Precise to a nanosecond."""
    paths = []
    for number, (time_s, indices) in enumerate(_by_time(rows)):
        objects = {}
        for index in indices:
            cuboid = {"name": "shape3D", "val": _cuboid(rows, index), "attributes": {"text": [], "num": []}}
            data = {"name": rows.name[index], "type": rows.cls[index].upper(), "cuboid": cuboid}
            objects[rows.name[index]] = {"object_data": data}
        path = folder / sweep_name(time_s)
        frame = {"frame_properties": {"timestamp": time_s}, "objects": objects}
        path.write_text(json.dumps({"openlabel": {"frames": {str(number): frame}}}))
        paths.append(path)
    return paths[0]


_DAIR_TYPES = {
    "car": "Car", "van": "Van", "truck": "Truck", "bus": "Bus", "motorcycle": "Motorcyclist", "bicycle": "Cyclist",
    "pedestrian": "Pedestrian",
}  # fmt: skip


def write_dair_v2x(
    folder: Path, rows: TrackRows, turn_rad: float = 0.6, shift_m: tuple[float, ...] = (7, -3, 5)
) -> Path:
    """Write V2X-Seq labels in the frame of a LiDAR that stands at ``shift_m``, turned; return the first label.

    Precise to a microsecond. Numbers are texts, as they often are.
    """
    labels, calibrations = folder / "label" / "virtuallidar", folder / "calib" / "virtuallidar_to_world"
    labels.mkdir(parents=True)
    calibrations.mkdir(parents=True)
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    calibration = {
        "rotation": rotation.tolist(),
        "translation": [[value] for value in shift_m],
        "relative_error": {"delta_x": "", "delta_y": ""},
    }
    index_entries = []
    for number, (time_s, indices) in enumerate(_by_time(rows)):
        items = []
        for index in indices:
            centre = rotation.T @ (np.array(_numbers(rows, index)[:3]) - shift_m)
            length, width, height = _numbers(rows, index)[4:]
            items.append(
                {
                    "type": _DAIR_TYPES[rows.cls[index]],
                    "track_id": rows.name[index],
                    "3d_dimensions": {"h": str(height), "w": str(width), "l": str(length)},
                    "3d_location": dict(zip("xyz", map(repr, centre.tolist()), strict=True)),
                    "rotation": repr(float(rows.yaw_rad[index]) - turn_rad),
                }
            )
        name = f"{number:06d}.json"
        (labels / name).write_text(json.dumps(items))
        (calibrations / name).write_text(json.dumps(calibration))
        index_entries.append(
            {
                "label_lidar_std_path": f"label/virtuallidar/{name}",
                "pointcloud_timestamp": str(round(time_s * 1e6)),
                "sequence_id": "0000",
            }
        )
    (folder / "data_info.json").write_text(json.dumps(index_entries))
    return labels / "000000.json"


TFD_COLUMNS = (
    "city", "timestamp", "id", "type", "sub_type", "tag", "x", "y", "z", "length", "width", "height", "theta", "v_x",
    "v_y", "intersect_id",
)  # fmt: skip


def write_v2x_seq_tfd(folder: Path, rows: TrackRows) -> Path:
    """Write a scene of V2X-Seq trajectory forecasting; precise to the last digit."""
    path = folder / "10001.csv"
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*TFD_COLUMNS])
        for index, name in enumerate(rows.name):
            x, y, z, yaw, length, width, height = _numbers(rows, index)
            kind = _DAIR_TYPES[rows.cls[index]].upper()
            group = {"PEDESTRIAN": "PEDESTRIAN", "CYCLIST": "BICYCLE"}.get(kind, "VEHICLE")
            place = ("PEK", float(rows.time_s[index]), name, group, kind, "OTHERS", x, y, z)
            writer.writerow([*place, length, width, height, yaw, 0, 0, "yizhuang#4-1_po"])
    return path


_AV2_TYPES = {
    "car": "regular_vehicle", "van": "regular_vehicle", "truck": "truck", "bus": "bus", "motorcycle": "motorcycle",
    "bicycle": "bicycle", "pedestrian": "pedestrian", "trailer": "vehicular_trailer", "tram": "railed_vehicle",
}  # fmt: skip
_AV2_SCENARIO_TYPES = {"bus": "bus", "motorcycle": "motorcyclist", "bicycle": "cyclist", "pedestrian": "pedestrian"}


def write_argoverse2_scenario(folder: Path, rows: TrackRows) -> Path:
    """Write a scenario of Argoverse 2: times in steps of 0.1 s, all vehicles but buses are cars, no z, no sizes."""
    path = folder / "scenario_hand-made.parquet"
    n = len(rows.name)
    columns = {
        "observed": pa.array([True] * n),
        "track_id": pa.array(list(rows.name)),
        "object_type": pa.array([_AV2_SCENARIO_TYPES.get(cls, "vehicle") for cls in rows.cls]),
        "timestep": pa.array(np.round(rows.time_s * 10).astype(np.int64)),
        "position_x": pa.array(rows.x_m),
        "position_y": pa.array(rows.y_m),
        "heading": pa.array(rows.yaw_rad),
        "start_timestamp": pa.array(np.zeros(n)),
        "city": pa.array(["austin"] * n),
    }
    parquet.write_table(pa.table(columns), path)
    return path


def write_argoverse2(folder: Path, rows: TrackRows) -> Path:
    """Write annotations of Argoverse 2, in the frame of a vehicle that drives in a curve, and its poses.

    Precise to some micrometres, for a nanosecond.
    """
    times = np.unique(rows.time_s)
    turns, xs, ys = 0.3 + 0.02 * times, 40 + 5 * times, -7 + 0.3 * times
    poses = {"timestamp_ns": _nanoseconds(times)} | _quaternion(-np.ones_like(turns), turns)
    poses |= {"tx_m": xs, "ty_m": ys, "tz_m": np.full_like(xs, 1.5)}
    feather.write_feather(pa.table(poses), str(folder / "city_SE3_egovehicle.feather"))
    step = np.searchsorted(times, rows.time_s)
    dx, dy = rows.x_m - xs[step], rows.y_m - ys[step]
    cos, sin = np.cos(turns[step]), np.sin(turns[step])
    boxes = {
        "timestamp_ns": _nanoseconds(rows.time_s),
        "track_uuid": list(rows.name),
        "category": [_AV2_TYPES[cls].upper() for cls in rows.cls],
        **{key: np.nan_to_num(getattr(rows, key)) for key in ("length_m", "width_m", "height_m")},
        **_quaternion(np.ones_like(dx), np.nan_to_num(rows.yaw_rad) - turns[step]),
        "tx_m": cos * dx + sin * dy,
        "ty_m": cos * dy - sin * dx,
        "tz_m": np.nan_to_num(rows.z_m) - 1.5,
        "num_interior_pts": np.ones(len(rows.name), dtype=np.int64),
    }
    path = folder / "annotations.feather"
    feather.write_feather(pa.table(boxes), str(path))
    return path


_OSI_VEHICLES = {"car": 4, "van": 6, "truck": 7, "trailer": 9, "motorcycle": 10, "bicycle": 11, "bus": 12, "tram": 13}


def osi_messages(rows: TrackRows) -> Iterator[tuple[float, Any]]:
    """Yield the time and a GroundTruth for each time; names must be numbers. What is NaN is not set."""
    from osi3.osi_groundtruth_pb2 import GroundTruth

    for time_s, indices in _by_time(rows):
        truth = GroundTruth()
        nanoseconds = round(time_s * 1e9)
        truth.timestamp.seconds, truth.timestamp.nanos = divmod(nanoseconds, 10**9)
        for index in indices:
            item = truth.moving_object.add()
            item.id.value = int(rows.name[index])
            item.type = 3 if rows.cls[index] == "pedestrian" else 2
            if item.type == 2:
                item.vehicle_classification.type = _OSI_VEHICLES[rows.cls[index]]
            for part, key, column in (
                ("position", "x", rows.x_m), ("position", "y", rows.y_m), ("position", "z", rows.z_m),
                ("orientation", "yaw", rows.yaw_rad), ("dimension", "length", rows.length_m),
                ("dimension", "width", rows.width_m), ("dimension", "height", rows.height_m),
            ):  # fmt: skip
                if not math.isnan(column[index]):
                    setattr(getattr(item.base, part), key, float(column[index]))
        yield time_s, truth


def write_osi(folder: Path, rows: TrackRows) -> Path:
    """Write an ``.osi`` trace of GroundTruth; precise to a nanosecond."""
    path = folder / "trace_gt_hand-made.osi"
    with path.open("wb") as file:
        for _, truth in osi_messages(rows):
            content = truth.SerializeToString()
            file.write(struct.pack("<I", len(content)) + content)
    return path


def write_osi_mcap(folder: Path, rows: TrackRows) -> Path:
    """Write an MCAP trace of GroundTruth, compressed with LZ4; precise to a nanosecond."""
    from mcap.writer import CompressionType, Writer
    from mcap_protobuf.schema import build_file_descriptor_set
    from osi3.osi_groundtruth_pb2 import GroundTruth

    path = folder / "trace.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start()
        descriptors = build_file_descriptor_set(GroundTruth).SerializeToString()
        schema = writer.register_schema("osi3.GroundTruth", "protobuf", descriptors)
        channel = writer.register_channel("ground_truth", "protobuf", schema)
        for time_s, truth in osi_messages(rows):
            nanoseconds = round(time_s * 1e9)
            writer.add_message(channel, nanoseconds, truth.SerializeToString(), nanoseconds)
        writer.finish()
    return path


def _by_time(rows: TrackRows) -> Iterator[tuple[float, list[int]]]:
    """Yield each time and the indices of its rows."""
    times, starts = np.unique(rows.time_s, return_index=True)
    ends = [*starts[1:].tolist(), len(rows.name)]
    for time_s, start, end in zip(times.tolist(), starts.tolist(), ends, strict=True):
        yield time_s, list(range(start, end))


def _numbers(rows: TrackRows, index: int) -> list[float]:
    """Return x, y, z, yaw, length, width and height of a row, 0 where unknown."""
    columns = (rows.x_m, rows.y_m, rows.z_m, rows.yaw_rad, rows.length_m, rows.width_m, rows.height_m)
    return [float(np.nan_to_num(column[index])) for column in columns]


def _cuboid(rows: TrackRows, index: int) -> list[float]:
    x, y, z, yaw, *size = _numbers(rows, index)
    return [x, y, z, 0, 0, math.sin(yaw / 2), math.cos(yaw / 2), *size]


def _nanoseconds(time_s: FloatArray) -> Any:
    return np.round(time_s * 1e9).astype(np.int64)


def _quaternion(sign: FloatArray, yaw_rad: FloatArray) -> dict[str, FloatArray]:
    zero = np.zeros_like(yaw_rad)
    return {"qw": sign * np.cos(yaw_rad / 2), "qx": zero, "qy": zero, "qz": sign * np.sin(yaw_rad / 2)}
