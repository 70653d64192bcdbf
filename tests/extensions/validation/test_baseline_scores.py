"""Published measures: cases by hand, and slow twins that share no code with them."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from egvs.artefacts.tpog import Tpog
from egvs.core.grid import Grid
from egvs.effects.range_limit import RangeLimit
from egvs.effects.returns import ReturnProbability
from egvs.extensions.validation import baseline_scores
from egvs.extensions.validation.surrogates import Occupancy, SiteEvidence
from egvs.extensions.validation.target_points import TargetPoints, list_target_points
from egvs.scenario.effects_config import RangeLimitParameters
from egvs.scoring.targets import TargetRecord, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors import sensor
from egvs.sensors.sites import Pose
from tests.clouds.cloud_scenes import frame_of, random_frame
from tests.scoring.target_scenes import by_range

GRID = Grid((0.0, 0.0, 0.0), 0.5, (20, 8, 4))  # 10 m x 4 m x 2 m


def ground_evidence(returns_m, road_rows=range(2, 6), weight=None):
    """Traffic in the lowest layer of the columns y = 1..3; a sensor 5 m above the corner; returns at these points."""
    counts = np.zeros(GRID.shape, dtype=np.int64)
    counts[:, list(road_rows), 0] = 1
    sensor_m = np.array([0.0, 0.0, 5.0])
    ends = np.asarray(returns_m, dtype=np.float64).reshape(-1, 3) - sensor_m
    beams = Beams(Pose(*sensor_m.tolist()), sensor.CATALOGUE["VLP-16"], ends, weight)
    return SiteEvidence(Occupancy(Tpog(GRID, 4, counts)), beams, np.ones(len(ends), dtype=np.bool_), None, None)


def nuc(evidence, sidewalk_m=0.0):
    return baseline_scores.NUC.function(evidence, sidewalk_m)


def test_nuc_of_two_clusters_by_hand():
    # three returns within a disc of each other, and one alone: discs hold 3, 3, 3 and 1 of 4 returns.
    # the road is 10 m x 2 m; p = pi 0.49 / 20. Values 3 / (4 p) and 1 / (4 p): mean 2.5 / (4 p),
    # variance 0.75 / (4 p)^2
    returns = [[2.0, 1.5, 0.1], [2.2, 1.5, 0.1], [2.0, 1.8, 0.1], [8.0, 2.5, 0.1]]
    p = math.pi * 0.49 / 20.0
    assert nuc(ground_evidence(returns)) == pytest.approx(math.sqrt(0.75) / (4.0 * p), rel=1e-12)


def test_nuc_of_equal_discs_is_zero_and_without_returns_undefined():
    assert nuc(ground_evidence([[2.0, 1.5, 0.1], [5.0, 1.5, 0.1], [8.0, 2.5, 0.1]])) == pytest.approx(0.0, abs=1e-12)
    assert math.isnan(nuc(ground_evidence([])))
    assert math.isnan(nuc(ground_evidence([[2.0, 1.5, 0.1]], road_rows=[])))


def test_nuc_leaves_out_what_is_not_on_the_ground():
    on_road = [[2.0, 1.5, 0.1], [2.2, 1.5, 0.1], [8.0, 2.5, 0.1]]
    elsewhere = [[2.1, 1.5, 0.7], [2.1, 0.2, 0.1], [2.1, 3.9, 0.1], [-1.0, 1.5, 0.1]]  # above, beside, outside
    assert nuc(ground_evidence([*on_road, *elsewhere])) == nuc(ground_evidence(on_road))
    with_sidewalk = nuc(ground_evidence([*on_road, *elsewhere]), sidewalk_m=3.0)
    p = math.pi * 0.49 / 40.0  # the whole region; five returns: discs of 2, 2, 1, 1, 1
    counts = np.array([2, 2, 1, 1, 1])
    assert with_sidewalk == pytest.approx(counts.std() / (5 * p), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("count", [50, 6500])
def test_nuc_equals_slow_twin(count):
    """The released program's loops: each disc against each return."""
    random = np.random.default_rng(count)
    returns = np.column_stack([random.uniform(0, 10, count), random.uniform(1, 3, count), np.full(count, 0.1)])
    weight = None if count == 50 else random.uniform(0.2, 1.0, count)
    result = nuc(ground_evidence(returns, weight=weight))
    centres = np.random.default_rng(0).permutation(count)[:6000]
    weight = np.ones(count) if weight is None else weight
    p, n = math.pi * 0.7**2 / 20.0, weight.sum()
    values = []
    for centre in returns[centres, :2].tolist():
        away = np.hypot(returns[:, 0] - centre[0], returns[:, 1] - centre[1])
        values.append(weight[away <= 0.7].sum() / (n * p))
    of_disc = weight[centres].tolist()
    mean = sum(w * v for w, v in zip(of_disc, values, strict=True)) / sum(of_disc)
    variance = sum(w * (v - mean) ** 2 for w, v in zip(of_disc, values, strict=True)) / sum(of_disc)
    assert result == pytest.approx(math.sqrt(variance), rel=1e-9)


def test_nuc_with_improbable_returns_is_nearly_that_without_them():
    random = np.random.default_rng(5)
    returns = np.column_stack([random.uniform(0, 10, 80), random.uniform(1, 3, 80), np.full(80, 0.1)])
    weight = np.where(np.arange(80) < 40, 1.0, 1e-9)
    assert nuc(ground_evidence(returns, weight=weight)) == pytest.approx(nuc(ground_evidence(returns[:40])), rel=1e-6)


# ---- vehicle grid occupancy


def car_evidence(at_m, size_m=(4.0, 2.0, 1.0), vehicles=1, of=None, probability=None):
    """Vehicles of one size with these points, positions from the centre; certain without probabilities."""
    boxes = np.tile([0.0, 0.0, 0.0, *size_m, 0.0], (vehicles, 1))
    at = np.asarray(at_m, dtype=np.float64).reshape(-1, 3)
    of = np.zeros(len(at), dtype=np.int64) if of is None else np.asarray(of)
    points = TargetPoints(of, at, np.ones(len(at)) if probability is None else np.asarray(probability))
    return SimpleNamespace(vehicles=SimpleNamespace(record=SimpleNamespace(boxes=boxes)), vehicle_points=points)


def occupancy(evidence, cell_m=1.0, views="each", entropy="event"):
    return baseline_scores.vehicle_grid_occupancy(evidence, cell_m, views, entropy)


def h(p):
    return sum(-q * math.log2(q) for q in (p, 1 - p) if q > 0)


def test_occupied_cells_of_a_corner_by_hand():
    # a car of 4 x 2 x 1 m with cells of 1 m: 8 cells from above, 4 from the side, 2 from ahead.
    # two points in the front right corner and one in the rear left: 2 of 8, 2 of 4, 2 of 2
    car = car_evidence([[1.9, -0.9, 0.4], [1.2, -0.1, 0.2], [-1.9, 0.9, -0.4]])
    assert occupancy(car, entropy="share") == pytest.approx((2 / 8 + 2 / 4 + 2 / 2) / 3)
    assert occupancy(car) == pytest.approx((h(1 / 4) + h(1 / 2) + h(1)) / 3)
    assert occupancy(car, entropy="term") == pytest.approx((0.5 + 0.5 + 0.0) / 3)
    assert occupancy(car, views="together") == pytest.approx(h(6 / 14))


def test_improbable_points_occupy_cells_in_expectation():
    # from above: a cell with two points of .5, one with a point of .2, and a certain one: .75 + .2 + 1 of 8 cells;
    # from the side .75 + .2 + 1 of 4; from ahead, where the first two cells are one, 1 - .5 .5 .8 = .8 and 1 of 2
    at = [[1.9, -0.9, 0.4], [1.2, -0.1, 0.2], [0.5, -0.5, 0.0], [-1.9, 0.9, -0.4]]
    car = car_evidence(at, probability=[0.5, 0.5, 0.2, 1.0])
    assert occupancy(car, entropy="share") == pytest.approx((1.95 / 8 + 1.95 / 4 + 1.8 / 2) / 3)


def test_points_on_faces_belong_to_the_outermost_cells():
    car = car_evidence([[2.0, 1.0, 0.5], [-2.0, -1.0, -0.5]])
    assert occupancy(car, entropy="share") == pytest.approx((2 / 8 + 2 / 4 + 2 / 2) / 3)


def test_vehicle_without_points_counts_as_zero_and_none_is_undefined():
    assert occupancy(car_evidence([[1.9, -0.9, 0.4]], vehicles=2), entropy="share") == pytest.approx(
        (1 / 8 + 1 / 4 + 1 / 2) / 3 / 2
    )
    assert occupancy(car_evidence([])) == 0.0
    assert math.isnan(occupancy(car_evidence([], vehicles=0)))


@pytest.mark.parametrize("views", ["each", "together"])
@pytest.mark.parametrize("entropy", ["event", "term", "share"])
def test_occupancy_equals_slow_twin(views, entropy):
    random = np.random.default_rng(3)
    of = random.integers(0, 5, 200)
    at = random.uniform(-0.5, 0.5, (200, 3)) * (4.3, 1.7, 1.4)
    car = car_evidence(at, (4.3, 1.7, 1.4), 5, of)
    cell = 0.4
    total = 0.0
    for vehicle in range(5):
        pairs = []
        for u, v in ((0, 1), (0, 2), (1, 2)):
            size = (4.3, 1.7, 1.4)
            seen = {(int((x[u] + size[u] / 2) / cell), int((x[v] + size[v] / 2) / cell)) for x in at[of == vehicle]}
            pairs.append((len(seen), math.ceil(size[u] / cell) * math.ceil(size[v] / cell)))
        shares = [a / b for a, b in pairs]
        if views == "together":
            shares = [sum(a for a, _ in pairs) / sum(b for _, b in pairs)]
        of_entropy = {"event": h, "term": lambda p: -p * math.log2(p), "share": lambda p: p}[entropy]
        total += sum(of_entropy(p) for p in shares) / len(shares)
    assert occupancy(car, cell, views, entropy) == pytest.approx(total / 5, rel=1e-12)


# ---- positions of points


def test_points_on_two_cars_by_hand():
    """A beam along x meets the rear of one car 0.25 m above its centre; one from above meets the roof of another."""
    grid = Grid((0.0, 0.0, 0.0), 0.5, (40, 20, 6))
    frame = frame_of([[10.0, 5.0, 0.75, 4.0, 2.0, 1.5, 0.0, 0.0], [1.0, 6.0, 0.75, 4.0, 2.0, 1.5, np.pi / 2, 0.0]])
    record = TargetRecord.of([frame], grid)
    ends = np.array([[15.0, 0.0, 0.0], [0.0, 1.5, -1.0]])
    points = list_target_points(record, Beams(Pose(1.0, 5.0, 1.0), sensor.CATALOGUE["VLP-16"], ends[:1]))
    np.testing.assert_array_equal(points.vehicle, [0])
    np.testing.assert_allclose(points.at_m, [[-2.0, 0.0, 0.25]], atol=2e-4)
    from_above = Beams(Pose(1.0, 5.0, 2.0), sensor.CATALOGUE["VLP-16"], ends[1:])  # 0.75 m north at the roof's height
    points = list_target_points(record, from_above)
    np.testing.assert_array_equal(points.vehicle, [1])
    np.testing.assert_allclose(points.at_m, [[-0.25, 0.0, 0.75]], atol=2e-4)


@pytest.mark.parametrize("lost", [False, True])
def test_points_are_those_that_are_counted(lost):
    """Numbers of points and their extent agree with the counts of the same beams; all points are on the box."""
    random = np.random.default_rng(7)
    grid = Grid((-30.0, -30.0, 0.0), 0.5, (120, 120, 10))
    record = TargetRecord.of([random_frame(random, (0.0, 0.0, 0.0), number=n) for n in range(3)], grid)
    ends = sensor.CATALOGUE["VLP-16"].directions() * 40.0
    beams = Beams(Pose(-5.0, 3.0, 4.0), sensor.CATALOGUE["VLP-16"], ends)
    seen = visible_targets(record, beams)
    probability = by_range(lambda r: (r < 15.0).astype(np.float64)) if lost else None
    points = list_target_points(record, beams, probability)
    counts = np.bincount(points.vehicle, minlength=len(record))
    if lost:
        expected = visible_targets(record, beams, probability).points
        np.testing.assert_array_equal(counts, expected)
        np.testing.assert_array_equal(points.probability, 1.0)
        assert counts.sum() < seen.points.sum()
        return
    np.testing.assert_array_equal(counts, seen.points)
    half_m = record.boxes[points.vehicle, 3:6] / 2.0
    assert (np.abs(points.at_m) <= half_m + 1e-3).all()
    assert (np.abs(np.abs(points.at_m) - half_m).min(axis=1) < 1e-3).all()  # on one of the six faces
    for row in np.flatnonzero(counts):
        at = points.at_m[points.vehicle == row]
        assert np.ptp(at[:, 0]) / record.boxes[row, 3] == pytest.approx(seen.length_share[row], abs=1e-9)


def test_probabilities_of_points_add_up_to_the_expected_number():
    """With losses by range and class of vehicle, as the scores count them."""
    random = np.random.default_rng(11)
    grid = Grid((-30.0, -30.0, 0.0), 0.5, (120, 120, 10))
    record = TargetRecord.of([random_frame(random, (0.0, 0.0, 0.0), number=n) for n in range(3)], grid)
    os1 = sensor.CATALOGUE["OS1-64"]
    beams = Beams(Pose(-5.0, 3.0, 4.0), os1, os1.directions() * 60.0)
    losses = ReturnProbability((RangeLimit(RangeLimitParameters()),), os1)
    points = list_target_points(record, beams, losses)
    expected = visible_targets(record, beams, losses).points
    summed = np.bincount(points.vehicle, points.probability, minlength=len(record))
    np.testing.assert_allclose(summed, expected, rtol=1e-3, atol=1e-9)
    assert 0.0 < points.probability.max() < 1.0
    assert summed.sum() < 0.9 * len(points.vehicle)
