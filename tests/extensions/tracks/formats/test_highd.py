"""HighD, by hand: corners to centres, y up, directions."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from egvs.extensions.tracks import sources as track_readers
from egvs.extensions.tracks.formats import highd
from tests.extensions.tracks.boxes import assert_same_boxes, moving_boxes
from tests.extensions.tracks.hand import assert_boxes, assert_one_message, truncated_gzip
from tests.extensions.tracks.writers import write_highd

NAN = math.nan
TRACKS = """frame,id,x,y,width,height,xVelocity,yVelocity,xAcceleration,yAcceleration,laneId
1,2,200.00,9.00,12.0,2.5,-25.00,0.50,0,0,2
3,4,10.00,21.00,4.0,2.0,25.00,0.50,0,0,5
"""
TRACKS_META = """id,width,height,initialFrame,finalFrame,numFrames,class,drivingDirection
2,12.0,2.5,1,1,1,Truck,1
4,4.0,2.0,3,3,1,Car,2
"""
RECORDING = "id,frameRate,locationId,upperLaneMarkings,lowerLaneMarkings\n1,25,2,8.5;12.6,21.0;25.0\n"


def write(folder: Path, tracks: str = TRACKS, meta: str = TRACKS_META, recording: str = RECORDING) -> Path:
    (folder / "01_tracksMeta.csv").write_text(meta)
    (folder / "01_recordingMeta.csv").write_text(recording)
    path = folder / "01_tracks.csv"
    path.write_text(tracks)
    return path


def test_by_hand(tmp_path: Path) -> None:
    """Half a length to the right of the corner, half a width below it, then y up; frame 1 is time 0."""
    path = write(tmp_path)
    assert track_readers.find_reader(path) is highd
    tracks = highd.read(path)
    assert_boxes(tracks, [("2", "truck", 0.0, 206, -10.25, NAN, 3.1416, 12, 2.5, NAN),
                          ("4", "car", 0.08, 12, -22, NAN, 0, 4, 2, NAN)])  # fmt: skip
    assert tracks.frame.crs is None and "without a place on the Earth" in tracks.sources[0]


def test_500_frames_written_and_read(tmp_path: Path) -> None:
    boxes = moving_boxes(["car", "truck"], straight=True)
    tracks = highd.read(write_highd(tmp_path, boxes))
    assert_same_boxes(tracks, boxes, ["z_m", "height_m"], position_m=2e-6)


@pytest.mark.parametrize(
    ("file", "old", "new", "expected"),
    [
        (0, "height", "breadth", "01_tracks.csv: expected a column 'height'"),
        (0, TRACKS[TRACKS.index("\n") :], "\n", "01_tracks.csv: contains no rows"),
        (0, "200.00", "x", "line 2: x: expected a number, got 'x'"),
        (0, "12.0,2.5", "0,2.5", "line 2: width: expected a size above 0 m, got none"),
        (0, "3,4,", "3,5,", "01_tracks.csv: id '5' is not in 01_tracksMeta.csv"),
        (1, "Truck,1", "Truck,3", "01_tracksMeta.csv: line 2: drivingDirection: expected 1 or 2, got 3"),
        (1, "Truck,1", "Truck,nan", "01_tracksMeta.csv: line 2: drivingDirection: expected a number, got 'nan'"),
        (1, "Car", "Bike", "01_tracksMeta.csv: line 3: class: unknown class 'Bike'"),
        (2, "1,25", "1,-25", "frameRate: expected 0.1 to 1000 frames per second, got -25"),
    ],
)
def test_bad_files_get_one_message(tmp_path: Path, file: int, old: str, new: str, expected: str) -> None:
    texts = [TRACKS, TRACKS_META, RECORDING]
    assert old in texts[file]
    texts[file] = texts[file].replace(old, new, 1)
    path = write(tmp_path, *texts)
    assert_one_message(lambda: highd.read(path), expected)


def test_missing_companion_and_damaged_gzip_get_one_message(tmp_path: Path) -> None:
    path = write(tmp_path)
    assert_one_message(lambda: highd.read(truncated_gzip(path)), "damaged gzip file")
    (tmp_path / "01_tracksMeta.csv").unlink()
    assert_one_message(lambda: highd.read(path), "expected the file 01_tracksMeta.csv beside it")
