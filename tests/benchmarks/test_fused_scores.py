"""Two joint scores of pairs of sensors against detection in fused clouds: pairs, levels, ranks and table by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from benchmarks.placement import fused_scores
from benchmarks.placement.fused_scores import FUSED, INDEPENDENT, GroupResult, JunctionResult

from egvs.extensions.validation.detection_metrics import BLOCKS
from egvs.extensions.validation.plan_validation import SensorGroup
from egvs.sensors.sites import Pose, Site


def site(name: str, x_m: float, z_m: float = 3.0) -> Site:
    return Site(name, Pose(x_m, 0.0, z_m), "VLP-32C")


SITES = [site("a", 0.0), site("a_high", 0.0, 4.5), site("b", 9.0), site("c", 20.0)]


def test_pairs_are_drawn_at_different_poles_and_at_the_same() -> None:
    groups = fused_scores.draw_pairs(SITES, 3, 2, seed=1)
    assert [fused_scores.at_same_pole(group) for group in groups] == [False, False, False, True]  # one pole has two
    assert groups[3].name == "a + a_high" and len({group.name for group in groups}) == 4
    assert groups == fused_scores.draw_pairs(SITES, 3, 2, seed=1) != fused_scores.draw_pairs(SITES, 3, 2, seed=2)
    assert not fused_scores.at_same_pole(SensorGroup((SITES[0],)))


def test_level_is_the_mean_difference_with_its_jackknife_error() -> None:
    """Two groups, two vehicle-frames in each of ten blocks; the standard error of the mean of ten equal blocks."""
    rng = np.random.default_rng(4)
    block = np.repeat(np.arange(BLOCKS), 2)
    expected, found = rng.random((2, 20)), rng.random((2, 20))
    estimate = fused_scores.mean_difference(list(expected), list(found), block, np.full(BLOCKS, 4))
    of_block = (expected - found).mean(axis=0).reshape(BLOCKS, 2).mean(axis=1)
    assert estimate.value == pytest.approx((expected - found).mean())
    assert estimate.se == pytest.approx(of_block.std(ddof=1) / math.sqrt(BLOCKS))


def test_ranks_by_hand() -> None:
    assert fused_scores.rank_correlation([0.1, 0.5, 0.7], [10.0, 20.0, 90.0]) == pytest.approx(1.0)
    assert fused_scores.rank_correlation([0.1, 0.5, 0.7], [90.0, 10.0, 20.0]) == pytest.approx(-0.5)


def test_table_has_levels_and_ranks_of_each_score() -> None:
    groups = []
    for number, same_pole in enumerate((False, False, False, False, True)):
        found = np.full(20, 0.5)
        scores = {INDEPENDENT: found + 0.1 + 0.01 * number, FUSED: found + 0.02 - 0.01 * number}
        groups.append(GroupResult(("x", "y"), same_pole, scores, found, ap=0.6 + 0.01 * number))
    result = JunctionResult("mini", np.repeat(np.arange(BLOCKS), 2), np.full(BLOCKS, 4), tuple(groups))
    head, _, poles, same, pairs = fused_scores.lines([result])
    cells = [cell.strip() for cell in head.strip("|").split("|")]
    assert cells[:5] == ["junction", "sensors", "groups", "found", "AP"] and len(cells) == 9
    assert poles == "| mini | two poles | 4 | 50.0 | 61.5 | +11.5 ± 0.0 | +0.5 ± 0.0 | 1.00 | -1.00 |"
    assert same.startswith("| mini | one pole | 1 | 50.0 | 64.0 | +14.0 ± 0.0 | -2.0 ± 0.0 |")
    assert pairs.startswith("| mini | all pairs | 5 | 50.0 | 62.0 | +12.0 ± 0.0 | +0.0 ± 0.0 |")
