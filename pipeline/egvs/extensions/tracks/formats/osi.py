"""Read ground truth of ASAM OSI traces, ``.osi`` and ``.mcap`` (``pip install 'egvs[osi]'``).

An ``.osi`` file is a sequence of messages, each after its length, four bytes with the lowest first. Messages are
GroundTruth; if the name of the file contains ``_sv_``, as in OSI's convention, they are SensorView, which contain a
GroundTruth. An MCAP file names the type of its messages. ``MovingObject.base`` has the centre, orientation and
dimensions of the box; what is not set is unknown. ``proj_string`` and ``proj_frame_offset`` give the frame: a position
is turned by the offset's yaw, then shifted by its position. See ASAM OSI 3: osi_groundtruth.proto, osi_object.proto,
and the trace file formats.
"""

from __future__ import annotations

import dataclasses
import math
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from egvs.core import limits, plugins, reading
from egvs.core.errors import InputError
from egvs.extensions.tracks.boxes import Box, BoxRows
from egvs.extensions.tracks.model import TrackFrame, Tracks
from egvs.formats.georeference import WorldFrame

if TYPE_CHECKING:
    from mcap.records import Chunk, McapRecord
    from osi3.osi_groundtruth_pb2 import GroundTruth
    from osi3.osi_object_pb2 import MovingObject

_MCAP = b"\x89MCAP0\r\n"
_TRUTH, _VIEW = "osi3.GroundTruth", "osi3.SensorView"
_LENGTH = struct.Struct("<I")
_HINT = "Use a complete OSI trace of GroundTruth or SensorView messages."

_TYPES = {2: "vehicle", 3: "pedestrian"}
"""MovingObject.Type; any other is "other"."""

_VEHICLE_TYPES = {
    0: "car", 2: "car", 3: "car", 4: "car", 5: "car", 6: "van", 7: "truck", 8: "trailer", 9: "trailer",
    10: "motorcycle", 11: "bicycle", 12: "bus", 13: "tram", 14: "tram", 15: "pedestrian", 16: "truck", 17: "bicycle",
    18: "bicycle", 19: "truck",
}  # fmt: skip
"""VehicleClassification.Type; 0 is unknown, any other is "other"."""


def can_open(path: Path, head: bytes) -> bool:
    """Return whether it is an MCAP file, or its name ends with ``.osi``, a format without a signature."""
    return head.startswith(_MCAP) or path.suffix.lower() == ".osi"


def companions(_path: Path) -> Sequence[Path]:
    """Return no file: a trace is complete."""
    return ()


def read(path: Path) -> Tracks:
    """Read a trace; MissingExtraError when the libraries of the extra ``osi`` are not installed."""
    plugins.require_libraries(f"{path.name}: reading ASAM OSI", "osi", "osi3", "mcap", "lz4")
    limits.checked_size(path, limits.FILE)
    with path.open("rb") as file:
        is_mcap = file.read(len(_MCAP)) == _MCAP
    traces: dict[tuple[str, str], _Trace] = {}
    for kind, topic, content in (_mcap_messages if is_mcap else _osi_messages)(path):
        trace = traces.setdefault((kind, topic), _Trace(path))
        trace.add(kind, content)
    kind = min((kind for kind, _ in traces), default="")  # GroundTruth, if there is one, else SensorView
    topics = sorted(topic for other, topic in traces if other == kind)
    if len(topics) != 1:
        problem = f"expected one channel of {_TRUTH} messages, got {', '.join(topics)[:200] or 'none'}"
        raise InputError(path, problem, _HINT)
    return traces[kind, topics[0]].to_tracks()


def _osi_messages(path: Path) -> Iterator[tuple[str, str, bytes]]:
    """Yield the kind, the topic and the bytes of each message."""
    kind = _VIEW if "_sv_" in path.name.lower() else _TRUTH
    number = 0
    with path.open("rb") as file:
        while head := file.read(_LENGTH.size):
            number += 1
            where = f"{path}: message {number}"
            length = _LENGTH.unpack(head)[0] if len(head) == _LENGTH.size else 0
            limits.ELEMENT.check_bytes(where, length, f"is {length / limits.MB:,.0f} MB long")
            content = file.read(length)
            if len(head) < _LENGTH.size or len(content) < length:
                raise InputError(where, f"expected {length} bytes, got {len(content)}", _HINT)
            yield kind, "", content


def _mcap_messages(path: Path) -> Iterator[tuple[str, str, bytes]]:
    """Yield the kind, the topic and the bytes of each message of ground truth."""
    from mcap.records import Channel, Message, Schema

    kinds: dict[int, str] = {}
    channels: dict[int, Channel] = {}
    with reading.translate_errors(path, _HINT, "cannot be read as MCAP"):
        for record in _mcap_records(path):
            if isinstance(record, Schema):
                kinds[record.id] = record.name
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                kind = kinds.get(channel.schema_id, "")
                if kind in (_TRUTH, _VIEW):
                    yield kind, channel.topic, record.data


def _mcap_records(path: Path) -> Iterator[McapRecord]:
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader, breakup_chunk

    with path.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True, record_size_limit=path.stat().st_size).records:
            if isinstance(record, Chunk):
                yield from breakup_chunk(_unpacked(path, record), validate_crc=True)
            else:
                yield record


def _unpacked(path: Path, chunk: Chunk) -> Chunk:
    """Return a chunk without LZ4; mcap limits the size only of chunks with Zstandard."""
    from lz4.frame import LZ4FrameDecompressor

    limits.UNPACKED.check_bytes(path, chunk.uncompressed_size)
    if chunk.compression != "lz4":
        return chunk
    data = LZ4FrameDecompressor().decompress(chunk.data, max_length=chunk.uncompressed_size)
    return dataclasses.replace(chunk, compression="", data=data)


class _Trace:
    """The boxes of one channel."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._rows = BoxRows(path)
        self._messages = self._without_position = 0
        self._projection, self._offset_m, self._turn_rad = "", (0.0, 0.0), 0.0

    def add(self, kind: str, content: bytes) -> None:
        """Add the boxes of a message."""
        self._messages += 1
        where = f"{self._path}: message {self._messages}"
        truth = _parse(kind, content, where)
        if not truth.HasField("timestamp"):
            raise InputError(where, "timestamp is missing", _HINT)
        if truth.proj_string:
            self._set_projection(truth, where)
        time_s = truth.timestamp.seconds + truth.timestamp.nanos * 1e-9
        for item in truth.moving_object:
            if not (item.base.position.HasField("x") and item.base.position.HasField("y")):
                self._without_position += 1
            else:
                self._rows.add(self._path, str(item.id.value), _class_of(item), time_s, _box(item))

    def _set_projection(self, truth: GroundTruth, where: str) -> None:
        offset = truth.proj_frame_offset
        stated = (truth.proj_string, (offset.position.x, offset.position.y), offset.yaw)
        if self._projection and stated != (self._projection, self._offset_m, self._turn_rad):
            raise InputError(where, "proj_string or proj_frame_offset changes", "Use a trace in one projection.")
        self._projection, self._offset_m, self._turn_rad = stated

    def to_tracks(self) -> Tracks:
        """Return the tracks in the projection of the trace, if it has one."""
        frame, sources = TrackFrame(), []
        if self._without_position:
            sources.append(f"objects without a position left out: {self._without_position:,}")
        if self._projection:
            try:
                WorldFrame.from_projection(self._projection, (0.0, 0.0), "proj_string")
                frame = TrackFrame(self._projection, self._offset_m)
            except InputError as error:
                sources.append(f"proj_string is not used: {error.problem}")
        if frame.crs is None:
            sources.append("the trace has no usable projection: positions count as x, y of the map")
        tracks = self._rows.to_tracks(frame, sources)
        if frame.crs is None or self._turn_rad == 0:
            return tracks
        turned = (tracks.x_m + 1j * tracks.y_m) * np.exp(1j * self._turn_rad)
        yaw_rad = tracks.yaw_rad + self._turn_rad
        return dataclasses.replace(tracks, x_m=turned.real.copy(), y_m=turned.imag.copy(), yaw_rad=yaw_rad)


def _parse(kind: str, content: bytes, where: str) -> GroundTruth:
    from osi3.osi_groundtruth_pb2 import GroundTruth
    from osi3.osi_sensorview_pb2 import SensorView

    with reading.translate_errors(where, _HINT, f"is not a message of type {kind}"):
        if kind == _VIEW:
            return SensorView.FromString(content).global_ground_truth
        return GroundTruth.FromString(content)


def _class_of(item: MovingObject) -> str:
    kind = _TYPES.get(item.type, "other")
    return _VEHICLE_TYPES.get(item.vehicle_classification.type, "other") if kind == "vehicle" else kind


def _box(item: MovingObject) -> Box:
    position, orientation, size = item.base.position, item.base.orientation, item.base.dimension
    return Box(
        position.x,
        position.y,
        position.z if position.HasField("z") else math.nan,
        orientation.yaw if orientation.HasField("yaw") else math.nan,
        size.length if size.HasField("length") else math.nan,
        size.width if size.HasField("width") else math.nan,
        size.height if size.HasField("height") else math.nan,
    )
