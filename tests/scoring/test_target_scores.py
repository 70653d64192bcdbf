"""Means over vehicle-frames: by hand, and what makes a gain fit."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from egvs.scoring.target_scores import log_points, points_on_target, saturating_gain, seen_well
from egvs.scoring.targets import SEEN_WELL_POINTS, TargetRecord, weighted_mean
from tests.scoring.target_scenes import GRID, beams_to, frame, seen


def with_points(*points: float):
    """What a site sees of as many vehicles."""
    boxes = [(102.0 + 3 * i, 210.0, 1.0, 2.0, 1.0, 1.5, 0.0) for i in range(len(points))]
    return dataclasses.replace(seen([frame(boxes)], beams_to((101, 210, 3), [])), points=np.array(points, dtype=float))


def test_scores_by_hand():
    its = with_points(0, 20, 60)
    assert points_on_target(its) == pytest.approx((math.log(21) + math.log(61)) / 3)
    assert SEEN_WELL_POINTS == 20.0
    assert seen_well(its) == pytest.approx((0 + (1 - math.exp(-1)) + (1 - math.exp(-3))) / 3)
    assert points_on_target(its, saturating_gain) == seen_well(its)
    assert points_on_target(its, np.sqrt) == pytest.approx((math.sqrt(20) + math.sqrt(60)) / 3)


def test_weights_say_how_much_a_vehicle_counts():
    its = with_points(0, 20, 60)
    assert seen_well(its, np.array([0.0, 2.0, 0.0])) == pytest.approx(1 - math.exp(-1))
    assert points_on_target(its, weight=np.array([1.0, 0.0, 1.0])) == pytest.approx(math.log(61) / 2)
    assert seen_well(its, np.ones(3)) == seen_well(its)


def test_without_vehicles_there_is_no_score():
    assert math.isnan(points_on_target(with_points())) and math.isnan(seen_well(with_points()))
    assert math.isnan(seen_well(with_points(5), np.zeros(1))) and math.isnan(weighted_mean(np.empty(0)))


@pytest.mark.parametrize("gain", [log_points, saturating_gain])
def test_a_gain_begins_at_0_rises_and_is_concave(gain):
    worth = gain(np.arange(200.0))
    assert worth[0] == 0.0
    assert (np.diff(worth) > 0).all() and (np.diff(worth, 2) < 0).all()


def test_the_share_seen_well_stays_below_1_and_distinguishes_small_numbers():
    assert saturating_gain(np.array([1e9])) == 1.0 and 0.0 < saturating_gain(np.array([1e-12]))[0] < 1e-12


def test_the_order_of_vehicles_is_nothing():
    points = np.random.default_rng(5).exponential(30.0, 1000)
    assert weighted_mean(log_points(points)) == weighted_mean(log_points(points[::-1]))


def test_a_record_says_how_long_it_is():
    assert len(TargetRecord.of([frame([])], GRID)) == 0 and len(with_points(1, 2)) == 2
