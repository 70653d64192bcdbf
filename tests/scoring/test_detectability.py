"""The chance that a vehicle is found: against trees walked in plain Python, by hand, and what the model must obey."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from egvs.scoring import target_scores
from egvs.scoring.target_scores import (
    CORRECTION_FEATURES,
    DETECTORS,
    FEATURES,
    MODELLED,
    MONOTONICITY,
    DetectabilityModel,
)
from tests.scoring.target_scenes import beams_to, frame, seen
from tests.scoring.test_visible_targets import AT, car, fan

DATA = json.loads(target_scores.MODEL_FILE.read_text(encoding="utf-8"))
CORRECTIONS = json.loads(target_scores.CORRECTIONS_FILE.read_text(encoding="utf-8"))["detectors"]
HIGH = {"log_points": 8.0, "log_points_on_sides": 8.0, "length_share": 1.0, "width_share": 1.0, "hole_m": 6.0,
        "gap_m": 20.0, "depression_deg": 60.0, "length_m": 18.0, "range_m": 120.0, "side": 1.0,
        "log_spacing": 1.6, "larger_length_m": 18.0, "larger_width_m": 2.6, "larger_height_m": 4.0}  # fmt: skip
LOW = dict.fromkeys(HIGH, 0.0) | {"log_spacing": -4.0}


def rows(count: int, seed: int = 1) -> np.ndarray:
    """Features of corrected models anywhere in their ranges, (count, g)."""
    return np.random.default_rng(seed).uniform(list(LOW.values()), list(HIGH.values()), (count, len(HIGH)))


def walked(detector: str, row: np.ndarray, scale: float = 1.0, base: float | None = None, more=()) -> float:
    its = DATA["detectors"][detector]
    logit = its["base"] if base is None else base
    trees = [(scale, tree) for tree in its["trees"]] + [(1.0, tree) for tree in more]
    for factor, tree in trees:
        node = tree[0]
        while len(node) > 1:
            feature, threshold, left, right = node
            node = tree[left if row[feature] <= threshold else right]
        logit += factor * node[0]
    return 1.0 / (1.0 + math.exp(-logit))


@pytest.mark.parametrize("detector", MODELLED)
def test_as_trees_walked_one_by_one(detector):
    x = rows(40)
    name = detector if detector not in CORRECTIONS else f"{detector}_uncorrected"
    found = target_scores.detectability_model(name).chances(x)
    np.testing.assert_allclose(found, [walked(detector, row) for row in x], rtol=1e-12)
    assert np.ptp(found) > 0.5 * found.max()  # they tell rows apart


@pytest.mark.parametrize("detector", DETECTORS)
def test_correction_scales_the_trees_and_adds_its_own(detector):
    x, its = rows(40), CORRECTIONS[detector]
    found = target_scores.detectability_model(detector).chances(x)
    expected = [walked(detector, row, its["scale"], its["base"], its["trees"]) for row in x]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert not np.allclose(found, target_scores.detectability_model(f"{detector}_uncorrected").chances(x), atol=0.01)


@pytest.mark.parametrize("detector", MODELLED)
@pytest.mark.parametrize("feature", [name for name, way in MONOTONICITY.items() if way])
def test_probability_is_monotonic_in_each_feature(detector, feature):
    x = rows(400)
    x[:, FEATURES.index("depression_deg")] *= 0.1  # one of the detectors finds hardly anything from steeply above
    column = FEATURES.index(feature)
    low, high = x.copy(), x.copy()
    high[:, column] = rows(400)[:, column]
    low[:, column] = 0.5 * (high[:, column] + LOW[feature])
    model = target_scores.detectability_model(detector)
    change = MONOTONICITY[feature] * (model.chances(high) - model.chances(low))
    assert (change >= 0.0).all() and change.max() > 0.0


def test_rows_of_several_blocks_are_as_each_alone_whatever_their_order_in_memory():
    x, model = rows(2500), target_scores.detectability_model("cluster")
    found = model.chances(x)
    assert np.array_equal(found, model.chances(np.asfortranarray(x)))
    some = [0, 1, 1023, 1024, 1025, 2047, 2048, 2499]
    assert np.array_equal(found[some], [model.chances(x[row : row + 1])[0] for row in some])
    assert len(model.chances(x[:0])) == 0


@pytest.mark.parametrize("detector", MODELLED)
def test_a_node_comes_before_those_that_it_leads_to(detector):
    for tree in DATA["detectors"][detector]["trees"]:
        assert all(min(node[2:]) > number for number, node in enumerate(tree) if len(node) > 1)


def test_features_that_a_tree_needs_must_be_there():
    with pytest.raises(ValueError, match="expected 14 features, got 11"):
        DetectabilityModel.of({"base": 0.0, "trees": [[[13, 2.0, 1, 2], [-1.0], [1.0]]]}).chances(rows(3)[:, :11])


def test_a_tree_by_hand():
    model = DetectabilityModel.of({"base": 0.5, "trees": [[[0, 2.0, 1, 2], [-1.5], [1.0]], [[0.25]]]})
    x = np.zeros((3, len(FEATURES)))
    x[:, 0] = 1.0, 2.0, 3.0  # on the threshold goes left
    np.testing.assert_allclose(np.log(1.0 / model.chances(x) - 1.0), [0.75, 0.75, -1.75])


def test_features_by_hand():
    found = seen([frame([car(21.0, 0.0), car(22.0, 40.0)])], fan())  # the second lies beyond the region
    x = target_scores.detectability_features(found)
    hole_m, slope = 4.0 / 64, math.degrees(math.atan(0.25 / 21.0))
    # 114 points on a side of 4 m by 1.5 m, and a little of the roof
    area_m2 = math.cos(math.radians(slope)) * 6.0 + math.sin(math.radians(slope)) * 8.0
    right = [math.log(115), math.log(115), found.length_share[0], 0.0, hole_m, 20.0, slope, 4.0, found.range_m[0], 1.0,
             0.5 * math.log(area_m2 / 114)]  # fmt: skip
    np.testing.assert_allclose(x, [right], atol=1e-9)
    assert FEATURES[5] == "gap_m" and found.record.gap_m[0] == 36.0  # 40 m between centres, 4 m long; 20 m is alone


def test_a_vehicle_without_a_point_is_missed_and_one_well_seen_is_found():
    near, hidden = car(10.0, 0.0), car(30.0, 0.0)
    found = seen([frame([near, (AT[0] + 20.0, AT[1], 1.5, 12.0, 2.5, 3.0, math.pi / 2), hidden])], fan())
    chance = target_scores.detection_chances(found)
    assert found.points[2] == 0.0 and chance[2] == 0.0
    assert chance[0] > 0.7
    assert target_scores.expected_detections(found) == pytest.approx(chance.mean())
    assert target_scores.expected_detections(found, weight=np.array([0.0, 0.0, 1.0])) == 0.0
    each = [target_scores.detection_chances(found, [name]) for name in DETECTORS]
    np.testing.assert_allclose(chance, np.mean(each, axis=0))
    assert not np.array_equal(*each)


def test_a_detector_that_measures_heights_from_the_sensor_misses_from_high_mounts():
    def chance(detector, height_m):
        """Of a car 15 m away, at the angle at which a sensor so high sees it, well visible from there."""
        depression_rad = math.atan2(height_m - 0.75, 15.0)
        row = dict(LOW, log_points=6.0, log_points_on_sides=5.5, length_share=0.98, width_share=0.9, gap_m=20.0,
                   depression_deg=math.degrees(depression_rad), length_m=4.5, range_m=15.0 / math.cos(depression_rad),
                   side=0.7, log_spacing=-2.2)  # fmt: skip
        features = np.array([[row[name] for name in CORRECTION_FEATURES]])
        return target_scores.detectability_model(detector).chances(features)[0]

    assert chance("pointpillars_sensor", 2.0) > 0.5
    assert chance("pointpillars_sensor", 6.0) < 0.2 * chance("pointpillars_sensor", 2.0)
    assert chance("pointpillars", 6.0) > 0.8


def test_without_a_vehicle_it_is_not_a_number():
    assert math.isnan(target_scores.expected_detections(seen([frame([])], beams_to(AT, [[5.0, 0.0, 0.0]]))))


@pytest.mark.parametrize(("detector", "largest"), [("cluster", 0.05), ("pointpillars", 0.15)])
def test_chances_held_at_junctions_that_they_were_not_learnt_from(detector, largest):
    elsewhere = DATA["detectors"][detector]["elsewhere"]
    assert set(elsewhere["rho_with_ap"]) == set(DATA["about"]["learnt_on"])
    assert "nishishinjuku" not in DATA["about"]["learnt_on"]  # held out: results are quoted for it
    for part in elsewhere["calibration"]:
        assert abs(part["chance"] - part["found"]) < largest
