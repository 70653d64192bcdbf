"""A user's own CSV or JSON lines: each key of the mapping has its effect."""

from __future__ import annotations

import gzip
import itertools
import json
import math
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from pydantic import ValidationError

from egvs.extensions.tracks import user_table
from egvs.extensions.tracks.formats import interaction
from egvs.extensions.tracks.model import CLASSES, TrackFrame
from egvs.formats.georeference import WorldFrame
from egvs.scenario.track_columns import RoadUserClass, TrackColumns
from egvs.scenario.traffic_config import TrafficConfig
from tests.extensions.tracks.boxes import assert_same_boxes, moving_boxes
from tests.extensions.tracks.hand import (
    REAL,
    assert_boxes,
    assert_one_message,
    box_list,
    needs_karlsruhe,
    truncated_gzip,
)
from tests.extensions.tracks.writers import write_user_table

NAN = math.nan
PLAIN: dict[str, Any] = {"time": "t", "id": "n", "x": "x", "y": "y"}
FULL = {**PLAIN, "z": "z", "yaw": "a", "length": "l", "width": "w", "height": "h", "type": "c"}
CSV = "t,n,x,y,z,a,l,w,h,c\n2,k,10,20,3,0.5,4,2,1.5,car\n"


def mapping(**keys: Any) -> TrackColumns:
    return TrackColumns.from_dict(keys)


def read(folder: Path, text: str, name: str = "own.csv", **keys: Any) -> list[Any]:
    """Return the first box as (name, class, time, x, y, z, yaw, length, width, height)."""
    path = folder / name
    path.write_text(text)
    return list(box_list(user_table.read(path, mapping(**keys)))[0])


def test_every_column_by_hand(tmp_path: Path) -> None:
    assert read(tmp_path, CSV, **FULL) == ["k", "car", 2, 10, 20, 3, 0.5, 4, 2, 1.5]


def test_only_required_columns(tmp_path: Path) -> None:
    path = tmp_path / "own.csv"
    path.write_text("t,n,x,y\n2,k,10,20\n")
    tracks = user_table.read(path, mapping(**PLAIN, default_type="van"))
    assert_boxes(tracks, [("k", "van", 2, 10, 20, NAN, NAN, NAN, NAN, NAN)])
    assert tracks.frame == TrackFrame()


def test_missing_sizes_are_nan(tmp_path: Path) -> None:
    box = read(tmp_path, CSV.replace("4,2,1.5", ",0,"), **FULL)
    assert all(math.isnan(size) for size in box[7:])


@pytest.mark.parametrize(
    ("keys", "position", "expected"),
    [
        ({"time_unit": "ms"}, 2, 0.002),
        ({"time_unit": "us"}, 2, 0.0),
        ({"length_unit": "ft"}, slice(3, 6), [3.048, 6.096, 0.9144]),
        ({"length_unit": "ft"}, slice(7, 10), [1.2192, 0.6096, 0.4572]),
        ({"yaw_unit": "deg"}, 6, 0.0087),
        ({"yaw_convention": "cw_from_north"}, 6, 1.0708),
        ({"yaw_unit": "deg", "yaw_convention": "cw_from_north"}, 6, 1.5621),
        # half of 4 m behind the front, at 0.5 rad
        ({"reference": "front"}, slice(3, 5), [8.2448, 19.0411]),
        ({"z_reference": "bottom"}, 5, 3.75),
    ],
)
def test_units_and_conventions(tmp_path: Path, keys: dict[str, Any], position: Any, expected: Any) -> None:
    """Only these numbers differ from those without the keys."""
    plain, actual = read(tmp_path, CSV, **FULL), read(tmp_path, CSV, **FULL, **keys)
    assert actual[position] == expected
    if keys != {"length_unit": "ft"}:
        plain[position] = expected
        assert actual == plain


def test_time_in_nanoseconds(tmp_path: Path) -> None:
    text = CSV.replace("\n2,", "\n1600000000500000000,")
    assert read(tmp_path, text, **FULL, time_unit="ns")[2] == pytest.approx(1600000000.5, abs=1e-4)


def test_delimiter(tmp_path: Path) -> None:
    for delimiter in (";", "\t", "|"):
        text = CSV.replace(",", delimiter)
        assert read(tmp_path, text, **FULL, delimiter=delimiter) == read(tmp_path, CSV, **FULL)


def test_types(tmp_path: Path) -> None:
    """Texts of the mapping in any case; names of classes; empty cells."""
    rows = "".join(f"{number},{text},0,0\n" for number, text in enumerate(("PKW", "pkw", "Bus", "", "pkw")))
    path = tmp_path / "own.csv"
    path.write_text(f"n,c,x,y\n{rows}")
    keys = {**PLAIN, "time": "n", "id": "c2", "type": "c", "types": {"PKW": "car"}}
    path.write_text("n,c,x,y,c2\n" + "".join(f"{row},v{number}\n" for number, row in enumerate(rows.splitlines())))
    tracks = user_table.read(path, mapping(**keys, default_type="other"))
    assert tracks.classes == ("car", "car", "bus", "other", "car")
    assert_one_message(lambda: user_table.read(path, mapping(**keys)), "own.csv: line 5: c: unknown class ''")
    path.write_text("n,c,x,y,c2\n1,LKW,0,0,1\n")
    assert_one_message(lambda: user_table.read(path, mapping(**keys)), "own.csv: line 2: c: unknown class 'LKW'")


def test_classes_are_those_of_tracks() -> None:
    assert get_args(RoadUserClass) == CLASSES


def test_fronts_without_yaw_use_the_motion(tmp_path: Path) -> None:
    """Northwards by 2 m in each step: the centre is 2 m to the south. A track that stands is left out, and counted."""
    rows = "".join(f"{t},k,5,{2 * t},4\n{t},stands,9,9,4\n" for t in range(4))
    path = tmp_path / "own.csv"
    path.write_text(f"t,n,x,y,l\n{rows}")
    tracks = user_table.read(path, mapping(**PLAIN, length="l", default_type="car", reference="front"))
    assert [box[:5] for box in box_list(tracks)] == [("k", "car", t, 5, 2 * t - 2) for t in range(4)]
    assert tracks.names == ("k",) and np.isnan(tracks.yaw_rad).all()
    assert tracks.sources[0].startswith("4 rows left out: only the front is given")


def test_z_at_the_bottom_without_height_is_unknown(tmp_path: Path) -> None:
    assert math.isnan(read(tmp_path, CSV.replace("1.5", ""), **FULL, z_reference="bottom")[5])


CHOICES = {
    "time_unit": ("s", "ms"), "length_unit": ("m", "ft"), "yaw_unit": ("rad", "deg"),
    "yaw_convention": ("ccw_from_east", "cw_from_north"), "reference": ("centre", "front"),
    "z_reference": ("centre", "bottom"),
}  # fmt: skip


@pytest.mark.parametrize("json_lines", [False, True])
@pytest.mark.parametrize(
    "keys",
    [dict(zip(CHOICES, values, strict=True)) for values in list(itertools.product(*CHOICES.values()))[::9]],
)
def test_500_frames_written_and_read(tmp_path: Path, keys: dict[str, Any], json_lines: bool) -> None:
    boxes = moving_boxes(["car", "pedestrian"])
    columns = mapping(**FULL, **keys, types={"PKW": "car"}, delimiter=";")
    tracks = user_table.read(write_user_table(tmp_path, boxes, columns, json_lines), columns)
    assert_same_boxes(tracks, boxes, position_m=2e-6)


# ---- JSON lines

ITEM: dict[str, Any] = {
    "t": 2, "n": 7, "p": {"xyz": [10, 20.0, "3"]}, "a": 0.5, "box": {"l": 4, "w": 2, "h": None}, "c": "car", "p.q": 1,
}  # fmt: skip
NESTED = {"time": "t", "id": "n", "x": "p.xyz.0", "y": "p.xyz.1", "z": "p.xyz.2", "yaw": "a", "length": "box.l",
          "width": "box.w", "type": "c"}  # fmt: skip


def test_json_lines_by_hand(tmp_path: Path) -> None:
    """Keys may lead into objects and lists; a number may be a text; blank lines are skipped."""
    box = read(tmp_path, f"\n{json.dumps(ITEM)}\n\n", "own.jsonl", **NESTED)
    assert box[:9] == ["7", "car", 2, 10, 20, 3, 0.5, 4, 2] and math.isnan(box[9])
    flat = dict(ITEM, **{"p.xyz.0": 11})
    assert read(tmp_path, json.dumps(flat), "own.jsonl", **NESTED)[3] == 11
    path = tmp_path / "own.gz"
    path.write_bytes(gzip.compress(json.dumps(ITEM).encode()))
    assert box_list(user_table.read(path, mapping(**NESTED)))[0][:9] == tuple(box[:9])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (json.dumps(ITEM) + "\n{", "own.jsonl: line 2: is not valid JSON"),
        (json.dumps(ITEM) + "\n[1]", "own.jsonl: line 2: expected a JSON object"),
        (json.dumps(dict(ITEM, t={})), "own.jsonl: line 1: t: expected a number or a text, got dict"),
        (json.dumps(dict(ITEM, t=None)), "expected a key 't', which no line has"),
        (json.dumps(ITEM) + "\n" + json.dumps(dict(ITEM, t=None)), "line 2: t: expected a number, got ''"),
        (json.dumps(dict(ITEM, t=True)), "line 1: t: expected a number, got 'True'"),
        (json.dumps(dict(ITEM, p=[1, 2])), "expected a key 'p.xyz.0', which no line has"),
        ('{"t": 1, "t": 2}', "line 1: is not valid JSON (the key 't' occurs twice in one object)"),
    ],
)
def test_bad_json_lines_get_one_message(tmp_path: Path, text: str, expected: str) -> None:
    assert_one_message(lambda: read(tmp_path, text, "own.jsonl", **NESTED), expected)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("z,", "height above ground,", "own.csv: expected a column 'z'"),
        (CSV, "", "own.csv: expected a column 't', got none"),
        (CSV[CSV.index("\n") :], "\n", "own.csv: contains no rows"),
        ("10", "ten", "own.csv: line 2: x: expected a number, got 'ten'"),
        ("10", "NaN", "own.csv: line 2: x: expected a number, got 'NaN'"),
        ("k,", ",", "own.csv: line 2: n: expected the name of a track, got nothing"),
        ("0.5", "1e9", "own.csv: line 2: a: expected an angle"),
        ("car", "horse", "own.csv: line 2: c: unknown class 'horse'"),
    ],
)
def test_bad_csv_gets_one_message(tmp_path: Path, old: str, new: str, expected: str) -> None:
    assert_one_message(lambda: read(tmp_path, CSV.replace(old, new, 1), **FULL), expected)


def test_front_without_length_and_damaged_gzip_get_one_message(tmp_path: Path) -> None:
    no_length = CSV.replace("0.5,4,", "0.5,,")
    assert_one_message(lambda: read(tmp_path, no_length, **FULL, reference="front"), "line 2: l: expected a length")
    path = tmp_path / "own.csv"
    assert_one_message(lambda: user_table.read(truncated_gzip(path), mapping(**FULL)), "damaged gzip file")


# ---- coordinate reference systems


def test_projected_coordinates_are_unchanged_and_have_crs(tmp_path: Path) -> None:
    path = tmp_path / "own.csv"
    path.write_text(CSV.replace("10,20", "293500,5629700"))
    columns = mapping(**FULL, crs="EPSG:25832", length_unit="ft")
    tracks = user_table.read(path, columns)
    assert tracks.frame == TrackFrame("EPSG:25832")
    assert (tracks.x_m[0], tracks.y_m[0]) == (293500, 5629700)  # in the unit of the projection, not in feet
    assert tracks.length_m[0] == pytest.approx(4 * 0.3048) and tracks.z_m[0] == pytest.approx(3 * 0.3048)


def test_a_system_whose_geoid_grid_is_missing_gives_positions(tmp_path: Path) -> None:
    path = tmp_path / "own.csv"
    path.write_text(CSV.replace("10,20", "293500,5629700"))
    crs = "+proj=utm +zone=32 +datum=WGS84 +geoidgrids=no_such_grid.gtx +vunits=m +units=m +no_defs"
    tracks = user_table.read(path, mapping(**FULL, crs=crs))
    world = WorldFrame("EPSG:32632", (-293_000.0, -5_629_000.0))
    assert tracks.frame.crs is not None
    xy_m = world.from_crs(np.column_stack([tracks.x_m, tracks.y_m]), tracks.frame.crs)
    np.testing.assert_allclose(xy_m[0], (500, 700), atol=1e-6)


@pytest.mark.parametrize(("convention", "yaw"), [("cw_from_north", 90.0), ("ccw_from_east", 0.0)])
def test_degrees_become_utm_and_yaw_follows_the_grid(tmp_path: Path, convention: str, yaw: float) -> None:
    """A car at Aachen that heads due east moves along its yaw in UTM zone 32."""
    path = tmp_path / "own.csv"
    path.write_text(f"t,n,x,y,a\n0,k,6.07,50.78,{yaw}\n1,k,6.0701,50.78,{yaw}\n")
    keys = {**PLAIN, "yaw": "a", "yaw_unit": "deg", "yaw_convention": convention, "default_type": "car"}
    tracks = user_table.read(path, mapping(**keys, crs="lonlat"))
    assert tracks.frame == TrackFrame("EPSG:32632")
    motion = math.atan2(tracks.y_m[1] - tracks.y_m[0], tracks.x_m[1] - tracks.x_m[0])
    assert math.degrees(motion) == pytest.approx(-2.27, abs=0.01)
    assert tracks.yaw_rad[0] == pytest.approx(motion, abs=1e-5)
    expected = WorldFrame("EPSG:32632").from_lon_lat(np.array([[6.07, 50.78]]))[0]
    assert (tracks.x_m[0], tracks.y_m[0]) == pytest.approx(tuple(expected), abs=1e-6)
    other = user_table.read(path, mapping(**keys, crs="EPSG:4326"))
    assert np.allclose(other.x_m, tracks.x_m, atol=1e-6)


def test_unusable_systems_and_places_get_one_message(tmp_path: Path) -> None:
    path = tmp_path / "own.csv"
    path.write_text(CSV)
    for crs, expected in (
        ("EPSG:1", "scenario.toml: traffic.track_columns: crs: unknown coordinate reference system 'EPSG:1'"),
        ("EPSG:2229", "traffic.track_columns: crs: EPSG:2229"),  # US survey feet
        ("WGS", "unknown coordinate reference system 'WGS'"),
        ("+proj=utm +zone=32 +ellps=bessel +nadgrids=no_such_grid.gsb", "the grid no_such_grid.gsb is not installed"),
        ("EPSG:4978", "'WGS 84' is geocentric"),
    ):
        columns = mapping(**FULL, crs=crs)
        read_it = partial(user_table.read, path, columns, "scenario.toml: traffic.track_columns")
        assert_one_message(read_it, expected)
    text = CSV + "2,k,10,21.5,3,0.5,4,2,1.5,car\n" + CSV.splitlines()[1]
    assert_one_message(lambda: read(tmp_path, text, **FULL, crs="lonlat"), "own.csv: line 3: x, y: longitude 10")


# ---- the keys themselves


def test_mapping_is_the_same_after_json() -> None:
    for keys in ({**PLAIN, "default_type": "car"}, FULL, {**FULL, "types": {"x": "car"}, "yaw_unit": "deg"}):
        assert TrackColumns.model_validate_json(mapping(**keys).model_dump_json()) == mapping(**keys)


def test_two_coordinate_systems_contradict() -> None:
    traffic = {"tracks": ["own.csv"], "track_columns": FULL}
    assert TrafficConfig.from_dict({**traffic, "track_crs": "world"}).track_columns == mapping(**FULL)
    with pytest.raises(ValidationError, match=r"expected track_crs or track_columns\.crs, got both"):
        TrafficConfig.from_dict({"tracks": ["a"], "track_crs": "world", "track_columns": {**FULL, "crs": "lonlat"}})


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        (PLAIN, "expected type, the column with the class, or default_type"),
        ({**FULL, "y": "x"}, "time, id, x and y are different columns, got 'x' twice"),
        ({**FULL, "x": ""}, "at least 1 character"),
        ({**FULL, "colour": "c"}, "Extra inputs are not permitted"),
        ({**FULL, "time_unit": "min"}, "Input should be 's', 'ms', 'us' or 'ns'"),
        ({**FULL, "types": {"x": "ship"}}, "Input should be 'car'"),
        ({**FULL, "delimiter": "1"}, "expected a character such as"),
        ({**FULL, "delimiter": ", "}, "at most 1 character"),
        ({**PLAIN, "default_type": "car", "yaw_unit": "deg"}, "yaw_unit has no effect without yaw"),
        ({**PLAIN, "default_type": "car", "yaw_convention": "cw_from_north"}, "yaw_convention has no effect without"),
        ({**PLAIN, "default_type": "car", "z_reference": "bottom"}, "z_reference has no effect without z"),
        ({**PLAIN, "default_type": "car", "types": {"a": "car"}}, "types has no effect without type"),
        ({**PLAIN, "default_type": "car", "reference": "front"}, 'reference = "front" needs length'),
        ({**PLAIN, "z": "z", "default_type": "car", "z_reference": "bottom"}, 'z_reference = "bottom" needs height'),
    ],
)
def test_keys_that_contradict(keys: dict[str, Any], expected: str) -> None:
    with pytest.raises(ValidationError, match=expected):
        mapping(**keys)


@pytest.mark.slow
@needs_karlsruhe
def test_mapping_reads_karlsruhe_as_its_reader_does() -> None:
    path = REAL / "karlsruhe_k733" / "vehicle_tracks_000.csv.gz"
    keys = {"time": "timestamp_ms", "id": "track_id", "x": "x", "y": "y", "yaw": "psi_rad", "length": "length",
            "width": "width", "type": "agent_type"}  # fmt: skip
    tracks = user_table.read(path, mapping(**keys, time_unit="ms", types={"Bike": "bicycle"}))
    expected = interaction.read(path)
    assert tracks.names == expected.names and tracks.classes == expected.classes
    for key in ("track", "time_s", "x_m", "y_m", "yaw_rad", "length_m", "width_m"):
        assert np.array_equal(getattr(tracks, key), getattr(expected, key)), key
