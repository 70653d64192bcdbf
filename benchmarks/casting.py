"""What do hits that float64 decides cost, against Embree alone?

For all sites of a shipped scenario, in interleaved runs: Embree alone on the bare triangles, one ray after the other as
embreex asks it, and eight at a time as the cast does; Embree on the triangles with their rims and fins; placing the
hits in float64 (``settle``); searching the doubtful beams (``search``); and the whole cast, with the choice of the
beams that can meet the region of interest. Ratios are medians over the rounds, each against Embree alone in the same
round.
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
_ROUNDS = 21


def _work(name: str) -> tuple[dict[str, Callable[[], Any]], int, int]:
    """What is timed, how many beams each does, and how many of them are doubtful."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scenario = egvs.load(_SCENARIOS / name)
    places = sites.candidate_sites(scenario)
    start_m = np.array([site.pose.position_m for site in places])
    caster, origin = (
        Caster(build_scene(scenario).world, scenario.roi.box, start_m),
        np.asarray(scenario.roi.box.origin_m),
    )
    bare, packets = EmbreeScene(), TriangleTree(caster._triangles)
    TriangleMesh(bare, caster._triangles.astype(np.float32))
    assert caster._tree is not None
    tree = caster._tree
    jobs = []
    for site in places:
        sensor = scenario_sensor(site.sensor, scenario, site.name)
        directions = sensor.directions(*site.pose.angles_deg)
        beam = caster.scan(site.pose.position_m, directions, sensor.range_m).beam
        o, single = np.asarray(site.pose.position_m) - origin, directions[beam].astype(np.float32)
        start, count = np.tile(o.astype(np.float32), (len(beam), 1)), len(beam)
        mesh = ray_triangle.TriangleMesh(caster._triangles, caster._planes)
        rays = ray_triangle.Rays(o, beam, directions, sensor.range_m)
        filled = np.empty(count), np.empty(count, dtype=np.int64)
        ends, doubtful = (np.empty((count, 3)), np.empty(count, dtype=np.bool_)), np.empty(count, dtype=np.int64)
        hits = ray_triangle.Hits(*filled, *ends)
        settled = (tree.nearest(o, beam, directions), caster._owner, mesh, rays, hits, doubtful)
        some = doubtful[: ray_triangle.resolve_hits(*settled)]
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
        for asked, *_ in jobs:  # each is let go before the next is made, as a run does
            caster.scan(*asked)

    work: dict[str, Callable[[], Any]] = {
        "Embree alone": lambda: [bare.run(*ray) for _, ray, *_ in jobs],
        "Embree alone, eight beams at a time": lambda: [packets.nearest(*ray) for _, _, ray, *_ in jobs],
        "Embree with rims and fins": lambda: [tree.nearest(*ray) for _, _, ray, *_ in jobs],
        "settle: hits placed in float64": lambda: [ray_triangle.resolve_hits(*settled) for *_, settled, _ in jobs],
        "search: doubtful beams": lambda: [ray_triangle.search_triangles(*searched) for *_, searched in jobs],
        "whole cast": cast,
    }
    return work, sum(len(ray[0]) for _, ray, *_ in jobs), sum(len(searched[0]) for *_, searched in jobs)


def rows() -> list[tuple[Any, ...]]:
    """A line for each part: what, times Embree alone, share of the whole cast."""
    found: list[tuple[Any, ...]] = []
    for name in ("nishishinjuku", "ingolstadt", "hill", "roundabout"):
        work, beams, doubtful = _work(name)
        times: dict[str, list[float]] = {part: [] for part in work}
        for _ in range(_ROUNDS):
            for part, do in work.items():
                start = time.perf_counter()
                do()
                times[part].append(time.perf_counter() - start)
        for part in work:
            against = [
                statistics.median(a / b for a, b in zip(times[part], times[base], strict=True))
                for base in (next(iter(work)), "whole cast")
            ]
            found.append((f"{name}: {part}", f"{against[0]:.2f} x Embree alone", f"{against[1]:.1%} of the cast"))
        found.append((f"{name}: {doubtful} of {beams} beams were doubtful", f"{doubtful / beams:.2%}"))
    return found


if __name__ == "__main__":
    for row in rows():
        print(*row, sep="   ")
