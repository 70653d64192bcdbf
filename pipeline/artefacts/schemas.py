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
def _declared(artefact: str) -> dict[str, Any]:
    """The Table Schema of an artefact."""
    declared: dict[str, Any] = json.loads((folder() / f"{artefact}.schema.json").read_text(encoding="utf-8"))
    return declared


def _fields(artefact: str) -> list[dict[str, Any]]:
    """The columns that the Table Schema of an artefact declares."""
    return list(_declared(artefact)["fields"])


def names(artefact: str) -> tuple[str, ...]:
    """All columns that the schema declares."""
    return tuple(field["name"] for field in _fields(artefact))


def takes_foreign_columns(artefact: str) -> bool:
    """Whether an artefact may have columns that its schema does not name ("partial", as Table Schema calls it)."""
    return "partial" in _declared(artefact).get("fieldsMatch", ())


@cache
def arrow_schema(artefact: str, optional: tuple[str, ...] = ()) -> pa.Schema:
    """The Arrow schema of an artefact: its needed columns, and those named in ``optional``. None holds nulls."""
    import pyarrow as pa

    fields = [f for f in _fields(artefact) if f["constraints"]["required"] or f["name"] in optional]
    return pa.schema([pa.field(f["name"], pa.type_for_alias(f["arrow_type"]), nullable=False) for f in fields])


def optional_columns(artefact: str) -> tuple[str, ...]:
    """The columns that exist only where an effect calls for them."""
    return tuple(f["name"] for f in _fields(artefact) if not f["constraints"]["required"])
