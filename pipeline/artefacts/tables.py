"""Writes artefacts whole and reads them back; all Parquet goes through here.

Files appear under their names only when they are whole (:mod:`pipeline.core.files`). Metadata is one JSON object under
the Parquet key ``egvs``. Nothing in a file depends on the clock, the machine, the number of threads or the path.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.artefacts import periods, schemas
from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.core.grid import Grid
from pipeline.core.reading import documents, limits

_KEY = b"egvs"
_WRITE = {"compression": "zstd", "compression_level": 3, "version": "2.6", "write_statistics": True}


class TableWriter:
    """Writes one artefact in pieces, each a row group. Made by :func:`writer`."""

    def __init__(self, file: pq.ParquetWriter, schema: pa.Schema) -> None:
        self._file, self._schema = file, schema

    def write(self, columns: dict[str, Any]) -> None:
        """Append one row group. ``columns`` maps every column's name to an array of equal length."""
        arrays = [pa.array(columns[f.name], type=f.type) for f in self._schema]
        table = pa.Table.from_arrays(arrays, schema=self._schema)
        self._file.write_table(table, row_group_size=max(1, table.num_rows))

    def describe(self, metadata: dict[str, Any]) -> None:
        """Set the artefact's metadata; may be called last, when the rows are known."""
        self._file.add_key_value_metadata({_KEY: files.canonical_json(metadata)})


@contextmanager
def writer(
    path: Path, artefact: str, optional: tuple[str, ...] = (), foreign: Mapping[str, pa.Array] | None = None
) -> Iterator[TableWriter]:
    """Open an artefact for writing in pieces; the file appears under its name only when all went well.

    ``optional`` names the columns beyond the needed ones that this file has; ``foreign`` are those that the schema does
    not name (:mod:`pipeline.artefacts.foreign_columns`), of which the types are taken here.
    """
    schema = schemas.arrow_schema(artefact, optional)
    for name, column in (foreign or {}).items():
        schema = schema.append(pa.field(name, column.type))
    strings = [f.name for f in schema if f.type == pa.string()]
    with files.aside(path) as partial, pq.ParquetWriter(partial, schema, use_dictionary=strings, **_WRITE) as file:
        yield TableWriter(file, schema)


def write(path: Path, artefact: str, columns: dict[str, Any], metadata: dict[str, Any]) -> None:
    """Write one artefact whole, as one row group."""
    with writer(path, artefact) as out:
        out.write(columns)
        out.describe(metadata)


def read(path: Path, artefact: str, columns: list[str] | None = None) -> tuple[pa.Table, dict[str, Any]]:
    """Read an artefact: its Arrow table and its metadata.

    Raises
    ------
    InputError
        When the file is missing, corrupt, or does not have the artefact's columns and types.
    """
    with reader(path, artefact) as (file, metadata), _whole(path):
        return file.read(columns=columns, use_threads=False), metadata


@contextmanager
def reader(path: Path, artefact: str) -> Iterator[tuple[pq.ParquetFile, dict[str, Any]]]:
    """Open an artefact to read its row groups one by one; checks as :func:`read` does."""
    if not path.is_file():
        raise InputError(path, "no such file", f"run the stage that makes {path.name} first")
    with _whole(path):
        file = pq.ParquetFile(path)
    with file:
        _check_columns(path, artefact, file.schema_arrow)
        raw = (file.metadata.metadata or {}).get(_KEY)
        if raw is None:
            raise InputError(path, "no metadata under the key 'egvs'", f"a {artefact} file written by egvs")
        yield file, _metadata(path, artefact, raw)


def read_group(file: pq.ParquetFile, group: int, path: Path, columns: list[str] | None = None) -> pa.Table:
    """Read one row group of an open artefact."""
    with _whole(path):
        return file.read_row_group(group, columns=columns, use_threads=False)


def read_metadata(path: Path, artefact: str) -> dict[str, Any]:
    """The JSON object under the key ``egvs`` alone."""
    with reader(path, artefact) as (_, metadata):
        return metadata


def _check_columns(path: Path, artefact: str, schema: pa.Schema) -> None:
    needed = schemas.arrow_schema(artefact).names
    known = schemas.arrow_schema(artefact, schemas.optional_columns(artefact))
    for field in known:
        if (index := schema.get_field_index(field.name)) >= 0:
            if schema.field(index).type != field.type:
                raise InputError(path, f"column '{field.name}' is {schema.field(index).type}", f"{field.type}")
        elif field.name in needed:
            raise InputError(path, f"column '{field.name}' is missing", f"the columns {', '.join(needed)}")
    if schemas.takes_foreign_columns(artefact):
        return
    if extra := sorted(set(schema.names) - set(known.names)):
        raise InputError(path, f"unknown columns {', '.join(extra)}", f"the columns {', '.join(needed)}")


_PROMISED: dict[str, tuple[str, ...]] = {
    "trajectories": ("frames",),
    "tpog": ("grid", "frames", "block_frames", "memory_frames"),
    "scans": ("sites",),
    "visibility": ("grid", "sites"),
    "blindspots": ("sites", "cells", "points"),
    "accuracy": ("inputs", "tolerance", "stages"),
    "placement": ("inputs", "stages", "plan"),
    "curve": ("inputs", "stages", "plan"),
    "city_plan": ("inputs", "plan"),
    "detection": ("inputs", "frames", "stages"),
    "fused": ("inputs", "frames", "shown"),
    "correlation": ("inputs", "frames", "stages", "own_score", "shown"),
}
"""What the metadata of an artefact must hold for those who read it."""

_SITE = ("site", "x_m", "y_m", "z_m", "sensor")


def _metadata(path: Path, artefact: str, raw: bytes) -> dict[str, Any]:
    """The checked metadata; InputError naming what is wrong with it."""
    right = "an unaltered file; make it again"
    try:
        metadata = documents.json_value(raw)
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"its metadata is no JSON ({error})", right) from None
    if not isinstance(metadata, dict):
        raise InputError(path, f"its metadata is {metadata!r}", right)
    if metadata.get("schema") != schemas.VERSION:
        raise InputError(path, f"schema version {metadata.get('schema')}", f"version {schemas.VERSION}")
    promised = _PROMISED.get(artefact, ())
    if artefact == "tpog" and "periods" in metadata:  # each has blocks of its own
        promised = ("grid", "frames", "periods")
    for key in promised:
        if not _is_sound(key, metadata.get(key)):
            raise InputError(path, f"its metadata says {key} = {metadata.get(key)!r}", right)
    return metadata


def _is_sound(key: str, value: Any) -> bool:
    if key == "grid":
        try:
            grid = Grid.from_json(value)
        except (KeyError, TypeError, ValueError, AttributeError):
            return False
        return grid.voxel_m > 0 and min(grid.shape) > 0 and math.prod(grid.shape) <= limits.VOXELS.most
    if key == "sites":
        return isinstance(value, list) and all(isinstance(s, dict) and all(k in s for k in _SITE) for s in value)
    if key == "periods":
        return periods.are_sound(value)
    if key == "inputs":
        return isinstance(value, str)
    if key == "cells":
        return _are_cells(value)
    if key == "plan":
        return isinstance(value, dict) and all(_is_number(value.get(name)) for name in _OF_PLANS)
    if key in ("stages", "own_score", "shown"):
        return isinstance(value, dict)
    if key in ("tolerance", "memory_frames", "points"):
        return isinstance(value, float) and 0 < value < math.inf
    return isinstance(value, int) and not isinstance(value, bool) and value > 0


_OF_PLANS = ("candidates", "joint", "together", "value", "bound", "certificate", "cost")
"""Numbers that the metadata of a plan holds."""


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < math.inf


def _are_cells(value: Any) -> bool:
    """Whether squares of a region are described: their corner, edge and number."""
    try:
        (x, y), edge, (nx, ny) = (value[key] for key in ("origin_m", "cell_m", "shape"))
        grid = Grid.from_json({"origin_m": [x, y, 0.0], "voxel_m": edge, "shape": [nx, ny, 1]})
    except (KeyError, TypeError, ValueError):
        return False
    return grid.voxel_m > 0 and min(grid.shape) > 0 and math.prod(grid.shape) <= limits.VOXELS.most


@contextmanager
def _whole(path: Path) -> Iterator[None]:
    """What is read is a whole Parquet file; else InputError."""
    try:
        yield
    except (pa.ArrowInvalid, OSError) as error:
        found = f"cannot be read as Parquet ({str(error).splitlines()[0]})"
        raise InputError(path, found, "a whole file; make it again") from None
