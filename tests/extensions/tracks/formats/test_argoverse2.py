"""Scenarios and annotations of Argoverse 2: boxes that a person can check, round trips, damaged files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyproj
import pytest
from pyarrow import feather, parquet

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.readers import HEAD_BYTES
from egvs.extensions.tracks.formats import argoverse2
from egvs.extensions.tracks.model import TrackFrame
from tests.extensions.tracks.boxes import assert_same_boxes, moving_boxes
from tests.extensions.tracks.writers_json import CLASSES, write_argoverse2, write_argoverse2_scenario

HALF = math.sqrt(0.5)
TIME_NS = 315973157959879000
BOX = {
    "timestamp_ns": [TIME_NS], "track_uuid": ["a"], "category": ["REGULAR_VEHICLE"], "length_m": [4.6],
    "width_m": [1.9], "height_m": [1.6], "qw": [HALF], "qx": [0.0], "qy": [0.0], "qz": [HALF], "tx_m": [10.0],
    "ty_m": [2.0], "tz_m": [0.8], "num_interior_pts": [90],
}  # fmt: skip
POSE = {
    "timestamp_ns": [TIME_NS, 5], "qw": [HALF, 1.0], "qx": [0.0, 0.0], "qy": [0.0, 0.0], "qz": [HALF, 0.0],
    "tx_m": [100.0, 0.0], "ty_m": [200.0, 0.0], "tz_m": [20.0, 0.0],
}  # fmt: skip
STEP = {
    "track_id": ["AV"], "object_type": ["vehicle"], "timestep": [7], "position_x": [3.5], "position_y": [-2.0],
    "heading": [0.25], "start_timestamp": [3.15973157e17], "city": ["pittsburgh"],
}  # fmt: skip


def annotations(folder: Path, boxes: dict[str, Any] = BOX, poses: dict[str, Any] | None = POSE) -> Path:
    path = folder / "annotations.feather"
    feather.write_feather(pa.table(boxes), str(path))
    if poses is not None:
        feather.write_feather(pa.table(poses), str(folder / "city_SE3_egovehicle.feather"))
    return path


def scenario(folder: Path, columns: dict[str, Any] = STEP) -> Path:
    path = folder / "scenario_1.parquet"
    parquet.write_table(pa.table(columns), path)
    return path


def only_box(path: Path) -> list[float]:
    tracks = argoverse2.read(path)
    assert tracks.n_rows == 1
    keys = ("time_s", "x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
    return [float(getattr(tracks, key)[0]) for key in keys]


def test_annotated_box_in_frame_of_city(tmp_path: Path) -> None:
    """The vehicle at (100, 200) looks north, so 10 ahead and 2 to the left is (98, 210)."""
    path = annotations(tmp_path)
    box = only_box(path)
    box[4] = abs(box[4])
    assert box == pytest.approx([315973157.959879, 98, 210, 20.8, math.pi, 4.6, 1.9, 1.6])
    tracks = argoverse2.read(path)
    assert (tracks.names, tracks.classes, tracks.frame) == (("a",), ("car",), TrackFrame())
    assert tracks.sources == ("the city is unknown, so positions in its frame count as x, y of the map",)


def test_sign_of_quaternion_does_not_count(tmp_path: Path) -> None:
    box = only_box(annotations(tmp_path, BOX | {"qw": [-HALF], "qz": [-HALF]}))
    assert np.abs(box) == pytest.approx([315973157.959879, 98, 210, 20.8, math.pi, 4.6, 1.9, 1.6])


def test_heading_of_tilted_box(tmp_path: Path) -> None:
    """Rolled and pitched by 0.1 rad: the direction of its front on the ground, as rotations about fixed axes say."""
    roll, pitch, yaw = 0.1, -0.1, 0.7
    cr, sr, cp, sp, cy, sy = (f(a / 2) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    quaternion = {
        "qw": [cr * cp * cy + sr * sp * sy], "qx": [sr * cp * cy - cr * sp * sy],
        "qy": [cr * sp * cy + sr * cp * sy], "qz": [cr * cp * sy - sr * sp * cy],
    }  # fmt: skip
    level = POSE | {"qw": [1.0, 1.0], "qz": [0.0, 0.0]}
    assert only_box(annotations(tmp_path, BOX | quaternion, level))[4] == pytest.approx(yaw)


def test_city_of_annotations_is_in_name_of_map(tmp_path: Path) -> None:
    path = annotations(tmp_path)
    (tmp_path / "map").mkdir()
    log_map = tmp_path / "map" / "log_map_archive_adcf7d18____PIT_city_57819.json"
    log_map.write_text("{}")
    frame = argoverse2.read(path).frame
    assert frame.crs == "EPSG:32617" and frame.offset_m == pytest.approx((583710.007, 4477260.0), abs=1e-3)
    assert argoverse2.companions(path) == [tmp_path / "city_SE3_egovehicle.feather", log_map]


def test_scenario_step(tmp_path: Path) -> None:
    path = scenario(tmp_path)
    box = only_box(path)
    assert box[:3] + box[4:5] == pytest.approx([315973157.7, 3.5, -2, 0.25])
    assert np.isnan([box[3], *box[5:]]).all()
    assert argoverse2.read(path).frame.crs == "EPSG:32617"
    assert argoverse2.companions(path) == ()


def test_origins_of_cities() -> None:
    """Against PROJ, from the latitudes and longitudes in the development kit."""
    origins = {
        "ATX": (30.27464237939507, -97.7404457407424), "DTW": (42.29993066912924, -83.17555750783717),
        "MIA": (25.77452579915163, -80.19656914449405), "PAO": (37.416065, -122.13571963362166),
        "PIT": (40.44177902989321, -80.01294377242584), "WDC": (38.889377, -77.0355047439081),
    }  # fmt: skip
    assert {code for code, *_ in argoverse2.CITY_ORIGINS.values()} == set(origins)
    for code, zone, origin_m in argoverse2.CITY_ORIGINS.values():
        lat_deg, lon_deg = origins[code]
        assert zone == math.floor((lon_deg + 180) / 6) + 1
        expected = pyproj.Proj(proj="utm", zone=zone, ellps="WGS84")(lon_deg, lat_deg)
        assert origin_m == pytest.approx(expected, abs=1e-5)


def test_static_classes_are_counted(tmp_path: Path) -> None:
    columns = {key: values * 3 for key, values in STEP.items()}
    tracks = argoverse2.read(scenario(tmp_path, columns | {"object_type": ["static", "background", "bus"]}))
    assert tracks.classes == ("bus",)
    assert tracks.sources == ("boxes of static classes left out: 1 static, 1 background",)
    boxes = {key: values * 2 for key, values in BOX.items()} | {"category": ["STOP_SIGN", "BOX_TRUCK"]}
    tracks = argoverse2.read(annotations(tmp_path, boxes))
    assert tracks.classes == ("truck",) and tracks.sources[-1] == "boxes of static classes left out: 1 STOP_SIGN"


def test_500_frames_of_annotations(tmp_path: Path) -> None:
    rows = moving_boxes(CLASSES)
    assert_same_boxes(argoverse2.read(write_argoverse2(tmp_path, rows)), rows)


def test_500_frames_of_scenario(tmp_path: Path) -> None:
    rows = moving_boxes(("car", "bus", "motorcycle", "bicycle", "pedestrian"))
    tracks = argoverse2.read(write_argoverse2_scenario(tmp_path, rows))
    assert_same_boxes(tracks, rows, missing=("z_m", "length_m", "width_m", "height_m"))


def test_recognises_its_files(tmp_path: Path) -> None:
    paths = [annotations(tmp_path), scenario(tmp_path)]
    for path in paths:
        assert argoverse2.can_open(path, path.read_bytes()[:HEAD_BYTES])
    for other in (b"", b"PAR1", b"ARROW1", b"{"):
        assert not argoverse2.can_open(tmp_path / "absent", other)
    parquet.write_table(pa.table({"x": [1]}), paths[1])
    assert not argoverse2.can_open(paths[1], paths[1].read_bytes())


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"tx_m": [math.nan]}, "row 1: tx_m: expected a number, got nan"),
        ({"tx_m": pa.array([None], pa.float64())}, "row 1: tx_m: is empty"),
        ({"tx_m": ["ten"]}, "tx_m: expected numbers, got values of type string"),
        ({"tx_m": [1e300]}, "row 1: tx_m, ty_m, tz_m: expected coordinates of at most 1e+08 m"),
        ({"qw": [0.0], "qz": [0.0]}, "row 1: qx, qy, qz, qw: expected a quaternion, got [0.0, 0.0, 0.0, 0.0]"),
        ({"length_m": [-4.0]}, "length_m: expected a number between 0 and 100, got -4"),
        ({"track_uuid": ["x" * 5000]}, "expected a name of at most 200 characters, got 5,000"),
    ],
)
def test_damaged_annotations_give_one_message(tmp_path: Path, change: dict[str, Any], expected: str) -> None:
    path = annotations(tmp_path, BOX | change)
    with pytest.raises(InputError) as error:
        argoverse2.read(path)
    assert str(error.value).startswith(str(path)) and expected in str(error.value), error.value


def test_missing_column_or_pose(tmp_path: Path) -> None:
    path = annotations(tmp_path, {key: values for key, values in BOX.items() if key != "qw"})
    with pytest.raises(InputError, match="expected a column 'qw', got timestamp_ns"):
        argoverse2.read(path)
    annotations(tmp_path, BOX | {"timestamp_ns": [TIME_NS + 1000]})
    with pytest.raises(InputError, match=f"has no pose at timestamp_ns {TIME_NS + 1000} of annotations.feather"):
        argoverse2.read(path)
    (tmp_path / "city_SE3_egovehicle.feather").unlink()
    with pytest.raises(InputError, match=r"expected city_SE3_egovehicle\.feather beside it"):
        argoverse2.read(path)


def test_far_pose_names_the_file_of_poses(tmp_path: Path) -> None:
    path = annotations(tmp_path, poses=POSE | {"tz_m": [2e9, 0.0]})
    message = r"city_SE3_egovehicle\.feather: row 1: tx_m, ty_m, tz_m: expected coordinates of at most 1e\+08 m, got \["
    with pytest.raises(InputError, match=message):
        argoverse2.read(path)


@pytest.mark.parametrize("kind", ["annotations.feather", "scenario_1.parquet"])
def test_truncated_file(tmp_path: Path, kind: str) -> None:
    path = annotations(tmp_path) if kind.startswith("ann") else scenario(tmp_path)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match="cannot be read as Parquet or Feather"):
        argoverse2.read(path)


def test_rows_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(limits.ROWS.name, "5")
    for write in (write_argoverse2, write_argoverse2_scenario):
        with pytest.raises(InputError, match="EGVS_MAX_ROWS"):
            argoverse2.read(write(tmp_path, moving_boxes(CLASSES, 9)))


def test_long_text_in_every_row_does_not_fill_memory(tmp_path: Path) -> None:
    """50,000 rows with one name of a megabyte are a small file, since Parquet stores the name once."""
    columns = {key: pa.array(values * 50_000) for key, values in STEP.items()}
    name = pa.DictionaryArray.from_arrays(pa.array([0] * 50_000, pa.int32()), pa.array(["x" * 1_000_000]))
    path = scenario(tmp_path, columns | {"track_id": name})
    assert path.stat().st_size < 3_000_000
    with pytest.raises(InputError, match="expected a name of at most 200 characters"):
        argoverse2.read(path)
