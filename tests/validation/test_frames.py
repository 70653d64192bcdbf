"""Frames of unseen traffic: read back, what is ground truth, and how they are spread over a record."""

import numpy as np
import pytest

from pipeline import load
from pipeline.artefacts import schemas, tables
from pipeline.core.errors import InputError
from pipeline.core.grid import Roi
from pipeline.validation import frames, unseen_traffic

ROI = Roi((0.0, 0.0, 0.0), (10.0, 10.0, 5.0))


def _record(path, rows):
    """Rows of (frame, vehicle, kind, x)."""
    names = ("frame", "vehicle", "part", "kind", "x_m", "y_m", "z_m", "yaw_rad", "pitch_rad")
    columns = {name: [] for name in (*names, "length_m", "width_m", "height_m")}
    for frame, vehicle, kind, x in rows:
        row = (frame, vehicle, 0, kind, x, 5.0, 0.75, 0.5, 0.1, 4.5, 1.8, 1.5)
        for name, value in zip(columns, row, strict=True):
            columns[name].append(value)
    tables.write(path, "trajectories", columns, {"schema": schemas.VERSION, "frames": 9})
    return path


def test_frames_are_read_in_order_and_empty_ones_are_told(tmp_path):
    path = _record(tmp_path / "t.parquet", [(0, "a", "passenger", 1.0), (3, "a", "bus", 2.0), (3, "b", "truck", 3.0)])
    read = list(frames.read(path, np.array([0, 1, 3, 8])))
    assert [frame.number for frame in read] == [0, 1, 3, 8]
    assert [frame.vehicles for frame in read] == [("a",), (), ("a", "b"), ()]
    assert read[2].kinds == ("bus", "truck")
    np.testing.assert_array_equal(read[0].boxes, [[1.0, 5.0, 0.75, 4.5, 1.8, 1.5, 0.5]])
    np.testing.assert_array_equal(read[0].pitch_rad, [0.1])


def test_rear_parts_are_told_from_whole_vehicles():
    boxes = np.zeros((4, 7))
    whole = frames.TrafficFrame(0, ("a", "b", "b", "c"), ("bus",) * 4, boxes, np.zeros(4))
    np.testing.assert_array_equal(whole.part, [0, 0, 0, 0])
    jointed = frames.TrafficFrame(0, ("a", "b", "b", "c"), ("bus",) * 4, boxes, np.zeros(4), np.array([0, 0, 1, 0]))
    np.testing.assert_array_equal(jointed.several_parts(), [False, True, True, False])


def test_ground_truth_are_vehicles_whose_centre_is_in_the_region(tmp_path):
    rows = [(0, "in", "passenger", 0.0), (0, "on the far plane", "bus", 10.0), (0, "on foot", "pedestrian", 5.0)]
    rows += [(0, "before", "truck", -1e-9), (0, "within", "delivery", 10.0 - 1e-9)]
    (frame,) = frames.read(_record(tmp_path / "t.parquet", rows), np.array([0]))
    assert [frame.vehicles[i] for i in frame.wanted(ROI)] == ["in", "within"]


def test_unseen_traffic_has_another_seed_and_frames_further_apart():
    scenario = load("scenarios/nishishinjuku")
    unseen = unseen_traffic.scenario_of(scenario, 250)
    assert unseen.seed not in (scenario.seed, *(scenario.model_copy(update={"seed": n}).seed for n in range(100)))
    assert (unseen.traffic.frames, unseen.traffic.frame_period_s) == (250, 2.0)
    assert unseen.traffic.kinds == scenario.traffic.kinds
    assert unseen_traffic.scenario_of(scenario, 250).seed == unseen.seed
    other = scenario.model_copy(update={"seed": 2})
    assert unseen_traffic.scenario_of(other, 250).seed != unseen.seed


def test_frames_are_spread_over_the_record(mini):
    scenario = load(mini)  # a finished file: 40 frames every 0.5 s, so that every fourth is 2 s apart
    assert unseen_traffic.scenario_of(scenario, 10) is scenario
    np.testing.assert_array_equal(unseen_traffic.numbers(scenario, 40, 10), np.arange(0, 40, 4))
    np.testing.assert_array_equal(unseen_traffic.numbers(scenario, 40, 3), [0, 12, 24])
    with pytest.raises(InputError, match=r"--frames: 11, of traffic with 40 frames every 0.5 s; at most 10"):
        unseen_traffic.numbers(scenario, 40, 11)
