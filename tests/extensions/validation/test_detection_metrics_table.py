"""Rows of ``detection.parquet`` against numbers calculated by hand."""

import math

import numpy as np
import pytest

from egvs.artefacts import parquet
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds.sweeps import Detections
from egvs.core.grid import Roi
from egvs.extensions.validation import detection_metrics
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME, DetectedBoxes, PointCounts

ROI = Roi((0.0, 0.0, 0.0), (50.0, 50.0, 5.0))
CAR, BUS = (10.0, 10.0, 0.8, 4.5, 1.8, 1.6, 0.0), (30.0, 20.0, 1.5, 12.0, 2.5, 3.0, 1.0)


def _frame(number, *vehicles):
    boxes = np.array([box for _, box in vehicles], dtype=np.float64).reshape(-1, 7)
    names = tuple(f"v{i}" for i in range(len(vehicles)))
    return TrafficFrame(number, names, tuple(kind for kind, _ in vehicles), boxes, np.zeros(len(vehicles)))


FRAMES = [_frame(n) for n in range(10)]
FRAMES[0] = _frame(0, ("passenger", CAR), ("bus", BUS))  # with 25 and 3 points
FRAMES[5] = _frame(5, ("passenger", CAR), ("pedestrian", (1.0, 1.0, 0.9, 0.6, 0.6, 1.8, 0.0)))  # 0 points


def _points(*of_first):
    return PointCounts(
        tuple(np.array(entry, dtype=np.int64) for entry in [of_first, [], [], [], [], [0], [], [], [], []])
    )


def _boxes(first):
    boxes, scores = zip(*first, strict=True)
    results = Detections(np.array(boxes), np.array(scores))
    return DetectedBoxes((results, *[Detections.empty()] * 9))


def _row(rows, detector, objects_of="vehicles"):
    (row,) = (row for row in rows if (row.detector, row.objects_of) == (detector, objects_of))
    return row


def test_points_on_three_vehicles():
    rows, warnings = detection_metrics.measure_detection(FRAMES, ROI, {"a": {POINT_COUNTS_NAME: _points(25, 3)}})
    row = _row(rows, POINT_COUNTS_NAME)
    assert (row.site, row.frames, row.objects, dict(row.objects_with)) == ("a", 10, 3, {1: 2, 5: 1, 20: 1})
    value = {name: entry.value for name, entry in row.measures.items()}
    assert value["seen_1"] == pytest.approx(2 / 3) and value["seen_5"] == value["seen_20"] == pytest.approx(1 / 3)
    assert value["seen_50"] == 0.0 and value["log_points"] == pytest.approx((math.log(26) + math.log(4)) / 3)
    # without the first frame none of one vehicle is visible, without the sixth two of two
    left_out = np.array([0.0, *[2 / 3] * 4, 1.0, *[2 / 3] * 4])
    np.testing.assert_allclose(row.measures["seen_1"].left_out, left_out)
    se = math.sqrt(0.9 * ((left_out - left_out.mean()) ** 2).sum())
    assert row.measures["seen_1"].se == pytest.approx(se)
    assert all(math.isnan(value[name]) for name in detection_metrics.AP_MEASURES) and warnings == []


def test_subsets_of_cars_and_visible_vehicles():
    rows, _ = detection_metrics.measure_detection(FRAMES, ROI, {"a": {POINT_COUNTS_NAME: _points(25, 3)}})
    assert {row.objects_of: row.objects for row in rows} == {
        "vehicles": 3, "cars": 2, "points_1": 2, "points_5": 1, "points_20": 1,
    }  # fmt: skip
    assert _row(rows, POINT_COUNTS_NAME, "cars").measures["seen_1"].value == 0.5
    assert _row(rows, POINT_COUNTS_NAME, "points_5").measures["seen_20"].value == 1.0


def test_boxes_on_two_of_three_vehicles():
    results = {POINT_COUNTS_NAME: _points(25, 3), "d": _boxes([(CAR, 0.9), (BUS, 0.8), ((40.0, 40.0, *CAR[2:]), 0.5)])}
    rows, _ = detection_metrics.measure_detection(FRAMES, ROI, {"a": results})
    value = {name: entry.value for name, entry in _row(rows, "d").measures.items()}
    assert value["recall_bev_iou70"] == value["recall_3d_iou50"] == pytest.approx(2 / 3)
    assert 26 / 40 <= value["ap_bev_r40_iou70"] <= 27 / 40  # precision 1 up to a recall of 2/3
    assert value["ap_mean_r40_iou70"] == pytest.approx((value["ap_bev_r40_iou70"] + value["ap_3d_r40_iou70"]) / 2)
    assert value["seen_1"] == pytest.approx(2 / 3)  # of the vehicles, whatever the detector
    assert _row(rows, "d", "points_20").measures["recall_bev_iou70"].value == 1.0


def test_warns_about_site_without_visible_vehicle():
    boxes = DetectedBoxes(tuple([Detections.empty()] * 10))
    rows, warnings = detection_metrics.measure_detection(
        FRAMES, ROI, {"a": {POINT_COUNTS_NAME: _points(0, 0), "d": boxes}}
    )
    assert (
        _row(rows, POINT_COUNTS_NAME).measures["seen_1"].value
        == _row(rows, POINT_COUNTS_NAME).measures["log_points"].value
        == 0.0
    )
    assert _row(rows, "d").measures["ap_bev_r40_iou70"].value == 0.0  # they are there, and missed
    assert _row(rows, "d", "points_1").objects == 0
    assert math.isnan(_row(rows, "d", "points_1").measures["ap_bev_r40_iou70"].value)
    assert math.isnan(_row(rows, POINT_COUNTS_NAME, "points_1").measures["log_points"].value)
    first = "no vehicles with 1 points or more in 10 frames, so average precision is undefined. Use more frames."
    assert str(warnings[0]) == f"detector d, site a: {first}"
    more = {name: {POINT_COUNTS_NAME: _points(0, 0), "d": boxes} for name in "abc"}
    texts = list(map(str, detection_metrics.measure_detection(FRAMES, ROI, more)[1]))
    assert texts[0] == f"detector d, sites a, b, c: {first}" and len(texts) == len(warnings)


def test_writes_rows(tmp_path):
    rows, _ = detection_metrics.measure_detection(
        FRAMES, ROI, {"a": {POINT_COUNTS_NAME: _points(25, 3)}, "b": {POINT_COUNTS_NAME: _points(0, 0)}}
    )
    metadata = {"schema": parquet.SCHEMA_VERSION, "inputs": "x", "frames": 10, "stages": {}}
    detection_metrics.write_detection(tmp_path / "detection.parquet", rows, metadata)
    table, read = parquet.read_artefact(tmp_path / "detection.parquet", "detection")
    assert read == metadata and table.column("site").to_pylist() == ["a"] * 5 + ["b"] * 5
    first = table.to_pylist()[0]
    assert first["seen_1"] == rows[0].measures["seen_1"].value and first["seen_1_se"] == rows[0].measures["seen_1"].se
