"""NGSIM, by hand: feet, fronts, ids that return."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from egvs.extensions.tracks import sources as track_readers
from egvs.extensions.tracks.formats import ngsim
from tests.extensions.tracks.boxes import assert_same_boxes, moving_boxes
from tests.extensions.tracks.hand import assert_boxes, assert_one_message, box_list, truncated_gzip
from tests.extensions.tracks.writers import write_ngsim

NAN = math.nan
HEADER = "Vehicle_ID,Frame_ID,Total_Frames,Global_Time,Local_X,Local_Y,v_length,v_Width,v_Class,v_Vel,v_Acc,Lane_ID\n"
ROWS = """5,1,3,1118847000000,20.0,100.0,15,6,2,40,0,1
5,2,3,1118847000100,20.0,108.0,15,6,2,40,0,1
5,3,3,1118847000200,20.0,116.0,15,6,2,40,0,1
"""


def write(folder: Path, text: str = HEADER + ROWS) -> Path:
    path = folder / "trajectories-0400-0415.csv"
    path.write_text(text)
    return path


def test_by_hand(tmp_path: Path) -> None:
    """20 ft are 6.096 m; the centre is 7.5 ft behind 100 ft, at 92.5 ft or 28.194 m."""
    path = write(tmp_path)
    assert track_readers.find_reader(path) is ngsim and not ngsim.companions(path)
    tracks = ngsim.read(path)
    time_s = 1118847000.0
    assert_boxes(tracks, [("5", "car", time_s, 6.096, 28.194, NAN, NAN, 4.572, 1.8288, NAN),
                          ("5", "car", time_s + 0.1, 6.096, 30.6324, NAN, NAN, 4.572, 1.8288, NAN),
                          ("5", "car", time_s + 0.2, 6.096, 33.0708, NAN, NAN, 4.572, 1.8288, NAN)])  # fmt: skip
    assert tracks.frame.crs is None
    assert "0 vehicles have an id that an earlier one had" in tracks.sources
    assert "0 vehicles without movement: taken to head along +y" in tracks.sources


def test_centres_lie_behind_along_the_motion_and_along_y_for_those_that_stand(tmp_path: Path) -> None:
    rows = "1,1,1,0,10,0,10,6,3,0,0,1\n1,1,1,100,0,0,10,6,3,0,0,1\n2,1,1,0,100,100,10,6,1,0,0,1\n"
    tracks = ngsim.read(write(tmp_path, HEADER + rows))
    assert [box[3] for box in box_list(tracks)] == [round(feet * 0.3048, 4) for feet in (15, 5, 100)]
    assert [box[4] for box in box_list(tracks)] == [round(feet * 0.3048, 4) for feet in (0, 0, 95)]
    assert tracks.classes == ("truck", "motorcycle")
    assert "1 vehicle without movement: taken to head along +y" in tracks.sources


def test_an_id_that_returns_is_another_vehicle(tmp_path: Path) -> None:
    rows = "".join(f"{i},1,1,{ms},20,{ft},15,6,2,40,0,1\n" for i, ms, ft in (
        (7, 900_000, 10), (7, 900_100, 20), (8, 100, 30), (7, 100, 10), (7, 5_000, 20), (7, 30_000, 10)))  # fmt: skip
    tracks = ngsim.read(write(tmp_path, HEADER + rows))
    assert [box[0] for box in box_list(tracks)] == ["7-3", "7-3", "8", "7", "7", "7-2"]
    assert "2 vehicles have an id that an earlier one had" in tracks.sources


def test_500_frames_written_and_read(tmp_path: Path) -> None:
    """Headings are those of the motion, so centres are exact on straight roads, and to a centimetre in curves."""
    missing = ["z_m", "height_m", "yaw_rad"]
    straight = moving_boxes(["car", "truck", "motorcycle"], straight=True)
    assert_same_boxes(ngsim.read(write_ngsim(tmp_path, straight)), straight, missing, position_m=2e-6)


def test_centres_of_vehicles_in_curves(tmp_path: Path) -> None:
    """The front of a box on a circle moves along the tangent at the front: up to l²/8r beside the axis of the box."""
    boxes = moving_boxes(["car"])
    tracks = ngsim.read(write_ngsim(tmp_path, boxes))
    error_m = np.hypot(tracks.x_m - boxes.x_m, tracks.y_m - boxes.y_m)
    radius_m = np.hypot(boxes.x_m, boxes.y_m).min()
    assert 0.0 < np.median(error_m) < 4.5**2 / (4 * radius_m)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("Local_Y", "Local_Z", "expected a column 'Local_Y'"),
        (ROWS, "", "contains no rows"),
        ("20.0,", "left,", "line 2: Local_X: expected a number, got 'left'"),
        ("20.0,", "nan,", "line 2: Local_X: expected a number, got 'nan'"),
        (",15,", ",0,", "line 2: v_Length: expected a length above 0 ft, from the front to the centre, got none"),
        ("15,6,2", "15,6,4", "line 2: v_Class: unknown class '4'"),
        ("1118847000000", "1118847000000000", "line 2: Global_Time: expected a time"),
    ],
)
def test_bad_files_get_one_message(tmp_path: Path, old: str, new: str, expected: str) -> None:
    path = write(tmp_path, (HEADER + ROWS).replace(old, new, 1))
    assert_one_message(lambda: ngsim.read(path), expected)


def test_two_locations_and_damaged_gzip_get_one_message(tmp_path: Path) -> None:
    path = write(tmp_path)
    assert_one_message(lambda: ngsim.read(truncated_gzip(path)), "damaged gzip file")
    lines = (HEADER + ROWS).splitlines()
    sites = ("Location", "us-101", "us-101", "i-80")
    path = write(tmp_path, "\n".join(f"{line},{site}" for line, site in zip(lines, sites, strict=True)))
    assert_one_message(lambda: ngsim.read(path), "Location: expected one location, got i-80, us-101")
