"""Average precision against cases calculated by hand, a slow reference of KITTI's procedure, and properties."""

import math

import numpy as np
import pytest

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds.sweeps import Detections
from egvs.core.errors import InputError
from egvs.core.grid import Roi
from egvs.extensions.validation.detection_metrics import (
    EvaluationFrames,
    GroundTruth,
    JackknifeEstimate,
    evaluate,
    frame_blocks,
)
from egvs.extensions.validation.detector_results import detections_in_roi
from tests.oracles import kitti

CAR = (0.75, 4.0, 2.0, 1.5, 0.0)  # z, length, width, height, yaw


def box(x, z=0.75, length=4.0):
    return (x, 0.0, z, length, 2.0, 1.5, 0.0)


def objects(boxes, cars=None, points=None):
    n = len(boxes)
    return GroundTruth(
        np.array(boxes, float).reshape(n, 7),
        np.ones(n, bool) if cars is None else np.array(cars, bool),
        np.full(n, 100) if points is None else np.array(points),
    )


def detections_of(*scored):
    return Detections(np.array([b for b, _ in scored], float).reshape(-1, 7), np.array([s for _, s in scored], float))


def one_frame(truth, *scored):
    """The measures of one frame, beside nine that are empty."""
    empty = [(objects([]), Detections.empty())] * 9
    return evaluate(EvaluationFrames.from_frames(*zip((truth, detections_of(*scored)), *empty, strict=True)))


def values(evaluation, view="bev", iou=70, end=""):
    names = (f"ap_{view}_r11", f"ap_{view}_r40", f"recall_{view}")
    return [evaluation.measures[f"{name}_iou{iou}{end}"].value for name in names]


A, B, ASTRAY = box(0.0), box(10.0), box(50.0)


# ---- by hand. An object alone counts 41 times, two count 21 times each: 42 objects. The score of row i of the 42 is
# taken for step k where k / 40 <= (i + 1.5) / 42 (nearer than the next row): row k for k <= 30, row k + 1 from then on.
# So of two objects the surer one gives the steps 0 to 20 and the other one the steps 21 to 40. R11 takes the steps 0, 4
# .. 40: six of the former and five of the latter; R40 takes 20 of each.


@pytest.mark.parametrize(
    ("truth", "scored", "r11", "r40", "recall"),
    [
        pytest.param([A, B], [(A, 0.9), (B, 0.8)], 1, 1, 1, id="perfect"),
        pytest.param([A, B], [], 0, 0, 0, id="no detections"),
        pytest.param([A, B], [(ASTRAY, 0.9)], 0, 0, 0, id="none found"),
        # Half is found: steps 0 to 20 have precision 1, the others are not reached.
        pytest.param([A, B], [(A, 0.9)], 6 / 11, 1 / 2, 1 / 2, id="one of two"),
        # All steps have the threshold .5, and there 1 of 2 is true.
        pytest.param([A], [(A, 0.5), (ASTRAY, 0.9)], 1 / 2, 1 / 2, 1, id="reversed scores"),
        # Below the lowest threshold nothing counts.
        pytest.param([A], [(A, 0.5), (ASTRAY, 0.1)], 1, 1, 1, id="false one is unsure"),
        # Equal scores enter together: 1 of 2.
        pytest.param([A], [(A, 0.5), (ASTRAY, 0.5)], 1 / 2, 1 / 2, 1, id="tie"),
        # The duplicate lies below the only threshold; with the same score it is a false positive: 1 of 2.
        pytest.param([A], [(A, 0.9), (A, 0.8)], 1, 1, 1, id="duplicate"),
        pytest.param([A], [(A, 0.9), (A, 0.9)], 1 / 2, 1 / 2, 1, id="duplicate of the same score"),
        # With another object below, the duplicate counts from there on. Steps 0 to 20: 1 of 1; then 2 of 3.
        # R11 (6 + 5 * 2/3) / 11 = 28/33; R40 (20 + 20 * 2/3) / 40 = 5/6.
        pytest.param([A, B], [(A, 0.9), (A, 0.8), (B, 0.5)], 28 / 33, 5 / 6, 1, id="duplicate above another"),
        pytest.param([A, B], [(A, 0.9), (ASTRAY, 0.7), (B, 0.5)], 28 / 33, 5 / 6, 1, id="false one between"),
        # At .9 it is 1 of 2, at .5 2 of 3; the better one applies to all: 2/3.
        pytest.param([A, B], [(ASTRAY, 0.95), (A, 0.9), (B, 0.5)], 2 / 3, 2 / 3, 1, id="monotone from the right"),
        # Two objects .4 m apart, a box between: it overlaps each by 3.8 / 4.2 = .905, and one of them takes it.
        pytest.param([box(0.0), box(0.4)], [(box(0.2), 0.9)], 6 / 11, 1 / 2, 1 / 2, id="two claimed by one box"),
        # x = 0 overlaps by 1 and x = .4 by 3.6 / 4.4 = .818. First pass: the surer one (.9). Second pass at .9: that
        # one, alone. The better one lies below every threshold.
        pytest.param([A], [(box(0.4), 0.9), (A, 0.8)], 1, 1, 1, id="the surer one gives the threshold"),
        # First pass: the object at 0 takes .9 (its only one: x = .8 overlaps it by 3.2 / 4.8); .8 is left, and overlaps
        # the object at .4 by 3.6 / 4.4. So all are found, though the box at .4 fits the second object to the digit.
        pytest.param([box(0), box(0.4)], [(box(0.4), 0.9), (box(0.8), 0.8)], 1, 1, 1, id="objects in turn"),
    ],
)
def test_by_hand(truth, scored, r11, r40, recall):
    evaluation = one_frame(objects(truth), *scored)
    for view in ("bev", "3d"):
        np.testing.assert_allclose(values(evaluation, view), [r11, r40, recall], atol=1e-12)
    for kind, value in (("r11", r11), ("r40", r40)):
        assert evaluation.measures[f"ap_mean_{kind}_iou70"].value == pytest.approx(value)


def test_measures_without_objects_are_nan_with_warnings():
    evaluation = one_frame(objects([]), (A, 0.9))
    assert all(math.isnan(entry.value) and math.isnan(entry.se) for entry in evaluation.measures.values())
    warnings = [str(warning) for warning in evaluation.warnings("site c03, cluster")]
    assert warnings[0] == (
        "site c03, cluster: no vehicles in 10 frames, so average precision is undefined. Use more frames."
    )
    assert len(warnings) == 5  # of each subset
    evaluation = one_frame(objects([A]), (A, 0.9))
    assert "all vehicles are in one of 10 blocks of frames" in str(evaluation.warnings("site c03")[0])
    assert evaluation.measures["ap_bev_r40_iou70"].value == 1 and math.isnan(evaluation.measures["ap_bev_r40_iou70"].se)


def test_match_must_exceed_minimum_overlap():
    """Half the length is an overlap of exactly .5; so is a shift d with (4 - d) / (4 + d) = .5, but for its digits."""
    for other in (box(0.0, length=2.0), box(4 / 3), box(-4 / 3)):
        assert values(one_frame(objects([A]), (other, 0.9)), iou=50) == [0, 0, 0]
    assert values(one_frame(objects([A]), (box(1.33), 0.9)), iou=50) == [1, 1, 1]
    assert values(one_frame(objects([A]), (box(1.33), 0.9)), iou=70) == [0, 0, 0]
    # Nor does it give a threshold: the only one is .5, and there 1 of 2 is true.
    assert values(one_frame(objects([A]), (box(0.0, length=2.0), 0.9), (A, 0.5)), iou=50) == [0.5, 0.5, 1]


def test_height_matters_in_3d_only():
    """Half its height up: an overlap of 1 from above, of .75 / 2.25 = 1/3 in space."""
    evaluation = one_frame(objects([A]), (box(0.0, z=1.5), 0.9))
    assert values(evaluation, "bev", 50) == [1, 1, 1] and values(evaluation, "3d", 50) == [0, 0, 0]
    assert evaluation.measures["ap_mean_r40_iou50"].value == 0.5


def test_detections_of_ignored_objects_are_not_counted():
    truth = objects([A, B], cars=[True, False], points=[4, 30])
    evaluation = one_frame(truth, (A, 0.5), (B, 0.9))
    assert {name: counts.sum() for name, counts in evaluation.objects.items()} == {
        "": 2, "cars": 1, "points_1": 2, "points_5": 1, "points_20": 1,
    }  # fmt: skip
    assert values(evaluation, end="_cars") == [1, 1, 1]
    assert values(evaluation, end="_points_20") == [1, 1, 1]
    # A second box on the bus, and one that fits neither, are false positives for cars too: 1 of 3 at .5.
    evaluation = one_frame(truth, (A, 0.5), (B, 0.9), (B, 0.8), (ASTRAY, 0.7))
    np.testing.assert_allclose(values(evaluation, end="_cars"), [1 / 3, 1 / 3, 1])


@pytest.mark.parametrize("cars", [[True, False], [False, True]])
def test_box_that_fits_two_objects_matches_the_evaluated_one(cars):
    evaluation = one_frame(objects([box(0.0), box(0.4)], cars=cars), (box(0.2), 0.9))
    assert values(evaluation, end="_cars") == [1, 1, 1]


def test_standard_error_by_hand():
    """One object a frame, found in five of ten. Recall .5; without a found one 4/9, without a missed one 5/9. Pseudo-
    values 10 * .5 - 9 * that: 1 and 0. se^2 = mean of (1/2)^2 / 9, so se = 1/6: that of a mean of five 1 and five 0."""
    truth, hit = objects([A]), detections_of((A, 0.9))
    record = EvaluationFrames.from_frames([truth] * 10, [hit] * 5 + [Detections.empty()] * 5)
    recall = evaluate(record).measures["recall_bev_iou70"]
    np.testing.assert_allclose(recall.left_out, [4 / 9] * 5 + [5 / 9] * 5)
    assert recall.value == 0.5 and recall.se == pytest.approx(1 / 6)


def test_standard_error_of_unequal_blocks():
    """A mean over frames: pseudo-values are the blocks' own means, whatever their lengths."""
    frames, rng = np.bincount(frame_blocks(47, 10)), np.random.default_rng(0)
    sums = rng.normal(size=10) * frames
    left_out = (sums.sum() - sums) / (frames.sum() - frames)
    estimate = JackknifeEstimate.from_values(np.concatenate([[sums.sum() / 47], left_out]), frames)
    expected = ((sums / frames - sums.sum() / 47) ** 2 / (47 / frames - 1)).mean() ** 0.5
    assert estimate.se == pytest.approx(expected)


def test_blocks_are_neighbours_of_equal_size():
    assert list(frame_blocks(7, 3)) == [0, 0, 0, 1, 1, 2, 2]
    with pytest.raises(InputError, match="--frames: expected at least 10 frames, got 9"):
        frame_blocks(9)


# ---- against the slow reference


def random_scenes(seed, frames, objects_a_frame=5.0):
    """Crowded and sloppy, with duplicates and coarse scores: every rule is at work."""
    rng = np.random.default_rng(seed)
    truth, detections = [], []
    for _ in range(frames):
        n = rng.poisson(objects_a_frame)
        boxes = np.column_stack([
            rng.uniform(0, 12, (n, 2)), np.full(n, 0.8), rng.uniform(3.5, 5, n), rng.uniform(1.6, 2.2, n),
            rng.uniform(1.4, 1.8, n), rng.uniform(-3, 3, n),
        ])  # fmt: skip
        truth.append(GroundTruth(boxes, rng.random(n) < 0.7, rng.integers(0, 30, n)))
        visible = np.repeat(boxes, rng.integers(0, 3, n), axis=0)
        visible = visible + rng.normal(0, [0.3, 0.1, 0.05, 0.2, 0.1, 0.1, 0.1], visible.shape)
        false = boxes[rng.random(n) < 0.3] + [20, 0, 0, 0, 0, 0, 0]
        both = np.concatenate([visible, false])
        detections.append(Detections(both, rng.integers(1, 12, len(both)) / 8))
    return truth, detections


def twin(truth, detections, subset, view, iou):
    scenes = []
    for entry, given in zip(truth, detections, strict=True):
        counts = {
            "": entry.points >= 0,
            "cars": entry.is_car,
            "points_5": entry.points >= 5,
            "points_20": entry.points >= 20,
        }
        rows = sorted(range(len(entry.boxes)), key=lambda i: (not counts[subset][i], tuple(entry.boxes[i])))
        columns = sorted(range(len(given.scores)), key=lambda j: (-given.scores[j], tuple(given.boxes[j])))
        scenes.append(
            kitti.Scene(
                [(entry.boxes[i], not counts[subset][i]) for i in rows],
                [(given.boxes[j], given.scores[j]) for j in columns],
            )
        )
    objects = sum(not ignored for scene in scenes for _, ignored in scene.objects)
    return kitti.average_precision(scenes * -(-41 // objects), view, iou)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_equals_slow_reference(seed):
    truth, detections = random_scenes(seed, 20)
    evaluation = evaluate(EvaluationFrames.from_frames(truth, detections))
    for subset in ("", "cars", "points_20"):
        for view, iou in (("bev", 0.7), ("3d", 0.5)):
            end = f"_{subset}" if subset else ""
            expected = twin(truth, detections, subset, view, iou)
            np.testing.assert_allclose(values(evaluation, view, round(100 * iou), end), expected, rtol=0, atol=1e-12)
            assert 0.05 < expected[1] < 0.95  # neither trivial value


def test_left_out_values_equal_evaluation_of_fewer_frames():
    truth, detections = random_scenes(7, 20)
    estimate = evaluate(EvaluationFrames.from_frames(truth, detections), 5).measures
    for block in (0, 3):
        rest = [k for k in range(20) if k // 4 != block]
        expected = twin([truth[k] for k in rest], [detections[k] for k in rest], "cars", "3d", 0.5)
        names = [f"{kind}_iou50_cars" for kind in ("ap_3d_r11", "ap_3d_r40", "recall_3d")]
        np.testing.assert_allclose([estimate[name].left_out[block] for name in names], expected, rtol=0, atol=1e-12)


def test_few_objects_count_frames_several_times():
    truth, detections = random_scenes(3, 12, 1.0)
    assert 5 < sum(len(entry.boxes) for entry in truth) < 30
    got = values(evaluate(EvaluationFrames.from_frames(truth, detections)), "bev", 50)
    np.testing.assert_allclose(got, twin(truth, detections, "", "bev", 0.5), atol=1e-12)


def test_order_of_input_has_no_effect():
    truth, detections = random_scenes(11, 40)
    rng = np.random.default_rng(0)

    def shuffled(entry):
        row = rng.permutation(len(entry.boxes))
        if isinstance(entry, GroundTruth):
            return GroundTruth(entry.boxes[row], entry.is_car[row], entry.points[row])
        return Detections(entry.boxes[row], entry.scores[row])

    plain = evaluate(EvaluationFrames.from_frames(truth, detections))
    other = evaluate(
        EvaluationFrames.from_frames([shuffled(entry) for entry in truth], [shuffled(entry) for entry in detections])
    )
    for name, entry in plain.measures.items():
        assert (entry.value, entry.se) == (other.measures[name].value, other.measures[name].se), name


@pytest.mark.parametrize("turned", [[0, 1], [1, 0]])
@pytest.mark.parametrize("swapped", [[0, 1], [1, 0]])
def test_ties_do_not_depend_on_order(turned, swapped):
    """Objects at 0 and 1. The box at .5 overlaps both by 3.5 / 4.5; the one at -1 overlaps the object at 0 alone, by
    3 / 5, and has the same score. First pass: the object at 0 takes the box at -1, which comes first, and that at 1 the
    other: thresholds for all steps. Second pass: the object at 0 takes the box that fits best, and nothing is left: 1
    of 2."""
    scored, truth = [(box(-1.0), 0.9), (box(0.5), 0.9)], [box(0.0), box(1.0)]
    evaluation = one_frame(objects([truth[k] for k in turned]), *(scored[k] for k in swapped))
    assert values(evaluation, iou=50) == [0.5, 0.5, 0.5]


def test_only_order_of_scores_matters():
    truth, detections = random_scenes(12, 30)
    bent = [Detections(entry.boxes, np.exp(7 * entry.scores) - 100) for entry in detections]
    plain, other = (evaluate(EvaluationFrames.from_frames(truth, entry)).measures for entry in (detections, bent))
    assert all(plain[name].value == other[name].value for name in plain)


# ---- what comes in


def test_ground_truth_of_frame():
    boxes = np.array([box(1.0), box(2.0), box(3.0), box(30.0)])
    frame = TrafficFrame(0, tuple("abcd"), ("taxi", "bus", "bicycle", "taxi"), boxes, np.zeros(4))
    roi = Roi((0.0, -5.0, 0.0), (10.0, 10.0, 5.0))
    entry = GroundTruth.from_frame(frame, np.array([7, 8, 9, 10])[frame.target_rows(roi)], roi)
    assert list(entry.is_car) == [True, False] and list(entry.points) == [7, 8] and list(entry.boxes[:, 0]) == [1, 2]


def test_drops_detections_outside_region():
    roi = Roi((0.0, -5.0, 0.0), (10.0, 10.0, 5.0))
    detections = detections_in_roi(detections_of((box(0.0), 0.1), (box(10.0), 0.2), (box(5.0, z=99.0), 0.3)), roi)
    assert list(detections.scores) == [0.1, 0.3]


@pytest.mark.parametrize(
    ("wrong", "score", "message"),
    [
        (box(math.nan), 1.0, "detection 1 of frame 1: x_m: expected a finite number, got nan"),
        (box(0.0), math.inf, "detection 1 of frame 1: score: expected a finite number, got inf"),
        (box(0.0, length=-1.0), 1.0, "detection 1 of frame 1: length_m: expected a length of at least 0, got -1"),
    ],
)
def test_rejects_invalid_boxes(wrong, score, message):
    with pytest.raises(InputError) as caught:
        EvaluationFrames.from_frames([objects([])] * 2, [Detections.empty(), detections_of((A, 0.5), (wrong, score))])
    assert str(caught.value).startswith(message)
