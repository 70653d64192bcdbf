"""InD, rounD, exiD and uniD, by hand."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from egvs.extensions.tracks import sources as track_readers
from egvs.extensions.tracks.formats import levelx
from egvs.extensions.tracks.model import TrackFrame
from tests.extensions.tracks.boxes import assert_same_boxes, moving_boxes
from tests.extensions.tracks.hand import assert_boxes, assert_one_message, truncated_gzip
from tests.extensions.tracks.writers import LEVELX_ORIGIN_M, write_levelx

NAN = math.nan
TRACKS = """recordingId,trackId,frame,trackLifetime,xCenter,yCenter,heading,width,length,xVelocity,yVelocity
0,0,2,2,50.0,-30.8,270.0,1.9,4.6,0.0,-10.0
0,1,1,1,60.0,-19.96,90.0,0.0,0.0,0,1
"""
TRACKS_META = """recordingId,trackId,initialFrame,finalFrame,numFrames,width,length,class
0,0,0,2,3,1.9,4.6,car
0,1,0,1,2,0.0,0.0,pedestrian
"""
RECORDING = """recordingId,locationId,frameRate,duration,latLocation,lonLocation,xUtmOrigin,yUtmOrigin,orthoPxToMeter
0,1,25,1000,50.78207,6.07116,293487.1224,5629711.5816,0.00814
"""


def write(folder: Path, tracks: str = TRACKS, meta: str = TRACKS_META, recording: str = RECORDING) -> Path:
    (folder / "00_tracksMeta.csv").write_text(meta)
    (folder / "00_recordingMeta.csv").write_text(recording)
    path = folder / "00_tracks.csv"
    path.write_text(tracks)
    return path


def test_by_hand(tmp_path: Path) -> None:
    """Frame 2 at 25 frames per second is 0.08 s; 270 degrees are -y; a size of 0 is none."""
    path = write(tmp_path)
    assert track_readers.find_reader(path) is levelx
    names = [file.name for file in [path, *track_readers.TrackSource((path,)).companions()]]
    assert names == ["00_tracks.csv", "00_tracksMeta.csv", "00_recordingMeta.csv"]
    tracks = levelx.read(path)
    assert_boxes(tracks, [("0", "car", 0.08, 50, -30.8, NAN, math.radians(270).__round__(4), 4.6, 1.9, NAN),
                          ("1", "pedestrian", 0.04, 60, -19.96, NAN, 1.5708, NAN, NAN, NAN)])  # fmt: skip
    assert tracks.frame == TrackFrame("EPSG:32632", LEVELX_ORIGIN_M)
    assert tracks.x_m[0] + tracks.frame.offset_m[0] == pytest.approx(293537.1224)
    assert tracks.y_m[0] + tracks.frame.offset_m[1] == pytest.approx(5629680.7816)


def test_lists_in_other_columns_and_truck_bus(tmp_path: Path) -> None:
    """exiD has cells with lists, separated by semicolons, which are not read."""
    tracks = "trackId,frame,xCenter,yCenter,heading,width,length,leadId\n4,0,1,2,0,2.5,12,3;4;-1\n"
    read = levelx.read(write(tmp_path, tracks, "trackId,class\n4,truck_bus\n5,car\n"))
    assert_boxes(read, [("4", "truck", 0, 1, 2, NAN, 0, 12, 2.5, NAN)])
    assert read.sources == ('tracks of class "truck_bus" count as trucks',)


@pytest.mark.parametrize(
    ("lat", "lon", "x", "y", "crs"),
    [
        # hand: zone 33 begins at 12 degrees east; Munich's data in zone 32 stay there when they are a little beyond it
        ("48.0", "11.9", "716266", "5320361", "EPSG:32632"),
        ("48.0", "12.1", "731187", "5320958", "EPSG:32632"),
        ("48.0", "12.1", "283756", "5320655", "EPSG:32633"),
        # the southern hemisphere: Sydney
        ("-33.87", "151.21", "334417", "6250800", "EPSG:32756"),
    ],
)
def test_utm_zone_is_where_the_origin_fits(tmp_path: Path, lat: str, lon: str, x: str, y: str, crs: str) -> None:
    recording = f"frameRate,latLocation,lonLocation,xUtmOrigin,yUtmOrigin\n25,{lat},{lon},{x},{y}\n"
    assert levelx.read(write(tmp_path, recording=recording)).frame.crs == crs


def test_500_frames_written_and_read(tmp_path: Path) -> None:
    boxes = moving_boxes(["car", "van", "truck", "bus", "trailer", "motorcycle", "bicycle", "pedestrian"])
    assert_same_boxes(levelx.read(write_levelx(tmp_path, boxes)), boxes, ["z_m", "height_m"])


@pytest.mark.parametrize(
    ("file", "old", "new", "expected"),
    [
        (0, "heading", "angle", "00_tracks.csv: expected a column 'heading'"),
        (0, TRACKS[TRACKS.index("\n") :], "\n", "00_tracks.csv: contains no rows"),
        (0, "50.0", "fifty", "00_tracks.csv: line 2: xCenter: expected a number, got 'fifty'"),
        (0, "50.0", "nan", "00_tracks.csv: line 2: xCenter: expected a number, got 'nan'"),
        (0, "0,1,1", "0,9,1", "00_tracks.csv: trackId '9' is not in 00_tracksMeta.csv"),
        (1, "class", "kind", "00_tracksMeta.csv: expected a column 'class'"),
        (1, "pedestrian", "dog", "00_tracksMeta.csv: line 3: class: unknown class 'dog'"),
        (1, "0,1,", "0,0,", "00_tracksMeta.csv: line 3: trackId: '0' occurs twice"),
        (2, "1,25,", "1,0,", "00_recordingMeta.csv: line 2: frameRate: expected 0.1 to 1000"),
        (2, "1,25,", "1,nan,", "00_recordingMeta.csv: line 2: frameRate: expected a number, got 'nan'"),
        (2, "6.07116", "26.07116", "xUtmOrigin, yUtmOrigin: (293487, 5629712) is"),
        (2, "50.78207", "150", "latLocation, lonLocation: expected degrees, got 150, 6.07116"),
        (2, RECORDING[RECORDING.index("\n") :], RECORDING[RECORDING.index("\n") :] * 2, "expected one row, got 2"),
    ],
)
def test_bad_files_get_one_message(tmp_path: Path, file: int, old: str, new: str, expected: str) -> None:
    texts = [TRACKS, TRACKS_META, RECORDING]
    assert old in texts[file]
    texts[file] = texts[file].replace(old, new, 1)
    path = write(tmp_path, *texts)
    assert_one_message(lambda: levelx.read(path), expected)


def test_missing_companions_and_damaged_gzip_get_one_message(tmp_path: Path) -> None:
    path = write(tmp_path)
    assert_one_message(lambda: levelx.read(truncated_gzip(path)), "00_tracks.csv.gz: damaged gzip file")
    (tmp_path / "00_recordingMeta.csv").unlink()
    assert_one_message(lambda: levelx.read(path), "expected the file 00_recordingMeta.csv beside it")
    assert_one_message(
        lambda: track_readers.TrackSource((path,)).companions(), "expected the file 00_recordingMeta.csv beside it"
    )
    renamed = path.rename(tmp_path / "inD.csv")
    assert_one_message(lambda: levelx.read(renamed), "expected a name that ends with _tracks.csv, got inD.csv")
