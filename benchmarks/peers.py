"""Our ray casting and traversal, compared with packages that do the same or nearly the same.

``make bench-peers`` prints, for some sites of the shipped junction, processor seconds as multiples of ours, all
measured in turns in one run (the smallest of the repeats), and in how many beams or voxels results differ from ours.

Ray casting, of the beams that can meet the region of interest: first hits on the static triangles.

- embreex: Embree's float32 ranges on the bare triangles, one ray at a time;
- Open3D: ``RaycastingScene.cast_rays``, float32.

A beam differs if one of both hits nothing, or if the ranges differ by more than 1 mm. Building the trees is not timed.

Traversal, of the same beams up to their ends, through the voxels of the scenario:

- taichi: Amanatides and Woo with accumulated t, in float64, on one thread of the processor;
- octomap: ``OcTree.insertPointCloud``. This answers another question: which voxels any beam crosses, not how many do,
  in an octree with occupancy at the ends; its ratio is the cost of a map, not of counts.

A voxel differs if its number of beams does; with octomap, if only one of both crosses it. ``make numerics`` shows that
ours are correct.

A peer that is not installed is left out by name: ``pip install "egvs[peers]"`` installs them all, ``pip install NAME``
one of them. Open3D takes 900 MB. ``--csv FILE`` writes the table of the documentation.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import egvs
from egvs.kernels import traversal
from egvs.sensors.scanner import Scanner
from egvs.stages.inputs import build_scene
from egvs.world.ray_casting import Caster

SCENARIO = Path(__file__).resolve().parent.parent / "scenarios" / "nishishinjuku"
SITES = 2
REPEATS = 3
SAME_RANGE_M = 1e-3
"""Ranges that differ by less are the same: float32 at 100 m is exact to 4 micrometres."""

Row = tuple[str, str, str]
HEADINGS: Row = ("method", "time / ours", "time of ours, or difference from it")


@dataclass(frozen=True)
class SiteBeams:
    """The beams of one site that can meet the region of interest.

    Attributes
    ----------
    start_m
        The sensor in the grid's frame, (3,) float64, metres.
    directions
        Unit vectors, (n, 3) float64.
    range_m
        Where a beam ends that hits nothing.
    ends_m
        Our end of each beam relative to the sensor, (n, 3) float64, metres.
    returned
        Whether it hits something, (n,) bool.
    """

    start_m: Any
    directions: Any
    range_m: float
    ends_m: Any
    returned: Any

    @property
    def hit_m(self) -> Any:
        """Our range of each hit, infinite for none, (n,) float64."""
        return np.where(self.returned, np.sqrt((self.ends_m**2).sum(axis=1)), np.inf)


@dataclass(frozen=True)
class Junction:
    """The static triangles of a scenario (t, 3, 3) in the grid's frame, its voxels, and the beams of some sites."""

    caster: Caster
    triangles: Any
    shape: Any
    voxel_m: float
    sites: list[SiteBeams]

    @classmethod
    def load(cls, folder: Path = SCENARIO, sites: int = SITES) -> Junction:
        """Build the static world, and cast the beams of the first sites."""
        scenario = egvs.load(folder)
        scene, grid = build_scene(scenario), scenario.roi.grid
        starts_m = np.array([site.pose.position_m for site in scene.sites[:sites]])
        caster = Caster(scene.world, scenario.roi.box, starts_m)
        scanner = Scanner(scene)
        beams = []
        for site in scene.sites[:sites]:
            sensor = scene.sensor(site.sensor)
            directions = sensor.directions(*site.pose.angles_deg)
            rows = scanner.scan_site(site).rows
            start_m = grid.to_grid_m(np.asarray(site.pose.position_m))
            beams.append(SiteBeams(start_m, directions[rows.beam], sensor.range_m, rows.ends_m, rows.returned))
        return cls(caster, caster._triangles, np.asarray(grid.shape, np.int64), grid.voxel_m, beams)

    def count_hits(self, site: SiteBeams) -> Any:
        """Return our number of beams in each voxel, flat, uint32."""
        hits = np.zeros(int(self.shape.prod()), np.uint32)
        traversal.count_hits(
            site.start_m / self.voxel_m,
            np.ascontiguousarray(site.ends_m / self.voxel_m),
            self.shape,
            self.voxel_m,
            hits,
        )
        return hits


Cast = Callable[[SiteBeams], Any]
"""Ranges of first hits, infinite for none, (n,)."""

Count = Callable[[SiteBeams], Any]
"""Number of beams in each voxel, flat; or whether any beam crosses it, bool."""


def our_cast(junction: Junction) -> Cast:
    """Return our caster: ranges in float64, uncertain beams searched."""
    return lambda site: junction.caster.first_hits(site.start_m, site.directions, site.range_m)[0]


def embreex_cast(junction: Junction) -> Cast:
    """Return Embree's own ranges in float32, on the bare triangles."""
    scene = import_module("embreex.rtcore_scene").EmbreeScene()
    import_module("embreex.mesh_construction").TriangleMesh(scene, junction.triangles.astype(np.float32))

    def cast(site: SiteBeams) -> Any:
        start = np.tile(site.start_m.astype(np.float32), (len(site.directions), 1))
        result = scene.run(start, site.directions.astype(np.float32), output=True)
        return np.where(result["primID"] >= 0, result["tfar"].astype(np.float64), np.inf)

    return cast


def open3d_cast(junction: Junction) -> Cast:
    """Return Open3D's RaycastingScene."""
    open3d = import_module("open3d")
    scene, count = open3d.t.geometry.RaycastingScene(nthreads=1), len(junction.triangles)
    corners = np.ascontiguousarray(junction.triangles.reshape(-1, 3).astype(np.float32))
    scene.add_triangles(corners, np.arange(3 * count, dtype=np.uint32).reshape(-1, 3))

    def cast(site: SiteBeams) -> Any:
        rays = np.empty((len(site.directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = site.start_m, site.directions
        return scene.cast_rays(rays, nthreads=1)["t_hit"].numpy().astype(np.float64)

    return cast


def taichi_count(junction: Junction) -> Count:
    """Return Amanatides and Woo's march as taichi compiles it, on one thread."""
    ti = import_module("taichi")
    ti.init(arch=ti.cpu, cpu_max_num_threads=1, default_fp=ti.f64, log_level=ti.WARN, offline_cache=False)
    march = import_module("benchmarks.peers_taichi").march
    shape = [int(n) for n in junction.shape]

    def count(site: SiteBeams) -> Any:
        hits = np.zeros(int(junction.shape.prod()), np.int32)
        start = site.start_m / junction.voxel_m
        march(np.ascontiguousarray(site.ends_m / junction.voxel_m), *start.tolist(), *shape, hits)
        return hits

    return count


def octomap_count(junction: Junction) -> Count:
    """Return which voxels an octree marks when a scan is inserted."""
    octomap = import_module("octomap")
    nx, ny, nz = (int(n) for n in junction.shape)
    centres = (np.stack(np.meshgrid(*(np.arange(n) for n in (nx, ny, nz)), indexing="ij"), axis=-1) + 0.5) * (
        junction.voxel_m
    )
    centres = centres.reshape(-1, 3)

    def insert(site: SiteBeams) -> Any:
        tree = octomap.OcTree(junction.voxel_m)
        tree.insertPointCloud(site.start_m + site.ends_m, site.start_m, lazy_eval=True)
        return lambda: np.asarray(tree.getLabels(centres)) >= 0  # is not part of what is timed

    return insert


CASTS: dict[str, tuple[str, Callable[[Junction], Cast]]] = {
    "embreex, one ray at a time": ("embreex", embreex_cast),
    "Open3D RaycastingScene": ("open3d", open3d_cast),
}
COUNTS: dict[str, tuple[str, Callable[[Junction], Count]]] = {
    "Amanatides and Woo with accumulated t": ("taichi", taichi_count),
    "insertion of the scan in an octree": ("octomap", octomap_count),
}
"""Module and maker of each peer, by its name in the table."""

PACKAGES = {"octomap": "octomap-python"}
"""Package of a module where its name differs."""


def smallest_seconds(works: dict[str, Callable[[], Any]], repeats: int = REPEATS) -> dict[str, float]:
    """Return the smallest processor seconds of each call; in turns, after one call that is not counted."""
    seconds = dict.fromkeys(works, float("inf"))
    for turn in range(repeats + 1):
        for name, work in works.items():
            start = time.process_time()
            work()
            if turn:
                seconds[name] = min(seconds[name], time.process_time() - start)
    return seconds


def differing_ranges(ranges: Any, site: SiteBeams) -> int:
    """Return in how many beams a hit is missing, added, or at another range than ours."""
    ranges = np.where(ranges <= site.range_m, ranges, np.inf)
    ours = site.hit_m
    with np.errstate(invalid="ignore"):  # both infinite: both hit nothing
        return int((~((ranges == ours) | (np.abs(ranges - ours) <= SAME_RANGE_M))).sum())


def differing_voxels(counts: Any, ours: Any) -> int:
    """Return in how many voxels the number of beams differs, or, of bools, whether any beam crosses it."""
    if counts.dtype == np.bool_:
        ours = ours > 0
    return int((counts != ours).sum())


def rows(junction: Junction, repeats: int = REPEATS) -> list[Row]:
    """Return a row for each peer: name, ratio to ours, and how the result differs; or why it is left out."""
    table = _rows("cast", junction, our_cast(junction), CASTS, repeats)
    return table + _rows("traversal", junction, junction.count_hits, COUNTS, repeats)


def _rows(
    what: str, junction: Junction, ours: Callable[[SiteBeams], Any], peers: dict[str, Any], repeats: int
) -> list[Row]:
    methods, left_out = {"ours": ours}, []
    for name, (module, make) in peers.items():
        try:
            import_module(module)
        except ModuleNotFoundError:
            hint = f"not installed; try pip install {PACKAGES.get(module, module)}"
            left_out.append((f"{what}: {name}", "left out", hint))
            continue
        except ImportError as error:  # a library of the system is missing
            left_out.append((f"{what}: {name}", "left out", f"cannot be imported: {error}"))
            continue
        methods[name] = make(junction)

    def make_work(method: Callable[[SiteBeams], Any]) -> Callable[[], None]:
        def work() -> None:
            for site in junction.sites:
                method(site)

        return work

    seconds = smallest_seconds({name: make_work(method) for name, method in methods.items()}, repeats)
    table = []
    for name, method in methods.items():
        if name == "ours":
            table.append((f"{what}: ours", "1 x", f"{1e3 * seconds[name] / len(junction.sites):.1f} ms a site"))
            continue
        difference = _describe_difference(what, method, junction)
        module = peers[name][0]
        package = PACKAGES.get(module, module)
        peer = f"{what}: {name}, {package} {version(package)}"
        table.append((peer, f"{seconds[name] / seconds['ours']:.3g} x", difference))
    return table + left_out


def _describe_difference(what: str, method: Callable[[SiteBeams], Any], junction: Junction) -> str:
    if what == "cast":
        wrong = sum(differing_ranges(method(site), site) for site in junction.sites)
        return f"{wrong:,} of {sum(len(site.directions) for site in junction.sites):,} beams differ"
    wrong, crossed = 0, 0
    for site in junction.sites:
        result = method(site)
        if callable(result):
            result = result()
        ours = junction.count_hits(site)
        wrong, crossed = wrong + differing_voxels(result, ours), crossed + int((ours > 0).sum())
    return f"{wrong:,} voxels differ, of {crossed:,} that beams cross"


def main(arguments: list[str] | None = None) -> None:
    """Print the table, and write it if a file is given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers", description=__doc__)
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the table there too")
    chosen = parser.parse_args(arguments)
    table = rows(Junction.load())
    for row in table:
        print("  ".join(f"{cell:<74}" for cell in row).rstrip())
    if chosen.csv is not None:
        with chosen.csv.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([HEADINGS, *table])


if __name__ == "__main__":
    main()
