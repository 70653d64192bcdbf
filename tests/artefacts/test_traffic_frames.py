"""Frames of recorded traffic: read back, what is to be seen, and how they are spread over a record."""

import numpy as np

from egvs.artefacts import parquet, traffic_frames
from egvs.core.grid import Roi

ROI = Roi((0.0, 0.0, 0.0), (10.0, 10.0, 5.0))


def _record(path, rows):
    """Rows of (frame, vehicle, kind, x)."""
    names = ("frame", "vehicle", "part", "kind", "x_m", "y_m", "z_m", "yaw_rad", "pitch_rad")
    columns = {name: [] for name in (*names, "length_m", "width_m", "height_m")}
    for frame, vehicle, kind, x in rows:
        row = (frame, vehicle, 0, kind, x, 5.0, 0.75, 0.5, 0.1, 4.5, 1.8, 1.5)
        for name, value in zip(columns, row, strict=True):
            columns[name].append(value)
    parquet.write_artefact(path, "trajectories", columns, {"schema": parquet.SCHEMA_VERSION, "frames": 9})
    return path


def test_frames_are_read_in_order_and_empty_ones_are_reported(tmp_path):
    path = _record(tmp_path / "t.parquet", [(0, "a", "passenger", 1.0), (3, "a", "bus", 2.0), (3, "b", "truck", 3.0)])
    read = list(traffic_frames.read_frames(path, np.array([0, 1, 3, 8])))
    assert [frame.number for frame in read] == [0, 1, 3, 8]
    assert [frame.vehicles for frame in read] == [("a",), (), ("a", "b"), ()]
    assert read[2].kinds == ("bus", "truck")
    np.testing.assert_array_equal(read[0].boxes, [[1.0, 5.0, 0.75, 4.5, 1.8, 1.5, 0.5]])
    np.testing.assert_array_equal(read[0].pitch_rad, [0.1])


def test_rear_parts_are_distinguished_from_whole_vehicles():
    boxes = np.zeros((4, 7))
    whole = traffic_frames.TrafficFrame(0, ("a", "b", "b", "c"), ("bus",) * 4, boxes, np.zeros(4))
    np.testing.assert_array_equal(whole.part, [0, 0, 0, 0])
    jointed = traffic_frames.TrafficFrame(
        0, ("a", "b", "b", "c"), ("bus",) * 4, boxes, np.zeros(4), np.array([0, 0, 1, 0])
    )
    np.testing.assert_array_equal(jointed.several_parts(), [False, True, True, False])


def test_ground_truth_are_vehicles_whose_centre_is_in_the_region(tmp_path):
    rows = [(0, "in", "passenger", 0.0), (0, "on the far plane", "bus", 10.0), (0, "on foot", "pedestrian", 5.0)]
    rows += [(0, "before", "truck", -1e-9), (0, "within", "delivery", 10.0 - 1e-9)]
    (frame,) = traffic_frames.read_frames(_record(tmp_path / "t.parquet", rows), np.array([0]))
    assert [frame.vehicles[i] for i in frame.target_rows(ROI)] == ["in", "within"]


def test_frames_are_spread_evenly():
    assert traffic_frames.spaced_frames(10, 5).tolist() == [1, 3, 5, 7, 9]
    assert traffic_frames.spaced_frames(10, 1).tolist() == [5]
    assert traffic_frames.spaced_frames(7, 3).tolist() == [1, 3, 5]
    assert traffic_frames.spaced_frames(5000, 500)[[0, -1]].tolist() == [5, 4995]
    for wanted in (0, 7, 8):
        assert traffic_frames.spaced_frames(7, wanted).tolist() == list(range(7))
