"""What one sensor more brings, and how sure that is, on numbers made up."""

import math

import numpy as np

from egvs.sensors.sites import Pose, Site
from egvs.validation.detection_metrics import ALL_OBJECTS, BLOCKS, MEASURES, JackknifeEstimate, SiteDetection
from egvs.validation.plan_validation import SensorGroup, estimate_difference, with_gains
from egvs.validation.sweeps import POINT_COUNTS_NAME

A, B = (Site(name, Pose(0.0, 0.0, 3.0), "small") for name in "ab")
GROUPS = (SensorGroup((A,)), SensorGroup((A, B)))


def _estimate(by_block):
    """The mean of a value that each of ten blocks of one frame has, as a detector's measures are jackknifed."""
    by_block = np.asarray(by_block, dtype=np.float64)
    left_out = (by_block.sum() - by_block) / (BLOCKS - 1)
    return JackknifeEstimate.from_values(np.append(by_block.mean(), left_out), np.ones(BLOCKS))


def test_a_difference_is_as_sure_as_the_blocks_agree():
    one, other = np.random.default_rng(1).random((2, BLOCKS))
    found = estimate_difference(_estimate(one), _estimate(other), BLOCKS)
    assert math.isclose(found.value, (one - other).mean())
    assert math.isclose(found.se, (one - other).std(ddof=1) / math.sqrt(BLOCKS))
    same = estimate_difference(_estimate(one), _estimate(one - 0.25), BLOCKS)  # far surer than either
    assert math.isclose(same.value, 0.25) and same.se < 1e-12 < _estimate(one).se


def _row(group, objects_of, value):
    measures = {name: _estimate(np.full(BLOCKS, value)) for name in MEASURES}
    return SiteDetection(group.name, POINT_COUNTS_NAME, objects_of, BLOCKS, 5, {}, measures)


def test_gains_are_of_the_group_before_and_of_the_same_objects():
    values = zip(GROUPS, (0.5, 0.8), strict=True)
    rows = [_row(group, name, value) for group, value in values for name in (ALL_OBJECTS, "points_5")]
    found = with_gains(GROUPS, rows)
    assert [its.sites for its in found] == [("a",), ("a",), ("a", "b"), ("a", "b")]
    assert [its.detection for its in found] == rows
    np.testing.assert_allclose([its.gain.value for its in found], [0.5, math.nan, 0.3, math.nan])
