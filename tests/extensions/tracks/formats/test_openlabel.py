"""OpenLABEL in both dialects: boxes that a person can check, a round trip, damaged files.

The poses are those of TUMTraf's station s110: a box at (10, 5, -6.5) in the frame of its southern LiDAR stands on the
road of the station, with its centre half its height above it.
"""

from __future__ import annotations

import gzip
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.readers import HEAD_BYTES
from egvs.extensions.tracks.formats import openlabel
from egvs.extensions.tracks.model import TrackFrame
from tests.extensions.tracks.boxes import assert_same_boxes, moving_boxes
from tests.extensions.tracks.writers_json import CLASSES, SENSOR, write_openlabel, write_tumtraf

TO_BASE = [
    [0.21479485, -0.9761028, 0.03296187, -15.87257873],
    [0.97627128, 0.21553835, 0.02091894, 2.30019086],
    [-0.02752358, 0.02768645, 0.99923767, 7.48077521],
    [0.0, 0.0, 0.0, 1.0],
]
CAR = [10, 5, -6.5, 0, 0, 0.70710678, 0.70710678, 4.6, 1.9, 1.6]


def sweep(
    folder: Path, objects: dict[str, Any], name: str = f"1646667310_044009872_{SENSOR}.json", **more: Any
) -> Path:
    frame = {"frame_properties": {}, "objects": objects}
    path = folder / name
    path.write_text(json.dumps({"openlabel": {"frames": {"7": frame}, **more}}))
    return path


def tumtraf_object(val: Any = CAR, kind: str = "CAR", **more: Any) -> dict[str, Any]:
    return {"object_data": {"name": "x", "type": kind, "cuboid": {"name": "shape3D", "val": val, **more}}}


def asam(folder: Path, cuboid: dict[str, Any], kind: str = "Car", frames: Any = None, **more: Any) -> Path:
    objects = {"1": {"object_data": {"cuboid": [cuboid]}}}
    content = {"0": {"frame_properties": {"timestamp": 2.5}, "objects": objects}} if frames is None else frames
    path = folder / "labels.json"
    path.write_text(
        json.dumps({"openlabel": {"objects": {"1": {"name": "a", "type": kind}}, "frames": content, **more}})
    )
    return path


def station(pose: list[list[float]]) -> dict[str, Any]:
    """Coordinate systems with a LiDAR in its station's base."""
    matrix = np.ravel(pose).tolist()
    return {
        "s110_base": {"type": "local_cs", "parent": "hd_map_origin", "children": [SENSOR]},
        SENSOR: {"type": "sensor_cs", "parent": "s110_base", "pose_wrt_parent": {"matrix4x4": matrix}},
    }


def only_box(path: Path) -> list[float]:
    tracks = openlabel.read(path)
    assert tracks.n_rows == 1
    keys = ("time_s", "x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
    return [float(getattr(tracks, key)[0]) for key in keys]


def test_tumtraf_box_in_sensor_frame(tmp_path: Path) -> None:
    path = sweep(tmp_path, {"uuid": tumtraf_object()})
    expected = [1646667310.044009872, 10, 5, -6.5, math.pi / 2, 4.6, 1.9, 1.6]
    assert only_box(path) == pytest.approx(expected, abs=1e-6)
    tracks = openlabel.read(path)
    assert (tracks.names, tracks.classes, tracks.frame) == (("uuid",), ("car",), TrackFrame())
    assert any(SENSOR in source for source in tracks.sources)


@pytest.mark.parametrize("is_inverse", [False, True])
def test_tumtraf_box_in_base_of_station(tmp_path: Path, is_inverse: bool) -> None:
    """Whichever way the pose is written: the LiDAR is above the road."""
    pose = np.linalg.inv(TO_BASE) if is_inverse else np.array(TO_BASE)
    pose[3] = [0, 0, 0, 1]
    path = sweep(tmp_path, {"a": tumtraf_object()}, coordinate_systems=station(pose.tolist()))
    assert only_box(path)[1:] == pytest.approx([-18.819, 13.005, 0.849, 2.9243, 4.6, 1.9, 1.6], abs=6e-4)
    assert any("'s110_base'" in source for source in openlabel.read(path).sources)


def test_all_sweeps_of_sensor_are_one_recording(tmp_path: Path) -> None:
    first = sweep(tmp_path, {"a": tumtraf_object()})
    second = sweep(tmp_path, {"a": tumtraf_object()}, name=f"1646667310_144009872_{SENSOR}.json")
    sweep(tmp_path, {"b": tumtraf_object()}, name="1646667310_144009872_s110_lidar_ouster_north.json")
    (tmp_path / "notes.json").write_text("{}")
    assert openlabel.companions(second) == [first]
    tracks = openlabel.read(second)
    assert np.diff(tracks.time_s) == pytest.approx([0.1], abs=1e-6)
    assert tracks.names == ("a",)
    assert "all 2 sweeps" in tracks.sources[0]


def test_message_names_the_damaged_sweep(tmp_path: Path) -> None:
    first = sweep(tmp_path, {"a": tumtraf_object()})
    second = sweep(tmp_path, {"a": tumtraf_object([1e9, *CAR[1:]])}, name=f"1646667310_144009872_{SENSOR}.json")
    with pytest.raises(InputError) as error:
        openlabel.read(first)
    assert str(error.value).startswith(f"{second}: track 'a', time 1.64667e+09 s: x_m: expected a number")


def test_labels_in_common_road_have_z_at_bottom(tmp_path: Path) -> None:
    path = sweep(tmp_path, {"a": tumtraf_object([1, 2, 0, 0, 0, 0, 1, 4, 2, 1.5], coordinate_system="common_road")})
    assert only_box(path)[3] == 0.75


def test_zero_headings_are_missing(tmp_path: Path) -> None:
    """Predictions saved by TUMTraf's development kit have yaw 0."""
    objects = {str(n): tumtraf_object([n, 0, 0, 0, 0, 0, 1, 4, 2, 1.5]) for n in range(20)}
    tracks = openlabel.read(sweep(tmp_path, objects))
    assert np.isnan(tracks.yaw_rad).all()
    assert "headings are exactly 0" in tracks.sources[-1]
    objects["0"] = tumtraf_object()
    assert not np.isnan(openlabel.read(sweep(tmp_path, objects)).yaw_rad).any()


def test_asam_box(tmp_path: Path) -> None:
    cuboid = {"name": "box", "coordinate_system": "site", "val": [1, 2, 3, 0, 0, 1, 0, 4, 2, 1.5]}
    path = asam(tmp_path, cuboid)
    assert only_box(path) == pytest.approx([2.5, 1, 2, 3, math.pi, 4, 2, 1.5])
    assert openlabel.companions(path) == []


def test_asam_box_with_euler_angles(tmp_path: Path) -> None:
    assert only_box(asam(tmp_path, {"name": "box", "val": [1, 2, 3, 0, 0, -0.5, 4, 2, 1.5]}))[4] == pytest.approx(-0.5)


def test_asam_box_moves_with_vehicle_to_utm_zone(tmp_path: Path) -> None:
    """A box 10 m ahead of a vehicle that looks north; its LiDAR looks left, 2 m above the ground."""
    half = math.sqrt(0.5)
    turned_left = {"quaternion": [0, 0, half, half]}
    systems = {
        "utm-30t": {"type": "geo_utm", "parent": "", "children": ["vehicle"]},
        "vehicle": {"type": "local_cs", "parent": "utm-30t", "children": ["lidar"]},
        "lidar": {
            "type": "sensor_cs",
            "parent": "vehicle",
            "pose_wrt_parent": {**turned_left, "translation": [0, 0, 2]},
        },
    }
    to_world = {
        "src": "vehicle",
        "dst": "utm-30t",
        "transform_src_to_dst": {**turned_left, "translation": [500, 700, 9]},
    }
    cuboid = {"name": "box", "coordinate_system": "lidar", "val": [0, -10, -1, 0, 0, 0, 1, 4, 2, 1.5]}
    objects = {"1": {"object_data": {"cuboid": [cuboid, cuboid]}}}
    properties = {"timestamp": "1.5", "transforms": {"vehicle_to_utm-30t": to_world}}
    path = asam(
        tmp_path, cuboid, coordinate_systems=systems, frames={"0": {"frame_properties": properties, "objects": objects}}
    )
    assert np.abs(only_box(path)) == pytest.approx([1.5, 500, 710, 10, math.pi, 4, 2, 1.5])
    tracks = openlabel.read(path)
    assert tracks.frame == TrackFrame("EPSG:32630")
    assert tracks.sources == ("further cuboids of the same object left out: 1",)


def test_static_and_unknown_classes_are_counted(tmp_path: Path) -> None:
    kinds = {"1": "TrafficLight", "2": "traffic_light", "3": "Spaceship", "4": "VAN"}
    path = sweep(tmp_path, {key: tumtraf_object(kind=kind) for key, kind in kinds.items()} | {"5": {"object_data": {}}})
    tracks = openlabel.read(path)
    assert tracks.names == ("3", "4") and tracks.classes == ("other", "van")
    assert tracks.sources[1:] == (
        "objects without a cuboid left out: 1",
        "boxes of static classes left out: 1 TrafficLight, 1 traffic_light",
        'boxes of unknown classes, which count as "other": 1 Spaceship',
    )


def test_quaternion_of_length_zero_is_no_heading(tmp_path: Path) -> None:
    assert math.isnan(only_box(sweep(tmp_path, {"a": tumtraf_object([1, 2, 0, 0, 0, 0, 0, 4, 2, 1.5])}))[4])


@pytest.mark.slow
def test_500_frames_of_asam(tmp_path: Path) -> None:
    rows = moving_boxes(CLASSES)
    assert_same_boxes(openlabel.read(write_openlabel(tmp_path, rows)), rows)


@pytest.mark.slow
def test_500_sweeps_of_tumtraf(tmp_path: Path) -> None:
    rows = moving_boxes(CLASSES)
    path = write_tumtraf(tmp_path, rows)
    assert len(openlabel.companions(path)) == 499
    assert_same_boxes(openlabel.read(path), rows)


def test_gzipped_file(tmp_path: Path) -> None:
    path = asam(tmp_path, {"name": "box", "val": CAR})
    zipped = tmp_path / "labels.json.gz"
    zipped.write_bytes(gzip.compress(path.read_bytes()))
    assert only_box(zipped) == only_box(path)


def test_recognises_its_files(tmp_path: Path) -> None:
    head = asam(tmp_path, {"name": "box", "val": CAR}).read_bytes()[:HEAD_BYTES]
    assert openlabel.can_open(Path("a"), head)
    for other in (b"", b'[{"openlabel": 1}]', b"PAR1", b"\xff\xfe{"):
        assert not openlabel.can_open(Path("a"), other)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda o: o["frames"]["7"]["objects"]["a"]["object_data"].pop("type"), "object_data.type: is missing"),
        (lambda o: o["frames"]["7"]["objects"]["a"].update(object_data=[]), "object_data: expected an object, got []"),
        (lambda o: o.pop("frames"), "openlabel.frames: is missing"),
        (lambda o: o.update(frames=[1]), "openlabel.frames: expected an object, got [1]"),
        (lambda o: cuboid_of(o).update(val=CAR[:8]), "cuboid.val: expected 9 or 10 numbers, got 8"),
        (lambda o: cuboid_of(o).update(val=["x", *CAR[1:]]), "cuboid.val.0: expected a number, got 'x'"),
        (lambda o: cuboid_of(o).update(val=[math.nan, *CAR[1:]]), "cuboid.val.0: expected a number, got nan"),
        (
            lambda o: cuboid_of(o).update(val=[*CAR[:6], 3, 4, 2, 1]),
            "val: expected a quaternion of length 1, got one of",
        ),
        (lambda o: cuboid_of(o).update(val=[1e308, *CAR[1:]]), "x_m: expected a number between -1e+08 and 1e+08"),
        (lambda o: cuboid_of(o).update(val=[*CAR[:7], -4, 2, 1]), "length_m: expected a number between 0 and 100"),
        (lambda o: cuboid_of(o).update(coordinate_system=5), "coordinate_system: expected a text, got 5"),
        (lambda o: o.update(coordinate_systems=station([[2, 0, 0, 0], *TO_BASE[1:]])), "expected a rotation"),
        (lambda o: o["frames"]["7"].update(objects={}), "contains no boxes of road users"),
        (lambda o: o["frames"]["7"]["frame_properties"].update(timestamp="noon"), "timestamp: expected a number"),
    ],
)
def test_damaged_sweep_gives_one_message(tmp_path: Path, change: Any, expected: str) -> None:
    path = sweep(tmp_path, {"a": tumtraf_object()})
    document = json.loads(path.read_text())
    change(document["openlabel"])
    path.write_text(json.dumps(document))
    with pytest.raises(InputError) as error:
        openlabel.read(path)
    assert str(error.value).startswith(str(path)) and expected in str(error.value), error.value
    assert "\n" not in str(error.value)


def cuboid_of(document: dict[str, Any]) -> dict[str, Any]:
    cuboid: dict[str, Any] = document["frames"]["7"]["objects"]["a"]["object_data"]["cuboid"]
    return cuboid


def test_asam_frame_without_time(tmp_path: Path) -> None:
    cuboid = {"name": "box", "val": CAR}
    frames = {"0": {"objects": {"1": {"object_data": {"cuboid": [cuboid]}}}}}
    with pytest.raises(InputError, match=r"frames\.0: frame_properties.timestamp is missing"):
        openlabel.read(asam(tmp_path, cuboid, frames=frames))


def test_undeclared_object(tmp_path: Path) -> None:
    path = asam(tmp_path, {"name": "box", "val": CAR}, objects={})
    with pytest.raises(InputError, match=r"openlabel\.objects\.1: is missing"):
        openlabel.read(path)


def test_several_coordinate_systems(tmp_path: Path) -> None:
    first, second = (tumtraf_object(coordinate_system=name) for name in ("a", "b"))
    with pytest.raises(InputError, match="several coordinate systems: 'a', 'b'"):
        openlabel.read(sweep(tmp_path, {"1": first, "2": second}))


def test_system_that_is_its_own_ancestor(tmp_path: Path) -> None:
    pose = {"quaternion": [0, 0, 0, 1], "translation": [0, 0, 0]}
    systems = {
        "a": {"type": "x", "parent": "b", "pose_wrt_parent": pose},
        "b": {"parent": "a", "pose_wrt_parent": pose},
    }
    path = asam(tmp_path, {"name": "box", "coordinate_system": "a", "val": CAR}, coordinate_systems=systems)
    with pytest.raises(InputError, match="is its own ancestor"):
        openlabel.read(path)


@pytest.mark.parametrize(
    "content", [b"", b'{"openlabel": {"frames": {', b"[" * 100_000, b'{"openlabel": 1e400}', b"\xff"]
)
def test_text_that_is_no_document(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "labels.json"
    path.write_bytes(content)
    with pytest.raises(InputError) as error:
        openlabel.read(path)
    assert str(error.value).startswith(str(path))


def test_large_file_is_rejected_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(limits.DOCUMENT.name, "1")
    path = tmp_path / "labels.json.gz"
    path.write_bytes(gzip.compress(b" " * 2_000_000))
    with pytest.raises(InputError, match="holds more than 1 MB after decompression"):
        openlabel.read(path)
    monkeypatch.setenv(limits.ROWS.name, "3")
    with pytest.raises(InputError, match="EGVS_MAX_ROWS"):
        openlabel.read(write_openlabel(tmp_path, moving_boxes(CLASSES, 5)))
