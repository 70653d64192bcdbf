"""INTERACTION 1.0 to 1.2 and TAF-BW, by hand and from the recording at Karlsruhe."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from egvs.extensions.tracks import sources as track_readers
from egvs.extensions.tracks.formats import interaction
from egvs.formats.georeference import WorldFrame
from tests.extensions.tracks.boxes import assert_same_boxes, moving_boxes
from tests.extensions.tracks.hand import REAL, assert_boxes, assert_one_message, needs_karlsruhe, truncated_gzip
from tests.extensions.tracks.writers import TAF_BW_ORIGIN_DEG, write_interaction, write_taf_bw

NAN = math.nan
VEHICLES = """track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,psi_rad,length,width
1,2,200,car,2,2.5,0,10,1.5708,4,1.8
1,3,300,car,2,3.5,0,10,1.5708,4,1.8
"""
PEDESTRIANS = """track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy
P1,2,200,pedestrian/bicycle,5,5,0,1.2
"""
CASES = """case_id,track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,psi_rad,length,width
1.0,1,1,100,car,2,2,0,10,1.5,4,1.8
1.0,1,2,200,car,2,3,0,10,1.5,4,1.8
2.0,1,1,100,pedestrian/bicycle,7,7,0,1,,,
2.0,2,3,300,car,8,8,0,1,0.5,5,2
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "vehicle_tracks_000.csv"
    path.write_text(text)
    return path


def test_vehicles_by_hand(tmp_path: Path) -> None:
    path = write(tmp_path, VEHICLES)
    assert track_readers.find_reader(path) is interaction
    tracks = interaction.read(path)
    assert_boxes(tracks, [("1", "car", 0.2, 2, 2.5, NAN, 1.5708, 4, 1.8, NAN),
                          ("1", "car", 0.3, 2, 3.5, NAN, 1.5708, 4, 1.8, NAN)])  # fmt: skip
    assert tracks.frame is interaction.MAP_FRAME and tracks.sources == ()


def test_pedestrians_have_text_ids_and_neither_yaw_nor_size(tmp_path: Path) -> None:
    tracks = interaction.read(write(tmp_path, PEDESTRIANS))
    assert_boxes(tracks, [("P1", "pedestrian", 0.2, 5, 5, NAN, NAN, NAN, NAN, NAN)])
    assert tracks.sources == ('tracks of type "pedestrian/bicycle" count as pedestrians',)


def test_cases_follow_each_other(tmp_path: Path) -> None:
    """The first lasts from 0 to 0.1 s; the second begins 0.1 s later, and its ids are other tracks."""
    tracks = interaction.read(write(tmp_path, CASES))
    assert_boxes(tracks, [("1.0-1", "car", 0.0, 2, 2, NAN, 1.5, 4, 1.8, NAN),
                          ("1.0-1", "car", 0.1, 2, 3, NAN, 1.5, 4, 1.8, NAN),
                          ("2.0-1", "pedestrian", 0.2, 7, 7, NAN, NAN, NAN, NAN, NAN),
                          ("2.0-2", "car", 0.4, 8, 8, NAN, 0.5, 5, 2, NAN)])  # fmt: skip
    assert tracks.sources[0] == "2 cases are placed one after another in time"


def test_columns_in_another_order_and_capitalised_types(tmp_path: Path) -> None:
    text = "time,agent_type,psi_rad,y,x,width,length,track_id,timestamp_ms\n17.5,Bike,0.5,3,2,0.5,1,9,17500\n"
    tracks = interaction.read(write(tmp_path, text))
    assert_boxes(tracks, [("9", "bicycle", 17.5, 2, 3, NAN, 0.5, 1, 0.5, NAN)])


def test_map_frame_is_that_of_maps_about_latitude_and_longitude_zero() -> None:
    """0.0018 degrees north are 199.229 m, and east 200.571 m."""
    frame = WorldFrame(str(interaction.MAP_FRAME.crs), tuple(-m for m in interaction.MAP_FRAME.offset_m))
    xy_m = frame.from_lon_lat(np.array([[0.0, 0.0], [0.0018, 0.0], [0.0, 0.0018]]))
    assert np.allclose(xy_m, [[0, 0], [200.571, 0], [0, 199.229]], atol=1e-3)


def test_origin_of_taf_bw_is_at_zero_with_true_scale(tmp_path: Path) -> None:
    """A spherical Mercator projection with the scale of its origin: 1e-4 degrees are R times the angle there."""
    path = write_taf_bw(tmp_path, moving_boxes(["car"], 2))
    assert [file.name for file in [path, *track_readers.TrackSource((path,)).companions()]] == [
        "vehicle_tracks_000.csv",
        "meta_data.csv",
    ]
    frame = interaction.read(path).frame
    lat, lon = TAF_BW_ORIGIN_DEG
    world = WorldFrame(str(frame.crs), tuple(-m for m in frame.offset_m))
    degree_m = math.radians(1.0) * 6378137.0
    xy_m = world.from_lon_lat(np.array([[lon, lat], [lon + 1e-4, lat]]))
    assert np.allclose(xy_m[0], 0.0, atol=1e-5)
    assert xy_m[1, 0] == pytest.approx(1e-4 * degree_m * math.cos(math.radians(lat)), rel=1e-6)
    # a sphere, of which PROJ converts the geodetic latitude 1:1
    north_m = world.from_lon_lat(np.array([[lon, lat + 1e-4]]))[0, 1]
    assert north_m == pytest.approx(1e-4 * degree_m, rel=1e-4)


@pytest.mark.slow
def test_500_frames_written_and_read(tmp_path: Path) -> None:
    boxes = moving_boxes(["car", "truck", "bus", "van", "motorcycle", "tram", "bicycle", "pedestrian"])
    assert_same_boxes(interaction.read(write_interaction(tmp_path, boxes)), boxes, ["z_m", "height_m"])


def test_500_frames_of_taf_bw_written_and_read(tmp_path: Path) -> None:
    boxes = moving_boxes(["car", "truck", "bicycle", "pedestrian"])
    assert_same_boxes(interaction.read(write_taf_bw(tmp_path, boxes)), boxes, ["z_m", "height_m"])


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("x,", "easting,", "vehicle_tracks_000.csv: expected a column 'x', got track_id"),
        (VEHICLES[VEHICLES.index("\n") :], "\n", "vehicle_tracks_000.csv: contains no rows"),
        ("2,2.5", "two,2.5", "line 2: x: expected a number, got 'two'"),
        ("2,2.5", "nan,2.5", "line 2: x: expected a number, got 'nan'"),
        ("2,2.5", ",2.5", "line 2: x: expected a number, got ''"),
        ("200", "inf", "line 2: timestamp_ms: expected a number, got 'inf'"),
        ("3,300,car", "3,300,horse", "line 3: agent_type: unknown class 'horse'"),
        ("4,1.8", "-4,1.8", "line 2: length: expected a size from 0 to 100 m, got -4 m"),
        ("2,2.5", "2,2,5", "line 2: expected 11 cells, got 12"),
    ],
)
def test_bad_files_get_one_message(tmp_path: Path, old: str, new: str, expected: str) -> None:
    path = write(tmp_path, VEHICLES.replace(old, new, 1))
    assert_one_message(lambda: interaction.read(path), expected)


def test_bad_origins_and_damaged_gzip_get_one_message(tmp_path: Path) -> None:
    path = write(tmp_path, VEHICLES)
    assert_one_message(lambda: interaction.read(truncated_gzip(path)), "damaged gzip file")
    for rows, expected in (
        ("95,8\n", "originLat, originLon: got 95, 8"),
        ("49,8\n49,9\n", "originLat, originLon: expected one origin, got 2"),
        ("49,\n", "meta_data.csv: line 2: originLon: expected a number, got ''"),
    ):
        (tmp_path / "meta_data.csv").write_text(f"originLat,originLon\n{rows}")
        assert_one_message(lambda: interaction.read(path), expected)


@needs_karlsruhe
def test_karlsruhe() -> None:
    """157 s of 74 road users with default sizes, whose positions are within 200 m of the declared origin."""
    path = REAL / "karlsruhe_k733" / "vehicle_tracks_000.csv.gz"
    assert track_readers.find_reader(path) is interaction
    tracks = interaction.read(path)
    assert len(tracks.names) == 74 and tracks.time_s.max() == pytest.approx(157, abs=1.0)
    assert {"car", "bicycle", "pedestrian", "truck"} == set(tracks.classes)
    row_sizes = zip(np.array(tracks.classes)[tracks.track], tracks.length_m, tracks.width_m, strict=True)
    sizes = {(str(cls), float(length), float(width)) for cls, length, width in row_sizes}
    assert sizes == {("car", 4.7, 2.1), ("bicycle", 1.0, 0.5), ("pedestrian", 0.5, 0.5), ("truck", 7.0, 2.5)}
    assert np.hypot(tracks.x_m, tracks.y_m).max() < 200.0
