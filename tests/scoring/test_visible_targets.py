"""What is seen of vehicles: by hand, and against a twin that puts each beam to each box by itself."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import egvs
from egvs.effects.returns import ReturnProbability
from egvs.scoring import targets
from egvs.scoring.visibility import Beams
from egvs.sensors import sensor
from egvs.sensors.sites import Pose
from tests.conftest import write_mini
from tests.scoring.target_scenes import COLUMNS, GRID, SENSOR, beams_to, frame, random_boxes, seen, seen_slowly

AT = (101.0, 210.0, 1.0)


def fan() -> Beams:
    """11 channels from -10 to 10 degrees, every 0.2 degrees of azimuth from -30 to 30, 60 m long; at AT."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-150, 151) / 5), np.radians(np.arange(-10, 11, 2)))
    d = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return beams_to(AT, 60.0 * np.stack(d, axis=-1).reshape(-1, 3))


def car(x, y, yaw=math.pi / 2, z=0.75):
    """4 m long, 2 m wide, 1.5 m high, x and y from the sensor; broadside to it unless told."""
    return (AT[0] + x, AT[1] + y, z, 4.0, 2.0, 1.5, yaw)


def test_a_car_broadside_at_20_m():
    found = seen([frame([car(21.0, 0.0)])], fan())
    # its side is at x = 20: |y| < 2 m is |azimuth| < 5.71 degrees, 57 columns; level beams meet it at z = 1, those at
    # -2 degrees at 0.3, those at 2 and -4 degrees pass above 1.5 and below 0
    assert found.points.tolist() == [114.0] and found.points_alone.tolist() == [114.0]
    assert found.length_share == pytest.approx([2 * 20.0001 * math.tan(math.radians(5.6)) / 4.0])
    assert found.width_share == pytest.approx([0.0], abs=1e-12)  # all points are on its side
    assert found.range_m == pytest.approx([math.hypot(21.0, 0.25)])
    assert found.side == pytest.approx([1.0]) and found.depression_deg == pytest.approx(
        [math.degrees(math.atan(0.25 / 21))]
    )
    assert found.points_on_sides.tolist() == [114.0]
    assert found.hole_m.tolist() == [4.0 / 64]  # columns are 7.0 cm apart there, slices 6.25 cm


def test_points_on_the_roof_and_a_hole_between_points():
    beams = beams_to((101.0, 210.0, 4.0), [[20.0, 0.0, -5.0], [24.0, 0.0, -5.0], [20.0, 3.0, -5.0], [9.0, 0.0, -5.0]])
    found = seen([frame([(110.0, 210.0, 0.75, 8.0, 2.0, 1.5, 0.0)])], beams)
    # the roof is at 1.5, from x = 106 to 114: met at x = 111 and 113; the third passes beside; the fourth meets the
    # rear at x = 106
    assert found.points.tolist() == [3.0] and found.points_on_sides.tolist() == [1.0]
    assert found.hole_m.tolist() == [39 * 8.0 / 64]  # slices 0 and 40 (5 m of 8) hold points, 39 between are empty
    assert found.side == pytest.approx([0.0])
    assert found.depression_deg == pytest.approx([math.degrees(math.atan2(3.25, 9.0))])


def test_a_car_that_turns_its_corner_shows_two_sides():
    found = seen([frame([car(21.0, 0.0, math.pi / 4)])], fan())
    assert found.length_share[0] > 0.95 and found.width_share[0] > 0.9
    end_on = seen([frame([car(22.0, 0.0, 0.0)])], fan())
    assert end_on.length_share == pytest.approx([0.0], abs=1e-12)
    assert end_on.width_share == pytest.approx([2 * 20.0001 * math.tan(math.radians(2.8)) / 2.0])  # |y| < 1: 2.86 deg


def test_a_car_behind_a_truck_is_not_seen_and_half_of_it_where_the_truck_ends_before_its_middle():
    hidden, truck = car(21.0, 0.0), (AT[0] + 10.0, AT[1], 1.5, 8.0, 2.0, 3.0, math.pi / 2)
    found = seen([frame([hidden, truck])], fan())
    assert found.points[0] == 0.0 and found.points_alone[0] == 114.0
    assert found.length_share[0] == found.width_share[0] == 0.0
    beside = (AT[0] + 10.0, AT[1] - 4.0, 1.5, 8.0, 2.0, 3.0, math.pi / 2)  # from y = -8 to 0
    found = seen([frame([hidden, beside])], fan())
    assert found.points[0] == 58.0  # azimuths 0 to 5.6 degrees
    assert found.length_share[0] == pytest.approx(20.0001 * math.tan(math.radians(5.6)) / 4.0, rel=1e-4)


def test_one_car_before_another_takes_its_beams():
    # one level beam towards each of y = -1, 0, 1 at x = 10, on from the sensor: a car there, a wider one at x = 20
    beams = beams_to(AT, [[30.0, -1.5, 0.0], [30.0, 0.0, 0.0], [30.0, 1.5, 0.0], [15.0, 4.0, 0.0]])
    near, far = (111.0, 210.0, 1.0, 2.0, 0.8, 2.0, 0.0), (121.0, 210.0, 1.0, 2.0, 6.0, 2.0, 0.0)
    found = seen([frame([far, near])], beams)
    # at x = 10 the outer beams are at y = +-0.5, beyond 0.4: the near car takes the middle one, the far car the others
    assert found.points.tolist() == [2.0, 1.0] and found.points_alone.tolist() == [3.0, 1.0]


def test_only_vehicles_in_the_region_count_and_all_are_in_the_way():
    beams = beams_to(AT, [[30.0, 0.0, 0.0]])
    walker, behind = (105.0, 210.0, 1.0, 1.0, 1.0, 2.0, 0.0), (115.0, 210.0, 1.0, 4.0, 2.0, 1.5, 0.0)
    outside = (145.0, 210.0, 1.0, 4.0, 2.0, 1.5, 0.0)
    found = seen([frame([walker, behind, outside], ("pedestrian", "bus", "bus"))], beams)
    assert found.points.tolist() == [0.0] and found.points_alone.tolist() == [1.0]
    assert len(seen([frame([])], beams)) == len(seen([], beams)) == 0
    assert seen([frame([walker, behind])], beams_to(AT, [])).points.tolist() == [0.0, 0.0]  # a scan without beams


def test_an_obstacle_before_the_car_ends_the_beam_and_a_box_around_the_sensor_is_ignored():
    beams = beams_to(AT, [[8.0, 0.0, 0.0], [30.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # the first ends at a wall
    round_it, behind = (101.0, 210.0, 1.0, 4.0, 2.0, 3.0, 0.0), (115.0, 210.0, 1.0, 4.0, 2.0, 1.5, 0.0)
    found = seen([frame([round_it, behind])], beams)
    assert found.points.tolist() == [0.0, 1.0] and found.points_alone.tolist() == [0.0, 1.0]


def test_a_beam_straight_down_meets_the_roof_below():
    found = seen([frame([(AT[0], AT[1], 0.25, 4.0, 2.0, 0.5, 0.3)])], beams_to(AT, [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]))
    assert found.points.tolist() == [1.0] and found.length_share.tolist() == [0.0]


def test_shares_of_beams_and_lost_returns_are_expectations():
    behind = (115.0, 210.0, 1.0, 4.0, 2.0, 1.5, 0.0)
    beams = beams_to(AT, [[30.0, 0.0, 0.0]], [0.5])
    assert seen([frame([behind])], beams).points.tolist() == [0.5]
    found = seen([frame([behind])], beams, lambda r: 1.0 / r)
    assert found.points == pytest.approx([0.5 / 12.0], rel=1e-4)  # entered at x = 113
    assert found.points_alone == pytest.approx([0.5 / 14.0])  # its centre


def test_spans_are_of_points_that_may_come():
    behind = (115.0, 210.0, 1.0, 4.0, 2.0, 1.5, 0.0)
    ends = [[30.0, -1.5, 0.0], [30.0, 0.0, 0.0], [30.0, 1.5, 0.0]]  # they meet it at y = -0.6, 0, 0.6
    assert seen([frame([behind])], beams_to(AT, ends)).width_share == pytest.approx([0.6], rel=1e-4)
    few = seen([frame([behind])], beams_to(AT, ends, [1e-9, 1.0, 0.0]))
    assert few.width_share == pytest.approx([0.3], rel=1e-4)  # a small share counts in full, none does not
    near = seen([frame([behind])], beams_to(AT, ends), lambda r: (r < 12.001).astype(np.float64))
    assert near.points.tolist() == [1.0] and near.width_share.tolist() == [0.0]


def scene(seed: int, upright: bool):
    """Two frames of boxes, a site among or beside them, its beams; of a third returns are lost, of one beams shared."""
    rng = np.random.default_rng(seed)
    at = (100.0 + rng.uniform(-5, 45), 200.0 + rng.uniform(-5, 25), rng.uniform(0.5, 6))
    if upright:  # rings and columns
        turned, down = (a.ravel() for a in np.meshgrid(np.radians(np.arange(0, 360, 12)), rng.uniform(-0.6, 0.1, 5)))
    else:
        turned, down = rng.uniform(-math.pi, math.pi, 150), rng.uniform(-1.5, 0.3, 150)
    d = np.column_stack([np.cos(down) * np.cos(turned), np.cos(down) * np.sin(turned), np.sin(down)])
    weight = rng.choice([0.0, 0.25, 1.0], 150) if seed % 3 == 1 else None
    beams = beams_to(at, d * rng.uniform(3, 60, (150, 1)), weight)
    frames = []
    for number in range(2):
        boxes = random_boxes(rng, int(rng.integers(1, 18)))
        pitch = rng.uniform(-0.2, 0.2, len(boxes)) * rng.integers(0, 2, len(boxes))
        frames.append(frame(boxes, rng.choice(["bus", "pedestrian"], len(boxes), p=[0.8, 0.2]), pitch, number))
    noticed = (lambda r: np.exp(-r / 20.0) * (r < 30.0)) if seed % 3 == 2 else None
    return frames, beams, noticed


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=20)
def test_as_every_beam_against_every_box(seed, upright):
    frames, beams, noticed = scene(seed, upright)
    found, slow = seen(frames, beams, noticed), seen_slowly(frames, beams, noticed)
    for name, values in slow.items():
        np.testing.assert_allclose(getattr(found, name), values, rtol=1e-9, atol=1e-9, err_msg=name)


def raster(sensor_m, azimuth_deg, elevation_deg, length_m=60.0):
    """Beams from a sensor at all azimuths and elevations."""
    azimuth, elevation = np.meshgrid(np.radians(azimuth_deg), np.radians(elevation_deg))
    d = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return beams_to(sensor_m, length_m * np.stack(d, axis=-1).reshape(-1, 3))


ALL_ROUND_DEG = np.arange(-180, 181, 6)


def boxes_that_touch():
    row = [(110.0 + 4.0 * i, 210.0, 0.75, 4.0, 2.0, 1.5, 0.0) for i in range(3)]
    beside, on_top = (114.0, 212.0, 0.75, 4.0, 2.0, 1.5, 0.0), (114.0, 210.0, 2.0, 4.0, 2.0, 1.0, 0.0)
    return [*row, beside, on_top], raster((103.0, 205.0, 3.7), np.arange(1, 80, 3), np.arange(-40, 3, 3))


def equal_boxes_and_fronts_in_one_plane():
    wide, narrow = (112.0, 210.0, 1.0, 4.0, 3.0, 2.0, 0.0), (112.5, 210.5, 1.0, 5.0, 1.0, 2.0, 0.0)  # fronts at 110
    return [wide, narrow, wide], raster((101.0, 210.0, 1.0), np.arange(-15.1, 16, 0.7), np.arange(-8.3, 9, 1.7))


def sensor_beside_a_long_vehicle():
    bus, car = (120.0, 210.0, 1.5, 18.0, 2.5, 3.0, 0.02), (120.0, 214.0, 0.75, 4.0, 2.0, 1.5, 0.0)
    return [bus, car], raster((118.0, 208.6, 1.7), ALL_ROUND_DEG + 0.5, np.arange(-70, 71, 10))


def behind_the_sensor_across_180_degrees():
    boxes = [(120.0, 210.0, 1.0, 4.0, 2.0, 2.0, 0.3), (110.0, 210.0, 1.5, 8.0, 2.5, 3.0, math.pi)]
    beams = raster((130.0, 210.0, 2.5), np.arange(160, 201, 1.0), np.arange(-20, 1, 2.3))
    straight = [[-30.0, 0.0, -3.0], [-30.0, -0.0, -3.0], [-30.0, 1e-12, -3.0], [-30.0, -1e-12, -3.0]]
    return boxes, beams_to(beams.pose.position_m, np.concatenate([beams.ends_m, straight]))


def beams_past_edges_and_corners():
    box = (112.0, 210.0, 1.0, 4.0, 2.0, 2.0, 0.0)
    half = np.array([2.0, 1.0, 1.0]) - (1e-4 + 1e-9)
    points = [np.array(signs) * half for signs in itertools.product((-1.0, 0.0, 1.0), repeat=3)]
    moved = [p + 1e-6 * np.array(by) for p in points for by in itertools.product((-1.0, 1.0), repeat=3)]
    sensor_m = (102.0, 206.0, 3.0)
    return [box], beams_to(sensor_m, 3.0 * (np.array(moved) + box[:3] - np.array(sensor_m)))


def sensor_above_a_vehicle():
    below, half_below = (115.0, 210.0, 0.75, 4.0, 2.0, 1.5, 0.7), (118.0, 210.0, 1.0, 6.0, 2.0, 2.0, 0.0)
    return [below, half_below], raster((115.1, 210.2, 4.0), ALL_ROUND_DEG, [-90, -80, -65, -50, -35, -20, 10])


def tilted_sensor():
    rng = np.random.default_rng(3)
    d = SENSOR.directions(40.0, -35.0, 20.0)[::97]
    return random_boxes(rng, 10), beams_to((115.0, 207.0, 5.5), 50.0 * d)


def many_boxes_one_behind_another():
    boxes = [(104.0 + 1.5 * i, 210.0, 1.0, 1.0, 8.0, 2.0 + 0.1 * i, 0.0) for i in range(20)]
    return boxes, raster((101.0, 210.0, 2.5), np.arange(-20.5, 21, 5), np.arange(-15, 6, 1.5))


ADVERSARIAL = (boxes_that_touch, equal_boxes_and_fronts_in_one_plane, sensor_beside_a_long_vehicle,
               behind_the_sensor_across_180_degrees, beams_past_edges_and_corners, sensor_above_a_vehicle,
               tilted_sensor, many_boxes_one_behind_another)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("make", ADVERSARIAL, ids=lambda make: make.__name__)
@pytest.mark.parametrize("noticed", [None, lambda r: np.exp(-r / 20.0)], ids=["counted", "listed"])
def test_hard_scenes_as_every_beam_against_every_box(make, noticed):
    boxes, beams = make()
    found, slow = seen([frame(boxes)], beams, noticed), seen_slowly([frame(boxes)], beams, noticed)
    assert sum(slow["points"]) > 0.0
    for name, values in slow.items():
        np.testing.assert_allclose(getattr(found, name), values, rtol=1e-9, atol=1e-9, err_msg=name)


def test_of_two_equal_boxes_the_first_takes_all_beams():
    boxes, beams = equal_boxes_and_fronts_in_one_plane()
    points = seen([frame(boxes)], beams).points
    assert points[0] > 0.0 and points[2] == 0.0


@pytest.mark.parametrize("seed", range(6))
def test_beams_that_are_counted_are_those_whose_hits_are_listed_or_weighted(seed):
    frames, beams, _ = scene(3 * seed, seed % 2 == 0)
    counted = seen(frames, beams)
    for other in (seen(frames, beams, lambda r: np.ones(len(r))),
                  seen(frames, beams_to(beams.pose.position_m, beams.ends_m, np.ones(len(beams.ends_m))))):  # fmt: skip
        for name in COLUMNS:
            assert getattr(counted, name).tobytes() == getattr(other, name).tobytes()


def test_scenes_of_the_twin_have_something_to_see():
    found = [seen(*scene(seed, seed % 2 == 0)) for seed in range(12)]
    assert sum(its.points.sum() > 0 for its in found) > 9
    assert max(its.length_share.max(initial=0) for its in found) > 0.5
    assert any((its.points < its.points_alone).any() for its in found if len(its))


def test_the_order_of_beams_is_nothing_and_lists_that_are_short_are_filled_again(monkeypatch):
    frames, beams, _ = scene(6, False)
    turned = beams_to(beams.pose.position_m, beams.ends_m[::-1])
    for name in COLUMNS[:6]:
        np.testing.assert_array_equal(getattr(seen(frames, beams), name), getattr(seen(frames, turned), name))
    whole = seen(frames, beams, lambda r: 1.0 / r)
    monkeypatch.setattr(targets, "MAX_HITS", 1)  # a list of one frame
    again = seen(frames, beams, lambda r: 1.0 / r)
    np.testing.assert_array_equal(whole.points, again.points)
    np.testing.assert_array_equal(whole.width_share, again.width_share)


def test_a_chance_of_one_is_no_effect():
    for seed in (0, 3, 1):  # whole beams, and shares of them
        frames, beams, _ = scene(seed, False)
        plain, certain = seen(frames, beams), seen(frames, beams, lambda r: np.ones(len(r)))
        for name in COLUMNS[:6]:
            np.testing.assert_array_equal(getattr(plain, name), getattr(certain, name))


def test_detection_probability_with_and_without_dropout(tmp_path):
    folder = write_mini(tmp_path / "mini")
    plain = egvs.build_scene(egvs.load(folder))
    assert ReturnProbability.of(plain, sensor.CATALOGUE["VLP-16"]) is None
    lossy = egvs.build_scene(egvs.load(folder, ["effects.dropout.share=0.25"]))
    noticed = ReturnProbability.of(lossy, sensor.CATALOGUE["VLP-16"])
    assert noticed is not None and noticed(np.array([1.0, 50.0])).tolist() == [0.75, 0.75]


def test_a_scene_far_from_the_worlds_zero_is_seen_alike():
    frames, beams, _ = scene(9, False)
    here = seen(frames, beams)
    moved = [frame(its.boxes + np.array([2.0**19, 2.0**22, 0, 0, 0, 0, 0]), its.kinds, its.pitch_rad) for its in frames]
    x, y, z = beams.pose.position_m
    there = targets.visible_targets(
        targets.TargetRecord.of(moved, type(GRID)((100.0 + 2.0**19, 200.0 + 2.0**22, 0.0), 1.0, GRID.shape)),
        Beams(Pose(x + 2.0**19, y + 2.0**22, z), SENSOR, beams.ends_m),
    )
    np.testing.assert_allclose(there.points, here.points)
    np.testing.assert_allclose(there.length_share, here.length_share, atol=1e-8)
