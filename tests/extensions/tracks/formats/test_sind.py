"""SinD, by hand and from pedestrians at Chongqing."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from egvs.extensions.tracks import sources as track_readers
from egvs.extensions.tracks.formats import sind
from egvs.extensions.tracks.formats.interaction import MAP_FRAME
from tests.extensions.tracks.boxes import assert_same_boxes, moving_boxes
from tests.extensions.tracks.hand import REAL, assert_boxes, assert_one_message, needs_sind, truncated_gzip
from tests.extensions.tracks.writers import write_sind

NAN = math.nan
VEHICLES = """track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,yaw_rad,heading_rad,length,width,ax,ay,v_lon,v_lat
12,58,5805.8058,car,10,5,0,8,1.5708,1.5650,4.9,1.87,0,0,8,0
13,58,5805.8058,tricycle,1,2,0,8,0.1,0.2,2.4,1.1,0,0,8,0
"""
PEDESTRIANS = """track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,ax,ay
P0,412,41241.2412,pedestrian,-14.39,33.91,-0.3,-0.7,0,0
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "Veh_smoothed_tracks.csv"
    path.write_text(text)
    return path


def test_vehicles_by_hand(tmp_path: Path) -> None:
    """Yaw is the direction of the body, not that of the motion."""
    path = write(tmp_path, VEHICLES)
    assert track_readers.find_reader(path) is sind
    tracks = sind.read(path)
    assert_boxes(tracks, [("12", "car", 5.8058, 10, 5, NAN, 1.5708, 4.9, 1.87, NAN),
                          ("13", "other", 5.8058, 1, 2, NAN, 0.1, 2.4, 1.1, NAN)])  # fmt: skip
    assert tracks.frame is MAP_FRAME and tracks.sources == ("tricycles are of class other",)


def test_pedestrians_by_hand(tmp_path: Path) -> None:
    path = write(tmp_path, PEDESTRIANS)
    assert track_readers.find_reader(path) is sind and not sind.companions(path)
    assert_boxes(sind.read(path), [("P0", "pedestrian", 41.2412, -14.39, 33.91, NAN, NAN, NAN, NAN, NAN)])


def test_500_frames_written_and_read(tmp_path: Path) -> None:
    boxes = moving_boxes(["car", "truck", "bus", "motorcycle", "bicycle", "pedestrian", "other"])
    assert_same_boxes(sind.read(write_sind(tmp_path, boxes)), boxes, ["z_m", "height_m"])


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("y,vx", "north,vx", "Veh_smoothed_tracks.csv: expected a column 'y'"),
        (VEHICLES[VEHICLES.index("\n") :], "", "contains no rows"),
        (",1.5708,", ",north,", "line 2: yaw_rad: expected a number, got 'north'"),
        ("car,10", "car,NaN", "line 2: x: expected a number, got 'NaN'"),
        ("tricycle", "rickshaw", "line 3: agent_type: unknown class 'rickshaw'"),
    ],
)
def test_bad_files_get_one_message(tmp_path: Path, old: str, new: str, expected: str) -> None:
    path = write(tmp_path, VEHICLES.replace(old, new, 1))
    assert_one_message(lambda: sind.read(path), expected)


def test_damaged_gzip_gets_one_message(tmp_path: Path) -> None:
    assert_one_message(lambda: sind.read(truncated_gzip(write(tmp_path, VEHICLES))), "damaged gzip file")


@needs_sind
def test_pedestrians_at_chongqing() -> None:
    """Steps of 3 frames at 29.97 Hz without gaps; positions lie inside the map."""
    path = REAL / "sind" / "chongqing_pedestrians.csv.gz"
    assert track_readers.find_reader(path) is sind
    tracks = sind.read(path)
    assert set(tracks.classes) == {"pedestrian"} and np.isnan(tracks.yaw_rad).all()
    for track in range(len(tracks.names)):
        assert np.allclose(np.diff(np.sort(tracks.time_s[tracks.track == track])), 3 / 29.97, atol=1e-6)
    low, high = np.array([-50, -32]), np.array([56, 66])
    positions_m = np.column_stack([tracks.x_m, tracks.y_m])
    assert (positions_m > low).all() and (positions_m < high).all()
