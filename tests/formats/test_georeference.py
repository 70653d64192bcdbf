"""What a file's coordinates are taken for, and what is refused: degrees, metres, what the file declares, or neither."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from egvs.core.errors import InputError
from egvs.core.grid import Roi
from egvs.formats.georeference import WORLD, Georeference, WorldFrame, declared_crs, geojson_coordinates

FRAME = WorldFrame("EPSG:32632", (-550_000.0, -5_634_000.0))
ROI = Roi((670.0, 1200.0, 0.0), (60.0, 60.0, 5.0))  # at 9.72 E, 50.865 N
HERE = Georeference(FRAME, ROI, "s/scenario.toml")
NOWHERE = Georeference(None, ROI, "s/scenario.toml")
CORNERS = np.array([[700.0, 1230.0], [712.0, 1230.0], [712.0, 1244.0], [700.0, 1230.0]])
DEGREES = FRAME.to_degrees(CORNERS)


def taken(world: Georeference, xy: NDArray[np.float64], declared: str | None = None) -> NDArray[np.float64]:
    return world.read_coordinates(xy, "a.geojson", declared).to_world(xy)


def test_metres_stay_as_they_are_to_the_bit() -> None:
    for world in (HERE, NOWHERE):
        assert taken(world, CORNERS) is CORNERS
        assert taken(world, CORNERS, WORLD) is CORNERS


def test_degrees_are_told_from_metres_by_where_they_land() -> None:
    assert np.array_equal(taken(HERE, DEGREES), CORNERS)
    assert np.array_equal(taken(HERE, DEGREES, "urn:ogc:def:crs:OGC:1.3:CRS84"), CORNERS)
    assert np.array_equal(taken(HERE, DEGREES[:1]), CORNERS[:1])  # a single point too


def test_small_numbers_are_told_apart_in_a_world_whose_zero_is_at_the_region_of_interest() -> None:
    """There, degrees and metres are numbers of one size: 9.7 m east and 50.9 m north of the zero is in the region."""
    x, y = WorldFrame("EPSG:32632").from_degrees(np.array([[9.72, 50.865]]))[0]
    frame = WorldFrame("EPSG:32632", (-round(x) + 20.0, -round(y) + 60.0))
    world = Georeference(frame, Roi((0.0, 0.0, 0.0), (60.0, 100.0, 5.0)), "s")
    metres = np.array([[9.0, 51.0], [9.4, 51.0], [9.4, 51.4]])
    degrees = frame.to_degrees(metres)
    assert taken(world, metres) is metres
    assert np.array_equal(taken(world, degrees), metres)
    assert np.array_equal(taken(world, degrees[:1]), metres[:1])
    with pytest.raises(InputError, match=r"\(53 km\) as degrees; they would lie beside it as metres .*null for metres"):
        taken(world, metres[:1])  # one point, and not far from where its degrees would lie: nobody can tell
    assert taken(world, metres[:1], WORLD) is not None


def test_another_projection_is_honoured_when_it_is_declared() -> None:
    gauss_kruger = WorldFrame("EPSG:31467").from_degrees(DEGREES)
    assert taken(HERE, gauss_kruger, "urn:ogc:def:crs:EPSG::31467") == pytest.approx(CORNERS, abs=2e-3)
    eastings = CORNERS - np.array(FRAME.offset_m)
    assert taken(HERE, eastings, "EPSG:25832") == pytest.approx(CORNERS, abs=5e-4)  # ETRS89 and WGS 84 are one here


def test_a_projection_of_the_world_itself_is_taken_where_nothing_says_what_the_world_is() -> None:
    assert taken(NOWHERE, CORNERS, "EPSG:25832") is CORNERS


@pytest.mark.parametrize(
    ("world", "xy", "declared", "message"),
    [
        (NOWHERE, DEGREES, None, r"look like longitude and latitude, and nothing says where the scenario's world frame "
         r"lies on the Earth; \[crs\] with epsg \(UTM there: 32632\) and offset_m in s/scenario.toml, or a network"),
        (NOWHERE, DEGREES[:1], None, "look like longitude and latitude"),
        (NOWHERE, DEGREES, "EPSG:4326", r"^a.geojson: is in WGS 84, and nothing says.*32632"),
        (NOWHERE, np.add(CORNERS / 1e6, 1e6), WORLD, r"lie far from the region .* \(1,413 km\) as metres .*; \"crs\""),
        (NOWHERE, CORNERS, "EPSG:2263", "is in NAD83 / New York Long Island .*, and nothing says"),
        (HERE, np.add(DEGREES, (1.8, 0.0)), None, r"lie far from the region of interest \(127 km from it as degrees, "),
        (HERE, np.add(DEGREES, (0.5, 0.0)), None, r"lie far from the region of interest \(35 km\) as degrees"),
        (HERE, DEGREES[:, ::-1], None, "they would lie beside it as latitude and longitude, in the wrong order"),
        (HERE, DEGREES[:, ::-1], "EPSG:4326", "they would lie beside it as latitude and longitude, in the wrong order"),
        (HERE, CORNERS - np.array(FRAME.offset_m), None,
         r"lie far from the region of interest \(5,661 km\) as metres of the world frame; "
         "they would lie beside it as eastings and northings of EPSG:32632; \"crs\" in the file"),
        (HERE, CORNERS, "EPSG:25832", "they would lie beside it as metres of the world frame"),
        (HERE, CORNERS + 1e5, WORLD, r"\(141 km\) as metres of the world frame"),
        (NOWHERE, CORNERS + 1e5, None, r"\(141 km\) as metres of the world frame"),
        (HERE, np.add(DEGREES, (361.28, 0.0)), None, r"are no metres .*, and \(371.* is no longitude and latitude"),
        (HERE, [*DEGREES, [371.0, 50.86], *DEGREES], None, r"are no metres .*, and \(371, 50.86\) is no longitude"),
        (HERE, [*DEGREES, [97.2, 50.86], *DEGREES], None, r"are no metres .*, and \(97.2, 50.86\) is no longitude"),
        (NOWHERE, np.add(DEGREES, (361.28, 0.0)), None, r"are no metres .*, and \(371.* is no longitude and latitude"),
        (NOWHERE, DEGREES, WORLD, "look like longitude and latitude, and nothing says where"),
        (HERE, DEGREES, WORLD, "are longitude and latitude: 0 m from the region of interest as such"),
        (HERE, CORNERS, "EPSG:999999", "'EPSG:999999' is none that is known"),
    ],
)  # fmt: skip
def test_what_is_in_neither_is_refused_by_name(
    world: Georeference, xy: NDArray[np.float64], declared: str | None, message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        taken(world, np.asarray(xy), declared)
    assert str(caught.value).startswith("a.geojson: ")


def test_what_is_drawn_in_centimetres_beside_metres_is_taken_as_it_is() -> None:
    """A thin pole, whether its file says metres itself or nothing."""
    turn = np.linspace(0.0, 2 * np.pi, 65)
    pole = np.add([700.0, 1230.0], 0.05 * np.column_stack([np.cos(turn), np.sin(turn)]))
    assert taken(HERE, pole, WORLD) is pole
    assert taken(HERE, pole) is pole


def test_columns_that_say_metres_may_not_hold_degrees() -> None:
    HERE.metres(CORNERS, "sites.csv", "right")
    with pytest.raises(InputError, match="are longitude and latitude: 0 m from the region of interest as such; right"):
        HERE.metres(DEGREES, "sites.csv", "right")
    with pytest.raises(InputError, match=r"lie far from the region of interest \(141 km\)"):
        NOWHERE.metres(CORNERS + 1e5, "sites.csv", "right")


def test_longitude_and_latitude_of_a_place_are_known_where_the_world_is() -> None:
    found = HERE.lon_lat_deg(CORNERS)
    assert found is not None
    assert found[0] == pytest.approx([9.72, 50.865], abs=0.01)
    assert np.array_equal(found, np.round(DEGREES, 9))
    assert NOWHERE.lon_lat_deg(CORNERS) is None


def test_all_coordinates_of_a_file_are_found_in_their_order() -> None:
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


def test_null_says_that_a_file_is_in_the_world_frame() -> None:
    assert declared_crs({"crs": None}, "here") == WORLD
    assert declared_crs({}, "here") is None
    named = {"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}}
    assert declared_crs(named, "here") == "urn:ogc:def:crs:EPSG::25832"
    with pytest.raises(InputError, match=r"here: crs: .*; .*or null"):
        declared_crs({"crs": "EPSG:25832"}, "here")
