"""Cost and errors of other methods to count beams and boxes.

On the shipped junction, from the beams of a site to the beams in each voxel and to the score, with methods that papers
and packages use instead:

- traversal: samples at a fixed step (NumPy); integer Bresenham between voxel indices (numba), as in published occupancy
  metrics; Amanatides and Woo with accumulated t (numba);
- occupancy: a voxel is occupied if its centre is in a box (numba), or if a box touches it (our kernels, boxes not
  shrunk);
- casting: trimesh without Embree, on every n-th beam; Embree's own float32 ranges (``tfar``) on the bare triangles.

Our method is the reference; ``make numerics`` shows that it is correct. An error is a beam (a frame, for occupancy)
that a voxel misses or has too many. Where a voxel gains what it loses, both cancel, so errors are lower bounds. Methods
are timed in turns; processor seconds are medians, as multiples of ours; the largest error of the sites is printed.
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
from benchmarks.stability import median_seconds, textbook_march, touching_box_kernels
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
"""Approximate number of beams per site that trimesh casts; its seconds are scaled up."""

Row = tuple[str, str, str, str, str]
March = Callable[[Any, Any, Any, float, Any], None]

_kernel = numba.njit(nogil=True, error_model="numpy", cache=True)
_CHUNK = 2_000_000  # samples in memory at once


def sampled(step: float) -> March:
    """Return a march with points every ``step`` voxels; each voxel counts once per beam."""

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
            is_inside = ((cells >= 0) & (cells < shape)).all(axis=1)
            beam, cells = beam[is_inside], cells[is_inside]
            flat = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
            fresh = np.ones(len(flat), np.bool_)  # a beam is never back in a voxel that it left
            fresh[1:] = (flat[1:] != flat[:-1]) | (beam[1:] != beam[:-1])
            hits += np.bincount(flat[fresh], minlength=len(hits)).astype(hits.dtype)
            start = stop

    return count


@_kernel
def bresenham(o, d, shape, voxel_m, hits):
    """March an integer line between the voxels of both ends, one voxel per step along the longest axis."""
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
    """March as Amanatides and Woo printed it; see :mod:`benchmarks.stability`."""
    del voxel_m
    textbook_march(o, d, shape, hits)


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
    """Count the frames in which each voxel's centre is in a level box; ``counts`` and ``seen`` are (nx, ny, nz)."""
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


def occupancy_by_centre(batch: FrameBoxes, grid: Grid) -> Any:
    """Return the number of frames in which each voxel's centre is in a box, (nx, ny, nz) int32."""
    counts, seen = np.zeros(grid.shape, np.int32), np.full(grid.shape, -1, np.int64)
    centres(batch.frame, batch.values, np.asarray(grid.shape, np.int64), grid.voxel_m, counts, seen)
    return counts


def by_boxes(batch: FrameBoxes, grid: Grid, kernels: Any = occupancy) -> Any:
    """Return the same by ``kernels``: ours, or those with boxes that touch."""
    nx, ny, nz = grid.shape
    steps, seen = np.zeros((nz + 1, nx, ny), np.int32), np.full((3, nx, ny), -1, np.int64)
    kernels.count_boxes(batch.frame, batch.values, np.asarray(grid.shape, np.int64), grid.voxel_m, steps, seen)
    kernels.sum_layers(steps)
    return np.ascontiguousarray(steps[:-1].transpose(1, 2, 0))


def trimesh_caster(triangles: Any) -> Callable[[Any, Any, float], Any]:
    """Return a function from beams ``(o, d, range)`` to their ends, by trimesh's ray caster."""
    from trimesh import triangles as tm_triangles
    from trimesh.ray.ray_triangle import ray_triangle_id

    tree = tm_triangles.bounds_tree(triangles)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.sqrt((normals**2).sum(axis=1))[:, None]

    def cast(o: Any, d: Any, range_m: float) -> Any:
        result = ray_triangle_id(triangles, np.tile(o, (len(d), 1)), d, normals, tree, multiple_hits=False)
        ranges = np.full(len(d), range_m)
        if len(result[1]):
            ranges[result[1]] = np.minimum(((result[2] - o) * d[result[1]]).sum(axis=1), range_m)
        return d * ranges[:, None]

    return cast


def embree_caster(triangles: Any) -> Callable[[Any, Any, float], Any]:
    """Return a function from beams to their ends, by Embree's float32 ranges on the bare triangles."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, triangles.astype(np.float32))

    def cast(o: Any, d: Any, range_m: float) -> Any:
        result = scene.run(np.tile(o.astype(np.float32), (len(d), 1)), d.astype(np.float32), output=True)
        met = result["primID"] >= 0
        return d * np.where(met, np.minimum(result["tfar"].astype(np.float64), range_m), range_m)[:, None]

    return cast


@dataclass
class Junction:
    """The shipped junction, with the occupancy of some hundred frames."""

    grid: Grid
    gamma: float
    world: World
    scene: Scene
    batch: FrameBoxes
    static: Any

    @classmethod
    def shipped(cls) -> Junction:
        """Build statics and simulate traffic."""
        scenario = egvs.load(SCENARIO, [f"traffic.frames={FRAMES}"])
        grid, scene = scenario.roi.grid, egvs.build_scene(scenario)
        filled = static_voxels(scene.world, grid)
        return cls(grid, scenario.gamma, scene.world, scene, recorded_boxes(scenario), filled)

    @property
    def sites(self) -> list[Site]:
        """The compared sites."""
        return [site for site in self.scene.sites if site.name in SITES]

    def scans(self) -> list[tuple[Site, Any]]:
        """Return each site with the ends of its beams."""
        scanner = Scanner(self.scene)
        return [(site, scanner.scan_site(site).rows.ends_m) for site in self.sites]

    @property
    def shape(self) -> Any:
        """Voxels along x, y, z."""
        return np.asarray(self.grid.shape, np.int64)

    def start(self, site: Any) -> Any:
        """Return the position of a sensor, in voxels of the grid's frame."""
        return self.grid.to_grid_m(np.asarray(site.pose.position_m)) / self.grid.voxel_m

    def hits(self, site: Any, ends_m: Any, method: March = traversal.count_hits) -> Any:
        """Return the number of beams in each voxel, flat."""
        result = np.zeros(int(self.shape.prod()), np.uint32)
        method(
            self.start(site), np.ascontiguousarray(ends_m / self.grid.voxel_m), self.shape, self.grid.voxel_m, result
        )
        return result

    def field(self, counts: Any) -> EntropyField:
        """Return the entropy of counted frames."""
        return EntropyField.of(np.where(self.static, 0, counts).astype(np.int64), FRAMES, self.grid)


def error_shares(result: Any, true: Any) -> tuple[float, float, float]:
    """Return the shares of voxels with a wrong count, of missed counts, and of invented counts."""
    off = result.astype(np.int64) - true.astype(np.int64)
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
    error = max(((result - true) / true for result, true in scores), key=abs)
    counts_text = f"missed {missed:.3%}, invented {invented:.3%}"
    off = f"{error:+.2%}" if abs(error) >= 1e-4 else f"{error:+.0e}"
    return what, f"{ratio:.3g} x", f"{voxels:.2%} of voxels wrong", counts_text, f"EGVS {off}"


def march_rows(junction: Junction) -> list[Row]:
    """Compare the traversal of all beams of the sites."""
    scans = junction.scans()
    field = junction.field(by_boxes(junction.batch, junction.grid))
    jobs = [(junction.start(site), np.ascontiguousarray(ends / junction.grid.voxel_m)) for site, ends in scans]
    shape, voxel_m, room = junction.shape, junction.grid.voxel_m, np.zeros(int(junction.shape.prod()), np.uint32)

    def make_work(method: March) -> Callable[[], None]:
        def work() -> None:
            for o, d in jobs:
                method(o, d, shape, voxel_m, room)

        return work

    seconds = median_seconds([make_work(method) for method in MARCHES.values()])
    true = [junction.hits(site, ends) for site, ends in scans]
    result = [_ours(f"march, {', '.join(SITES)}", seconds[0])]
    for (name, method), took in list(zip(MARCHES.items(), seconds, strict=True))[1:]:
        others = [junction.hits(site, ends, method) for site, ends in scans]
        errors = [error_shares(a, b) for a, b in zip(others, true, strict=True)]
        scores = [
            (field.score(a, junction.gamma).egvs, field.score(b, junction.gamma).egvs)
            for a, b in zip(others, true, strict=True)
        ]
        result.append(_row(f"march: {name}", took / seconds[0], errors, scores))
    return result


def occupancy_rows(junction: Junction) -> list[Row]:
    """Compare definitions of occupied voxels."""
    plain = touching_box_kernels()
    methods = {
        "ours": lambda: by_boxes(junction.batch, junction.grid),
        "touching boxes": lambda: by_boxes(junction.batch, junction.grid, plain),
        "voxel centres": lambda: occupancy_by_centre(junction.batch, junction.grid),
    }
    hits = [junction.hits(site, ends) for site, ends in junction.scans()]
    seconds = median_seconds(list(methods.values()))
    true = methods["ours"]()
    field = junction.field(true)
    result: list[Row] = [
        (f"occupancy, {FRAMES} frames: ours", "1 x", f"{seconds[0] * 1e3:.1f} ms", "the reference", "")
    ]
    for (name, method), took in list(zip(methods.items(), seconds, strict=True))[1:]:
        counts = method()
        others = junction.field(counts)
        scores = [(others.score(h, junction.gamma).egvs, field.score(h, junction.gamma).egvs) for h in hits]
        result.append(_row(f"occupancy: {name}", took / seconds[0], [error_shares(counts, true)], scores))
    return result


def cast_rows(junction: Junction) -> list[Row]:
    """Compare casting of beams that can meet the region of interest."""
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

    def make_work(method: Callable[[Any, Any, float], Any], step: int = 1) -> Callable[[], object]:
        return lambda: [method(o, d[::step], range_m) for _, o, d, range_m in jobs]

    step = max(1, min(len(job[2]) for job in jobs) // CAST_BEAMS)
    slow, single = trimesh_caster(triangles), embree_caster(triangles)
    seconds = median_seconds([make_work(ours), make_work(single)])
    start = time.process_time()
    make_work(slow, step)()
    seconds.append((time.process_time() - start) * sum(len(j[2]) for j in jobs) / sum(len(j[2][::step]) for j in jobs))
    methods = (
        ("Embree's float32 ranges", single, 1),
        (f"trimesh with rtree; 1 beam in {step}, scaled", slow, step),
    )
    result = [_ours("cast", seconds[0])]
    for (name, method, every), took in zip(methods, seconds[1:], strict=True):
        errors, scores = [], []
        for site, o, d, range_m in jobs:
            others, true = (junction.hits(site, cast(o, d[::every], range_m)) for cast in (method, ours))
            errors.append(error_shares(others, true))
            scores.append((field.score(others, junction.gamma).egvs, field.score(true, junction.gamma).egvs))
        result.append(_row(f"cast: {name}", took / seconds[0], errors, scores))
    return result


def rows() -> list[tuple[Any, ...]]:
    """Return what, seconds relative to ours, share of wrong voxels, missed and invented counts, error of the score."""
    junction = Junction.shipped()
    return [*march_rows(junction), *occupancy_rows(junction), *cast_rows(junction)]


if __name__ == "__main__":
    for row in rows():
        print(*row, sep=" | ")
