"""Layers of GIS files as GeoJSON documents: GeoPackage, Shapefile, KML and GeoParquet, also KMZ and zipped ones.

GeoPackage, Shapefile and KML are read by GDAL in a process of its own (:mod:`egvs.formats.gdal_layers`, extra ``gis``),
GeoParquet (https://geoparquet.org) by pyarrow in another one (:mod:`egvs.formats.parquet_process`). The result is a
FeatureCollection with the member ``crs``, as GeoJSON files of this program have it. So the same rules apply to all
formats. Coordinates stay in the system of the file, x before y.

KML: the altitude of a point counts only where it is ``relativeToGround`` and there is no field ``z_m``; Google Earth
writes 0 where it is clamped to the ground. The fields of LIBKML that describe how a placemark is drawn are left out.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from egvs.core import limits, plugins
from egvs.core.digests import open_input
from egvs.core.errors import InputError
from egvs.core.numbers import parse_decimal
from egvs.core.reading import COMPLETE_FILE
from egvs.core.wording import list_first
from egvs.formats import archives

if TYPE_CHECKING:
    from egvs.formats import parquet_process

GIS_FORMATS = {
    ".gpkg": "GeoPackage", ".shp": "Shapefile", ".kml": "KML", ".parquet": "GeoParquet", ".geoparquet": "GeoParquet",
}  # fmt: skip
"""Formats by the suffix of their files."""

KML_SUFFIXES = (".kml", ".kmz")
_ARCHIVES = (".kmz", archives.SUFFIX)
_KMZ_FILE = "doc.kml"

_SHAPEFILE_PARTS = (".dbf", ".prj", ".cpg", ".shx", ".DBF", ".PRJ", ".CPG", ".SHX")
_MAX_NAMED_FILES = 10
_EXPORT_HINT = "Export it again, or use GeoJSON or CSV."
_KML_FIELDS = (
    "id", "timestamp", "begin", "end", "altitudeMode", "tessellate", "extrude", "visibility", "drawOrder", "icon",
)  # fmt: skip


def is_gis_file(path: Path) -> bool:
    """Return whether :func:`read_gis_file` reads a file; its suffix decides."""
    return path.suffix.lower() in (*GIS_FORMATS, *_ARCHIVES)


def companion_files(path: Path) -> list[Path]:
    """Return the other files of a Shapefile; none for other formats."""
    if path.suffix.lower() != ".shp":
        return []
    parts = [path.with_suffix(suffix) for suffix in _SHAPEFILE_PARTS]
    return [part for part in parts if part.is_file()]


def read_gis_file(path: Path, geometry: str) -> dict[str, Any]:
    """Read the layer of a file.

    Parameters
    ----------
    path
        The file; :func:`is_gis_file` holds for it.
    geometry
        The kind of geometry that tells the layer from others: ``"Point"`` or ``"Polygon"``.

    Returns
    -------
    dict
        A GeoJSON FeatureCollection with the member ``crs``.

    Raises
    ------
    InputError
        When the file is damaged, has several such layers, or does not declare its coordinate reference system.
    MissingExtraError
        When pyogrio is not installed.
    """
    if path.suffix.lower() in _ARCHIVES:
        with archives.unpack_archives([path], _ARCHIVES) as unpacked:
            return read_gis_file(_layer_in(unpacked.paths[0]), geometry)
    kind = GIS_FORMATS[path.suffix.lower()]
    table, geometry_column, crs = _read_geoparquet(path) if kind == "GeoParquet" else _read_gdal(path, kind, geometry)
    if not crs:
        hint = "Set the coordinate reference system of the layer in a GIS, and save it again."
        if kind == "Shapefile":
            hint = f"Add {path.stem}.prj, which belongs to the Shapefile."
        raise InputError(path, "the file does not declare its coordinate reference system", hint)
    features = [_feature(row, geometry_column, path) for row in table.to_pylist()]
    named_crs = {"type": "name", "properties": {"name": crs}}
    return {"type": "FeatureCollection", "crs": named_crs, "features": features}


def _layer_in(folder: Path) -> Path:
    """Return the only GIS file of an unpacked archive; of a KMZ, the one that its standard names."""
    if not folder.is_dir():
        problem = "expected a ZIP archive, got other content" if folder.is_file() else "expected a file"
        raise InputError(folder, problem, "Check the path and the suffix.")
    inside = sorted(path for path in folder.rglob("*") if path.suffix.lower() in GIS_FORMATS)
    if folder.suffix.lower() == ".kmz":
        inside = [path for path in inside if path == folder / _KMZ_FILE] or inside
    if len(inside) != 1:
        listed = list_first([path.name for path in inside], _MAX_NAMED_FILES) or "none"
        formats = ", ".join(dict.fromkeys(GIS_FORMATS.values()))
        raise InputError(folder, f"expected one file of {formats}, got {listed}", "Make an archive of one of them.")
    return inside[0]


def _read_gdal(path: Path, kind: str, geometry: str) -> tuple[pa.Table, str, str | None]:
    """Return the table of a layer, the name of its geometry column, and its reference system."""
    plugins.require_libraries(f"{path.name}: reading {kind}", "gis", "pyogrio")
    if kind == "Shapefile":
        _check_shapefile_complete(path)

    from egvs.formats.gdal_layers import read_layer

    return read_layer(path, kind, geometry, companion_files(path))


def _check_shapefile_complete(path: Path) -> None:
    """Raise an InputError when a Shapefile has no attributes, or a file is shorter than its header says.

    GDAL would leave out the attributes, or the rest.

    Sources: ESRI Shapefile Technical Description (1998), p. 4 (.shp and .shx: length in 16-bit words, big-endian, at
    byte 24); dBASE III (.dbf: number of records at byte 4, size of the header at byte 8 and of a record at byte 10,
    little-endian).
    """
    parts = (path, *companion_files(path))
    for part in parts:
        suffix = part.suffix.lower()
        if suffix not in (".shp", ".shx", ".dbf"):
            continue
        with open_input(part) as content:
            head = content.read(32)
            size = content.seek(0, io.SEEK_END)
        if len(head) < 32:
            if suffix == ".shp":
                return  # GDAL says what is wrong
            raise InputError(part, f"the file has only {size} bytes", COMPLETE_FILE)
        if suffix == ".dbf":
            records, head_size, record_size = struct.unpack_from("<IHH", head, 4)
            declared = head_size + records * record_size
        else:
            declared = 2 * struct.unpack_from(">I", head, 24)[0]
        if size < declared:
            problem = f"the header declares {declared:,} bytes, but the file contains {size:,}"
            raise InputError(part, problem, COMPLETE_FILE)
    if not any(part.suffix.lower() == ".dbf" for part in parts):
        problem = "its file of attributes, such as names and heights, is missing"
        raise InputError(path, problem, f"Add {path.stem}.dbf, which belongs to the Shapefile.")


def _read_geoparquet(path: Path) -> tuple[pa.Table, str, str | None]:
    """Return the table of a GeoParquet file, the name of its geometry column, and its reference system."""
    from egvs.formats import parquet_process

    doing = "the file cannot be read as GeoParquet"
    with parquet_process.open_parquet(path, doing) as (header, batches):
        name, crs = _geometry_column(path, header, doing)
        table = _bounded_table(path, batches)
    kind = table.schema.field(name).type
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    if not (pa.types.is_binary(kind) or pa.types.is_large_binary(kind)):
        problem = f"expected a geometry column {name!r} encoded as WKB, got values of type {kind}"
        raise InputError(path, problem, "Export it again with the encoding WKB.")
    return table, name, crs


def _geometry_column(path: Path, header: parquet_process.ParquetHeader, doing: str) -> tuple[str, str | None]:
    """Return the geometry column of a GeoParquet file, and its reference system."""
    try:
        geo = json.loads(header.metadata["geo"])
        name = geo["primary_column"]
        column = geo["columns"][name]
        encoding = column["encoding"]
        crs = column.get("crs", "OGC:CRS84")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(path, f"{doing} ({error!r})"[:200], _EXPORT_HINT) from None
    if encoding != "WKB" or name not in header.columns:
        problem = f"expected a geometry column {name!r} encoded as WKB, got {encoding!r}"
        raise InputError(path, problem, "Export it again with the encoding WKB.")
    duplicates = sorted({column for column in header.columns if header.columns.count(column) > 1})
    if duplicates:
        raise InputError(path, f"the column {duplicates[0]!r} occurs twice", "Use each column name once.")
    return name, json.dumps(crs) if isinstance(crs, dict) else crs


def _bounded_table(path: Path, rows: Iterator[pa.RecordBatch]) -> pa.Table:
    """Return the rows of a file that is small enough to be held as features."""
    from egvs.formats import parquet_process
    from egvs.formats.gdal_layers import FEATURE_BYTES

    batches = []
    size = 0
    for batch in rows:
        size += parquet_process.decoded_bytes(batch) + FEATURE_BYTES * batch.num_rows
        limits.DOCUMENT.check_bytes(path, size, f"has more than {limits.DOCUMENT.maximum} MB as GeoJSON")
        batches.append(batch)
    if not batches:
        raise InputError(path, "contains no rows", _EXPORT_HINT)
    return pa.Table.from_batches(batches)


@np.errstate(invalid="ignore")  # coordinates that are not finite are reported with the feature
def _feature(row: Mapping[str, Any], geometry_column: str, path: Path) -> dict[str, Any]:
    """Return a GeoJSON feature of a row."""
    import shapely

    shape = None
    if row[geometry_column] is not None:
        try:
            shape = shapely.from_wkb(row[geometry_column])
        except shapely.errors.ShapelyError as error:
            raise InputError(path, f"a geometry cannot be read ({error})", "Repair it in a GIS.") from None
    properties = {name: _plain_value(value) for name, value in row.items() if name != geometry_column}
    if path.suffix.lower() == ".kml":
        shape = _kml_shape(shape, properties.get("altitudeMode"), f"{path}: {properties.get('Name') or '?'}")
        properties = dict(_kml_properties(properties))
        if shape is not None and properties.get("z_m") not in (None, ""):
            shape = shapely.force_2d(shape)  # z_m counts from z = 0, an altitude from the ground
    if shape is None:
        return {"type": "Feature", "geometry": None, "properties": properties}
    if shape.geom_type.startswith("Multi") and len(shape.geoms) == 1:
        shape = shape.geoms[0]  # a GIS saves points as MultiPoint
    geometry = json.loads(json.dumps(shapely.geometry.mapping(shape)))  # lists, as in a file
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _plain_value(value: Any) -> Any:
    """Return a value that JSON can hold: times as text; binary values are left out."""
    if isinstance(value, date | datetime):
        return value.isoformat()
    return None if isinstance(value, bytes) else value


def _kml_shape(shape: Any, altitude_mode: str | None, where: str) -> Any:
    """Return a geometry without altitudes, unless they are heights above the ground."""
    import shapely

    if shape is None or altitude_mode == "relativeToGround":
        return shape
    if altitude_mode == "absolute":
        hint = "Use the altitude mode relativeToGround, or a field z_m and the mode clampToGround."
        raise InputError(where, "expected an altitude above the ground, got one above sea level", hint)
    return shapely.force_2d(shape)


def _kml_properties(fields: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield name, description and the user's fields; KML has numbers as text."""
    for name, value in fields.items():
        if name in _KML_FIELDS or value is None:
            continue
        if isinstance(value, str) and name.endswith(("_m", "_deg")):
            with suppress(ValueError):  # the reader of the column rejects it, with the row
                value = parse_decimal(value)
        yield "name" if name == "Name" else name, value
