"""The detector cluster with several sensors, on scenes small enough to know the answer."""

from dataclasses import replace

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies

from egvs.clouds.sweeps import Detections, Sweep
from egvs.extensions.validation.detectors.cluster import Cluster, Rectangles, visible_ends
from egvs.extensions.validation.detectors.clustering import Clusters, Density, _merge_labels, find_clusters
from egvs.sensors.sites import Pose
from tests.extensions.validation.detectors.test_cluster import CAR, ROI, overlaps, simulate_sweep

NEAR, FAR = Pose(0.0, 0.0, 4.0), Pose(0.0, 30.0, 4.0, yaw_deg=40.0)


def fused(boxes, poses, still=(), noise_m=0.0):
    """What sensors find together, and what each finds alone."""
    views_and_sweeps = [simulate_sweep(boxes, pose, still=still, noise_m=noise_m) for pose in poses]
    joint = Cluster().at_sites([detector.joint.views[0] for detector, _ in views_and_sweeps], ROI)
    return joint.detect([sweep for _, sweep in views_and_sweeps]), [
        detector.detect(sweep) for detector, sweep in views_and_sweeps
    ]


@pytest.mark.slow
@pytest.mark.parametrize("yaw", [0.0, 0.7, 1.6])
def test_detects_car_between_two_sensors_once(yaw):
    boxes = [(4.0, 15.0, *CAR, yaw)]
    detections, alone = fused(boxes, [NEAR, FAR], noise_m=0.03)
    assert len(detections.scores) == 1 and overlaps(boxes, detections).min() > 0.7
    assert detections.scores[0] > 0.5 * max(single.scores.max() for single in alone)


@pytest.mark.slow
def test_one_sensor_detects_what_is_hidden_from_the_other():
    wall = (0.0, 20.0, 60.0, 0.4, 6.0, 0.0)
    boxes = [(12.0, 5.0, *CAR, 0.4), (-12.0, 26.0, *CAR, 0.4)]
    detections, alone = fused(boxes, [NEAR, replace(FAR, y_m=40.0)], still=[wall])
    assert overlaps(boxes, detections).min() > 0.7
    assert [len(single.scores) for single in alone] == [1, 1]
    assert [overlaps(boxes[k : k + 1], alone[k]).min() > 0.7 for k in (0, 1)] == [True, True]


@pytest.mark.slow
def test_each_sensor_subtracts_its_own_background():
    still = [(3.0, 8.0, 1.3, 0.5, 2.0, 0.4), (-5.0, 18.0, 2.0, 2.0, 2.0, 0.0)]
    detections, _ = fused([], [NEAR, FAR], still=still, noise_m=0.02)
    assert len(detections.scores) == 0


@pytest.mark.slow
def test_sensor_without_foreground_changes_nothing():
    boxes = [(6.0, 5.0, *CAR, 0.3)]
    far_off = replace(NEAR, x_m=3000.0)
    detections, (alone, nothing) = fused(boxes, [NEAR, far_off])
    assert len(nothing.scores) == 0
    np.testing.assert_allclose(detections.boxes, alone.boxes, atol=1e-9)
    np.testing.assert_allclose(detections.scores, alone.scores)


@pytest.mark.slow
def test_empty_sweeps_give_no_detections():
    detector, _ = simulate_sweep([], NEAR)
    joint = Cluster().at_sites([detector.joint.views[0]] * 2, ROI)
    empty = Sweep(np.empty((0, 4), np.float32), np.empty(0, np.uint32))
    assert joint.detect([empty, empty]).boxes.shape == Detections.empty().boxes.shape


def test_links_neighbours_of_different_sensors_only_within_reach():
    density = Density(least_points=2)
    points = np.array([[10.0, 0.05, 1.0], [10.5, 0.05, 1.0], [11.3, 0.05, 1.0], [40.0, 0.05, 1.0], [40.75, 0.05, 1.0]])
    sensors_m = np.array([[0.0, 0.0], [45.0, 0.0]])

    def sizes(sensor):
        return np.diff(find_clusters(points, density, np.array(sensor), sensors_m).starts).tolist()

    assert sizes([0, 1, 0, 0, 0]) == [2, 2]  # 0.5 m apart; and 0.75 m, near at a range of 40 m
    assert sizes([0, 1, 0, 1, 1]) == [2]  # but not at 5 m
    assert sizes([0, 1, 0, 0, 1]) == [2]  # nor between sensors


def test_visible_ends_face_another_sensor_and_have_points():
    """A box of 4 m x 2 m round (0, 10); one sensor at the origin sees its south, one at (10, 20) its north and east."""
    along = np.linspace(-2.0, 2.0, 9)
    south, north = (np.column_stack([along, np.full(9, y), np.ones(9)]) for y in (9.0, 11.0))
    east = np.column_stack([np.full(5, 2.0), np.linspace(9.0, 11.0, 5), np.ones(5)])
    points, sensor = np.concatenate([south, north, east]), np.repeat([0, 1, 1], [9, 9, 5])
    starts = np.array([0, len(points)])
    clusters = Clusters(points, starts, points[:, :2], starts, sensor)
    box = Rectangles(np.zeros(1), np.array([[[-2.0, 2.0], [9.0, 11.0]]]), np.ones(1))
    sensors_m = np.array([[0.0, 0.0], [10.0, 20.0]])
    assert visible_ends(clusters, box, sensors_m, 0).tolist() == [[[False, True], [False, True]]]
    assert visible_ends(clusters, box, sensors_m, 1).tolist() == [[[False, False], [True, False]]]
    # the second sensor has points on the east side only, and on one corner of the north side
    edge = replace(clusters, sensor=np.where(points[:, 0] >= 2.0, 1, 0))
    assert visible_ends(edge, box, sensors_m, 0).tolist() == [[[False, True], [False, False]]]


@pytest.mark.slow
@pytest.mark.parametrize(("x_m", "size_m"), [(0.0, (4.3, 1.79, 1.46)), (4.0, (10.5, 2.5, 3.7))])
def test_vehicle_visible_from_both_ends_has_measured_length(x_m, size_m):
    """A car on the line between two sensors, neither of which sees its length; a lorry next to it."""
    boxes = [(x_m, 15.0, *size_m, np.pi / 2)]
    detections, _ = fused(boxes, [Pose(0.2, 0.0, 2.0), Pose(-0.2, 30.0, 2.0)])
    assert overlaps(boxes, detections).min() > 0.7


LABELS = strategies.lists(strategies.integers(-1, 4), min_size=8, max_size=8)


@pytest.mark.slow
@hypothesis.given(strategies.lists(LABELS, min_size=1, max_size=3))
def test_merged_labels_are_connected_components(labels):
    merged = _merge_labels([_compact(label) for label in labels])
    linked = np.zeros((8, 8), dtype=bool)
    for label in labels:
        linked |= (np.equal.outer(label, label)) & (np.array(label) >= 0)
    for _ in range(8):  # whatever is reached in so many steps
        linked = (linked.astype(int) @ linked.astype(int)) > 0
    for i in range(8):
        assert (merged[i] >= 0) == linked[i, i]
        for j in range(8):
            assert (merged[i] == merged[j] and merged[i] >= 0) == bool(linked[i, j])


def _compact(label):
    """As DBSCAN numbers clusters: 0, 1, ..."""
    known = sorted({number for number in label if number >= 0})
    return np.array([known.index(number) if number >= 0 else -1 for number in label])
