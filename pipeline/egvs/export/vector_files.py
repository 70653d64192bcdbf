"""Writers of layers: GeoPackage with QGIS styles, KML, GeoJSON, GeoParquet, CSV.

GeoPackage (https://www.geopackage.org/spec120/) is written by GDAL (pyogrio); the styles are rows of its table
``layer_styles``, where QGIS looks for them.

KML (https://docs.ogc.org/is/12-007r2/12-007r2.html) is written here: the KML driver of GDAL in pyogrio writes neither
styles, nor folders, nor heights above the ground. Its coordinates are always degrees.

GeoJSON in degrees is that of RFC 7946. In another reference system it has the member ``crs`` of GeoJSON 2008, which
GDAL, QGIS and this program read; for local metres that is null. GeoParquet 1.1 (https://geoparquet.org) is written by
geopandas. CSV is for spreadsheets: UTF-8 with a byte order mark, positions in two columns, lines and areas as WKT.

The bytes of all files do not depend on the time.
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
"""Time of writing in all files."""

_VERSION = "1.2"
"""A version that older programs open without a warning; no feature of a later one is used."""

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
    """Write layers, with their QGIS styles, to a new file."""
    import pyogrio
    import shapely

    full_disk_errors = (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, pyogrio.errors.FeatureError)
    with _fixed_time(), files.check_disk_space(path.parent, *full_disk_errors):
        dataset_options: dict[str, str] | None = {"VERSION": _VERSION}
        for number, layer in enumerate(layers):
            shapes = shapely.to_wkb(reference.geometries(layer.geometries))
            table = layer.rows.append_column(_GEOMETRY, pa.array(shapes, pa.binary()))
            pyogrio.write_arrow(
                table, path, layer=layer.name, driver="GPKG", geometry_name=_GEOMETRY,
                geometry_type=_KINDS.get(layer.name, "Point"), crs=reference.crs, append=number > 0,
                dataset_options=dataset_options,
                layer_options={"FID": _NUMBER, "GEOMETRY_NAME": _GEOMETRY, "IDENTIFIER": layer.name},
            )  # fmt: skip
            dataset_options = None  # the file exists
    with files.check_disk_space(path.parent, sqlite3.Error), closing(sqlite3.connect(path)) as database, database:
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
    """Make GDAL write :data:`_EPOCH` as the time."""
    import pyogrio

    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _EPOCH})
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})


_NAMESPACE = "http://www.opengis.net/kml/2.2"
_DOT_ICON = "http://maps.google.com/mapfiles/kml/shapes/placemark_circle.png"
"""A round icon of Google Earth; programs that cannot load it use their default icon."""

_INVALID_XML = re.compile("[\x00-\x08\x0b-\x1f\ud800-\udfff\ufffe\uffff]")
"""Characters that XML does not allow."""
_TITLE_COLUMNS = {
    SITES: "site", PLAN: "site", MISSED: "words", MISSED_LANES: "words", FOOTPRINTS: "name", REGION: "name",
    JUNCTIONS: "junction",
}  # fmt: skip
"""The column with the name of a row."""
_ALPHA = {FOOTPRINTS: "a0", REGION: "00"}


def write_kml(
    path: Path, name: str, layers: Sequence[Layer], reference: ExportCrs, credits: Sequence[str] = ()
) -> None:
    """Write a document with one folder per layer, and in it one per site if the layer has rows of each site.

    Points have their height above the ground as altitude, and z of the world frame in the field ``z_m``.

    Parameters
    ----------
    path
        The file.
    name
        Name of the document.
    layers
        The layers.
    reference
        The reference system, in degrees.
    credits
        The makers of the maps.
    """
    root = ET.Element("kml", xmlns=_NAMESPACE)
    document = ET.SubElement(root, "Document")
    ET.SubElement(document, "name").text = _remove_invalid_xml(name)
    if credits:
        ET.SubElement(document, "description").text = f"Map data {_remove_invalid_xml('; '.join(credits))}"
    styles: dict[str, ET.Element] = {}
    for layer in layers:
        layer_folder = _folder(document, layer.name)
        site_folders: dict[str, ET.Element] = {}
        shapes = reference.geometries(layer.geometries)
        for number, (row, shape) in enumerate(zip(layer.rows.to_pylist(), shapes, strict=True)):
            altitude_m = row.get("z_m") if layer.has_points else None
            if altitude_m is not None and layer.ground_m is not None:
                altitude_m = round(altitude_m - float(layer.ground_m[number]), 6)
            folder, is_visible = layer_folder, True
            if layer.initial_site:
                site = row["site"]
                if site not in site_folders:
                    site_folders[site] = _folder(layer_folder, site)
                folder, is_visible = site_folders[site], site == layer.initial_site
            colour = row_colour(layer, row.get(layer.colours_by))
            style = f"{layer.name}-{colour}"
            if style not in styles:
                styles[style] = _style(style, layer, colour)
            _placemark(folder, layer, row, shape, style, is_visible, altitude_m)
    for number, element in enumerate(styles.values(), start=1):
        document.insert(number, element)
    ET.indent(root, space="")  # one element per line; spaces would be a third of the file
    path.write_bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _folder(parent: ET.Element, name: str) -> ET.Element:
    folder = ET.SubElement(parent, "Folder")
    ET.SubElement(folder, "name").text = _remove_invalid_xml(name)
    return folder


def _placemark(
    folder: ET.Element,
    layer: Layer,
    row: Mapping[str, Any],
    shape: Any,
    style: str,
    is_visible: bool,
    altitude_m: float | None,
) -> None:
    mark = ET.SubElement(folder, "Placemark")
    ET.SubElement(mark, "name").text = _remove_invalid_xml(str(row[_TITLE_COLUMNS[layer.name]]))
    ET.SubElement(mark, "visibility").text = str(int(is_visible))
    ET.SubElement(mark, "styleUrl").text = f"#{style}"
    extended = ET.SubElement(mark, "ExtendedData")
    for key, value in row.items():
        if value is not None:
            text = repr(value) if isinstance(value, float) else str(value)
            data = ET.SubElement(extended, "Data", name=_remove_invalid_xml(key))
            ET.SubElement(data, "value").text = _remove_invalid_xml(text)
    _geometry(mark, shape, altitude_m)


def _geometry(parent: ET.Element, shape: Any, altitude_m: float | None) -> None:
    import shapely

    match shape.geom_type:
        case "Point":
            point = ET.SubElement(parent, "Point")
            if altitude_m is not None:
                ET.SubElement(point, "extrude").text = "1"
                ET.SubElement(point, "altitudeMode").text = "relativeToGround"
            ET.SubElement(point, "coordinates").text = _coordinates(shape, altitude_m)
        case "LineString":
            line = ET.SubElement(parent, "LineString")
            ET.SubElement(line, "tessellate").text = "1"
            ET.SubElement(line, "coordinates").text = _coordinates(shape)
        case "Polygon":
            polygon = ET.SubElement(parent, "Polygon")
            _boundary(polygon, "outerBoundaryIs", shape.exterior)
            for hole in shape.interiors:
                _boundary(polygon, "innerBoundaryIs", hole)
        case _:
            multi_geometry = ET.SubElement(parent, "MultiGeometry")
            for part in shapely.get_parts(shape):
                _geometry(multi_geometry, part, altitude_m)


def _boundary(polygon: ET.Element, tag: str, ring: Any) -> None:
    linear_ring = ET.SubElement(ET.SubElement(polygon, tag), "LinearRing")
    ET.SubElement(linear_ring, "coordinates").text = _coordinates(ring)


def _coordinates(shape: Any, altitude_m: float | None = None) -> str:
    import shapely

    height = "" if altitude_m is None else f",{altitude_m!r}"
    return " ".join(f"{x!r},{y!r}{height}" for x, y in shapely.get_coordinates(shape).tolist())


def _style(name: str, layer: Layer, colour: str) -> ET.Element:
    code = f"ff{colour[4:]}{colour[2:4]}{colour[:2]}"  # alpha, blue, green, red
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
    return _INVALID_XML.sub("", text)


def write_geojson(path: Path, layer: Layer, reference: ExportCrs, credits: Sequence[str] = ()) -> None:
    """Write a layer as a FeatureCollection, with whom the licences of the maps require to be named."""
    import shapely

    shapes = reference.geometries(layer.geometries)
    if reference.is_degrees:
        shapes = shapely.orient_polygons(shapes)  # counter-clockwise, as RFC 7946 requires
    document: dict[str, Any] = {"type": "FeatureCollection", "name": layer.name}
    if credits:
        document["attribution"] = "; ".join(credits)
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
    """Name of a reference system in GeoJSON 2008."""
    authority, _, code = crs.partition(":")
    return f"urn:ogc:def:crs:EPSG::{code}" if authority == "EPSG" else crs


def write_geoparquet(path: Path, layer: Layer, reference: ExportCrs) -> None:
    """Write a layer as GeoParquet."""
    import geopandas

    shapes = reference.geometries(layer.geometries)
    frame = geopandas.GeoDataFrame(layer.rows.to_pandas(), geometry=list(shapes), crs=reference.crs)
    frame.to_parquet(path, index=False, compression="zstd", schema_version="1.1.0")


def write_csv(path: Path, layer: Layer, reference: ExportCrs) -> None:
    """Write a layer as a table with column names in the first line."""
    import shapely

    shapes = reference.geometries(layer.geometries)
    positions: list[list[str]]
    if layer.has_points:
        position_names = ["easting_m", "northing_m"]
        if reference.is_degrees:
            position_names = ["longitude_deg", "latitude_deg"]
        positions = [[repr(x), repr(y)] for x, y in shapely.get_coordinates(shapes).tolist()]
    else:
        position_names = ["wkt"]
        digits = 9 if reference.is_degrees else 6
        positions = [[text] for text in shapely.to_wkt(shapes, rounding_precision=digits)]
    names = [name for name in layer.rows.column_names if name not in position_names]
    with path.open("w", encoding="utf-8-sig", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*names, *position_names])
        for row, position in zip(layer.rows.select(names).to_pylist(), positions, strict=True):
            writer.writerow([*(_spreadsheet_cell(row[name]) for name in names), *position])


def _spreadsheet_cell(value: object) -> object:
    """A value for a spreadsheet: text that looks like a formula gets a leading apostrophe."""
    if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r"):
        return f"'{value}"
    return value
