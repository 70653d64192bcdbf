"""How well the surface of a point cloud predicts beams that it was not made from.

``python -m benchmarks.as_built [--chengdu FOLDER]`` prints two tables. A held-out beam agrees along itself when the
surface is within 0.2 m of its measured range, and across the surface when it is within 0.2 m of that point along the
normal of the triangle hit: along a grazing beam, 2 cm of height can be 0.2 m. The ceiling is what a neighbouring beam,
taken as the prediction, reaches.

- **Nishishinjuku**: the scenario's static world, scanned from nine stations with 2 cm of noise; the beams of three
  other places; also the visibility of voxels from ten sites.
- **Chengdu**: ten sweeps of a fixed sensor, without every fifth column, and without every fifth sector of 1 degree; the
  static beams of another sweep there. FOLDER contains ``sweep.pcd.gz`` and ``frames.npz``.
"""

from __future__ import annotations

import argparse
import gzip
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from tests.extensions.maps import as_built_clouds

import egvs
from egvs.core.grid import FloatArray, IntArray, Roi
from egvs.extensions.maps.point_clouds.as_built_view import AsBuiltMap
from egvs.extensions.maps.point_clouds.moving_points import StationScan, not_shared
from egvs.extensions.maps.point_clouds.reader import make_meshes
from egvs.extensions.maps.point_clouds.surface import SURFEL_SPACING_M, triangulate_cloud
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster
from egvs.world.static_world import build_world

ROOT = Path(__file__).resolve().parent.parent
AGREE_M = 0.2
SPACINGS_M = (SURFEL_SPACING_M, 0.1)
OTHER_PLACES = ((165.0, 222.0, 4.0), (210.0, 245.0, 5.0), (232.0, 226.0, 6.0))
COLUMNS, CHANNELS, COLUMN_DEG = 1800, 80, 0.2
MAX_RANGE_M = 120.0


class Beams(NamedTuple):
    """Beams from one place: directions (n, 3), measured ranges (n,), and the ranges of neighbouring beams (n,)."""

    position_m: FloatArray
    directions: FloatArray
    range_m: FloatArray
    neighbour_m: FloatArray


class Agreement(NamedTuple):
    """Which beams agree, along the beam and across the surface; (n,) each."""

    along: NDArray[np.bool_]
    across: NDArray[np.bool_]
    neighbour_along: NDArray[np.bool_]
    neighbour_across: NDArray[np.bool_]


def agreement(caster: Caster, world: World, beams: Beams) -> Agreement:
    """Compare the measured ranges of beams with the surface, and with their neighbours."""
    x, y, z = beams.position_m.tolist()
    scan = caster.sweep((x, y, z), beams.directions, 500.0)
    assert scan.face is not None
    actual = np.where(scan.returned, np.sqrt((scan.ends_m**2).sum(axis=1)), np.inf)
    corners = world.triangles_m[np.maximum(scan.face, 0)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cosine = np.abs((normals * beams.directions).sum(axis=1)) / np.sqrt((normals**2).sum(axis=1))
    cosine[~scan.returned] = 1.0
    error = np.abs(actual - beams.range_m)
    neighbour_error = np.abs(beams.neighbour_m - beams.range_m)
    return Agreement(
        error <= AGREE_M, error * cosine <= AGREE_M, neighbour_error <= AGREE_M, neighbour_error * cosine <= AGREE_M
    )


def print_agreement(name: str, beams: Sequence[Beams], world: World, roi: Roi) -> None:
    """Print a row: all beams, those below 40 m, and the ceilings."""
    caster = Caster(world, roi)
    results = [agreement(caster, world, one) for one in beams]
    near = np.concatenate([one.range_m for one in beams]) < 40.0
    columns = [np.concatenate(values) for values in zip(*results, strict=True)]
    shares = [f"{column.mean():.3f} ({column[near].mean():.3f})" for column in columns]
    print(f"  {name}: {' | '.join(shares)} | {near.size:,} beams ({near.sum():,} below 40 m)", flush=True)


HEADER = "  method: along (below 40 m) | across | ceiling along | ceiling across | beams"


def as_built_world(points_m: FloatArray, spacing_m: float) -> tuple[World, str]:
    """Triangulate a cloud; return it, and its size and build time in words."""
    start = time.perf_counter()
    surface = triangulate_cloud(points_m, spacing_m)
    seconds = time.perf_counter() - start
    triangles = len(surface.ground.faces), len(surface.objects.faces)
    name = (
        f"surfels of {spacing_m:g} m, {triangles[0] / 1e6:.2f} + {triangles[1] / 1e6:.2f} M triangles, {seconds:.1f} s"
    )
    return AsBuiltMap(meshes=make_meshes(surface)).world(), name


# --- nishishinjuku ---


def junction() -> None:
    """Nine stations of nishishinjuku, against its own static world."""
    scenario = egvs.load(ROOT / "scenarios" / "nishishinjuku")
    true, _ = build_world(scenario)
    roi = scenario.roi.box
    views = as_built_clouds.scan_stations(true, roi, as_built_clouds.stations_around(roi))
    points = np.concatenate([view.points_m for view in views])
    print(f"nishishinjuku: {len(points):,} points of nine stations\n{HEADER}")
    true_caster = Caster(true, roi)
    beams = [_true_beams(true_caster, roi, np.array(place)) for place in OTHER_PLACES]
    voxels = as_built_clouds.random_voxel_centres(scenario.roi.grid, 15_000)
    for spacing_m in SPACINGS_M:
        world, name = as_built_world(points, spacing_m)
        print_agreement(name, beams, world, roi)
        _print_visibility(true_caster, world, roi, voxels)


def _true_beams(caster: Caster, roi: Roi, position_m: FloatArray) -> Beams:
    """Return the beams of a surveyor's scanner that end in the true world; neighbours are 0.2 degrees to the left."""
    sensor = as_built_clouds.SURVEYOR
    directions = sensor.directions()
    ranges, _ = caster.first_hits(position_m - roi.origin_m, directions)
    neighbour = np.roll(ranges.reshape(-1, sensor.channels), 1, axis=0).ravel()
    hit = ranges <= MAX_RANGE_M
    return Beams(position_m, directions[hit], ranges[hit], neighbour[hit])


def _print_visibility(true_caster: Caster, world: World, roi: Roi, voxels_m: FloatArray) -> None:
    start = time.perf_counter()
    caster = Caster(world, roi)
    built_s = time.perf_counter() - start
    different, bias = [], []
    for site in as_built_clouds.SITES_M:
        expected, actual = (as_built_clouds.visible_points(one, roi, site, voxels_m) for one in (true_caster, caster))
        different.append(float(np.mean(expected != actual)))
        bias.append(float(actual.mean() - expected.mean()))
    worst = max(bias, key=abs)
    print(
        f"    visibility of {len(voxels_m):,} voxels from ten sites: {np.mean(different):.2%} differ, at the worst site"
        f" {max(different):.2%}; its visible share is off by {worst:+.3f}; {built_s:.0f} s to build the caster",
        flush=True,
    )


# --- Chengdu ---


class Sweep(NamedTuple):
    """Returns of one sweep: points (n, 3), and the column and channel of each (n,)."""

    points_m: FloatArray
    column: IntArray
    channel: IntArray


class BeamAngles(NamedTuple):
    """Elevation of each channel, and its azimuth in column 0, degrees; (channels,) each."""

    elevation_deg: FloatArray
    offset_deg: FloatArray


def chengdu(folder: Path) -> None:
    """Ten sweeps of a real sensor, and the held-out beams of another."""
    with gzip.open(folder / "sweep.pcd.gz") as file:
        rows = file.read().partition(b"DATA ascii\n")[2].split()
    organised = np.array(rows, dtype=np.float64).reshape(COLUMNS, CHANNELS, 4)[:, :, :3]
    angles = _beam_angles(organised)
    held_out = _sweep_of_points(organised[np.isfinite(organised).all(axis=2)], angles)
    with np.load(folder / "frames.npz") as frames:
        sweeps = [_sweep_of_points(frames[name].astype(np.float64), angles) for name in sorted(frames)]
    station = np.zeros(3)
    moving = not_shared([StationScan(station, sweep.points_m) for sweep in sweeps])
    static = []
    for sweep, mask in zip(sweeps, moving, strict=True):
        static.append(Sweep(sweep.points_m[~mask], sweep.column[~mask], sweep.channel[~mask]))
    removed, total = sum(int(mask.sum()) for mask in moving), sum(map(len, moving))
    print(f"Chengdu: {removed:,} of {total:,} points of ten sweeps removed as moving\n{HEADER}")
    ranges = _median_ranges(static)
    in_columns = lambda column: column % 5 == 0  # noqa: E731
    in_sectors = lambda column: column // 5 % 5 == 0  # noqa: E731
    low, high = np.array([-150.0, -150.0, -30.0]), np.array([150.0, 150.0, 30.0])
    roi = Roi(tuple(low.tolist()), tuple((high - low).tolist()))
    for name, is_held_out, step in (("every 5th column", in_columns, 1), ("every 5th sector of 1 deg", in_sectors, 5)):
        points = np.concatenate([sweep.points_m[~is_held_out(sweep.column)] for sweep in static])
        beams = _static_beams(held_out, is_held_out(held_out.column), ranges, step)
        for spacing_m in SPACINGS_M:
            world, surface = as_built_world(points, spacing_m)
            print_agreement(f"{name}, {surface}", [beams], world, roi)


def _beam_angles(organised: FloatArray) -> BeamAngles:
    """Return the angles of each channel, from an organised sweep (columns, channels, 3) with NaN for no return."""
    x, y, z = np.moveaxis(organised, 2, 0)
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    azimuth = np.degrees(np.arctan2(y, x)) + COLUMN_DEG * np.arange(COLUMNS)[:, None]
    offset = np.degrees(np.angle(np.nanmean(np.exp(1j * np.radians(azimuth)), axis=0)))
    return BeamAngles(np.nanmedian(elevation, axis=0), offset)


def _sweep_of_points(points_m: FloatArray, angles: BeamAngles) -> Sweep:
    """Return points with the nearest channel by elevation, and the nearest column."""
    x, y, z = points_m.T
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    order = np.argsort(angles.elevation_deg)
    levels = angles.elevation_deg[order]
    above = np.clip(np.searchsorted(levels, elevation), 1, CHANNELS - 1)
    channel = order[np.where(elevation - levels[above - 1] < levels[above] - elevation, above - 1, above)]
    azimuth = np.degrees(np.arctan2(y, x))
    column = np.rint((angles.offset_deg[channel] - azimuth) / COLUMN_DEG).astype(np.int64) % COLUMNS
    return Sweep(points_m, column, channel)


def _median_ranges(sweeps: Sequence[Sweep]) -> FloatArray:
    """Return the median static range of each beam, NaN where fewer than three sweeps returned; (columns, channels)."""
    beam = np.concatenate([sweep.column * CHANNELS + sweep.channel for sweep in sweeps])
    ranges = np.concatenate([np.sqrt((sweep.points_m**2).sum(axis=1)) for sweep in sweeps])
    order = np.lexsort((ranges, beam))
    beam, ranges = beam[order], ranges[order]
    first = np.flatnonzero(np.insert(np.diff(beam) != 0, 0, True))
    count = np.diff(first, append=len(beam))
    medians = np.full(COLUMNS * CHANNELS, np.nan)
    medians[beam[first]] = np.where(count >= 3, ranges[first + (count - 1) // 2], np.nan)
    return medians.reshape(COLUMNS, CHANNELS)


def _static_beams(sweep: Sweep, is_held_out: NDArray[np.bool_], ranges_m: FloatArray, step: int) -> Beams:
    """Return the held-out beams that agree with the other sweeps' range of the same beam.

    Neighbours have the same elevation and azimuth ``step`` columns away, whatever their channel: channels point to
    different azimuths in the same column.
    """
    range_m = np.sqrt((sweep.points_m**2).sum(axis=1))
    same = ranges_m[sweep.column, sweep.channel]
    agrees = np.abs(same - range_m) <= AGREE_M
    print(f"  of all held-out returns, {np.mean(agrees[is_held_out]):.3f} agree with the same beam of the other sweeps")
    is_static = is_held_out & agrees & (range_m < MAX_RANGE_M)
    neighbour = ranges_m[(sweep.column[is_static] + step) % COLUMNS, sweep.channel[is_static]]
    directions = sweep.points_m[is_static] / range_m[is_static, None]
    return Beams(np.zeros(3), directions, range_m[is_static], np.nan_to_num(neighbour, nan=np.inf))


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.as_built", description=__doc__.split("\n")[0])
    parser.add_argument("--chengdu", type=Path, help="folder of sweep.pcd.gz and frames.npz")
    given = parser.parse_args()
    if given.chengdu is not None:
        chengdu(given.chengdu)
    junction()


if __name__ == "__main__":
    main()
