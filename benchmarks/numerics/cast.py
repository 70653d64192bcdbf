"""Check that no beam leaks, and that each ends on the surface that it truly meets first.

Scenes with known answers, adversarial ones compared with a float64 brute force over all triangles, and every beam of
every site of the shipped scenarios.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from tests.oracles import cast

import egvs
from benchmarks.numerics.row import Row
from egvs.core.grid import Roi
from egvs.scenario.model import Scenario
from egvs.sensors import sensor, sites
from egvs.sensors.sensor import scenario_sensor
from egvs.world import static_world
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster

Floats = NDArray[np.float64]

_SCENARIOS = Path(__file__).resolve().parent.parent.parent / "scenarios"
_SHIPPED = ("nishishinjuku", "ingolstadt")
_ROI = Roi((0.0, 0.0, 0.0), (100.0, 100.0, 10.0))
_CENTRE = np.array([50.0, 50.0, 5.0])
_RANGE_RULE = "range within 1 mm of the true range, no leak"
_FIRST_RULE = "first triangle hit, including 1 micrometre around its edges"


def rows(scale: float) -> list[Row]:
    """Run all checks; ``scale`` 1 casts some ten million rays."""
    rng = np.random.default_rng(20_240_501)
    ranges = [
        _walls(rng, scale), _two_walls(rng, scale), _pole(rng, scale), _box(rng, scale), _sphere(),
        *_surfaces(rng, scale), _slivers(rng, scale), _t_junction(rng, scale), _on_a_wall(rng, scale),
        _scenes(rng, scale, True), _scenes(rng, scale, False),
    ]  # fmt: skip
    for name in _SHIPPED:
        ranges += [_shipped(name, scale), _aimed(name, rng, scale)]
    return ranges


def _caster(triangles: Floats) -> Caster:
    vertices = np.asarray(triangles, dtype=np.float64).reshape(-1, 3)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return Caster(World(vertices, faces, np.zeros(len(faces), dtype=np.int32), (("scene", "hunt"),)), _ROI)


def _scaled(scale: float, full: int) -> int:
    return max(200, round(full * scale))


def _unit(v: Floats) -> Floats:
    unit: Floats = v / np.linalg.norm(v, axis=1)[:, None]
    return unit


def _compare_ranges(case: str, ranges: Floats, true: Floats) -> Row:
    """Return a row for ranges that are known from geometry."""
    error = np.where(np.isfinite(ranges), np.abs(ranges - true), np.inf)
    met = error[np.isfinite(error)].max(initial=0.0)
    leaks = int(np.isinf(error).sum())
    return Row(case, _RANGE_RULE, "geometry", len(ranges), 0, int((error > 1e-3).sum()), f"{met:.1e} m, {leaks} leaks")


def _quad(*corners: list[float]) -> Floats:
    a, b, c, d = corners
    return np.array([[a, b, c], [a, c, d]], dtype=np.float64)


def _rotation(degrees: float) -> Floats:
    turn: Floats = trimesh.transformations.rotation_matrix(np.radians(degrees), [0, 0, 1])[:3, :3]
    return turn


def _walls(rng: np.random.Generator, scale: float) -> Row:
    parts = []
    for degrees in (0.0, 37.0, 90.0, 123.4):
        turn, n = _rotation(degrees), _scaled(scale, 250_000)
        wall = _quad([-50, 0.2, -5], [250, 0.2, -5], [250, 0.2, 5], [-50, 0.2, 5]) @ turn.T + _CENTRE
        angle, tilt = np.radians(0.1 + 89.9 * rng.random(n) ** 4), np.radians(rng.uniform(-1, 1, n))
        d = np.column_stack([np.cos(tilt) * np.cos(angle), np.cos(tilt) * np.sin(angle), np.sin(tilt)])
        parts.append((_caster(wall).first_hits(_CENTRE, d @ turn.T)[0], 0.2 / d[:, 1]))
    ranges, true = (np.concatenate(part) for part in zip(*parts, strict=True))
    return _compare_ranges("a wall of 300 m seen at 0.1 to 90 degrees", ranges, true)


def _two_walls(rng: np.random.Generator, scale: float) -> Row:
    far, near = (_quad([-400, y, 0], [400, y, 0], [400, y, 10], [-400, y, 10]) for y in (50.002, 50.001))
    angle = np.radians(0.1 + 89.9 * rng.random(_scaled(scale, 1_000_000)) ** 4)
    d = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    ranges, _ = _caster(np.concatenate([far, near])).first_hits(np.array([10.3, 50.0005, 5.0]), d)
    return _compare_ranges("two walls 1 mm apart, 0.1 to 90 degrees", ranges, 0.0005 / d[:, 1])


def _pole(rng: np.random.Generator, scale: float) -> Row:
    o = np.array([0.0, 50.0, 5.0])
    pole = trimesh.creation.box((0.1, 0.1, 8.0)).triangles + np.array([150.05, 50.0, 5.0])
    y = rng.uniform(-0.1, 0.1, _scaled(scale, 1_000_000))
    near = np.abs(np.abs(y) - 0.05) < 2e-6
    ranges, _ = _caster(pole).first_hits(o, _unit(np.column_stack([np.full(len(y), 150.0), y, np.full(len(y), -0.1)])))
    met = np.abs(y) < 0.05
    error = np.abs(ranges - np.sqrt(150.0**2 + y**2 + 0.01))[np.isfinite(ranges) & met & ~near]
    wrong = int(((np.isfinite(ranges) != met) & ~near).sum()) + int((error > 1e-3).sum())
    return Row(
        "a pole of 0.1 m at 150 m", _RANGE_RULE, "geometry", len(y), int(near.sum()), wrong, f"{error.max():.1e} m"
    )


def _box(rng: np.random.Generator, scale: float) -> Row:
    low, high, o = np.array([10.0, 20.0, 1.0]), np.array([70.0, 90.0, 8.0]), np.array([33.3, 44.4, 5.5])
    n = _scaled(scale, 1_000_000)
    free = np.eye(3)[rng.integers(0, 3, n // 5)] > 0
    edges = low + (high - low) * np.where(free, rng.random((n // 5, 1)), rng.integers(0, 2, (n // 5, 3)))
    d = np.concatenate([_unit(rng.normal(size=(n, 3))), _unit(edges - o)])
    with np.errstate(divide="ignore"):
        true = np.where(d > 0, (high - o) / d, np.where(d < 0, (low - o) / d, np.inf)).min(axis=1)
    ranges, _ = _caster(trimesh.creation.box(high - low).triangles + (low + high) / 2).first_hits(o, d)
    return _compare_ranges("a closed box from inside, a sixth aimed at its edges", ranges, true)


def _sphere() -> Row:
    """Check a sphere around the origin, where float32 is finest and Embree alone leaks most."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=10.0)
    o, caster = np.array([3.0, 2.0, 1.0]), _caster(ball.triangles)
    targets = np.concatenate([ball.vertices, ball.vertices[ball.edges_unique].mean(axis=1)])
    row = _compare_ranges(
        "a closed sphere of 20,480 triangles, aimed at each vertex and edge", *_ranges_to(caster, o, targets)
    )
    leaks = _bare_leaks(ball.triangles, o, targets[: len(ball.vertices)])
    return replace(row, worst=f"{row.worst} (Embree alone: {leaks} of {len(ball.vertices)} vertices)")


def _bare_leaks(triangles: Floats, o: Floats, targets: Floats) -> int:
    """Return how many rays pass through the mesh in Embree alone."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, triangles.astype(np.float32))
    d = _unit(targets - o).astype(np.float32)
    return int((scene.run(np.tile(o.astype(np.float32), (len(d), 1)), d) < 0).sum())


def _ranges_to(caster: Caster, o: Floats, targets: Floats) -> tuple[Floats, Floats]:
    """Return cast and true ranges of rays to points of a surface that nothing hides."""
    return caster.first_hits(o, _unit(targets - o))[0], np.linalg.norm(targets - o, axis=1)


def _surfaces(rng: np.random.Generator, scale: float) -> Iterator[Row]:
    """Check a plane of many triangles at grazing angles, aimed at edges and corners."""
    for graze_deg in (0.1, 0.5, 2.0, 30.0):
        parts = []
        for size_m in (20.0, 80.0, 200.0):
            turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
            at = np.linspace(-size_m / 2, size_m / 2, 41)
            points = np.stack([*np.meshgrid(at, at, indexing="ij"), np.zeros((41, 41))], axis=-1) @ turn.T + _CENTRE
            a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
            surface = np.concatenate([np.stack(three, axis=-2).reshape(-1, 3, 3) for three in ((a, b, c), (a, c, d))])
            o = turn @ np.array([-0.2 * size_m, 0.033 * size_m, np.tan(np.radians(graze_deg)) * 0.4 * size_m]) + _CENTRE
            n = _scaled(scale, 100_000)
            chosen, side, s = rng.integers(0, len(surface), n), rng.integers(0, 3, n), rng.random((n, 1))
            s[: n // 4] = 0.0
            parts.append(
                _ranges_to(_caster(surface), o, surface[chosen, side] * (1 - s) + surface[chosen, (side + 1) % 3] * s)
            )
        ranges, true = (np.concatenate(part) for part in zip(*parts, strict=True))
        yield _compare_ranges(
            f"edges and corners of 3,200 coplanar triangles, seen at {graze_deg:g} degrees", ranges, true
        )


def _slivers(rng: np.random.Generator, scale: float) -> Row:
    parts, count, tip, o = [], 600, np.array([100.0, 50.0, 5.0]), np.array([30.0, 50.123, 1.0])
    for width in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7):
        rim = np.column_stack(
            [np.zeros(count + 1), 50 + (np.arange(count + 1) - count / 2) * width, np.full(count + 1, 5.0)]
        )
        fan = np.stack([rim[:-1], rim[1:], np.broadcast_to(tip, (count, 3))], axis=1)
        n = _scaled(scale, 20_000)
        s = rng.random((n, 1)) * 0.99
        parts.append(
            _ranges_to(_caster(fan), o, tip * s + (rim[[0]] + rng.random((n, 1)) * (rim[[-1]] - rim[[0]])) * (1 - s))
        )
    ranges, true = (np.concatenate(part) for part in zip(*parts, strict=True))
    return _compare_ranges("a fan of needles 100 m long, 0.1 m to 0.1 micrometres wide", ranges, true)


def _t_junction(rng: np.random.Generator, scale: float) -> Row:
    at = np.array([0.0, 1 / 3, 0.7, 1.0])
    side = np.array([20.0, 10.0, 2.0]) + at[:, None] * np.array([50.0, 70.0, 6.0])
    left, right = np.array([10.0, 80.0, 5.0]), np.array([80.0, 20.0, 6.0])
    scene = np.concatenate([[[side[0], side[3], left]], [[side[i], right, side[i + 1]] for i in range(3)]])
    s = np.concatenate([rng.uniform(0.001, 0.999, (_scaled(scale, 200_000), 1)), at[1:3, None]])
    return _compare_ranges(
        "T-junctions", *_ranges_to(_caster(scene), np.array([40.0, 50.0, 20.0]), side[0] + s * (side[3] - side[0]))
    )


def _on_a_wall(rng: np.random.Generator, scale: float) -> Row:
    directions, cases, wrong = sensor.CATALOGUE["VLP-16"].directions()[::7], 0, 0
    for _ in range(_scaled(scale, 1000) // 10):
        turn, away = _rotation(rng.uniform(0, 360)), rng.choice([-1e-9, -1e-13, 0.0, 1e-13, 1e-9])
        house = trimesh.creation.box((10, 8, 6)).triangles @ turn.T + _CENTRE
        outwards = directions[directions @ turn[:, 0] > 1e-3]
        ranges, _ = _caster(house).first_hits(turn @ np.array([5.0 + away, *rng.uniform(-2, 2, 2)]) + _CENTRE, outwards)
        cases, wrong = cases + len(outwards), wrong + int(np.isfinite(ranges).sum())
    rule = "a plane within 1 micrometre of the sensor is not hit"
    return Row("a sensor on an oblique wall", rule, "geometry", cases, 0, wrong, f"{wrong} beams blocked")


def _scenes(rng: np.random.Generator, scale: float, lattice: bool) -> Row:
    """Check small scenes; rays are aimed at corners, edges, faces and random points."""
    cases, wrong, worst = 0, 0, 0.0
    for _ in range(_scaled(scale, 4000) // 4):
        if lattice:
            scene, o = rng.integers(0, 9, (20, 3, 3)) * 1.25, rng.integers(0, 9, 3) * 1.25 + np.array([0.3, 0.2, 0.1])
        else:
            scene = rng.random((60, 1, 3)) * [100, 100, 10] + rng.normal(size=(60, 3, 3)) * 10.0 ** rng.uniform(-2, 1.6)
            noise = rng.normal(size=(20, 3)) * 10.0 ** rng.uniform(-6, 0)
            scene[::3, 2] = scene[::3, 0] + (scene[::3, 1] - scene[::3, 0]) * rng.random((20, 1)) + noise
            o = np.array([50.0, 50.0, 20.0])
        inside = (scene * rng.dirichlet([1, 1, 1], len(scene))[:, :, None]).sum(axis=1)
        targets = np.concatenate([scene.reshape(-1, 3), scene[:, :2].mean(axis=1), inside, rng.random((100, 3)) * 100])
        d = _unit(targets - o)
        ranges, (true, _) = _caster(np.asarray(scene, np.float64)).first_hits(o, d)[0], cast.first_hits(o, d, scene)
        cases, wrong = cases + len(d), wrong + int(cast.differ(ranges, true, 1e-5).sum())
        both = np.isfinite(ranges) & np.isfinite(true)
        worst = max(worst, float(np.abs(ranges[both] - true[both]).max(initial=0.0)))
    name = "random scenes on a coarse lattice" if lattice else "random scenes, needles down to 1 micrometre"
    return Row(
        f"{name}, aimed at corners, edges, faces", _FIRST_RULE, "float64 brute force", cases, 0, wrong, f"{worst:.1e} m"
    )


def _scene(name: str) -> tuple[Scenario, Caster, Floats]:
    scenario = egvs.load(_SCENARIOS / name)
    world = static_world.build_world(scenario)[0]
    return scenario, Caster(world, scenario.roi.box), world.triangles_m - np.asarray(scenario.roi.box.origin_m)


def _compare(case: str, jobs: Iterator[tuple[Caster, Floats, Floats, Floats]]) -> Row:
    """Compare rays with all triangles; surfaces less than 1 mm behind the first are counted as excluded."""
    cases, wrong, close, gap, worst = 0, 0, 0, 0.0, 0.0
    for caster, triangles, o, d in jobs:
        ranges, (true, _) = caster.first_hits(o, d)[0], cast.first_hits(o, d, triangles)
        other, apart = cast.differ(ranges, true), np.full(len(d), np.inf)
        both = np.isfinite(ranges) & np.isfinite(true)
        apart[both] = np.abs(ranges[both] - true[both])
        near = np.flatnonzero(other & both)
        close, wrong = close + int((apart[near] < 1e-3).sum()), wrong + int((apart[other] >= 1e-3).sum())
        cases += len(d)
        gap, worst = (
            max(gap, float(apart[near].max(initial=0.0))),
            max(worst, float(apart[both & ~other].max(initial=0.0))),
        )
    figure = f"{worst:.1e} m; other surface: {close + wrong}, up to {gap:.1e} m"
    return Row(case, _FIRST_RULE, "float64 brute force", cases, close, wrong, figure)


def _shipped(name: str, scale: float) -> Row:
    scenario, caster, triangles = _scene(name)
    step = max(1, round(1 / scale))

    def jobs() -> Iterator[tuple[Caster, Floats, Floats, Floats]]:
        for site in sites.candidate_sites(scenario):
            sensor = scenario_sensor(site.sensor, scenario, site.name)
            d = sensor.directions(*site.pose.angles_deg)
            selected = caster.scan(site.pose.position_m, d, sensor.range_m).beam[::step]
            yield (
                caster,
                triangles,
                np.asarray(site.pose.position_m) - np.asarray(scenario.roi.box.origin_m),
                d[selected],
            )

    return _compare(f"{name}: {'every beam' if step == 1 else f'one in {step} beams'} of every site", jobs())


def _aimed(name: str, rng: np.random.Generator, scale: float) -> Row:
    scenario, caster, triangles = _scene(name)
    places = sites.candidate_sites(scenario)

    def jobs() -> Iterator[tuple[Caster, Floats, Floats, Floats]]:
        for site in places:
            n = _scaled(scale, 300_000 // len(places))
            chosen, side, s = rng.integers(0, len(triangles), n), rng.integers(0, 3, n), rng.random((n, 1))
            on_side = triangles[chosen, side] * (1 - s) + triangles[chosen, (side + 1) % 3] * s
            o = np.asarray(site.pose.position_m) - np.asarray(scenario.roi.box.origin_m)
            yield caster, triangles, o, _unit(on_side + rng.normal(size=(n, 3)) * 1e-3 - o)

    return _compare(f"{name}: aimed within a few mm of triangle edges", jobs())


def main() -> Any:
    """Run this part alone: python -m benchmarks.numerics.cast."""
    for row in rows(0.01):
        print(row)


if __name__ == "__main__":
    main()
