"""Reader of static objects from CityJSON 1.0 to 2.0."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from egvs.creation.map_parts import MapContext, SolidMap
from egvs.extensions.maps.buildings.city_models import collect_solids
from egvs.extensions.maps.formats.cityjson import CityJsonFile


def read_solids(paths: Sequence[Path], context: MapContext) -> SolidMap:
    """Return the buildings, bridges, furniture and plants in the window; InputError when a file is damaged."""
    return collect_solids(map(CityJsonFile, paths), context)
