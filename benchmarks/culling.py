"""Savings by leaving out triangles and beams that cannot meet.

Compares casters with all triangles of the static world and with only those that a beam can meet, for the shipped
junction, for nine copies of it, and for an empty world. All are timed in turns; the bytes of their scans must be equal.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import egvs
from egvs.artefacts.frame_boxes import FrameBoxes
from egvs.scoring.occupancy import count_occupancy
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster

SCENARIO = Path(__file__).resolve().parent.parent / "scenarios" / "nishishinjuku"
REPEATS = 7


def interleaved_medians(*works: Callable[[], Any]) -> list[float]:
    """Return the median seconds of each call, measured in turns after one call each."""
    times: list[list[float]] = [[] for _ in works]
    for work in works:
        work()
    for _ in range(REPEATS):
        for taken, work in zip(times, works, strict=True):
            start = time.perf_counter()
            work()
            taken.append(time.perf_counter() - start)
    return [statistics.median(taken) for taken in times]


def nine_copies(world: World, spacing_m: float = 700.0) -> World:
    """Return the world and eight copies around it."""
    steps = sorted(((x, y, 0) for x in (-1, 0, 1) for y in (-1, 0, 1)), key=np.linalg.norm)
    vertices = np.concatenate([world.vertices_m + spacing_m * np.array(step) for step in steps])
    faces = np.concatenate([world.faces + i * len(world.vertices_m) for i in range(9)]).astype(np.int32)
    return World(vertices, faces, np.tile(world.solid_of_face, 9), world.solids)


def rows() -> list[tuple[str, str, str, bool]]:
    """Return name, ratio, limit, and whether the limit holds."""
    return [
        *_world_rows("junction", lambda world: world),
        *_world_rows("city of nine", nine_copies),
        *_beam_rows(),
        *_flat_box_rows(),
    ]


def _beam_rows() -> list[tuple[str, str, str, bool]]:
    """Only beams that can meet the region of interest are cast."""
    scenario = egvs.load(SCENARIO)
    roi, scene = scenario.roi.box, egvs.build_scene(scenario)
    sensor = scene.sensor(scene.sites[0].sensor)
    directions, range_m = sensor.directions(), sensor.range_m
    caster = Caster(scene.world, roi, np.array([site.pose.position_m for site in scene.sites]), range_m)
    starts = [np.asarray(site.pose.position_m) - np.asarray(roi.origin_m) for site in scene.sites]
    scans = [caster.scan(site.pose.position_m, directions, range_m) for site in scene.sites]
    same = True
    for start, scan in zip(starts, scans, strict=True):
        ranges = np.minimum(caster.first_hits(start, directions, range_m)[0], range_m)
        same &= (directions * ranges[:, None])[scan.beam].tobytes() == scan.ends_m.tobytes()
    seconds = interleaved_medians(
        lambda: [
            caster.first_hits(start, directions[scan.beam], range_m) for start, scan in zip(starts, scans, strict=True)
        ],
        lambda: [caster.first_hits(start, directions, range_m) for start in starts],
    )
    share = sum(len(scan.beam) for scan in scans) / (len(directions) * len(scans))
    return [
        ("beams that can meet the region", f"{share:.0%}", "same bytes", same),
        ("  casting these / all", f"{seconds[0] / seconds[1]:.2f}", "1", seconds[0] <= seconds[1]),
    ]


def _flat_box_rows() -> list[tuple[str, str, str, bool]]:
    """Flat boxes take the flat path."""
    grid = egvs.load(SCENARIO).roi.grid
    rng, n = np.random.default_rng(5), 20_000
    centres = np.column_stack([rng.uniform(0, 100, n), rng.uniform(0, 50, n), np.full(n, 0.75)])
    sizes = np.tile([4.5, 1.75, 1.5], (n, 1))
    flat = FrameBoxes(np.arange(n) // 20, np.column_stack([centres, rng.uniform(-3, 3, n), np.zeros(n), sizes]))
    tipped = FrameBoxes(flat.frame, flat.values + np.array([0, 0, 0, 0, 1e-15, 0, 0, 0]))
    same = np.array_equal(count_occupancy(flat, grid, n // 20), count_occupancy(tipped, grid, n // 20))
    seconds = interleaved_medians(
        lambda: count_occupancy(flat, grid, n // 20), lambda: count_occupancy(tipped, grid, n // 20)
    )
    return [
        (
            "flat boxes: flat path / separating axes",
            f"{seconds[0] / seconds[1]:.3f}",
            "1, same counts",
            same and seconds[0] <= seconds[1],
        )
    ]


def _world_rows(name: str, enlarge: Callable[[World], World]) -> list[tuple[str, str, str, bool]]:
    scenario = egvs.load(SCENARIO)
    roi, scene = scenario.roi.box, egvs.build_scene(scenario)
    world = enlarge(scene.world)
    sites = np.array([site.pose.position_m for site in scene.sites])
    nothing = World(np.empty((0, 3)), np.empty((0, 3), np.int32), np.empty(0, np.int32), ())
    sensor = scene.sensor(scene.sites[0].sensor)
    directions, range_m = sensor.directions(), sensor.range_m
    culled, complete, empty = Caster(world, roi, sites, range_m), Caster(world, roi), Caster(nothing, roi)

    def cast(caster: Caster) -> list[bytes]:
        scans = (caster.scan(site.pose.position_m, directions, range_m) for site in scene.sites)
        return [scan.ends_m.tobytes() + scan.returned.tobytes() for scan in scans]

    same = cast(culled) == cast(complete)
    build = interleaved_medians(
        lambda: Caster(world, roi, sites, range_m), lambda: Caster(world, roi), lambda: Caster(nothing, roi)
    )
    casting = interleaved_medians(lambda: cast(culled), lambda: cast(complete), lambda: cast(empty))
    share = len(culled._triangles) / len(complete._triangles)
    return [
        (f"{name}: triangles that a beam can meet", f"{share:.0%} of {len(complete._triangles)}", "same bytes", same),
        ("  building, with / without culling", f"{build[0] / build[1]:.2f}", "1.1", build[0] <= 1.1 * build[1]),
        (
            "  casting 13 sites, with / without culling",
            f"{casting[0] / casting[1]:.2f}",
            "1.1",
            casting[0] <= 1.1 * casting[1],
        ),
        ("  no geometry, building / with geometry", f"{build[2] / build[1]:.3f}", "0.1", build[2] <= 0.1 * build[1]),
        (
            "  no geometry, casting / with geometry",
            f"{casting[2] / casting[1]:.2f}",
            "0.6",
            casting[2] <= 0.6 * casting[1],
        ),
    ]


if __name__ == "__main__":
    for row in rows():
        print(*row, sep=" | ")
