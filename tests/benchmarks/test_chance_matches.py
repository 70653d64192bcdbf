"""Chance matches of boxes by hand: three frames, in which a car, a bus and two people stand or change places."""

import numpy as np
import pytest
from benchmarks.chance_matches import chance_shares, group_of

from tests.clouds.cloud_scenes import frame_of

KINDS = ["passenger", "bus", "pedestrian", "bicycle"]


def frame_at(*x_m):
    """Boxes in a row along x."""
    return frame_of([(x, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0, 0.0) for x in x_m], KINDS)


def test_vehicles_match_any_vehicle_and_people_any_person():
    """Frame 1 follows 0, and 0 stands in for what follows 1.

    The bus of frame 0 (at 20) finds the car of frame 1 (22); the car (0) is 1 m from a pedestrian only. Back again, the
    car (22) finds the bus, the bus (60) nothing. The pedestrian (40) and the bicycle (42.9) find each other; the
    bicycle (80) finds nothing, and the pedestrian (1) a car only.
    """
    frames = [frame_at(0.0, 20.0, 40.0, 80.0), frame_at(22.0, 60.0, 1.0, 42.9)]
    shares = chance_shares(frames, 1, 1, (1.0, 1.0))
    assert [shares[group].value for group in ("cars", "larger vehicles", "people")] == [0.5, 0.5, 0.5]
    none_kept = chance_shares(frames, 1, 1, (0.0, 0.0))
    assert [ratio.value for ratio in none_kept.values()] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("kind", "group"),
    [("taxi", "cars"), ("delivery", "larger vehicles"), ("trailer", "larger vehicles"), ("bicycle", "people")],
)
def test_groups_by_kind(kind, group):
    assert group_of(kind) == group


def test_share_of_matches_falls_with_the_number_of_boxes():
    rng = np.random.default_rng(1)
    frames = [frame_of([(x, 0, 1, 4, 2, 2, 0, 0) for x in rng.uniform(0, 60, 12)]) for _ in range(40)]
    values = [chance_shares(frames, 7, 5, (kept, 1.0))["cars"].value for kept in (1.0, 0.5, 0.1)]
    assert values[0] > values[1] > values[2]
