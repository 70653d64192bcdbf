"""The additive model of detection: by hand, and its features."""

from __future__ import annotations

import math

import numpy as np
import pytest
from benchmarks.across_junctions.models.additive_model import (
    DIRECTIONS,
    AdditiveModel,
    TargetFeatures,
    target_features,
)
from benchmarks.across_junctions.models.crowding import CLASSES

from egvs.scoring.target_scores import point_spacing_m
from tests.scoring.target_scenes import frame, seen
from tests.scoring.test_visible_targets import car, fan

MODEL = AdditiveModel(
    -1.0,
    {
        "log_points": (np.array([0.0, 2.0, 4.0]), np.array([0.0, 1.0, 4.0])),
        "hidden_share": (np.array([0.0, 1.0]), np.array([0.0, -2.0])),
    },
    np.array([0.0, 0.5, 0.0, 0.0, -2.0]),
)
"""By :data:`CLASSES`: car, van, truck, bus, motorcycle."""


def changed(**values) -> TargetFeatures:
    """One vehicle per value."""
    count = max(len(column) for column in values.values())
    columns = {name: np.array(values.get(name, [0.0] * count), dtype=np.float64) for name in DIRECTIONS}
    return TargetFeatures(columns, np.zeros(count, dtype=np.int64))


def test_probability_by_hand():
    model = MODEL
    # between knots: -1 + 0.5, -1 + 2.5; at and beyond the last: -1 + 4; half of it hidden: 3 - 1
    x = changed(log_points=[1.0, 3.0, 4.0, 9.0, 4.0], hidden_share=[0.0, 0.0, 0.0, 0.0, 0.5])
    logit = np.log(model.chances(x) / (1.0 - model.chances(x)))
    np.testing.assert_allclose(logit, [-0.5, 1.5, 3.0, 3.0, 2.0])
    motorcycle = TargetFeatures(x.columns, np.full(5, CLASSES.index("motorcycle")))
    np.testing.assert_allclose(
        np.log(model.chances(motorcycle) / (1 - model.chances(motorcycle))), logit - 2.0, atol=1e-9
    )


@pytest.mark.slow
def test_features_by_hand():
    visible = seen([frame([car(21.0, 0.0)], ("bus",))], fan())
    x = target_features(visible)
    assert set(x.columns) == set(DIRECTIONS) and x.vehicle_class.tolist() == [CLASSES.index("bus")]
    assert x.columns["log_points"].tolist() == [math.log(115)] and x.columns["length_m"].tolist() == [4.0]
    assert x.columns["log_spacing"].tolist() == [math.log(point_spacing_m(visible)[0])]
    assert x.columns["log_column_spacing"].tolist() == x.columns["log_spacing"].tolist()  # without rings
    in_rings = target_features(visible, column_step_deg=0.5).columns["log_column_spacing"]
    assert in_rings == pytest.approx([math.log(visible.range_m[0] * math.pi / 360.0)])
