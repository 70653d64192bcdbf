"""Rasters of a run, seen from above, and their GeoTIFF files.

The rasters show the occupancy by traffic, the entropy that a site sees and misses, the share of vehicles that it
misses, the points that a car and a pedestrian get from it, and the overlap of the sensors of a plan. Cells are columns
of voxels, or squares of a metre; a cell without observations, or off the road surface, has no data.

- ``NAME.tif`` has the values, float32, with :data:`NODATA`, and ``NAME.qml`` the colours for QGIS.
- ``NAME_colours.tif`` has the values in 254 steps with a colour table, for programs that show images as they are. 0 is
  no data, and the description of the file gives the value of a step. Scale and offset are not set, because QGIS would
  look up the scaled values in the colour table, and show nothing.

In degrees, each cell gets the value of the nearest cell of the raster in metres.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts import readers
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.tpog import read_tpog
from egvs.core import files
from egvs.core.grid import FloatArray, Grid
from egvs.drawing import colours
from egvs.drawing.run_figures import column_entropy
from egvs.export.finished_run import ExportCrs, FinishedRun
from egvs.export.layers import raster_qml
from egvs.scoring.points_map import OVERLAP_POINTS, overlap_map
from egvs.stages.plan_scans import plan_beams
from egvs.stages.points_maps import points_maps, target_positions
from egvs.stages.site_scans import empty_scans

CellValues = FloatArray


@dataclass(frozen=True, eq=False)
class Raster:
    """Values of square cells.

    Attributes
    ----------
    name
        File name without suffix.
    description, unit
        Description of a value, and its unit.
    values
        Shape (nx, ny), from the south-western corner; NaN for no data.
    origin_m, cell_m
        The south-western corner in the world frame, and the size of a cell.
    peak
        Value at the end of the colour scale; the same for rasters that are compared.
    """

    name: str
    description: str
    unit: str
    values: CellValues
    origin_m: tuple[float, float]
    cell_m: float
    peak: float


def run_rasters(run: FinishedRun, sites: Collection[str]) -> Iterator[Raster]:
    """Return the occupancy, then what some sites see and miss, in the order of the scans."""
    tpog = read_tpog(run.artefact(RunFolder.tpog.name))
    x, y, _ = tpog.grid.origin_m
    origin_m, voxel_m = (x, y), tpog.grid.voxel_m
    occupancy = np.where(tpog.counts.any(axis=2), tpog.counts.sum(axis=2) / tpog.frames, np.nan)
    description = "Occupied voxels in the column on average"
    yield Raster("tpog", description, "voxel", occupancy, origin_m, voxel_m, _max_value(occupancy))

    scorer = run.scorer(tpog)
    field = scorer.field
    total = column_entropy(field, np.ones(len(field.cells), dtype=np.bool_))
    has_entropy, peak = total > 0, _max_value(total)
    for scan in empty_scans(run.work, sites):
        site = scan.site.name
        crossed = (scorer.hits(scan.beams) > 0).ravel()[field.cells]
        for name, verb, which in (("seen", "sees", crossed), ("missed", "misses", ~crossed)):
            entropy = np.where(has_entropy, column_entropy(field, which), np.nan)
            description = f"Entropy in the column that {site} {verb}"
            yield Raster(f"{name}_{site}", description, "bit", entropy, origin_m, voxel_m, peak)

    if run.scenario.score.blindspots:
        for spots in readers.read_blindspots(run.artefact(RunFolder.blindspots.name), set(sites)):
            name, description = f"vehicles_missed_{spots.site}", f"Share of the vehicles that {spots.site} misses"
            yield Raster(name, description, "1", spots.share_missed, spots.origin_m, spots.cell_m, 1.0)
    yield from _points_rasters(run, sites, tpog.grid)


def _points_rasters(run: FinishedRun, sites: Collection[str], grid: Grid) -> Iterator[Raster]:
    """Points on a car and on a pedestrian from some sites, then by how many sensors of the plan; none without lanes."""
    positions = target_positions(run.work, grid)
    scans = ((scan.site.name, scan.beams) for scan in empty_scans(run.work, sites))
    for site, points in points_maps(run.work, positions, scans):
        description = f"Points that a {points.target.name} gets from {site}"
        name = f"points_{points.target.name}_{site}"
        yield Raster(name, description, "1", points.values, points.origin_m, points.cell_m, _max_value(points.values))

    plan = run.plan
    if plan is None or not plan.sensors or not positions:
        return
    planned = [sensor.mount for sensor in plan.sensors]
    beams = plan_beams(run.work, planned, moved=plan.refinement is not None)
    from_sensors = [points for _, points in points_maps(run.work, positions, beams)]
    for place in positions:
        overlap = overlap_map([points for points in from_sensors if points.target is place.target])
        target = place.target.name
        description = f"Sensors of the plan from which a {target} gets {OVERLAP_POINTS:g} points or more"
        peak = float(len(plan.sensors))
        yield Raster(f"overlap_{target}", description, "1", overlap.values, overlap.origin_m, overlap.cell_m, peak)


def _max_value(values: CellValues) -> float:
    return float(values[np.isfinite(values)].max(initial=0.0)) or 1.0


NODATA = -9999.0
_N_COLOURS = 254
"""Number of colours of a colour table, after 0 for no data."""
_TILE = {"compress": "deflate", "predictor": 1, "interleave": "band"}


@dataclass(frozen=True, eq=False)
class GeoRaster:
    """A raster in a reference system, whose units all lengths have.

    Attributes
    ----------
    values
        Rows from the north, columns from the west; NaN for no data.
    west, north
        The north-western corner.
    width, height
        Size of a cell.
    """

    values: FloatArray
    west: float
    north: float
    width: float
    height: float


def georeference(raster: Raster, reference: ExportCrs) -> GeoRaster:
    """Return a raster in a reference system."""
    nx, ny = raster.values.shape
    low, cell = np.asarray(raster.origin_m), raster.cell_m
    high = low + cell * np.array([nx, ny])
    if not reference.is_degrees:
        west, north = reference.from_world(np.array([[low[0], high[1]]]))[0]
        return GeoRaster(np.flipud(raster.values.T), float(west), float(north), cell, cell)
    border = reference.from_world(_rectangle_border(low, high))
    west_south, east_north = border.min(axis=0), border.max(axis=0)
    columns, rows = (max(1, round(float(n))) for n in _cell_counts(reference, west_south, east_north, cell))
    width, height = (east_north - west_south) / (columns, rows)
    lon = west_south[0] + (np.arange(columns) + 0.5) * width
    lat = east_north[1] - (np.arange(rows) + 0.5) * height
    centres_m = reference.to_world(np.stack(np.meshgrid(lon, lat), axis=-1).reshape(-1, 2))
    index = np.floor((centres_m - low) / cell).astype(np.int64)
    inside = ((index >= 0) & (index < (nx, ny))).all(axis=1)
    values = np.full(len(centres_m), np.nan)
    values[inside] = raster.values[tuple(index[inside].T)]
    return GeoRaster(
        values.reshape(rows, columns), float(west_south[0]), float(east_north[1]), float(width), float(height)
    )


def _rectangle_border(low: FloatArray, high: FloatArray) -> FloatArray:
    """Points along the edges of a rectangle, shape (n, 2): in degrees the edges are curves."""
    share = np.linspace(0.0, 1.0, 21)
    x, y = low[0] + share * (high[0] - low[0]), low[1] + share * (high[1] - low[1])
    sides = [(x, np.full(21, low[1])), (x, np.full(21, high[1])), (np.full(21, low[0]), y), (np.full(21, high[0]), y)]
    return np.vstack([np.column_stack(side) for side in sides])


def _cell_counts(reference: ExportCrs, west_south: FloatArray, east_north: FloatArray, cell: float) -> FloatArray:
    """Width and height of a box in degrees, in cells of ``cell`` metres."""
    (west, south), (east, north) = west_south, east_north
    corners = np.array([[west, south], [east, south], [west, north]])
    metres = reference.to_world(corners)
    counts: FloatArray = np.hypot(*(metres[1:] - metres[0]).T) / cell
    return counts


def write_geotiff(folder: Path, raster: Raster, reference: ExportCrs, name: str) -> Iterator[Path]:
    """Write the files of a raster, whose names begin with ``name``, into a folder; yield their paths."""
    geo_raster = georeference(raster, reference)
    has_data = np.isfinite(geo_raster.values)
    description = f"{raster.description} ({raster.unit})"
    values = np.where(has_data, geo_raster.values, NODATA).astype(np.float32)
    yield _write_tiff(folder / f"{name}.tif", values, NODATA, geo_raster, reference, description)

    style = folder / f"{name}.qml"
    stops = [(raster.peak * step / colours.STEPS, colour) for step, colour in enumerate(colours.ON_LIGHT)]
    style.write_text(raster_qml(0.0, raster.peak, stops), encoding="utf-8")
    yield style

    share = np.clip(np.nan_to_num(geo_raster.values) / raster.peak, 0.0, 1.0)
    steps = np.where(has_data, 1 + np.round(share * (_N_COLOURS - 1)), 0).astype(np.uint8)
    description += (
        f": (step - 1) * {raster.peak / (_N_COLOURS - 1):.9g}, steps of 1 to {_N_COLOURS}; 0 where there is no data"
    )
    yield _write_tiff(folder / f"{name}_colours.tif", steps, 0, geo_raster, reference, description, _colour_table())


def _colour_table() -> dict[int, tuple[int, int, int, int]]:
    table = {0: (255, 255, 255, 0), 255: (255, 255, 255, 0)}
    for step in range(_N_COLOURS):
        red, green, blue = colours.interpolate_colour(step, _N_COLOURS - 1, colours.ON_LIGHT)
        table[step + 1] = (red, green, blue, 255)
    return table


def _write_tiff(
    path: Path,
    values: NDArray[Any],
    nodata: float,
    geo_raster: GeoRaster,
    reference: ExportCrs,
    description: str,
    colour_table: Mapping[int, tuple[int, int, int, int]] | None = None,
) -> Path:
    import rasterio.errors
    from rasterio._err import CPLE_BaseError
    from rasterio.crs import CRS
    from rasterio.transform import Affine

    rows, columns = values.shape
    transform = Affine(geo_raster.width, 0.0, geo_raster.west, 0.0, -geo_raster.height, geo_raster.north)
    crs = CRS.from_user_input(reference.crs)
    with (
        files.check_disk_space(path.parent, rasterio.errors.RasterioError, CPLE_BaseError),
        rasterio.open(
            path, "w", driver="GTiff", width=columns, height=rows, count=1, dtype=values.dtype.name, nodata=nodata,
            crs=crs, transform=transform, **_TILE,
        ) as file,
    ):  # fmt: skip
        file.update_tags(TIFFTAG_IMAGEDESCRIPTION=description, AREA_OR_POINT="Area")
        if colour_table is not None:  # before the values, or it is not in the header
            file.write_colormap(1, dict(colour_table))
        file.write(values, 1)
    return path
