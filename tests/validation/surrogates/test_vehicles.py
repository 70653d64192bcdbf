"""Points on vehicles: against a twin that puts each beam to each box by itself, in float64 and without any shortcut."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pipeline.core.grid import Grid
from pipeline.scoring.visibility import Beams
from pipeline.sensing import sensors
from pipeline.sensing.sites import Pose
from pipeline.validation.frames import TrafficFrame
from pipeline.validation.surrogates.vehicles import points_on_vehicles

GRID = Grid((100.0, 200.0, 0.0), 1.0, (40, 20, 5))
SENSOR = sensors.CATALOGUE["VLP-16"]


def frame(boxes, kinds=None, pitch=None, number=0):
    boxes = np.array(boxes, dtype=np.float64).reshape(-1, 7)
    kinds = ("passenger",) * len(boxes) if kinds is None else kinds
    pitch = np.zeros(len(boxes)) if pitch is None else np.array(pitch)
    return TrafficFrame(number, tuple(f"v{i}" for i in range(len(boxes))), tuple(kinds), boxes, pitch)


def entered_m(box, pitch, origin, direction):
    """Where a ray enters a box that is 0.1 mm smaller on each side; infinity where it does not."""
    x, y, z, length, width, height, yaw = box
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    axes = [(cy * cp, sy * cp, sp), (-sy, cy, 0.0), (-cy * sp, -sy * sp, cp)]
    near, far = 0.0, math.inf
    for axis, size in zip(axes, (length, width, height), strict=True):
        along = sum(a * d for a, d in zip(axis, direction, strict=True))
        off = sum(a * (o - c) for a, o, c in zip(axis, origin, (x, y, z), strict=True))
        half = size / 2 - 1e-4
        if along == 0.0:
            if abs(off) >= half:
                return math.inf
            continue
        ends = sorted(((-half - off) / along, (half - off) / along))
        near, far = max(near, ends[0]), min(far, ends[1])
    return near if near < far else math.inf


def counted_slowly(one, beams):
    """(seen, alone) of every box of a frame."""
    origin, seen, alone = beams.pose.position_m, np.zeros(len(one.boxes)), np.zeros(len(one.boxes))
    for i, end in enumerate(beams.ends_m):
        length = math.sqrt(sum(end**2))
        weight = 1.0 if beams.weight is None else beams.weight[i]
        met = [entered_m(b, p, origin, end / length) for b, p in zip(one.boxes, one.pitch_rad, strict=True)]
        for b, t in enumerate(met):
            alone[b] += weight * (t < length)
        if met and min(met) < length:
            seen[int(np.argmin(met))] += weight
    return seen, alone


def test_one_car_before_another_takes_its_beams():
    # one level beam towards each of y = -1, 0, 1 at x = 10, on from the sensor: a car there, a wider one at x = 20
    ends = np.array([[30.0, -1.5, 0.0], [30.0, 0.0, 0.0], [30.0, 1.5, 0.0], [15.0, 4.0, 0.0]])
    beams = Beams(Pose(101.0, 210.0, 1.0), SENSOR, ends)
    near, far = (111.0, 210.0, 1.0, 2.0, 0.8, 2.0, 0.0), (121.0, 210.0, 1.0, 2.0, 6.0, 2.0, 0.0)
    points = points_on_vehicles([frame([far, near])], GRID, beams)
    # at x = 10 the outer beams are at y = +-0.5, beyond 0.4: the near car takes the middle one, the far car the others
    assert points.seen.tolist() == [2.0, 1.0] and points.alone.tolist() == [3.0, 1.0]


def test_only_vehicles_in_the_region_count_and_all_are_in_the_way():
    beams = Beams(Pose(101.0, 210.0, 1.0), SENSOR, np.array([[30.0, 0.0, 0.0]]))
    walker, car = (105.0, 210.0, 1.0, 1.0, 1.0, 2.0, 0.0), (115.0, 210.0, 1.0, 4.0, 2.0, 1.5, 0.0)
    outside = (145.0, 210.0, 1.0, 4.0, 2.0, 1.5, 0.0)
    points = points_on_vehicles([frame([walker, car, outside], ("pedestrian", "bus", "bus"))], GRID, beams)
    assert points.seen.tolist() == [0.0] and points.alone.tolist() == [1.0]
    assert points_on_vehicles([frame([])], GRID, beams).seen.shape == (0,)
    assert points_on_vehicles([], GRID, beams).seen.shape == (0,)


def test_what_stands_before_the_car_ends_the_beam_and_a_box_round_the_sensor_is_ignored():
    ends = np.array([[8.0, 0.0, 0.0], [30.0, 0.0, 0.0]])  # the first ends at a wall, before the car
    beams = Beams(Pose(101.0, 210.0, 1.0), SENSOR, ends)
    round_it, car = (101.0, 210.0, 1.0, 4.0, 2.0, 3.0, 0.0), (115.0, 210.0, 1.0, 4.0, 2.0, 1.5, 0.0)
    points = points_on_vehicles([frame([round_it, car])], GRID, beams)
    assert points.seen.tolist() == [0.0, 1.0] and points.alone.tolist() == [0.0, 1.0]


def test_returns_that_are_lost_are_no_points():
    beams = Beams(Pose(101.0, 210.0, 1.0), SENSOR, np.array([[30.0, 0.0, 0.0]]), np.array([0.5]))
    car = (115.0, 210.0, 1.0, 4.0, 2.0, 1.5, 0.0)
    points = points_on_vehicles([frame([car])], GRID, beams, lambda r: 1.0 / r)
    assert points.seen == pytest.approx([0.5 / 12.0], rel=1e-4)  # entered at x = 113
    assert points.alone == pytest.approx([0.5 / 14.0])  # its centre


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_as_every_beam_against_every_box(seed):
    rng = np.random.default_rng(seed)
    at = Pose(100.0 + rng.uniform(0, 40), 200.0 + rng.uniform(0, 20), rng.uniform(2, 6))
    turned = rng.uniform(-math.pi, math.pi, 300)
    down = rng.uniform(-0.5, 0.1, 300)
    d = np.column_stack([np.cos(down) * np.cos(turned), np.cos(down) * np.sin(turned), np.sin(down)])
    beams = Beams(at, SENSOR, d * rng.uniform(3, 60, (300, 1)), rng.uniform(0.1, 1, 300) if seed == 2 else None)
    n = 30
    boxes = np.column_stack([
        100 + rng.uniform(-2, 42, n), 200 + rng.uniform(-2, 22, n), rng.uniform(0.5, 2, n), rng.uniform(2, 9, n),
        rng.uniform(1, 3, n), rng.uniform(1, 4, n), rng.uniform(-7, 7, n),
    ])  # fmt: skip
    one = frame(boxes, pitch=rng.uniform(-0.1, 0.1, n) if seed == 3 else None)
    points, (seen, alone) = points_on_vehicles([one], GRID, beams), counted_slowly(one, beams)
    held = [abs(entered_m(b, p, at.position_m, (1.0, 0, 0))) == 0 for b, p in zip(boxes, one.pitch_rad, strict=True)]
    assert not any(held)  # no box holds the sensor in these draws
    wanted = one.wanted(GRID.roi)
    assert len(wanted) > 10 and seen[wanted].sum() > 5
    np.testing.assert_allclose(points.seen, seen[wanted], rtol=1e-12)
    np.testing.assert_allclose(points.alone, alone[wanted], rtol=1e-12)
