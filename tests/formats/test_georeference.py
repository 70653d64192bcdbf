"""World frames against formulas that do not use PROJ, and the coordinate systems of files.

The reference for UTM is a series and an integral, on and off the zone's central meridian.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from pyproj import CRS
from scipy.integrate import quad

from egvs.core.errors import InputError
from egvs.core.grid import Roi
from egvs.formats import georeference
from egvs.formats.georeference import (
    WGS84,
    WORLD,
    CoordinateReading,
    Georeference,
    WorldFrame,
    declared_crs,
    geojson_coordinates,
    height_unit,
    parse_crs,
    proj_string,
)

A_M, F = 6378137.0, 1 / 298.257223563
UTM32 = WorldFrame("+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs")


def meridian_arc_m(lat_deg: float) -> float:
    """Length of a meridian of the ellipsoid from the equator to a latitude."""
    e2 = F * (2 - F)
    return quad(lambda t: A_M * (1 - e2) / (1 - e2 * math.sin(t) ** 2) ** 1.5, 0, math.radians(lat_deg), epsabs=1e-9)[0]


def utm_by_krueger_series(lon_deg: float, lat_deg: float, central_deg: float) -> tuple[float, float]:
    """UTM by Krueger's series to the third flattening's third power (better than 1 mm in a zone)."""
    n = F / (2 - F)
    radius = A_M / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    a = (n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16, 13 * n**2 / 48 - 3 * n**3 / 5, 61 * n**3 / 240)
    lam, sin_lat, k = math.radians(lon_deg - central_deg), math.sin(math.radians(lat_deg)), 2 * math.sqrt(n) / (1 + n)
    t = math.sinh(math.atanh(sin_lat) - k * math.atanh(k * sin_lat))
    xi, eta = math.atan2(t, math.cos(lam)), math.atanh(math.sin(lam) / math.hypot(1, t))
    east = eta + sum(c * math.cos(2 * j * xi) * math.sinh(2 * j * eta) for j, c in enumerate(a, 1))
    north = xi + sum(c * math.sin(2 * j * xi) * math.cosh(2 * j * eta) for j, c in enumerate(a, 1))
    return 500_000 + 0.9996 * radius * east, 0.9996 * radius * north


def project(frame: WorldFrame, lon_deg: float, lat_deg: float) -> list[float]:
    return frame.from_lon_lat(np.array([[lon_deg, lat_deg]]))[0].tolist()


def test_central_meridian_has_easting_500_km_and_its_arc_as_northing() -> None:
    assert project(UTM32, 9.0, 0.0) == pytest.approx([500_000, 0], abs=1e-6)
    assert project(UTM32, 9.0, 51.0) == pytest.approx([500_000, 0.9996 * meridian_arc_m(51.0)], abs=1e-4)


@pytest.mark.parametrize(("lon", "lat"), [(9.7203, 50.8651), (11.42, 48.76), (6.1, 47.3), (11.9, 54.8)])
def test_utm_agrees_with_krueger_series_off_the_central_meridian(lon: float, lat: float) -> None:
    assert project(UTM32, lon, lat) == pytest.approx(utm_by_krueger_series(lon, lat, 9.0), abs=1e-3)


def test_x_is_east_and_y_is_north_for_systems_that_name_northing_first() -> None:
    """Gauss-Krueger zone 3 and Japan's plane rectangular zone IX name the northing first."""
    x, y = project(WorldFrame("EPSG:31467"), 9.0, 51.0)
    assert (round(x / 1e5), round(y / 1e5)) == (35, 57)
    origin = project(WorldFrame("EPSG:6677"), 139 + 50 / 60, 36.0)
    assert origin == pytest.approx([0, 0], abs=1e-3)
    east, north = (
        project(WorldFrame("EPSG:6677"), 139 + 51 / 60, 36.0),
        project(WorldFrame("EPSG:6677"), 139 + 50 / 60, 36.01),
    )
    assert east == pytest.approx([1502.6, 0.1], abs=0.2)
    assert north == pytest.approx([0, 1109.5], abs=0.2)


@pytest.mark.parametrize("declared", ["EPSG:4326", "urn:ogc:def:crs:EPSG::4326", "urn:ogc:def:crs:OGC:1.3:CRS84"])
def test_longitude_comes_first_in_degrees_for_every_name_of_wgs84(declared: str) -> None:
    spot = np.array([[9.7203, 50.8651]])
    assert UTM32.from_crs(spot, declared).tolist() == UTM32.from_lon_lat(spot).tolist()


def test_offset_is_added_to_easting_and_northing() -> None:
    frame = WorldFrame(UTM32.projection, (-500_000.0, -5_600_000.0))
    x, y = project(UTM32, 9.7203, 50.8651)
    assert project(frame, 9.7203, 50.8651) == [x - 500_000, y - 5_600_000]
    assert frame.from_crs(np.array([[x, y]]), UTM32.projection)[0].tolist() == [x - 500_000, y - 5_600_000]


@pytest.mark.parametrize(
    "projection", [UTM32.projection, "EPSG:25832", "EPSG:2056", "EPSG:31467", "EPSG:6677", "EPSG:32756"]
)
def test_conversion_to_degrees_and_back_is_exact_to_10_micrometres(projection: str) -> None:
    frame = WorldFrame(projection, (-1234.5, 678.9))
    near = {"EPSG:2056": (2_600_000.0, 1_200_000.0), "EPSG:31467": (3_500_000.0, 5_650_000.0), "EPSG:6677": (0.0, 0.0)}
    middle = frame.to_degrees(np.array([near.get(projection, (500_000.0, 5_600_000.0))]) + frame.offset_m)
    lon_lat_deg = middle + np.random.default_rng(1).uniform(-0.2, 0.2, (500, 2))
    xy_m = frame.from_lon_lat(lon_lat_deg)
    again = frame.from_lon_lat(frame.to_degrees(xy_m))
    assert np.abs(again - xy_m).max() < 1e-5
    metres = (frame.to_degrees(xy_m) - lon_lat_deg) * 111_000
    assert np.abs(metres).max() < 1e-5


def test_rejects_frames_that_are_no_map_projection_in_metres() -> None:
    assert WorldFrame.from_projection("EPSG:25832", (1.0, 2.0), "here") == WorldFrame("EPSG:25832", (1.0, 2.0))
    for wrong, message in (("EPSG:4326", "is not a map projection"), ("EPSG:2263", "has axes in US survey foot"),
                         ("EPSG:1", "unknown coordinate reference system"),
                         ("!", "unknown coordinate reference system")):  # fmt: skip
        with pytest.raises(InputError, match=f"^here: .*{message}"):
            WorldFrame.from_projection(wrong, (0.0, 0.0), "here")


def test_parse_crs_returns_the_horizontal_part_of_a_compound_system() -> None:
    assert georeference.parse_crs("EPSG:25832+5783", "here").to_epsg() == 25832


def test_scale_factor_is_large_for_web_mercator_and_near_1_for_utm() -> None:
    location = (9.7203, 50.8651)
    x, y = project(WorldFrame("EPSG:3857"), *location)
    assert WorldFrame("EPSG:3857").scale_factor((x, y)) == pytest.approx(
        1 / math.cos(math.radians(location[1])), rel=3e-3
    )
    assert UTM32.scale_factor((project(UTM32, *location)[0], project(UTM32, *location)[1])) == pytest.approx(
        0.99963, abs=1e-4
    )


@pytest.mark.parametrize(("lon", "lat", "code"), [(9.7, 50.9, 32632), (139.7, 35.7, 32654), (151.2, -33.9, 32756),
                                                  (-180.0, 10.0, 32601), (180.0, 10.0, 32660)])  # fmt: skip
def test_utm_epsg_of_a_location(lon: float, lat: float, code: int) -> None:
    assert georeference.utm_epsg(lon, lat) == code


@pytest.mark.parametrize("projection", ["EPSG:2053", "+proj=tmerc +lon_0=9 +axis=wsu +ellps=WGS84 +units=m +no_defs"])
def test_rejects_projection_whose_axes_point_west_and_south(projection: str) -> None:
    with pytest.raises(
        InputError, match=r"s: crs: .* has axes in metre to the west and south.* metres to the east and north"
    ):
        WorldFrame.from_projection(projection, (0.0, 0.0), "s: crs")


@pytest.mark.parametrize(
    ("system", "metres"),
    [
        ("EPSG:4326", 1.0), ("EPSG:4979", 1.0), ("EPSG:25832", 1.0), ("EPSG:25832+5783", 1.0),
        ("EPSG:2263", 1200 / 3937), ("EPSG:2263+5703", 1.0),
        ("EPSG:26918+6360", 1200 / 3937), ("EPSG:26918+6358", None),
    ],
)  # fmt: skip
def test_height_unit_is_that_of_the_vertical_axis_else_of_the_projection(system: str, metres: float | None) -> None:
    """A US survey foot is 1200/3937 m; EPSG:6358 counts depths, downwards."""
    unit_m = georeference.height_unit_m(system, "s")
    assert unit_m < 0 if metres is None else unit_m == pytest.approx(metres, rel=1e-9)


FRAME = WorldFrame("EPSG:32632", (-550_000.0, -5_634_000.0))
ROI = Roi((670.0, 1200.0, 0.0), (60.0, 60.0, 5.0))  # at 9.72 E, 50.865 N
LOCATED = Georeference(FRAME, ROI, "s/scenario.toml")
UNLOCATED = Georeference(None, ROI, "s/scenario.toml")
CORNERS = np.array([[700.0, 1230.0], [712.0, 1230.0], [712.0, 1244.0], [700.0, 1230.0]])
DEGREES = FRAME.to_degrees(CORNERS)


def convert(world: Georeference, xy: NDArray[np.float64], declared: str) -> NDArray[np.float64]:
    return world.read_coordinates(xy, "a.geojson", declared).to_world(xy)


def test_metres_of_the_world_frame_are_returned_unchanged() -> None:
    for world in (LOCATED, UNLOCATED):
        assert convert(world, CORNERS, WORLD) is CORNERS


def test_degrees_are_converted_when_declared() -> None:
    assert np.array_equal(convert(LOCATED, DEGREES, WGS84), CORNERS)
    assert np.array_equal(convert(LOCATED, DEGREES, "urn:ogc:def:crs:OGC:1.3:CRS84"), CORNERS)
    assert np.array_equal(convert(LOCATED, DEGREES[:1], WGS84), CORNERS[:1])


def test_small_numbers_are_read_as_declared_where_degrees_and_metres_have_one_size() -> None:
    """Near the origin of the world: 9.7 m east and 50.9 m north of it is in the region of interest."""
    x, y = WorldFrame("EPSG:32632").from_lon_lat(np.array([[9.72, 50.865]]))[0]
    frame = WorldFrame("EPSG:32632", (-round(x) + 20.0, -round(y) + 60.0))
    world = Georeference(frame, Roi((0.0, 0.0, 0.0), (60.0, 100.0, 5.0)), "s")
    metres = np.array([[9.0, 51.0], [9.4, 51.0], [9.4, 51.4]])
    degrees = frame.to_degrees(metres)
    assert convert(world, metres, WORLD) is metres
    assert np.array_equal(convert(world, degrees, WGS84), metres)
    assert np.array_equal(convert(world, degrees[:1], WGS84), metres[:1])
    with pytest.raises(InputError, match=r"53 km .* as WGS 84.*Read as metres .*null for metres"):
        convert(world, metres[:1], WGS84)
    assert convert(world, metres[:1], WORLD).tolist() == metres[:1].tolist()


def test_declared_projection_is_converted() -> None:
    gauss_kruger = WorldFrame("EPSG:31467").from_lon_lat(DEGREES)
    assert convert(LOCATED, gauss_kruger, "urn:ogc:def:crs:EPSG::31467") == pytest.approx(CORNERS, abs=2e-3)
    eastings = CORNERS - np.array(FRAME.offset_m)
    assert convert(LOCATED, eastings, "EPSG:25832") == pytest.approx(CORNERS, abs=5e-4)  # ETRS89 equals WGS 84 here


def test_declared_projection_is_the_world_frame_where_its_position_is_unknown() -> None:
    assert convert(UNLOCATED, CORNERS, "EPSG:25832") is CORNERS


@pytest.mark.parametrize(
    ("world", "xy", "declared", "message"),
    [
        (UNLOCATED, DEGREES, WORLD, r"look like degrees, but the position .* is unknown.*Set epsg \(UTM there: 32632\) "
         r"and offset_m under \[crs\] in s/scenario.toml"),
        (UNLOCATED, DEGREES, "EPSG:4326", r"^a.geojson: the file is in WGS 84, but the position.*32632"),
        (UNLOCATED, np.add(CORNERS / 1e6, 1e6), WORLD, r"are 1,413 km from the region .* as metres .*Set \"crs\""),
        (UNLOCATED, CORNERS, "EPSG:2263", "the file is in NAD83 / New York Long Island .*, but the position"),
        (LOCATED, np.add(DEGREES, (1.8, 0.0)), WGS84, r"are 127 km from the region of interest, read as WGS 84"),
        (LOCATED, np.add(DEGREES, (0.5, 0.0)), WGS84, r"are 35 km from the region of interest, read as WGS 84"),
        (LOCATED, DEGREES[:, ::-1], "EPSG:4326", "Read as latitude and longitude, in the wrong order, they"),
        (LOCATED, CORNERS - np.array(FRAME.offset_m), WORLD,
         r"are 5,661 km from the region of interest, read as metres of the world frame. "
         r'Read as eastings and northings of EPSG:32632, they would be near it. Set "crs" in the file'),
        (LOCATED, CORNERS, "EPSG:25832", "Read as metres of the world frame, they would be near it"),
        (LOCATED, CORNERS + 1e5, WORLD, "are 141 km .* as metres of the world frame"),
        (UNLOCATED, CORNERS + 1e5, WORLD, "are 141 km .* as metres of the world frame"),
        (LOCATED, DEGREES, WORLD, "expected metres .*, got longitude and latitude: .* 0 m from the region of interest"),
        (LOCATED, CORNERS, "EPSG:999999", "unknown coordinate reference system 'EPSG:999999'"),
    ],
)  # fmt: skip
def test_rejects_coordinates_outside_the_declared_system(
    world: Georeference, xy: NDArray[np.float64], declared: str, message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        convert(world, np.asarray(xy), declared)
    assert str(caught.value).startswith("a.geojson: ")


def test_outline_of_a_thin_pole_is_accepted_as_metres() -> None:
    turn = np.linspace(0.0, 2 * np.pi, 65)
    pole = np.add([700.0, 1230.0], 0.05 * np.column_stack([np.cos(turn), np.sin(turn)]))
    assert convert(LOCATED, pole, WORLD) is pole
    assert convert(UNLOCATED, pole, WORLD) is pole


def test_check_metres_rejects_degrees_and_distant_coordinates() -> None:
    LOCATED.check_metres(CORNERS, "sites.csv", "Use metres")
    with pytest.raises(InputError, match=r"expected metres .*, got longitude and latitude.*Use metres"):
        LOCATED.check_metres(DEGREES, "sites.csv", "Use metres")
    with pytest.raises(InputError, match="141 km from the region of interest"):
        UNLOCATED.check_metres(CORNERS + 1e5, "sites.csv", "Use metres")


def test_lon_lat_deg_is_none_where_the_position_of_the_world_frame_is_unknown() -> None:
    lon_lat_deg = LOCATED.lon_lat_deg(CORNERS)
    assert lon_lat_deg is not None
    assert lon_lat_deg[0] == pytest.approx([9.72, 50.865], abs=0.01)
    assert np.array_equal(lon_lat_deg, np.round(DEGREES, 9))
    assert UNLOCATED.lon_lat_deg(CORNERS) is None


def test_geojson_coordinates_returns_all_pairs_in_order() -> None:
    ring = [[1, 2], [3, 4, 9], [5, 6], [1, 2]]
    features = [
        {"geometry": {"type": "Polygon", "coordinates": [ring]}, "properties": {"coordinates": [7, 7]}},
        {"geometry": {"type": "GeometryCollection", "geometries": [{"type": "Point", "coordinates": [8, 9]}]}},
        {"geometry": None}, 5, None, {"geometry": {"type": "Point", "coordinates": ["x", 0]}},
        {"geometry": {"type": "Point", "coordinates": [float("nan"), 0]}},
        {"geometry": {"type": "Point", "coordinates": [10**400, 0]}},
    ]  # fmt: skip
    assert geojson_coordinates(features).tolist() == [[1, 2], [3, 4], [5, 6], [1, 2], [8, 9]]
    assert geojson_coordinates([]).shape == (0, 2)


def test_declared_crs_of_geojson() -> None:
    assert declared_crs({"crs": None}, "here") == WORLD
    named = {"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}}
    assert declared_crs(named, "here") == "urn:ogc:def:crs:EPSG::25832"
    with pytest.raises(InputError, match=r"here: crs: .*'EPSG:25832'.*Set \"crs\".*null"):
        declared_crs({"crs": "EPSG:25832"}, "here")


def test_geojson_without_crs_is_rejected_with_the_key_to_set() -> None:
    with pytest.raises(InputError, match=r'here: .*no member "crs"\. Set "crs" in the file to null for metres .*CRS84'):
        declared_crs({"features": []}, "here")


def test_numbers_look_like_degrees_when_they_would_be_one_point_in_metres() -> None:
    assert georeference.look_like_degrees(DEGREES)
    assert not georeference.look_like_degrees(CORNERS)
    assert not georeference.look_like_degrees(DEGREES[:1])
    assert not georeference.look_like_degrees(np.array([[10.0, 50.0], [10.5, 50.4]]))


def test_other_systems_and_back() -> None:
    """Degrees at the central meridian by the length of the meridian's arc; and the inverse of from_crs."""
    frame = WorldFrame(UTM32.projection, (-500_000.0, -5_000_000.0))
    northing_m = 0.9996 * meridian_arc_m(50.0)
    at_m = np.array([[0.0, northing_m - 5_000_000.0], [1234.5, 567_890.1]])
    assert frame.to_crs(at_m, WGS84)[0] == pytest.approx([9.0, 50.0], abs=1e-9)
    for crs in ("EPSG:25832", "EPSG:31467", "EPSG:3857"):
        assert frame.from_crs(frame.to_crs(at_m, crs), crs) == pytest.approx(at_m, abs=5e-3)


@pytest.mark.parametrize(("crs", "text"), [
    ("EPSG:32632", "+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs"), (UTM32.projection, UTM32.projection),
    ("EPSG:6677", "+proj=tmerc +lat_0=36 +lon_0=139.833333333333"),
])  # fmt: skip
def test_projection_as_a_proj_string(crs: str, text: str) -> None:
    found = georeference.proj_string(crs, "map.xodr")
    assert found.startswith(text)
    at = np.array([[-1000.0, 2000.0]])
    there = WorldFrame(crs).to_degrees(at)
    assert WorldFrame(found).to_degrees(at) == pytest.approx(there, abs=1e-8)


@pytest.mark.slow
def test_unknown_projection_has_no_proj_string() -> None:
    with pytest.raises(InputError, match="unknown coordinate reference system"):
        georeference.proj_string("nowhere", "map.xodr")


GEOID_TAIL = "+geoidgrids=no_such_grid.gtx +vunits=us-ft"
UTM_15 = "+proj=utm +zone=15 +datum=WGS84 +units=m"


@pytest.mark.parametrize(
    "crs",
    [
        f"{UTM_15} {GEOID_TAIL} +no_defs",
        f"+proj=utm +k_0=1 +zone=15 +datum=WGS84 {GEOID_TAIL}",
        CRS(f"{UTM_15} {GEOID_TAIL}").to_wkt(),
        "EPSG:32615+5773",
        "EPSG:32615",
    ],
)
def test_x_and_y_need_no_model_of_the_geoid(crs: str) -> None:
    lon_lat_deg = np.array([[-93.35, 41.57]])
    expected = WorldFrame("EPSG:32615").from_lon_lat(lon_lat_deg)
    frame = WorldFrame.from_projection(crs, (0.0, 0.0), "a.xodr") if crs.startswith("+") else WorldFrame(crs)
    np.testing.assert_allclose(frame.from_lon_lat(lon_lat_deg), expected, atol=1e-6)
    np.testing.assert_allclose(WorldFrame("EPSG:32615").from_crs(expected, crs), expected, atol=1e-6)
    assert "geoid" not in proj_string(crs, "a.xodr")


def test_heights_keep_the_unit_that_the_geoid_string_states() -> None:
    unit = height_unit(f"{UTM_15} {GEOID_TAIL}", "a.osi")
    assert (unit.metres, unit.source) == (pytest.approx(1200 / 3937), "its vertical system")


@pytest.mark.parametrize(
    ("crs", "message"),
    [
        ("+proj=utm +zone=32 +ellps=bessel +nadgrids=no_such_grid.gsb", "the grid no_such_grid.gsb is not installed"),
        ("EPSG:4978", "'WGS 84' is geocentric. Convert the coordinates to a map projection"),
        ("EPSG:5773", "'EGM96 height' is a system of heights"),
        ("IAU_2015:49900", "do not belong to the same celestial body"),
        ("Local", "unknown coordinate reference system 'Local'"),
    ],
)
def test_one_message_where_proj_cannot_convert(crs: str, message: str) -> None:
    with pytest.raises(InputError, match=f"^a.csv: crs: .*{message}"):
        parse_crs(crs, "a.csv: crs")


def test_grid_that_the_datum_makes_needless_is_left_out() -> None:
    """SUMO would reject the string."""
    needless = "+proj=utm +zone=32 +datum=WGS84 +nadgrids=none_such.gsb +units=m"
    assert proj_string(needless, "a") == "+proj=utm +zone=32 +datum=WGS84 +units=m"
    mercator = "+proj=merc +a=6378137 +b=6378137 +units=m +nadgrids=@null"
    assert proj_string(mercator, "a") == mercator


def test_old_form_of_an_epsg_code_is_read_without_a_warning() -> None:
    assert parse_crs("+init=epsg:25832", "a").to_epsg() == 25832


def test_message_about_another_planet_is_complete() -> None:
    with pytest.raises(InputError, match=r"\(Source and target .* celestial body \(Earth vs Moon\)\)\. Use"):
        parse_crs("+proj=longlat +a=1737400 +b=1737400", "a")


def test_a_local_system_in_feet_is_converted_to_metres() -> None:
    local = CRS('LOCAL_CS["site",UNIT["foot",0.3048],AXIS["E",EAST],AXIS["N",NORTH]]').to_wkt()
    roi = Roi((0.0, 0.0, 0.0), (10.0, 10.0, 5.0))
    reading = Georeference(None, roi, "scenario.toml").read_coordinates(np.array([[10.0, 20.0]]), "a.las", local)
    np.testing.assert_allclose(reading.to_world(np.array([[10.0, 20.0]])), [[3.048, 6.096]])


def test_rejects_coordinates_too_large_to_be_rounded() -> None:
    reading = CoordinateReading("metres", lambda xy: xy, "a.shp")
    with pytest.raises(InputError, match=r"a\.shp: \(-2e\+304, 5\) cannot be converted from metres"):
        reading.to_world(np.array([[1.0, 2.0], [-2e304, 5.0]]))
