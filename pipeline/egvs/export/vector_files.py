"""GeoPackage, GeoJSON, GeoParquet, KML, CSV.

Writes layers as one GeoPackage, with the styles that QGIS shows them in.

GDAL (pyogrio) writes the layers; the styles are rows of the table ``layer_styles``, where QGIS looks for them. The
bytes depend on no clock.

https://www.geopackage.org/spec120/

Writes layers as one KML document that Google Earth colours: a folder a layer, of blind spots one a site.

KML knows degrees only. Sensors hang at their height above the ground as the scenario has it.

https://docs.ogc.org/is/12-007r2/12-007r2.html

Writes a layer as GeoJSON, GeoParquet or CSV, one file each.

- GeoJSON in degrees is that of RFC 7946. In another system it has the member ``crs`` of GeoJSON 2008, which GDAL, QGIS
  and this program read; of local metres that is null.
- GeoParquet 1.1 (https://geoparquet.org), by geopandas.
- CSV for a spreadsheet: UTF-8 with its mark, positions of points in two columns, of lines and areas as WKT.
"""

from __future__ import annotations

import csv
import re
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pyarrow as pa

from egvs.core import files
from egvs.export.finished_run import ExportCrs
from egvs.export.layers import (
    FOOTPRINTS,
    JUNCTIONS,
    MISSED,
    MISSED_LANES,
    PLAN,
    REGION,
    SITES,
    Layer,
    layer_qml,
    row_colour,
)

_EPOCH = "2000-01-01T00:00:00.000Z"
"""When everything is said to have been written."""

_VERSION = "1.2"
"""Programs that are some years old open this one without a warning; nothing of a later one is used."""

_GEOMETRY, _NUMBER = "geom", "fid"
_KINDS = {FOOTPRINTS: "MultiPolygon", REGION: "Polygon", MISSED_LANES: "LineString"}

_STYLES = f"""
CREATE TABLE layer_styles (
  id INTEGER PRIMARY KEY AUTOINCREMENT, f_table_catalog TEXT, f_table_schema TEXT, f_table_name TEXT,
  f_geometry_column TEXT, styleName TEXT, styleQML TEXT, styleSLD TEXT, useAsDefault BOOLEAN, description TEXT,
  owner TEXT, ui TEXT, update_time DATETIME DEFAULT '{_EPOCH}');
INSERT INTO gpkg_contents (table_name, data_type, identifier, description, last_change)
  VALUES ('layer_styles', 'attributes', 'layer_styles', 'Styles of QGIS', '{_EPOCH}');
"""


def write_geopackage(path: Path, layers: Sequence[Layer], reference: ExportCrs) -> None:
    """Write layers to a file that is not there yet."""
    import pyogrio
    import shapely

    with _fixed_time():
        for number, layer in enumerate(layers):
            shapes = shapely.to_wkb(reference.geometries(layer.geometries))
            table = layer.rows.append_column(_GEOMETRY, pa.array(shapes, pa.binary()))
            pyogrio.write_arrow(
                table, path, layer=layer.name, driver="GPKG", geometry_name=_GEOMETRY,
                geometry_type=_KINDS.get(layer.name, "Point"), crs=reference.crs, append=number > 0,
                dataset_options=None if number else {"VERSION": _VERSION},
                layer_options={"FID": _NUMBER, "GEOMETRY_NAME": _GEOMETRY, "IDENTIFIER": layer.name},
            )  # fmt: skip
    with closing(sqlite3.connect(path)) as database, database:
        database.executescript(_STYLES)
        rows = [(layer.name, _GEOMETRY, layer.name, layer_qml(layer), _EPOCH) for layer in layers]
        database.executemany(
            "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName,"
            " styleQML, styleSLD, useAsDefault, description, owner, update_time)"
            " VALUES ('', '', ?, ?, ?, ?, '', 1, '', '', ?)",
            rows,
        )


@contextmanager
def _fixed_time() -> Iterator[None]:
    """GDAL writes :data:`_EPOCH` for the time."""
    import pyogrio

    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _EPOCH})
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})


_NAMESPACE = "http://www.opengis.net/kml/2.2"
_DOT_ICON = "http://maps.google.com/mapfiles/kml/shapes/placemark_circle.png"
"""Google Earth's own round mark; where it is not to be had, a mark of the program's stands there."""

_INVALID_XML = re.compile("[\x00-\x08\x0b-\x1f\ud800-\udfff\ufffe\uffff]")
"""Signs that XML cannot hold."""
_TITLE_COLUMNS = {
    SITES: "site", PLAN: "site", MISSED: "words", MISSED_LANES: "words", FOOTPRINTS: "name", REGION: "name",
    JUNCTIONS: "junction",
}  # fmt: skip
"""The column that a thing is called by."""
_ALPHA = {FOOTPRINTS: "a0", REGION: "00"}


def write_kml(path: Path, name: str, layers: Sequence[Layer], reference: ExportCrs) -> None:
    """Write a document; ``reference`` is in degrees."""
    root = ET.Element("kml", xmlns=_NAMESPACE)
    document = ET.SubElement(root, "Document")
    ET.SubElement(document, "name").text = _remove_invalid_xml(name)
    used: dict[str, tuple[Layer, str]] = {}
    for layer in layers:
        folder = ET.SubElement(document, "Folder")
        ET.SubElement(folder, "name").text = layer.name
        folders: dict[str, ET.Element] = {}
        for row, shape in zip(layer.rows.to_pylist(), reference.geometries(layer.geometries), strict=True):
            into, site = folder, row["site"] if layer.initial_site else ""
            if layer.initial_site:
                if site not in folders:
                    folders[site] = ET.SubElement(folder, "Folder")
                    ET.SubElement(folders[site], "name").text = _remove_invalid_xml(site)
                into = folders[site]
            paint = row_colour(layer, row.get(layer.colours_by))
            used.setdefault(style := f"{layer.name}-{paint}", (layer, paint))
            _placemark(into, layer, row, shape, style, site == layer.initial_site)
    for number, (style, (layer, paint)) in enumerate(used.items(), start=1):
        document.insert(number, _style(style, layer, paint))
    ET.indent(root)
    path.write_bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _placemark(
    folder: ET.Element, layer: Layer, row: Mapping[str, Any], shape: Any, style: str, is_visible: bool
) -> None:
    mark = ET.SubElement(folder, "Placemark")
    ET.SubElement(mark, "name").text = _remove_invalid_xml(str(row[_TITLE_COLUMNS[layer.name]]))
    ET.SubElement(mark, "visibility").text = str(int(is_visible))
    ET.SubElement(mark, "styleUrl").text = f"#{style}"
    extended = ET.SubElement(mark, "ExtendedData")
    for key, value in row.items():
        if value is not None:
            data = ET.SubElement(extended, "Data", name=_remove_invalid_xml(key))
            ET.SubElement(data, "value").text = _remove_invalid_xml(
                repr(value) if isinstance(value, float) else str(value)
            )
    _geometry(mark, shape, row.get("z_m") if layer.has_points else None)


def _geometry(parent: ET.Element, shape: Any, z_m: float | None) -> None:
    import shapely

    match shape.geom_type:
        case "Point":
            point = ET.SubElement(parent, "Point")
            if z_m is not None:
                ET.SubElement(point, "extrude").text = "1"
                ET.SubElement(point, "altitudeMode").text = "relativeToGround"
            ET.SubElement(point, "coordinates").text = _coordinates(shape, z_m)
        case "LineString":
            line = ET.SubElement(parent, "LineString")
            ET.SubElement(line, "tessellate").text = "1"
            ET.SubElement(line, "coordinates").text = _coordinates(shape)
        case "Polygon":
            polygon = ET.SubElement(parent, "Polygon")
            for ring, where in ((shape.exterior, "outer"), *((hole, "inner") for hole in shape.interiors)):
                border = ET.SubElement(polygon, f"{where}BoundaryIs")
                ET.SubElement(ET.SubElement(border, "LinearRing"), "coordinates").text = _coordinates(ring)
        case _:
            several = ET.SubElement(parent, "MultiGeometry")
            for part in shapely.get_parts(shape):
                _geometry(several, part, z_m)


def _coordinates(shape: Any, z_m: float | None = None) -> str:
    import shapely

    height = "" if z_m is None else f",{z_m!r}"
    return " ".join(f"{x!r},{y!r}{height}" for x, y in shapely.get_coordinates(shape).tolist())


def _style(name: str, layer: Layer, paint: str) -> ET.Element:
    """Colours are written alpha, blue, green, red."""
    code = f"ff{paint[4:]}{paint[2:4]}{paint[:2]}"
    style = ET.Element("Style", id=name)
    icon = ET.SubElement(style, "IconStyle")
    ET.SubElement(icon, "color").text = code
    ET.SubElement(icon, "scale").text = "0.8" if layer.name == MISSED else "1.1"
    ET.SubElement(ET.SubElement(icon, "Icon"), "href").text = _DOT_ICON
    line = ET.SubElement(style, "LineStyle")
    ET.SubElement(line, "color").text = code
    ET.SubElement(line, "width").text = "5" if layer.name == MISSED_LANES else "2"
    ET.SubElement(ET.SubElement(style, "PolyStyle"), "color").text = _ALPHA.get(layer.name, "ff") + code[2:]
    return style


def _remove_invalid_xml(text: str) -> str:
    """A text without signs that XML cannot hold."""
    return _INVALID_XML.sub("", text)


def write_geojson(path: Path, layer: Layer, reference: ExportCrs) -> None:
    """Write a FeatureCollection."""
    import shapely

    shapes = reference.geometries(layer.geometries)
    if reference.is_degrees:
        shapes = shapely.orient_polygons(shapes)  # counter-clockwise, as the RFC asks
    document: dict[str, Any] = {"type": "FeatureCollection", "name": layer.name}
    if reference.is_local:
        document["crs"] = None
    elif not reference.is_degrees:
        document["crs"] = {"type": "name", "properties": {"name": _crs_urn(reference.crs)}}
    document["features"] = [
        {"type": "Feature", "properties": row, "geometry": shapely.geometry.mapping(shape)}
        for row, shape in zip(layer.rows.to_pylist(), shapes, strict=True)
    ]
    path.write_text(files.to_json_text(document) + "\n", encoding="utf-8")


def _crs_urn(crs: str) -> str:
    """The name of a system in GeoJSON 2008."""
    authority, _, code = crs.partition(":")
    return f"urn:ogc:def:crs:EPSG::{code}" if authority == "EPSG" else crs


def write_geoparquet(path: Path, layer: Layer, reference: ExportCrs) -> None:
    """Write GeoParquet."""
    import geopandas

    shapes = reference.geometries(layer.geometries)
    frame = geopandas.GeoDataFrame(layer.rows.to_pandas(), geometry=list(shapes), crs=reference.crs)
    frame.to_parquet(path, index=False, compression="zstd", schema_version="1.1.0")


def write_csv(path: Path, layer: Layer, reference: ExportCrs) -> None:
    """Write a table with a line of names."""
    import shapely

    shapes = reference.geometries(layer.geometries)
    if layer.has_points:
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
        out.writerows(
            (*(_spreadsheet_cell(row[name]) for name in own), *place) for row, place in zip(rows, places, strict=True)
        )


def _spreadsheet_cell(value: object) -> object:
    """A value as a spreadsheet takes it: a text that it would take for a formula gets an apostrophe in front."""
    if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r"):
        return f"'{value}"
    return value
