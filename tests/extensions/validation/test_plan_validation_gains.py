"""Gain by one more sensor and its standard error, on synthetic numbers."""

import math

import numpy as np

from egvs.extensions.validation.detection_metrics import (
    ALL_OBJECTS,
    BLOCKS,
    MEASURES,
    JackknifeEstimate,
    SiteDetection,
    estimate_difference,
)
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME
from egvs.extensions.validation.plan_validation import SensorGroup, with_gains
from egvs.sensors.sites import Pose, Site

A, B = (Site(name, Pose(0.0, 0.0, 3.0), "small") for name in "ab")
GROUPS = (SensorGroup((A,)), SensorGroup((A, B)))


def _estimate(by_block):
    """The mean of a value that each of ten blocks of one frame has, as a detector's measures are jackknifed."""
    by_block = np.asarray(by_block, dtype=np.float64)
    left_out = (by_block.sum() - by_block) / (BLOCKS - 1)
    return JackknifeEstimate.from_values(np.append(by_block.mean(), left_out), np.ones(BLOCKS))


def test_standard_error_of_difference_uses_common_blocks():
    one, other = np.random.default_rng(1).random((2, BLOCKS))
    gains = estimate_difference(_estimate(one), _estimate(other), BLOCKS)
    assert math.isclose(gains.value, (one - other).mean())
    assert math.isclose(gains.se, (one - other).std(ddof=1) / math.sqrt(BLOCKS))
    same = estimate_difference(_estimate(one), _estimate(one - 0.25), BLOCKS)  # far surer than either
    assert math.isclose(same.value, 0.25) and same.se < 1e-12 < _estimate(one).se


def _row(group, objects_of, value):
    measures = {name: _estimate(np.full(BLOCKS, value)) for name in MEASURES}
    return SiteDetection(group.name, POINT_COUNTS_NAME, objects_of, BLOCKS, 5, {}, measures)


def test_gain_is_relative_to_previous_group_and_same_objects():
    values = zip(GROUPS, (0.5, 0.8), strict=True)
    rows = [_row(group, name, value) for group, value in values for name in (ALL_OBJECTS, "points_5")]
    gains = with_gains(GROUPS, rows)
    assert [entry.sites for entry in gains] == [("a",), ("a",), ("a", "b"), ("a", "b")]
    assert [entry.detection for entry in gains] == rows
    np.testing.assert_allclose([entry.gain.value for entry in gains], [0.5, math.nan, 0.3, math.nan])
