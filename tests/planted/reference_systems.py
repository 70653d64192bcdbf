"""Offsets, projections and reference systems that differ."""

from __future__ import annotations

from functools import partial

from pyproj import Transformer

from tests.planted import scenes
from tests.planted.case import Case, Plant, both, file, key, make, text
from tests.planted.heights import poly_scene
from tests.planted.scenes import Scene, street, tracks
from tests.planted.truth import (
    STREET,
    Truth,
)

UTM32 = "+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"
EAST_M, NORTH_M = 458_000.0, 5_428_000.0
MAPPED = f'netOffset="{-EAST_M:.2f},{-NORTH_M:.2f}" projParameter="{UTM32}"'
"""A network from a map: UTM zone 32 without a large part of its numbers."""

_TO_DEGREES = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)


def degrees(x_m: float, y_m: float) -> tuple[float, float]:
    """Longitude and latitude."""
    lon, lat = _TO_DEGREES.transform(x_m + EAST_M, y_m + NORTH_M)
    return float(lon), float(lat)


def swapped_degrees(x_m: float, y_m: float) -> tuple[float, float]:
    """Latitude and longitude."""
    lon, lat = degrees(x_m, y_m)
    return lat, lon


def utm(x_m: float, y_m: float) -> tuple[float, float]:
    """Easting and northing."""
    return x_m + EAST_M, y_m + NORTH_M


ROUNDED = 2e-3
"""Coordinates of 10 digits after the point are 1e-5 m apart: few beams change their voxels."""

MAP = file("net.net.xml", lambda s: scenes.network(s.truth.ground_m, location=MAPPED))
CRS84, EPSG_32632 = "urn:ogc:def:crs:OGC:1.3:CRS84", "urn:ogc:def:crs:EPSG::32632"
GEO_SOLIDS = file("solids.geojson", lambda s: scenes.solids(s.truth.solids, place=degrees, crs=CRS84))
UTM_SOLIDS = file("solids.geojson", lambda s: scenes.solids(s.truth.solids, place=utm, crs=EPSG_32632))
LON_LAT = {"x_m": "longitude", "y_m": "latitude"}
GEO_SITES = file("sites.csv", lambda s: scenes.sites(s.truth.mounts, degrees, LON_LAT))
GEO_FCD = both(file("fcd.csv", lambda s: scenes.fcd_csv(s.truth.frames, place=degrees)), key("traffic.fcd_geo", True))


def xml_traffic(location: str) -> Plant:
    """The finished FCD file as XML with a <location>."""

    def step(scene: Scene) -> None:
        scene.files.pop("fcd.csv", None)
        scene.config["traffic.fcd"] = "fcd.xml"
        scene.files["fcd.xml"] = scenes.fcd_xml(scene.truth.frames, location)

    return step


def location(offset: str = f"{-EAST_M:.2f},{-NORTH_M:.2f}", projection: str = UTM32) -> str:
    """The element of SUMO's files."""
    return f'<location netOffset="{offset}" projParameter="{projection}"/>'


def geo_polygons() -> Scene:
    """A .poly.xml file in degrees, which says so."""
    scene = poly_scene(location(), MAPPED)
    shapes = scenes.polygons(STREET.solids, location=location(), place=degrees)
    scene.files["solids.poly.xml"] = shapes.replace('fill="1"', 'fill="1" geo="1"')
    return scene


REFERENCE_SYSTEMS = (
    Case(
        "polygons in degrees that do not say so",
        geo_polygons,
        text("solids.poly.xml", ' geo="1"', ""),
        "solids.poly.xml",
        "expected metres of the world frame, got longitude and latitude",
        tolerance=ROUNDED,
    ),
    Case(
        "region in degrees",
        make(MAP),
        key("roi.center_m", [*degrees(20.0, 0.0), 2.5]),
        "scenario.toml: roi",
        "no lane passes through the region",
    ),
    Case(
        "netOffset of polygons",
        partial(poly_scene, location("0.00,0.00", "!")),
        file("solids.poly.xml", lambda s: scenes.polygons(s.truth.solids, location=location("30.00,0.00", "!"))),
        "solids.poly.xml",
        "states netOffset 30,0",
    ),
    Case(
        "polygons of another zone",
        partial(poly_scene, location(), MAPPED),
        text("solids.poly.xml", "+zone=32", "+zone=33"),
        "solids.poly.xml",
        "439 km from the region of interest, read as metres of its own <location>",
    ),
    Case(
        "netOffset of FCD",
        make(xml_traffic(location("0.00,0.00", "!"))),
        text("fcd.xml", '"0.00,0.00"', '"0.00,-12.00"'),
        "fcd.xml",
        "states netOffset 0,-12",
    ),
    Case(
        "FCD of another zone",
        make(MAP, xml_traffic(location())),
        text("fcd.xml", "+zone=32", "+zone=31"),
        "fcd.xml",
        "+zone=31",
    ),
    Case(
        "EPSG code of another zone",
        make(MAP, key("crs.epsg", 32632), key("crs.offset_m", [-EAST_M, -NORTH_M])),
        key("crs.epsg", 32633),
        "scenario.toml: crs",
        "epsg = 32633 with offset_m",
    ),
    Case(
        "offset of another tile",
        make(MAP, key("crs.epsg", 32632), key("crs.offset_m", [-EAST_M, -NORTH_M])),
        key("crs.offset_m", [-EAST_M, -NORTH_M - 1000.0]),
        "scenario.toml: crs",
        "1,000 m from where the network's <location> puts it",
    ),
    Case(
        "offset with the wrong sign",
        make(MAP, key("crs.epsg", 32632), key("crs.offset_m", [-EAST_M, -NORTH_M])),
        key("crs.offset_m", [EAST_M, NORTH_M]),
        "scenario.toml: crs",
        "epsg = 32632 scales lengths by 1.01",
    ),
    Case(
        "footprints of another zone",
        make(MAP, UTM_SOLIDS),
        text("solids.geojson", "EPSG::32632", "EPSG::32633"),
        "solids.geojson",
        "read as WGS 84 / UTM zone 33N",
        tolerance=ROUNDED,
    ),
    Case(
        "footprints without their system",
        make(MAP, UTM_SOLIDS),
        text("solids.geojson", '"crs": {"type": "name", "properties": {"name": "' + EPSG_32632 + '"}}, ', ""),
        "solids.geojson",
        'no member "crs"',
        tolerance=ROUNDED,
    ),
    Case(
        "footprints in degrees without a network of a map",
        make(MAP, GEO_SOLIDS),
        file("net.net.xml", lambda _: scenes.network()),
        "solids.geojson",
        "the position of the world frame on the Earth is unknown",
        tolerance=ROUNDED,
    ),
    Case(
        "latitude before longitude in footprints",
        make(MAP, GEO_SOLIDS),
        file("solids.geojson", lambda s: scenes.solids(s.truth.solids, place=swapped_degrees, crs=CRS84)),
        "solids.geojson",
        "Read as latitude and longitude, in the wrong order",
        tolerance=ROUNDED,
    ),
    Case(
        "degrees declared as metres of the world",
        make(MAP, GEO_SOLIDS),
        file("solids.geojson", lambda s: scenes.solids(s.truth.solids, place=degrees, crs=None)),
        "solids.geojson",
        "expected metres of the world frame, got longitude and latitude",
        tolerance=ROUNDED,
    ),
    Case(
        "degrees of FCD taken as metres",
        make(MAP, GEO_FCD),
        key("traffic.fcd_geo", None),
        "fcd.csv",
        "expected metres of the world frame, got longitude and latitude",
        tolerance=ROUNDED,
    ),
    Case(
        "metres of FCD taken as degrees",
        make(MAP),
        key("traffic.fcd_geo", True),
        "fcd.csv",
        "Read as metres of the world frame, they would be near it",
    ),
    Case(
        "latitude before longitude in FCD",
        make(MAP, GEO_FCD),
        file("fcd.csv", lambda s: scenes.fcd_csv(s.truth.frames, place=swapped_degrees)),
        "fcd.csv",
        "Read as latitude and longitude, in the wrong order",
        tolerance=ROUNDED,
    ),
    Case(
        "latitude as longitude of sites",
        make(MAP, GEO_SITES),
        file("sites.csv", lambda s: scenes.sites(s.truth.mounts, degrees, {"x_m": "latitude", "y_m": "longitude"})),
        "sites.csv",
        "Read as latitude and longitude, in the wrong order",
        tolerance=ROUNDED,
    ),
    Case(
        "degrees of sites without a network of a map",
        make(MAP, GEO_SITES),
        file("net.net.xml", lambda _: scenes.network()),
        "sites.csv",
        "the position of the world frame on the Earth is unknown",
        tolerance=ROUNDED,
    ),
    Case(
        "degrees of sites in columns of metres",
        make(MAP, GEO_SITES),
        text("sites.csv", "longitude,latitude", "x_m,y_m"),
        "sites.csv",
        "expected metres of the world frame, got longitude and latitude",
        tolerance=ROUNDED,
    ),
    Case(
        "easting and northing of sites in columns of the world frame",
        make(MAP),
        file("sites.csv", lambda s: scenes.sites(s.truth.mounts, utm)),
        "sites.csv",
        "Read as eastings and northings of the network's projection",
    ),
    Case(
        "metres and degrees of sites that differ",
        make(MAP, file("sites.csv", lambda s: both_coordinates(s.truth, 0.0))),
        file("sites.csv", lambda s: both_coordinates(s.truth, 25.0)),
        "sites.csv: line 2 (pole_a)",
        "25.0 m away",
        tolerance=ROUNDED,
    ),
    Case(
        "tracks of another zone",
        lambda: map_tracks("EPSG:32632"),
        key("traffic.track_columns", {**scenes.TRACK_COLUMNS, "crs": "EPSG:32633"}),
        "tracks.csv",
        "read as WGS 84 / UTM zone 33N",
        tolerance=ROUNDED,
        extension="tracks",
    ),
    Case(
        "easting and northing of tracks taken as the world frame",
        lambda: map_tracks("EPSG:32632"),
        key("traffic.track_columns", scenes.TRACK_COLUMNS),
        "tracks.csv",
        "Read as eastings and northings of the network's projection",
        tolerance=ROUNDED,
        extension="tracks",
    ),
    Case(
        "network moved by a lane",
        street,
        file("net.net.xml", lambda _: scenes.network().replace(",1.6,", ",9.6,").replace(",-1.6,", ",6.4,")),
        "traffic.fcd = 'fcd.csv'",
        "+8.0 m north",
    ),
)


def both_coordinates(truth: Truth, off_m: float) -> str:
    """Sites with metres and degrees."""
    rows = scenes.site_rows(truth.mounts)
    for row in rows:
        row["longitude"], row["latitude"] = degrees(row["x_m"] + off_m, row["y_m"])
    return scenes.csv_text(rows)


def map_tracks(crs: str) -> Scene:
    """Tracks in metres of a map projection."""
    scene = tracks(crs=crs)
    MAP(scene)
    scene.files["tracks.csv"] = scenes.csv_text(scenes.track_rows(STREET.frames, utm))
    return scene
