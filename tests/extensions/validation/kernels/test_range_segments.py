"""Segments and rectangles: cases by hand, and slow twins that share no code with the kernels."""

import math

import numpy as np
import pytest

from egvs.extensions.validation.kernels import range_segments
from egvs.extensions.validation.kernels.range_segments import BY_AREA, BY_VARIANCE, MAX_SEARCHED, SUMMARY

HEADINGS = 90
TURN = np.arange(HEADINGS) * (math.pi / 2 / HEADINGS)


def search(clusters, criterion=BY_VARIANCE):
    starts = np.append(0, np.cumsum([len(c) for c in clusters])).astype(np.int64)
    heading, ends, value = np.empty(len(clusters), np.int64), np.empty((len(clusters), 4)), np.empty(len(clusters))
    xy = np.concatenate(clusters)
    range_segments.search_rectangles(xy, starts, np.cos(TURN), np.sin(TURN), criterion, heading, ends, value)
    return heading, ends, value


def corner(length_m=4.0, width_m=1.8, yaw_rad=0.0, at_m=(10.0, 3.0), step_m=0.1):
    """Points on the two sides that meet in the low corner of a rectangle."""
    along = np.arange(0.0, length_m + 1e-9, step_m)
    across = np.arange(0.0, width_m + 1e-9, step_m)
    points = np.concatenate([np.column_stack([along, 0 * along]), np.column_stack([0 * across, across])])
    turn = np.array([[math.cos(yaw_rad), -math.sin(yaw_rad)], [math.sin(yaw_rad), math.cos(yaw_rad)]])
    return points @ turn.T + at_m


@pytest.mark.parametrize("criterion", [BY_VARIANCE, BY_AREA])
@pytest.mark.parametrize("degrees", [0, 17, 45, 89])
def test_two_sides_of_a_car_give_its_rectangle(criterion, degrees):
    heading, ends, _ = search([corner(yaw_rad=math.radians(degrees))], criterion)
    assert heading[0] == degrees
    assert ends[0, 1] - ends[0, 0] == pytest.approx(4.0, abs=1e-9)
    assert ends[0, 3] - ends[0, 2] == pytest.approx(1.8, abs=1e-9)


def test_all_points_of_a_large_segment_are_inside():
    points = corner(step_m=0.002)  # 2900 points: headings are searched with every seventh
    assert len(points) > 2 * MAX_SEARCHED
    heading, ends, _ = search([points])
    assert heading[0] == 0
    np.testing.assert_allclose(ends[0], [10.0, 14.0, 3.0, 4.8], atol=1e-9)


def slow_rectangle(points, criterion):
    """Zhang's algorithms as they are written, with numpy's variance."""
    best = None
    for number, turn in enumerate(TURN):
        along = points @ [math.cos(turn), math.sin(turn)]
        across = points @ [-math.sin(turn), math.cos(turn)]
        if criterion == BY_AREA:
            value = -np.ptp(along) * np.ptp(across)
        else:
            distances = []
            for c in (along, across):
                from_high, from_low = c.max() - c, c - c.min()
                distances.append(from_low if (from_low**2).sum() <= (from_high**2).sum() else from_high)
            first = distances[0][distances[0] < distances[1]]
            second = distances[1][distances[0] >= distances[1]]
            value = -sum(group.var() for group in (first, second) if len(group))
        if best is None or value > best[0] + 1e-12:
            best = value, number, [along.min(), along.max(), across.min(), across.max()]
    return best


@pytest.mark.parametrize("criterion", [BY_VARIANCE, BY_AREA])
def test_rectangles_equal_slow_twin(criterion):
    random = np.random.default_rng(4)
    clusters = [random.normal(0, 1, (n, 2)) * random.uniform(0.2, 3, 2) for n in (4, 7, 30, 200)]
    clusters += [corner(yaw_rad=random.uniform(0, 1.5)) + random.normal(0, 0.03, (60, 2)) for _ in range(5)]
    _, ends, value = search(clusters, criterion)
    for row, points in enumerate(clusters):
        expected, _, expected_ends = slow_rectangle(points, criterion)
        assert value[row] == pytest.approx(expected, abs=1e-9)
        np.testing.assert_allclose(ends[row], expected_ends, atol=1e-9)


# ---- segments

GRAPH_STEP_RAD = math.radians(0.5)


def line_of_beams(ranges):
    """Beams 0.5 degrees apart in a plane, each with one return; no return for NaN."""
    turn = np.arange(len(ranges)) * GRAPH_STEP_RAD
    beam = np.flatnonzero(np.isfinite(ranges)).astype(np.int64)
    range_m = np.asarray(ranges, dtype=np.float64)[beam]
    points = range_m[:, None] * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])[beam]
    point_of_beam = np.full(len(ranges), -1, dtype=np.int64)
    point_of_beam[beam] = np.arange(len(beam))
    pairs = [[n for n in (b - 1, b + 1) if 0 <= n < len(ranges)] for b in range(len(ranges))]
    starts = np.append(0, np.cumsum([len(p) for p in pairs])).astype(np.int64)
    return points, range_m, beam, point_of_beam, starts, np.concatenate(pairs).astype(np.int64)


def labels(ranges, beta_deg=10.0, joined_m=0.1, apart_m=1.0):
    points, range_m, beam, point_of_beam, starts, neighbours = line_of_beams(ranges)
    label = np.empty(len(points), dtype=np.int64)
    limits = np.array([math.tan(math.radians(beta_deg)), joined_m, apart_m])
    range_segments.join_neighbours(points, range_m, beam, point_of_beam, starts, neighbours, limits, label)
    return label.tolist()


def test_jump_in_range_separates():
    # arcs at 10 m are 0.087 m; from 10 m to 10.6 m beta = atan2(10 sin 0.5, 10.6 - 10 cos 0.5) = 8.3 degrees
    assert labels([10.0, 10.0, 10.6, 10.6]) == [0, 0, 2, 2]
    assert labels([10.0, 10.0, 10.6, 10.6], beta_deg=8.0) == [0, 0, 0, 0]
    assert labels([10.0, 10.0, 10.6, 10.6], joined_m=0.55) == [0, 0, 0, 0]  # 0.606 m apart, arc of 0.087 m
    assert labels([10.0, 10.0, 10.6, 10.6], beta_deg=8.0, apart_m=0.5) == [0, 0, 2, 2]


def test_beam_without_return_separates():
    assert labels([10.0, 10.0, np.nan, 10.0]) == [0, 0, 2]


def test_segments_equal_slow_twin():
    random = np.random.default_rng(2)
    for _ in range(20):
        ranges = np.where(random.random(60) < 0.1, np.nan, 10.0 + random.choice([0, 0.3, 0.8, 3.0], 60).cumsum() % 7)
        points, range_m, beam, *_ = line_of_beams(ranges)
        group = list(range(len(points)))
        for i in range(len(points) - 1):
            if beam[i + 1] != beam[i] + 1:
                continue
            far, near = max(range_m[i : i + 2]), min(range_m[i : i + 2])
            beta = math.atan2(near * math.sin(GRAPH_STEP_RAD), far - near * math.cos(GRAPH_STEP_RAD))
            apart, arc = math.dist(points[i], points[i + 1]), near * math.sin(GRAPH_STEP_RAD)
            if apart <= 1.0 + arc and (beta >= math.radians(10.0) or apart <= 0.1 + arc):
                group[i + 1] = group[i]
        assert labels(ranges) == group


def test_point_next_to_a_nearer_object_is_hidden():
    points, range_m, beam, point_of_beam, starts, neighbours = line_of_beams([10.0, 10.0, np.nan, 6.0, 6.0])
    label, scene = np.array([0, 0, 2, 2]), np.array([10.0, 10.0, 9.0, 6.0, 6.0])  # a pole in the third beam
    hidden = np.empty(4, dtype=np.bool_)
    arguments = range_m, beam, label, point_of_beam, scene, starts, neighbours
    range_segments.hidden_edges(*arguments, 0.5, hidden)
    assert hidden.tolist() == [False, True, False, False]
    range_segments.hidden_edges(*arguments, 1.5, hidden)
    assert hidden.tolist() == [False, False, False, False]
    del points


def test_summary_by_hand():
    # a rectangle of 3 m x 2 m: three points on its low side across, one in the middle, one at the far corner
    xy = np.array([[0.0, 0.0], [0.0, 1.0], [0.0, 2.0], [1.5, 1.0], [3.0, 2.0]])
    z, hidden = np.array([0.5, 0.7, 0.6, 1.4, 1.0]), np.array([True, False, False, False, True])
    summary = np.empty((1, len(SUMMARY)))
    starts, axes = np.array([0, 5]), np.array([[1.0, 0.0, 0.0, 1.0]])
    range_segments.summarise_segments(xy, z, hidden, starts, axes, np.array([[0.0, 3.0, 0.0, 2.0]]), summary)
    row = dict(zip(SUMMARY, summary[0].tolist(), strict=True))
    assert row == pytest.approx(
        {
            "points": 5, "z_low_m": 0.5, "z_high_m": 1.4, "z_mean_m": 0.84,
            "z_high_low_a_m": 0.7, "z_high_mid_a_m": 1.4, "z_high_high_a_m": 1.0,
            "z_high_low_b_m": 0.5, "z_high_high_b_m": 1.4,
            "share_on_low_a": 0.6, "share_on_low_b": 0.2,
            "hidden_low_a": 1 / 3, "hidden_high_a": 1.0, "hidden_low_b": 1.0, "hidden_high_b": 0.5,
        }
    )  # fmt: skip
