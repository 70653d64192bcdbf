"""Point clouds of every format: hand-made files, exact round trips, damaged files, and formats of other packages."""

from __future__ import annotations

import importlib.util
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from egvs.core import readers
from egvs.core.errors import InputError, MissingBackendError
from egvs.formats import las as las_format
from egvs.formats import pcd as pcd_format
from egvs.formats import ply as ply_format
from egvs.formats.point_clouds import KIND, read_points, stream_points, write_points
from tests import processes
from tests.core.test_plugins import install_readers, site  # noqa: F401  the fixture

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
    """A plain, greedy LZF packer: the inverse of the module's decompressor."""
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


# --- in and out ---


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


@pytest.mark.slow
@quick
@given(points=hnp.arrays(np.float64, st.tuples(st.integers(1, 20), st.just(3)), elements=finite))
@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
def test_round_trip_keeps_every_finite_float64(
    tmp_path: Path, suffix: str, points: np.ndarray[Any, np.dtype[np.float64]]
) -> None:
    path = tmp_path / f"a{suffix}"
    write_points(path, points)
    back, _ = read_points(path, "")
    assert back.tobytes() == points.tobytes()


@pytest.mark.slow
@quick
@given(points=hnp.arrays(np.float64, st.tuples(st.integers(1, 8), st.just(3)), elements=finite))
@pytest.mark.parametrize("name", ["a.pcd", "a.ply", "a.csv"])
def test_reads_shortest_text_of_float64_exactly(
    tmp_path: Path, name: str, points: np.ndarray[Any, np.dtype[np.float64]]
) -> None:
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


def test_writes_arrays_of_any_memory_layout(tmp_path: Path) -> None:
    write_points(tmp_path / "a.pcd", np.asfortranarray(POINTS)[::-1])
    assert read_points(tmp_path / "a.pcd", "")[0].tolist() == POINTS[::-1].tolist()


def test_write_rejects_unknown_suffix_and_wrong_shape(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.xyz: unknown file format '\.xyz'. Use one of \.pcd, \.ply"):
        write_points(tmp_path / "a.xyz", POINTS)
    with pytest.raises(ValueError, match=r"shape \(3, 2\)"):
        write_points(tmp_path / "a.pcd", np.zeros((3, 2)))
    assert not list(tmp_path.iterdir())


# --- PCD ---


def test_pcd_that_is_stored_without_compression(tmp_path: Path) -> None:
    """Where LZF gains nothing, writers store the bytes as they are; bytes that are LZF are unpacked all the same."""
    plain = np.random.default_rng(1).uniform(-20, 20, (3, 60)).astype("<f4")
    head = pcd("x y z", "4 4 4", "F F F", 60, "binary_compressed")
    sizes = struct.pack("<II", plain.nbytes, plain.nbytes)
    assert read(tmp_path, "a.pcd", head + sizes + plain.tobytes()) == plain.T.astype(np.float64).tolist()
    assert read(tmp_path, "b.pcd", head + packed(plain.tobytes())) == plain.T.astype(np.float64).tolist()
    damaged = head + struct.pack("<II", 100, 720) + plain.tobytes()[:100]
    with pytest.raises(InputError, match="not valid LZF data"):
        read(tmp_path, "c.pcd", damaged)


@pytest.mark.parametrize("padding", [bytes(4096), b"\n", b"\0\r\n \0"])
def test_padding_behind_binary_points(tmp_path: Path, padding: bytes) -> None:
    for name in ("a.pcd", "a.ply"):
        write_points(tmp_path / name, POINTS)
        content = (tmp_path / name).read_bytes()
        assert read(tmp_path, name, content + padding) == POINTS.tolist()


def test_pcd_compressed_has_no_block_for_padding_between_the_fields(tmp_path: Path) -> None:
    points = np.arange(21.0).reshape(7, 3)
    head = pcd("x y z _", "4 4 4 1", "F F F U", 7, "binary_compressed", "COUNT 1 1 1 20\n")
    blocks = points.astype("<f4").T.tobytes()
    for padding in (b"", bytes(140)):
        assert read(tmp_path, "a.pcd", head + packed(blocks + padding)) == points.tolist()


def test_pcd_ascii_with_old_keyword_and_padding(tmp_path: Path) -> None:
    head = pcd("x y z", "4 4 4", "F F F", 1, "ascii").decode().replace("FIELDS", "COLUMNS")
    assert read(tmp_path, "a.pcd", head + "1 2 3\n\0\0\0\0") == [[1, 2, 3]]


def test_pcd_ascii_reads_fields_in_any_order(tmp_path: Path) -> None:
    head = pcd("rgb z y n x", "4 4 4 4 8", "U F F F F", 2, "ascii", "COUNT 1 1 1 2 1\n").decode()
    assert read(tmp_path, "a.pcd", head + "9 3 2 0 0 1\r\n\n9\t6 5  nan inf 4.1") == [[1, 2, 3], [4.1, 5, 6]]


def test_pcd_binary_reads_fields_of_any_type(tmp_path: Path) -> None:
    head = pcd("_ z _ x ring y", "1 2 4 8 2 4", "U I F F U F", 2, more="COUNT 3 1 2 1 1 1\n")
    body = struct.pack("<3xh8xdHf", -3, 0.1, 7, 2.5) + struct.pack("<3xh8xdHf", 30, 0.2, 8, 0.1)
    assert read(tmp_path, "a.pcd", head + body) == [[0.1, 2.5, -3], [0.2, float(np.float32(0.1)), 30]]


def test_pcd_compressed_reads_one_block_per_field(tmp_path: Path) -> None:
    head = pcd("x n y z", "4 1 8 2", "F U F U", 3, "binary_compressed", "COUNT 1 2 1 1\n")
    plain = struct.pack("<3f6B3d3H", 1, 2, 3, 0, 0, 0, 0, 0, 0, 0.1, 0.1, 0.1, 7, 7, 65535)
    body = packed(plain)
    assert len(body) < len(plain)
    assert read(tmp_path, "a.pcd", head + body + b"\0" * 9) == [[1, 0.1, 7], [2, 0.1, 7], [3, 0.1, 65535]]


def test_decompresses_hand_made_lzf(tmp_path: Path) -> None:
    """Four literal bytes; a copy of 4 from 4 back; a copy of 16 from 4 back, which overlaps its own output."""
    body = bytes([3, 0, 0, 128, 63, 2 << 5, 3, 7 << 5, 16 - 9, 3])
    head = pcd("x y z", "4 4 4", "F F F", 2, "binary_compressed")
    assert read(tmp_path, "a.pcd", head + struct.pack("<II", len(body), 24) + body) == [[1, 1, 1], [1, 1, 1]]


@pytest.mark.slow
@quick
@given(data=st.data())
def test_pcd_compressed_equals_uncompressed(tmp_path: Path, data: st.DataObject) -> None:
    few = st.sampled_from([0.0, 1.0, -1.5]) | st.floats(width=32, allow_nan=False, allow_infinity=False)
    points = data.draw(hnp.arrays(np.float32, st.tuples(st.integers(1, 60), st.just(3)), elements=few))
    head = pcd("x y z", "4 4 4", "F F F", len(points), "binary_compressed")
    assert read(tmp_path, "a.pcd", head + packed(points.T.tobytes())) == points.astype(float).tolist()


def pcd_with_viewpoint(viewpoint: str) -> str:
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
def test_pcd_viewpoint_converts_points_to_the_world_frame(
    tmp_path: Path, viewpoint: str, expected: list[list[float]]
) -> None:
    np.testing.assert_allclose(read(tmp_path, "a.pcd", pcd_with_viewpoint(viewpoint)), expected, rtol=0, atol=1e-12)


def test_pcd_viewpoint_keeps_missing_returns_missing(tmp_path: Path) -> None:
    text = pcd_with_viewpoint("1 0 0 0 0 0 1").replace("4 5 6", "inf nan 6")
    points, dropped = read_points(put(tmp_path, "a.pcd", text), "")
    assert (points.tolist(), dropped) == ([[0, -2, 3]], 1)


# --- PLY, CSV, LAS ---


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


def test_ply_ascii_ignores_other_elements(tmp_path: Path) -> None:
    text = (
        "ply\nformat ascii 1.0\nelement path 1\nproperty list uchar int way\nelement vertex 2\nproperty float x\n"
        "property float y\nproperty uchar red\nproperty float z\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n2 0 1\n0.1 2 255 3\n4 5 0 6\n3 0 1 0\n"
    )
    assert read(tmp_path, "a.ply", text) == [[0.1, 2, 3], [4, 5, 6]]


def test_csv_reads_columns_in_any_order_and_ignores_others(tmp_path: Path) -> None:
    text = '\xef\xbb\xbfname, z_m,x_m,y_m,,name\r\n"a, b",3,1, 2 ,,\xff\r\n\r\n,6e0,+4,-5.5,x,\r\n'
    assert read(tmp_path, "a.csv", text) == [[1, 2, 3], [4, -5.5, 6]]


def las(folder: Path, name: str, n: int = 300) -> tuple[Path, Any]:
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001, 0.001, 0.01], [4e5, 3.9e6, -7.0]
    cloud = laspy.LasData(header)
    integers = np.random.default_rng(7).integers(-100_000, 100_000, (n, 3))
    cloud.X, cloud.Y, cloud.Z = integers.T
    cloud.write(folder / name)
    return folder / name, integers * header.scales + header.offsets


@pytest.mark.slow
@pytest.mark.system
@needs_laspy
@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_las_returns_scaled_coordinates_in_float64(tmp_path: Path, name: str) -> None:
    path, expected = las(tmp_path, name)
    points, dropped = read_points(path, "")
    assert points.tobytes() == expected.tobytes()
    assert dropped == 0


@needs_laspy
@pytest.mark.parametrize("declared", [1, 150, 299])
def test_rejects_las_with_more_points_than_it_declares(tmp_path: Path, declared: int) -> None:
    path, _ = las(tmp_path, "a.las")
    content = bytearray(path.read_bytes())
    content[247:255] = struct.pack("<Q", declared)
    path.write_bytes(content)
    message = f"the header declares {declared} points, but there are {30 * (300 - declared)} bytes after the last one"
    with pytest.raises(InputError, match=message):
        read_points(path, "")


@needs_laspy
def test_rejects_laz_with_more_chunks_than_its_points_need(tmp_path: Path) -> None:
    path, _ = las(tmp_path, "a.laz", 120_000)  # chunks of 50,000 points
    content = bytearray(path.read_bytes())
    content[247:255] = struct.pack("<Q", 60_000)
    path.write_bytes(content)
    with pytest.raises(InputError, match="the header declares 60000 points, but there are 3 chunks of 50000 points"):
        read_points(path, "")


@needs_laspy
def test_records_after_the_points_of_las_are_no_points(tmp_path: Path) -> None:
    import laspy

    path, expected = las(tmp_path, "a.las")
    with laspy.open(path) as file:
        cloud = file.read()
    cloud.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("someone", 7, "text", b"x" * 5000)])
    cloud.write(path)
    assert read_points(path, "")[0].tobytes() == expected.tobytes()


@pytest.mark.slow
@pytest.mark.system
@needs_laspy
@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_rejects_truncated_las(tmp_path: Path, name: str) -> None:
    path, _ = las(tmp_path, name)
    content = path.read_bytes()
    for end in [0, 3, 100, 226, 300, 400, len(content) // 2, len(content) - 1]:
        path.write_bytes(content[:end])
        with pytest.raises(InputError, match=rf"{name}: .*\. Download or make the file again"):
            read_points(path, "")


@needs_laspy
@pytest.mark.parametrize(
    ("at", "value", "message"),
    [
        (0, b"X", "no LASF header"),
        (100, b"\xff\xff\xff\xff", "points beyond the file or into itself"),  # number of variable-length records
        (96, b"\xff\xff\xff\x7f", "points beyond the file or into itself"),  # where the points start
        (104, b"\x3f", "cannot be read as LAS"),  # point format 63
        (247, b"\x2d\x01", "the header declares 9030 bytes of points, but the file contains 9000"),  # 301 points
        (
            105,
            b"\xff\xff",
            "the header declares 19660500 bytes of points, but the file contains 9000",
        ),  # length of a point
        (131, struct.pack("<d", 1e308), "expected at least one return with finite x, y and z"),  # the scale of x
    ],
)
def test_rejects_las_with_damaged_header(tmp_path: Path, at: int, value: bytes, message: str) -> None:
    path, _ = las(tmp_path, "a.las")
    overwrite(path, at, value)
    with pytest.raises(InputError, match=message):
        read_points(path, "")


@pytest.mark.slow
@pytest.mark.system
@needs_laspy
def test_rejects_laz_that_would_end_the_process(tmp_path: Path) -> None:
    """By memory for 4e9 chunks, at either location of the table's offset, or by a panic for a point without items."""
    path, _ = las(tmp_path, "a.laz")
    content = path.read_bytes()
    points_at = struct.unpack_from("<I", content, 96)[0]
    table_at = content[points_at : points_at + 8]
    overwrite(path, struct.unpack("<q", table_at)[0] + 4, b"\xff\xff\xff\xff")
    message = "the file declares 4294967295 chunks in .* bytes"
    with pytest.raises(InputError, match=message):
        read_points(path, "")
    overwrite(path, points_at, b"\xff" * 8)
    overwrite(path, path.stat().st_size, table_at)
    with pytest.raises(InputError, match=message):
        read_points(path, "")
    path.write_bytes(content)
    overwrite(path, 375 + 54 + 32, b"\0\0")  # how many items: after the header and the record's own
    with pytest.raises(InputError, match=r"cannot be read as LAS \(.*LazItem"):
        read_points(path, "")


@pytest.mark.slow
@needs_laspy
@pytest.mark.system
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory cannot be limited on this system")
def test_rejects_laz_that_needs_more_memory_than_the_limit(tmp_path: Path) -> None:
    """A layer of its first chunk says that it has 4 GB, after the first point (30 bytes), a count and eight layers."""
    path, _ = las(tmp_path, "a.laz")
    points_at = struct.unpack_from("<I", path.read_bytes(), 96)[0]
    overwrite(path, points_at + 8 + 30 + 4 + 7 * 4, b"\xff\xff\xff\xf0")
    message = (
        r"its reader was killed by signal 6: it needed too much memory\)\. "
        r"The limit is 2,000 MB; set EGVS_MAX_READER_MB"
    )
    with pytest.raises(InputError, match=message):
        read_points(path, "")


@needs_laspy
def test_rejects_more_points_than_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_POINTS", "299")
    for name in ("a.las", "a.laz"):
        with pytest.raises(InputError, match=rf"{name}: has 300 points\. The limit is 299 points; set EGVS_MAX_POINTS"):
            read_points(las(tmp_path, name)[0], "")


def overwrite(path: Path, at: int, value: bytes) -> None:
    data = bytearray(path.read_bytes())
    data[at : at + len(value)] = value
    path.write_bytes(data)


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_message_without_laspy_says_how_to_install_it(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(InputError, match=r"needs laspy, which is not installed\. Run pip install 'egvs\[las\]'"):
        read_points(put(tmp_path, name, b"LASF"), "")


@needs_laspy
def test_message_without_lazrs_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import laspy

    path, _ = las(tmp_path, "a.laz")
    monkeypatch.setattr(laspy.LazBackend, "detect_available", lambda: ())
    with pytest.raises(InputError, match=r"needs lazrs, which is not installed\. Run pip install 'egvs\[las\]'"):
        read_points(path, "")


# --- in chunks ---


@pytest.mark.slow
@needs_laspy
@pytest.mark.system
@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_las_comes_in_chunks_beyond_the_limit_of_points(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EGVS_MAX_POINTS", "10")
    path, expected = las(tmp_path, name)
    chunks = list(stream_points(path, ""))
    assert [(chunk.scan, chunk.station_m) for chunk in chunks] == [(0, None)]
    assert np.concatenate([chunk.points_m for chunk in chunks]).tobytes() == expected.tobytes()


@needs_laspy
def test_large_las_file_is_never_held_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(las_format, "_CHUNK", 100)
    path, expected = las(tmp_path, "a.las")
    chunks = [chunk.points_m for chunk in stream_points(path, "")]
    assert [len(chunk) for chunk in chunks] == [100, 100, 100]
    assert np.concatenate(chunks).tobytes() == expected.tobytes()


def test_pcd_viewpoint_is_the_station(tmp_path: Path) -> None:
    (chunk,) = stream_points(put(tmp_path, "a.pcd", pcd_with_viewpoint("10 20 30 1 0 0 0")), "")
    assert chunk.station_m is not None and chunk.station_m.tolist() == [10, 20, 30]
    assert chunk.points_m.tolist() == [[11, 22, 33], [14, 25, 36]]
    (chunk,) = stream_points(put(tmp_path, "a.pcd", ASCII_PCD), "")
    assert chunk.station_m is None


def test_formats_without_chunks_come_at_once_with_missing_returns(tmp_path: Path) -> None:
    (chunk,) = stream_points(put(tmp_path, "a.csv", "x_m,y_m,z_m\n1,2,3\nnan,0,0\n"), "")
    assert np.isnan(chunk.points_m).sum() == 1
    with pytest.raises(InputError, match=r"a\.ply: not a PLY file"):
        next(stream_points(put(tmp_path, "a.ply", "no"), ""))


# --- points with more than x, y, z ---


@pytest.mark.parametrize("name", ["a.pcd", "a.ply"])
def test_writes_further_columns(tmp_path: Path, name: str) -> None:
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


# --- damaged files ---


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
def test_drops_and_counts_missing_returns(tmp_path: Path, name: str, content: str | bytes) -> None:
    points, dropped = read_points(put(tmp_path, name, content), "")
    assert (points.tolist(), dropped) == ([[1, 2, 3], [4, 5, 6]], 2)


BINARY = pcd("x y z", "4 4 4", "F F F", 2)
PACKED = pcd("x y z", "4 4 4", "F F F", 2, "binary_compressed")
BINARY_PLY = ASCII_PLY[: ASCII_PLY.index("1 2 3")].replace("ascii", "binary_little_endian")
CSV = "x_m,y_m,z_m\n1,2,3\n"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.xyz", "1 2 3", r"a\.xyz: unknown file format '\.xyz'. Use one of \.bin, \.csv, .*\.laz, \.pcd, \.ply"),
        ("a", "1 2 3", r"/a: the file name has no suffix. Use one of \.bin, \.csv"),
        # PCD, header
        ("a.pcd", "", r"a\.pcd: the PCD header has no DATA line"),
        ("a.pcd", ASCII_PCD[:40], "the PCD header has no DATA line"),
        ("a.pcd", "VERSION\x00\x80 7\n" + ASCII_PCD, r"a\.pcd: line 1: expected text, got .VERSION.x00.x80 7."),
        ("a.pcd", ASCII_PCD.replace("FIELDS x y z\n", ""), "the PCD header has no FIELDS line"),
        ("a.pcd", ASCII_PCD.replace("x y z", "x y zz"),
         "expected one field 'z', got the fields x y zz. Write one field for each of x, y and z"),
        ("a.pcd", ASCII_PCD.replace("x y z", "x x z"), "expected one field 'x', got the fields x x z"),
        ("a.pcd", ASCII_PCD.replace("TYPE", "COUNT 1 2 1\nTYPE"), "expected one field 'y'"),
        ("a.pcd", ASCII_PCD.replace("8 8 8", "8 8"), "SIZE: expected 3 values, one per field, got 2"),
        ("a.pcd", ASCII_PCD.replace("8 8 8", "8 2 8"), "field 'y' has TYPE F and SIZE 2. Use TYPE F with SIZE 4 or 8"),
        ("a.pcd", ASCII_PCD.replace("8 8 8", "8 eight 8"), "SIZE of y: expected a whole number, got 'eight'"),
        ("a.pcd", ASCII_PCD.replace("F F F", "F Q F"), "field 'y' has TYPE Q and SIZE 8"),
        ("a.pcd", ASCII_PCD.replace("POINTS 2", "POINTS 3"), "POINTS is 3, but WIDTH x HEIGHT is 2"),
        ("a.pcd", ASCII_PCD.replace("POINTS 2", "POINTS -2"), "POINTS: expected a whole number, got '-2'"),
        ("a.pcd", ASCII_PCD.replace("POINTS 2", "POINTS " + "9" * 5000),
         r"POINTS: expected a whole number, got '9+ .* 9+'"),
        ("a.pcd", ASCII_PCD.replace("POINTS 2\n", "").replace("WIDTH 2\n", ""), "no POINTS line"),
        ("a.pcd", ASCII_PCD.replace(" 2\n", " 0\n"),
         "the header declares 0 points. Use a file with at least one return"),
        ("a.pcd", ASCII_PCD.replace("ascii", "zip"), "DATA: expected ascii, binary or binary_compressed, got 'zip'"),
        ("a.pcd", pcd_with_viewpoint("0 0 0 2 0 0 0"),
         "VIEWPOINT: expected a quaternion of length 1, got '2 0 0 0' of length 2. Write a translation and a unit"),
        ("a.pcd", pcd_with_viewpoint("0 0 0 0 0 0 0"), "expected a quaternion of length 1, got '0 0 0 0' of length 0"),
        ("a.pcd", pcd_with_viewpoint("0 0 nan 1 0 0 0"), "VIEWPOINT: .* got '0 0 nan 1 0 0 0'"),
        ("a.pcd", pcd_with_viewpoint("0 0 0"), "VIEWPOINT: .* got '0 0 0'"),
        # PCD, points
        ("a.pcd", ASCII_PCD.replace("4 5 6\n", ""), "the header declares 2 points, but the file contains 1 lines"),
        ("a.pcd", ASCII_PCD + "7 8 9\n", "the header declares 2 points, but the file contains 3 lines"),
        ("a.pcd", ASCII_PCD.replace("4 5 6", "4 5"), r"a\.pcd: line 9: expected 3 values, got 2"),
        ("a.pcd", ASCII_PCD.replace("1 2 3\n4 5 6", "1 2 3 0\n4 5 6 0"), r"line 8: expected 3 values, got 4"),
        ("a.pcd", ASCII_PCD.replace("4 5 6", "\n4 5 six"),
         "line 10: expected a number, got 'six'. Use a number, or nan for a missing return"),
        ("a.pcd", ASCII_PCD.replace("4 5 6", "4 5 6_0"), "line 9: expected a number, got '6_0'"),
        ("a.pcd", ASCII_PCD.replace("1 2 3\n4 5 6", "nan 2 3\n4 5 inf"),
         "expected at least one return with finite x, y and z, got none of 2"),
        ("a.pcd", BINARY + bytes(23), r"declares 2 points of 12 bytes \(24 bytes\), but the file contains 23 bytes"),
        ("a.pcd", BINARY + bytes(24) + b"\1", r"\(24 bytes\), but the file contains 25 bytes"),
        ("a.pcd", ASCII_PCD.replace("DATA ascii", "DATA " + "x" * 900), "DATA: .* got 'x{60}'"),
        ("a.pcd", PACKED + bytes(7), r"the file ends before its points \(only 7 bytes of data\)"),
        ("a.pcd", PACKED + struct.pack("<II", 1, 12) + b"\0",
         "the header declares 24 bytes of points, but there are 12 after decompression"),
        ("a.pcd", PACKED + packed(bytes(24))[:-1], "expected 5 bytes of packed points, got 4 bytes"),
        ("a.pcd", PACKED + struct.pack("<II", 2, 24) + b"\x20\x05", "the packed points are not valid LZF data"),
        ("a.pcd", PACKED + struct.pack("<II", 1, 24) + b"\xe0", "the packed points are not valid LZF data"),
        ("a.pcd", PACKED + struct.pack("<II", 2, 24) + b"\x05\x05", "the packed points are not valid LZF data"),
        # PLY
        ("a.ply", "plyx", r"a\.ply: not a PLY file with a header from 'ply' to 'end_header'"),
        ("a.ply", "solid\nend_header\n", "not a PLY file"),
        ("a.ply", ASCII_PLY.replace("vertex", "corner"),
         "expected an element 'vertex', got corner. Write the points as vertices"),
        ("a.ply", ASCII_PLY.replace("double z", "double q"), "expected one field 'z', got the fields x y q"),
        ("a.ply", ASCII_PLY.replace("format ascii 1.0\n", ""),
         "the PLY header has no 'format' line. Add a 'format' line with one of ascii"),
        ("a.ply", ASCII_PLY.replace("end_header", "element é 1\nend_header"),
         r"line \d: expected a header in ASCII, got 'element "),
        ("a.ply", ASCII_PLY.replace("ascii", "utf8"),
         r"line 2: expected a format, an element, .* got 'format utf8 1\.0'"),
        ("a.ply", ASCII_PLY.replace("double z", "real z"), r"line 6: .* got 'property real z'"),
        ("a.ply", ASCII_PLY.replace("double z", "double x"), r"line 6: .* got 'property double x'"),
        ("a.ply", ASCII_PLY.replace("vertex 2", "vertex two"),
         "count of element 'vertex': expected a whole number, got 'two'"),
        ("a.ply", ASCII_PLY.replace("vertex 2", "vertex 0"), "the header declares 0 points"),
        ("a.ply", ASCII_PLY.replace("double z", "list uchar int z"),
         "the element 'vertex' has a list property. Use no list properties in"),
        ("a.ply", BINARY_PLY.replace("element", "element path 1\nproperty list uchar int way\nelement") + "\0" * 49,
         "the element 'path' has a list property"),
        ("a.ply", ASCII_PLY.replace("4 5 6\n", ""), "the header declares 2 points, but the file contains 1 lines"),
        ("a.ply", ASCII_PLY.replace("4 5 6\n", "4 5\n"), "line 9: expected 3 values, got 2"),
        ("a.ply", ASCII_PLY.replace("4 5 6\n", "4 5 z\n"), "line 9: expected a number, got 'z'"),
        ("a.ply", BINARY_PLY + "\0" * 47, r"2 points of 24 bytes \(48 bytes\), but the file contains 47 bytes"),
        ("a.ply", BINARY_PLY + "\0" * 48 + "\1", r"\(48 bytes\), but the file contains 49 bytes"),
        # CSV
        ("a.csv", "", r"a\.csv: expected exactly one column 'x_m', got none"),
        ("a.csv", CSV.replace("x_m", "x"), "expected exactly one column 'x_m', got x, y_m, z_m. Write a header row"),
        ("a.csv", CSV.replace("z_m", "x_m"), "expected exactly one column 'x_m', got x_m, y_m, x_m"),
        ("a.csv", "x_m,y_m,z_m\n", "got none of 0"),
        ("a.csv", CSV + "4,five,6\n",
         r"a\.csv: line 3: y_m: expected a number, got 'five'. Use a number, or nan for a missing return"),
        ("a.csv", CSV + "\n4,,6\n", "line 4: y_m: expected a number, got ''"),
        ("a.csv", CSV + "4,5\n", "line 3: expected 3 values, one per column, got 2"),
        ("a.csv", CSV + "1,5,2,5,3,5\n", "line 3: expected 3 values, one per column, got 6"),
        ("a.csv", CSV.replace(",", ";"), "expected exactly one column 'x_m', got x_m;y_m;z_m"),
        ("a.csv", CSV + "4,5,6_0\n", "line 3: z_m: expected a number, got '6_0'"),
        ("a.csv", CSV + "4,5,\0\n", "line 3: z_m: expected a number, got '\\\\x00'"),
        ("a.csv", "x" * 200_000, r"cannot be read as CSV \(field larger than"),
    ],
)  # fmt: skip
def test_rejects_damaged_file(tmp_path: Path, name: str, content: str | bytes, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_points(put(tmp_path, name, content), "sites.csv: row A")
    assert str(caught.value).startswith(f"sites.csv: row A: {tmp_path / name}: ")


def test_rejects_missing_file_and_folder(tmp_path: Path) -> None:
    (tmp_path / "b.ply").mkdir()
    for name in ("a.pcd", "a.ply", "b.ply", "a.csv"):
        with pytest.raises(InputError, match=rf"{name}: cannot be read \(.*\)\. Check the path"):
            read_points(tmp_path / name, "")


def test_path_is_not_repeated_in_messages(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^scenario\.toml: sites\.points = 'a\.pcd': cannot be read"):
        read_points(tmp_path / "a.pcd", "scenario.toml: sites.points = 'a.pcd'")


COMPLETE_FILES = {
    "ascii.pcd": ASCII_PCD.encode(),
    "binary.pcd": BINARY + bytes(24),
    "packed.pcd": PACKED + packed(struct.pack("<6f", 1, 1, 1, 1, 2, 3)),
    "viewed.pcd": pcd_with_viewpoint("1 2 3 0.5 0.5 0.5 0.5").encode(),
    "ascii.ply": ASCII_PLY.encode(),
    "binary.ply": BINARY_PLY.encode() + bytes(48),
    "a.csv": b'x_m,y_m,z_m,n\n1,2,3,"a"\n4,5,6,\n',
}


@pytest.mark.slow
@settings(quick, max_examples=400)
@given(name=st.sampled_from(sorted(COMPLETE_FILES)), data=st.data())
def test_random_damage_gives_points_or_input_error(tmp_path: Path, name: str, data: st.DataObject) -> None:
    content = bytearray(COMPLETE_FILES[name])
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


# --- formats of other packages ---


FOO_FORMAT = """
import numpy as np

def read(path, where):
    "Points as text, one number a line."
    return np.array([float(word) for word in path.read_text().split()]).reshape(-1, 3)

def write(path, points_m):
    path.write_text("\\n".join(map(repr, points_m.ravel().tolist())))
"""
BAR_FORMAT = """
import numpy as np

def read(path, where):
    return np.zeros((1, 3))
"""
FOO, BAR = (f"Reader('{name}', 'points', 'plug_{name}', suffixes=('.{name}',))" for name in ("foo", "bar"))

WRITE_AND_READ = """
import sys
from pathlib import Path
import numpy as np
from egvs.core.errors import InputError
from egvs.formats.point_clouds import read_points, write_points
path = Path(sys.argv[1])
write_points(path, np.array([[0.1, 2.0, 3.0], [4.0, np.nan, 6.0]]))
points, dropped = read_points(path, "")
assert points.tolist() == [[0.1, 2.0, 3.0]] and dropped == 1
try:
    write_points(path.with_suffix(".bar"), points)
except InputError as error:
    print(error)
"""


@pytest.mark.slow
@pytest.mark.system
def test_package_adds_a_format(tmp_path: Path) -> None:
    (tmp_path / "site").mkdir()
    install_readers(tmp_path / "site", "foo", f"{FOO}, {BAR}", {"plug_foo": FOO_FORMAT, "plug_bar": BAR_FORMAT})
    done = processes.python(WRITE_AND_READ, tmp_path / "a.FOO", beside=tmp_path / "site")
    assert done.returncode == 0, done.stderr
    assert "a.bar: unknown file format '.bar'. Use one of .foo, .pcd, .ply" in done.stdout


@pytest.mark.system
def test_formats_of_this_program_can_be_read() -> None:
    suffixes = {suffix for reader in readers.list_readers(KIND) for suffix in reader.suffixes}
    assert {".csv", ".las", ".laz", ".pcd", ".ply"} <= suffixes
    for reader in readers.list_readers(KIND):
        assert callable(readers.load_reader(reader).read)


@pytest.mark.slow
@pytest.mark.system
def test_reading_imports_no_other_format(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
                    "end_header\n1 2 3\n", encoding="ascii")  # fmt: skip
    assert np.array_equal(read_points(path, "")[0], [[1, 2, 3]])
    code = (
        "import sys\nfrom pathlib import Path\nfrom egvs.formats.point_clouds import read_points\n"
        f"read_points(Path({str(path)!r}), '')\n"
        "print([m for m in sys.modules if m in ('egvs.formats.pcd', 'egvs.formats.las', 'pyarrow', 'laspy')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


READER = """
import numpy as np
def read(path, where):
    {}
"""


@pytest.mark.system
@pytest.mark.parametrize(
    ("body", "problem"),
    [
        ("raise RuntimeError('boom')", r"raised RuntimeError\('boom'\)"),
        ("raise SystemExit(0)", r"raised SystemExit\(0\)"),
        ("return None", "returns NoneType"),
        ("return [[1.0, 2.0, 3.0]]", "returns list"),
        ("return np.array([['a', 'b', 'c']])", "returns a <U1 array"),
        ("return np.ones((5, 2))", r"returns a float64 array of shape \(5, 2\)"),
        ("return np.ones(3)", r"returns a float64 array of shape \(3,\)"),
    ],
)
def test_message_names_failing_reader_and_file(site: Path, body: str, problem: str) -> None:  # noqa: F811
    install_readers(site, "foo", FOO, {"plug_foo": READER.format(body)})
    with pytest.raises(InputError, match=rf"a\.foo: its reader plug_foo \(package foo\) {problem}"):
        read_points(site / "a.foo", "sites.csv: row A")


@pytest.mark.system
def test_integer_points_become_float64(site: Path) -> None:  # noqa: F811
    install_readers(site, "foo", FOO, {"plug_foo": READER.format("return np.array([[1, 2, 3]])")})
    points, dropped = read_points(site / "a.foo", "")
    assert (points.dtype, points.tolist(), dropped) == (np.float64, [[1.0, 2.0, 3.0]], 0)


@pytest.mark.system
def test_input_error_of_reader_is_passed_on(site: Path) -> None:  # noqa: F811
    body = "from egvs.core.errors import InputError; raise InputError(where, 'the file is empty', 'Add a point.')"
    install_readers(site, "foo", FOO, {"plug_foo": READER.format(body)})
    with pytest.raises(InputError, match=r"a\.foo: the file is empty\. Add a point\.$"):
        read_points(site / "a.foo", "")


@pytest.mark.system
def test_format_without_read_is_rejected_and_does_not_disable_others(site: Path) -> None:  # noqa: F811
    install_readers(site, "foo", FOO, {"plug_foo": ""})
    with pytest.raises(MissingBackendError, match=r"plug_foo has no read; .* of the package foo"):
        read_points(site / "a.foo", "")
    write_points(site / "a.ply", np.ones((1, 3)))
    assert read_points(site / "a.ply", "")[0].tolist() == [[1.0, 1.0, 1.0]]
