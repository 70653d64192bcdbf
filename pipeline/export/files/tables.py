"""Writes a layer as GeoJSON, GeoParquet or CSV, one file each.

- GeoJSON in degrees is that of RFC 7946. In another system it has the member ``crs`` of GeoJSON 2008, which GDAL, QGIS
  and this program read; of local metres that is null.
- GeoParquet 1.1 (https://geoparquet.org), by geopandas.
- CSV for a spreadsheet: UTF-8 with its mark, positions of points in two columns, of lines and areas as WKT.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from pipeline.core import files
from pipeline.export.layers import Layer
from pipeline.export.reference import Reference


def write_geojson(path: Path, layer: Layer, reference: Reference) -> None:
    """Write a FeatureCollection."""
    import shapely

    shapes = reference.geometries(layer.geometries)
    if reference.is_degrees:
        shapes = shapely.orient_polygons(shapes)  # counter-clockwise, as the RFC asks
    document: dict[str, Any] = {"type": "FeatureCollection", "name": layer.name}
    if reference.is_local:
        document["crs"] = None
    elif not reference.is_degrees:
        document["crs"] = {"type": "name", "properties": {"name": _urn(reference.crs)}}
    document["features"] = [
        {"type": "Feature", "properties": row, "geometry": shapely.geometry.mapping(shape)}
        for row, shape in zip(layer.rows.to_pylist(), shapes, strict=True)
    ]
    path.write_text(files.json_text(document) + "\n", encoding="utf-8")


def _urn(crs: str) -> str:
    """The name of a system in GeoJSON 2008."""
    authority, _, code = crs.partition(":")
    return f"urn:ogc:def:crs:EPSG::{code}" if authority == "EPSG" else crs


def write_geoparquet(path: Path, layer: Layer, reference: Reference) -> None:
    """Write GeoParquet."""
    import geopandas

    shapes = reference.geometries(layer.geometries)
    frame = geopandas.GeoDataFrame(layer.rows.to_pandas(), geometry=list(shapes), crs=reference.crs)
    frame.to_parquet(path, index=False, compression="zstd", schema_version="1.1.0")


def write_csv(path: Path, layer: Layer, reference: Reference) -> None:
    """Write a table with a line of names."""
    import shapely

    shapes = reference.geometries(layer.geometries)
    if layer.is_of_points:
        names: tuple[str, ...] = (
            ("longitude_deg", "latitude_deg") if reference.is_degrees else ("easting_m", "northing_m")
        )
        places: list[tuple[str, ...]] = [tuple(map(repr, pair)) for pair in shapely.get_coordinates(shapes).tolist()]
    else:
        names = ("wkt",)
        places = [(text,) for text in shapely.to_wkt(shapes, rounding_precision=9 if reference.is_degrees else 6)]
    own = [name for name in layer.rows.column_names if name not in names]
    with path.open("w", encoding="utf-8-sig", newline="") as file:
        out = csv.writer(file)
        out.writerow((*own, *names))
        rows = layer.rows.select(own).to_pylist()
        out.writerows((*(_cell(row[name]) for name in own), *place) for row, place in zip(rows, places, strict=True))


def _cell(value: object) -> object:
    """A value as a spreadsheet takes it: a text that it would take for a formula gets an apostrophe in front."""
    if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r"):
        return f"'{value}"
    return value
