"""Read terrain from the triangulated surfaces of LandXML files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from egvs.core.wording import by_number, number_of
from egvs.creation.map_parts import MapContext
from egvs.creation.terrain.ground_heights import CombinedTerrain
from egvs.extensions.maps.formats import landxml
from egvs.extensions.maps.terrain.triangles import combine_tins, tin_terrain


def read_terrain(paths: Sequence[Path], context: MapContext) -> CombinedTerrain:
    """Return the ground of all surfaces; where they overlap, of the first.

    Raises
    ------
    InputError
        When a file is damaged, no file has a surface in the region, or a file declares no reference system and there
        is no alignment.
    """
    terrains = []
    for path in paths:
        file = landxml.read_landxml(path)
        notes = (
            [
                f"{path}: {number_of(file.hidden_faces, 'hidden face')}"
                f" {by_number(file.hidden_faces, 'was', 'were')} left out."
            ]
            if file.hidden_faces
            else []
        )
        for surface in file.surfaces:
            where = f"{path}: surface {surface.name!r}"
            terrains.append(tin_terrain(surface.vertices, surface.faces, file.crs, where, context, notes))
            notes = []
    return combine_tins(terrains, ", ".join(str(path) for path in paths))
