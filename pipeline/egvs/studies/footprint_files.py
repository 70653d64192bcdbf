"""Footprints of runs that differ in the static world: read a scenario's, and write changed ones into run folders."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.reading import read_json
from egvs.formats import vector_files


def read_document(path: Path) -> dict[str, Any]:
    """Return the features of a file of footprints, as a GeoJSON FeatureCollection."""
    if vector_files.is_gis_file(path):
        return vector_files.read_gis_file(path, "Polygon")
    document = read_json(path, "Use a GeoJSON FeatureCollection.")
    if not isinstance(document, dict) or not isinstance(document.get("features"), list):
        raise InputError(path, "expected a GeoJSON FeatureCollection, got no features list")
    return document


def write_if_changed(path: Path, document: Mapping[str, Any]) -> None:
    """Write JSON; a file with the same content is not touched, so that a run stays up to date."""
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":")) + "\n"
    if path.is_file() and path.read_text(encoding="utf-8") == text:
        return
    files.write_text(path, text)
