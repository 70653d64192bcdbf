"""LUMPI labels, by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from egvs.extensions.tracks import sources as track_readers
from egvs.extensions.tracks.formats import lumpi
from tests.extensions.tracks.boxes import assert_same_boxes, moving_boxes
from tests.extensions.tracks.hand import assert_boxes, assert_one_message, truncated_gzip
from tests.extensions.tracks.writers import write_lumpi

ROWS = """12.3,17,0,0,1,1,4,1,250,5.0,6.0,0.8,4.5,1.9,1.6,0.3
12.4,18,0,0,1,1,0.7,6,250,7.0,8.0,0.9,4.5,1.9,0,0.4,11,12,
"""


def write(folder: Path, text: str = ROWS) -> Path:
    path = folder / "Label.csv"
    path.write_text(text)
    return path


def test_by_hand(tmp_path: Path) -> None:
    path = write(tmp_path)
    assert track_readers.find_reader(path) is lumpi and not lumpi.companions(path)
    tracks = lumpi.read(path)
    assert_boxes(tracks, [("17", "car", 12.3, 5, 6, 0.8, 0.3, 4.5, 1.9, 1.6),
                          ("18", "other", 12.4, 7, 8, 0.9, 0.4, 4.5, 1.9, float("nan"))])  # fmt: skip
    assert tracks.frame.crs is None and tracks.sources[0] == "1 of 2 boxes were corrected by hand"


def test_names_of_columns_and_coordinates_of_utm(tmp_path: Path) -> None:
    names = "time,id,l,t,w,h,score,class,points,x,y,z,length,width,height,heading\n"
    rows = "12.3,17,0,0,1,1,4,1.0,250,548700.5,5804200.25,55.8,4.5,1.9,1.6,0.3\n"
    path = write(tmp_path, names + rows)
    assert track_readers.find_reader(path) is lumpi
    tracks = lumpi.read(path)
    assert_boxes(tracks, [("17", "car", 12.3, 548700.5, 5804200.25, 55.8, 0.3, 4.5, 1.9, 1.6)])
    assert tracks.frame.crs == "EPSG:25832"


@pytest.mark.slow
def test_500_frames_written_and_read(tmp_path: Path) -> None:
    boxes = moving_boxes(["car", "truck", "bus", "motorcycle", "bicycle", "pedestrian", "other"])
    assert_same_boxes(lumpi.read(write_lumpi(tmp_path, boxes)), boxes)


def test_other_files_of_numbers_are_not_taken(tmp_path: Path) -> None:
    path = write(tmp_path).rename(tmp_path / "numbers.csv")
    assert_one_message(lambda: track_readers.find_reader(path), "the format of the tracks is unknown")


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (ROWS, "", "contains no rows"),
        (ROWS, "time,id\n", "contains no rows"),
        (",0.3", "", "line 1: expected at least 16 cells, got 15"),
        ("5.0", "five", "line 1: x: expected a number, got 'five'"),
        ("5.0", "nan", "line 1: x: expected a number, got 'nan'"),
        ("4,1,250", "4,8,250", "line 1: class: unknown class '8'"),
        ("4.5", "-4.5", "line 1: length: expected a size from 0 to 100 m, got -4.5 m"),
        ("17,", ",", "line 1: id: expected the name of a track, got nothing"),
    ],
)
def test_bad_files_get_one_message(tmp_path: Path, old: str, new: str, expected: str) -> None:
    path = write(tmp_path, ROWS.replace(old, new, 1))
    assert_one_message(lambda: lumpi.read(path), expected)


def test_damaged_gzip_gets_one_message(tmp_path: Path) -> None:
    assert_one_message(lambda: lumpi.read(truncated_gzip(write(tmp_path, ROWS * 20))), "damaged gzip file")
