"""Read one layer of a GeoPackage, a Shapefile or a KML file with GDAL, in a process of its own.

The other process (:mod:`egvs.formats.reader_process`) knows the driver of the expected format only. A layer of a
GeoPackage must be a table: a view is a query, which the file would make this program execute.
"""

from __future__ import annotations

import os
import sqlite3
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pyarrow as pa

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.wording import list_first
from egvs.formats import xml
from egvs.formats.gdal_drivers import keep_driver
from egvs.formats.reader_process import Block, read_blocks, serve

_DRIVERS = {"GeoPackage": "GPKG", "Shapefile": "ESRI Shapefile", "KML": "LIBKML"}
_SIGNATURES = {"GeoPackage": b"SQLite format 3\x00", "Shapefile": b"\x00\x00\x27\x0a"}
_KML_ROOT = "kml"
_JOURNALS = ("-wal", "-journal")
FEATURE_BYTES = 100
"""What a feature takes in a GeoJSON file beside its values: layers have the limit of GeoJSON files."""
_MAX_NAMED_LAYERS = 10
_EXPORT_HINT = "Export it again, with the encoding UTF-8, or use GeoJSON or CSV."


def read_layer(path: Path, kind: str, geometry: str, companions: Sequence[Path]) -> tuple[pa.Table, str, str | None]:
    """Return the table of a layer, the name of its geometry column (WKB), and its reference system.

    Parameters
    ----------
    path
        The file.
    kind
        Name of the format, ``"GeoPackage"``, ``"Shapefile"`` or ``"KML"``.
    geometry
        The kind of geometry that tells the layer from others: ``"Point"`` or ``"Polygon"``.
    companions
        Other files of a Shapefile.

    Raises
    ------
    InputError
        When the file is damaged or of another format, or has several such layers.
    """
    if not path.is_file():
        raise InputError(path, "expected a file", f"Save the layer as one {kind} file.")
    limits.checked_size(path, limits.FILE)
    _check_signature(path, kind)
    _check_saved(path, kind)
    doing = f"the file cannot be read as {kind}"
    layers = list(read_blocks(__name__, path, os.fspath(path), doing, [kind, geometry], companions))
    if len(layers) != 1:
        raise InputError(path, doing, _EXPORT_HINT)
    layer = layers[0]
    try:
        table = pa.ipc.open_stream(layer.content).read_all()
        table.validate(full=True)
    except pa.ArrowException as error:
        raise InputError(path, f"{doing} ({error})", _EXPORT_HINT) from None
    return table, layer.values["geometry"], layer.values["crs"]


def _check_signature(path: Path, kind: str) -> None:
    """Raise an InputError when the content of a file is not that of its format."""
    signature = _SIGNATURES.get(kind)
    if signature is None:
        tag = xml.read_root_tag(path).rpartition("}")[2]
        is_expected = tag == _KML_ROOT
        actual = f"its root is <{tag}>"
    else:
        with path.open("rb") as file:
            start = file.read(len(signature))
        is_expected = start == signature
        actual = f"it begins with {start[:8]!r}"
    if not is_expected:
        raise InputError(path, f"the file cannot be read as {kind} ({actual})", _EXPORT_HINT)


def _check_saved(path: Path, kind: str) -> None:
    """Raise an InputError when a GeoPackage has changes that are in a journal beside it only."""
    if kind != "GeoPackage":
        return
    for suffix in _JOURNALS:
        journal = path.with_name(path.name + suffix)
        if journal.is_file() and journal.stat().st_size:
            hint = "Close the file in all programs, so that they save it."
            raise InputError(path, f"has changes that are only in {journal.name}", hint)


# --- in the other process ---


def _keep_one_driver() -> None:
    # pyogrio imports these where it can, which takes 2 s; they are not needed here. An entry None lets an import fail:
    # https://docs.python.org/3/reference/import.html#the-module-cache
    for name in ("geopandas", "pandas", "shapely"):
        sys.modules[name] = None  # type: ignore[assignment]
    import pyogrio

    keep_driver(_DRIVERS[sys.argv[2]], pyogrio.list_drivers())


def _read_file(path: Path) -> Iterator[Block]:
    import pyogrio

    kind, geometry = sys.argv[2:]
    layers = _geopackage_tables(path) if kind == "GeoPackage" else pyogrio.list_layers(path).tolist()
    layer = _choose_layer(path, layers, geometry)
    metadata, table = pyogrio.read_arrow(path, layer=layer)
    size = table.nbytes + FEATURE_BYTES * table.num_rows
    limits.DOCUMENT.check_bytes(path, size, f"has {size / limits.MB:,.0f} MB as GeoJSON in the layer {layer}")
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as stream:
        stream.write_table(table)
    values = {"geometry": metadata["geometry_name"] or "wkb_geometry", "crs": metadata["crs"]}
    yield Block(values, memoryview(sink.getvalue()).cast("B"))


def _choose_layer(path: Path, layers: list[list[Any]], geometry: str) -> str:
    """Return the only layer with geometries, or the only one with geometries of a kind."""
    names = [name for name, layer_type in layers if layer_type is not None]
    if len(names) > 1:
        fitting = [name for name, layer_type in layers if geometry.lower() in (layer_type or "").lower()]
        names = fitting or names
    if len(names) == 1:
        return str(names[0])
    listed = list_first([str(name) for name in names], _MAX_NAMED_LAYERS) or "none"
    problem = f"expected one layer of {geometry} geometries, got {listed}"
    raise InputError(path, problem, "Save the layer to use in a file of its own.")


def _geopackage_tables(path: Path) -> list[list[Any]]:
    """Return name and type of geometry of each layer that is a plain table, neither a view nor a virtual table.

    GDAL would execute the views to list them. Source: GeoPackage 1.4 (OGC 12-128r19), 2.1.5 gpkg_geometry_columns.
    """
    hint = "Save the layer in a GeoPackage of its own, as a table."
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro&immutable=1", uri=True)) as database:
        is_plain = "type = 'table' AND sql LIKE 'CREATE TABLE%'"
        objects = f"SELECT lower(name), {is_plain} FROM sqlite_master WHERE type IN ('table', 'view')"
        is_table = {str(name): bool(plain) for name, plain in database.execute(objects)}
        for name, plain in sorted(is_table.items()):
            if name.startswith("gpkg_") and not plain:
                raise InputError(path, f"{name} is not a table, but a query", hint)
        listed = "SELECT table_name, geometry_type_name FROM gpkg_geometry_columns"
        layers = [[str(name), str(geometry)] for name, geometry in database.execute(listed)]
    tables = [layer for layer in layers if is_table.get(layer[0].lower())]
    if layers and not tables:
        raise InputError(path, f"the layer {layers[0][0]} is not a table, but a query", hint)
    return tables


if __name__ == "__main__":
    serve(_read_file, _keep_one_driver)
