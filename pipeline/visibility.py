"""Which voxels do a site's beams cross?

Steps: take the site's empty scan from ``scans.parquet`` (with ``scan.keep = false``: cast it instead), move it into the grid's
frame in float64, march every beam, count.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline import tables
from pipeline.errors import InputError
from pipeline.grid import Grid
from pipeline.kernels import march
from pipeline.scenario import Scenario
from pipeline.world import read_ply


def hits_of(scenario: Scenario, out: Path, grid: Grid, sites: Collection[str]) -> Iterator[tuple[str, NDArray[np.uint32]]]:
    """Beams that cross each voxel, (nx, ny, nz) uint32, with the site's name; for the named sites, in the order of the scans."""
    for about, ends_m in scans(scenario, out, sites):
        hits = np.zeros(int(np.prod(grid.shape)), dtype=np.uint32)
        count_hits(about, ends_m, grid, hits)
        yield about["site"], hits.reshape(grid.shape)


def scans(
    scenario: Scenario, out: Path, only: Collection[str] | None = None
) -> Iterator[tuple[dict[str, Any], NDArray[np.float64]]]:
    """What is known of each site, and where its beams end, (n, 3) metres from the sensor, in the order of the sites.

    Parameters
    ----------
    only
        The sites that are wanted; all when None.
    """
    return _kept(out / "scans.parquet", only) if scenario.scan.keep else _cast(scenario, out, only)


def count_hits(about: dict[str, Any], ends_m: NDArray[np.float64], grid: Grid, hits: NDArray[np.uint32]) -> None:
    """Add a site's beams to ``hits``, flat, (nx * ny * nz,) uint32."""
    o, d, shape = in_voxels(about, ends_m, grid)
    march.count_hits(o, d, shape, grid.voxel_m, hits)


def in_voxels(
    about: dict[str, Any], ends_m: NDArray[np.float64], grid: Grid
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Sensor (3,), beams (n, 3) and shape (3,) as :mod:`pipeline.kernels.march` wants them; InputError for what no grid holds."""
    place = f"scans.parquet: site {about['site']}"
    position_m = np.array([about["x_m"], about["y_m"], about["z_m"]])
    o, d = grid.to_grid_m(position_m) / grid.voxel_m, ends_m / grid.voxel_m
    if not (np.isfinite(o).all() and np.isfinite(d).all()):
        raise InputError(place, "a beam with an end that is no number", "finite metres")
    if len(d) > np.iinfo(np.uint32).max:
        raise InputError(place, f"{len(d)} beams", "fewer than 2**32")
    return o, d, np.asarray(grid.shape, dtype=np.int64)


def _kept(path: Path, only: Collection[str] | None) -> Iterator[tuple[dict[str, Any], NDArray[np.float64]]]:
    with tables.reader(path, "scans") as (file, about):
        if file.num_row_groups != len(about["sites"]):
            raise InputError(path, f"{file.num_row_groups} row groups for {len(about['sites'])} sites", "one a site")
        for group, site in enumerate(about["sites"]):
            if only is None or site["site"] in only:
                table = tables.read_group(file, group, path, ["dx_m", "dy_m", "dz_m"])
                yield site, np.column_stack([table.column(name).to_numpy() for name in table.column_names])


def _cast(scenario: Scenario, out: Path, only: Collection[str] | None) -> Iterator[tuple[dict[str, Any], NDArray[np.float64]]]:
    from pipeline import survey  # brings Embree, which kept scans do not need

    world, _ = read_ply(out / "statics.ply")
    surveyed = survey.Survey(scenario, world)
    for site in surveyed.sites:
        if only is None or site.site in only:
            done = surveyed.scan(site)
            yield done.about, done.scan.ends_m
