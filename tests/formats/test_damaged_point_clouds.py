"""Point clouds with missing returns, and what is said about files that are wrong: each with its message, none a
traceback."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from egvs.core.errors import InputError
from egvs.formats.point_clouds import read_points
from tests.formats.test_point_clouds import ASCII_PCD, ASCII_PLY, packed, pcd, put, quick, viewed


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.pcd", ASCII_PCD.replace("POINTS 2", "POINTS 4").replace("WIDTH 2", "WIDTH 4") + "nan nan nan\n1 -inf 3\n"),
        ("a.pcd", pcd("x y z", "4 4 4", "F F F", 4)
         + struct.pack("<9f", 1, 2, 3, 4, 5, 6, float("nan"), 0, 0) + b"\x01\0\xa0\x7f" + struct.pack("<2f", 0, 0)),
        ("a.ply", ASCII_PLY.replace("vertex 2", "vertex 4") + "nan nan nan\n1 -inf 3\n"),
        ("a.csv", "x_m,y_m,z_m\n1,2,3\n4,5,6\nnan,NaN,0\n1,-inf,3\n"),
    ],
    ids=["pcd ascii", "pcd binary, with a signalling NaN", "ply", "csv"],
)  # fmt: skip
def test_missing_returns_are_dropped_and_counted(tmp_path: Path, name: str, content: str | bytes) -> None:
    points, dropped = read_points(put(tmp_path, name, content), "")
    assert (points.tolist(), dropped) == ([[1, 2, 3], [4, 5, 6]], 2)


BINARY = pcd("x y z", "4 4 4", "F F F", 2)
PACKED = pcd("x y z", "4 4 4", "F F F", 2, "binary_compressed")
BINARY_PLY = ASCII_PLY[: ASCII_PLY.index("1 2 3")].replace("ascii", "binary_little_endian")
CSV = "x_m,y_m,z_m\n1,2,3\n"
OTHER_COLUMNS = r"has no single column 'x_m' \(its columns: x, y_m, z_m\); a header row with x_m, y_m, z_m"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.xyz", "1 2 3", r"a\.xyz: is of the unknown kind '\.xyz'; one of \.csv, \.las, \.laz, \.pcd, \.ply"),
        ("a", "1 2 3", r"/a: has no suffix that tells its kind; one of \.csv"),
        # PCD, header
        ("a.pcd", "", r"a\.pcd: is not a whole PCD file \(no line DATA in its header\)"),
        ("a.pcd", ASCII_PCD[:40], "is not a whole PCD file"),
        ("a.pcd", "VERSION\x00\x80 7\n" + ASCII_PCD, r"a\.pcd: line 1: .VERSION.x00.x80 7. is no text"),
        ("a.pcd", ASCII_PCD.replace("FIELDS x y z\n", ""), "its PCD header has no line FIELDS"),
        ("a.pcd", ASCII_PCD.replace("x y z", "x y zz"), r"has no single field 'z' \(its fields: x y zz\); x, y and z"),
        ("a.pcd", ASCII_PCD.replace("x y z", "x x z"), "has no single field 'x'"),
        ("a.pcd", ASCII_PCD.replace("TYPE", "COUNT 1 2 1\nTYPE"), "has no single field 'y'"),
        ("a.pcd", ASCII_PCD.replace("8 8 8", "8 8"), "SIZE has 2 values for 3 FIELDS; one value a field"),
        ("a.pcd", ASCII_PCD.replace("8 8 8", "8 2 8"), "field 'y' has TYPE F and SIZE 2. F of 4 or 8, I or U"),
        ("a.pcd", ASCII_PCD.replace("8 8 8", "8 eight 8"), "the SIZE of y is 'eight'; a whole number"),
        ("a.pcd", ASCII_PCD.replace("F F F", "F Q F"), "field 'y' has TYPE Q and SIZE 8"),
        ("a.pcd", ASCII_PCD.replace("POINTS 2", "POINTS 3"), "POINTS is 3, but WIDTH x HEIGHT is 2; the same number"),
        ("a.pcd", ASCII_PCD.replace("POINTS 2", "POINTS -2"), "POINTS is '-2'; a whole number"),
        ("a.pcd", ASCII_PCD.replace("POINTS 2", "POINTS " + "9" * 5000), r"POINTS is '9+ .* 9+'; a whole number"),
        ("a.pcd", ASCII_PCD.replace("POINTS 2\n", "").replace("WIDTH 2\n", ""), "no line POINTS"),
        ("a.pcd", ASCII_PCD.replace(" 2\n", " 0\n"), "holds no points, says its header; at least one return"),
        ("a.pcd", ASCII_PCD.replace("ascii", "zip"), "DATA is 'zip'; ascii, binary or binary_compressed"),
        ("a.pcd", viewed("0 0 0 2 0 0 0"), "VIEWPOINT is '0 0 0 2 0 0 0'; a translation and a unit quaternion"),
        ("a.pcd", viewed("0 0 nan 1 0 0 0"), "VIEWPOINT is '0 0 nan 1 0 0 0'"),
        ("a.pcd", viewed("0 0 0"), "VIEWPOINT is '0 0 0'"),
        # PCD, points
        ("a.pcd", ASCII_PCD.replace("4 5 6\n", ""), "holds 1 lines of points; 2, as its header says; a whole file"),
        ("a.pcd", ASCII_PCD + "7 8 9\n", "holds 3 lines of points; 2, as its header says"),
        ("a.pcd", ASCII_PCD.replace("4 5 6", "4 5"), r"a\.pcd: line 9: holds 2 values; 3 in each line"),
        ("a.pcd", ASCII_PCD.replace("1 2 3\n4 5 6", "1 2 3 0\n4 5 6 0"), r"line 8: holds 4 values; 3 in each line"),
        ("a.pcd", ASCII_PCD.replace("4 5 6", "\n4 5 six"),
         "line 10: 'six' is no number; a number, or nan where nothing"),
        ("a.pcd", ASCII_PCD.replace("4 5 6", "4 5 6_0"), "cannot be read as text .*6_0"),
        ("a.pcd", ASCII_PCD.replace("1 2 3\n4 5 6", "nan 2 3\n4 5 inf"),
         r"holds no finite point \(of 2\); at least one"),
        ("a.pcd", BINARY + bytes(23), r"holds 23 bytes of points; 24 \(2 points of 12\), as its header says"),
        ("a.pcd", BINARY + bytes(25), "holds 25 bytes of points; 24"),
        ("a.pcd", ASCII_PCD.replace("DATA ascii", "DATA " + "x" * 900), "DATA is 'x{60}'; ascii, binary"),
        ("a.pcd", PACKED + bytes(7), r"ends before its points \(7 bytes of them\); 24, as its header says"),
        ("a.pcd", PACKED + struct.pack("<II", 1, 12) + b"\0", "holds 12 bytes of points, unpacked; 24"),
        ("a.pcd", PACKED + packed(bytes(24))[:-1], "holds 4 bytes of packed points; 5; a whole file"),
        ("a.pcd", PACKED + struct.pack("<II", 2, 24) + b"\x20\x05", "its packed points are damaged. LZF data of 24"),
        ("a.pcd", PACKED + struct.pack("<II", 1, 24) + b"\xe0", "its packed points are damaged"),
        ("a.pcd", PACKED + struct.pack("<II", 2, 24) + b"\x05\x05", "its packed points are damaged"),
        # PLY
        ("a.ply", "plyx", r"a\.ply: is not a whole PLY file \(from 'ply' to 'end_header'\)"),
        ("a.ply", "solid\nend_header\n", "is not a whole PLY file"),
        ("a.ply", ASCII_PLY.replace("vertex", "corner"),
         r"has no element 'vertex' \(its elements: corner\); vertices with"),
        ("a.ply", ASCII_PLY.replace("double z", "double q"), r"has no single field 'z' \(its fields: x y q\)"),
        ("a.ply", ASCII_PLY.replace("format ascii 1.0\n", ""), "its PLY header has no line 'format'; one of ascii"),
        ("a.ply", ASCII_PLY.replace("ascii", "utf8"),
         r"line 2: 'format utf8 1\.0' in its PLY header; a format, an element"),
        ("a.ply", ASCII_PLY.replace("double z", "real z"), r"line 6: 'property real z' in its PLY header"),
        ("a.ply", ASCII_PLY.replace("double z", "double x"), r"line 6: 'property double x' in its PLY header"),
        ("a.ply", ASCII_PLY.replace("vertex 2", "vertex two"),
         "the count of element 'vertex' is 'two'; a whole number"),
        ("a.ply", ASCII_PLY.replace("vertex 2", "vertex 0"), "holds no points, says its header"),
        ("a.ply", ASCII_PLY.replace("double z", "list uchar int z"),
         "the element 'vertex' holds a list; no list among"),
        ("a.ply", BINARY_PLY.replace("element", "element path 1\nproperty list uchar int way\nelement") + "\0" * 49,
         "the element 'path' holds a list"),
        ("a.ply", ASCII_PLY.replace("4 5 6\n", ""), "holds 1 lines of points; 2"),
        ("a.ply", ASCII_PLY.replace("4 5 6\n", "4 5\n"), "line 9: holds 2 values; 3 in each line"),
        ("a.ply", ASCII_PLY.replace("4 5 6\n", "4 5 z\n"), "line 9: 'z' is no number"),
        ("a.ply", BINARY_PLY + "\0" * 47, r"holds 47 bytes of points; 48 \(2 points of 24\)"),
        ("a.ply", BINARY_PLY + "\0" * 49, "holds 49 bytes of points; 48"),
        # LAS is refused further up; CSV
        ("a.csv", "", r"a\.csv: has no single column 'x_m' \(its columns: none\)"),
        ("a.csv", CSV.replace("x_m", "x"), OTHER_COLUMNS),
        ("a.csv", CSV.replace("z_m", "x_m"), "has no single column 'x_m'"),
        ("a.csv", "x_m,y_m,z_m\n", r"holds no finite point \(of 0\)"),
        ("a.csv", CSV + "4,five,6\n",
         r"a\.csv: line 3: y_m: 'five' is no number; a number, or nan where nothing returned"),
        ("a.csv", CSV + "\n4,,6\n", "line 4: y_m: '' is no number"),
        ("a.csv", CSV + "4,5\n", "line 3: holds 2 values; 3, one a column"),
        ("a.csv", CSV + "1,5,2,5,3,5\n", "line 3: holds 6 values; 3, one a column"),
        ("a.csv", CSV.replace(",", ";"), r"has no single column 'x_m' \(its columns: x_m;y_m;z_m\)"),
        ("a.csv", CSV + "4,5,6_0\n", r"cannot be read as CSV \(.*6_0"),
        ("a.csv", CSV + "4,5,\0\n", "line 3: z_m: '\\\\x00' is no number"),
        ("a.csv", "x" * 200_000, r"cannot be read as CSV \(field larger than"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(tmp_path: Path, name: str, content: str | bytes, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_points(put(tmp_path, name, content), "sites.csv: row A")
    assert str(caught.value).startswith(f"sites.csv: row A: {tmp_path / name}: ")


def test_a_missing_file_and_a_folder_are_said(tmp_path: Path) -> None:
    (tmp_path / "b.ply").mkdir()
    for name in ("a.pcd", "a.ply", "b.ply", "a.csv"):
        with pytest.raises(InputError, match=rf"{name}: cannot be read \(.*\); a file that is there and may be read"):
            read_points(tmp_path / name, "")


def test_a_place_that_names_the_file_stands_alone(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^scenario\.toml: sites\.points = 'a\.pcd': cannot be read"):
        read_points(tmp_path / "a.pcd", "scenario.toml: sites.points = 'a.pcd'")


WHOLE = {
    "ascii.pcd": ASCII_PCD.encode(),
    "binary.pcd": BINARY + bytes(24),
    "packed.pcd": PACKED + packed(struct.pack("<6f", 1, 1, 1, 1, 2, 3)),
    "viewed.pcd": viewed("1 2 3 0.5 0.5 0.5 0.5").encode(),
    "ascii.ply": ASCII_PLY.encode(),
    "binary.ply": BINARY_PLY.encode() + bytes(48),
    "a.csv": b'x_m,y_m,z_m,n\n1,2,3,"a"\n4,5,6,\n',
}


@pytest.mark.slow
@settings(quick, max_examples=400)
@given(name=st.sampled_from(sorted(WHOLE)), data=st.data())
def test_damage_never_ends_in_anything_but_points_or_a_message(tmp_path: Path, name: str, data: st.DataObject) -> None:
    content = bytearray(WHOLE[name])
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + data.draw(st.integers(0, 2))] = data.draw(st.binary(max_size=3))
    content = content[: data.draw(st.integers(0, len(content)) | st.just(len(content)))]
    try:
        points, dropped = read_points(put(tmp_path, name, bytes(content)), "")
    except InputError as error:
        assert name in str(error)
    else:
        assert np.isfinite(points).all()
        assert len(points) + dropped > 0
