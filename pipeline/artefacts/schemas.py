"""The columns of the artefacts, with types and units.

The answer stands once, in ``data_schemas/<artefact>.schema.json`` (Frictionless Table Schema with ``unit`` and
``arrow_type`` beside each field). This module is the only one that reads that folder.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.core.errors import MissingBackendError

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = 1
"""Version of all artefact schemas; written into each file's metadata."""


def folder() -> Path:
    """The folder ``data_schemas``: beside the package in a checkout, inside it when installed from a wheel."""
    here = Path(__file__).resolve().parent.parent
    for candidate in (here / "data_schemas", here.parent / "data_schemas"):
        if candidate.is_dir():
            return candidate
    raise MissingBackendError(f"{here.parent}: the folder data_schemas is missing; install egvs again")


@cache
def table_schema(artefact: str) -> dict[str, Any]:
    """The Table Schema of ``trajectories``, ``tpog``, ``scans``, ``visibility`` or ``scores``."""
    text = (folder() / f"{artefact}.schema.json").read_text(encoding="utf-8")
    schema: dict[str, Any] = json.loads(text)
    return schema


@cache
def arrow_schema(artefact: str, optional: tuple[str, ...] = ()) -> pa.Schema:
    """The Arrow schema of an artefact with its needed columns and those named in ``optional``. No column may hold
    nulls."""
    import pyarrow as pa

    types = {"bool": pa.bool_()}
    fields = [f for f in table_schema(artefact)["fields"] if f["constraints"]["required"] or f["name"] in optional]
    return pa.schema(
        [
            pa.field(f["name"], types.get(f["arrow_type"]) or pa.type_for_alias(f["arrow_type"]), nullable=False)
            for f in fields
        ]
    )


def optional_columns(artefact: str) -> tuple[str, ...]:
    """The columns that exist only where an effect calls for them."""
    return tuple(f["name"] for f in table_schema(artefact)["fields"] if not f["constraints"]["required"])
