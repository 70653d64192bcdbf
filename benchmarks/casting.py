"""Cost of hits that float64 decides, compared with Embree alone.

For all sites of some shipped scenarios, timed in turns: Embree alone on the bare triangles, one ray at a time as in
embreex, and eight at a time as in our caster; Embree on triangles with rims and fins; placing the hits in float64;
searching uncertain beams; and the complete cast, with the selection of beams that can meet the region of interest.
Ratios are medians over the rounds, each relative to Embree alone in the same round.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import egvs
from egvs.kernels import ray_triangle
from egvs.kernels.embree import TriangleTree
from egvs.sensors import sites
from egvs.sensors.sensor import scenario_sensor
from egvs.stages.inputs import build_scene
from egvs.world.ray_casting import Caster

_SCENARIOS = Path(__file__).resolve().parent.parent / "scenarios"
_ROUNDS = 7


def _work(name: str) -> tuple[dict[str, Callable[[], Any]], int, int]:
    """Return what is timed, the number of beams, and how many of them are uncertain."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scenario = egvs.load(_SCENARIOS / name)
    candidates = sites.candidate_sites(scenario)
    start_m = np.array([site.pose.position_m for site in candidates])
    caster, origin = (
        Caster(build_scene(scenario).world, scenario.roi.box, start_m),
        np.asarray(scenario.roi.box.origin_m),
    )
    bare, packets = EmbreeScene(), TriangleTree(caster._triangles)
    TriangleMesh(bare, caster._triangles.astype(np.float32))
    assert caster._tree is not None
    tree = caster._tree
    jobs = []
    for site in candidates:
        sensor = scenario_sensor(site.sensor, scenario, site.name)
        directions = sensor.directions(*site.pose.angles_deg)
        beam = caster.scan(site.pose.position_m, directions, sensor.range_m).beam
        o, single = np.asarray(site.pose.position_m) - origin, directions[beam].astype(np.float32)
        start, count = np.tile(o.astype(np.float32), (len(beam), 1)), len(beam)
        mesh = ray_triangle.TriangleMesh(caster._triangles, caster._planes)
        rays = ray_triangle.Rays(o, beam, directions, sensor.range_m)
        filled = np.empty(count), np.empty(count, dtype=np.int64)
        ends, ambiguous = (np.empty((count, 3)), np.empty(count, dtype=np.bool_)), np.empty(count, dtype=np.int64)
        hits = ray_triangle.Hits(*filled, *ends)
        settled = (tree.nearest(o, beam, directions), caster._owner, mesh, rays, hits, ambiguous)
        some = ambiguous[: ray_triangle.resolve_hits(*settled)]
        searched = (some, mesh, ray_triangle.BoxTree(caster._boxes, caster._level_starts), rays, hits)
        jobs.append(
            (
                (site.pose.position_m, directions, sensor.range_m),
                (start, single),
                (o, beam, directions),
                settled,
                searched,
            )
        )

    def cast() -> None:
        for scan_arguments, *_ in jobs:  # each scan is freed before the next, as in a run
            caster.scan(*scan_arguments)

    work: dict[str, Callable[[], Any]] = {
        "Embree alone": lambda: [bare.run(*ray) for _, ray, *_ in jobs],
        "Embree alone, eight beams at a time": lambda: [packets.nearest(*ray) for _, _, ray, *_ in jobs],
        "Embree with rims and fins": lambda: [tree.nearest(*ray) for _, _, ray, *_ in jobs],
        "hits placed in float64": lambda: [ray_triangle.resolve_hits(*settled) for *_, settled, _ in jobs],
        "search of uncertain beams": lambda: [ray_triangle.search_triangles(*searched) for *_, searched in jobs],
        "complete cast": cast,
    }
    return work, sum(len(ray[0]) for _, ray, *_ in jobs), sum(len(searched[0]) for *_, searched in jobs)


def rows() -> list[tuple[Any, ...]]:
    """Return a row for each part: what, ratio to Embree alone, and share of the complete cast."""
    table: list[tuple[Any, ...]] = []
    for name in ("nishishinjuku", "ingolstadt", "hill", "roundabout"):
        work, beams, ambiguous = _work(name)
        times: dict[str, list[float]] = {part: [] for part in work}
        for _ in range(_ROUNDS):
            for part, do in work.items():
                start = time.perf_counter()
                do()
                times[part].append(time.perf_counter() - start)
        for part in work:
            against = [
                statistics.median(a / b for a, b in zip(times[part], times[base], strict=True))
                for base in (next(iter(work)), "complete cast")
            ]
            table.append((f"{name}: {part}", f"{against[0]:.2f} x Embree alone", f"{against[1]:.1%} of the cast"))
        table.append((f"{name}: {ambiguous} of {beams} beams were uncertain", f"{ambiguous / beams:.2%}"))
    return table


if __name__ == "__main__":
    for row in rows():
        print(*row, sep="   ")
