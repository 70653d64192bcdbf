"""The world frame on the Earth: points that can be checked by hand, the order of axes, and there and back.

The oracle for UTM is a series and an integral of one's own (no PROJ), on and off the zone's central meridian."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad

from egvs.core.errors import InputError
from egvs.formats import georeference
from egvs.formats.georeference import WorldFrame

A_M, F = 6378137.0, 1 / 298.257223563
UTM32 = WorldFrame("+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs")


def meridian_m(lat_deg: float) -> float:
    """From the equator to a latitude along a meridian of the ellipsoid."""
    e2 = F * (2 - F)
    return quad(lambda t: A_M * (1 - e2) / (1 - e2 * math.sin(t) ** 2) ** 1.5, 0, math.radians(lat_deg), epsabs=1e-9)[0]


def kruger(lon_deg: float, lat_deg: float, central_deg: float) -> tuple[float, float]:
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


def at(frame: WorldFrame, lon_deg: float, lat_deg: float) -> list[float]:
    return frame.from_degrees(np.array([[lon_deg, lat_deg]]))[0].tolist()


def test_the_central_meridian_is_500_km_east_and_its_arc_north() -> None:
    assert at(UTM32, 9.0, 0.0) == pytest.approx([500_000, 0], abs=1e-6)
    assert at(UTM32, 9.0, 51.0) == pytest.approx([500_000, 0.9996 * meridian_m(51.0)], abs=1e-4)


@pytest.mark.parametrize(("lon", "lat"), [(9.7203, 50.8651), (11.42, 48.76), (6.1, 47.3), (11.9, 54.8)])
def test_a_point_off_the_meridian_is_where_a_series_of_ones_own_puts_it(lon: float, lat: float) -> None:
    assert at(UTM32, lon, lat) == pytest.approx(kruger(lon, lat, 9.0), abs=1e-3)


def test_x_is_east_and_y_is_north_whatever_order_a_system_names_its_axes_in() -> None:
    """Gauss-Krueger zone 3 and Japan's plane rectangular zone IX name the northing first."""
    x, y = at(WorldFrame("EPSG:31467"), 9.0, 51.0)
    assert (round(x / 1e5), round(y / 1e5)) == (35, 57)
    origin = at(WorldFrame("EPSG:6677"), 139 + 50 / 60, 36.0)
    assert origin == pytest.approx([0, 0], abs=1e-3)
    east, north = at(WorldFrame("EPSG:6677"), 139 + 51 / 60, 36.0), at(WorldFrame("EPSG:6677"), 139 + 50 / 60, 36.01)
    assert east == pytest.approx([1502.6, 0.1], abs=0.2)
    assert north == pytest.approx([0, 1109.5], abs=0.2)


@pytest.mark.parametrize("declared", ["EPSG:4326", "urn:ogc:def:crs:EPSG::4326", "urn:ogc:def:crs:OGC:1.3:CRS84"])
def test_longitude_comes_first_in_degrees_under_every_name(declared: str) -> None:
    spot = np.array([[9.7203, 50.8651]])
    assert UTM32.from_crs(spot, declared).tolist() == UTM32.from_degrees(spot).tolist()


def test_the_offset_is_added_as_sumo_adds_it() -> None:
    frame = WorldFrame(UTM32.projection, (-500_000.0, -5_600_000.0))
    x, y = at(UTM32, 9.7203, 50.8651)
    assert at(frame, 9.7203, 50.8651) == [x - 500_000, y - 5_600_000]
    assert frame.from_crs(np.array([[x, y]]), UTM32.projection)[0].tolist() == [x - 500_000, y - 5_600_000]


@pytest.mark.parametrize(
    "projection", [UTM32.projection, "EPSG:25832", "EPSG:2056", "EPSG:31467", "EPSG:6677", "EPSG:32756"]
)
def test_there_and_back_is_less_than_a_millimetre(projection: str) -> None:
    frame = WorldFrame(projection, (-1234.5, 678.9))
    near = {"EPSG:2056": (2_600_000.0, 1_200_000.0), "EPSG:31467": (3_500_000.0, 5_650_000.0), "EPSG:6677": (0.0, 0.0)}
    middle = frame.to_degrees(np.array([near.get(projection, (500_000.0, 5_600_000.0))]) + frame.offset_m)
    lon_lat_deg = middle + np.random.default_rng(1).uniform(-0.2, 0.2, (500, 2))
    xy_m = frame.from_degrees(lon_lat_deg)
    again = frame.from_degrees(frame.to_degrees(xy_m))
    assert np.abs(again - xy_m).max() < 1e-5
    metres = (frame.to_degrees(xy_m) - lon_lat_deg) * 111_000
    assert np.abs(metres).max() < 1e-5


def test_a_frame_is_a_map_projection_in_metres() -> None:
    assert WorldFrame.of("EPSG:25832", (1.0, 2.0), "here") == WorldFrame("EPSG:25832", (1.0, 2.0))
    for wrong, found in (("EPSG:4326", "is no map projection"), ("EPSG:2263", "counts in US survey foot"),
                         ("EPSG:1", "is none that is known"), ("!", "is none that is known")):  # fmt: skip
        with pytest.raises(InputError, match=f"^here: .*{found}"):
            WorldFrame.of(wrong, (0.0, 0.0), "here")


def test_of_a_compound_system_the_horizontal_part_counts() -> None:
    assert georeference.parse_crs("EPSG:25832+5783", "here").to_epsg() == 25832


def test_web_mercator_stretches_and_utm_does_not() -> None:
    place = (9.7203, 50.8651)
    x, y = at(WorldFrame("EPSG:3857"), *place)
    assert WorldFrame("EPSG:3857").stretch((x, y)) == pytest.approx(1 / math.cos(math.radians(place[1])), rel=3e-3)
    assert UTM32.stretch((at(UTM32, *place)[0], at(UTM32, *place)[1])) == pytest.approx(0.99963, abs=1e-4)


@pytest.mark.parametrize(("lon", "lat", "code"), [(9.7, 50.9, 32632), (139.7, 35.7, 32654), (151.2, -33.9, 32756),
                                                  (-180.0, 10.0, 32601), (180.0, 10.0, 32660)])  # fmt: skip
def test_the_utm_zone_of_a_place(lon: float, lat: float, code: int) -> None:
    assert georeference.utm_epsg(lon, lat) == code


@pytest.mark.parametrize("turned", ["EPSG:2053", "+proj=tmerc +lon_0=9 +axis=wsu +ellps=WGS84 +units=m +no_defs"])
def test_a_system_that_counts_to_the_west_and_south_would_turn_the_world_round(turned: str) -> None:
    with pytest.raises(
        InputError, match=r"s: crs: .* counts to the west and south: .*; a system that counts to the east"
    ):
        WorldFrame.of(turned, (0.0, 0.0), "s: crs")


@pytest.mark.parametrize(
    ("system", "metres"),
    [
        ("EPSG:4326", 1.0), ("EPSG:4979", 1.0), ("EPSG:25832", 1.0), ("EPSG:25832+5783", 1.0),
        ("EPSG:2263", 1200 / 3937), ("EPSG:2263+5703", 1.0),
        ("EPSG:26918+6360", 1200 / 3937), ("EPSG:26918+6358", None),
    ],
)  # fmt: skip
def test_heights_have_the_unit_of_the_vertical_axis_or_of_the_map_projection(system: str, metres: float | None) -> None:
    """A US survey foot is 1200/3937 m; EPSG:6358 counts depths, downwards."""
    found = georeference.height_unit_m(system, "s")
    assert found < 0 if metres is None else found == pytest.approx(metres, rel=1e-9)
