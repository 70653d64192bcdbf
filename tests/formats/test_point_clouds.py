"""Point clouds: hand-made files of every kind, and exact round trips."""

from __future__ import annotations

import importlib.util
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from egvs.core.errors import InputError
from egvs.formats import pcd as pcd_format
from egvs.formats import ply as ply_format
from egvs.formats.point_clouds import read_points, write_points

needs_laspy = pytest.mark.skipif(importlib.util.find_spec("laspy") is None, reason="laspy is not installed (egvs[las])")
quick = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])

POINTS = np.array([[1 / 3, -2.5, 1e6 / 7], [4.0, 5.0, 6.0]])
ASCII_PCD = "FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n1 2 3\n4 5 6\n"
ASCII_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\nend_header\n"
    "1 2 3\n4 5 6\n"
)


def put(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode("latin-1") if isinstance(content, str) else content)
    return path


def read(folder: Path, name: str, content: str | bytes) -> list[list[float]]:
    points, dropped = read_points(put(folder, name, content), "sites.csv: row A")
    assert points.dtype == np.float64
    assert dropped == 0
    rows: list[list[float]] = points.tolist()
    return rows


def pcd(fields: str, sizes: str, types: str, n: int, data: str = "binary", more: str = "") -> bytes:
    head = f"# made by hand\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\n"
    return f"{head}{more}WIDTH {n}\nHEIGHT 1\nDATA {data}\n".encode()


def lzf(plain: bytes) -> bytes:
    """A plain, greedy LZF packer: the twin of the module's unpacker."""
    out, literals, at = bytearray(), bytearray(), 0

    def flush() -> None:
        for i in range(0, len(literals), 32):
            out.extend((len(literals[i : i + 32]) - 1, *literals[i : i + 32]))
        literals.clear()

    while at < len(plain):
        best, back = 0, 0
        for first in range(max(0, at - 8192), at):
            length = 0
            while length < 264 and at + length < len(plain) and plain[first + length] == plain[at + length]:
                length += 1
            if length > best:
                best, back = length, at - first - 1
        if best < 3:
            literals.append(plain[at])
            at += 1
            continue
        flush()
        out += bytes([min(best - 2, 7) << 5 | back >> 8, *([best - 9] if best >= 9 else []), back & 255])
        at += best
    flush()
    return bytes(out)


def packed(plain: bytes) -> bytes:
    body = lzf(plain)
    return struct.pack("<II", len(body), len(plain)) + body


# --- in and out -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.pcd", "a.ply", "A.PCD"])
def test_round_trip_is_exact_and_repeats_its_bytes(tmp_path: Path, name: str) -> None:
    first, second = tmp_path / name, tmp_path / "deeper" / name
    write_points(first, POINTS)
    write_points(second, POINTS)
    points, dropped = read_points(first, "")
    assert points.tobytes() == POINTS.tobytes()
    assert dropped == 0
    assert first.read_bytes() == second.read_bytes()
    assert not list(tmp_path.glob(".*"))


finite = st.floats(allow_nan=False, allow_infinity=False)


@quick
@given(points=hnp.arrays(np.float64, st.tuples(st.integers(1, 20), st.just(3)), elements=finite))
@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
def test_every_finite_float64_survives(
    tmp_path: Path, suffix: str, points: np.ndarray[Any, np.dtype[np.float64]]
) -> None:
    path = tmp_path / f"a{suffix}"
    write_points(path, points)
    back, _ = read_points(path, "")
    assert back.tobytes() == points.tobytes()


@quick
@given(points=hnp.arrays(np.float64, st.tuples(st.integers(1, 8), st.just(3)), elements=finite))
@pytest.mark.parametrize("name", ["a.pcd", "a.ply", "a.csv"])
def test_shortest_text_survives(tmp_path: Path, name: str, points: np.ndarray[Any, np.dtype[np.float64]]) -> None:
    n, separator = len(points), "," if name == "a.csv" else " "
    head = {
        "a.pcd": ASCII_PCD[: ASCII_PCD.index("1 2 3")]
        .replace("WIDTH 2", f"WIDTH {n}")
        .replace("POINTS 2", f"POINTS {n}"),
        "a.ply": ASCII_PLY[: ASCII_PLY.index("1 2 3")].replace("vertex 2", f"vertex {n}"),
        "a.csv": "x_m,y_m,z_m\n",
    }[name]
    text = head + "".join(separator.join(map(repr, row)) + "\n" for row in points.tolist())
    back, _ = read_points(put(tmp_path, name, text), "")
    assert back.tobytes() == points.tobytes()


def test_a_view_of_other_layout_is_written_as_what_it_shows(tmp_path: Path) -> None:
    write_points(tmp_path / "a.pcd", np.asfortranarray(POINTS)[::-1])
    assert read_points(tmp_path / "a.pcd", "")[0].tolist() == POINTS[::-1].tolist()


def test_write_refuses_other_kinds_and_shapes(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.xyz: is of the unknown kind '\.xyz'; one of \.pcd, \.ply"):
        write_points(tmp_path / "a.xyz", POINTS)
    with pytest.raises(ValueError, match=r"shape \(3, 2\)"):
        write_points(tmp_path / "a.pcd", np.zeros((3, 2)))
    assert not list(tmp_path.iterdir())


# --- PCD --------------------------------------------------------------------------------------------------------------


def test_pcd_ascii_takes_fields_in_any_order(tmp_path: Path) -> None:
    head = pcd("rgb z y n x", "4 4 4 4 8", "U F F F F", 2, "ascii", "COUNT 1 1 1 2 1\n").decode()
    assert read(tmp_path, "a.pcd", head + "9 3 2 0 0 1\r\n\n9\t6 5  nan inf 4.1") == [[1, 2, 3], [4.1, 5, 6]]


def test_pcd_binary_takes_fields_of_any_type(tmp_path: Path) -> None:
    head = pcd("_ z _ x ring y", "1 2 4 8 2 4", "U I F F U F", 2, more="COUNT 3 1 2 1 1 1\n")
    body = struct.pack("<3xh8xdHf", -3, 0.1, 7, 2.5) + struct.pack("<3xh8xdHf", 30, 0.2, 8, 0.1)
    assert read(tmp_path, "a.pcd", head + body) == [[0.1, 2.5, -3], [0.2, float(np.float32(0.1)), 30]]


def test_pcd_compressed_holds_each_field_as_a_block(tmp_path: Path) -> None:
    head = pcd("x n y z", "4 1 8 2", "F U F U", 3, "binary_compressed", "COUNT 1 2 1 1\n")
    plain = struct.pack("<3f6B3d3H", 1, 2, 3, 0, 0, 0, 0, 0, 0, 0.1, 0.1, 0.1, 7, 7, 65535)
    body = packed(plain)
    assert len(body) < len(plain)
    assert read(tmp_path, "a.pcd", head + body + b"\0" * 9) == [[1, 0.1, 7], [2, 0.1, 7], [3, 0.1, 65535]]


def test_lzf_by_hand(tmp_path: Path) -> None:
    """Four plain bytes; a copy of 4 from 4 back; a copy of 16 from 4 back, which runs into what it writes."""
    body = bytes([3, 0, 0, 128, 63, 2 << 5, 3, 7 << 5, 16 - 9, 3])
    head = pcd("x y z", "4 4 4", "F F F", 2, "binary_compressed")
    assert read(tmp_path, "a.pcd", head + struct.pack("<II", len(body), 24) + body) == [[1, 1, 1], [1, 1, 1]]


@pytest.mark.slow
@quick
@given(data=st.data())
def test_compressed_equals_plain(tmp_path: Path, data: st.DataObject) -> None:
    few = st.sampled_from([0.0, 1.0, -1.5]) | st.floats(width=32, allow_nan=False, allow_infinity=False)
    points = data.draw(hnp.arrays(np.float32, st.tuples(st.integers(1, 60), st.just(3)), elements=few))
    head = pcd("x y z", "4 4 4", "F F F", len(points), "binary_compressed")
    assert read(tmp_path, "a.pcd", head + packed(points.T.tobytes())) == points.astype(float).tolist()


def viewed(viewpoint: str) -> str:
    return ASCII_PCD.replace("POINTS", f"VIEWPOINT {viewpoint}\nPOINTS")


@pytest.mark.parametrize(
    ("viewpoint", "expected"),
    [
        ("0 0 0 1 0 0 0", [[1, 2, 3], [4, 5, 6]]),
        ("0 0 0 -1 0 0 0", [[1, 2, 3], [4, 5, 6]]),
        ("10 20 30 1 0 0 0", [[11, 22, 33], [14, 25, 36]]),
        ("10 20 30 0 0 0 1", [[9, 18, 33], [6, 15, 36]]),  # half a turn about z
        ("0 0 5 0.70710678 0 0 0.70710678", [[-2, 1, 8], [-5, 4, 11]]),  # a quarter to the left: x becomes y
        ("0 0 5 0.707 0.707 0 0", [[1, -3, 7], [4, -6, 10]]),  # a quarter about x: y becomes z; few digits
        ("0 0 0 0.5 0.5 0.5 0.5", [[3, 1, 2], [6, 4, 5]]),  # x to y, y to z, z to x
    ],
)
def test_pcd_viewpoint_brings_points_into_the_world(
    tmp_path: Path, viewpoint: str, expected: list[list[float]]
) -> None:
    np.testing.assert_allclose(read(tmp_path, "a.pcd", viewed(viewpoint)), expected, rtol=0, atol=1e-12)


def test_pcd_viewpoint_leaves_missing_returns_missing(tmp_path: Path) -> None:
    text = viewed("1 0 0 0 0 0 1").replace("4 5 6", "inf nan 6")
    points, dropped = read_points(put(tmp_path, "a.pcd", text), "")
    assert (points.tolist(), dropped) == ([[0, -2, 3]], 1)


# --- PLY, CSV, LAS ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("order", "mark"), [("little", "<"), ("big", ">")])
@pytest.mark.parametrize(("kind", "letter"), [("double", "d"), ("float64", "d"), ("float", "f"), ("int16", "h")])
def test_ply_binary(tmp_path: Path, order: str, mark: str, kind: str, letter: str) -> None:
    head = (
        f"ply\r\nformat binary_{order}_endian 1.0\r\ncomment end_header to come\r\nelement camera 1\n"
        f"property uchar id\nelement vertex 2\nproperty {kind} z\nproperty uchar red\n"
        f"property {kind} y\nproperty {kind} x\nelement face 1\nproperty list uchar int vertex_indices\nend_header\r\n"
    ).encode()
    body = b"\7" + b"".join(
        struct.pack(f"{mark}{letter}B2{letter}", z, 255, y, x) for x, y, z in [(1, 2, 3), (4, 5, -6)]
    )
    assert read(tmp_path, "a.ply", head + body + b"\3" + bytes(12)) == [[1, 2, 3], [4, 5, -6]]


def test_ply_ascii_ignores_faces_and_what_comes_before(tmp_path: Path) -> None:
    text = (
        "ply\nformat ascii 1.0\nelement path 1\nproperty list uchar int way\nelement vertex 2\nproperty float x\n"
        "property float y\nproperty uchar red\nproperty float z\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n2 0 1\n0.1 2 255 3\n4 5 0 6\n3 0 1 0\n"
    )
    assert read(tmp_path, "a.ply", text) == [[0.1, 2, 3], [4, 5, 6]]


def test_csv_takes_columns_in_any_order_and_ignores_the_rest(tmp_path: Path) -> None:
    text = '\xef\xbb\xbfname, z_m,x_m,y_m,,name\r\n"a, b",3,1, 2 ,,\xff\r\n\r\n,6e0,+4,-5.5,x,\r\n'
    assert read(tmp_path, "a.csv", text) == [[1, 2, 3], [4, -5.5, 6]]


def las(folder: Path, name: str, n: int = 300) -> tuple[Path, Any]:
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001, 0.001, 0.01], [4e5, 3.9e6, -7.0]
    cloud = laspy.LasData(header)
    whole = np.random.default_rng(7).integers(-100_000, 100_000, (n, 3))
    cloud.X, cloud.Y, cloud.Z = whole.T
    cloud.write(folder / name)
    return folder / name, whole * header.scales + header.offsets


@pytest.mark.slow
@pytest.mark.system
@needs_laspy
@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_las_gives_scaled_coordinates_in_float64(tmp_path: Path, name: str) -> None:
    path, expected = las(tmp_path, name)
    points, dropped = read_points(path, "")
    assert points.tobytes() == expected.tobytes()
    assert dropped == 0


@pytest.mark.slow
@pytest.mark.system
@needs_laspy
@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_las_cut_anywhere_is_refused(tmp_path: Path, name: str) -> None:
    path, _ = las(tmp_path, name)
    whole = path.read_bytes()
    for end in [0, 3, 100, 226, 300, 400, len(whole) // 2, len(whole) - 1]:
        path.write_bytes(whole[:end])
        with pytest.raises(InputError, match=rf"{name}: .*; .*a whole"):
            read_points(path, "")


@needs_laspy
@pytest.mark.parametrize(
    ("at", "value", "message"),
    [
        (0, b"X", "no LASF header"),
        (100, b"\xff\xff\xff\xff", "points past the file or into itself"),  # number of variable-length records
        (96, b"\xff\xff\xff\x7f", "points past the file or into itself"),  # where the points start
        (104, b"\x3f", "cannot be read as LAS"),  # point format 63
        (247, b"\x2d\x01", "holds 9000 bytes of points; 9030, as its header says"),  # 301 points
        (105, b"\xff\xff", "holds 9000 bytes of points; 19660500, as its header says"),  # length of a point
        (131, struct.pack("<d", 1e308), "holds no finite point"),  # the scale of x
    ],
)
def test_las_with_a_damaged_header_is_refused(tmp_path: Path, at: int, value: bytes, message: str) -> None:
    path, _ = las(tmp_path, "a.las")
    overwrite(path, at, value)
    with pytest.raises(InputError, match=message):
        read_points(path, "")


@pytest.mark.slow
@pytest.mark.system
@needs_laspy
def test_laz_that_would_end_the_process_is_refused(tmp_path: Path) -> None:
    """By memory for 4e9 chunks, wherever the table's place stands, or by a panic for a point of no items."""
    path, _ = las(tmp_path, "a.laz")
    whole = path.read_bytes()
    points_at = struct.unpack_from("<I", whole, 96)[0]
    table_at = whole[points_at : points_at + 8]
    overwrite(path, struct.unpack("<q", table_at)[0] + 4, b"\xff\xff\xff\xff")
    many = "says that it holds 4294967295 chunks in .* bytes; a whole LAS or LAZ file"
    with pytest.raises(InputError, match=many):
        read_points(path, "")
    overwrite(path, points_at, b"\xff" * 8)
    overwrite(path, path.stat().st_size, table_at)
    with pytest.raises(InputError, match=many):
        read_points(path, "")
    path.write_bytes(whole)
    overwrite(path, 375 + 54 + 32, b"\0\0")  # how many items: after the header and the record's own
    with pytest.raises(InputError, match=r"cannot be read as LAS \(.*LazItem"):
        read_points(path, "")


@needs_laspy
@pytest.mark.system
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="where memory can be bounded")
def test_laz_that_asks_for_more_memory_than_the_bound_is_refused(tmp_path: Path) -> None:
    """A layer of its first chunk says that it has 4 GB, after the first point (30 bytes), a count and eight layers."""
    path, _ = las(tmp_path, "a.laz")
    points_at = struct.unpack_from("<I", path.read_bytes(), 96)[0]
    overwrite(path, points_at + 8 + 30 + 4 + 7 * 4, b"\xff\xff\xff\xf0")
    told = r"what unpacks it ended, by signal 6: .*too much memory\)\. The limit is 2,000 MB; set EGVS_MAX_READER_MB"
    with pytest.raises(InputError, match=told):
        read_points(path, "")


@needs_laspy
def test_more_points_than_the_bound_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_POINTS", "299")
    for name in ("a.las", "a.laz"):
        with pytest.raises(InputError, match=rf"{name}: has 300 points\. The limit is 299 points; set EGVS_MAX_POINTS"):
            read_points(las(tmp_path, name)[0], "")


def overwrite(path: Path, at: int, value: bytes) -> None:
    data = bytearray(path.read_bytes())
    data[at : at + len(value)] = value
    path.write_bytes(data)


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_las_without_laspy_says_how_to_get_it(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(InputError, match=r"needs laspy, which is not installed; pip install egvs\[las\]"):
        read_points(put(tmp_path, name, b"LASF"), "")


@needs_laspy
def test_laz_without_a_backend_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import laspy

    path, _ = las(tmp_path, "a.laz")
    monkeypatch.setattr(laspy.LazBackend, "detect_available", lambda: ())
    with pytest.raises(InputError, match=r"needs lazrs, which is not installed; pip install egvs\[las\]"):
        read_points(path, "")


# --- points with more than x, y, z ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.pcd", "a.ply"])
def test_further_columns_stand_beside_the_points(tmp_path: Path, name: str) -> None:
    columns = {axis: np.arange(3, dtype=np.float32) + at for at, axis in enumerate("xyz")}
    columns |= {"intensity": np.array([0, 0.5, 1], dtype=np.float32), "object": np.array([-1, 0, 7], dtype=np.int32)}
    {"pcd": pcd_format, "ply": ply_format}[name[2:]].write_columns(tmp_path / name, columns)
    assert read_points(tmp_path / name, "")[0].tolist() == [[0, 1, 2], [1, 2, 3], [2, 3, 4]]
    data = (tmp_path / name).read_bytes()
    head = {
        "a.pcd": b"FIELDS x y z intensity object\nSIZE 4 4 4 4 4\nTYPE F F F F I\nCOUNT 1 1 1 1 1\n",
        "a.ply": b"property float z\nproperty float intensity\nproperty int object\nend_header\n",
    }[name]
    assert head in data
    kind = np.dtype([(key, column.dtype.newbyteorder("<")) for key, column in columns.items()])
    assert np.frombuffer(data[-3 * kind.itemsize :], dtype=kind)["object"].tolist() == [-1, 0, 7]
