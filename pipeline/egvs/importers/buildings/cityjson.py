"""Reader of static objects from CityJSON 1.0 to 2.0."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from egvs.formats import cityjson
from egvs.formats.cityjson import CityJsonFile
from egvs.importers.buildings.city_models import collect_solids
from egvs.importers.map_parts import MapContext, SolidMap

NAME = "CityJSON"


def can_open(path: Path, head: bytes) -> bool:
    """Return whether a file is CityJSON."""
    return cityjson.is_cityjson(path, head)


def read_solids(paths: Sequence[Path], context: MapContext) -> SolidMap:
    """Return the buildings, bridges, furniture and plants in the window; InputError when a file is damaged."""
    return collect_solids(map(CityJsonFile, paths), context)
