"""Traces of ASAM OSI: boxes that a person can check, round trips, damaged files."""

from __future__ import annotations

import dataclasses
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egvs.core import limits, plugins
from egvs.core.errors import InputError, MissingExtraError
from egvs.core.readers import HEAD_BYTES
from egvs.extensions.tracks.formats import osi
from egvs.extensions.tracks.model import TrackFrame
from tests.extensions.tracks.boxes import assert_same_boxes, moving_boxes
from tests.extensions.tracks.writers_json import CLASSES, write_osi, write_osi_mcap

groundtruth = pytest.importorskip("osi3.osi_groundtruth_pb2", reason="osi-python is not installed (egvs[osi])")


def one_car() -> Any:
    """Object 7 at t = 1.5 s: a car at (10, 5), its centre 0.8 m up, heading north."""
    truth = groundtruth.GroundTruth()
    truth.timestamp.seconds, truth.timestamp.nanos = 1, 500_000_000
    item = truth.moving_object.add()
    item.id.value, item.type, item.vehicle_classification.type = 7, 2, 4
    item.base.position.x, item.base.position.y, item.base.position.z = 10, 5, 0.8
    item.base.orientation.yaw = 1.5707963
    item.base.dimension.length, item.base.dimension.width, item.base.dimension.height = 4.6, 1.9, 1.6
    return truth


def trace(folder: Path, *messages: Any, name: str = "trace_gt_3.osi") -> Path:
    path = folder / name
    contents = [message.SerializeToString() for message in messages]
    path.write_bytes(b"".join(struct.pack("<I", len(content)) + content for content in contents))
    return path


def mcap_trace(folder: Path, messages: list[tuple[str, str, bytes]], compression: str = "ZSTD") -> Path:
    """Write messages, each with the name of its schema and its topic."""
    from mcap.writer import CompressionType, Writer

    path = folder / "trace.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType[compression])
        writer.start()
        channels = {}
        for schema, topic, content in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(
                    topic, "protobuf", writer.register_schema(schema, "protobuf", b"")
                )
            writer.add_message(channels[topic], 0, content, 0)
        writer.finish()
    return path


def only_box(path: Path) -> list[float]:
    tracks = osi.read(path)
    assert tracks.n_rows == 1
    keys = ("time_s", "x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
    return [float(getattr(tracks, key)[0]) for key in keys]


EXPECTED = [1.5, 10, 5, 0.8, 1.5707963, 4.6, 1.9, 1.6]


def test_box(tmp_path: Path) -> None:
    path = trace(tmp_path, one_car())
    assert only_box(path) == EXPECTED
    tracks = osi.read(path)
    assert (tracks.names, tracks.classes, tracks.frame) == (("7",), ("car",), TrackFrame())
    assert tracks.sources == ("the trace has no usable projection: positions count as x, y of the map",)
    assert osi.companions(path) == ()


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_box_in_mcap(tmp_path: Path, compression: str) -> None:
    """Other messages do not count, nor does a SensorView where there is ground truth."""
    messages = [
        ("osi3.MapAsamOpenDrive", "map", b"xx"),
        ("osi3.SensorView", "view", sensor_view().SerializeToString()),
        ("osi3.GroundTruth", "truth", one_car().SerializeToString()),
    ]
    assert only_box(mcap_trace(tmp_path, messages, compression)) == EXPECTED
    assert only_box(mcap_trace(tmp_path, messages[:2], compression)) == EXPECTED


def sensor_view() -> Any:
    from osi3.osi_sensorview_pb2 import SensorView

    view = SensorView()
    view.global_ground_truth.CopyFrom(one_car())
    return view


def test_box_in_sensor_view(tmp_path: Path) -> None:
    assert only_box(trace(tmp_path, sensor_view(), name="20261101T120000Z_sv_370_700_1_test.osi")) == EXPECTED


def test_unset_fields_are_missing(tmp_path: Path) -> None:
    """A number that is not set reads 0."""
    truth = one_car()
    base = truth.moving_object[0].base
    base.dimension.ClearField("height")
    base.position.ClearField("z")
    base.ClearField("orientation")
    truth.moving_object.add().type = 3
    path = trace(tmp_path, truth)
    np.testing.assert_equal(only_box(path), [1.5, 10, 5, math.nan, math.nan, 4.6, 1.9, math.nan])
    assert osi.read(path).sources[0] == "objects without a position left out: 1"


def test_frame_is_that_of_projection(tmp_path: Path) -> None:
    """Turned by a quarter to the left, (10, 5) is (-5, 10); the projection may stand in one message only."""
    first, second = one_car(), one_car()
    first.proj_string = "+proj=utm +zone=32 +datum=WGS84 +units=m"
    first.proj_frame_offset.position.x, first.proj_frame_offset.position.y = 500_000, 5_400_000
    second.timestamp.seconds = 2
    path = trace(tmp_path, first, second)
    assert osi.read(path).frame == TrackFrame(first.proj_string, (500_000, 5_400_000))
    assert osi.read(path).x_m.tolist() == [10, 10] and osi.read(path).sources == ()
    first.proj_frame_offset.yaw = math.pi / 2
    tracks = osi.read(trace(tmp_path, second, first))
    assert tracks.x_m == pytest.approx([-5, -5]) and tracks.y_m == pytest.approx([10, 10])
    assert tracks.yaw_rad == pytest.approx([math.pi, math.pi])
    second.proj_string = "EPSG:25833"
    with pytest.raises(InputError, match="message 2: proj_string or proj_frame_offset changes"):
        osi.read(trace(tmp_path, first, second))


@pytest.mark.parametrize("text", ["+proj=longlat", "nowhere"])
def test_projection_without_metres_is_not_used(tmp_path: Path, text: str) -> None:
    truth = one_car()
    truth.proj_string = text
    tracks = osi.read(trace(tmp_path, truth))
    assert tracks.frame == TrackFrame() and tracks.sources[0].startswith("proj_string is not used: ")


def test_classes(tmp_path: Path) -> None:
    truth = one_car()
    for number, (kind, vehicle) in enumerate([(2, 9), (2, 21), (3, 0), (4, 0), (2, 17), (2, 0)]):
        item = truth.moving_object.add()
        item.CopyFrom(truth.moving_object[0])
        item.id.value, item.type, item.vehicle_classification.type = 10 + number, kind, vehicle
    expected = ("trailer", "other", "pedestrian", "other", "bicycle", "car", "car")
    assert osi.read(trace(tmp_path, truth)).classes == expected


@pytest.mark.parametrize("write", [write_osi, write_osi_mcap])
def test_500_frames(tmp_path: Path, write: Callable[..., Path]) -> None:
    rows = moving_boxes(CLASSES)
    nan = np.where(np.arange(len(rows.name)) % 7 == 0, np.nan, rows.height_m)
    rows = dataclasses.replace(rows, height_m=nan)
    assert_same_boxes(osi.read(write(tmp_path, rows)), rows)


def test_recognises_its_files(tmp_path: Path) -> None:
    path = write_osi_mcap(tmp_path, moving_boxes(CLASSES, 5))
    assert osi.can_open(tmp_path / "a", path.read_bytes()[:HEAD_BYTES])
    assert osi.can_open(tmp_path / "a.OSI", b"")
    assert not osi.can_open(tmp_path / "a.csv", b"\x05\x00\x00\x00")


def test_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = trace(tmp_path, one_car())
    monkeypatch.setattr(plugins, "find_spec", lambda name: None if name == "osi3" else object())
    with pytest.raises(MissingExtraError) as error:
        osi.read(path)
    text = "trace_gt_3.osi: reading ASAM OSI needs osi-python, which is not installed. Run pip install 'egvs[osi]'"
    assert str(error.value) == text and error.value.exit_code == 2


def test_damaged_trace_gives_one_message(tmp_path: Path) -> None:
    path = trace(tmp_path, one_car(), one_car())
    whole = path.read_bytes()
    path.write_bytes(whole[:-3])
    with pytest.raises(InputError, match=r"message 2: expected \d+ bytes, got \d+"):
        osi.read(path)
    path.write_bytes(whole + b"\x01")
    with pytest.raises(InputError, match="message 3: expected 0 bytes, got 0"):
        osi.read(path)
    path.write_bytes(b"\xff\xff\xff\xff")
    with pytest.raises(InputError, match=f"is 4,295 MB long.*{limits.ELEMENT.name}"):
        osi.read(path)
    path.write_bytes(b"\x03\x00\x00\x00abc")
    with pytest.raises(InputError, match=r"message 1: is not a message of type osi3\.GroundTruth"):
        osi.read(path)
    path.write_bytes(b"")
    with pytest.raises(InputError, match=r"expected one channel of osi3\.GroundTruth messages, got none"):
        osi.read(path)


def test_impossible_values_give_one_message(tmp_path: Path) -> None:
    truth = one_car()
    truth.moving_object[0].base.position.x = math.nan
    with pytest.raises(InputError, match=r"track '7', time 1\.5 s: x_m: expected a number"):
        osi.read(trace(tmp_path, truth))
    truth.moving_object[0].base.position.x = math.inf
    with pytest.raises(InputError, match="x_m: expected a number between"):
        osi.read(trace(tmp_path, truth))
    truth = one_car()
    truth.ClearField("timestamp")
    with pytest.raises(InputError, match="message 1: timestamp is missing"):
        osi.read(trace(tmp_path, truth))
    with pytest.raises(InputError, match="contains no boxes of road users"):
        osi.read(trace(tmp_path, without_objects()))


def without_objects() -> Any:
    truth = one_car()
    truth.ClearField("moving_object")
    return truth


def test_damaged_mcap(tmp_path: Path) -> None:
    content = one_car().SerializeToString()
    path = mcap_trace(tmp_path, [("osi3.GroundTruth", "a", content), ("osi3.GroundTruth", "b", content)])
    with pytest.raises(InputError, match=r"expected one channel of osi3\.GroundTruth messages, got a, b"):
        osi.read(path)
    path = mcap_trace(tmp_path, [("osi3.GroundTruth", "a", content)])
    whole = path.read_bytes()
    path.write_bytes(whole[:100])
    with pytest.raises(InputError, match="cannot be read as MCAP"):
        osi.read(path)
    path = mcap_trace(tmp_path, [("Other", "a", content)])
    with pytest.raises(InputError, match="got none"):
        osi.read(path)


def test_chunk_that_grows_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """100 kB of LZ4 that would become 20 MB."""
    truth = one_car()
    truth.map_reference = "x" * 20_000_000
    messages = [("osi3.GroundTruth", "a", truth.SerializeToString())]
    path = mcap_trace(tmp_path, messages, "LZ4")
    assert path.stat().st_size < 200_000
    assert osi.read(path).n_rows == 1
    monkeypatch.setenv(limits.UNPACKED.name, "10")
    with pytest.raises(InputError, match=limits.UNPACKED.name):
        osi.read(path)
