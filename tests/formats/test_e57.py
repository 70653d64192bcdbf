"""E57 files: points and stations of hand-made files, what marks invalid points, and damaged files."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.formats import e57
from egvs.formats.point_clouds import read_points
from tests.formats.e57_pages import with_checksums

needs_pye57 = pytest.mark.skipif(importlib.util.find_spec("pye57") is None, reason="pye57 is not installed (egvs[las])")
pytestmark = [needs_pye57, pytest.mark.system]

QUARTER_TURN = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
"""About z: x becomes y."""
NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])

CRS = 'LOCAL_CS["survey",UNIT["metre",1]]'


def write_e57(path: Path, *scans: tuple[dict[str, Any], Any, Any], crs: str = "") -> Path:
    """Write scans of columns, a quaternion and a translation each; equal scans give equal bytes."""
    import pye57
    from pye57 import libe57

    class File(pye57.E57):  # type: ignore[misc]
        """With a reference system, which pye57 leaves empty."""

        def write_default_header(self) -> None:
            image = self.image_file
            image.extensionsAdd("", libe57.E57_V1_0_URI)
            texts = {"formatName": "ASTM E57 3D Imaging Data File", "guid": "{1}", "coordinateMetadata": crs}
            for name, text in texts.items():
                self.root.set(name, libe57.StringNode(image, text))
            for name, number in (("versionMajor", 1), ("versionMinor", 0)):
                self.root.set(name, libe57.IntegerNode(image, number))
            for name in ("data3D", "images2D"):
                self.root.set(name, libe57.VectorNode(image, True))

    file = File(str(path), mode="w")
    with mock.patch("uuid.uuid4", return_value="1"):
        for columns, rotation, translation in scans:
            turn, shift = np.asarray(rotation), np.asarray(translation, dtype=float)
            file.write_scan_raw(columns, rotation=turn, translation=shift)
    file.close()
    return path


def cartesian(*points: tuple[float, float, float], invalid: tuple[int, ...] = ()) -> dict[str, Any]:
    """Columns of points, and of their invalid states."""
    values = np.array(points)
    columns: dict[str, Any] = {f"cartesian{axis}": values[:, i].copy() for i, axis in enumerate("XYZ")}
    if invalid:
        columns["cartesianInvalidState"] = np.array(invalid, dtype=np.int8)
    return columns


ONE_POINT = cartesian((1.0, 2.0, 3.0))


@pytest.mark.slow
def test_points_and_stations_follow_the_poses(tmp_path: Path) -> None:
    path = write_e57(
        tmp_path / "a.e57",
        (cartesian((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)), NO_TURN, (10, 20, 30)),
        (ONE_POINT, QUARTER_TURN, (100, 0, 0)),
    )
    first, second = e57.stream(path, "a.e57")
    assert (first.scan, second.scan) == (0, 1)
    assert first.station_m is not None and first.station_m.tolist() == [10, 20, 30]
    assert second.station_m is not None and second.station_m.tolist() == [100, 0, 0]
    assert first.points_m.tolist() == [[11, 22, 33], [14, 25, 36]]
    np.testing.assert_allclose(second.points_m, [[98, 1, 3]], atol=1e-12)
    assert len(e57.read(path, "a.e57")) == 3


def test_invalid_points_are_dropped_and_counted(tmp_path: Path) -> None:
    path = write_e57(
        tmp_path / "a.e57", (cartesian((1.0, 2.0, 3.0), (9.0, 9.0, 9.0), invalid=(0, 2)), NO_TURN, (0, 0, 0))
    )
    points, dropped = read_points(path, "")
    assert (points.tolist(), dropped) == ([[1, 2, 3]], 1)


@pytest.mark.slow
def test_identity_poses_tell_no_station(tmp_path: Path) -> None:
    """Programs that join scans write such poses."""
    at_zero, at_five = (ONE_POINT, NO_TURN, (0, 0, 0)), (ONE_POINT, NO_TURN, (5, 0, 0))
    assert stations(write_e57(tmp_path / "a.e57", at_zero, at_zero)) == [None, None]
    assert stations(write_e57(tmp_path / "b.e57", at_zero, at_five)) == [[0, 0, 0], [5, 0, 0]]


def stations(path: Path) -> list[list[float] | None]:
    at = [chunk.station_m for chunk in e57.stream(path, "")]
    return [None if station is None else station.tolist() for station in at]


def test_spherical_coordinates() -> None:
    points = e57._to_cartesian(np.array([[2.0, np.pi / 2, 0.0], [2.0, 0.0, np.pi / 6]]))
    np.testing.assert_allclose(points, [[0, 2, 0], [np.sqrt(3), 0, 1]], atol=1e-15)


@pytest.mark.slow
def test_large_scans_come_in_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.arange(1_200_000, dtype=float)
    columns = {f"cartesian{axis}": values for axis in "XYZ"}
    path = write_e57(tmp_path / "a.e57", (columns, NO_TURN, (1, 0, 0)))
    chunks = list(e57.stream(path, ""))
    assert [len(chunk.points_m) for chunk in chunks] == [500_000, 500_000, 200_000]
    assert chunks[2].points_m[-1].tolist() == [1_200_000, 1_199_999, 1_199_999]
    monkeypatch.setenv("EGVS_MAX_POINTS", "600000")
    with pytest.raises(InputError, match=r"a\.e57: has 1,000,000 points\. The limit is 600,000 points"):
        read_points(path, "")


@pytest.mark.slow
def test_declared_reference_system(tmp_path: Path) -> None:
    scan = (ONE_POINT, NO_TURN, (0, 0, 0))
    assert e57.crs_of(write_e57(tmp_path / "a.e57", scan), "") is None
    assert e57.crs_of(write_e57(tmp_path / "b.e57", scan, crs=CRS), "") == CRS


@pytest.mark.slow
def test_truncated_files_give_one_message_and_print_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = write_e57(tmp_path / "a.e57", (cartesian(*[(1.0, 2.0, 3.0)] * 500), NO_TURN, (1, 2, 3)))
    content = path.read_bytes()
    for end in (0, 5, 8, 48, 1000, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:end])
        with pytest.raises(InputError, match=r"a\.e57: .*\. Download or make the file again"):
            read_points(path, "")
    out, err = capfd.readouterr()
    assert (out, err) == ("", "")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b'recordCount="3"', b'recordCount="9"', "scan 0 declares 9 points, but contains 3"),
        (b"cartesianX", b"cartesianQ", "scan 0 has neither cartesian nor spherical coordinates"),
        (b'<w type="Float">1', b'<w type="Float">7', "scan 0 has no valid pose"),
        (b"</e57Root>", b"</e57Boot>", "cannot be read as E57"),
    ],
)  # fmt: skip
def test_damaged_xml_with_valid_checksums(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], old: bytes, new: bytes, message: str
) -> None:
    path = write_e57(tmp_path / "a.e57", (cartesian(*[(1.0, 2.0, 3.0)] * 3), NO_TURN, (1, 2, 3)))
    data = path.read_bytes()
    assert old in data
    path.write_bytes(with_checksums(data.replace(old, new)))
    with pytest.raises(InputError, match=message):
        read_points(path, "")
    assert capfd.readouterr() == ("", "")


def test_checksums_are_those_of_the_library(tmp_path: Path) -> None:
    data = write_e57(tmp_path / "a.e57", (ONE_POINT, NO_TURN, (1, 2, 3))).read_bytes()
    assert with_checksums(data) == data


def test_message_without_pye57_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.e57"
    path.write_bytes(b"ASTM-E57")
    monkeypatch.setattr(e57, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"needs pye57, which is not installed\. Run pip install 'egvs\[las\]'"):
        read_points(path, "")
