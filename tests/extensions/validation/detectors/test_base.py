"""Overlap suppression keeps the detection with the largest weight."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.clouds.sweeps import Detections
from egvs.extensions.validation.detection_metrics import paired_overlap
from egvs.extensions.validation.detectors.base import MAX_OVERLAP, suppress_overlaps


def test_keeps_box_with_higher_score():
    boxes = np.array([[1, 0, 1, 4, 2, 2, 0.1], [3.9, 0, 1, 4, 2, 2, 0.0], [0, 0, 1, 4, 2, 2, 0.0]])
    scores = np.array([0.4, 0.2, 0.9])
    detections = suppress_overlaps(Detections(boxes, scores), scores)
    np.testing.assert_array_equal(detections.boxes[:, 0], [0.0, 3.9])
    np.testing.assert_array_equal(detections.scores, [0.9, 0.2])


def test_keeps_first_of_equal_weights():
    boxes = np.array([[0, 0, 1, 4, 2, 2, 0.0], [0.5, 0, 1, 4, 2, 2, 0.0]])
    assert suppress_overlaps(Detections(boxes, np.array([0.9, 0.5])), np.array([20, 20])).boxes[:, 0].tolist() == [0.0]


def test_no_detections():
    assert len(suppress_overlaps(Detections.empty(), np.empty(0)).boxes) == 0


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1), st.integers(1, 25))
def test_equals_comparison_with_all_others(seed, count):
    random = np.random.default_rng(seed)
    size = random.uniform([3, 1, 1], [18, 3, 4], (count, 3))
    boxes = np.column_stack([random.uniform(-12, 12, (count, 3)), size, random.uniform(-4, 4, count)])
    scores, weight = random.uniform(0, 1, count), random.integers(0, 5, count)
    detections = suppress_overlaps(Detections(boxes, scores), weight)
    selected = []
    for row in sorted(range(count), key=lambda row: -weight[row]):  # stable
        if all(paired_overlap(boxes[[row]], boxes[[other]])[0][0] <= MAX_OVERLAP for other in selected):
            selected.append(row)
    np.testing.assert_array_equal(detections.boxes, boxes[selected])
    np.testing.assert_array_equal(detections.scores, scores[selected])
