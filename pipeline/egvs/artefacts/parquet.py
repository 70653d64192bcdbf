r"""All Parquet goes through here: schemas of data_schemas/, metadata, whole files.

Makes Arrow columns of what rows say beyond an artefact's own columns; their types follow from the values.

Truth values, whole numbers, numbers and texts have a type of their own; a column of several kinds is text. All may be
null. A name that the artefact has itself gets ``given_`` in front.

Periods in the metadata of a TPOG: which blocks are whose, and how much each counts in the mix.

With c_q the counts of period q over its T_q frames and w_q its weight, the mix is

.. math:: p(v) = \sum_q w_q c_q(v) / T_q \Big/ \sum_q w_q = \sum_q m_q c_q(v) \Big/ \sum_q m_q T_q

with the smallest whole numbers m_q in the ratio of w_q / T_q: it stays a count of frames, and its entropy exact.
Weights are the decimal numbers that the scenario writes.

The columns of the artefacts, with types and units.

The answer stands once, in ``data_schemas/<artefact>.schema.json`` (Frictionless Table Schema with ``unit`` and
``arrow_type`` beside each field). This module is the only one that reads that folder.

Writes artefacts whole and reads them back; all Parquet goes through here.

Files appear under their names only when they are whole (:mod:`egvs.core.files`). Metadata is one JSON object under
the Parquet key ``egvs``. Nothing in a file depends on the clock, the machine, the number of threads or the path.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from math import inf
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from egvs.core import files, limits, reading
from egvs.core.errors import InputError
from egvs.core.grid import Grid
from egvs.core.package_data import data_folder

ExtraValues = Mapping[str, str | int | float | bool | None]


def extra_columns(rows: Sequence[ExtraValues], taken: Collection[str]) -> dict[str, pa.Array]:
    """One nullable column (n,) a name that any of the ``rows`` (n) has, in order; null where a row has it not."""
    columns: dict[str, pa.Array] = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        free = name
        while free in taken or free in columns:
            free = f"given_{free}"
        columns[free] = _extra_column([row.get(name) for row in rows])
    return columns


def _extra_column(values: list[str | int | float | bool | None]) -> pa.Array:
    kinds = {type(value) for value in values if value is not None}
    if kinds == {bool}:
        return pa.array(values, type=pa.bool_())
    if kinds == {int}:
        return pa.array(values, type=pa.int64())
    if kinds and kinds <= {int, float}:
        return pa.array([None if value is None else float(value) for value in values], type=pa.float64())
    texts = [value if isinstance(value, str | None) else json.dumps(value) for value in values]
    return pa.array(texts, type=pa.string())


def are_valid_periods(value: Any) -> bool:
    """Whether metadata holds one period or more."""
    wanted = {"name": str, "weight": float, "frames": int, "block_frames": int, "memory_frames": float, "times": int}
    return (
        isinstance(value, list)
        and bool(value)
        and all(
            isinstance(row, dict)
            and row.keys() == wanted.keys()
            and all(type(row[key]) is kind for key, kind in wanted.items())
            and all(0 < row[key] < inf for key in wanted if key != "name")
            for row in value
        )
    )


SCHEMA_VERSION = 1
"""Version of all artefact schemas; written into each file's metadata."""


def schema_folder() -> Path:
    """The folder of the Table Schemas, one for each artefact."""
    return data_folder("data_schemas")


@cache
def _table_schema(artefact: str) -> dict[str, Any]:
    """The Table Schema of an artefact."""
    declared: dict[str, Any] = json.loads(
        (schema_folder() / f"{artefact}.schema.json").read_text(encoding="utf-8")
    )
    return declared


def _schema_fields(artefact: str) -> list[dict[str, Any]]:
    """The columns that the Table Schema of an artefact declares."""
    return list(_table_schema(artefact)["fields"])


def column_names(artefact: str) -> tuple[str, ...]:
    """All columns that the schema declares."""
    return tuple(field["name"] for field in _schema_fields(artefact))


def allows_extra_columns(artefact: str) -> bool:
    """Whether an artefact may have columns that its schema does not name ("partial", as Table Schema calls it)."""
    return "partial" in _table_schema(artefact).get("fieldsMatch", ())


@cache
def arrow_schema(artefact: str, optional: tuple[str, ...] = ()) -> pa.Schema:
    """The Arrow schema of an artefact: its needed columns, and those named in ``optional``. None holds nulls."""
    import pyarrow as pa

    fields = [f for f in _schema_fields(artefact) if f["constraints"]["required"] or f["name"] in optional]
    return pa.schema([pa.field(f["name"], pa.type_for_alias(f["arrow_type"]), nullable=False) for f in fields])


def optional_columns(artefact: str) -> tuple[str, ...]:
    """The columns that exist only where an effect calls for them."""
    return tuple(f["name"] for f in _schema_fields(artefact) if not f["constraints"]["required"])


_METADATA_KEY = b"egvs"
_WRITE_OPTIONS = {"compression": "zstd", "compression_level": 3, "version": "2.6", "write_statistics": True}


class ArtefactWriter:
    """Writes one artefact in pieces, each a row group. Made by :func:`artefact_writer`."""

    def __init__(self, file: pq.ParquetWriter, schema: pa.Schema) -> None:
        self._file, self._schema = file, schema

    def write(self, columns: dict[str, Any]) -> None:
        """Append one row group. ``columns`` maps every column's name to an array of equal length."""
        arrays = [pa.array(columns[f.name], type=f.type) for f in self._schema]
        table = pa.Table.from_arrays(arrays, schema=self._schema)
        self._file.write_table(table, row_group_size=max(1, table.num_rows))

    def describe(self, metadata: dict[str, Any]) -> None:
        """Set the artefact's metadata; may be called last, when the rows are known."""
        self._file.add_key_value_metadata({_METADATA_KEY: files.canonical_json(metadata)})


@contextmanager
def artefact_writer(
    path: Path, artefact: str, optional: tuple[str, ...] = (), extra: Mapping[str, pa.Array] | None = None
) -> Iterator[ArtefactWriter]:
    """Open an artefact for writing in pieces; the file appears under its name only when all went well.

    ``optional`` names the columns beyond the needed ones that this file has; ``extra`` are those that the schema does
    not name (:mod:`egvs.artefacts.parquet`), of which the types are taken here.
    """
    schema = arrow_schema(artefact, optional)
    for name, column in (extra or {}).items():
        schema = schema.append(pa.field(name, column.type))
    strings = [f.name for f in schema if f.type == pa.string()]
    with (
        files.atomic_write(path) as partial,
        pq.ParquetWriter(partial, schema, use_dictionary=strings, **_WRITE_OPTIONS) as file,
    ):
        yield ArtefactWriter(file, schema)


def write_artefact(path: Path, artefact: str, columns: dict[str, Any], metadata: dict[str, Any]) -> None:
    """Write one artefact whole, as one row group."""
    with artefact_writer(path, artefact) as out:
        out.write(columns)
        out.describe(metadata)


def read_artefact(path: Path, artefact: str, columns: list[str] | None = None) -> tuple[pa.Table, dict[str, Any]]:
    """Read an artefact: its Arrow table and its metadata.

    Raises
    ------
    InputError
        When the file is missing, corrupt, or does not have the artefact's columns and types.
    """
    with open_artefact(path, artefact) as (file, metadata), _parquet_errors(path):
        return file.read(columns=columns, use_threads=False), metadata


@contextmanager
def open_artefact(path: Path, artefact: str) -> Iterator[tuple[pq.ParquetFile, dict[str, Any]]]:
    """Open an artefact to read its row groups one by one; checks as :func:`read_artefact` does."""
    if not path.is_file():
        raise InputError(path, "no such file", f"run the stage that makes {path.name} first")
    with _parquet_errors(path):
        file = pq.ParquetFile(path)
    with file:
        _check_columns(path, artefact, file.schema_arrow)
        raw = (file.metadata.metadata or {}).get(_METADATA_KEY)
        if raw is None:
            raise InputError(path, "no metadata under the key 'egvs'", f"a {artefact} file written by egvs")
        yield file, _checked_metadata(path, artefact, raw)


def read_row_group(file: pq.ParquetFile, group: int, path: Path, columns: list[str] | None = None) -> pa.Table:
    """Read one row group of an open artefact."""
    with _parquet_errors(path):
        return file.read_row_group(group, columns=columns, use_threads=False)


def read_metadata(path: Path, artefact: str) -> dict[str, Any]:
    """The JSON object under the key ``egvs`` alone."""
    with open_artefact(path, artefact) as (_, metadata):
        return metadata


def _check_columns(path: Path, artefact: str, schema: pa.Schema) -> None:
    needed = arrow_schema(artefact).names
    known = arrow_schema(artefact, optional_columns(artefact))
    for field in known:
        if (index := schema.get_field_index(field.name)) >= 0:
            if schema.field(index).type != field.type:
                raise InputError(path, f"column '{field.name}' is {schema.field(index).type}", f"{field.type}")
        elif field.name in needed:
            raise InputError(path, f"column '{field.name}' is missing", f"the columns {', '.join(needed)}")
    if allows_extra_columns(artefact):
        return
    if extra := sorted(set(schema.names) - set(known.names)):
        raise InputError(path, f"unknown columns {', '.join(extra)}", f"the columns {', '.join(needed)}")


_REQUIRED_METADATA: dict[str, tuple[str, ...]] = {
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

_SITE_KEYS = ("site", "x_m", "y_m", "z_m", "sensor")


def _checked_metadata(path: Path, artefact: str, raw: bytes) -> dict[str, Any]:
    """The checked metadata; InputError naming what is wrong with it."""
    right = "an unaltered file; make it again"
    try:
        metadata = reading.parse_json(raw)
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"its metadata is no JSON ({error})", right) from None
    if not isinstance(metadata, dict):
        raise InputError(path, f"its metadata is {metadata!r}", right)
    if metadata.get("schema") != SCHEMA_VERSION:
        raise InputError(path, f"schema version {metadata.get('schema')}", f"version {SCHEMA_VERSION}")
    promised = _REQUIRED_METADATA.get(artefact, ())
    if artefact == "tpog" and "periods" in metadata:  # each has blocks of its own
        promised = ("grid", "frames", "periods")
    for key in promised:
        if not _is_valid(key, metadata.get(key)):
            raise InputError(path, f"its metadata says {key} = {metadata.get(key)!r}", right)
    return metadata


def _is_valid(key: str, value: Any) -> bool:
    if key == "grid":
        try:
            grid = Grid.from_json(value)
        except (KeyError, TypeError, ValueError, AttributeError):
            return False
        return grid.voxel_m > 0 and min(grid.shape) > 0 and math.prod(grid.shape) <= limits.VOXELS.maximum
    if key == "sites":
        return isinstance(value, list) and all(isinstance(s, dict) and all(k in s for k in _SITE_KEYS) for s in value)
    if key == "periods":
        return are_valid_periods(value)
    if key == "inputs":
        return isinstance(value, str)
    if key == "cells":
        return _is_cell_grid(value)
    if key == "plan":
        return isinstance(value, dict) and all(_is_number(value.get(name)) for name in _PLAN_KEYS)
    if key in ("stages", "own_score", "shown"):
        return isinstance(value, dict)
    if key in ("tolerance", "memory_frames", "points"):
        return isinstance(value, float) and 0 < value < math.inf
    return isinstance(value, int) and not isinstance(value, bool) and value > 0


_PLAN_KEYS = ("candidates", "joint", "together", "value", "bound", "certificate", "cost")
"""Numbers that the metadata of a plan holds."""


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < math.inf


def _is_cell_grid(value: Any) -> bool:
    """Whether squares of a region are described: their corner, edge and number."""
    try:
        (x, y), edge, (nx, ny) = (value[key] for key in ("origin_m", "cell_m", "shape"))
        grid = Grid.from_json({"origin_m": [x, y, 0.0], "voxel_m": edge, "shape": [nx, ny, 1]})
    except (KeyError, TypeError, ValueError):
        return False
    return grid.voxel_m > 0 and min(grid.shape) > 0 and math.prod(grid.shape) <= limits.VOXELS.maximum


@contextmanager
def _parquet_errors(path: Path) -> Iterator[None]:
    """What is read is a whole Parquet file; else InputError."""
    try:
        yield
    except (pa.ArrowInvalid, OSError) as error:
        found = f"cannot be read as Parquet ({str(error).splitlines()[0]})"
        raise InputError(path, found, "a whole file; make it again") from None
