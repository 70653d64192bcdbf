"""Rasters and GeoTIFF.

The rasters of a run, seen from above: where traffic is, what a site sees and misses of its entropy, and which share
of the vehicles it misses.

Cells are columns of voxels, or squares of a metre. A cell in which nothing was recorded has no data.

Writes rasters as GeoTIFF: the values, and a picture of them.

- ``NAME.tif`` holds the values, float32, with :data:`NODATA` where there are none, and ``NAME.qml`` the colours in
  which QGIS shows them.
- ``NAME_colours.tif`` holds the same in 254 steps with a colour table, for programs that show it as it is; 0 is where
  there is no data, and its description says what value a step stands for. Scale and offset are not set: QGIS would look
  for scaled values in the colour table, and show nothing.

In degrees a raster is sampled anew, each cell from the nearest: values stay values.
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
from egvs.export.finished_run import ExportCrs, FinishedRun
from egvs.export.layers import raster_qml
from egvs.report import colours
from egvs.report.figures import column_entropy
from egvs.scoring.egvs import EntropyField
from egvs.stages.site_scans import empty_scans

CellValues = NDArray[np.float64]

TPOG_RASTER, VISIBLE_RASTER, MISSED_RASTER, MISSED_VEHICLES_RASTER = "tpog", "seen", "missed", "vehicles_missed"


@dataclass(frozen=True, eq=False)
class Raster:
    """Values on squares.

    Attributes
    ----------
    name
        Of its file, without an end.
    words, unit
        What a value says.
    values
        (nx, ny) float64, from the south-western corner; not a number where there is no data.
    origin_m, cell_m
        That corner in the world frame, and the edge of a square.
    peak
        The value at the end of the colours, which those that are looked at together share.
    """

    name: str
    words: str
    unit: str
    values: CellValues
    origin_m: tuple[float, float]
    cell_m: float
    peak: float


def run_rasters(run: FinishedRun, sites: Collection[str]) -> Iterator[Raster]:
    """The TPOG, then what each of some sites sees and misses, in the order of the scans."""
    tpog = read_tpog(run.artefact(RunFolder.tpog.name))
    x, y, _ = tpog.grid.origin_m
    origin_m, voxel_m = (x, y), tpog.grid.voxel_m
    traffic = tpog.counts.any(axis=2)
    summed = np.where(traffic, tpog.counts.sum(axis=2) / tpog.frames, np.nan)
    words = "Occupied voxels in the column on average"
    yield Raster(TPOG_RASTER, words, "voxel", summed, origin_m, voxel_m, _max_value(summed))
    scorer = run.scorer(tpog)
    field = scorer.field
    whole = _column_entropy(field, np.ones(len(field.cells), dtype=np.bool_))
    has_entropy, peak = whole > 0, _max_value(whole)
    for scan in empty_scans(run.work, sites):
        crossed = (scorer.hits(scan.beams) > 0).ravel()[field.cells]
        for name, which in ((VISIBLE_RASTER, crossed), (MISSED_RASTER, ~crossed)):
            cells = np.where(has_entropy, _column_entropy(field, which), np.nan)
            words = f"Entropy in the column that {scan.site.name} {'sees' if name == VISIBLE_RASTER else 'misses'}"
            yield Raster(f"{name}_{scan.site.name}", words, "bit", cells, origin_m, voxel_m, peak)
    if run.scenario.score.blindspots:
        for its in readers.read_blindspots(run.artefact(RunFolder.blindspots.name), set(sites)):
            words = f"Share of the vehicles that {its.site} misses"
            yield Raster(
                f"{MISSED_VEHICLES_RASTER}_{its.site}", words, "1", its.share_missed, its.origin_m, its.cell_m, 1.0
            )


def _column_entropy(field: EntropyField, which: NDArray[np.bool_]) -> CellValues:
    return column_entropy(field, which)


def _max_value(values: CellValues) -> float:
    known = values[np.isfinite(values)]
    return float(known.max(initial=0.0)) or 1.0


NODATA = -9999.0
_N_COLOURS = 254
"""Of a colour table, after 0 for no data."""
_SMALLEST = 1e-12
_TILE = {"compress": "deflate", "predictor": 1, "interleave": "band"}


@dataclass(frozen=True, eq=False)
class GeoRaster:
    """A raster in a reference system: rows from the north, columns from the west, not a number where there is no data;
    the north-western corner, and the size of a cell, in the system's units."""

    values: NDArray[np.float64]
    west: float
    north: float
    width: float
    height: float


def georeference(raster: Raster, reference: ExportCrs) -> GeoRaster:
    """A raster in a reference system."""
    nx, ny = raster.values.shape
    low, cell = np.asarray(raster.origin_m), raster.cell_m
    high = low + cell * np.array([nx, ny])
    if not reference.is_degrees:
        west, north = reference.from_world(np.array([[low[0], high[1]]]))[0]
        return GeoRaster(np.flipud(raster.values.T), float(west), float(north), cell, cell)
    border = _rectangle_border(low, high)
    west_south, east_north = (how(reference.from_world(border), axis=0) for how in (np.min, np.max))
    columns, rows = (max(1, round(float(n))) for n in _cells_across(reference, low, high, cell))
    width, height = (east_north - west_south) / (columns, rows)
    lon = west_south[0] + (np.arange(columns) + 0.5) * width
    lat = east_north[1] - (np.arange(rows) + 0.5) * height
    at = reference.to_world(np.stack(np.meshgrid(lon, lat), axis=-1).reshape(-1, 2))
    index = np.floor((at - low) / cell).astype(np.int64)
    inside = ((index >= 0) & (index < (nx, ny))).all(axis=1)
    values = np.full(len(at), np.nan)
    values[inside] = raster.values[tuple(index[inside].T)]
    return GeoRaster(
        values.reshape(rows, columns), float(west_south[0]), float(east_north[1]), float(width), float(height)
    )


def _rectangle_border(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points along the edge of a rectangle, (n, 2): in degrees its edges are curves."""
    share = np.linspace(0.0, 1.0, 21)
    x, y = low[0] + share * (high[0] - low[0]), low[1] + share * (high[1] - low[1])
    sides = [(x, np.full(21, low[1])), (x, np.full(21, high[1])), (np.full(21, low[0]), y), (np.full(21, high[0]), y)]
    return np.vstack([np.column_stack(side) for side in sides])


def _cells_across(
    reference: ExportCrs, low: NDArray[np.float64], high: NDArray[np.float64], cell: float
) -> NDArray[np.float64]:
    """How many cells as large as those of the raster its box in degrees is wide and tall."""
    degrees = reference.from_world(_rectangle_border(low, high))
    (west, south), (east, north) = degrees.min(axis=0), degrees.max(axis=0)
    corners = np.array([[west, south], [east, south], [west, north]])
    metres = reference.to_world(corners)
    found: NDArray[np.float64] = np.hypot(*(metres[1:] - metres[0]).T) / cell
    return found


def write_geotiff(folder: Path, raster: Raster, reference: ExportCrs, name: str) -> Iterator[Path]:
    """Write a raster's files into a folder, ``name`` in front of their ends; their paths."""
    its = georeference(raster, reference)
    known = np.isfinite(its.values)
    words = f"{raster.words} ({raster.unit})"
    values = np.where(known, its.values, NODATA).astype(np.float32)
    yield _write_tiff(folder / f"{name}.tif", values, NODATA, its, reference, words)
    style = folder / f"{name}.qml"
    stops = [(raster.peak * step / colours.STEPS, code) for step, code in enumerate(colours.ON_LIGHT)]
    text = raster_qml(0.0, raster.peak, [(value, code, f"{value:.4g}") for value, code in stops])
    style.write_text(text, encoding="utf-8")
    yield style
    share = np.clip(np.nan_to_num(its.values) / raster.peak, 0.0, 1.0)
    steps = np.where(known, 1 + np.round(share * (_N_COLOURS - 1)), 0).astype(np.uint8)
    words += (
        f": (step - 1) * {raster.peak / (_N_COLOURS - 1):.9g}, steps of 1 to {_N_COLOURS}; 0 where there is no data"
    )
    yield _write_tiff(folder / f"{name}_colours.tif", steps, 0, its, reference, words, _colour_table())


def _colour_table() -> dict[int, tuple[int, int, int, int]]:
    table = {0: (255, 255, 255, 0)}
    table |= {255: (255, 255, 255, 0)}
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
    words: str,
    colour_table: Mapping[int, tuple[int, int, int, int]] | None = None,
) -> Path:
    import rasterio
    from rasterio.crs import CRS
    from rasterio.transform import Affine

    rows, columns = values.shape
    transform = Affine(geo_raster.width, 0.0, geo_raster.west, 0.0, -geo_raster.height, geo_raster.north)
    with rasterio.open(
        path, "w", driver="GTiff", width=columns, height=rows, count=1, dtype=values.dtype.name, nodata=nodata,
        crs=CRS.from_user_input(reference.crs), transform=transform, **_TILE,
    ) as file:  # fmt: skip
        file.update_tags(TIFFTAG_IMAGEDESCRIPTION=words, AREA_OR_POINT="Area")
        if colour_table is not None:  # before the values: what comes later does not get into the file's head
            file.write_colormap(1, dict(colour_table))
        file.write(values, 1)
    return path
