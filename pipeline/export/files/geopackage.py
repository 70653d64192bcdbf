"""Writes layers as one GeoPackage, with the styles that QGIS shows them in.

GDAL (pyogrio) writes the layers; the styles are rows of the table ``layer_styles``, where QGIS looks for them. The
bytes depend on no clock.

https://www.geopackage.org/spec120/
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import pyarrow as pa

from pipeline.export.files.qgis_style import qml
from pipeline.export.layers import FOOTPRINTS, MISSED_LANES, REGION, Layer
from pipeline.export.reference import Reference

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


def write(path: Path, layers: Sequence[Layer], reference: Reference) -> None:
    """Write layers to a file that is not there yet."""
    import pyogrio
    import shapely

    with _without_clock():
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
        rows = [(layer.name, _GEOMETRY, layer.name, qml(layer), _EPOCH) for layer in layers]
        database.executemany(
            "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName,"
            " styleQML, styleSLD, useAsDefault, description, owner, update_time)"
            " VALUES ('', '', ?, ?, ?, ?, '', 1, '', '', ?)",
            rows,
        )


@contextmanager
def _without_clock() -> Iterator[None]:
    """GDAL writes :data:`_EPOCH` for the time."""
    import pyogrio

    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _EPOCH})
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})
