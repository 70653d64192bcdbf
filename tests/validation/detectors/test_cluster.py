"""The detector cluster on scenes small enough to know the answer."""

from dataclasses import replace

import numpy as np
import pytest

from egvs.core.grid import Roi
from egvs.sensors.sensor import CATALOGUE
from egvs.sensors.sites import Pose
from egvs.validation.detection_metrics import paired_overlap
from egvs.validation.detectors.cluster import Cluster, box_scores, load_kinds
from egvs.validation.detectors.clustering import SQUARE_M, Density, find_clusters
from egvs.validation.sweeps import SiteView, Sweep

ROI = Roi((-60.0, -60.0, -10.0), (120.0, 120.0, 25.0))
SENSOR = CATALOGUE["VLP-32C"]
POSE = Pose(0.0, 0.0, 4.0)
CAR = (4.3, 1.79, 1.46)


def _met(boxes, start, ways, slope):
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


def look(boxes, pose=POSE, slope=0.0, still=(), noise_m=0.0):
    """A detector at a site, and a sweep of boxes (x, y, length, width, height, yaw) there."""
    start, ways = np.asarray(pose.position_m), SENSOR.directions(*pose.angles_deg)
    view = SiteView("s", pose, SENSOR, _met(still, start, ways, slope))
    ranges = _met([*still, *boxes], start, ways, slope)
    beam = np.flatnonzero(np.isfinite(ranges)).astype(np.uint32)
    measured = ranges[beam] + noise_m * np.random.default_rng(1).standard_normal(len(beam))
    points = np.column_stack([SENSOR.directions()[beam] * measured[:, None], np.ones(len(beam))])
    return Cluster().at_site(view, ROI), Sweep(points.astype(np.float32), beam)


def overlaps(boxes, found, slope=0.0):
    """The best overlap of each box with the detections, from above and in space, (2, n)."""
    wanted = np.array([(x, y, slope * x + h / 2, le, w, h, yaw) for x, y, le, w, h, yaw in boxes])
    each = [paired_overlap(np.repeat(box[None], len(found.boxes), 0), found.boxes).max(axis=1) for box in wanted]
    return np.array(each).T


@pytest.mark.slow
@pytest.mark.parametrize("yaw", [0.0, 0.4, 1.2, 2.5])
@pytest.mark.parametrize("place", [(15.0, 6.0), (-9.0, 20.0), (-12.0, -14.0)])
@pytest.mark.parametrize("noise_m", [0.0, 0.03])
def test_a_car_in_the_open_is_found(place, yaw, noise_m):
    boxes = [(*place, *CAR, yaw)]
    detector, sweep = look(boxes, noise_m=noise_m)
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
def test_a_tilted_sensor_sees_the_same_car(pose):
    boxes = [(12.0, 5.0, *CAR, 0.4)]
    detector, sweep = look(boxes, pose)
    assert overlaps(boxes, detector.detect(sweep)).min() > 0.7


@pytest.mark.parametrize(("slope", "yaw"), [(0.05, 0.9), (-0.08, 0.3)])
def test_on_a_slope_heights_count_from_the_ground(slope, yaw):
    boxes = [(20.0, 6.0, *CAR, yaw)]
    detector, sweep = look(boxes, slope=slope)
    assert overlaps(boxes, detector.detect(sweep), slope).min() > 0.65


def test_two_cars_a_metre_apart_stay_two():
    boxes = [(12.0, 8.0, *CAR, 0.0), (12.0 + 4.3 + 1.0, 8.0, *CAR, 0.0)]
    detector, sweep = look(boxes)
    found = detector.detect(sweep)
    assert len(found.boxes) == 2
    assert overlaps(boxes, found).min() > 0.7


def test_what_a_pole_hides_of_a_car_is_completed():
    """A column hides the front half of a car that is seen from its side; the rear end stays where it was seen."""
    car = (0.0, 15.0, *CAR, 0.0)
    column = (0.8, 7.0, 1.3, 0.5, 4.0, 0.0)
    whole, _ = look([car])
    detector, sweep = look([car], still=[column])
    found = detector.detect(sweep)
    assert len(found.boxes) == 1
    assert overlaps([car], found)[0].min() > 0.7
    # did it not know of the column, it would take it for something short
    blind = replace(detector, joint=replace(detector.joint, static_images=whole.joint.static_images))
    assert overlaps([car], blind.detect(sweep))[0].min() < 0.7 if len(blind.detect(sweep).boxes) else True


def test_a_pedestrian_is_no_vehicle():
    detector, sweep = look([(8.0, 5.0, 0.6, 0.5, 1.75, 0.2)])
    assert len(detector.detect(sweep).boxes) == 0


def test_a_lorry_is_as_long_as_it_looks():
    boxes = [(10.0, 12.0, 10.5, 2.5, 3.7, 0.1)]
    detector, sweep = look(boxes)
    found = detector.detect(sweep)
    assert overlaps(boxes, found).min() > 0.7
    assert found.boxes[0, 3] > 8


def test_an_empty_sweep_and_one_point_are_nothing():
    detector, sweep = look([(12.0, 5.0, *CAR, 0.4)])
    assert detector.detect(Sweep(np.empty((0, 4), np.float32), np.empty(0, np.uint32))).boxes.shape == (0, 7)
    new = np.flatnonzero(
        np.linalg.norm(sweep.points[:, :3], axis=1) < detector.joint.views[0].empty_range_m[sweep.beam] - 1
    )[:1]
    assert len(new) == 1
    assert detector.detect(Sweep(sweep.points[new], sweep.beam[new])).scores.shape == (0,)


@pytest.mark.slow
def test_the_empty_scene_holds_nothing():
    detector, sweep = look([], still=[(0.8, 7.0, 1.3, 0.5, 4.0, 0.0)], noise_m=0.02)
    assert len(detector.detect(sweep).boxes) == 0


def test_the_order_of_points_has_no_say():
    boxes = [(12.0, 8.0, *CAR, 0.0), (17.3, 8.0, *CAR, 0.0), (-20.0, 3.0, *CAR, 1.0)]
    detector, sweep = look(boxes, noise_m=0.03)
    found = detector.detect(sweep)
    order = np.random.default_rng(2).permutation(len(sweep.beam))
    again = detector.detect(Sweep(sweep.points[order], sweep.beam[order]))
    assert found.boxes.tobytes() == again.boxes.tobytes()
    assert found.scores.tobytes() == again.scores.tobytes()


@pytest.mark.slow
def test_clusters_are_those_of_single_linkage():
    """A slow twin: squares within reach of each other, directly or over others, are one cluster."""
    random = np.random.default_rng(4)
    density = Density(reach_m=0.6, reach_per_range=0.03, core_squares=1, least_points=1)
    points = np.column_stack([random.uniform(-12, 12, (300, 2)), random.uniform(0, 2, 300)])  # nearer than 20 m
    clusters = find_clusters(points, density)
    squares = {tuple(np.floor(p[:2] / SQUARE_M).astype(int)): [] for p in points}
    for p in points:
        squares[tuple(np.floor(p[:2] / SQUARE_M).astype(int))].append(p)
    means = np.array([np.mean(its, axis=0)[:2] for its in squares.values()])
    label = np.arange(len(means))
    for _ in means:
        near = np.hypot(*(means[:, None] - means[None]).transpose(2, 0, 1)) <= density.reach_m
        label = np.where(near, label[None], len(means)).min(axis=1)
    assert len(clusters) == len(np.unique(label))
    sizes = sorted(sum(len(its) for its, k in zip(squares.values(), label, strict=True) if k == n) for n in set(label))
    assert sorted(np.diff(clusters.starts).tolist()) == sizes


def test_the_table_of_kinds_is_sound():
    table = load_kinds()
    assert (table.size_m[:, 0] >= table.size_m[:, 1]).all() and (table.size_m > 0.3).all()
    assert len(set(table.names)) == len(table.names)
    assert (table.share > 0).all() and not table.is_vehicle.all()


def test_its_settings_say_all_that_its_boxes_depend_on():
    settings = Cluster().settings
    assert set(settings) == {"density", "tolerances", "kinds"} and len(settings["kinds"]) == 64


def test_a_score_is_of_points_and_fit():
    """By hand: 1 - e^-1 with 100 points; 1/e of it with a cost of 10."""
    full = 1.0 - np.exp(-1.0)
    found = box_scores(np.array([100, 100, 100, 0]), np.array([0.0, 10.0, -3.0, 0.0]))
    np.testing.assert_allclose(found, [full, full / np.e, full, 0.0], rtol=1e-12)
