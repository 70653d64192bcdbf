"""Positions and heights of Lanelet2 maps: projections, local coordinates, anonymised maps, MGRS."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.extensions.maps.formats import lanelet2, lanelet2_projection
from egvs.extensions.maps.formats.lanelet2_projection import (
    ProjectedPoints,
    local_cartesian_frame,
    mgrs_frame,
    read_projector,
)
from egvs.formats.georeference import WorldFrame
from tests.extensions.maps.lanelet2_maps import FRAME, MapWriter

TOKYO = mgrs_frame("54SUE", "test")


def square_map(at_m: tuple[float, float] = (0.0, 0.0), z_m: float = 0.0) -> MapWriter:
    """One lanelet 100 m long."""
    x, y = at_m
    writer = MapWriter()
    left, right = (writer.line([[x, y + side, z_m], [x + 100, y + side, z_m]]) for side in (3, 0))
    writer.lanelet(left, right)
    return writer


def project(path: Path) -> ProjectedPoints:
    return lanelet2_projection.project_points(lanelet2.read_lanelet2(path), path)


def xy_m(points: ProjectedPoints) -> np.ndarray:
    return np.array([points.xyz_m[number][:2] for number in sorted(points.xyz_m)])


def test_real_positions_are_projected_by_utm(tmp_path: Path) -> None:
    points = project(square_map().write(tmp_path / "map.osm"))
    assert points.frame is not None
    assert "+zone=32 " in points.frame.projection
    local_m = xy_m(points)
    assert local_m.min() >= 0
    assert local_m.min(axis=0).max() < 1  # the corner of the map is near the origin
    assert local_m[1, 0] - local_m[0, 0] == pytest.approx(100.0, abs=1e-3)
    lon_lat = points.frame.to_degrees(local_m)
    np.testing.assert_allclose(lon_lat, FRAME.to_degrees(np.array(square_map().points)[:, :2]), atol=1e-9)
    assert not points.has_heights
    assert any("z = 0: 0 of 4 points" in note for note in points.notes)


def test_anonymised_map_is_in_true_metres(tmp_path: Path) -> None:
    path = square_map((30.0, 40.0)).write(tmp_path / "map.osm", frame=local_cartesian_frame(0.0, 0.0))
    points = project(path)
    np.testing.assert_allclose(xy_m(points), np.array([[30, 43], [130, 43], [30, 40], [130, 40]]), atol=1e-3)
    assert "anonymised" in points.notes[0]
    assert points.frame is not None
    np.testing.assert_allclose(points.frame.from_lon_lat(np.zeros((1, 2))), 0, atol=1e-6)


def test_local_coordinates_count(tmp_path: Path) -> None:
    path = square_map((81384.0, 49922.0), 40.0).write(tmp_path / "map.osm", local=True, frame=TOKYO)
    points = project(path)
    np.testing.assert_allclose(xy_m(points)[0], [81384.0, 49925.0])
    assert points.has_heights
    assert points.xyz_m[1][2] == 40.0
    assert points.frame == TOKYO  # found from latitude and longitude alone
    ((lon_deg, lat_deg),) = points.frame.to_degrees(np.array([[81384.0, 49922.0]]))
    assert (round(lat_deg, 5), round(lon_deg, 5)) == (35.68607, 139.68912)  # Nishi-Shinjuku


def test_local_coordinates_without_degrees_have_no_position(tmp_path: Path) -> None:
    path = square_map().write(tmp_path / "map.osm", local=True)
    text = path.read_text(encoding="utf-8")
    path.write_text(re.sub(r'lat="[^"]*" lon="[^"]*"', 'lat="" lon=""', text), encoding="utf-8")
    points = project(path)
    assert points.frame is None
    np.testing.assert_allclose(xy_m(points)[0], [0.0, 3.0])
    assert "unknown" in points.notes[0]


@pytest.mark.parametrize(
    ("square", "corner_m", "lat_lon"),
    [
        ("54SUE", (300_000, 3_900_000), (35.686, 139.689)),
        ("32UMV", (400_000, 5_400_000), (49.003, 8.424)),
        ("33TWN", (500_000, 5_200_000), (47.07, 15.44)),
        ("56HLH", (300_000, 6_200_000), (-33.87, 151.2)),
    ],
)
def test_corner_of_mgrs_square(square: str, corner_m: tuple[int, int], lat_lon: tuple[float, float]) -> None:
    """Known squares of Tokyo, Karlsruhe, Graz and Sydney; a place in each lies within 100 km of its corner."""
    frame = mgrs_frame(square, "test")
    assert frame.offset_m == (-corner_m[0], -corner_m[1])
    local_m = frame.from_lon_lat(np.array([lat_lon[::-1]]))
    assert (local_m >= 0).all()
    assert (local_m < 100_000).all()


@pytest.mark.parametrize("square", ["", "54S", "61SUE", "54SAE", "54IUE", "54SUEX"])
def test_rejects_invalid_square(square: str) -> None:
    with pytest.raises(InputError, match="mgrs_grid"):
        mgrs_frame(square, "f: mgrs_grid")


ORIGIN = "map_origin:\n  latitude: 35.6\n  longitude: 139.7\n  altitude: 3.0 # metres\n"


@pytest.mark.parametrize(
    ("text", "kind", "expected_m"),
    [
        ("projector_type: MGRS\nmgrs_grid: 54SUE\n", "MGRS", None),
        (f"projector_type: LocalCartesian\n{ORIGIN}", "LocalCartesian", (0.0, 0.0)),
        (f"---\nprojector_type: 'LocalCartesianUTM'\n{ORIGIN}", "LocalCartesianUTM", (0.0, 0.0)),
        (f'projector_type: "TransverseMercator"\nscale_factor: 1.0\n{ORIGIN}', "TransverseMercator", (0.0, 0.0)),
        ("# no projection\nprojector_type: Local\n", "Local", None),
    ],
)
def test_reads_projector(tmp_path: Path, text: str, kind: str, expected_m: tuple[float, float] | None) -> None:
    path = tmp_path / "map_projector_info.yaml"
    path.write_text(text, encoding="utf-8")
    projector = read_projector(path)
    assert projector.kind == kind
    if expected_m is not None:
        assert projector.frame is not None
        WorldFrame.from_projection(projector.frame.projection, (0, 0), "test")  # SUMO's <location> can state it
        origin_m = projector.frame.from_lon_lat(np.array([[139.7, 35.6]]))[0]
        np.testing.assert_allclose(origin_m, expected_m, atol=1e-6)
        # 0.001 degrees of latitude are 110.955 m on WGS 84 at 35.6 N; UTM and its like shorten them by up to 0.0004
        north_m = projector.frame.from_lon_lat(np.array([[139.7, 35.601]]))[0]
        assert np.hypot(*north_m) == pytest.approx(110.955, abs=0.05)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("projector_type: Mercator\n", "projector_type: expected one of Local, .*, got 'Mercator'"),
        ("", "projector_type: expected one of"),
        ("projector_type: MGRS\n", "mgrs_grid: expected a 100 km square"),
        ("projector_type: LocalCartesian\n", "map_origin.latitude: expected degrees"),
        (f"projector_type: TransverseMercator\nscale_factor: 0\n{ORIGIN}", "scale_factor: expected a scale near 1"),
        ("projector_type: [MGRS\n", "projector_type"),
        ("projector_type MGRS\n", "line 1: expected KEY: VALUE"),
        ("projector_type: Local\nprojector_type: MGRS\n", "projector_type: occurs twice"),
    ],
)
def test_rejects_invalid_projector(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "map_projector_info.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_projector(path)


def test_uses_projector_file_of_the_map(tmp_path: Path) -> None:
    path = square_map((81384.0, 49922.0)).write(tmp_path / "map.osm", frame=TOKYO)
    (tmp_path / "map_projector_info.yaml").write_text("projector_type: MGRS\nmgrs_grid: 54SUE\n", encoding="utf-8")
    np.testing.assert_allclose(xy_m(project(path))[0], [81384.0, 49925.0], atol=1e-3)
    (tmp_path / "map_projector_info.yaml").write_text("projector_type: Local\n", encoding="utf-8")
    with pytest.raises(InputError, match="the map's nodes have no local_x and local_y"):
        project(path)


def test_autoware_map_needs_heights(tmp_path: Path) -> None:
    path = square_map().write(tmp_path / "map.osm", local=True)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace('<tag k="ele" v="0.0000"/>', "", 1), encoding="utf-8")
    with pytest.raises(InputError, match=r"node 1: has no height \(ele\); 1 of 4 nodes have none"):
        project(path)
    path.write_text(text.replace('<tag k="local_y" v="3.0000"/>', "", 1), encoding="utf-8")
    with pytest.raises(InputError, match="node 1: local_y: expected metres, got None"):
        project(path)


def test_rejects_point_far_from_all_others(tmp_path: Path) -> None:
    path = square_map().write(tmp_path / "map.osm")
    text = re.sub(r'(<node id="2" lat=")[^"]*', r"\g<1>0", path.read_text(encoding="utf-8"))
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"node 2: the point is 5,4\d\d km from the middle of the map"):
        project(path)


def test_rejects_map_on_another_side_of_the_earth_than_its_origin(tmp_path: Path) -> None:
    path = square_map().write(tmp_path / "map.osm")
    origin = "projector_type: LocalCartesian\nmap_origin:\n  latitude: -49\n  longitude: 8.4\n  altitude: 0\n"
    (tmp_path / "map_projector_info.yaml").write_text(origin, encoding="utf-8")
    with pytest.raises(InputError, match="its points are on another side of the Earth than the origin"):
        project(path)
