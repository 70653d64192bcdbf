"""Point clouds of a scenario's static world, as nine stations of a survey would take them, and what sites see of it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from egvs.core.grid import FloatArray, Grid, Roi
from egvs.extensions.maps.point_clouds.moving_points import StationScan
from egvs.sensors.sensor import Sensor
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster

NOISE_M = 0.02
SURVEYOR = Sensor(
    "surveyor", tuple(np.linspace(-40.0, 50.0, 128).round(4).tolist()), (0.0,) * 128, 1800, 200.0, "made up"
)
"""128 channels, 0.2 degrees between columns."""


SITES_M = np.array(
    [(x, y, 4.5) for x, y in ((150, 258), (175, 258), (200, 255), (220, 260), (240, 258),
                              (150, 217), (170, 217), (195, 216), (221, 216), (240, 217))]
)  # fmt: skip
"""Ten sensors on both sides of the junction of nishishinjuku."""


def stations_around(roi: Roi, height_m: float = 2.0) -> FloatArray:
    """Nine stations over a region, in three rows, (9, 3)."""
    shares = (0.05, 0.5, 0.95)
    at = [np.add(roi.origin_m[:2], np.multiply(roi.size_m[:2], share)) for share in itertools.product(shares, shares)]
    return np.column_stack([at, np.full(9, height_m)])


def scan_stations(
    world: World, roi: Roi, stations_m: FloatArray, noise_m: float = NOISE_M, seed: int = 0
) -> list[StationScan]:
    """What a surveyor's scanner returns at each station."""
    rng = np.random.default_rng(seed)
    caster = Caster(world, roi)
    scans = []
    for station in stations_m:
        directions = SURVEYOR.directions()
        ranges, _ = caster.first_hits(station - roi.origin_m, directions, SURVEYOR.range_m)
        hit = ranges <= SURVEYOR.range_m
        measured = ranges[hit] + rng.normal(0.0, noise_m, np.count_nonzero(hit))
        scans.append(StationScan(station, station + directions[hit] * measured[:, None]))
    return scans


def random_voxel_centres(grid: Grid, count: int, seed: int = 1) -> FloatArray:
    """Centres of random voxels of a grid, (count, 3)."""
    index = np.random.default_rng(seed).integers(0, grid.shape, (count, 3))
    centres: FloatArray = (index + 0.5) * grid.voxel_m + np.asarray(grid.origin_m)
    return centres


def visible_points(caster: Caster, roi: Roi, site_m: FloatArray, points_m: FloatArray) -> NDArray[np.bool_]:
    """Which points (n, 3) a sensor sees past a static world, (n,) bool."""
    offsets = points_m - site_m
    distances = np.sqrt((offsets**2).sum(axis=1))
    ranges, _ = caster.first_hits(site_m - roi.origin_m, offsets / distances[:, None])
    return ranges >= distances


def write_e57(path: Path, scans: Sequence[StationScan]) -> Path:
    """Write scans as E57, in the frames of their stations, with their poses."""
    import pye57

    file = pye57.E57(str(path), mode="w")
    for scan in scans:
        local = scan.points_m - scan.station_m
        columns = {f"cartesian{axis}": np.ascontiguousarray(local[:, i]) for i, axis in enumerate("XYZ")}
        file.write_scan_raw(columns, rotation=np.array([1.0, 0.0, 0.0, 0.0]), translation=scan.station_m)
    file.close()
    return path
