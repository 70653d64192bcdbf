"""What LAS files say of themselves: reference systems as GeoTIFF keys and WKT, units, noise and withheld points.

Evidence: systems of EPSG, and PROJ strings that state the same by hand; positions are converted through both.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import CRS, Transformer

from egvs.core.errors import InputError
from egvs.formats.georeference import height_unit, parse_crs
from egvs.formats.geotiff_keys import GeoKeys
from egvs.formats.point_clouds import other_point_cloud_crs, point_cloud_crs, read_points, stream_points

laspy = pytest.importorskip("laspy")

SURVEY_FOOT_M = 1200 / 3937
OREGON_FEET = (
    "+proj=lcc +lat_0=41.75 +lon_0=-120.5 +lat_1=43 +lat_2=45.5 +x_0=399999.9999984 +y_0=0 +datum=NAD83 +units=ft"
)
OREGON_KEYS = {
    1024: 1, 1026: "Oregon Lambert", 2048: 4269, 2054: 9102, 3072: 32767, 3074: 32767, 3075: 8, 3076: 9002,
    3078: 43.0, 3079: 45.5, 3082: 1312335.958, 3083: 0.0, 3084: -120.5, 3085: 41.75,
}  # fmt: skip
UTM_15 = {1024: 1, 3072: 32615, 3076: 9001}
WKT_UTM_FEET = CRS("EPSG:32615+6360").to_wkt("WKT1_GDAL")


def key_records(keys: Mapping[int, Any]) -> dict[int, bytes]:
    """The three records with GeoTIFF keys: whole numbers, numbers, texts."""
    directory, doubles, texts = [(1, 1, 0, len(keys))], b"", b""
    for key, value in keys.items():
        if isinstance(value, int):
            directory.append((key, 0, 1, value))
        elif isinstance(value, float):
            directory.append((key, 34736, 1, len(doubles) // 8))
            doubles += struct.pack("<d", value)
        else:
            directory.append((key, 34737, len(value) + 1, len(texts)))
            texts += value.encode() + b"|"
    return {34735: b"".join(struct.pack("<4H", *row) for row in directory), 34736: doubles, 34737: texts}


def write_las(
    path: Path,
    keys: Mapping[int, Any] | None = None,
    wkt: str | None = None,
    *,
    wkt_flag: bool = False,
    wkt_is_behind: bool = False,
    version: str = "1.4",
    point_format: int = 6,
    points: Any = ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)),
    **fields: Any,
) -> Path:
    """A LAS file with records of a reference system as they are given, before or behind the points."""
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = [0.001] * 3, np.floor(np.min(points, axis=0))
    records = [] if keys is None else list(key_records(keys).items())
    header.vlrs.extend(laspy.VLR("LASF_Projection", number, "", content) for number, content in records if content)
    text = None if wkt is None else laspy.VLR("LASF_Projection", 2112, "", wkt.encode() + b"\0")
    if text is not None and not wkt_is_behind:
        header.vlrs.append(text)
    header.global_encoding.wkt = wkt_flag
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = np.asarray(points, dtype=np.float64).T
    for name, value in fields.items():
        setattr(cloud, name, value)
    if text is not None and wkt_is_behind:
        cloud.evlrs = laspy.vlrs.vlrlist.VLRList([text])
    cloud.write(path)
    return path


def position(crs: str, lon_lat_deg: tuple[float, float]) -> list[float]:
    return list(Transformer.from_crs("OGC:CRS84", parse_crs(crs, "a.las"), always_xy=True).transform(*lon_lat_deg))


@pytest.mark.parametrize(
    ("keys", "same", "lon_lat_deg"),
    [
        (UTM_15, "EPSG:32615", (-93.35, 41.57)),
        ({1024: 1, 3072: 26995, 3076: 9003}, "EPSG:2255", (-91.1458, 32.9896)),
        (OREGON_KEYS, OREGON_FEET, (-123.065, 44.055)),
        ({1024: 1, 2048: 32767, 2056: 7019, 3072: 32767, 3074: 16015}, "EPSG:26915", (-93.35, 41.57)),
        ({1024: 1, 2048: 4326, 3072: 32767, 3075: 1, 3076: 32767, 3077: 0.5, 3080: 9.0, 3081: 0.0, 3092: 0.9996,
          3082: 1e6, 3083: 0.0}, "+proj=utm +zone=32 +datum=WGS84 +to_meter=0.5", (9.3, 48.5)),
        ({1024: 1, 2048: 4326, 3072: 32767, 3075: 15, 3081: 90.0, 3095: -45.0, 3092: 0.994, 3082: 2e6, 3083: 2e6},
         "+proj=stere +lat_0=90 +lon_0=-45 +k_0=0.994 +x_0=2000000 +y_0=2000000 +datum=WGS84", (10.0, 75.0)),
        ({1024: 1, 2048: 32767, 2050: 6269, 3072: 32767, 3075: 11, 3078: 29.5, 3079: 45.5, 3080: -96.0, 3081: 23.0},
         "+proj=aea +lat_0=23 +lon_0=-96 +lat_1=29.5 +lat_2=45.5 +datum=NAD83", (-93.35, 35.0)),
        ({1024: 2, 2048: 4326}, "OGC:CRS84", (8.0, 50.0)),
        ({1024: 1, 3072: 7415}, "EPSG:28992", (5.4, 52.2)),
        ({1024: 2, 2048: 32767, 2057: 6378137.0, 2059: 298.257222101, 2054: 9102}, "OGC:CRS84", (8.0, 50.0)),
    ],
)  # fmt: skip
def test_keys_place_points_as_the_same_system_of_proj(
    keys: dict[int, Any], same: str, lon_lat_deg: tuple[float, float]
) -> None:
    crs = GeoKeys.from_records(key_records(keys)).to_crs()
    assert crs is not None
    np.testing.assert_allclose(position(crs, lon_lat_deg), position(same, lon_lat_deg), rtol=0, atol=0.001)


@pytest.mark.parametrize(
    ("keys", "metres", "source"),
    [
        (UTM_15, 1.0, "the unit of x and y: the file declares no vertical system"),
        (UTM_15 | {4096: 6360, 4099: 9003}, SURVEY_FOOT_M, "NAVD88 height (ftUS)"),
        (UTM_15 | {4096: 5703, 4099: 9003}, SURVEY_FOOT_M, "NAVD88 height (US survey foot)"),
        (UTM_15 | {4096: 5103}, 1.0, "NAVD88 height"),
        (UTM_15 | {4099: 9002}, 0.3048, "heights of the GeoTIFF keys"),
        (UTM_15 | {4096: 32767, 4097: "Town datum", 4099: 9002}, 0.3048, "Town datum"),
        (UTM_15 | {4096: 4979}, 1.0, "heights of the GeoTIFF keys"),
        ({1024: 1, 3072: 7415}, 1.0, "NAP height"),
        (UTM_15 | {4096: 5030, 4099: 9001}, 1.0, "heights of the GeoTIFF keys"),
        ({1024: 1, 3072: 2255}, SURVEY_FOOT_M, "the unit of x and y: the file declares no vertical system"),
        ({1024: 1, 3072: 2255, 4096: 5703, 4099: 9001}, 1.0, "NAVD88 height"),
        ({1024: 2, 2048: 4326}, 1.0, "assumed: the file declares no vertical system"),
        ({1024: 2, 2048: 4326, 4096: 5773, 4099: 9002}, 0.3048, "EGM96 height (foot)"),
        ({1024: 1, 2048: 32767, 3072: 32767, 3076: 9002}, 0.3048,
         "the unit of x and y: the file declares no vertical system"),
    ],
)  # fmt: skip
def test_unit_of_heights_and_what_states_it(keys: dict[int, Any], metres: float, source: str) -> None:
    crs = GeoKeys.from_records(key_records(keys)).to_crs()
    unit = height_unit(crs, "a.las")
    assert unit.metres == pytest.approx(metres, rel=1e-12)
    assert unit.source == source


def test_unknown_keys_name_no_system() -> None:
    assert GeoKeys.from_records({}).to_crs() is None
    for keys in ({1024: 1, 2048: 32767, 3072: 32767}, {1024: 1, 2048: 4269}):  # a projection without its parameters
        assert GeoKeys.from_records(key_records(keys)).to_crs() is None


@pytest.mark.parametrize(
    ("records", "message"),
    [
        (key_records({1024: 1, 3072: 5}), "name EPSG:5, which PROJ does not know"),
        (key_records({1024: 1, 2048: 4326, 3072: 32767, 3075: 4}), "the projection method 4 .* is unknown"),
        (key_records({1024: 1, 3072: 32767, 3075: 1}), "neither a datum nor an ellipsoid"),
        (key_records(UTM_15 | {4096: 4326}), "name EPSG:4326 as a VerticalCRS, but it has no heights"),
        (key_records(UTM_15 | {3076: 77}), "the unit 77 .* is unknown"),
        ({34735: struct.pack("<4H", 1, 1, 0, 900)}, "declares 900 keys in 8 bytes"),
        ({34735: struct.pack("<8H", 1, 1, 0, 1, 3080, 34736, 1, 4)}, "key 3080 points beyond its record"),
        (key_records(OREGON_KEYS | {3078: float("nan")}), "key 3078 is not a finite number"),
    ],
)
def test_keys_that_cannot_be_used(records: dict[int, bytes], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GeoKeys.from_records(records).to_crs()


def test_las_with_wkt_before_or_behind_the_points(tmp_path: Path) -> None:
    for behind in (False, True):
        crs = point_cloud_crs(write_las(tmp_path / "a.las", wkt=WKT_UTM_FEET, wkt_is_behind=behind), "")
        assert crs == WKT_UTM_FEET
        assert height_unit(crs, "").metres == pytest.approx(SURVEY_FOOT_M)


@pytest.mark.parametrize("start", [2**62, 2**64 - 1])
def test_records_far_behind_the_file_are_none(tmp_path: Path, start: int) -> None:
    """Some file systems reject such a position."""
    path = write_las(tmp_path / "a.las", keys=UTM_15, wkt=WKT_UTM_FEET, wkt_is_behind=True)
    data = bytearray(path.read_bytes())
    data[235:243] = start.to_bytes(8, "little")
    path.write_bytes(data)
    crs = point_cloud_crs(path, "")
    assert crs is not None and height_unit(crs, "").metres == 1.0


def test_flag_of_the_header_says_which_record_counts(tmp_path: Path) -> None:
    both: dict[str, Any] = {"keys": UTM_15, "wkt": WKT_UTM_FEET}
    assert point_cloud_crs(write_las(tmp_path / "a.las", **both, wkt_flag=True), "") == WKT_UTM_FEET
    by_keys = point_cloud_crs(write_las(tmp_path / "b.las", **both), "")
    assert height_unit(by_keys, "").metres == 1.0
    empty = point_cloud_crs(write_las(tmp_path / "c.las", keys=UTM_15, wkt='""', wkt_flag=True), "")
    assert empty == by_keys


@pytest.mark.slow
def test_other_record_of_a_reference_system(tmp_path: Path) -> None:
    both: dict[str, Any] = {"keys": UTM_15, "wkt": WKT_UTM_FEET}
    other = other_point_cloud_crs(write_las(tmp_path / "a.las", **both, wkt_flag=True), "")
    assert other is not None and height_unit(other, "").metres == 1.0
    assert other_point_cloud_crs(write_las(tmp_path / "b.las", **both), "") == WKT_UTM_FEET
    assert other_point_cloud_crs(write_las(tmp_path / "c.las", keys=UTM_15), "") is None
    assert other_point_cloud_crs(write_las(tmp_path / "d.las", keys=UTM_15, wkt="Local"), "") is None


@pytest.mark.slow
def test_texts_that_are_no_reference_system(tmp_path: Path) -> None:
    assert point_cloud_crs(write_las(tmp_path / "quotes.las", wkt='""'), "") is None
    with pytest.raises(InputError, match=r"local\.las: unknown coordinate reference system 'Local'"):
        point_cloud_crs(write_las(tmp_path / "local.las", wkt="Local"), "")
    with pytest.raises(InputError, match=r"keys\.las: its GeoTIFF keys name EPSG:5, .*pdal translate"):
        point_cloud_crs(write_las(tmp_path / "keys.las", keys={1024: 1, 3072: 5}), "")


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".las", pytest.param(".laz", marks=pytest.mark.system)])
def test_noise_and_withheld_points_are_missing_returns(tmp_path: Path, suffix: str) -> None:
    """One point each: unclassified, ground, low noise, water, high noise, withheld, synthetic, overlap."""
    flags = np.arange(8)
    path = write_las(
        tmp_path / f"a{suffix}",
        points=np.column_stack([flags, flags, flags]),
        classification=[1, 2, 7, 9, 18, 18, 1, 1],
        withheld=flags == 5,
        synthetic=flags == 6,
        overlap=flags == 7,
    )
    points, dropped = read_points(path, "")
    assert points[:, 0].tolist() == [0, 1, 3, 6, 7]
    assert dropped == 3
    (chunk,) = stream_points(path, "")
    assert chunk.marked == {"noise (class 7)": 1, "noise (class 18)": 1, "withheld": 1}
    assert np.isnan(chunk.points_m[[2, 4, 5]]).all()


def test_flags_of_old_point_formats(tmp_path: Path) -> None:
    """Class and flags share a byte in point formats 0 to 5."""
    path = write_las(
        tmp_path / "a.las", version="1.2", point_format=0, points=np.eye(3), classification=[7, 2, 2],
        withheld=[False, True, False],
    )  # fmt: skip
    (chunk,) = stream_points(path, "")
    assert chunk.marked == {"noise (class 7)": 1, "withheld": 1}
    assert np.isfinite(chunk.points_m).all(axis=1).tolist() == [False, False, True]


@pytest.mark.parametrize("name", ["a.pcd", "a.ply"])
def test_classes_in_a_field_of_other_formats(tmp_path: Path, name: str) -> None:
    rows = "0 0 0 2\n1 1 1 7\n2 2 2 18\n3 3 3 1\n"
    if name == "a.pcd":
        head = "FIELDS x y z classification\nSIZE 4 4 4 1\nTYPE F F F U\nWIDTH 4\nHEIGHT 1\nDATA ascii\n"
    else:
        properties = "".join(f"property float {axis}\n" for axis in ("x", "y", "z", "scalar_Classification"))
        head = f"ply\nformat ascii 1.0\nelement vertex 4\n{properties}end_header\n"
    (tmp_path / name).write_text(head + rows)
    points, dropped = read_points(tmp_path / name, "")
    assert points[:, 0].tolist() == [0, 3]
    assert dropped == 2
    (chunk,) = stream_points(tmp_path / name, "")
    assert chunk.marked == {"noise (class 7)": 1, "noise (class 18)": 1}


def test_zero_bytes_behind_the_points_are_padding(tmp_path: Path) -> None:
    path = write_las(tmp_path / "a.las")
    content = path.read_bytes()
    path.write_bytes(content + bytes(4096))
    assert read_points(path, "")[0].tolist() == [[1, 2, 3], [4, 5, 6]]
    path.write_bytes(content + bytes(4000) + b"\1")
    with pytest.raises(InputError, match="declares 2 points, but there are 4001 bytes after the last one"):
        read_points(path, "")
