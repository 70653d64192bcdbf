"""What do other ways to count beams and boxes cost, and how wrong are they?

The same job on the shipped junction - from a site's beams to the beams in each voxel, and on to the score - by what
papers and packages do instead:

- the march: samples at a fixed step (NumPy); integer Bresenham between voxel indices (numba), as published occupancy
  metrics do; Amanatides and Woo with t accumulated (numba);
- occupancy: a voxel is occupied when its centre lies in a box (numba); when a box touches it (ours, not shrunk);
- the cast: trimesh without Embree, on every nth beam; Embree's own float32 range (``tfar``) on the bare triangles.

Ours is the reference: that it is right is shown by ``make numerics``. Wrong are beams (frames, for occupancy) that a
voxel misses or has too many; where one voxel gains what it loses, both cancel, so these are lower bounds. Repeats are
interleaved; processor seconds are medians, as multiples of ours; of the sites' errors the worst is shown.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np

import egvs
from benchmarks.scenes import recorded_boxes
from benchmarks.stability import medians, textbook, touching
from egvs.artefacts.frame_boxes import FrameBoxes
from egvs.core.grid import Grid
from egvs.kernels import occupancy, traversal
from egvs.scoring.egvs import EntropyField
from egvs.scoring.occupancy import static_voxels
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene
from egvs.sensors.sites import Site
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster

SCENARIO = Path(__file__).resolve().parent.parent / "scenarios" / "nishishinjuku"
SITES = ("c08", "c10")
FRAMES = 400
CAST_BEAMS = 400
"""trimesh casts about so many beams a site; its seconds are scaled up."""

Row = tuple[str, str, str, str, str]
March = Callable[[Any, Any, Any, float, Any], None]

_kernel = numba.njit(nogil=True, error_model="numpy", cache=True)
_CHUNK = 2_000_000  # samples held at once


def sampled(step: float) -> March:
    """Points every ``step`` voxels from the sensor on; each voxel that holds one or more of a beam's counts once."""

    def count(o: Any, d: Any, shape: Any, voxel_m: float, hits: Any) -> None:
        del voxel_m
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = -o / d, (shape - o) / d
        level, inside = d == 0.0, (o >= 0) & (o < shape)
        low = np.where(level, np.where(inside, 0.0, np.inf), np.minimum(a, b)).max(axis=1).clip(0.0)
        high = np.where(level, 1.0, np.maximum(a, b)).min(axis=1).clip(max=1.0)
        met = low <= high
        d, low, high = d[met], low[met], high[met]
        length = np.sqrt((d**2).sum(axis=1))
        first = np.ceil(low * length / step).astype(np.int64)
        counts = np.maximum(np.floor(high * length / step).astype(np.int64) - first + 1, 0)
        ends = np.cumsum(counts)
        start = 0
        while start < len(d):
            done = ends[start - 1] if start else 0
            stop = max(start + 1, int(np.searchsorted(ends, done + _CHUNK, side="right")))
            beam = np.repeat(np.arange(start, stop), counts[start:stop])
            number = np.arange(len(beam)) - (ends[beam] - counts[beam] - done) + first[beam]
            points = o + d[beam] * (number * step / length[beam])[:, None]
            cells = np.floor(points).astype(np.int64)
            kept = ((cells >= 0) & (cells < shape)).all(axis=1)
            beam, cells = beam[kept], cells[kept]
            flat = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
            fresh = np.ones(len(flat), np.bool_)  # a beam is never back in a voxel that it left
            fresh[1:] = (flat[1:] != flat[:-1]) | (beam[1:] != beam[:-1])
            hits += np.bincount(flat[fresh], minlength=len(hits)).astype(hits.dtype)
            start = stop

    return count


@_kernel
def bresenham(o, d, shape, voxel_m, hits):
    """Integer line from the sensor's voxel to that of the beam's end, one voxel a step along the longest axis."""
    n, at, sign, error = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    for beam in range(d.shape[0]):
        longest = 0
        for a in range(3):
            at[a] = np.int64(np.floor(o[a]))
            n[a] = np.int64(np.floor(o[a] + d[beam, a])) - at[a]
            sign[a] = 1 if n[a] > 0 else -1
            n[a] = abs(n[a])
            longest = max(longest, n[a])
        for a in range(3):
            error[a] = 2 * n[a] - longest
        for _ in range(longest + 1):
            if 0 <= at[0] < shape[0] and 0 <= at[1] < shape[1] and 0 <= at[2] < shape[2]:
                hits[(at[0] * shape[1] + at[1]) * shape[2] + at[2]] += np.uint32(1)
            for a in range(3):
                if n[a] == longest:
                    at[a] += sign[a]
                else:
                    if error[a] > 0:
                        at[a] += sign[a]
                        error[a] -= 2 * longest
                    error[a] += 2 * n[a]


def accumulated(o: Any, d: Any, shape: Any, voxel_m: float, hits: Any) -> None:
    """Amanatides and Woo's march as printed, see :mod:`benchmarks.stability`."""
    del voxel_m
    textbook(o, d, shape, hits)


MARCHES: dict[str, March] = {
    "ours": traversal.count_hits,
    "samples, 1 voxel (NumPy)": sampled(1.0),
    "samples, 1/2 voxel (NumPy)": sampled(0.5),
    "samples, 1/4 voxel (NumPy)": sampled(0.25),
    "Bresenham between indices": bresenham,
    "march that accumulates t": accumulated,
}
"""Each adds the beams (n, 3) of a sensor to the counters of the voxels: ``(o, d, shape, voxel_m, hits)``, in voxel
units."""


@_kernel
def centres(frame, values, shape, voxel_m, counts, seen):
    """Frames in which each voxel's centre lies in a flat box, added to ``counts``; both arrays (nx, ny, nz)."""
    for b in range(values.shape[0]):
        x, y, z, yaw = values[b, 0], values[b, 1], values[b, 2], values[b, 3]
        half_l, half_w, half_h = 0.5 * values[b, 5], 0.5 * values[b, 6], 0.5 * values[b, 7]
        c, s, reach = np.cos(yaw), np.sin(yaw), np.hypot(half_l, half_w)
        for ix in range(max(int((x - reach) / voxel_m), 0), min(int((x + reach) / voxel_m) + 1, shape[0])):
            for iy in range(max(int((y - reach) / voxel_m), 0), min(int((y + reach) / voxel_m) + 1, shape[1])):
                px, py = (ix + 0.5) * voxel_m - x, (iy + 0.5) * voxel_m - y
                if abs(c * px + s * py) > half_l or abs(c * py - s * px) > half_w:
                    continue
                for iz in range(max(int((z - half_h) / voxel_m), 0), min(int((z + half_h) / voxel_m) + 1, shape[2])):
                    if abs((iz + 0.5) * voxel_m - z) <= half_h and seen[ix, iy, iz] != frame[b]:
                        seen[ix, iy, iz] = frame[b]
                        counts[ix, iy, iz] += 1


def by_centre(batch: FrameBoxes, grid: Grid) -> Any:
    """Frames in which each voxel's centre is in a box, (nx, ny, nz) int32."""
    counts, seen = np.zeros(grid.shape, np.int32), np.full(grid.shape, -1, np.int64)
    centres(batch.frame, batch.values, np.asarray(grid.shape, np.int64), grid.voxel_m, counts, seen)
    return counts


def by_boxes(batch: FrameBoxes, grid: Grid, kernels: Any = occupancy) -> Any:
    """The same by ``kernels``: ours, or those of boxes that touch."""
    nx, ny, nz = grid.shape
    steps, seen = np.zeros((nz + 1, nx, ny), np.int32), np.full((3, nx, ny), -1, np.int64)
    kernels.count_boxes(batch.frame, batch.values, np.asarray(grid.shape, np.int64), grid.voxel_m, steps, seen)
    kernels.sum_layers(steps)
    return np.ascontiguousarray(steps[:-1].transpose(1, 2, 0))


def by_trimesh(triangles: Any) -> Callable[[Any, Any, float], Any]:
    """Ends of beams ``(o, d, range)`` by trimesh's own ray caster; what it needs once is made before."""
    from trimesh import triangles as made
    from trimesh.ray.ray_triangle import ray_triangle_id

    tree = made.bounds_tree(triangles)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.sqrt((normals**2).sum(axis=1))[:, None]

    def cast(o: Any, d: Any, range_m: float) -> Any:
        found = ray_triangle_id(triangles, np.tile(o, (len(d), 1)), d, normals, tree, multiple_hits=False)
        ranges = np.full(len(d), range_m)
        if len(found[1]):
            ranges[found[1]] = np.minimum(((found[2] - o) * d[found[1]]).sum(axis=1), range_m)
        return d * ranges[:, None]

    return cast


def by_embree(triangles: Any) -> Callable[[Any, Any, float], Any]:
    """Ends of beams by Embree's float32 ranges on the bare triangles."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, triangles.astype(np.float32))

    def cast(o: Any, d: Any, range_m: float) -> Any:
        found = scene.run(np.tile(o.astype(np.float32), (len(d), 1)), d.astype(np.float32), output=True)
        met = found["primID"] >= 0
        return d * np.where(met, np.minimum(found["tfar"].astype(np.float64), range_m), range_m)[:, None]

    return cast


@dataclass
class Junction:
    """The shipped junction, with the occupancy of a few hundred frames."""

    grid: Grid
    gamma: float
    world: World
    scene: Scene
    batch: FrameBoxes
    static: Any

    @classmethod
    def shipped(cls) -> Junction:
        """Statics built, traffic simulated."""
        scenario = egvs.load(SCENARIO, [f"traffic.frames={FRAMES}"])
        grid, scene = scenario.roi.grid, egvs.build_scene(scenario)
        filled = static_voxels(scene.world, grid)
        return cls(grid, scenario.gamma, scene.world, scene, recorded_boxes(scenario), filled)

    @property
    def sites(self) -> list[Site]:
        """The sites that are compared."""
        return [site for site in self.scene.sites if site.name in SITES]

    def scans(self) -> list[tuple[Site, Any]]:
        """Each of these sites, and where its beams end."""
        scanner = Scanner(self.scene)
        return [(site, scanner.scan_site(site).rows.ends_m) for site in self.sites]

    @property
    def shape(self) -> Any:
        """Voxels along x, y, z."""
        return np.asarray(self.grid.shape, np.int64)

    def start(self, site: Any) -> Any:
        """Where a sensor is, in voxels of the grid's frame."""
        return self.grid.to_grid_m(np.asarray(site.pose.position_m)) / self.grid.voxel_m

    def hits(self, site: Any, ends_m: Any, way: March = traversal.count_hits) -> Any:
        """Beams in each voxel, flat."""
        found = np.zeros(int(self.shape.prod()), np.uint32)
        way(self.start(site), np.ascontiguousarray(ends_m / self.grid.voxel_m), self.shape, self.grid.voxel_m, found)
        return found

    def field(self, counts: Any) -> EntropyField:
        """The entropy of counted frames."""
        return EntropyField.of(np.where(self.static, 0, counts).astype(np.int64), FRAMES, self.grid)


def wrong(found: Any, true: Any) -> tuple[float, float, float]:
    """Shares of voxels with a wrong count, of what is missed and of what is invented."""
    off = found.astype(np.int64) - true.astype(np.int64)
    total = max(int(true.sum()), 1)
    return (
        int((off != 0).sum()) / max(int((true > 0).sum()), 1),
        -int(off[off < 0].sum()) / total,
        int(off[off > 0].sum()) / total,
    )


def _ours(what: str, seconds: float) -> Row:
    return f"{what}: ours", "1 x", f"{seconds / len(SITES) * 1e3:.1f} ms a site", "the reference", ""


def _row(what: str, ratio: float, errors: list[tuple[float, float, float]], scores: list[tuple[float, float]]) -> Row:
    voxels, missed, invented = (max(share) for share in zip(*errors, strict=True))
    error = max(((found - true) / true for found, true in scores), key=abs)
    told = f"missed {missed:.3%}, invented {invented:.3%}"
    off = f"{error:+.2%}" if abs(error) >= 1e-4 else f"{error:+.0e}"
    return what, f"{ratio:.3g} x", f"{voxels:.2%} of voxels wrong", told, f"EGVS {off}"


def march_rows(junction: Junction) -> list[Row]:
    """(a), (b), (c): the march of all beams of the sites."""
    scans = junction.scans()
    field = junction.field(by_boxes(junction.batch, junction.grid))
    jobs = [(junction.start(site), np.ascontiguousarray(ends / junction.grid.voxel_m)) for site, ends in scans]
    shape, voxel_m, room = junction.shape, junction.grid.voxel_m, np.zeros(int(junction.shape.prod()), np.uint32)

    def all_of(way: March) -> Callable[[], None]:
        def work() -> None:
            for o, d in jobs:
                way(o, d, shape, voxel_m, room)

        return work

    seconds = medians([all_of(way) for way in MARCHES.values()])
    true = [junction.hits(site, ends) for site, ends in scans]
    found = [_ours(f"march, {', '.join(SITES)}", seconds[0])]
    for (name, way), took in list(zip(MARCHES.items(), seconds, strict=True))[1:]:
        theirs = [junction.hits(site, ends, way) for site, ends in scans]
        errors = [wrong(a, b) for a, b in zip(theirs, true, strict=True)]
        scores = [
            (field.score(a, junction.gamma).egvs, field.score(b, junction.gamma).egvs)
            for a, b in zip(theirs, true, strict=True)
        ]
        found.append(_row(f"march: {name}", took / seconds[0], errors, scores))
    return found


def occupancy_rows(junction: Junction) -> list[Row]:
    """(d): what counts as occupied."""
    plain = touching()
    ways = {
        "ours": lambda: by_boxes(junction.batch, junction.grid),
        "touching boxes": lambda: by_boxes(junction.batch, junction.grid, plain),
        "voxel centres": lambda: by_centre(junction.batch, junction.grid),
    }
    hits = [junction.hits(site, ends) for site, ends in junction.scans()]
    seconds = medians(list(ways.values()))
    true = ways["ours"]()
    field = junction.field(true)
    found: list[Row] = [(f"occupancy, {FRAMES} frames: ours", "1 x", f"{seconds[0] * 1e3:.1f} ms", "the reference", "")]
    for (name, way), took in list(zip(ways.items(), seconds, strict=True))[1:]:
        counts = way()
        theirs = junction.field(counts)
        scores = [(theirs.score(h, junction.gamma).egvs, field.score(h, junction.gamma).egvs) for h in hits]
        found.append(_row(f"occupancy: {name}", took / seconds[0], [wrong(counts, true)], scores))
    return found


def cast_rows(junction: Junction) -> list[Row]:
    """(e), (f): the cast of beams that can meet the region of interest, and the march of what it finds."""
    origin = np.asarray(junction.grid.origin_m)
    positions_m = np.array([site.pose.position_m for site in junction.scene.sites])
    range_m = max(sensor.range_m for sensor in junction.scene.used_sensors.values())
    caster = Caster(junction.world, junction.scene.roi, positions_m, range_m)
    triangles = caster._triangles
    field = junction.field(by_boxes(junction.batch, junction.grid))
    jobs = []
    for site in junction.sites:
        sensor = junction.scene.sensor(site.sensor)
        directions = sensor.directions(*site.pose.angles_deg)
        d = directions[caster.scan(site.pose.position_m, directions, sensor.range_m).beam]
        jobs.append((site, np.asarray(site.pose.position_m) - origin, d, sensor.range_m))

    def ours(o: Any, d: Any, range_m: float) -> Any:
        return caster.scan(tuple(o + origin), d, range_m).ends_m

    def all_of(way: Callable[[Any, Any, float], Any], step: int = 1) -> Callable[[], object]:
        return lambda: [way(o, d[::step], range_m) for _, o, d, range_m in jobs]

    step = max(1, min(len(job[2]) for job in jobs) // CAST_BEAMS)
    slow, single = by_trimesh(triangles), by_embree(triangles)
    seconds = medians([all_of(ours), all_of(single)])
    start = time.process_time()
    all_of(slow, step)()
    seconds.append((time.process_time() - start) * sum(len(j[2]) for j in jobs) / sum(len(j[2][::step]) for j in jobs))
    ways = (
        ("Embree's float32 ranges", single, 1),
        (f"trimesh with rtree; 1 beam in {step}, scaled", slow, step),
    )
    found = [_ours("cast", seconds[0])]
    for (name, way, every), took in zip(ways, seconds[1:], strict=True):
        errors, scores = [], []
        for site, o, d, range_m in jobs:
            theirs, true = (junction.hits(site, cast(o, d[::every], range_m)) for cast in (way, ours))
            errors.append(wrong(theirs, true))
            scores.append((field.score(theirs, junction.gamma).egvs, field.score(true, junction.gamma).egvs))
        found.append(_row(f"cast: {name}", took / seconds[0], errors, scores))
    return found


def rows() -> list[tuple[Any, ...]]:
    """(what, seconds against ours, wrong voxels, beams or frames missed and invented, error of the score)."""
    junction = Junction.shipped()
    return [*march_rows(junction), *occupancy_rows(junction), *cast_rows(junction)]


if __name__ == "__main__":
    for row in rows():
        print(*row, sep=" | ")
