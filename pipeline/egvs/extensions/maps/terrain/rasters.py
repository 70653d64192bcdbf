"""Read terrain from GeoTIFF files and ASCII grids: only the part that the region needs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.creation.map_parts import MapContext
from egvs.creation.terrain.ground_heights import GridTerrain, grid_terrain
from egvs.extensions.maps.formats import rasters
from egvs.extensions.maps.formats.rasters import HeightGrid
from egvs.formats import xml

NAME = "GeoTIFF or ASCII grid"

_TIFF_SUFFIXES = (".tif", ".tiff")
_RIM_POINTS = 21


def can_open(path: Path, head: bytes) -> bool:
    """Return whether a file is a GeoTIFF or an ASCII grid."""
    if rasters.is_geotiff(head) or rasters.is_ascii_grid(head):
        return True
    return path.name.lower().removesuffix(".gz").endswith((*_TIFF_SUFFIXES, ".asc"))


def read_terrain(paths: Sequence[Path], context: MapContext) -> GridTerrain:
    """Return the ground of rasters, which may be tiles.

    Raises
    ------
    InputError
        When a file is damaged, declares no reference system and there is no alignment, or none covers the region.
    MissingExtraError
        When rasterio is not installed, for a GeoTIFF.
    """
    grids = [(_read_grid(path, context), str(path)) for path in paths]
    return grid_terrain(grids, context)


def _read_grid(path: Path, context: MapContext) -> HeightGrid:
    limits.checked_size(path, limits.FILE)
    with xml.open_bounded(path) as file:
        head = file.read(512)
    if rasters.is_ascii_grid(head):
        grid = rasters.read_ascii_grid(path)
        _window_bounds(grid.crs, context, path)  # raises where its coordinates cannot be converted
        return grid
    if not rasters.is_geotiff(head):
        expected = f"expected a GeoTIFF or an ASCII grid, got a file that starts with {head[:20]!r}"
        raise InputError(path, expected, "Check the file name.")
    header = rasters.read_geotiff_header(path)
    return rasters.read_geotiff(path, _window_bounds(header.crs, context, path))


def _window_bounds(crs: str | None, context: MapContext, path: Path) -> tuple[float, float, float, float]:
    """Return the rectangle around the region in a file's system."""
    x0, y0, x1, y1 = context.window.bounds
    rim = shapely.box(x0, y0, x1, y1).exterior
    shares = np.linspace(0.0, 1.0, 4 * _RIM_POINTS)
    points_m = shapely.get_coordinates(shapely.line_interpolate_point(rim, shares, normalized=True))
    points = context.from_world(points_m, crs, str(path))
    (low_x, low_y), (high_x, high_y) = points.min(axis=0), points.max(axis=0)
    return float(low_x), float(low_y), float(high_x), float(high_y)
