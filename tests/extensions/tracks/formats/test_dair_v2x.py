"""Infrastructure labels of DAIR-V2X and V2X-Seq: boxes that a person can check, a round trip, damaged files."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.core.readers import HEAD_BYTES, find_reader
from egvs.extensions.tracks.formats import dair_v2x
from egvs.extensions.tracks.model import TrackFrame
from egvs.formats.sweep_labels import read_labels
from tests.extensions.tracks.boxes import assert_same_boxes, moving_boxes
from tests.extensions.tracks.writers_json import CLASSES, write_dair_v2x

QUARTER_TURN = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]


def label(**more: Any) -> dict[str, Any]:
    """A car 30 m ahead and 4 m to the right of a LiDAR 5.75 m above the road; numbers are texts."""
    return {
        "type": "Car",
        "3d_dimensions": {"h": "1.5", "w": "1.8", "l": "4.2"},
        "3d_location": {"x": "30", "y": "-4", "z": "-5.0"},
        "rotation": "0.5",
        **more,
    }


def data_set(folder: Path, sweeps: list[list[dict[str, Any]]], sequence: str | None = "sequence_id") -> Path:
    """Write sweeps with a step of 0.1 s; return the first label."""
    labels = folder / "label" / "virtuallidar"
    labels.mkdir(parents=True, exist_ok=True)
    index = []
    for number, items in enumerate(sweeps):
        (labels / f"{number:06d}.json").write_text(json.dumps(items))
        entry = {
            "label_lidar_std_path": f"label/virtuallidar/{number:06d}.json",
            "pointcloud_timestamp": f"{1626155122981522 + 100_000 * number}",
        }
        index.append(entry | ({sequence: "0003"} if sequence else {}))
    (folder / "data_info.json").write_text(json.dumps(index))
    return labels / "000000.json"


def calibrate(folder: Path, number: int = 0, **changed: Any) -> Path:
    calib = folder / "calib" / "virtuallidar_to_world"
    calib.mkdir(parents=True, exist_ok=True)
    pose = {
        "rotation": QUARTER_TURN,
        "translation": [[100], [200], [20]],
        "relative_error": {"delta_x": "", "delta_y": ""},
    }
    path = calib / f"{number:06d}.json"
    path.write_text(json.dumps(pose | changed))
    return path


def only_box(path: Path) -> list[float]:
    tracks = dair_v2x.read(path)
    assert tracks.n_rows == 1
    keys = ("time_s", "x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
    return [float(getattr(tracks, key)[0]) for key in keys]


def test_box_in_frame_of_lidar(tmp_path: Path) -> None:
    path = data_set(tmp_path, [[label(track_id="000017")]])
    assert only_box(path) == pytest.approx([1626155122.981522, 30, -4, -5, 0.5, 4.2, 1.8, 1.5], abs=1e-6)
    tracks = dair_v2x.read(path)
    assert (tracks.names, tracks.classes, tracks.frame) == (("000017",), ("car",), TrackFrame())
    assert tracks.sources == (
        "positions are in the LiDAR's frame, as there is no calib/virtuallidar_to_world: they count as x, y of the map",
    )


def test_box_in_frame_of_maps(tmp_path: Path) -> None:
    """Turned by a quarter to the left, (30, -4) is (4, 30); then 100 east, 200 north, 20 up."""
    path = data_set(tmp_path, [[label(track_id=17)]])
    calibrate(tmp_path)
    expected = [1626155122.981522, 104, 230, 15, 0.5 + math.pi / 2, 4.2, 1.8, 1.5]
    assert only_box(path) == pytest.approx(expected, abs=1e-6)
    assert "frame of the data set's maps" in dair_v2x.read(path).sources[0]
    calibrate(tmp_path, translation=[100, 200, 20])
    assert only_box(path) == pytest.approx(expected, abs=1e-6)


def test_boxes_without_track_are_tracks_of_one_row(tmp_path: Path) -> None:
    path = data_set(tmp_path, [[label(), label(type="Van")], [label(), label(track_id="-1")]], sequence="batch_id")
    tracks = dair_v2x.read(path)
    assert tracks.names == ("000000-0", "000000-1", "000001-0", "000001-1")
    assert tracks.sources[1] == (
        "4 boxes without track_id: each is a track of one row, and counts only in a frame at exactly its time"
    )


def test_sequence_of_given_label_is_read(tmp_path: Path) -> None:
    first = data_set(tmp_path, [[label(track_id=1)] for _ in range(4)])
    index = tmp_path / "data_info.json"
    entries = json.loads(index.read_text())
    entries[3]["sequence_id"] = "0004"
    entries.append(entries[0] | {"label_lidar_std_path": "label/virtuallidar/000009.json"})
    index.write_text(json.dumps(entries))
    tracks = dair_v2x.read(first)
    assert np.diff(tracks.time_s) == pytest.approx([0.1, 0.1], abs=1e-6)
    assert tracks.sources[-1] == "sweeps without a label file left out: 1"
    calibrate(tmp_path, 2)
    names = [path.relative_to(tmp_path.absolute()).as_posix() for path in dair_v2x.companions(first)]
    assert names == [
        "data_info.json", "label/virtuallidar/000001.json", "label/virtuallidar/000002.json",
        "calib/virtuallidar_to_world/000002.json",
    ]  # fmt: skip
    assert dair_v2x.read(first.with_name("000003.json")).n_rows == 1
    with pytest.raises(InputError, match=r"data_info.json: lists 2 sequences: 0003, 0004\. Name a label file"):
        dair_v2x.read(index)


def test_index_of_one_sequence_is_read(tmp_path: Path) -> None:
    data_set(tmp_path, [[label(track_id=1)]] * 3, sequence=None)
    assert dair_v2x.read(tmp_path / "data_info.json").n_rows == 3
    assert len(dair_v2x.companions(tmp_path / "data_info.json")) == 3


def test_static_classes_are_counted(tmp_path: Path) -> None:
    path = data_set(tmp_path, [[label(track_id=n, type=kind) for n, kind in enumerate(["Trafficcone", "Tricyclist"])]])
    tracks = dair_v2x.read(path)
    assert tracks.classes == ("motorcycle",)
    assert tracks.sources[-1] == "boxes of static classes left out: 1 Trafficcone"


@pytest.mark.slow
def test_500_sweeps(tmp_path: Path) -> None:
    rows = moving_boxes(CLASSES)
    assert_same_boxes(dair_v2x.read(write_dair_v2x(tmp_path, rows)), rows)


def test_recognises_its_files(tmp_path: Path) -> None:
    path = data_set(tmp_path, [[label()]])
    for file in (path, tmp_path / "data_info.json"):
        assert dair_v2x.can_open(file, file.read_bytes()[:HEAD_BYTES])
    for other in (b"", b"{}", b"\xff[", b'{"3d_location": 1}'):
        assert not dair_v2x.can_open(path, other)


def test_an_empty_list_is_a_sweep_without_labels_but_no_tracks(tmp_path: Path) -> None:
    path = tmp_path / "000001.json"
    path.write_text(" [ ]\n", encoding="utf-8")
    (labels,) = read_labels([path])
    assert (labels.sweep, len(labels)) == ("000001", 0)
    assert find_reader("tracks", path) is None


@pytest.mark.parametrize(
    ("item", "expected"),
    [
        ({"rotation": "left"}, "0.rotation: expected a number, got 'left'"),
        ({"rotation": None}, "0.rotation: is missing"),
        ({"3d_location": {"x": 1, "y": 2}}, "0.3d_location.z: is missing"),
        ({"3d_location": {"x": "nan", "y": 2, "z": 3}}, "0.3d_location.x: expected a number, got 'nan'"),
        ({"3d_dimensions": [1, 2, 3]}, "0.3d_dimensions: expected an object, got [1, 2, 3]"),
        ({"3d_dimensions": {"l": -4, "w": 2, "h": 1}}, "length_m: expected a number between 0 and 100, got -4"),
        ({"type": 3}, "0.type: expected a text, got 3"),
        ({"track_id": [1]}, "0.track_id: expected a text or a whole number"),
    ],
)
def test_damaged_label_gives_one_message(tmp_path: Path, item: dict[str, Any], expected: str) -> None:
    path = data_set(tmp_path, [[label(track_id="1") | item]])
    with pytest.raises(InputError) as error:
        dair_v2x.read(path)
    assert str(error.value).startswith(str(path)) and expected in str(error.value), error.value


def test_damaged_companions(tmp_path: Path) -> None:
    path = data_set(tmp_path, [[label(track_id=1)], [label(track_id=1)]])
    calibrate(tmp_path)
    with pytest.raises(InputError, match=r"has no file '000001\.json', but those of other sweeps"):
        dair_v2x.read(path)
    calibrate(tmp_path, 1, rotation=[[1, 0, 0], [0, 1, 0]])
    with pytest.raises(InputError, match=r"000001\.json: rotation: expected a rotation matrix"):
        dair_v2x.read(path)
    calibrate(tmp_path, 1, translation=[1, 2])
    with pytest.raises(InputError, match=r"000001\.json: translation: expected 3 numbers, got 2"):
        dair_v2x.read(path)
    index = (tmp_path / "data_info.json").read_text()
    (tmp_path / "data_info.json").write_text(re.sub(r'("pointcloud_timestamp": )[^,}]*', r"\g<1>1e40", index, count=1))
    with pytest.raises(InputError, match=r"data_info\.json: .*pointcloud_timestamp: expected microseconds"):
        dair_v2x.read(path)
    (tmp_path / "data_info.json").write_text("[]")
    with pytest.raises(InputError, match=r"is not listed in data_info\.json"):
        dair_v2x.read(path)
    (tmp_path / "data_info.json").unlink()
    with pytest.raises(InputError, match=r"expected data_info\.json, which has the times"):
        dair_v2x.read(path)


def test_labels_in_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = data_set(tmp_path, [[label(track_id=1)]])
    monkeypatch.chdir(path.parent)
    assert dair_v2x.read(Path(path.name)).names == ("1",)
    assert dair_v2x.companions(Path(path.name)) == [tmp_path / "data_info.json"]


def test_labels_of_the_vehicle_are_rejected(tmp_path: Path) -> None:
    path = data_set(tmp_path, [[label()]])
    path.parent.rename(tmp_path / "label" / "lidar")
    with pytest.raises(
        InputError, match=r"there are no labels in label/virtuallidar\. Use the infrastructure's side\."
    ):
        dair_v2x.read(tmp_path / "data_info.json")
    with pytest.raises(InputError, match="expected a label in a folder 'virtuallidar'"):
        dair_v2x.read(tmp_path / "label" / "lidar" / path.name)


def test_labels_at_times_of_images_are_rejected(tmp_path: Path) -> None:
    path = data_set(tmp_path, [[label()]])
    other = tmp_path / "label" / "camera" / path.name
    other.parent.mkdir()
    other.write_bytes(path.read_bytes())
    with pytest.raises(InputError, match=r"Use label/virtuallidar\."):
        dair_v2x.read(other)


def test_index_cannot_lead_out_of_the_folder(tmp_path: Path) -> None:
    path = data_set(tmp_path / "set", [[label(track_id=1)]])
    (tmp_path / "secret.json").write_text(json.dumps([label(track_id="secret")]))
    index = tmp_path / "set" / "data_info.json"
    entries = json.loads(index.read_text())
    entries.append(entries[0] | {"label_lidar_std_path": "../secret.json"})
    index.write_text(json.dumps(entries))
    assert dair_v2x.read(path).names == ("1",)
