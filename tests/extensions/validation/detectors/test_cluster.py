"""The detector cluster on scenes small enough to know the answer."""

from dataclasses import replace

import numpy as np
import pytest

from egvs.clouds.sweeps import SiteView, Sweep
from egvs.core.grid import Roi
from egvs.extensions.validation.detection_metrics import paired_overlap
from egvs.extensions.validation.detectors.cluster import (
    Cluster,
    RangeImage,
    box_scores,
    elevation_cell_deg,
    load_kinds,
)
from egvs.extensions.validation.detectors.clustering import SQUARE_M, Density, find_clusters
from egvs.sensors.sensor import CATALOGUE
from egvs.sensors.sites import Pose

ROI = Roi((-60.0, -60.0, -10.0), (120.0, 120.0, 25.0))
SENSOR = CATALOGUE["VLP-32C"]
POSE = Pose(0.0, 0.0, 4.0)
CAR = (4.3, 1.79, 1.46)


def _first_hit_range(boxes, start, ways, slope):
    """Range of the first surface along each beam: the plane z = slope * x, or an upright box standing on it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = (slope * start[0] - start[2]) / (ways[:, 2] - slope * ways[:, 0])
        ranges = np.where((ground > 0) & (ground < SENSOR.range_m), ground, np.inf)
        for x, y, length, width, height, yaw in boxes:
            c, s = np.cos(yaw), np.sin(yaw)
            turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
            o, d = turn @ (start - (x, y, slope * x + height / 2)), ways @ turn.T
            half = np.array([length, width, height]) / 2
            ends = np.sort(np.stack([(-half - o) / d, (half - o) / d]), axis=0)
            enter, leave = ends[0].max(axis=1), ends[1].min(axis=1)
            ranges = np.where((enter < leave) & (enter > 0) & (enter < ranges), enter, ranges)
    return ranges


def simulate_sweep(boxes, pose=POSE, slope=0.0, still=(), noise_m=0.0):
    """A detector at a site, and a sweep of boxes (x, y, length, width, height, yaw) there."""
    start, ways = np.asarray(pose.position_m), SENSOR.directions(*pose.angles_deg)
    view = SiteView("s", pose, SENSOR, _first_hit_range(still, start, ways, slope))
    ranges = _first_hit_range([*still, *boxes], start, ways, slope)
    beam = np.flatnonzero(np.isfinite(ranges)).astype(np.uint32)
    measured = ranges[beam] + noise_m * np.random.default_rng(1).standard_normal(len(beam))
    points = np.column_stack([SENSOR.directions()[beam] * measured[:, None], np.ones(len(beam))])
    return Cluster().at_site(view, ROI), Sweep(points.astype(np.float32), beam)


def overlaps(boxes, detections, slope=0.0):
    """The best overlap of each box with the detections, from above and in space, (2, n)."""
    expected = np.array([(x, y, slope * x + h / 2, le, w, h, yaw) for x, y, le, w, h, yaw in boxes])
    each = [
        paired_overlap(np.repeat(box[None], len(detections.boxes), 0), detections.boxes).max(axis=1) for box in expected
    ]
    return np.array(each).T


@pytest.mark.slow
@pytest.mark.parametrize("yaw", [0.0, 0.4, 1.2, 2.5])
@pytest.mark.parametrize("position", [(15.0, 6.0), (-9.0, 20.0), (-12.0, -14.0)])
@pytest.mark.parametrize("noise_m", [0.0, 0.03])
def test_detects_car_in_the_open(position, yaw, noise_m):
    boxes = [(*position, *CAR, yaw)]
    detector, sweep = simulate_sweep(boxes, noise_m=noise_m)
    assert overlaps(boxes, detector.detect(sweep)).min() > 0.7


@pytest.mark.slow
@pytest.mark.parametrize(
    "pose",
    [
        Pose(0.0, 0.0, 4.0, yaw_deg=70.0),
        Pose(0.0, 0.0, 4.0, yaw_deg=20.0, pitch_deg=-15.0),
        Pose(0.0, 0.0, 4.0, roll_deg=-10.0),
    ],
)
def test_tilted_sensor_detects_same_car(pose):
    boxes = [(12.0, 5.0, *CAR, 0.4)]
    detector, sweep = simulate_sweep(boxes, pose)
    assert overlaps(boxes, detector.detect(sweep)).min() > 0.7


@pytest.mark.slow
@pytest.mark.parametrize(("slope", "yaw"), [(0.05, 0.9), (-0.08, 0.3)])
def test_heights_are_measured_from_sloped_ground(slope, yaw):
    boxes = [(20.0, 6.0, *CAR, yaw)]
    detector, sweep = simulate_sweep(boxes, slope=slope)
    assert overlaps(boxes, detector.detect(sweep), slope).min() > 0.65


def test_separates_two_cars_a_metre_apart():
    boxes = [(12.0, 8.0, *CAR, 0.0), (12.0 + 4.3 + 1.0, 8.0, *CAR, 0.0)]
    detector, sweep = simulate_sweep(boxes)
    detections = detector.detect(sweep)
    assert len(detections.boxes) == 2
    assert overlaps(boxes, detections).min() > 0.7


@pytest.mark.slow
def test_completes_car_hidden_by_pole():
    """A column hides the front half of a car that is visible from its side; its rear end is fixed."""
    car = (0.0, 15.0, *CAR, 0.0)
    column = (0.8, 7.0, 1.3, 0.5, 4.0, 0.0)
    unhidden, _ = simulate_sweep([car])
    detector, sweep = simulate_sweep([car], still=[column])
    detections = detector.detect(sweep)
    assert len(detections.boxes) == 1
    assert overlaps([car], detections)[0].min() > 0.7
    # without the column in its empty scan, it detects a shorter vehicle
    blind = replace(detector, joint=replace(detector.joint, static_images=unhidden.joint.static_images))
    assert overlaps([car], blind.detect(sweep))[0].min() < 0.7 if len(blind.detect(sweep).boxes) else True


@pytest.mark.slow
def test_drops_pedestrian():
    detector, sweep = simulate_sweep([(8.0, 5.0, 0.6, 0.5, 1.75, 0.2)])
    assert len(detector.detect(sweep).boxes) == 0


@pytest.mark.slow
def test_lorry_has_measured_length():
    boxes = [(10.0, 12.0, 10.5, 2.5, 3.7, 0.1)]
    detector, sweep = simulate_sweep(boxes)
    detections = detector.detect(sweep)
    assert overlaps(boxes, detections).min() > 0.7
    assert detections.boxes[0, 3] > 8


def test_empty_sweep_and_single_point_give_no_detections():
    detector, sweep = simulate_sweep([(12.0, 5.0, *CAR, 0.4)])
    assert detector.detect(Sweep(np.empty((0, 4), np.float32), np.empty(0, np.uint32))).boxes.shape == (0, 7)
    new = np.flatnonzero(
        np.linalg.norm(sweep.points[:, :3], axis=1) < detector.joint.views[0].empty_range_m[sweep.beam] - 1
    )[:1]
    assert len(new) == 1
    assert detector.detect(Sweep(sweep.points[new], sweep.beam[new])).scores.shape == (0,)


@pytest.mark.slow
def test_empty_scene_gives_no_detections():
    detector, sweep = simulate_sweep([], still=[(0.8, 7.0, 1.3, 0.5, 4.0, 0.0)], noise_m=0.02)
    assert len(detector.detect(sweep).boxes) == 0


@pytest.mark.slow
def test_order_of_points_has_no_effect():
    boxes = [(12.0, 8.0, *CAR, 0.0), (17.3, 8.0, *CAR, 0.0), (-20.0, 3.0, *CAR, 1.0)]
    detector, sweep = simulate_sweep(boxes, noise_m=0.03)
    detections = detector.detect(sweep)
    order = np.random.default_rng(2).permutation(len(sweep.beam))
    again = detector.detect(Sweep(sweep.points[order], sweep.beam[order]))
    assert detections.boxes.tobytes() == again.boxes.tobytes()
    assert detections.scores.tobytes() == again.scores.tobytes()


@pytest.mark.slow
def test_clusters_equal_single_linkage():
    """A slow reference: squares within reach of each other, directly or through others, are one cluster."""
    random = np.random.default_rng(4)
    density = Density(reach_m=0.6, reach_per_range=0.03, core_squares=1, least_points=1)
    points = np.column_stack([random.uniform(-12, 12, (300, 2)), random.uniform(0, 2, 300)])  # nearer than 20 m
    clusters = find_clusters(points, density)
    squares = {tuple(np.floor(p[:2] / SQUARE_M).astype(int)): [] for p in points}
    for p in points:
        squares[tuple(np.floor(p[:2] / SQUARE_M).astype(int))].append(p)
    means = np.array([np.mean(square_points, axis=0)[:2] for square_points in squares.values()])
    label = np.arange(len(means))
    for _ in means:
        near = np.hypot(*(means[:, None] - means[None]).transpose(2, 0, 1)) <= density.reach_m
        label = np.where(near, label[None], len(means)).min(axis=1)
    assert len(clusters) == len(np.unique(label))
    sizes = sorted(
        sum(len(square_points) for square_points, k in zip(squares.values(), label, strict=True) if k == n)
        for n in set(label)
    )
    assert sorted(np.diff(clusters.starts).tolist()) == sizes


def test_table_of_kinds_is_plausible():
    table = load_kinds()
    assert (table.size_m[:, 0] >= table.size_m[:, 1]).all() and (table.size_m > 0.3).all()
    assert len(set(table.names)) == len(table.names)
    assert (table.share > 0).all() and not table.is_vehicle.all()


def test_settings_contain_parameters_and_table():
    settings = Cluster().settings
    assert set(settings) == {"density", "tolerances", "kinds"} and len(settings["kinds"]) == 64


def test_score_depends_on_points_and_fit():
    """By hand: 1 - e^-1 with 100 points; 1/e of it with a cost of 10."""
    full = 1.0 - np.exp(-1.0)
    scores = box_scores(np.array([100, 100, 100, 0]), np.array([0.0, 10.0, -3.0, 0.0]))
    np.testing.assert_allclose(scores, [full, full / np.e, full, 0.0], rtol=1e-12)


@pytest.mark.parametrize("name", ["VLP-16", "VLP-32C", "OS1-64", "OS1-128"])
def test_cells_of_sensors_with_wide_channels_are_one_degree_high(name):
    """The sensors of the validity study: their results do not depend on the rule for dense channels."""
    assert elevation_cell_deg(CATALOGUE[name]) == 1.0


def test_cells_are_four_median_spacings_of_dense_channels():
    dense = replace(SENSOR, elevations_deg=(-25.0, -8.0, -0.3, -0.2, -0.1, 0.0), azimuth_offsets_deg=(0.0,) * 6)
    assert elevation_cell_deg(dense) == pytest.approx(0.4)
    one = replace(SENSOR, elevations_deg=(0.0,), azimuth_offsets_deg=(0.0,))
    assert elevation_cell_deg(one) == 1.0


def test_low_barrier_does_not_share_low_cells_with_points_far_behind_and_above_it():
    """At 20 m, 0.3 m below the sensor (-0.86 degrees); at 60 m, 0.2 m below it (-0.19 degrees)."""
    barrier, vehicle = np.array([[20.0, 0.0, -0.3]]), np.array([[60.0, 0.0, -0.2]])
    for cell_deg, cells in ((1.0, 1), (0.4, 2)):
        image = RangeImage.from_points(np.concatenate([barrier, vehicle]), cell_deg)
        assert np.isfinite(image.range_m).sum() == cells
