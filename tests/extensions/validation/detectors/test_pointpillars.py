"""PointPillars: pillars, windows, encoding of boxes, model files, the shipped model."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

import egvs
from egvs import load
from egvs.clouds.simulation import CloudSimulator, sweep_rng
from egvs.core.errors import InputError
from egvs.core.grid import Roi
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME as POINTS_ON
from egvs.extensions.validation.detector_results import DetectedBoxes, PointCounts
from egvs.extensions.validation.detector_runs import SiteDetectionTask
from egvs.extensions.validation.detectors import pointpillars
from egvs.extensions.validation.detectors.pointpillars import POINTS_PER_PILLAR, PillarPoints, PillarWindow
from egvs.extensions.validation.held_out_traffic import prepare_held_out_traffic
from egvs.sensors.sites import Pose
from tests.clouds.cloud_scenes import random_frame


def _pillar_points(rows):
    """Points of (x, y, height, intensity, new, range)."""
    values = np.array(rows, dtype=np.float64)
    return PillarPoints(
        values[:, :2], values[:, 2], values[:, 3].astype(np.float32), values[:, 4].astype(bool), values[:, 5]
    )


def test_pillars_of_four_points_by_hand():
    window = PillarWindow((0.0, 0.0), cells=4)  # 1.6 m wide, its first corner at (-0.8, -0.8)
    rows = [(-0.7, -0.7, 1.0, 0.5, 1, 25.0), (-0.5, -0.6, 3.0, 0.1, 0, 50.0), (0.1, 0.3, 0.0, 0.2, 0, 10.0)]
    rows += [(0.9, 0.0, 1.0, 0.5, 1, 25.0), (0.0, 0.0, 4.6, 0.5, 1, 25.0)]  # out of the window; too high
    pillars = pointpillars.make_pillars(_pillar_points(rows), window, "ground")
    np.testing.assert_array_equal(pillars.cell, [0, 2 * 4 + 2])
    np.testing.assert_array_equal(pillars.present.sum(axis=1), [2, 1])
    # the first pillar's middle is (0.2, 0.2) from the corner, its points are at (0.1, 0.1) and (0.3, 0.2)
    first = [-0.1, -0.1, 1.0, 0.5, -0.1, -0.05, -1.0, 1.0, 0.5]
    second = [0.1, 0.0, 3.0, 0.1, 0.1, 0.05, 1.0, 0.0, 1.0]
    np.testing.assert_allclose(pillars.features[0, :2], [first, second], atol=1e-6)
    np.testing.assert_allclose(pillars.features[1, 0], [-0.1, 0.1, 0.0, 0.2, 0.0, 0.0, 0.0, 0.0, 0.2], atol=1e-6)
    assert not pillars.features[0, 2:].any()


def test_full_pillar_selects_points_at_equal_steps():
    rows = [(0.1, 0.1, i / 100, 0.5, 1, 5.0) for i in range(2 * POINTS_PER_PILLAR + 3)]
    pillars = pointpillars.make_pillars(_pillar_points(rows), PillarWindow((0.0, 0.0)), "ground")
    assert pillars.present.sum() == POINTS_PER_PILLAR
    steps = np.diff(np.round(100 * pillars.features[0, :, 2]).astype(int))
    assert set(steps.tolist()) <= {2, 3}  # 35 points to 16 places


def test_pillars_are_sorted_and_within_height_limits():
    random = np.random.default_rng(3)
    rows = np.column_stack([random.uniform(-9, 9, (300, 2)), random.uniform(-4, 5, 300), random.random((300, 3))])
    points = _pillar_points(rows)
    pillars = pointpillars.make_pillars(points, PillarWindow((0.0, 0.0)), "sensor")
    heights = pillars.features[..., 2][pillars.present > 0]
    assert heights.min() >= -3.0 and heights.max() <= 1.0 and len(heights) > 100
    assert (np.diff(pillars.cell) > 0).all()
    assert pillars.present.sum() == ((rows[:, 2] >= -3) & (rows[:, 2] <= 1)).sum()


@pytest.mark.parametrize("turn", [0.0, 0.7, -2.5])
def test_window_converts_to_world_and_back(turn):
    window, at = PillarWindow((10.0, -4.0), turn), np.random.default_rng(0).uniform(-50, 50, (20, 2))
    np.testing.assert_allclose(window.to_world(window.to_window(at)), at, atol=1e-12)
    ahead = window.to_world(np.array([[window.size_m / 2 + 1.0, window.size_m / 2]]))
    np.testing.assert_allclose(ahead, [[10.0 + math.cos(turn), -4.0 + math.sin(turn)]], atol=1e-12)


def test_decodes_encoded_boxes():
    random = np.random.default_rng(1)
    places = np.array([[10.0, 20.0], [30.3, 20.9], [60.1, 61.0]])
    sizes = np.array([[4.5, 1.8, 1.5], [10.9, 2.5, 3.1], [3.4, 1.5, 1.7]])
    yaw = random.uniform(-math.pi, math.pi, 3)
    boxes = np.column_stack([places, [0.75, 1.55, 0.85], sizes, yaw])
    cell, values = pointpillars.encode_boxes(boxes)
    heat, maps = np.zeros((128, 128), np.float32), np.zeros((pointpillars.N_VALUES, 128, 128), np.float32)
    heat[tuple(cell.T)] = [0.9, 0.6, 0.7]
    maps[:, cell[:, 0], cell[:, 1]] = values.T
    decoded, scores = pointpillars.decode_boxes(heat, maps)
    np.testing.assert_allclose(scores, [0.9, 0.7, 0.6], atol=1e-6)
    np.testing.assert_allclose(decoded[:, :6], boxes[[0, 2, 1], :6], atol=1e-5)
    np.testing.assert_allclose(np.sin(decoded[:, 6] - boxes[[0, 2, 1], 6]), 0.0, atol=1e-5)  # up to half a turn


def test_neighbours_of_peaks_and_low_scores_are_no_detections():
    heat, maps = np.zeros((8, 8), np.float32), np.zeros((pointpillars.N_VALUES, 8, 8), np.float32)
    heat[3, 3], heat[3, 4], heat[6, 6] = 0.8, 0.7, 0.04
    _, scores = pointpillars.decode_boxes(heat, maps)
    np.testing.assert_allclose(scores, [0.8], atol=1e-6)


@pytest.mark.parametrize("size_m", [(100.0, 50.0), (102.4, 102.4), (150.0, 60.0), (400.0, 300.0)])
def test_windows_cover_region_and_overlap(size_m):
    roi = Roi((5.0, -7.0, 0.0), (*size_m, 5.0))
    windows = pointpillars.roi_windows(roi)
    at = np.asarray(roi.origin_m[:2]) + np.random.default_rng(0).uniform(0, 1, (500, 2)) * size_m
    inside = [((w.to_window(at) >= 0) & (w.to_window(at) < w.size_m)).all(axis=1) for w in windows]
    assert np.any(inside, axis=0).all()
    assert (len(windows) == 1) == (max(size_m) <= 102.4)
    for axis in (0, 1):
        places = sorted({w.centre_m[axis] for w in windows})
        assert all(b - a <= 102.4 - 20.0 + 1e-9 for a, b in itertools.pairwise(places))


def test_rejects_file_that_is_not_a_model(tmp_path):
    path = tmp_path / "m.onnx"
    path.write_bytes(b"no model")
    with pytest.raises(InputError, match=r"m\.onnx: not an ONNX model .*\. Use a model written by egvs train"):
        pointpillars.OnnxModel.load(path)
    with pytest.raises(InputError, match="No such file"):
        pointpillars.OnnxModel.load(tmp_path / "absent.onnx")


def test_shipped_model_has_metadata():
    metadata = pointpillars.OnnxModel.load(pointpillars.SHIPPED_MODEL).metadata
    assert metadata["convention"] == "ground" and metadata["parameters"] == 985785
    assert "nishishinjuku" not in metadata["junctions"] and len(metadata["junctions"]) >= 4
    assert metadata["curve"][-1]["step"] == metadata["recipe"]["steps"]
    assert metadata["curve"][-1]["ap_bev_r40_iou50"] > 0.5  # of held-out frames and poses


@pytest.mark.slow
def test_detections_do_not_depend_on_intensity(mini):
    """Geometry alone decides; with each point's own intensity, the same network depends on it."""
    scene = egvs.build_scene(load(mini, ["sites.sensor=VLP-32C"]))
    simulator = CloudSimulator(scene, Pose(10.0, 12.0, 5.0), scene.sensor("VLP-32C"), "here")
    frame = random_frame(np.random.default_rng(2), (20.0, 5.0, 0.0))
    sweep = simulator.sweep(frame, sweep_rng(1, "here", 0)).sweep

    def detect(detector, intensity):
        points = sweep.points.copy()
        points[:, 3] = intensity
        return detector.at_site(simulator.view, scene.roi).detect(replace(sweep, points=points))

    shipped, fed = pointpillars.PointPillars(), pointpillars.PointPillars(intensity=None)
    expected = detect(shipped, sweep.points[:, 3])
    assert len(expected.boxes)
    for intensity in (0.0, 0.5, 1.0, np.nan, sweep.points[::-1, 3]):
        found = detect(shipped, intensity)
        np.testing.assert_array_equal(found.boxes, expected.boxes)
        np.testing.assert_array_equal(found.scores, expected.scores)
    assert not np.array_equal(detect(fed, 0.0).scores, detect(fed, 1.0).scores)
    np.testing.assert_array_equal(detect(fed, pointpillars.INTENSITY).scores, expected.scores)
    assert shipped.settings != fed.settings


@pytest.mark.slow
def test_shipped_model_detects_cars(mini, tmp_path):
    """From both sites, with a sensor of the catalogue: every car with 100 points to a metre, nearly all to half."""
    record = prepare_held_out_traffic(load(mini, ["sites.sensor=VLP-32C"]), tmp_path / "r", 10)
    task, distances_m = SiteDetectionTask(record, {"pointpillars": pointpillars.PointPillars()}), []
    for site in record.scene.sites:
        results = task.at(site, [POINTS_ON, "pointpillars"])
        boxes, points = results["pointpillars"], results[POINTS_ON]
        assert isinstance(boxes, DetectedBoxes) and isinstance(points, PointCounts)
        for frame, detections, on in zip(record.read(), boxes.frames, points.points, strict=True):
            certain = detections.boxes[detections.scores > 0.3]
            for box in frame.boxes[frame.target_rows(record.scene.roi)][on >= 100]:
                distances_m.append(np.hypot(*(certain[:, :2] - box[:2]).T).min(initial=9.0))
                assert distances_m[-1] < 1.0, (site.name, frame.number)
    assert len(distances_m) > 20
    assert np.quantile(distances_m, 0.9) < 0.5
