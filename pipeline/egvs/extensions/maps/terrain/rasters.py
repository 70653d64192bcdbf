"""Read terrain from GeoTIFF files and ASCII grids: only the part that the region needs.

Between the cells of a grid, heights are interpolated bilinearly (:mod:`egvs.extensions.maps.formats.rasters`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.wording import by_number, format_percent, number_of
from egvs.creation.map_parts import MapContext
from egvs.creation.terrain.ground_heights import window_points
from egvs.extensions.maps.formats import rasters
from egvs.extensions.maps.formats.rasters import HeightGrid
from egvs.extensions.maps.terrain.triangles import check_heights
from egvs.formats import xml

_RIM_POINTS = 21


@dataclass(frozen=True)
class GridTerrain:
    """Heights from grids; of several at a point, from the first that knows its height.

    Attributes
    ----------
    grids
        The grids, each with the file that it is from.
    context
        The region, for coordinates.
    notes
        Sentences for the user.
    """

    grids: tuple[tuple[HeightGrid, str], ...]
    context: MapContext
    notes: tuple[str, ...] = ()

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        """Return the heights (n,) of the ground at world-frame points (n, 2); NaN where unknown."""
        heights = np.full(len(xy_m), np.nan)
        for grid, where in self.grids:
            unknown = np.flatnonzero(np.isnan(heights))
            if not len(unknown):
                break
            heights[unknown] = grid.height_m(self.context.from_world(xy_m[unknown], grid.crs, where))
        return heights


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


def grid_terrain(grids: Sequence[tuple[HeightGrid, str]], context: MapContext) -> GridTerrain:
    """Return the terrain of grids that cover the region, with notes on them.

    Raises
    ------
    InputError
        When none of them has a height in the region, a height is impossible, or their coordinates cannot be converted.
    """
    for grid, where in grids:
        check_heights(grid.heights_m, where)
    present = [(grid, where) for grid, where in grids if grid.heights_m.size]
    terrain = GridTerrain(tuple(present), context)
    if not present or not np.isfinite(terrain.height_m(window_points(context.window))).any():
        places = ", ".join(where for _, where in grids)
        raise InputError(places, "the terrain has no height in the region", "Use a terrain that covers the road map.")
    return GridTerrain(tuple(present), context, tuple(_grid_notes(present, context)))


def _grid_notes(grids: Sequence[tuple[HeightGrid, str]], context: MapContext) -> Iterator[str]:
    for grid, where in grids:
        known = np.isfinite(grid.heights_m)
        rows, columns = grid.heights_m.shape
        if not known.any():
            yield f"{where}: all {rows} x {columns} cells in the region have no data."
            continue
        heights = grid.heights_m[known]
        cells = f"{where}: terrain of {rows} x {columns} cells, {heights.min():.1f} to {heights.max():.1f} m high"
        missing = int(known.size - np.count_nonzero(known))
        yield (
            f"{cells}; {number_of(missing, 'cell')} {by_number(missing, 'has', 'have')} no data."
            if missing
            else f"{cells}."
        )
    points = window_points(context.window)
    unknown = int(np.isnan(GridTerrain(tuple(grids), context).height_m(points)).sum())
    if unknown:
        yield f"The terrain has no height in {format_percent(unknown / len(points))} of the region."


def _read_grid(path: Path, context: MapContext) -> HeightGrid:
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
