"""Scenes of V2X-Seq trajectory forecasting: boxes that a person can check, a round trip, damaged files."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.core.readers import HEAD_BYTES
from egvs.extensions.tracks.formats import v2x_seq_tfd
from egvs.extensions.tracks.model import TrackFrame
from tests.extensions.tracks.boxes import assert_same_boxes, moving_boxes
from tests.extensions.tracks.writers_json import CLASSES, TFD_COLUMNS, write_v2x_seq_tfd

CAR = "PEK,1626155123.9,7,VEHICLE,CAR,TARGET_AGENT,10,5,20.5,4.6,1.9,1.6,1.5708,0,8,yizhuang#4-1_po"
WALKER = "PEK,1626155124.0,8,PEDESTRIAN,PEDESTRIAN,OTHERS,1,2,20,,,,,0,1,yizhuang#4-1_po"


def scene(folder: Path, *rows: str, header: str = ",".join(TFD_COLUMNS)) -> Path:
    path = folder / "10001.csv"
    path.write_text("\n".join([header, *rows, ""]))
    return path


def test_boxes(tmp_path: Path) -> None:
    cone = CAR.replace("VEHICLE,CAR", "UNKNOWN,TRAFFICCONE")
    tracks = v2x_seq_tfd.read(scene(tmp_path, CAR, cone, WALKER))
    keys = ("time_s", "x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
    boxes = np.column_stack([getattr(tracks, key) for key in keys])
    nan = np.nan
    np.testing.assert_allclose(
        boxes,
        [[1626155123.9, 10, 5, 20.5, 1.5708, 4.6, 1.9, 1.6], [1626155124, 1, 2, 20, nan, nan, nan, nan]],
        rtol=1e-12,
    )
    assert (tracks.names, tracks.classes, tracks.frame) == (("7", "8"), ("car", "pedestrian"), TrackFrame())
    assert tracks.sources == (
        "positions are in the frame of the data set's maps, whose place on Earth is unknown",
        "boxes of static classes left out: 1 TRAFFICCONE",
    )


@pytest.mark.parametrize("time", ["1626155123900", "1626155123900000"])
def test_times_in_other_units(tmp_path: Path, time: str) -> None:
    tracks = v2x_seq_tfd.read(scene(tmp_path, CAR.replace("1626155123.9", time)))
    assert tracks.time_s == pytest.approx([1626155123.9])


@pytest.mark.slow
def test_500_frames(tmp_path: Path) -> None:
    rows = moving_boxes(CLASSES)
    path = write_v2x_seq_tfd(tmp_path, rows)
    assert_same_boxes(v2x_seq_tfd.read(path), rows)
    zipped = tmp_path / "scene.csv.gz"
    zipped.write_bytes(gzip.compress(path.read_bytes()))
    assert_same_boxes(v2x_seq_tfd.read(zipped), rows)
    assert v2x_seq_tfd.companions(path) == ()


def test_recognises_its_files(tmp_path: Path) -> None:
    path = scene(tmp_path, CAR)
    assert v2x_seq_tfd.can_open(path, path.read_bytes()[:HEAD_BYTES])
    for other in (b"", b"track_id,frame_id,x,y\n", b"\xff\xfe"):
        assert not v2x_seq_tfd.can_open(path, other)


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        (CAR.replace(",10,5,", ",nan,5,"), "line 2: x: expected a number, got 'nan'"),
        (CAR.replace(",10,5,", ",ten,5,"), "line 2: x: expected a number, got 'ten'"),
        (CAR.replace(",10,5,", ",1e300,5,"), "line 2: x: expected a coordinate from -1e+08 to 1e+08 m, got 1e+300 m"),
        (CAR.replace(",4.6,", ",-4.6,"), "line 2: length: expected a size from 0 to 100 m, got -4.6 m"),
        ("PEK,1", "line 2: expected 16 cells, got 2"),
        (CAR.replace("CAR", "TRAFFICCONE"), "contains no boxes of road users"),
    ],
)
def test_damaged_row_gives_one_message(tmp_path: Path, row: str, expected: str) -> None:
    path = scene(tmp_path, row)
    with pytest.raises(InputError) as error:
        v2x_seq_tfd.read(path)
    assert str(error.value).startswith(str(path)) and expected in str(error.value), error.value


def test_missing_column(tmp_path: Path) -> None:
    path = scene(tmp_path, CAR, header=",".join(TFD_COLUMNS).replace("theta", "angle"))
    with pytest.raises(InputError, match="expected a column 'theta'"):
        v2x_seq_tfd.read(path)
    path = scene(tmp_path, CAR, header=",".join(TFD_COLUMNS).replace("theta", '"an\ngle"'))
    with pytest.raises(InputError) as error:
        v2x_seq_tfd.read(path)
    assert "an gle" in str(error.value) and "\n" not in str(error.value)
