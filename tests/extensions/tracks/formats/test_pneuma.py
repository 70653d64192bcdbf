"""pNEUMA, by hand: a line per vehicle, latitude and longitude."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from egvs.extensions.tracks import sources as track_readers
from egvs.extensions.tracks.formats import pneuma
from egvs.formats.georeference import WorldFrame
from tests.extensions.tracks.boxes import assert_same_boxes, moving_boxes
from tests.extensions.tracks.hand import assert_one_message, truncated_gzip
from tests.extensions.tracks.writers import PNEUMA_ORIGIN_M, write_pneuma

HEADER = "track_id; type; traveled_d; avg_speed; lat; lon; speed; lon_acc; lat_acc; time\n"
LINES = """1; Car; 48.9; 40.0; 37.977391; 23.737688; 36.0; 0; 0; 0.00; 37.977395; 23.737688; 36.0; 0; 0; 0.04;
2; Medium Vehicle; 48.9; 40.0; 37.977391; 23.737788; 36.0; 0; 0; 0.04;
"""


def write(folder: Path, text: str = HEADER + LINES) -> Path:
    path = folder / "20181024_d1_0830_0900.csv"
    path.write_text(text)
    return path


def test_by_hand(tmp_path: Path) -> None:
    """Four millionths of a degree of latitude are 0.444 m; the grid of UTM zone 34 is turned by 1.7 degrees here."""
    path = write(tmp_path)
    assert track_readers.find_reader(path) is pneuma and not pneuma.companions(path)
    tracks = pneuma.read(path)
    assert tracks.names == ("1", "2") and tracks.classes == ("car", "van")
    assert tracks.track.tolist() == [0, 0, 1] and tracks.time_s.tolist() == [0.0, 0.04, 0.04]
    assert tracks.frame.crs == "EPSG:32634"
    step = np.array([tracks.x_m[1] - tracks.x_m[0], tracks.y_m[1] - tracks.y_m[0]])
    assert np.hypot(*step) == pytest.approx(0.444, abs=1e-3)
    assert math.degrees(math.atan2(-step[0], step[1])) == pytest.approx(1.68, abs=0.02)
    east_m = np.hypot(tracks.x_m[2] - tracks.x_m[0], tracks.y_m[2] - tracks.y_m[0])
    assert east_m == pytest.approx(1e-4 * 111_320 * math.cos(math.radians(37.977)), rel=2e-3)
    degrees = WorldFrame(tracks.frame.crs).to_degrees(np.array([[tracks.x_m[0], tracks.y_m[0]]]))
    assert np.allclose(degrees, [[23.737688, 37.977391]], atol=1e-9)
    for key in ("z_m", "yaw_rad", "length_m", "width_m", "height_m"):
        assert np.isnan(getattr(tracks, key)).all()


@pytest.mark.parametrize(("decimals", "tolerance_m"), [(6, 0.06), (10, 1e-5)])
def test_500_frames_written_and_read(tmp_path: Path, decimals: int, tolerance_m: float) -> None:
    """Half a millionth of a degree of latitude is 0.056 m."""
    boxes = moving_boxes(["car", "van", "truck", "bus", "motorcycle"])
    tracks = pneuma.read(write_pneuma(tmp_path, boxes, decimals))
    missing = ["z_m", "yaw_rad", "length_m", "width_m", "height_m"]
    assert_same_boxes(tracks, boxes, missing, position_m=tolerance_m, shift_m=PNEUMA_ORIGIN_M)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (LINES, "", "contains no vehicles"),
        ("; 0.04;\n2", "; 0.04; 37.977395;\n2", "line 2: expected 4 cells and 6 for each position, got 17"),
        ("37.977395", "north", "line 2: lat: expected a number, got 'north'"),
        ("37.977395", "nan", "line 2: lat: expected a number, got 'nan'"),
        ("37.977395", "-37.977395", "line 2: lat, lon: longitude 23.7377, latitude -37.9774 is no place near"),
        ("37.977395", "", "line 2: lat: expected a number, got ''"),
        ("0.00;", "x;", "line 2: time: expected a number, got 'x'"),
        ("Medium Vehicle", "Camel", "line 3: type: unknown class 'Camel'"),
        ("\n2;", "\n1;", "line 3: track_id: '1' occurs twice"),
    ],
)
def test_bad_files_get_one_message(tmp_path: Path, old: str, new: str, expected: str) -> None:
    path = write(tmp_path, (HEADER + LINES).replace(old, new, 1))
    assert_one_message(lambda: pneuma.read(path), expected)


def test_damaged_gzip_and_another_header(tmp_path: Path) -> None:
    path = write(tmp_path)
    assert_one_message(lambda: pneuma.read(truncated_gzip(path)), "damaged gzip file")
    other = write(tmp_path, (HEADER + LINES).replace("lat;", "latitude;", 1))
    assert_one_message(lambda: track_readers.find_reader(other), "the format of the tracks is unknown")
    assert_one_message(lambda: pneuma.read(other), "expected track_id; type; traveled_d")
