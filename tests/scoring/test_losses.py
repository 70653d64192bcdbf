"""Losses of returns on vehicles: expected points and extents against single draws, and who is spared.

Evidence: the mean over many draws of single returns, each lost or not by the slow formula of one pulse.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from egvs.effects.range_limit import RangeLimit
from egvs.effects.returns import ReturnProbability
from egvs.kernels import vehicle_visibility
from egvs.scenario.effects_config import RangeLimitParameters
from egvs.scoring.fused_targets import fuse_targets
from egvs.scoring.targets import TargetRecord, VisibleTargets, slice_misses, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Pose
from tests.scoring.target_scenes import GRID, frame

DRAWS = 4000
SENSOR = Sensor("s", (0.0,), (0.0,), 8, 200.0, "this test", rated_range_m=30.0, rated_reflectivity=0.1)
"""Half of the returns from cars are lost at 16.4 m."""


def losses(**parameters: float) -> ReturnProbability:
    return ReturnProbability((RangeLimit(RangeLimitParameters(**parameters)),), SENSOR)


def fan(pose: Pose, rows: int = 12, columns: int = 500) -> Beams:
    """Beams that are spread evenly over azimuth, and downwards."""
    azimuth = np.linspace(-math.pi, math.pi, columns, endpoint=False)
    slope = np.linspace(-0.5, 0.0, rows)
    azimuth, slope = (part.ravel() for part in np.meshgrid(azimuth, slope, indexing="ij"))
    ends = 60.0 * np.column_stack([np.cos(azimuth), np.sin(azimuth), slope])
    return Beams(pose, SENSOR, ends)


BOXES = np.array([
    [108.0, 203.0, 0.75, 4.5, 1.8, 1.5, 0.4], [116.0, 209.0, 0.75, 4.5, 1.8, 1.5, 1.7],
    [121.0, 203.0, 1.55, 12.0, 2.5, 3.1, 0.1], [104.0, 212.0, 0.75, 4.0, 1.7, 1.5, 2.5],
])  # fmt: skip
POSE = Pose(101.0, 206.0, 3.0)


def visible(probability: ReturnProbability | None, beams: Beams | None = None) -> VisibleTargets:
    record = TargetRecord.of([frame(BOXES)], GRID)
    return visible_targets(record, fan(POSE) if beams is None else beams, probability)


def points_of(beams: Beams) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Range, coordinate along and across of each first hit on each box: each beam against each face, one by one."""
    direction = beams.ends_m / np.sqrt((beams.ends_m**2).sum(axis=1))[:, None]
    entry = np.full((len(BOXES), len(direction)), np.inf)
    local = []
    for i, (x, y, z, length, width, height, yaw) in enumerate(BOXES):
        turn = np.array([[math.cos(yaw), math.sin(yaw), 0.0], [-math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        origin, way = turn @ (np.array(beams.pose.position_m) - (x, y, z)), direction @ turn.T
        half = np.array([length, width, height]) / 2 - 1e-4
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (-half - origin) / way, (half - origin) / way
        near, far = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
        entry[i] = np.where((near < far) & (near > 0.0) & (near < 60.0), near, np.inf)
        local.append((origin, way))
    points = []
    for i, (origin, way) in enumerate(local):
        first = (entry[i] < np.inf) & (entry[i] == entry.min(axis=0))
        at = origin + entry[i][first][:, None] * way[first]
        points.append((entry[i][first], at[:, 0], at[:, 1]))
    return points


def chance(range_m: float) -> float:
    limit_m = 30.0 * math.sqrt(0.03 / 0.1)
    return 0.95 * 0.5 * math.erfc(-2.0 * math.log(limit_m / range_m) / math.sqrt(2.0))


def test_expected_points_are_the_sum_of_probabilities() -> None:
    result, plain = visible(losses()), visible(None)
    points = points_of(fan(POSE))
    np.testing.assert_allclose(plain.points, [len(range_m) for range_m, _, _ in points])
    expected = [sum(chance(r) for r in range_m.tolist()) for range_m, _, _ in points]
    np.testing.assert_allclose(result.points, expected, rtol=2e-3)
    centre = [chance(r) for r in result.range_m.tolist()]
    np.testing.assert_allclose(result.points_alone, plain.points_alone * centre, rtol=1e-9)
    assert (result.points_on_sides <= result.points + 1e-9).all() and (result.points_on_sides > 0.0).any()


@pytest.mark.slow
def test_expected_extents_are_the_mean_over_draws() -> None:
    """A beam counts by its probability: not fully, as it would if any probability were enough."""
    result, plain = visible(losses()), visible(None)
    rng = np.random.default_rng(5)
    for i, (range_m, along_m, across_m) in enumerate(points_of(fan(POSE))):
        probability = np.array([chance(r) for r in range_m.tolist()])
        length_m, width_m = BOXES[i, 3:5]
        spans, holes = [], []
        for _ in range(DRAWS):
            kept = rng.random(len(range_m)) < probability
            if not kept.any():
                spans.append((0.0, 0.0))
                holes.append(0.0)
                continue
            spans.append((np.ptp(along_m[kept]) / length_m, np.ptp(across_m[kept]) / width_m))
            parts = np.unique(np.clip(64 * (along_m[kept] / (length_m - 2e-4) + 0.5), 0, 63).astype(int))
            holes.append(max(np.diff(parts) - 1, default=0) / 64 * length_m)
        span, scatter = np.mean(spans, axis=0), np.std(spans, axis=0) / math.sqrt(DRAWS)
        assert result.length_share[i] == pytest.approx(span[0], abs=4 * scatter[0] + 1 / 64)
        assert result.width_share[i] == pytest.approx(span[1], abs=4 * scatter[1] + 1 / 64)
        hole_scatter = 4 * np.std(holes) / math.sqrt(DRAWS)
        assert result.hole_m[i] == pytest.approx(np.mean(holes), abs=hole_scatter + length_m / 64)
    assert (result.length_share < plain.length_share - 0.02).any()
    assert (result.hole_m > plain.hole_m + 0.05).any()


def test_shares_of_beams_and_hard_limits_are_thinned_beam_by_beam() -> None:
    beams = fan(POSE)
    half = Beams(beams.pose, beams.sensor, beams.ends_m, np.full(len(beams.ends_m), 0.5))
    np.testing.assert_allclose(visible(losses(), half).points, 0.5 * visible(losses()).points, rtol=2e-3)
    hard = visible(losses(softness=0.0, dropout=0.0))
    expected = [np.count_nonzero(range_m <= 30.0 * math.sqrt(0.3)) for range_m, _, _ in points_of(beams)]
    np.testing.assert_allclose(hard.points, expected, atol=1.0)
    assert any(0 < count < len(points[0]) for count, points in zip(expected, points_of(beams), strict=True))


def test_nothing_lost_is_the_plain_result() -> None:
    result, plain = visible(losses(reflectivity=1e15, dropout=0.0)), visible(None)
    for name in ("points", "points_on_sides", "points_alone", "length_share", "width_share"):
        np.testing.assert_allclose(getattr(result, name), getattr(plain, name), atol=1e-6, err_msg=name)
    assert (np.abs(result.hole_m - plain.hole_m) <= BOXES[:, 3] / 64).all()


def test_slices_without_losses_are_those_of_the_points() -> None:
    """Of the length each slice with a point; of the width those with the outermost points."""
    misses = slice_misses(visible(None))
    for i, (_, along_m, across_m) in enumerate(points_of(fan(POSE))):
        for axis, at_m in enumerate((along_m, np.array([across_m.min(), across_m.max()]))):
            parts = np.unique(np.floor(64 * (at_m / (BOXES[i, 3 + axis] - 2e-4) + 0.5)).clip(0, 63).astype(int))
            assert np.flatnonzero(misses[i, axis] == 0.0).tolist() == parts.tolist()
    assert set(np.unique(misses)) == {0.0, 1.0}


def test_fused_sensors_miss_a_slice_if_each_does() -> None:
    here, there = Pose(101.0, 206.0, 3.0), Pose(118.0, 212.0, 3.0)
    record = TargetRecord.of([frame(BOXES)], GRID)
    views = [visible_targets(record, fan(pose), losses()) for pose in (here, there)]
    fused = fuse_targets(views)
    expected = slice_misses(views[0]) * slice_misses(views[1])
    np.testing.assert_allclose(slice_misses(fused), expected, rtol=1e-6)
    assert (fused.length_share >= np.max([view.length_share for view in views], axis=0) - 1 / 64).all()
    mixed = fuse_targets([views[0], visible_targets(record, fan(there))])
    assert (mixed.length_share >= fused.length_share - 1e-6).all()


@pytest.mark.parametrize("probability", [0.02, 0.3, 0.9])
@pytest.mark.parametrize("count", [2, 8, 30, 64])
def test_expected_gap_equals_mean_over_draws(probability: float, count: int) -> None:
    rng = np.random.default_rng(count)
    slices = vehicle_visibility.SLICES
    misses = np.ones((1, 2, slices), dtype=np.float32)
    misses[0, :, rng.choice(slices, count, replace=False)] = 1.0 - probability
    share, spans = np.zeros(1), np.zeros((1, 2))
    vehicle_visibility.expected_gaps(misses, np.array([0]), share)
    bounds_m = np.array([[[-0.5, -0.5], [0.5, 0.5]]])
    vehicle_visibility.expected_spans(misses, np.array([0]), bounds_m, np.ones((1, 2)), spans)

    kept = rng.random((20000, slices)) > misses[0, 0]
    gaps, widths = [], []
    for row in kept:
        parts = np.flatnonzero(row)
        gaps.append(max(np.diff(parts) - 1, default=0))
        widths.append(parts[-1] - parts[0] + 1 if len(parts) else 0)
    assert share[0] * slices == pytest.approx(np.mean(gaps), abs=1.0)
    np.testing.assert_allclose(spans[0] * slices, np.mean(widths), atol=5 * np.std(widths) / 141 + 1e-3)
