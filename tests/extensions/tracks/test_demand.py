"""Demand and driving behaviour from recorded vehicles."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from egvs.extensions.tracks import demand as track_demand
from egvs.extensions.tracks.demand import Follower
from egvs.extensions.tracks.matching import MatchedTracks, match_tracks
from egvs.statistics import intervals
from tests.extensions.tracks.drives import LEFT, PERIOD_S, Drive, boxes_of, constant
from tests.traffic.crossing import read_network


def match(folder: Path, *drives: Drive) -> MatchedTracks:
    return match_tracks(boxes_of(drives), PERIOD_S, read_network(folder))


@pytest.mark.parametrize(
    ("count", "low", "high"), [(0, 0.0, 3.6889), (1, 0.0253, 5.5716), (3, 0.6187, 8.7673), (10, 4.7954, 18.3904)]
)
def test_poisson_interval_is_that_of_the_tables(count: int, low: float, high: float) -> None:
    """Garwood's limits as printed in textbooks."""
    assert intervals.poisson_interval(count) == pytest.approx((low, high), abs=1e-4)


def test_share_interval_of_extreme_shares() -> None:
    """With 0 of 10, the upper limit solves (1 - p)^10 = 0.025."""
    assert intervals.share_interval(0, 10) == pytest.approx((0.0, 1.0 - 0.025**0.1))
    assert intervals.share_interval(10, 10) == pytest.approx((0.025**0.1, 1.0))


def test_interval_of_a_median_is_that_of_order_statistics() -> None:
    """Of ten values, the second and the ninth enclose the median with a probability of 97.9 %."""
    estimate = intervals.median_of(list(range(1, 11)))
    assert estimate is not None
    assert (estimate.value, estimate.low, estimate.high, estimate.n) == (5.5, 2.0, 9.0, 10)
    assert not estimate.is_usable
    assert intervals.median_of([]) is None


def test_intervals_cover_the_truth_in_95_percent_of_trials() -> None:
    rng = np.random.default_rng(1)
    covered = np.zeros(3)
    for _ in range(400):
        values = rng.normal(1.1, 0.08, 40)
        results = [intervals.mean_of(values), intervals.deviation_of(values), intervals.median_of(values)]
        for number, (estimate, truth) in enumerate(zip(results, (1.1, 0.08, 1.1), strict=True)):
            assert estimate is not None
            covered[number] += estimate.low <= truth <= estimate.high
    assert (covered / 400 >= 0.92).all()
    assert (covered[:2] / 400 <= 0.98).all()


def test_passages_of_junction(tmp_path: Path) -> None:
    straight, left = Drive(constant(10.0), 0.0, 22.0), Drive(constant(4.0), 0.0, 54.0, LEFT)
    inside = Drive(constant(10.0, start_m=105.0), 0.0, 9.0)
    stays = Drive(constant(1.0), 0.0, 10.0)
    beside = Drive(constant(10.0), 0.0, 8.0, ((-110.0, 30.0), (110.0, 30.0)))
    # first seen inside, but later than the recording begins: it came from the only road that leads there
    appears = Drive(constant(10.0, begin_s=5.0, start_m=105.0), 5.0, 14.0)
    passages = track_demand.find_passages(match(tmp_path, straight, left, inside, stays, beside, appears))
    assert [(passage.track, passage.edges) for passage in passages.counted] == [
        (0, ("in", "out")), (1, ("in", "north")), (5, ("in", "out")),
    ]  # fmt: skip
    assert (passages.inside_at_begin, passages.on_one_road, passages.off_lanes) == (1, 1, 1)


def test_leaders_on_the_same_lane_and_beyond_the_junction(tmp_path: Path) -> None:
    first = Drive(constant(10.0, start_m=50.0), 0.0, 16.0)
    second = Drive(constant(10.0, start_m=20.0), 0.0, 16.0)
    matched = match(tmp_path, first, second)
    leaders = track_demand.find_leaders(matched)
    of_second = matched.track == 1
    assert leaders.distance_m[of_second] == pytest.approx(np.full(of_second.sum(), 30.0))
    assert (matched.track[leaders.row[of_second]] == 0).all()
    assert (matched.time_s[leaders.row[of_second]] == matched.time_s[of_second]).all()
    assert (leaders.row[~of_second] == -1).all()


def test_speed_factor_is_that_of_free_vehicles(tmp_path: Path) -> None:
    """The limit is 10 m/s; a follower 20 m behind, at 12 m/s, is less than 4 s away and not free."""
    leader, follower = Drive(constant(12.0, start_m=20.0), 0.0, 16.0), Drive(constant(12.0), 0.0, 16.0)
    turns = Drive(constant(12.0, begin_s=40.0), 40.0, 56.0, LEFT)
    slow = Drive(constant(4.0, begin_s=60.0), 60.0, 80.0)
    matched = match(tmp_path, leader, follower, turns, slow)
    factors = track_demand.free_speed_factors(matched, track_demand.find_leaders(matched))
    assert factors == {0: pytest.approx(1.2), 2: pytest.approx(1.2)}


def test_braking_vehicle_shows_no_desired_speed(tmp_path: Path) -> None:
    braking = Drive(lambda time_s: 12.0 * time_s - 0.5 * time_s**2, 0.0, 6.0)
    matched = match(tmp_path, braking)
    assert track_demand.free_speed_factors(matched, track_demand.find_leaders(matched)) == {}


def test_gap_between_standing_vehicles(tmp_path: Path) -> None:
    """Centres 8 m apart, lengths 4 and 8 m: 2 m between the bumpers."""
    first, second = Drive(constant(0.0, start_m=90.0), 0.0, 5.0), Drive(constant(0.0, start_m=82.0), 0.0, 5.0)
    matched = match(tmp_path, first, second)
    gaps = track_demand.standing_gaps_m(matched, track_demand.find_leaders(matched), np.array([4.0, 8.0]))
    assert gaps == {1: pytest.approx(2.0)}


def queue(number: int) -> Drive:
    """Return a vehicle of 4 m that stands behind the stop line, starts after 10 s and passes it 2 s after the last."""
    start_m, begin_s = 97.0 - 7.0 * number, 10.0 + 1.3 * number

    def at_m(time_s: np.ndarray) -> np.ndarray:
        return start_m + 10.0 * np.maximum(time_s - begin_s, 0.0)

    return Drive(at_m, 0.0, begin_s + 8.0)


def test_followers_of_a_queue_from_the_fourth_on(tmp_path: Path) -> None:
    """Each starts 1.3 s after the one before and has 7 m more to go at 10 m/s: headways of 2 s, gaps of 16 m."""
    matched = match(tmp_path, *(queue(number) for number in range(6)))
    followers = track_demand.queue_followers(matched, track_demand.find_leaders(matched), np.full(6, 4.0), 0.25)
    assert [follower.track for follower in followers] == [3, 4, 5]
    for follower in followers:
        assert follower.headway_s == pytest.approx(2.0, abs=0.01)
        assert follower.gap_m == pytest.approx(16.0, abs=0.01)
        assert follower.speed_m_s == pytest.approx(10.0)


def test_moving_vehicles_are_no_queue(tmp_path: Path) -> None:
    drives = [Drive(constant(10.0, begin_s=2.0 * k), 2.0 * k, 2.0 * k + 16.0) for k in range(6)]
    matched = match(tmp_path, *drives)
    assert track_demand.queue_followers(matched, track_demand.find_leaders(matched), np.full(6, 4.0), 0.25) == []


def test_time_gap_solves_the_equation_of_the_safe_speed() -> None:
    """At equal speeds, tau is the gap beyond the minimum gap over the speed."""
    assert Follower(0, 2.0, 12.0, 5.0, 5.0).time_gap_s(2.0, 4.5, 0.0) == pytest.approx(2.0)
    follower = Follower(0, 2.0, 11.0, 7.0, 9.0)
    tau = follower.time_gap_s(2.5, 4.5, 0.2)
    speed = 7.2
    assert speed**2 + 2 * 4.5 * tau * speed == pytest.approx(9.0**2 + 2 * 4.5 * (11.0 - 2.5))
    assert math.isnan(Follower(0, 2.0, math.nan, 7.0, 9.0).time_gap_s(2.5, 4.5, 0.2))
