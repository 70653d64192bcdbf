"""What do hits that float64 decides cost, against Embree alone?

For all sites of a shipped scenario, in interleaved runs: Embree alone on the bare triangles; Embree on the triangles
with their rims and fins; placing the hits in float64 (``settle``); searching the doubtful beams (``search``); and the
whole cast, with the choice of the beams that can meet the region of interest. Ratios are medians over the rounds, each
against Embree alone in the same round.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import pipeline
from pipeline.kernels import rays
from pipeline.sensing import sensors, sites
from pipeline.world import static_world
from pipeline.world.casting import Caster

_SCENARIOS = Path(__file__).resolve().parent.parent / "scenarios"
_ROUNDS = 21


def _work(name: str) -> tuple[dict[str, Callable[[], Any]], int, int]:
    """What is timed, how many beams each does, and how many of them are doubtful."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scenario = pipeline.load(_SCENARIOS / name)
    world = static_world.build(scenario)[0]
    caster, origin = Caster(world, scenario.roi.box), np.asarray(scenario.roi.box.origin_m)
    bare = EmbreeScene()
    TriangleMesh(bare, caster._triangles.astype(np.float32))
    jobs = []
    for site in sites.of(scenario):
        sensor = sensors.of_scenario(site.sensor, scenario, site.name)
        directions = sensor.directions(*site.pose.angles_deg)
        position = np.asarray(site.pose.position_m)
        d = directions[caster.scan(site.pose.position_m, directions, sensor.range_m).beam]
        start, single = np.tile((position - origin).astype(np.float32), (len(d), 1)), d.astype(np.float32)
        nearest = caster._scene.run(start, single)
        ranges, met, doubtful = np.empty(len(d)), *(np.empty(len(d), dtype=np.int64) for _ in range(2))
        count = rays.settle(
            nearest,
            caster._owner,
            caster._triangles,
            caster._planes,
            position - origin,
            d,
            sensor.range_m,
            ranges,
            met,
            doubtful,
        )
        jobs.append(
            (
                site.pose.position_m,
                directions,
                sensor.range_m,
                position - origin,
                d,
                start,
                single,
                nearest,
                ranges,
                met,
                doubtful,
                count,
            )
        )

    def settle() -> None:
        for _, _, range_m, o, d, _start, _single, nearest, ranges, met, doubtful, _count in jobs:
            rays.settle(nearest, caster._owner, caster._triangles, caster._planes, o, d, range_m, ranges, met, doubtful)

    def search() -> None:
        for *_, o, d, _start, _single, _nearest, ranges, met, doubtful, count in jobs:
            rays.search(
                doubtful[:count], caster._triangles, caster._planes, caster._boxes, caster._starts, o, d, ranges, met
            )

    work: dict[str, Callable[[], Any]] = {
        "Embree alone": lambda: [bare.run(job[5], job[6]) for job in jobs],
        "Embree with rims and fins": lambda: [caster._scene.run(job[5], job[6]) for job in jobs],
        "settle: hits placed in float64": settle,
        "search: doubtful beams": search,
        "whole cast": lambda: [caster.scan(*job[:3]) for job in jobs],
    }
    return work, sum(len(job[4]) for job in jobs), sum(job[-1] for job in jobs)


def rows() -> list[tuple[Any, ...]]:
    """A line for each part: what, times Embree alone, share of the whole cast."""
    found: list[tuple[Any, ...]] = []
    for name in ("nishishinjuku", "ingolstadt"):
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
