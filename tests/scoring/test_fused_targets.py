"""What several sensors see together: by hand, and against a twin that throws all their points together."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from egvs.scoring.fused_targets import fuse_targets
from egvs.scoring.target_scores import detection_chances, expected_detections
from egvs.scoring.targets import TargetRecord, TargetVisibility, VisibleTargets, visible_targets
from egvs.scoring.visibility import Beams
from tests.scoring.target_scenes import COLUMNS, GRID, beams_to, by_range, frame, fused_slowly, random_boxes

CAR = (120.0, 210.0, 0.75, 4.0, 2.0, 1.5, 0.0)
"""Along x from 118 to 122, its sides at y = 209 and 211."""


def views_of(record: TargetRecord, *scans: Beams) -> list[VisibleTargets]:
    return [visible_targets(record, beams) for beams in scans]


def aimed(at: tuple[float, float, float], *targets: tuple[float, float, float]) -> Beams:
    """Beams from a sensor through each target, to twice its distance."""
    return beams_to(at, 2.0 * (np.array(targets) - np.array(at)))


def slice_x(number: int) -> float:
    """x of the middle of a slice of the car, from its rear."""
    return 118.0 + (number + 0.5) / 16


def test_two_sensors_on_opposite_sides_of_a_car() -> None:
    record = TargetRecord.of([frame([CAR])], GRID)
    # level beams, to slices 8, 16 and 32 of the right side and to 32 and 48 of the left; a slice is 1/16 m long
    right = aimed((120.0, 202.0, 1.0), *((slice_x(k), 209.0, 1.0) for k in (8, 16, 32)))
    left = aimed((120.0, 216.0, 1.0), *((slice_x(k), 211.0, 1.0) for k in (32, 48)))
    first, second = views_of(record, right, left)
    assert first.points.tolist() == [3.0] and second.points.tolist() == [2.0]
    assert first.length_share == pytest.approx([1.5 / 4.0], rel=1e-3)
    assert second.length_share == pytest.approx([1.0 / 4.0], rel=1e-3)
    assert first.width_share == pytest.approx([0.0], abs=1e-9) and second.width_share == pytest.approx([0.0], abs=1e-9)
    assert first.hole_m.tolist() == [15 / 16] and second.hole_m.tolist() == [15 / 16]

    both = fuse_targets([first, second])
    assert both.points.tolist() == [5.0] and both.points_on_sides.tolist() == [5.0]
    assert both.length_share == pytest.approx([2.5 / 4.0], rel=1e-3)  # slices 8 to 48
    assert both.width_share == pytest.approx([1.0], rel=1e-3)  # from one side to the other
    assert both.hole_m.tolist() == [15 / 16]  # between slices 16 and 32, and 32 and 48
    # the first sensor has more points: it is 8 m away and 0.25 m higher than the centre
    assert both.range_m == pytest.approx([math.hypot(8.0, 0.25)])
    assert both.depression_deg == pytest.approx([math.degrees(math.atan(0.25 / 8.0))])


def test_a_second_sensor_closes_a_hole_or_opens_one() -> None:
    record = TargetRecord.of([frame([CAR])], GRID)
    at = (120.0, 202.0, 1.0)
    ends, middle = aimed(at, (slice_x(8), 209.0, 1.0), (slice_x(56), 209.0, 1.0)), aimed(at, (slice_x(32), 209.0, 1.0))
    rear, front = aimed(at, (slice_x(8), 209.0, 1.0)), aimed(at, (slice_x(56), 209.0, 1.0))
    seen_ends, seen_middle, seen_rear, seen_front = views_of(record, ends, middle, rear, front)
    assert seen_ends.hole_m.tolist() == [47 / 16]  # between slices 8 and 56
    assert fuse_targets([seen_ends, seen_middle]).hole_m.tolist() == [23 / 16]  # slice 32 is between
    assert seen_rear.hole_m.tolist() == seen_front.hole_m.tolist() == [0.0]
    assert fuse_targets([seen_rear, seen_front]).hole_m.tolist() == [47 / 16]


def rings(at: tuple[float, float, float], seed: int = 0, count: int = 2000) -> Beams:
    """Beams in random directions, most of them downwards."""
    rng = np.random.default_rng(seed)
    turned, down = rng.uniform(-math.pi, math.pi, count), rng.uniform(-0.9, 0.1, count)
    d = np.column_stack([np.cos(down) * np.cos(turned), np.cos(down) * np.sin(turned), np.sin(down)])
    return beams_to(at, 60.0 * d)


def test_two_equal_sensors_at_one_pole_add_points_and_nothing_else() -> None:
    record = TargetRecord.of([frame(random_boxes(np.random.default_rng(5), 40))], GRID)
    one = visible_targets(record, rings((110.0, 205.0, 5.0)))
    twice = fuse_targets([one, one])
    assert (one.points > 0.0).any() and (one.points == 0.0).any()
    assert (twice.points == 2.0 * one.points).all() and (twice.points_on_sides == 2.0 * one.points_on_sides).all()
    for name in ("length_share", "width_share", "hole_m", "range_m", "depression_deg", "side", "bounds_m", "slices"):
        assert (getattr(twice, name) == getattr(one, name)).all()
    single, doubled = detection_chances(one), detection_chances(twice)
    independent = 1.0 - (1.0 - single) ** 2
    visible = one.points > 0.0
    assert (doubled >= single).all()
    assert doubled[visible].mean() < 0.9 * independent[visible].mean()


def test_one_sensor_alone_is_itself_and_an_unseen_vehicle_stays_unseen() -> None:
    record = TargetRecord.of([frame(random_boxes(np.random.default_rng(6), 12))], GRID)
    one, blind = views_of(record, rings((130.0, 215.0, 4.0)), beams_to((101.0, 201.0, 3.0), [[0.0, 0.0, 1.0]]))
    for both in (fuse_targets([one]), fuse_targets([one, blind]), fuse_targets([blind, one])):
        rows = one.points > 0.0
        for name in (*COLUMNS, "bounds_m", "slices"):
            assert (getattr(both, name)[rows] == getattr(one, name)[rows]).all()
        assert expected_detections(both) == expected_detections(one)
    nothing = fuse_targets([blind, blind])
    assert not nothing.points.any() and not nothing.length_share.any() and not nothing.hole_m.any()
    assert expected_detections(nothing) == 0.0


def scans_of(rng: np.random.Generator, count: int) -> list[Beams]:
    at = [(100 + rng.uniform(-5, 45), 200 + rng.uniform(-5, 25), rng.uniform(2.0, 6.0)) for _ in range(count)]
    return [rings(point, seed=int(rng.integers(1000)), count=150) for point in at]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_all_points_thrown_together_give_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pitch = rng.uniform(-0.1, 0.1, 6)
    frames = [frame(random_boxes(rng, 6), pitch=pitch, number=number) for number in range(3)]
    scans = scans_of(rng, 2 + seed % 2)
    both = fuse_targets(views_of(TargetRecord.of(frames, GRID), *scans))
    expected = fused_slowly(frames, scans)
    assert len(expected["points"]) == len(both) > 0 and both.points.any()
    for name, column in expected.items():
        assert getattr(both, name) == pytest.approx(column, rel=1e-4, abs=1e-4), name


def test_the_order_of_sensors_does_not_matter() -> None:
    rng = np.random.default_rng(8)
    record = TargetRecord.of([frame(random_boxes(rng, 12))], GRID)
    views = [visible_targets(record, beams, by_range(lambda r: np.exp(-r / 30.0))) for beams in scans_of(rng, 3)]
    first = fuse_targets(views)
    for order in itertools.permutations(views):
        other = fuse_targets(order)
        for name in (*COLUMNS, "bounds_m", "slices"):
            assert np.array_equal(getattr(other, name), getattr(first, name)), name


def test_sensors_have_to_see_the_same_record() -> None:
    scan = rings((110.0, 205.0, 5.0))
    views: list[TargetVisibility] = [
        visible_targets(TargetRecord.of([frame([CAR])], GRID), scan),
        visible_targets(TargetRecord.of([frame([CAR])], GRID), scan),
    ]
    with pytest.raises(ValueError, match="same record"):
        fuse_targets(views)
    with pytest.raises(ValueError, match="at least one sensor"):
        fuse_targets([])
