"""What one sensor more brings, and how sure that is, on numbers made up."""

import math

import numpy as np

from pipeline.sensing.sites import Pose, Site
from pipeline.validation.detection import ALL, MEASURES, SiteDetection
from pipeline.validation.fused.gains import difference, with_gains
from pipeline.validation.fused.plans import Group
from pipeline.validation.metrics.leave_out import BLOCKS, Estimate
from pipeline.validation.site_findings import POINTS

A, B = (Site(name, Pose(0.0, 0.0, 3.0), "small") for name in "ab")
GROUPS = (Group((A,)), Group((A, B)))


def _estimate(by_block):
    """The mean of a value that each of ten blocks of one frame has, as a detector's measures are jackknifed."""
    by_block = np.asarray(by_block, dtype=np.float64)
    left_out = (by_block.sum() - by_block) / (BLOCKS - 1)
    return Estimate.of(np.append(by_block.mean(), left_out), np.ones(BLOCKS))


def test_a_difference_is_as_sure_as_the_blocks_agree():
    one, other = np.random.default_rng(1).random((2, BLOCKS))
    found = difference(_estimate(one), _estimate(other), BLOCKS)
    assert math.isclose(found.value, (one - other).mean())
    assert math.isclose(found.se, (one - other).std(ddof=1) / math.sqrt(BLOCKS))
    same = difference(_estimate(one), _estimate(one - 0.25), BLOCKS)  # far surer than either
    assert math.isclose(same.value, 0.25) and same.se < 1e-12 < _estimate(one).se


def _row(group, objects_of, value):
    measures = {name: _estimate(np.full(BLOCKS, value)) for name in MEASURES}
    return SiteDetection(group.name, POINTS, objects_of, BLOCKS, 5, {}, measures)


def test_gains_are_of_the_group_before_and_of_the_same_objects():
    values = zip(GROUPS, (0.5, 0.8), strict=True)
    rows = [_row(group, name, value) for group, value in values for name in (ALL, "points_5")]
    found = with_gains(GROUPS, rows)
    assert [its.sites for its in found] == [("a",), ("a",), ("a", "b"), ("a", "b")]
    assert [its.detection for its in found] == rows
    np.testing.assert_allclose([its.gain.value for its in found], [0.5, math.nan, 0.3, math.nan])
