"""Read point clouds of ROS 1 and ROS 2 recordings with rosbags (``pip install 'egvs[sweeps]'``).

A recording is a ``.bag`` (ROS 1), an ``.mcap`` or ``.db3`` (ROS 2), or the folder of a ROS 2 recording, which contains
``metadata.yaml``. Each message ``sensor_msgs/PointCloud2`` is a sweep. Its fields ``x``, ``y``, ``z`` (float32 or
float64, metres) may be anywhere in a point; missing returns are NaN. Times of points are read from the first of these
fields that exists: ``time``, ``timestamp``, ``t``, ``offset_time``, ``time_stamp``; floating point numbers are seconds,
integers nanoseconds; rings from the first of
:data:`egvs.formats.recordings.RING_FIELDS`. No ROS installation is needed.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from egvs.core import limits, plugins
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.formats.reader_process import Block, serve
from egvs.formats.recording_options import RecordingOptions
from egvs.formats.recordings import (
    RING_FIELDS,
    TIME_FIELDS,
    RecordedSweep,
    Recording,
    chosen_sweeps,
    header_block,
    process_options,
    read_recording,
    sweep_blocks,
)

_CANNOT_READ = "cannot be read as a recording of ROS"
_TYPE = "sensor_msgs/msg/PointCloud2"
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy types by the datatype of a sensor_msgs/PointField."""
_NANO = 1e-9


def read(path: Path, where: str, options: RecordingOptions) -> tuple[Recording, list[RecordedSweep]]:
    """Return the sweeps of a recording.

    Raises
    ------
    InputError
        If the recording is damaged, has no point clouds, or has several topics with point clouds and none is chosen.
    MissingExtraError
        If rosbags is not installed.
    """
    plugins.require_libraries(f"{where}: reading a recording of ROS", "sweeps", "rosbags")
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        limits.checked_size(file, limits.FILE, where)
    return read_recording(__name__, path, where, _CANNOT_READ, options)


# --- in the other process ---


def _read_file(path: Path) -> Iterator[Block]:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    options = process_options()
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        connections = [connection for connection in reader.connections if connection.msgtype == _TYPE]
        topics = sorted({connection.topic for connection in connections})
        topic = options.topic or (topics[0] if len(topics) == 1 else None)
        if topic not in topics:
            raise _topic_error(topics, topic, sorted({connection.topic for connection in reader.connections}))
        chosen = [connection for connection in connections if connection.topic == topic]
        stamps_s: list[float] = []
        for connection, _, data in reader.messages(chosen):
            stamps_s.append(_stamp_s(reader.deserialize(data, connection.msgtype)))
        if not stamps_s:
            raise InputError("", f"the topic {topic} has no messages", "Choose another topic with --topic.")
        selected = set(chosen_sweeps(len(stamps_s), options.max_sweeps).tolist())
        frames: set[str] = set()
        blocks: list[Block] = []
        for number, (connection, _, data) in enumerate(reader.messages(chosen)):
            if number not in selected:
                continue
            message: Any = reader.deserialize(data, connection.msgtype)
            frames.add(str(message.header.frame_id))
            label = f"{topic} at {stamps_s[number] - stamps_s[0]:.3f} s"
            blocks += sweep_blocks(label, *decode_points(message))
        yield header_block(f"topic {topic}, frame {', '.join(sorted(frames)) or 'not named'}", stamps_s)
        yield from blocks


def _topic_error(topics: list[str], topic: str | None, all_topics: list[str]) -> InputError:
    if not topics:
        others = ", ".join(all_topics) or "none"
        return InputError(
            "",
            f"expected a topic of {_TYPE.replace('/msg', '')}, got none (topics: {others})",
            "Record the driver's point clouds, not its packets.",
        )
    names = ", ".join(topics)
    if topic is None:
        problem = f"expected one topic with point clouds, got {len(topics)}: {names}"
        return InputError("", problem, "Choose one with --topic.")
    return InputError("--topic", f"expected one of {names}, got {topic!r}", "Choose one of these.")


def _stamp_s(message: Any) -> float:
    stamp = message.header.stamp
    return float(stamp.sec) + _NANO * float(stamp.nanosec)


def decode_points(message: Any) -> tuple[FloatArray, FloatArray | None, FloatArray | None]:
    """Return the points (n, 3) of a ``PointCloud2``, row by row, and times in seconds and rings, (n,), if it has them.

    Raises
    ------
    ValueError
        If the message lacks x, y or z, or its sizes contradict one another.
    """
    order = ">" if message.is_bigendian else "<"
    fields = {str(field.name): field for field in message.fields}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise ValueError(f"a point cloud has no field {missing[0]}, its fields are {', '.join(fields) or 'none'}")
    height, width = int(message.height), int(message.width)
    point_step, row_step = int(message.point_step), int(message.row_step)
    data = np.ascontiguousarray(message.data, dtype=np.uint8)
    if point_step <= 0 or row_step < width * point_step or len(data) < height * row_step:
        raise ValueError(
            f"a point cloud of {height} x {width} points of {point_step} bytes in rows of {row_step} has {len(data)}"
        )

    def column(name: str) -> tuple[np.dtype[Any], FloatArray]:
        field = fields[name]
        if int(field.datatype) not in _TYPES:
            raise ValueError(f"the field {name} has the unknown type {field.datatype}")
        dtype = np.dtype(order + _TYPES[int(field.datatype)])
        if int(field.offset) + dtype.itemsize > point_step:
            raise ValueError(f"the field {name} does not fit into a point of {point_step} bytes")
        if not height * width:
            return dtype, np.empty(0)
        view = np.ndarray((height, width), dtype, data.data, int(field.offset), (row_step, point_step))
        with np.errstate(invalid="ignore"):
            return dtype, view.astype(np.float64).ravel()

    axes = [column(name) for name in "xyz"]
    if any(dtype.kind != "f" for dtype, _ in axes):
        raise ValueError("expected floating point numbers in the fields x, y, z")
    points_m = np.column_stack([values for _, values in axes])
    rings = [column(name)[1] for name in RING_FIELDS if name in fields]
    ring = rings[0] if rings else None
    name = next((name for name in TIME_FIELDS if name in fields), None)
    if name is None:
        return points_m, None, ring
    dtype, time = column(name)
    if dtype.kind != "f":
        time = (time - time.min(initial=np.inf)) * _NANO if len(time) else time
    return points_m, time, ring


if __name__ == "__main__":
    serve(_read_file)
