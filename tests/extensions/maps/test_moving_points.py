"""What moved between sweeps from one place, and what stations saw through."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from egvs.core.grid import FloatArray, Roi
from egvs.extensions.maps.point_clouds.moving_points import StationScan, group_by_station, not_shared, seen_through
from egvs.sensors.sensor import Sensor
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster

ROI = Roi((-30.0, -30.0, 0.0), (60.0, 60.0, 6.0))
SCANNER = Sensor("scanner", tuple(np.linspace(-30.0, 20.0, 100).tolist()), (0.0,) * 100, 720, 60.0, "made up")


def world(*boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> World:
    """A plane of 60 m with boxes of a size at a centre; kinds are "ground" and "box"."""
    parts = [trimesh.creation.box((60.0, 60.0, 1.0)).apply_translation((0, 0, -0.5))]
    parts += [trimesh.creation.box(size).apply_translation(centre) for size, centre in boxes]
    vertices = np.concatenate([part.vertices for part in parts])
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)]).astype(np.int32)
    solid = np.repeat(np.arange(len(parts), dtype=np.int32), [len(part.faces) for part in parts])
    return World(vertices, faces, solid, (("ground", "ground"), *((f"box{i}", "box") for i in range(len(boxes)))))


def scan(of: World, station: tuple[float, float, float], seed: int = 0) -> StationScan:
    """What a station measures, with 1 cm of noise."""
    at = np.array(station)
    directions = SCANNER.directions()
    ranges, _ = Caster(of, ROI).first_hits(at - ROI.origin_m, directions)
    hit = np.isfinite(ranges)
    noise = np.random.default_rng(seed).normal(0, 0.01, np.count_nonzero(hit))
    return StationScan(at, at + directions[hit] * (ranges[hit] + noise)[:, None])


WALL = ((20.0, 0.5, 6.0), (0.0, 20.0, 3.0))
CAR = (4.0, 1.8, 1.5)


def on_box(points: FloatArray, centre: tuple[float, float, float]) -> np.ndarray:
    """Points on a car, 0.3 m above the ground or higher."""
    inside = np.abs(points - centre) < np.array(CAR) / 2 + 0.05
    return inside.all(axis=1) & (points[:, 2] > 0.3)


@pytest.mark.slow
def test_car_that_passes_is_removed_from_sweeps() -> None:
    """Ten sweeps from one place; the car is at another place in each."""
    centres = [(-18.0 + 4.5 * i, 8.0, 0.75) for i in range(10)]
    sweeps = [scan(world(WALL, (CAR, centre)), (0.0, -5.0, 3.0), i) for i, centre in enumerate(centres)]
    moving = not_shared(sweeps)
    for sweep, mask, centre in zip(sweeps, moving, centres, strict=True):
        car = on_box(sweep.points_m, centre)
        assert car.sum() > 20
        assert mask[car].all()
        assert mask[~car].mean() < 0.01


@pytest.mark.slow
def test_car_that_stays_is_not_removed_from_sweeps() -> None:
    sweeps = [scan(world(WALL, (CAR, (0.0, 8.0, 0.75))), (0.0, -5.0, 3.0), i) for i in range(10)]
    for sweep, mask in zip(sweeps, not_shared(sweeps), strict=True):
        car = on_box(sweep.points_m, (0.0, 8.0, 0.75))
        assert not mask[car].any()


def test_farthest_range_that_three_sweeps_share() -> None:
    """One beam, ten sweeps, ranges 40 (twice), 30 and 10 (four times each): 30 is the farthest that three share."""
    ranges = [40.0, 40.0, 30.0, 30.1, 30.2, 30.0, 10.0, 10.0, 10.0, 10.0]
    station = np.zeros(3)
    sweeps = [StationScan(station, np.array([[0.05 + r, 0.05 * r, 0.0]])) for r in ranges]
    assert [bool(mask[0]) for mask in not_shared(sweeps)] == [True] * 2 + [False] * 4 + [True] * 4


@pytest.mark.slow
def test_car_in_one_of_four_scans_is_removed() -> None:
    """The other three stations saw the ground where it was; a car that all saw stays, and so does a pole."""
    parked, passing = (8.0, -8.0, 0.75), (-6.0, 4.0, 0.75)
    pole = ((0.2, 0.2, 5.0), (3.0, 6.0, 2.5))
    stations = [(-12.0, -8.0, 2.0), (12.0, -2.0, 2.0), (-12.0, 12.0, 2.0), (10.0, 12.0, 2.0)]
    static = [WALL, (CAR, parked), pole]
    views = [scan(world(*static, *([(CAR, passing)] if i == 0 else [])), at, i) for i, at in enumerate(stations)]
    moving = seen_through(views)
    car = on_box(views[0].points_m, passing)
    assert car.sum() > 100
    assert moving[0][car].mean() > 0.8
    for view, mask in zip(views, moving, strict=True):
        others = ~on_box(view.points_m, passing)
        assert mask[others].mean() < 0.002
        at_pole = np.hypot(view.points_m[:, 0] - 3.0, view.points_m[:, 1] - 6.0) < 0.3
        assert mask[at_pole & others].mean() < 0.02


def test_scans_within_half_a_metre_are_at_one_station() -> None:
    at = [(0.0, 0.0, 2.0), (10.0, 0.0, 2.0), (0.3, 0.3, 2.0), (0.0, 0.0, 2.6)]
    scans = [StationScan(np.array(station), np.zeros((1, 3))) for station in at]
    assert group_by_station(scans) == [[0, 2], [1], [3]]


@pytest.mark.parametrize("count", [0, 1])
def test_sweeps_may_be_empty(count: int) -> None:
    sweeps = [StationScan(np.zeros(3), np.ones((count, 3)))] * 3
    assert [len(mask) for mask in not_shared(sweeps)] == [count] * 3
