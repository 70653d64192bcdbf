"""Map formats of this extension; see :mod:`egvs.creation.map_readers`."""

from __future__ import annotations

from egvs.core.readers import Reader, with_gzip

_CITYJSON = rb'"type"\s*:\s*"CityJSON"'
_JSON_OBJECT = rb"\A(?:\xef\xbb\xbf)?\s*\{"
_CITY_MODEL = rb"<(?:[\w.-]+:)?CityModel[\s>]"

READERS = (
    Reader(  # before the buildings: its module tells terrain from other city models
        "CityGML relief",
        "map",
        "egvs.extensions.maps.terrain.citygml_relief",
        head=_CITY_MODEL,
        gives=("terrain",),
    ),
    Reader(
        "CityGML",
        "map",
        "egvs.extensions.maps.buildings.citygml",
        head=_CITY_MODEL,
        gives=("solids",),
    ),
    Reader(
        "CityJSON",
        "map",
        "egvs.extensions.maps.buildings.cityjson",
        suffixes=(".city.json",),
        head=_CITYJSON,
        gives=("solids",),
    ),
    Reader(  # members of a JSON object have no order: the type may come last
        "CityJSON",
        "map",
        "egvs.extensions.maps.buildings.cityjson",
        suffixes=(".json",),
        head=_JSON_OBJECT,
        content=_CITYJSON,
        gives=("solids",),
    ),
    Reader(
        "building footprints",
        "map",
        "egvs.extensions.maps.buildings.footprint_maps",
        suffixes=(".geojson", ".gpkg", ".shp", ".kml", ".kmz", ".parquet", ".geoparquet"),
        gives=("solids",),
    ),
    Reader(
        "building footprints",
        "map",
        "egvs.extensions.maps.buildings.footprint_maps",
        suffixes=(".json",),
        head=_JSON_OBJECT,
        content=rb'"FeatureCollection"',
        gives=("solids",),
    ),
    Reader(
        "LandXML",
        "map",
        "egvs.extensions.maps.terrain.landxml",
        head=rb"[<:]LandXML",
        gives=("terrain",),
    ),
    Reader(
        "Lanelet2",
        "map",
        "egvs.extensions.maps.lanelet2.reader",
        head=rb"<osm[\s>]",
        content=rb"""v\s*=\s*["']lanelet["']""",
        gives=("roads",),
    ),
    Reader(
        "triangle mesh",
        "map",
        "egvs.extensions.maps.buildings.mesh_maps",
        suffixes=(".ply", ".obj", ".stl", ".glb", ".gltf", ".off"),
        gives=("solids",),
    ),
    Reader(
        "OpenDRIVE",
        "map",
        "egvs.extensions.maps.opendrive.reader",
        suffixes=with_gzip(".xodr"),
        head=rb"[<:]OpenDRIVE",
        gives=("roads",),
    ),
    Reader(
        "point cloud",
        "map",
        "egvs.extensions.maps.point_clouds.reader",
        suffixes=(*with_gzip(".csv", ".pcd", ".ply"), ".e57", ".las", ".laz"),
        gives=("solids",),
    ),
    Reader(
        "GeoTIFF or ASCII grid",
        "map",
        "egvs.extensions.maps.terrain.rasters",
        suffixes=with_gzip(".tif", ".tiff", ".asc"),
        head=rb"\A(?:II[*+]\0|MM\0[*+]|(?i:\s*ncols))",
        gives=("terrain",),
    ),
)
