"""Recordings of ROS 1 and ROS 2, written by rosbags: each sweep is a message ``sensor_msgs/PointCloud2``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from egvs.core.grid import FloatArray

TOPIC = "/lidar/points"


def point_cloud(store: Any, points_m: FloatArray, stamp_s: float, time_s: FloatArray | None = None) -> Any:
    """Return a message with float32 coordinates and, where given, times: one row, as drivers publish lists."""
    types = store.types
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")]
    numbers = {"<f4": 7, "<u4": 6}
    if time_s is not None:
        kinds.append(("t", "<u4"))
    rows = np.zeros(len(points_m), dtype=kinds)
    for axis, name in enumerate("xyz"):
        rows[name] = points_m[:, axis]
    if time_s is not None:
        rows["t"] = np.round(time_s * 1e9)
    field_of = types["sensor_msgs/msg/PointField"]
    fields = [
        field_of(name=name, offset=rows.dtype.fields[name][1], datatype=numbers[kind], count=1) for name, kind in kinds
    ]
    seconds, rest = divmod(round(stamp_s * 1e9), 10**9)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
    header = {"stamp": stamp, "frame_id": "lidar"}
    header_of = types["std_msgs/msg/Header"]
    if "seq" in header_of.__dataclass_fields__:
        header["seq"] = 0
    return types["sensor_msgs/msg/PointCloud2"](
        header=header_of(**header),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=False,
        point_step=rows.itemsize,
        row_step=rows.nbytes,
        data=np.frombuffer(rows.tobytes(), dtype=np.uint8),
        is_dense=False,
    )


def write_recording(
    path: Path,
    clouds: Sequence[tuple[float, FloatArray, FloatArray | None]],
    topics: Sequence[str] = (TOPIC,),
) -> Path:
    """Write (stamp, points, times) as a recording; return what to read.

    A ``.bag`` is ROS 1; ``.mcap`` and ``.db3`` are the storage file of a ROS 2 recording in the folder without suffix.
    """
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    is_ros1 = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/PointCloud2"
    writer: Any
    if is_ros1:
        writer = Writer1(path)
    else:
        plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path.with_suffix(""), version=9, storage_plugin=plugin)
    with writer:
        for topic in topics:
            connection = writer.add_connection(topic, kind, typestore=store)
            for stamp_s, points_m, time_s in clouds:
                message = point_cloud(store, points_m, stamp_s, time_s)
                serialize = store.serialize_ros1 if is_ros1 else store.serialize_cdr
                writer.write(connection, round(stamp_s * 1e9), serialize(message, kind))
    if is_ros1:
        return path
    (storage,) = path.with_suffix("").glob(f"*{path.suffix}")
    storage.rename(path)
    return path
