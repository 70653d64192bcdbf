"""Reader of terrain from the relief of CityGML, such as the ``dem`` tiles of PLATEAU.

A file is terrain if PLATEAU's name for it says so, or if a ``ReliefFeature`` is near its beginning. Of tiles with names
by grid squares, only those that the window reaches are opened.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from egvs.core.errors import InputError
from egvs.creation.map_parts import MapContext
from egvs.creation.terrain.ground_heights import CombinedTerrain, TinTerrain
from egvs.extensions.maps.buildings import citygml
from egvs.extensions.maps.formats.citygml import read_relief
from egvs.extensions.maps.formats.mesh_codes import parse_tile_name
from egvs.extensions.maps.terrain.triangles import combine_tins, tin_terrain

_STEPS = 5
"""Points on each side of the window whose coordinates give its bounds in another system."""


def can_open(path: Path, head: bytes) -> bool:
    """Return whether a file is a city model with terrain."""
    return citygml.is_relief(path, head)


def read_terrain(paths: Sequence[Path], context: MapContext) -> CombinedTerrain:
    """Return the ground of all files; where they overlap, of the first.

    Raises
    ------
    InputError
        When a file is damaged, no file has triangles in the region, or a file declares no reference system and there
        is no alignment.
    """
    near = [path for path in paths if _is_in_reach(path, context)]
    beyond = [None] * (len(paths) - len(near))
    return combine_tins([*(_read_file(path, context) for path in near), *beyond], str(paths[0]))


def _is_in_reach(path: Path, context: MapContext) -> bool:
    tile = parse_tile_name(path.name)
    return tile is None or citygml.is_in_reach(tile, context)


def _read_file(path: Path, context: MapContext) -> TinTerrain | None:
    """Return the terrain of a file; None if it has no triangle in the region."""
    relief = read_relief(path, lambda crs: _window_bounds(crs, str(path), context))
    if not len(relief.faces):
        return None
    return tin_terrain(relief.vertices, relief.faces, relief.crs, str(path), context)


def _window_bounds(crs: str | None, where: str, context: MapContext) -> Sequence[float]:
    """Return west, south, east and north of the window in a reference system."""
    x0, y0, x1, y1 = context.window.bounds
    grid = np.meshgrid(np.linspace(x0, x1, _STEPS), np.linspace(y0, y1, _STEPS))
    points = context.from_world(np.stack(grid, axis=-1).reshape(-1, 2), crs, where)
    if not np.isfinite(points).all():
        raise InputError(where, f"the region cannot be converted to {crs}", "Check the file's reference system.")
    return [*points.min(axis=0).tolist(), *points.max(axis=0).tolist()]
