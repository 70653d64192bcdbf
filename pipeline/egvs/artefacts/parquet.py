"""All Parquet goes through here: schemas of data_schemas/, metadata, and files that are complete or not there.

Columns, types and units are declared once, in ``data_schemas/<artefact>.schema.json`` (Frictionless Table Schema with
``unit`` and ``arrow_type`` beside each field); no other module reads that folder.

Metadata is one JSON object under the Parquet key ``egvs``. The schema declares the keys that readers need as well:
``metadata`` maps each to its kind, one of those in :func:`_is_valid`. Nothing in a file depends on the clock, the
machine, the number of threads or the path.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from egvs.core import files, limits, reading
from egvs.core.digests import open_input
from egvs.core.errors import InputError
from egvs.core.grid import Grid
from egvs.core.package_data import SCHEMAS, data_folder

_REMAKE_HINT = "Create the file again."


SCHEMA_VERSION = 1
"""Version of all artefact schemas; written into the metadata of each file."""


def schema_folder() -> Path:
    """The folder of the Table Schemas, one for each artefact."""
    return data_folder(SCHEMAS)


@cache
def _table_schema(artefact: str) -> dict[str, Any]:
    schema: dict[str, Any] = json.loads((schema_folder() / f"{artefact}.schema.json").read_text(encoding="utf-8"))
    return schema


def column_names(artefact: str) -> tuple[str, ...]:
    """Return all columns that the schema of an artefact declares."""
    return tuple(column["name"] for column in _table_schema(artefact)["fields"])


@cache
def arrow_schema(artefact: str, optional: tuple[str, ...] = ()) -> pa.Schema:
    """Return the Arrow schema of an artefact: its required columns, and those named in ``optional``; no nulls."""
    columns = []
    for column in _table_schema(artefact)["fields"]:
        if column["constraints"]["required"] or column["name"] in optional:
            columns.append(pa.field(column["name"], pa.type_for_alias(column["arrow_type"]), nullable=False))
    return pa.schema(columns)


def optional_columns(artefact: str) -> tuple[str, ...]:
    """Return the columns that an artefact has only with some settings."""
    columns = _table_schema(artefact)["fields"]
    return tuple(column["name"] for column in columns if not column["constraints"]["required"])


_METADATA_KEY = b"egvs"
_WRITE_OPTIONS = {"compression": "zstd", "compression_level": 3, "version": "2.6", "write_statistics": True}


Follow = Callable[[pa.Table], None]
"""Called with each row group of an artefact when it has been written."""


class ArtefactWriter:
    """Writes an artefact in pieces, each a row group; :func:`artefact_writer` makes it."""

    def __init__(self, file: pq.ParquetWriter, schema: pa.Schema, follow: Follow | None = None) -> None:
        self._file = file
        self._schema = schema
        self._follow = follow

    def write(self, columns: Mapping[str, Any]) -> None:
        """Append one row group; ``columns`` maps the name of every column to an array, all of one length."""
        arrays = [pa.array(columns[column.name], type=column.type) for column in self._schema]
        table = pa.Table.from_arrays(arrays, schema=self._schema)
        self._file.write_table(table, row_group_size=max(1, table.num_rows))
        if self._follow is not None:
            self._follow(table)

    def describe(self, metadata: Mapping[str, Any]) -> None:
        """Set the metadata of the artefact; may be called last, when the rows are known."""
        self._file.add_key_value_metadata({_METADATA_KEY: files.canonical_json(metadata)})


@contextmanager
def artefact_writer(
    path: Path,
    artefact: str,
    optional: tuple[str, ...] = (),
    extra: Mapping[str, pa.Array] | None = None,
    follow: Follow | None = None,
) -> Iterator[ArtefactWriter]:
    """Open an artefact to write it in pieces; the file appears under its name when the block ends well.

    Parameters
    ----------
    path
        File to write.
    artefact
        Name of the schema.
    optional
        Optional columns of the schema that this file has.
    extra
        Columns that the schema does not name (:mod:`egvs.artefacts.extra_columns`); only their types are used here.
    follow
        Called with each row group that was written.
    """
    schema = arrow_schema(artefact, optional)
    for name, column in (extra or {}).items():
        schema = schema.append(pa.field(name, column.type))
    strings = [column.name for column in schema if column.type == pa.string()]
    with (
        files.atomic_write(path) as partial,
        pq.ParquetWriter(partial, schema, use_dictionary=strings, **_WRITE_OPTIONS) as file,
    ):
        yield ArtefactWriter(file, schema, follow)


def write_artefact(path: Path, artefact: str, columns: Mapping[str, Any], metadata: Mapping[str, Any]) -> None:
    """Write a complete artefact as one row group."""
    with artefact_writer(path, artefact) as file:
        file.write(columns)
        file.describe(metadata)


class OpenArtefact(NamedTuple):
    """An artefact that is open for reading, and its metadata."""

    file: pq.ParquetFile
    metadata: dict[str, Any]


@dataclass
class _SharedFiles:
    """Artefacts that stay open; the stamp in the key changes when a file is replaced."""

    open: dict[tuple[Path, str, int, int], OpenArtefact] = field(default_factory=dict)
    stack: ExitStack = field(default_factory=ExitStack)


_SHARED_FILES: ContextVar[_SharedFiles | None] = ContextVar("_SHARED_FILES", default=None)


@contextmanager
def share_open_files() -> Iterator[None]:
    """Open each artefact once: within the block, :func:`open_artefact` returns the file that is already open.

    For one thread; other threads open their own files.
    """
    shared = _SharedFiles()
    token = _SHARED_FILES.set(shared)
    try:
        with shared.stack:
            yield
    finally:
        _SHARED_FILES.reset(token)


def read_artefact(path: Path, artefact: str, columns: list[str] | None = None) -> tuple[pa.Table, dict[str, Any]]:
    """Read an artefact: its Arrow table (only some ``columns`` if given) and its metadata.

    Raises
    ------
    InputError
        When the file is missing, corrupt, or does not have the columns and types of the artefact.
    """
    with open_artefact(path, artefact) as (file, metadata), _translate_parquet_errors(path):
        return file.read(columns=columns, use_threads=False), metadata


@contextmanager
def open_artefact(path: Path, artefact: str) -> Iterator[OpenArtefact]:
    """Open an artefact to read its row groups one by one; InputError as of :func:`read_artefact`."""
    if path.is_dir():
        raise InputError(path, f"expected the file {artefact}.parquet, got a folder", f"Use {path / artefact}.parquet.")
    if not path.is_file():
        raise InputError(path, "no such file", f"Run the stage that writes {path.name} first.")
    shared = _SHARED_FILES.get()
    if shared is None:
        with ExitStack() as stack:
            yield _open_checked(path, artefact, stack)
        return
    status = path.stat()
    key = (Path(os.path.realpath(path)), artefact, status.st_ino, status.st_mtime_ns)
    if key not in shared.open:
        shared.open[key] = _open_checked(path, artefact, shared.stack)
    yield shared.open[key]


def _open_checked(path: Path, artefact: str, stack: ExitStack) -> OpenArtefact:
    """Open a file until ``stack`` ends, and check its columns and metadata."""
    with _translate_parquet_errors(path):
        file = stack.enter_context(pq.ParquetFile(stack.enter_context(open_input(path))))
    _check_columns(path, artefact, file.schema_arrow)
    content = (file.metadata.metadata or {}).get(_METADATA_KEY)
    if content is None:
        raise InputError(path, "the metadata key 'egvs' is missing", f"Use a {artefact} file written by egvs.")
    return OpenArtefact(file, _parse_metadata(path, artefact, content))


def read_row_group(file: pq.ParquetFile, group: int, path: Path, columns: list[str] | None = None) -> pa.Table:
    """Read one row group of an open artefact."""
    with _translate_parquet_errors(path):
        return file.read_row_group(group, columns=columns, use_threads=False)


def read_metadata(path: Path, artefact: str) -> dict[str, Any]:
    """Return the metadata of an artefact without reading its rows."""
    with open_artefact(path, artefact) as (_, metadata):
        return metadata


def _check_columns(path: Path, artefact: str, schema: pa.Schema) -> None:
    required = arrow_schema(artefact).names
    known = arrow_schema(artefact, optional_columns(artefact))
    hint = f"The file must have the columns {', '.join(required)}."
    for column in known:
        index = schema.get_field_index(column.name)
        if index >= 0 and schema.field(index).type != column.type:
            problem = f"expected type {column.type} for the column {column.name!r}, got {schema.field(index).type}"
            raise InputError(path, problem, _REMAKE_HINT)
        if index < 0 and column.name in required:
            raise InputError(path, f"the column {column.name!r} is missing", hint)
    unknown = sorted(set(schema.names) - set(known.names))
    if unknown and "partial" not in _table_schema(artefact).get("fieldsMatch", ()):
        raise InputError(path, f"unknown columns {', '.join(unknown)}", hint)


_SITE_KEYS = ("site", "x_m", "y_m", "z_m", "sensor")

_PLAN_KEYS = ("candidates", "joint", "together", "value", "bound", "certificate", "cost")
"""Numbers in the metadata of a plan."""

_SEEDS_KEY = "seeds"
"""Number of independent simulations in the metadata of a TPOG or of one of its periods; 1 where it is missing."""

_PERIOD_TYPES = {"name": str, "weight": float, "frames": int, "block_frames": int, "memory_frames": float, "times": int}


def _parse_metadata(path: Path, artefact: str, content: bytes) -> dict[str, Any]:
    """Parse and check metadata; InputError names the key that is wrong."""
    try:
        metadata = reading.parse_json(content)
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"the metadata is not JSON ({error})", _REMAKE_HINT) from None
    if not isinstance(metadata, dict):
        raise InputError(path, f"expected a JSON object as metadata, got {metadata!r}", _REMAKE_HINT)
    if metadata.get("schema") != SCHEMA_VERSION:
        problem = f"expected schema version {SCHEMA_VERSION}, got {metadata.get('schema')}"
        raise InputError(path, problem, _REMAKE_HINT)
    required = _table_schema(artefact).get("metadata", {})
    if artefact == "tpog" and "periods" in metadata:  # each period has blocks of its own
        required = {"grid": "grid", "frames": "count", "periods": "periods"}
    for key, kind in required.items():
        if not _is_valid(kind, metadata.get(key)):
            raise InputError(path, f"invalid metadata: {key} = {metadata.get(key)!r}", _REMAKE_HINT)
    if artefact == "tpog" and not _is_valid("count", metadata.get(_SEEDS_KEY, 1)):
        raise InputError(path, f"invalid metadata: {_SEEDS_KEY} = {metadata[_SEEDS_KEY]!r}", _REMAKE_HINT)
    return metadata


def _is_valid(kind: str, value: Any) -> bool:
    """Whether a value of the metadata is of a kind that a schema names."""
    match kind:
        case "string":
            return isinstance(value, str)
        case "object":
            return isinstance(value, dict)
        case "count":
            return isinstance(value, int) and not isinstance(value, bool) and value > 0
        case "quantity":
            return isinstance(value, float) and 0 < value < math.inf
        case "grid":
            return _is_grid(value)
        case "cells":
            return _is_cell_grid(value)
        case "zones":
            return isinstance(value, list) and bool(value)
        case "sites":
            return isinstance(value, list) and all(_has_keys(site, _SITE_KEYS) for site in value)
        case "periods":
            return isinstance(value, list) and bool(value) and all(_is_period(period) for period in value)
        case "plan":
            return _has_keys(value, _PLAN_KEYS) and all(_is_number(value[name]) for name in _PLAN_KEYS)
    raise ValueError(f"a schema names an unknown kind of metadata, {kind!r}")


def _has_keys(value: Any, keys: Sequence[str]) -> bool:
    return isinstance(value, dict) and all(key in value for key in keys)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < math.inf


def _is_period(value: Any) -> bool:
    if not isinstance(value, dict) or value.keys() - {_SEEDS_KEY} != _PERIOD_TYPES.keys():
        return False
    if not _is_valid("count", value.get(_SEEDS_KEY, 1)):
        return False
    for key, expected_type in _PERIOD_TYPES.items():
        if type(value[key]) is not expected_type:
            return False
        if key != "name" and not 0 < value[key] < math.inf:
            return False
    return True


def _is_grid(value: Any) -> bool:
    try:
        grid = Grid.from_json(value)
    except (KeyError, TypeError, ValueError, AttributeError):
        return False
    return grid.voxel_m > 0 and min(grid.shape) > 0 and math.prod(grid.shape) <= limits.VOXELS.maximum


def _is_cell_grid(value: Any) -> bool:
    """Whether the cells of a map are described: their corner, edge and number."""
    try:
        x, y = value["origin_m"]
        nx, ny = value["shape"]
        return _is_grid({"origin_m": [x, y, 0.0], "voxel_m": value["cell_m"], "shape": [nx, ny, 1]})
    except (KeyError, TypeError, ValueError):
        return False


@contextmanager
def _translate_parquet_errors(path: Path) -> Iterator[None]:
    """Raise InputError where a file is not a complete Parquet file."""
    try:
        yield
    except (pa.ArrowInvalid, OSError) as error:
        problem = f"cannot be read as Parquet ({str(error).splitlines()[0]})"
        raise InputError(path, problem, _REMAKE_HINT) from None
