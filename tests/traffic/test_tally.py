"""Are overlaps and standing vehicles those that are really there?"""

import math

import numpy as np
import pyarrow as pa
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from egvs.traffic import trajectories, vehicle_boxes
from egvs.traffic.fcd import FrameGroup
from egvs.traffic.trajectories import TrafficStatistics
from tests.traffic.helpers import SIZES, group_of


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ((0, 4, 0), 0),  # bumper to bumper
        ((0, 3.99, 0), 1),
        ((2, 0, 0), 0),  # side by side
        ((1.99, 0, 0), 1),
        ((3, 0, 90), 1),  # its front bumper 1 m inside
        ((6, 0, 90), 0),
    ],
)
def test_overlap_of_two_cars(other, expected):
    x, y, angle = other
    if angle == 90:
        y -= 2  # level with the first car's middle
    rows = [(0, "a", "car", 0, 0, 0, 1), (0, "b", "car", x, y, angle, 1)]
    assert (
        len(trajectories.find_overlaps(vehicle_boxes.boxes_from_bumpers(group_of(rows), SIZES, 1.0, "place")))
        == expected
    )


def test_vehicles_on_a_bridge_and_below_it_do_not_overlap():
    group = group_of([(0, "a", "car", 0, 0, 0, 1), (0, "b", "car", 0, 0, 90, 1)])
    raised = group.rows.set_column(5, "z", pa.array([0.0, 5.0]))
    assert (
        len(
            trajectories.find_overlaps(
                vehicle_boxes.boxes_from_bumpers(FrameGroup(0, 1, group.frame, raised), SIZES, 1.0, "place")
            )
        )
        == 0
    )


def footprint(found, i):
    cos, sin = math.cos(found.yaw_rad[i]), math.sin(found.yaw_rad[i])
    half_l, half_w = found.length_m[i] / 2 - 1e-3, found.width_m[i] / 2 - 1e-3
    corners = [(a * half_l, b * half_w) for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    return shapely.Polygon([(found.x_m[i] + cos * u - sin * v, found.y_m[i] + sin * u + cos * v) for u, v in corners])


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1))
def test_overlaps_are_those_that_polygons_find(seed):
    rng = np.random.default_rng(seed)
    rows = [
        (f, str(i), rng.choice(["car", "bus"]), rng.uniform(0, 25), rng.uniform(0, 25), rng.uniform(0, 360), 1)
        for f in range(3)
        for i in range(10)
    ]
    found = vehicle_boxes.boxes_from_bumpers(group_of(rows), SIZES, 1.0, "place")
    shapes = [footprint(found, i) for i in range(30)]
    expected = {
        (i, j)
        for i in range(30)
        for j in range(i)
        if found.frame[i] == found.frame[j] and shapes[i].intersection(shapes[j]).area > 1e-7
    }
    got = {(int(b), int(a)) for a, b in trajectories.find_overlaps(found)}
    for i, j in got ^ expected:  # a contact thinner than the polygons' own rounding may go either way
        assert shapes[i].distance(shapes[j]) < 1e-6
        assert shapes[i].intersection(shapes[j]).area < 1e-5


@pytest.mark.parametrize("spread_m", [10.0, 300.0, 1e8])
def test_overlaps_are_those_of_all_pairs(spread_m):
    """Wherever vehicles are, those in neighbouring cells are found, and none of another frame."""
    rng = np.random.default_rng(7)
    near = rng.uniform(-spread_m, spread_m, (40, 2))
    places = np.concatenate([near, near + rng.uniform(-8, 8, (40, 2)), [[-spread_m, -spread_m], [spread_m, spread_m]]])
    rows = [
        (f, str(i), ["car", "bus"][i % 2], x, y, rng.uniform(0, 360), 1)
        for f in range(3)
        for i, (x, y) in enumerate(places.tolist())
    ]
    found = vehicle_boxes.boxes_from_bumpers(group_of(rows), SIZES, 1.0, "place")
    a, b = np.triu_indices(found.frame.size, 1)
    a, b = a[found.frame[a] == found.frame[b]], b[found.frame[a] == found.frame[b]]
    hit = trajectories._boxes_overlap(found, a, b)
    expected = set(zip(a[hit].tolist(), b[hit].tolist(), strict=True))
    got = [tuple(pair) for pair in trajectories.find_overlaps(found).tolist()]
    assert len(got) == len(set(got)) > 20
    assert set(got) == expected


def test_standing_is_followed_across_groups():
    counted = TrafficStatistics(6)
    for frames in ((0, 1), (2, 3), (4, 5)):
        rows = [(f, "still", "car", 0, 0, 0, 0.0) for f in frames]
        rows += [(f, "goes", "car", 50, 0, 0, 5.0 if f == 4 else 0.0) for f in frames]
        counted.add(vehicle_boxes.boxes_from_bumpers(group_of(rows), SIZES, 1.0, "place"))
    assert counted.standing_since == {"still": 0, "goes": 5}
    assert counted.longest_standing_frames == 5
    result = counted.to_json(0.5)
    assert result["vehicles"] == {"fewest": 2, "most": 2, "different": 2}
    assert result["longest_standing_s"] == 2.5
    assert result["share_standing"] == round(11 / 12, 4)
