"""Which reader opens a map file, by its name, its beginning and its content."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import pytest

from egvs.core import readers
from egvs.creation.map_parts import RoadReader, SolidReader, TerrainReader

PARTS = {"roads": RoadReader, "solids": SolidReader, "terrain": TerrainReader}
CITY_MODEL = b'<?xml version="1.0"?><core:CityModel xmlns:core="x">'
RELIEF = b"<gml:member><dem:ReliefFeature >"
LANELET = b"<osm><way><tag k='type' v='lanelet'/></way></osm>"
LATE_CITYJSON = json.dumps({"CityObjects": {str(n): {} for n in range(2000)}, "type": "CityJSON"}).encode()
PLY = b"ply\nelement vertex 3\n"
LICENCE = (
    b'<?xml version="1.0"?>\n<!-- <osm > <net > <LandXML> ' + b"licence " * 200_000 + b"-->\n<?note <OpenDRIVE> ?>"
)
NAMESPACES = b"".join(b' xmlns:n%d="http://www.example.org/a/long/name"' % n for n in range(200))
DOCTYPE = b'<!DOCTYPE x [<!ENTITY a "]>">]>'

FILES = {
    "CityGML": [("a.gml", CITY_MODEL), ("a.xml", CITY_MODEL.decode().encode("utf-16")),
                ("53392640_bldg_6697_op.gml", CITY_MODEL), ("a.gml", LICENCE + b"<CityModel" + NAMESPACES + b">")],
    "CityGML relief": [("a.gml", CITY_MODEL + RELIEF), ("a.gml", b"<CityModel" + NAMESPACES + b">" + RELIEF),
                       ("a.gml", CITY_MODEL + b"<!--" + b"x" * 9000 + b"--><cityObjectMember>\n <dem:ReliefFeature>"),
                       ("53392640_dem_6697_op.gml", CITY_MODEL)],
    "CityJSON": [("a.city.json", b""), ("a.json", b'{"type" : "CityJSON"}'), ("a.json", LATE_CITYJSON),
                 ("a.txt", LATE_CITYJSON)],
    "building footprints": [("a.geojson", b""), ("a.GPKG", b""), ("a.shp", b""), ("a.parquet", b""),
                            ("a.json", b'{"type": "FeatureCollection"')],
    "LandXML": [("a.xml", b"<LandXML>"), ("a.xml", b'<l:LandXML xmlns:l="x">'), ("a.xml", LICENCE + b"<LandXML>"),
                ("a.xml", (LICENCE + b"<LandXML>").decode().encode("utf-16"))],
    "Lanelet2": [("a.osm", LANELET), ("a.osm.gz", gzip.compress(LANELET))],
    "triangle mesh": [("a.obj", b""), ("a.GLB", b""), ("a.gltf", b""), ("a.stl", b""),
                      ("a.ply", PLY + b"element face 1\n")],
    "OpenDRIVE": [("a.xodr", b""), ("a.XODR.gz", b""), ("a.xml", b'<?xml version="1.0"?>\n<OpenDRIVE>'),
                  ("a.xml", b"\xef\xbb\xbf" + LICENCE + b"<OpenDRIVE>")],
    "OpenStreetMap": [("a.osm", b"<osm></osm>"), ("a.osm.pbf", b""), ("a.xml", b"<osm >"),
                      ("a.xml.gz", gzip.compress(LICENCE + DOCTYPE + b"<osm >"))],
    "point cloud": [("a.pcd", b""), ("a.pcd.gz", b""), ("a.laz", b""), ("a.ply", PLY + b"element face 0\n"),
                    ("a.csv", b"x_m,y_m,z_m,intensity\n1,2,3,4\n")],
    "GeoTIFF or ASCII grid": [("a.tif", b""), ("a.asc.gz", b""), ("a", b"II*\0"), ("a.txt", b"\n NCOLS 2")],
    "SUMO network": [("a.net.xml", b""), ("a.xml", b'<net version="1.20">'), ("a.xml", LICENCE + b"<net >"),
                     ("a.xml", b"<net\n version='1.20'>")],
    "": [("a.jpg", b"\xff\xd8"), ("a.json", b"{}"), ("a.las.gz", b""), ("a.csv", b"x,y\n1,2\n"),
         ("a.xml", b"<osm-files>"), ("a.csv", b"site,x_m,y_m,z_m\n"), ("a.gz", b""), ("a", b""), ("a.ply", b"ply\n"),
         ("a.xml", LICENCE), ("a.xml", b"<!-- " + b"<osm >" * 1000), ("a.xml", b"<"), ("a.xml", b"<?")],
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_finds_the_reader(tmp_path: Path, name: str) -> None:
    for file, content in FILES[name]:
        path = tmp_path / file
        path.write_bytes(content)
        found = readers.find_reader("map", path)
        assert ("" if found is None else found.name) == name, (file, content[:40])
        path.unlink()


def test_modules_have_what_their_readers_give() -> None:
    for reader in readers.list_readers("map"):
        module = readers.load_reader(reader)
        assert reader.gives
        for part in reader.gives:
            assert isinstance(module, PARTS[part]) or (part == "roads" and callable(module.open_roads)), reader
